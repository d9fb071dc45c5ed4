"""3D boxes and forecasts drawn on the pictures of calibrated cameras, which may move.

Letters: M pictures, N objects, E lines, P points.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.foxglove import Annotations, Cuboids, colours
from mcaptrack.foxglove.views import label_places, styles
from mcaptrack.foxglove.views.ground import raised
from mcaptrack.foxglove.views.image import BATCH, PictureTimes, View
from mcaptrack.foxglove.views.people import (
    People,
    PeopleInParts,
    ellipse_points,
    ellipses,
    forecasts,
    latest,
    segments,
    shown_at,
)
from mcaptrack.foxglove.views.styles import Scale, TrackStyle
from mcaptrack.geometry.arrays import Bools, Floats, Ints, taken
from mcaptrack.geometry.pinhole import Lens, project
from mcaptrack.schema import Frame

#: Lines are cut off at this distance before the camera.
_NEAR_M: Final = 0.1
#: Lines that end farther outside of the picture than so many of its widths are not drawn.
_MOST_WIDTHS: Final = 8.0
#: The corners of a box, as shares of its size, and its edges as pairs of these.
_CORNERS: Final = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
_EDGES: Final = np.array([(a, b) for a in range(8) for b in range(a) if bin(a ^ b).count("1") == 1])


class MovingCamera(NamedTuple):
    """M pictures of a calibrated camera: their log times, rising, their stamps, and the times at which the world is
    drawn on them, rising, in ns; the pose of the world in the camera for each, rotations (M, 3, 3) and translations
    (M, 3), NaN where it is not known; its lenses, which of them took each picture (M,), and the size of the pictures.

    ``width_px`` and ``height_px`` are that size.
    """

    t_ns: Ints
    stamp_ns: Ints
    at_ns: Ints
    rotation: Floats
    translation: Floats
    lenses: Sequence[Lens]
    lens: Ints
    width_px: int
    height_px: int


def tracks(frames: Sequence[Frame], camera: MovingCamera, style: TrackStyle) -> View:
    """Draw the edges of 3D boxes with ids; interpolated ones are fainter."""
    scale = Scale.of_width(camera.width_px)
    pictures = PictureTimes(camera.t_ns, camera.stamp_ns)
    for first, last, people in PeopleInParts(frames, camera.at_ns, ()).parts(BATCH):
        with_body = np.flatnonzero(people.has_body())
        rgb, alpha = style.colours(people.number), styles.opacity(people.observed)
        px, is_seen = _on_pictures(corners(taken(people.body, with_body))[:, _EDGES], people.frame[with_body], camera)
        named, corner = _label_corners(people, with_body, px, is_seen, scale.text_px, camera.at_ns)
        for span, drawn in pictures.batches(first, last):
            some = slice(*np.searchsorted(people.frame[with_body], [span.start, span.stop]))
            rows = with_body[some]
            frame = people.frame[rows] - span.start
            thickness = style.thickness * scale.line_px
            _draw(drawn, frame, px[some], is_seen[some], rgb[rows], alpha[rows, None], thickness)
            here = slice(*np.searchsorted(people.frame[named], [span.start, span.stop]))
            these = named[here]
            frame = people.frame[these] - span.start
            drawn.labels(frame, corner[here], people.label[these], rgb[these], scale.text_px)
            yield from pictures.numbered(span, drawn)


def _label_corners(
    people: People, rows: Ints, px: Floats, is_seen: Bools, text_px: float, at_ns: Ints
) -> tuple[Ints, Floats]:
    """The rows with boxes in view, of those with lines (N, E, 2, 2) in pictures, and the lower left corners of their
    labels: at the upper left of what is seen of a box, and away from each other.
    """
    has_name = is_seen.any(axis=1)
    named = rows[has_name]
    inside = np.where(is_seen[..., None, None], px, np.inf)[has_name].reshape(len(named), -1, 2)
    corner = np.maximum(inside.min(axis=1, initial=np.inf), [0.0, text_px])
    frame, number, label = people.frame[named], people.number[named], people.label[named]
    corner[:, 1] += label_places.shifts(at_ns, frame, number, corner, label, text_px, is_down=False)
    return named, corner


def predictions(frames: Sequence[Frame], camera: MovingCamera, bodies: Sequence[Frame]) -> View:
    """Draw the latest forecasts of tracks with 3D boxes, ``bodies``, as lines on the ground with ellipses."""
    line_px = Scale.of_width(camera.width_px).line_px
    wanted = latest(frames, camera.at_ns)
    futures = []
    for plain in forecasts(frames):
        future = raised(plain, frames, bodies)
        flat = ellipse_points(plain.end_m, *ellipses(plain.spread_m2), styles.ELLIPSE_POINTS)
        up = np.broadcast_to(future.end_m[:, None, 2:], (*flat.shape[:2], 1))
        ring = np.concatenate([flat, up], axis=2)
        ring = np.concatenate([ring, ring[:, :1]], axis=1)
        futures.append((future, ring, colours(future.number)))
    pictures = PictureTimes(camera.t_ns, camera.stamp_ns)
    for span, drawn in pictures.batches():
        for future, ring, rgb in futures:
            which, frame = shown_at(future.message, wanted[span])
            steps = future.path_m.shape[1] - 1
            weaker = np.broadcast_to(styles.fade_ahead(steps), (len(which), steps))
            for points, alpha in ((future.path_m, weaker), (ring, np.full((len(which), 1), styles.ELLIPSE_ALPHA))):
                ends = segments(points[which]).reshape(len(which), points.shape[1] - 1, 2, 3)
                px, is_seen = _on_pictures(ends, frame + span.start, camera)
                _draw(drawn, frame, px, is_seen, rgb[which], alpha, styles.FORECAST_LINE * line_px)
        yield from pictures.numbered(span, drawn)


def corners(boxes: Cuboids) -> Floats:
    """The corners (N, 8, 3) of boxes."""
    along, across, up = np.moveaxis(_CORNERS * boxes.size_m[:, None], -1, 0)
    cosine, sine = np.cos(boxes.heading_rad)[:, None], np.sin(boxes.heading_rad)[:, None]
    turned = np.stack([along * cosine - across * sine, along * sine + across * cosine, up], axis=-1)
    return np.asarray(boxes.centre_m[:, None] + turned, np.float64)


def _draw(
    drawn: Annotations, frame: Ints, px: Floats, is_seen: Bools, rgb: Floats, alpha: Floats, thickness: float
) -> None:
    """Draw those of the lines (N, E, 2, 2) of objects (N,) that are seen (N, E)."""
    of, line = np.nonzero(is_seen)
    if len(of):
        opacity = np.broadcast_to(alpha, is_seen.shape)[of, line]
        drawn.pairs(frame[of], px[of, line], rgb[of], opacity[:, None], thickness)


def _on_pictures(ends_m: Floats, picture: Ints, camera: MovingCamera) -> tuple[Floats, Bools]:
    """Lines (N, E, 2, 3) in metres to lines (N, E, 2, 2) in pixels of the pictures (N,), and which are seen (N, E).

    Lines are cut off before the camera. Objects outside of the picture are not seen at all.
    """
    turn, shift = camera.rotation[picture], camera.translation[picture]
    at = np.einsum("nij,neaj->neai", turn, ends_m) + shift[:, None, None]
    depth = at[..., 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        is_seen = (depth > _NEAR_M).any(axis=2)
        share = (_NEAR_M - depth) / (depth[..., ::-1] - depth)
        at = np.where((depth < _NEAR_M)[..., None], at + share[..., None] * (at[..., ::-1, :] - at), at)
    px = np.full((*at.shape[:-1], 2), np.nan)
    for number in np.unique(camera.lens[picture]).tolist():
        mine = camera.lens[picture] == number
        points = at[mine].reshape(-1, 3)
        px[mine] = project(points, camera.lenses[number], np.eye(3), np.zeros(3))[0].reshape(px[mine].shape)
    size = np.array([camera.width_px, camera.height_px], float)
    with np.errstate(invalid="ignore"):
        is_seen &= (np.abs(px - size / 2) < _MOST_WIDTHS * size.max()).all(axis=(2, 3))
        seen_px = np.where(is_seen[..., None, None], px, np.nan).reshape(len(px), -1, 2)
        low, high = np.fmin.reduce(seen_px, axis=1), np.fmax.reduce(seen_px, axis=1)
        is_inside = ((high > 0) & (low < size)).all(axis=1)
    return px, np.asarray(is_seen & is_inside[:, None], np.bool_)
