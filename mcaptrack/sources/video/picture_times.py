"""Times of pictures as messages: strictly increasing; and what is odd about those of the container."""

from __future__ import annotations

from array import array
from fractions import Fraction
from pathlib import Path
from typing import Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.clocks import LAST_NS, NS_PER_S
from mcaptrack.notices import warn

#: Pictures are regular if this share of their intervals is within a tenth of the median, or within the tick of a clock
#: of milliseconds. An interval is a gap if at least two pictures would fit between.
_REGULAR, _ALIKE, _TICK_NS, _GAP = 0.9, 0.1, 1_500_000, 2.5
_FEWEST: Final = 10


class Clock:
    """Times of pictures in ns: from the container, exact in its time base, or evenly spaced by ``fps``."""

    def __init__(self, where: Path, start_ns: int, fps: Fraction | None) -> None:
        self.fps = fps
        self._where, self._start_ns = where, start_ns
        self._first: Fraction | None = None
        self._times = array("q")
        self._moved, self._first_moved = 0, 0

    def time(self, index: int, seconds: Fraction | None) -> int:
        """The time of picture ``index``, which is ``seconds`` in the container."""
        if self.fps:
            seconds = index / self.fps
        elif seconds is None:
            raise McaptrackError(
                f"{self._where}: picture {index} has no time in its container; space them evenly with `fps=`"
            )
        else:
            self._first = seconds if self._first is None else self._first
            seconds -= self._first
        t_ns = self._start_ns + round(seconds * NS_PER_S)
        if not 0 <= t_ns < LAST_NS:
            raise McaptrackError(
                f"{self._where}: picture {index} is {float(seconds):g} s after the first; times reach to the year 2262"
            )
        if self._times and t_ns <= self._times[-1]:
            self._first_moved = self._first_moved if self._moved else index
            self._moved += 1
            t_ns = self._times[-1] + 1
        self._times.append(t_ns)
        return t_ns

    def warn(self) -> None:
        """Warn about times that had to be moved, and about gaps in regular ones."""
        if self._moved:
            warn(
                f"{self._where}: {self._moved} of {len(self._times)} pictures are not later than the one before, "
                f"number {self._first_moved} first; they are put 1 ns after it (`fps=` spaces all evenly)",
                "clock",
            )
        if self.fps or len(self._times) < _FEWEST:
            return
        times: Ints = np.frombuffer(self._times, np.int64)
        steps = times[1:] - times[:-1]
        usual = float(np.median(steps))
        is_usual = np.abs(steps - usual) <= max(_ALIKE * usual, _TICK_NS)
        gaps = np.flatnonzero(steps >= _GAP * usual)
        if len(gaps) and is_usual.mean() >= _REGULAR:
            missing = int((np.rint(steps[gaps] / usual) - 1).sum())
            places = "1 gap" if len(gaps) == 1 else f"{len(gaps)} gaps"
            at_s, longest_s = (times[gaps[0]] - times[0]) / NS_PER_S, steps[gaps].max() / NS_PER_S
            warn(
                f"{self._where} has {places} between pictures that otherwise come every {usual / 1e6:.4g} ms, the "
                f"first after {at_s:.2f} s, the longest of {longest_s:.2f} s: about {missing} pictures were not "
                "recorded, or are lost",
                "clock",
            )
