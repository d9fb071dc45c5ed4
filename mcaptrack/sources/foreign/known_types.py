"""Types of messages of other software that need more than their fields: one line for each.

A type that isn't here is read by its fields all the same, which is said. A line says nothing but that names of fields
don't mislead, or names the fields that do, the classes behind numbers (for JSON, which has no constants), or a function
that takes a box as the fields have it, with its thing, to the box as it is meant.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isnan, nan
from typing import Any, Final, NamedTuple

from mcaptrack.contracts import UNKNOWN_VECTOR, Box3d, Vector
from mcaptrack.sources.foreign.decoding import integer, number
from mcaptrack.sources.foreign.fields import Adjust, around, moved, part, rotated, vector


class Known(NamedTuple):
    """A type: ``fields`` as for ``map=``, from a thing on; ``classes`` from 0 on; and what a box of it means.

    ``has_coco`` says that numbers of classes are those of COCO.
    """

    fields: str = ""
    classes: str = ""
    adjust: Adjust | None = None
    has_coco: bool = False


# jsk_recognition_msgs


def _jsk(_: Any, box: Box3d) -> Box3d:
    return box._replace(score=box.score or nan)  # 0 where no value is set


# derived_object_msgs

#: The largest certainty of a classification.
_CERTAIN: Final = 255
#: The level of detection from which the velocity is known.
_TRACKED: Final = 1
#: The types of shape_msgs/SolidPrimitive.
_BOX, _SPHERE, _CYLINDER, _CONE = 1, 2, 3, 4


def _shape_size(shape: Any) -> Vector:
    """The size of the box around a shape; NaN if it has none."""
    kind, lengths = integer(shape.type), [number(dimension) for dimension in shape.dimensions]
    if kind == _BOX and len(lengths) >= 3:
        return lengths[0], lengths[1], lengths[2]
    if kind == _SPHERE and lengths:
        return 2 * lengths[0], 2 * lengths[0], 2 * lengths[0]
    if kind in (_CYLINDER, _CONE) and len(lengths) >= 2:  # height and radius
        return 2 * lengths[1], 2 * lengths[1], lengths[0]
    return UNKNOWN_VECTOR


def _derived(seen: Any, box: Box3d) -> Box3d:
    """Objects without a shape, as of radars, have the size of their polygon, or none."""
    size, centre = _shape_size(seen.shape), box.centre
    if isnan(size[0]) and (points := [vector(point) for point in part(part(seen, "polygon"), "points") or ()]):
        x, y, z, w = box.orientation
        along = [rotated((-x, -y, -z, w), point) for point in points]  # the polygon is in the frame of the message
        middle, (length, width, _) = around(along)
        centre, size = rotated(box.orientation, middle), (length, width, nan)
    is_tracked = integer(seen.detection_level) == _TRACKED
    return box._replace(
        centre=centre,
        size=size,
        score=box.score / _CERTAIN if box.score else nan,
        velocity=box.velocity if is_tracked else UNKNOWN_VECTOR,
    )


# Autoware

_ROUND, _POLYGON, _HEADING_UNKNOWN = 1, 2, 0


def _autoware(item: Any, box: Box3d) -> Box3d:
    """Footprints and cylinders are sizes, and velocities are along the axes of the object."""
    kinematics, shape, size, centre = item.kinematics, item.shape, box.size, box.centre
    if integer(shape.type) == _ROUND:  # x is the diameter
        size = (size[0], size[0], size[2])
    elif integer(shape.type) == _POLYGON:
        points = [vector(point) for point in shape.footprint.points]
        (x, y, _), (length, width, _) = around(points) if points else ((0.0, 0.0, 0.0), UNKNOWN_VECTOR)
        centre, size = moved(centre, box.orientation, (x, y, 0.0)), (length, width, size[2])
    velocity = rotated(box.orientation, box.velocity) if getattr(kinematics, "has_twist", True) else UNKNOWN_VECTOR
    is_turned = integer(getattr(kinematics, "orientation_availability", 1)) != _HEADING_UNKNOWN
    score = box.score if box.score > 0 else nan
    return box._replace(centre=centre, size=size, velocity=velocity, has_heading=is_turned, score=score)


_AUTOWARE: Final = Known(
    classes=",car,truck,bus,trailer,motorcycle,bicycle,pedestrian,animal,hazard,over_drivable,under_drivable",
    adjust=_autoware,
)


# ZED

_OFF, _ENDED = 0, 3


def _zed(thing: Any, box: Box3d) -> Box3d | None:
    """Confidences are in percent; tracks that are off or have ended are no measurements."""
    is_tracked = bool(thing.tracking_available)
    if is_tracked and integer(thing.tracking_state) in (_OFF, _ENDED):
        return None
    return box._replace(score=box.score / 100, source_id=box.source_id if is_tracked else None)


_ZED: Final = Known(
    "class=label,id=label_id,length=dimensions_3d[2],width=dimensions_3d[0],height=dimensions_3d[1]", adjust=_zed
)
_YOLO: Final = Known(has_coco=True)
_OPENCV: Final = Known("cx=x,cy=y,w=width,h=height")

#: By the name of the type as in ROS 1 and Foxglove.
KNOWN: Final[Mapping[str, Known]] = {
    "vision_msgs/Detection2DArray": Known(),
    "vision_msgs/Detection2D": Known(),
    "vision_msgs/Detection3DArray": Known(),
    "vision_msgs/Detection3D": Known(),
    "darknet_ros_msgs/BoundingBoxes": _YOLO,
    "yolo_msgs/DetectionArray": _YOLO,
    "yolov8_msgs/DetectionArray": _YOLO,
    "ultralytics_ros/YoloResult": _YOLO,
    "object_msgs/ObjectsInBoxes": Known(),
    "depthai_ros_msgs/SpatialDetectionArray": Known(),
    "depthai_ros_msgs/TrackDetection2DArray": Known(),
    "hri_msgs/NormalizedRegionOfInterest2D": Known(),
    "opencv_apps/FaceArrayStamped": Known("cx=face.x,cy=face.y,w=face.width,h=face.height"),
    "opencv_apps/FaceArray": Known("cx=face.x,cy=face.y,w=face.width,h=face.height"),
    "opencv_apps/RectArrayStamped": _OPENCV,
    "opencv_apps/RectArray": _OPENCV,
    "jsk_recognition_msgs/BoundingBoxArray": Known("score=value", adjust=_jsk),
    "jsk_recognition_msgs/BoundingBox": Known("score=value", adjust=_jsk),
    "derived_object_msgs/ObjectArray": Known(
        "class=classification,score=classification_certainty",
        ",unknown_small,unknown_medium,unknown_big,pedestrian,bike,car,truck,motorcycle,other_vehicle,barrier,sign",
        _derived,
    ),
    "people_msgs/People": Known(),
    "people_msgs/PositionMeasurementArray": Known(),
    "spencer_tracking_msgs/TrackedPersons": Known(),
    "spencer_tracking_msgs/DetectedPersons": Known(),
    "leg_tracker/PersonArray": Known(),
    "leg_tracker/LegArray": Known(),
    "radar_msgs/RadarTracks": Known(),
    "zed_interfaces/ObjectsStamped": _ZED,
    "zed_msgs/ObjectsStamped": _ZED,
    **{
        f"{package}/{kind}Objects": _AUTOWARE
        for package in ("autoware_perception_msgs", "autoware_auto_perception_msgs")
        for kind in ("Detected", "Tracked", "Predicted")
    },
}
