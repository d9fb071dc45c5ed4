"""jsk_recognition_msgs/BoundingBoxArray."""

from __future__ import annotations

from math import nan
from typing import Any

from mcaptrack.sources.foreign.boxes_3d.box import Box3d, Message3d, head_of, number, own_head, part, quaternion, vector
from mcaptrack.sources.foreign.decoding import integer


def boxes_of(message: Any) -> Message3d:
    """The boxes of a message."""
    head = head_of(message)
    return Message3d(*head, [_box(box, head) for box in message.boxes])


def _box(box: Any, around: tuple[int, str]) -> Box3d:
    return Box3d(
        *own_head(box, around),
        vector(box.pose.position),
        quaternion(part(box.pose, "orientation")),
        vector(box.dimensions),
        str(integer(box.label)),
        number(box.value) or nan,  # 0 where no value is set
    )
