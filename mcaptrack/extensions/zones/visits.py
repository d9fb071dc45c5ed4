"""Visits of zones, crossings of lines, and counts over time: rows of ZoneVisits, ZoneCrossings and ZoneCounts.

Letters: F frames, N rows, V visits, C crossings, Z zones and lines.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from math import isnan
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import foxglove
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.world_tracks import WorldInterval, WorldTracks, lacks_intervals, tracks_in_worlds
from mcaptrack.extensions.zones.shapes import Paths, Shape, Units, Zone, crossings, visits
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.geometry.plane import PERSON_HEIGHT_M, GroundPlane, Planes
from mcaptrack.schema import TRACKS, ZONE_COUNTS, ZONE_CROSSINGS, ZONE_VISITS, Frame, Rows
from mcaptrack.schema.classes import class_name, is_person
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns
from mcaptrack.schema.framing import JoinedFrames, frame_numbers, frame_times, joined_parts, split_rows

#: Frames of counts that are made at once.
_FRAMES_AT_ONCE: Final = 4096
_SIZES: Final = {"metres": "m", "pixels": "px"}


@dataclass(frozen=True)
class ZoneOptions:
    """Options of counting: how far from an edge a track has changed sides, and the longest gap within a visit.

    ``margin_m`` is in metres; in a picture without a ground plane it is in heights of people of 1.7 m.
    """

    margin_m: float = 0.25
    max_gap_s: float = 4.0


@dataclass(frozen=True)
class ZoneInWorlds:
    """Of a zone in so many worlds of re-tracking: medians and intervals of 90 %.

    ``tracks`` are the different tracks that visited it, ``mean_dwell_s`` is the mean of their visits, over the worlds
    that have any. ``then`` has by the name of each other zone the tracks that came here first, and there after.
    """

    worlds: int
    tracks: WorldInterval
    mean_dwell_s: WorldInterval | None
    then: Mapping[str, WorldInterval]

    def to_json(self) -> dict[str, Any]:
        """As values of JSON."""
        dwell, then = self.mean_dwell_s, {name: interval.to_json() for name, interval in self.then.items()}
        values = {"worlds": self.worlds, "tracks": self.tracks.to_json(), "then": then}
        return values | {"mean_dwell_s": dwell and dwell.to_json()}


@dataclass(frozen=True)
class ZoneTotals:
    """The totals of one zone or line for one channel of tracks.

    ``tracks`` are the different tracks that visited or crossed it. Of a zone: ``visits``, of which ``entered`` and
    ``left`` over its edge, the others began or ended inside; ``dwell_s`` of all visits together, their mean and
    median; the most tracks inside at a time, and their mean over time. Of a line: crossings ``forward`` and
    ``backward``. ``in_worlds`` is what worlds of re-tracking say of a zone, None without them.
    """

    zone: str
    is_line: bool
    tracks: int
    visits: int = 0
    entered: int = 0
    left: int = 0
    dwell_s: float = 0.0
    mean_dwell_s: float | None = None
    median_dwell_s: float | None = None
    most_inside: int = 0
    mean_inside: float | None = None
    forward: int = 0
    backward: int = 0
    in_worlds: ZoneInWorlds | None = None

    def to_json(self) -> dict[str, Any]:
        """The totals as values of JSON; of a zone without crossings, of a line without visits."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        if self.in_worlds is None:
            del values["in_worlds"]
        else:
            values["in_worlds"] = self.in_worlds.to_json()
        lines = ("forward", "backward")
        kept = {"zone", "is_line", "tracks", *lines} if self.is_line else values.keys() - set(lines)
        return {name: value for name, value in values.items() if name in kept}


def medians_of(zones: Iterable[ZoneInWorlds]) -> str:
    """The numbers that worlds have of zones, in words: medians, and intervals if any zone has these."""
    return "medians" + ", and intervals of 90 %" * any(zone.tracks.low is not None for zone in zones)


class ZoneEvents(NamedTuple):
    """Frames of visits, crossings and counts, one for each frame of the tracks; ``notes`` say what is odd."""

    visits: Sequence[Frame]
    crossings: Sequence[Frame]
    counts: Sequence[Frame]
    notes: list[str]


