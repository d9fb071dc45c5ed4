"""Re-tracking of each class by itself: links, swaps and gaps never join tracks of different classes.

Letters: C classes, F frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.classes import first_classes
from mcaptrack.schema.framing import join_frames, split_rows
from mcaptrack.transforms.motion_limits import ClassNames, limits_by_class, units_m


class Movers(NamedTuple):
    """The unit and the kind of the tracks of one class.

    All of re-tracking is made for people. Other classes are re-tracked in a unit of length in which they move as people
    do: ``unit_m`` metres. ``on_ground`` says that a tracker made their tracks in metres, with velocities, and not
    from boxes in pictures: detections don't merge where objects occlude one another, and the tracker has confirmed each
    track by the scores of its detections. ``usual_score`` is the median score of the log,
    ``drift_m_per_s`` how much velocities change within a second, None for what the options say.
    """

    unit_m: float = 1.0
    on_ground: bool = False
    usual_score: float = 1.0
    drift_m_per_s: float | None = None


#: People in pictures.
PEOPLE: Final[Movers] = Movers()


def usual_score(frames: Sequence[Frame]) -> float:
    """The median score of the observed rows of a log; 1 where there are none."""
    parts = [frame.rows["score"][frame.rows["observed"]] for frame in frames if len(frame.rows)]
    scores = np.concatenate(parts) if parts else np.empty(0)
    scores = scores[np.isfinite(scores)]
    return max(float(np.median(scores)), 1e-6) if len(scores) else 1.0


def movers_of(frames: Sequence[Frame], class_names: ClassNames, usual_score: float, class_limits: str = "") -> Movers:
    """The unit and the kind of the tracks in frames of one class."""
    parts = [frame.rows for frame in frames if len(frame.rows)]
    if not parts:
        return PEOPLE
    on_ground = all(np.isfinite(part["vx_m_per_s"]).all() for part in parts)
    number = int(parts[0]["class_id"][0])
    limits = limits_by_class([number], class_names, class_limits)[number]
    drift_m_per_s = limits.drift_m_per_s if on_ground else None
    (unit_m,) = units_m([number], class_names, class_limits)
    return Movers(unit_m, on_ground, usual_score, drift_m_per_s)


def split_classes(frames: Sequence[Frame]) -> list[Sequence[Frame]]:
    """The frames of each class (C,), all F of them, in the order in which classes appear.

    The class of a track is that of its first row.
    """
    joined = join_frames(TRACKS, frames)
    rows = joined.rows
    if not len(rows) or (rows["class_id"] == rows["class_id"][0]).all():
        return [frames]
    ids, track = np.unique(rows["track_id"], return_inverse=True)
    class_id = first_classes(track, rows["class_id"], len(ids))[track]
    classes, first = np.unique(class_id, return_index=True)
    # Ids of tracks tell classes apart that appear in one frame: the order of rows has no influence.
    begins = zip(classes.tolist(), joined.frame[first].tolist(), strict=True)
    lowest = [rows["track_id"][(joined.frame == frame) & (class_id == one)].min() for one, frame in begins]
    order = np.lexsort((np.array(lowest), joined.frame[first]))
    index = [frame.index for frame in frames]
    out: list[Sequence[Frame]] = []
    for one in classes[order].tolist():
        mine = class_id == one
        ends = np.concatenate([[0], mine.cumsum()])[joined.ends[1:]]
        out.append(split_rows(joined.t_ns, index, TRACKS.joined([rows[mine]]), ends))
    return out


def join_classes(runs: Sequence[Iterator[tuple[Frame, ...]]]) -> Iterator[tuple[Frame, ...]]:
    """The results of each class (C,) as one: ids follow on those of the class before. One result for each of F frames.

    All frames of a result have tracks with the same ids: offline and online tracks, and predictions.
    """
    results = [list(run) for run in runs]
    taken = [0]
    for result in results:
        ids = (frame.rows["track_id"].max() for frames in result for frame in frames if len(frame.rows))
        taken.append(taken[-1] + int(max(ids, default=0)))
    for parts in zip(*results, strict=True):
        yield tuple(_joined(frames, taken) for frames in zip(*parts, strict=True))


def _joined(frames: Sequence[Frame], above: Sequence[int]) -> Frame:
    """Frames of one output (C,) as one; ids of each are raised ``above`` those of the classes before."""
    rows = np.concatenate([frame.rows for frame in frames])
    rows["track_id"] += np.repeat(above[: len(frames)], [len(frame.rows) for frame in frames])
    return frames[0]._replace(rows=rows)
