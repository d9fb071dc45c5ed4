"""derived_object_msgs/ObjectArray."""

from __future__ import annotations

from math import isnan, nan
from typing import Any, Final

from mcaptrack.sources.foreign.boxes_3d.box import (
    UNKNOWN_VECTOR,
    Box3d,
    Message3d,
    Vector,
    around,
    enumeration,
    head_of,
    named,
    number,
    own_head,
    part,
    quaternion,
    rotated,
    vector,
)
from mcaptrack.sources.foreign.decoding import integer

#: The classes of derived_object_msgs/Object, for messages without their definition (JSON).
_CLASSES: Final = {
    0: "",
    1: "unknown_small",
    2: "unknown_medium",
    3: "unknown_big",
    4: "pedestrian",
    5: "bike",
    6: "car",
    7: "truck",
    8: "motorcycle",
    9: "other_vehicle",
    10: "barrier",
    11: "sign",
}
_PREFIX: Final = "CLASSIFICATION_"
#: The largest certainty of a classification.
_CERTAIN: Final = 255
#: The level of detection from which the velocity is known.
_TRACKED: Final = 1
#: The types of shape_msgs/SolidPrimitive.
_BOX, _SPHERE, _CYLINDER, _CONE = 1, 2, 3, 4


def boxes_of(message: Any) -> Message3d:
    """The objects of a message. Those without a shape, as of radars, have the size of their polygon, or none."""
    head = head_of(message)
    return Message3d(*head, [_box(seen, head) for seen in message.objects])


def _size(shape: Any) -> Vector:
    """The size of the box around a shape; NaN if it has none."""
    kind, lengths = integer(shape.type), [number(dimension) for dimension in shape.dimensions]
    if kind == _BOX and len(lengths) >= 3:
        return lengths[0], lengths[1], lengths[2]
    if kind == _SPHERE and lengths:
        return 2 * lengths[0], 2 * lengths[0], 2 * lengths[0]
    if kind in (_CYLINDER, _CONE) and len(lengths) >= 2:  # height and radius
        return 2 * lengths[1], 2 * lengths[1], lengths[0]
    return UNKNOWN_VECTOR


def _box(seen: Any, head: tuple[int, str]) -> Box3d:
    certainty = integer(seen.classification_certainty)
    centre, size = vector(seen.pose.position), _size(seen.shape)
    orientation = quaternion(part(seen.pose, "orientation"))
    if isnan(size[0]) and (points := [vector(point) for point in part(part(seen, "polygon"), "points") or ()]):
        x, y, z, w = orientation
        along = [rotated((-x, -y, -z, w), point) for point in points]  # the polygon is in the frame of the message
        middle, (length, width, _) = around(along)
        centre, size = rotated(orientation, middle), (length, width, nan)
    return Box3d(
        *own_head(seen, head),
        centre,
        orientation,
        size,
        named(enumeration(seen, _PREFIX) or _CLASSES, seen.classification),
        certainty / _CERTAIN if certainty else nan,
        integer(seen.id),
        vector(seen.twist.linear) if integer(seen.detection_level) == _TRACKED else UNKNOWN_VECTOR,
    )
