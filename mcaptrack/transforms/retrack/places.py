"""Where lost tracks come back and where they don't, as far as the log has shown.

People go out at some places, and are missed for a moment at others. Whether a lost track comes back is told by what
became of those that were lost nearby, compared with the whole log. (Where a track began tells less of whether it will
last: people who are soon occluded look like false detections.)

Letters: F steps; R tracks alive at these steps, end to end.
"""

from __future__ import annotations

from typing import Final, TypeAlias

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.ragged import run_ends, run_starts

Place: TypeAlias = tuple[float, float]

#: Places are as near as this to be one.
_NEAR_M: Final = 2.0
#: Each place counts as if so many tracks like all others had been there before.
_USUAL: Final = 8.0
#: So many of the last tracks count.
_LAST: Final = 2000
#: What happens to tracks, in the order in which it is looked at within a step.
_OVER, _BACK, _LOST = range(3)


class PlaceOdds:
    """The odds that something turns out well at places, compared with everywhere."""

    def __init__(self) -> None:
        self._xy_m = np.empty((2, _LAST))
        self._is_good = np.zeros(_LAST, bool)
        self._count = 0

    def add(self, place: Place, is_good: bool) -> None:
        """Count what became of something that was at a place."""
        at = self._count % _LAST
        self._xy_m[:, at], self._is_good[at] = place, is_good
        self._count += 1

    def ratio(self, place: Place) -> float:
        """The odds that something at a place turns out well, as a ratio to those everywhere."""
        count = min(self._count, _LAST)
        is_good = self._is_good[:count]
        share = (int(is_good.sum()) + 1) / (count + 2)
        (x, y), (x_m, y_m) = place, self._xy_m[:, :count]
        near = is_good[(x_m - x) ** 2 + (y_m - y) ** 2 <= _NEAR_M**2]
        good = int(near.sum())
        return (good / share + _USUAL) / ((len(near) - good) / (1 - share) + _USUAL)


class PlacesOfLosses:
    """Where tracks were lost, and what became of them: called with the steps of a log, some at a time."""

    def __init__(self) -> None:
        self._odds = PlaceOdds()
        self._lost: dict[int, tuple[Place, float]] = {}  # where each lost track was lost, and the ratio there

    def __call__(self, passed: Ints, tick: Ints, ids: Ints, is_observed: Bools, xy_m: Floats) -> Floats:
        """The odds that lost tracks (R,) come back, as ratios to those of the whole log; 1 for others.

        ``passed`` (F,) is by how many steps time advanced, ``tick`` (R,) the index of the step of each track, rising,
        and ``xy_m`` (2, R) where it is. Nothing is known at a step that was not known then.
        """
        order = np.lexsort((tick, ids))
        ids, tick, missed = ids[order], tick[order], ~is_observed[order]
        starts = run_starts(ids)
        first, last = np.flatnonzero(starts), np.flatnonzero(run_ends(starts))
        names = ids[first].tolist()
        for name in self._lost.keys() - set(names):
            self._end(name, is_told=bool(passed[0] == 1))
        was_missed = np.append(False, missed[:-1])[: len(ids)]
        was_missed[first] = [name in self._lost for name in names]
        happened = (
            last[missed[last] & (tick[last] < len(passed) - 1)],
            np.flatnonzero(was_missed & ~missed),
            np.flatnonzero(missed & ~was_missed),
        )
        row, what = np.concatenate(happened), np.repeat(range(len(happened)), [len(rows) for rows in happened])
        when = tick[row] + (what == _OVER)
        x_m, y_m = xy_m[:, order[row]].tolist()
        ratio = np.ones(len(ids))  # at the row from which on it holds
        ratio[first] = [self._lost[name][1] if name in self._lost else 1.0 for name in names]
        events = zip(when.tolist(), what.tolist(), row.tolist(), ids[row].tolist(), x_m, y_m, strict=True)
        for step, event, at, name, x, y in sorted(events):
            if event == _OVER:
                self._end(name, is_told=bool(passed[step] == 1))
            elif event == _BACK:
                self._odds.add(self._lost.pop(name)[0], True)
                ratio[at] = 1.0
            else:
                ratio[at] = self._odds.ratio((x, y))
                self._lost[name] = (x, y), float(ratio[at])
        changes = np.union1d(first, row[what != _OVER])
        out = np.empty(len(order))
        out[order] = np.repeat(ratio[changes], np.diff(np.append(changes, len(order))))
        return out

    def _end(self, name: int, is_told: bool) -> None:
        """A lost track is over; a gap of the log ends tracks without telling anything of them."""
        place, _ = self._lost.pop(name)
        if is_told:
            self._odds.add(place, False)
