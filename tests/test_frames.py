"""Transforms between frames: read in all encodings, cleaned, and interpolated as SciPy does."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from scipy.spatial.transform import Rotation, Slerp

from mcaptrack import foxglove, log
from mcaptrack.geometry.transform_tree import PoseSamples, Reason, Recorded, TransformTree
from mcaptrack.notices import collected
from mcaptrack.sources import fixed_frame
from mcaptrack.sources.foreign import MessageType
from tests.commands import done
from tests.logs import recorder
from tests.ros_messages import BAR, Ros

START_NS = 1_700_000_000_000_000_000
S = 10**9


def at(*seconds: float) -> np.ndarray:
    return START_NS + np.round(np.array(seconds) * S).astype(np.int64)


def yaw(*degrees: float) -> np.ndarray:
    return Rotation.from_euler("z", np.reshape(degrees, (-1, 1)), degrees=True).as_quat()


def moves(parent, child, seconds, positions, quaternions=None, *, latched=False, late_s=0.0, stamps=None):
    """Poses at these times; ``stamps`` replaces the stamps in nanoseconds."""
    t_ns = at(*seconds)
    turned = np.tile([0.0, 0, 0, 1], (len(t_ns), 1)) if quaternions is None else np.asarray(quaternions, float)
    stamp_ns = t_ns if stamps is None else np.asarray(stamps, np.int64)
    positions = np.asarray(positions, float).reshape(-1, 3)
    return Recorded(parent, child, latched, PoseSamples(stamp_ns, t_ns + round(late_s * S), positions, turned))


def drive(parent="map", child="base_link", seconds=None, speed=10.0, **more):
    """Straight ahead along x."""
    seconds = np.arange(0, 10, 0.025) if seconds is None else np.asarray(seconds)
    return moves(parent, child, seconds, np.stack([speed * seconds, 0 * seconds, 0 * seconds], axis=1), **more)


def x_of(tree, *seconds, target="map", source="base_link"):
    return tree.lookup(target, source, at(*seconds)).translation[:, 0]


def said(tree) -> str:
    return "\n".join(remark.text for remark in tree.remarks)


class TestInterpolation:
    def test_as_scipy(self):
        rng = np.random.default_rng(1)
        seconds = np.cumsum(rng.uniform(0.05, 0.3, 40))
        places = np.cumsum(rng.normal(0, 0.1, (40, 3)), axis=0)
        turns = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.1, (40, 3)), axis=0))
        signs = rng.choice([-1, 1], (40, 1))  # a quaternion and its negative are the same rotation
        tree = TransformTree([moves("map", "robot", seconds, places, turns.as_quat() * signs)])
        when = rng.uniform(seconds[0], seconds[-1], 200)
        poses = tree.lookup("map", "robot", at(*when))
        assert poses.is_known.all()
        assert not poses.unknown
        expected = Slerp(seconds, turns)(when)
        assert (expected.inv() * Rotation.from_matrix(poses.rotation)).magnitude().max() < 1e-6
        for axis in range(3):
            assert np.abs(poses.translation[:, axis] - np.interp(when, seconds, places[:, axis])).max() < 1e-6

    def test_a_chain_and_back(self):
        """A lidar on a robot that turned left by 90 degrees at (10, 5), and a camera that looks along its y axis."""
        tree = TransformTree(
            [
                moves("map", "robot", [0, 0.1], [[10, 5, 0], [10, 5.001, 0]], yaw(90, 90)),
                moves("robot", "lidar", [0], [[1, 0, 2]], latched=True),
                moves("robot", "eye", [0], [[0, 1, 0]], yaw(90), latched=True),
            ]
        )
        ahead = tree.lookup("map", "lidar", at(0)).apply(np.array([[3.0, 0, 0]]))
        assert ahead[0] == pytest.approx([10, 9, 2])
        across = tree.lookup("eye", "lidar", at(0)).apply(np.array([[3.0, 0, 0]]))
        assert across[0] == pytest.approx([-1, -4, 2])
        there = tree.lookup("lidar", "map", at(0)).apply(ahead)
        assert there[0] == pytest.approx([3, 0, 0])
        assert tree.roots() == ["map"]
        assert tree.root_of("eye") == "map"
        assert tree.lookup("robot", "robot", at(99)).is_known.all()


class TestWhereItIsKnown:
    def test_ends(self):
        """Beyond the ends the motion is continued for one interval, here 25 ms, and no further."""
        tree = TransformTree([drive()])
        poses = tree.lookup("map", "base_link", at(-0.03, -0.02, 9.98, 9.99, 10.01))
        assert poses.reason.tolist() == [Reason.BEFORE, 0, 0, 0, Reason.AFTER]
        assert poses.translation[:, 0] == pytest.approx([np.nan, -0.2, 99.8, 99.9, np.nan], nan_ok=True)
        assert poses.unknown == {
            "before the first transform map -> base_link": 1,
            "after the last transform map -> base_link": 1,
        }
        slow = TransformTree([drive(seconds=np.arange(10))])
        assert slow.lookup("map", "base_link", at(9.09, 9.11)).is_known.tolist() == [True, False]

    @pytest.mark.parametrize(("step", "hole", "known"), [(0.025, 0.45, True), (0.025, 0.55, False), (1, 2.9, True)])
    def test_gaps(self, step, hole, known):
        """Longer than half a second, and than three intervals."""
        seconds = np.arange(0, 20, step)
        seconds = seconds[(seconds <= 10) | (seconds >= 10 + hole - 1e-9)]
        seconds[np.searchsorted(seconds, 10 + hole - 1e-9)] = 10 + hole
        tree = TransformTree([drive(seconds=seconds)])
        poses = tree.lookup("map", "base_link", at(10 + hole / 2))
        assert poses.is_known.all() == known
        assert ("it has 1 gap, the longest of 0.55 s" in said(tree)) == (not known)

    def test_nothing_is_interpolated_over_long(self):
        tree = TransformTree([drive(seconds=np.arange(0, 100, 11.0), speed=0.1)])
        assert not tree.lookup("map", "base_link", at(5)).is_known.any()

    @pytest.mark.parametrize("offset", [2.0, 500.0])
    def test_jumps_are_not_interpolated(self, offset):
        """A localisation that is reset at 5 s: each side is continued up to the middle."""
        seconds = np.arange(0, 10, 0.025)
        places = np.stack([10 * seconds, np.where(seconds > 4.99, offset, 0.0), 0 * seconds], axis=1)
        tree = TransformTree([moves("map", "base_link", seconds, places)])
        poses = tree.lookup("map", "base_link", at(4.975, 4.98, 4.99, 4.995, 5.0, 5.01))
        assert poses.translation[:, 0] == pytest.approx([49.75, 49.8, 49.9, 49.95, 50, 50.1])
        assert poses.translation[:, 1].tolist() == pytest.approx([0, 0, offset, offset, offset, offset])
        assert f"it jumps 1 time, farthest by {offset:.2g} m at 1700000005.000 s" in said(tree)

    def test_a_pose_between_two_jumps_holds(self):
        seconds = np.arange(0, 1, 0.1)
        places = np.stack([seconds, np.array([0, 0, 0, 0, 30, 60, 60, 60, 60, 60]), 0 * seconds], axis=1)
        tree = TransformTree([moves("map", "robot", seconds, places)])
        assert tree.lookup("map", "robot", at(0.36, 0.43)).translation[:, :2].ravel().tolist() == [0.4, 30, 0.4, 30]

    def test_a_jump_on_the_spot(self):
        seconds = np.arange(0, 10, 0.1)
        tree = TransformTree([moves("map", "robot", seconds, np.zeros((100, 3)), yaw(*np.where(seconds < 5, 0, 90)))])
        assert "it jumps 1 time, farthest by 90 degrees" in said(tree)
        matrix = tree.lookup("map", "robot", at(4.93, 4.97)).rotation
        assert matrix[:, 0, 0] == pytest.approx([1, 0], abs=1e-6)

    def test_single_poses_elsewhere_are_left_out(self):
        seconds = np.arange(0, 10, 0.025)
        places = np.stack([10 * seconds, 0 * seconds, 0 * seconds], axis=1)
        places[[100, 250]] += [0, 30, 0]
        tree = TransformTree([moves("map", "base_link", seconds, places)])
        assert said(tree) == "map -> base_link: 2 poses far from those before and after are left out"
        poses = tree.lookup("map", "base_link", at(2.49, 2.5, 2.51))
        assert poses.translation[:, 0] == pytest.approx([24.9, 25, 25.1])
        assert poses.translation[:, 1] == pytest.approx([0, 0, 0])

    def test_hard_driving_is_no_jump(self):
        """Full brakes from 30 m/s, turns on the spot by 180 degrees a second, and stamps that jitter by a quarter."""
        rng = np.random.default_rng(2)
        for step in (0.025, 0.1, 0.5):
            seconds = np.arange(0, 12, step)
            slow = np.clip(seconds - 5, 0, 3)
            x = 30 * np.minimum(seconds, 5) + 30 * slow - 5 * slow**2
            turned = yaw(*(np.clip(seconds - 9, 0, 2) * 180))
            stamps = at(*(seconds + step * rng.uniform(-0.25, 0.25, len(seconds))))
            tree = TransformTree([moves("map", "car", seconds, np.stack([x, 0 * x, 0 * x], 1), turned, stamps=stamps)])
            assert said(tree) == ""


class TestOddRecordings:
    def test_two_parents(self):
        tree = TransformTree([drive(), drive("odom", seconds=np.arange(0, 10, 0.5))])
        assert tree.root_of("base_link") == "map"
        words = "base_link has several parents: map (400 messages) is taken, and odom (20 messages) left out"
        assert said(tree) == words

    def test_a_loop(self):
        often, seldom = np.arange(0, 10, 0.1), np.arange(0, 10, 0.5)
        tree = TransformTree([drive("a", "b", often), drive("b", "c", seldom), drive("c", "a", often)])
        assert said(tree) == "the frames a -> b -> c -> a form a loop: b -> c is left out"
        assert tree.roots() == ["c"]
        assert tree.lookup("c", "b", at(1)).is_known.all()

    def test_a_loop_through_a_static_frame(self):
        """/tf_static is published once; that doesn't make it the weakest."""
        mount = moves("base_link", "lidar", [0], [[1, 0, 0]], latched=True)
        odd = moves("lidar", "map", [1, 2, 3], [[9, 9, 9]] * 3)
        tree = TransformTree([mount, odd, drive()])
        assert said(tree).endswith("form a loop: lidar -> map is left out")
        np.testing.assert_allclose(x_of(tree, 5, source="lidar"), 51)

    def test_a_long_chain_and_a_long_loop(self):
        """Names of frames may be many: nothing takes time by their square, and no line is endless."""
        count = 500
        chain = [moves(f"f{number}", f"f{number + 1}", [0], [1, 0, 0], latched=True) for number in range(count)]
        tree = TransformTree(chain)
        assert tree.roots() == ["f0"]
        assert tree.children_of("/f7") == ["f8"]
        assert tree.lookup("f0", f"f{count}", at(1)).translation[0, 0] == count
        tree = TransformTree([*chain, moves(f"f{count}", "f0", [0], [1, 0, 0], latched=True)])
        assert "(and 494 more) form a loop" in said(tree)
        assert len(said(tree)) < 200

    def test_a_frame_in_itself_or_without_a_name(self):
        tree = TransformTree([drive(), drive("x", "x"), drive("", "y"), drive("/", "z")])
        assert tree.frames() == ["base_link", "map"]
        assert said(tree).count("left out") == 3

    def test_quaternions(self):
        good = yaw(*np.zeros(400))
        good[:3] = [[0, 0, 0, 0], [np.nan, 0, 0, 1], [0, 0, np.inf, 1]]
        good[9] *= 3
        tree = TransformTree([drive(quaternions=good)])
        assert "3 poses without a rotation or a position are left out" in said(tree)
        assert "1 quaternion of another length than 1 are normalised" in said(tree)
        assert not tree.lookup("map", "base_link", at(0)).is_known.any()
        assert np.linalg.det(tree.lookup("map", "base_link", at(0.225)).rotation[0]) == pytest.approx(1)
        assert TransformTree([drive(quaternions=np.zeros((400, 4)))]).frames() == []

    def test_equal_stamps(self):
        """The last one is taken; the same pose twice is not worth a word."""
        twice = np.repeat(np.arange(0, 10, 0.1), 2)
        assert said(TransformTree([drive(seconds=twice)])) == ""
        places = np.stack([twice, np.tile([0, 0.1], 100), 0 * twice], axis=1)
        tree = TransformTree([moves("map", "robot", twice, places)])
        assert "100 stamps have several poses, of which the last is taken" in said(tree)
        assert tree.lookup("map", "robot", at(1.05)).translation[0] == pytest.approx([1.05, 0.1, 0])

    def test_time_travel(self):
        """A recording that was played twice, the second time half of it: the longer part is taken."""
        once = np.arange(0, 10, 0.025)
        seconds = np.concatenate([once, once[:200]])
        places = np.stack([seconds, np.repeat([0.0, 50.0], [400, 200]), 0 * seconds], axis=1)
        log_s = np.arange(600) * 0.025
        one = moves("map", "base_link", log_s, places, stamps=at(*seconds))
        tree = TransformTree([one])
        words = "its clock goes back 1 time, by up to 9.97 s; 200 poses of times that it had before are left out"
        assert words in said(tree)
        assert tree.lookup("map", "base_link", at(1.01)).translation[0] == pytest.approx([1.01, 0, 0])
        apart = moves("map", "base_link", log_s[:400], places[:400], stamps=at(*np.roll(once, 200)))
        assert "0 poses of times" in said(TransformTree([apart]))

    def test_static_transforms(self):
        """One that is published again is the same; one that changes holds until the next; none ends."""
        again = moves("robot", "lidar", np.arange(0, 10, 0.1), np.tile([1.0, 0, 2], (100, 1)))
        tree = TransformTree([again])
        assert tree.series["lidar"].is_static
        assert tree.lookup("robot", "lidar", at(-99, 5, 99)).translation.tolist() == [[1, 0, 2]] * 3
        assert said(tree) == ""
        tree = TransformTree([moves("robot", "lidar", [0, 2, 4], [[1, 0, 0], [1, 0, 0], [2, 0, 0]], latched=True)])
        assert x_of(tree, -1, 3.9, 4, 9, target="robot", source="lidar").tolist() == [1, 1, 2, 2]
        assert "it is static, but changes 1 time" in said(tree)
        stamps = np.zeros(3)
        tree = TransformTree([moves("a", "b", [0, 2, 4], np.diag([1, 2, 3]), latched=True, stamps=stamps)])
        assert x_of(tree, 3, 5, target="a", source="b").tolist() == [0, 0]
        assert tree.lookup("a", "b", at(3)).translation[0].tolist() == [0, 2, 0]
        assert "one message, which is taken for all times" in said(TransformTree([moves("a", "b", [0], [1, 0, 0])]))

    def test_clocks(self):
        """Stamps of 0, and stamps of another clock than those of other transforms, give way to the log time."""
        tree = TransformTree([drive(stamps=np.zeros(400))])
        assert x_of(tree, 1.01) == pytest.approx(10.1)
        assert "its stamps are 0" in said(tree)
        seconds = np.arange(0, 10, 0.025)
        since_boot = np.round(seconds * S).astype(np.int64) + S
        arm = drive("base_link", "arm", stamps=since_boot)
        tree = TransformTree([drive(), arm])
        assert x_of(tree, 1.01, source="arm") == pytest.approx(20.2)
        assert "another clock" in said(tree)
        alone = TransformTree([arm])
        assert said(alone) == ""
        assert alone.lookup("base_link", "arm", np.array([2 * S])).translation[0, 0] == pytest.approx(10)
        assert x_of(alone.on_log_time, 1.01, target="base_link", source="arm") == pytest.approx(10.1)
        some = np.where(np.arange(400) < 5, 0, at(*seconds))
        assert "5 poses without a stamp are left out" in said(TransformTree([drive(stamps=some)]))


