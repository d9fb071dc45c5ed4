"""Logs of a robot with boxes in space, by other writers: a scene that is known, and its messages in all forms."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from scipy.spatial.transform import Rotation, Slerp

from mcaptrack.foxglove import schema_record
from mcaptrack.geometry.clocks import NS_PER_S
from tests.logs import Recorder, recorder
from tests.ros_messages import BAR, Ros

START_NS = 1_700_000_000_000_000_000
LATE_NS = 40_000_000
NAMES = ("pedestrian", "car", "truck", "bicycle")

#: The types of vision_msgs: noetic, foxy (before Humble), and since. Others come from the distribution.
DETECTIONS_3D = {
    layout: (
        "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n"
        + BAR + "MSG: vision_msgs/Detection3D\nstd_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\n" + last
        + BAR + "MSG: vision_msgs/ObjectHypothesisWithPose\n" + guess + "geometry_msgs/PoseWithCovariance pose\n" + more
        + BAR + "MSG: vision_msgs/BoundingBox3D\ngeometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n"
    )
    for layout, last, guess, more in (
        ("ros1", "sensor_msgs/PointCloud2 source_cloud\n", "int64 id\nfloat64 score\n", ""),
        ("v3", "sensor_msgs/PointCloud2 source_cloud\nbool is_tracking\nstring tracking_id\n", "string id\nfloat64 score\n", ""),
        ("v4", "string id\n", "vision_msgs/ObjectHypothesis hypothesis\n", BAR + "MSG: vision_msgs/ObjectHypothesis\nstring class_id\nfloat64 score\n"),
    )
}  # fmt: skip


@dataclass
class Seen:
    """A box in its frame: centre, quaternion (x, y, z, w), size (3), class, score, id, velocity in its frame."""

    centre: np.ndarray
    turn: np.ndarray
    size: np.ndarray
    name: str = "car"
    score: float = 0.5
    number: int = 7
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))


#: A box that is turned by a quarter to the left, so that its x axis is y.
SEEN = Seen(
    np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]), np.array([4.0, 2.0, 1.5]), number=12
)


@dataclass
class Shot:
    """What a sensor measured at ``stamp_ns``, and where it is in the map: rotation and translation."""

    stamp_ns: int
    boxes: list[Seen]


class Robot:
    """A robot on a slope that drives a curve, with a lidar on its roof; boxes are drawn at random."""

    def __init__(self, seed: int = 0, shots: int = 8, boxes: int = 3) -> None:
        rng = np.random.default_rng(seed)
        self.stamps = START_NS + np.arange(0, shots * 100_000_000 + 200_000_000, 25_000_000) - 30_000_000
        s = (self.stamps - START_NS) / NS_PER_S
        self.place = np.stack([5000 + 8 * s, -300 + s**2, 60 + 0.1 * s], axis=-1)
        self.turn = Rotation.from_euler("zyx", np.stack([0.3 + 0.4 * s, 0.05 + 0 * s, 0.02 * s], axis=-1))
        self.mount = Rotation.from_euler("zyx", [0.7, 0.03, -0.02]), np.array([1.2, -0.3, 1.9])
        self.shots = [
            Shot(START_NS + k * 100_000_000 + 1_234_567, [self._box(rng, n) for n in range(boxes)])
            for k in range(shots)
        ]

    @staticmethod
    def _box(rng: np.random.Generator, number: int) -> Seen:
        turn = Rotation.from_euler("zyx", [rng.uniform(-3, 3), *rng.normal(0, 0.03, 2)]).as_quat()
        size = np.sort(rng.uniform(0.5, 5, 3))[::-1]
        centre = [*rng.uniform(-40, 40, 2), rng.uniform(-2, 1)]
        name = NAMES[int(rng.integers(len(NAMES)))]
        return Seen(
            np.array(centre), turn, size, name, round(float(rng.uniform(0.1, 1)), 3), 10 + number, rng.normal(0, 3, 3)
        )

    def pose(self, stamp_ns: int) -> tuple[Rotation, np.ndarray]:
        """The pose of the lidar in the map, between the recorded ones."""
        base = Slerp(self.stamps - START_NS, self.turn)(stamp_ns - START_NS)
        place = [np.interp(stamp_ns - START_NS, self.stamps - START_NS, self.place[:, axis]) for axis in range(3)]
        return base * self.mount[0], base.apply(self.mount[1]) + place

    def wanted(self) -> list[dict[str, float]]:
        """The rows in the map, by scipy."""
        out = []
        for shot in self.shots:
            rotation, shift = self.pose(shot.stamp_ns)
            for box in shot.boxes:
                centre, velocity = rotation.apply(box.centre) + shift, rotation.apply(box.velocity)
                ahead = (rotation * Rotation.from_quat(box.turn)).apply([1, 0, 0])
                names = dict(zip(("length_m", "width_m", "height_m"), box.size.tolist(), strict=True))
                names |= dict(zip(("x_m", "y_m", "z_m"), centre.tolist(), strict=True))
                names |= {"heading_rad": float(np.arctan2(ahead[1], ahead[0])), "score": box.score, "id": box.number}
                names |= {"vx_m_per_s": velocity[0], "vy_m_per_s": velocity[1], "class": box.name}
                out.append({"t_ns": shot.stamp_ns} | names)
        return out


# Writers


@cache
def ros(name: str, definition: str = "", ros1: bool = False) -> Ros:
    return Ros(name, definition, ros1)


def header(writer: Ros, stamp_ns: int, frame_id: str):
    stamp = writer.new("builtin_interfaces/Time", *divmod(stamp_ns, NS_PER_S))
    return writer.new("std_msgs/Header", *([7] if writer.ros1 else []), stamp, frame_id)


def point(writer: Ros, values, name: str = "Point"):
    return writer.new(f"geometry_msgs/{name}", *map(float, values))


def pose(writer: Ros, box: Seen):
    return writer.new("geometry_msgs/Pose", point(writer, box.centre), point(writer, box.turn, "Quaternion"))


def covered(writer: Ros, name: str, value):
    return writer.new(f"geometry_msgs/{name}WithCovariance", value, np.zeros(36))


def point_cloud(writer: Ros):
    return writer.new(
        "sensor_msgs/PointCloud2", header(writer, 0, ""), 0, 0, [], False, 0, 0, np.zeros(0, np.uint8), False
    )


def transforms(robot: Robot, ros1: bool = False) -> Iterator[tuple[str, Ros, int, bytes]]:
    """TFMessages of the robot on /tf, and one on /tf_static: topic, writer, stamp and payload of each."""
    writer = ros("tf2_msgs/TFMessage", ros1=False)

    def one(parent: str, child: str, stamp_ns: int, turn: Rotation, shift) -> bytes:
        inner = writer.new(
            "geometry_msgs/Transform", point(writer, shift, "Vector3"), point(writer, turn.as_quat(), "Quaternion")
        )
        return writer.pack(
            writer.new(
                "tf2_msgs/TFMessage",
                [writer.new("geometry_msgs/TransformStamped", header(writer, stamp_ns, parent), child, inner)],
            )
        )

    yield "/tf_static", writer, START_NS, one("base_link", "lidar", START_NS, *robot.mount)
    for stamp_ns, turn, shift in zip(robot.stamps.tolist(), robot.turn, robot.place, strict=True):
        yield "/tf", writer, stamp_ns, one("map", "base_link", stamp_ns, turn, shift)


def detection_3d_array(
    layout: str, stamp_ns: int, boxes: Sequence[Seen], frame_id: str = "lidar", own: str = ""
) -> tuple[Ros, bytes]:
    writer = ros("vision_msgs/Detection3DArray", DETECTIONS_3D[layout], layout == "ros1")
    found = []
    for box in boxes:
        label = NAMES.index(box.name) + 1 if layout == "ros1" else box.name
        guesses = [(label, box.score), (9 if layout == "ros1" else "other", box.score / 2)]
        at = covered(writer, "Pose", pose(writer, box))
        results = [
            writer.new("vision_msgs/ObjectHypothesisWithPose", writer.new("vision_msgs/ObjectHypothesis", i, s), at)
            if layout == "v4"
            else writer.new("vision_msgs/ObjectHypothesisWithPose", i, s, at)
            for i, s in guesses
        ]
        bbox = writer.new("vision_msgs/BoundingBox3D", pose(writer, box), point(writer, box.size, "Vector3"))
        cloud = [] if layout == "v4" else [point_cloud(writer)]
        last = {"ros1": [], "v3": [True, str(box.number)], "v4": [str(box.number)]}[layout]
        found.append(writer.new("vision_msgs/Detection3D", header(writer, 0, own), results, bbox, *cloud, *last))
    return writer, writer.pack(writer.new("vision_msgs/Detection3DArray", header(writer, stamp_ns, frame_id), found))


def marker(
    writer: Ros,
    stamp_ns: int,
    box: Seen,
    kind: int = 1,
    action: int = 0,
    points: Sequence = (),
    text: str = "",
    space: str | None = None,
):
    fields = writer.store.fielddefs["visualization_msgs/msg/Marker"][1]
    given = {
        "header": header(writer, stamp_ns, "lidar"), "ns": box.name if space is None else space, "id": box.number, "type": kind,
        "action": action, "pose": pose(writer, box), "scale": point(writer, box.size, "Vector3"),
        "color": writer.new("std_msgs/ColorRGBA", 0.0, 0.0, 0.0, 1.0), "lifetime": writer.new("builtin_interfaces/Duration", 0, 0),
        "frame_locked": False, "points": [point(writer, one) for one in points], "colors": [], "text": text or str(box.score),
        "texture_resource": "", "uv_coordinates": [], "mesh_resource": "", "mesh_use_embedded_materials": False,
    }  # fmt: skip
    if "texture" in {name for name, _ in fields}:
        given["texture"] = writer.new("sensor_msgs/CompressedImage", header(writer, 0, ""), "", np.zeros(0, np.uint8))
        given["mesh_file"] = writer.new("visualization_msgs/MeshFile", "", np.zeros(0, np.uint8))
    return writer.new("visualization_msgs/Marker", **{name: given[name] for name, _ in fields})


def marker_array(stamp_ns: int, boxes: Sequence[Seen], cleared: bool = True) -> tuple[Ros, bytes]:
    writer = ros("visualization_msgs/MarkerArray")
    all_gone = (
        [marker(writer, stamp_ns, Seen(np.zeros(3), np.array([0, 0, 0, 1.0]), np.ones(3)), action=3)] if cleared else []
    )
    found = [marker(writer, stamp_ns, box) for box in boxes]
    return writer, writer.pack(writer.new("visualization_msgs/MarkerArray", all_gone + found))


def scene_update(stamp_ns: int, boxes: Sequence[Seen], frame_id: str = "lidar") -> SceneUpdate:
    message = SceneUpdate()
    for box in boxes:
        entity = message.entities.add(frame_id=frame_id, id=str(box.number), frame_locked=True)
        entity.timestamp.seconds, entity.timestamp.nanos = divmod(stamp_ns, NS_PER_S)
        for key, value in (("Class", box.name), ("confidence", str(box.score))):
            entity.metadata.add(key=key, value=value)
        cube = entity.cubes.add()
        for axis, value in zip("xyz", box.centre.tolist(), strict=True):
            setattr(cube.pose.position, axis, value)
        for axis, value in zip("xyzw", box.turn.tolist(), strict=True):
            setattr(cube.pose.orientation, axis, value)
        for axis, value in zip("xyz", box.size.tolist(), strict=True):
            setattr(cube.size, axis, value)
    return message


def scene_update_json(stamp_ns: int, boxes: Sequence[Seen]) -> bytes:
    """As a writer of JSON makes it, which knows nothing of protobuf."""

    def named(axes: str, values) -> dict[str, float]:
        return dict(zip(axes, map(float, values), strict=True))

    sec, nsec = divmod(stamp_ns, NS_PER_S)
    entities = [
        {
            "timestamp": {"sec": sec, "nsec": nsec},
            "frame_id": "lidar",
            "id": str(box.number),
            "metadata": [{"key": "label", "value": box.name}, {"key": "score", "value": repr(box.score)}],
            "cubes": [
                {
                    "pose": {"position": named("xyz", box.centre), "orientation": named("xyzw", box.turn)},
                    "size": named("xyz", box.size),
                }
            ],
        }
        for box in boxes
    ]
    return json.dumps(
        {"deletions": [{"timestamp": {"sec": sec, "nsec": nsec}, "type": 1, "id": ""}], "entities": entities}
    ).encode()


def write(
    path: Path,
    robot: Robot,
    boxes: Callable[[Recorder], Callable[[int, Shot], None]],
    moving: str = "ros",
    keep=lambda stamp_ns: True,
) -> Path:
    """A log with the robot's transforms, and its boxes on /lidar/boxes, 40 ms late."""
    with recorder(path) as writer:
        channels: dict[str, int] = {}
        if moving == "ros":
            for topic, theirs, stamp_ns, payload in transforms(robot):
                if topic not in channels:
                    schema = writer.register_schema("tf2_msgs/msg/TFMessage", "ros2msg", theirs.kind.schema)
                    channels[topic] = writer.register_channel(topic, "cdr", schema)
                if topic == "/tf_static" or keep(stamp_ns):
                    writer.add_message(channels[topic], stamp_ns + 3_000_000, payload, stamp_ns)
        elif moving == "protobuf":
            name, encoding, data = schema_record("foxglove.FrameTransform")
            channel = writer.add_channel("/tf", (name, encoding, data), "protobuf")
            moves = [
                (at, "map", "base_link", turn, shift)
                for at, turn, shift in zip(robot.stamps.tolist(), robot.turn, robot.place, strict=True)
            ]
            moves += [(at, "base_link", "lidar", *robot.mount) for at in robot.stamps[[0, -1]].tolist()]
            for stamp_ns, parent, child, turn, shift in moves:
                message = FrameTransform(parent_frame_id=parent, child_frame_id=child)
                message.timestamp.seconds, message.timestamp.nanos = divmod(stamp_ns, NS_PER_S)
                for axis, value in zip("xyz", shift, strict=True):
                    setattr(message.translation, axis, value)
                for axis, value in zip("xyzw", turn.as_quat(), strict=True):
                    setattr(message.rotation, axis, value)
                writer.add_message(channel, stamp_ns + 3_000_000, message.SerializeToString(), stamp_ns)
        add = boxes(writer)
        for number, shot in enumerate(robot.shots):
            add(number, shot)
    return path


