"""False tracks: which tracks follow no person, because they flicker, never move, or duplicate another track.

Letters: K tracks, N rows of trajectories, F features.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.neighbours import near_pairs
from mcaptrack.geometry.ragged import group_index, run_starts
from mcaptrack.transforms.retrack.motion_model import MotionModel, State, Trajectories
from mcaptrack.transforms.retrack.weights import Logistic, columns, probability

# The features that tell people from false tracks: how long, where and how regularly a track was seen.
#
# Much of it is known only from the other tracks of the log: whether a track never leaves the side of another, and
# whether it is missed for longer than others are.
#
# Letters: K tracks, N rows of trajectories, F features, G gaps, P pairs of rows.


#: Whether a track is a person; the features of that, and their means and spreads.
_PEOPLE: Final = Logistic.of("people")
FEATURES: Final = _PEOPLE.names
_MEAN, _SPREAD = (np.array([_PEOPLE.numbers[what][name] for name in FEATURES]) for what in ("mean", "spread"))
#: A duplicate of a track is nearer to it than this.
_DUPLICATE_M: Final = 1.2
#: A track lies inside another if it begins more than so many steps after it and ends as many before it.
_INSIDE_STEPS: Final = 3
#: A track is beside a longer one where it is nearer to it than this, if at so many samples.
_BESIDE_M: Final = 1.8
_BESIDE_SAMPLES: Final = 4
#: Two tracks are in step if their distance varies by less than this factor of the noise of both; so much is added to
#: ratios to the noise.
_IN_STEP: Final = 2.0
_LEAST_SPREAD: Final = 0.05
#: Gaps are compared with those of tracks that go farther than this: what goes somewhere is a person.
_GOES_M: Final = 3.0
#: What stays inside a box with a shorter diagonal stands. It does so for the whole log if it begins and ends within so
#: many seconds of it, or this share of it where that is less, is missed for no longer at once, and the log has at least
#: so many seconds.
_STANDS_M: Final = 1.5
_MISSED_S, _BORDER_SHARE, _SHORTEST_S = 2.0, 0.1, 10.0
#: What is in step with another track to this extent is a double of it.
_DOUBLE: Final = 1.0


def features(model: MotionModel, trajectories: Trajectories, smoothed: State) -> Floats:
    """The features that distinguish people from false tracks, (K, F): see ``FEATURES``."""
    first, last = trajectories.first[:-1], trajectories.first[1:] - 1
    length = last - first + 1
    observed = np.isfinite(trajectories.xy_m[:, 0])
    count = np.add.reduceat(observed.astype(float), first)
    xy = smoothed.mean[:, :2]
    extent = _extent(xy, first)
    residual = np.where(observed[:, None], trajectories.xy_m - xy, 0.0)
    roughness = np.add.reduceat((residual**2).sum(axis=1), first) / count / (2 * model.noise_m**2)
    speed = np.hypot(smoothed.mean[:, 2], smoothed.mean[:, 3])
    mean_speed = np.add.reduceat(speed, first) / length
    beside, in_step = _beside(trajectories, xy, model.noise_m, np.sqrt(roughness))
    values = {
        "log length": np.log(length * model.step_s),
        "log count": np.log(count),
        "log extent": np.log(extent + 0.3),
        "log speed": np.log(mean_speed + 0.1),
        "log roughness": np.log(roughness + 0.1),  # the mean squared residual
        "observed": count / length,
        "duplicate": _duplicate_share(trajectories, xy),
        "beside": beside,
        "in step": in_step,
        "rare gaps": _rare_gaps(trajectories, extent > _GOES_M),
    }
    return columns(FEATURES, values)


def stand_throughout(
    trajectories: Trajectories, smoothed: State, values: Floats, log: tuple[int, int], step_s: float
) -> Bools:
    """Which tracks (K,) stand still from the first step of the log to its last one, ``log``, and are no doubles.

    People may stand for longer than a log is; most clutter comes and goes. ``values`` (K, F) are the features.
    """
    first, last = trajectories.first[:-1], trajectories.first[1:] - 1
    most = _MISSED_S / step_s
    border = min(most, _BORDER_SHARE * (log[1] - log[0]))
    begins, ends = trajectories.step[first] <= log[0] + border, trajectories.step[last] >= log[1] - border
    stays = (_extent(smoothed.mean[:, :2], first) < _STANDS_M) & (values[:, FEATURES.index("in step")] < _DOUBLE)
    is_long = (log[1] - log[0]) * step_s >= _SHORTEST_S - 1e-9
    track, missed = _gaps(trajectories)
    is_missed = np.bincount(track[missed > most], minlength=len(first)) > 0
    return np.asarray(begins & ends & stays & ~is_missed & is_long)


def _gaps(trajectories: Trajectories) -> tuple[Ints, Ints]:
    """The track of each gap (G,), and the steps for which it is missed."""
    seen = np.flatnonzero(np.isfinite(trajectories.xy_m[:, 0]))
    track = group_index(np.diff(trajectories.first))[seen]
    missed = np.diff(trajectories.step[seen]) - 1
    is_gap = (np.diff(track) == 0) & (missed > 0)
    return track[1:][is_gap], missed[is_gap]


def _extent(xy: Floats, first: Ints) -> Floats:
    """The diagonal of the box around each track (K,)."""
    return np.asarray(np.hypot(*(np.maximum.reduceat(xy, first) - np.minimum.reduceat(xy, first)).T))


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


def _beside(trajectories: Trajectories, xy: Floats, noise_m: float, errors: Floats) -> tuple[Floats, Floats]:
    """The share of each track's samples beside the companion that it is most in step with, (K,); and that times how
    much steadier the distance of their samples is than ``_IN_STEP`` allows, as a logarithm, (K,).

    A companion has more samples, or as many and is the first of the two. People who walk together are measured one by
    one, so their distance varies by the noise of both; two detections of one person share what is wrong with them. That
    says nothing where nothing is wrong, so variation is compared with the ``errors`` (K,) of the track, as a ratio to
    the noise, where these are smaller.
    """
    seen = np.flatnonzero(np.isfinite(trajectories.xy_m[:, 0]))
    track = group_index(np.diff(trajectories.first))
    count = np.bincount(track[seen], minlength=len(trajectories.first) - 1)
    pair = np.stack(near_pairs(trajectories.step[seen], xy[seen], _BESIDE_M))
    own, other = seen[np.concatenate([pair, pair[::-1]], axis=1)]
    a, b = track[own], track[other]
    is_longer = (count[b] > count[a]) | ((count[b] == count[a]) & (b < a))
    own, other, a, b = own[is_longer], other[is_longer], a[is_longer], b[is_longer]
    order = np.lexsort((trajectories.step[own], b, a))
    own, other, a, b = own[order], other[order], a[order], b[order]
    starts = np.flatnonzero(run_starts(a, b))
    together = np.diff(np.append(starts, len(a)))
    share, in_step = np.zeros((2, len(count)))
    if len(starts) == 0:
        return share, in_step
    apart = trajectories.xy_m[own] - trajectories.xy_m[other]
    mean = np.add.reduceat(apart, starts) / together[:, None]
    off = ((apart - np.repeat(mean, together, axis=0)) ** 2).sum(axis=1)
    varies = np.sqrt(np.add.reduceat(off, starts) / np.maximum(2 * (together - 1), 1) / 2) / noise_m
    track = a[starts]
    shares = together / count[track]
    expected = np.log(_IN_STEP * (np.minimum(errors[track], 1) + _LEAST_SPREAD) / (1 + _LEAST_SPREAD))
    steady = shares * np.maximum(expected - np.log(varies + _LEAST_SPREAD), 0)
    often = together >= _BESIDE_SAMPLES
    order = np.lexsort((shares, steady, track))[::-1]
    order = order[often[order]]
    best = order[run_starts(track[order])]
    share[track[best]], in_step[track[best]] = shares[best], steady[best]
    return share, in_step


def _rare_gaps(trajectories: Trajectories, goes: Bools) -> Floats:
    """The rarity of the gaps of each track, (K,): the mean of the negative logarithms of the shares of gaps that are
    as long, among those of the other tracks that go somewhere; 0 without gaps.
    """
    track, missed = _gaps(trajectories)
    usual = np.sort(missed[goes[track]])
    own = goes[track]  # a gap isn't compared with itself
    as_long = len(usual) - np.searchsorted(usual, missed) - own
    rare = -np.log((as_long + 1) / (len(usual) - own + 2))
    total, count = (np.bincount(track, weights, minlength=len(goes)) for weights in (rare, None))
    return np.asarray(total / np.maximum(count, 1))


#: What is added to the log odds of tracks that stand for the whole log.
_THROUGHOUT: Final = float(_PEOPLE.numbers["stands throughout"])
#: How strongly weights stay as they were fitted while they follow a log, and how much each sample of a track counts
#: against that, up to so many: steps between samples are no evidence. (Chosen on synthetic scenes and crowds.)
_STAYS: Final = 20.0
_EACH_SAMPLE, _MOST_SAMPLES = 1 / 8, 20
#: The same for detections with scores: log odds without any; of the mean score, as a ratio to the usual one, above
#: ``_LOW``, times the number of rows up to ``_ENOUGH``; of log seconds; of the share that was observed; of log extent.
SCORED: Final = (-3.1, 0.8, 1.1, 5.1, 1.6)
_LOW: Final = 0.6
_ENOUGH: Final = 10


def log_odds_in_log(model: MotionModel, trajectories: Trajectories, smoothed: State, log: tuple[int, int]) -> Floats:
    """The log odds that each track is a person, (K,), by weights that follow the log.

    ``log`` are the first and last step of the log.

    What false tracks are like differs from log to log: somewhere they flicker, elsewhere they stand still for long, as
    some people do. Tracks that are like one another are people or false together, so the weights move to where few
    tracks of this log are doubtful: they minimise the entropy of the tracks and the distance from the fitted weights
    (Grandvalet and Bengio, Semi-supervised learning by entropy minimization, 2005).
    """
    from scipy.optimize import minimize

    values = features(model, trajectories, smoothed)
    standard = (values - _MEAN) / _SPREAD
    columns = np.column_stack([standard, np.ones(len(standard))])
    # not a feature: its weight doesn't follow the log, and is no reason to think less of others who stand
    extra = _THROUGHOUT * stand_throughout(trajectories, smoothed, values, log, model.step_s)
    samples = np.add.reduceat(np.isfinite(trajectories.xy_m[:, 0]), trajectories.first[:-1], dtype=np.int64)
    counts = _EACH_SAMPLE * np.minimum(samples, _MOST_SAMPLES)
    fitted = np.append(_PEOPLE.weights * _SPREAD, _PEOPLE.bias + _PEOPLE.weights @ _MEAN)

    def loss(weights: Floats) -> tuple[float, Floats]:
        value, off = columns @ weights + extra, weights - fitted
        likely = probability(value)
        entropy = np.logaddexp(0, value) - likely * value
        slope = columns.T @ (counts * -value * likely * (1 - likely))
        return float(counts @ entropy + _STAYS / 2 * (off @ off)), slope + _STAYS * off

    return np.asarray(columns @ minimize(loss, fitted, jac=True, method="L-BFGS-B").x + extra)


def scored_log_odds(xy_m: Floats, first: Ints, score: Floats, observed: Bools, usual: float, step_s: float) -> Floats:
    """The log odds that each track of detections with scores is an object, (K,).

    Much in traffic stands still, so a track needs no motion; but what neither moves nor has scores as high as is usual
    in the log is clutter. Rows (N,) of track k begin at ``first[k]``, of K + 1; ``xy_m`` (N, 2) are their positions.
    ``usual`` is the median score of the log. Rows without a score count as usual ones.
    """
    begin, length = first[:-1], np.diff(first)
    counted = observed & ~np.isnan(score)
    count = np.add.reduceat(observed.astype(float), begin)
    total = np.add.reduceat(np.where(counted, score / usual - _LOW, 0.0), begin)
    excess = total / np.maximum(np.add.reduceat(counted.astype(float), begin), 1) * np.minimum(length, _ENOUGH)
    moved = np.log(np.clip(_extent(xy_m, begin), 0.5, 5.0))
    values = [np.ones(len(begin)), excess, np.log(length * step_s), count / length, moved]
    return np.asarray(np.stack(values, axis=1) @ np.array(SCORED))