# Where zones and tracks are, in the units that they are compared in.
#
# A zone in metres is compared with positions on the ground. A zone in pixels is brought to the ground by the plane
# of its camera; where there is none, or several, it is compared with the points in the picture at which boxes touch
# the ground.
#
# Letters: N rows.


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
    none, nowhere = np.zeros(0, np.int64), np.zeros((0, 2))
    parts = [(none, none, none, none, nowhere, nowhere, nowhere, np.zeros(0), np.zeros(0))]
    since = np.array([start for start, _ in planes[1:]], np.int64)
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
        ids, low = rows["track_id"].astype(np.int64), rows["z_m"] - np.nan_to_num(rows["height_m"]) / 2
        of_class = rows["class_id"].astype(np.int64)
        parts.append((ids, joined.frame + first, t_ns, of_class, metres, feet, seen, low, boxes[:, 3]))
    *columns, high = (np.concatenate(column[1:] or column) for column in zip(*parts, strict=True))
    high = high[np.isfinite(high)]
    order = np.lexsort((columns[1], columns[0]))
    track, frame, t_ns, kind, metres, feet, seen, low = (column[order] for column in columns)
    height_px = float(np.median(high)) if len(high) else np.nan
    both = {"metres": metres, "pixels": feet}
    return TrackPositions(both, seen, track, frame, t_ns, height_px, low, kind, classes)


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


def find_zone_events(
    frames: Sequence[Frame], positions: TrackPositions, zones: Sequence[PlacedZone], options: ZoneOptions, name: str
) -> ZoneEvents:
    """Find visits of zones and crossings of lines, and count them.

    Parameters
    ----------
    frames : sequence of Frame
        Rows of Tracks.
    positions : TrackPositions
        Of these rows.
    zones : sequence of PlacedZone
    options : ZoneOptions
    name : str
        Of the tracks, for notes.

    Returns
    -------
    ZoneEvents

    Raises
    ------
    McaptrackError
        If tracks have no positions in the units of a zone.
    """
    notes: list[str] = []
    stays: list[_Stays] = []
    passes: list[_Passes] = []
    for placed in zones:
        paths, rows, margin = _paths(positions, placed, options, name)
        if placed.zone.is_line:
            row, sign = crossings(paths, placed.shape, margin)
            passes.append(_Passes(placed.zone.number, rows[row], sign * placed.forward > 0))
        else:
            stays.append(_Stays.of(placed, margin, rows, positions, paths))
        notes += _far_away(placed, paths.points, name)
        notes += missing_classes(positions, placed.zone, name)
    t_ns, numbers = frame_times(frames), frame_numbers(frames)
    return ZoneEvents(
        _visit_frames(stays, positions, t_ns, numbers),
        _crossing_frames(passes, positions, t_ns, numbers),
        _counts(zones, stays, passes, positions, t_ns, numbers),
        notes,
    )


def _paths(positions: TrackPositions, placed: PlacedZone, options: ZoneOptions, name: str) -> tuple[Paths, Ints, float]:
    """The paths of tracks in the units of a zone, the row of each of their points, and the margin in these units."""
    points = positions.at[placed.units]
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(points) and not len(rows):
        where = "positions in metres" if placed.units == "metres" else "boxes in the picture"
        raise McaptrackError(f"{name} has no {where}, which zone {placed.zone.name} in {placed.zone.units} needs")
    rows = rows[is_counted(positions, placed.zone)[rows]]
    gap_ns = seconds_to_ns(options.max_gap_s)
    margin = options.margin_m if placed.units == "metres" else options.margin_m / PERSON_HEIGHT_M * positions.height_px
    paths = Paths.of(points[rows], positions.t_ns[rows], positions.track[rows], gap_ns)
    return paths, rows, placed.shape.margin(margin)


def _far_away(placed: PlacedZone, points: Floats, name: str) -> Iterator[str]:
    """A note about a zone that lies beyond the places of all tracks."""
    if not len(points):
        return
    (low, high), least, most = placed.shape.box, points.min(axis=0), points.max(axis=0)
    if (low > most).any() or (high < least).any():
        unit = _SIZES[placed.units]
        spans = (
            f"({a[0]:.6g}, {a[1]:.6g}) to ({b[0]:.6g}, {b[1]:.6g}) {unit}" for a, b in ((low, high), (least, most))
        )
        kind = "line" if placed.zone.is_line else "zone"
        yield f"{kind} {placed.zone.name}, {next(spans)}, is beyond all of {name}, {next(spans)}"


