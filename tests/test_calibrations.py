"""The ground as calibrated cameras on robots see it: drawn people at known places, projected by OpenCV."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from scipy.spatial.transform import Rotation

import mcaptrack
from mcaptrack import foxglove, log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.camera_path import CameraPath, poses_of
from mcaptrack.geometry.pinhole import Lens, ground_homography
from mcaptrack.geometry.plane import GroundPlane, moved_planes, plane_at, scene_planes
from mcaptrack.notices import collected
from mcaptrack.pipeline.staleness import read_planes
from mcaptrack.schema import TRACKS
from mcaptrack.sources.calibrations import find_calibration, is_rectified_topic, read_calibrations, see_ground
from mcaptrack.sources.cameras import camera_at
from mcaptrack.sources.foreign import MessageType
from tests.commands import call, done
from tests.ros_messages import Ros, pixels, vision
from tests.test_frames import packed, write

START_NS = 1_700_000_000_000_000_000
S = 10**9
LATE_NS = 60_000_000
SIZE, K = (1280, 720), np.array([[700.0, 0, 640], [0, 700, 360], [0, 0, 1]])
BENT = {"plumb_bob": [-0.25, 0.08, 0.001, -0.001, 0.0], "equidistant": [-0.01, 0.005, 0.0, 0.0], "": []}
#: The camera on the robot: 0.5 m ahead of its centre and 1.4 m up, 8 degrees down, in ROS's axes of cameras.
AHEAD = np.array([0.5, 0.1, 1.4])
EYE = Rotation.from_euler("y", 8, degrees=True) * Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def robot_at(s: float) -> tuple[Rotation, np.ndarray]:
    """The robot drives a curve at 1.5 m/s and pitches a little."""
    turn = Rotation.from_euler("zy", [20 * s, 2 * np.sin(3 * s)], degrees=True)
    return turn, np.array([100 + 1.5 * s, 50 + 0.3 * s * s, 0.0])


def people_at(s: float) -> np.ndarray:
    """Two people on the ground of the map, (2, 3)."""
    return np.array([[107 + 0.8 * s, 51.5 + 0.9 * s, 0], [108.5 + 1.2 * s, 49.0 + 1.5 * s, 0]])


def seen(points: np.ndarray, s: float, model: str) -> np.ndarray:
    """Where OpenCV sees points of the map."""
    turn, place = robot_at(s)
    back = (turn * EYE).inv()
    shift = -back.apply(place + turn.apply(AHEAD))
    given = np.array(BENT[model])
    if model == "equidistant":
        return cv2.fisheye.projectPoints(points[:, None], back.as_rotvec(), shift, K, given)[0][:, 0]
    return cv2.projectPoints(points[:, None], back.as_rotvec(), shift, K, given)[0][:, 0]


def transform(parent: str, child: str, t_ns: int, turn: Rotation, place: np.ndarray) -> bytes:
    message = foxglove.unpack(foxglove.TRANSFORM, packed(parent, child, t_ns))
    for axis, value in zip("xyz", place.tolist(), strict=True):
        setattr(message.translation, axis, value)
    for axis, value in zip("xyzw", turn.as_quat().tolist(), strict=True):
        setattr(message.rotation, axis, value)
    return message.SerializeToString()


def camera_info(model: str, frame_id: str = "eye", **changes) -> tuple[MessageType, bytes]:
    ros = Ros("sensor_msgs/CameraInfo")
    roi = ros.new("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
    header = ros.new("std_msgs/Header", ros.header().stamp, frame_id)
    p = np.column_stack([K, np.zeros(3)]).ravel()
    values = {"height": SIZE[1], "width": SIZE[0], "distortion_model": model, "d": np.array(BENT.get(model, [0.1]))}
    values |= {"k": K.ravel(), "r": np.eye(3).ravel(), "p": p, "binning_x": 0, "binning_y": 0, "roi": roi} | changes
    return ros.kind, ros.pack(ros.new("sensor_msgs/CameraInfo", header, **values))


def in_protobuf(model: str) -> tuple[MessageType, bytes]:
    one = CameraCalibration(frame_id="eye", width=SIZE[0], height=SIZE[1], distortion_model=model, D=BENT[model])
    one.K.extend(K.ravel())
    name = "foxglove.CameraCalibration"
    return MessageType(*foxglove.schema_record(name), "protobuf"), one.SerializeToString()


def in_json(model: str) -> tuple[MessageType, bytes]:
    stamp = {"sec": START_NS // S, "nsec": 0}
    fields = {"timestamp": stamp, "frame_id": "eye", "width": SIZE[0], "height": SIZE[1]}
    fields |= {"distortion_model": model, "D": BENT[model], "K": K.ravel().tolist(), "R": [], "P": []}
    return MessageType("foxglove.CameraCalibration", "jsonschema", b"{}", "json"), json.dumps(fields).encode()


def boxes(s: float, model: str) -> bytes:
    """Boxes of people whose feet are where OpenCV sees them, 40 x 100 pixels."""
    feet = seen(people_at(s), s, model)
    found = [(x, y - 50, 40.0, 100.0, 0.0, [("person", 0.9)]) for x, y in feet.tolist()]
    return vision("v4", found)[1]


def stamped(payload: bytes, s: float) -> bytes:
    """The same message with another stamp: that of tests.ros_messages is at the begin of CDR's header."""
    sec, nsec = divmod(START_NS + round(s * S), S)
    return payload[:4] + int(sec).to_bytes(4, "little") + int(nsec).to_bytes(4, "little") + payload[12:]


