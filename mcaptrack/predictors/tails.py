"""Calibrated forecasts: mixtures with ellipses that hold as many true positions as they say.

The covariance of a predictor is scaled, and becomes that of a mixture of a narrow and a wide normal distribution. Both
begin as a table for each predictor, which was fitted on synthetic walks with the faults of trackers (noise, gaps, short
and merged tracks, switched ids), before and after re-tracking: ``tools/fit_tails.py`` makes the file. While a log is
read they follow it, because people and trackers differ: forecasts of a time that has come are compared with where their
tracks were observed then. Nothing is known that was not known at the time of a forecast.

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
from mcaptrack.geometry.mixtures import Tails, mahalanobis_squared, mass_within
from mcaptrack.predictors.forecast import Forecast, Predictor

TABLES: Final = Path(__file__).parent / "trained" / "tails.json"
#: Edges and centres of bins of half the squared Mahalanobis distance, in which comparisons are counted.
_EDGES: Final = np.geomspace(1e-4, 1e4, 49)
_CENTRES: Final = np.sqrt(_EDGES[1:] * _EDGES[:-1])
#: The table counts like so many comparisons of each step.
_PRIOR_COUNT: Final = 20.0
#: Comparisons count 1 / e after so many seconds.
_MEMORY_S: Final = 300.0
#: The distribution is fitted again after so many steps, with so many iterations from the last one.
_REFIT_STEPS: Final = 3
_ITERATIONS: Final = 4
#: Limits of the weight of the wide part.
_LEAST_WIDE, _MOST_WIDE = 0.02, 0.6
#: The noise of measured positions is estimated from those of so many of the last steps, if they are so many.
_NOISE_STEPS: Final = 40
_LEAST_POSITIONS: Final = 10


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


class _Made(NamedTuple):
    """Forecasts of one time that wait for theirs."""

    step: int
    ids: Ints
    mean: Floats
    cov: Floats


class TailCalibration:
    """Makes mixtures of the forecasts of one log, in the order of time.

    Parameters
    ----------
    table : TailTable
        The calibration to begin with.
    predictor : Predictor
        The predictor of the forecasts.
    """

    def __init__(self, table: TailTable, predictor: Predictor) -> None:
        self._steps, self._step_s, self._past = predictor.steps, predictor.step_s, predictor.past
        ahead_s: Floats = self._step_s * np.arange(1.0, self._steps + 1)
        self._table = table.at(ahead_s)
        self._tails = Tails(self._table.wide_weight, self._table.narrow_scale, self._table.wide_scale)
        inside = mass_within(2 * _EDGES, Tails(*(part[:, None] for part in self._tails)))
        self._prior = _PRIOR_COUNT * np.diff(inside, axis=1)
        self._counts = np.zeros_like(self._prior)
        self._made: deque[_Made] = deque(maxlen=self._steps)
        self._bends_m2: deque[Floats] = deque(maxlen=_NOISE_STEPS)
        self._noise_m2 = 0.0
        self._fitted_at, self._is_new = 0, False

    @classmethod
    def of(cls, name: str, predictor: Predictor) -> TailCalibration | None:
        """The calibration of a predictor by name; None if it has no table."""
        table = table_of(name)
        return None if table is None else cls(table, predictor)

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
        self._learn(step, ids[~is_coasting], past[~is_coasting])
        known = np.isfinite(past[:, -self._past :, 0]).sum(axis=1)
        factor = np.where((known < self._past)[:, None], self._table.short, 1.0)
        factor = np.where(is_coasting[:, None], self._table.coasting, factor)
        cov = forecast.cov * factor[:, :, None, None]
        self._made.append(_Made(step, ids.copy(), forecast.mean.copy(), cov))  # not parts of larger arrays
        weight, narrow, wide = self._tails
        whole = (1 - weight) * narrow + weight * wide
        parts = (np.broadcast_to(part, factor.shape) for part in (weight, narrow / whole, wide / whole))
        return Forecast(forecast.mean, cov * whole[:, None, None]), Tails(*parts)

    def _learn(self, step: int, ids: Ints, past: Floats) -> None:
        """Compare earlier forecasts with the tracks that are observed now; fit the mixtures again now and then."""
        if past.shape[1] >= 3 and len(past):
            bend = past[:, -1] - 2 * past[:, -2] + past[:, -3]
            self._bends_m2.append((bend**2).sum(axis=1)[np.isfinite(bend[:, 0])])
        due = [(one, step - one.step - 1) for one in self._made if 0 < step - one.step <= self._steps]
        if due and len(ids):
            order = np.argsort(ids, kind="stable")
            of = np.concatenate([one.ids for one, _ in due])
            ahead = np.repeat([k for _, k in due], [len(one.ids) for one, _ in due])
            mean = np.concatenate([one.mean[:, k] for one, k in due])
            cov = np.concatenate([one.cov[:, k] for one, k in due])
            at = order[np.minimum(np.searchsorted(ids, of, sorter=order), len(ids) - 1)]
            seen = ids[at] == of
            self._compare(ahead[seen], past[at[seen], -1] - mean[seen], cov[seen])
        if self._is_new and step - self._fitted_at >= _REFIT_STEPS:
            self._counts *= np.exp(-(step - self._fitted_at) * self._step_s / _MEMORY_S)
            self._tails = fit_mixture(self._counts + self._prior, self._tails, _ITERATIONS)
            self._fitted_at, self._is_new = step, False
            bends_m2 = np.concatenate(self._bends_m2) if self._bends_m2 else np.empty(0)
            if len(bends_m2) >= _LEAST_POSITIONS:  # bends have six times the variance of white noise, in two axes
                self._noise_m2 = float(np.median(bends_m2)) / (12 * np.log(2))

    def _compare(self, ahead: Ints, off: Floats, cov: Floats) -> None:
        """Count errors (M, 2) of steps (M,); the measured positions have noise, too, which the true ones have not."""
        weight, narrow, wide = self._tails
        noise = (self._noise_m2 / np.maximum((1 - weight) * narrow + weight * wide, 1e-3))[ahead]
        half = mahalanobis_squared(off, cov + noise[:, None, None] * np.eye(2)) / 2
        self._counts += counts_of(ahead, half, self._steps)
        self._is_new = self._is_new or bool(len(ahead))
