"""Predictors that are linear in past positions: constant velocity, smoothed velocity, Kalman filter.

A forecast that is linear in the past positions is a matrix of weights, and so is its error: for a velocity that drifts
at random (white acceleration) and positions measured with noise, the variance of every future step follows exactly from
the weights; no growth of the uncertainty is assumed. It is scaled for each track by the innovations so far: a track
that was hard to predict will stay so.

Letters: B batch, L past positions (the last one is now), n of them known, T future steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.histories import Holt, fill_gaps
from mcaptrack.predictors.forecast import Forecast

#: Motion model for the errors of forecasts: standard deviation of a measured position, prior standard deviation of the
#: velocity, and power of the white acceleration. tools/calibrate.py prints the coverage that follows.
POSITION_NOISE_M: Final = 0.2
SPEED_M_PER_S: Final = 1.0
DRIFT_M2_PER_S3: Final = 0.06
#: Scaling of the variance by the squared innovations of a track: how many innovations the prior counts for, the limits
#: of the scale, and a factor that makes 95 % ellipses hold 95 %, because errors have heavier tails than a Gaussian.
PRIOR_COUNT: Final = 4.0
MIN_SCALE, MAX_SCALE = 0.7, 2.0
TAIL_FACTOR: Final = 1.5


def _cv_weights(count: int, times: Floats, ahead: Floats) -> Floats:
    """Extrapolate the mean velocity of the last three steps."""
    back = min(3, count - 1)
    weights = np.zeros((len(ahead), count))
    weights[:, -1] = 1.0
    if back:
        speed = ahead / (times[-1] - times[-1 - back])
        weights[:, -1] += speed
        weights[:, -1 - back] -= speed
    return weights


def _holt_weights(count: int, times: Floats, ahead: Floats) -> Floats:
    """Extrapolate the smoothed velocity (alpha = beta = 0.5, as in the paper)."""
    weights = np.zeros((len(ahead), count))
    weights[:, -1] = 1.0
    if count > 1:
        holt = Holt(0.5, 0.5)
        displacement = np.diff(np.eye(count), axis=0)  # each as weights on the positions
        level, trend = holt.start(displacement[0])
        for step in displacement[1:]:
            level, trend = holt.step(level, trend, step)
        weights += np.outer(ahead / (times[1] - times[0]), level)
    return weights


def _kalman(count: int, times: Floats, ahead: Floats) -> tuple[Floats, Floats]:
    """Weights (T, n) of the filter's forecasts, and (n - 1, n) of its normalised innovations: each of variance 1."""
    innovations = np.zeros((count - 1, count))
    step = float(times[1] - times[0]) if count > 1 else 0.0
    move = np.array([[1.0, step], [0.0, 1.0]])
    noise = DRIFT_M2_PER_S3 * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
    cov = np.diag([POSITION_NOISE_M**2, SPEED_M_PER_S**2])
    state = np.zeros((2, count))  # position and velocity, each as weights on the positions
    state[0, 0] = 1.0
    for at in range(1, count):
        state, cov = move @ state, move @ cov @ move.T + noise
        gain = cov[:, 0] / (cov[0, 0] + POSITION_NOISE_M**2)
        innovation = -state[0]
        innovation[at] += 1.0
        innovations[at - 1] = innovation / np.sqrt(cov[0, 0] + POSITION_NOISE_M**2)
        state = state + np.outer(gain, innovation)
        cov = cov - np.outer(gain, cov[0])
    return state[0] + np.outer(ahead, state[1]), innovations


def linear_variance(weights: Floats, times: Floats, ahead: Floats) -> Floats:
    """The variance (T,) in m^2 and per axis of a forecast by ``weights`` (T, n), which sum to 1 over n.

    ``times`` (n,) are those of the past positions and ``ahead`` (T,) those of the future ones after the last of them,
    in seconds. The motion model: integrated white acceleration, unknown initial velocity, noisy measurements.
    """
    start = times[0]
    variance = np.empty(len(ahead))
    for step, future in enumerate(ahead):
        at = np.append(times, times[-1] + future) - start
        error = np.append(-weights[step], 1.0)
        low, high = np.minimum.outer(at, at), np.maximum.outer(at, at)
        drift = DRIFT_M2_PER_S3 * (low**2 * high / 2 - low**3 / 6)
        variance[step] = (
            POSITION_NOISE_M**2 * (weights[step] ** 2).sum()
            + (SPEED_M_PER_S * (error @ at)) ** 2
            + error @ drift @ error
        )
    return variance


