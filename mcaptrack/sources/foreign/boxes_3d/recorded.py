"""All 3D boxes of a channel as arrays, in the frames that they were recorded in.

Letters: M messages, N boxes, F frames (times).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.transform_tree import OTHER_CLOCK_S, plain_frame
from mcaptrack.sources.foreign.boxes import Classes
from mcaptrack.sources.foreign.boxes_3d.box import Box3d, Message3d

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
_TRIED: Final = 5
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
    likely = np.argsort(-ratio, kind="stable")[:_TRIED]
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
        Ids of classes as ``classes.class_id`` gives them; ids of the detector, -1 where there is none.
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
    classes: Classes
    message_ns: Ints
    message_stamp_ns: Ints
    is_measured: Bools
    remarks: dict[str, int]

    def select(self, kept: Bools) -> Recorded3d:
        """The boxes of a mask (N,); messages stay."""
        names = ("frame", "message", "stamp_ns", "log_ns", "centre", "orientation", "size", "velocity", "has_heading")
        return replace(self, **{name: getattr(self, name)[kept] for name in (*names, "score", "class_id", "source_id")})

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


def recorded(messages: Iterable[tuple[int, Message3d]]) -> Recorded3d:
    """The boxes of messages, each with its log time in ns, as arrays.

    Boxes without a position are left out; sizes that can't be are unknown. ``remarks`` counts both.
    """
    boxes: list[Box3d] = []
    owner: list[int] = []
    heads: list[tuple[int, int, bool]] = []
    remarks: Counter[str] = Counter()
    for number, (t_ns, of_message) in enumerate(messages):
        boxes += of_message.boxes
        owner += [number] * len(of_message.boxes)
        heads.append((t_ns, of_message.stamp_ns, of_message.is_measured))
        remarks.update({f"{remark} are left out": count for remark, count in of_message.ignored.items()})
    head_ns = np.array([head[:2] for head in heads], np.int64).reshape(-1, 2)
    names = sorted({plain_frame(box.frame_id) for box in boxes})
    place = {name: number for number, name in enumerate(names)}
    classes = Classes()
    message = np.array(owner, np.int64)
    out = Recorded3d(
        names,
        np.array([place[plain_frame(box.frame_id)] for box in boxes], np.int64),
        message,
        np.array([box.stamp_ns for box in boxes], np.int64),
        head_ns[message, 0],
        _columns([box.centre for box in boxes], 3),
        _columns([box.orientation for box in boxes], 4),
        _columns([box.size for box in boxes], 3),
        _columns([box.velocity for box in boxes], 3),
        np.array([box.has_heading for box in boxes], bool),
        np.array([box.score for box in boxes], np.float64),
        np.array([classes.class_id(box.class_name) for box in boxes], np.int64),
        _ids([box.source_id for box in boxes]),
        classes,
        head_ns[:, 0],
        head_ns[:, 1],
        np.array([head[2] for head in heads], bool),
        dict(remarks),
    )
    return _checked(out)


def _columns(values: Sequence[tuple[float, ...]], width: int) -> Floats:
    return np.array(values, np.float64).reshape(-1, width)


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
        kinds = {
            "boxes have no position (no finite number) and are left out": is_far,
            "boxes have no z: it is unknown, and 0 in their frame for x and y": np.isnan(boxes.centre[:, 2]),
            "boxes have a size that is no finite number: it is unknown": ~np.isfinite(size).all(axis=1),
            "boxes have a negative size: it is unknown": (size < 0).any(axis=1),
            "boxes have a size of 0: it is unknown": (size == 0).any(axis=1),
            "boxes have an orientation that is no finite number: it is unknown": odd_turn,
            "boxes have an orientation of zeros: they count as not turned": is_unturned,
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
