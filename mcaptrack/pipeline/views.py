"""Draw the channels of a camera for viewers, and make layouts of them: the last stage of a run.

A view is a channel that draws another; its provenance names that channel and its digest. A view is due if it is missing
or shows earlier rows.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack import foxglove, log
from mcaptrack.errors import McaptrackError, call
from mcaptrack.foxglove import views
from mcaptrack.foxglove.views import MovingCamera, layouts
from mcaptrack.foxglove.views.layouts import ERRORS, PEOPLE, SPREAD
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import headings
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.geometry.plane import Planes, moved_planes
from mcaptrack.geometry.transform_tree import TransformTree
from mcaptrack.location import sibling
from mcaptrack.notices import warn
from mcaptrack.pipeline.checks import describe_origin, may_replace
from mcaptrack.pipeline.motion import path_with
from mcaptrack.pipeline.pictures import PictureClock, picture_clock
from mcaptrack.pipeline.scenes import Member, Scenes
from mcaptrack.pipeline.staleness import digest_of, read_planes
from mcaptrack.pipeline.write import RunState, View, Views, add_views, write_by_time
from mcaptrack.schema import (
    COUNTS,
    DETECTIONS,
    EVENTS,
    FORECAST_SCORES,
    GROUND_PLANE,
    PREDICTIONS,
    SCHEMAS,
    TRACKS,
    Frame,
    Rows,
    Schema,
)
from mcaptrack.schema.classes import class_names
from mcaptrack.schema.encodings import PROTOBUF
from mcaptrack.schema.framing import frame_times, has_any, join_frames, joined_parts, thinned
from mcaptrack.schema.names import plain_name
from mcaptrack.schema.provenance import VIEW, Provenance, frame_id_of
from mcaptrack.sources import foreign
from mcaptrack.sources.calibrations import holds_calibrations, moving_camera
from mcaptrack.sources.camera_motion import tracks_topic
from mcaptrack.sources.cameras import Camera, camera_at, cameras, chain_of, scenes_of
from mcaptrack.sources.fixed_frame import transforms_of
from mcaptrack.sources.foreign.decoding import decoder_with_errors
from mcaptrack.sources.foreign.flatten import message_decoder, message_type_of
from mcaptrack.transforms import FULL, STAGES

#: Endings of the topics of channels without a view: another channel shows the same tracks at more times.
NOT_SHOWN: Final = ("/samples", "/online")


# Which views of a log a video shows: on its pictures, on those of calibrated cameras, or from above.


#: The number of scenes that are read to find their frame.
_SHOWN_MOST_READ: Final = 100


class Shown(NamedTuple):
    """The topics of views, and of the pictures that they are drawn on; "" if they are scenes, seen from above."""

    views: list[str]
    pictures: str


def find_views(opened: log.Log, prefix: str, topics: Sequence[str] = ()) -> Shown:
    """Return the views that layouts show by default, or the views of the given channels.

    Views are on the pictures of the camera or, if it has none, on those of a calibrated camera; if there is none
    either, they are scenes. Raises McaptrackError if there are no views, or if the given ones don't fit together.
    """
    pictures = camera_at(opened, prefix).pictures
    if topics:
        return _given(opened, prefix, topics, pictures)
    if pictures is not None:
        for scene in scenes_of(opened):
            if best := _best(opened, scene, views.SUFFIX + pictures):
                text = f"drawing the tracks of {scene} on {pictures}; `topic=` names those of {prefix}"
                warn(text, "chosen-camera")
                return Shown(best, pictures)
        if best := _best(opened, prefix, views.SUFFIX):
            return Shown(best, pictures)
        raise McaptrackError(f"{opened.path} has no views of {prefix} yet; {call('run', opened.path)} makes them")
    drawn_on = _calibrated(opened, prefix)
    for pictures_topic in drawn_on:
        if len(drawn_on) > 1:
            others = ", ".join(drawn_on[1:])
            warn(f"tracks are drawn on {pictures_topic}; `topic=` names views on {others} or scenes", "chosen-camera")
        return Shown(_best(opened, prefix, views.SUFFIX + pictures_topic), pictures_topic)
    if best := _best(opened, prefix, views.SCENE_SUFFIX):
        return Shown(best, "")
    lack = f"{opened.path} has no pictures of {prefix} to draw on, and no scenes of tracks yet"
    raise McaptrackError(f"{lack}; {call('run', opened.path)} makes them")


def views_from_above(opened: log.Log, prefix: str) -> list[str]:
    """Return the views of a camera, from above, that layouts show by default."""
    return _best(opened, prefix, views.SCENE_SUFFIX)


def _given(opened: log.Log, prefix: str, topics: Sequence[str], pictures: str | None) -> Shown:
    """Return the views of given channels, or these themselves if they are views."""
    if pictures is None:
        suffix = next((views.SUFFIX + topic for topic in _calibrated(opened, prefix)), views.SCENE_SUFFIX)
    else:
        suffix = views.SUFFIX
    view_topics = [opened.channel(_view_of(opened, opened.find(topic, prefix), suffix)).topic for topic in topics]
    places = {_place_of(topic, pictures) for topic in view_topics}
    if len(places) > 1:
        text = ", ".join(sorted(place or "scenes" for place in places))
        raise McaptrackError(f"{opened.path}: views on {text} can't be drawn in one video; name those of one")
    return Shown(view_topics, places.pop())


def _place_of(view: str, pictures: str | None) -> str:
    """Return the pictures of a view; "" for scenes."""
    if view.endswith(views.SCENE_SUFFIX):
        return ""
    return view.partition(views.SUFFIX)[2] or pictures or ""


def _best(opened: log.Log, prefix: str, suffix: str) -> list[str]:
    """Return the views with a suffix that layouts show by default."""
    topics = [topic for topic in opened.channels if topic.startswith(prefix + "/") and topic.endswith(suffix)]
    names = {topic.removeprefix(prefix + "/").removesuffix(suffix) for topic in topics}
    channels = {topic.removeprefix(prefix + "/") for topic in opened.channels}
    return [f"{prefix}/{name}{suffix}" for name in layouts.best_channels(names, channels)]


def _calibrated(opened: log.Log, prefix: str) -> list[str]:
    """Return the pictures of calibrated cameras that tracks are drawn on, by topic."""
    drawn_on = (topic.partition(views.SUFFIX)[2] for topic in opened.channels if topic.startswith(prefix + "/"))
    return sorted({pictures for pictures in drawn_on if pictures and _best(opened, prefix, views.SUFFIX + pictures)})


def _view_of(opened: log.Log, topic: str, suffix: str) -> str:
    """Return the topic of a channel's view: its own, or the view of the same tracks at the video's rate."""
    if views.SUFFIX in topic or topic.endswith(views.SCENE_SUFFIX):
        return topic
    names = [topic + suffix, topic + FULL + suffix]
    return next((name for name in names if name in opened.channels), names[0])


class RobotPath(NamedTuple):
    """Where a robot is in the frame of scenes, at M times: positions (M, 2) in m and headings (M,), NaN if unknown."""

    at_m: Floats
    heading_rad: Floats


def robot_path(opened: log.Log, prefix: str, view: str, t_ns: Ints) -> RobotPath | None:
    """Return the path of the robot that recorded the boxes of a view; None if none moves in its frame."""
    fixed, tree = _frame_of(opened, view), transforms_of(opened, view)
    if not fixed or tree is None:
        return None
    sources = recorded_sources(opened, camera_at(opened, prefix).topics)
    robot = robot_frame(opened, sources, tree, fixed)
    if not robot:
        return None
    poses = tree.lookup(fixed, robot, t_ns)
    return RobotPath(np.asarray(poses.translation[:, :2]), headings(poses.rotation[:, :, 0]))


def _frame_of(opened: log.Log, view: str) -> str:
    """Return the frame of the scenes of a view; "" if the first ones are empty."""
    decode = message_decoder(opened, view)
    scenes = (decode(message.payload) for message in islice(opened.messages(view), _SHOWN_MOST_READ))
    return next((str(entity.frame_id) for scene in scenes for entity in scene.entities), "")


#: The number of messages that are read to find the frame of a channel.
_MOST_READ: Final = 100
#: Schemas of recorded messages that viewers draw in 3D, by their names in ROS 1 and Foxglove.
_DRAWN_BY_VIEWERS: Final = (
    "foxglove.LaserScan",
    "foxglove.PointCloud",
    "foxglove.SceneUpdate",
    "sensor_msgs/LaserScan",
    "sensor_msgs/PointCloud2",
    "visualization_msgs/Marker",
    "visualization_msgs/MarkerArray",
)
#: Schemas that always have a view in metres.
_ON_GROUND: Final = (TRACKS, PREDICTIONS, GROUND_PLANE)


class ChannelToDraw(NamedTuple):
    """A channel that gets views: ``digest`` of its messages; ``made_by``, the stage that made it in this run, or "";
    ``classes``, the names of its classes by number; ``frame_id``, the frame of its metres, "" for the ground plane.

    Forecasts of tracks with 3D boxes have these tracks, ``bodies``.
    """

    schema: Schema
    frames: Sequence[Frame]
    digest: str
    made_by: str
    classes: Mapping[int, str] = {}
    frame_id: str = ""
    bodies: Sequence[Frame] = ()

    def is_solid(self) -> bool:
        """Whether it has 3D boxes, or belongs to tracks that have."""
        return bool(self.bodies) or (self.schema in (DETECTIONS, TRACKS) and has_bodies(self.schema, self.frames))

    def is_on_ground(self) -> bool:
        """Whether it has a view in metres."""
        return self.schema in _ON_GROUND or (self.schema is DETECTIONS and self.is_solid())


def has_bodies(schema: Schema, frames: Sequence[Frame]) -> bool:
    """Whether any row of these tracks or detections has a 3D box."""
    return has_any(schema, frames, lambda rows: np.isfinite(rows["z_m"]))


@dataclass
class ViewFactory:
    """Draws the channels of a camera: in its pictures, and in the frame of their metres.

    ``frames`` are the coordinate frames that no transform of the log names, ``robot`` is that of the robot, or "".
    ``cameras`` are calibrated ones by the topics of their pictures, for tracks with 3D boxes; ``members`` those of a
    scene.
    """

    prefix: str
    picture_ns: Ints
    stamp_ns: Ints
    planes: Planes
    path: CameraPath | None
    frames: Sequence[str]
    robot: str
    cameras: Mapping[str, MovingCamera]
    members: Sequence[Member]

    def views(self, shown: Mapping[str, ChannelToDraw], start_ns: int) -> Iterator[View]:
        """Yield the views of these channels, and, once, that of the robot and the transforms that no other names."""
        for topic, channel in shown.items():
            if topic == f"{self.prefix}/ground_plane":
                outline = views.ground.outlines(self.planes, start_ns, frame_of(self.prefix, channel))
                yield self._view(topic, channel, views.SCENE_SUFFIX, foxglove.SCENE, outline)
            # Where another channel shows the same tracks at more times, that is drawn.
            if channel.schema in views.DRAWN and not topic.endswith(NOT_SHOWN) and topic + FULL not in shown:
                yield from self._drawn(topic, channel)
        on_ground = next(((topic, channel) for topic, channel in shown.items() if channel.is_on_ground()), None)
        if on_ground is None:
            return
        made_from = Provenance(VIEW, {}, on_ground[0], on_ground[1].digest)
        if self.frames:
            transforms = [
                (start_ns, number, foxglove.pack_transform(start_ns, views.ground.world_of(self.prefix), frame_id))
                for number, frame_id in enumerate(self.frames)
            ]
            self.frames = ()
            yield View(frame_topic(self.prefix), foxglove.TRANSFORM, made_from, "", iter(transforms))
        if self.robot:
            drawn = views.ground.robot(start_ns, self.robot)
            self.robot = ""
            yield View(robot_topic(self.prefix), foxglove.SCENE, made_from, "", drawn)

    def _view(self, topic: str, channel: ChannelToDraw, suffix: str, schema_name: str, messages: Iterator[Any]) -> View:
        made_from = Provenance(VIEW, {}, topic, channel.digest)
        return View(topic + suffix, schema_name, made_from, channel.made_by, messages)

    def _drawn(self, topic: str, channel: ChannelToDraw) -> Iterator[View]:
        """Yield the views of one channel."""
        schema, frames, names, is_solid = channel.schema, channel.frames, channel.classes, channel.is_solid()
        is_retracked = channel.made_by in STAGES and STAGES[channel.made_by].repairs_tracks
        drawing = views.Drawing(topic, schema, frames, self.planes, is_retracked, names, self.path)
        on_pictures = len(self.picture_ns) > 0 and not is_solid
        if on_pictures:
            messages = drawing.on_pictures(self.picture_ns, self.stamp_ns)
            yield self._view(topic, channel, views.SUFFIX, foxglove.ANNOTATIONS, messages)
        if schema is not DETECTIONS:
            for pictures, camera in self.cameras.items() if is_solid else ():
                messages = drawing.on_camera(camera, channel.bodies)
                yield self._view(topic, channel, views.SUFFIX + pictures, foxglove.ANNOTATIONS, messages)
            for clock, drawn in self.members:
                rows, planes = drawn(schema, frames, not channel.made_by)
                on_picture = views.Drawing(topic, schema, rows, planes, is_retracked, names)
                messages = on_picture.on_pictures(clock.t_ns, clock.stamp_ns)
                yield self._view(topic, channel, f"{views.SUFFIX}{clock.topic}", foxglove.ANNOTATIONS, messages)
        if channel.is_on_ground():
            t_ns = self.picture_ns if on_pictures else frame_times(frames)
            scene = drawing.on_ground(t_ns, frame_of(self.prefix, channel), channel.bodies)
            yield self._view(topic, channel, views.SCENE_SUFFIX, foxglove.SCENE, scene)


def frame_topic(prefix: str) -> str:
    """Return the topic of the transforms to the frames that no other transform of the log names."""
    return f"{prefix}/view/tf"


def robot_topic(prefix: str) -> str:
    """Return the topic of the drawing of the robot."""
    return f"{prefix}/{layouts.ROBOT}{views.SCENE_SUFFIX}"


def frame_of(prefix: str, channel: ChannelToDraw) -> str:
    """Return the coordinate frame that a channel is drawn in."""
    return channel.frame_id or views.ground.frame_of(prefix)


def new_frames(prefix: str, shown: Mapping[str, ChannelToDraw], existing: Collection[str]) -> list[str]:
    """Return the coordinate frames of drawings that are not among the ``existing`` ones, in order."""
    wanted = [frame_of(prefix, channel) for channel in shown.values() if channel.is_on_ground()]
    return [frame_id for frame_id in dict.fromkeys(wanted) if frame_id not in existing]


def robot_frame(opened: log.Log, sources: Collection[str], tree: TransformTree, fixed: str) -> str:
    """Return the frame of the robot with the sensors of these topics: the lowest frame above theirs that moves.

    Sensors are fixed to it. "" if the frame of the messages is not known, or does not move in the fixed frame.
    """
    for topic in sources:
        chain = tree.chain_of(_frame_of_messages(opened, topic))
        for frame_id in chain[: chain.index(fixed)] if fixed in chain else ():
            if not tree.series[frame_id].is_static:
                return frame_id
    return ""


def calibrated_cameras(opened: log.Log, frame_id: str) -> dict[str, views.MovingCamera]:
    """Return where cameras were in a frame, by the topics of their pictures, as far as calibrations and transforms say.

    Pictures without them are left out, with a warning if the log has calibrations.
    """
    if not any(map(holds_calibrations, opened.channels.values())):
        return {}
    cameras = {}
    for topic, channel in sorted(opened.channels.items()):
        if foreign.holds_pictures(channel) and channel.messages:
            try:
                cameras[topic] = moving_camera(opened, topic, frame_id)
            except McaptrackError as error:
                warn(f"{opened.path}: tracks are not drawn on {topic}: {error}", "left-out")
    return cameras


def recorded_drawings(opened: log.Log, sources: Collection[str]) -> dict[str, bool]:
    """Return the recorded topics that viewers draw in 3D, and whether they are among ``sources``."""
    return {
        channel.topic: channel.topic in sources
        for channel in sorted(opened.channels.values(), key=lambda channel: channel.topic)
        if is_drawn_by_viewers(channel)
    }


def is_drawn_by_viewers(channel: log.Channel) -> bool:
    """Return whether viewers draw the recorded messages of a channel in 3D."""
    return plain_name(channel.schema_name) in _DRAWN_BY_VIEWERS and Provenance.from_metadata(channel.metadata) is None


def recorded_sources(opened: log.Log, topics: Iterable[str]) -> list[str]:
    """Return the recorded topics that these were made from."""
    origins = {topic for made_topic in topics for topic in chain_of(opened, made_topic)[-1:]} & set(opened.channels)
    return sorted(topic for topic in origins if Provenance.from_metadata(opened.channels[topic].metadata) is None)


def _frame_of_messages(opened: log.Log, topic: str) -> str:
    """Return the frame that the first messages of a recorded channel name; "" if they name none."""
    try:
        decode = decoder_with_errors(message_type_of(opened, topic), _frame_named)
        return next(filter(None, (decode(message.payload) for message in islice(opened.timed(topic), _MOST_READ))), "")
    except McaptrackError:
        return ""


def _frame_named(message: Any) -> str:
    parts = (getattr(message, name, ()) for name in ("entities", "markers", "boxes", "objects", "detections"))
    for holder_of_name in (message, *(part for some in parts for part in some)):
        for holder in (holder_of_name, getattr(holder_of_name, "header", None)):
            name = getattr(holder, "frame_id", "")
            if name:
                return str(name)
    return ""


#: The name of the stage, in reports.
STAGE: Final = "views"
#: The schemas of channels that get views.
WITH_VIEWS: Final = (*views.DRAWN, GROUND_PLANE)
#: Endings of the topics of forecasts, and of the online tracks that they belong to.
_PREDICTED, _ONLINE = "/predictions", "/online"
#: Where views look from follows from about so many rows at most.
_MOST_ROWS: Final = 200_000
#: The channels of each plot below the prefix of a camera, and the columns of each that it may show. Of forecasts, one
#: channel is shown: the first with such values.
_PLOTS: Final[Mapping[str, tuple[Schema, tuple[str, ...], tuple[str, ...]]]] = {
    PEOPLE: (COUNTS, ("tracks/counts", "retracks/counts", "retracks/full/counts"), ("tracked", "people")),
    ERRORS: (
        FORECAST_SCORES,
        ("predictions/scores", "retracks/predictions/scores"),
        ("ade_m", "fde_m", "later_ade_m", "later_fde_m"),
    ),
    SPREAD: (FORECAST_SCORES, ("retracks/predictions/scores", "predictions/scores"), ("spread_mean_m", "spread_90_m")),
}


def make_views(
    state: RunState,
    planes: Planes,
    stamps: Mapping[str, Sequence[int]] = {},
    boxes: Mapping[str, foreign.NamedFrames] = {},
    is_written: bool = False,
) -> Views | None:
    """Draw the channels of a camera with a view that is due, and make its layouts.

    Parameters
    ----------
    state : RunState
        The log, the camera, and the channels that this run has made.
    planes : Planes
        The ground planes of the camera.
    stamps : mapping of str to sequence of int
        Capture times in ns of pictures that stages have read, by topic.
    boxes : mapping of str to NamedFrames
        Recorded boxes in space that this run has read, by topic; those that viewers don't draw get a view.
    is_written : bool
        Whether the log is written in any case.

    Returns
    -------
    Views or None
        None if the log stays as it is: nothing new is in it, and no view is due. A topic that others recorded gets no
        view, with a warning.
    """
    camera = camera_at(state.opened, state.prefix)
    shown = channels_to_draw(state, camera)
    if not (shown or state.results or is_written):
        return None
    work = _Work(state, camera, planes, stamps, shown | _boxes_to_draw(state.opened, boxes))
    drawn = Views(*work.views(), work.outdated)
    return drawn._replace(layouts=layouts.make(work.contents(drawn)))


class _Work:
    """The work of drawing channels of a camera, ``shown``: where, when and in which frames they are drawn."""

    def __init__(
        self,
        state: RunState,
        camera: Camera,
        planes: Planes,
        stamps: Mapping[str, Sequence[int]],
        shown: Mapping[str, ChannelToDraw],
    ) -> None:
        opened, prefix = state.opened, state.prefix
        self.state, self.camera, self.shown = state, camera, shown
        self.clock = picture_clock(opened, prefix, stamps)
        self.path, _ = path_with(state, tracks_topic(prefix))
        self.planes = moved_planes(planes, self.path)
        self.frame_id = _Current(state, shown).frame_id()
        is_framed = bool(self.frame_id) or any(channel.frame_id for channel in shown.values())
        self.tree = transforms_of(opened, tracks_topic(prefix)) if is_framed else None
        solid_in = next((channel.frame_id for channel in shown.values() if channel.is_solid()), "")
        self.calibrated = calibrated_cameras(opened, solid_in) if solid_in and self.tree else {}
        self.members = Scenes().members(state)
        self.frames = new_frames(prefix, shown, self.tree.frames() if self.tree else ())
        self.sources = self._sources()
        self.robot = robot_frame(opened, self.sources, self.tree, self.frame_id) if self.tree else ""
        self.seen_on = (*self.calibrated, *(member.clock.topic or "" for member in self.members))
        self.start_ns = _start_ns(opened, camera, shown, self.clock)
        of_shown = self._outdated()
        self._recorded = {topic for topic in of_shown if not may_replace(opened, topic, VIEW)}
        self.outdated = of_shown - self._recorded
        for topic in sorted(self._recorded):
            warn(f"no view at {topic}, which {describe_origin(opened, topic)}", "left-out")

    def _sources(self) -> list[str]:
        """Return the recorded topics that the channels were made from."""
        inputs = [channel.provenance.input for channel in self.state.results.values()]
        return recorded_sources(self.state.opened, [*self.camera.topics, *inputs])

    def _outdated(self) -> set[str]:
        """Return the topics of all views of these channels."""
        topics = {topic + suffix for topic in self.shown for suffix in views.SUFFIXES}
        topics |= {topic + views.SUFFIX + pictures for topic in self.shown for pictures in self.seen_on}
        on_others = tuple(f"{topic}{views.SUFFIX}/" for topic in self.shown)
        topics |= {view for view in self.state.opened.channels if view.startswith(on_others)}
        topics |= {frame_topic(self.state.prefix)} if self.frames else set()
        return topics | ({robot_topic(self.state.prefix)} if self.robot else set())

    def views(self) -> tuple[list[View], list[View]]:
        """Return the views of channels that stay as they are, and of those of this run.

        The former come first, so that channels that are made again keep their place, and the log its bytes.
        """
        factory = ViewFactory(
            self.state.prefix, self.clock.t_ns, self.clock.stamp_ns, self.planes, self.path, self.frames, self.robot,
            self.calibrated, self.members,
        )  # fmt: skip
        first, last = (
            {topic: channel for topic, channel in self.shown.items() if (topic in self.state.results) is is_new}
            for is_new in (False, True)
        )
        drawn = [[*factory.views(channels, self.start_ns)] for channels in (first, last)]
        kept = [[view for view in some if view.topic not in self._recorded] for some in drawn]
        return kept[0], kept[1]

    def contents(self, drawn: Views) -> layouts.CameraChannels:
        """Return what layouts have to know of the camera."""
        opened, prefix, results, gone = self.state
        current = _Current(self.state, {**self.shown, **{topic: _nothing(opened, topic) for topic in gone}})
        topics = {*opened.channels} - self.outdated - gone | {*results} | drawn.topics
        by_viewers = recorded_drawings(opened, self.sources) if self.frame_id else {}
        by_viewers |= {name: True for source in self.sources if (name := source + views.SCENE_SUFFIX) in topics}
        eye = layouts.eye_on(current.positions(), self.planes, self.start_ns)
        return layouts.CameraChannels(
            prefix,
            frozenset(topic.removeprefix(prefix + "/") for topic in topics if topic.startswith(prefix + "/")),
            self.clock.topic,
            self.frame_id or views.ground.frame_of(prefix),
            eye._replace(z_m=current.floor_m() if self.frame_id else 0.0),
            current.is_truth_known(),
            self.robot,
            by_viewers,
            self.seen_on,
            highest_values(prefix, current.frames),
        )


# Channels with views that are due.


def channels_to_draw(state: RunState, camera: Camera) -> dict[str, ChannelToDraw]:
    """Return the channels that get views, by topic: those of this run, and others with a view that is due."""
    opened, _, results, gone = state
    shown = {
        topic: ChannelToDraw(
            channel.schema, channel.frames, how.digest, how.transform, class_names(how.to_metadata()), how.frame_id
        )
        for topic, channel in results.items()
        for how in (channel.provenance,)
    }
    inputs = {topic: channel.provenance.input for topic, channel in results.items()}
    for topic in sorted(camera.topics - shown.keys() - gone):
        how = Provenance.from_metadata(opened.channels[topic].metadata)
        if how is not None and (drawing := _due_of_log(state, camera, topic, how)):
            shown[topic], inputs[topic] = drawing, how.input
    for topic, drawing in shown.items():
        if drawing.schema is PREDICTIONS:
            shown[topic] = drawing._replace(bodies=_bodies(_Current(state, shown), topic, inputs[topic]))
    return shown


def _due_of_log(state: RunState, camera: Camera, topic: str, how: Provenance) -> ChannelToDraw | None:
    """Return a channel of the log if a view of it is due. Its rows are read only if one may be."""
    channel = state.opened.channels[topic]
    schema = SCHEMAS.get(channel.schema_name)
    if schema is None or not _is_drawn(state, camera, topic, schema):
        return None
    is_outdated = _is_outdated(state.opened, topic, how)
    lacks_image = camera.pictures and schema in views.DRAWN and topic + views.SUFFIX not in state.opened.channels
    if not (is_outdated or lacks_image):
        return None
    names, made_by = class_names(channel.metadata), how.transform if how.transform in STAGES else ""
    frames = state.opened.frame_columns(topic, schema)
    drawing = ChannelToDraw(schema, frames, how.digest, made_by, names, how.frame_id)
    if is_outdated:
        return drawing if camera.pictures or drawing.is_on_ground() else None
    return drawing if _is_in_pictures(state, topic, drawing, how) else None


def _is_drawn(state: RunState, camera: Camera, topic: str, schema: Schema) -> bool:
    """Return whether a channel of the log gets views."""
    is_drawn = schema in views.DRAWN or (schema is GROUND_PLANE and topic == f"{camera.prefix}/ground_plane")
    full = topic + FULL in {*state.opened.channels, *state.results} - state.gone
    return is_drawn and not topic.endswith(NOT_SHOWN) and not full


def _is_outdated(opened: log.Log, topic: str, how: Provenance) -> bool:
    """Return whether a channel has no view, or those of earlier rows."""
    names = [topic + suffix for suffix in views.SUFFIXES]
    names += [view for view in opened.channels if view.startswith(f"{topic}{views.SUFFIX}/")]
    drawn = [Provenance.from_metadata(opened.channels[name].metadata) for name in names if name in opened.channels]
    return not any(view is not None and view.input_digest == how.digest for view in drawn)


def _is_in_pictures(state: RunState, topic: str, drawing: ChannelToDraw, how: Provenance) -> bool:
    """Return whether a channel is drawn in the pictures of its camera, which may have come after its other view."""
    bodies = _bodies(_Current(state, {}), topic, how.input) if drawing.schema is PREDICTIONS else ()
    is_solid = drawing._replace(bodies=bodies).is_solid()
    return not is_solid and len(picture_clock(state.opened, state.prefix, {}).t_ns) > 0


def _nothing(opened: log.Log, topic: str) -> ChannelToDraw:
    """Return a channel that this run drops, as one without frames."""
    return ChannelToDraw(SCHEMAS.get(opened.channel(topic).schema_name, EVENTS), (), "", "", {}, "")


def _boxes_to_draw(opened: log.Log, boxes: Mapping[str, foreign.NamedFrames]) -> dict[str, ChannelToDraw]:
    """Return the recorded boxes that viewers can't draw, by topic."""
    return {
        topic: ChannelToDraw(DETECTIONS, box.frames, digest_of(opened, topic), "", box.classes, box.frame_id)
        for topic, box in boxes.items()
        if not is_drawn_by_viewers(opened.channel(topic)) and has_bodies(DETECTIONS, box.frames)
    }


