"""The motion of a camera that its tracks are compensated for, and ground truth in metres before such a camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.boxes import columns_to_boxes, headings
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.geometry.plane import GroundPlane, Planes, scene_planes
from mcaptrack.geometry.transform_tree import plain_frame, turned
from mcaptrack.schema import CAMERA_MOTION, DETECTIONS, GROUND_PLANE, TRACKS, Frame
from mcaptrack.schema.as_rows import frames_to_path, rows_to_plane
from mcaptrack.schema.framing import join_frames, split_rows
from mcaptrack.schema.provenance import Provenance, frame_id_of
from mcaptrack.sources.cameras import camera_at, lineage, provenance_of
from mcaptrack.sources.fixed_frame import poses_at
from mcaptrack.transforms import STAGES

__all__ = ["path_of", "planes_in", "read_ground_truth", "tracks_topic"]

#: Positions that differ by no more than this, in metres, are those of a plane.
_SAME_M: Final = 1e-6


def motion_topic(prefix: str) -> str:
    """The topic with the motion of a camera."""
    return f"{prefix}/{STAGES['motion'].output_topic}"


def tracks_topic(prefix: str) -> str:
    """The usual topic of the tracks of a camera."""
    return f"{prefix}/{next(stage.output_topic for stage in STAGES.values() if stage.reads is DETECTIONS)}"


def path_of(
    opened: log.Log,
    prefix: str,
    topic: str,
    provenances: Mapping[str, Provenance] = {},
    frames: Mapping[str, Sequence[Frame]] = {},
) -> tuple[CameraPath | None, Mapping[str, str]]:
    """Return the camera's path, if the tracks that a channel was made from are compensated for it, and its digest.

    ``provenances`` and ``frames`` are those of channels that are not in the log yet, by topic. The digest is by topic.
    The path is None if the tracks are not compensated, or were made from an earlier motion.
    """
    motion = motion_topic(prefix)
    for _, provenance in lineage(opened, topic, provenances):
        if provenance and motion in provenance.references and "camera_motion" in provenance.parameters:
            from mcaptrack.transforms.sort.tracker import used_path

            path = used_path(_read_path(opened, motion, frames), provenance.parameters["camera_motion"])
            return path, {} if path is None else {motion: provenance.references[motion]}
    return None, {}


def _read_path(opened: log.Log, topic: str, frames: Mapping[str, Sequence[Frame]]) -> CameraPath | None:
    if topic not in frames and not opened.holds(topic, CAMERA_MOTION):
        return None
    try:
        return frames_to_path(frames[topic] if topic in frames else opened.frames(topic, CAMERA_MOTION))
    except McaptrackError:
        return None


# Bring ground truth to the frame of reference of the tracks that are compared with it. Letters: N rows.


def in_frame(opened: log.Log, topic: str, frames: Sequence[Frame], target: str, source: str) -> list[Frame]:
    """Return frames of tracks of a channel with positions in metres in another frame of reference.

    Frames at times at which the pose isn't known are left out, with a warning. Raises McaptrackError if it is never
    known.
    """
    if plain_frame(target) == plain_frame(source):
        return list(frames)
    joined = join_frames(TRACKS, frames)
    poses = poses_at(opened, topic, target, source, joined.t_ns, joined.t_ns)
    if not poses.is_known.any():
        raise McaptrackError(
            f"{opened.path}: {topic} is in the frame {source}, tracks are in {target}, and no transform between them "
            "is known; ingest the labels with the right `frame=`"
        )
    rotation, rows = poses.rotation[joined.frame], joined.rows.copy()
    shift = poses.translation[joined.frame]
    height = np.nan_to_num(rows["z_m"])  # a position without a height is taken as on the ground
    place = turned(rotation, np.stack([rows["x_m"], rows["y_m"], height], axis=1)) + shift
    rows["x_m"], rows["y_m"] = place[:, 0], place[:, 1]
    rows["z_m"] = np.where(np.isnan(rows["z_m"]), np.nan, place[:, 2])
    level = np.zeros(len(rows))
    ahead = np.stack([np.cos(rows["heading_rad"]), np.sin(rows["heading_rad"]), level], axis=1)
    rows["heading_rad"] = headings(turned(rotation, ahead))
    velocity = turned(rotation, np.stack([rows["vx_m_per_s"], rows["vy_m_per_s"], level], axis=1))
    rows["vx_m_per_s"], rows["vy_m_per_s"] = velocity[:, 0], velocity[:, 1]
    moved = split_rows(joined.t_ns, [frame.index for frame in frames], rows, joined.ends[1:])
    return [frame for frame, is_known in zip(moved, poses.is_known.tolist(), strict=True) if is_known]


# Ground planes of a log.


def planes_in(opened: log.Log, topic: str) -> list[tuple[int, GroundPlane]]:
    """Return the ground planes of a channel, each with its start time in ns.

    Raises McaptrackError, with the log and the topic, if a message does not hold one plane of finite numbers.
    """
    try:
        return [(frame.t_ns, rows_to_plane(frame.rows)) for frame in opened.frames(topic, GROUND_PLANE)]
    except McaptrackError as error:
        if topic in str(error):
            raise
        raise McaptrackError(f"{opened.path}: {topic}: {error}") from None


def read_ground_truth(
    opened: log.Log, prefix: str, provenances: Mapping[str, Provenance] = {}, frames: Mapping[str, Sequence[Frame]] = {}
) -> list[Frame]:
    """Return the ground truth of a camera, with positions in metres where its pictures show them.

    Labels got their positions from their boxes and the ground plane of the log. Where tracks are compensated for the
    motion of the camera, so are these, because the plane holds for one picture. Where tracks are in another frame of
    reference, labels are brought to it. Parameters are those of ``path_of``.

    ``provenances`` and ``frames`` are those of channels that are not in the log yet.
    """
    camera = camera_at(opened, prefix)
    truth = opened.frames(camera.truth, TRACKS)
    provenance = provenances.get(tracks_topic(prefix)) or provenance_of(opened, tracks_topic(prefix))
    fixed, own = provenance.frame_id if provenance else "", frame_id_of(opened.channel(camera.truth).metadata)
    if fixed and own:
        return in_frame(opened, camera.truth, truth, fixed, own)
    path, _ = path_of(opened, prefix, tracks_topic(prefix), provenances, frames)
    if path is None or camera.ground_plane not in opened.channels:
        return truth
    planes = planes_in(opened, camera.ground_plane)
    return in_metres(truth, planes, path)


def in_metres(frames: Sequence[Frame], planes: Planes, path: CameraPath) -> list[Frame]:
    """Return frames of tracks with the positions in metres that the planes of a moving camera give to their boxes.

    Rows with positions that don't come from their boxes and the first plane keep them.
    """
    joined = join_frames(TRACKS, frames)
    rows, boxes = joined.rows.copy(), columns_to_boxes(joined.rows)
    recorded = np.stack([rows["x_m"], rows["y_m"]], axis=1)
    if not planes or not len(rows):
        return list(frames)
    with np.errstate(invalid="ignore"):
        is_derived = (np.abs(planes[0][1].boxes_to_metres(boxes) - recorded) <= _SAME_M).all(axis=1)
    still = scene_planes(planes, path)
    which = np.searchsorted(np.array([since for since, _ in still[1:]], np.int64), joined.row_ns, "right")
    for number, (_, plane) in enumerate(still):
        of = is_derived & (which == number)
        feet = plane.feet(boxes[of])
        at = path.to_scene(np.concatenate([feet, np.zeros_like(feet)], axis=1), joined.row_ns[of])[:, :2]
        rows["x_m"][of], rows["y_m"][of] = plane.pixels_to_metres(at).T
    return split_rows(joined.t_ns, [frame.index for frame in frames], rows, joined.ends[1:])
