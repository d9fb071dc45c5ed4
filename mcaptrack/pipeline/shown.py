"""Which views of a log a video shows: on its pictures, on those of calibrated cameras, or from above."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError, call
from mcaptrack.foxglove import views
from mcaptrack.foxglove.views import layouts
from mcaptrack.geometry.angles import headings
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.notices import warn
from mcaptrack.pipeline.drawing import recorded_sources, robot_frame
from mcaptrack.sources.cameras import camera_at, scenes_of
from mcaptrack.sources.foreign.flatten import message_decoder
from mcaptrack.sources.frames import transforms_of
from mcaptrack.transforms import FULL

#: The number of scenes that are read to find their frame.
_MOST_READ: Final = 100


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
            if found := _best(opened, scene, views.SUFFIX + pictures):
                words = f"drawing the tracks of {scene} on {pictures}; `topic=` names those of {prefix}"
                warn(words, "chosen-camera")
                return Shown(found, pictures)
        if found := _best(opened, prefix, views.SUFFIX):
            return Shown(found, pictures)
        raise McaptrackError(f"{opened.path} has no views of {prefix} yet; {call('run', opened.path)} makes them")
    drawn_on = _calibrated(opened, prefix)
    for one in drawn_on:
        if len(drawn_on) > 1:
            others = ", ".join(drawn_on[1:])
            warn(f"tracks are drawn on {one}; `topic=` names views on {others} or scenes", "chosen-camera")
        return Shown(_best(opened, prefix, views.SUFFIX + one), one)
    if found := _best(opened, prefix, views.SCENE_SUFFIX):
        return Shown(found, "")
    there = f"{opened.path} has no pictures of {prefix} to draw on, and no scenes"
    raise McaptrackError(f"{there}; {call('info', opened.path)} shows what it has")


def _given(opened: log.Log, prefix: str, topics: Sequence[str], pictures: str | None) -> Shown:
    """Return the views of given channels, or these themselves if they are views."""
    if pictures is None:
        suffix = next((views.SUFFIX + one for one in _calibrated(opened, prefix)), views.SCENE_SUFFIX)
    else:
        suffix = views.SUFFIX
    found = [opened.channel(_view_of(opened, topic, suffix)).topic for topic in topics]
    places = {_place_of(topic, pictures) for topic in found}
    if len(places) > 1:
        words = ", ".join(sorted(place or "scenes" for place in places))
        raise McaptrackError(f"{opened.path}: views on {words} can't be drawn in one video; name those of one")
    return Shown(found, places.pop())


def _place_of(view: str, pictures: str | None) -> str:
    """Return the pictures of a view; "" for scenes."""
    if view.endswith(views.SCENE_SUFFIX):
        return ""
    return view.partition(views.SUFFIX)[2] or pictures or ""


def _best(opened: log.Log, prefix: str, suffix: str) -> list[str]:
    """Return the views with a suffix that layouts show by default."""
    topics = [topic for topic in opened.channels if topic.startswith(prefix + "/") and topic.endswith(suffix)]
    names = {topic.removeprefix(prefix + "/").removesuffix(suffix) for topic in topics}
    return [f"{prefix}/{name}{suffix}" for name in layouts.best_channels(names)]


def _calibrated(opened: log.Log, prefix: str) -> list[str]:
    """Return the pictures of calibrated cameras that tracks are drawn on, by topic."""
    found = (topic.partition(views.SUFFIX)[2] for topic in opened.channels if topic.startswith(prefix + "/"))
    return sorted({pictures for pictures in found if pictures and _best(opened, prefix, views.SUFFIX + pictures)})


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
    fixed, tree = _frame_of(opened, view), transforms_of(opened)
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
    scenes = (decode(one.payload) for one in islice(opened.messages(view), _MOST_READ))
    return next((str(entity.frame_id) for scene in scenes for entity in scene.entities), "")
