"""The motion of people: constant velocity with drift, measured with noise. Kalman filters for many tracks at once.

Both axes have the same covariance, so three numbers of it are enough for each track: the variance of the position, the
covariance of position and velocity, and the variance of the velocity.

Letters: K tracks or pairs, N rows of trajectories.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints, joined
from mcaptrack.geometry.ragged import group_index, ragged_range
from mcaptrack.schema.framing import spans_of

#: Standard deviation of measured positions per axis in metres, until it is estimated.
DEFAULT_NOISE_M: Final = 0.2
#: People walk at about this speed.
WALK_M_PER_S: Final = 1.4


class State(NamedTuple):
    """``mean`` (K, 4): x, y in m, vx, vy in m/s. ``cov`` (K, 3): of position, position x velocity, velocity."""

    mean: Floats
    cov: Floats


@dataclass(frozen=True)
class MotionModel:
    """Constant velocity with white acceleration noise.

    ``noise_m`` is the standard deviation of a measured position, ``speed_m_per_s`` that of the velocity of a new track
    (both per axis). ``drift_m_per_s`` is how much velocities change within a second at rest, in m/s, and
    ``drift_ratio`` how much more with speed, as a share of it. Steps have ``step_s`` seconds.
    """

    noise_m: float
    speed_m_per_s: float
    drift_m_per_s: Floats | float
    drift_ratio: float
    step_s: float

    def initial(self, xy_m: Floats, noise_m: Floats | float) -> StateRows:
        """States of tracks that were measured once, at (2, K), with this noise, (K,) or one for all."""
        out = StateRows(np.zeros((4, xy_m.shape[1])), np.zeros((3, xy_m.shape[1])))
        out.mean[:2], out.cov[0], out.cov[2] = xy_m, noise_m**2, self.speed_m_per_s**2
        return out

    def predict(self, state: StateRows, elapsed_s: Floats | float, out: StateRows) -> None:
        """States after some time, (K,) or one for all, into ``out``, which may be ``state`` itself."""
        (x, y, vx, vy), (p, c, v), t = *state, elapsed_s
        power = (self.drift_m_per_s + self.drift_ratio * np.hypot(vx, vy)) ** 2
        mean, cov = out
        mean[0], mean[1], mean[2], mean[3] = x + vx * t, y + vy * t, vx, vy
        cov[0] = p + t * (2 * c + t * (v + t * power / 3))
        cov[1] = c + t * (v + t * power / 2)
        cov[2] = v + t * power


class StateRows(NamedTuple):
    """States with a row for each number: ``mean`` (4, K), ``cov`` (3, K). Long rows are quicker than short ones."""

    mean: Floats
    cov: Floats

    def take(self, which: Ints | slice) -> StateRows:
        """The states of some of the tracks; of a slice they are views."""
        return StateRows(self.mean[:, which], self.cov[:, which])


def update(state: StateRows, xy_m: Floats, noise_m: Floats | float) -> None:
    """Update states with measurements at (2, K) with noise, (K,) or one for all, in place."""
    mean, (p, c, v) = state
    s = p + noise_m * noise_m
    off = xy_m - mean[:2]
    of_place, of_velocity = p / s, c / s
    mean[:2] += of_place * off
    mean[2:] += of_velocity * off
    v -= of_velocity * c
    p *= 1 - of_place
    c *= 1 - of_place


class Tracks(NamedTuple):
    """Samples that are assigned to tracks, (C,) each: step, track, input id, sample, position (C, 2) in units, the
    descriptor of what is seen of it, or -1, and the online track.
    """

    step: Ints
    track: Ints
    source: Ints
    sample: Ints
    xy_m: Floats
    look: Ints
    online: Ints

    @property
    def order(self) -> Ints:
        """The order by track, then step."""
        return np.lexsort((self.step, self.track))


class Trajectories(NamedTuple):
    """Tracks laid end to end: one row for every step from a track's first to its last, also inside gaps.

    ``first`` (K + 1,) is the row where each track begins. ``step`` (N,); ``xy_m`` (N, 2), NaN inside gaps.
    """

    first: Ints
    step: Ints
    xy_m: Floats


def to_trajectories(step: Ints, track: Ints, xy_m: Floats) -> tuple[Ints, Ints, Trajectories]:
    """Assignments (C,) of positions to tracks, as trajectories.

    Returns the ids of the tracks (K,), the row of each assignment (C,), and the trajectories.
    """
    ids, which = np.unique(track, return_inverse=True)
    low, high = np.full(len(ids), np.iinfo(np.int64).max), np.full(len(ids), np.iinfo(np.int64).min)
    np.minimum.at(low, which, step)
    np.maximum.at(high, which, step)
    length = high - low + 1
    first = np.concatenate([[0], np.cumsum(length)])
    row = first[which] + step - low[which]
    places = np.full((int(first[-1]), 2), np.nan)
    places[row] = xy_m
    return ids, row, Trajectories(first, ragged_range(low, length), places)


class _Steps(NamedTuple):
    """The rows of trajectories (N,), step by step: the first row of each track, then the second of each, and so on.

    Longer tracks stand before shorter ones, so the tracks of each step are the first ones of those of the step before.

    Attributes
    ----------
    forward, backward : (N,) of int
        Rows of the trajectories, counted from the first row of each track, and from its last one.
    bounds : list of int
        The rows of step k are ``bounds[k]`` to ``bounds[k + 1]``.
    """

    forward: Ints
    backward: Ints
    bounds: list[int]

    @classmethod
    def of(cls, first: Ints) -> _Steps:
        """The steps of tracks that begin at these rows, (K + 1,)."""
        length = np.diff(first)
        order = np.argsort(-length, kind="stable")
        alive = np.searchsorted(-length[order], -np.arange(int(length.max(initial=0))), "left")
        step, place = group_index(alive), ragged_range(0, alive)
        forward = first[:-1][order][place] + step
        return cls(forward, first[1:][order][place] - 1 - step, [0, *np.cumsum(alive).tolist()])


def filtered(model: MotionModel, trajectories: Trajectories) -> tuple[State, State]:
    """The state of every row from past and present, and from present and future.

    The filters run over all tracks at once, forward and backward together.
    """
    steps = _Steps.of(trajectories.first)
    rows = np.stack([steps.forward, steps.backward], axis=-1).reshape(-1)
    noise_m = np.full(len(rows), model.noise_m)
    both = _filter(model, trajectories.xy_m.T.take(rows, axis=1), noise_m, [2 * bound for bound in steps.bounds])
    forward = _states(both.take(slice(0, None, 2)), steps.forward)
    backward = _states(both.take(slice(1, None, 2)), steps.backward)
    backward.mean[:, 2:] *= -1
    return forward, backward


def smooth(model: MotionModel, trajectories: Trajectories, noise_m: Floats | None = None) -> State:
    """The state of every row from past, present and future (RTS smoother). ``noise_m`` (N,) is the model's by default.

    Source: Rauch, Tung, Striebel 1965.
    """
    steps = _Steps.of(trajectories.first)
    noise_m = np.full(len(trajectories.step), model.noise_m) if noise_m is None else noise_m
    xy_m = trajectories.xy_m.T.take(steps.forward, axis=1)
    forward = _states(_filter(model, xy_m, noise_m[steps.forward], steps.bounds), steps.forward)
    rows = StateRows(*(np.ascontiguousarray(part[steps.backward].T) for part in forward))
    _smooth_back(model, rows, steps.bounds)
    return _states(rows, steps.backward)


# How noisy the positions of a log are, and how sharply each of its tracks turns.
#
# Where a smoother sees a track depends on the ratio of noise and drift alone. So the model's drift is kept: a track
# that turns more sharply is smoothed as if its positions had less noise, one that goes straight as if they had more.
# A filter at each of some levels says how likely the positions of each track are. Noise is the same for all tracks; it
# and the shares of levels are estimated together (expectation maximization: Dempster, Laird and Rubin 1977), so that a
# short track is smoothed as most are, a long one as it moves itself. Noise that lasts looks like turns, and is left.
#
# Letters: K tracks, G levels, N rows of trajectories.


#: The noise in m at each level; at the next one tracks turn four times as sharply.
_LEVELS_M: Final = 0.8 / 4.0 ** np.arange(6)
#: Tracks may begin at any speed.
_ANY_SPEED_M_PER_S: Final = 20.0
#: Steps over which speeds are measured, and the factor by which turns are doubted.
_SPEED_STEPS, _DOUBT = 3, 2.0
#: Rounds of expectation maximization; each level counts as if so many tracks had been of it.
_ROUNDS, _SEEN_BEFORE = 30, 0.5
#: As if so many positions had been without noise: a few that are off show a turn rather than noise.
_EXACT: Final = 30.0
#: The least variance of noise in m^2, and about how many rows of trajectories are filtered at once.
_LEAST_VARIANCE_M2, _ROWS_AT_ONCE = 1e-6, 2**15


class _Fits(NamedTuple):
    """The fit of filters at each level to tracks: the number of ``positions`` (K,) after the first one, sums (K, G) of
    squared misses in m^2 of noise, and sums (K, G) of the logarithms of the variances of misses, as multiples of
    noise's.
    """

    positions: Floats
    squares_m2: Floats
    log_spread: Floats


def smooth_in_log(model: MotionModel, trajectories: Trajectories, is_noise_known: bool, unit_m: float) -> Floats:
    """The position of every row (N, 2) from past, present and future, with the noise and the turns of the log.

    Noise is estimated if it isn't known. A track that seems to turn more sharply than one of the model would at the
    usual speed of the log is taken to turn half as sharply, because noise that lasts looks like turns. Positions are in
    units of ``unit_m`` metres.
    """
    fits = [_fits(model, trajectories, *span) for span in spans_of(trajectories.first, _ROWS_AT_ONCE)]
    level_m = np.exp(_of_levels(joined(fits), model.noise_m if is_noise_known else None) @ np.log(_LEVELS_M))
    faster = max(_usual_speed(trajectories, model.step_s) * unit_m / WALK_M_PER_S, 1.0)
    usual_m = model.noise_m / faster**2
    of_track = np.maximum(level_m, np.minimum(usual_m, _DOUBT * level_m))
    model = replace(model, speed_m_per_s=_ANY_SPEED_M_PER_S)
    return smooth(model, trajectories, np.repeat(of_track, np.diff(trajectories.first))).mean[:, :2]


def _usual_speed(trajectories: Trajectories, step_s: float) -> float:
    """The root mean square of speeds over some steps, in m/s; 0 if no track is seen as long."""
    off = trajectories.xy_m[_SPEED_STEPS:] - trajectories.xy_m[:-_SPEED_STEPS]
    track = group_index(np.diff(trajectories.first))
    square = (off**2).sum(axis=1)[track[_SPEED_STEPS:] == track[:-_SPEED_STEPS]]
    square = square[np.isfinite(square)]
    return float(np.sqrt(square.mean())) / (_SPEED_STEPS * step_s) if len(square) else 0.0


def _fits(model: MotionModel, trajectories: Trajectories, low: int, high: int) -> _Fits:
    """The fit of filters at each level to some of the tracks, K from ``low`` to ``high``."""
    first, levels = trajectories.first[low : high + 1], len(_LEVELS_M)
    steps = _Steps.of(first - first[0])
    model = replace(model, speed_m_per_s=_ANY_SPEED_M_PER_S)
    bounds = levels * np.array(steps.bounds)
    xy_m = trajectories.xy_m[first[0] : first[-1]].T.take(np.repeat(steps.forward, levels), axis=1)
    noise_m = np.tile(_LEVELS_M, len(steps.forward))
    expected = _filter(model, xy_m, noise_m, bounds.tolist())
    model.predict(expected, model.step_s, expected)
    size = np.diff(bounds)
    later = np.arange(bounds[1], bounds[-1])
    later = later[np.isfinite(xy_m[0, later])]
    before = later - np.repeat(size[:-1], size[1:])[later - bounds[1]]
    spread = expected.cov[0, before] / noise_m[later] ** 2 + 1
    squares_m2 = ((xy_m[:, later] - expected.mean[:2, before]) ** 2).sum(axis=0) / spread
    of = np.repeat(group_index(np.diff(first))[steps.forward] * levels, levels)[later] + later % levels
    sums = (
        np.bincount(of, weights, (high - low) * levels) for weights in (np.ones(len(of)), squares_m2, np.log(spread))
    )
    positions, *others = (np.asarray(of_cells.reshape(high - low, levels), np.float64) for of_cells in sums)
    return _Fits(positions[:, 0], *others)


def _of_levels(fits: _Fits, noise_m: float | None) -> Floats:
    """The probability that each track is of each level, (K, G)."""
    total = max(fits.positions.sum(), 1.0)
    alone_m2 = np.maximum(fits.squares_m2.sum(axis=0) / (2 * total), _LEAST_VARIANCE_M2)  # if all are of this level
    best = (total * np.log(alone_m2) + fits.log_spread.sum(axis=0)).argmin()
    variance_m2 = alone_m2[best] if noise_m is None else max(noise_m**2, _LEAST_VARIANCE_M2)
    share = np.ones(len(_LEVELS_M)) / len(_LEVELS_M)
    for _ in range(_ROUNDS):
        log_odds = np.log(share) - fits.squares_m2 / (2 * variance_m2) - fits.log_spread
        of_level = np.exp(log_odds - log_odds.max(axis=1, keepdims=True))
        of_level /= of_level.sum(axis=1, keepdims=True)
        share = of_level.sum(axis=0) + _SEEN_BEFORE
        share /= share.sum()
        if noise_m is None:
            variance_m2 = max((of_level * fits.squares_m2).sum() / (2 * (total + _EXACT)), _LEAST_VARIANCE_M2)
    return np.asarray(of_level)


def _states(rows: StateRows, place: Ints) -> State:
    """States (K,) in another order: that of ``rows[k]`` is at ``place[k]``."""
    out = State(*(np.empty((len(place), len(part))) for part in rows))
    for part, values in zip(out, rows, strict=True):
        part[place] = values.T
    return out


def _smooth_back(model: MotionModel, states: StateRows, bounds: Sequence[int]) -> None:
    """Smooth the states of forward filters (N,), in place. They are laid step by step, from the last one back."""
    ahead, step_s = StateRows(np.empty_like(states.mean), np.empty_like(states.cov)), model.step_s
    model.predict(states, step_s, ahead)
    p, c, v = states.cov
    # gain = P F' / P', per axis: two rows of two
    a, b = p + step_s * c, c
    d, e = c + step_s * v, v
    pp, pc, pv = ahead.cov
    det = pp * pv - pc**2
    gains = np.stack([a * pv - b * pc, b * pp - a * pc, d * pv - e * pc, e * pp - d * pc]) / det
    for later, low, high in zip(bounds, bounds[1:], bounds[2:], strict=False):
        now, then = slice(low, high), slice(later, later + high - low)
        mean, cov = states.take(now)
        g00, g01, g10, g11 = gains[:, now]
        off = states.mean[:, then] - ahead.mean[:, now]
        mean[:2] += g00 * off[:2] + g01 * off[2:]
        mean[2:] += g10 * off[:2] + g11 * off[2:]
        dp, dc, dv = states.cov[:, then] - ahead.cov[:, now]
        cov[0] += g00**2 * dp + 2 * g00 * g01 * dc + g01**2 * dv
        cov[1] += g00 * g10 * dp + (g00 * g11 + g01 * g10) * dc + g01 * g11 * dv
        cov[2] += g10**2 * dp + 2 * g10 * g11 * dc + g11**2 * dv


def _filter(model: MotionModel, xy_m: Floats, noise_m: Floats, bounds: Sequence[int]) -> StateRows:
    """The states (M,) of filters that read positions (2, M), NaN inside gaps, with noise (M,), step by step as
    ``bounds`` says.
    """
    count = xy_m.shape[1]
    out = StateRows(np.empty((4, count)), np.empty((3, count)))
    if not count:
        return out
    start = slice(bounds[0], bounds[1])
    for part, values in zip(out, model.initial(xy_m[:, start], noise_m[start]), strict=True):
        part[:, start] = values
    is_measured = np.isfinite(xy_m[0])
    is_whole = np.logical_and.reduceat(is_measured, bounds[:-1]).tolist()
    for before, low, high, whole in zip(bounds, bounds[1:], bounds[2:], is_whole[1:], strict=False):
        now, here = out.take(slice(low, high)), slice(low, high)
        model.predict(out.take(slice(before, before + high - low)), model.step_s, now)
        if whole:
            update(now, xy_m[:, here], noise_m[here])
            continue
        (which,) = is_measured[here].nonzero()
        some = now.take(which)
        update(some, xy_m[:, here][:, which], noise_m[here][which])
        now.mean[:, which], now.cov[:, which] = some
    return out
