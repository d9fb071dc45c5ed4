"""What is taken from a calibration file: a table of files, and of values that are just inside or outside of limits."""

from __future__ import annotations

import json
import re
from itertools import count

import numpy as np
import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.sources.ingest.calibration import CameraFile, read_cameras

K = [900.0, 0, 960, 0, 890, 540, 0, 0, 1]
#: A quarter turn about the third axis, and a place.
TURN, PLACE = [[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], [1.0, 2, 3]
POSE = [[*row, at] for row, at in zip(TURN, PLACE, strict=True)]
EYE = np.eye(3).tolist()


@pytest.fixture
def read(tmp_path):
    """Read a calibration that is given as values; its text, if it is text."""
    numbers = count()

    def read_one(values: dict | str | None = None, **more) -> CameraFile:
        path = tmp_path / f"{next(numbers)}.yaml"
        path.write_text(values if isinstance(values, str) else json.dumps((values or {}) | more))
        (one,) = read_cameras(path)
        return one

    return read_one


def refused(read, values: dict, said: str) -> None:
    with pytest.raises(McaptrackError) as error:
        read(values)
    assert said in str(error.value)
    assert re.match(r"\S*\d+\.yaml\b", str(error.value))


def entry(place: int, value: float) -> list[float]:
    """The camera matrix with another entry."""
    return K[:place] + [value] + K[place + 1 :]


@pytest.mark.parametrize(
    ("values", "turn", "place"),
    [
        ({"extrinsic": POSE}, TURN, PLACE), ({"RT": [*POSE, [0, 0, 0, 1]]}, TURN, PLACE),
        ({"T_cam_world": np.ravel(POSE).tolist()}, TURN, PLACE), ({"tvec": [4, 5, 6], "RT": POSE}, TURN, PLACE),
        ({"R": TURN, "t": PLACE, "RT": POSE}, TURN, PLACE),
        ({"rotation_matrix": EYE, "translation": [[4], [5], [6]], "RT": POSE}, EYE, [4, 5, 6]),
        ({"rvec": [0, 0, np.pi / 2], "tvec": PLACE, "RT": [*POSE[:2], [0, 0, 1, 9]]}, TURN, PLACE),
        ({"rvec": [0, 0, np.pi / 2], "R": EYE, "tvec": PLACE}, TURN, PLACE),
        ({"rvec": np.ravel(TURN).tolist(), "tvec": PLACE}, TURN, PLACE), ({"K": K}, None, None),
    ],
)  # fmt: skip
def test_poses(read, values, turn, place):
    one = read(values)
    for found, wanted, shape in ((one.rotation, turn, (3, 3)), (one.translation, place, (3,))):
        assert (found is None) == (wanted is None)
        if wanted is not None:
            assert np.shape(found) == shape
            np.testing.assert_allclose(found, wanted, atol=1e-12)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"RT": POSE[:2]}, "rt has 8 numbers; a pose is a matrix of 3 x 4 or 4 x 4"),
        ({"RT": [*POSE, [0, 0, 0, 1, 0]]}, "rt has 17 numbers"),
        ({"RT": [[0, 1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]]}, "rt is not a rotation and a translation"),  # a mirror
        ({"RT": [[1.0006, 0, 0, 1], *np.eye(4)[1:].tolist()]}, "rt is not a rotation"),
        ({"tvec": PLACE}, "has a translation and no rotation (rvec)"),
        ({"R": EYE}, "has a rotation and no translation (tvec)"),
        ({"rvec": PLACE}, "has a rotation and no translation (tvec)"),
        ({"rvec": PLACE, "tvec": [1, 2]}, "rvec has 3 numbers and tvec 2; the pose of a camera is"),
        ({"rvec": [1, 2], "tvec": PLACE}, "rvec has 2 numbers and tvec 3"),
        ({"R": EYE, "tvec": [*PLACE, 1]}, "r has 9 numbers and tvec 4"),
        ({"R": [[0, 1, 0], [1, 0, 0], [0, 0, 1]], "tvec": PLACE}, "r is not a rotation"),
        ({"K": entry(0, 1e5)}, "its focal lengths are 100000 and 890 pixels"),
        ({"K": entry(4, 1e5)}, "its focal lengths are 900 and 100000 pixels"),
        ({"K": entry(4, -1)}, "its focal lengths are 900 and -1 pixels"),
        ({"K": entry(4, 0)}, "its focal lengths are 900 and 0 pixels"),
        ({"K": entry(3, 1e-8)}, "is not fx 0 cx, 0 fy cy, 0 0 1"),
        ({"K": entry(6, 1e-8)}, "is not fx 0 cx, 0 fy cy, 0 0 1"),
        ({"K": entry(7, -1e-8)}, "is not fx 0 cx, 0 fy cy, 0 0 1"),
        ({"K": entry(8, 1 - 1e-8)}, "is not fx 0 cx, 0 fy cy, 0 0 1"),
        ({"K": entry(2, -100_001)}, "is not fx 0 cx, 0 fy cy, 0 0 1"),
        ({"K": entry(1, 0.91)}, "has a skew of 0.91"),
        ({"K": entry(1, -0.91)}, "has a skew of -0.91"),
        ({"K": [*K, 1]}, "yaml: k has 10 numbers, and needs 3 x 3"),
        ({"K": [900, 0, 960, 0, float("nan"), 540, 0, 0, 1]}, "k holds something else than finite numbers"),
        ({"K": [0] * 9}, "its focal lengths are 0 and 0 pixels"),
        ({"D": [0.1] * 12, "K": K}, "with thin prisms or a tilted sensor"),
        ({"cam0": {"camera_model": "omni", "intrinsics": [1, 2, 3, 4]}}, "of the camera model 'omni'"),
        (
            {"cam0": {"camera_model": "pinhole", "intrinsics": [1, 2, 3, 4], "T_cam_imu": [1, 2]}},
            "T_cam_imu has 2 numbers",
        ),
        ({"K": ["x", *K[1:]]}, "yaml: k holds something else than finite numbers"),
        ({"K": K, "D1": [1], "M2": K}, "holds two cameras (K, D1, M2), of which m2 is one"),
        ({"rms": 1, "boards": 2}, "holds rms, boards; a calibration has"),
        ({f"a{n}": 1 for n in range(12)}, "a10, a11; a calibration has"),
        ({f"a{n}": 1 for n in range(13)}, "a10, a11 ...; a calibration has"),
        ({"K": K, "D": [1, 2, 3]}, "has 3 coefficients of distortion; plumb_bob has 5"),
        ({"K": K, "D": [0.1] * 6}, "has 6 coefficients of distortion; rational_polynomial has 8"),
        ({"K": K, "D": [0.1] * 5, "fisheye": 1}, "has 5 coefficients of distortion; kannala_brandt has 4"),
        ({"K": K, "D": [0.1] * 8 + [0, 0.1]}, "has 10 coefficients of distortion, with thin prisms"),
        ({"K": K, "D": [0.1] * 4, "distortion_model": "fov"}, "has distortion by 'fov'"),
        ({"K": K, "image_width": 640.5, "image_height": 480}, "640.5 x 480 is no size"),
        ({"K": K, "image_width": 640, "image_height": 100_000}, "640 x 100000 is no size"),
        ({"K": K, "image_width": 0, "image_height": 480}, "0 x 480 is no size"),
        ({"K": K, "image_width": "wide", "image_height": 480}, "wide x 480 is no size"),
        ({"K": K, "D": {"rows": 1, "cols": 3, "data": [1, 2, 3, 4]}}, "d has 4 numbers, and says that it is 1 x 3"),
        ({"K": K, "D": {"values": [1, 2, 3, 4]}}, "d holds something else than finite numbers"),
        ({"cam0": {"camera_model": "pinhole", "intrinsics": [1, 2, 3]}}, "cam0 has 3 intrinsics"),
        ({"cam0": {"camera_model": "pinhole", "intrinsics": [1, 2, 3, 4, 5]}}, "cam0 has 5 intrinsics"),
        ({"cam0": {"intrinsics": [1, 2, 3, 4]}}, "cam0 is of the camera model 'unknown'"),
        (
            {"cam0": {"camera_model": "pinhole", "intrinsics": [1, 2, 3, 4], "T_cam_imu": [*POSE, [0, 0, 0, 1.1]]}},
            "cam0: T_cam_imu is not a rotation",
        ),
        ({"K": K, "distortion_model": "plumb_bob", "binning_x": 2}, "pictures that are binned or a region"),
        ({"K": K, "distortion_model": "plumb_bob", "binning_y": 4}, "pictures that are binned or a region"),
        ({"K": K, "distortion_model": "plumb_bob", "roi": {"y_offset": 4}}, "pictures that are binned or a region"),
        ({"K": K, "distortion_model": "plumb_bob", "roi": {"height": 4}}, "pictures that are binned or a region"),
    ],
)
def test_what_is_refused(read, values, said):
    refused(read, values, said)


