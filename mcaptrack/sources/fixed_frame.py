"""Read boxes of other software, those in space in the fixed frame.

Boxes in a sensor's frame are brought to a frame that doesn't move, by the transforms of the log at their stamps; all
later stages are in this frame.

Letters: N boxes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from itertools import islice
from typing import Any, Final, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError, list_names
from mcaptrack.geometry.angles import headings
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.oriented_boxes import COLUMNS
from mcaptrack.geometry.transform_tree import Poses, PoseSamples, Recorded, TransformTree, plain_frame, turned
from mcaptrack.notices import warn
from mcaptrack.schema import DETECTIONS, SCORES_NEEDED, Frame, Rows
from mcaptrack.schema.classes import UNKNOWN
from mcaptrack.schema.provenance import Provenance, frame_id_of, input_of
from mcaptrack.sources import foreign
from mcaptrack.sources.foreign.boxes_3d.recorded import Recorded3d, recorded
from mcaptrack.sources.foreign.decoding import decoder_with_errors, plain_name, stamp_of
from mcaptrack.sources.foreign.flatten import message_type_of

#: Messages of a channel of drawings in which boxes are looked for.
_TRIED: Final = 50
_LISTED: Final = 8


# Read the transforms of a recording: frames of reference, and how they move.


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


_FRAMES_CACHE: Final[WeakKeyDictionary[log.Log, FramesRead]] = WeakKeyDictionary()


def holds_transforms(channel: log.Channel) -> bool:
    """Return whether a channel has recorded transforms; those of views of mcaptrack are none."""
    is_recorded = Provenance.from_metadata(channel.metadata) is None
    return is_recorded and plain_name(channel.schema_name) in TRANSFORMS_READ


def transforms_of(opened: log.Log) -> TransformTree | None:
    """Return the transforms of a log as a tree over time; None if it has none. See ``read_frames``."""
    return read_frames(opened).tree


def read_frames(opened: log.Log) -> FramesRead:
    """Read all transforms of a log. Messages that can't be read are left out, and counted in ``unread``."""
    if opened not in _FRAMES_CACHE:
        _FRAMES_CACHE[opened] = _read(opened)
    return _FRAMES_CACHE[opened]


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


_CACHE: Final[WeakKeyDictionary[log.Log, dict[str, bool]]] = WeakKeyDictionary()


def holds_boxes(opened: log.Log, topic: str) -> bool:
    """Whether a channel has boxes of other software: in pictures, or in space.

    Drawings are boxes if there is one among the first messages.
    """
    channel = opened.channel(topic)
    return foreign.holds_detections(channel) or holds_boxes_3d(opened, topic)


def holds_boxes_3d(opened: log.Log, topic: str) -> bool:
    """Whether a channel has 3D boxes of other software, as ``holds_boxes`` says."""
    channel = opened.channel(topic)
    if not foreign.may_hold_boxes_3d(channel):
        return False
    if not foreign.is_drawing(channel):
        return True
    cached = _CACHE.setdefault(opened, {})
    if topic not in cached:
        try:
            cached[topic] = any(message.boxes for _, message in islice(foreign.boxes_3d(opened, topic), _TRIED))
        except McaptrackError:
            cached[topic] = False
    return cached[topic]


