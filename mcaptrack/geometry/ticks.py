"""Regular ticks where there are frames.

Letters: F frames, T times, A anchors.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.clocks import JUMP_S, seconds_to_ns
from mcaptrack.geometry.ragged import ragged_range


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
