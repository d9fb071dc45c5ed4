"""How good forecasts are that were made from tracks: displacement errors over recall, and more.

At every prediction time the tracks that carry a forecast are assigned to the true people by how well their last
``t_obs`` positions agree (Yu and Zhou 2021, Eq. 4). One assignment a time serves every threshold: sorted by that
distance, the running mean of the errors against the share of people matched so far is the exact curve.

Counted are people with ``t_obs`` past and all future positions, and forecasts of tracks with ``t_obs`` past positions
(holes inside a track filled linearly between what was known by then). Others are counted neither for nor against.

Letters: N rows, S true people at one time, F forecasts at one time, T future steps, P matched pairs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.evaluation.metrics.calibration import LEVELS, mahalanobis_squared
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.assignment import solve

#: The threshold of association at which single numbers are given, in m^2 (the paper's tau).
TAU_M2: Final = 2.0
#: The quantiles of chi^2 with 2 degrees of freedom that belong to the levels of calibration.
_CHI2: Final = -2 * np.log(1 - np.array(LEVELS))
#: How many pairs are compared in one go, to bound the memory that takes.
_PAIRS_AT_ONCE: Final = 200_000


@dataclass(frozen=True)
class Path:
    """Positions on a regular clock. ``step`` (N,), ``id`` (N,) whole numbers, ``xy_m`` (N, 2)."""

    step: Ints
    id: Ints
    xy_m: Floats


class _Paths(NamedTuple):
    """Positions by id and step, one for each step of an id: ids (I,), and which of them, when and where (N,)."""

    names: Ints
    who: Ints
    step: Ints
    xy_m: Floats

    def goes(self, by: int) -> Bools:
        """Whether the same id has all positions from here to ``by`` steps on, or back."""
        out = np.zeros(len(self.who), bool)
        if abs(by) < len(out):
            here, there = slice(max(-by, 0), len(out) - max(by, 0)), slice(max(by, 0), len(out) - max(-by, 0))
            out[here] = (self.who[there] == self.who[here]) & (self.step[there] == self.step[here] + by)
        return out

    def find(self, names: Ints, step: Ints) -> Ints:
        """Where the positions of these ids at these steps (M,) stand; -1 for those that there are none of."""
        if not len(self.who):
            return np.full(len(names), -1)
        first, width = int(self.step.min()), int(np.ptp(self.step)) + 1
        slot = np.minimum(np.searchsorted(self.names, names), len(self.names) - 1)
        wanted = slot * width + (step - first)
        keys = self.who * width + (self.step - first)
        at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        known = (self.names[slot] == names) & (step >= first) & (step < first + width) & (keys[at] == wanted)
        return np.where(known, at, -1)

    def window(self, at: Ints, first: int, last: int) -> Floats:
        """The positions (M, last - first + 1, 2) from ``first`` to ``last`` steps after those at ``at`` (M,)."""
        return np.asarray(self.xy_m[at[:, None] + np.arange(first, last + 1)], np.float64)


def _paths(path: Path, fill: bool) -> _Paths:
    """Positions in order; with ``fill`` holes are filled, on the straight line."""
    known = np.isfinite(path.xy_m).all(axis=1)
    names, who = np.unique(path.id[known], return_inverse=True)
    step, xy_m = path.step[known], path.xy_m[known]
    order = np.lexsort((step, who))
    who, step, xy_m = who[order], step[order], xy_m[order]
    last = np.append((who[1:] != who[:-1]) | (step[1:] != step[:-1]), True)[: len(who)]
    who, step, xy_m = who[last], step[last], xy_m[last]
    if fill and len(who) > 1:
        ahead = np.append(np.where(who[1:] == who[:-1], np.diff(step), 1), 1)
        row = np.repeat(np.arange(len(who)), ahead)
        within = np.arange(len(row)) - np.repeat(np.cumsum(ahead) - ahead, ahead)
        inside, share = within > 0, within / ahead[row]
        filled = xy_m[row]
        filled[inside] += share[inside, None] * (xy_m[row[inside] + 1] - filled[inside])
        who, step, xy_m = who[row], step[row] + within, filled
    return _Paths(names, who, step, xy_m)


@dataclass(frozen=True)
class Forecasts:
    """Forecasts made at ``step`` (N,) for ``id`` (N,): mean (N, T, 2) in m, covariance (N, T, 2, 2) in m^2."""

    step: Ints
    id: Ints
    mean_m: Floats
    cov_m2: Floats


@dataclass(frozen=True)
class Displacement:
    """The pairs (P,) of people and forecasts of one or several sequences, and what is left over."""

    d_obs_m2: Floats
    ade_m: Floats
    fde_m: Floats
    ade_squared_m2: Floats
    covered: Floats  # (P, 3): share of the future steps inside the 50, 90 and 95 % ellipse; NaN without covariance
    people: int
    false_forecasts: int
    frames: int
    drift_m: Floats  # |P_t - P_t+1| over the shared steps of consecutive forecasts of one track
    away_m: Floats  # (P, T): how far each step is from the truth; NaN where another sequence foretells further

    def curve(self) -> tuple[Floats, Floats]:
        """Recall (P,) and ADE in m (P,): entry k holds for the k + 1 pairs that agree best on the past."""
        order = np.argsort(self.d_obs_m2, kind="stable")
        count = np.arange(1, len(order) + 1)
        return count / max(self.people, 1), np.cumsum(self.ade_m[order]) / count

    def squared_at(self, recall: float) -> float:
        """The squared ADE in m^2 (the paper's) of the pairs that agree best on the past, up to a recall; NaN beyond."""
        count = round(recall * self.people)
        best = np.argsort(self.d_obs_m2, kind="stable")[:count]
        return float(self.ade_squared_m2[best].mean()) if 0 < count == len(best) else float("nan")

    def away_by_step(self, tau_m2: float = TAU_M2) -> Floats:
        """How far the steps of the pairs that count at one threshold are from the truth, (pairs, T) in m."""
        return self.away_m[self.d_obs_m2 < tau_m2]

    def summary(self, tau_m2: float = TAU_M2) -> dict[str, float | None]:
        """The numbers at one threshold; None where there is nothing to average."""
        kept = self.d_obs_m2 < tau_m2

        def mean(values: Floats) -> float | None:
            return float(values.mean()) if len(values) and np.isfinite(values).all() else None

        _, running = self.curve()
        return {
            "ADE_m": mean(self.ade_m[kept]),
            "FDE_m": mean(self.fde_m[kept]),
            "ADE_squared_m2": mean(self.ade_squared_m2[kept]),
            "recall": kept.sum() / self.people if self.people else None,
            "AADE_m": mean(running[: int(kept.sum())]),
            "false_forecasts_per_frame": self.false_forecasts / self.frames if self.frames else None,
            "consistency_m": mean(self.drift_m),
            **{f"coverage_{100 * p:g}": mean(self.covered[kept, k]) for k, p in enumerate(LEVELS)},
        }


def combine(parts: list[Displacement]) -> Displacement:
    """Several sequences as one: all pairs pooled."""

    def pooled(name: str) -> Floats:
        return np.concatenate([getattr(part, name) for part in parts])

    furthest = max(part.away_m.shape[1] for part in parts)
    away = [np.pad(p.away_m, ((0, 0), (0, furthest - p.away_m.shape[1])), constant_values=np.nan) for p in parts]
    return Displacement(
        d_obs_m2=pooled("d_obs_m2"),
        ade_m=pooled("ade_m"),
        fde_m=pooled("fde_m"),
        ade_squared_m2=pooled("ade_squared_m2"),
        covered=pooled("covered"),
        people=sum(part.people for part in parts),
        false_forecasts=sum(part.false_forecasts for part in parts),
        frames=sum(part.frames for part in parts),
        drift_m=pooled("drift_m"),
        away_m=np.concatenate(away),
    )


class Paired(NamedTuple):
    """Who is whom: P pairs of forecasts and true people, by step and person, whether or not their future is known.

    ``forecast`` (P,) is the number of the forecast, ``person`` (P,) the id, ``off_m`` (P, T, 2) how far the forecast is
    off, NaN where the future is not known as a whole. ``is_judged`` (N,) says which forecasts could be paired,
    ``people`` counts those who have past and future, at each of the ``frames`` times of a forecast.
    """

    forecast: Ints
    person: Ints
    d_obs_m2: Floats
    off_m: Floats
    is_judged: Bools
    people: int
    frames: int


def pair(truth: Path, tracks: Path, forecasts: Forecasts, t_obs: int = 4) -> Paired:
    """The forecasts made for tracks, with the true people they belong to by their past, of a clock that all share.

    ``tracks`` are the positions that the forecasts were made from. The order of rows does not matter.
    """
    horizon = forecasts.mean_m.shape[1]
    people, paths = _paths(truth, fill=False), _paths(tracks, fill=True)
    steps = np.unique(forecasts.step)
    has_past, has_future = people.goes(1 - t_obs), people.goes(horizon)
    place = paths.find(forecasts.id, forecasts.step)
    is_judged = (place >= 0) & paths.goes(1 - t_obs)[place] if len(paths.who) else np.zeros(len(place), bool)
    subject = np.flatnonzero(has_past & np.isin(people.step, steps))
    subject = subject[np.argsort(people.step[subject], kind="stable")]
    made = np.flatnonzero(is_judged)
    made = made[np.lexsort((forecasts.id[made], forecasts.step[made]))]
    past_true = people.window(subject, 1 - t_obs, 0)
    past = paths.window(place[made], 1 - t_obs, 0)
    row, column, d_obs = _assigned(past_true, past, people.step[subject], forecasts.step[made], steps)
    who, number = subject[row], made[column]
    off = np.full((len(who), horizon, 2), np.nan)
    known = has_future[who]
    off[known] = forecasts.mean_m[number[known]] - people.window(who[known], 1, horizon)
    counted = int(has_future[subject].sum())
    return Paired(number, people.names[people.who[who]], d_obs, off, is_judged, counted, len(steps))


def _assigned(past_true: Floats, past: Floats, true_step: Ints, step: Ints, steps: Ints) -> tuple[Ints, Ints, Floats]:
    """Rows (P,) and columns (P,) of the pairs of least total squared distance at each of ``steps``, and that (P,).

    Pasts (S, t_obs, 2) and (F, t_obs, 2) are at rising steps.
    """
    true_ends, ends = (np.searchsorted(those, np.append(steps, np.iinfo(np.int64).max)) for those in (true_step, step))
    size = np.diff(true_ends) * np.diff(ends)
    parts: list[tuple[Ints, Ints, Floats]] = [(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))]
    block = (np.cumsum(size) - size) // _PAIRS_AT_ONCE
    cuts = np.flatnonzero(np.diff(block)) + 1
    for low, high in zip([0, *cuts.tolist()], [*cuts.tolist(), len(size)], strict=True):
        at = slice(low, high + 1)
        row, column, which = _all_pairs(true_ends[at], ends[at])
        cost = ((past_true[row] - past[column]) ** 2).sum(axis=-1).mean(axis=-1)
        best = _best(cost, row, column, which, np.diff(true_ends[at]), np.diff(ends[at]))
        parts.append((row[best], column[best], cost[best]))
    rows, columns, costs = (np.concatenate(part) for part in zip(*parts, strict=True))
    return rows, columns, costs


