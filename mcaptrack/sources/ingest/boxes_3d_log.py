"""Find the 3D boxes of a log that labels belong to."""

from __future__ import annotations

from typing import Final

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.schema import DETECTIONS, TRACKS
from mcaptrack.schema.provenance import INGEST, Provenance
from mcaptrack.sources.foreign.decoding import plain_name
from mcaptrack.sources.frames import transforms_of
from mcaptrack.sources.ingest.labels.camera import DEFAULT, camera_prefix

#: Schemas that may hold 3D boxes, by their names in ROS 1 and Foxglove.
_BOXES_3D: Final = (
    "vision_msgs/Detection3DArray",
    "foxglove.SceneUpdate",
    "visualization_msgs/MarkerArray",
    "jsk_recognition_msgs/BoundingBoxArray",
    "derived_object_msgs/ObjectArray",
    "autoware_perception_msgs/DetectedObjects",
    "autoware_auto_perception_msgs/DetectedObjects",
)
_TRUTH: Final = "truth"


def boxes_topic(opened: log.Log, camera: str) -> str:
    """The topic of the 3D boxes below the name of a camera, or the only one of the log; "" if there is none.

    Raises McaptrackError if there are several, and no name is given.
    """
    topics = sorted(channel.topic for channel in opened.channels.values() if channel.messages and _holds_boxes(channel))
    if camera != DEFAULT:
        topics = [topic for topic in topics if camera_prefix(topic) == "/" + camera.strip("/")]
        return topics[0] if topics else ""
    prefixes = sorted({camera_prefix(topic) for topic in topics})
    if len(prefixes) > 1:
        raise McaptrackError(
            f"{opened.path} has 3D boxes in several places, {', '.join(topics)}; labels belong to those of one: choose "
            f"with `camera={prefixes[0].strip('/')!r}`"
        )
    return topics[0] if topics else ""


def _holds_boxes(channel: log.Channel) -> bool:
    made = Provenance.from_metadata(channel.metadata)
    if made is None:
        return plain_name(channel.schema_name) in _BOXES_3D
    is_truth = channel.topic.endswith(f"/{_TRUTH}")
    return (
        made.transform == INGEST
        and channel.schema_name in (DETECTIONS.name, TRACKS.name)
        and bool(made.frame_id and not is_truth)
    )


def root_frame(opened: log.Log) -> str:
    """The only root of the transforms of a log; "" if it has none, or several."""
    tree = transforms_of(opened)
    roots = tree.roots() if tree is not None else []
    return roots[0] if len(roots) == 1 else ""
