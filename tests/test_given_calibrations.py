"""What a given calibration means for pictures of a log: sizes, centres, units of lengths, the ground; by hand."""

from __future__ import annotations

import json
from itertools import count

import numpy as np
import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.notices import collected
from mcaptrack.sources.ingest.calibration import GivenCalibration

DOWN = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]
SIZE = {"image_width": 1000, "image_height": 500}


def matrix(fx: float = 800, fy: float = 700, cx: float = 500, cy: float = 250) -> dict:
    return {"camera_matrix": [fx, 0, cx, 0, fy, cy, 0, 0, 1]}


def above(height: float) -> dict:
    """The pose of a camera above or below the origin, which looks straight at the plane z = 0."""
    turn = np.array(DOWN if height > 0 else np.eye(3))
    return {"R": turn.tolist(), "T": (-turn @ [0, 0, height]).tolist()}


@pytest.fixture
def given(tmp_path):
    """What a log gets of calibrations that are given as values, and the warnings."""
    numbers = count()

    def read(*values: dict, size=(1000, 500), is_stated=True, prefix="/c", pictures="", is_rectified=False, **options):
        paths = [tmp_path / f"{next(numbers)}.yaml" for _ in values]
        for path, one in zip(paths, values, strict=True):
            path.write_text(json.dumps(one))
        with collected() as warnings:
            made = GivenCalibration.read(paths, **options)
            found = made.calibrated(prefix, pictures, size, is_stated, "eye", "center", is_rectified)
        return found, [one.message for one in warnings]

    return read


@pytest.mark.parametrize(
    ("height", "unit", "metres"),
    [
        (30, "m", 30), (30.01, "cm", 0.3001), (1500, "cm", 15), (3000.5, "mm", 3.0005), (30_000, "mm", 30),
        (-29, "m", 29), (-1000, "cm", 10),
    ],
)  # fmt: skip
def test_the_unit_that_gives_a_usual_height_is_taken(given, height, unit, metres):
    found, warnings = given(matrix() | SIZE | above(height))
    assert f"; the camera is {metres:.2f} m from the ground (lengths in {unit})" in found.remarks[-1]
    assert found.parameters == {"files": ["0.yaml"], "unit": unit}
    assert sum("lengths of the pose are taken" in one for one in warnings) == (unit != "m")
    if unit != "m":
        words = f"taken to be in {unit}, so that the camera is {metres:.2f} m above the ground, and not {abs(height):,.0f} m"
        assert words in warnings[0]
    assert sum(f"the camera is at z = {-metres:.2f} m" in one for one in warnings) == (height < 0)
    # Its centre shows the origin; 80 px to the right are a tenth of the height.
    places = found.plane.pixels_to_metres(np.array([[500, 250], [580, 250.0]]))
    np.testing.assert_allclose(places, [[0, 0], [metres / 10, 0]], atol=1e-9)


@pytest.mark.parametrize("height", [1501, 3000, 30_001])
def test_heights_between_units_are_refused(given, height):
    words = (
        rf"would be {height:,} m above the ground, {height / 100:,.1f} m if lengths are in cm and {height / 1000:.2f} m"
    )
    with pytest.raises(McaptrackError, match=words):
        given(matrix() | SIZE | above(height))
    found, warnings = given(matrix() | SIZE | above(height), unit="cm")
    assert (found.parameters["unit"], warnings) == ("cm", [])
    assert f"{height / 100:.2f} m from the ground (lengths in cm)" in found.remarks[-1]