def _all_pairs(true_ends: Ints, ends: Ints) -> tuple[Ints, Ints, Ints]:
    """Row, column and time of all pairs of each time; those of time k are from ``ends[k]`` to ``ends[k + 1]``."""
    across = np.diff(ends)
    size = np.diff(true_ends) * across
    which = np.repeat(np.arange(len(size)), size)
    within = np.arange(len(which)) - (np.cumsum(size) - size)[which]
    return true_ends[which] + within // across[which], ends[which] + within % across[which], which


def _best(cost: Floats, row: Ints, column: Ints, which: Ints, down: Ints, across: Ints) -> Ints:
    """The pairs to take of all: those of least total cost at each time, as many as the fewer of both sides.

    Where the nearest to each of the fewer are different ones, these are they; only the rest needs the solver.
    """
    is_by_row = (down <= across)[which]
    one, other = np.where(is_by_row, row, column), np.where(is_by_row, column, row)
    order = np.lexsort((cost, one, which))
    is_first = np.ones(len(order), bool)
    is_first[1:] = (one[order][1:] != one[order][:-1]) | (which[order][1:] != which[order][:-1])
    nearest = order[is_first[: len(order)]]
    by_other = nearest[np.lexsort((other[nearest], which[nearest]))]
    twice = (other[by_other][1:] == other[by_other][:-1]) & (which[by_other][1:] == which[by_other][:-1])
    contested = np.unique(which[by_other][1:][twice])
    taken = [nearest[~np.isin(which[nearest], contested)]]
    size = down * across
    start = np.cumsum(size) - size
    for k in contested.tolist():
        rows, columns = solve(cost[start[k] : start[k] + size[k]].reshape(down[k], across[k]))
        taken.append(start[k] + rows * across[k] + columns)
    return np.sort(np.concatenate(taken))


