"""Poses of a camera <-> rows of the channel `motion`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.affine import IDENTITY
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.camera_path import CameraPath, CameraPose, Verdict
from mcaptrack.schema import CAMERA_MOTION, Frame, Rows

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
    poses = []
    for frame in frames:
        if len(frame.rows) != 1:
            raise McaptrackError(f"a camera motion message holds one row, not {len(frame.rows)}")
        row = frame.rows[0]
        motion, reference = (_matrix([float(row[name]) for name in names]) for names in (_MOTION, _REFERENCE))
        try:
            verdict = Verdict(int(row["verdict"]))
        except ValueError:
            verdict = Verdict.LOST
        number = int(row["reference_frame"])
        poses.append(CameraPose(motion, reference, number, float(row["inliers"]), verdict))
    return CameraPath(np.array([frame.t_ns for frame in frames], np.int64), poses)


def _matrix(values: list[float]) -> Floats:
    """A transform (2, 3); the object ``IDENTITY`` if it is the identity to the bit. Raises McaptrackError."""
    matrix = np.array(values).reshape(2, 3)
    if not is_motion(matrix):
        raise McaptrackError(f"a camera motion is 6 finite numbers, 2 rows of 3, that can be inverted; got {values}")
    return IDENTITY if np.array_equal(matrix, IDENTITY) else matrix


def is_motion(matrix: Floats) -> bool:
    """Whether numbers (2, 3) can be how a camera moved: finite, and invertible."""
    return bool(np.isfinite(matrix).all() and abs(np.linalg.det(matrix[:, :2])) > 1e-12)
