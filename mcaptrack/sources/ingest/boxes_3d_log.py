"""Find the 3D boxes of a log that labels belong to."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from mcaptrack import log, notices
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.transform_tree import plain_frame
from mcaptrack.notices import warn
from mcaptrack.schema import DETECTIONS, TRACKS
from mcaptrack.schema.framing import frame_times as frame_times_of
from mcaptrack.schema.provenance import INGEST, Provenance, frame_id_of
from mcaptrack.sources.fixed_frame import holds_boxes_3d, named_detections
from mcaptrack.sources.frames import transforms_of
from mcaptrack.sources.ingest.labels.camera import DEFAULT, camera_prefix

_TRUTH: Final = "truth"
_LISTED: Final = 8


def boxes_topic(opened: log.Log, camera: str) -> str:
    """The topic of the 3D boxes below the name of a camera, or the only one of the log; "" if there is none.

    Raises McaptrackError if there are several, and no name is given.
    """
    topics = sorted(
        channel.topic for channel in opened.channels.values() if channel.messages and _holds_boxes(opened, channel)
    )
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


def _holds_boxes(opened: log.Log, channel: log.Channel) -> bool:
    made = Provenance.from_metadata(channel.metadata)
    if made is None:
        return holds_boxes_3d(opened, channel.topic)
    is_truth = channel.topic.endswith(f"/{_TRUTH}")
    return (
        made.transform == INGEST
        and channel.schema_name in (DETECTIONS.name, TRACKS.name)
        and bool(made.frame_id and not is_truth)
    )


def frame_times(opened: log.Log, topic: str) -> Ints:
    """The times of the frames of 3D boxes (F,): the stamps of recorded messages."""
    if Provenance.from_metadata(opened.channel(topic).metadata) is not None:
        return np.asarray(opened.times(topic), np.int64)
    with notices.collected():  # the command that tracks the boxes says it
        return frame_times_of(named_detections(opened, topic).frames)


def root_frame(opened: log.Log) -> str:
    """The only root of the transforms of a log; "" if it has none, or several."""
    tree = transforms_of(opened)
    roots = tree.roots() if tree is not None else []
    return roots[0] if len(roots) == 1 else ""


def warn_of_frame(opened: log.Log, frame_id: str, labels: Path) -> None:
    """Warn if a log has frames of reference, and not the one of labels."""
    tree = transforms_of(opened)
    known = set(tree.frames() if tree else ()) | {frame_id_of(one.metadata) for one in opened.channels.values()} - {""}
    if known and plain_frame(frame_id) not in known:
        listed = sorted(known)
        there = ", ".join(listed[:_LISTED]) + (", ..." if len(listed) > _LISTED else "")
        words = f"there is no frame {frame_id} in {opened.path} (but {there}), so that its tracks can't be compared"
        warn(f"{labels}: {words} with these boxes", "transforms")
