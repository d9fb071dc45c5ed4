"""Rows drawn on pictures: one annotation message for every picture.

Letters: N people, P points.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.foxglove import Annotations, colours
from mcaptrack.foxglove.views import looks
from mcaptrack.foxglove.views.looks import Look
from mcaptrack.foxglove.views.people import (
    Forecasts,
    People,
    around,
    by_count,
    by_plane,
    ellipses,
    forecasts,
    latest,
    pieces,
    shown_at,
    trails,
)
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.plane import Planes
from mcaptrack.schema import DETECTIONS, Frame

View = Iterator[tuple[int, int, bytes]]

#: Messages are made for so many pictures at a time.
_BATCH: Final = 128
_WORDS_PX: Final = 12.0
#: Where nobody knows a box, a place is marked by a rhombus of this size.
_MARK_PX: Final = 4.0
_ELLIPSE_POINTS: Final = 14
#: Farther than this from the picture nothing is drawn.
_FAR_PX: Final = 1e5
_GREY, _WHITE = (0.75, 0.75, 0.75), (1.0, 1.0, 1.0)


class Pictures(NamedTuple):
    """The pictures of a camera: their times, rising, and their stamps, by which viewers match what is drawn on them."""

    t_ns: Ints
    stamp_ns: Ints

    def batches(self) -> Iterator[tuple[slice, Annotations]]:
        """Some pictures at a time, and what is to be drawn on them."""
        for start in range(0, len(self.t_ns), _BATCH):
            span = slice(start, min(start + _BATCH, len(self.t_ns)))
            yield span, Annotations(self.stamp_ns[span])

    def numbered(self, span: slice, drawn: Annotations) -> View:
        """The messages of these pictures: time, number and payload."""
        times = self.t_ns[span].tolist()
        yield from zip(times, range(span.start, span.stop), drawn.messages(), strict=True)


def fade(count: int, longest: int, strongest: float = 0.875, weakest: float = 0.125) -> Floats:
    """How opaque the last ``count`` of so many lines are, the last most."""
    return np.linspace(weakest, strongest, longest)[longest - count :]


def detections(frames: Sequence[Frame], pictures: Pictures, planes: Planes) -> View:
    """Thin grey boxes, at the pictures that were looked at."""
    thickness = 1.0 * looks.unit(frames, planes)
    times = np.array([frame.t_ns for frame in frames], np.int64)
    for span, drawn in pictures.batches():
        at = pictures.t_ns[span]
        first, last = np.searchsorted(times, at[0], "left"), np.searchsorted(times, at[-1], "right")
        near = frames[int(first) : int(last)]
        number = np.searchsorted(at, times[first:last])
        hit = at[np.minimum(number, len(at) - 1)] == times[first:last]
        rows = DETECTIONS.joined([f.rows for f, ok in zip(near, hit.tolist(), strict=True) if ok])
        of = np.repeat(number[hit], [len(f.rows) for f, ok in zip(near, hit.tolist(), strict=True) if ok])
        boxes = columns_to_boxes(rows)
        fine = np.isfinite(boxes).all(axis=1)
        grey = np.broadcast_to(_GREY, (int(fine.sum()), 3))
        drawn.loops(of[fine], _corners(boxes[fine]), grey, np.full(len(grey), 0.875), thickness)
        yield from pictures.numbered(span, drawn)


def tracks(people: People, pictures: Pictures, unit: float, look: Look) -> View:
    """Boxes with their numbers, fainter where nobody was seen, and where people were in the last seconds, fading.

    ``people`` are those at the times of the pictures; lines of one are ``unit`` pixels thick.
    """
    has_place = _near(people.foot_px)
    has_box = _near(people.box_px)
    lines = trails(people, has_place, pictures.t_ns)
    longest = lines.row.shape[1] - 1
    rgb = np.broadcast_to(_WHITE, (len(people.number), 3)) if look.is_white else colours(people.number)
    alpha = np.where(people.seen, looks.SEEN, looks.FILLED_IN)
    bounds = np.searchsorted(people.frame, np.arange(len(pictures.t_ns) + 1))
    for span, drawn in pictures.batches():
        rows = np.arange(bounds[span.start], bounds[span.stop])
        boxed, marked = rows[has_box[rows]], rows[~has_box[rows] & has_place[rows]]
        frame = people.frame - span.start
        boxes = people.box_px[boxed]
        if look.is_open:
            drawn.pairs(frame[boxed], _sides(boxes), rgb[boxed], alpha[boxed, None], look.thickness * unit)
        else:
            drawn.loops(frame[boxed], _corners(boxes), rgb[boxed], alpha[boxed], look.thickness * unit)
        mark = people.foot_px[marked, None] + _MARK_PX * unit * np.array([[-1, 0], [0, -1], [1, 0], [0, 1]])
        drawn.loops(frame[marked], mark, rgb[marked], alpha[marked], look.thickness * unit)
        for points, chosen in by_count(lines.points[rows]):
            if points > 1 and look.dash:
                path = people.foot_px[lines.row[rows[chosen], -points:]]
                of, shade = frame[rows[chosen]], rgb[rows[chosen]]
                drawn.pairs(of, pieces(path, look.dash), shade, fade(points - 1, longest), look.thickness * unit)
        named = np.concatenate([boxed, marked])
        named.sort()
        corner = np.where(has_box[named, None], people.box_px[named, :2], people.foot_px[named])
        size = np.where(has_box[named, None], people.box_px[named, 2:], 0.0)
        words_px = _WORDS_PX * unit
        if look.name_at == "below":
            corner = corner + size * [0, 1] + [0, words_px + look.thickness * unit]
        elif look.name_at == "beside":
            corner = corner + size * [1, 0] + [look.thickness * unit, words_px]
        drawn.words(frame[named], corner, people.number[named], rgb[named], words_px)
        yield from pictures.numbered(span, drawn)


def predictions(frames: Sequence[Frame], pictures: Pictures, planes: Planes) -> View:
    """The latest forecasts as lines that fade into the future, with the ellipses that hold 95 % of where they end."""
    unit = looks.unit((), planes)
    made_ns = np.array([frame.t_ns for frame in frames], np.int64)
    wanted = latest(frames, pictures.t_ns)
    futures = [_in_pixels(future, planes, made_ns) for future in forecasts(frames)] if planes else []
    for span, drawn in pictures.batches():
        for future in futures:
            which, frame = shown_at(future.message, wanted[span])
            rgb = future.rgb[which]
            ok = future.has_path[which]
            if future.path_px.shape[1] > 1 and ok.any():
                path = pieces(future.path_px[which[ok]])
                weaker = fade(path.shape[1] // 2, path.shape[1] // 2, weakest=0.25)[::-1]
                drawn.pairs(frame[ok], path, rgb[ok], weaker, 1.5 * unit)
            ok = future.has_ellipse[which]
            if ok.any():
                around_px = future.ellipse_px[which[ok]]
                drawn.loops(frame[ok], around_px, rgb[ok], np.full(len(around_px), 0.5), unit, fill=0.15)
        yield from pictures.numbered(span, drawn)


class _Future(NamedTuple):
    """Forecasts on the picture; what can't be drawn is marked."""

    message: Ints
    rgb: Floats
    path_px: Floats
    has_path: NDArray[np.bool_]
    ellipse_px: Floats
    has_ellipse: NDArray[np.bool_]


