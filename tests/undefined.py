"""Messages of ROS in the layouts of its distributions, for recordings that don't define them: written by rosbags."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.logs import recorder

T0 = 1_700_000_000_000_000_000
_HYPOTHESIS = "geometry_msgs/PoseWithCovariance pose"
#: vision_msgs by its major version.
_VISION: dict[int, dict[str, str]] = {
    2: {
        "ObjectHypothesisWithPose": f"string id\nfloat64 score\n{_HYPOTHESIS}",
        "BoundingBox2D": "geometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
        "Detection2D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox2D bbox\nsensor_msgs/Image source_img\nbool is_tracking\nstring tracking_id",
    },
    3: {
        "ObjectHypothesis": "string class_id\nfloat64 score",
        "ObjectHypothesisWithPose": f"vision_msgs/ObjectHypothesis hypothesis\n{_HYPOTHESIS}",
        "BoundingBox2D": "geometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
        "Detection2D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox2D bbox\nstring id",
    },
    4: {
        "Point2D": "float64 x\nfloat64 y",
        "Pose2D": "vision_msgs/Point2D position\nfloat64 theta",
        "ObjectHypothesis": "string class_id\nfloat64 score",
        "ObjectHypothesisWithPose": f"vision_msgs/ObjectHypothesis hypothesis\n{_HYPOTHESIS}",
        "BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
        "Detection2D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox2D bbox\nstring id",
    },
}
_BOTH = {
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "Detection3D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox3D bbox\nstring id",
    "Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections",
    "Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
}
_OTHERS = {
    "foxglove_msgs/CompressedImage": "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format",
    "tf/tfMessage": "geometry_msgs/TransformStamped[] transforms",
}


@cache
def store_of(distribution: Stores) -> Any:
    """The types of a distribution, with those of packages that its users have."""
    store = get_typestore(distribution)
    older = {Stores.ROS2_DASHING: 2, Stores.ROS2_ELOQUENT: 2, Stores.ROS2_FOXY: 2, Stores.ROS2_GALACTIC: 3}
    vision = {f"vision_msgs/{name}": text for name, text in (_VISION[older.get(distribution, 4)] | _BOTH).items()}
    for name, text in (vision | _OTHERS).items():
        store.register(get_types_from_msg(text, "{}/msg/{}".format(*name.split("/"))))
    return store


def message(name: str, distribution: Stores = Stores.ROS2_HUMBLE) -> tuple[dict, list[bytes]]:
    """The types of a message, it first, and three messages of it with values in all fields."""
    store, ros2 = store_of(distribution), "{}/msg/{}".format(*name.split("/"))
    types: dict[str, Any] = {}
    missing = [ros2]
    while missing:
        wanted = missing.pop(0)
        if wanted not in types:
            types[wanted] = store.fielddefs[wanted]
            missing += [inner for _, kind in types[wanted][1] for inner in _names(kind)]
    return types, [bytes(store.serialize_cdr(_filled(store, (Nodetype.NAME, ros2), ""), ros2)) for _ in range(3)]


def _names(kind) -> list[str]:
    node, inner = kind
    return [inner] if node == Nodetype.NAME else [] if node == Nodetype.BASE else _names(inner[0])


#: Values of fields where the usual ones would make no picture, box or transform.
_VALUES = {
    "encoding": "mono8", "format": "png", "width": 2, "height": 1, "step": 2, "data": np.array([3, 4], np.uint8),
    "frame_id": "odom", "child_frame_id": "lidar", "type": 1, "action": 0, "w": 1.0, "z": 0.0, "theta": 0.0,
    "is_bigendian": 0, "distortion_model": "plumb_bob", "d": np.zeros(5), "size_x": 20.0, "points": [], "colors": [],
    "K": np.array([500.0, 0, 1, 0, 500, 1, 0, 0, 1]), "k": np.array([500.0, 0, 1, 0, 500, 1, 0, 0, 1]),
    "r": np.eye(3).ravel(), "p": np.eye(3, 4).ravel() * 500, "sec": 1_700_000_000, "class_id": "person", "id": None,
}  # fmt: skip


def _filled(store, kind, field: str):
    """A value of a type: small numbers, words, and one member in each list."""
    node, inner = kind
    usual = _VALUES.get(field)
    if usual is not None and isinstance(usual, np.ndarray | list) == (node in (Nodetype.ARRAY, Nodetype.SEQUENCE)):
        return usual
    if node == Nodetype.NAME:
        fields = [(name, _filled(store, each, name)) for name, each in store.fielddefs[inner][1]]
        if inner == "geometry_msgs/msg/Quaternion":
            fields = [("x", 0.0), ("y", 0.0), ("z", 0.0), ("w", 1.0)]
        return store.types[inner](**dict(fields))
    if node == Nodetype.BASE:
        return "word" if inner[0] == "string" else (1.5 if "float" in inner[0] else 1)
    member, count = inner
    if member[0] == Nodetype.BASE and member[1][0] != "string":
        dtype = {"bool": "bool_", "byte": "uint8", "char": "uint8"}.get(member[1][0], member[1][0])
        return np.ones(count if node == Nodetype.ARRAY else 2, getattr(np, dtype))
    return [_filled(store, member, "") for _ in range(count if node == Nodetype.ARRAY else 1)]


def names_no_definitions(types: dict) -> str:
    """The definition of the first of these types in the format of ROS, as a recording would have it."""
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store.generate_msgdef(next(iter(types)), ros_version=2)[0]


def package(folder: Path) -> tuple[Path, str, list[bytes]]:
    """A workspace with a package that changed a message of vision_msgs; the name of it, and messages."""
    changed = "std_msgs/Header header\nvision_msgs/Detection2D[] detections\nuint8[3] version\n"
    place = folder / "ws" / "src" / "vision_msgs" / "msg"
    place.mkdir(parents=True)
    (place / "Detection2DArray.msg").write_text(changed)
    name = "vision_msgs/msg/Detection2DArray"
    types, payloads = message("vision_msgs/Detection2DArray")
    del types
    return folder / "ws" / "src", name, [payload + bytes([1, 2, 3]) for payload in payloads]


def write_undefined(folder: Path) -> None:
    """A log of messages whose definition is that of the workspace ``src`` alone."""
    place, name, payloads = package(folder)
    place.rename(folder / "src")
    with recorder(folder / "bare.mcap", "ros2") as writer:
        channel = writer.add_channel("/t", (name, "ros2msg", b""), "cdr")
        for number, payload in enumerate(payloads):
            writer.add_message(channel, T0 + number, payload, T0)
