"""derived_object_msgs/ObjectArray."""

from __future__ import annotations

from math import nan
from typing import Any, Final

from mcaptrack.sources.foreign.boxes_3d.box import (
    UNKNOWN_VECTOR,
    Box3d,
    Message3d,
    Vector,
    enumeration,
    head_of,
    named,
    number,
    own_head,
    part,
    quaternion,
    vector,
)
from mcaptrack.sources.foreign.values import integer

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
    """The objects of a message that have a shape."""
    head = head_of(message)
    out = Message3d(*head)
    for one in message.objects:
        size = _size(one.shape)
        if size is None:
            out.ignored["objects without a shape"] += 1
        else:
            out.boxes.append(_box(one, head, size))
    return out


def _size(shape: Any) -> Vector | None:
    """The size of the box around a shape; None if it has none."""
    kind, lengths = integer(shape.type), [number(one) for one in shape.dimensions]
    if kind == _BOX and len(lengths) >= 3:
        return lengths[0], lengths[1], lengths[2]
    if kind == _SPHERE and lengths:
        return 2 * lengths[0], 2 * lengths[0], 2 * lengths[0]
    if kind in (_CYLINDER, _CONE) and len(lengths) >= 2:  # height and radius
        return 2 * lengths[1], 2 * lengths[1], lengths[0]
    return None


def _box(one: Any, around: tuple[int, str], size: Vector) -> Box3d:
    certainty = integer(one.classification_certainty)
    return Box3d(
        *own_head(one, around),
        vector(one.pose.position),
        quaternion(part(one.pose, "orientation")),
        size,
        named(enumeration(one, _PREFIX) or _CLASSES, one.classification),
        certainty / _CERTAIN if certainty else nan,
        integer(one.id),
        vector(one.twist.linear) if integer(one.detection_level) == _TRACKED else UNKNOWN_VECTOR,
    )
