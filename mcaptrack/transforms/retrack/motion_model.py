"""The motion of people: constant velocity with drift, measured with noise. Kalman filters for many tracks at once.

Both axes have the same covariance, so three numbers of it are enough for each track: the variance of the position, the
covariance of position and velocity, and the variance of the velocity.

Letters: K tracks or pairs, N rows of trajectories.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.ragged import group_index, ragged_range

#: Standard deviation of measured positions per axis in metres, until it is estimated.
DEFAULT_NOISE_M: Final = 0.2


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
    drift_m_per_s: float
    drift_ratio: float
    step_s: float

    def initial(self, xy_m: Floats, noise_m: float) -> StateRows:
        """States of tracks that were measured once, at (2, K), with this noise."""
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
        order, alive = _by_length(first)
        step, place = group_index(alive), ragged_range(0, alive)
        forward = first[:-1][order][place] + step
        return cls(forward, first[1:][order][place] - 1 - step, [0, *np.cumsum(alive).tolist()])


def filtered(model: MotionModel, trajectories: Trajectories, steps: _Steps | None = None) -> tuple[State, State]:
    """The state of every row from past and present, and from present and future.

    The filters run over all tracks at once, forward and backward together.
    """
    steps = steps or _Steps.of(trajectories.first)
    rows = np.stack([steps.forward, steps.backward], axis=-1).reshape(-1)
    both = _filter(model, trajectories.xy_m.T.take(rows, axis=1), [2 * bound for bound in steps.bounds])
    forward = _states(both.take(slice(0, None, 2)), steps.forward)
    backward = _states(both.take(slice(1, None, 2)), steps.backward)
    backward.mean[:, 2:] *= -1
    return forward, backward


def smooth(model: MotionModel, trajectories: Trajectories) -> tuple[State, State, State]:
    """The state of every row: from past and present, from present and future, and from all (RTS smoother).

    Source: Rauch, Tung, Striebel 1965.
    """
    steps = _Steps.of(trajectories.first)
    forward, backward = filtered(model, trajectories, steps)
    smoothed = StateRows(*(np.ascontiguousarray(part[steps.backward].T) for part in forward))
    _smooth_back(model, smoothed, steps.bounds)
    return forward, backward, _states(smoothed, steps.backward)


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


def _by_length(first: Ints) -> tuple[Ints, Ints]:
    """Tracks from the longest to the shortest, and for each k how many of them have a row k."""
    length = np.diff(first)
    order = np.argsort(-length, kind="stable")
    longest = int(length.max(initial=0))
    alive = np.searchsorted(-length[order], -np.arange(longest), "left")
    return order, alive


def _filter(model: MotionModel, xy_m: Floats, bounds: Sequence[int]) -> StateRows:
    """The states (M,) of filters that read positions (2, M), NaN inside gaps, step by step as ``bounds`` says."""
    count = xy_m.shape[1]
    out = StateRows(np.empty((4, count)), np.empty((3, count)))
    if not count:
        return out
    start = slice(bounds[0], bounds[1])
    for part, values in zip(out, model.initial(xy_m[:, start], model.noise_m), strict=True):
        part[:, start] = values
    out.cov[0, start] = model.noise_m * model.noise_m
    is_measured = np.isfinite(xy_m[0])
    is_whole = np.logical_and.reduceat(is_measured, bounds[:-1]).tolist()
    for before, low, high, whole in zip(bounds, bounds[1:], bounds[2:], is_whole[1:], strict=False):
        now, here = out.take(slice(low, high)), slice(low, high)
        model.predict(out.take(slice(before, before + high - low)), model.step_s, now)
        if whole:
            update(now, xy_m[:, here], model.noise_m)
            continue
        (which,) = is_measured[here].nonzero()
        some = now.take(which)
        update(some, xy_m[:, here][:, which], model.noise_m)
        now.mean[:, which], now.cov[:, which] = some
    return out