def test_a_calibration_is_scaled_to_pictures_of_the_same_shape(given):
    projection = {"projection_matrix": [400, 0, 240, -40, 0, 400, 120, 0, 0, 0, 1, 0], "distortion_model": "plumb_bob"}
    half = matrix() | SIZE | projection
    found, warnings = given(half, size=(2000, 1000))
    assert warnings[0].startswith("0.yaml: it has no pose of the camera, so that no ground plane follows")
    words = "is for pictures of 1000 x 500, and these are 2000 x 1000: its focal lengths and centre are scaled by 2"
    assert found.remarks[0].endswith(words)
    assert found.remarks[1] == "0.yaml: focal length 1600 px in pictures of 2000 x 1000, no distortion"
    assert list(found.message.K) == [1600, 0, 1000.5, 0, 1400, 500.5, 0, 0, 1]
    assert list(found.message.P) == [800, 0, 480.5, -80, 0, 800, 240.5, 0, 0, 0, 1, 0]
    assert list(found.message.R) == np.eye(3).ravel().tolist()
    assert (found.message.width, found.message.height, found.message.frame_id) == (2000, 1000, "eye")
    found, _ = given(matrix() | SIZE, size=(500, 254))
    assert list(found.message.K) == pytest.approx([400, 0, 249.75, 0, 355.6, 126.754, 0, 0, 1])
    assert list(found.message.P) == pytest.approx([400, 0, 249.75, 0, 0, 355.6, 126.754, 0, 0, 0, 1, 0])
    found, _ = given(matrix() | SIZE)
    assert len(found.remarks) == 1


@pytest.mark.parametrize(
    ("size", "is_taken"), [((1019, 500), True), ((1021, 500), False), ((981, 500), True), ((979, 500), False)]
)
def test_another_shape_is_refused(given, size, is_taken):
    if is_taken:
        given(matrix() | SIZE, size=size)
    else:
        with pytest.raises(McaptrackError, match="they are of another shape"):
            given(matrix() | SIZE, size=size)


@pytest.mark.parametrize(
    ("stated", "size", "is_stated", "wanted", "warns"),
    [
        ({}, (900, 500), True, (900, 500), False),
        ({}, (900, 500), False, (900, 500), True),
        (SIZE, (900, 480), False, (1000, 500), False),
        (SIZE, (0, 0), False, (1000, 500), False),
        (SIZE, (2000, 1000), True, (2000, 1000), False),
    ],
)
def test_the_size_of_pictures(given, stated, size, is_stated, wanted, warns):
    found, warnings = given(matrix() | stated | above(3), size=size, is_stated=is_stated)
    assert (found.message.width, found.message.height) == (found.plane.width_px, found.plane.height_px) == wanted
    assert any("900 x 500 is taken, the extent of boxes" in one for one in warnings) == warns


@pytest.mark.parametrize("size", [(0, 0), (640, 0), (0, 480)])
def test_pictures_without_a_size_are_refused(given, size):
    for is_stated in (True, False):
        with pytest.raises(
            McaptrackError, match="doesn't say the size of its pictures, and there are none; give it with"
        ):
            given(matrix(), size=size, is_stated=is_stated)


@pytest.mark.parametrize(
    ("cx", "cy", "stated", "said"),
    [
        (690, 250, {}, ""), (310, 250, {}, ""), (500, 345, {}, ""), (500, 155, {}, ""),
        (710, 250, {}, "(710, 250) of pictures of 1000 x 500, far from their middle; it may be for pictures of another size"),
        (290, 250, SIZE, "(290, 250) of pictures of 1000 x 500, far from their middle"),
        (500, 355, SIZE, "(500, 355) of pictures of 1000 x 500, far from their middle"),
        (999, 250, {}, "(999, 250) of pictures of 1000 x 500, far from their middle; it may be"),
        (1001, 250, SIZE, "(1001, 250) of pictures of 1000 x 500, far from their middle"),
        (1001, 250, {}, None), (500, -1, {}, None),
    ],
)  # fmt: skip
def test_a_centre_far_from_the_middle(given, cx, cy, stated, said):
    values = matrix(cx=cx, cy=cy) | stated | above(3)
    if said is None:
        with pytest.raises(
            McaptrackError, match="the calibration, which states no size, is for pictures of another one"
        ):
            given(values)
        return
    _, warnings = given(values)
    assert len(warnings) == bool(said)
    assert not warnings or said in warnings[0]
    assert not stated or not warnings or "it may be" not in warnings[0]


