"""Frames of tracks by class, and several outputs of each class as one again. Letters: C classes, F frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.ragged import group_index
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.classes import first_classes
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns
from mcaptrack.schema.framing import joined_parts, spans_of, split_rows


def split_classes(frames: FrameColumns) -> list[FrameColumns]:
    """The frames of each class (C,), all F of them, in the order in which classes appear.

    The class of a track is that of its first row.
    """
    columns = [part.rows[["track_id", "class_id"]].copy() for _, _, part in joined_parts(TRACKS, frames)]
    rows = np.concatenate([TRACKS.empty()[["track_id", "class_id"]], *columns])
    ids, track = np.unique(rows["track_id"], return_inverse=True)
    class_id = first_classes(track, rows["class_id"], len(ids))[track]
    # Ids of tracks tell classes apart that appear in one frame: the order of rows has no influence.
    order = np.lexsort((rows["track_id"], group_index(np.diff(frames.ends))))
    classes, first = np.unique(class_id[order], return_index=True)
    if len(classes) < 2:
        return [frames]
    out = {number: FrameCollector(TRACKS) for number in classes[np.argsort(first)].tolist()}
    for low, high, part in joined_parts(TRACKS, frames):
        here = class_id[frames.ends[low] : frames.ends[high]]
        for number, collector in out.items():
            mine, numbers = here == number, frames.numbers[low:high]
            collector.extend(part.t_ns, numbers, np.append(0, mine.cumsum())[part.ends], part.rows[mine])
    return [collector.done() for collector in out.values()]


def join_classes(classes: Sequence[Sequence[FrameColumns]]) -> Iterator[tuple[Frame, ...]]:
    """The outputs of several classes (C,) as one: ids follow on those of the class before. A tuple for each frame.

    All outputs of a class have tracks with the same ids: offline and online tracks, predictions and decisions.
    """
    above = np.cumsum([0, *(max(map(_highest_id, outputs)) for outputs in classes)])
    return zip(*(_joined(frames, above) for frames in zip(*classes, strict=True)), strict=True)


def _highest_id(frames: FrameColumns) -> int:
    """The highest id of a track; 0 if there is none."""
    parts = joined_parts(frames.schema, frames)
    return max((int(part.rows["track_id"].max(initial=0)) for _, _, part in parts), default=0)


def _joined(frames: Sequence[FrameColumns], above: Ints) -> Iterator[Frame]:
    """One output of all classes (C,) as one; ids of each are raised ``above`` those of the classes before."""
    schema = frames[0].schema
    for low, high in spans_of(np.sum([frame.ends for frame in frames], axis=0)):
        counts = [np.diff(frame.ends[low : high + 1]) for frame in frames]
        rows = schema.joined([frame.rows(low, high) for frame in frames])
        raised = rows["track_id"] + np.repeat(above[: len(frames)], [int(count.sum()) for count in counts])
        rows["track_id"] = np.where(rows["track_id"] < 0, rows["track_id"], raised)
        order = np.argsort(np.concatenate([group_index(count) for count in counts]), kind="stable")
        ends = np.cumsum(np.sum(counts, axis=0))
        yield from split_rows(frames[0].t_ns[low:high], frames[0].numbers[low:high], rows.take(order), ends)