def named_detections(opened: log.Log, topic: str, frame_id: str = "") -> foreign.NamedFrames:
    """The boxes of other software as rows of detections, with the names of classes and of their frame.

    Parameters
    ----------
    opened : Log
        The log.
    topic : str
        A channel of boxes.
    frame_id : str
        The frame that boxes in space are brought to; by default that of the tracks that were made from them, or else
        the root of the tree that their frame is in.

    Returns
    -------
    NamedFrames
        For boxes in pictures one frame for each message, at its log time. For boxes in space one for each stamp.

    Raises
    ------
    McaptrackError
        If a message can't be read, or if the pose of no box is known.
    """
    if not foreign.may_hold_boxes_3d(opened.channel(topic)):
        return foreign.named_detections(opened, topic)
    boxes, unnamed = recorded(foreign.boxes_3d(opened, topic)).in_usual_frame()
    for remark, count in boxes.remarks.items():
        warn(f"{opened.path}: {topic}: {count:,} {remark}", "left-out")
    if unnamed:
        usual = boxes.names[np.bincount(boxes.frame).argmax()]
        remark = f"boxes name no frame: they count as in {usual}, as most others are"
        warn(f"{opened.path}: {topic}: {unnamed:,} of {len(boxes.frame):,} {remark}", "transforms")
    fixed = _fixed_frame(opened, topic, boxes, plain_frame(frame_id))
    is_known, rotation, shift = _poses(opened, topic, boxes, fixed)
    start_ns, frame, assumed = boxes.frames()
    if assumed:
        warn(f"{opened.path}: {topic}: {assumed}", "clock")
    is_repeated = boxes.is_repeated(frame)
    is_left_out = np.zeros(len(start_ns), bool)
    is_left_out[frame[~is_known]] = True  # nothing is known then, unlike in a frame without boxes
    is_left_out[frame[is_known]] = False
    if repeated := int(is_repeated.sum()):
        remark = "boxes are recorded again, with the same stamp and numbers: they are left out"
        warn(f"{opened.path}: {topic}: {repeated:,} of {len(frame):,} {remark}", "left-out")
    is_taken = is_known & ~is_repeated
    boxes, frame = boxes.select(is_taken), frame[is_taken]
    _warn_odd(opened, topic, boxes)
    rows = rows_of_boxes(boxes, rotation[is_taken], shift[is_taken], f"{opened.path}: {topic}")
    names = foreign.settle_classes(opened, topic, boxes.classes, [rows])
    if nameless := boxes.classes.nameless(np.unique(rows["class_id"]).tolist()):
        listed = list_names([*map(str, nameless)], _LISTED)
        remark = "1 counts as people, and others move as objects of unknown class do"
        warn(f"{opened.path}: classes of {topic} are numbers without names ({listed}): {remark}", "classes")
    if unclassed := int((rows["class_id"] == UNKNOWN).sum()):
        remark = "boxes have no class, or 0: they move as objects of unknown class do"
        warn(f"{opened.path}: {topic}: {unclassed:,} of {len(rows):,} {remark}", "classes")
    if not assumed and (several := boxes.of_several_messages(frame)):
        remark = "times have boxes of several messages, where others have those of one, as if a clock was set back"
        warn(f"{opened.path}: {topic}: {several:,} of {len(start_ns):,} {remark}: they count as one frame", "clock")
    order = np.argsort(frame, kind="stable")
    parts = np.split(rows[order], np.searchsorted(frame[order], np.arange(1, len(start_ns))))
    kept = np.flatnonzero(~is_left_out).tolist()
    times = start_ns.tolist()
    frames = [Frame(times[at], index, parts[at]) for index, at in enumerate(kept)]
    return foreign.NamedFrames(frames, names, fixed)


class BoxesRead:
    """Boxes of other software that were read from a log, for later steps: decoding them takes long."""

    def __init__(self) -> None:
        self._frames: dict[str, foreign.NamedFrames] = {}

    def read(self, opened: log.Log, topic: str, frame_id: str = "") -> foreign.NamedFrames:
        """Return the boxes of a channel as ``named_detections`` does; each channel is decoded only once."""
        wanted = plain_frame(frame_id) or _frame_before(opened, topic)
        stored = self._frames.get(topic)
        if stored is None or stored.frame_id != (wanted or stored.frame_id):
            self._frames[topic] = stored = named_detections(opened, topic, frame_id)
        return stored

    def in_space(self) -> dict[str, foreign.NamedFrames]:
        """Return the boxes in space that were read, by topic."""
        return {topic: boxes for topic, boxes in self._frames.items() if boxes.frame_id}


def _fixed_frame(opened: log.Log, topic: str, boxes: Recorded3d, wanted: str) -> str:
    """The frame that boxes are brought to. Raises McaptrackError if there is no such frame."""
    counts = Counter(boxes.frame.tolist())
    usual = boxes.names[counts.most_common(1)[0][0]] if counts else ""
    tree = transforms_of(opened)
    frames = set(tree.frames() if tree else ()) | set(boxes.names)
    if wanted:
        if boxes.names and wanted not in frames:
            listed = list_names(sorted(frames), _LISTED)
            raise McaptrackError(
                f"{opened.path}: there is no frame {wanted} for the boxes of {topic}; there are {listed}"
            )
        if tree and (
            moving := [series for series in tree.between(tree.root_of(wanted), wanted) or () if not series.is_static]
        ):
            text = f"{wanted} moves ({moving[0]} isn't static), and so do objects that stand"
            warn(f"{opened.path}: {topic}: {text}; tracks should be in a frame that doesn't move", "transforms")
        return wanted
    if (before := _frame_before(opened, topic)) and before in frames:
        return before
    if tree is None or usual not in tree.frames():
        if counts and not usual:
            text = "boxes name no frame: they stay as they are, in a frame without a name"
            warn(f"{opened.path}: {topic}: {text}", "transforms")
        elif counts:
            why = "the log has no transforms" if tree is None else _unknown(tree, usual)
            warn(f"{opened.path}: {topic}: {why}, so that boxes stay in their frame, {usual}", "transforms")
        if "optical" in usual:
            text = f"z is ahead and y down in {usual}, so that x and y are no positions on the ground"
            warn(f"{opened.path}: {topic}: {text}; `frame=` names another frame", "transforms")
        return usual
    return tree.root_of(usual)