#: A Kalman filter with the motion model of ``linear_variance`` has the weights with the least error.
_WEIGHTS: Final = {"cv": _cv_weights, "holt-cv": _holt_weights, "kalman": lambda *past: _kalman(*past)[0]}
#: Number of past positions that each one uses.
_PAST: Final = {"cv": 4, "holt-cv": 8, "kalman": 8}
#: Number of past positions for the innovations that scale the uncertainty.
_SCALE_PAST: Final = 8


@dataclass(frozen=True)
class LinearPredictor:
    """A predictor that multiplies past positions by weights, one set for each number of known positions.

    Attributes
    ----------
    name : str
        ``cv`` (constant velocity, as in Schoeller et al., RA-L 2020), ``holt-cv`` (Holt's smoothing, as in Eq. 3 of Yu
        and Zhou, IROS 2021) or ``kalman``.
    steps : int
        Number of future steps.
    step_s : float
        Length of a step in seconds.

    Examples
    --------
    A track that moves by 0.4 m a step along x:

    >>> predictor = LinearPredictor("cv", steps=2, step_s=0.4)
    >>> xy_m = np.array([[[0.0, 0.0], [0.4, 0.0], [0.8, 0.0]]])
    >>> predictor.predict(xy_m, np.ones((1, 3), bool)).mean.round(6).tolist()
    [[[1.2, 0.0], [1.6, 0.0]]]
    """

    name: str
    steps: int
    step_s: float
    weights_sha256: None = None

    @property
    def past(self) -> int:
        """Number of past positions that are used, L."""
        return _PAST[self.name]

    @cached_property
    def table(self) -> tuple[Floats, Floats]:
        """Weights (L + 1, T, L), right-aligned, and variances (L + 1, T), by the number of known positions."""
        ahead: Floats = self.step_s * np.arange(1.0, self.steps + 1)
        weights = np.zeros((self.past + 1, self.steps, self.past))
        variance = np.zeros((self.past + 1, self.steps))
        for count in range(1, self.past + 1):
            times: Floats = self.step_s * np.arange(float(count))
            row_weights = _WEIGHTS[self.name](count, times, ahead)
            weights[count, :, self.past - count :] = row_weights
            variance[count] = linear_variance(row_weights, times, ahead)
        return weights, variance

    @cached_property
    def _innovations(self) -> Floats:
        """Weights (8 + 1, 7, 8) of normalised innovations, right-aligned, by the number of known positions."""
        weights = np.zeros((_SCALE_PAST + 1, _SCALE_PAST - 1, _SCALE_PAST))
        for count in range(2, _SCALE_PAST + 1):
            times: Floats = self.step_s * np.arange(float(count))
            weights[count, : count - 1, _SCALE_PAST - count :] = _kalman(count, times, np.empty(0))[1]
        return weights

    def predict(self, xy_m: Floats, valid: NDArray[np.bool_]) -> Forecast:
        """Positions (B, L', 2), of which ``valid`` (B, L') are known, the last one always -> forecasts.

        Gaps are interpolated linearly; L' may be longer or shorter than ``past``. The mean uses ``past`` positions, its
        uncertainty 8.
        """
        filled, count = fill_gaps(xy_m[:, -_SCALE_PAST:], valid[:, -_SCALE_PAST:])
        now = filled[:, -1:]
        filled = filled - now
        counted = np.minimum(count, self.past)
        weights, variance = self.table
        recent = filled[:, -self.past :]
        mean = now + weights[counted][:, :, self.past - recent.shape[1] :] @ recent
        scale = self._scale(filled, count, valid[:, -_SCALE_PAST:])
        return Forecast(mean, (variance[counted] * scale[:, None])[:, :, None, None] * np.eye(2))

    def _scale(self, filled: Floats, counts: NDArray[np.int64], valid: NDArray[np.bool_]) -> Floats:
        """The scale of the variance of each track (B,): its mean squared innovation so far, shrunk towards 1."""
        innovations = self._innovations[counts][:, :, _SCALE_PAST - filled.shape[1] :] @ filled
        count = 2 * (valid.sum(axis=1) - 1)  # along both axes, of positions that are not interpolated
        scale = (PRIOR_COUNT + (innovations**2).sum(axis=(1, 2))) / (PRIOR_COUNT + count)
        return np.where(counts > 1, TAIL_FACTOR * np.clip(scale, MIN_SCALE, MAX_SCALE), 1.0)


def cv(steps: int, step_s: float) -> LinearPredictor:
    """Constant velocity."""
    return LinearPredictor("cv", steps, step_s)


def holt_cv(steps: int, step_s: float) -> LinearPredictor:
    """Constant velocity after Holt's double exponential smoothing."""
    return LinearPredictor("holt-cv", steps, step_s)


def kalman(steps: int, step_s: float) -> LinearPredictor:
    """A Kalman filter with a constant-velocity model."""
    return LinearPredictor("kalman", steps, step_s)