TF = MessageType(*foxglove.schema_record(foxglove.TRANSFORM), "protobuf")


def robot(
    path: Path, model: str, info=camera_info, tree: bool = True, until_s: float = 2.0, last_s: float = 2.0, **changes
) -> Path:
    """A log of a robot: boxes at 10 Hz with stamps 60 ms before their log time, transforms at 20 Hz."""
    times = np.arange(0, last_s, 0.1)
    found = [(START_NS + round(s * S) + LATE_NS, stamped(boxes(s, model), s)) for s in times]
    kind, calibration = info(model, **changes)
    info_at = [(START_NS + LATE_NS, calibration)]
    channels = [("/front/boxes", vision("v4", [])[0], found), ("/front/camera_info", kind, info_at)]
    if tree:
        times = [(s, START_NS + round(s * S)) for s in np.arange(-0.1, until_s + 0.05, 0.05)]
        poses = [(t_ns, transform("map", "base_link", t_ns, *robot_at(s))) for s, t_ns in times]
        channels.append(("/tf", TF, poses))
        channels.append(("/tf_static", TF, [(START_NS, transform("base_link", "eye", START_NS, EYE, AHEAD))]))
    return write(path, *channels)


def errors_m(path: Path, topic: str) -> np.ndarray:
    """How far tracks are from the people that they are of, in metres."""
    with log.read(path) as opened:
        frames = opened.frames(topic, TRACKS)
    out = []
    for frame in frames:
        people = people_at((frame.t_ns - LATE_NS - START_NS) / S)[:, :2]
        at = np.stack([frame.rows["x_m"], frame.rows["y_m"]], axis=1)
        out.append(np.linalg.norm(at[:, None] - people, axis=2).min(axis=1))
    return np.concatenate(out)


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_boxes_become_positions_in_the_map(model, tmp_path):
    path = robot(tmp_path / "robot.mcap", model)
    result = mcaptrack.track(path, topic="/front/boxes", to="/front/tracks")
    assert not [one for one in result.warnings if one.code in ("transforms", "assumed-ground-plane")]
    # SORT smooths boxes, by some pixels.
    assert np.nanmedian(errors_m(path, "/front/tracks")) < 0.35
    with log.read(path) as opened:
        planes = read_planes(opened, "/front")
        how = opened.channels["/front/ground_plane"].metadata
    assert how["mcaptrack.frame_id"] == "map"
    assert len(planes) == 20
    for number, (t_ns, plane) in enumerate(planes):
        s = number / 10
        assert t_ns == START_NS + round(s * S) + LATE_NS
        feet = seen(people_at(s), s, model)
        assert np.abs(plane.pixels_to_metres(feet) - people_at(s)[:, :2]).max() < 0.01
        assert np.abs(plane.metres_to_pixels(people_at(s)[:, :2]) - feet).max() < 0.5


