"""Time in integer nanoseconds: how many frames or steps have passed when frames arrive at irregular times, and regular
ticks where there are frames.

No work may grow with the time that a log covers: a clock may be set from 1970 to today between two frames.

Letters: F frames, T times, A anchors.
"""

from __future__ import annotations

import re
from bisect import bisect_left, insort
from collections import deque
from datetime import UTC, datetime
from fractions import Fraction
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.ragged import ragged_range

__all__ = ["NS_PER_S", "seconds_to_ns"]

NS_PER_S: Final = 1_000_000_000
#: Earlier times are not dates but seconds since something began: the year 1980.
FIRST_DATE_NS: Final = 315_532_800 * NS_PER_S
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
#: A longer time without frames is a jump of the clock, or a pause: nothing goes on after it, and its length has no
#: effect. By default stages bridge at most 24 s (links by appearance); 60 s leaves room for options. An option that
#: bridges more moves the limit.
JUMP_S: Final = 60.0
#: The last time that 64-bit nanoseconds since 1970 can represent, in 2262.
LAST_NS: Final = 2**63 - 1
#: Frame rates: from one picture a day (time lapse) to ten thousand a second.
FPS_RANGE: Final = (Fraction(1, 86_400), Fraction(10_000))
#: Numbers in text; exponents are short, because long ones would take too long to compute.
_RATIO: Final = re.compile(r"\+?(\d+\.?\d*|\.\d+)(e[+-]?\d{1,2})?(/\d+)?", re.ASCII | re.IGNORECASE)
_MAX_DIGITS: Final = 40
_WHOLE: Final = re.compile(r"-?\d{1,19}", re.ASCII)
#: Number of intervals from which the usual one is estimated.
_MEMORY: Final = 25
#: Number of intervals after which a change of the usual one is detected, and the factor by which it has to change.
_MIN_INTERVALS: Final = 8
_CHANGED: Final = 1.5


def parse_ratio(text: str) -> Fraction:
    """A number of 0 or more from "25", "29.97" or "30000/1001". Raises ValueError for anything else."""
    text = text.strip()
    if len(text) > _MAX_DIGITS or not _RATIO.fullmatch(text):
        raise ValueError(f"{text[:_MAX_DIGITS]!r} is no number")
    number, _, below = text.partition("/")
    if below and not int(below):
        raise ValueError(f"{text!r} divides by 0")
    return Fraction(number) / int(below or 1)


def parse_fps(text: str) -> Fraction:
    """Frames per second, as ``parse_ratio``. Raises ValueError for what is out of ``FPS_RANGE``, too."""
    fps = parse_ratio(text)
    if not FPS_RANGE[0] <= fps <= FPS_RANGE[1]:
        raise ValueError(f"{text} frames per second: it has to be from one per day to {FPS_RANGE[1]} per second")
    return fps


def parse_ns(text: str) -> int | None:
    """A time in nanoseconds, as ``str`` writes it; None for anything else, and for times beyond 64 bits."""
    if not _WHOLE.fullmatch(text) or abs(int(text)) > LAST_NS:
        return None
    return int(text)


def utc_ns(moment: str, fraction: str) -> int:
    """The nanoseconds from 1970 to a moment of ISO 8601 in whole seconds, with its zone, and digits after the point."""
    since = datetime.fromisoformat(moment) - _EPOCH
    return (since.days * 86_400 + since.seconds) * NS_PER_S + int(fraction.ljust(9, "0"))


def seconds_to_ns(seconds: float) -> int:
    """Seconds -> nanoseconds, to the nearest."""
    return round(seconds * NS_PER_S)


def steps_passed(passed_ns: int, rate_hz: float, bridged_s: float = 0.0) -> int:
    """The number of steps at ``rate_hz`` in the time between two frames, at least 1.

    The time counts up to ``JUMP_S``, or ``bridged_s`` if it is longer.
    """
    longest_ns = seconds_to_ns(max(JUMP_S, bridged_s))
    return max(1, round(min(passed_ns, longest_ns) * rate_hz / NS_PER_S))


