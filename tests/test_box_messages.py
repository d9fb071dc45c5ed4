"""Messages of 3D boxes, by the definitions that their packages publish, in every encoding that they exist in."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mcaptrack import log, notices
from mcaptrack.columns import Unsupported
from mcaptrack.contracts import Box3d
from mcaptrack.errors import McaptrackError
from mcaptrack.sources.fixed_frame import Recorded3d, named_detections
from mcaptrack.sources.foreign import MessageType
from mcaptrack.sources.foreign import things as things_of_messages
from mcaptrack.sources.foreign.boxes import choosing
from mcaptrack.sources.foreign.fields import Message3d, rotated
from tests.box_reading import boxes_of, boxes_of_each, recorded
from tests.logs import recorder
from tests.ros_messages import BAR, Ros, plain
from tests.space_logs import (
    SEEN,
    START_NS,
    covered,
    detection_3d_array,
    header,
    marker_array,
    point,
    pose,
    ros,
    scene_update,
    scene_update_json,
)
from tests.worlds import ns

ENCODINGS = ("ros1", "cdr", "json")

JSK = (
    "std_msgs/Header header\njsk_recognition_msgs/BoundingBox[] boxes\n"
    + BAR + "MSG: jsk_recognition_msgs/BoundingBox\nstd_msgs/Header header\ngeometry_msgs/Pose pose\n"
    "geometry_msgs/Vector3 dimensions  # size of bounding box (x, y, z)\nfloat32 value\nuint32 label\n"
)  # fmt: skip
KINDS = ("UNKNOWN", "UNKNOWN_SMALL", "UNKNOWN_MEDIUM", "UNKNOWN_BIG", "PEDESTRIAN", "BIKE", "CAR", "TRUCK", "MOTORCYCLE", "OTHER_VEHICLE", "BARRIER", "SIGN")  # fmt: skip
DERIVED = (
    "std_msgs/Header header\nderived_object_msgs/Object[] objects\n"
    + BAR + "MSG: derived_object_msgs/Object\nstd_msgs/Header header\nuint32 id\nuint8 detection_level\n"
    "uint8 OBJECT_DETECTED=0\nuint8 OBJECT_TRACKED=1\nbool object_classified\ngeometry_msgs/Pose pose\n"
    "geometry_msgs/Twist twist\ngeometry_msgs/Accel accel\ngeometry_msgs/Polygon polygon\nshape_msgs/SolidPrimitive shape\n"
    "uint8 classification\n" + "".join(f"uint8 CLASSIFICATION_{name}={n}\n" for n, name in enumerate(KINDS))
    + "uint8 classification_certainty\nuint32 classification_age\n"
)  # fmt: skip
#: The labels since November 2021, and before, when there was no bus.
LABELS = ("UNKNOWN", "CAR", "TRUCK", "BUS", "TRAILER", "MOTORCYCLE", "BICYCLE", "PEDESTRIAN", "ANIMAL", "HAZARD", "OVER_DRIVABLE", "UNDER_DRIVABLE")  # fmt: skip
FIRST_LABELS = ("UNKNOWN", "CAR", "TRUCK", "TRAILER", "MOTORCYCLE", "BICYCLE", "PEDESTRIAN")


def autoware(package: str, kind: str, labels: tuple[str, ...] = LABELS) -> str:
    """The definition of DetectedObjects or TrackedObjects."""
    own = "unique_identifier_msgs/UUID object_id\n" if kind == "Tracked" else ""
    motion = {
        "Detected": "bool has_position_covariance\nuint8 orientation_availability\n"
        "geometry_msgs/TwistWithCovariance twist_with_covariance\nbool has_twist\nbool has_twist_covariance\n",
        "Tracked": "geometry_msgs/TwistWithCovariance twist_with_covariance\n"
        "geometry_msgs/AccelWithCovariance acceleration_with_covariance\nuint8 orientation_availability\nbool is_stationary\n",
    }[kind]
    return (
        f"std_msgs/Header header\n{package}/{kind}Object[] objects\n"
        + BAR + f"MSG: {package}/{kind}Object\n{own}float32 existence_probability\n{package}/ObjectClassification[] classification\n"
        f"{package}/{kind}ObjectKinematics kinematics\n{package}/Shape shape\n"
        + BAR + f"MSG: {package}/ObjectClassification\n" + "".join(f"uint8 {name} = {n}\n" for n, name in enumerate(labels))
        + "uint8 label\nfloat32 probability\n"
        + BAR + f"MSG: {package}/{kind}ObjectKinematics\nuint8 UNAVAILABLE=0\nuint8 SIGN_UNKNOWN=1\nuint8 AVAILABLE=2\n"
        f"geometry_msgs/PoseWithCovariance pose_with_covariance\n{motion}"
        + BAR + f"MSG: {package}/Shape\nuint8 BOUNDING_BOX=0\nuint8 CYLINDER=1\nuint8 POLYGON=2\nuint8 type\n"
        "geometry_msgs/Polygon footprint\ngeometry_msgs/Vector3 dimensions\n"
    )  # fmt: skip


def read(writer: Ros, message, encoding: str) -> Message3d:
    """The boxes of a message; a writer of ROS 1 or ROS 2 made it."""
    if encoding != "json":
        return boxes_of(writer.kind, writer.pack(message))
    kind = MessageType(writer.kind.name, "jsonschema", b"{}", "json")
    return boxes_of(kind, json.dumps(plain(message)).encode())


def twist(writer: Ros, velocity):
    still = point(writer, [0, 0, 0], "Vector3")
    return writer.new("geometry_msgs/Twist", point(writer, velocity, "Vector3"), still)


# The same box by every family


def by_detections(layout: str) -> tuple[Ros, object]:
    writer, payload = detection_3d_array(layout, START_NS, [SEEN])
    name = "vision_msgs/msg/Detection3DArray"
    store = writer.store
    return writer, store.deserialize_ros1(payload, name) if writer.ros1 else store.deserialize_cdr(payload, name)


def by_markers(ros1: bool) -> tuple[Ros, object]:
    if not ros1:
        writer, payload = marker_array(START_NS, [SEEN])
        return writer, writer.store.deserialize_cdr(payload, "visualization_msgs/msg/MarkerArray")
    writer = ros("visualization_msgs/MarkerArray", ros1=True)
    colour = writer.new("std_msgs/ColorRGBA", 0.0, 0.0, 0.0, 1.0)
    lifetime = writer.new("builtin_interfaces/Duration", 0, 0)
    cube = writer.new(
        "visualization_msgs/Marker", header(writer, START_NS, "lidar"), SEEN.name, SEEN.number, 1, 0, pose(writer, SEEN),
        point(writer, SEEN.size, "Vector3"), colour, lifetime, False, [], [], str(SEEN.score), "", False,
    )  # fmt: skip
    return writer, writer.new("visualization_msgs/MarkerArray", [cube])


def bounding_box(writer: Ros, own, value: float, label: int):
    size = point(writer, SEEN.size, "Vector3")
    return writer.new("jsk_recognition_msgs/BoundingBox", own, pose(writer, SEEN), size, value, label)


def by_jsk(ros1: bool) -> tuple[Ros, object]:
    writer = ros("jsk_recognition_msgs/BoundingBoxArray", JSK, ros1)
    box = bounding_box(writer, header(writer, 0, ""), SEEN.score, 3)
    return writer, writer.new("jsk_recognition_msgs/BoundingBoxArray", header(writer, START_NS, "lidar"), [box])


def derived(
    writer: Ros, kind: int, lengths, label: int, certainty: int, level: int = 1, number: int = 12, velocity=(5, 6, 7)
):
    still = point(writer, [0, 0, 0], "Vector3")
    nothing = writer.new("geometry_msgs/Polygon", [])
    shape = writer.new("shape_msgs/SolidPrimitive", kind, np.array(lengths, float), *([] if writer.ros1 else [nothing]))
    return writer.new(
        "derived_object_msgs/Object", header(writer, 0, ""), number, level, True, pose(writer, SEEN),
        twist(writer, velocity), writer.new("geometry_msgs/Accel", still, still), nothing, shape, label, certainty, 9,
    )  # fmt: skip


def by_derived(ros1: bool) -> tuple[Ros, object]:
    writer = ros("derived_object_msgs/ObjectArray", DERIVED, ros1)
    objects = [derived(writer, 1, SEEN.size, 6, 51)]
    return writer, writer.new("derived_object_msgs/ObjectArray", header(writer, START_NS, "lidar"), objects)


class Autoware:
    """A writer of DetectedObjects or TrackedObjects."""

    def __init__(self, package: str, kind: str, labels: tuple[str, ...] = LABELS) -> None:
        self.package, self.kind = package, kind
        self.writer = ros(f"{package}/{kind}Objects", autoware(package, kind, labels))

    def new(self, name: str, *values):
        return self.writer.new(f"{self.package}/{name}", *values)

    def one(
        self, shape=0, footprint=(), size=SEEN.size, labels=((1, 0.5),), existence=0.5, known=2, uuid=b"", moves=True
    ):
        writer = self.writer
        corners = [writer.new("geometry_msgs/Point32", *map(float, corner)) for corner in footprint]
        form = self.new("Shape", shape, writer.new("geometry_msgs/Polygon", corners), point(writer, size, "Vector3"))
        guesses = [self.new("ObjectClassification", *guess) for guess in labels]
        moving, at = covered(writer, "Twist", twist(writer, [3, 0, 0])), covered(writer, "Pose", pose(writer, SEEN))
        if self.kind == "Detected":
            motion = self.new("DetectedObjectKinematics", at, False, known, moving, moves, False)
            return self.new("DetectedObject", existence, guesses, motion, form)
        still = point(writer, [0, 0, 0], "Vector3")
        accel = covered(writer, "Accel", writer.new("geometry_msgs/Accel", still, still))
        id_ = writer.new("unique_identifier_msgs/UUID", np.frombuffer(uuid.ljust(16, b"\0"), np.uint8))
        motion = self.new("TrackedObjectKinematics", at, moving, accel, known, False)
        return self.new("TrackedObject", id_, existence, guesses, motion, form)

    def message(self, *objects):
        return self.new(f"{self.kind}Objects", header(self.writer, START_NS, "lidar"), list(objects))


def by_autoware(package: str, kind: str) -> tuple[Ros, object]:
    writer = Autoware(package, kind)
    return writer.writer, writer.message(writer.one())


FAMILIES: Mapping[tuple[str, str], Callable[[], tuple[Ros, object]]] = {
    **{("detections of noetic", one): lambda: by_detections("ros1") for one in ("ros1", "json")},
    **{("detections of foxy", one): lambda: by_detections("v3") for one in ("cdr", "json")},
    **{("detections since humble", one): lambda: by_detections("v4") for one in ("cdr", "json")},
    **{("markers", one): lambda one=one: by_markers(one == "ros1") for one in ENCODINGS},
    **{("jsk", one): lambda one=one: by_jsk(one == "ros1") for one in ENCODINGS},
    **{("derived", one): lambda one=one: by_derived(one == "ros1") for one in ENCODINGS},
    **{
        (f"{package} {kind}", one): lambda package=package, kind=kind: by_autoware(package, kind)
        for package in ("autoware_perception_msgs", "autoware_auto_perception_msgs")
        for kind in ("Detected", "Tracked")
        for one in ("cdr", "json")
    },
}
#: What differs from a car of score .5 with the id 12.
DIFFERENT = {
    "detections of noetic": {"class_name": "2", "source_id": None},  # the number of a class, and no ids
    "jsk": {"class_name": "3", "source_id": None},
    "derived": {"score": 51 / 255, "velocity": (5, 6, 7)},
    "Detected": {"source_id": None, "velocity": (0, 3, 0)},
    "Tracked": {"source_id": "0" * 32, "velocity": (0, 3, 0)},
}


@pytest.mark.parametrize(("family", "encoding"), FAMILIES, ids="-".join)
def test_a_box_is_the_same_in_every_family_and_encoding(family, encoding):
    found = read(*FAMILIES[family, encoding](), encoding)
    (box,) = found.boxes
    different = DIFFERENT.get(family) or DIFFERENT.get(family.partition(" ")[2], {})
    wanted = {"class_name": "car", "score": 0.5, "source_id": 12, "velocity": (np.nan,) * 3} | different
    assert (box.stamp_ns, box.frame_id, box.has_heading) == (START_NS, "lidar", True)
    np.testing.assert_allclose(box.centre, SEEN.centre, atol=1e-6)
    np.testing.assert_allclose(box.orientation, SEEN.turn, atol=1e-6)
    np.testing.assert_allclose(box.size, SEEN.size, atol=1e-6)
    np.testing.assert_allclose(box.velocity, wanted["velocity"], atol=1e-6)
    assert box.score == pytest.approx(wanted["score"])
    assert str(box.source_id) == str(wanted["source_id"])
    assert box.class_name == wanted["class_name"]
    assert found.ignored == {}


def test_detections_that_state_their_pose_in_a_result_alone():
    def vectors(*values: float):
        return dict(zip("xyzw", values, strict=False))

    def one(centre, pose):
        bbox = {"center": {"position": vectors(*centre), "orientation": vectors(0, 0, 0, 0)}, "size": vectors(4, 2, 1)}
        guess = {"hypothesis": {"class_id": "car", "score": 0.5}}
        posed = {"pose": {"pose": {"position": vectors(*pose), "orientation": vectors(0, 0, 0, 1)}}}
        return {"header": head, "bbox": bbox, "results": [guess | posed]}

    head = {"stamp": {"sec": 1, "nanosec": 0}, "frame_id": "lidar"}
    boxes = [one((0, 0, 0), (7, 8, 9)), one((1, 0, 0), (7, 8, 9)), one((0, 0, 0), (0, 0, 0))]
    kind = MessageType("vision_msgs/msg/Detection3DArray", "jsonschema", b"{}", "json")
    found = boxes_of(kind, json.dumps({"header": head, "detections": boxes}).encode())
    assert [box.centre for box in found.boxes] == [(7, 8, 9), (1, 0, 0), (0, 0, 0)]
    assert [box.orientation for box in found.boxes] == [(0, 0, 0, 1), (0, 0, 0, 0), (0, 0, 0, 0)]


def test_a_field_that_is_missing_is_named():
    kind = MessageType("jsk_recognition_msgs/BoundingBoxArray", "jsonschema", b"{}", "json")
    with pytest.raises(McaptrackError, match=r"message \(it has no field 'stamp'\)$"):
        boxes_of(kind, b'{"header": {"frame_id": "a"}, "boxes": [{"pose": {"position": {"x": 1, "y": 2}}}]}')


def test_scenes_of_foxglove_are_the_same_in_all_encodings():
    protobuf = MessageType("foxglove.SceneUpdate", "protobuf", b"", "protobuf")
    wanted = boxes_of(protobuf, scene_update(START_NS, [SEEN]).SerializeToString())
    found = boxes_of(protobuf._replace(encoding="json"), scene_update_json(START_NS, [SEEN]))
    assert found.boxes == wanted.boxes
    assert wanted.boxes[0].source_id == "12"
    for ros1 in (False, True):
        writer = ros("foxglove_msgs/SceneUpdate", SCENE, ros1)
        stamp = writer.new("builtin_interfaces/Time", *divmod(START_NS, 10**9))
        cube = writer.new("foxglove_msgs/CubePrimitive", pose(writer, SEEN), point(writer, SEEN.size, "Vector3"))
        pairs = [writer.new("foxglove_msgs/KeyValuePair", *pair) for pair in (("class", "car"), ("score", "0.5"))]
        entity = writer.new("foxglove_msgs/SceneEntity", stamp, "lidar", "12", pairs, [cube])
        found = read(writer, writer.new("foxglove_msgs/SceneUpdate", [], [entity]), "ros")
        assert found.boxes == wanted.boxes


#: The fields of foxglove_msgs that hold boxes.
SCENE = (
    "foxglove_msgs/SceneEntityDeletion[] deletions\nfoxglove_msgs/SceneEntity[] entities\n"
    + BAR + "MSG: foxglove_msgs/SceneEntityDeletion\ntime timestamp\nuint8 type\nstring id\n"
    + BAR + "MSG: foxglove_msgs/SceneEntity\ntime timestamp\nstring frame_id\nstring id\n"
    "foxglove_msgs/KeyValuePair[] metadata\nfoxglove_msgs/CubePrimitive[] cubes\n"
    + BAR + "MSG: foxglove_msgs/KeyValuePair\nstring key\nstring value\n"
    + BAR + "MSG: foxglove_msgs/CubePrimitive\ngeometry_msgs/Pose pose\ngeometry_msgs/Vector3 size\n"
).replace("time timestamp", "builtin_interfaces/Time timestamp")  # fmt: skip


def unread_as_columns(*_) -> None:
    raise Unsupported("columns")


@pytest.mark.parametrize("is_damaged", [False, True])
@pytest.mark.parametrize("family", [of for of in FAMILIES if of[0] != "markers" and of[1] != "json"], ids="-".join)
def test_messages_of_a_batch_are_read_as_each_for_itself(monkeypatch, family, is_damaged):
    """All at once, as columns, or decoded one by one by rosbags. A damaged message costs itself."""
    writer, message = FAMILIES[family]()
    ((name, things),) = ((name, value) for name, value in vars(message).items() if isinstance(value, list))
    payloads = []
    for number in range(20):
        setattr(message, name, things * (number % 3))
        payloads.append(writer.pack(message))
    if is_damaged:
        payloads[13] = payloads[13][: len(payloads[13]) // 2]
    with monkeypatch.context() as patched:
        if not is_damaged:
            patched.setattr(things_of_messages, "decoder_with_errors", lambda *_: None)  # nothing is decoded
        at_once = boxes_of_each(writer.kind, payloads)
    monkeypatch.setattr(things_of_messages, "column_reader", unread_as_columns)
    assert boxes_of_each(writer.kind, payloads) == at_once
    assert [number for number, seen in enumerate(at_once) if seen is None] == [13] * is_damaged
    assert [len(seen.boxes) for seen in at_once if seen] == [number % 3 for number in range(20) if at_once[number]]


# What each family says beside


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_boxes_of_jsk_have_their_own_headers_and_no_score_of_zero(encoding):
    writer = ros("jsk_recognition_msgs/BoundingBoxArray", JSK, encoding == "ros1")
    stated = ((0, "", 0.75, 3), (START_NS + 5, "roof", 0.0, 0), (0, "roof", 0.5, 1))
    boxes = [bounding_box(writer, header(writer, stamp, own), value, label) for stamp, own, value, label in stated]
    message = writer.new("jsk_recognition_msgs/BoundingBoxArray", header(writer, START_NS, "lidar"), boxes)
    found = read(writer, message, encoding).boxes
    heads = [(START_NS, "lidar"), (START_NS + 5, "roof"), (START_NS, "roof")]
    assert [(box.stamp_ns, box.frame_id) for box in found] == heads
    assert [(box.class_name, box.source_id) for box in found] == [("3", None), ("0", None), ("1", None)]
    np.testing.assert_array_equal([box.score for box in found], [0.75, np.nan, 0.5])


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_derived_objects_have_a_shape_and_a_certainty_out_of_255_and_move_if_they_are_tracked(encoding):
    writer = ros("derived_object_msgs/ObjectArray", DERIVED, encoding == "ros1")
    objects = [
        derived(writer, *stated, number=40 + number)
        for number, stated in enumerate(
            [
                (1, [4.0, 2.0, 1.5], 6, 204), (3, [1.75, 0.25], 4, 255, 0), (2, [0.5], 0, 0), (0, [], 7, 100),
                (1, [1.0], 7, 1),
            ]
        )
    ]  # fmt: skip
    message = writer.new("derived_object_msgs/ObjectArray", header(writer, START_NS, "map"), objects)
    found = read(writer, message, encoding)
    sizes = [(4, 2, 1.5), (0.5, 0.5, 1.75), (1, 1, 1), *[(np.nan,) * 3] * 2]  # radars know no shape
    np.testing.assert_array_equal([box.size for box in found.boxes], sizes)
    assert [box.class_name for box in found.boxes] == ["car", "pedestrian", "", "truck", "truck"]
    np.testing.assert_allclose([box.score for box in found.boxes], [0.8, 1.0, np.nan, 100 / 255, 1 / 255])
    assert [box.source_id for box in found.boxes] == [40, 41, 42, 43, 44]
    moving = [[5, 6, 7], [np.nan] * 3, *[[5, 6, 7]] * 3]
    np.testing.assert_array_equal([box.velocity for box in found.boxes], moving)
    assert {box.centre for box in found.boxes} == {tuple(SEEN.centre)}
    assert found.ignored == {}


def test_points_are_turned_as_scipy_turns_them():
    turns, points = Rotation.random(9, random_state=1), np.random.default_rng(1).normal(size=(9, 3))
    for length in (1, 2):
        np.testing.assert_allclose(rotated(length * turns.as_quat(), points), turns.apply(points))


def test_derived_objects_without_a_shape_have_the_box_around_their_polygon():
    writer = ros("derived_object_msgs/ObjectArray", DERIVED)
    turn = Rotation.from_euler("z", 0.5)
    corners = turn.apply([(2, 1, 0), (2, -1, 0), (-2, -1, 0), (-2, 0.5, 0)]) + [7, 8, 0]
    one = derived(writer, 0, [], 6, 255)
    one.pose.orientation = point(writer, turn.as_quat(), "Quaternion")
    one.polygon.points = [point(writer, corner, "Point32") for corner in corners]
    message = writer.new("derived_object_msgs/ObjectArray", header(writer, START_NS, "map"), [one])
    (box,) = read(writer, message, "cdr").boxes
    np.testing.assert_allclose(box.size, [4, 2, np.nan], atol=1e-5)
    np.testing.assert_allclose(box.centre, [7, 8, 0], atol=1e-5)


@pytest.mark.parametrize("encoding", ["cdr", "json"])
@pytest.mark.parametrize("kind", ["Detected", "Tracked"])
def test_objects_of_autoware_have_the_likeliest_class_a_shape_and_a_velocity_along_their_axes(kind, encoding):
    made = Autoware("autoware_perception_msgs", kind)
    message = made.message(
        made.one(labels=((1, 0.25), (7, 0.75)), existence=0.9, uuid=b"b"),
        made.one(1, size=np.array([0.5, 0, 1.75]), labels=((5, np.nan), (6, 0.5)), existence=0.0, known=0, uuid=b"a"),
        made.one(2, [(-1, -1, 0), (3, -1, 0), (3, 1, 0), (0, 1, 0)], labels=(), uuid=b"b", moves=False),
    )
    found = read(made.writer, message, encoding)
    assert [box.class_name for box in found.boxes] == ["pedestrian", "bicycle", ""]
    np.testing.assert_allclose([box.score for box in found.boxes], [0.9, 0.5, 0.5], atol=1e-6)
    assert [box.has_heading for box in found.boxes] == [True, False, True]
    # The axes of the object are turned by 90 degrees: x is ahead to y.
    last = [np.nan] * 3 if kind == "Detected" else [0, 3, 0]
    np.testing.assert_allclose([box.velocity for box in found.boxes], [[0, 3, 0], [0, 3, 0], last], atol=1e-12)
    assert [box.size for box in found.boxes] == [(4, 2, 1.5), (0.5, 0.5, 1.75), (4, 2, 1.5)]
    np.testing.assert_allclose([box.centre for box in found.boxes], [[1, 2, 3], [1, 2, 3], [1, 3, 3]], atol=1e-12)
    ids = recorded([(START_NS, found)]).source_id.tolist()
    assert ids == ([1, 0, 1] if kind == "Tracked" else [-1, -1, -1])


def test_classes_have_the_numbers_of_the_recorded_definition():
    """The first definitions had no bus, so that a pedestrian was 6."""
    made = Autoware("autoware_auto_perception_msgs", "Detected", FIRST_LABELS)
    objects = [made.one(labels=((number, 1.0),)) for number in range(9)]
    found = read(made.writer, made.message(*objects), "cdr")
    names = ["", "car", "truck", "trailer", "motorcycle", "bicycle", "pedestrian", "7", "8"]
    assert [box.class_name for box in found.boxes] == names
    writer = ros("derived_object_msgs/ObjectArray", DERIVED.replace("CLASSIFICATION_SIGN=11", "CLASSIFICATION_TRAM=11"))
    objects = [derived(writer, 1, SEEN.size, number, 9) for number in (0, 1, 5, 10, 11)]
    message = writer.new("derived_object_msgs/ObjectArray", header(writer, START_NS, "map"), objects)
    names = ["", "unknown_small", "bike", "barrier", "tram"]
    assert [box.class_name for box in read(writer, message, "cdr").boxes] == names
    assert [box.class_name for box in read(writer, message, "json").boxes] == [*names[:-1], "sign"]


IDL = """IDL: {package}/msg/DetectedObjects
module {package} {{ module msg {{ struct DetectedObjects {{
  std_msgs::msg::Header header; sequence<{package}::msg::DetectedObject> objects; }}; }}; }};
{bar}IDL: {package}/msg/DetectedObject
module {package} {{ module msg {{ struct DetectedObject {{
  float existence_probability; sequence<{package}::msg::ObjectClassification> classification;
  {package}::msg::DetectedObjectKinematics kinematics; {package}::msg::Shape shape; }}; }}; }};
{bar}IDL: {package}/msg/ObjectClassification
module {package} {{ module msg {{
  module ObjectClassification_Constants {{ {labels} }};
  struct ObjectClassification {{ uint8 label; @range (min=0.0, max=1.0) float probability; }}; }}; }};
{bar}IDL: {package}/msg/DetectedObjectKinematics
module {package} {{ module msg {{ struct DetectedObjectKinematics {{
  geometry_msgs::msg::PoseWithCovariance pose_with_covariance; boolean has_position_covariance;
  uint8 orientation_availability; geometry_msgs::msg::TwistWithCovariance twist_with_covariance;
  boolean has_twist; boolean has_twist_covariance; }}; }}; }};
{bar}IDL: {package}/msg/Shape
module {package} {{ module msg {{ struct Shape {{
  uint8 type; geometry_msgs::msg::Polygon footprint; geometry_msgs::msg::Vector3 dimensions; }}; }}; }};
