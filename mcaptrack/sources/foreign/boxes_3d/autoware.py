"""DetectedObjects and TrackedObjects of Autoware (autoware_perception_msgs, autoware_auto_perception_msgs)."""

from __future__ import annotations

from math import isfinite, nan
from typing import Any, Final

from mcaptrack.sources.foreign.boxes_3d.box import (
    UNKNOWN_VECTOR,
    Box3d,
    Message3d,
    Vector,
    around,
    enumeration,
    head_of,
    moved,
    named,
    number,
    part,
    quaternion,
    rotated,
    vector,
)
from mcaptrack.sources.foreign.decoding import integer, to_bytes

#: The labels of ObjectClassification, for messages without their definition (JSON). Earlier ones had no bus.
_CLASSES: Final = {
    0: "",
    1: "car",
    2: "truck",
    3: "bus",
    4: "trailer",
    5: "motorcycle",
    6: "bicycle",
    7: "pedestrian",
    8: "animal",
    9: "hazard",
    10: "over_drivable",
    11: "under_drivable",
}
_CYLINDER, _POLYGON = 1, 2
_HEADING_UNKNOWN: Final = 0


def boxes_of(message: Any) -> Message3d:
    """The objects of a message."""
    head = head_of(message)
    return Message3d(*head, [_box(item, head) for item in message.objects])


def _box(item: Any, head: tuple[int, str]) -> Box3d:
    kinematics, shape = item.kinematics, item.shape
    pose = kinematics.pose_with_covariance.pose
    centre, orientation, size = vector(pose.position), quaternion(part(pose, "orientation")), vector(shape.dimensions)
    if integer(shape.type) == _CYLINDER:  # x is the diameter
        size = (size[0], size[0], size[2])
    elif integer(shape.type) == _POLYGON:
        middle, size = _footprint([vector(point) for point in shape.footprint.points], size[2])
        centre = moved(centre, orientation, middle)
    velocity = UNKNOWN_VECTOR
    if getattr(kinematics, "has_twist", True):  # along the axes of the object
        velocity = rotated(orientation, vector(kinematics.twist_with_covariance.twist.linear))
    name, probability = _class_of(item)
    existence = number(item.existence_probability)
    return Box3d(
        *head,
        centre,
        orientation,
        size,
        name,
        existence if existence > 0 else probability,
        _id(item),
        velocity,
        integer(kinematics.orientation_availability) != _HEADING_UNKNOWN,
    )


def _class_of(item: Any) -> tuple[str, float]:
    """The likeliest class, and its probability; "" and NaN if there is none."""
    guesses = [(number(guess.probability), guess) for guess in item.classification]
    shares = [(share if isfinite(share) else -1.0, guess) for share, guess in guesses]
    if not shares:
        return "", nan
    share, guess = max(shares, key=lambda pair: pair[0])
    return named(enumeration(guess) or _CLASSES, guess.label), share if share > 0 else nan


def _footprint(points: list[Vector], height: float) -> tuple[Vector, Vector]:
    """Middle and size of the upright box around a footprint, along the axes of the object."""
    if not points:
        return (0.0, 0.0, 0.0), (nan, nan, height)
    (x, y, _), (length, width, _) = around(points)
    return (x, y, 0.0), (length, width, height)


def _id(item: Any) -> str | None:
    """The UUID of a tracked object, in hexadecimal; None for a detected one."""
    uuid = part(item, "object_id")
    return None if uuid is None else to_bytes(uuid.uuid).hex()
