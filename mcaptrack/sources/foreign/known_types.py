"""Types of messages of other software that need more than their fields: one line for each.

A type that isn't here is read by its fields all the same, which is said. A line says nothing but that names of fields
don't mislead, or names the fields that do, the classes behind numbers (for JSON, which has no constants), or a function
that takes boxes as the fields have them, with their things, to boxes as they are meant.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from math import nan
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats, taken
from mcaptrack.sources.foreign.fields import Adjust, Boxes3d, around, rotated
from mcaptrack.sources.foreign.things import EACH, Path, Things


class Known(NamedTuple):
    """A type: ``fields`` as for ``map=``, from a thing on; ``classes`` from 0 on; and what boxes of it mean, for which
    ``also`` are read: paths of fields with blanks between them.

    ``has_coco`` says that numbers of classes are those of COCO.
    """

    fields: str = ""
    classes: str = ""
    adjust: Adjust | None = None
    also: str = ""
    has_coco: bool = False


def _stated(score: Floats) -> Floats:
    """Scores (N,), NaN for those of 0, where no value is set."""
    return np.where(score == 0, nan, score)


# jsk_recognition_msgs


def _jsk(_: Things, boxes: Boxes3d) -> Boxes3d:
    return boxes._replace(score=_stated(boxes.score))


# derived_object_msgs

#: The largest certainty of a classification.
_CERTAIN: Final = 255
#: The level of detection from which the velocity is known.
_TRACKED: Final = 1
#: The types of shape_msgs/SolidPrimitive, with the places of length, width and height among their dimensions, and by
#: which factors: cylinders and cones have height and radius.
_SHAPES: Final = {
    1: ((0, 1, 2), (1, 1, 1)),
    2: ((0, 0, 0), (2, 2, 2)),
    3: ((1, 1, 0), (2, 2, 1)),
    4: ((1, 1, 0), (2, 2, 1)),
}


def _derived(things: Things, boxes: Boxes3d) -> Boxes3d:
    """Objects without a shape, as of radars, have the size of their polygon, or none."""
    kind, dimensions = things.numbers(("shape", "type")), things.vectors(("shape", "dimensions"))
    size, centre = np.full_like(boxes.size, nan), boxes.centre.copy()
    for number, (places, factors) in _SHAPES.items():
        size[kind == number] = dimensions[kind == number][:, places] * factors
    size[np.isnan(size).any(axis=1)] = nan
    owner, points = things.members(("polygon", "points", EACH))
    back = boxes.orientation[owner] * [-1, -1, -1, 1]
    middle, extent = around(rotated(back, points.vectors(())), owner, len(things))  # it is in the frame of the message
    is_outlined = np.isnan(size[:, 0]) & np.isfinite(middle).all(axis=1)
    centre[is_outlined] = rotated(boxes.orientation, middle)[is_outlined]
    size[is_outlined] = extent[is_outlined] * [1, 1, nan]
    is_tracked = things.numbers(("detection_level",)) == _TRACKED
    return boxes._replace(
        centre=centre,
        size=size,
        score=_stated(boxes.score) / _CERTAIN,
        velocity=np.where(is_tracked[:, None], boxes.velocity, nan),
    )


# Autoware

_ROUND, _POLYGON, _HEADING_UNKNOWN = 1, 2, 0


def _autoware(things: Things, boxes: Boxes3d, at: Path = ()) -> Boxes3d:
    """Footprints and cylinders are sizes, and velocities are along the axes of the object, ``at`` the end of a path."""
    kind, size, turn = things.numbers((*at, "shape", "type")), boxes.size.copy(), boxes.orientation
    size[kind == _ROUND, 1] = size[kind == _ROUND, 0]  # x is the diameter
    owner, points = things.members((*at, "shape", "footprint", "points", EACH))
    middle, extent = around(points.vectors(()), owner, len(things))
    is_outlined = kind == _POLYGON
    size[is_outlined, :2] = extent[is_outlined, :2]
    centre = boxes.centre.copy()
    centre[is_outlined] += rotated(turn, np.nan_to_num(middle) * [1, 1, 0])[is_outlined]
    has_twist = [value in (None, True) for value in things.values((*at, "kinematics", "has_twist"))]
    velocity = np.where(np.reshape(has_twist, (-1, 1)), rotated(turn, boxes.velocity), nan)
    is_turned = things.numbers((*at, "kinematics", "orientation_availability")) != _HEADING_UNKNOWN
    score = _stated(boxes.score)
    return boxes._replace(centre=centre, size=size, velocity=velocity, has_heading=is_turned, score=score)


def _along_heading(_: Things, boxes: Boxes3d) -> Boxes3d:
    """Velocities along the axes of the object, as those of Autoware before kinematics had a message of their own."""
    return boxes._replace(velocity=rotated(boxes.orientation, boxes.velocity))


_AUTOWARE: Final = Known(
    "",
    ",car,truck,bus,trailer,motorcycle,bicycle,pedestrian,animal,hazard,over_drivable,under_drivable",
    _autoware,
    "shape kinematics.has_twist kinematics.orientation_availability",
)
_IN_OBJECT: Final = _AUTOWARE._replace(
    adjust=partial(_autoware, at=("object",)),
    also="object.shape object.kinematics.has_twist object.kinematics.orientation_availability",
)


# ZED

_OFF, _ENDED = 0, 3


def _zed(things: Things, boxes: Boxes3d) -> Boxes3d:
    """Confidences are in percent; tracks that are off or have ended are no measurements."""
    is_tracked = np.array(things.values(("tracking_available",)), bool)
    is_over = is_tracked & np.isin(things.numbers(("tracking_state",)), (_OFF, _ENDED))
    source_id = np.where(is_tracked, boxes.source_id, None)
    return taken(boxes._replace(score=boxes.score / 100, source_id=source_id), ~is_over)


_ZED: Final = Known(
    "class=label,id=label_id,length=dimensions_3d[2],width=dimensions_3d[0],height=dimensions_3d[1]",
    adjust=_zed,
    also="tracking_available tracking_state",
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
        "shape polygon.points detection_level",
    ),
    "people_msgs/People": Known(),
    "people_msgs/PositionMeasurementArray": Known(),
    "spencer_tracking_msgs/TrackedPersons": Known(),
    "spencer_tracking_msgs/DetectedPersons": Known(),
    "leg_tracker/PersonArray": Known(),
    "leg_tracker/LegArray": Known(),
    "radar_msgs/RadarTracks": Known(),
    "autoware_msgs/DetectedObjectArray": Known(adjust=_along_heading),
    "autoware_perception_msgs/DynamicObjectArray": Known(
        "", ",car,truck,bus,bicycle,motorbike,pedestrian,animal", _along_heading
    ),
    "tier4_perception_msgs/DetectedObjectsWithFeature": _IN_OBJECT,
    "zed_interfaces/ObjectsStamped": _ZED,
    "zed_msgs/ObjectsStamped": _ZED,
    **{
        f"{package}/{kind}Objects": _AUTOWARE
        for package in ("autoware_perception_msgs", "autoware_auto_perception_msgs")
        for kind in ("Detected", "Tracked", "Predicted")
    },
}
