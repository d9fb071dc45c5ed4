"""Messages of ROS in both serialisations."""

from __future__ import annotations

from functools import cache

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mcaptrack.sources.foreign import MessageType

STAMP_NS = 1_700_000_000_123_456_789


BAR = "=" * 80 + "\n"


HEADER2 = BAR + "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"


HEADER1 = BAR + "MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"


POSES = (
    BAR + "MSG: geometry_msgs/PoseWithCovariance\ngeometry_msgs/Pose pose\nfloat64[36] covariance\n"
    + BAR + "MSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
    + BAR + "MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
    + BAR + "MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
)  # fmt: skip


# vision_msgs: kinetic/noetic, foxy to galactic (3), humble and later (4).
VISION = {
    "ros1": (
        "Header header\nDetection2D[] detections\n" + HEADER1
        + BAR + "MSG: vision_msgs/Detection2D\nHeader header\nObjectHypothesisWithPose[] results\nBoundingBox2D bbox\nsensor_msgs/Image source_img\n"
        + BAR + "MSG: vision_msgs/ObjectHypothesisWithPose\nint64 id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose\n"
        + BAR + "MSG: vision_msgs/BoundingBox2D\ngeometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n"
        + BAR + "MSG: geometry_msgs/Pose2D\nfloat64 x\nfloat64 y\nfloat64 theta\n"
        + BAR + "MSG: sensor_msgs/Image\nHeader header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n"
        + POSES
    ),
    "v3": (
        "std_msgs/Header header\nvision_msgs/Detection2D[] detections\n" + HEADER2
        + BAR + "MSG: vision_msgs/Detection2D\nstd_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox2D bbox\nstring id\n"
        + BAR + "MSG: vision_msgs/ObjectHypothesisWithPose\nstring id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose\n"
        + BAR + "MSG: vision_msgs/BoundingBox2D\ngeometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n"
        + BAR + "MSG: geometry_msgs/Pose2D\nfloat64 x\nfloat64 y\nfloat64 theta\n"
        + POSES
    ),
    "v4": (
        "std_msgs/Header header\nvision_msgs/Detection2D[] detections\n" + HEADER2
        + BAR + "MSG: vision_msgs/Detection2D\nstd_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox2D bbox\nstring id\n"
        + BAR + "MSG: vision_msgs/ObjectHypothesisWithPose\nvision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
        + BAR + "MSG: vision_msgs/ObjectHypothesis\nstring class_id\nfloat64 score\n"
        + BAR + "MSG: vision_msgs/BoundingBox2D\nvision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n"
        + BAR + "MSG: vision_msgs/Pose2D\nvision_msgs/Point2D position\nfloat64 theta\n"
        + BAR + "MSG: vision_msgs/Point2D\nfloat64 x\nfloat64 y\n"
        + POSES
    ),
}  # fmt: skip


class Ros:
    """rosbags' own writer of one message type."""

    def __init__(self, name: str, definition: str = "", ros1: bool = False) -> None:
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        self.types = "{}/msg/{}".format(*name.split("/"))
        if definition:  # of its own types at least; those of the distribution are known
            self.store.register(get_types_from_msg(definition, self.types))
        self.ros1, self.definition = ros1, self.store.generate_msgdef(self.types, ros_version=1 if ros1 else 2)[0]
        encoding = ("ros1msg", "ros1") if ros1 else ("ros2msg", "cdr")
        self.kind = MessageType(name if ros1 else self.types, encoding[0], self.definition.encode(), encoding[1])

    def new(self, name: str, *values, **named):
        return self.store.types["{}/msg/{}".format(*name.split("/"))](*values, **named)

    def header(self, stamp_ns: int = STAMP_NS):
        stamp = self.new("builtin_interfaces/Time", *divmod(stamp_ns, 10**9))
        return self.new("std_msgs/Header", *([7] if self.ros1 else []), stamp, "eye")

    def pack(self, message) -> bytes:
        write = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        return bytes(write(message, self.types))


@cache
def ros_writer(name: str, definition: str = "", ros1: bool = False) -> Ros:
    """The writer of a message type, made once: rosbags compiles code for each."""
    return Ros(name, definition, ros1)


def pixels(data: bytes) -> np.ndarray:
    return np.frombuffer(data, np.uint8)


def vision(layout: str, boxes) -> tuple[MessageType, bytes]:
    """Boxes of (centre x, y, width, height, theta, [(id, score)])."""
    ros = ros_writer("vision_msgs/Detection2DArray", VISION[layout], layout == "ros1")
    point = ros.new("geometry_msgs/Point", 0.0, 0.0, 0.0)
    pose = ros.new(
        "geometry_msgs/PoseWithCovariance",
        ros.new("geometry_msgs/Pose", point, ros.new("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0)),
        np.zeros(36),
    )
    found = []
    for x, y, w, h, theta, guesses in boxes:
        if layout == "v4":
            centre = ros.new("vision_msgs/Pose2D", ros.new("vision_msgs/Point2D", x, y), theta)
            results = [
                ros.new(
                    "vision_msgs/ObjectHypothesisWithPose", ros.new("vision_msgs/ObjectHypothesis", str(i), s), pose
                )
                for i, s in guesses
            ]
        else:
            centre = ros.new("geometry_msgs/Pose2D", x, y, theta)
            results = [
                ros.new("vision_msgs/ObjectHypothesisWithPose", i if layout == "ros1" else str(i), s, pose)
                for i, s in guesses
            ]
        bbox = ros.new("vision_msgs/BoundingBox2D", centre, w, h)
        last = ros.new("sensor_msgs/Image", ros.header(), 0, 0, "", 0, 0, pixels(b"")) if ros.ros1 else "name"
        found.append(ros.new("vision_msgs/Detection2D", ros.header(), results, bbox, last))
    return ros.kind, ros.pack(ros.new("vision_msgs/Detection2DArray", ros.header(), found))


def plain(message) -> object:
    """A message as a bridge writes it in JSON."""
    if isinstance(message, np.ndarray | list):
        return [plain(one) for one in message]
    fields = getattr(message, "__dataclass_fields__", None)
    if fields is None:
        return message.item() if isinstance(message, np.generic) else message
    names = [name for name, one in fields.items() if "ClassVar" not in str(one.type) and name != "__msgtype__"]
    return {name: plain(getattr(message, name)) for name in names}