@pytest.mark.parametrize(
    "matrix",
    [entry(0, 99_999), entry(4, 99_999), entry(2, 1e5), entry(2, -1e5), entry(1, 0.9), entry(1, -0.9), entry(8, 1 + 1e-10)],
)  # fmt: skip
def test_matrices_just_inside_of_limits(read, matrix):
    assert read(camera_matrix=matrix).matrix.ravel().tolist() == matrix


def test_a_rotation_is_one_within_a_thousandth(read):
    assert read(R=(np.eye(3) * 1.0004).tolist(), T=PLACE).rotation[0, 0] == 1.0004


@pytest.mark.parametrize(
    ("given", "model", "bent"),
    [
        ({}, "plumb_bob", []),
        ({"D": []}, "plumb_bob", []),
        ({"D": [1, 2, 3, 4]}, "plumb_bob", [1, 2, 3, 4, 0]),
        ({"D": [1, 2, 3, 4, 5]}, "plumb_bob", [1, 2, 3, 4, 5]),
        ({"D": [1, 2, 3, 4, 5, 6, 7, 8]}, "rational_polynomial", [1, 2, 3, 4, 5, 6, 7, 8]),
        ({"D": [1, 2, 3, 4, 5, 0, 0, 0]}, "rational_polynomial", [1, 2, 3, 4, 5, 0, 0, 0]),
        ({"D": [1, 2, 3, 4, 5, 0, 0, 0, 0, 0, 0, 0]}, "rational_polynomial", [1, 2, 3, 4, 5, 0, 0, 0]),
        ({"D": [1, 2, 3, 4, 5, 0, 0, 0], "distortion_model": "radtan"}, "plumb_bob", [1, 2, 3, 4, 5]),
        ({"D": [1, 2, 3, 4, 5, 0, 0, 8], "distortion_model": "radtan"}, "rational_polynomial", [1, 2, 3, 4, 5, 0, 0, 8]),
        ({"D": [1, 2, 3, 4, 5], "distortion_model": "Rational_Polynomial "}, "rational_polynomial", [1, 2, 3, 4, 5, 0, 0, 0]),
        ({"D": [1, 2, 3, 4], "fisheye_model": 1}, "kannala_brandt", [1, 2, 3, 4]),
        ({"D": [1, 2, 3, 4, 0], "fisheye_model": "true"}, "kannala_brandt", [1, 2, 3, 4]),
        ({"D": [1, 2, 3, 4], "fisheye_model": 0, "is_fisheye": "false"}, "plumb_bob", [1, 2, 3, 4, 0]),
        ({"D": [1, 2, 3, 4], "distortion_model": "none", "fisheye": 1}, "plumb_bob", [1, 2, 3, 4, 0]),
        ({"D": [0, 0, 0], "distortion_model": "thin_prism"}, "plumb_bob", []),
        ({"dist": [1, 2, 3, 4], "distortion_coefficients": [5, 6, 7, 8]}, "plumb_bob", [5, 6, 7, 8, 0]),
        ({"D": "1, 2 3\n4"}, "plumb_bob", [1, 2, 3, 4, 0]),
        ({"D": {"rows": 1, "cols": 4, "data": [1, 2, 3, 4]}}, "plumb_bob", [1, 2, 3, 4, 0]),
        ({"D": {"rows": "n", "cols": 4, "data": [[1, 2], [3, 4]]}}, "plumb_bob", [1, 2, 3, 4, 0]),
    ],
)  # fmt: skip
def test_coefficients_of_distortion(read, given, model, bent):
    # A model and a matrix called K are ROS's.
    one = read(given, intrinsics=K)
    assert (one.model, list(one.bent)) == (model, bent)
    if given.get("distortion_model", "") not in ("", "none"):
        one = read(given, K=K)
        assert (one.model, list(one.bent)) == (model, bent)


