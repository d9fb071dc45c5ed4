"""Pairing of forecasts with people: at each time tracks and people are assigned by their last positions.

At each prediction time, tracks with a forecast are assigned to people of the ground truth by how well their last
``t_obs`` positions agree (Yu and Zhou 2021, Eq. 4). One assignment at each time serves all thresholds.

People count if ``t_obs`` past positions and all future positions are known, forecasts if their track has ``t_obs`` past
positions (gaps inside a track are interpolated from positions known at that time). Others are not counted at all.

Letters: N rows, S people of the ground truth at one time, F forecasts at one time, T future steps, P matched pairs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.assignment import solve
from mcaptrack.geometry.mixtures import Tails, normal_tails
from mcaptrack.geometry.ragged import cross_pairs, group_index, ragged_range, run_ends, run_starts

#: The number of pairs compared at once, to limit memory.
_PAIRS_AT_ONCE: Final = 200_000
#: Gaps of more steps are not interpolated: an id may go on after a jump of the clock by years.
_MOST_FILLED: Final = 600


@dataclass(frozen=True)
class Positions:
    """Positions at the steps of a regular clock: ``step`` (N,) and ``id`` (N,) are ints, ``xy_m`` is (N, 2)."""

    step: Ints
    id: Ints
    xy_m: Floats


class _SortedPositions(NamedTuple):
    """Positions sorted by id and step, at most one for each: the ids (I,), and for each row its index in them (N,)."""

    ids: Ints
    slot: Ints
    step: Ints
    xy_m: Floats

    def is_continuous(self, by: int) -> Bools:
        """Whether the same id has all positions from here to ``by`` steps ahead, or back (N,)."""
        out = np.zeros(len(self.slot), bool)
        if abs(by) < len(out):
            here, ahead = slice(max(-by, 0), len(out) - max(by, 0)), slice(max(by, 0), len(out) - max(-by, 0))
            out[here] = (self.slot[ahead] == self.slot[here]) & (self.step[ahead] == self.step[here] + by)
        return out

    def find(self, ids: Ints, step: Ints) -> Ints:
        """The rows of these ids at these steps (M,); -1 where there is none."""
        if not len(self.slot):
            return np.full(len(ids), -1)
        first, width = int(self.step.min()), int(np.ptp(self.step)) + 1
        place = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        wanted = place * width + (step - first)
        keys = self.slot * width + (self.step - first)
        at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        exists = (self.ids[place] == ids) & (step >= first) & (step < first + width) & (keys[at] == wanted)
        return np.where(exists, at, -1)

    def window(self, at: Ints, first: int, last: int) -> Floats:
        """The positions (M, last - first + 1, 2) from ``first`` to ``last`` steps after the rows ``at`` (M,)."""
        return np.asarray(self.xy_m[at[:, None] + np.arange(first, last + 1)], np.float64)


def _sorted_positions(path: Positions, fill: bool) -> _SortedPositions:
    """Sort positions; with ``fill`` gaps are interpolated linearly, if they are not longer than any past needs."""
    is_known = np.isfinite(path.xy_m).all(axis=1)
    ids, slot = np.unique(path.id[is_known], return_inverse=True)
    step, xy_m = path.step[is_known], path.xy_m[is_known]
    order = np.lexsort((step, slot))
    slot, step, xy_m = slot[order], step[order], xy_m[order]
    last = run_ends(run_starts(slot, step))
    slot, step, xy_m = slot[last], step[last], xy_m[last]
    if fill and len(slot) > 1:
        gap = np.diff(step)
        ahead = np.append(np.where((slot[1:] == slot[:-1]) & (gap <= _MOST_FILLED), gap, 1), 1)
        row, within = group_index(ahead), ragged_range(0, ahead)
        inside, share = within > 0, within / ahead[row]
        filled = xy_m[row]
        filled[inside] += share[inside, None] * (xy_m[row[inside] + 1] - filled[inside])
        slot, step, xy_m = slot[row], step[row] + within, filled
    return _SortedPositions(ids, slot, step, xy_m)


@dataclass(frozen=True)
class Forecasts:
    """Forecasts made at ``step`` (N,) for ``id`` (N,): mean (N, T, 2) in m, covariance (N, T, 2, 2) in m^2.

    ``tails`` (N, T) are the shapes of their distributions, None if all are normal distributions.
    """

    step: Ints
    id: Ints
    mean_m: Floats
    cov_m2: Floats
    tails: Tails | None = None

    def shapes(self, which: Ints | Bools) -> Tails:
        """The shapes of the distributions of some forecasts."""
        return normal_tails(self.mean_m[which].shape[:2]) if self.tails is None else self.tails.chosen(which)


class PairedForecasts(NamedTuple):
    """P pairs of a forecast and a person, by step and person, whether or not the person's future is known.

    ``forecast`` (P,) is the number of the forecast, ``person`` (P,) the id, ``offset_m`` (P, T, 2) the forecast minus
    the true future, NaN if that is not known completely. ``is_judged`` (N,) says which forecasts could be paired,
    ``people`` counts those with past and future, at the ``frames`` times of a forecast.
    """

    forecast: Ints
    person: Ints
    d_obs_m2: Floats
    offset_m: Floats
    is_judged: Bools
    people: int
    frames: int


def pair_forecasts(ground_truth: Positions, tracks: Positions, forecasts: Forecasts, t_obs: int = 4) -> PairedForecasts:
    """Assign the forecasts made for tracks to people by their past positions.

    Parameters
    ----------
    ground_truth : Positions
    tracks : Positions
        The positions from which the forecasts were made.
    forecasts : Forecasts
        On the same clock as the other two. The order of rows has no influence.
    t_obs : int
        The number of past positions to compare.

    Returns
    -------
    PairedForecasts

    Examples
    --------
    A person walks 0.4 m at each step; the forecast made at step 4 says that they stop:

    >>> import numpy as np
    >>> walk = Positions(np.arange(8), np.ones(8, int), np.stack([0.4 * np.arange(8), np.zeros(8)], axis=1))
    >>> stop = Forecasts(np.array([4]), np.array([1]), np.full((1, 3, 2), [1.6, 0.0]), np.tile(np.eye(2), (1, 3, 1, 1)))
    >>> found = pair_forecasts(walk, walk, stop)
    >>> found.forecast.tolist(), found.person.tolist(), found.offset_m[0, :, 0].round(1).tolist()
    ([0], [1], [-0.4, -0.8, -1.2])
    """
    horizon = forecasts.mean_m.shape[1]
    people, paths = _sorted_positions(ground_truth, fill=False), _sorted_positions(tracks, fill=True)
    steps = np.unique(forecasts.step)
    has_past, has_future = people.is_continuous(1 - t_obs), people.is_continuous(horizon)
    place = paths.find(forecasts.id, forecasts.step)
    is_judged = (place >= 0) & paths.is_continuous(1 - t_obs)[place] if len(paths.slot) else np.zeros(len(place), bool)
    subject = np.flatnonzero(has_past & np.isin(people.step, steps))
    subject = subject[np.argsort(people.step[subject], kind="stable")]
    judged = np.flatnonzero(is_judged)
    judged = judged[np.lexsort((forecasts.id[judged], forecasts.step[judged]))]
    past_true = people.window(subject, 1 - t_obs, 0)
    past = paths.window(place[judged], 1 - t_obs, 0)
    row, column, d_obs = _assigned(past_true, past, people.step[subject], forecasts.step[judged], steps)
    at, number = subject[row], judged[column]
    offset = np.full((len(at), horizon, 2), np.nan)
    has_truth = has_future[at]
    offset[has_truth] = forecasts.mean_m[number[has_truth]] - people.window(at[has_truth], 1, horizon)
    counted = int(has_future[subject].sum())
    return PairedForecasts(number, people.ids[people.slot[at]], d_obs, offset, is_judged, counted, len(steps))


def _assigned(past_true: Floats, past: Floats, true_step: Ints, step: Ints, steps: Ints) -> tuple[Ints, Ints, Floats]:
    """Assign pasts to each other at each of ``steps``: rows (P,), columns (P,) and mean squared distances (P,).

    Pasts (S, t_obs, 2) and (F, t_obs, 2) are ordered by step.
    """
    true_ends, ends = (np.searchsorted(those, np.append(steps, np.iinfo(np.int64).max)) for those in (true_step, step))
    size = np.diff(true_ends) * np.diff(ends)
    parts: list[tuple[Ints, Ints, Floats]] = [(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))]
    block = (np.cumsum(size) - size) // _PAIRS_AT_ONCE
    cuts = np.flatnonzero(np.diff(block)) + 1
    for low, high in zip([0, *cuts.tolist()], [*cuts.tolist(), len(size)], strict=True):
        at = slice(low, high + 1)
        down, across = np.diff(true_ends[at]), np.diff(ends[at])
        which, row, column = cross_pairs(down, across)
        row, column = row + true_ends[low], column + ends[low]
        cost = ((past_true[row] - past[column]) ** 2).sum(axis=-1).mean(axis=-1)
        best = _best(cost, row, column, which, down, across)
        parts.append((row[best], column[best], cost[best]))
    rows, columns, costs = (np.concatenate(part) for part in zip(*parts, strict=True))
    return rows, columns, costs


def _best(cost: Floats, row: Ints, column: Ints, which: Ints, down: Ints, across: Ints) -> Ints:
    """Choose pairs of least total cost at each time, as many as the smaller side has.

    If the nearest partners of the smaller side are all different, they are the solution; the solver runs for the
    rest.
    """
    is_by_row = (down <= across)[which]
    mine, other = np.where(is_by_row, row, column), np.where(is_by_row, column, row)
    order = np.lexsort((cost, mine, which))
    nearest = order[run_starts(mine[order], which[order])]
    by_other = nearest[np.lexsort((other[nearest], which[nearest]))]
    contested = np.unique(which[by_other][~run_starts(other[by_other], which[by_other])])
    taken = [nearest[~np.isin(which[nearest], contested)]]
    size = down * across
    start = np.cumsum(size) - size
    for k in contested.tolist():
        rows, columns = solve(cost[start[k] : start[k] + size[k]].reshape(down[k], across[k]))
        taken.append(start[k] + rows * across[k] + columns)
    return np.sort(np.concatenate(taken))
