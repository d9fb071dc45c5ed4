"""Which online tracks are written, step by step, by what the log says so far of how long tracks last.

A track is confirmed once it was observed for a while, because false detections flicker. But if all tracks of a tracker
follow people, this delay hides people; and if many are false, even those that were confirmed are soon over. Both are
seen in the log: for each number of observations, how many of the tracks so far were observed again (the estimator of
E. L. Kaplan and P. Meier, 1958, which also counts tracks that are not over yet). A track that lasts with a probability
of at least a half is written from its first observation.

A track that is lost is written for a while, because most come back. Those that don't have left, or were false. Which is
likelier is learned in the same way, for each number of steps without an observation, for tracks that have not lasted
yet, and for those that would be outside of the area in which tracks were seen so far: most of these have left it. It
also depends on where the track was lost (``places``).

Letters: F steps, R tracks of all steps, end to end; H levels of observations, the last one of tracks that have lasted;
A levels of steps without an observation.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final, TypeAlias

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.ragged import run_ends, run_starts
from mcaptrack.transforms.retrack.online_tracker import HITS, IDS, MISSED

#: A track has lasted once it was observed for so many times as long as its confirmation takes.
_LASTING: Final = 3
#: Before anything is known: the probability that a track lasts, and that a lost one comes back; and for how many tracks
#: this counts at each number of observations and steps.
_LASTS, _RETURNS, _WEIGHT = 0.6, 0.8, 2.0
#: Numbers of observations, and of steps without one, are counted in at most so many levels.
_LEVELS: Final = 200


# Where lost tracks come back and where they don't, as far as the log has shown.
#
# People go out at some places, and are missed for a moment at others. Whether a lost track comes back is told by
# what became of those that were lost nearby, compared with the whole log. (Where a track began tells less of
# whether it will last: people who are soon occluded look like false detections.)
#
# Letters: F steps; R tracks alive at these steps, end to end.


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


# Convex hulls that grow. Letters: N points, V vertices.


#: Points so little outside are taken for inside, in units of length.
_SLACK: Final = 1e-6


@dataclass
class GrowingHull:
    """The convex hull of all points so far.

    Attributes
    ----------
    vertices : (V, 2) of float
        Its vertices, anticlockwise; fewer than three if no area was seen yet, which has no inside.

    Examples
    --------
    >>> hull = GrowingHull()
    >>> hull.add(np.array([[0.0, 4.0, 4.0, 0.0, 2.0], [0.0, 0.0, 4.0, 4.0, 2.0]]))
    >>> hull.vertices.tolist()
    [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]]
    >>> hull.holds(np.array([[1.0, 5.0], [1.0, 1.0]])).tolist()
    [True, False]
    """

    vertices: Floats = field(default_factory=lambda: np.empty((0, 2)))
    _normals: Floats = field(init=False, default_factory=lambda: np.empty((0, 2)))
    _limits: Floats = field(init=False, default_factory=lambda: np.empty((0, 1)))

    def holds(self, xy: Floats) -> Bools:
        """Which points (2, N) are inside, (N,); those that are NaN are not."""
        if not len(self._normals):
            return np.zeros(xy.shape[1], bool)
        return np.asarray((self._normals @ xy <= self._limits).all(axis=0))

    def add(self, xy: Floats) -> None:
        """Add points (2, N); those that are NaN are left out."""
        new = xy[:, np.isfinite(xy).all(axis=0) & ~self.holds(xy)]
        if not new.shape[1]:
            return
        points = sorted({(x, y) for x, y in [*self.vertices.tolist(), *new.T.tolist()]})
        ring = [*_chain(points), *_chain(points[::-1])]
        self.vertices = np.array(ring)
        if len(ring) > 2:
            edges = np.roll(self.vertices, -1, axis=0) - self.vertices
            outwards = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
            self._normals = outwards / np.hypot(*outwards.T)[:, None]
            self._limits = (self._normals * self.vertices).sum(axis=1)[:, None] + _SLACK


def _chain(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """One side of the hull of sorted points, without the last one (A. M. Andrew, 1979)."""
    out: list[tuple[float, float]] = []
    for x, y in points:
        while len(out) > 1:
            (ax, ay), (bx, by) = out[-2:]
            if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                break
            out.pop()
        out.append((x, y))
    return out[:-1] if len(out) > 1 else out


class ShownTracks:
    """Which tracks are written: called with the steps of a log, some at a time.

    Parameters
    ----------
    confirm_hits : int
        A track with so many observations is written in any case.
    coast : int
        A lost track is written for at most so many steps.
    max_age : int
        Tracks terminate after so many steps without an observation.
    adapts : bool
        Whether it follows the log. Otherwise tracks are written once they are confirmed, and if they are lost once they
        were observed half as often again.
    """

    def __init__(self, confirm_hits: int, coast: int, max_age: int, adapts: bool) -> None:
        self._adapts = adapts
        self._confirm_hits, self._coast, self._max_age = confirm_hits, coast, max_age
        self._lasting = _LASTING * (confirm_hits - 1) + 1
        self._levels, self._ages = min(self._lasting, _LEVELS), min(max_age, _LEVELS)
        self._seen = GrowingHull()
        self._places = PlacesOfLosses()
        # By level of observations: tracks that reached the next one or terminated, and those that terminated. By inside
        # and outside and level of steps without an observation: tracks that went on from there, and that came back.
        self._counts = np.zeros((2, self._levels + 1))
        self._returns = np.zeros((2, 2, self._ages + 1))
        self._prior = _WEIGHT * (1 - _LASTS ** (1 / max(self._levels - 1, 1)))
        self._prior_returns = _WEIGHT * (1 - (1 - _RETURNS) ** (1 / self._ages))
        #: Of the last step: id, levels of observations and of steps without one, and whether outside, (4, K).
        self._last: Ints = np.empty((4, 0), np.int64)

    def __call__(self, passed: Ints, tick: Ints, is_observed: Bools, tracks: Ints, xy_m: Floats) -> Bools:
        """Which of the tracks alive at each of F steps are written, (R,).

        ``passed`` (F,) is by how many steps time advanced, ``tick`` (R,) the number of the step of each row, rising;
        ``tracks`` (5, R) and ``xy_m`` (2, R) are as in ``Step``. Nothing is known at a step that was not known then.
        """
        is_confirmed, may_coast = tracks[HITS] >= self._confirm_hits, tracks[MISSED] <= self._coast
        if not self._adapts:
            is_old = tracks[HITS] * 2 >= self._confirm_hits * 3
            return np.asarray(np.where(is_observed, is_confirmed, may_coast & is_old))
        outside = ~self._inside(len(passed), tick, is_observed & is_confirmed, xy_m)
        level, next_level = (self._level(tracks[HITS] + more) for more in (0, 1))
        age = np.where(is_observed, 0, -(-np.minimum(tracks[MISSED], self._max_age) * self._ages // self._max_age))
        lasts, returns = self._learn(passed, tick, np.stack([tracks[IDS], level, age, outside]))
        lasting, where = level >= self._levels, outside.astype(np.intp)
        ratio = self._places(passed, tick, tracks[IDS], is_observed, xy_m)
        early = lasts[tick, level] >= 0.5
        comes_back = _at_odds(returns[tick, where, age], ratio) * lasts[tick, next_level] >= 0.5
        stays = may_coast & ((lasting & ~outside) | comes_back)
        return np.asarray(np.where(is_observed, early | is_confirmed, stays))

    def _level(self, hits: Ints) -> Ints:
        return -(-np.minimum(hits, self._lasting) * self._levels // self._lasting)

    def _inside(self, count: int, tick: Ints, is_sure: Bools, xy_m: Floats) -> Bools:
        """Which tracks (R,) are in the area in which others, or they themselves, were seen before."""
        bounds = np.searchsorted(tick, np.arange(count + 1)).tolist()
        inside = np.zeros(len(tick), bool)
        for low, high in pairwise(bounds):
            here = xy_m[:, low:high]
            inside[low:high] = self._seen.holds(here)
            if (is_sure[low:high] & ~inside[low:high]).any():
                self._seen.add(here[:, is_sure[low:high]])
        return inside

    def _learn(self, passed: Ints, tick: Ints, now: Ints) -> tuple[Floats, Floats]:
        """Learn from what became of tracks, of which ``now`` (4, R) is known at each step.

        Returns the probability that a track lasts at each step by its level of observations, (F, H + 1), and that a
        lost one comes back, by whether it is outside and the level of steps without an observation, (F, 2, A + 1).
        """
        count, levels = len(passed), self._levels + 1
        all_, at = np.concatenate([self._last, now], axis=1), np.append(np.full(self._last.shape[1], -1), tick)
        order = np.lexsort((at, all_[0]))
        (ids, level, age, outside), at = all_[:, order], at[order]
        goes_on = np.append(ids[1:] == ids[:-1], False)[: len(ids)]
        is_judged = goes_on | (at < count - 1)  # what became of those of the last step is not known yet
        then = np.minimum(at + 1, count - 1)
        is_judged &= passed[then] == 1  # a gap of the log ends tracks, and says nothing about them
        next_level, next_age = (np.append(values[1:], 0)[: len(ids)] for values in (level, age))
        lasting, back = level >= self._levels, goes_on & (next_age == 0)
        is_new = is_judged & ~lasting & (~goes_on | (next_level > level))
        is_lost = is_judged & (age > 0) & (~lasting | (outside > 0)) & (~goes_on | back | (next_age > age))
        place = then * levels + level
        counts = np.stack([_counted(place[which], count, (levels,)) for which in (is_new, is_new & ~goes_on)])
        shape = 2, self._ages + 1
        place = (then * 2 + outside) * shape[1] + age
        returns = np.stack([_counted(place[which], count, shape) for which in (is_lost, is_lost & back)])
        counts[:, 0] += self._counts
        returns[:, 0] += self._returns
        counts, returns = counts.cumsum(axis=1), returns.cumsum(axis=1)
        self._counts, self._returns, self._last = counts[:, -1], returns[:, -1], now[:, tick == count - 1]
        survives: Floats = 1 - (counts[1] + self._prior) / (counts[0] + _WEIGHT)
        survives[:, -1] = 1.0
        stays_lost: Floats = 1 - (returns[1] + self._prior_returns) / (returns[0] + _WEIGHT)
        return _from_here_on(survives), 1 - _from_here_on(stays_lost)


def _at_odds(probability: Floats, ratio: Floats) -> Floats:
    """Probabilities (R,) with odds multiplied by ``ratio`` (R,)."""
    return np.asarray(probability * ratio / (1 - probability + probability * ratio))


def _counted(place: Ints, count: int, shape: tuple[int, ...]) -> Floats:
    """Count each of the places of ``count`` tables, laid end to end."""
    size = count * int(np.prod(shape))
    return np.bincount(place, minlength=size).reshape(count, *shape).astype(np.float64)


def _from_here_on(survives: Floats) -> Floats:
    """The products of the last elements along the last axis, from each of them on."""
    return np.asarray(np.cumprod(survives[..., ::-1], axis=-1)[..., ::-1], np.float64)