def _bodies(current: _Current, topic: str, source: str) -> Sequence[Frame]:
    """Return the tracks that forecasts belong to, if they have 3D boxes: those beside them, or those predicted from."""
    beside = topic.removesuffix(_PREDICTED)
    for name in (beside + _ONLINE, beside, source):
        frames = current.frames(name, TRACKS)
        if len(frames):
            return frames if has_bodies(TRACKS, frames) else ()
    return ()


def _start_ns(opened: log.Log, camera: Camera, shown: Mapping[str, ChannelToDraw], clock: PictureClock) -> int:
    """Return the time of a camera's first picture or row in ns; 0 if there is none."""
    row_topics = [channel.topic for channel in opened.channels.values() if channel.schema_name in SCHEMAS]
    times = [clock.t_ns, *(opened.times(topic) for topic in row_topics if topic in camera.topics)]
    times += [np.array([channel.frames[0].t_ns], np.int64) for channel in shown.values() if len(channel.frames)]
    return min((int(some[0]) for some in times if len(some)), default=0)


# What layouts need to know of the channels of a camera.


@dataclass(frozen=True)
class _Current:
    """The channels of a camera as they are after a run: those that it draws, or else those of the log."""

    state: RunState
    shown: Mapping[str, ChannelToDraw]

    def frames(self, topic: str, schema: Schema) -> Sequence[Frame]:
        """Return the frames of a channel; empty if there is none with such rows."""
        if topic in self.shown:
            return self.shown[topic].frames if self.shown[topic].schema is schema else ()
        opened = self.state.opened
        return opened.frame_columns(topic, schema) if opened.holds(topic, schema) else ()

    def _each(self, schema: Schema, *names: str) -> Iterator[Sequence[Frame]]:
        """Yield the frames of channels, by the ends of their topics."""
        return (self.frames(f"{self.state.prefix}/{name}", schema) for name in names)

    def _rows_of_tracks(self) -> Iterator[Rows]:
        """Yield rows of each channel of tracks, about as many as say where they are; the best channel first."""
        for frames in self._each(TRACKS, "retracks", "tracks", "truth", "samples"):
            yield join_frames(TRACKS, thinned(frames, _MOST_ROWS)).rows

    def is_truth_known(self) -> bool:
        """Return whether any forecast is compared with the ground truth."""
        scores = self._each(FORECAST_SCORES, "retracks/predictions/scores", "predictions/scores")
        return any(has_any(FORECAST_SCORES, frames, lambda rows: np.isfinite(rows["ade_m"])) for frames in scores)

    def positions(self) -> NDArray[np.float64]:
        """Return positions of people, (N, 2) in m, from the first channel of tracks that has any."""
        for rows in self._rows_of_tracks():
            xy_m = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
            if np.isfinite(xy_m).all(axis=1).any():
                return xy_m
        return np.empty((0, 2))

    def frame_id(self) -> str:
        """Return the frame of the metres of a camera's tracks; "" for that of its ground plane."""
        for name in ("retracks/full", "retracks", "tracks", "truth", "samples"):
            topic = f"{self.state.prefix}/{name}"
            if topic in self.shown:
                return self.shown[topic].frame_id
            if topic in self.state.opened.channels:
                return frame_id_of(self.state.opened.channels[topic].metadata)
        return ""

    def floor_m(self) -> float:
        """Return the usual height of the bottoms of 3D boxes; 0 if there are none."""
        for rows in self._rows_of_tracks():
            base_m = rows["z_m"] - rows["height_m"] / 2
            if np.isfinite(base_m).any():
                return round(float(np.nanmedian(base_m)), 1)
        return 0.0


