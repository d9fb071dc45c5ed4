"""The noise of measured positions in a log, as far as tracks show it: white noise, and noise that lasts.

A detector's box may be off for a second or two, and a tracker smooths boxes: positions then have errors that are alike
from step to step. Such noise hides in a track. A forecast starts with it, so that near forecasts agree better with
the track than with the truth; far ones agree worse. What shows are the bends of tracks, second differences over one,
two and three steps. White noise bends a track alike over any time, people bend it much more over longer times, and
lasting noise is between them. So the three are told apart by how bends grow, as variances of clocks are (Allan).
How long noise lasts can't be seen beside the motion of people: it is taken to have no time scale of its own, with as
much of its variance in each octave from a step or two to the usual horizon (as flicker noise).

Letters: N tracks, L past positions, T future steps, R times.

References
----------
D. W. Allan, "Statistics of atomic frequency standards", Proceedings of the IEEE 54, 1966.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats, Ints

#: Steps over which bends are seen.
_LAGS: Final = (1, 2, 3)
#: The time constants of lasting noise, each with as much of its variance.
_LASTS_S: Final = np.array([0.6, 1.2, 2.4, 4.8])
#: The power of the time with which the variance of bends by motion grows.
_MOTION: Final = 3.4
#: Bends count 1 / e after so many seconds, and less than so many say nothing.
_MEMORY_S, _LEAST_POSITIONS = 60.0, 30
#: Squared bends in m^2 are counted in bins between these powers of ten, so many to each.
_LOWEST, _HIGHEST, _BINS = -8, 6, 16
#: Positions of a past, the current one included, that show bends.
PAST: Final = 1 + 2 * _LAGS[-1]
#: All choices of the three parts, the empty one first.
_CHOICES: Final = np.array([[bool(number & 1 << part) for part in range(3)] for number in range(8)])
#: What is added to the equations of each choice: those of other columns are 0, and some columns are almost alike.
_ALONE: Final = np.stack([np.diag(np.where(choice, 1e-12, 1.0)) for choice in _CHOICES])
#: Errors of forecasts are no smaller than these shares of the variance of white and of lasting noise.
_LEAST_WHITE, _LEAST_LASTING = 0.3, 0.7


class NoiseOfErrors(NamedTuple):
    """The effect of noise on the errors of forecasts at R times, (R, T) in m^2 for each axis.

    ``added`` is how much larger the variance of errors is if forecasts are compared with measured positions instead of
    true ones; it is negative where both have the same noise. ``least`` is the least variance of errors.
    """

    added: Floats
    least: Floats


# Sums over the time of a log in which what is older counts less. Letters: R times.


def running(before: Floats, kept: Floats, new: NDArray[Any]) -> tuple[Floats, Floats]:
    """Decaying sums (R, ...) at some times, and the last of them.

    At each time ``kept`` (R, ...) of the sum before, which has the shape (...), is left, and ``new`` (R, ...) is added.

    Examples
    --------
    >>> running(np.array([8.0]), np.array([0.5, 0.5]), np.array([[1.0], [0.0]]))[0].tolist()
    [[5.0], [2.5]]
    """
    out = np.empty(new.shape)
    for number, (left, added) in enumerate(zip(kept, new, strict=True)):
        before = left * before + added
        out[number] = before
    return out, out[-1].copy() if len(out) else before


class PositionNoise:
    """Estimates the noise of the positions of tracks, in the order of time; steps have ``step_s`` seconds."""

    def __init__(self, step_s: float) -> None:
        self._step_s = step_s
        lags = np.array(_LAGS)
        lasting = 1 - 4 / 3 * _likeness(step_s * lags) + _likeness(2 * step_s * lags) / 3
        # bends have six times the variance of white noise
        self._shapes = np.stack([np.ones(len(lags)), lasting, lags**_MOTION], axis=-1)
        self._counts = np.zeros((len(_LAGS), (_HIGHEST - _LOWEST) * _BINS))

    def follow(self, passed: Ints, place: Ints, past: Floats, steps: int) -> NoiseOfErrors:
        """The effect of noise on the errors of forecasts of so many ``steps``, at some times (R,).

        ``passed`` (R,) are the steps since the time before, ``past`` (N, L, 2) the past positions of tracks that were
        observed in these steps, the current ones last, and ``place`` (N,) says of which time they are.
        """
        white_m2, lasting_m2 = (part[:, None] for part in self.variances_m2(passed, place, past))
        like = _likeness(self._step_s * np.arange(1.0, steps + 1))
        least = np.broadcast_to(_LEAST_WHITE * white_m2 + _LEAST_LASTING * lasting_m2, (len(passed), steps))
        return NoiseOfErrors(white_m2 + lasting_m2 * (1 - 2 * like), least)

    def variances_m2(self, passed: Ints, place: Ints, past: Floats) -> tuple[Floats, Floats]:
        """The variances (R,) of white and of lasting noise, in m^2 for each axis; as for ``follow``.

        They are 0 as long as little is known.
        """
        variance_m2 = self.bends_m2(passed, place, past)
        is_known = np.isfinite(variance_m2).all(axis=1)
        variance_m2[~is_known] = 1.0
        unit_m2 = variance_m2.mean(axis=1)
        parts = nonnegative(self._shapes * (unit_m2[:, None] / variance_m2)[:, :, None])
        white, lasting, _ = (parts * np.where(is_known, unit_m2, 0.0)[:, None]).T
        return white, lasting

    def bends_m2(self, passed: Ints, place: Ints, past: Floats) -> Floats:
        """The variance (R, lags) of white noise that would bend tracks as much over each of the lags, in m^2 for each
        axis; NaN where little is known. The rest is as for ``follow``.
        """
        bends_m2 = _bends_m2(past)
        row, lag = np.nonzero(np.isfinite(bends_m2))
        lags, bins = self._counts.shape
        power = np.log10(np.maximum(bends_m2[row, lag], 10.0**_LOWEST)) - _LOWEST
        cell = (place[row] * lags + lag) * bins + np.minimum((power * _BINS).astype(np.int64), bins - 1)
        new = np.bincount(cell, minlength=len(passed) * lags * bins).reshape(len(passed), lags, bins)
        counts, self._counts = running(self._counts, np.exp(-passed * self._step_s / _MEMORY_S), new)
        below = counts.cumsum(axis=2)
        total = below[..., -1]
        # of two axes; the median, because some tracks turn or are exchanged
        median = np.minimum((below < total[..., None] / 2).sum(axis=2), bins - 1)[..., None]
        above = np.take_along_axis(below, median, 2)[..., 0] - total / 2
        within = 1 - above / np.maximum(np.take_along_axis(counts, median, 2)[..., 0], 1e-300)
        variance_m2 = 10 ** (_LOWEST + (median[..., 0] + within) / _BINS) / (12 * np.log(2))
        return np.asarray(np.where(total >= _LEAST_POSITIONS, variance_m2, np.nan))


def _likeness(passed_s: Floats) -> Floats:
    """The correlation (K,) of lasting noise with itself after some time (K,)."""
    return np.asarray(np.exp(-passed_s[:, None] / _LASTS_S).mean(axis=1))


def nonnegative(shapes: Floats) -> Floats:
    """The nonnegative factors (R, 3) with which the sums of columns of ``shapes`` (R, M, 3) are nearest to 1.

    By least squares: the best of the solutions for each choice of columns, of those without negative factors.
    """
    size = np.sqrt((shapes**2).sum(axis=1))
    columns = shapes / size[:, None]
    product, with_one = np.einsum("rmk,rml->rkl", columns, columns)[:, None], columns.sum(axis=1)
    both = _CHOICES[:, :, None] & _CHOICES[:, None, :]
    one_side = np.where(_CHOICES, with_one[:, None], 0.0)
    parts = np.linalg.solve(np.where(both, product, 0.0) + _ALONE, one_side[..., None])[..., 0]
    gain = np.where((parts >= 0).all(axis=2), (parts * one_side).sum(axis=2), -1.0)
    best = gain.argmax(axis=1)
    return np.asarray(parts[np.arange(len(parts)), best] / size)


def _bends_m2(past: Floats) -> Floats:
    """The squared bends of pasts (N, L, 2) over each of the lags, in m^2; (N, lags) for as many as the pasts allow."""
    lags = np.array([lag for lag in _LAGS if past.shape[1] > 2 * lag], np.int64)
    bends = past[:, -1:] - 2 * past[:, -1 - lags] + past[:, -1 - 2 * lags]
    return np.asarray((bends**2).sum(axis=2))
