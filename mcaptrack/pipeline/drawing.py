"""Draw the channels of a camera: on its pictures, and in the coordinate frame of their metres."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import foxglove, log
from mcaptrack.errors import McaptrackError, call
from mcaptrack.foxglove import views
from mcaptrack.foxglove.views import MovingCamera, layouts
from mcaptrack.geometry.angles import headings
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.geometry.plane import Planes
from mcaptrack.geometry.transform_tree import TransformTree
from mcaptrack.notices import warn
from mcaptrack.pipeline.scenes import Member
from mcaptrack.pipeline.write import View
from mcaptrack.schema import DETECTIONS, GROUND_PLANE, PREDICTIONS, TRACKS, Frame, Schema
from mcaptrack.schema.framing import frame_times, has_any
from mcaptrack.schema.names import plain_name
from mcaptrack.schema.provenance import VIEW, Provenance
from mcaptrack.sources import foreign
from mcaptrack.sources.calibrations import holds_calibrations, moving_camera
from mcaptrack.sources.cameras import camera_at, chain_of, scenes_of
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