def _frame_before(opened: log.Log, topic: str) -> str:
    """The frame of a channel that was made from these boxes; "" if there is none."""
    metadata = (channel.metadata for channel in opened.channels.values() if input_of(channel.metadata) == topic)
    return next(filter(None, map(frame_id_of, metadata)), "")


def _unknown(tree: TransformTree, frame: str) -> str:
    return f"no transform has the frame {frame!r} (but {list_names(tree.frames(), _LISTED)})"


def _poses(opened: log.Log, topic: str, boxes: Recorded3d, fixed: str) -> tuple[Bools, Floats, Floats]:
    """Whether the pose of the frame of each box is known (N,), its rotation (N, 3, 3) and translation (N, 3).

    Raises McaptrackError if none is.
    """
    count = len(boxes.frame)
    rotation, shift = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    is_known = np.ones(count, bool)
    for number, name in enumerate(boxes.names):
        mine = boxes.frame == number
        if not mine.any():
            continue
        if name == fixed:
            warn_of_remarks(opened, transforms_of(opened), fixed, name)
            continue
        # Boxes of a message have the same pose, mostly.
        stamps = np.where(boxes.stamp_ns > 0, boxes.stamp_ns, boxes.log_ns)[mine]
        times, place = np.unique(np.stack([stamps, boxes.log_ns[mine]]), axis=1, return_inverse=True)
        what = "messages" if len(boxes.names) == 1 else f"messages have boxes in {name} that"
        poses = poses_at(opened, topic, fixed, name, times[0], times[1], what)
        place = place.reshape(-1)
        is_known[mine] = poses.is_known[place]
        rotation[mine], shift[mine] = poses.rotation[place], poses.translation[place]
    if count and not is_known.any():
        raise McaptrackError(
            f"{opened.path}: the pose of no box of {topic} in {fixed} is known; {_connected(opened, boxes)} "
            "`frame=` names another frame, such as that of the boxes"
        )
    return is_known, rotation, shift


def _connected(opened: log.Log, boxes: Recorded3d) -> str:
    transforms = transforms_of(opened)
    frames = list_names(transforms.frames() if transforms else [], _LISTED)
    return f"boxes are in {list_names(boxes.names, _LISTED)}, and transforms have {frames};"


def _warn_odd(opened: log.Log, topic: str, boxes: Recorded3d) -> None:
    """Warn of boxes that have the log time instead of their stamp, and of scores that are none."""
    _, count = boxes.times()
    if count:
        text = "have no stamp, or one that is more than 60 s from the log time: their time is the log time"
        warn(f"{opened.path}: {topic}: {count:,} of {len(boxes.stamp_ns):,} boxes {text}", "clock")
    if ((boxes.score < 0) | (boxes.score > 1)).any():
        low, high = np.nanmin(boxes.score), np.nanmax(boxes.score)
        warn(f"{opened.path}: {topic}: scores are from {low:g} to {high:g}; {SCORES_NEEDED}")


def rows_of_boxes(boxes: Recorded3d, rotation: Floats, shift: Floats, where: str = "") -> Rows:
    """Boxes as rows of detections (N,), from the poses of their frames: (N, 3, 3) and (N, 3). Classes are not settled.

    ``where`` is named in warnings.
    """
    from scipy.spatial.transform import Rotation

    count = len(boxes.frame)
    axes = np.empty((0, 3, 3)) if not count else rotation @ Rotation.from_quat(boxes.orientation).as_matrix()
    has_z = np.isfinite(boxes.centre[:, 2])
    centre = turned(rotation, np.where(has_z[:, None] | [True, True, False], boxes.centre, 0.0)) + shift
    velocity = turned(rotation, boxes.velocity)
    # The axis that is most upright is that of the height; of the others the first is that of the length.
    up = np.abs(axes[:, 2]).argmax(axis=1) if count else np.empty(0, np.intp)
    along, across = np.where(up == 0, 1, 0), np.where(up == 2, 1, 2)
    here = np.arange(count)
    heading = headings(axes[here, :, along])
    lying = int((up[boxes.has_heading] != 2).sum())
    if lying:
        text = "boxes stand on another side than that of their z axis: their height is along the axis that is upright"
        warn(f"{where}: {lying:,} {text}")
    centre[~has_z, 2], heading[~boxes.has_heading] = np.nan, np.nan
    size = [boxes.size[here, axis] for axis in (along, across, up)]
    columns = dict(zip(COLUMNS, [*centre.T, *size, heading], strict=True))
    columns |= {"vx_m_per_s": velocity[:, 0], "vy_m_per_s": velocity[:, 1]}
    return DETECTIONS.rows(score=boxes.score, class_id=boxes.class_id, source_id=boxes.source_id, **columns)
