"""Where zones and tracks are, in the units that they are compared in.

A zone in metres is compared with positions on the ground. A zone in pixels is brought to the ground by the plane of its
camera; where there is none, or several, it is compared with the points in the picture at which boxes touch the ground.

Letters: N rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.geometry.plane import GroundPlane, Planes
from mcaptrack.geometry.zones import Shape, Units, Zone
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.classes import class_name, is_person
from mcaptrack.schema.framing import joined_parts

#: Edges of a picture are curved on the ground where it has a lens: they are drawn with so many pieces.
_PIECES: Final = 16


class PlacedZone(NamedTuple):
    """A zone in the units that it is compared in; ``forward`` is the sign of crossings from its left to its right."""

    zone: Zone
    shape: Shape
    units: Units
    forward: int = 1


class TrackPositions(NamedTuple):
    """The rows of tracks that have a position, in order of track and time (N,).

    ``at`` are positions by units, (N, 2), NaN where not known: on the ground, and in the (reference) picture.
    ``picture_px`` are those in the picture of that time. ``frame`` is the index of the frame of each row.
    ``height_px`` is the usual height of boxes, NaN without boxes. ``low_m`` (N,) is the height at which each object
    stands, NaN where not known, ``class_id`` (N,) its class, and ``classes`` are the names of these.
    """

    at: Mapping[str, Floats]
    picture_px: Floats
    track: Ints
    frame: Ints
    t_ns: Ints
    height_px: float
    low_m: Floats
    class_id: Ints
    classes: Mapping[int, str]


def place_zone(zone: Zone, planes: Planes) -> PlacedZone:
    """Bring a zone in pixels to the ground, where one plane holds for all its pictures.

    Raises McaptrackError for a zone that reaches above the horizon.
    """
    shape = zone.shape()
    if zone.units == "metres":
        return PlacedZone(zone, shape, "metres")
    if len(planes) != 1:
        return PlacedZone(zone, shape, "pixels", -1)
    plane = planes[0][1]
    if plane.lens is not None:
        shape = _in_pieces(shape)
    parts = tuple(tuple(_on_ground(ring, plane, zone.name) for ring in part) for part in shape.parts)
    middle = np.concatenate([ring for part in shape.parts for ring in part]).mean(axis=0)
    corner = plane.pixels_to_metres(middle + np.array([[0.0, 0], [1, 0], [0, 1]]))
    (a, b), (c, d) = corner[1:] - corner[0]
    return PlacedZone(zone, Shape(parts, zone.is_line), "metres", 1 if a * d - b * c < 0 else -1)


def _in_pieces(shape: Shape) -> Shape:
    """The same shape with more points on each edge."""
    share = np.arange(_PIECES)[:, None] / _PIECES

    def cut(ring: Floats) -> Floats:
        start = ring[:-1] if shape.is_line else ring
        end = ring[1:] if shape.is_line else np.roll(ring, -1, axis=0)
        points = (start[:, None] + share * (end - start)[:, None]).reshape(-1, 2)
        return np.concatenate([points, ring[-1:]]) if shape.is_line else points

    return Shape(tuple(tuple(cut(ring) for ring in part) for part in shape.parts), shape.is_line)


def _on_ground(ring: Floats, plane: GroundPlane, name: str) -> Floats:
    xy_m = plane.pixels_to_metres(ring)
    above = np.flatnonzero(~np.isfinite(xy_m).all(axis=1))
    if len(above):
        x, y = ring[above[0]]
        raise McaptrackError(f"zone {name} reaches above the horizon, at ({x:g}, {y:g}) px: there is no ground")
    return xy_m


def positions_of(
    frames: Sequence[Frame], planes: Planes, path: CameraPath | None, classes: Mapping[int, str] = {}
) -> TrackPositions:
    """Find where tracks are, on the ground and in the picture; ``classes`` are the names of their classes.

    ``planes`` are those of the reference picture where the camera moves by ``path``, otherwise those of all pictures.
    """
    parts: list[tuple[Ints, ...]] = []
    places: list[tuple[Floats, ...]] = []
    since = np.array([start for start, _ in planes[1:]], np.int64)
    heights: list[Floats] = []
    for first, _, joined in joined_parts(TRACKS, frames):
        rows, t_ns = joined.rows, joined.row_ns
        boxes = columns_to_boxes(rows)
        in_scene = boxes if path is None else path.to_scene(boxes, t_ns)
        which = np.searchsorted(since, t_ns, "right")
        feet, seen = (np.stack([b[:, 0] + b[:, 2] / 2, b[:, 1] + b[:, 3]], axis=1) for b in (in_scene, boxes))
        metres = np.stack([rows["x_m"], rows["y_m"]], axis=1)
        for number, (_, plane) in enumerate(planes):
            of = which == number
            feet[of], seen[of] = plane.feet(in_scene[of]), plane.feet(boxes[of])
            unknown = of & ~np.isfinite(metres).all(axis=1) & np.isfinite(feet).all(axis=1)
            metres[unknown] = plane.pixels_to_metres(feet[unknown])
        parts.append((rows["track_id"].astype(np.int64), joined.frame + first, t_ns, rows["class_id"].astype(np.int64)))
        places.append((metres, feet, seen, rows["z_m"] - np.nan_to_num(rows["height_m"]) / 2))
        heights.append(boxes[:, 3])
    if not parts:
        none, nowhere = np.zeros(0, np.int64), np.zeros((0, 2))
        no_height = np.zeros(0)
        both = {"metres": nowhere, "pixels": nowhere}
        return TrackPositions(both, nowhere, none, none, none, np.nan, no_height, none, classes)
    track, frame, t_ns, kind = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.lexsort((frame, track))
    metres, feet, seen, low = (np.concatenate(column)[order] for column in zip(*places, strict=True))
    high = np.concatenate(heights)
    high = high[np.isfinite(high)]
    height_px = float(np.median(high)) if len(high) else np.nan
    return TrackPositions(
        {"metres": metres, "pixels": feet},
        seen,
        track[order],
        frame[order],
        t_ns[order],
        height_px,
        low,
        kind[order],
        classes,
    )


def is_counted(positions: TrackPositions, zone: Zone) -> Bools:
    """Mask the rows (N,) of the classes that a zone counts: by their names, and all people for the name of one."""
    if not zone.classes:
        return np.ones(len(positions.track), bool)
    wanted = {name.casefold() for name in zone.classes}
    has_people = any(map(is_person, wanted))
    names = {number: class_name(number, positions.classes) for number in np.unique(positions.class_id).tolist()}
    kept = [number for number, name in names.items() if name.casefold() in wanted or (has_people and is_person(name))]
    return np.isin(positions.class_id, np.array(kept, np.int64))


def missing_classes(positions: TrackPositions, zone: Zone, tracks: str) -> list[str]:
    """A note about a zone that counts classes of which no track is."""
    if not zone.classes or not len(positions.track) or is_counted(positions, zone).any():
        return []
    listed = ", ".join(class_name(number, positions.classes) for number in np.unique(positions.class_id).tolist())
    kind = "line" if zone.is_line else "zone"
    return [f"{kind} {zone.name} counts {', '.join(zone.classes)}; {tracks} has none of these, but {listed}"]


def ground_height_m(positions: TrackPositions, shape: Shape) -> float:
    """The height of the ground at a shape in metres: the median of where objects stand in its extent, or anywhere.

    0 if no heights are known, as on the plane of a camera.
    """
    is_known = np.isfinite(positions.low_m) & np.isfinite(positions.at["metres"]).all(axis=1)
    if not is_known.any():
        return 0.0
    low, high = shape.box
    places = positions.at["metres"]
    near = is_known & (places >= low).all(axis=1) & (places <= high).all(axis=1)
    return float(np.median(positions.low_m[near if near.any() else is_known]))
