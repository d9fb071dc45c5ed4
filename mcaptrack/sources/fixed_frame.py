"""Read boxes of other software, those in space in the fixed frame.

Boxes in a sensor's frame are brought to a frame that doesn't move, by the transforms of the log at their stamps; all
later stages are in this frame.

Letters: N boxes.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError, list_names, offer
from mcaptrack.geometry.arrays import Bools, Floats, Ints, joined, taken
from mcaptrack.geometry.boxes import ORIENTED_COLUMNS, headings
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.transform_tree import (
    OTHER_CLOCK_S,
    Poses,
    PoseSamples,
    Recorded,
    TransformTree,
    plain_frame,
    turned,
)
from mcaptrack.notices import warn
from mcaptrack.schema import DETECTIONS, Frame, Rows
from mcaptrack.schema.classes import UNKNOWN
from mcaptrack.schema.names import plain_name, shared_parts
from mcaptrack.schema.provenance import Provenance, frame_id_of, input_of
from mcaptrack.sources import foreign
from mcaptrack.sources.foreign.boxes import (
    BOXES_READ,
    ClassesRead,
    Reading,
    choice_for,
    classes_of,
    facts_of,
    named_boxes,
    read_classes,
)
from mcaptrack.sources.foreign.decoding import unpacker
from mcaptrack.sources.foreign.fields import Message3d, Seen3d
from mcaptrack.sources.foreign.flatten import payload_decoder
from mcaptrack.sources.foreign.things import EACH, Path, Things, read_channel

# All 3D boxes of a channel as arrays, in the frames that they were recorded in.
#
# Letters: M messages, N boxes, F frames (times).


#: Messages with stamps this close are one measurement, as where each box is a message.
_SAME_NS: Final = 1_000_000
#: Centres that are farther away are no positions.
_FARTHEST_M: Final = 1e9
_NUMBER: Final = re.compile(r"\d{1,18}", re.ASCII)


# Find the sweeps of a sensor where a detector writes several messages for each, such as one for each object.
#
# These messages have nearly the same stamp, or were written in a burst. So the gaps between their times are of two
# kinds: short ones within a sweep, long ones between two. An object is in a sweep once, so a box is nearer to a box
# of the next sweep, the same object, than to the others of its own.
#
# Letters: T times, N boxes.


#: The objects of a sweep are measured, and written, within this time.
_LONGEST_NS: Final = NS_PER_S // 4
#: Shorter gaps count as this.
_SHORTEST_NS: Final = 1_000_000
#: Gaps between sweeps are longer by this factor than those within.
_MIN_RATIO: Final = 1.5
#: The number of ways of dividing gaps that are tried, and that of sweeps by which a way is judged.
_RECORDED_TRIED: Final = 5
_JUDGED: Final = 300
#: With fewer sweeps, gaps say nothing.
_MIN_SWEEPS: Final = 3
#: No object is faster, in m/s.
_FASTEST: Final = 100.0


def find_sweeps(t_ns: Ints, log_ns: Ints, place: Ints, centre_m: Floats, class_id: Ints) -> Ints | None:
    """The sweep of each of T times, as numbers that rise with time; None if there is no sign of longer sweeps.

    ``t_ns`` and ``log_ns`` (T,) are when boxes were measured and written, ``place`` (N,) is the time of each box by its
    number. Centres (N, 3) are in the frame of the sensor.
    """
    for times in (t_ns, log_ns):
        gaps = np.maximum(np.diff(np.sort(times)), _SHORTEST_NS)
        for limit in _limits(gaps):
            sweep = _chains(times, limit)
            if _are_sweeps(sweep, t_ns, log_ns, place, centre_m, class_id):
                return sweep
    return None


def are_mixed(t_ns: Ints, place: Ints, centre_m: Floats) -> bool:
    """Whether most of T rising times have a single box, of another object than the box before it."""
    counts = np.bincount(place, minlength=len(t_ns))
    if len(t_ns) < 4 * _MIN_SWEEPS or not len(place) or (counts[counts > 0] == 1).mean() < 0.9:
        return False
    order = np.argsort(place, kind="stable")
    way = np.linalg.norm(np.diff(np.nan_to_num(centre_m[order]), axis=0), axis=1)
    passed_s = np.diff(t_ns[place[order]]) / NS_PER_S
    return bool((way > 1.0 + _FASTEST * passed_s).mean() > 0.5)


def _limits(gaps: Ints) -> list[int]:
    """Lengths of gaps up to which times may belong together, the most distinct first."""
    lengths = np.sort(gaps)
    if len(lengths) < 2 * _MIN_SWEEPS:
        return []
    ratio = lengths[1:] / lengths[:-1]
    ratio[-1] = 0  # one gap alone may be a pause
    likely = np.argsort(-ratio, kind="stable")[:_RECORDED_TRIED]
    return [int(lengths[place]) for place in likely.tolist() if ratio[place] >= _MIN_RATIO]


def _chains(times: Ints, limit: int) -> Ints:
    """The chain of each of T times: times that are at most ``limit`` apart are in one."""
    order = np.argsort(times, kind="stable")
    chain = np.empty(len(times), np.int64)
    chain[order] = np.concatenate([[0], np.cumsum(np.maximum(np.diff(times[order]), _SHORTEST_NS) > limit)])
    return chain


def _are_sweeps(sweep: Ints, t_ns: Ints, log_ns: Ints, place: Ints, centre_m: Floats, class_id: Ints) -> bool:
    """Whether groups of T times are sweeps: short, of several times mostly, and without an object twice."""
    count = np.bincount(sweep)
    with_boxes = np.bincount(sweep[np.unique(place)])
    if len(count) < _MIN_SWEEPS or not (with_boxes > 1).sum() >= (with_boxes == 1).sum():
        return False
    for times in (t_ns, log_ns):
        first, last = np.full(len(count), np.iinfo(np.int64).max), np.full(len(count), np.iinfo(np.int64).min)
        np.minimum.at(first, sweep, times)
        np.maximum.at(last, sweep, times)
        if (last - first).max() > _LONGEST_NS:
            return False
    return _share_repeated(sweep[place], centre_m, class_id) < 0.5


def _share_repeated(sweep: Ints, centre_m: Floats, class_id: Ints) -> float:
    """The share of boxes (N,) that are nearer to another of their own sweep than to all of the next one."""
    order = np.argsort(sweep, kind="stable")
    numbers, begins = np.unique(sweep[order], return_index=True)
    if len(numbers) < _MIN_SWEEPS:
        return 1.0
    parts = np.split(order, begins[1:])
    judged = np.unique(np.linspace(0, len(numbers) - 2, min(len(numbers) - 1, _JUDGED)).astype(int))
    compared = repeated = 0
    for number in judged.tolist():
        own = _nearest(parts[number], parts[number], centre_m, class_id)
        later = _nearest(parts[number], parts[number + 1], centre_m, class_id)
        compared += int(np.isfinite(later).sum())
        repeated += int((own < later).sum() - (np.isfinite(own) & np.isinf(later)).sum())
    return repeated / compared if compared else 1.0


def _nearest(some: Ints, others: Ints, centre_m: Floats, class_id: Ints) -> Floats:
    """The distance (S,) of boxes to the nearest other box of their class, except boxes at the same place."""
    places = np.nan_to_num(centre_m)
    away = np.linalg.norm(places[some][:, None] - places[others], axis=2)
    is_other = (class_id[some][:, None] == class_id[others]) & (away > 0)
    return np.asarray(np.where(is_other, away, np.inf).min(axis=1, initial=np.inf))


#: Columns of boxes that are as in messages (``Boxes3d``).
_AS_IN_MESSAGES: Final = (
    *("message", "stamp_ns", "centre", "orientation", "size", "velocity", "has_heading", "score"),
)


@dataclass(frozen=True)
class Recorded3d:
    """The boxes of a channel.

    Attributes
    ----------
    names : list of str
        Names of frames; ``frame`` (N,) are indices of these.
    message : (N,) of int64
        Index of the message of each box.
    stamp_ns, log_ns : (N,) of int64
        Stamp of each box, 0 where it has none; and log time.
    centre, orientation, size, velocity : (N, 3), (N, 4), (N, 3) and (N, 3)
        In the frame of each box; sizes, velocities and z of centres are NaN where they are unknown.
    has_heading : (N,) of bool
        Whether the orientation is known.
    score : (N,)
        NaN where there is none.
    class_id, source_id : (N,) of int64
        Ids of ``classes``; ids of the detector, -1 where there is none.
    message_ns, message_stamp_ns : (M,) of int64
        Log time and stamp of each message.
    is_measured : (M,) of bool
        False for messages that only take drawings away.
    remarks : dict of str to int
        What is odd, in words, and how often.
    """

    names: list[str]
    frame: Ints
    message: Ints
    stamp_ns: Ints
    log_ns: Ints
    centre: Floats
    orientation: Floats
    size: Floats
    velocity: Floats
    has_heading: Bools
    score: Floats
    class_id: Ints
    source_id: Ints
    classes: ClassesRead
    message_ns: Ints
    message_stamp_ns: Ints
    is_measured: Bools
    remarks: dict[str, int]

    def select(self, kept: Bools) -> Recorded3d:
        """The boxes of a mask (N,); messages stay."""
        names = (*_AS_IN_MESSAGES, "frame", "log_ns", "class_id", "source_id")
        return replace(self, **{name: getattr(self, name)[kept] for name in names})

    def times(self) -> tuple[Ints, int]:
        """When each box was measured (N,), in ns: its stamp, or the log time; and the number of log times."""
        is_off = _is_off(self.stamp_ns, self.log_ns)
        return np.where(is_off, self.log_ns, self.stamp_ns), int(is_off.sum())

    def in_usual_frame(self) -> tuple[Recorded3d, int]:
        """Put boxes without a frame into the frame that most boxes name; also returns their number."""
        counts = np.bincount(self.frame, minlength=len(self.names))
        unnamed = [number for number, name in enumerate(self.names) if not name]
        counts[unnamed] = 0
        if not unnamed or not counts.any():
            return self, 0
        is_unnamed = np.isin(self.frame, unnamed)
        return replace(self, frame=np.where(is_unnamed, counts.argmax(), self.frame)), int(is_unnamed.sum())

    def is_repeated(self, frame: Ints) -> Bools:
        """Mark boxes (N,) that repeat an earlier box of their frame (N,), as in messages recorded twice."""
        out = np.zeros(len(frame), bool)
        many = max(len(self.message_ns), 1)
        several = np.bincount(np.unique(frame * many + self.message) // many) > 1  # frames of several messages
        some = np.flatnonzero(several[frame]) if several.any() else np.empty(0, np.intp)
        states = (frame[:, None], self.frame[:, None], self.class_id[:, None], self.score[:, None])
        state = np.concatenate([*states, self.centre, self.size, self.orientation], axis=1)[some]
        order = np.lexsort(state.T)
        before, after = state[order[:-1]], state[order[1:]]
        out[some[order[1:]]] = ((before == after) | (np.isnan(before) & np.isnan(after))).all(axis=1)
        return out

    def of_several_messages(self, frame: Ints) -> int:
        """Count frames with boxes of several messages, if most have one; ``frame`` (N,) is by box.

        0 where each message has one box: then they are parts of a frame.
        """
        many = max(len(self.message_ns), 1)
        if np.bincount(self.message, minlength=1).max() < 2:
            return 0
        counts = np.unique(np.unique(frame * many + self.message) // many, return_counts=True)[1]
        return int((counts > 1).sum()) if np.median(counts) < 2 else 0

    def frames(self) -> tuple[Ints, Ints, str]:
        """The times of F frames in ns (F,), increasing, the frame of each box (N,), and what was assumed, in words.

        A message is a frame, unless the stamps of its boxes are far apart; so are messages with one stamp, and those of
        one sweep. Messages without boxes are frames, too. One that only takes drawings away is none next to a frame
        with boxes: then it makes room for these.
        """
        box_ns, _ = self.times()
        count = len(self.message_ns)
        is_off = _is_off(self.message_stamp_ns, self.message_ns)
        # A message without boxes may have no stamp: it is as late as the others.
        late = self.message_ns[~is_off] - self.message_stamp_ns[~is_off]
        own_ns = self.message_ns - np.int64(np.median(late) if len(late) else 0)
        own_ns = np.where(is_off, own_ns, self.message_stamp_ns)
        middle, apart = own_ns.copy(), np.zeros(count, np.int64)
        for number, some in _groups(self.message, box_ns):
            middle[number], apart[number] = np.sort(some)[(len(some) - 1) // 2], some.max() - some.min()
        has_boxes = np.bincount(self.message, minlength=count).astype(bool)
        usual = _usual_step(middle[has_boxes])
        at = np.where((apart <= usual / 2)[self.message], middle[self.message], box_ns)
        empty = middle[~has_boxes & self.is_measured]
        starts = _starts(np.concatenate([at, empty]))
        gone = middle[~has_boxes & ~self.is_measured]
        if len(starts) and len(gone):
            near = np.searchsorted(starts, gone)
            away = [np.abs(starts[np.clip(near + side, 0, len(starts) - 1)] - gone) for side in (-1, 0)]
            gone = gone[np.minimum(*away) > usual / 2]
        starts = _starts(np.concatenate([starts, gone]))
        return self._gathered(starts, np.searchsorted(starts, at, "right") - 1, box_ns)

    def _gathered(self, starts: Ints, frame: Ints, box_ns: Ints) -> tuple[Ints, Ints, str]:
        """Frames (F,) as ``frames`` returns them, those of one sweep of the sensor as one."""
        # Messages without boxes may have no stamp: they were written as late as others.
        log_ns = starts + np.int64(np.median(self.log_ns - box_ns) if len(box_ns) else 0)
        log_ns[frame[::-1]] = self.log_ns[::-1]
        sweep = find_sweeps(starts, log_ns, frame, self.centre, self.class_id)
        if sweep is None:
            text = "messages have one box each, and their times don't show which are of one sweep: each is a frame"
            return starts, frame, text if are_mixed(starts, frame, self.centre) else ""
        t_ns = starts[np.unique(sweep, return_index=True)[1]]
        for number, some in _groups(sweep[frame], box_ns):
            t_ns[number] = np.sort(some)[(len(some) - 1) // 2]
        order = np.argsort(t_ns, kind="stable")
        place = np.empty(len(order), np.int64)
        place[order] = np.arange(len(order))
        apart_ms = max(int(np.ptp(some)) for _, some in _groups(sweep[frame], box_ns)) / 1e6
        text = f"messages are gathered to {len(order):,} frames, one for each sweep"
        return t_ns[order], place[sweep][frame], f"{text}: times up to {apart_ms:.0f} ms apart, then longer gaps"


def _is_off(stamp_ns: Ints, log_ns: Ints) -> Bools:
    """Whether stamps are of another clock than the log time, or missing."""
    # In floating-point numbers, since stamps may be anywhere.
    away = np.abs(stamp_ns.astype(np.float64) - log_ns)
    return np.asarray((stamp_ns <= 0) | (away > OTHER_CLOCK_S * NS_PER_S))


def _groups(group: Ints, values: Ints) -> Iterable[tuple[int, Ints]]:
    """Each group (message or sweep) that has boxes, with the values (N,) of its boxes."""
    order = np.argsort(group, kind="stable")
    numbers, begins = np.unique(group[order], return_index=True)
    return zip(numbers.tolist(), np.split(values[order], begins[1:]), strict=False) if len(numbers) else ()


def _usual_step(t_ns: Ints) -> float:
    steps = np.diff(np.unique(t_ns))
    steps = steps[steps > _SAME_NS]
    return float(np.median(steps)) if len(steps) else 0.0


def _starts(t_ns: Ints) -> Ints:
    """The first times of groups, each within ``_SAME_NS``."""
    out: list[int] = []
    for time_ns in np.unique(t_ns).tolist():
        if not out or time_ns - out[-1] > _SAME_NS:
            out.append(time_ns)
    return np.array(out, np.int64)


def recorded(
    log_ns: Ints,
    parts: Iterable[tuple[Ints, Seen3d]],
    classes: Callable[[Sequence[str]], ClassesRead] = read_classes,
) -> Recorded3d:
    """The boxes of messages at log times (M,): of some of them each, by their numbers.

    ``classes`` takes the texts of their classes. Boxes without a position are left out; sizes that can't be are
    unknown. ``remarks`` counts both.
    """
    stamp_ns, is_measured = np.zeros(len(log_ns), np.int64), np.zeros(len(log_ns), bool)
    remarks: Counter[str] = Counter()
    by_part = [Message3d(0).columns().boxes]
    for which, seen in parts:
        stamp_ns[which], is_measured[which] = seen.stamp_ns, seen.is_measured
        remarks.update({f"{remark} are left out": count for remark, count in seen.ignored.items()})
        by_part.append(seen.boxes._replace(message=which[seen.boxes.message]))
    boxes = joined(by_part)
    plain = {name: plain_frame(name) for name in dict.fromkeys(boxes.frame_id)}
    names = sorted(set(plain.values()))
    place = {name: names.index(own) for name, own in plain.items()}
    of_boxes = classes(boxes.class_name)
    out = Recorded3d(
        names=names, frame=np.array([place[name] for name in boxes.frame_id], np.int64), log_ns=log_ns[boxes.message],
        class_id=of_boxes.ids, source_id=_ids(boxes.source_id), classes=of_boxes, message_ns=log_ns,
        message_stamp_ns=stamp_ns, is_measured=is_measured, remarks=dict(remarks),
        **{name: getattr(boxes, name) for name in _AS_IN_MESSAGES},
    )  # fmt: skip
    return _checked(out)


def _ids(ids: Sequence[int | str | None]) -> Ints:
    """Ids of boxes: numbers as they are, also as text; other texts are numbered in alphabetical order after these."""
    numbers: list[int] = []
    texts: dict[int, str] = {}
    for at, own in enumerate(ids):
        text = str(own if own is not None else "").strip()
        is_number = _NUMBER.fullmatch(text)
        numbers.append(int(text) if is_number else -1)
        if text and not is_number and not isinstance(own, int):
            texts[at] = text
    first = max(numbers, default=-1) + 1
    place = {name: first + order for order, name in enumerate(sorted(set(texts.values())))}
    for at, name in texts.items():
        numbers[at] = place[name]
    return np.array(numbers, np.int64)


def _checked(boxes: Recorded3d) -> Recorded3d:
    """The boxes that have a position; sizes and orientations that can't be are unknown, and counted as remarks."""
    with np.errstate(invalid="ignore"):
        # Radars know no height: x and y are a position.
        is_there = (np.abs(boxes.centre) < _FARTHEST_M) | (np.isnan(boxes.centre) & [False, False, True])
        is_far: Bools = ~np.asarray(is_there.all(axis=1))
        boxes = boxes.select(~is_far)
        size, turn = boxes.size, boxes.orientation
        odd_turn: Bools = ~np.asarray(np.isfinite(turn).all(axis=1))
        length = np.linalg.norm(np.where(odd_turn[:, None], 0.0, turn), axis=1)
        is_unturned = ~odd_turn & (length < np.finfo(np.float64).tiny)
        is_odd_size = ~np.isfinite(size).all(axis=1) & ~np.isnan(size).all(axis=1)
        kinds = {
            "boxes have no position (no finite number) and are left out": is_far,
            "boxes have no z: it is unknown, and 0 in their frame for x and y": np.isnan(boxes.centre[:, 2]),
            "boxes have a size that is no finite number: it is unknown": is_odd_size,
            "boxes have a negative size: it is unknown": (size < 0).any(axis=1),
            "boxes have a size of 0: it is unknown": (size == 0).any(axis=1),
            "boxes have an orientation that is no finite number: it is unknown": odd_turn,
            "boxes have an orientation of zeros: they count as not turned": is_unturned & boxes.has_heading,
        }
        velocity = boxes.velocity
        # Programs that don't measure velocities leave them at 0; objects that move can't all have one of 0.
        if (is_stated := np.isfinite(velocity).all(axis=1)).any() and not velocity[is_stated].any():
            kinds["boxes have a velocity of 0, and no box has another: it is unknown"] = is_stated
            velocity = np.full_like(velocity, np.nan)
        score = boxes.score
        if (is_scored := np.isfinite(score)).any() and not score[is_scored].any():
            kinds["boxes have a score of 0, and no box has another: it is unknown"] = is_scored
            score = np.full_like(score, np.nan)
        size = np.where(np.isfinite(size) & (size > 0), size, np.nan)
    turn = np.where((odd_turn | is_unturned)[:, None], [0.0, 0.0, 0.0, 1.0], turn)
    remarks = boxes.remarks | {remark: int(which.sum()) for remark, which in kinds.items() if which.any()}
    has_heading = boxes.has_heading & ~odd_turn
    return replace(
        boxes, size=size, orientation=turn, velocity=velocity, score=score, has_heading=has_heading, remarks=remarks
    )


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
LATCHED: Final = "tf_static"


