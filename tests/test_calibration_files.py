"""Calibrations of OpenCV, ROS and Kalibr: read as OpenCV writes and projects them, and refused in one line."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import collected
from mcaptrack.pipeline.staleness import read_planes
from mcaptrack.schema import TRACKS
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.ingest.calibration import GivenCalibration, is_calibration
from tests.commands import call, done
from tests.robots import robot_log

SIZE = (1920, 1080)
K = np.array([[1743.4, 0, 934.5], [0, 1735.2, 520.4], [0, 0, 1]])
BENT = np.array([-0.25, 0.09, 0.004, -0.002, -0.01])
#: The camera stands at (9.1, -5.8) m, 2.9 m above the ground, and looks along y, 14 degrees down.
PLACE = np.array([9.1, -5.8, 2.9])
TURN = (Rotation.from_matrix([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) * Rotation.from_euler("x", -14, degrees=True)).inv()
RVEC, TVEC = TURN.as_rotvec(), -TURN.apply(PLACE)
GROUND = np.array([[9.0, 2.0, 0], [7.5, 6.0, 0], [12.0, 9.0, 0], [9.2, 25.0, 0]])


def stored(path: Path, **values) -> Path:
    """A file as OpenCV writes it: XML, YAML or JSON, by its ending."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        storage.write(name, value)
    storage.release()
    return path


def calibrated(*paths: Path, size=SIZE, camera="camera", pictures="", is_rectified=False, **options):
    """What files say of a camera."""
    given = GivenCalibration.read(paths, **options)
    return given.calibrated(f"/{camera}", pictures, size, True, camera, "foot", is_rectified)


def untyped(folder: Path, **values) -> Path:
    """A file of WILDTRACK: XML with numbers and no types."""
    path = folder / "extr.xml"
    inner = "".join(f"<{name}>\n {' '.join(map(repr, one.tolist()))}\n</{name}>" for name, one in values.items())
    path.write_text(f'<?xml version="1.0"?>\n<opencv_storage>{inner}</opencv_storage>\n')
    return path


@pytest.mark.parametrize(("ending", "is_vector"), [("xml", True), ("yml", False), ("json", True), ("json", False)])
def test_feet_stand_where_opencv_projects_them_from(tmp_path, ending, is_vector):
    pose = {"rvec": RVEC, "tvec": TVEC} if is_vector else {"R": TURN.as_matrix(), "T": TVEC.reshape(3, 1)}
    path = stored(tmp_path / f"a.{ending}", camera_matrix=K, distortion_coefficients=BENT, **pose)
    assert is_calibration(path)
    found = calibrated(path)
    pixels = cv2.projectPoints(GROUND, RVEC, TVEC, K, BENT)[0][:, 0]
    assert np.abs(found.plane.pixels_to_metres(pixels) - GROUND[:, :2]).max() < 1e-6
    assert np.abs(found.plane.metres_to_pixels(GROUND[:, :2]) - pixels).max() < 1e-6
    message = CameraCalibration.FromString(found.at(7))
    assert (message.width, message.height, message.distortion_model) == (*SIZE, "plumb_bob")
    assert (message.K, message.D, message.timestamp.nanos) == (K.ravel().tolist(), BENT.tolist(), 7)
    assert message.P[:3] == K[0].tolist()


