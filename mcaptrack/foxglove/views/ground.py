"""Rows drawn on the ground plane or as 3D boxes, in metres: a scene for each picture, or for each frame.

Letters: N people, P points.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.foxglove import SCENE, SceneMessages, class_colour, colours, message_class
from mcaptrack.foxglove.views import label_places, styles
from mcaptrack.foxglove.views.image import BATCH, View
from mcaptrack.foxglove.views.people import (
    ForecastPaths,
    PeopleInParts,
    base_heights,
    bodies_of,
    by_count,
    ellipses,
    forecasts_in_parts,
    latest,
    segments,
    shown_at,
    trails,
)
from mcaptrack.foxglove.views.styles import RETRACKED, TrackStyle
from mcaptrack.geometry.arrays import Floats, Ints, taken
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.plane import GroundPlane, Planes
from mcaptrack.schema import DETECTIONS, Frame
from mcaptrack.schema.framing import frame_times, join_frames

_FORECAST_PX: Final = 3.0
#: The opacity of detections, which tracks are seen through.
_DETECTED: Final = 0.3125
#: The outline of a picture ends where a pixel is this many times as large on the ground as in the middle of the lower
#: edge; the horizon is farther away.
_FARTHEST: Final = 20.0
_OUTLINE: Final = (0.5, 0.5, 0.5, 0.75)
#: The lifetime of a scene, in usual intervals between scenes.
_LIFETIME: Final = 1.5


def frame_of(prefix: str) -> str:
    """The name of the coordinate frame of a camera's ground plane."""
    return f"{prefix.strip('/')}/ground"


def world_of(prefix: str) -> str:
    """The name of the parent of that frame."""
    return f"{prefix.strip('/')}/world"


def lifetime_ns(t_ns: Ints) -> int:
    """The lifetime of scenes at these times: until the next one is due, and a little longer."""
    steps = np.diff(t_ns)
    return round(_LIFETIME * float(np.quantile(steps, 0.95))) if len(steps) else NS_PER_S


class Instants:
    """The instants of the scenes of a channel, in batches."""

    def __init__(self, t_ns: Ints, frame_id: str) -> None:
        self.t_ns, self._frame_id, self._lifetime_ns = t_ns, frame_id, lifetime_ns(t_ns)

    def batches(self, first: int = 0, last: int | None = None) -> Iterator[tuple[slice, SceneMessages]]:
        """Yield the span and the empty scenes of each batch, from instant ``first`` to before ``last``."""
        last = len(self.t_ns) if last is None else last
        for start in range(first, last, BATCH):
            span = slice(start, min(start + BATCH, last))
            yield span, SceneMessages(self.t_ns[span], self._frame_id, self._lifetime_ns)

    def numbered(self, span: slice, scene: SceneMessages) -> View:
        """Yield time, number and payload of the scenes of a batch."""
        yield from zip(self.t_ns[span].tolist(), range(span.start, span.stop), scene.messages(), strict=True)


