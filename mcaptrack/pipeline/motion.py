"""Camera motion in the pipeline: which stages use it, when it is estimated, and the boxes that it leaves out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, Final, NamedTuple

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.notices import warn
from mcaptrack.pipeline.checks import Job, fits, read_frames
from mcaptrack.pipeline.write import Made, digest_of
from mcaptrack.schema import CAMERA_MOTION, DETECTIONS, VIDEO, Frame, Schema
from mcaptrack.schema.camera_motion import frames_to_path
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.camera_motion import motion_topic, path_of, read_ground_truth
from mcaptrack.sources.cameras import camera_at, provenance_of
from mcaptrack.transforms import STAGES, Transform
from mcaptrack.transforms.protocol import traits_of

STAGE: Final = "motion"
_OFF: Final = "off"


class SideInputs(NamedTuple):
    """Inputs of a job beside its main one: values of its transform by name, and the digests of the topics."""

    values: Mapping[str, Any]
    references: Mapping[str, str]


def uses_motion(transform: Transform | None) -> bool:
    """Whether a transform takes camera motion into account where it is known."""
    return getattr(transform, "camera_motion", _OFF) != _OFF


def is_motion_new(opened: log.Log, prefix: str, provenance: Provenance) -> bool:
    """Whether a channel that takes camera motion into account was made before the motion was known."""
    usual = _OFF
    if provenance.transform in STAGES and "transform" not in provenance.plugins:
        usual = getattr(STAGES[provenance.transform].default, "camera_motion", _OFF)
    is_used = provenance.parameters.get("camera_motion", usual) != _OFF
    topic = motion_topic(camera_at(opened, prefix).prefix)
    return is_used and topic in opened.channels and topic not in provenance.references


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
    name = provenance.parameters.get("detector", "")
    return traits_of(stage.built_in().get(str(name), stage.default)).needs_still_camera


def side_inputs(opened: log.Log, prefix: str, job: Job, results: Mapping[str, Made]) -> SideInputs:
    """Return the inputs of a job beside its main one. ``results`` are the channels that jobs before it made."""
    names = {f.name for f in fields(job.transform) if f.metadata.get("context")}
    if "camera_path" in names and uses_motion(job.transform):
        return _path(opened, prefix, job, results)
    if "known_boxes" in names and getattr(job.transform, "mask_boxes", False):
        return _boxes(opened, prefix, results)
    return SideInputs({}, {})


def _path(opened: log.Log, prefix: str, job: Job, results: Mapping[str, Made]) -> SideInputs:
    """Return the path of the camera, if its motion is known."""
    topic = motion_topic(prefix)
    motion_read = _read(opened, topic, CAMERA_MOTION, results)
    if motion_read is None:
        if getattr(job.transform, "camera_motion", "") == "on":
            warn(f"the motion of the camera is not known: {topic} needs pictures of it in the log", "option-not-used")
        return SideInputs({}, {})
    frames, digest = motion_read
    try:
        path = frames_to_path(frames)
    except McaptrackError as error:
        raise McaptrackError(f"{opened.path}: {topic}: {error}") from None
    return SideInputs({"camera_path": path}, {topic: digest})


def path_with(
    opened: log.Log, prefix: str, topic: str, results: Mapping[str, Made]
) -> tuple[CameraPath | None, Mapping[str, str]]:
    """Return what ``path_of`` does, with the channels of this run."""
    return path_of(opened, prefix, topic, *_of_run(results))


def ground_truth_with(opened: log.Log, prefix: str, results: Mapping[str, Made]) -> list[Frame]:
    """Return what ``read_ground_truth`` does, with the channels of this run."""
    return read_ground_truth(opened, prefix, *_of_run(results))


def _of_run(results: Mapping[str, Made]) -> tuple[dict[str, Provenance], dict[str, Sequence[Frame]]]:
    return {topic: channel.provenance for topic, channel in results.items()}, {
        topic: channel.frames for topic, channel in results.items()
    }


def moves(opened: log.Log, prefix: str, results: Mapping[str, Made]) -> bool:
    """Whether the camera is known to move, or its pictures to have cuts."""
    motion_read = _read(opened, motion_topic(prefix), CAMERA_MOTION, results)
    try:
        return motion_read is not None and frames_to_path(motion_read[0]).matters
    except McaptrackError:
        return False


def _boxes(opened: log.Log, prefix: str, results: Mapping[str, Made]) -> SideInputs:
    """The boxes of people, by the time of their picture."""
    usual = f"{prefix}/{next(s.output_topic for s in STAGES.values() if s.writes[''] is DETECTIONS)}"
    topic = usual if usual in results or usual in opened.channels else camera_at(opened, prefix).boxes
    boxes_read = None if topic is None else _read(opened, topic, DETECTIONS, results)
    if topic is None or boxes_read is None or _needs_still_camera(opened, topic, ()):
        return SideInputs({}, {})
    boxes = {frame.t_ns: columns_to_boxes(frame.rows) for frame in boxes_read[0] if len(frame.rows)}
    return SideInputs({"known_boxes": boxes}, {topic: boxes_read[1]})


def _read(
    opened: log.Log, topic: str, schema: Schema, results: Mapping[str, Made]
) -> tuple[Sequence[Frame], str] | None:
    """The frames of a channel and their digest; None if it isn't there or holds something else."""
    if topic in results:
        return results[topic].frames, results[topic].provenance.digest
    channel = opened.channels.get(topic)
    if channel is None or not fits(channel, schema)[1]:
        return None
    return read_frames(opened, topic, schema), digest_of(opened, topic)
