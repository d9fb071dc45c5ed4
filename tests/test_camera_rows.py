"""Ground planes and poses of cameras as rows of their channels, column by column; expected by hand."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.affine import IDENTITY
from mcaptrack.geometry.camera_path import CameraPose, Verdict
from mcaptrack.geometry.pinhole import Lens
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import CAMERA_MOTION, GROUND_PLANE, Frame
from mcaptrack.schema.as_rows import (
    frames_to_path,
    is_motion,
    plane_to_rows,
    pose_to_rows,
    rows_to_plane,
    rows_to_verdict,
)

BENT = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@pytest.mark.parametrize(
    ("bent", "is_fisheye", "columns"),
    [
        ((), False, dict.fromkeys(BENT[:5], 0.0)),
        ((0.1, 0.2, 0.3, 0.4), False, dict(zip(BENT, (0.1, 0.2, 0.3, 0.4), strict=False))),
        ((0.1, 0.2, 0.3, 0.4, 0.5), False, dict(zip(BENT, (0.1, 0.2, 0.3, 0.4, 0.5), strict=False))),
        (tuple(range(1, 9)), False, dict(zip(BENT, range(1, 9), strict=True))),
        ((0.1, 0.0, 0.3, 0.4), True, {"k1": 0.1, "k2": 0.0, "k3": 0.3, "k4": 0.4}),
    ],
)
def test_a_ground_plane_with_a_lens(bent, is_fisheye, columns):
    numbers = (1.0, 2, 3, 4, 5, 6, 7, 8, 10)
    plane = GroundPlane(numbers, 640, 480, "center", True, Lens((900.0, 800.0), (320.0, 240.0), bent, is_fisheye))
    rows = plane_to_rows(plane)
    assert [rows[f"h{n // 3}{n % 3}"][0] for n in range(9)] == list(numbers)
    assert (rows["width_px"][0], rows["height_px"][0], rows["foot"][0], rows["assumed"][0]) == (640, 480, False, True)
    assert [rows[f"{name}_px"][0] for name in ("fx", "fy", "cx", "cy")] == [900, 800, 320, 240]
    assert {name: rows[name][0] for name in BENT if np.isfinite(rows[name][0])} == columns
    assert rows_to_plane(rows) == plane


def test_a_ground_plane_without_a_lens():
    plane = GroundPlane((1.0, 0, 0, 0, 1, 0, 0, 0, 1), 64, 48)
    rows = plane_to_rows(plane)
    assert (rows["foot"][0], rows["assumed"][0]) == (True, False)
    assert np.isnan([rows[name][0] for name in ("fx_px", "fy_px", "cx_px", "cy_px", *BENT)]).all()
    assert rows_to_plane(rows) == plane
    for count in (0, 2):
        with pytest.raises(McaptrackError, match=f"a ground plane message holds one row, not {count}"):
            rows_to_plane(GROUND_PLANE.empty(count))


def poses(*rows: np.ndarray) -> list[CameraPose]:
    path = frames_to_path([Frame(n, n, one) for n, one in enumerate(rows)])
    return [path.pose_at(n) for n in range(len(rows))]


def pose(x_px: float = 0, y_px: float = 0, **changed) -> CameraPose:
    plain = {"reference": 3, "inliers": 0.75, "verdict": Verdict.STILL, "is_elsewhere": False}
    reference = np.array([[1, 0, x_px], [0, 1, y_px]], float)
    return CameraPose(np.array([[1, 2, 3], [4, 5, 6.0]]), reference, **plain | changed)


def test_a_pose_has_a_column_for_each_number():
    rows = pose_to_rows(pose(7, 8), 640, 480)
    names = [f"{kind}{row}{end}" for kind in "mr" for row in "01" for end in ("0", "1", "2_px")]
    assert [rows[name][0] for name in names] == [1, 2, 3, 4, 5, 6, 1, 0, 7, 0, 1, 8]
    assert (rows["reference_frame"][0], rows["inliers"][0], rows["verdict"][0]) == (3, 0.75, int(Verdict.STILL))
    assert (rows["width_px"][0], rows["height_px"][0]) == (640, 480)
    (found,) = poses(rows)
    assert found.from_previous.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert found.to_reference.tolist() == [[1, 0, 7], [0, 1, 8]]
    assert (found.reference, found.inliers, found.verdict, found.is_elsewhere) == (3, 0.75, Verdict.STILL, False)
    plain = rows.copy()
    for name, value in zip(names, [1, 0, 0, 0, 1, 0] * 2, strict=True):
        plain[name] = value
    (found,) = poses(plain)
    assert found.from_previous is IDENTITY
    plain["verdict"] = 250
    assert poses(plain)[0].verdict == Verdict.LOST
    for count in (0, 2):
        with pytest.raises(McaptrackError, match=f"a camera motion message holds one row, not {count}"):
            frames_to_path([Frame(5, 0, rows), Frame(6, 1, CAMERA_MOTION.empty(count))])
    rows["m11"] = 8  # 1 * 8 - 2 * 4 = 0
    with pytest.raises(McaptrackError, match="that can be inverted; got"):
        frames_to_path([Frame(5, 0, rows)])
    assert not is_motion(np.array([[1, 0, np.inf], [0, 1, 0]]))
    assert is_motion(np.array([[1e-5, 0, 0], [0, 1e-5, 0]]))


def test_a_camera_looks_elsewhere_by_the_size_of_its_pictures():
    """Farther than a tenth of the diagonal: that of 300 x 400 is 500, of 600 x 800 1000."""
    moves = [(0, 49, 300), (51, 0, 300), (0, -51, 600), (99, 0, 600), (0, 101, 600)]
    rows = [pose_to_rows(pose(x, y), width, width * 4 // 3) for x, y, width in moves]
    assert [one.is_elsewhere for one in poses(*rows)] == [False, True, False, False, True]
    assert rows_to_verdict(np.concatenate(rows[2:4])) == Verdict.STILL
