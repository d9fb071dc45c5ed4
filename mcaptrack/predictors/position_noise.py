"""The noise of measured positions in a log, as far as tracks show it: white noise, and noise that lasts.

A detector's box may be off for a second or two, and a tracker smooths boxes: positions then have errors that are alike
from step to step. Such noise hides in a track. A forecast starts with it, so that near forecasts agree better with
the track than with the truth; far ones agree worse. What shows are the bends of tracks, second differences over one,
two and three steps. White noise bends a track alike over any time, people bend it much more over longer times, and
lasting noise is between them. So the three are told apart by how bends grow, as variances of clocks are (Allan).
How long noise lasts can't be seen beside the motion of people; it is taken to be about a second.

Letters: N tracks, L past positions, T future steps.

References
----------
D. W. Allan, "Statistics of atomic frequency standards", Proceedings of the IEEE 54, 1966.
"""

from __future__ import annotations

from collections import deque
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats

#: Steps over which bends are seen.
_LAGS: Final = (1, 2, 3)
#: The time constant of lasting noise, and the power of the time with which the variance of bends by motion grows.
_LASTS_S, _MOTION = 1.2, 3.4
#: Noise is estimated again after so many steps, from so many times as many, if there are so many positions.
_EVERY, _KEPT, _LEAST_POSITIONS = 3, 13, 10
#: Errors of forecasts are no smaller than these shares of the variance of white and of lasting noise.
_LEAST_WHITE, _LEAST_LASTING = 0.3, 0.7


class NoiseOfErrors(NamedTuple):
    """The effect of noise on the errors of forecasts, (T,) in m^2 for each axis.

    ``added`` is how much larger the variance of errors is if forecasts are compared with measured positions instead of
    true ones; it is negative where both have the same noise. ``least`` is the least variance of errors.
    """

    added: Floats
    least: Floats


class PositionNoise:
    """Estimates the noise of the positions of tracks, in the order of time; steps have ``step_s`` seconds."""

    def __init__(self, step_s: float) -> None:
        self._step_s = step_s
        like = np.exp(-step_s * np.array(_LAGS) / _LASTS_S)
        lasting = 1 - 4 / 3 * like + like**2 / 3
        # bends have six times the variance of white noise
        self._shapes = np.stack([np.ones(len(_LAGS)), lasting, np.array(_LAGS, np.float64) ** _MOTION], axis=-1)
        self._bends_m2: deque[Floats] = deque(maxlen=_KEPT)
        self._waiting: list[Floats] = []
        self._variances_m2 = np.zeros(len(_LAGS))
        self._seen_at = 0
        self.white_m2 = self.lasting_m2 = 0.0

    def see(self, step: int, past: Floats) -> None:
        """Take the past positions (N, L, 2) of the tracks that are observed at a step, the current ones last."""
        if len(past):
            self._waiting.append(past[:, -1 - 2 * _LAGS[-1] :])
        if step - self._seen_at < _EVERY:
            return
        self._seen_at = step
        if self._waiting:
            self._bends_m2.append(_bends_m2(np.concatenate(self._waiting)))
            self._waiting.clear()
            self._estimate()

    def _estimate(self) -> None:
        """Estimate the noise from the bends of the last steps."""
        from scipy.optimize import lsq_linear  # ``nnls`` of some releases of SciPy gives up at times

        for place, bends_m2 in enumerate(np.concatenate(self._bends_m2).T):
            known = bends_m2[np.isfinite(bends_m2)]
            if len(known) >= _LEAST_POSITIONS:  # of two axes; the median, because some tracks turn or are exchanged
                self._variances_m2[place] = float(np.median(known)) / (12 * np.log(2))
        given = self._variances_m2
        if (given > 0).all():
            unit_m2 = float(given.mean())
            shapes = self._shapes * (unit_m2 / given)[:, None]
            parts = lsq_linear(shapes, np.ones(len(given)), (0, np.inf), method="bvls").x
            white, lasting, _ = (max(float(part), 0.0) for part in parts)  # -1e-19 is within rounding
            self.white_m2, self.lasting_m2 = white * unit_m2, lasting * unit_m2

    def of_errors(self, steps: int) -> NoiseOfErrors:
        """The effect of noise on the errors of forecasts of so many steps."""
        like = np.exp(-self._step_s * np.arange(1.0, steps + 1) / _LASTS_S)
        added = self.white_m2 + self.lasting_m2 * (1 - 2 * like)
        least = _LEAST_WHITE * self.white_m2 + _LEAST_LASTING * self.lasting_m2
        return NoiseOfErrors(added, np.full(steps, least))


def _bends_m2(past: Floats) -> Floats:
    """The squared bends of pasts (N, L, 2) over each of the lags, in m^2; (N, lags) for as many as the pasts allow."""
    lags = np.array([lag for lag in _LAGS if past.shape[1] > 2 * lag], np.int64)
    bends = past[:, -1:] - 2 * past[:, -1 - lags] + past[:, -1 - 2 * lags]
    return np.asarray((bends**2).sum(axis=2))
