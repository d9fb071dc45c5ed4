"""Rows drawn on pictures: one annotation message for each picture.

Letters: N people, P points.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.foxglove import Annotations, colours
from mcaptrack.foxglove.views import label_places
from mcaptrack.foxglove.views.label_places import INTERPOLATED, OBSERVED, TrackStyle, line_unit
from mcaptrack.foxglove.views.people import (
    ForecastPaths,
    People,
    PeopleInParts,
    by_count,
    by_plane,
    ellipse_points,
    ellipses,
    forecasts_in_parts,
    latest,
    segments,
    shown_at,
    trails,
)
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.geometry.plane import Planes
from mcaptrack.schema import DETECTIONS, Frame
from mcaptrack.schema.framing import frame_times, join_frames

View = Iterator[tuple[int, int, bytes]]

#: The number of pictures of a batch.
BATCH: Final = 128
_WORDS_PX: Final = 12.0
#: The size of the rhombus that marks a position without a box.
_MARK_PX: Final = 4.0
_ELLIPSE_POINTS: Final = 14
#: Objects farther than this from the picture are not drawn.
_FAR_PX: Final = 1e5
_GREY, _WHITE = (0.75, 0.75, 0.75), (1.0, 1.0, 1.0)


class PictureTimes(NamedTuple):
    """The times of pictures, rising, and their stamps, by which viewers match drawings with pictures."""

    t_ns: Ints
    stamp_ns: Ints

    def batches(self, first: int = 0, last: int | None = None) -> Iterator[tuple[slice, Annotations]]:
        """Batches of the pictures from ``first`` to before ``last``, with the annotations to draw on."""
        last = len(self.t_ns) if last is None else last
        for start in range(first, last, BATCH):
            span = slice(start, min(start + BATCH, last))
            yield span, Annotations(self.stamp_ns[span])

    def numbered(self, span: slice, drawn: Annotations) -> View:
        """The messages of a batch: time, number and payload."""
        times = self.t_ns[span].tolist()
        yield from zip(times, range(span.start, span.stop), drawn.messages(), strict=True)


def fade(count: int, longest: int, weakest: float = 0.125) -> Floats:
    """The opacities of the last ``count`` of ``longest`` lines; the last is the strongest."""
    return np.linspace(weakest, 0.875, longest)[longest - count :]


def detections(frames: Sequence[Frame], pictures: PictureTimes, planes: Planes) -> View:
    """Draw thin grey boxes, on the pictures in which people were detected."""
    thickness = 1.0 * line_unit(frames, planes)
    times = frame_times(frames)
    for span, drawn in pictures.batches():
        at = pictures.t_ns[span]
        first, last = np.searchsorted(times, at[0], "left"), np.searchsorted(times, at[-1], "right")
        near = frames[int(first) : int(last)]
        number = np.searchsorted(at, times[first:last])
        hit = at[np.minimum(number, len(at) - 1)] == times[first:last]
        joined = join_frames(DETECTIONS, [f for f, ok in zip(near, hit.tolist(), strict=True) if ok])
        of = number[hit][joined.frame]
        boxes = columns_to_boxes(joined.rows)
        fine = np.isfinite(boxes).all(axis=1)
        grey = np.broadcast_to(_GREY, (int(fine.sum()), 3))
        drawn.loops(of[fine], _corners(boxes[fine]), grey, np.full(len(grey), 0.875), thickness)
        yield from pictures.numbered(span, drawn)


def tracks(
    shown: PeopleInParts,
    pictures: PictureTimes,
    unit: float,
    style: TrackStyle,
    path: CameraPath | None = None,
) -> View:
    """Draw boxes with numbers and fading trails; interpolated positions are fainter.

    ``shown`` are those at the times of the pictures; lines of thickness 1 are ``unit`` px thick. ``path`` is how the
    camera moves, if trails are to stay where people walked.
    """
    for first, last, people in shown.parts(BATCH):
        has_place = _near(people.foot_px)
        has_box = _near(people.box_px)
        lines = trails(people, has_place, pictures.t_ns)
        longest = lines.row.shape[1] - 1
        rgb = np.broadcast_to(_WHITE, (len(people.number), 3)) if style.is_white else colours(people.number)
        alpha = np.where(people.observed, OBSERVED, INTERPOLATED)
        named = np.flatnonzero(has_box | has_place)
        corner = _label_corners(people, named, has_box[named], unit, style, pictures.t_ns)
        for span, drawn in pictures.batches(first, last):
            rows = np.arange(*np.searchsorted(people.frame, [span.start, span.stop]))
            boxed, marked = rows[has_box[rows]], rows[~has_box[rows] & has_place[rows]]
            frame = people.frame - span.start
            boxes = people.box_px[boxed]
            if style.is_open:
                drawn.pairs(frame[boxed], _sides(boxes), rgb[boxed], alpha[boxed, None], style.thickness * unit)
            else:
                drawn.loops(frame[boxed], _corners(boxes), rgb[boxed], alpha[boxed], style.thickness * unit)
            mark = people.foot_px[marked, None] + _MARK_PX * unit * np.array([[-1, 0], [0, -1], [1, 0], [0, 1]])
            drawn.loops(frame[marked], mark, rgb[marked], alpha[marked], style.thickness * unit)
            for points, chosen in by_count(lines.points[rows]):
                if points > 1 and style.dash:
                    row = lines.row[rows[chosen], -points:]
                    t_ns = pictures.t_ns[people.frame[row]]
                    walked = _moved(people.foot_px[row], t_ns, t_ns[:, -1], path)
                    of, shade = frame[rows[chosen]], rgb[rows[chosen]]
                    drawn.pairs(
                        of, segments(walked, style.dash), shade, fade(points - 1, longest), style.thickness * unit
                    )
            these = slice(*np.searchsorted(named, rows[[0, -1]] + [0, 1])) if len(rows) else slice(0)
            of = named[these]
            drawn.labels(frame[of], corner[these], people.label[of], rgb[of], _WORDS_PX * unit)
            yield from pictures.numbered(span, drawn)


def _label_corners(
    people: People, named: Ints, has_box: NDArray[np.bool_], unit: float, style: TrackStyle, at_ns: Ints
) -> Floats:
    """The lower left corners of the labels of some people (N, 2): at their boxes, and away from each other."""
    corner = np.where(has_box[:, None], people.box_px[named, :2], people.foot_px[named])
    size = np.where(has_box[:, None], people.box_px[named, 2:], 0.0)
    words_px = _WORDS_PX * unit
    if style.name_at == "below":
        corner = corner + size * [0, 1] + [0, words_px + style.thickness * unit]
    elif style.name_at == "beside":
        corner = corner + size * [1, 0] + [style.thickness * unit, words_px]
    else:
        corner = np.maximum(corner, [-np.inf, words_px])  # not above the picture
    extent = label_places.extents(people.label[named], words_px)
    is_down = style.name_at != "above"
    number, frame = people.number[named], people.frame[named]
    corner[:, 1] += label_places.shifts(at_ns, frame, number, corner, extent, is_down)
    return corner


def _moved(points: Floats, then_ns: Ints, now_ns: Ints, path: CameraPath | None) -> Floats:
    """Points (N, P, 2) of pictures at times (N, P) or (N, 1), in the picture at another time for each (N,)."""
    if path is None:
        return points
    boxes = np.concatenate([points, np.zeros_like(points)], axis=-1).reshape(-1, 4)
    before, later = np.broadcast_to(then_ns, points.shape[:2]).ravel(), np.repeat(now_ns, points.shape[1])
    return path.to_pictures(path.to_scene(boxes, before), later)[:, :2].reshape(points.shape)


def predictions(
    frames: Sequence[Frame], pictures: PictureTimes, planes: Planes, path: CameraPath | None = None
) -> View:
    """Draw the latest forecasts as lines that fade into the future, with the 95 % ellipses of their last step.

    ``path`` is how the camera moves, if forecasts are to stay where they lead to.
    """
    unit = line_unit((), planes)
    made_ns = frame_times(frames)
    wanted = latest(frames, pictures.t_ns)
    # Planes of pictures: each picture has its own, unless ``path`` says how it moved.
    has_own = path is None and len(planes) > 1
    # Planes are those of pictures, and forecasts are made between them.
    last = np.searchsorted(pictures.t_ns, made_ns, "right") - 1
    seen_ns = pictures.t_ns[np.maximum(last, 0)] if len(pictures.t_ns) else made_ns
    for first, until, forecasts in forecasts_in_parts(frames, wanted, BATCH):
        futures = forecasts if planes else []
        once = [] if has_own else [_in_pixels(future, planes, made_ns[future.message]) for future in futures]
        for span, drawn in pictures.batches(first, until):
            for number, future in enumerate(futures):
                which, frame = shown_at(future.message, wanted[span])
                now_ns = pictures.t_ns[span][frame]
                seen = _in_pixels(future.chosen(which), planes, now_ns) if has_own else once[number].chosen(which)
                then_ns = seen_ns[seen.message][:, None]
                ok = seen.has_path
                if seen.path_px.shape[1] > 1 and ok.any():
                    line = segments(_moved(seen.path_px[ok], then_ns[ok], now_ns[ok], path))
                    weaker = fade(line.shape[1] // 2, line.shape[1] // 2, weakest=0.25)[::-1]
                    drawn.pairs(frame[ok], line, seen.rgb[ok], weaker, 1.5 * unit)
                ok = seen.has_ellipse
                if ok.any():
                    around_px = _moved(seen.ellipse_px[ok], then_ns[ok], now_ns[ok], path)
                    drawn.loops(frame[ok], around_px, seen.rgb[ok], np.full(len(around_px), 0.5), unit, fill=0.15)
            yield from pictures.numbered(span, drawn)


class _Future(NamedTuple):
    """Forecasts in pixels, and which of their parts can be drawn."""

    message: Ints
    rgb: Floats
    path_px: Floats
    has_path: NDArray[np.bool_]
    ellipse_px: Floats
    has_ellipse: NDArray[np.bool_]

    def chosen(self, which: Ints) -> _Future:
        """Some of the forecasts."""
        paths, rings = (self.path_px[which], self.has_path[which]), (self.ellipse_px[which], self.has_ellipse[which])
        return _Future(self.message[which], self.rgb[which], *paths, *rings)


def _in_pixels(future: ForecastPaths, planes: Planes, at_ns: Ints) -> _Future:
    """Forecasts (N,) in the pictures at times (N,)."""
    ring = ellipse_points(future.end_m, *ellipses(future.spread_m2), _ELLIPSE_POINTS)
    path, ellipse = np.full_like(future.path_m, np.nan), np.full_like(ring, np.nan)
    for plane, held in by_plane(planes, at_ns):
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
