"""Calibrated forecasts: mixtures with ellipses that hold as many true positions as they say.

The covariance of a predictor is scaled, and becomes that of a mixture of a narrow and a wide normal distribution. Both
begin as a table for each predictor, which was fitted on synthetic walks with the faults of trackers (noise, gaps, short
and merged tracks, switched ids), before and after re-tracking: ``tools/fit_tails.py`` makes the file. While a log is
read they follow it, because people and trackers differ: forecasts of a time that has come are compared with where their
tracks were observed then, and scale the distributions of the forecasts after them (compare adaptive conformal
inference: I. Gibbs and E. Candes, NeurIPS 2021; here the scales are shrunk towards the table, so that few comparisons
change little). What ellipses have held in the log so far corrects them (``held_levels``), and the noise of positions is
taken out of the comparisons (``position_noise``). Nothing is known that was not known at the time of a forecast.

The means of forecasts, and the covariances by which tracks are associated, are those of the predictor.

Letters: N forecasts, T future steps, K times of a table, L past positions, M comparisons, B bins.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.mixtures import Tails, mahalanobis_squared, squared_radius
from mcaptrack.notices import warn
from mcaptrack.predictors.forecast import Forecast, Predictor
from mcaptrack.predictors.held_levels import HeldLevels
from mcaptrack.predictors.position_noise import PositionNoise

TABLES: Final = Path(__file__).parent / "trained" / "tails.json"
#: Edges and centres of bins of half the squared Mahalanobis distance, in which comparisons are counted.
_EDGES: Final = np.geomspace(1e-4, 1e4, 49)
_CENTRES: Final = np.sqrt(_EDGES[1:] * _EDGES[:-1])
#: Comparisons count 1 / e after so many seconds.
_MEMORY_S: Final = 300.0
#: Forecasts of a track at consecutive times have errors that are alike: they count as so many independent ones.
_INDEPENDENT_PER_S: Final = 0.625
#: Mixtures are fitted again after so many seconds.
_REFIT_S: Final = 0.8
#: So many independent comparisons count as much as the table, for the size of errors at all steps together; as much as
#: the size at all steps, for that at one step; and as much as the table, for the share of large errors.
_ALL_STEPS, _ONE_STEP, _WEIGHT = 1.0, 4.0, 20.0
#: Large errors are rare and their size varies: for it the table counts so many times as much.
_LARGE: Final = 20.0
#: This share of the forecasts of tracks that are no longer observed is taken to have large errors, as in the table:
#: people who turn or stop are lost more often than others.
_LOST: Final = 0.005
#: Errors of measured positions are no smaller than this share of the least ones of true positions.
_LEAST_MEASURED: Final = 0.1
#: Warn of ellipses that became so many times as large as those of the table, after so many independent comparisons.
_LARGER, _ENOUGH = 1.8, 100.0
#: Limits of the weight of the wide part.
_LEAST_WIDE, _MOST_WIDE = 0.02, 0.6


class TailTable(NamedTuple):
    """The calibration of a predictor, by the time ahead: ``ahead_s`` (K,), and with as many elements:

    ``wide_weight``, ``narrow_scale``, ``wide_scale`` as in ``Tails``, relative to the predictor's covariance, and the
    factors of the covariance for tracks with a short history and for those that coast.
    """

    ahead_s: Floats
    wide_weight: Floats
    narrow_scale: Floats
    wide_scale: Floats
    short: Floats
    coasting: Floats

    def at(self, ahead_s: Floats) -> TailTable:
        """The table at other times, interpolated; beyond its ends as at the ends."""
        weight = np.interp(ahead_s, self.ahead_s, self.wide_weight)
        parts = (self.narrow_scale, self.wide_scale, self.short, self.coasting)
        scales = [np.exp(np.interp(ahead_s, self.ahead_s, np.log(part))) for part in parts]
        return TailTable(ahead_s, weight, *scales)


@lru_cache(maxsize=1)
def _tables() -> Mapping[str, Any]:
    found: Mapping[str, Any] = json.loads(TABLES.read_text(encoding="utf-8"))["predictors"]
    return found


def table_of(name: str) -> TailTable | None:
    """The table of a predictor by name; None for those of other packages, and for networks with other weights."""
    found = _tables().get(name)
    return None if found is None else TailTable(**{key: np.array(found[key], np.float64) for key in TailTable._fields})


def fit_mixture(counts: Floats, start: Tails, iterations: int) -> Tails:
    """The mixtures (T,) under which counts (T, B) of half the squared distances are likeliest.

    By expectation and maximisation, ``iterations`` times from ``start``.
    """
    weight, narrow, wide = (part[:, None] for part in start)
    total = counts.sum(axis=1, keepdims=True)
    for _ in range(iterations):
        one = (1 - weight) / narrow * np.exp(-_CENTRES / narrow)
        two = weight / wide * np.exp(-_CENTRES / wide)
        of_wide = counts * two / np.maximum(one + two, 1e-300)
        sums = of_wide.sum(axis=1, keepdims=True)
        wide = (of_wide @ _CENTRES)[:, None] / np.maximum(sums, 1e-9)
        narrow = ((counts - of_wide) @ _CENTRES)[:, None] / np.maximum(total - sums, 1e-9)
        weight = np.clip(sums / total, _LEAST_WIDE, _MOST_WIDE)
    return Tails(weight[:, 0], narrow[:, 0], wide[:, 0])


def counts_of(step: Ints, half_squared: Floats, steps: int) -> Floats:
    """The number (T, B) of half squared distances (M,) of each step (M,), the first of which is 0, in each bin."""
    column = np.clip(np.searchsorted(_EDGES, half_squared) - 1, 0, len(_CENTRES) - 1)
    flat = np.bincount(step * len(_CENTRES) + column, minlength=steps * len(_CENTRES))
    return np.asarray(flat.reshape(steps, len(_CENTRES)), np.float64)


class Learned(NamedTuple):
    """The errors of forecasts in a log so far, for T steps ahead.

    ``counts`` (T, B) are independent comparisons by half the squared distance, ``lost`` (T,) independent forecasts of
    tracks that were not observed then. ``noise`` and ``least`` (T,) are in units of the predictor's covariance: what
    is added to the size of errors by comparing with measured positions, and their least size.
    """

    counts: Floats
    lost: Floats
    noise: Floats
    least: Floats

    def measured(self, tails: Tails) -> Tails:
        """The distributions (T,) of distances from measured positions, of those from true ones."""
        least = np.maximum(_LEAST_MEASURED * self.least, 1e-6)
        narrow, wide = (np.maximum(part + self.noise, least) for part in (tails.narrow_scale, tails.wide_scale))
        return Tails(tails.wide_weight, narrow, wide)


def follow(table: Tails, before: Tails, learned: Learned) -> Tails:
    """The mixtures (T,) of a table after what a log says: one step of expectation and maximisation from ``before``.

    Sizes of errors are scaled by a factor for all steps, so that what is known of the near future counts for the
    distant one, too, and by one for each step. Both are geometric means of the table's and of the log's, by what either
    counts.
    """
    noise = learned.noise
    weight, narrow, wide = (part[:, None] for part in learned.measured(before))
    one = (1 - weight) / narrow * np.exp(-_CENTRES / narrow)
    two = weight / wide * np.exp(-_CENTRES / wide)
    of_wide = learned.counts * two / np.maximum(one + two, 1e-300)
    sums = np.stack([learned.counts.sum(axis=1) - of_wide.sum(axis=1), of_wide.sum(axis=1)])  # narrow, wide
    total = np.stack([(learned.counts - of_wide) @ _CENTRES, of_wide @ _CENTRES])
    size = np.maximum(total / np.maximum(sums, 1e-9) - noise, np.maximum(learned.least, 1e-4))
    given = np.stack([table.narrow_scale, table.wide_scale])
    change = np.where(sums > 1e-6, np.log(size / given), 0.0)
    trust, lost = np.array([[1.0], [_LARGE]]), _LOST * learned.lost
    all_sums = sums + np.stack([np.zeros_like(lost), lost])  # those that are lost have the size of the table
    shared = (sums * change).sum(axis=1) / (trust[:, 0] * _ALL_STEPS + all_sums.sum(axis=1))
    own = (trust * _ONE_STEP * shared[:, None] + sums * change) / (trust * _ONE_STEP + all_sums)
    narrow_scale, wide_scale = given * np.exp(own)
    few, many = all_sums[1], all_sums.sum(axis=0)
    mean = table.wide_weight.mean()
    odds = (_WEIGHT * mean + few.sum()) / (_WEIGHT * (1 - mean) + (many - few).sum()) * (1 - mean) / mean
    expected = 1 / (1 + (1 / table.wide_weight - 1) / odds)
    wide_weight = np.minimum(np.maximum((_WEIGHT * expected + few) / (_WEIGHT + many), _LEAST_WIDE), _MOST_WIDE)
    narrow_scale = np.maximum(narrow_scale, learned.least)
    return Tails(wide_weight, narrow_scale, np.maximum(wide_scale, narrow_scale))


class _Made(NamedTuple):
    """Forecasts of one time that wait for theirs; ``tails`` (T,) are before the correction by levels."""

    step: int
    ids: Ints
    mean: Floats
    cov: Floats
    tails: Tails


class _Due(NamedTuple):
    """Forecasts of a time that has come, and their steps; which of their tracks are seen, and where these are now."""

    forecasts: list[tuple[_Made, int]]
    seen: Bools
    now: Floats


class TailCalibration:
    """Makes mixtures of the forecasts of one log, in the order of time.

    Parameters
    ----------
    table : TailTable
        The calibration to begin with.
    predictor : Predictor
        The predictor of the forecasts.
    adapts : bool
        Whether it follows the log.
    """

    def __init__(self, table: TailTable, predictor: Predictor, adapts: bool = True) -> None:
        self._steps, self._step_s, self._past = predictor.steps, predictor.step_s, predictor.past
        ahead_s: Floats = self._step_s * np.arange(1.0, self._steps + 1)
        self._table, self._adapts = table.at(ahead_s), adapts
        self._given = Tails(self._table.wide_weight, self._table.narrow_scale, self._table.wide_scale)
        self._fitted = self._tails = self._given
        self._counts = np.zeros((self._steps, len(_CENTRES)))
        self._lost, self._seen, self._inverse = (np.zeros(self._steps) for _ in range(3))
        self._made: deque[_Made] = deque(maxlen=self._steps)
        self._due: list[_Due] = []
        self._noise, self._levels = PositionNoise(self._step_s), HeldLevels(self._steps)
        self._learned = self._learned_so_far()
        self._fitted_at = 0

    @classmethod
    def of(cls, name: str, predictor: Predictor, adapts: bool = True) -> TailCalibration | None:
        """The calibration of a predictor by name; None if it has no table."""
        table = table_of(name)
        return None if table is None else cls(table, predictor, adapts)

    @property
    def factor(self) -> float:
        """The size of the 50 % ellipses beside those of the table, as a ratio of lengths."""
        radii = squared_radius(0.5, self._tails) / squared_radius(0.5, self._given)
        return float(np.sqrt(np.median(radii)))

    def warn(self, name: str) -> None:
        """Warn if ellipses, those of the predictor ``name``, became much larger than those of the table."""
        independent = _INDEPENDENT_PER_S * self._step_s
        if independent * self._seen.sum() > _ENOUGH and self.factor > _LARGER:
            warn(
                f"errors of predictions by {name} are {self.factor:.1f} times as large as in the walks that its "
                "ellipses begin with; ellipses followed, but those of the first seconds are too small",
                "ellipses",
            )

    def __call__(
        self, step: int, ids: Ints, forecast: Forecast, past: Floats, is_coasting: Bools
    ) -> tuple[Forecast, Tails]:
        """Calibrate the forecasts of tracks.

        Parameters
        ----------
        step : int
            Time of the forecasts, in steps.
        ids : (N,) of int
            Ids of the tracks; those that the same calibration got before are the same tracks.
        forecast : Forecast
            Forecasts of the predictor.
        past : (N, L, 2) of float
            Past positions, the current one last, in the unit of the forecasts; unknown ones are NaN.
        is_coasting : (N,) of bool
            Which tracks are not observed now.

        Returns
        -------
        Forecast, Tails
            With the covariances of the mixtures, and their shapes (N, T).
        """
        if self._adapts:
            self._learn(step, ids[~is_coasting], past[~is_coasting])
        known = np.isfinite(past[:, -self._past :, 0]).sum(axis=1)
        factor = np.where((known < self._past)[:, None], self._table.short, 1.0)
        factor = np.where(is_coasting[:, None], self._table.coasting, factor)
        cov = forecast.cov * factor[:, :, None, None]
        if self._adapts:
            self._made.append(_Made(step, ids.copy(), forecast.mean.copy(), cov, self._fitted))  # not parts of arrays
        weight, narrow, wide = self._tails
        whole = (1 - weight) * narrow + weight * wide
        parts = (np.broadcast_to(part, factor.shape) for part in (weight, narrow / whole, wide / whole))
        return Forecast(forecast.mean, cov * whole[:, None, None]), Tails(*parts)

    def _learn(self, step: int, ids: Ints, past: Floats) -> None:
        """Compare earlier forecasts with the tracks that are observed now, and follow what they say, now and then."""
        self._noise.see(step, past)
        due = [(one, step - one.step - 1) for one in self._made if 0 < step - one.step <= self._steps]
        if not due or not len(ids):
            return
        order = np.argsort(ids, kind="stable")
        of = np.concatenate([one.ids for one, _ in due])
        at = order[np.minimum(np.searchsorted(ids, of, sorter=order), len(ids) - 1)]
        seen = ids[at] == of
        if not seen.any():
            return
        self._due.append(_Due(due, seen, past[at[seen], -1]))
        passed_s = (step - self._fitted_at) * self._step_s
        if passed_s < _REFIT_S - self._step_s / 2:
            return
        self._compare()
        kept = np.exp(-passed_s / _MEMORY_S)
        for part in (self._counts, self._lost, self._inverse, self._seen):
            np.multiply(part, kept, out=part)
        self._learned, before = self._learned_so_far(), self._fitted
        self._fitted = follow(self._given, before, self._learned)
        # levels of ellipses that were much smaller or larger say little about those of now
        change = np.abs(np.log(self._fitted.narrow_scale / before.narrow_scale))
        self._levels.forget(kept * np.exp(-change))
        corrected = self._levels.correct(self._fitted, _INDEPENDENT_PER_S * self._step_s)
        narrow = np.maximum(corrected.narrow_scale, self._learned.least)
        self._tails = Tails(corrected.wide_weight, narrow, np.maximum(corrected.wide_scale, narrow))
        self._fitted_at = step

    def _learned_so_far(self) -> Learned:
        inverse = self._inverse / np.maximum(self._seen, 1e-9)
        independent, noise = _INDEPENDENT_PER_S * self._step_s, self._noise.of_errors(self._steps)
        return Learned(
            independent * self._counts, independent * self._lost, inverse * noise.added, inverse * noise.least
        )

    def _compare(self) -> None:
        """Count the errors of the forecasts that were due since the last time, M of them seen, and those not seen."""
        due = [one for part in self._due for one in part.forecasts]
        seen = np.concatenate([part.seen for part in self._due])
        size = [len(one.ids) for one, _ in due]
        ahead, which = np.repeat([k for _, k in due], size), np.repeat(np.arange(len(due)), size)[seen]
        self._lost += np.bincount(ahead[~seen], minlength=self._steps)
        mean = np.concatenate([one.mean[:, k] for one, k in due])[seen]
        cov = np.concatenate([one.cov[:, k] for one, k in due])[seen]
        ahead, off = ahead[seen], np.concatenate([part.now for part in self._due]) - mean
        with np.errstate(invalid="ignore", divide="ignore"):
            half = mahalanobis_squared(off, cov) / 2
            size_m2 = np.sqrt(cov[:, 0, 0] * cov[:, 1, 1] - cov[:, 0, 1] ** 2)
        good = np.isfinite(half)
        ahead, half, which = ahead[good], half[good], which[good]
        tails = Tails(*np.array([one.tails for one, _ in due])[which, :, ahead].T)
        learned = self._learned._replace(noise=self._learned.noise[ahead], least=self._learned.least[ahead])
        self._levels.add(ahead, half, learned.measured(tails))
        self._counts += counts_of(ahead, half, self._steps)
        self._seen += np.bincount(ahead, minlength=self._steps)
        self._inverse += np.bincount(ahead, 1 / size_m2[good], minlength=self._steps)
        self._due.clear()