@given(
    st.floats(300, 4000), st.floats(-0.3, 0.3), st.floats(-0.1, 0.1), st.floats(2, 30),
    st.floats(8, 60), st.floats(-180, 180), st.sampled_from(["m", "cm", "mm"]),
)  # fmt: skip
@settings(max_examples=25)
def test_any_pose_that_is_written_by_opencv_gives_its_ground(focal, k1, k2, height, pitch, yaw, unit):
    axes = Rotation.from_matrix([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    turn = (Rotation.from_euler("z", yaw, degrees=True) * axes * Rotation.from_euler("x", -pitch, degrees=True)).inv()
    shift = -turn.apply([5.0, -3.0, height])
    k, scale = np.array([[focal, 0, 960], [0, focal, 540], [0, 0, 1.0]]), {"m": 1, "cm": 100, "mm": 1000}[unit]
    path = Path("/dev/shm" if Path("/dev/shm").is_dir() else ".") / "mcaptrack-test.yml"
    stored(path, K=k, D=np.array([k1, k2, 0, 0]), rvec=turn.as_rotvec(), tvec=shift * scale)
    found = calibrated(path, unit=unit)
    path.unlink()
    ahead = turn.inv().apply([0, np.tan(0.05), 1.0])
    points = np.array([[5.0, -3.0, height] + ahead * height / -ahead[2]]) if ahead[2] < 0 else np.empty((0, 3))
    pixels = cv2.projectPoints(points, turn.as_rotvec(), shift, k, np.array([k1, k2, 0, 0]))[0][:, 0]
    metres = found.plane.pixels_to_metres(pixels)
    assert len(metres) == 1
    assert np.abs(metres - points[:, :2]).max() < 1e-4


def test_a_fisheye_and_a_rational_lens_are_those_of_opencv(tmp_path):
    few = np.array([-0.02, 0.006, -0.001, 0.0005])
    path = stored(tmp_path / "f.yml", camera_matrix=K, dist_coeffs=few, fisheye_model=1, rvec=RVEC, tvec=TVEC)
    pixels = cv2.fisheye.projectPoints(GROUND[:, None], RVEC, TVEC, K, few)[0][:, 0]
    found = calibrated(path)
    assert np.abs(found.plane.pixels_to_metres(pixels) - GROUND[:, :2]).max() < 1e-6
    assert found.message.distortion_model == "kannala_brandt"
    many = np.array([0.1, -0.02, 0.001, 0.002, 0.003, 0.12, -0.01, 0.001, 0, 0, 0, 0])
    path = stored(tmp_path / "r.yml", camera_matrix=K, dist_coeffs=many, rvec=RVEC, tvec=TVEC)
    pixels = cv2.projectPoints(GROUND, RVEC, TVEC, K, many)[0][:, 0]
    found = calibrated(path)
    assert np.abs(found.plane.pixels_to_metres(pixels) - GROUND[:, :2]).max() < 1e-6
    assert (found.message.distortion_model, len(found.message.D)) == ("rational_polynomial", 8)


def test_intrinsics_and_pose_are_two_files_without_a_unit(tmp_path):
    inner, outer = stored(tmp_path / "intr.xml", camera_matrix=K), untyped(tmp_path, rvec=RVEC, tvec=TVEC * 100)
    with collected() as warnings:
        found = calibrated(inner, outer)
    assert "taken to be in cm, so that the camera is 2.90 m above the ground" in warnings[0].message
    same = calibrated(outer, inner, unit="cm")
    assert same.plane == found.plane
    pixels = cv2.projectPoints(GROUND, RVEC, TVEC, K, None)[0][:, 0]
    assert np.abs(found.plane.pixels_to_metres(pixels) - GROUND[:, :2]).max() < 1e-6
    with collected() as warnings:
        assert calibrated(inner, untyped(tmp_path, rvec=RVEC, tvec=TVEC)).plane is not None
    assert not warnings
    with pytest.raises(McaptrackError, match=r"29.0 m if lengths are in cm and 2.90 m if they are in mm"):
        calibrated(inner, untyped(tmp_path, rvec=RVEC, tvec=TVEC * 1000))
    with pytest.raises(McaptrackError, match="holds a pose and no camera matrix"):
        calibrated(outer)
    with pytest.raises(McaptrackError, match="both hold camera matrices"):
        calibrated(inner, inner)


BILLION = '<!DOCTYPE a [<!ENTITY b "c"><!ENTITY d "&b;&b;">]><opencv_storage><k>&d;</k></opencv_storage>'
HEAD = "%YAML:1.0\n---\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ("1 0 0\n0 1 0\n0 0 1\n", "a homography of 3 x 3 numbers is given with `ground_plane=`"),
        (BILLION, "a document type"),
        ("<opencv_storage><k>1</k>", "not valid XML"),
        ('<?xml version="1.0" encoding="utf-99"?><opencv_storage/>', "1: not read: unknown encoding: utf-99"),
        ('<?xml version="1.0" encoding="shift_jis"?><opencv_storage/>', "1: not read: multi-byte encodings"),
        ("<opencv_storage><k>1</k><k>2</k></opencv_storage>", "<k> is there twice"),
        ("<annotations><k>1</k></annotations>", "is XML of <annotations>"),
        ("<opencv_storage>" + "<a>" * 40 + "</a>" * 40 + "</opencv_storage>", "nested more than 16 deep"),
        (HEAD + "camera_matrix: !!python/object/apply:os.system [ls]\n", "tags are not read"),
        (HEAD + "a: &b [1, 2]\nc: *b\n", "anchors and aliases are not read"),
        (HEAD + "square_size: 0.1\nboard: 7\n", "holds square_size, board; a calibration has a camera matrix"),
        (HEAD + f"K: [900, 0, 960, 0, 900, 540, 0, 0, 1]\nrvecs: {[0] * 6}\ntvecs: {[0] * 6}\n", "Poses of pictures of a board"),
        (HEAD + "K: [900, 0, 96000, 0, 900, 540, 0, 0, 1]\n", "is for pictures of another one"),
    ],
)  # fmt: skip
def test_what_is_no_calibration_is_refused_in_a_line(tmp_path, text, said):
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(McaptrackError) as refused:
        calibrated(path)
    assert said in str(refused.value)
    assert str(path) in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


