"""Adapters for 3D boxes of other software, one module for each family of messages.

A module has a function ``boxes_of``, which takes a decoded message to a ``Message3d``; ``recorded`` makes arrays of all
messages of a channel.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.sources.foreign.boxes_3d import (
    autoware,
    bounding_box_array,
    detection_3d_array,
    markers,
    object_array,
    scene_update,
)
from mcaptrack.sources.foreign.boxes_3d.box import Message3d
from mcaptrack.sources.foreign.decoding import MessageType, decoder_with_errors, plain_name

_FAMILIES: Final[Mapping[str, Callable[[Any], Message3d]]] = {
    "vision_msgs/Detection3DArray": detection_3d_array.boxes_of,
    "foxglove.SceneUpdate": scene_update.boxes_of,
    "visualization_msgs/MarkerArray": markers.boxes_of,
    "visualization_msgs/Marker": markers.boxes_of,
    "jsk_recognition_msgs/BoundingBoxArray": bounding_box_array.boxes_of,
    "derived_object_msgs/ObjectArray": object_array.boxes_of,
} | {
    f"{package}/{name}": autoware.boxes_of
    for package in ("autoware_perception_msgs", "autoware_auto_perception_msgs")
    for name in ("DetectedObjects", "TrackedObjects")
}
__all__ = ["BOXES_3D_READ", "DRAWINGS", "Message3d", "boxes_3d_decoder"]

#: Schemas of 3D boxes, by their names in ROS 1 and Foxglove; ROS 2 adds "/msg/".
BOXES_3D_READ: Final = tuple(_FAMILIES)
#: Those that are drawings: a channel with such messages need not hold boxes.
DRAWINGS: Final = ("foxglove.SceneUpdate", "visualization_msgs/MarkerArray", "visualization_msgs/Marker")


def boxes_3d_decoder(kind: MessageType) -> Callable[[bytes], Message3d]:
    """A function that decodes payloads of a channel to 3D boxes; raises as ``picture_decoder`` does."""
    family = _FAMILIES.get(plain_name(kind.name))
    if family is None:
        raise McaptrackError(f"it holds {kind.name or 'no schema'}, not 3D boxes; {', '.join(BOXES_3D_READ)} are read")
    return decoder_with_errors(kind, family)
