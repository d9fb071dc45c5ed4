"""Cameras with known intrinsics, compared with OpenCV's projection."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.pinhole import Lens, ground_homography, project

FOCAL, CENTRE = (800.0, 790.0), (641.0, 355.0)
LENSES = {
    "none": Lens(FOCAL, CENTRE),
    "four": Lens(FOCAL, CENTRE, (-0.2, 0.05, 0.001, -0.002)),
    "plumb_bob": Lens(FOCAL, CENTRE, (-0.3, 0.1, 0.001, -0.002, -0.01)),
    "rational": Lens(FOCAL, CENTRE, (0.4, -0.2, 0.001, 0.0005, 0.01, 0.75, -0.1, 0.03)),
    "fisheye": Lens((400.0, 405.0), CENTRE, (-0.01, 0.02, -0.005, 0.001), is_fisheye=True),
}
#: A camera 1.5 m above the ground that looks along x, 10 degrees down: its axes in the ground frame.
TURN = Rotation.from_euler("y", 10, degrees=True) * Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
ROTATION = TURN.inv().as_matrix()
TRANSLATION = -ROTATION @ np.array([0.3, 0.1, 1.5])


def by_opencv(points, lens):
    turn = cv2.Rodrigues(ROTATION)[0]
    given = np.array(lens.distortion)
    if lens.is_fisheye:
        found, _ = cv2.fisheye.projectPoints(points[:, None], turn, TRANSLATION, lens.matrix, given)
    else:
        found, _ = cv2.projectPoints(points[:, None], turn, TRANSLATION, lens.matrix, given)
    return found[:, 0]


def ground_points(count=300):
    rng = np.random.default_rng(1)
    along = rng.uniform(4, 30, count)
    return np.stack([along, along * rng.uniform(-0.6, 0.6, count), np.zeros(count)], axis=1)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
class TestAsOpenCV:
    def test_points_in_front(self, lens):
        points = ground_points() + [0, 0, 0.5]
        found, in_front = project(points, lens, ROTATION, TRANSLATION)
        assert in_front.all()
        assert np.abs(found - by_opencv(points, lens)).max() < 1e-6

    def test_distortion_is_taken_out(self, lens):
        straight = Lens(lens.focal_px, lens.centre_px)
        points = ground_points()
        distorted = by_opencv(points, lens)
        assert np.abs(lens.undistort(distorted) - by_opencv(points, straight)).max() < 1e-4

    def test_metres_on_the_ground(self, lens):
        points = ground_points()
        plane = np.reshape(ground_homography(lens, ROTATION, TRANSLATION, np.eye(3)), (3, 3))
        straight = lens.undistort(by_opencv(points, lens))
        x, y, w = plane @ np.column_stack([straight, np.ones(len(points))]).T
        assert (w > 0).all()
        assert np.abs(np.stack([x / w, y / w], 1) - points[:, :2]).max() < 1e-3

    def test_points_behind(self, lens):
        found, in_front = project(np.array([[-5.0, 0, 0], [5, 0, 0]]), lens, ROTATION, TRANSLATION)
        assert in_front.tolist() == [False, True]
        assert np.isnan(found).all(axis=1).tolist() == [True, False]

    def test_no_points(self, lens):
        assert project(np.empty((0, 3)), lens, ROTATION, TRANSLATION)[0].shape == (0, 2)
        assert lens.undistort(np.empty((0, 2))).shape == (0, 2)


def test_points_beyond_the_edge_of_a_lens_are_nowhere():
    """A polynomial folds back: OpenCV draws a point 70 degrees to the side into the picture."""
    lens = LENSES["plumb_bob"]
    aside = np.array([[5.0, 5 * np.tan(np.radians(70)), 0]])
    folded = by_opencv(aside, lens)
    assert not np.isfinite(folded).all() or np.abs(lens.undistort(folded) - folded).max() < 1e5
    assert np.isnan(project(aside, lens, ROTATION, TRANSLATION)[0]).all()
    assert np.isfinite(project(aside * [1, 0.2, 1], lens, ROTATION, TRANSLATION)[0]).all()


def test_pixels_of_another_picture():
    """The camera has moved by 7 pixels to the right and 2 down since: its lens bends what it sees now."""
    lens = LENSES["plumb_bob"]
    moved = lens.after(np.array([[1.0, 0, 7], [0, 1, 2]]))
    xy = np.array([[100.0, 200], [640, 360], [1200, 700]])
    assert moved.undistort(xy) == pytest.approx(lens.undistort(xy + [7, 2]))
    assert moved.distort(lens.undistort(xy + [7, 2])) == pytest.approx(xy, abs=1e-4)
    again = moved.after(np.array([[2.0, 0, 1], [0, 2, 0]]))
    assert again.undistort(xy / 4) == pytest.approx(lens.undistort(xy / 2 + [8, 2]))


@pytest.mark.parametrize(
    "bad",
    [
        {"focal_px": (0.0, 1.0)},
        {"focal_px": (float("nan"), 1.0)},
        {"distortion": (0.1,) * 6},
        {"distortion": (float("inf"), 0.0, 0.0, 0.0)},
        {"distortion": (0.1,) * 5, "is_fisheye": True},
    ],
)
def test_lenses_that_are_none(bad):
    with pytest.raises(McaptrackError):
        Lens(**{"focal_px": FOCAL, "centre_px": CENTRE, **bad})


def test_a_camera_below_the_ground():
    with pytest.raises(McaptrackError, match=r"the camera is 2\.00 m below the ground"):
        ground_homography(LENSES["none"], ROTATION, -ROTATION @ np.array([0, 0, -2.0]), np.eye(3))
