"""False tracks: which tracks follow no person, because they flicker, never move, or duplicate another track.

Letters: K tracks, N rows of trajectories, F features.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.transforms.retrack.motion_model import MotionModel, State, Trajectories
from mcaptrack.transforms.retrack.track_features import FEATURES, features, stand_throughout
from mcaptrack.transforms.retrack.weights import weights_of

#: Weight of each feature as a log odds ratio, and the log odds without any; means and spreads of features.
_WEIGHTS, _FITTED = weights_of("people", FEATURES)
_BIAS: Final = float(_FITTED["bias"])
_MEAN, _SPREAD = (np.array([_FITTED[what][name] for name in FEATURES]) for what in ("mean", "spread"))
#: What is added to the log odds of tracks that stand for the whole log.
_THROUGHOUT: Final = float(_FITTED["stands throughout"])
#: How strongly weights stay as they were fitted while they follow a log, and how much each step of a track counts
#: against that, up to so many steps. (Chosen on synthetic scenes and crowds.)
_STAYS: Final = 30.0
_EACH_STEP, _MOST_STEPS = 1 / 8, 20
#: The same for detections with scores: log odds without any; of the mean score, as a ratio to the usual one, above
#: ``_LOW``, times the number of rows up to ``_ENOUGH``; of log seconds; of the share that was observed; of log extent.
SCORED: Final = (-3.1, 0.8, 1.1, 5.1, 1.6)
_LOW: Final = 0.6
_ENOUGH: Final = 10


def probability(log_odds: Floats) -> Floats:
    """Log odds as probabilities."""
    return np.asarray(1 / (1 + np.exp(-log_odds)))


def log_odds_in_log(
    model: MotionModel, trajectories: Trajectories, smoothed: State, step_s: float, log: tuple[int, int]
) -> Floats:
    """The log odds that each track is a person, (K,), by weights that follow the log.

    ``log`` are the first and last step of the log.

    What false tracks are like differs from log to log: somewhere they flicker, elsewhere they stand still for long, as
    some people do. Tracks that are like one another are people or false together, so the weights move to where few
    tracks of this log are doubtful: they minimise the entropy of the tracks and the distance from the fitted weights
    (Grandvalet and Bengio, Semi-supervised learning by entropy minimization, 2005).
    """
    from scipy.optimize import minimize

    found = features(model, trajectories, smoothed, step_s)
    standard = (found - _MEAN) / _SPREAD
    known = np.column_stack([standard, np.ones(len(standard))])
    # not a feature: its weight doesn't follow the log, and is no reason to think less of others who stand
    extra = _THROUGHOUT * stand_throughout(trajectories, smoothed, found, log, step_s)
    counts = _EACH_STEP * np.minimum(np.diff(trajectories.first), _MOST_STEPS)
    fitted = np.append(_WEIGHTS * _SPREAD, _BIAS + _WEIGHTS @ _MEAN)

    def loss(weights: Floats) -> tuple[float, Floats]:
        value, off = known @ weights + extra, weights - fitted
        likely = probability(value)
        entropy = np.logaddexp(0, value) - likely * value
        slope = known.T @ (counts * -value * likely * (1 - likely))
        return float(counts @ entropy + _STAYS / 2 * (off @ off)), slope + _STAYS * off

    return np.asarray(known @ minimize(loss, fitted, jac=True, method="L-BFGS-B").x + extra)


def scored_log_odds(xy_m: Floats, first: Ints, score: Floats, observed: Bools, usual: float, step_s: float) -> Floats:
    """The log odds that each track of detections with scores is an object, (K,).

    Much in traffic stands still, so a track needs no motion; but what neither moves nor has scores as high as is usual
    in the log is clutter. Rows (N,) of track k begin at ``first[k]``, of K + 1; ``xy_m`` (N, 2) are their positions.
    ``usual`` is the median score of the log. Rows without a score count as usual ones.
    """
    return np.asarray(scored_features(xy_m, first, score, observed, usual, step_s) @ np.array(SCORED))


def scored_features(xy_m: Floats, first: Ints, score: Floats, observed: Bools, usual: float, step_s: float) -> Floats:
    """The features of tracks of detections with scores, (K, 5), see ``SCORED``."""
    begin, length = first[:-1], np.diff(first)
    counted = observed & ~np.isnan(score)
    count = np.add.reduceat(observed.astype(float), begin)
    total = np.add.reduceat(np.where(counted, score / usual - _LOW, 0.0), begin)
    excess = total / np.maximum(np.add.reduceat(counted.astype(float), begin), 1) * np.minimum(length, _ENOUGH)
    extent = np.hypot(*(np.maximum.reduceat(xy_m, begin) - np.minimum.reduceat(xy_m, begin)).T)
    moved = np.log(np.clip(extent, 0.5, 5.0))
    return np.stack([np.ones(len(begin)), excess, np.log(length * step_s), count / length, moved], axis=1)