class _Stays(NamedTuple):
    """The visits of a zone (V,): the first and the last row of ``TrackPositions`` inside, and the frame after each."""

    number: int
    first: Ints
    last: Ints
    after: Ints
    began: Bools
    ended: Bools
    dwell_s: Floats

    @classmethod
    def of(cls, placed: PlacedZone, margin: float, rows: Ints, positions: TrackPositions, paths: Paths) -> _Stays:
        some = visits(paths, placed.shape.depth(paths.points, margin), margin)
        ended = some.left < 0
        until = np.where(ended, some.last, some.left)
        dwell = (paths.t_ns[until] - paths.t_ns[some.first]) / NS_PER_S
        after = positions.frame[rows[until]] + ended
        return cls(placed.zone.number, rows[some.first], rows[some.last], after, some.began, ended, dwell)


class _Passes(NamedTuple):
    """The crossings of a line (C,): rows of ``TrackPositions`` after each, and whether it is forward."""

    number: int
    row: Ints
    forward: Bools


def _places(positions: TrackPositions, rows: Ints, front: str = "") -> Iterator[tuple[str, Floats]]:
    for unit, at in (("m", positions.at["metres"]), ("px", positions.picture_px)):
        for axis, name in enumerate("xy"):
            yield f"{front}{name}_{unit}", at[rows, axis]


def _visit_frames(stays: Sequence[_Stays], positions: TrackPositions, t_ns: Ints, numbers: Ints) -> Sequence[Frame]:
    first, last = (np.concatenate([np.zeros(0, np.int64), *(getattr(s, n) for s in stays)]) for n in ("first", "last"))
    rows = ZONE_VISITS.empty(len(first))
    rows["zone_id"] = np.repeat([s.number for s in stays], [len(s.first) for s in stays])
    rows["track_id"] = positions.track[first]
    for column, name in (("dwell_s", "dwell_s"), ("began_inside", "began"), ("ended_inside", "ended")):
        rows[column] = np.concatenate([rows[column][:0], *(getattr(s, name) for s in stays)])
    for column, values in (*_places(positions, first), *_places(positions, last, "last_")):
        rows[column] = values
    return _by_frame(rows, positions.frame[first], t_ns, numbers)


def _crossing_frames(
    passes: Sequence[_Passes], positions: TrackPositions, t_ns: Ints, numbers: Ints
) -> Sequence[Frame]:
    row = np.concatenate([np.zeros(0, np.int64), *(crossed.row for crossed in passes)])
    rows = ZONE_CROSSINGS.empty(len(row))
    rows["zone_id"] = np.repeat([crossed.number for crossed in passes], [len(crossed.row) for crossed in passes])
    rows["track_id"] = positions.track[row]
    rows["forward"] = np.concatenate([rows["forward"][:0], *(crossed.forward for crossed in passes)])
    for column, values in _places(positions, row):
        rows[column] = values
    return _by_frame(rows, positions.frame[row], t_ns, numbers)


def _by_frame(rows: Rows, frame: Ints, t_ns: Ints, numbers: Ints) -> Sequence[Frame]:
    order = np.lexsort((rows["track_id"], rows["zone_id"], frame))
    ends = np.searchsorted(frame[order], np.arange(len(t_ns)), "right")
    return split_rows(t_ns.tolist(), numbers.tolist(), rows[order], ends)


def _counts(
    zones: Sequence[PlacedZone],
    stays: Sequence[_Stays],
    passes: Sequence[_Passes],
    positions: TrackPositions,
    t_ns: Ints,
    numbers: Ints,
) -> FrameColumns:
    """A row of ZoneCounts for each frame and zone."""
    out = FrameCollector(ZONE_COUNTS)
    steps: dict[int, dict[str, Ints]] = {}
    for stay in stays:
        begin, end = positions.frame[stay.first], stay.after
        new = begin[_first_of_each(positions.track[stay.first], begin)]
        steps[stay.number] = {"entered": np.sort(begin), "left": np.sort(end), "tracks": np.sort(new)}
    for crossed in passes:
        at = positions.frame[crossed.row]
        new = at[_first_of_each(positions.track[crossed.row], at)]
        sides = {"forward": np.sort(at[crossed.forward]), "backward": np.sort(at[~crossed.forward])}
        steps[crossed.number] = {**sides, "tracks": np.sort(new)}
    count = len(zones)
    for low in range(0, len(t_ns), _FRAMES_AT_ONCE):
        frame = np.arange(low, min(low + _FRAMES_AT_ONCE, len(t_ns)))
        rows = ZONE_COUNTS.empty(len(frame) * count)
        for place, placed in enumerate(zones):
            of = rows[place::count]
            of["zone_id"] = placed.zone.number
            for name, at in steps[placed.zone.number].items():
                of[name] = np.searchsorted(at, frame, "right")
            of["inside"] = of["entered"] - of["left"]
        out.extend(t_ns[frame], numbers[frame], np.arange(len(frame) + 1) * count, rows)
    return out.done()


