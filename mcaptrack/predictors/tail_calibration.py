"""Mixtures for the forecasts of one log: they begin as a table, and follow what the log says.

Forecasts of a time that has come are compared with where their tracks were observed then. Mixtures are fitted again
now and then, at times that depend on the clock alone; each fit takes all that became known since the one before. A
forecast has the mixture of the last fit before it, or at its time: it depends on nothing later, whether forecasts are
given step by step or many steps at once.

Letters: N forecasts, T future steps, L past positions, M comparisons, R fits, B bins.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.mixtures import Tails, mahalanobis_squared, squared_radius
from mcaptrack.notices import warn
from mcaptrack.predictors.forecast import Forecast, Predictor
from mcaptrack.predictors.held_levels import LEVELS, correct, level_counts
from mcaptrack.predictors.position_noise import PAST, PositionNoise
from mcaptrack.predictors.running_sums import running
from mcaptrack.predictors.tails import BINS, Learned, TailTable, counts_of, follow, table_of

#: Comparisons count 1 / e after so many seconds.
_MEMORY_S: Final = 300.0
#: Forecasts of a track at consecutive times have errors that are alike: they count as so many independent ones.
_INDEPENDENT_PER_S: Final = 0.625
#: Mixtures are fitted again after this share of the time so far, as what is known grows by about as much, but after no
#: less and no more than so many seconds.
_REFIT_SHARE, _REFIT_S, _LATEST_REFIT_S = 0.05, 0.8, 4.0
#: Steps of expectation and maximisation of a fit, which begins with the one before.
_ITERATIONS: Final = 3
#: Warn of ellipses that became so many times as large as those of the table, after so many independent comparisons.
_LARGER, _ENOUGH = 1.8, 100.0


class _Made(NamedTuple):
    """Forecasts, in the order of time: their steps and ids (N,), whether tracks were observed then, and their pasts.

    ``cov`` (N, T, 2, 2) is before that of the mixture, ``fit`` (N,) the number of the fit that the mixture is of.
    """

    step: Ints
    ids: Ints
    is_seen: Bools
    past: Floats
    mean: Floats
    cov: Floats
    fit: Ints

    def copied(self, which: slice) -> _Made:
        """A part, without the larger arrays that it is of."""
        step, ids, is_seen, past, mean, cov, fit = self
        numbers = step[which].copy(), ids[which].copy(), is_seen[which].copy()
        return _Made(*numbers, past[which].copy(), mean[which].copy(), cov[which].copy(), fit[which].copy())


class _Compared(NamedTuple):
    """Comparisons in the order of time, (M,): times in steps, steps ahead from 0, fits, and errors.

    ``half`` are half the squared Mahalanobis distances, ``size_m2`` the roots of the determinants of covariances.
    """

    step: Ints
    ahead: Ints
    fit: Ints
    half: Floats
    size_m2: Floats

    def chosen(self, which: Bools) -> _Compared:
        """Some of them."""
        step, ahead, fit, half, size_m2 = self
        return _Compared(step[which], ahead[which], fit[which], half[which], size_m2[which])


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
        self._independent = _INDEPENDENT_PER_S * self._step_s
        self._table, self._adapts = table.at(self._step_s * np.arange(1.0, self._steps + 1)), adapts
        self._given = Tails(self._table.wide_weight, self._table.narrow_scale, self._table.wide_scale)
        # the mixtures (3, T) of the fits that forecasts have, before and after they are corrected by levels
        self._fitted, self._tails = (np.array([self._given]) for _ in range(2))
        self._dropped = 0  # fits before those
        self._made: list[_Made] = []  # forecasts that are not compared with all times that they are of
        self._first: int | None = None
        self._fitted_at = 0
        self._counts, self._levels = np.zeros((self._steps, BINS)), np.zeros((self._steps, LEVELS))
        # (T,) of forecasts of tracks that were lost, of those that were seen, and of these the sums of 1 / size
        self._sums = np.zeros((3, self._steps))
        self._noise = PositionNoise(self._step_s)

    @classmethod
    def of(cls, name: str, predictor: Predictor, adapts: bool = True) -> TailCalibration | None:
        """The calibration of a predictor by name; None if it has no table."""
        table = table_of(name)
        return None if table is None else cls(table, predictor, adapts)

    @property
    def factor(self) -> float:
        """The size of the 50 % ellipses beside those of the table, as a ratio of lengths."""
        radii = squared_radius(0.5, Tails(*self._tails[-1])) / squared_radius(0.5, self._given)
        return float(np.sqrt(np.median(radii)))

    def warn(self, name: str) -> None:
        """Warn if ellipses, those of the predictor ``name``, became much larger than those of the table."""
        if self._independent * self._sums[1].sum() > _ENOUGH and self.factor > _LARGER:
            warn(
                f"errors of predictions by {name} are {self.factor:.1f} times as large as in the walks that its "
                "ellipses begin with; ellipses followed, but those of the first seconds are too small",
                "ellipses",
            )

    def __call__(
        self,
        step: Ints,
        ids: Ints,
        forecast: Forecast,
        past: Floats,
        is_coasting: Bools,
        observed: Floats | None = None,
    ) -> tuple[Forecast, Tails]:
        """Calibrate the forecasts of tracks at one time or at several.

        Parameters
        ----------
        step : (N,) of int
            Times of the forecasts in steps, in ascending order, and after those that the calibration got before.
        ids : (N,) of int
            Ids of the tracks; those that the same calibration got before are the same tracks.
        forecast : Forecast
            Forecasts of the predictor.
        past : (N, L, 2) of float
            Past positions, the current one last, in the unit of the forecasts; unknown ones are NaN.
        is_coasting : (N,) of bool
            Which tracks are not observed now.
        observed : (N, L, 2) of float, optional
            Past positions without interpolated ones, which have less noise; by default those of ``past``.

        Returns
        -------
        Forecast, Tails
            With the covariances of the mixtures, and their shapes (N, T).
        """
        known = np.isfinite(past[:, -self._past :, 0]).sum(axis=1)
        factor = np.where((known < self._past)[:, None], self._table.short, 1.0)
        factor = np.where(is_coasting[:, None], self._table.coasting, factor)
        cov = forecast.cov * factor[:, :, None, None]
        fit = np.full(len(ids), self._dropped + len(self._fitted) - 1)
        if self._adapts and len(ids):
            refits = self._refits(step[~is_coasting])
            fit += np.searchsorted(refits, step, "right")
            seen = (past if observed is None else observed)[:, -PAST:]
            self._made.append(_Made(step, ids, ~is_coasting, seen, forecast.mean, cov, fit))
            if len(refits):
                self._learn(refits)
        weight, narrow, wide = self._tails[fit - self._dropped].transpose(1, 0, 2)
        whole = (1 - weight) * narrow + weight * wide
        self._drop_fits()
        return Forecast(forecast.mean, cov * whole[:, :, None, None]), Tails(weight, narrow / whole, wide / whole)

    def _refits(self, seen: Ints) -> Ints:
        """The steps at which mixtures are fitted again, of those at which tracks are seen (N,), in ascending order."""
        if self._first is None and len(seen):
            self._first = self._fitted_at = int(seen[0])
        out, last = [], self._fitted_at
        while len(seen) and seen[-1] > last:
            after_s = min(max(_REFIT_SHARE * (last - (self._first or 0)) * self._step_s, _REFIT_S), _LATEST_REFIT_S)
            at = int(np.searchsorted(seen, last + max(1, round(after_s / self._step_s))))
            if at == len(seen):
                break
            last = int(seen[at])
            out.append(last)
        return np.array(out, np.int64)

    def _learn(self, refits: Ints) -> None:
        """Fit mixtures again at some steps (R,), each by what became known since the fit before."""
        made = _Made(*_joined(self._made))
        found, lost = self._compare(made, refits)
        passed = np.diff(refits, prepend=self._fitted_at)
        kept = np.exp(-passed * self._step_s / _MEMORY_S)
        place, shape = np.searchsorted(refits, found.step), (len(refits), self._steps)
        cell, cells = place * self._steps + found.ahead, len(refits) * self._steps
        new = counts_of(cell, found.half, cells).reshape(*shape, BINS)
        counts, self._counts = running(self._counts, kept, new)
        inverse_m2 = np.bincount(cell, 1 / found.size_m2, cells).reshape(shape)
        parts, self._sums = running(self._sums, kept, np.stack([lost, new.sum(axis=2), inverse_m2], axis=1))
        lost, seen, inverse_m2 = parts.transpose(1, 0, 2)

        here = made.is_seen & (made.step > self._fitted_at) & (made.step <= refits[-1])
        noise = self._noise.follow(passed, np.searchsorted(refits, made.step[here]), made.past[here], self._steps)
        per_m2 = inverse_m2 / np.maximum(seen, 1e-9)
        learned = Learned(self._independent * counts, self._independent * lost, *(per_m2 * part for part in noise))
        fits = [self._fitted[-1]]
        for one in map(Learned, *learned):
            fits.append(np.array(follow(self._given, Tails(*fits[-1]), one, _ITERATIONS)))
        self._fitted = np.concatenate([self._fitted, fits[1:]])

        # levels of ellipses that were much smaller or larger say little about those of now
        change = np.abs(np.diff(np.log([one[1] for one in fits]), axis=0))
        at = Learned(*(part[place, found.ahead] for part in learned))
        of = at.measured(Tails(*self._fitted[found.fit - self._dropped, :, found.ahead].T))
        levels = level_counts(cell, found.half, of, cells).reshape(*shape, LEVELS)
        forgotten = kept[:, None, None] * np.exp(-change)[..., None]
        levels, self._levels = running(self._levels, forgotten, levels * forgotten)
        weight, narrow, wide = correct(Tails(*np.stack(fits[1:], axis=1)), self._independent * levels)
        narrow = np.maximum(narrow, learned.least)
        self._tails = np.concatenate([self._tails, np.stack([weight, narrow, np.maximum(wide, narrow)], axis=1)])

        self._fitted_at = int(refits[-1])
        left = int(np.searchsorted(made.step, self._fitted_at - self._steps, "right"))
        self._made = [made.copied(slice(left, None))]

    def _compare(self, made: _Made, refits: Ints) -> tuple[_Compared, Floats]:
        """Compare forecasts with where their tracks are observed after the last fit, up to the last of ``refits``.

        Returns also the number (R, T) of forecasts of tracks that are not observed when others are.
        """
        now = np.flatnonzero(made.is_seen & (made.step > self._fitted_at) & (made.step <= refits[-1]))
        _, slot = np.unique(made.ids, return_inverse=True)
        first = int(made.step[0]) - self._steps
        key = slot * (int(made.step[-1]) - first + 1) + (made.step - first)
        order = np.argsort(key, kind="stable")
        have, wanted = key[order], key[now, None] - np.arange(1, self._steps + 1)
        at = np.minimum(np.searchsorted(have, wanted), len(have) - 1)
        row, ahead = np.nonzero(have[at] == wanted)
        source, row = order[at[row, ahead]], now[row]
        times = np.unique(made.step[now])
        of = times[:, None] - np.arange(1, self._steps + 1)
        due = np.searchsorted(made.step, of, "right") - np.searchsorted(made.step, of)
        seen = np.bincount(np.searchsorted(times, made.step[row]) * self._steps + ahead, minlength=due.size)
        lost = np.zeros((len(refits), self._steps))
        np.add.at(lost, np.searchsorted(refits, times), np.maximum(due - seen.reshape(due.shape), 0))
        off, cov = made.past[row, -1] - made.mean[source, ahead], made.cov[source, ahead]
        with np.errstate(invalid="ignore", divide="ignore"):
            half = mahalanobis_squared(off, cov) / 2
            size_m2 = np.sqrt(cov[:, 0, 0] * cov[:, 1, 1] - cov[:, 0, 1] ** 2)
        return _Compared(made.step[row], ahead, made.fit[source], half, size_m2).chosen(np.isfinite(half)), lost

    def _drop_fits(self) -> None:
        """Drop the fits that no forecast has any more."""
        fits = [int(one.fit[0]) for one in self._made if len(one.fit)]
        count = min([*fits, self._dropped + len(self._fitted) - 1]) - self._dropped
        if count:
            self._fitted, self._tails = self._fitted[count:].copy(), self._tails[count:].copy()
            self._dropped += count


def _joined(made: Sequence[_Made]) -> tuple[Any, ...]:
    return tuple(np.concatenate(parts) for parts in zip(*made, strict=True))
