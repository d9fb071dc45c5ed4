"""False tracks: which tracks follow no person, because they flicker, never move, or duplicate another track.

Letters: K tracks, N rows of trajectories, F features.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.neighbours import near_pairs
from mcaptrack.geometry.ragged import group_index
from mcaptrack.transforms.retrack.motion_model import MotionModel, State, Trajectories
from mcaptrack.transforms.retrack.weights import weights_of

#: A duplicate of a track is nearer to it than this.
_DUPLICATE_M: Final = 1.2
#: A track lies inside another if it begins more than so many steps after it and ends as many before it.
_INSIDE_STEPS: Final = 3

FEATURES: Final = ("log length", "log count", "log extent", "log speed", "log roughness", "observed", "duplicate")
#: Weight of each feature as a log odds ratio, and the log odds without any.
_WEIGHTS, _FITTED = weights_of("people", FEATURES)
_BIAS: Final = float(_FITTED["bias"])
#: The same for detections with scores: log odds without any; of the mean score, as a ratio to the usual one, above
#: ``_LOW``, times the number of rows up to ``_ENOUGH``; of log seconds; of the share that was observed; of log extent.
SCORED: Final = (-3.1, 0.8, 1.1, 5.1, 1.6)
_LOW: Final = 0.6
_ENOUGH: Final = 10


def probability(log_odds: Floats) -> Floats:
    """Log odds as probabilities."""
    return np.asarray(1 / (1 + np.exp(-log_odds)))


def track_log_odds(model: MotionModel, trajectories: Trajectories, smoothed: State, step_s: float) -> Floats:
    """The log odds that each track is a person, (K,)."""
    return np.asarray(features(model, trajectories, smoothed, step_s) @ _WEIGHTS + _BIAS)


def features(model: MotionModel, trajectories: Trajectories, smoothed: State, step_s: float) -> Floats:
    """The features that distinguish people from false tracks, (K, F): see ``FEATURES``."""
    first, last = trajectories.first[:-1], trajectories.first[1:] - 1
    length = last - first + 1
    observed = np.isfinite(trajectories.xy_m[:, 0])
    count = np.add.reduceat(observed.astype(float), first)
    xy = smoothed.mean[:, :2]
    low, high = np.minimum.reduceat(xy, first), np.maximum.reduceat(xy, first)
    extent = np.hypot(*(high - low).T)
    residual = np.where(observed[:, None], trajectories.xy_m - xy, 0.0)
    roughness = np.add.reduceat((residual**2).sum(axis=1), first) / count / (2 * model.noise_m**2)
    speed = np.hypot(smoothed.mean[:, 2], smoothed.mean[:, 3])
    mean_speed = np.add.reduceat(speed, first) / length
    return np.stack(
        [
            np.log(length * step_s),
            np.log(count),
            np.log(extent + 0.3),
            np.log(mean_speed + 0.1),
            np.log(roughness + 0.1),
            count / length,
            _duplicate_share(trajectories, xy),
        ],
        axis=1,
    )


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


def _duplicate_share(trajectories: Trajectories, xy: Floats) -> Floats:
    """The share of each track's rows that are near one other track which began before it and ended after it, (K,)."""
    begins, ends = trajectories.step[trajectories.first[:-1]], trajectories.step[trajectories.first[1:] - 1]
    length = np.diff(trajectories.first)
    track = group_index(length)
    a, b = (track[side] for side in near_pairs(trajectories.step, xy, _DUPLICATE_M))
    is_a_short = length[a] <= length[b]
    short, long = np.where(is_a_short, a, b), np.where(is_a_short, b, a)
    pair, count = np.unique(short * len(length) + long, return_counts=True)
    short, long = pair // len(length), pair % len(length)
    share = count / length[short]
    is_inside = (begins[long] + _INSIDE_STEPS < begins[short]) & (ends[long] - _INSIDE_STEPS > ends[short])
    out = np.zeros(len(length))
    np.maximum.at(out, short, share * is_inside)
    return out
