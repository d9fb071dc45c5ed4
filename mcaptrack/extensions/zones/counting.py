"""Count visits of zones and crossings of lines, and write them beside the tracks.

<tracks>/zones/visits       visits: rows of ZoneVisits
<tracks>/zones/crossings    crossings: rows of ZoneCrossings
<tracks>/zones/counts       who is inside, and the counts so far, in each frame: rows of ZoneCounts
<tracks>/zones/view/log     enters, leaves and crossings as text, for a viewer
<tracks>/zones/view/image   zones and lines on the pictures, with their counts so far
<tracks>/zones/view/scene   the same on the ground

The zones themselves are in the provenance of these channels, so that later runs count again where tracks have changed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, ClassVar, Final, NamedTuple

from mcaptrack import foxglove, log
from mcaptrack.contracts import Finished
from mcaptrack.errors import McaptrackError, call, command
from mcaptrack.evaluation.event_text import SUFFIX
from mcaptrack.evaluation.world_tracks import smoothed_places
from mcaptrack.extensions.zones import drawing as drawn_zones
from mcaptrack.extensions.zones.geojson import zones_from_json, zones_to_json
from mcaptrack.extensions.zones.shapes import Zone
from mcaptrack.extensions.zones.visits import (
    PlacedZone,
    TrackPositions,
    ZoneInWorlds,
    ZoneOptions,
    ZoneTotals,
    find_zone_events,
    ground_height_m,
    place_zone,
    positions_of,
    zone_messages,
    zone_totals,
    zones_in_worlds,
)
from mcaptrack.foxglove import views
from mcaptrack.foxglove.views.image import PictureTimes
from mcaptrack.geometry.plane import Planes, moved_planes, scene_planes
from mcaptrack.location import Location
from mcaptrack.notices import warn
from mcaptrack.pipeline.checks import may_add
from mcaptrack.pipeline.motion import ground_truth_with, path_with
from mcaptrack.pipeline.pictures import PictureClock, picture_clock
from mcaptrack.pipeline.staleness import is_outdated, planes_to_json, read_planes
from mcaptrack.pipeline.write import DrawnMessages, Made, RunState
from mcaptrack.schema import TRACKS, WORLDS, ZONE_COUNTS, ZONE_CROSSINGS, ZONE_VISITS
from mcaptrack.schema.framing import filtered_rows, frame_times, join_frames
from mcaptrack.schema.provenance import VIEW, Provenance, frame_id_of
from mcaptrack.sources.cameras import camera_at, provenance_of
from mcaptrack.transforms import FULL

#: The name of the stage, in reports and in the provenance.
STAGE: Final = "zones"
_BELOW: Final = "/zones"
_VIEWS: Final = (SUFFIX, views.SUFFIX, views.SCENE_SUFFIX)
#: The height of pictures where no plane says it.
_HEIGHT_PX: Final = 480.0
_SCHEMAS: Final = {"/visits": ZONE_VISITS, "/crossings": ZONE_CROSSINGS, "/counts": ZONE_COUNTS}


@dataclass(frozen=True)
class ZoneWatch:
    """The zones to count, and the channels of tracks to count them for.

    Without ``zones`` they are those that the log was counted with before; if there are none, nothing is counted.
    Without ``topics`` channels are the tracks, the re-tracked tracks at the rate of the video, the ground truth, and
    those with counts already. ``options`` None: those of before, or the default ones. With ``force`` all is counted
    again.
    """

    zones: tuple[Zone, ...] = ()
    topics: tuple[str, ...] = ()
    options: ZoneOptions | None = None
    force: bool = False
    name: ClassVar[str] = STAGE

    def make(self, state: RunState, planes: Planes, stamps: Mapping[str, Sequence[int]]) -> dict[str, Made]:
        """Count the zones of channels of tracks that are not counted yet, or that have changed since.

        ``stamps`` are as for ``write``. Returns the channels that it makes by topic. Raises McaptrackError for given
        topics that hold no tracks, and for zones that none of the tracks can be compared with.
        """
        opened, prefix, *_ = state
        before = _before(opened, prefix)
        zones = self.zones or before.zones
        if not zones:
            return {}
        options = self.options or before.options or ZoneOptions()
        zones = _of_camera(opened, prefix, zones, is_given=bool(self.zones))
        topics = _topics(state, self, before)
        if self.zones and not topics:
            raise McaptrackError(f"{opened.path} has no tracks of {prefix}; {call('run', opened.path)} makes them")
        out: dict[str, Made] = {}
        faults: list[McaptrackError] = []
        parameters = _parameters(zones, options, planes)
        for topic in _due_topics(state, topics, self, parameters):
            try:
                pictures = picture_clock(opened, prefix, stamps)
                out |= _counted(state, topic, planes, zones, options, parameters, pictures)
            except McaptrackError as error:
                faults.append(error)
        if faults and (not out or self.topics) and self.zones:
            raise McaptrackError(f"{opened.path}: {faults[0]}")
        for fault in faults:
            warn(str(fault), "not-compared")
        return out

    def report(self, opened: log.Log, prefixes: Sequence[str]) -> Finished | None:
        """Return the totals by the topic of the tracks, of all channels that were counted, now or before."""
        counted = [channel for prefix in prefixes for channel in counted_zones(opened, prefix, with_worlds=True)]
        return finished({channel.topic: channel.totals for channel in counted}, opened.path) if counted else None


def zones_in_short(totals: Mapping[str, Sequence[ZoneTotals]]) -> str:
    """Return the number of zones and lines that were counted, and of channels of tracks, as text."""
    zones = len({total.zone for some in totals.values() for total in some})
    kinds = "zone or line" if zones == 1 else "zones and lines"
    return f"{zones} {kinds}, of {len(totals)} channel{'' if len(totals) == 1 else 's'} of tracks"


def finished(totals: Mapping[str, Sequence[ZoneTotals]], path: Location) -> Finished:
    """Return what a run says of a log with these totals."""
    data = {topic: [total.to_json() for total in some] for topic, some in totals.items()}
    return Finished(totals, data, f"{zones_in_short(totals)}; {command('zones', path)} prints them")


class CountedZones(NamedTuple):
    """The zones that a channel of tracks was counted with, and their totals."""

    topic: str
    zones: tuple[Zone, ...]
    totals: list[ZoneTotals]


def outputs(topic: str) -> tuple[str, ...]:
    """Return the topics for the zones of a channel of tracks; those of views on pictures and scenes may be missing."""
    return *(topic + _BELOW + name for name in _SCHEMAS), *(topic + _BELOW + suffix for suffix in _VIEWS)


def _due_topics(
    state: RunState, topics: Sequence[str], watch: ZoneWatch, parameters: Mapping[str, Any]
) -> Iterator[str]:
    """Yield the channels of tracks to count, each when those before it are counted."""
    for topic in topics:
        if not state.holds(topic, TRACKS):
            schema_name = state.opened.channel(topic).schema_name  # raises if there is no such channel
            raise McaptrackError(f"{state.opened.path}: {topic} holds {schema_name or 'no schema'}, not tracks")
        is_due = watch.force or _is_due(state, topic, parameters)
        if is_due and may_add(state.opened, outputs(topic), STAGE, f"zones of {topic}", bool(watch.topics)):
            yield topic


def _counted(
    state: RunState,
    topic: str,
    planes: Planes,
    zones: Sequence[Zone],
    options: ZoneOptions,
    parameters: Mapping[str, Any],
    pictures: PictureClock,
) -> dict[str, Made]:
    """Count the zones of one channel of tracks, and return the new channels by topic."""
    opened, prefix, *_ = state
    is_truth = topic == camera_at(opened, prefix).truth
    frames = ground_truth_with(state) if is_truth else state.frames(topic)
    path, motion = path_with(state, topic)
    still = scene_planes(planes, path)
    placed: list[PlacedZone] = [place_zone(zone, still) for zone in zones]
    positions = positions_of(frames, still, path, state.classes(topic))
    zone_events = find_zone_events(frames, positions, placed, options, topic)
    for note in zone_events.notes:
        warn(note, "not-compared")
    names = {str(zone.number): zone.name for zone in zones}
    how = state.provenance(topic)
    provenance = Provenance(
        STAGE, parameters, topic, state.digest(topic), references=motion, zones=names,
        frame_id=how.frame_id if how else frame_id_of(opened.channel(topic).metadata),
    )  # fmt: skip
    rows = (zone_events.visits, zone_events.crossings, zone_events.counts)
    out = {
        topic + _BELOW + name: Made.of(schema, some, provenance)
        for (name, schema), some in zip(_SCHEMAS.items(), rows, strict=True)
    }
    visited, crossed = (topic + _BELOW + name for name in list(_SCHEMAS)[:2])
    text = list(zone_messages(zone_events.visits, zone_events.crossings, zones, topic, opened.start_ns))
    crossings = {crossed: out[crossed].provenance.digest}
    view = Provenance(VIEW, {}, visited, out[visited].provenance.digest, references=crossings)
    out[topic + _BELOW + SUFFIX] = Made(ZONE_VISITS, [], view, text, foxglove.LOG)
    shapes = [_shape(zone, positions) for zone in placed]
    counts = topic + _BELOW + "/counts"
    view = Provenance(VIEW, {}, counts, out[counts].provenance.digest)
    captions = drawn_zones.ZoneCaptions.of(zones, zone_events.counts)
    moving, frame_id = moved_planes(planes, path), provenance.frame_id or views.ground.frame_of(prefix)
    if len(pictures.t_ns):
        clock = PictureTimes(pictures.t_ns, pictures.stamp_ns)
        height_px = float(planes[0][1].height_px) if planes else _HEIGHT_PX
        out[topic + _BELOW + views.SUFFIX] = Made(
            ZONE_COUNTS, [], view,
            DrawnMessages(len(pictures.t_ns), lambda: drawn_zones.on_pictures(
                shapes, captions, clock, moving, path, height_px)),
            foxglove.ANNOTATIONS,
        )  # fmt: skip
    if any(shape.ground for shape in shapes):
        scenes = DrawnMessages(len(captions.t_ns), lambda: drawn_zones.on_ground(shapes, captions, frame_id))
        out[topic + _BELOW + views.SCENE_SUFFIX] = Made(ZONE_COUNTS, [], view, scenes, foxglove.SCENE)
    return out


def _shape(placed: PlacedZone, positions: TrackPositions) -> drawn_zones.ZoneShape:
    """A zone to draw, on the ground if it was given in metres."""
    ground, height_m = None, 0.0
    if placed.units == "metres":
        ground, height_m = placed.shape, ground_height_m(positions, placed.shape)
    return drawn_zones.ZoneShape(placed.zone, placed.zone.shape(), ground, placed.forward, height_m)


def counted_zones(opened: log.Log, prefix: str, with_worlds: bool = False) -> list[CountedZones]:
    """Return the totals of all channels of a camera's tracks that zones were counted of, in order of their topics.

    Those of re-tracked tracks have intervals ``with_worlds``, where the log has worlds.
    """
    state, out = RunState(opened, prefix, {}), []
    for topic in _with_counts(opened, prefix):
        names = [topic + _BELOW + name for name in _SCHEMAS]
        schemas = _SCHEMAS.values()
        if not all(state.holds(name, schema) for name, schema in zip(names, schemas, strict=True)):
            continue
        provenance = provenance_of(opened, names[0])
        zones = zones_from_json(provenance.parameters.get("zones")) if provenance else ()
        rows = [opened.frame_columns(name, schema) for name, schema in zip(names, schemas, strict=True)]
        totals = zone_totals(zones, *rows)
        if with_worlds and topic.removesuffix(FULL) == f"{prefix}/retracks" and provenance:
            found = _in_worlds(state, zones, _options_in(provenance.parameters))
            totals = [replace(total, in_worlds=found.get(total.zone)) for total in totals]
        out.append(CountedZones(topic, zones, totals))
    return out


def _in_worlds(state: RunState, zones: Sequence[Zone], options: ZoneOptions) -> dict[str, ZoneInWorlds]:
    """Find what worlds of re-tracking say of zones, by the names of these; nothing without worlds."""
    topic = f"{state.prefix}/retracks/worlds"
    worlds, how = join_frames(WORLDS, state.frames(topic, WORLDS)), state.provenance(topic)
    if not len(worlds.rows) or how is None or not state.frames(how.input) or is_outdated(state, (topic,)):
        return {}
    samples = filtered_rows(TRACKS, state.frames(how.input), lambda joined: joined.rows["observed"])
    path, _ = path_with(state, how.input)
    still = scene_planes(read_planes(state.opened, state.prefix) or (), path)
    positions = positions_of(samples, still, path, state.classes(how.input))
    shown, metres = join_frames(TRACKS, state.frames(f"{state.prefix}/retracks")), positions.at["metres"]
    metres = smoothed_places(positions.track, positions.t_ns, metres, shown.rows, shown.row_ns)
    positions = positions._replace(at={**positions.at, "metres": metres})
    return zones_in_worlds(
        positions, frame_times(samples), worlds, [place_zone(zone, still) for zone in zones], options
    )


class _Before(NamedTuple):
    """The earlier counts of a camera: channels of tracks, zones and options."""

    topics: tuple[str, ...] = ()
    zones: tuple[Zone, ...] = ()
    options: ZoneOptions | None = None


def _before(opened: log.Log, prefix: str) -> _Before:
    topics = tuple(_with_counts(opened, prefix))
    for topic in topics:
        provenance = provenance_of(opened, topic + _BELOW + next(iter(_SCHEMAS)))
        zones = zones_from_json(provenance.parameters.get("zones")) if provenance else ()
        if provenance and zones:
            return _Before(topics, zones, _options_in(provenance.parameters))
    return _Before(topics)


def _options_in(parameters: Mapping[str, Any]) -> ZoneOptions:
    """The options of counting in the parameters of a channel."""
    values = {field.name: parameters.get(field.name) for field in fields(ZoneOptions)}
    numbers = {
        name: float(value)
        for name, value in values.items()
        if isinstance(value, int | float) and not isinstance(value, bool) and value >= 0
    }
    return ZoneOptions(**numbers)


def _with_counts(opened: log.Log, prefix: str) -> list[str]:
    """The channels of a camera's tracks with visits that this stage counted."""
    ending = _BELOW + next(iter(_SCHEMAS))
    visits = (topic for topic in sorted(camera_at(opened, prefix).topics) if topic.endswith(ending))
    provenances = ((topic, provenance_of(opened, topic)) for topic in visits)
    return [topic.removesuffix(ending) for topic, how in provenances if how and how.transform == STAGE]