"""


def test_definitions_in_idl_have_their_constants_in_a_module_beside():
    package = "autoware_auto_perception_msgs"
    made = Autoware(package, "Detected", FIRST_LABELS)
    labels = " ".join(f"const uint8 {name} = {number};" for number, name in enumerate(FIRST_LABELS))
    text = BAR + IDL.format(package=package, bar=BAR, labels=labels)
    kind = made.writer.kind._replace(schema_encoding="ros2idl", schema=text.encode())
    objects = [made.one(labels=((number, 1.0),)) for number in (1, 3, 6)]
    found = boxes_of(kind, made.writer.pack(made.message(*objects)))
    assert [box.class_name for box in found.boxes] == ["car", "trailer", "pedestrian"]
    assert found.boxes[0].velocity == pytest.approx((0, 3, 0))


# Messages with one box each, or several messages of one sweep, become frames


FIRST_NS, MS = 1_700_000_000_000_000_000, 1_000_000
OBJECTS, SWEEPS, PERIOD_MS = 12, 20, 100
RNG = np.random.default_rng(5)
PLACES = RNG.uniform(-40, 40, (OBJECTS, 2))
SPEEDS = RNG.normal(0, 4, (OBJECTS, 2))


def scattered(stamp_ms, late_ms=lambda sweep, number: 40.0, objects: int = OBJECTS, missed: float = 0.1) -> Recorded3d:
    """Objects that move, a message for each of them in each sweep, ``stamp_ms`` after the beginning of the sweep."""
    rng, messages = np.random.default_rng(6), []
    for sweep in range(SWEEPS):
        for number in range(objects):
            if rng.random() < missed:
                continue
            after_ms = stamp_ms(rng, number)
            stamp_ns = FIRST_NS + round((PERIOD_MS * sweep + after_ms) * MS)
            x, y = PLACES[number] + SPEEDS[number] * (PERIOD_MS * sweep + after_ms) / 1000
            box = Box3d(stamp_ns, "lidar", (x, y, 0.0), (0.0, 0.0, 0.0, 1.0), (4.0, 2.0, 1.5), "car", 0.5, number)
            log_ns = FIRST_NS + round((PERIOD_MS * sweep + late_ms(sweep, number)) * MS)
            messages.append((log_ns, Message3d(stamp_ns, [box])))
    return recorded(sorted(messages, key=lambda one: one[0]))


@pytest.mark.parametrize(
    ("stamp_ms", "late_ms"),
    [
        (lambda rng, number: 2.0 * number, lambda sweep, number: 40 + number),
        (lambda rng, number: rng.uniform(0, 15), lambda sweep, number: 40.0),
        (lambda rng, number: 5.0 * number, lambda sweep, number: 70.0),
        # The stamps of a lidar that turns have no gaps, but the messages are written in a burst.
        (lambda rng, number: rng.uniform(0, 99), lambda sweep, number: 140 + 0.2 * number),
    ],
    ids=["steps", "noise", "most of a turn", "bursts"],
)
def test_a_message_for_each_object_with_its_own_stamp_is_gathered_to_sweeps(stamp_ms, late_ms):
    found = scattered(stamp_ms, late_ms)
    starts, frame, words = found.frames()
    assert f"gathered to {SWEEPS} frames" in words
    assert len(starts) == SWEEPS
    assert (np.diff(starts) > 0).all()
    sweep = ((found.stamp_ns - FIRST_NS) // (PERIOD_MS * MS)).tolist()
    assert frame.tolist() == sweep
    for number in range(SWEEPS):  # the time is one of a box
        assert starts[number] in found.stamp_ns[frame == number]


@pytest.mark.parametrize(
    ("stamp_ms", "objects"),
    [
        (lambda rng, number: 0.0, OBJECTS),  # one stamp: a frame without a word
        (lambda rng, number: 0.0, 1),
        (lambda rng, number: rng.uniform(0, 40), 1),  # one object: each message is a frame
    ],
)
def test_frames_that_are_known_are_not_gathered(stamp_ms, objects):
    found = scattered(stamp_ms, objects=objects)
    starts, _, words = found.frames()
    assert words == ""
    assert len(starts) == len(np.unique(found.stamp_ns))


def test_an_object_that_is_seen_twice_at_a_time_is_no_sweep():
    """Pairs of frames with a pause between pairs: objects are in both frames of a pair."""
    messages = []
    for frame in range(40):
        stamp_ns = FIRST_NS + (200 * (frame // 2) + 40 * (frame % 2)) * MS
        boxes = []
        for place, speed in zip(PLACES, SPEEDS, strict=True):
            x, y = place + speed * (stamp_ns - FIRST_NS) / 1e9
            boxes.append(Box3d(stamp_ns, "lidar", (x, y, 0.0), (0.0, 0.0, 0.0, 1.0), (4.0, 2.0, 1.5), "car", 0.5))
        messages.append((stamp_ns, Message3d(stamp_ns, boxes)))
    starts, _, words = recorded(messages).frames()
    assert (len(starts), words) == (40, "")


def test_boxes_without_a_sign_of_sweeps_are_frames_of_their_own_aloud():
    def written(sweep: int, number: int) -> float:
        return 140 + 99 * number / OBJECTS

    found = scattered(lambda rng, number: 99 * number / OBJECTS, written, missed=0.0)
    starts, _, words = found.frames()
    assert len(starts) == SWEEPS * OBJECTS
    assert words == "messages have one box each, and their times don't show which are of one sweep: each is a frame"


# Boxes in pictures of other software are at the times of the pictures that they were found in


COUNT = 20
#: Pictures are logged so much later than they were taken, and boxes so much later again.
LATE_S, FOUND_S = 0.03, 0.25
START_S = 1_000.0


def stamp(seconds: float) -> dict[str, dict[str, dict[str, int]]]:
    whole, nanos = divmod(ns(seconds), 10**9)
    return {"header": {"stamp": {"sec": whole, "nanosec": nanos}}}


def taken_s(number: int) -> float:
    return START_S + number / 10


def written(path: Path, stamps, pictures=range(COUNT), header="header", data="YQ==") -> Path:
    """A log with pictures of these numbers, and boxes with these stamps, by their numbers."""
    box = {"center": {"position": {"x": 50, "y": 50}}, "size_x": 20, "size_y": 60}
    messages = [
        (ns(taken_s(number) + LATE_S), 0, {"timestamp": stamp(taken_s(number))["header"]["stamp"], "format": "jpeg"})
        for number in pictures
    ]
    for number in range(COUNT):
        about = stamp(stamps(number))["header"] if stamps(number) is not None else {}
        message = {header: about, "detections": [{"bbox": box, "results": []}] * number}
        messages.append((ns(taken_s(number) + LATE_S + FOUND_S), 1, message))
    with recorder(path) as writer:
        ids = []
        for topic, name in (("/cam/image", "foxglove.CompressedImage"), ("/cam/boxes", "vision_msgs/Detection2DArray")):
            schema = writer.register_schema(name, "jsonschema", b"{}")
            ids.append(writer.register_channel(topic, "json", schema))
        for t_ns, which, message in sorted(messages, key=lambda one: one[0]):
            whole = {"data": data, **message} if which == 0 else message
            writer.add_message(ids[which], t_ns, json.dumps(whole).encode(), t_ns)
    return path


def times_of(path: Path) -> tuple[dict[int, int], list[notices.Notice]]:
    """The time of each message by its number of boxes, and what is warned of."""
    with log.read(path) as opened, notices.collected() as said:
        frames = named_detections(opened, "/cam/boxes").frames
    assert [frame.t_ns for frame in frames] == sorted(frame.t_ns for frame in frames)
    return {len(frame.rows): frame.t_ns for frame in frames}, said


@pytest.mark.parametrize(
    "how", [{}, {"header": "image_header"}, {"pictures": [number for number in range(COUNT) if number % 3]}]
)
def test_boxes_are_at_the_time_of_their_picture_also_if_it_was_not_recorded(tmp_path, how):
    times, said = times_of(written(tmp_path / "a.mcap", taken_s, **how))
    assert times == {number: ns(taken_s(number) + LATE_S) for number in range(COUNT)}
    assert said == []


def test_pictures_that_cant_be_read_cost_no_boxes(tmp_path):
    assert times_of(written(tmp_path / "a.mcap", taken_s, data="?"))[0] == {
        number: ns(taken_s(number) + LATE_S + FOUND_S) for number in range(COUNT)
    }


@pytest.mark.parametrize("pictures", [range(COUNT), ()])
@pytest.mark.parametrize(("stamps", "words"), [(lambda n: None, ""), (lambda n: taken_s(n) + 0.01, "0.27 s after")])
def test_other_boxes_are_at_their_log_times_and_that_is_said(tmp_path, stamps, words, pictures):
    times, said = times_of(written(tmp_path / "a.mcap", stamps, pictures=pictures))
    assert times == {number: ns(taken_s(number) + LATE_S + FOUND_S) for number in range(COUNT)}
    assert [(notice.code, words in notice.message) for notice in said] == ([("clock", True)] if words else [])


# Boxes against the pictures that they are about


SIZE = (320, 240)


def with_boxes(path: Path, box: dict, pictures: bool, calibrated: bool = False) -> Path:
    """A log with boxes of one kind, and pictures of 320 x 240 or the calibration of a camera with these."""
    png = base64.b64encode(cv2.imencode(".png", np.zeros(SIZE[::-1], np.uint8))[1].tobytes()).decode()
    with recorder(path) as writer:
        boxes, images, lens = (
            writer.add_channel(topic, (name, "jsonschema", b"{}"))
            for topic, name in (
                ("/cam/boxes", "vision_msgs/Detection2DArray"),
                ("/cam/image", "foxglove.CompressedImage"),
                ("/cam/camera_info", "sensor_msgs/CameraInfo"),
            )
        )
        for number in range(COUNT):
            about = stamp(taken_s(number))["header"]
            t_ns = ns(taken_s(number))
            message = {"header": about, "detections": [{"bbox": box, "results": []}]}
            writer.add_message(boxes, t_ns, json.dumps(message).encode(), t_ns)
            if pictures:
                image = {"timestamp": about["stamp"], "format": "png", "data": png}
                writer.add_message(images, t_ns, json.dumps(image).encode(), t_ns)
            if calibrated:
                writer.add_message(lens, t_ns, json.dumps({"width": SIZE[0], "height": SIZE[1]}).encode(), t_ns)
    return path


SHARES = {"center": {"position": {"x": 0.5, "y": 0.5}}, "size_x": 0.1, "size_y": 0.5}


@pytest.mark.parametrize("way", ["pictures", "calibrated", "map"])
def test_boxes_in_shares_are_scaled_by_the_size_of_their_pictures(way, tmp_path):
    path = with_boxes(tmp_path / "a.mcap", SHARES, way == "pictures", way == "calibrated")
    chosen = "picture=320x240" if way == "map" else None
    with log.read(path) as opened, notices.collected() as said, choosing("/cam/boxes", chosen, None):
        found = named_detections(opened, "/cam/boxes")
    assert [list(row)[:4] for row in found.frames[0].rows] == [[144, 60, 32, 120]]
    assert [notice.code for notice in said] == ["units"]
    assert found.facts["scale"] == "shares of 320x240"


def test_boxes_in_shares_of_unknown_pictures_are_refused_with_the_way(tmp_path):
    path = with_boxes(tmp_path / "a.mcap", SHARES, pictures=False)
    with log.read(path) as opened, pytest.raises(McaptrackError, match=r"shares of a picture.*`map='picture="):
        named_detections(opened, "/cam/boxes")


@pytest.mark.parametrize(("scale", "codes"), [(1.0, []), (2.0, ["outside"])])
def test_boxes_of_pictures_of_another_size_are_said(scale, codes, tmp_path):
    box = {"center": {"position": {"x": 250 * scale, "y": 180 * scale}}, "size_x": 40 * scale, "size_y": 90 * scale}
    path = with_boxes(tmp_path / "a.mcap", box, pictures=True)
    with log.read(path) as opened, notices.collected() as said:
        found = named_detections(opened, "/cam/boxes")
    assert [notice.code for notice in said] == codes
    assert found.facts["scale"] == "pixels"