def test_a_calibration_that_a_user_gives_replaces_the_recorded_one(tmp_path):
    """Recorded is a focal length that is off; planes follow from it until a better one is given, and from that then."""
    wrong = np.array([[400.0, 0, 640], [0, 400, 360], [0, 0, 1]])
    path = robot(tmp_path / "robot.mcap", "", k=wrong.ravel(), p=np.column_stack([wrong, np.zeros(3)]).ravel())
    where = {"topic": "/front/boxes", "to": "/front/tracks", "sidecar": False}
    mcaptrack.track(path, **where)
    assert np.nanmedian(errors_m(path, "/front/tracks")) > 0.8
    recorded = messages(path, "/front/camera_info")
    for number, (focal, least, most) in enumerate([(700.0, 0.0, 0.35), (500.0, 0.5, 50.0)]):
        given = tmp_path / f"given{number}.yml"
        lens = [focal, 0, 640, 0, focal, 360, 0, 0, 1]
        given.write_text(f"%YAML:1.0\n---\nimage_width: {SIZE[0]}\nimage_height: {SIZE[1]}\nK: {lens}\n")
        with collected():
            mcaptrack.ingest(given, into=path, camera="front", force=True)
            mcaptrack.track(path, **where)
        assert least < np.nanmedian(errors_m(path, "/front/tracks")) < most
        with log.read(path) as opened:
            assert read_planes(opened, "/front")[0][1].lens.focal_px == (focal, focal)
            assert opened.channels["/front/ground_plane"].metadata["mcaptrack.input"] == "/front/calibration"
    assert messages(path, "/front/camera_info") == recorded


def messages(path: Path, topic: str) -> list[bytes]:
    with log.read(path) as opened:
        return [one.payload for one in opened.messages(topic)]


@pytest.fixture(scope="module")
def straight(tmp_path_factory) -> Path:
    """The log of a robot with a lens without distortion. Tests must not change it."""
    return robot(tmp_path_factory.mktemp("straight") / "robot.mcap", "")


def ground(path: Path, **more):
    with log.read(path) as opened, collected() as warnings:
        return see_ground(opened, camera_at(opened, "/front"), **more), [one.message for one in warnings]


