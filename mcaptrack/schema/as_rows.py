"""Objects <-> rows of their channels: ground planes, poses of cameras (`motion`), and predictions.

Letters: F frames, N tracks at one time, T future steps, R rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.affine import IDENTITY
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.camera_path import FAR, CameraPath, CameraPose, Verdict, verdict_of
from mcaptrack.geometry.mixtures import Tails
from mcaptrack.geometry.pinhole import Lens
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.predictors import Forecast
from mcaptrack.schema import CAMERA_MOTION, GROUND_PLANE, PREDICTIONS, TRACKS, Frame, Rows
from mcaptrack.schema.framing import JoinedFrames, mapped_rows

#: The columns of distortion, in the order of OpenCV; a lens without distortion has zeros in the first five.
_POLYNOMIAL: Final = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE: Final = ("k1", "k2", "k3", "k4")
_PLUMB_BOB: Final = 5


def plane_to_rows(plane: GroundPlane) -> Rows:
    """Encode a ground plane as the single row of its message."""
    names = [f"h{row}{column}" for row in range(3) for column in range(3)]
    lens = {} if plane.lens is None else _lens_to_columns(plane.lens)
    return GROUND_PLANE.rows(
        **{name: [value] for name, value in zip(names, plane.homography, strict=True)},
        width_px=[plane.width_px],
        height_px=[plane.height_px],
        foot=[plane.point == "foot"],
        assumed=[plane.assumed],
        **{name: [value] for name, value in lens.items()},
    )


def rows_to_plane(rows: Rows) -> GroundPlane:
    """Decode a ground plane. Raises McaptrackError unless there is exactly one row."""
    if len(rows) != 1:
        raise McaptrackError(f"a ground plane message holds one row, not {len(rows)}")
    row = rows[0]
    homography = tuple(float(row[f"h{i}{j}"]) for i in range(3) for j in range(3))
    size = (int(row["width_px"]), int(row["height_px"]))
    lens = _columns_to_lens(row) if np.isfinite(row["fx_px"]) else None
    return GroundPlane(homography, *size, "foot" if row["foot"] else "center", bool(row["assumed"]), lens)


def _lens_to_columns(lens: Lens) -> dict[str, float]:
    (fx, fy), (cx, cy) = lens.focal_px, lens.centre_px
    bent = lens.distortion or (0.0,) * _PLUMB_BOB
    names = _FISHEYE if lens.is_fisheye else _POLYNOMIAL
    columns = {"fx_px": fx, "fy_px": fy, "cx_px": cx, "cy_px": cy}
    return columns | dict(zip(names, bent, strict=False))


def _columns_to_lens(row: np.void) -> Lens:
    is_fisheye = bool(np.isnan(row["p1"]))
    bent = [float(row[name]) for name in (_FISHEYE if is_fisheye else _POLYNOMIAL)]
    coefficients = tuple(value for value in bent if np.isfinite(value))
    focal, centre = ((float(row[f"{name}x_px"]), float(row[f"{name}y_px"])) for name in "fc")
    return Lens(focal, centre, coefficients if any(coefficients) else (), is_fisheye and any(coefficients))


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


def forecast_to_rows(ids: NDArray[np.int64], forecast: Forecast, step_s: float, tails: Tails | None = None) -> Rows:
    """Predictions of N tracks as N x T rows; ``tails`` (N, T) if they are mixtures."""
    count, steps = forecast.mean.shape[:2]
    step = np.tile(np.arange(1, steps + 1), count)
    mean, cov = forecast.mean.reshape(-1, 2), forecast.cov.reshape(-1, 2, 2)
    mixtures = {} if tails is None else {name: part.reshape(-1) for name, part in tails._asdict().items()}
    return PREDICTIONS.rows(
        track_id=np.repeat(ids, steps),
        step=step,
        ahead_s=step * step_s,
        x_m=mean[:, 0],
        y_m=mean[:, 1],
        cov_xx_m2=cov[:, 0, 0],
        cov_xy_m2=cov[:, 0, 1],
        cov_yy_m2=cov[:, 1, 1],
        **mixtures,
    )


def tails_of(rows: Rows, *shape: int) -> Tails:
    """The shapes of the distributions of R rows, reshaped to (-1, *shape) if a shape is given."""
    parts = (np.asarray(rows[name], np.float64) for name in Tails._fields)
    return Tails(*(part.reshape(-1, *shape) if shape else part for part in parts))
