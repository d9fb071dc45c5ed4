"""Rows drawn on pictures: one annotation message for each picture.

Letters: N people, P points.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.foxglove import Annotations, colours
from mcaptrack.foxglove.views import label_places, styles
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
from mcaptrack.foxglove.views.styles import Scale, TrackStyle
from mcaptrack.geometry.arrays import Bools, Floats, Ints, taken
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.geometry.plane import Planes
from mcaptrack.schema import DETECTIONS, Frame
from mcaptrack.schema.framing import frame_times, join_frames

View = Iterator[tuple[int, int, bytes]]

#: The number of pictures of a batch.
BATCH: Final = 128
#: The size of the rhombus that marks a position without a box.
_MARK_PX: Final = 4.0
#: Objects farther than this from the picture are not drawn.
_FAR_PX: Final = 1e5


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


def detections(frames: Sequence[Frame], pictures: PictureTimes, planes: Planes) -> View:
    """Draw thin grey boxes, on the pictures in which people were detected."""
    thickness = Scale.of(frames, planes).line_px
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
        grey = np.broadcast_to(styles.GREY, (int(fine.sum()), 3))
        drawn.loops(of[fine], _corners(boxes[fine]), grey, np.full(len(grey), 0.875), thickness)
        yield from pictures.numbered(span, drawn)


def tracks(
    shown: PeopleInParts,
    pictures: PictureTimes,
    scale: Scale,
    style: TrackStyle,
    path: CameraPath | None = None,
) -> View:
    """Draw boxes with numbers and fading trails; interpolated positions are fainter.

    ``shown`` are those at the times of the pictures. ``path`` is how the camera moves, if trails are to stay where
    people walked.
    """
    thickness = style.thickness * scale.line_px
    for first, last, people in shown.parts(BATCH):
        has_place = _near(people.foot_px)
        has_box = _near(people.box_px)
        lines = trails(people, has_place, pictures.t_ns)
        longest = lines.row.shape[1] - 1
        rgb, alpha = style.colours(people.number), styles.opacity(people.observed)
        named = np.flatnonzero(has_box | has_place)
        corner = _label_corners(people, named, has_box[named], scale, style, pictures.t_ns)
        for span, drawn in pictures.batches(first, last):
            rows = np.arange(*np.searchsorted(people.frame, [span.start, span.stop]))
            boxed, marked = rows[has_box[rows]], rows[~has_box[rows] & has_place[rows]]
            frame = people.frame - span.start
            box = _corners(people.box_px[boxed])
            drawn.loops(frame[boxed], box, rgb[boxed], alpha[boxed], thickness, dashes=style.dashes)
            mark = people.foot_px[marked, None] + _MARK_PX * scale.line_px * np.array(
                [[-1, 0], [0, -1], [1, 0], [0, 1]]
            )
            drawn.loops(frame[marked], mark, rgb[marked], alpha[marked], thickness)
            for points, chosen in by_count(lines.points[rows]):
                if points > 1 and style.trail:
                    row = lines.row[rows[chosen], -points:]
                    t_ns = pictures.t_ns[people.frame[row]]
                    walked = _moved(people.foot_px[row], t_ns, t_ns[:, -1], path)
                    of, shade = frame[rows[chosen]], rgb[rows[chosen]]
                    drawn.pairs(of, segments(walked, style.trail), shade, styles.fade(points - 1, longest), thickness)
            these = slice(*np.searchsorted(named, rows[[0, -1]] + [0, 1])) if len(rows) else slice(0)
            of = named[these]
            drawn.labels(frame[of], corner[these], people.label[of], rgb[of], scale.text_px)
            yield from pictures.numbered(span, drawn)


def _label_corners(people: People, named: Ints, has_box: Bools, scale: Scale, style: TrackStyle, at_ns: Ints) -> Floats:
    """The lower left corners of the labels of some people (N, 2): at their boxes, and away from each other."""
    corner = np.where(has_box[:, None], people.box_px[named, :2], people.foot_px[named])
    size = np.where(has_box[:, None], people.box_px[named, 2:], 0.0)
    line_px = style.thickness * scale.line_px
    if style.name_at == "below":
        corner = corner + size * [0, 1] + [0, scale.text_px + line_px]
    elif style.name_at == "beside":
        corner = corner + size * [1, 0] + [line_px, scale.text_px]
    else:
        corner = np.maximum(corner, [-np.inf, scale.text_px])  # not above the picture
    number, frame, label = people.number[named], people.frame[named], people.label[named]
    is_down = style.name_at != "above"
    corner[:, 1] += label_places.shifts(at_ns, frame, number, corner, label, scale.text_px, is_down)
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
    """Draw the latest forecasts as lines that fade into the future, with the ellipses of their last step.

    Ellipses end at the border of the picture; those with most of their area outside say nothing and are left out.
    ``path`` is how the camera moves, if forecasts are to stay where they lead to.
    """
    line_px = Scale.of((), planes).line_px
    size = np.array([(plane.width_px, plane.height_px) for _, plane in planes[:1]], float).ravel()
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
                seen = _in_pixels(taken(future, which), planes, now_ns) if has_own else taken(once[number], which)
                then_ns = seen_ns[seen.message][:, None]
                ok = seen.has_path
                if seen.path_px.shape[1] > 1 and ok.any():
                    line = segments(_moved(seen.path_px[ok], then_ns[ok], now_ns[ok], path))
                    weaker = styles.fade_ahead(line.shape[1] // 2)
                    drawn.pairs(frame[ok], line, seen.rgb[ok], weaker, styles.FORECAST_LINE * line_px)
                known = np.flatnonzero(seen.has_ellipse)
                around_px = _moved(seen.ellipse_px[known], then_ns[known], now_ns[known], path)
                for of, ring in clipped(around_px, size):
                    alpha = np.full(len(of), styles.ELLIPSE_ALPHA)
                    drawn.loops(
                        frame[known[of]],
                        ring,
                        seen.rgb[known[of]],
                        alpha,
                        styles.ELLIPSE_LINE * line_px,
                        styles.ELLIPSE_FILL,
                    )
            yield from pictures.numbered(span, drawn)


class _Future(NamedTuple):
    """Forecasts in pixels, and which of their parts can be drawn."""

    message: Ints
    rgb: Floats
    path_px: Floats
    has_path: Bools
    ellipse_px: Floats
    has_ellipse: Bools


def _in_pixels(future: ForecastPaths, planes: Planes, at_ns: Ints) -> _Future:
    """Forecasts (N,) in the pictures at times (N,)."""
    ring = ellipse_points(future.end_m, *ellipses(future.spread_m2), styles.ELLIPSE_POINTS)
    path, ellipse = np.full_like(future.path_m, np.nan), np.full_like(ring, np.nan)
    for plane, held in by_plane(planes, at_ns):
        for out, metres in ((path, future.path_m), (ellipse, ring)):
            out[held] = plane.metres_to_pixels(metres[held].reshape(-1, 2)).reshape(-1, *metres.shape[1:])
    return _Future(future.message, colours(future.number), path, _near(path), ellipse, _near(ellipse))


def clipped(rings: Floats, size: Floats) -> Iterator[tuple[Ints, Floats]]:
    """Cut convex polygons (N, P, 2) off at the border of a picture of a size (2,).

    Yields those with equally many points left, as indices of polygons and points (K, Q, 2). Polygons with less than
    half of their area in the picture are left out.
    """
    points, count = rings, np.full(len(rings), rings.shape[1])
    for axis, bound, sign in ((0, 0.0, 1), (1, 0.0, 1), (0, size[0], -1), (1, size[1], -1)):
        slot = np.arange(points.shape[1])
        following = np.take_along_axis(points, ((slot + 1) % np.maximum(count, 1)[:, None])[..., None], axis=1)
        depth, depth_after = (sign * (some[..., axis] - bound) for some in (points, following))
        is_in, is_in_after = depth >= 0, depth_after >= 0
        with np.errstate(divide="ignore", invalid="ignore"):
            cut = points + (depth / (depth - depth_after))[..., None] * (following - points)
        kept = np.stack([is_in, is_in != is_in_after], axis=2) & (slot < count[:, None])[..., None]
        both = np.stack([points, cut], axis=2).reshape(len(points), 2 * len(slot), 2)
        kept = kept.reshape(len(points), 2 * len(slot))
        count = kept.sum(axis=1)
        order = np.argsort(~kept, axis=1, kind="stable")[:, : count.max(initial=0)]
        points = np.take_along_axis(both, order[..., None], axis=1)
    whole = _areas(rings)
    for left, chosen in by_count(count):
        ring = points[chosen, :left]
        is_useful = 2 * _areas(ring) >= whole[chosen]
        if left > 2 and is_useful.any():
            yield chosen[is_useful], ring[is_useful]


def _areas(rings: Floats) -> Floats:
    """The areas (N,) of polygons (N, P, 2)."""
    x, y = rings[..., 0], rings[..., 1]
    return np.asarray(np.abs((x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1)) / 2)


def _near(values: Floats) -> Bools:
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(values) < _FAR_PX).all(axis=tuple(range(1, values.ndim))))


def _corners(boxes: Floats) -> Floats:
    """Boxes (N, 4) -> their corners (N, 4, 2), once around."""
    around = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    return np.asarray(boxes[:, None, :2] + boxes[:, None, 2:] * around, np.float64)