def displacement(
    truth: Path, tracks: Path, forecasts: Forecasts, t_obs: int = 4, tau_m2: float = TAU_M2
) -> Displacement:
    """Compare the forecasts made for tracks with the true future of the people they belong to.

    All three share one clock. ``tracks`` are the positions that the forecasts were made from.
    """
    found = pair(truth, tracks, forecasts, t_obs)
    known = np.isfinite(found.off_m).all(axis=(1, 2))
    ade_m, fde_m, squared_m2, covered, away_m = errors(found.off_m[known], forecasts.cov_m2[found.forecast[known]])
    return Displacement(
        d_obs_m2=found.d_obs_m2[known],
        ade_m=ade_m,
        fde_m=fde_m,
        ade_squared_m2=squared_m2,
        covered=covered,
        people=found.people,
        false_forecasts=int(found.is_judged.sum() - (found.d_obs_m2 < tau_m2).sum()),
        frames=found.frames,
        drift_m=_drift(forecasts),
        away_m=away_m,
    )


def errors(off: Floats, cov: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """ADE, FDE, squared ADE, covered shares and distances (P, T) of P pairs.

    From errors (P, T, 2) and covariances (P, T, 2, 2).
    """
    squared = (off**2).sum(axis=-1)
    euclidean = np.sqrt(squared)
    with np.errstate(invalid="ignore", divide="ignore"):
        away = mahalanobis_squared(off, cov)[..., None]
    inside = np.where(np.isfinite(away), away <= _CHI2, np.nan)
    return euclidean.mean(axis=-1), euclidean[..., -1], squared.mean(axis=-1), inside.mean(axis=-2), euclidean


def _drift(forecasts: Forecasts) -> Floats:
    order = np.lexsort((forecasts.step, forecasts.id))
    step, who, mean = forecasts.step[order], forecasts.id[order], forecasts.mean_m[order]
    next_one = (who[1:] == who[:-1]) & (step[1:] == step[:-1] + 1)
    off = mean[:-1, 1:][next_one] - mean[1:, :-1][next_one]
    return np.asarray(np.hypot(off[..., 0], off[..., 1]).mean(axis=-1) if len(off) else np.empty(0))