def _in_pixels(future: Forecasts, planes: Planes, made_ns: Ints) -> _Future:
    ring = around(future.end_m, *ellipses(future.spread_m2), _ELLIPSE_POINTS)
    path, ellipse = np.full_like(future.path_m, np.nan), np.full_like(ring, np.nan)
    for plane, held in by_plane(planes, made_ns[future.message]):
        for out, metres in ((path, future.path_m), (ellipse, ring)):
            out[held] = plane.metres_to_pixels(metres[held].reshape(-1, 2)).reshape(-1, *metres.shape[1:])
    return _Future(future.message, colours(future.number), path, _near(path), ellipse, _near(ellipse))


def _near(values: Floats) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(values) < _FAR_PX).all(axis=tuple(range(1, values.ndim))))


def _corners(boxes: Floats) -> Floats:
    """Boxes (N, 4) -> their corners (N, 4, 2), once around."""
    return _points_of(boxes, [[0, 0], [1, 0], [1, 1], [0, 1]])


def _sides(boxes: Floats) -> Floats:
    """Boxes (N, 4) -> the ends (N, 4, 2) of their left and right edges."""
    return _points_of(boxes, [[0, 0], [0, 1], [1, 0], [1, 1]])


def _points_of(boxes: Floats, shares: list[list[int]]) -> Floats:
    return np.asarray(boxes[:, None, :2] + boxes[:, None, 2:] * np.array(shares), np.float64)