def _of_camera(opened: log.Log, prefix: str, zones: tuple[Zone, ...], is_given: bool) -> tuple[Zone, ...]:
    """Return the zones of this camera. Raises McaptrackError if all are of others."""
    camera = camera_at(opened, prefix)
    names = {name.strip("/") for name in (prefix, *camera.names, *camera.topics)}
    kept = tuple(zone for zone in zones if not zone.camera or zone.camera in names)
    others = sorted({zone.camera for zone in zones} - {zone.camera for zone in kept})
    kept = tuple(replace(zone, number=number) for number, zone in enumerate(kept, start=1))
    if not kept:
        raise McaptrackError(f"all zones are of {', '.join(others)}, not of {prefix.strip('/')}; `camera=` chooses")
    if others and is_given:
        left = len(zones) - len(kept)
        warn(f"{left} zones of {', '.join(others)} are left out: these are tracks of {prefix.strip('/')}", "left-out")
    return kept


def _topics(state: RunState, watch: ZoneWatch, before: _Before) -> tuple[str, ...]:
    """Return the channels of tracks to count: those that were named, or the usual ones and those counted before."""
    prefix = state.prefix
    if watch.topics:
        return tuple(state.opened.find(topic, prefix) for topic in watch.topics)
    full = f"{prefix}/retracks{FULL}"
    retracked = full if state.holds(full, TRACKS) else f"{prefix}/retracks"
    usual = (f"{prefix}/tracks", retracked, camera_at(state.opened, prefix).truth)
    return tuple(topic for topic in dict.fromkeys((*usual, *before.topics)) if state.holds(topic, TRACKS))


def _parameters(zones: Sequence[Zone], options: ZoneOptions, planes: Planes) -> dict[str, Any]:
    """The parameters of counting, as values of JSON."""
    values: dict[str, Any] = {"zones": zones_to_json(zones), **asdict(options)}
    return values | ({"ground_planes": planes_to_json(planes)} if planes else {})


def _is_due(state: RunState, topic: str, wanted: Mapping[str, Any]) -> bool:
    """Whether zones were not counted yet, were counted with other parameters, or are out of date."""
    names = outputs(topic)[: len(_SCHEMAS) + 1]
    before = provenance_of(state.opened, names[0])
    return before is None or is_outdated(state, names) or not _is_same(before.parameters, wanted)


def _is_same(before: Mapping[str, Any], wanted: Mapping[str, Any]) -> bool:
    """Whether two sets of parameters are the same in JSON."""
    zones = zones_from_json(before.get("zones"))
    rest = [{key: value for key, value in parameters.items() if key != "zones"} for parameters in (before, wanted)]
    return zones_to_json(zones) == wanted["zones"] and rest[0] == rest[1]
