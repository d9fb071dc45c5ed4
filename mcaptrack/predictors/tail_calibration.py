"""Mixtures for the forecasts of one log: they begin as a table, and follow what the log says.

Forecasts of a time that has come are compared with where their tracks were observed then. Mixtures are fitted again
now and then, at times that depend on the clock alone; each fit takes all that became known since the one before. A
forecast has the mixture of the last fit before it, or at its time: it depends on nothing later, whether forecasts are
given step by step or many steps at once.

Letters: N forecasts, T future steps, L past positions, M comparisons, R fits, B bins.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints, joined, taken
from mcaptrack.geometry.mixtures import Tails, half_radius, mahalanobis_squared, normal_tails, squared_radius
from mcaptrack.notices import warn
from mcaptrack.predictors.forecast import Forecast, Predictor
from mcaptrack.predictors.position_noise import PAST, PositionNoise, running

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


class _Issued(NamedTuple):
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


class _Compared(NamedTuple):
    """Comparisons in the order of time, (M,): times in steps, steps ahead from 0, fits, and errors.

    ``half`` are half the squared Mahalanobis distances, ``size_m2`` the roots of the determinants of covariances.
    """

    step: Ints
    ahead: Ints
    fit: Ints
    half: Floats
    size_m2: Floats


# Corrects mixtures by what their ellipses have held in a log.
#
# The level of an error is the probability of the smallest ellipse that holds it. Levels are uniform if ellipses hold
# what they say. Where they aren't, ellipses are made those of the level that did hold half of the errors, and nine
# tenths.
# This is calibrated regression (Kuleshov et al., 2018), for forecasts that are made one after another.
#
# Letters: T future steps, R times, M errors, B bins of levels.
#
# References
# ----------
# V. Kuleshov, N. Fenner, S. Ermon, "Accurate uncertainties for deep learning using calibrated regression", ICML 2018.


#: Bins of levels.
LEVELS: Final = 40
#: The levels by which the narrow and the wide part are corrected.
_MIDDLE, _OUTER = 0.5, 0.9


# Calibrated forecasts: mixtures with ellipses that hold as many true positions as they say.
#
# The covariance of a predictor is scaled, and becomes that of a mixture of a narrow and a wide normal distribution.
# Both begin as a table for each predictor, which was fitted on synthetic walks with the faults of trackers (noise,
# gaps, short and merged tracks, switched ids), before and after re-tracking: ``tools/fit_tails.py`` makes the file.
# While a log is read they follow it, because people and trackers differ: forecasts of a time that has come are
# compared with where their tracks were observed then, and scale the distributions of the forecasts after them
# (compare adaptive conformal inference: I. Gibbs and E. Candes, NeurIPS 2021; here the scales are shrunk towards
# the table, so that few comparisons change little). What ellipses have held in the log so far corrects them
# (``correct``), and the noise of positions is taken out of the comparisons (``position_noise``). Nothing is
# known that was not known at the time of a forecast.
#
# The means of forecasts, and the covariances by which tracks are associated, are those of the predictor.
#
# Letters: N forecasts, T future steps, K times of a table, L past positions, M comparisons, B bins.


TABLES: Final = Path(__file__).parent / "trained" / "tails.json"
#: Edges and centres of bins of half the squared Mahalanobis distance, in which comparisons are counted.
_EDGES: Final = np.geomspace(1e-4, 1e4, 49)
CENTRES: Final = np.sqrt(_EDGES[1:] * _EDGES[:-1])
BINS: Final = len(CENTRES)
#: Counts (T, B) times this are their sums, and those of half the squared distances.
_SUMS: Final = np.stack([np.ones(BINS), CENTRES], axis=1)
#: So many independent comparisons count as much as the table, for the size of errors at all steps together; as much as
#: the size at all steps, for that at one step; and as much as the table, for the share of large errors.
_TOGETHER, _ONE_STEP, _WEIGHT = 1.0, 4.0, 20.0
#: Large errors are rare and their size varies: for it the table counts so many times as much.
_LARGE: Final = 20.0
#: This share of the forecasts of tracks that are no longer observed is taken to have large errors, as in the table:
#: people who turn or stop are lost more often than others.
_LOST: Final = 0.005
#: Errors of measured positions are no smaller than this share of the least ones of true positions.
_LEAST_MEASURED: Final = 0.1
#: Limits of the weight of the wide part.
LEAST_WIDE, MOST_WIDE = 0.02, 0.6


#: A column of a table.
Numbers = Sequence[float] | Floats


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
        return TailTable(ahead_s, *_interpolated(ahead_s, *self))


def _interpolated(ahead_s: Floats, table_s: Numbers, weight: Numbers, *scales: Numbers) -> tuple[Floats, ...]:
    """A weight and scales of a table, by its times ahead, at others; beyond its ends as at the ends."""
    logs = (np.interp(ahead_s, table_s, np.log(scale)) for scale in scales)
    return np.interp(ahead_s, table_s, weight), *map(np.exp, logs)


@lru_cache(maxsize=2)
def tables_in(path: Path) -> Mapping[str, Any]:
    """The tables of a file, by the names of predictors."""
    tables: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))["predictors"]
    return tables


def table_of(name: str) -> TailTable | None:
    """The table of a predictor by name; None for those of other packages, and for networks with other weights."""
    table = tables_in(TABLES).get(name)
    return None if table is None else TailTable(**{key: np.array(table[key], np.float64) for key in TailTable._fields})


def counts_of(step: Ints, half_squared: Floats, steps: int) -> Floats:
    """The number (T, B) of half squared distances (M,) of each step (M,), the first of which is 0, in each bin."""
    column = np.clip(np.searchsorted(_EDGES, half_squared) - 1, 0, len(CENTRES) - 1)
    flat = np.bincount(step * BINS + column, minlength=steps * BINS)
    return np.asarray(flat.reshape(steps, BINS), np.float64)


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

    @property
    def least_measured(self) -> Floats:
        """The least size (T,) of errors from measured positions."""
        return np.maximum(_LEAST_MEASURED * self.least, 1e-6)

    def measured(self, tails: Tails) -> Tails:
        """Distributions (T,) of distances from measured positions, given those from true positions."""
        least = self.least_measured
        narrow, wide = (np.maximum(part + self.noise, least) for part in (tails.narrow_scale, tails.wide_scale))
        return Tails(tails.wide_weight, narrow, wide)


def follow(table: Tails, before: Tails, learned: Learned, iterations: int) -> Tails:
    """The mixtures (T,) of a table after what a log says: steps of expectation and maximisation from ``before``.

    Sizes of errors are scaled by a factor for all steps, so that what is known of the near future counts for the
    distant one, too, and by one for each step. Both are geometric means of the table's and of the log's, by what either
    counts.
    """
    share, scale = np.stack([1 - before.wide_weight, before.wide_weight]), np.stack(before[1:])  # (2, T): narrow, wide
    scales, mean = np.stack(table[1:]), float(table.wide_weight.mean())
    odds_of_table = 1 / table.wide_weight - 1
    trust, lost = np.array([[1.0], [_LARGE]]), np.zeros_like(scale)
    lost[1] = _LOST * learned.lost  # those that are lost have the size of the table
    all_sums = learned.counts @ _SUMS
    least, least_seen = np.maximum(learned.least, 1e-4), learned.least_measured
    for _ in range(iterations):
        seen = np.maximum(scale + learned.noise, least_seen)
        density = np.exp(-CENTRES / seen[..., None]) * (share / seen)[..., None]
        of_wide = (learned.counts * (density[1] / np.maximum(density[0] + density[1], 1e-300))) @ _SUMS
        sums, total = np.stack([all_sums - of_wide, of_wide], axis=1).transpose(2, 1, 0)
        change = np.log(np.maximum(total / np.maximum(sums, 1e-9) - learned.noise, least) / scales) * (sums > 1e-6)
        mass, said = sums + lost, sums * change
        shared = said.sum(axis=1, keepdims=True) / (trust * _TOGETHER + mass.sum(axis=1, keepdims=True))
        scale = scales * np.exp((trust * _ONE_STEP * shared + said) / (trust * _ONE_STEP + mass))
        many, few = mass
        odds = (_WEIGHT * mean + few.sum()) / (_WEIGHT * (1 - mean) + many.sum()) * ((1 - mean) / mean)
        share[1] = (_WEIGHT / (1 + odds_of_table / odds) + few) / (_WEIGHT + few + many)
        share[1] = np.minimum(np.maximum(share[1], LEAST_WIDE), MOST_WIDE)
        share[0] = 1 - share[1]
        np.maximum(scale, learned.least, out=scale)
        np.maximum(scale[1], scale[0], out=scale[1])
    return Tails(share[1], *scale)


#: So many independent errors of all steps together count as much as that levels are uniform, and as many of one step as
#: much as those of all.
_UNIFORM, _ALL_STEPS = 20.0, 40.0
#: Levels of which half of the errors, or nine tenths, are smaller, lie between these.
_LOWEST, _HIGHEST = 0.02, 0.995
#: The correction isn't for what the fit of the mixture has still to learn: limits of the factors of the covariance.
_LEAST_NARROW, _MOST_NARROW, _MOST_WIDE = 0.6, 2.0, 1.5


def level_counts(cell: Ints, half_squared: Floats, tails: Tails, cells: int) -> Floats:
    """The numbers (cells, B) of errors (M,) at each level: ``cell`` says where each counts, ``tails`` its mixture."""
    weight, narrow, wide = tails
    level = 1 - (1 - weight) * np.exp(-half_squared / narrow) - weight * np.exp(-half_squared / wide)
    column = np.minimum((level * LEVELS).astype(np.int64), LEVELS - 1)
    return np.bincount(cell * LEVELS + column, minlength=cells * LEVELS).reshape(cells, LEVELS).astype(np.float64)


def correct(tails: Tails, counts: Floats) -> Tails:
    """Mixtures (R, T) that hold what they say, after ``counts`` (R, T, B) of independent errors at each level.

    The narrow part is scaled so that half of the errors are in the 50 % ellipse. The wide part, of rare errors, is
    only made larger.
    """
    share = _shares(counts)
    below = np.concatenate([np.zeros((*share.shape[:-1], 1)), np.cumsum(share, axis=-1)], axis=-1)
    level = np.array([_MIDDLE, _OUTER])[:, None, None]
    at = np.minimum((below <= level[..., None]).sum(axis=-1) - 1, LEVELS - 1)  # (2, R, T)
    inside = level - np.take_along_axis(below[None], at[..., None], -1)[..., 0]
    held = (at + inside / np.take_along_axis(share[None], at[..., None], -1)[..., 0]) / LEVELS
    held = np.clip(held, _LOWEST, _HIGHEST)
    now, wanted = half_radius(np.stack([held, np.broadcast_to(level, held.shape)]), tails)
    middle, outer = now / wanted
    narrow = tails.narrow_scale * np.clip(middle, _LEAST_NARROW, _MOST_NARROW)
    wide = tails.wide_scale * np.clip(np.maximum(middle, outer), 1.0, _MOST_WIDE)
    return Tails(tails.wide_weight, narrow, np.maximum(wide, narrow))


def _shares(counts: Floats) -> Floats:
    """The expected shares of errors in each bin of levels, (R, T, B)."""
    of_all = counts.mean(axis=1, keepdims=True)
    shared = (of_all + _UNIFORM / LEVELS) / (of_all.sum(axis=2, keepdims=True) + _UNIFORM)
    own: Floats = (counts + _ALL_STEPS * shared) / (counts.sum(axis=2, keepdims=True) + _ALL_STEPS)
    return own


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
        self._of_table = Tails(self._table.wide_weight, self._table.narrow_scale, self._table.wide_scale)
        # the mixtures (3, T) of the fits that forecasts have, before and after they are corrected by levels
        self._fitted, self._tails = (np.array([self._of_table]) for _ in range(2))
        self._dropped = 0  # fits before those
        self._issued: list[_Issued] = []  # forecasts that are not compared with all times that they are of
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
        radii = squared_radius(0.5, Tails(*self._tails[-1])) / squared_radius(0.5, self._of_table)
        return float(np.sqrt(np.median(radii)))

    def warn(self, name: str) -> None:
        """Warn if ellipses, those of the predictor ``name``, became much larger than those of the table."""
        if self._independent * self._sums[1].sum() > _ENOUGH and self.factor > _LARGER:
            warn(
                f"predictions by {name} are {self.factor:.1f} times as far off as in the walks that it was measured "
                "on; their ellipses grew to fit this log, but those of its first seconds are too small",
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
        count = np.isfinite(past[:, -self._past :, 0]).sum(axis=1)
        factor = np.where((count < self._past)[:, None], self._table.short, 1.0)
        factor = np.where(is_coasting[:, None], self._table.coasting, factor)
        cov = forecast.cov * factor[:, :, None, None]
        fit = np.full(len(ids), self._dropped + len(self._fitted) - 1)
        if self._adapts and len(ids):
            refits = self._refits(step[~is_coasting])
            fit += np.searchsorted(refits, step, "right")
            seen = (past if observed is None else observed)[:, -PAST:]
            self._issued.append(_Issued(step, ids, ~is_coasting, seen, forecast.mean, cov, fit))
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
        issued = joined(self._issued)
        compared, lost = self._compare(issued, refits)
        passed = np.diff(refits, prepend=self._fitted_at)
        kept = np.exp(-passed * self._step_s / _MEMORY_S)
        place, shape = np.searchsorted(refits, compared.step), (len(refits), self._steps)
        cell, cells = place * self._steps + compared.ahead, len(refits) * self._steps
        new = counts_of(cell, compared.half, cells).reshape(*shape, BINS)
        counts, self._counts = running(self._counts, kept, new)
        inverse_m2 = np.bincount(cell, 1 / compared.size_m2, cells).reshape(shape)
        parts, self._sums = running(self._sums, kept, np.stack([lost, new.sum(axis=2), inverse_m2], axis=1))
        lost, seen, inverse_m2 = parts.transpose(1, 0, 2)

        here = issued.is_seen & (issued.step > self._fitted_at) & (issued.step <= refits[-1])
        noise = self._noise.follow(passed, np.searchsorted(refits, issued.step[here]), issued.past[here], self._steps)
        per_m2 = inverse_m2 / np.maximum(seen, 1e-9)
        learned = Learned(self._independent * counts, self._independent * lost, *(per_m2 * part for part in noise))
        fits = [self._fitted[-1]]
        for step in map(Learned, *learned):
            fits.append(np.array(follow(self._of_table, Tails(*fits[-1]), step, _ITERATIONS)))
        self._fitted = np.concatenate([self._fitted, fits[1:]])

        # levels of ellipses that were much smaller or larger say little about those of now
        change = np.abs(np.diff(np.log([fit[1] for fit in fits]), axis=0))
        at = Learned(*(part[place, compared.ahead] for part in learned))
        of = at.measured(Tails(*self._fitted[compared.fit - self._dropped, :, compared.ahead].T))
        levels = level_counts(cell, compared.half, of, cells).reshape(*shape, LEVELS)
        forgotten = kept[:, None, None] * np.exp(-change)[..., None]
        levels, self._levels = running(self._levels, forgotten, levels * forgotten)
        weight, narrow, wide = correct(Tails(*np.stack(fits[1:], axis=1)), self._independent * levels)
        narrow = np.maximum(narrow, learned.least)
        self._tails = np.concatenate([self._tails, np.stack([weight, narrow, np.maximum(wide, narrow)], axis=1)])

        self._fitted_at = int(refits[-1])
        left = int(np.searchsorted(issued.step, self._fitted_at - self._steps, "right"))
        self._issued = [taken(issued, np.arange(left, len(issued.step)))]

    def _compare(self, issued: _Issued, refits: Ints) -> tuple[_Compared, Floats]:
        """Compare forecasts with where their tracks are observed after the last fit, up to the last of ``refits``.

        Returns also the number (R, T) of forecasts of tracks that are not observed when others are.
        """
        now = np.flatnonzero(issued.is_seen & (issued.step > self._fitted_at) & (issued.step <= refits[-1]))
        _, slot = np.unique(issued.ids, return_inverse=True)
        first = int(issued.step[0]) - self._steps
        key = slot * (int(issued.step[-1]) - first + 1) + (issued.step - first)
        order = np.argsort(key, kind="stable")
        have, wanted = key[order], key[now, None] - np.arange(1, self._steps + 1)
        at = np.minimum(np.searchsorted(have, wanted), len(have) - 1)
        row, ahead = np.nonzero(have[at] == wanted)
        source, row = order[at[row, ahead]], now[row]
        times = np.unique(issued.step[now])
        of = times[:, None] - np.arange(1, self._steps + 1)
        due = np.searchsorted(issued.step, of, "right") - np.searchsorted(issued.step, of)
        seen = np.bincount(np.searchsorted(times, issued.step[row]) * self._steps + ahead, minlength=due.size)
        lost = np.zeros((len(refits), self._steps))
        np.add.at(lost, np.searchsorted(refits, times), np.maximum(due - seen.reshape(due.shape), 0))
        off, cov = issued.past[row, -1] - issued.mean[source, ahead], issued.cov[source, ahead]
        with np.errstate(invalid="ignore", divide="ignore"):
            half = mahalanobis_squared(off, cov) / 2
            size_m2 = np.sqrt(cov[:, 0, 0] * cov[:, 1, 1] - cov[:, 0, 1] ** 2)
        compared = _Compared(issued.step[row], ahead, issued.fit[source], half, size_m2)
        return taken(compared, np.isfinite(half)), lost

    def _drop_fits(self) -> None:
        """Drop the fits that no forecast has any more."""
        fits = [int(forecasts.fit[0]) for forecasts in self._issued if len(forecasts.fit)]
        count = min([*fits, self._dropped + len(self._fitted) - 1]) - self._dropped
        if count:
            self._fitted, self._tails = self._fitted[count:].copy(), self._tails[count:].copy()
            self._dropped += count


# Vehicles that a tracker follows in metres.
#
# Predictors know how people move; vehicles keep their velocity better than people do, until they brake or turn: their
# errors are small or large. So the distribution of a forecast is a mixture of a narrow and a wide normal
# distribution, by predictor, class, time ahead, and whether the vehicle stands or moves. The tables were fitted on
# drawn traffic (``tools/fit_vehicle_tails.py``), and on no recording.


VEHICLE_TABLES: Final = Path(__file__).parent / "trained" / "vehicle_tails.json"
#: The table of each class of vehicles, by its name among the limits of motion.
TABLE_OF_CLASS: Final[Mapping[str, str]] = {
    "bicycle": "bicycle", "motorcycle": "bicycle", "car": "car",
    "bus": "truck", "truck": "truck", "trailer": "truck", "train": "truck",
}  # fmt: skip
#: Vehicles that are slower than so many m/s stand.
STANDING_M_PER_S: Final = 0.5


def calibrated_vehicles(
    predictor: str, forecast: Forecast, step_s: float, names: Sequence[str], speed_m_per_s: Floats
) -> tuple[Forecast, Tails | None]:
    """Forecasts of which those of vehicles are mixtures.

    Parameters
    ----------
    predictor : str
        Name of the predictor. Only built-in ones have tables.
    forecast : Forecast
        N forecasts of T steps of ``step_s`` seconds, in metres.
    names : sequence of N str
        The class of each, as among the limits of motion; those of others stay as they are.
    speed_m_per_s : (N,) of float
        NaN where it isn't known; these forecasts stay as they are, too.

    Returns
    -------
    Forecast, Tails
        With the covariances of the mixtures, and their shapes (N, T), NaN for normal distributions; None if there is no
        table.
    """
    tables = tables_in(VEHICLE_TABLES).get(predictor)
    if tables is None:
        return forecast, None
    count, steps = forecast.mean.shape[:2]
    ahead_s = step_s * np.arange(1.0, steps + 1)
    cov, out = forecast.cov.copy(), normal_tails((count, steps))
    kinds = np.array([TABLE_OF_CLASS.get(name, "") for name in names])
    for kind in set(kinds.tolist()) - {""}:
        for state, is_in in (
            ("standing", speed_m_per_s < STANDING_M_PER_S),
            ("moving", speed_m_per_s >= STANDING_M_PER_S),
        ):
            here = (kinds == kind) & is_in
            if here.any():
                table = tables[kind][state]
                columns = (table[name] for name in ("ahead_s", "wide_weight", "narrow_scale", "wide_scale"))
                weight, narrow, wide = _interpolated(ahead_s, *columns)
                whole = (1 - weight) * narrow + weight * wide
                cov[here] *= whole[:, None, None]
                for part, values in zip(out, (weight, narrow / whole, wide / whole), strict=True):
                    part[here] = values
    return Forecast(forecast.mean, cov), out
