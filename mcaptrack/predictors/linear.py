"""Predictors that weigh past positions: constant velocity, smoothed velocity, Kalman filter.

A forecast that is linear in the past positions is a matrix of weights, and so is its error: for a walker whose velocity
drifts at random and positions that are seen with noise, the variance of every future step follows exactly from the
weights. Nothing is assumed about how uncertainty grows. How large it is, each track says itself: one that has surprised
so far (its steps differ from what was expected of them) will do so again, and one that has gone smoothly will go on.

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

#: How people walk, for the errors of forecasts: noise of a seen position, spread of velocity when nothing is known of
#: it, and how fast velocity drifts (the power of its white acceleration). tools/calibrate.py says what they cover.
POSITION_NOISE_M: Final = 0.2
SPEED_M_PER_S: Final = 1.0
DRIFT_M2_PER_S3: Final = 0.06
#: As many surprises (squared, in units of their variance) does the model's word count for, against those of a track,
#: which move the variance between the least and the most; and by how much it is widened so that the 95 % ellipse holds
#: 95 %: people's errors have heavier tails than Gauss's.
MODEL_COUNT: Final = 4.0
LEAST_SURPRISE, MOST_SURPRISE = 0.7, 2.0
WIDENED: Final = 1.5


def _cv_weights(known: int, times: Floats, ahead: Floats) -> Floats:
    """The mean velocity of the last three steps goes on."""
    back = min(3, known - 1)
    weights = np.zeros((len(ahead), known))
    weights[:, -1] = 1.0
    if back:
        speed = ahead / (times[-1] - times[-1 - back])
        weights[:, -1] += speed
        weights[:, -1 - back] -= speed
    return weights


def _holt_weights(known: int, times: Floats, ahead: Floats) -> Floats:
    """The smoothed velocity (alpha = beta = 0.5, the paper's) goes on."""
    weights = np.zeros((len(ahead), known))
    weights[:, -1] = 1.0
    if known > 1:
        holt = Holt(0.5, 0.5)
        displacement = np.diff(np.eye(known), axis=0)  # each as weights on the positions
        level, trend = holt.start(displacement[0])
        for one in displacement[1:]:
            level, trend = holt.step(level, trend, one)
        weights += np.outer(ahead / (times[1] - times[0]), level)
    return weights


def _kalman_weights(known: int, times: Floats, ahead: Floats) -> Floats:
    """A Kalman filter with the model of ``linear_variance`` itself: the least error of all weights."""
    return _kalman(known, times, ahead)[0]


def _kalman(known: int, times: Floats, ahead: Floats) -> tuple[Floats, Floats]:
    """Weights (T, n) of the filter's forecasts, and (n - 1, n) of its surprises on the way: each of variance 1."""
    surprises = np.zeros((known - 1, known))
    step = float(times[1] - times[0]) if known > 1 else 0.0
    move = np.array([[1.0, step], [0.0, 1.0]])
    noise = DRIFT_M2_PER_S3 * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
    cov = np.diag([POSITION_NOISE_M**2, SPEED_M_PER_S**2])
    state = np.zeros((2, known))  # position and velocity, each as weights on the positions
    state[0, 0] = 1.0
    for seen in range(1, known):
        state, cov = move @ state, move @ cov @ move.T + noise
        gain = cov[:, 0] / (cov[0, 0] + POSITION_NOISE_M**2)
        innovation = -state[0]
        innovation[seen] += 1.0
        surprises[seen - 1] = innovation / np.sqrt(cov[0, 0] + POSITION_NOISE_M**2)
        state = state + np.outer(gain, innovation)
        cov = cov - np.outer(gain, cov[0])
    return state[0] + np.outer(ahead, state[1]), surprises


def linear_variance(weights: Floats, times: Floats, ahead: Floats) -> Floats:
    """The variance (T,) in m^2 and per axis of a forecast by ``weights`` (T, n), which sum to 1 over n.

    ``times`` (n,) are those of the past positions and ``ahead`` (T,) those of the future ones after the last of them,
    in seconds. The walker: integrated white acceleration, a velocity of unknown direction, positions seen with noise.
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


_RECIPES: Final = {"cv": _cv_weights, "holt-cv": _holt_weights, "kalman": _kalman_weights}
#: How many past positions each one looks at.
_PAST: Final = {"cv": 4, "holt-cv": 8, "kalman": 8}
#: How many past positions say how uncertain a forecast is.
_MOST: Final = 8


@dataclass(frozen=True)
class LinearPredictor:
    """A predictor made of weights, for every number of known positions from 1 to ``past``.

    Source: constant velocity as in Schoeller et al. (RA-L 2020); Holt's smoothing as in Eq. 3 of the paper; Kalman.
    """

    name: str
    steps: int
    step_s: float
    weights_sha256: None = None

    @property
    def past(self) -> int:
        """How many past positions count, L."""
        return _PAST[self.name]

    @cached_property
    def table(self) -> tuple[Floats, Floats]:
        """Weights (L + 1, T, L), right-aligned, and variances (L + 1, T), by the number of known positions."""
        ahead: Floats = self.step_s * np.arange(1.0, self.steps + 1)
        weights = np.zeros((self.past + 1, self.steps, self.past))
        variance = np.zeros((self.past + 1, self.steps))
        for known in range(1, self.past + 1):
            times: Floats = self.step_s * np.arange(float(known))
            recipe = _RECIPES[self.name](known, times, ahead)
            weights[known, :, self.past - known :] = recipe
            variance[known] = linear_variance(recipe, times, ahead)
        return weights, variance

    @cached_property
    def _surprises(self) -> Floats:
        """Weights (8 + 1, 7, 8) of the surprises on the way, right-aligned, by the number of known positions."""
        weights = np.zeros((_MOST + 1, _MOST - 1, _MOST))
        for known in range(2, _MOST + 1):
            times: Floats = self.step_s * np.arange(float(known))
            weights[known, : known - 1, _MOST - known :] = _kalman(known, times, np.empty(0))[1]
        return weights

    def predict(self, xy_m: Floats, valid: NDArray[np.bool_]) -> Forecast:
        """Positions (B, L', 2) of which ``valid`` (B, L') are known, the last one always -> forecasts.

        Holes are filled linearly; L' may be longer or shorter than ``past``. The mean looks at ``past`` positions, its
        uncertainty at 8.
        """
        filled, known = fill_gaps(xy_m[:, -_MOST:], valid[:, -_MOST:])
        now = filled[:, -1:]
        filled = filled - now
        counted = np.minimum(known, self.past)
        weights, variance = self.table
        recent = filled[:, -self.past :]
        mean = now + weights[counted][:, :, self.past - recent.shape[1] :] @ recent
        scale = self._scale(filled, known, valid[:, -_MOST:])
        return Forecast(mean, (variance[counted] * scale[:, None])[:, :, None, None] * np.eye(2))

    def _scale(self, filled: Floats, known: NDArray[np.int64], valid: NDArray[np.bool_]) -> Floats:
        """How much more (or less) than the model the tracks (B,) have surprised so far, the model's word included."""
        surprises = self._surprises[known][:, :, _MOST - filled.shape[1] :] @ filled
        count = 2 * (valid.sum(axis=1) - 1)  # along both axes, of what was truly seen
        scale = (MODEL_COUNT + (surprises**2).sum(axis=(1, 2))) / (MODEL_COUNT + count)
        return np.where(known > 1, WIDENED * np.clip(scale, LEAST_SURPRISE, MOST_SURPRISE), 1.0)