def test_matrices_of_rectified_pictures(given):
    turn = [0.0, -1, 0, 1, 0, 0, 0, 0, 1]
    new = [900.0, 0, 480, -30, 0, 910, 260, 0, 0, 0, 1, 0]
    ros = matrix() | SIZE | {"distortion_model": "plumb_bob", "D": [0.1, 0, 0, 0, 0]}
    eye, plain = np.eye(3).ravel().tolist(), [800, 0, 500, 0, 0, 700, 250, 0, 0, 0, 1, 0]
    for values, rectified, projection in (
        ({"rectification_matrix": turn, "projection_matrix": new}, turn, new),
        ({"projection_matrix": new}, eye, new),
        ({"rectification_matrix": turn}, eye, plain),
        ({"rectification_matrix": turn, "projection_matrix": [0] * 12}, eye, plain),
    ):
        found, _ = given(ros | values)
        assert (list(found.message.R), list(found.message.P)) == (rectified, projection)
    assert found.remarks == (
        f"{found.parameters['files'][0]}: focal length 800 px in pictures of 1000 x 500, "
        "5 coefficients of distortion (plumb_bob)",
    )
    # Rectified pictures have the projection's focal length, and no distortion.
    found, _ = given(ros | {"projection_matrix": new}, above(2), is_rectified=True)
    near = found.plane.pixels_to_metres(np.array([[480.0, 260], [570, 260], [480, 260 + 91]]))
    np.testing.assert_allclose(near, [[0, 0], [0.2, 0], [0, -0.2]], atol=1e-9)


def level(height: float, down_rad: float) -> dict:
    """The pose of a camera that looks along y, so far down."""
    sin, cos = np.sin(down_rad), np.cos(down_rad)
    turn = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]]) @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    return {"R": turn.tolist(), "T": (-turn @ [0, 0, height]).tolist()}


@pytest.mark.parametrize("height", [0.5, 2.0])
def test_the_last_row_of_pictures_has_to_show_the_ground_within_a_thousand_heights(given, height):
    lens = matrix(1000, 1000, 20, 1) | {"image_width": 40, "image_height": 3}
    found, _ = given(lens | level(height, 0.0003), size=(40, 3))  # the last row is 1.3 thousandths down
    place = found.plane.pixels_to_metres(np.array([[20.0, 2]]))
    np.testing.assert_allclose(place, [[0, height / 0.0013]], rtol=1e-3, atol=1e-9)
    with pytest.raises(McaptrackError, match=f"sees no ground: it is {height:.2f} m from z = 0 and looks away"):
        given(lens | level(height, -0.0003), size=(40, 3))
    with pytest.raises(McaptrackError, match="the camera is in the plane z = 0, which is to be the ground"):
        given(lens | level(0, 0.5), size=(40, 3))


def test_the_camera_of_a_chain(given):
    def one(focal: float, topic: str) -> dict:
        return {"camera_model": "pinhole", "intrinsics": [focal, 700, 500, 250], "rostopic": topic}

    chain = {"cam0": one(100, "/left/image"), "cam1": one(200, "/right/image"), "cam2": one(300, "/cam0/image")}
    for options, focal in (
        ({"prefix": "/left"}, 100),
        ({"prefix": "/right"}, 200),
        ({"prefix": "/cam0"}, 100),  # its name comes before the name in a topic
        ({"prefix": "/cam0", "pictures": "/right/image"}, 200),  # and the topic before its name
        ({"prefix": "/left", "name": "cam2"}, 300),
        ({"prefix": "/left", "name": "/right/image"}, 200),
        ({"prefix": "/left", "pictures": "/cam0/image", "name": "cam1"}, 200),
    ):
        found, _ = given(chain, **options)
        assert found.message.K[0] == focal
    assert found.parameters["name"] == "cam1"
    with pytest.raises(McaptrackError, match=r"has cam0 \(/left/image\), cam1 \(/right/image\), cam2 .*none is of up;"):
        given(chain, prefix="/up", pictures="/up/image")
    _, warnings = given(matrix(), name="cam0", unit="mm")
    assert [one.partition(": ")[0] for one in warnings if "changes nothing" in one] == [
        "`calibration_name='cam0'` changes nothing here", "`calibration_unit='mm'` changes nothing here",
    ]  # fmt: skip
    with pytest.raises(McaptrackError, match=r"9.yaml and .*10.yaml both hold poses; give the files of one camera"):
        given(above(3), above(3))
    with pytest.raises(McaptrackError, match="has no camera 'cam7'; it has cam0"):
        given(chain, prefix="/left", name="cam7")