TF = (
    "geometry_msgs/TransformStamped[] transforms\n" + BAR
    + "MSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
    + BAR + "MSG: std_msgs/Header\n{header}string frame_id\n"
    + BAR + "MSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
    + BAR + "MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
    + BAR + "MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
)  # fmt: skip
PLACE, TURN = (1.0, -2.0, 3.0), tuple(yaw(30)[0].tolist())
AXES = "xyzw"


def of_ros(name: str, ros1: bool) -> tuple[MessageType, bytes]:
    header = "uint32 seq\ntime stamp\n" if ros1 else "builtin_interfaces/Time stamp\n"
    ros = Ros(name, TF.format(header=header) if name != "geometry_msgs/TransformStamped" else "", ros1)
    stamp = ros.new("builtin_interfaces/Time", *divmod(START_NS, S))
    head = ros.new("std_msgs/Header", *([7] if ros1 else []), stamp, "/map" if ros1 else "map")
    pose = ros.new(
        "geometry_msgs/Transform", ros.new("geometry_msgs/Vector3", *PLACE), ros.new("geometry_msgs/Quaternion", *TURN)
    )
    one = ros.new("geometry_msgs/TransformStamped", head, "robot", pose)
    return ros.kind, ros.pack(one if name.endswith("Stamped") else ros.new(name, [one]))