class FrameClock:
    """Counts frames by their timestamps.

    The usual interval is the mean of the middle half of the last 25, so neither gaps nor jitter change it, and it needs
    the past alone. A step of n usual intervals counts as n frames; jitter of less than a tenth of an interval changes
    no count.

    ``interval_ns`` is the usual interval, 0 while it isn't known. ``stretch`` is the ratio of the new frame interval to
    the old one at the tick where a new frame rate is detected, and 1 at all others.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._intervals: deque[int] = deque()
        self._sorted: list[int] = []
        self._anchor_ns = 0
        self.interval_ns = 0
        self.stretch = 1.0

    def tick(self, t_ns: int) -> int:
        """Add the time of the next frame; returns by how many frames it advances, at least 1."""
        passed = 0 if self._last_ns is None else t_ns - self._last_ns
        self._last_ns, self.stretch = t_ns, 1.0
        if passed <= 0:
            return 1
        intervals, in_order = self._intervals, self._sorted
        oldest = intervals.popleft() if len(intervals) == _MEMORY else None
        intervals.append(passed)
        count, usual = len(intervals), self.interval_ns
        if oldest != passed:  # otherwise the intervals are the same as before
            if oldest is not None:
                del in_order[bisect_left(in_order, oldest)]
            insort(in_order, passed)
            cut = min((count + 3) // 4, (count - 1) // 2)
            middle = in_order[cut : count - cut]
            self.interval_ns = usual = max(sum(middle) // len(middle), 1)
        if count >= _MIN_INTERVALS:
            self._detect_change(usual, in_order[count // 2])
        return max(1, round(passed / usual))

    def _detect_change(self, usual: int, median: int) -> None:
        anchor = self._anchor_ns
        if anchor and not anchor < usual * _CHANGED < anchor * _CHANGED**2:
            self.stretch, self._anchor_ns = median / anchor, median
        elif not anchor:
            self._anchor_ns = usual

    def frames(self, seconds: float) -> int:
        """The number of frames in a time span, at least 1; 1 while the usual interval isn't known."""
        return max(1, round(seconds_to_ns(seconds) / self.interval_ns)) if self.interval_ns else 1


class RegularClock(NamedTuple):
    """A regular clock that starts with the first frame, and again with the first frame after each jump.

    Attributes
    ----------
    anchor_ns : (A,) of int64
        The times at which it starts, ascending.
    step_ns : float
        The time between two ticks.
    """

    anchor_ns: Ints
    step_ns: float

    @classmethod
    def of(cls, frame_ns: Ints, start_ns: int, step_ns: float, bridged_s: float = 0.0) -> RegularClock:
        """The clock of frames at rising times (F,) that starts at ``start_ns``.

        A jump is longer than ``JUMP_S`` and than ``bridged_s``.
        """
        is_jump = np.diff(frame_ns) > seconds_to_ns(max(JUMP_S, bridged_s))
        return cls(np.append(np.int64(start_ns), frame_ns[1:][is_jump]), step_ns)

    def to_step(self, t_ns: Ints) -> Ints:
        """The number of the tick next to each time, (T,)."""
        anchor_ns = self.anchor_ns[self._part(t_ns)]
        steps = np.rint((anchor_ns - self.anchor_ns[0]) / self.step_ns) + np.rint((t_ns - anchor_ns) / self.step_ns)
        return np.asarray(steps.astype(np.int64))

    def ticks(self, frame_ns: Ints, limit_ns: int) -> Ints:
        """The times of ticks at frames (F,), and between those that are at most ``limit_ns`` apart.

        Tick k is k steps after its anchor, to the nanosecond.
        """
        if not len(frame_ns):
            return frame_ns
        ends = np.append(frame_ns[1:], frame_ns[-1])
        ends = np.where(ends - frame_ns <= limit_ns, ends, frame_ns)
        anchor_ns = self.anchor_ns[self._part(frame_ns)]
        low = np.maximum(np.ceil((frame_ns - anchor_ns) / self.step_ns - 0.5).astype(np.int64), 0)
        high = np.maximum(np.floor((ends - anchor_ns) / self.step_ns + 0.5).astype(np.int64), -1)
        count = np.maximum(high - low + 1, 0)  # one too many at either end is removed below
        tick_ns = np.repeat(anchor_ns, count) + np.rint(ragged_range(low, count) * self.step_ns).astype(np.int64)
        inside = (tick_ns >= np.repeat(frame_ns, count)) & (tick_ns <= np.repeat(ends, count))
        return np.unique(tick_ns[inside])

    def _part(self, t_ns: Ints) -> Ints:
        return np.maximum(np.searchsorted(self.anchor_ns, t_ns, "right") - 1, 0)
