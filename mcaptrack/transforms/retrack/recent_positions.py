"""The recent positions of tracks, looked up for many tracks and steps at once. Letters: N positions, L past ones."""

from __future__ import annotations

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints


class RecentPositions:
    """Positions by track and step, of which the last ``length`` steps are looked up."""

    def __init__(self, length: int) -> None:
        self._length = length
        self._track, self._step = np.empty((2, 0), np.int64)
        self._xy = np.empty((0, 2))

    def add(self, first: int, track: Ints, step: Ints, xy: Floats) -> None:
        """Add positions (N, 2) of tracks (N,) at ``step`` (N,), from step ``first`` on; what is too old is dropped."""
        kept = self._step > first - 1 - self._length
        self._track = np.concatenate([self._track[kept], track])
        self._step = np.concatenate([self._step[kept], step])
        self._xy = np.concatenate([self._xy[kept], xy])

    def before(self, track: Ints, step: Ints, now: Floats) -> tuple[Floats, Bools]:
        """The last positions of tracks (N,) as known at ``step`` (N,), (N, L, 2), and which are known, (N, L).

        ``now`` (N, 2) are those at ``step``; NaN where a track has none.
        """
        width = max(self._step.max(initial=0), step.max(initial=0)) + 1
        # ids of the input may be as large as they like
        _, number = np.unique(np.concatenate([self._track, track]), return_inverse=True)
        had, track = number[: len(self._track)], number[len(self._track) :]
        have = had * width + self._step
        order = np.argsort(have)
        have, xy = have[order], self._xy[order]
        past = np.full((len(track), self._length, 2), np.nan)
        for back in range(1, self._length if len(have) else 0):
            want = track * width + step - back
            place = np.minimum(np.searchsorted(have, want), len(have) - 1)
            found = (have[place] == want) & (step >= back)
            past[found, self._length - 1 - back] = xy[place[found]]
        past[:, -1] = now
        return past, np.isfinite(past[..., 0])