def test_a_calibration_goes_into_a_log_and_boxes_get_metres(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pixels = cv2.projectPoints(GROUND, RVEC, TVEC, K, BENT)[0][:, 0]
    rows = [f"1,{n + 1},{x - 10},{y - 50},20,50,1,-1,-1,-1" for n, (x, y) in enumerate(pixels)]
    Path("gt.txt").write_text("\n".join(rows) + "\n")
    intr, extr = stored(Path("intr.yml"), K=K, D=BENT), untyped(tmp_path, rvec=RVEC, tvec=TVEC)
    out = done("ingest", "gt.txt", "--as", "truth", "--fps", 1, "--size", "1920x1080", "--camera", "c", "--calibration",
               intr, "--calibration", extr, "-o", "a.mcap", "--json")  # fmt: skip
    (result,) = json.loads(out.out)["results"]
    assert result["messages"] == {"/c/ground_plane": 1, "/c/calibration": 1, "/c/truth": 1}
    assert "the camera is 2.90 m from the ground (lengths in m)" in result["notes"][0]
    with log.read(Path("a.mcap")) as opened:
        truth = opened.rows("/c/truth", TRACKS).rows
    assert np.abs(np.stack([truth["x_m"], truth["y_m"]], axis=-1) - GROUND[:, :2]).max() < 1e-2
    with log.read(Path("a.mcap")) as opened:
        ((_, plane),) = read_planes(opened, "/c")
        made = Provenance.from_metadata(opened.channel("/c/calibration").metadata)
    assert plane == calibrated(intr, extr, camera="c").plane
    assert made.parameters == {"files": ["intr.yml", "extr.xml"], "unit": "m"}
    # The same, added to a log that has the boxes: first the lens alone, then with the pose.
    done("ingest", "gt.txt", "--as", "truth", "--fps", 1, "--camera", "c", "-o", "b.mcap", "-q")
    code, _, err = call("ingest", intr, "--into", "b.mcap", "--camera", "c", "--size", "1920x1080")
    assert code == 0
    assert "it has no pose of the camera, so that no ground plane follows" in err
    words = ("--calibration", intr, "--into", "b.mcap", "--camera", "c", "--size", "1920x1080")
    code, _, err = call("ingest", extr, *words)
    assert (code, "b.mcap has /c/calibration already; --force replaces them" in err) == (1, True)
    done("ingest", extr, "--as", "calibration", *words, "--force", "-q")
    with log.read(Path("b.mcap")) as opened:
        assert read_planes(opened, "/c")[0][1] == plane


def test_mistakes_with_calibrations_are_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("gt.txt").write_text("1,1,500,500,20,50,1,-1,-1,-1\n")
    Path("h.txt").write_text("1 0 0\n0 1 0\n0 0 1\n")
    Path("m.txt").write_text("0,1,0,0,0,1,0\n")
    stored(Path("cam.yml"), K=K, rvec=RVEC, tvec=TVEC)
    done("ingest", "gt.txt", "--fps", 1, "-o", "log.mcap", "-q")
    for words, said in {
        "cam.yml": "a calibration belongs to a log with pictures or boxes of the camera; name it with --into",
        "cam.yml --into log.mcap --camera left": "log.mcap has no camera left that cam.yml could be of",
        "gt.txt --fps 1 --calibration cam.yml --ground-plane h.txt": "are both a ground plane",
        "gt.txt --fps 1 --calibration none.yml": "none.yml does not exist",
        "m.txt --as motion --into log.mcap --calibration cam.yml": "in a call of its own",
    }.items():
        code, _, err = call("ingest", *words.split())
        assert (code, err.count("\n"), said in err) == (1, 1, True), err


def test_a_recording_gets_a_calibration_in_the_frame_of_its_pictures(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robot_log(Path("robot.mcap"), "/front/image")
    stored(Path("cam.yml"), K=np.array([[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1.0]]), rvec=RVEC, tvec=TVEC)
    result = mcaptrack.ingest("robot.mcap", "out.mcap", calibration="cam.yml")
    assert {"/front/calibration", "/front/ground_plane"} <= result.messages.keys()
    with log.read(Path("out.mcap")) as opened:
        ((_, plane),) = read_planes(opened, "/front")
    assert (plane.width_px, plane.height_px) == (64, 48)
