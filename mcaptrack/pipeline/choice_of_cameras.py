"""The cameras that a run of a whole log works on, and the scenes that they are fused to."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Final, NamedTuple

from mcaptrack import log
from mcaptrack.errors import McaptrackError, list_names
from mcaptrack.pipeline.checks import cameras_named
from mcaptrack.sources import foreign
from mcaptrack.sources.cameras import (
    Camera,
    camera_at,
    cameras,
    detections_topic,
    has_own_channels,
    provenance_of,
    scenes_of,
)
from mcaptrack.sources.pictures import size_of_pictures
from mcaptrack.transforms import STAGES

#: The scene that a run fuses cameras to.
SCENE: Final = "/world"
#: How the reason begins why a camera with pictures of no use is left out.
UNREAD: Final = "has pictures that can't be read"
#: The channels that a run can begin with, if a camera has no pictures and no boxes of others.
_BEGINNINGS: Final = tuple(STAGES[name].input_topic for name in ("track", "sample", "predict"))


class ChosenCameras(NamedTuple):
    """The cameras of a run, by prefix; the reasons why others are left out, by name; and the scenes that are named."""

    prefixes: tuple[str, ...]
    left_out: Mapping[str, str]
    scenes: tuple[str, ...] = ()


def choose_cameras(opened: log.Log, names: Sequence[str] = ()) -> ChosenCameras | None:
    """Choose the cameras of a run: those with these names, or all that have pictures or boxes.

    None if the log has one camera only, or sensors of boxes in space alone: then there is no choice. Raises
    McaptrackError if no camera has anything to begin with, and for names that the log doesn't have, or that can't be
    run.
    """
    named, scenes = cameras_named(opened, names, cameras(opened)), scenes_of(opened)
    wanted = [camera for camera in named if camera.prefix not in scenes] if names else _usual(opened, scenes)
    if not names and not wanted:
        return None
    wanted_scenes = tuple(camera.prefix for camera in named if camera.prefix in scenes)
    chosen, lacks = split_by_lack(wanted, partial(_lack, opened) if names else partial(_unfit, opened))
    if not chosen and not wanted_scenes:
        why = "; ".join(f"{name} {reason}" for name, reason in lacks.items())
        raise McaptrackError(f"{opened.path} has no camera to begin with: {why}")
    for name, reason in lacks.items() if names else ():
        raise McaptrackError(f"{opened.path}: {name} {reason}; leave it out of `camera=`")
    return ChosenCameras(tuple(camera.prefix for camera in chosen), lacks, wanted_scenes)


def split_by_lack(wanted: Sequence[Camera], lack: Callable[[Camera], str]) -> tuple[list[Camera], dict[str, str]]:
    """Return the cameras that lack nothing, and what the others lack, by name."""
    lacks = {camera.prefix[1:]: why for camera in wanted if (why := lack(camera))}
    return [camera for camera in wanted if camera.prefix[1:] not in lacks], lacks


def _usual(opened: log.Log, scenes: Sequence[str]) -> list[Camera]:
    """Return the cameras of a run that names none, but none if there is no choice between several with pictures.

    Those that are only boxes in space are left out.
    """
    usual = [camera for camera in cameras(opened) if camera.prefix not in scenes]
    usual = [camera for camera in usual if not _is_truth_of_scene(opened, camera)]
    usual = [camera for camera in usual if not camera.in_space or has_own_channels(opened, camera)]
    return usual if len(usual) + len(scenes) > 1 and not all(camera.in_space for camera in usual) else []


def _is_truth_of_scene(opened: log.Log, camera: Camera) -> bool:
    """Whether these are the labels of a scene that isn't made yet."""
    return camera.prefix == SCENE and camera.pictures is None and camera.boxes is None and _is_bare(opened, camera)


def _is_bare(opened: log.Log, camera: Camera) -> bool:
    return not any(f"{camera.prefix}/{name}" in opened.channels for name in _BEGINNINGS)


def _lack(opened: log.Log, camera: Camera) -> str:
    """The reason why nothing can be made of a camera; "" if there is none."""
    if camera.boxes or not _is_bare(opened, camera):
        return ""
    if camera.pictures is None:
        with_pictures = sorted(topic for topic in camera.topics if foreign.holds_pictures(opened.channels[topic]))
        if with_pictures:
            return f"has pictures in {list_names(with_pictures)}; `topic=` runs it on one of them"
        has = sorted(topic for topic in camera.topics if "/view/" not in topic)
        return f"has neither pictures nor boxes, but {list_names(has, 5)}"
    if not opened.channels[camera.pictures].messages:
        return f"has no pictures: {camera.pictures} has no messages"
    if depth := foreign.depth_of(opened, camera.pictures):
        return f"has depths in {camera.pictures} ({depth}), in which people are not detected; `topic=` runs it"
    try:
        if size_of_pictures(opened, camera.pictures) is None:
            why = foreign.facts_of(opened, camera.pictures).recogniser.cause
            return f"{UNREAD}: none in {camera.pictures} can be decoded{f', because {why}' if why else ''}"
    except McaptrackError as error:
        return f"{UNREAD}: {error}"
    return ""


def _unfit(opened: log.Log, camera: Camera) -> str:
    """The reason why a camera that no option names isn't run; "" if there is none."""
    if lack := _lack(opened, camera):
        return lack
    topic = camera.pictures
    if topic is None or has_own_channels(opened, camera):
        return ""
    better = foreign.better_form(opened, topic)
    return f"has the pictures of {better} a second time, in {topic}; `camera=` runs it" if better else ""


def begins_with(opened: log.Log, prefix: str) -> str:
    """Describe the input of the run of one of several cameras; "" for the usual one, pictures alone."""
    camera, detections = camera_at(opened, prefix), detections_topic(prefix)
    provenance = provenance_of(opened, detections)
    if detections in opened.channels and (provenance is None or provenance.transform not in STAGES):
        return f"{prefix[1:]} has detections in {detections} already: it is tracked from these, nothing is detected"
    if camera.pictures is None and camera.boxes:
        return f"{prefix[1:]} has no pictures: it is tracked from the boxes in {camera.boxes}"
    if camera.pictures is None:
        return f"{prefix[1:]} has neither pictures nor boxes, but tracks or samples: it is run from these"
    return ""
