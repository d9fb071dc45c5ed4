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
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.mixtures import Tails

TABLES: Final = Path(__file__).parent / "trained" / "tails.json"
#: Edges and centres of bins of half the squared Mahalanobis distance, in which comparisons are counted.
_EDGES: Final = np.geomspace(1e-4, 1e4, 49)
_CENTRES: Final = np.sqrt(_EDGES[1:] * _EDGES[:-1])
BINS: Final = len(_CENTRES)
#: Counts (T, B) times this are their sums, and those of half the squared distances.
_SUMS: Final = np.stack([np.ones(BINS), _CENTRES], axis=1)
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
        """The distributions (T,) of distances from measured positions, of those from true ones."""
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
    given, mean = np.stack(table[1:]), float(table.wide_weight.mean())
    odds_of_table = 1 / table.wide_weight - 1
    trust, lost = np.array([[1.0], [_LARGE]]), np.zeros_like(scale)
    lost[1] = _LOST * learned.lost  # those that are lost have the size of the table
    all_sums = learned.counts @ _SUMS
    least, least_seen = np.maximum(learned.least, 1e-4), learned.least_measured
    for _ in range(iterations):
        seen = np.maximum(scale + learned.noise, least_seen)
        density = np.exp(-_CENTRES / seen[..., None]) * (share / seen)[..., None]
        of_wide = (learned.counts * (density[1] / np.maximum(density[0] + density[1], 1e-300))) @ _SUMS
        sums, total = np.stack([all_sums - of_wide, of_wide], axis=1).transpose(2, 1, 0)
        change = np.log(np.maximum(total / np.maximum(sums, 1e-9) - learned.noise, least) / given) * (sums > 1e-6)
        known, said = sums + lost, sums * change
        shared = said.sum(axis=1, keepdims=True) / (trust * _ALL_STEPS + known.sum(axis=1, keepdims=True))
        scale = given * np.exp((trust * _ONE_STEP * shared + said) / (trust * _ONE_STEP + known))
        many, few = known
        odds = (_WEIGHT * mean + few.sum()) / (_WEIGHT * (1 - mean) + many.sum()) * ((1 - mean) / mean)
        share[1] = (_WEIGHT / (1 + odds_of_table / odds) + few) / (_WEIGHT + few + many)
        share[1] = np.minimum(np.maximum(share[1], _LEAST_WIDE), _MOST_WIDE)
        share[0] = 1 - share[1]
        np.maximum(scale, learned.least, out=scale)
        np.maximum(scale[1], scale[0], out=scale[1])
    return Tails(share[1], *scale)