def _first_of_each(track: Ints, frame: Ints) -> Ints:
    """The index of the first event of each track."""
    order = np.lexsort((frame, track))
    return np.asarray(order[np.unique(track[order], return_index=True)[1]])


def zone_totals(
    zones: Sequence[Zone], visited: Sequence[Frame], crossed: Sequence[Frame], counts: Sequence[Frame]
) -> list[ZoneTotals]:
    """The totals of zones, from their rows."""
    some, passes = _joined(ZONE_VISITS, visited), _joined(ZONE_CROSSINGS, crossed)
    inside = _insides(zones, counts)
    out = []
    for zone in zones:
        rows, ways = some[some["zone_id"] == zone.number], passes[passes["zone_id"] == zone.number]
        if zone.is_line:
            forward = int(ways["forward"].sum())
            tracks = len(np.unique(ways["track_id"]))
            out.append(ZoneTotals(zone.name, True, tracks, forward=forward, backward=len(ways) - forward))
            continue
        dwell, (most, mean) = rows["dwell_s"], inside[zone.number]
        out.append(
            ZoneTotals(
                zone.name,
                False,
                len(np.unique(rows["track_id"])),
                len(rows),
                int((~rows["began_inside"]).sum()),
                int((~rows["ended_inside"]).sum()),
                float(dwell.sum()),
                float(dwell.mean()) if len(rows) else None,
                float(np.median(dwell)) if len(rows) else None,
                most,
                mean,
            )
        )
    return out


def _joined(schema: Any, frames: Sequence[Frame]) -> Rows:
    parts = [joined.rows for _, _, joined in joined_parts(schema, frames)]
    return np.concatenate([schema.empty(), *parts])


def _insides(zones: Sequence[Zone], counts: Sequence[Frame]) -> dict[int, tuple[int, float | None]]:
    """The most tracks in each zone at a time, and their mean over frames."""
    most, total = dict.fromkeys((zone.number for zone in zones), 0), dict.fromkeys((z.number for z in zones), 0)
    for _, _, joined in joined_parts(ZONE_COUNTS, counts):
        for number in most:
            inside = joined.rows["inside"][joined.rows["zone_id"] == number]
            most[number] = max(most[number], int(inside.max(initial=0)))
            total[number] += int(inside.sum())
    return {number: (most[number], total[number] / len(counts) if len(counts) else None) for number in most}


# Zones in worlds of re-tracking.
#
# Letters: W worlds, K tracklets, N rows.


def zones_in_worlds(
    positions: TrackPositions, t_ns: Ints, worlds: JoinedFrames, zones: Sequence[PlacedZone], options: ZoneOptions
) -> dict[str, ZoneInWorlds]:
    """Find what worlds say of zones, by the names of these.

    Parameters
    ----------
    positions : TrackPositions
        Of the observed samples that were re-tracked.
    t_ns : (F,) of int
        The times of their frames.
    worlds : JoinedFrames
        Rows of Worlds.
    zones : sequence of PlacedZone
    options : ZoneOptions

    Returns
    -------
    dict of str to ZoneInWorlds
        Lines have none.
    """
    zones = [placed for placed in zones if not placed.zone.is_line]
    seen, counts, dwell_s, then = [], [], [], []
    samples = (positions.track, positions.class_id, positions.frame, positions.at["metres"])
    for rows_of_world in tracks_in_worlds(*samples, t_ns, worlds.rows, worlds.row_ns):
        of_world, arrivals = _of_world(positions, t_ns, rows_of_world), []
        seen.append((rows_of_world.people, rows_of_world.late, rows_of_world.lost))
        for placed in zones:
            paths, rows, margin = _paths(of_world, placed, options, "worlds")
            stay = _Stays.of(placed, margin, rows, of_world, paths)
            arrivals.append(_Arrivals.of(of_world, stay))
            dwell_s.append(stay.dwell_s.mean() if len(stay.dwell_s) else np.nan)
        counts.append([len(arrival.track) for arrival in arrivals])
        then.append([[a.before(b) for b in arrivals] for a in arrivals])
    size, dwell = len(seen), np.array(dwell_s).reshape(len(seen), len(zones))
    lacks = lacks_intervals(seen)
    out = {}
    for number, placed in enumerate(zones):
        tracks = np.array(counts)[:, number]
        others = ((other, np.array(then)[:, number, to]) for to, other in enumerate(zones) if to != number)
        out[placed.zone.name] = ZoneInWorlds(
            size,
            WorldInterval.of(tracks, True, lacks),
            None if np.isnan(dwell[:, number]).all() else WorldInterval.of(dwell[:, number], has_none=lacks),
            {other.zone.name: WorldInterval.of(values, True, lacks) for other, values in others},
        )
    return out