def tracks(shown: PeopleInParts, t_ns: Ints, frame_id: str, style: TrackStyle) -> View:
    """Draw cylinders, or 3D boxes, with ids and fading trails; interpolated positions are fainter.

    ``shown`` are those at these times.
    """
    instants = Instants(t_ns, frame_id)
    for first, last, people in shown.parts(BATCH):
        has_body = people.has_body()
        placed = np.asarray(np.isfinite(people.at_m).all(axis=1), np.bool_)
        lines = trails(people, placed, t_ns)
        longest = lines.row.shape[1] - 1
        rgb, strength = style.colours(people.number), styles.opacity(people.observed)
        alpha, body_alpha = 0.875 * strength, 0.625 * strength
        places = np.column_stack([people.at_m, people.body.base_m()])
        apart_m = np.zeros(len(people.number))
        apart_m[placed] = label_places.heights(t_ns, people.frame[placed], people.number[placed], people.at_m[placed])
        for span, scene in instants.batches(first, last):
            rows = np.arange(*np.searchsorted(people.frame, [span.start, span.stop]))
            rows = rows[placed[rows]]
            for points, is_solid, these in _alike(lines.points, has_body, rows):
                trail = places[lines.row[these, -points:], : 3 if is_solid else 2]
                opacity = styles.fade(points, longest + 1)
                if style.marker.in_pieces:
                    trail, opacity = segments(trail, style.trail), np.repeat(opacity[1:], 2)
                frame, label = people.frame[these] - span.start, people.label[these]
                if is_solid:
                    boxes = taken(people.body, these)
                    scene.boxes(
                        frame, label, boxes, rgb[these], body_alpha[these], style.box, trail, opacity, style.marker,
                        style.sign,
                    )  # fmt: skip
                else:
                    scene.people(
                        frame, label, people.at_m[these], rgb[these], alpha[these], style.marker, trail, opacity,
                        apart_m[these], style.sign,
                    )  # fmt: skip
            yield from instants.numbered(span, scene)


def detections(frames: Sequence[Frame], t_ns: Ints, frame_id: str, classes: Mapping[int, str] = {}) -> View:
    """Draw the 3D boxes of detections, a frame at each of the times, in the colours of their classes.

    Labels are the ids of the detector, or the numbers of rows where not all boxes of a frame have one of their own.
    """
    instants = Instants(t_ns, frame_id)
    joined = join_frames(DETECTIONS, frames)
    body = bodies_of(joined.rows)
    complete = np.flatnonzero(np.isfinite(np.column_stack([body.centre_m, body.size_m])).all(axis=1))
    number = joined.rows["source_id"].astype(np.int64)
    if (number < 0).any() or len(np.unique(np.stack([joined.frame, number]), axis=1).T) < len(number):
        number = np.arange(len(number)) - joined.ends[joined.frame]
    rgb = class_colours(joined.rows["class_id"].astype(np.int64), classes)
    bounds = np.searchsorted(joined.frame[complete], np.arange(len(t_ns) + 1))
    for span, scene in instants.batches():
        rows = complete[bounds[span.start] : bounds[span.stop]]
        some = taken(body, rows)
        scene.boxes(
            joined.frame[rows] - span.start, number[rows], some, rgb[rows], np.full(len(rows), _DETECTED),
            RETRACKED.box, some.centre_m[:, None], np.ones(1), RETRACKED.marker,
        )  # fmt: skip
        yield from instants.numbered(span, scene)


def _alike(points: Ints, has_body: NDArray[np.bool_], rows: Ints) -> Iterator[tuple[int, bool, Ints]]:
    """Split rows by the number of points of their trail and by whether they have a 3D box."""
    for is_solid in (False, True):
        some = rows[has_body[rows] == is_solid]
        for count, chosen in by_count(points[some]):
            yield count, is_solid, some[chosen]


def class_colours(class_id: Ints, classes: Mapping[int, str]) -> Floats:
    """The colours of classes (N,), (N, 3)."""
    unique, which = np.unique(class_id, return_inverse=True)
    table = [class_colour(class_number, classes.get(class_number, "")) for class_number in unique.tolist()]
    return np.array(table, float).reshape(-1, 3)[which]


def predictions(frames: Sequence[Frame], t_ns: Ints, frame_id: str, bodies: Sequence[Frame] = ()) -> View:
    """Draw the latest forecasts as lines that fade into the future, with the ellipses of their last step.

    ``bodies`` are tracks with 3D boxes; forecasts of these are drawn at the height of their bottoms.
    """
    instants = Instants(t_ns, frame_id)
    wanted = latest(frames, t_ns)
    for first, last, forecasts in forecasts_in_parts(frames, wanted, BATCH, is_whole=bool(bodies)):
        futures = [
            (raised(future, frames, bodies), ellipses(future.spread_m2), colours(future.number)) for future in forecasts
        ]
        for span, scene in instants.batches(first, last):
            for future, (half, turn), rgb in futures:
                which, frame = shown_at(future.message, wanted[span])
                path = future.path_m[which]
                weaker = styles.fade_ahead(path.shape[1])
                is_known = np.isfinite(half[which]).all(axis=1)
                for has_ellipse in (True, False):
                    ok = is_known == has_ellipse
                    at = which[ok]
                    spread = (future.end_m[at], half[at], turn[at]) if has_ellipse else None
                    scene.forecasts(frame[ok], future.number[at], path[ok], rgb[at], weaker, _FORECAST_PX, spread)
            yield from instants.numbered(span, scene)