class _Transforms(NamedTuple):
    """Recorded transforms (N,), from points of ``child`` to points of ``parent``, and the messages that they are in."""

    message: Ints
    parent: Any
    child: Any
    stamp_ns: Ints
    translation: Floats
    quaternion: Floats


class FramesRead(NamedTuple):
    """The transforms of a log: their tree, the topics that they are from, and those that can't be read, with why."""

    tree: TransformTree | None
    topics: tuple[str, ...]
    unread: tuple[str, ...]


def holds_transforms(channel: log.Channel) -> bool:
    """Return whether a channel has recorded transforms; those of views of mcaptrack are none."""
    is_recorded = Provenance.from_metadata(channel.metadata) is None
    return is_recorded and plain_name(channel.schema_name) in TRANSFORMS_READ


def transforms_of(opened: log.Log, topic: str = "") -> TransformTree | None:
    """Return the transforms of a log as a tree over time; None if it has none. See ``read_frames``."""
    return read_frames(opened, topic).tree


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
    tree, _, unread = read_frames(opened, topic)
    tree = tree or TransformTree([])
    for text in unread:
        warn(text, "lost")
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


@log.kept
def read_frames(opened: log.Log, topic: str = "") -> FramesRead:
    """Read the transforms of a log. Messages that can't be read are left out, and counted in ``unread``.

    Robots with a namespace each (/robot1/tf) may have frames of the same names. For a channel of ``topic`` the poses of
    a frame are those of the most similar topics of transforms; without a topic all count together.
    """
    read = _read_transforms(opened)
    return FramesRead(_tree(opened, _is_near(read, topic)), read.topics, read.unread)