class _Arrivals(NamedTuple):
    """The tracks that visited a zone, rising, and the frames in which they came first and last."""

    track: Ints
    first: Ints
    last: Ints

    @classmethod
    def of(cls, positions: TrackPositions, stay: _Stays) -> _Arrivals:
        track, at = np.unique(positions.track[stay.first], return_index=True)
        came = positions.frame[stay.first]
        return cls(track, came[at], came[np.append(at[1:], len(came))[: len(at)] - 1])

    def before(self, other: _Arrivals) -> int:
        """The number of tracks that came here before they came there."""
        _, here, there = np.intersect1d(self.track, other.track, assume_unique=True, return_indices=True)
        return int((self.first[here] < other.last[there]).sum())


def _of_world(positions: TrackPositions, t_ns: Ints, rows: WorldTracks) -> TrackPositions:
    """The positions of the tracks of a world."""
    at = {unit: rows.values(xy) for unit, xy in positions.at.items()}
    kept = {name: getattr(positions, name)[rows.before] for name in ("picture_px", "low_m", "class_id")}
    return positions._replace(at=at, track=rows.track, frame=rows.frame, t_ns=t_ns[rows.frame], **kept)


# Visits of zones and crossings of lines as text, for the log panel of viewers.


def zone_messages(
    visited: Sequence[Frame], crossed: Sequence[Frame], zones: Sequence[Zone], tracks_topic: str, start_ns: int
) -> Iterator[tuple[int, int, bytes]]:
    """foxglove.Log messages (time, number, payload) of enters, leaves and crossings, in order of time.

    ``visited`` and ``crossed`` are frames of ZoneVisits and ZoneCrossings; times in the text count from ``start_ns``.
    """
    names = {zone.number: zone.name for zone in zones}
    lines: list[tuple[int, int, str]] = []
    for frame in visited:
        for row in frame.rows:
            track, name, dwell_s = f"track {row['track_id']}", names[int(row["zone_id"])], float(row["dwell_s"])
            verb = "begins in" if row["began_inside"] else "enters"
            lines.append((frame.t_ns, 0, f"{track} {verb} {name}{_place(row)}"))
            until_ns, verb = frame.t_ns + round(dwell_s * NS_PER_S), "ends in" if row["ended_inside"] else "leaves"
            lines.append((until_ns, 1, f"{track} {verb} {name} after {dwell_s:.1f} s{_place(row, 'last_')}"))
    for frame in crossed:
        for row in frame.rows:
            way = "forward" if row["forward"] else "backward"
            sentence = f"track {row['track_id']} crosses {names[int(row['zone_id'])]} {way}{_place(row)}"
            lines.append((frame.t_ns, 2, sentence))
    for number, (t_ns, _, sentence) in enumerate(sorted(lines)):
        text = f"{sentence} at {(t_ns - start_ns) / NS_PER_S:.2f} s"
        yield t_ns, number, foxglove.pack_log(t_ns, "INFO", tracks_topic, text)


def _place(row: Any, front: str = "") -> str:
    for unit, digits in (("m", 1), ("px", 0)):
        x, y = float(row[f"{front}x_{unit}"]), float(row[f"{front}y_{unit}"])
        if not isnan(x) and not isnan(y):
            return f", ({x:.{digits}f}, {y:.{digits}f}) {unit},"
    return ""
