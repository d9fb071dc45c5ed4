"""Read the transforms of a recording: frames of reference, and how they move."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.transform_tree import Poses, PoseSamples, Recorded, TransformTree
from mcaptrack.notices import warn
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.foreign.decoding import decoder_with_errors, plain_name, stamp_of
from mcaptrack.sources.foreign.flatten import message_type_of

#: Schemas of transforms, by their names in ROS 1 and Foxglove; ROS 2 adds "/msg/".
TRANSFORMS_READ: Final = (
    "tf2_msgs/TFMessage",
    "tf/tfMessage",
    "geometry_msgs/TransformStamped",
    "foxglove.FrameTransform",
    "foxglove.FrameTransforms",
)
#: The end of topics where a transform holds until the next one.
_LATCHED: Final = "tf_static"


class _Transform(NamedTuple):
    """A recorded transform, from points of ``child`` to points of ``parent``."""

    parent: str
    child: str
    stamp_ns: int
    translation: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]


class FramesRead(NamedTuple):
    """The transforms of a log: their tree, the topics that they are from, and those that can't be read, with why."""

    tree: TransformTree | None
    topics: tuple[str, ...]
    unread: tuple[str, ...]


_CACHE: Final[WeakKeyDictionary[log.Log, FramesRead]] = WeakKeyDictionary()


def holds_transforms(channel: log.Channel) -> bool:
    """Return whether a channel has recorded transforms; those of views of mcaptrack are none."""
    is_recorded = Provenance.from_metadata(channel.metadata) is None
    return is_recorded and plain_name(channel.schema_name) in TRANSFORMS_READ


def transforms_of(opened: log.Log) -> TransformTree | None:
    """Return the transforms of a log as a tree over time; None if it has none. See ``read_frames``."""
    return read_frames(opened).tree


def read_frames(opened: log.Log) -> FramesRead:
    """Read all transforms of a log. Messages that can't be read are left out, and counted in ``unread``."""
    if opened not in _CACHE:
        _CACHE[opened] = _read(opened)
    return _CACHE[opened]


def warn_of_remarks(opened: log.Log, tree: TransformTree | None, target: str, source: str) -> None:
    """Warn of what is odd in the transforms between two frames."""
    for remark in tree.remarks_between(target, source) if tree else ():
        warn(f"{opened.path}: transforms: {remark.text}", "transforms")


def poses_at(
    opened: log.Log, topic: str, target: str, source: str, stamps_ns: Ints, log_ns: Ints, what: str = "messages"
) -> Poses:
    """Return the poses of a frame in another for messages (N,) of a topic, by their stamps, and warn of gaps.

    If no stamp is within the transforms, and log times are, the stamps are of another clock than those of the
    transforms: poses are looked up by log time. Poses that aren't known are counted in a warning, as those of ``what``.
    """
    tree, _, unread = read_frames(opened)
    tree = tree or TransformTree([])
    for text in unread:
        warn(f"{opened.path}: {text}", "lost")
    poses = tree.lookup(target, source, stamps_ns)
    if len(stamps_ns) and not poses.is_known.any():
        by_log_time = tree.on_log_time.lookup(target, source, log_ns)
        if by_log_time.is_known.any():
            poses, tree = by_log_time, tree.on_log_time
            text = "no stamp is within those of the transforms: they are looked up by log time"
            warn(f"{opened.path}: {topic}: {text}", "clock")
    warn_of_remarks(opened, tree, target, source)
    if poses.unknown:
        why = "; ".join(f"{count:,} {where}" for where, count in poses.unknown.items())
        count = f"{sum(poses.unknown.values()):,} of {len(stamps_ns):,}"
        text = f"{count} {what} are left out, since the pose of {source} in {target} isn't known: {why}"
        warn(f"{opened.path}: {topic}: {text}", "transforms")
    return poses


def _read(opened: log.Log) -> FramesRead:
    by_edge: dict[tuple[str, str, bool], list[tuple[_Transform, int]]] = {}
    topics = [topic for topic, channel in sorted(opened.channels.items()) if holds_transforms(channel)]
    unread: list[str] = []
    for topic in topics:
        is_latched = topic.endswith(_LATCHED)
        bad, why = 0, ""
        try:
            decode = decoder_with_errors(message_type_of(opened, topic), lambda message: list(_transforms(message)))
            for message in opened.timed(topic):
                try:
                    for transform in decode(message.payload):
                        edge = (transform.parent, transform.child, is_latched)
                        by_edge.setdefault(edge, []).append((transform, message.t_ns))
                except McaptrackError as error:
                    bad, why = bad + 1, why or str(error)
        except McaptrackError as error:
            unread.append(f"{topic} can't be read: {error}")
        if bad:
            unread.append(f"{topic}: {bad:,} message{'' if bad == 1 else 's'} can't be read; the first: {why}")
    recorded = [
        Recorded(parent, child, is_latched, _samples(those)) for (parent, child, is_latched), those in by_edge.items()
    ]
    return FramesRead(TransformTree(recorded) if recorded else None, tuple(topics), tuple(unread))


def _samples(those: list[tuple[_Transform, int]]) -> PoseSamples:
    return PoseSamples(
        np.array([transform.stamp_ns for transform, _ in those], np.int64),
        np.array([t_ns for _, t_ns in those], np.int64),
        np.array([transform.translation for transform, _ in those], np.float64),
        np.array([transform.quaternion for transform, _ in those], np.float64),
    )


def _transforms(message: Any) -> Iterator[_Transform]:
    """Yield the transforms of a message of any of the schemas."""
    if hasattr(message, "transforms"):
        for transform in message.transforms:
            yield from _transforms(transform)
        return
    if hasattr(message, "parent_frame_id"):
        parent, inner = message.parent_frame_id, message
    else:
        parent, inner = message.header.frame_id, message.transform
    child = message.child_frame_id
    if not isinstance(parent, str) or not isinstance(child, str):
        raise ValueError("names of frames are text")
    x, y, z = (float(getattr(inner.translation, axis)) for axis in "xyz") if _has(inner, "translation") else (0.0,) * 3
    turn = (
        [float(getattr(inner.rotation, axis)) for axis in "xyzw"] if _has(inner, "rotation") else [0.0, 0.0, 0.0, 1.0]
    )
    yield _Transform(parent, child, stamp_of(message), (x, y, z), (turn[0], turn[1], turn[2], turn[3]))


def _has(message: Any, name: str) -> bool:
    """Return whether an optional field of a message is set: in protobuf and JSON it may be missing."""
    if hasattr(message, "HasField"):
        return bool(message.HasField(name))
    return getattr(message, name, None) is not None
