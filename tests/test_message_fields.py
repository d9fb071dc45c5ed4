"""Messages of other packages, by the definitions that they publish: places, ids, classes and scores are those set."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import collected
from mcaptrack.sources import foreign
from mcaptrack.sources.fixed_frame import named_detections
from mcaptrack.sources.foreign.boxes import choosing, read_classes
from tests.logs import recorder
from tests.ros_messages import BAR, Ros, plain
from tests.tiers import one_in

START_NS = 1_700_000_000_000_000_000
HEAD = {"stamp": {"sec": 1_700_000_000, "nanosec": 0}, "frame_id": "map"}


def package(name: str, **types: str) -> str:
    """The definition of a message: the first of ``types``, followed by the others."""
    first, *others = types.items()
    own = {key: text for key, text in types.items() if "/" not in key}

    def whole(text: str) -> str:
        lines = [line.split() for line in text.replace("; ", "\n").splitlines() if line.strip()]
        return "".join(f"{name + '/' if words[0].split('[')[0] in own else ''}{' '.join(words)}\n" for words in lines)

    return whole(first[1]) + "".join(BAR + f"MSG: {name}/{key}\n" + whole(text) for key, text in others)


HYPOTHESIS = BAR + "MSG: vision_msgs/ObjectHypothesis\nstring class_id\nfloat64 score\n"
BOX_2D = (
    BAR + "MSG: vision_msgs/BoundingBox2D\nvision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n"
    + BAR + "MSG: vision_msgs/Pose2D\nvision_msgs/Point2D position\nfloat64 theta\n"
    + BAR + "MSG: vision_msgs/Point2D\nfloat64 x\nfloat64 y\n"
)  # fmt: skip
WITH_POSE = (
    BAR + "MSG: vision_msgs/ObjectHypothesisWithPose\nvision_msgs/ObjectHypothesis hypothesis\n"
    "geometry_msgs/PoseWithCovariance pose\n" + HYPOTHESIS
)  # fmt: skip
DETECTION_2D = (
    BAR + "MSG: vision_msgs/Detection2D\nstd_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox2D bbox\nstring id\n"
)  # fmt: skip
ZED = package(
    "zed_msgs",
    ObjectsStamped="std_msgs/Header header; Object[] objects",
    Object="string label; int16 label_id; string sublabel; float32 confidence; float32[3] position; "
    "float32[6] position_covariance; float32[3] velocity; bool tracking_available; int8 tracking_state; "
    "int8 action_state; BoundingBox2Di bounding_box_2d; BoundingBox3D bounding_box_3d; float32[3] dimensions_3d; "
    "bool skeleton_available; int8 body_format; BoundingBox2Df head_bounding_box_2d; "
    "BoundingBox3D head_bounding_box_3d; float32[3] head_position; Skeleton2D skeleton_2d; Skeleton3D skeleton_3d",
    BoundingBox2Di="Keypoint2Di[4] corners",
    BoundingBox2Df="Keypoint2Df[4] corners",
    BoundingBox3D="Keypoint3D[8] corners",
    Keypoint2Di="uint32[2] kp",
    Keypoint2Df="float32[2] kp",
    Keypoint3D="float32[3] kp",
    Skeleton2D="Keypoint2Df[70] keypoints",
    Skeleton3D="Keypoint3D[70] keypoints",
)
YOLO = {
    name: package(
        name,
        DetectionArray="std_msgs/Header header; Detection[] detections",
        Detection="int32 class_id; string class_name; float64 score; string id; BoundingBox2D bbox; "
        "BoundingBox3D bbox3d; Mask mask; KeyPoint2DArray keypoints; KeyPoint3DArray keypoints3d",
        BoundingBox2D="Pose2D center; Vector2 size",
        Pose2D="Point2D position; float64 theta",
        Point2D="float64 x; float64 y",
        Vector2="float64 x; float64 y",
        BoundingBox3D="geometry_msgs/Pose center; geometry_msgs/Vector3 size; string frame_id",
        Mask="int32 height; int32 width; Point2D[] data",
        KeyPoint2DArray="KeyPoint2D[] data",
        KeyPoint2D="int32 id; Point2D point; float64 score",
        KeyPoint3DArray="KeyPoint3D[] data; string frame_id",
        KeyPoint3D="int32 id; geometry_msgs/Point point; float64 score",
    )
    for name in ("yolo_msgs", "yolov8_msgs")
}
FACES = package(
    "opencv_apps",
    FaceArrayStamped="std_msgs/Header header; Face[] faces",
    Face="Rect face; Rect[] eyes; string label; float64 confidence",
    Rect="float64 x; float64 y; float64 width; float64 height",
)
RECTS = package(
    "opencv_apps",
    RectArrayStamped="std_msgs/Header header; Rect[] rects",
    Rect="float64 x; float64 y; float64 width; float64 height",
)
PERSON = "string name; geometry_msgs/Point position; geometry_msgs/Point velocity; float64 reliability; "

DEFINITIONS = {
    "people_msgs/People": package(
        "people_msgs",
        People="std_msgs/Header header; Person[] people",
        Person=PERSON + "string[] tagnames; string[] tags",
    ),
    "people_msgs/PositionMeasurementArray": package(
        "people_msgs",
        PositionMeasurementArray="std_msgs/Header header; PositionMeasurement[] people; float32[] cooccurrence",
        PositionMeasurement="std_msgs/Header header; string name; string object_id; geometry_msgs/Point pos; "
        "float64 reliability; float64[9] covariance; int8 initialization",
    ),
    "spencer_tracking_msgs/TrackedPersons": package(
        "spencer_tracking_msgs",
        TrackedPersons="std_msgs/Header header; TrackedPerson[] tracks",
        TrackedPerson="uint64 track_id; bool is_occluded; bool is_matched; uint64 detection_id; float64 age; "
        "geometry_msgs/PoseWithCovariance pose; geometry_msgs/TwistWithCovariance twist",
    ),
    "spencer_tracking_msgs/DetectedPersons": package(
        "spencer_tracking_msgs",
        DetectedPersons="std_msgs/Header header; DetectedPerson[] detections",
        DetectedPerson="uint64 detection_id; float64 confidence; geometry_msgs/PoseWithCovariance pose; string modality",
    ),
    "leg_tracker/PersonArray": package(
        "leg_tracker",
        PersonArray="std_msgs/Header header; Person[] people",
        Person="geometry_msgs/Pose pose; uint32 id",
    ),
    "leg_tracker/LegArray": package(
        "leg_tracker",
        LegArray="std_msgs/Header header; Leg[] legs",
        Leg="geometry_msgs/Point position; float32 confidence",
    ),
    "radar_msgs/RadarTracks": package(
        "radar_msgs",
        RadarTracks="std_msgs/Header header; RadarTrack[] tracks",
        RadarTrack="uint16 track_id; geometry_msgs/Point position; geometry_msgs/Vector3 velocity; "
        "geometry_msgs/Vector3 acceleration; geometry_msgs/Vector3 size; string classification",
    ),
    "autoware_perception_msgs/DynamicObjectArray": package(
        "autoware_perception_msgs",
        DynamicObjectArray="std_msgs/Header header; DynamicObject[] objects",
        DynamicObject="unique_identifier_msgs/UUID id; Semantic semantic; State state; Shape shape",
        Semantic="uint8 UNKNOWN=0; uint8 CAR=1; uint8 PEDESTRIAN=6; uint32 type; float64 confidence",
        State="geometry_msgs/PoseWithCovariance pose_covariance; bool orientation_reliable; "
        "geometry_msgs/TwistWithCovariance twist_covariance; bool twist_reliable",
        Shape="uint8 type; geometry_msgs/Vector3 dimensions; geometry_msgs/Polygon footprint",
    )
    + BAR
    + "MSG: unique_identifier_msgs/UUID\nuint8[16] uuid\n",
    # Laid out as osi3.GroundTruth of the Open Simulation Interface.
    "osi_msgs/GroundTruth": package(
        "osi_msgs",
        GroundTruth="std_msgs/Header header; StationaryObject[] stationary_object; MovingObject[] moving_object",
        StationaryObject="Identifier id; BaseStationary base",
        MovingObject="uint8 TYPE_UNKNOWN=0; uint8 TYPE_PERSON=1; uint8 TYPE_VEHICLE=2; "
        "Identifier id; BaseMoving base; uint8 type",
        Identifier="uint64 value",
        BaseStationary="Dimension3d dimension; geometry_msgs/Vector3 position; Orientation3d orientation",
        BaseMoving="Dimension3d dimension; geometry_msgs/Vector3 position; Orientation3d orientation; "
        "geometry_msgs/Vector3 velocity",
        Dimension3d="float64 length; float64 width; float64 height",
        Orientation3d="float64 roll; float64 pitch; float64 yaw",
    ),
    "obstacle_detector/Obstacles": package(
        "obstacle_detector",
        Obstacles="std_msgs/Header header; SegmentObstacle[] segments; CircleObstacle[] circles",
        SegmentObstacle="geometry_msgs/Point first_point; geometry_msgs/Point last_point",
        CircleObstacle="geometry_msgs/Point center; geometry_msgs/Vector3 velocity; float64 radius; "
        "float64 true_radius",
    ),
    "zed_msgs/ObjectsStamped": ZED,
    "zed_interfaces/ObjectsStamped": ZED.replace("zed_msgs", "zed_interfaces"),
    "depthai_ros_msgs/SpatialDetectionArray": package(
        "depthai_ros_msgs",
        SpatialDetectionArray="std_msgs/Header header; SpatialDetection[] detections",
        SpatialDetection="vision_msgs/ObjectHypothesis[] results; vision_msgs/BoundingBox2D bbox; "
        "geometry_msgs/Point position; bool is_tracking; string tracking_id",
    )
    + HYPOTHESIS
    + BOX_2D,
    "depthai_ros_msgs/TrackDetection2DArray": package(
        "depthai_ros_msgs",
        TrackDetection2DArray="std_msgs/Header header; TrackDetection2D[] detections",
        TrackDetection2D="vision_msgs/ObjectHypothesisWithPose[] results; vision_msgs/BoundingBox2D bbox; "
        "bool is_tracking; string tracking_id; int32 tracking_age; int32 tracking_status",
    )
    + WITH_POSE
    + BOX_2D,
    "ultralytics_ros/YoloResult": "std_msgs/Header header\nvision_msgs/Detection2DArray detections\n"
    "sensor_msgs/Image[] masks\n" + BAR + "MSG: vision_msgs/Detection2DArray\nstd_msgs/Header header\n"
    "vision_msgs/Detection2D[] detections\n" + DETECTION_2D + WITH_POSE + BOX_2D,
    "darknet_ros_msgs/BoundingBoxes": package(
        "darknet_ros_msgs",
        BoundingBoxes="std_msgs/Header header; std_msgs/Header image_header; BoundingBox[] bounding_boxes",
        BoundingBox="float64 probability; int64 xmin; int64 ymin; int64 xmax; int64 ymax; int16 id; string class_id",
    ),
    "object_msgs/ObjectsInBoxes": package(
        "object_msgs",
        ObjectsInBoxes="std_msgs/Header header; ObjectInBox[] objects_vector; float32 inference_time_ms",
        ObjectInBox="Object object; sensor_msgs/RegionOfInterest roi",
        Object="string object_name; float32 probability",
    ),
    "hri_msgs/NormalizedRegionOfInterest2D": "std_msgs/Header header\nfloat32 xmin\nfloat32 ymin\nfloat32 xmax\n"
    "float32 ymax\nfloat32 c\n",
    "opencv_apps/FaceArrayStamped": FACES,
    "opencv_apps/RectArrayStamped": RECTS,
    "yolo_msgs/DetectionArray": YOLO["yolo_msgs"],
    "yolov8_msgs/DetectionArray": YOLO["yolov8_msgs"],
    "autoware_perception_msgs/PredictedObjects": package(
        "autoware_perception_msgs",
        PredictedObjects="std_msgs/Header header; PredictedObject[] objects",
        PredictedObject="unique_identifier_msgs/UUID object_id; float32 existence_probability; "
        "ObjectClassification[] classification; PredictedObjectKinematics kinematics; Shape shape",
        ObjectClassification="uint8 UNKNOWN=0; uint8 CAR=1; uint8 PEDESTRIAN=7; uint8 label; float32 probability",
        PredictedObjectKinematics="geometry_msgs/PoseWithCovariance initial_pose_with_covariance; "
        "geometry_msgs/TwistWithCovariance initial_twist_with_covariance; "
        "geometry_msgs/AccelWithCovariance initial_acceleration_with_covariance; PredictedPath[] predicted_paths",
        PredictedPath="geometry_msgs/Pose[] path; float32 confidence",
        Shape="uint8 type; geometry_msgs/Polygon footprint; geometry_msgs/Vector3 dimensions",
    )
    + BAR
    + "MSG: unique_identifier_msgs/UUID\nuint8[16] uuid\n",
    "tier4_perception_msgs/DetectedObjectsWithFeature": package(
        "tier4_perception_msgs",
        DetectedObjectsWithFeature="std_msgs/Header header; DetectedObjectWithFeature[] feature_objects",
        DetectedObjectWithFeature="DetectedObject object; Feature feature",
        Feature="sensor_msgs/PointCloud2 cluster; sensor_msgs/RegionOfInterest roi",
        DetectedObject="float32 existence_probability; ObjectClassification[] classification; "
        "DetectedObjectKinematics kinematics; Shape shape",
        ObjectClassification="uint8 UNKNOWN=0; uint8 CAR=1; uint8 PEDESTRIAN=7; uint8 label; float32 probability",
        DetectedObjectKinematics="geometry_msgs/PoseWithCovariance pose_with_covariance; bool has_position_covariance; "
        "uint8 orientation_availability; geometry_msgs/TwistWithCovariance twist_with_covariance; bool has_twist; "
        "bool has_twist_covariance",
        Shape="uint8 type; geometry_msgs/Polygon footprint; geometry_msgs/Vector3 dimensions",
    ),
    # Not known by name: nobody published it.
    "lab_msgs/WalkerList": package(
        "lab_msgs",
        WalkerList="std_msgs/Header header; Walker[] walkers",
        Walker="int32 uid; float32 pos_x; float32 pos_y; float32 vx; float32 vy; float32 yaw; float32 likelihood",
    ),
    "lab_msgs/SeenObjects": package(
        "lab_msgs",
        SeenObjects="std_msgs/Header header; Seen[] objects",
        Seen="uint8 TYPE_UNKNOWN=0; uint8 TYPE_PERSON=1; uint8 TYPE_DOG=2; uint8 type; geometry_msgs/PoseStamped pose; "
        "Extent dimensions; float32 confidence",
        Extent="float32 length; float32 width; float32 height",
    ),
    "lab_msgs/Boxes": package(
        "lab_msgs",
        Boxes="std_msgs/Header header; Item[] items",
        Item="string label; float32 score; sensor_msgs/RegionOfInterest roi",
    ),
}
AT = {"x": 1.5, "y": -2.25, "z": 0.75}
POSE = {"position": AT, "orientation": {"x": 0.0, "y": 0.0, "z": np.sqrt(0.5), "w": np.sqrt(0.5)}}
FAST = {"x": 0.5, "y": 0.25, "z": 0.0}
SIZE = {"x": 0.5, "y": 0.25, "z": 1.75}
MIDDLE = {"center": {"position": {"x": 32.0, "y": 115.0}, "theta": 0.0}, "size_x": 24.0, "size_y": 70.0}
SURE = [{"class_id": "dog", "score": 0.25}, {"class_id": "person", "score": 0.75}]
SURE_POSED = [{"hypothesis": guess} for guess in SURE]
ROI = {"x_offset": 20, "y_offset": 80, "width": 24, "height": 70}
CORNERS = {"corners": [{"kp": kp} for kp in ([20, 80], [44, 80], [44, 150], [20, 150])]}

#: A thing as each type states it, in what list, and what its row is beyond the place that all of them have.
IN_SPACE = {
    "people_msgs/People": ("people", {"name": "7", "position": AT, "velocity": FAST, "reliability": 0.75}, "id score v"),
    "people_msgs/PositionMeasurementArray": (
        "people", {"name": "laser", "object_id": "7", "pos": AT, "reliability": 0.75, "header": HEAD}, "id score",
    ),
    "spencer_tracking_msgs/TrackedPersons": (
        "tracks", {"track_id": 7, "detection_id": 3, "pose": {"pose": POSE}, "twist": {"twist": {"linear": FAST}}},
        "id v heading",
    ),
    "spencer_tracking_msgs/DetectedPersons": (
        "detections", {"detection_id": 3, "confidence": 0.75, "pose": {"pose": POSE}}, "score heading",
    ),
    "leg_tracker/PersonArray": ("people", {"pose": POSE, "id": 7}, "id heading"),
    "leg_tracker/LegArray": ("legs", {"position": AT, "confidence": 0.75}, "score leg"),
    "radar_msgs/RadarTracks": (
        "tracks", {"track_id": 7, "position": AT, "velocity": FAST, "size": SIZE, "classification": "Person"},
        "id v size",
    ),
    "autoware_perception_msgs/PredictedObjects": (
        "objects",
        {
            "object_id": {"uuid": [1] * 16}, "existence_probability": 0.75,
            "classification": [{"label": 7, "probability": 1.0}], "shape": {"dimensions": SIZE},
            "kinematics": {
                "initial_pose_with_covariance": {"pose": POSE},
                "initial_twist_with_covariance": {"twist": {"linear": {"x": 0.25, "y": -0.5}}},  # of the object's axes
            },
        },
        "uuid score v size heading",
    ),
    "tier4_perception_msgs/DetectedObjectsWithFeature": (
        "feature_objects",
        {
            "object": {
                "existence_probability": 0.75, "classification": [{"label": 7, "probability": 1.0}],
                "shape": {"dimensions": SIZE},
                "kinematics": {
                    "pose_with_covariance": {"pose": POSE}, "orientation_availability": 2, "has_twist": True,
                    "twist_with_covariance": {"twist": {"linear": {"x": 0.25, "y": -0.5}}},
                },
            },
            "feature": {"roi": ROI},
        },
        "score v size heading pedestrian",
    ),
    "autoware_perception_msgs/DynamicObjectArray": (
        "objects",
        {
            "semantic": {"type": 6, "confidence": 0.75}, "shape": {"dimensions": SIZE}, "id": {"uuid": [1] * 16},
            "state": {"pose_covariance": {"pose": POSE}, "twist_covariance": {"twist": {"linear": {"x": 0.25, "y": -0.5}}}},
        },
        "uuid score v size heading",
    ),
    "osi_msgs/GroundTruth": (
        "moving_object",
        {
            "id": {"value": 7}, "type": 1,
            "base": {
                "position": AT, "velocity": FAST, "orientation": {"yaw": np.pi / 2},
                "dimension": {"length": 0.5, "width": 0.25, "height": 1.75},
            },
        },
        "id v size heading",
    ),
    "obstacle_detector/Obstacles": ("circles", {"center": AT, "velocity": FAST, "radius": 0.25}, "v round nothing"),
    **dict.fromkeys(
        ("zed_msgs/ObjectsStamped", "zed_interfaces/ObjectsStamped"),
        (
            "objects",
            {
                "label": "Person", "label_id": 7, "sublabel": "Person", "confidence": 75.0, "position": [1.5, -2.25, 0.75],
                "velocity": [0.5, 0.25, 0.0], "dimensions_3d": [0.25, 1.75, 0.5], "tracking_available": True,
                "tracking_state": 1, "bounding_box_2d": CORNERS,
            },
            "id score v size",
        ),
    ),
    "depthai_ros_msgs/SpatialDetectionArray": (
        "detections", {"results": SURE, "bbox": MIDDLE, "position": AT, "is_tracking": True, "tracking_id": "7"},
        "id score",
    ),
    "lab_msgs/WalkerList": (
        "walkers", {"uid": 7, "pos_x": 1.5, "pos_y": -2.25, "vx": 0.5, "vy": 0.25, "yaw": np.pi / 2, "likelihood": 0.75},
        "id score v heading flat",
    ),
    "lab_msgs/SeenObjects": (
        "objects",
        {
            "type": 1, "pose": {"header": HEAD, "pose": POSE}, "confidence": 0.75,
            "dimensions": {"length": 0.5, "width": 0.25, "height": 1.75},
        },
        "score size heading",
    ),
    **{
        f"{name}/DetectionArray": (
            "detections",
            {
                "class_id": 0, "class_name": "person", "score": 0.75, "id": "7", "bbox": {},
                "bbox3d": {"center": POSE, "size": SIZE, "frame_id": "odom"},
            },
            "id score size heading odom",
        )
        for name in YOLO
    },
}  # fmt: skip
IN_PICTURES = {
    "darknet_ros_msgs/BoundingBoxes": (
        "bounding_boxes",
        {"probability": 0.75, "xmin": 20, "ymin": 80, "xmax": 44, "ymax": 150, "id": 0, "class_id": "person"},
    ),
    "ultralytics_ros/YoloResult": ("detections.detections", {"results": SURE_POSED, "bbox": MIDDLE}),
    "depthai_ros_msgs/TrackDetection2DArray": (
        "detections", {"results": SURE_POSED, "bbox": MIDDLE, "is_tracking": True, "tracking_id": "7"},
    ),
    "object_msgs/ObjectsInBoxes": ("objects_vector", {"object": {"object_name": "person", "probability": 0.75}, "roi": ROI}),
    "opencv_apps/FaceArrayStamped": (
        "faces", {"face": {"x": 32, "y": 115, "width": 24, "height": 70}, "label": "person", "confidence": 0.75},
    ),
    "opencv_apps/RectArrayStamped": ("rects", {"x": 32, "y": 115, "width": 24, "height": 70}),
    "hri_msgs/NormalizedRegionOfInterest2D": ("", {"xmin": 0.1, "ymin": 0.4, "xmax": 0.22, "ymax": 0.75, "c": 0.75}),
    "lab_msgs/Boxes": ("items", {"label": "person", "score": 0.75, "roi": ROI}),
    **{
        f"{name}/DetectionArray": (
            "detections",
            {
                "class_id": 0, "class_name": "person", "score": 0.75, "id": "7",
                "bbox": {"center": MIDDLE["center"], "size": {"x": 24.0, "y": 70.0}},
            },
        )
        for name in YOLO
    },
}  # fmt: skip
ENCODINGS = ("ros1", "cdr", "json")


def made(ros: Ros, name: str, fields: dict):
    values = {}
    for key, kind in ros.store.fielddefs[name][1]:
        values[key] = value_of(ros, kind, fields.get(key))
    assert fields.keys() <= values.keys(), fields.keys() - values.keys()
    return ros.store.types[name](**values)


def value_of(ros: Ros, kind, value):
    node, inner = kind
    if node.name == "NAME":
        if inner.endswith("Header") and value is None:
            value = {"stamp": {"sec": 0, "nanosec": 0}}
        return made(ros, inner, value or {})
    if node.name == "BASE":
        default = "" if "string" in inner[0] else False if inner[0] == "bool" else 0
        return default if value is None else value
    (of, name), length = inner
    if of.name == "NAME":
        return [made(ros, name, one) for one in (value if value is not None else [{}] * length)]
    if "string" in name[0]:
        return list(value or [])
    return np.array(value if value is not None else [0] * length, np.dtype(name[0]))


def whole(where: str, thing: dict) -> dict:
    """The fields of a message with a thing in a list."""
    if not where:
        return {"header": HEAD, **thing}
    *above, last = where.split(".")
    out: dict = {last: [thing]}
    for name in reversed(above):
        out = {name: {"header": HEAD, **out}}
    return {"header": HEAD, **out}


def write(path: Path, channels: dict[str, tuple[str, list[dict]]], encoding: str) -> Path:
    """A log with messages of types, by topic; each is a tenth of a second after the last one."""
    with recorder(path) as writer:
        for topic, (name, messages) in channels.items():
            ros = Ros(name, DEFINITIONS.get(name, ""), ros1=encoding == "ros1")
            kind = ros.kind
            if encoding == "json":
                kind = kind._replace(name=name, schema_encoding="jsonschema", schema=b"{}", encoding="json")
            channel = writer.add_channel(topic, (kind.name, kind.schema_encoding, kind.schema), kind.encoding)
            for number, fields in enumerate(messages):
                message = made(ros, ros.types, fields)
                payload = json.dumps(plain(message)).encode() if encoding == "json" else ros.pack(message)
                writer.add_message(channel, START_NS + number * 10**8, payload, START_NS + number * 10**8)
    return path


def read(path: Path, topic: str = "/seen", **chosen: str):
    with log.read(path) as opened, collected() as said, choosing(topic, chosen.get("map"), chosen.get("class_map")):
        found = named_detections(opened, topic)
    return found, [(notice.code, notice.message) for notice in said]


@pytest.mark.parametrize(("name", "encoding"), one_in(2, product(IN_SPACE, ENCODINGS)))
def test_positions_ids_classes_and_scores_are_as_the_message_states_them(name, encoding, tmp_path):
    where, thing, has = IN_SPACE[name]
    empty = whole(where, thing) | {where: [], "header": {**HEAD, "stamp": {"sec": 1_700_000_000, "nanosec": 10**8}}}
    path = write(tmp_path / "a.mcap", {"/seen": (name, [whole(where, thing), empty])}, encoding)
    found, _ = read(path)
    assert [len(frame.rows) for frame in found.frames] == [1, 0]
    (row,) = found.frames[0].rows
    has, nan = set(has.split()), np.nan
    size = (0.5, 0.25, 1.75) if "size" in has else (0.5, 0.5, nan) if "round" in has else (nan,) * 3
    wanted = {
        **dict(zip(("x_m", "y_m"), (1.5, -2.25), strict=True)),
        "z_m": nan if "flat" in has else 0.75,
        **dict(zip(("vx_m_per_s", "vy_m_per_s"), (0.5, 0.25) if "v" in has else (nan, nan), strict=True)),
        **dict(zip(("length_m", "width_m", "height_m"), size, strict=True)),
        "heading_rad": np.pi / 2 if "heading" in has else nan,
        "score": 0.75 if "score" in has else nan,
        "source_id": 7 if "id" in has else 0 if "uuid" in has else -1,
    }
    np.testing.assert_allclose([row[key] for key in wanted], list(wanted.values()), atol=1e-6)
    assert found.frame_id == ("odom" if "odom" in has else "map")
    name_of_class = (
        "pedestrian"
        if has & {"uuid", "pedestrian"}
        else "leg"
        if "leg" in has
        else ""
        if "nothing" in has
        else "person"
    )
    assert ({0: "", 1: "person"} | found.classes)[row["class_id"]].lower() == name_of_class
    with log.read(path) as opened:
        assert foreign.holds_boxes(opened, "/seen", in_space=True)


@pytest.mark.parametrize(("name", "encoding"), one_in(2, product(IN_PICTURES, ENCODINGS)))
def test_boxes_in_pictures_are_as_the_message_states_them(name, encoding, tmp_path):
    where, thing = IN_PICTURES[name]
    path = write(tmp_path / "a.mcap", {"/humans/body": (name, [whole(where, thing)] * 2)}, encoding)
    found, said = read(path, "/humans/body", map="picture=200x200" if "hri" in name else None)
    (row,) = found.frames[0].rows
    score = np.nan if "Rect" in name else 0.75
    np.testing.assert_allclose(list(row)[:5], [20, 80, 24, 70, score], atol=1e-5)
    assert row["class_id"] == 1
    codes = [code for code, _ in said if code != "clock"]  # they are at their log times, since there are no pictures
    assert codes == (["units"] if "hri" in name else ["fields"] if name.startswith("lab") else [])
    with log.read(path) as opened:
        assert foreign.holds_boxes(opened, "/humans/body", in_space=False)


def test_enumerations_of_protobuf_name_classes_without_what_all_values_begin_with(tmp_path):
    """As style guides of protobuf have it: enum ObjectType { OBJECT_TYPE_UNSPECIFIED = 0; OBJECT_TYPE_PERSON = 1; }."""
    file = descriptor_pb2.FileDescriptorProto(name="a.proto", package="lab", syntax="proto3")
    kinds = file.enum_type.add(name="ObjectType").value
    for number, name in enumerate(("UNSPECIFIED", "PERSON", "FORK_LIFT")):
        kinds.add(name=f"OBJECT_TYPE_{name}", number=number)
    thing = descriptor_pb2.FieldDescriptorProto
    of_type = {"x_m": thing.TYPE_DOUBLE, "y_m": thing.TYPE_DOUBLE, "kind": thing.TYPE_ENUM}
    fields = file.message_type.add(name="Thing").field
    for number, (name, kind) in enumerate(of_type.items(), 1):
        fields.add(
            name=name, number=number, type=kind, label=1, type_name=".lab.ObjectType" if name == "kind" else None
        )
    things = file.message_type.add(name="Frame").field
    things.add(name="objects", number=1, type=thing.TYPE_MESSAGE, label=3, type_name=".lab.Thing")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    frame = message_factory.GetMessageClass(pool.FindMessageTypeByName("lab.Frame"))()
    for number in range(3):
        frame.objects.add(x_m=1.0, y_m=float(number), kind=number)
    definition = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    with recorder(tmp_path / "a.mcap") as writer:
        channel = writer.add_channel("/seen", ("lab.Frame", "protobuf", definition), "protobuf")
        writer.add_message(channel, START_NS, frame.SerializeToString(), START_NS)
    found, _ = read(tmp_path / "a.mcap")
    names = {0: "", 1: "person"} | found.classes
    assert [names[row["class_id"]] for row in found.frames[0].rows] == ["", "person", "fork_lift"]


@pytest.mark.parametrize(
    ("name", "encoding"), [("visualization_msgs/MarkerArray", "cdr"), ("lab_msgs/WalkerList", "json")]
)
def test_channels_that_begin_without_things_are_read(name, encoding, tmp_path):
    """A detector that sees no people for a minute: what its channel holds is in a later message."""
    unstamped = HEAD | {"stamp": {"sec": 0, "nanosec": 0}}
    drawn = {"type": 1, "header": unstamped, "pose": POSE, "scale": SIZE, "ns": "person"}
    where, thing = ("markers", drawn) if encoding == "cdr" else ("walkers", {"uid": 7, "pos_x": 1.5, "pos_y": -2.25})
    messages = [{where: [thing] if number >= 60 else []} for number in range(70)]
    found, _ = read(write(tmp_path / "a.mcap", {"/seen": (name, messages)}, encoding))
    assert [row["x_m"] for frame in found.frames for row in frame.rows] == [1.5] * 10


def test_a_head_drawn_above_a_body_is_no_second_person(tmp_path):
    unstamped = HEAD | {"stamp": {"sec": 0, "nanosec": 0}}
    body = {"header": unstamped, "type": 3, "id": 7, "ns": "body", "scale": SIZE | {"x": 0.5, "y": 0.5}, "pose": POSE}
    head = body | {"type": 2, "ns": "head", "scale": {"x": 0.25, "y": 0.25, "z": 0.25}}
    other = body | {"ns": "visitor", "pose": {"position": AT | {"x": 4.5}, "orientation": {"w": 1.0}}}
    messages = [{"markers": [head, body, other]}]
    path = write(tmp_path / "a.mcap", {"/people_markers": ("visualization_msgs/MarkerArray", messages)}, "cdr")
    found, said = read(path, "/people_markers")
    assert found.frames[0].rows[["x_m", "height_m"]].tolist() == [(1.5, 1.75), (4.5, 1.75)]
    assert "1 markers that are parts of larger ones with their id are left out" in dict(said)["left-out"]


def test_json_needs_no_schema(tmp_path):
    with recorder(tmp_path / "a.mcap") as writer:
        thing = {"label": "person", "score": 0.5, "pos_x": 1.5, "pos_y": -2.25}
        payload = json.dumps({"objects": [thing]}).encode()
        writer.add_message(writer.register_channel("/seen", "json", 0), START_NS, payload, START_NS)
    found, said = read(tmp_path / "a.mcap")
    assert found.frames[0].rows["x_m"].tolist() == [1.5]
    assert "messages of JSON are read by the names of their fields" in dict(said)["fields"]


def test_json_may_begin_with_what_is_none_and_have_numbers_for_stamps_and_unsigned_ids(tmp_path):
    thing = {"label": "person", "pos_x": 1.5, "pos_y": -2.25, "id": 2**64 - 1}
    payload = json.dumps({"timestamp": START_NS / 1e9, "objects": [thing]}).encode()
    with recorder(tmp_path / "a.mcap") as writer:
        channel = writer.register_channel("/seen", "json", 0)
        for number, data in enumerate([b"{", payload, payload]):
            writer.add_message(channel, START_NS + number * 10**8, data, START_NS)
    found, said = read(tmp_path / "a.mcap")
    assert [(frame.t_ns, len(frame.rows)) for frame in found.frames] == [
        (START_NS + n * 10**8, n > 0) for n in range(3)
    ]
    assert {row["source_id"] for frame in found.frames for row in frame.rows} == {0}
    assert "have no stamp" in dict(said)["clock"]
    assert "it counts as empty" in dict(said)["lost"]


POSES = [{"position": {"x": float(n), "y": 2.0, "z": 0.0}, "orientation": {"w": 1.0}} for n in range(3)]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_positions_that_may_be_of_anything_are_read_where_their_channel_is_named(encoding, tmp_path):
    messages = [{"header": HEAD, "poses": POSES}]
    arrays = dict.fromkeys(("/particles", "/robot/people_poses"), ("geometry_msgs/PoseArray", messages))
    path = write(tmp_path / "a.mcap", arrays, encoding)
    with log.read(path) as opened:
        assert [foreign.holds_boxes(opened, topic) for topic in arrays] == [False, True]
        assert list(foreign.uncertain_boxes(opened)) == ["/particles"]
        with choosing("/particles", None, None):
            assert foreign.holds_boxes(opened, "/particles")
    for topic, class_id, source in zip(arrays, (0, 1), ("none", "the name of the channel"), strict=True):
        found, said = read(path, topic)
        assert found.facts["classes"] == source
        assert found.frames[0].rows["x_m"].tolist() == [0, 1, 2]
        assert set(found.frames[0].rows["class_id"].tolist()) == {class_id}
        assert next(code for code, _ in said) == "fields"


def test_a_log_with_positions_that_may_be_of_people_says_so(tmp_path):
    messages = [{"header": HEAD, "poses": POSES}] * 3
    path = write(tmp_path / "a.mcap", {"/cluster_poses": ("geometry_msgs/PoseArray", messages)}, "cdr")
    with pytest.raises(McaptrackError, match=r"/cluster_poses \(geometry_msgs/msg/PoseArray\).*`topic=`"):
        mcaptrack.run(path, tables=False)


#: What is no list of things that move.
NO_THINGS = {
    "nav_msgs/Path": {"poses": [{"header": HEAD, "pose": POSE}]},
    "apriltag_msgs/AprilTagDetectionArray": {"detections": [{"id": 3, "centre": {"x": 5.0, "y": 6.0}}]},
    "geometry_msgs/PolygonStamped": {"polygon": {"points": [AT]}},
    "sensor_msgs/JointState": {"position": [1.0, 2.0, 3.0]},
    "nav_msgs/Odometry": {"pose": {"pose": POSE}},
    "geometry_msgs/PoseStamped": {"pose": POSE},
    "lab_msgs/Lanes": {"lanes": [{"id": 1, "start": AT}]},
}
DEFINITIONS |= {
    "apriltag_msgs/AprilTagDetectionArray": package(
        "apriltag_msgs",
        AprilTagDetectionArray="std_msgs/Header header; AprilTagDetection[] detections",
        AprilTagDetection="string family; int32 id; int32 hamming; float32 goodness; float32 decision_margin; "
        "Point centre; Point[4] corners; float64[9] homography",
        Point="float64 x; float64 y",
    ),
    "lab_msgs/Lanes": package(
        "lab_msgs", Lanes="std_msgs/Header header; Lane[] lanes", Lane="int32 id; geometry_msgs/Point start"
    ),
}


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("name", NO_THINGS)
def test_what_does_not_move_is_not_taken_for_people(name, encoding, tmp_path):
    path = write(tmp_path / "a.mcap", {"/a": (name, [{"header": HEAD, **NO_THINGS[name]}])}, encoding)
    with log.read(path) as opened:
        assert not foreign.holds_boxes(opened, "/a")
        assert not foreign.uncertain_boxes(opened)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_paths_say_what_no_name_does(encoding, tmp_path):
    messages = [{"header": HEAD, "lanes": [{"id": 1, "start": AT}, {"id": 2, "start": AT}]}]
    path = write(tmp_path / "a.mcap", {"/a": ("lab_msgs/Lanes", messages)}, encoding)
    for written in ("x=lanes[].start.x,y=lanes[].start.y,z=start.z", "position=start", "position=lanes[].start,id=id"):
        found, said = read(path, "/a", map=written)
        rows = found.frames[0].rows
        np.testing.assert_allclose([list(row) for row in rows[["x_m", "y_m", "z_m"]]], [[1.5, -2.25, 0.75]] * 2)
        assert rows["source_id"].tolist() == ([1, 2] if "id=" in written else [-1, -1])
        assert (found.facts["map"], "fields" in dict(said)) == (written, False)
    for written, why in (
        ("x=lanes[].start.x", "has to name position, or x and y"),
        ("x=lanes[].end.x,y=lanes[].end.y", "has no field lanes.*it has header, lanes"),
        ("x=header.stamp.sec,y=lanes[].start.y", "paths are in several lists"),
        ("q=lanes", "'q'; there are position"),
        ("x=lanes[", "is no path"),
        ("x=a,x=b", "names x twice"),
        (" ", "names no field"),
    ):
        with pytest.raises(McaptrackError, match=why) as raised:
            read(path, "/a", map=written)
        assert "\n" not in str(raised.value)


def test_paths_and_class_maps_are_remembered_with_what_was_made(tmp_path):
    ways = [{**AT, "x": 0.1 * number} for number in range(20)]
    messages = [
        {"header": {**HEAD, "stamp": {"sec": 0, "nanosec": 0}}, "lanes": [{"id": 3, "start": way}]} for way in ways
    ]
    path = write(tmp_path / "a.mcap", {"/a": ("lab_msgs/Lanes", messages)}, "json")
    chosen = {"map": "position=lanes[].start,class=id", "class_map": "3=person"}
    mcaptrack.run(path, topic="/a", tables=False, sidecar=False, **chosen)
    (tracks,) = (channel for channel in mcaptrack.info(path).channels if channel.topic == "/camera/tracks")
    assert {key: tracks.boxes[key] for key in chosen} == chosen
    assert tracks.boxes["classes"] == "class map 3=person"
    again = mcaptrack.run(path, tables=False)
    assert again.is_up_to_date
    other = mcaptrack.run(path, topic="/a", tables=False, class_map="3=car")
    assert "track" in other.stages
    with mcaptrack.open(path) as opened:
        assert set(opened.array("tracks")["class_id"].tolist()) == {2}


@pytest.mark.parametrize(
    ("texts", "options", "ids", "codes"),
    [
        (["0", "1", "", "0"], {"has_zero": True}, [1, 2, 0, 1], ["COCO"]),
        (["1", "2"], {"has_zero": True}, [1, 2], ["numbers without names"]),
        (["1", "2"], {"has_coco": True}, [2, 3], ["COCO"]),
        (["0", "85"], {"has_zero": True}, [0, 85], ["numbers without names"]),
        (["0", "0"], {}, [0, 0], []),
        (["0", "car"], {"has_zero": True}, [0, 2], ["are names", "numbers without names"]),
        (["0", "1", "7"], {"class_map": "0=car,1=person"}, [2, 1, 3], ["not in the class map: 7", "are names"]),
        (["ped", "Car"], {"class_map": "PED=person"}, [1, 2], ["are names"]),
        (["person", "Pedestrian", "5", "car", "-3", "99999999999", "4294967295", "bicycle"], {},
         [1, 1, 5, 7, 0, 0, 0, 6], ["are names", "numbers without names"]),
    ],
)  # fmt: skip
def test_numbers_of_classes_mean_what_their_source_says(texts, options, ids, codes):
    found = read_classes(texts, **options)
    assert found.ids.tolist() == ids
    assert all(code in remark for code, remark in zip(codes, found.remarks, strict=True))


def test_names_of_classes_have_an_end():
    found = read_classes([f"name {number:05}" for number in range(1030)])
    assert found.ids.tolist() == [*range(2, 1026), *[0] * 6]
    assert read_classes(["Human", "car"]).names == {1: "Human", 2: "car"}
    assert read_classes(["person", "pedestrian"]).names == {}