def raised(future: ForecastPaths, frames: Sequence[Frame], bodies: Sequence[Frame]) -> ForecastPaths:
    """Forecasts with a height: that of the bottom of the 3D box, or of the usual one if a track has none."""
    if not bodies:
        return future
    height = base_heights(bodies, frame_times(frames)[future.message], future.number)
    has_height = np.isfinite(height)
    height[~has_height] = np.median(height[has_height]) if has_height.any() else 0.0
    along = np.broadcast_to(height[:, None, None], (*future.path_m.shape[:2], 1))
    return future._replace(
        path_m=np.concatenate([future.path_m, along], axis=2), end_m=np.column_stack([future.end_m, height])
    )


def robot(t_ns: int, frame_id: str) -> View:
    """Draw a robot once, at its frame, with which it moves."""
    scene = message_class(SCENE)()
    entity = scene.entities.add(id="robot", frame_id=frame_id, frame_locked=True)
    entity.timestamp.FromNanoseconds(t_ns)
    part = entity.triangles.add()
    part.pose.orientation.w = 1.0
    red, green, blue = styles.WHITE
    part.color.r, part.color.g, part.color.b, part.color.a = red, green, blue, styles.ROBOT_ALPHA
    for x, y in styles.ROBOT_M.tolist():
        part.points.add(x=x, y=y)
    part.indices.extend([0, 1, 2, 0, 2, 3])
    yield t_ns, 0, scene.SerializeToString(deterministic=True)


def outlines(planes: Planes, start_ns: int, frame_id: str) -> View:
    """Draw the outline of the picture on the ground, at the time from which each plane holds, until the next."""
    t_ns = np.array([max(start_ns, since) for since, _ in planes], np.int64)
    if len(t_ns):
        t_ns[0] = start_ns
    keep = np.append(t_ns[1:] > t_ns[:-1], True)[: len(t_ns)]
    scene = SceneMessages(t_ns[keep], frame_id, 0)
    for number, (_, plane) in enumerate(plane for plane, kept in zip(planes, keep.tolist(), strict=True) if kept):
        around_m = outline(plane)
        if len(around_m):
            scene.outline(number, "picture", around_m, _OUTLINE)
    yield from zip(t_ns[keep].tolist(), range(int(keep.sum())), scene.messages(), strict=True)


def outline(plane: GroundPlane) -> Floats:
    """The outline of the picture on the ground, (P, 2) m, cut off before the horizon; empty if no ground is visible."""
    width, height = float(plane.width_px), float(plane.height_px)
    corners = np.array([[0.0, 0], [width, 0], [width, height], [0, height]])
    depth = np.append(corners, np.ones((4, 1)), axis=1) @ plane.matrix[2]
    near = float(plane.matrix[2] @ [width / 2, height, 1.0])
    if not near:
        return np.empty((0, 2))
    share = depth / near - 1 / _FARTHEST
    out: list[Floats] = []
    for this in range(4):
        other = (this + 1) % 4
        if share[this] >= 0:
            out.append(corners[this])
        if share[this] * share[other] < 0:
            out.append(corners[this] + share[this] / (share[this] - share[other]) * (corners[other] - corners[this]))
    return plane.pixels_to_metres(np.array(out).reshape(-1, 2))