def namespaces_of(opened: log.Log) -> tuple[str, ...]:
    """Return the namespaces, as in "/robot1/", of robots with frames of the same names; ("",) for other logs.

    ``read_frames`` takes them as topics.
    """
    read = _read_transforms(opened)
    of_topic = [_namespace(topic) for topic in read.topics]
    near = [_is_near(read, name) for name in dict.fromkeys(of_topic)]
    own = {of_topic[edge.topic] for edge, *is_near in zip(read.edges, *near, strict=True) if not all(is_near)}
    return tuple(sorted(own)) or ("",)


def _namespace(topic: str) -> str:
    return f"{topic.rpartition('/')[0]}/"


def _is_near(read: _TransformsRead, topic: str) -> tuple[bool, ...]:
    """Whether the topic of each edge is most similar to ``topic``, of those with its frame; all are to ""."""
    ranks = [(shared_parts(source, topic), topic.startswith(_namespace(source))) for source in read.topics]
    nearest: dict[str, tuple[int, bool]] = {}
    for edge in read.edges:
        nearest[edge.child] = max(nearest.get(edge.child, (0, False)), ranks[edge.topic])
    return tuple(not topic or ranks[edge.topic] == nearest[edge.child] for edge in read.edges)


class _Edge(NamedTuple):
    """A frame and its parent, whether their topic is of transforms that don't change, and its number."""

    parent: str
    child: str
    is_latched: bool
    topic: int