@pytest.mark.parametrize(
    ("given", "size"),
    [
        ({"image_width": 640, "image_height": 480}, (640, 480)),
        ({"image_Width": "640.0", "imageHeight": 480}, (640, 480)), ({"width": 99_999, "height": 1}, (99_999, 1)),
        ({"width": 9, "height": 9, "image_width": 640, "image_height": 480}, (640, 480)),
        ({"image_size": [640, 480]}, (640, 480)), ({"image_size": "640 480"}, (640, 480)),
        ({"image_size": [640, 480], "image_width": 1280, "height": 960}, (1280, 960)),
        ({"image_size": [640, 480, 3]}, None), ({"image_size": "640 480 3"}, None), ({"image_size": [640]}, None),
        ({"image_width": 640}, None), ({"image_height": 480}, None),
    ],
)  # fmt: skip
def test_sizes_of_pictures(read, given, size):
    assert read(given, M1=K).size == size


def test_files_of_ros(read):
    whole = {"camera_matrix": {"rows": 3, "cols": 3, "data": K}, "distortion_model": "plumb_bob", "D": [1, 2, 3, 4, 5]}
    flat = {"rows": 3, "cols": 4, "data": list(range(12))}
    turn = {"rectification_matrix": {"rows": 3, "cols": 3, "data": list(range(9))}, "projection_matrix": flat}
    one = read(whole, camera_name="left", image_width=640, image_height=480, **turn)
    assert (one.name, one.size, one.bent, one.relative, one.topic) == ("left", (640, 480), (1, 2, 3, 4, 5), "", "")
    assert one.matrix.tolist() == np.reshape(K, (3, 3)).tolist()
    assert one.rectified.tolist() == np.arange(9).reshape(3, 3).tolist()
    assert one.projection.tolist() == np.arange(12).reshape(3, 4).tolist()
    assert one.rotation is None
    echoed = {"k": K, "distortion_model": "", "header": {"frame_id": "eye"}, "width": 64, "height": 48}
    roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": "true"}
    one = read(echoed, binning_x=1, binning_y="1", roi=roi, r=list(range(9)), p=list(range(12)))
    assert (one.name, one.size, one.bent, one.rectified[1, 1], one.projection[1, 1]) == ("eye", (64, 48), (), 4, 5)
    one = read(camera_info=echoed | {"camera_name": ""})
    assert (one.name, one.rectified, one.projection) == ("eye", None, None)
    assert read(echoed | {"header": "eye"}).name == ""


def test_files_of_kalibr(read):
    one = {"camera_model": "pinhole", "intrinsics": [1, 2, 3, 4], "resolution": [640, 480], "rostopic": "/eye"}
    pose = [*np.eye(4).tolist()]
    bent = {"distortion_model": "equi", "distortion_coeffs": K[:4]}
    found = read(cam12=one | bent | {"T_cam_imu": pose, "T_cn_cnm1": pose})
    assert (found.name, found.size, found.topic, found.model) == ("cam12", (640, 480), "/eye", "kannala_brandt")
    assert found.matrix.tolist() == [[1, 0, 3], [0, 2, 4], [0, 0, 1]]
    assert found.relative == "the IMU (T_cam_imu) and the camera before it (T_cn_cnm1)"
    assert found.bent == tuple(K[:4])
    found = read(cam0=one | {"resolution": [640, 480, 3]})
    assert (found.size, found.relative, found.bent, found.model) == (None, "", (), "plumb_bob")
