"""Scores of forecasts made from tracks: displacement errors over recall, and calibration.

Each forecast is compared with the future of the person that its track is paired with. The running mean of
the errors, sorted by the distance of the pasts, over the share of people matched so far is the exact curve.

Letters: T future steps, P matched pairs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints, taken
from mcaptrack.geometry.assignment import solve
from mcaptrack.geometry.mixtures import Tails, log_density, mahalanobis_squared, mass_within, normal_tails
from mcaptrack.geometry.ragged import cross_pairs, find_rows, group_index, ragged_range, run_ends, run_starts

__all__ = ["LEVELS", "Displacement", "forecast_scores"]

#: The association threshold in m^2 at which single numbers are reported (tau in the paper).
TAU_M2: Final = 2.0
#: The number of past positions by which tracks are assigned to people.
_PAST: Final = 4


# Scores of forecasts when the true future is known: displacement errors, likelihood, and calibration.
#
# Letters: N forecasts, T future steps.


#: The probabilities of the ellipses for which reliability is reported.
RELIABILITY_LEVELS: Final = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
#: The levels that tables have columns for.
LEVELS: Final = (0.5, 0.9, 0.95)


def ellipse_levels(off_m: Floats, cov_m2: Floats, tails: Tails) -> Floats:
    """The probabilities of the smallest ellipses that hold errors: uniform from 0 to 1 if forecasts are calibrated.

    Parameters
    ----------
    off_m : array (..., 2), m
        Errors.
    cov_m2 : array (..., 2, 2), m^2
        Covariances of the forecasts.
    tails : Tails (...)
        Shapes of their distributions.

    Returns
    -------
    array (...)
        NaN where the covariance is not known.

    Examples
    --------
    >>> import numpy as np
    >>> cov_m2 = np.tile(np.eye(2), (2, 1, 1))
    >>> ellipse_levels(np.array([[0.0, 0.0], [3.0, 0.0]]), cov_m2, normal_tails(2)).round(3).tolist()
    [0.0, 0.989]
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        squared = mahalanobis_squared(off_m, cov_m2)
    return np.where(np.isfinite(squared), mass_within(squared, tails), np.nan)