class _TransformsRead(NamedTuple):
    """All transforms (N,) of a log: the number of the edge of each, the poses, and what ``FramesRead`` has besides."""

    edges: tuple[_Edge, ...]
    of_edge: Ints
    poses: PoseSamples | None
    topics: tuple[str, ...]
    unread: tuple[str, ...]


@log.kept
def _read_transforms(opened: log.Log) -> _TransformsRead:
    edges: dict[_Edge, int] = {}
    of_edge, samples = list[int](), list[PoseSamples]()
    topics = [topic for topic, channel in sorted(opened.channels.items()) if holds_transforms(channel)]
    problems: list[str] = []
    for number, topic in enumerate(topics):
        try:
            log_ns, parts, unread = read_channel(opened, topic, _transforms, _FIELDS)
        except McaptrackError as error:
            problems.append(str(error))
            continue
        problems += [str(unread)] if str(unread) else []
        for which, read in parts:
            names = zip(read.parent, read.child, strict=True)
            of_edge += [edges.setdefault(_Edge(*pair, topic.endswith(LATCHED), number), len(edges)) for pair in names]
            times = log_ns[which[read.message]]
            samples.append(PoseSamples(read.stamp_ns, times, read.translation, read.quaternion))
    poses = joined(samples) if samples else None
    return _TransformsRead(tuple(edges), np.array(of_edge, np.int64), poses, tuple(topics), tuple(problems))