def of_protobuf(name: str) -> tuple[MessageType, bytes]:
    one = FrameTransform(parent_frame_id="map", child_frame_id="robot")
    one.timestamp.seconds, one.timestamp.nanos = divmod(START_NS, S)
    for axis, value in zip(AXES, PLACE, strict=False):
        setattr(one.translation, axis, value)
    for axis, value in zip(AXES, TURN, strict=True):
        setattr(one.rotation, axis, value)
    message = one if name == "foxglove.FrameTransform" else FrameTransforms(transforms=[one])
    return MessageType(*foxglove.schema_record(name), "protobuf"), message.SerializeToString()


def of_json(name: str) -> tuple[MessageType, bytes]:
    stamp = dict(zip(("sec", "nsec"), divmod(START_NS, S), strict=True))
    place = dict(zip(AXES, PLACE, strict=False))
    pose = {"translation": place, "rotation": dict(zip(AXES, TURN, strict=True))}
    if name.startswith("foxglove"):
        one = {"timestamp": stamp, "parent_frame_id": "map", "child_frame_id": "robot", **pose}
    else:
        one = {"header": {"stamp": stamp, "frame_id": "map"}, "child_frame_id": "robot", "transform": pose}
    message = one if name in ("foxglove.FrameTransform", "geometry_msgs/TransformStamped") else {"transforms": [one]}
    return MessageType(name, "jsonschema", b"{}", "json"), json.dumps(message).encode()