def negative_log_likelihood(off_m: Floats, cov_m2: Floats, tails: Tails) -> Floats:
    """The negative log-likelihood of errors, in nats; of errors in metres, so that smaller ellipses can be below 0.

    Parameters
    ----------
    off_m : array (..., 2), m
        Errors.
    cov_m2 : array (..., 2, 2), m^2
        Covariances of the forecasts.
    tails : Tails (...)
        Shapes of their distributions.

    Returns
    -------
    array (...)
        NaN where the covariance is not known.

    Examples
    --------
    >>> import numpy as np
    >>> negative_log_likelihood(np.zeros((1, 2)), np.eye(2)[None], normal_tails(1)).round(3).tolist()
    [1.838]
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        squared = mahalanobis_squared(off_m, cov_m2)
        log_area = np.log(cov_m2[..., 0, 0] * cov_m2[..., 1, 1] - cov_m2[..., 0, 1] ** 2) / 2
    return np.where(np.isfinite(squared), -log_density(squared, log_area, tails), np.nan)


def coverage(off_m: Floats, cov_m2: Floats, level: float, tails: Tails | None = None) -> float:
    """The share of errors that lie inside the ellipses of a probability. Calibrated forecasts have a share of
    ``level``.

    Parameters
    ----------
    off_m : array (..., 2), m
        Errors.
    cov_m2 : array (..., 2, 2), m^2
        Covariances of the forecasts.
    level : float
        Probability of the ellipses, between 0 and 1.
    tails : Tails (...), optional
        Shapes of the distributions; normal distributions if left out.

    Returns
    -------
    float
        Between 0 and 1.

    Examples
    --------
    >>> import numpy as np
    >>> coverage(np.array([[0.1, 0.0], [9.0, 0.0]]), np.tile(np.eye(2), (2, 1, 1)), 0.95)
    0.5
    """
    shapes = normal_tails(off_m.shape[:-1]) if tails is None else tails
    return float((ellipse_levels(off_m, cov_m2, shapes) <= level).mean())


def forecast_scores(mean_m: Floats, cov_m2: Floats, future_m: Floats, tails: Tails | None = None) -> dict[str, float]:
    """Compare forecasts with the true future.

    Parameters
    ----------
    mean_m : array (N, T, 2), m
        Predicted positions.
    cov_m2 : array (N, T, 2, 2), m^2
        Their covariances.
    future_m : array (N, T, 2), m
        True positions.
    tails : Tails (N, T), optional
        Shapes of the distributions; normal distributions if left out.

    Returns
    -------
    dict
        ADE_m and FDE_m: mean Euclidean distance over all steps [1]_ and at the last step [2]_. ADE_squared_m2: mean
        squared distance, as in [3]_. NLL: mean negative log-likelihood of a step, in nats. coverage_P: share of the
        true positions inside the P % ellipses.

    References
    ----------
    .. [1] S. Pellegrini, A. Ess, K. Schindler, L. Van Gool: You'll Never Walk Alone: Modeling Social Behavior for
       Multi-Target Tracking. ICCV 2009.
    .. [2] A. Alahi, K. Goel, V. Ramanathan, A. Robicquet, L. Fei-Fei, S. Savarese: Social LSTM: Human Trajectory
       Prediction in Crowded Spaces. CVPR 2016.
    .. [3] S. Yu, H. Zhou: Re-tracking by prediction. IROS 2021.

    Examples
    --------
    >>> import numpy as np
    >>> future_m = np.zeros((1, 2, 2))
    >>> mean_m = np.array([[[3.0, 4.0], [6.0, 8.0]]])
    >>> found = forecast_scores(mean_m, np.tile(np.eye(2), (1, 2, 1, 1)), future_m)
    >>> found["ADE_m"], found["FDE_m"], found["coverage_95"]
    (7.5, 10.0, 0.0)
    """
    off = mean_m - future_m
    away = np.hypot(off[..., 0], off[..., 1])
    shapes = normal_tails(away.shape) if tails is None else tails
    return {
        "ADE_m": float(away.mean()),
        "FDE_m": float(away[:, -1].mean()),
        "ADE_squared_m2": float((away**2).mean()),
        "NLL": float(negative_log_likelihood(off, cov_m2, shapes).mean()),
        **{f"coverage_{100 * level:g}": coverage(off, cov_m2, level, shapes) for level in LEVELS},
    }


@dataclass(frozen=True)
class Displacement:
    """The errors of P matched forecasts of one or several sequences, and counts of the others.

    ``d_obs_m2`` (P,) is the mean squared distance of the matched pasts in m^2. ``ade_m``, ``fde_m`` and
    ``ade_squared_m2`` (P,) are mean errors over the steps of a forecast, at its last step, and squared. ``covered`` (P,
    levels) is the share of the future steps inside the ellipse of each level, ``nll`` (P,) the mean negative
    log-likelihood of a future step in nats, both NaN without covariance. ``people`` counts those with a future,
    ``false_forecasts`` the forecasts of none of them, in so many ``frames``. ``consistency_m`` are distances of
    consecutive forecasts of one track over the steps that they share. ``error_m`` (P, T) is the distance of each step
    from the ground truth, NaN beyond the horizon of shorter forecasts; ``straight_error_m`` (P, T) is the same if these
    tracks went on at constant velocity.
    """

    d_obs_m2: Floats
    ade_m: Floats
    fde_m: Floats
    ade_squared_m2: Floats
    covered: Floats  # (P, levels): share of the future steps inside the ellipse of each level; NaN without covariance
    nll: Floats  # mean negative log-likelihood of a future step; NaN without covariance
    people: int
    false_forecasts: int
    frames: int
    consistency_m: Floats  # |P_t - P_t+1| over the shared steps of consecutive forecasts of one track
    error_m: Floats  # (P, T): distance of each step from the ground truth; NaN beyond the horizon of shorter forecasts
    straight_error_m: Floats  # (P, T): the same if these tracks went on at constant velocity

    def curve(self, squared: bool = False) -> tuple[Floats, Floats]:
        """Recall (P,) and ADE (P,) in m, or squared in m^2: entry k is for the k + 1 pairs with the most similar pasts.

        Pairs are assigned once for each time, whatever the threshold of their pasts (the paper's tau), so that raising
        it adds pairs one by one: this is the curve for all thresholds.
        """
        order = np.argsort(self.d_obs_m2, kind="stable")
        count = np.arange(1, len(order) + 1)
        error = self.ade_squared_m2 if squared else self.ade_m
        return count / max(self.people, 1), np.cumsum(error[order]) / count

    def squared_at(self, recall: float) -> float:
        """The squared ADE in m^2 of the pairs with the most similar pasts, up to a recall; NaN beyond."""
        count = round(recall * self.people)
        best = np.argsort(self.d_obs_m2, kind="stable")[:count]
        return float(self.ade_squared_m2[best].mean()) if 0 < count == len(best) else float("nan")

    def errors_by_step(self) -> Floats:
        """The distance of each step from the ground truth, (pairs, T) in m, for the pairs below the threshold."""
        return self.error_m[self.d_obs_m2 < TAU_M2]

    def constant_velocity(self) -> dict[str, float | None]:
        """ADE_m and FDE_m of constant velocity for the same tracks at the same times, as in ``summary``."""
        away_m = self.straight_error_m[self.d_obs_m2 < TAU_M2]
        if not len(away_m):
            return {"ADE_m": None, "FDE_m": None}
        steps = np.isfinite(away_m).sum(axis=1)
        last_m = away_m[np.arange(len(away_m)), steps - 1]
        return {"ADE_m": float((np.nansum(away_m, axis=1) / steps).mean()), "FDE_m": float(last_m.mean())}

    def summary(self) -> dict[str, float | None]:
        """Compute the scores of the pairs below the threshold.

        Returns
        -------
        dict
            ADE_m, FDE_m, ADE_squared_m2: mean errors over all steps, at the last step, and squared. recall: share of
            the people that have a forecast. AADE_m: ADE averaged over recalls. false_forecasts_per_frame.
            consistency_m: distance between consecutive forecasts of a track. NLL: mean negative log-likelihood of a
            step, in nats. coverage_P: share of future steps inside the P % ellipse. None if there is no value to
            average.
        """
        kept = self.d_obs_m2 < TAU_M2

        def mean(values: Floats) -> float | None:
            return float(values.mean()) if len(values) and np.isfinite(values).all() else None

        _, running = self.curve()
        return {
            "ADE_m": mean(self.ade_m[kept]),
            "FDE_m": mean(self.fde_m[kept]),
            "ADE_squared_m2": mean(self.ade_squared_m2[kept]),
            "recall": int(kept.sum()) / self.people if self.people else None,
            "AADE_m": mean(running[: int(kept.sum())]),
            "false_forecasts_per_frame": self.false_forecasts / self.frames if self.frames else None,
            "consistency_m": mean(self.consistency_m),
            "NLL": mean(self.nll[kept]),
            **{
                f"coverage_{100 * level:g}": mean(self.covered[kept, k])
                for k, level in enumerate(RELIABILITY_LEVELS)
                if level in LEVELS
            },
        }

    def reliability(self) -> list[dict[str, float]]:
        """The share of future steps inside the ellipse of each level, for the pairs below the threshold.

        Each member has ``level``, the probability of the ellipse, and ``held``, the share. Empty without covariances.
        """
        kept = self.covered[self.d_obs_m2 < TAU_M2]
        if not len(kept) or not np.isfinite(kept).all():
            return []
        return [
            {"level": level, "held": float(held)}
            for level, held in zip(RELIABILITY_LEVELS, kept.mean(axis=0), strict=True)
        ]


def combine_displacements(parts: list[Displacement]) -> Displacement:
    """Combine several sequences: all pairs are pooled."""

    def pooled(name: str) -> Floats:
        return np.concatenate([getattr(part, name) for part in parts])

    def padded(name: str) -> Floats:
        away = [getattr(part, name) for part in parts]
        longest = max(part.shape[1] for part in away)
        to_longest = [((0, 0), (0, longest - part.shape[1])) for part in away]
        return np.concatenate([np.pad(*both, constant_values=np.nan) for both in zip(away, to_longest, strict=True)])

    by_step = ("error_m", "straight_error_m")
    arrays = [name for name in ("d_obs_m2", "consistency_m", *ForecastErrors._fields) if name not in by_step]
    counts = {name: sum(getattr(part, name) for part in parts) for name in ("people", "false_forecasts", "frames")}
    values: dict[str, Any] = {name: pooled(name) for name in arrays} | counts
    return Displacement(**values | {name: padded(name) for name in by_step})


# Pairing of forecasts with people: at each time tracks and people are assigned by their last positions.
#
# At each prediction time, tracks with a forecast are assigned to people of the ground truth by how well their last
# ``_PAST`` positions agree (Yu and Zhou 2021, Eq. 4). One assignment at each time serves all thresholds.
#
# People count if ``_PAST`` past positions and all future positions are known, forecasts if their track has
# ``_PAST`` past positions (gaps inside a track are interpolated from positions known at that time). Others are not
# counted at all.
#
# Letters: N rows, S people of the ground truth at one time, F forecasts at one time, T future steps, P matched
# pairs.


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
        return find_rows((self.ids[self.slot], self.step), (ids, step))

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
        return normal_tails(self.mean_m[which].shape[:2]) if self.tails is None else taken(self.tails, which)


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


def pair_forecasts(
    ground_truth: Positions, tracks: Positions, forecasts: Forecasts, labelled: Ints | None = None
) -> PairedForecasts:
    """Assign the forecasts made for tracks to people by their past positions.

    Parameters
    ----------
    ground_truth : Positions
    tracks : Positions
        The positions from which the forecasts were made.
    forecasts : Forecasts
        On the same clock as the other two. The order of rows has no influence.
    labelled : int array, optional
        The steps that the ground truth describes. Forecasts with another one from 0 on in their past are not judged.

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
    counts = np.ones(len(forecasts.step), bool)
    for back in range(_PAST) if labelled is not None else ():
        step = forecasts.step - back
        counts &= (step < 0) | np.isin(step, np.asarray(labelled))
    steps = np.unique(forecasts.step[counts])
    has_past, has_future = people.is_continuous(1 - _PAST), people.is_continuous(horizon)
    place = paths.find(forecasts.id, forecasts.step)
    is_judged = (place >= 0) & paths.is_continuous(1 - _PAST)[place] if len(paths.slot) else np.zeros(len(place), bool)
    is_judged &= counts
    subject = np.flatnonzero(has_past & np.isin(people.step, steps))
    subject = subject[np.argsort(people.step[subject], kind="stable")]
    judged = np.flatnonzero(is_judged)
    judged = judged[np.lexsort((forecasts.id[judged], forecasts.step[judged]))]
    past_true = people.window(subject, 1 - _PAST, 0)
    past = paths.window(place[judged], 1 - _PAST, 0)
    row, column, d_obs = _assigned(past_true, past, people.step[subject], forecasts.step[judged], steps)
    at, number = subject[row], judged[column]
    offset = np.full((len(at), horizon, 2), np.nan)
    has_truth = has_future[at]
    offset[has_truth] = forecasts.mean_m[number[has_truth]] - people.window(at[has_truth], 1, horizon)
    counted = int(has_future[subject].sum())
    return PairedForecasts(number, people.ids[people.slot[at]], d_obs, offset, is_judged, counted, len(steps))


def _assigned(past_true: Floats, past: Floats, true_step: Ints, step: Ints, steps: Ints) -> tuple[Ints, Ints, Floats]:
    """Assign pasts to each other at each of ``steps``: rows (P,), columns (P,) and mean squared distances (P,).

    Pasts (S, 4, 2) and (F, 4, 2) are ordered by step.
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


def displacement(
    ground_truth: Positions, tracks: Positions, forecasts: Forecasts, labelled: Ints | None = None
) -> Displacement:
    """Compare the forecasts made for tracks with the true future of the people assigned to the tracks.

    Forecasts of tracks with a past that is farther than ``TAU_M2`` from that of a person count as false [1]_.

    Parameters
    ----------
    ground_truth : Positions
    tracks : Positions
        The positions from which the forecasts were made.
    forecasts : Forecasts
        On the same clock as the other two.
    labelled : int array, optional
        The steps that the ground truth describes, as in ``pair_forecasts``.

    Returns
    -------
    Displacement

    References
    ----------
    .. [1] S. Yu, H. Zhou: Re-tracking by prediction. IROS 2021, Eq. 4 and 5.

    Examples
    --------
    A person walks 0.4 m at each step; the forecast made at step 4 says that they stop:

    >>> import numpy as np
    >>> walk = Positions(np.arange(8), np.ones(8, int), np.stack([0.4 * np.arange(8), np.zeros(8)], axis=1))
    >>> stop = Forecasts(np.array([4]), np.array([1]), np.full((1, 3, 2), [1.6, 0.0]), np.tile(np.eye(2), (1, 3, 1, 1)))
    >>> found = displacement(walk, walk, stop).summary()
    >>> round(found["ADE_m"], 3), round(found["FDE_m"], 3), found["recall"]
    (0.8, 1.2, 1.0)
    """
    pairs = pair_forecasts(ground_truth, tracks, forecasts, labelled)
    is_known = np.isfinite(pairs.offset_m).all(axis=(1, 2))
    number = pairs.forecast[is_known]
    errors = forecast_errors(pairs.offset_m[is_known], forecasts.cov_m2[number], forecasts.shapes(number))
    return Displacement(
        d_obs_m2=pairs.d_obs_m2[is_known],
        people=pairs.people,
        false_forecasts=int(pairs.is_judged.sum() - (pairs.d_obs_m2 < TAU_M2).sum()),
        frames=pairs.frames,
        consistency_m=_consistency_m(forecasts),
        straight_error_m=_straight_error_m(tracks, forecasts, number, pairs.offset_m[is_known]),
        **errors._asdict(),
    )


#: The steps back from which constant velocity is taken, as that of the predictor ``cv``; all pasts have them.
_VELOCITY_STEPS: Final = 3


def _straight_error_m(tracks: Positions, forecasts: Forecasts, number: Ints, offset_m: Floats) -> Floats:
    """The errors (P, T) of constant velocity instead of forecasts ``number`` (P,), which are off by ``offset_m``."""
    paths = _sorted_positions(tracks, fill=True)
    place = paths.find(forecasts.id[number], forecasts.step[number])
    now, velocity = paths.xy_m[place], (paths.xy_m[place] - paths.xy_m[place - _VELOCITY_STEPS]) / _VELOCITY_STEPS
    ahead = np.arange(1, forecasts.mean_m.shape[1] + 1)[:, None]
    away = now[:, None] + ahead * velocity[:, None] - (forecasts.mean_m[number] - offset_m)
    return np.asarray(np.hypot(away[..., 0], away[..., 1]))


class ForecastErrors(NamedTuple):
    """The errors of P forecasts, as in ``Displacement``."""

    ade_m: Floats
    fde_m: Floats
    ade_squared_m2: Floats
    covered: Floats
    nll: Floats
    error_m: Floats


def forecast_errors(offset: Floats, cov: Floats, tails: Tails) -> ForecastErrors:
    """The errors of P pairs, from offsets (P, T, 2), covariances (P, T, 2, 2) and shapes of distributions (P, T)."""
    squared = (offset**2).sum(axis=-1)
    euclidean = np.sqrt(squared)
    level = ellipse_levels(offset, cov, tails)[..., None]
    inside = np.where(np.isfinite(level), level <= np.array(RELIABILITY_LEVELS), np.nan)
    return ForecastErrors(
        euclidean.mean(axis=-1),
        euclidean[..., -1],
        squared.mean(axis=-1),
        inside.mean(axis=-2),
        negative_log_likelihood(offset, cov, tails).mean(axis=-1),
        euclidean,
    )


def _consistency_m(forecasts: Forecasts) -> Floats:
    order = np.lexsort((forecasts.step, forecasts.id))
    step, id_of, mean = forecasts.step[order], forecasts.id[order], forecasts.mean_m[order]
    next_one = (id_of[1:] == id_of[:-1]) & (step[1:] == step[:-1] + 1)
    offset = mean[:-1, 1:][next_one] - mean[1:, :-1][next_one]
    return np.asarray(np.hypot(offset[..., 0], offset[..., 1]).mean(axis=-1) if len(offset) else np.empty(0))