def highest_values(prefix: str, frames_of: Callable[[str, Schema], Sequence[Frame]]) -> dict[str, float]:
    """Return the largest value of each plot, as far as it is known: axes have room for all of them.

    ``frames_of`` returns the frames of a topic with rows of a schema; empty if there are none.
    """
    out: dict[str, float] = {}
    for plot, (schema, names, columns) in _PLOTS.items():
        for name in names:
            if plot == SPREAD and plot in out:
                break
            for _, _, joined in joined_parts(schema, frames_of(f"{prefix}/{name}", schema)):
                for column in columns:
                    values = np.asarray(joined.rows[column], np.float64)
                    finite = values[np.isfinite(values)]
                    if len(finite):
                        out[plot] = max(out.get(plot, 0.0), float(finite.max()))
    return out


# Views that a log lacks, for commands that show it and leave it as it is.


@contextmanager
def with_views(opened: log.Log) -> Iterator[tuple[log.Log, dict[str, bytes]]]:
    """Yield a log with the views that are due, which are in a temporary file, and the layouts for all of it, by name.

    It yields the log itself, and no layouts, if no view is due, or if others recorded what stands in its place. The log
    on the disk stays as it is. Raises McaptrackError if the folder of temporary files has no room.
    """
    due = [camera for camera in cameras(opened) if channels_to_draw(RunState(opened, camera.prefix, {}), camera)]
    made = [make_views(RunState(opened, at.prefix, {}), read_planes(opened, at.prefix) or ()) for at in due]
    drawn = [views_of_camera for views_of_camera in made if views_of_camera and views_of_camera.topics]
    if not drawn:
        yield opened, {}
        return
    with ExitStack() as stack:
        try:
            folder = stack.enter_context(TemporaryDirectory(prefix="mcaptrack-views-"))
            path = sibling(Path(folder, opened.path.name), ".views.mcap", of=opened.path.name.removesuffix(".mcap"))
            with log.create(path) as writer:
                streams = [add_views(writer, (*each.first, *each.last), PROTOBUF) for each in drawn]
                write_by_time(writer, chain.from_iterable(streams))
        except (OSError, McaptrackError) as error:
            if isinstance(error, McaptrackError) and not isinstance(error.__cause__, OSError):
                raise
            raise McaptrackError(
                f"views that {opened.path} lacks can't be drawn in a temporary file ({error}); the variable TMPDIR "
                f"names another folder, and {call('run', opened.path)} keeps them in the log"
            ) from error
        complete = stack.enter_context(log.read(opened.path))
        complete.attach_results(log.read(path), is_new=False)
        yield complete, {name: layout for each in drawn for name, layout in each.layouts.items()}