MESSAGES = {
    "TFMessage of ROS 2": of_ros("tf2_msgs/TFMessage", ros1=False),
    "TFMessage of ROS 1": of_ros("tf2_msgs/TFMessage", ros1=True),
    "tfMessage of ROS 1": of_ros("tf/tfMessage", ros1=True),
    "TransformStamped of ROS 2": of_ros("geometry_msgs/TransformStamped", ros1=False),
    "TransformStamped of ROS 1": of_ros("geometry_msgs/TransformStamped", ros1=True),
    "FrameTransform": of_protobuf("foxglove.FrameTransform"),
    "FrameTransforms": of_protobuf("foxglove.FrameTransforms"),
    **{f"{name} in JSON": of_json(name) for name in fixed_frame.TRANSFORMS_READ},
}


def write(path: Path, *channels) -> Path:
    """A log of channels: (topic, message type, [(log time, payload)])."""
    with recorder(path) as writer:
        for topic, kind, messages in channels:
            channel = writer.add_channel(topic, (kind.name, kind.schema_encoding, kind.schema), kind.encoding)
            for t_ns, payload in messages:
                writer.add_message(channel, t_ns, payload, t_ns)
    return path


class TestReading:
    @pytest.mark.parametrize("name", MESSAGES)
    def test_all_encodings(self, name, tmp_path):
        kind, payload = MESSAGES[name]
        with log.read(write(tmp_path / "a.mcap", ("/tf_static", kind, [(START_NS + 5, payload)]))) as opened:
            tree = fixed_frame.transforms_of(opened)
        assert tree is not None
        assert [str(one) for one in tree.series.values()] == ["map -> robot"]
        poses = tree.lookup("map", "robot", at(0))
        assert poses.translation[0] == pytest.approx(PLACE)
        assert poses.rotation[0] == pytest.approx(Rotation.from_quat(TURN).as_matrix())
        assert tree.series["robot"].t_ns.tolist() == [START_NS]

    def test_what_is_not_set_is_no_motion(self, tmp_path):
        kind, _ = MESSAGES["FrameTransform"]
        empty = FrameTransform(parent_frame_id="a", child_frame_id="b")
        with log.read(write(tmp_path / "a.mcap", ("/tf", kind, [(START_NS, empty.SerializeToString())]))) as opened:
            tree = fixed_frame.transforms_of(opened)
        assert tree.lookup("a", "b", at(0)).rotation[0].tolist() == np.eye(3).tolist()

    def test_damaged_messages_are_counted(self, tmp_path):
        kind, payload = MESSAGES["TFMessage of ROS 2"]
        path = write(
            tmp_path / "a.mcap",
            ("/tf", kind, [(START_NS, payload), (START_NS + 1, payload[:40])]),
            ("/other/tf", MessageType("tf2_msgs/msg/TFMessage", "", b"", "xml"), [(START_NS, b"")]),
        )
        with log.read(path) as opened:
            found = fixed_frame.read_frames(opened)
            with collected() as warnings:
                poses = fixed_frame.poses_at(opened, "/boxes", "map", "lidar", at(0, 1), at(0, 1))
        assert found.tree.frames() == ["map", "robot"]
        assert len(found.unread) == 2
        assert any("/tf at " in words for words in found.unread)
        assert any("encoding 'xml'" in words for words in found.unread)
        assert not poses.is_known.any()
        assert "2 of 2 messages are left out" in warnings[-1].message
        assert "no transform connects lidar with map" in warnings[-1].message

    def test_good_messages_are_kept_however_many_are_damaged(self, tmp_path):
        kind, payload = MESSAGES["TFMessage of ROS 2"]
        messages = [(START_NS + at, payload if at % 10 == 9 else payload[:40]) for at in range(3000)]
        with log.read(write(tmp_path / "a.mcap", ("/tf", kind, messages))) as opened:
            read = fixed_frame.read_frames(opened)
        assert read.tree.frames() == ["map", "robot"]
        assert "2700 of 3000 messages are like this" in read.unread[0]

    def test_another_clock_than_the_boxes(self, tmp_path):
        kind, _ = MESSAGES["FrameTransform"]
        messages = []
        for number in range(10):
            one = FrameTransform(parent_frame_id="a", child_frame_id="b")
            one.timestamp.seconds = 100 + number // 10
            one.timestamp.nanos = number % 10 * S // 10
            one.translation.x = number
            messages.append((int(at(number / 10)[0]), one.SerializeToString()))
        with log.read(write(tmp_path / "a.mcap", ("/tf", kind, messages))) as opened, collected() as warnings:
            poses = fixed_frame.poses_at(opened, "/boxes", "a", "b", at(0.45), at(0.55))
        assert poses.translation[0, 0] == pytest.approx(5.5)
        assert [one.code for one in warnings] == ["clock"]

    def test_robots_with_namespaces_have_transforms_of_their_own(self, tmp_path):
        """As navigation of several robots is set up in ROS 2: frames have the same names, topics don't."""
        kind, _ = MESSAGES["FrameTransform"]
        of_robots = (("/a/tf_static", 10.0), ("/b/tf_static", -10.0))
        channels = [(topic, kind, [(START_NS, packed("odom", "lidar", START_NS, x))]) for topic, x in of_robots]
        shared = ("/tf_static", kind, [(START_NS, packed("map", "odom", START_NS, 1.0))])
        with log.read(write(tmp_path / "a.mcap", *channels, shared)) as opened:
            for topic, x in (("/a/lidar/boxes", 11.0), ("/b/camera/image", -9.0)):
                assert fixed_frame.poses_at(opened, topic, "map", "lidar", at(0.5), at(0.5)).translation[0, 0] == x
        shown = done("info", tmp_path / "a.mcap", "--frames").out.partition("\nframes\n")[2].splitlines()
        assert [line.split()[-1] for line in shown[::4]] == ["/a/", "/b/"]
        assert [shown[number].split()[-2:] for number in (3, 7)] == 2 * [["lidar", "static"]]

    def test_a_log_without(self, tmp_path):
        kind, _ = MESSAGES["FrameTransform"]
        with log.read(write(tmp_path / "a.mcap", ("/tf", kind, []))) as opened:
            assert fixed_frame.transforms_of(opened) is None


