"""Camera motion in the pipeline: which stages use it, when it is estimated, and the boxes that it leaves out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.installed import missing_extension
from mcaptrack.notices import warn
from mcaptrack.pipeline.checks import Job, fits, read_frames
from mcaptrack.pipeline.staleness import OFF
from mcaptrack.pipeline.write import RunState
from mcaptrack.schema import CAMERA_MOTION, DETECTIONS, VIDEO, Frame
from mcaptrack.schema.as_rows import frames_to_path
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.camera_motion import motion_topic, path_of, read_ground_truth
from mcaptrack.sources.cameras import camera_at, provenance_of
from mcaptrack.transforms import STAGES, Transform
from mcaptrack.transforms.protocol import traits_of

STAGE: Final = "motion"


class SideInput(NamedTuple):
    """An input of a job beside its main one: the value of a field of its transform, and the digests of its topics."""

    value: Any
    references: Mapping[str, str] = {}


def uses_motion(transform: Transform | None) -> bool:
    """Whether a transform takes camera motion into account where it is known."""
    return getattr(transform, "camera_motion", OFF) != OFF


def is_motion_wanted(opened: log.Log, transform: Transform, boxes: str, jobs: Sequence[Job]) -> bool:
    """Whether the motion of a camera is needed before its boxes are tracked.

    It isn't if the boxes come from a detector that needs a still camera, unless it is switched on.
    """
    if not uses_motion(transform):
        return False
    return getattr(transform, "camera_motion", "") == "on" or not _needs_still_camera(opened, boxes, jobs)


def _needs_still_camera(opened: log.Log, boxes: str, jobs: Sequence[Job]) -> bool:
    """Whether boxes come, or will come, from a detector that needs a still camera."""
    for job in jobs:
        if job.target == boxes:
            return traits_of(job.transform).needs_still_camera
    return detects_motion(provenance_of(opened, boxes))


def detects_motion(provenance: Provenance | None) -> bool:
    """Whether a channel has the boxes of a detector that needs a still camera."""
    stage = STAGES.get(provenance.transform) if provenance and "transform" not in provenance.plugins else None
    if provenance is None or stage is None or stage.reads is not VIDEO:
        return False
    name = str(provenance.parameters.get("detector", ""))
    if missing_extension(name, "detector"):  # as of another package
        return False
    return traits_of(stage.built_in().get(name, stage.default)).needs_still_camera


def motion_input(state: RunState, transform: Transform) -> SideInput | None:
    """Return the path of the camera for a transform that compensates for it, if its motion is known."""
    if not uses_motion(transform):
        return None
    topic = motion_topic(state.prefix)
    if not state.holds(topic, CAMERA_MOTION):
        if getattr(transform, "camera_motion", "") == "on":
            warn(f"the motion of the camera is not known: {topic} needs pictures of it in the log", "option-not-used")
        return None
    try:
        path = frames_to_path(state.frames(topic, CAMERA_MOTION))
    except McaptrackError as error:
        raise McaptrackError(f"{state.opened.path}: {topic}: {error}") from None
    return SideInput(path, {topic: state.digest(topic)})


def path_with(state: RunState, topic: str) -> tuple[CameraPath | None, Mapping[str, str]]:
    """Return what ``path_of`` does, with the channels of this run."""
    return path_of(state.opened, state.prefix, topic, *_of_run(state))


def ground_truth_with(state: RunState) -> list[Frame]:
    """Return what ``read_ground_truth`` does, with the channels of this run."""
    return read_ground_truth(state.opened, state.prefix, *_of_run(state))


def _of_run(state: RunState) -> tuple[dict[str, Provenance], dict[str, Sequence[Frame]]]:
    results = state.results.items()
    return {topic: channel.provenance for topic, channel in results}, {name: made.frames for name, made in results}


def moves(state: RunState) -> bool:
    """Whether the camera is known to move, or its pictures to have cuts."""
    topic = motion_topic(state.prefix)
    frames = state.frames(topic, CAMERA_MOTION)
    try:
        return state.holds(topic, CAMERA_MOTION) and frames_to_path(frames).matters
    except McaptrackError:
        return False


def boxes_input(state: RunState, transform: Transform) -> SideInput | None:
    """Return the boxes of people by the time of their picture, for a transform that leaves them out."""
    if not getattr(transform, "mask_boxes", False):
        return None
    opened = state.opened
    usual = f"{state.prefix}/{next(s.output_topic for s in STAGES.values() if s.writes[''] is DETECTIONS)}"
    is_usual = usual in state.results or usual in opened.channels
    topic = usual if is_usual else camera_at(opened, state.prefix).boxes
    if topic is None or _needs_still_camera(opened, topic, ()):
        return None
    if topic not in state.results and not fits(opened, topic, DETECTIONS)[1]:
        return None
    frames = state.frames(topic, DETECTIONS) if topic in state.results else read_frames(opened, topic, DETECTIONS)
    boxes = {frame.t_ns: columns_to_boxes(frame.rows) for frame in frames if len(frame.rows)}
    return SideInput(boxes, {topic: state.digest(topic)})
