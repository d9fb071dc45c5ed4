"""Poses of a camera <-> rows of the channel `motion`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.affine import IDENTITY
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.camera_path import FAR, CameraPath, CameraPose, Verdict, verdict_of
from mcaptrack.schema import CAMERA_MOTION, TRACKS, Frame, Rows
from mcaptrack.schema.framing import JoinedFrames, mapped_rows

_MOTION: Final = ("m00", "m01", "m02_px", "m10", "m11", "m12_px")
_REFERENCE: Final = ("r00", "r01", "r02_px", "r10", "r11", "r12_px")


def pose_to_rows(pose: CameraPose, width_px: int, height_px: int) -> Rows:
    """Encode a pose as the single row of its message."""
    rows = CAMERA_MOTION.empty(1)
    for names, matrix in ((_MOTION, pose.from_previous), (_REFERENCE, pose.to_reference)):
        for name, value in zip(names, matrix.ravel(), strict=True):
            rows[name] = value
    rows["reference_frame"], rows["verdict"], rows["inliers"] = pose.reference, pose.verdict, pose.inliers
    rows["width_px"], rows["height_px"] = width_px, height_px
    return rows


def frames_to_path(frames: Sequence[Frame]) -> CameraPath:
    """Decode a camera's path. Raises McaptrackError unless each frame has one row, and an invertible motion."""
    for frame in frames:
        if len(frame.rows) != 1:
            raise McaptrackError(f"a camera motion message holds one row, not {len(frame.rows)}")
    rows = CAMERA_MOTION.joined([frame.rows for frame in frames])
    poses = []
    for row, is_elsewhere in zip(rows, _elsewhere(rows).tolist(), strict=True):
        motion, reference = (_matrix([float(row[name]) for name in names]) for names in (_MOTION, _REFERENCE))
        try:
            verdict = Verdict(int(row["verdict"]))
        except ValueError:
            verdict = Verdict.LOST
        number = int(row["reference_frame"])
        poses.append(CameraPose(motion, reference, number, float(row["inliers"]), verdict, is_elsewhere))
    return CameraPath(np.array([frame.t_ns for frame in frames], np.int64), poses)


def rows_to_verdict(rows: Rows) -> Verdict:
    """The state of a camera over a whole log, by the rows (F,) of all its messages."""
    return verdict_of(rows["verdict"], _elsewhere(rows))


def _elsewhere(rows: Rows) -> Bools:
    """Whether the camera looks elsewhere than at its reference, at each row (F,)."""
    matrix = np.stack([rows[name] for name in _REFERENCE], axis=1).reshape(-1, 2, 3)
    width, height = rows["width_px"].astype(float), rows["height_px"].astype(float)
    corner = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [1.0, 1.0, 1.0]])
    corners = corner * np.stack([width, height, np.ones(len(rows))], axis=1)[:, None]  # (F, 4, 3)
    away = np.einsum("fij,fcj->fci", matrix, corners) - corners[..., :2]
    is_elsewhere: Bools = np.hypot(away[..., 0], away[..., 1]).max(axis=1) > FAR * np.hypot(width, height)
    return is_elsewhere


def _matrix(values: list[float]) -> Floats:
    """A transform (2, 3); the object ``IDENTITY`` if it is the identity to the bit. Raises McaptrackError."""
    matrix = np.array(values).reshape(2, 3)
    if not is_motion(matrix):
        raise McaptrackError(f"a camera motion is 6 finite numbers, 2 rows of 3, that can be inverted; got {values}")
    return IDENTITY if np.array_equal(matrix, IDENTITY) else matrix


def is_motion(matrix: Floats) -> bool:
    """Whether numbers (2, 3) can be how a camera moved: finite, and invertible."""
    return bool(np.isfinite(matrix).all() and abs(np.linalg.det(matrix[:, :2])) > 1e-12)


def to_scene(frames: Sequence[Frame], path: CameraPath | None) -> Sequence[Frame]:
    """Return frames of tracks with boxes in pixels of the reference picture; as they are without a path."""
    return frames if path is None else _moved(frames, path.to_scene)


def to_pictures(frames: Sequence[Frame], path: CameraPath | None) -> Sequence[Frame]:
    """Return frames of tracks with boxes in pixels of the picture at their time; as they are without a path."""
    return frames if path is None else _moved(frames, path.to_pictures)


def _moved(frames: Sequence[Frame], move: Callable[[Floats, Ints], Floats]) -> Sequence[Frame]:
    def moved(joined: JoinedFrames) -> Rows:
        rows = joined.rows
        rows["x_px"], rows["y_px"], rows["w_px"], rows["h_px"] = move(columns_to_boxes(rows), joined.row_ns).T
        return rows

    return mapped_rows(TRACKS, frames, moved)
