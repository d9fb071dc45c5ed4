"""Where tracks last and where lost ones come back, as far as the log has shown.

People come in and go out at some places, and false detections begin at others. Whether a new track will last is told by
what became of those that began nearby, and whether a lost track comes back by what became of those that were lost
nearby, each compared with the whole log.

Letters: F steps; R tracks alive at these steps, end to end.
"""

from __future__ import annotations

from dataclasses import dataclass
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
_OVER, _BACK, _BORN, _LASTED, _LOST = range(5)


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


@dataclass
class _Alive:
    """A track that is alive: where it began, until it has lasted; where it was lost, while it is; the ratios there."""

    began: Place | None
    lasts: float
    lost: Place | None = None
    returns: float = 1.0


class PlacesOfTracks:
    """Where tracks began and were lost, and what became of them: called with the steps of a log, some at a time."""

    def __init__(self) -> None:
        self._began, self._lost = PlaceOdds(), PlaceOdds()
        self._alive: dict[int, _Alive] = {}

    def __call__(
        self, passed: Ints, tick: Ints, ids: Ints, has_lasted: Bools, is_observed: Bools, xy_m: Floats
    ) -> tuple[Floats, Floats]:
        """The odds that tracks (R,) last, and that lost ones come back, as ratios to those of the whole log; or 1.

        ``passed`` (F,) is by how many steps time advanced, ``tick`` (R,) the index of the step of each track, rising,
        and ``xy_m`` (2, R) where it is. Nothing is known at a step that was not known then.
        """
        order = np.lexsort((tick, ids))
        ids, tick, lasted, missed = ids[order], tick[order], has_lasted[order], ~is_observed[order]
        starts = run_starts(ids)
        first, last = np.flatnonzero(starts), np.flatnonzero(run_ends(starts))
        names = ids[first].tolist()
        before = [self._alive.get(name) for name in names]
        had_lasted, was_missed = (np.append(False, values[:-1])[: len(ids)] for values in (lasted, missed))
        had_lasted[first] = [one is not None and one.began is None for one in before]
        was_missed[first] = [one is not None and one.lost is not None for one in before]
        happened = (
            last[tick[last] < len(passed) - 1],
            np.flatnonzero(was_missed & ~missed),
            first[[one is None for one in before]],
            np.flatnonzero(lasted & ~had_lasted),
            np.flatnonzero(missed & ~was_missed),
        )
        row, what = np.concatenate(happened), np.repeat(range(len(happened)), [len(rows) for rows in happened])
        when = tick[row] + (what == _OVER)
        x_m, y_m = xy_m[:, order[row]].tolist()
        for name in self._alive.keys() - set(names):
            self._end(name, is_told=bool(passed[0] == 1))
        # by the row from which on they hold
        lasts = {at: 1.0 if one is None else one.lasts for at, one in zip(first.tolist(), before, strict=True)}
        returns = {at: 1.0 if one is None else one.returns for at, one in zip(first.tolist(), before, strict=True)}
        events = zip(when.tolist(), what.tolist(), row.tolist(), ids[row].tolist(), x_m, y_m, strict=True)
        for step, event, at, name, *xy in sorted(events):
            place = (xy[0], xy[1])
            if event == _OVER:
                self._end(name, is_told=bool(passed[step] == 1))
            elif event == _BORN:
                self._alive[name] = _Alive(place, self._began.ratio(place))
                lasts[at] = self._alive[name].lasts
            else:
                returns[at] = self._go_on(self._alive[name], event, place)
        return _unsorted(lasts, order), _unsorted(returns, order)

    def _go_on(self, track: _Alive, event: int, place: Place) -> float:
        """Count what happened to a track in a place; returns the odds that it comes back, as a ratio, or 1."""
        if event == _LASTED and track.began is not None:
            self._began.add(track.began, True)
            track.began = None
        elif event == _LOST:
            track.lost, track.returns = place, self._lost.ratio(place)
        elif event == _BACK and track.lost is not None:
            self._lost.add(track.lost, True)
            track.lost, track.returns = None, 1.0
        return track.returns

    def _end(self, name: int, is_told: bool) -> None:
        """A track is over; a gap of the log ends tracks without telling anything of them."""
        track = self._alive.pop(name)
        if is_told and track.began is not None:
            self._began.add(track.began, False)
        if is_told and track.lost is not None:
            self._lost.add(track.lost, False)


def _unsorted(values: dict[int, float], order: Ints) -> Floats:
    """Values that hold from some rows on, row by row (R,), where row k of them stands at ``order[k]``."""
    at = np.array(sorted(values), np.int64)
    out = np.empty(len(order))
    out[order] = np.repeat([values[row] for row in at.tolist()], np.diff(np.append(at, len(order))))
    return out