@log.kept
def _tree(opened: log.Log, is_near: tuple[bool, ...]) -> TransformTree | None:
    """The tree of some of the edges of a log; None if there is none. Edges of several topics are one."""
    read = _read_transforms(opened)
    if read.poses is None or not any(is_near):
        return None
    numbers: dict[tuple[str, str, bool], int] = {}
    merged = [
        numbers.setdefault(edge[:3], len(numbers)) if near else -1
        for edge, near in zip(read.edges, is_near, strict=True)
    ]
    group = np.array(merged)[read.of_edge]
    edges, poses = list(numbers), _groups(group, np.arange(len(group)))
    return TransformTree([Recorded(*edges[edge], taken(read.poses, which)) for edge, which in poses if edge >= 0])


#: The fields of transforms of all schemas.
_FIELDS: Final = [
    (*at, name)
    for at in ((), ("transforms",))
    for name in ("header", "timestamp", "parent_frame_id", "child_frame_id", "transform", "translation", "rotation")
]


def _transforms(messages: Things) -> _Transforms:
    """The transforms of messages of any of the schemas."""
    owner, each = messages.members(("transforms", EACH) if messages.has(("transforms",)) else ())
    is_foxglove = each.has(("parent_frame_id",))
    at: Path = () if is_foxglove else ("transform",)
    parent = each.texts(("parent_frame_id",) if is_foxglove else ("header", "frame_id"))
    stamp_ns = each.stamps(("timestamp",) if each.has(("timestamp",)) else ("header", "stamp"))
    shift, turn = each.vectors((*at, "translation")), each.vectors((*at, "rotation"), "xyzw")
    shift[~each.is_set((*at, "translation"))] = 0.0
    turn[~each.is_set((*at, "rotation"))] = [0.0, 0.0, 0.0, 1.0]
    return _Transforms(owner, parent, each.texts(("child_frame_id",)), stamp_ns, shift, turn)


