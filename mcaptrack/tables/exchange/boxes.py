"""The boxes of a channel as columns, for the files of other programs. Letters: N rows, F frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.schema import DETECTIONS, SCHEMAS
from mcaptrack.schema.classes import class_name, class_names
from mcaptrack.schema.framing import joined_parts
from mcaptrack.sources.cameras import cameras
from mcaptrack.sources.pictures import size_of_pictures

#: The id of boxes without one.
NO_ID: Final = -1
_NAMES: Final = {
    "mot": "MOTChallenge",
    "kitti": "KITTI",
    "coco": "COCO",
    "cvat": "CVAT",
    "boxes-csv": "this table",
}


@dataclass(frozen=True)
class ExportedBoxes:
    """Rows with a box in pixels, in order of frames.

    ``frame`` (N,) are numbers of pictures from 0; ``frames`` (F,) those of all frames, with or without rows, and
    ``t_ns`` (F,) their times. ``id`` (N,) is -1 for detections. ``boxes`` (N, 4) are left, top, width and height in px;
    ``xy_m`` (N, 2) is NaN where it isn't known; ``score`` (N,) is float32, NaN where there is none. ``size`` is that of
    pictures, None if there are none. ``has_ids``: the rows are tracks.
    """

    topic: str
    frames: Ints
    t_ns: Ints
    frame: Ints
    id: Ints
    boxes: Floats
    xy_m: Floats
    score: NDArray[np.float32]
    class_id: Ints
    observed: Bools
    names: Mapping[int, str]
    has_ids: bool
    has_3d: bool
    size: tuple[int, int] | None
    notes: tuple[str, ...]

    @property
    def classes(self) -> dict[int, str]:
        """The names of the classes that rows have, by number, rising."""
        return {number: class_name(number, self.names) for number in np.unique(self.class_id).tolist()}

    @property
    def last_frame(self) -> int:
        """The number of the last frame."""
        return int(self.frames[-1])

    def left_out(self, form: str, holds: frozenset[str]) -> str:
        """The contents of rows that the file lacks, as text; "" if nothing is missing."""
        scored = np.isfinite(self.score)
        has_contents = {
            "sizes and headings of 3D boxes": self.has_3d,
            "positions in metres": "metres" not in holds and bool(np.isfinite(self.xy_m).any()),
            "scores": "scores" not in holds and bool(scored.any()),
            "which boxes were filled in": "observed" not in holds and not self.observed.all(),
        }
        lacking = [what for what, is_there in has_contents.items() if is_there]
        out = [f"{_NAMES[form]} has no place for {' and '.join(lacking)}; they are left out"] if lacking else []
        if form in ("mot", "kitti") and scored.any() and not scored.all():
            out.append(f"{int((~scored).sum()):,} boxes without a score have 1 there")
        return "; ".join(out)


def read_boxes(opened: log.Log, topic: str) -> ExportedBoxes:
    """The boxes of a channel. Raises McaptrackError if no row has a box in pixels."""
    channel = opened.channel(topic)
    schema = SCHEMAS[channel.schema_name]
    columns = opened.frame_columns(topic, schema)
    numbers, notes = _frame_numbers(topic, columns.numbers)
    parts: list[tuple[NDArray[np.generic], ...]] = []
    without = 0
    has_3d = False
    for first, _, joined in joined_parts(schema, columns):
        rows = joined.rows
        boxes = columns_to_boxes(rows)
        kept = np.isfinite(boxes).all(axis=1)
        without += int((~kept).sum())
        has_3d = has_3d or bool(np.isfinite(rows["z_m"]).any())
        is_detections = schema is DETECTIONS
        parts.append(
            (
                numbers[joined.frame[kept] + first],
                np.full(int(kept.sum()), NO_ID) if is_detections else rows["track_id"][kept].copy(),
                boxes[kept],
                np.stack([rows["x_m"][kept], rows["y_m"][kept]], axis=-1),
                rows["score"][kept].copy(),
                rows["class_id"][kept].astype(np.int64),
                np.ones(int(kept.sum()), bool) if is_detections else rows["observed"][kept].copy(),
            )
        )
    if not parts or not sum(len(part[0]) for part in parts):
        what = "positions in metres, and no boxes in pixels" if without else "no rows"
        raise McaptrackError(f"{opened.path}: {topic} has {what}; a file of boxes needs boxes in pixels")
    if without:
        notes.append(f"{topic}: {without:,} rows without a box in pixels are left out")
    frame, track_id, boxes, xy_m, score, class_id, observed = (
        np.concatenate([part[k] for part in parts]) for k in range(7)
    )
    return ExportedBoxes(
        topic, numbers, columns.t_ns, frame, track_id, boxes, xy_m, score, class_id, observed,
        class_names(channel.metadata), schema is not DETECTIONS, has_3d, _size(opened, topic), tuple(notes),
    )  # fmt: skip


def _frame_numbers(topic: str, numbers: Ints) -> tuple[Ints, list[str]]:
    """The numbers of frames (F,), and notes: numbers that don't rise are replaced by the order of the frames."""
    if len(numbers) and (numbers[0] < 0 or (np.diff(numbers) <= 0).any()):
        text = f"{topic}: several of its frames are of one picture; its frames are counted instead, from 0"
        return np.arange(len(numbers)), [text]
    return numbers, []


def _size(opened: log.Log, topic: str) -> tuple[int, int] | None:
    """Width and height of the pictures of a channel's camera; None if there are none that can be decoded."""
    for camera in cameras(opened):
        if topic in camera.topics and camera.pictures:
            return size_of_pictures(opened, camera.pictures)
    return None