class TestGround:
    @pytest.mark.parametrize("info", [in_protobuf, in_json])
    def test_of_foxglove(self, info, straight, tmp_path):
        found, _ = ground(robot(tmp_path / "a.mcap", "plumb_bob", info))
        assert found.planes[7][1].lens.distortion == tuple(BENT["plumb_bob"])
        expected, _ = ground(straight)
        assert found.planes[7][1].homography == pytest.approx(expected.planes[7][1].homography)

    def test_in_the_frame_of_the_robot(self, straight):
        """With z = 0 of the robot as ground, points are in the plane that pitches with it."""
        found, _ = ground(straight, ground_frame="base_link")
        assert (found.frame, found.ground_frame) == ("map", "base_link")
        turn, place = robot_at(1.2)
        points = np.array([[5.0, 1, 0], [9, -2, 0]])
        there = turn.apply(points) + place
        plane = found.planes[12][1]
        assert np.abs(plane.pixels_to_metres(seen(there, 1.2, "")) - there[:, :2]).max() < 0.01
        found, _ = ground(straight, frame="base_link")
        assert found.frame == "base_link"
        assert np.abs(found.planes[0][1].pixels_to_metres(seen(there, 1.2, "")) - points[:, :2]).max() < 0.01
        assert len(found.planes) == 1  # the camera stands still on the robot

    def test_a_map_that_is_somewhere_else(self, tmp_path, monkeypatch):
        """The origin of a map may be far below the road: then the robot's own frame is on the ground."""
        robot_there, people_there, up = robot_at, people_at, [0, 0, 67.0]
        monkeypatch.setattr("tests.test_calibrations.robot_at", lambda s: (robot_there(s)[0], robot_there(s)[1] + up))
        monkeypatch.setattr("tests.test_calibrations.people_at", lambda s: people_there(s) + up)
        seen_there, said = ground(robot(tmp_path / "a.mcap", "", last_s=0.1))
        assert seen_there.ground_frame == "base_link"
        where = (
            "eye is 68.4 m above z = 0 of map: the ground is taken to be z = 0 of base_link. `ground_frame=` chooses"
        )
        assert said == [where]
        feet = seen(people_at(0), 0, "")
        assert np.abs(seen_there.planes[0][1].pixels_to_metres(feet) - people_at(0)[:, :2]).max() < 0.01

    def test_pictures_without_a_pose_have_no_ground(self, tmp_path):
        path = robot(tmp_path / "a.mcap", "", until_s=1.0)
        found, said = ground(path)
        late = found.planes[-1][1]
        assert found.planes[-1][0] == START_NS + round(1.1 * S) + LATE_NS
        assert np.isnan(late.pixels_to_metres(np.array([[640.0, 700], [3, 3]]))).all()
        assert np.isnan(late.metres_to_pixels(np.array([[107.0, 51]]))).all()
        assert "9 of 20 messages are left out" in said[-1]
        done("track", path, "--topic", "/front/boxes", "--to", "/front/tracks", "--in-place")
        with log.read(path) as opened:
            frames = opened.frames("/front/tracks", TRACKS)
        rows = np.concatenate([frame.rows for frame in frames if frame.t_ns >= found.planes[-1][0]])
        assert len(rows) > 5
        assert np.isnan(rows["x_m"]).all()

    def test_pictures_that_were_resized(self, straight, tmp_path):
        ros = Ros("sensor_msgs/CompressedImage")
        half = cv2.imencode(".jpg", np.zeros((SIZE[1] // 2, SIZE[0] // 2), np.uint8))[1].tobytes()
        payload = ros.pack(ros.new("sensor_msgs/CompressedImage", ros.header(START_NS), "jpeg", pixels(half)))
        kind, calibration = camera_info("")
        fixed = [(START_NS, transform("map", "eye", START_NS, EYE, AHEAD))]
        channels = [("/front/image", ros.kind, [(START_NS, payload)]), ("/tf_static", TF, fixed)]
        path = write(tmp_path / "a.mcap", *channels, ("/front/camera_info", kind, [(START_NS, calibration)]))
        ((_, plane),) = ground(path)[0].planes
        assert (plane.width_px, plane.height_px) == (640, 360)
        # The middle of a pixel of the small picture is between two of the large one.
        there = EYE.inv().as_matrix(), -EYE.inv().apply(AHEAD)
        whole = GroundPlane(ground_homography(Lens((700, 700), (640, 360)), *there, np.eye(3)), *SIZE)
        wanted = whole.pixels_to_metres(np.array([[600.5, 600.5]]))
        assert plane.pixels_to_metres(np.array([[300.0, 300]])) == pytest.approx(wanted)

    def test_what_is_missing_is_said(self, tmp_path):
        path = robot(tmp_path / "a.mcap", "", tree=False)
        ended = done("run", path, "--topic", "/front/boxes", "--no-tables", "--in-place")
        assert f"warning: {path}: no ground plane follows from the calibration of /front: there are no tr" in ended.err
        assert mcaptrack.run(path, topic="/front/boxes", tables=False).stages == ()
        code, _, err = call("run", path, "--ground-frame", "base_link", "--no-tables")
        assert code == 1
        assert "there are no transforms, which say where the camera of /front/camera_info is" in err.splitlines()[-1]

    def test_a_camera_without_a_transform(self, tmp_path):
        path = robot(tmp_path / "a.mcap", "", frame_id="other")
        words = r"no transform has the frame 'other' of /front/camera_info; .* eye, map"
        with pytest.raises(McaptrackError, match=words):
            ground(path)

    def test_a_frame_with_x_ahead_is_not_that_of_a_camera(self, tmp_path, straight, monkeypatch):
        monkeypatch.setattr("tests.test_calibrations.EYE", Rotation.identity())
        _, said = ground(robot(tmp_path / "a.mcap", ""))
        assert [words for words in said if words.startswith("eye looks up: z of a camera's frame points ahead")]
        assert not any("looks up" in words for words in ground(straight)[1])

    def test_rectified_pictures_by_their_topic(self):
        for topic in ("/front/image_rect", "/front/image_rect_color/compressed", "/front/rectified/image"):
            assert is_rectified_topic(topic)
        for topic in ("/front/image_raw/compressed", "/direct/image", "/rect/front/image"):
            assert not is_rectified_topic(topic)

    def test_a_given_plane_wins(self, straight, tmp_path):
        path = tmp_path / "robot.mcap"
        path.write_bytes(straight.read_bytes())
        (tmp_path / "plane.txt").write_text("0.01 0 0\n0 0.01 0\n0 0 1\n")
        (tmp_path / "truth.csv").write_text("frame,id,x,y,w,h\n0,1,5,5,9,9\n")
        done("run", path, "--topic", "/front/boxes", "--no-tables", "--in-place")
        words = ["ingest", tmp_path / "truth.csv", "--into", path, "--camera", "front", "--as", "truth", "--force"]
        words += ["--fps", "10", "--start-time", "2023-11-14T22:13:20Z", "--size", "1280x720", "--in-place"]
        done(*words, "--ground-plane", tmp_path / "plane.txt")
        result = mcaptrack.run(path, topic="/front/boxes", ground_frame="map", tables=False)
        assert "sample" in result.stages
        unused = [one.message for one in result.warnings if one.code == "option-not-used"]
        assert unused == ["`ground_frame=` changes nothing here: a ground plane is given"]
        with log.read(path) as opened:
            ((_, plane),) = read_planes(opened, "/front")
        assert plane.lens is None


def test_planes_of_each_picture_hold_where_tracks_are_compensated(straight, tmp_path):
    """Boxes that are moved to the pixels of one picture stand where they did; lenses bend what each picture saw."""
    for path in (straight, robot(tmp_path / "bent.mcap", "plumb_bob", last_s=0.5)):
        planes = ground(path)[0].planes[:5]
        turn = Rotation.from_euler("z", 2, degrees=True).as_matrix()[:2, :2]
        motions = [np.column_stack([turn, [-12.0 + 2 * number, 5]]) for number in range(5)]
        t_ns = np.array([since for since, _ in planes])
        moves = CameraPath(t_ns, poses_of(motions, *SIZE))
        feet = np.array([[300.0, 500], [700, 650], [1000, 560]])
        points = np.column_stack([feet, np.zeros((3, 2))])  # boxes without a size
        for moved, to_here in ((scene_planes(planes, moves), moves.to_scene), (moved_planes(planes, moves), None)):
            for since_ns, plane in planes:
                here = points if to_here is None else to_here(points, np.full(3, since_ns))
                found = plane_at(moved, since_ns)
                assert found.boxes_to_metres(here) == pytest.approx(plane.boxes_to_metres(points), abs=1e-5)
                assert found.metres_to_pixels(plane.boxes_to_metres(points)) == pytest.approx(here[:, :2], abs=1e-2)


class TestCalibrations:
    def read(self, path: Path, is_rectified: bool = False):
        with log.read(path) as opened:
            return read_calibrations(opened, "/front/camera_info", is_rectified)[0][1]

    def written(self, tmp_path, model="plumb_bob", **changes) -> Path:
        kind, payload = camera_info(model, **changes)
        return write(tmp_path / "a.mcap", ("/front/camera_info", kind, [(START_NS, payload)]))

    def test_a_part_of_the_sensor(self, tmp_path):
        """Every second pixel of the part that begins at (100, 60): OpenCV sees the same point at half the distance."""
        roi = Ros("sensor_msgs/CameraInfo").new("sensor_msgs/RegionOfInterest", 100, 60, 400, 800, False)
        one = self.read(self.written(tmp_path, binning_x=2, binning_y=2, roi=roi))
        assert (one.width_px, one.height_px) == (400, 200)
        assert one.lens.focal_px == (350, 350)
        assert one.lens.centre_px == (269.75, 149.75)

    def test_rectified_pictures(self, tmp_path):
        p = np.array([[600.0, 0, 650, 0], [0, 610, 350, 0], [0, 0, 1, 0]]).ravel()
        one = self.read(self.written(tmp_path, p=p), is_rectified=True)
        assert (one.lens.focal_px, one.lens.centre_px, one.lens.distortion) == ((600, 610), (650, 350), ())

    @pytest.mark.parametrize(
        ("model", "changes", "words"),
        [
            ("plumb_bob", {"k": np.zeros(9)}, "ns: it isn't calibrated: its focal length is 0 pixels"),
            ("plumb_bob", {"k": np.full(9, np.nan)}, "ns: it isn't calibrated: its focal length is nan pixels"),
            ("cylinder", {}, "distortion by 'cylinder' is not read"),
            ("plumb_bob", {"d": np.full(6, 0.1)}, "coefficients of distortion, not 6"),
        ],
    )
    def test_what_is_not_read(self, model, changes, words, tmp_path):
        with pytest.raises(McaptrackError, match=words):
            self.read(self.written(tmp_path, model, **changes))

    def test_which_one_is_taken(self, tmp_path):
        """The one in the frame of the pictures; of several the nearest by name; in other frames that beside them."""
        kinds = {name: camera_info("", frame_id=name) for name in ("left", "right", "")}
        topics = {"/left/info": "left", "/a/info": "right", "/b/info": "right", "/c/info": ""}
        channels = [(topic, kinds[name][0], [(START_NS, kinds[name][1])]) for topic, name in topics.items()]
        with log.read(write(tmp_path / "a.mcap", *channels)) as opened:
            assert find_calibration(opened, "/x/image", "left") == "/left/info"
            assert find_calibration(opened, "/c/image", "left") == "/left/info"
            assert find_calibration(opened, "/b/image", "right") == "/b/info"
            assert find_calibration(opened, "/c/image", "else") == "/c/info"
            assert find_calibration(opened, "/c/image/compressed", "") == "/c/info"
            with pytest.raises(McaptrackError, match="several calibrations fit /x/image: /a/info, /b/info"):
                find_calibration(opened, "/x/image", "right")
            with pytest.raises(McaptrackError, match="no calibration is of the frame 'up' of /x/image"):
                find_calibration(opened, "/x/image", "up")