def by_ros(
    make: Callable[[int, Sequence[Seen]], tuple[Ros, bytes]], late_ns: int = LATE_NS
) -> Callable[[Recorder], Callable[[int, Shot], None]]:
    def begin(writer: Recorder) -> Callable[[int, Shot], None]:
        channel = None

        def add(number: int, shot: Shot) -> None:
            nonlocal channel
            theirs, payload = make(shot.stamp_ns, shot.boxes)
            if channel is None:
                kind = theirs.kind
                channel = writer.register_channel(
                    "/lidar/boxes", kind.encoding, writer.register_schema(kind.name, kind.schema_encoding, kind.schema)
                )
            writer.add_message(channel, shot.stamp_ns + late_ns, payload, shot.stamp_ns, number)

        return add

    return begin


def by_foxglove(
    make: Callable[[int, Sequence[Seen]], bytes], encoding: str = "protobuf", name: str = "foxglove.SceneUpdate"
) -> Callable[[Recorder], Callable[[int, Shot], None]]:
    def begin(writer: Recorder) -> Callable[[int, Shot], None]:
        record = schema_record(name) if encoding == "protobuf" else (name, "jsonschema", b"{}")
        channel = writer.add_channel("/lidar/boxes", record, encoding)

        def add(number: int, shot: Shot) -> None:
            writer.add_message(channel, shot.stamp_ns + LATE_NS, make(shot.stamp_ns, shot.boxes), shot.stamp_ns, number)

        return add

    return begin


#: The same log by different writers.
WAYS = {
    "detections since humble": by_ros(lambda t, boxes: detection_3d_array("v4", t, boxes)),
    "detections before humble": by_ros(lambda t, boxes: detection_3d_array("v3", t, boxes)),
    "detections of ros 1": by_ros(lambda t, boxes: detection_3d_array("ros1", t, boxes)),
    "markers": by_ros(marker_array),
    "scene updates": by_foxglove(lambda t, boxes: scene_update(t, boxes).SerializeToString()),
    "json": by_foxglove(scene_update_json, "json"),
}
