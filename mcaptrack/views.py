"""What a person looks at: one annotation message for every picture, made from the rows around it.

Tracks on another clock than the video's are brought to the times of its pictures, so that boxes move with the people.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack import foxglove
from mcaptrack.boxes import columns_to_boxes
from mcaptrack.clock import seconds_to_ns
from mcaptrack.plane import Planes, plane_at
from mcaptrack.resample import resample
from mcaptrack.schema import DETECTIONS, PREDICTIONS, TRACKS, Frame, Rows, Schema

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
View = Iterator[tuple[int, int, bytes]]

#: Suffix of a view's topic.
SUFFIX: Final = "/view/image"
_TRAIL_S: Final = 2.0
_TRAIL_POINTS: Final = 8
_MAX_HOLE_S: Final = 2.0
#: Forecasts are shown until the next ones are due.
_FORECAST_S: Final = 1.0
_GREY: Final = (0.75, 0.75, 0.75, 0.9)
_WHITE: Final = (1.0, 1.0, 1.0, 0.7)


def view(
    topic: str, schema: Schema, frames: Sequence[Frame], picture_ns: Ints, planes: Planes, stamp_ns: Ints | None = None
) -> View:
    """The annotation messages (time, frame, payload) of a channel, one for each picture.

    ``picture_ns`` are the times of the pictures, rising; ``stamp_ns`` what stands in them, by which viewers match what
    is drawn, if that is another time. Predictions need ``planes`` to come back to pixels.
    """
    stamps = (picture_ns if stamp_ns is None else stamp_ns).tolist()
    if schema is DETECTIONS:
        yield from _detections(frames, picture_ns, stamps)
    elif schema is TRACKS:
        yield from _tracks(frames, picture_ns, stamps, planes, truth=topic.endswith("/truth"))
    elif schema is PREDICTIONS:
        yield from _predictions(frames, picture_ns, stamps, planes)


def _detections(frames: Sequence[Frame], picture_ns: Ints, stamps: list[int]) -> View:
    at = {frame.t_ns: frame.rows for frame in frames}
    for index, (t_ns, stamp) in enumerate(zip(picture_ns.tolist(), stamps, strict=True)):
        boxes = columns_to_boxes(at.get(t_ns, DETECTIONS.empty()))
        yield t_ns, index, foxglove.pack_annotations(stamp, boxes, None, thickness=1.0, rgba=_GREY)


def _tracks(frames: Sequence[Frame], picture_ns: Ints, stamps: list[int], planes: Planes, truth: bool) -> View:
    """Boxes with ids, and the trail of the last seconds, fading. True tracks are thin and white."""
    shown, at = resample(frames, picture_ns, seconds_to_ns(_MAX_HOLE_S))
    boxes = columns_to_boxes(shown)
    feet = boxes[:, :2] + boxes[:, 2:] * [0.5, 0.5 if planes and planes[0][1].point == "center" else 1.0]
    first, last = (np.searchsorted(at, np.arange(len(picture_ns)), side) for side in ("left", "right"))
    trails = _Trails(shown["track_id"], feet, picture_ns[at])
    for index, (t_ns, stamp) in enumerate(zip(picture_ns.tolist(), stamps, strict=True)):
        span = slice(int(first[index]), int(last[index]))
        ids = shown["track_id"][span].tolist()
        if truth:
            yield t_ns, index, foxglove.pack_annotations(stamp, boxes[span], None, thickness=1.0, rgba=_WHITE)
        else:
            paths = [trails.until(row) for row in range(span.start, span.stop)]
            yield t_ns, index, foxglove.pack_annotations(stamp, boxes[span], ids, [path for path in paths if path])


class _Trails:
    """Where each row's person was in the seconds before it."""

    def __init__(self, ids: Ints, feet: Floats, t_ns: Ints) -> None:
        order = np.lexsort((t_ns, ids))
        self._place = np.empty(len(ids), int)
        self._place[order] = np.arange(len(ids))
        self._ids, self._feet, self._t_ns = ids[order], feet[order], t_ns[order]
        self._first = np.searchsorted(self._ids, self._ids, "left")

    def until(self, row: int) -> foxglove.Path | None:
        end = int(self._place[row])
        start = int(self._first[end])
        since = int(self._t_ns[end]) - seconds_to_ns(_TRAIL_S)
        start += int(np.searchsorted(self._t_ns[start : end + 1], since))
        if end - start < 1:
            return None
        picked = np.unique(np.linspace(start, end, min(_TRAIL_POINTS, end - start + 1)).round().astype(int))
        points = self._feet[picked]
        if not np.isfinite(points).all():
            return None
        age = (self._t_ns[end] - self._t_ns[picked]) / seconds_to_ns(_TRAIL_S)
        return foxglove.Path(int(self._ids[end]), points, (0.9 * (1 - age) + 0.05).tolist())


def _predictions(frames: Sequence[Frame], picture_ns: Ints, stamps: list[int], planes: Planes) -> View:
    """The latest forecasts as lines that fade into the future."""
    made_ns = np.array([frame.t_ns for frame in frames], np.int64)
    latest = np.searchsorted(made_ns, picture_ns, "right") - 1
    drawn: tuple[int, list[foxglove.Path]] = (-1, [])
    none = np.empty((0, 4))
    for index, (t_ns, stamp, number) in enumerate(zip(picture_ns.tolist(), stamps, latest.tolist(), strict=True)):
        if number < 0 or t_ns - made_ns[number] > seconds_to_ns(_FORECAST_S):
            yield t_ns, index, foxglove.pack_annotations(stamp, none, None)
            continue
        if drawn[0] != number:
            drawn = (number, list(_paths(frames[number].rows, planes, int(made_ns[number]))))
        yield t_ns, index, foxglove.pack_annotations(stamp, none, None, drawn[1], thickness=1.5)


def _paths(rows: Rows, planes: Planes, t_ns: int) -> Iterator[foxglove.Path]:
    plane = plane_at(planes, t_ns)
    if plane is None or len(rows) == 0:
        return
    points = plane.metres_to_pixels(np.stack([rows["x_m"], rows["y_m"]], axis=-1))
    starts = np.append(np.flatnonzero(rows["step"] == rows["step"].min()), len(rows))
    for start, end in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        path = points[start:end]
        if np.isfinite(path).all():
            opacity = np.linspace(0.9, 0.1, end - start).tolist()
            yield foxglove.Path(int(rows["track_id"][start]), path, opacity)
