"""Time: nanoseconds as whole numbers, and how many frames have passed when frames come when they like."""

from __future__ import annotations

from collections import deque
from statistics import median_high
from typing import Final

NS_PER_S: Final = 1_000_000_000
#: How many intervals the usual one is taken from.
_MEMORY: Final = 25


def seconds_to_ns(seconds: float) -> int:
    """Seconds -> nanoseconds, to the nearest."""
    return round(seconds * NS_PER_S)


class FrameClock:
    """Counts frames by their timestamps.

    The usual interval is the median of the last 25, so a gap does not move it, and it is known from the past alone. A
    step that is n usual intervals long counts as n frames; stamps that are off by less than a tenth of an interval
    change no count.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._intervals: deque[int] = deque(maxlen=_MEMORY)

    def tick(self, t_ns: int) -> int:
        """Take the time of the next frame; returns how many frames on it is, at least 1."""
        passed = 0 if self._last_ns is None else t_ns - self._last_ns
        self._last_ns = t_ns
        if passed <= 0:
            return 1
        self._intervals.append(passed)
        return max(1, round(passed / median_high(self._intervals)))

    def frames(self, seconds: float) -> int:
        """How many frames a time span is, at least 1; so far as the usual interval is known, otherwise 1."""
        if not self._intervals:
            return 1
        return max(1, round(seconds_to_ns(seconds) / median_high(self._intervals)))