def packed(parent: str, child: str, t_ns: int, x: float = 0.0) -> bytes:
    one = FrameTransform(parent_frame_id=parent, child_frame_id=child)
    one.timestamp.seconds, one.timestamp.nanos = divmod(t_ns, S)
    one.translation.x = x
    one.rotation.w = 1
    return one.SerializeToString()


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> Path:
    """A robot whose localisation is silent from 2 to 4 s, and jumps by 5 m at 6 s, with a lidar and an arm."""
    kind, _ = MESSAGES["FrameTransform"]
    times = [number / 10 for number in range(101) if not 20 < number < 40]
    moving = [(int(at(s)[0]), packed("map", "base_link", int(at(s)[0]), s + 5 * (s > 5.95))) for s in times]
    fixed = [(START_NS, packed("base_link", name, START_NS, 1.0)) for name in ("lidar", "arm\x1b")]
    other = [(START_NS, packed("base_link", "lidar", START_NS, 1.0))]
    path = tmp_path_factory.mktemp("robot") / "robot.mcap"
    return write(path, ("/tf", kind, moving), ("/tf_static", kind, fixed), ("/other", kind, other))


class TestInfo:
    def test_the_tree_is_drawn(self, robot):
        outcome = done("info", robot, "--frames")
        assert "transforms: map -> base_link: it has 1 gap, the longest of 2 s" in outcome.err
        assert outcome.out.partition("\nframes\n")[2].splitlines() == [
            "└── map",
            "    └── base_link  10 Hz, 0.000 to 10.000 s  gap: 2.000 to 4.000 s  jump: 6.000 s (5.1 m, 0 degrees)",
            "        ├── arm\\x1b  static",
            "        └── lidar  static",
        ]

    def test_a_log_without_transforms(self, tmp_path):
        kind, _ = MESSAGES["FrameTransform"]
        path = write(tmp_path / "a.mcap", ("/other", kind._replace(name="foxglove.Log"), []))
        assert done("info", path, "--frames").out.splitlines()[-1] == "no transforms"