def edges_of(message: Any) -> tuple[tuple[str, str], ...]:
    """The frames that the transforms of a decoded message lead from and to, sorted."""
    read = _transforms(Things([message]))
    return tuple(sorted(zip(read.parent, read.child, strict=True)))


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
        If it has no boxes, if a message can't be read, or if the pose of no box is known.
    """
    reading = foreign.reading_of(opened, topic)
    if reading is None:
        payload_decoder(opened, topic, unpacker)  # says why, if its messages can't be decoded
        name = opened.channel(topic).schema_name or "no schema"
        raise McaptrackError(f"{opened.path}: {topic} holds {name}, not detections; {', '.join(BOXES_READ)} are read")
    if reading.known is None and reading.fields is not None and not choice_for(opened, topic).fields:
        text = f"messages of {opened.channel(topic).schema_name or 'JSON'} are read by the names of their fields"
        warn(f"{opened.path}: {topic}: {text} ({reading.fields}); `map=` names others", "fields")
    return _in_space(opened, topic, reading, frame_id) if reading.in_space else named_boxes(opened, topic, reading)


def _in_space(opened: log.Log, topic: str, reading: Reading, frame_id: str) -> foreign.NamedFrames:
    """The boxes in space of a channel, as ``named_detections`` returns them."""
    own = reading.class_name

    def classes(texts: Sequence[str]) -> ClassesRead:
        return classes_of(opened, topic, reading, [text or own for text in texts])

    log_ns, parts, unread = read_channel(opened, topic, reading.read, reading.paths)
    unread.warn("it counts as empty")
    boxes, unnamed = recorded(log_ns, parts, classes).in_usual_frame()
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
    odd = boxes.times()[1]
    if odd:
        text = "have no stamp, or one that is more than 60 s from the log time: their time is the log time"
        warn(f"{opened.path}: {topic}: {odd:,} of {len(boxes.stamp_ns):,} boxes {text}", "clock")
    rows = rows_of_boxes(boxes, rotation[is_taken], shift[is_taken], f"{opened.path}: {topic}")
    if unclassed := int((rows["class_id"] == UNKNOWN).sum()):
        remark = "boxes have no class, or 0: they move as objects of unknown class do"
        warn(f"{opened.path}: {topic}: {unclassed:,} of {len(rows):,} {remark}", "classes")
    if not assumed and (several := boxes.of_several_messages(frame)):
        remark = "times have boxes of several messages, where others have those of one, as if a clock was set back"
        warn(f"{opened.path}: {topic}: {several:,} of {len(start_ns):,} {remark}: they count as one frame", "clock")
    order = np.argsort(frame, kind="stable")
    by_frame = np.split(rows[order], np.searchsorted(frame[order], np.arange(1, len(start_ns))))
    kept = np.flatnonzero(~is_left_out).tolist()
    times = start_ns.tolist()
    frames = [Frame(times[at], index, by_frame[at]) for index, at in enumerate(kept)]
    clock = "stamps" if not odd else "stamps, and log times where they are missing or off"
    facts = facts_of(choice_for(opened, topic), reading, clock=clock, classes=boxes.classes.source, scale="metres")
    return foreign.NamedFrames(frames, boxes.classes.names, fixed, facts)


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
    tree = transforms_of(opened, topic)
    frames = set(tree.frames() if tree else ()) | set(boxes.names)
    if wanted:
        if boxes.names and wanted not in frames:
            raise McaptrackError(
                f"{opened.path}: there is no frame {wanted} for the boxes of {topic}; "
                f"{offer(wanted, sorted(frames), 'there are')}"
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
            warn_of_remarks(opened, transforms_of(opened, topic), fixed, name)
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
            f"{opened.path}: the pose of no box of {topic} in {fixed} is known; {_connected(opened, topic, boxes)} "
            "`frame=` names another frame, such as that of the boxes"
        )
    return is_known, rotation, shift


def _connected(opened: log.Log, topic: str, boxes: Recorded3d) -> str:
    transforms = transforms_of(opened, topic)
    frames = list_names(transforms.frames() if transforms else [], _LISTED)
    return f"boxes are in {list_names(boxes.names, _LISTED)}, and transforms have {frames};"


def rows_of_boxes(boxes: Recorded3d, rotation: Floats, shift: Floats, where: str = "") -> Rows:
    """Boxes as rows of detections (N,), from the poses of their frames: (N, 3, 3) and (N, 3).

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
    columns = dict(zip(ORIENTED_COLUMNS, [*centre.T, *size, heading], strict=True))
    columns |= {"vx_m_per_s": velocity[:, 0], "vy_m_per_s": velocity[:, 1]}
    return DETECTIONS.rows(score=boxes.score, class_id=boxes.class_id, source_id=boxes.source_id, **columns)
