"""The motion of people: constant velocity with drift, measured with noise. Kalman filters for many tracks at once.

Both axes have the same covariance, so three numbers of it are enough for each track: the variance of the position, the
covariance of position and velocity, and the variance of the velocity.

Letters: K tracks or pairs, N rows of trajectories.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.ragged import ragged_range

#: Standard deviation of measured positions per axis, before any is estimated.
DEFAULT_NOISE_M: Final = 0.2


class State(NamedTuple):
    """``mean`` (K, 4): x, y in m, vx, vy in m/s. ``cov`` (K, 3): of position, position x velocity, velocity."""

    mean: Floats
    cov: Floats

    def take(self, which: Bools | Ints | slice) -> State:
        """The states of some of the tracks."""
        return State(self.mean[which], self.cov[which])


@dataclass(frozen=True)
class MotionModel:
    """Constant velocity with white acceleration noise.

    ``noise_m`` is the standard deviation of a measured position, ``speed_m_per_s`` that of the velocity of a new track
    (both per axis). ``drift_m_per_s`` is how much velocities change within a second at rest, in m/s, and
    ``drift_ratio`` how much more with speed, as a share of it.
    """

    noise_m: float
    speed_m_per_s: float
    drift_m_per_s: float
    drift_ratio: float

    def initial(self, xy_m: Floats) -> State:
        """States of tracks that were measured once, at (K, 2)."""
        mean = np.concatenate([xy_m, np.zeros_like(xy_m)], axis=1)
        return State(mean, np.tile([self.noise_m**2, 0.0, self.speed_m_per_s**2], (len(xy_m), 1)))

    def predict(self, state: State, elapsed_s: Floats | float) -> State:
        """States after some time, (K,) or one for all."""
        mean, (p, c, v) = state.mean, state.cov.T
        speed = np.hypot(mean[:, 2], mean[:, 3])
        power = (self.drift_m_per_s + self.drift_ratio * speed) ** 2
        t = np.broadcast_to(elapsed_s, speed.shape)
        out = mean.copy()
        out[:, :2] += mean[:, 2:] * t[:, None]
        cov = np.empty_like(state.cov)
        cov[:, 0] = p + t * (2 * c + t * (v + t * power / 3))
        cov[:, 1] = c + t * (v + t * power / 2)
        cov[:, 2] = v + t * power
        return State(out, cov)

    def update(self, state: State, xy_m: Floats, noise_m: Floats) -> State:
        """States after measurements at (K, 2) with noise (K,)."""
        mean, cov = state
        s = cov[:, 0] + noise_m**2
        innovation = xy_m - mean[:, :2]
        gain = cov[:, :2] / s[:, None]
        new = mean + np.concatenate([gain[:, :1] * innovation, gain[:, 1:] * innovation], axis=1)
        p = cov[:, 0] * (1 - gain[:, 0])
        c = cov[:, 1] * (1 - gain[:, 0])
        v = cov[:, 2] - gain[:, 1] * cov[:, 1]
        return State(new, np.stack([p, c, v], axis=1))


class Trajectories(NamedTuple):
    """Tracks laid end to end: one row for every step from a track's first to its last, also inside gaps.

    ``first`` (K + 1,) is the row where each track begins. ``step`` (N,); ``xy_m`` (N, 2), NaN inside gaps;
    ``noise_m`` (N,).
    """

    first: Ints
    step: Ints
    xy_m: Floats
    noise_m: Floats


def to_trajectories(step: Ints, track: Ints, xy_m: Floats, noise_m: float) -> tuple[Ints, Ints, Trajectories]:
    """Assignments (C,) of positions to tracks, as trajectories.

    Returns the ids of the tracks (K,), the row of each assignment (C,), and the trajectories.
    """
    ids, which = np.unique(track, return_inverse=True)
    low, high = np.full(len(ids), np.iinfo(np.int64).max), np.full(len(ids), np.iinfo(np.int64).min)
    np.minimum.at(low, which, step)
    np.maximum.at(high, which, step)
    length = high - low + 1
    first = np.concatenate([[0], np.cumsum(length)])
    total = int(first[-1])
    row = first[which] + step - low[which]
    places = np.full((total, 2), np.nan)
    places[row] = xy_m
    return ids, row, Trajectories(first, ragged_range(low, length), places, np.full(total, noise_m))


def smooth(model: MotionModel, trajectories: Trajectories, step_s: float) -> tuple[State, State, State]:
    """The state of every row: from past and present, from present and future, and from all (RTS smoother).

    The filters run over all tracks at once. Source: Rauch, Tung, Striebel 1965.
    """
    forward = _filter(model, trajectories, step_s)
    backward = _filter(model, _reversed(trajectories), step_s)
    backward = State(*(part[::-1] for part in backward))
    backward.mean[:, 2:] *= -1
    order, alive = _by_length(trajectories.first)
    mean, cov = forward.mean.copy(), forward.cov.copy()
    last = trajectories.first[1:][order] - 1
    for back in range(1, len(alive)):
        at = last[: alive[back]] - back
        now, later = forward.take(at), State(mean[at + 1], cov[at + 1])
        ahead = model.predict(now, step_s)
        p, c, v = now.cov.T
        # gain = P F' / P', per axis: two rows of two
        a, b = p + step_s * c, c
        d, e = c + step_s * v, v
        pp, pc, pv = ahead.cov.T
        det = pp * pv - pc**2
        g00, g01 = (a * pv - b * pc) / det, (b * pp - a * pc) / det
        g10, g11 = (d * pv - e * pc) / det, (e * pp - d * pc) / det
        off = later.mean - ahead.mean
        mean[at, :2] += g00[:, None] * off[:, :2] + g01[:, None] * off[:, 2:]
        mean[at, 2:] += g10[:, None] * off[:, :2] + g11[:, None] * off[:, 2:]
        dp, dc, dv = (later.cov - ahead.cov).T
        cov[at, 0] += g00**2 * dp + 2 * g00 * g01 * dc + g01**2 * dv
        cov[at, 1] += g00 * g10 * dp + (g00 * g11 + g01 * g10) * dc + g01 * g11 * dv
        cov[at, 2] += g10**2 * dp + 2 * g10 * g11 * dc + g11**2 * dv
    return forward, backward, State(mean, cov)


def _by_length(first: Ints) -> tuple[Ints, Ints]:
    """Tracks from the longest to the shortest, and for each k how many of them have a row k."""
    length = np.diff(first)
    order = np.argsort(-length, kind="stable")
    longest = int(length.max(initial=0))
    alive = np.searchsorted(-length[order], -np.arange(longest), "left")
    return order, alive


def _reversed(trajectories: Trajectories) -> Trajectories:
    """The same trajectories in reversed time."""
    total = trajectories.first[-1]
    return Trajectories(
        (total - trajectories.first)[::-1],
        -trajectories.step[::-1],
        trajectories.xy_m[::-1],
        trajectories.noise_m[::-1],
    )


def _filter(model: MotionModel, trajectories: Trajectories, step_s: float) -> State:
    """The state of every row from past and present."""
    order, alive = _by_length(trajectories.first)
    start = trajectories.first[:-1][order]
    out = State(np.empty((len(trajectories.step), 4)), np.empty((len(trajectories.step), 3)))
    state = model.initial(trajectories.xy_m[start])
    state.cov[:, 0] = trajectories.noise_m[start] ** 2
    for row in range(len(alive)):
        at = start[: alive[row]] + row
        if row:
            state = model.predict(state.take(slice(alive[row])), step_s)
            measured = np.isfinite(trajectories.xy_m[at, 0])
            new = model.update(
                state.take(measured), trajectories.xy_m[at[measured]], trajectories.noise_m[at[measured]]
            )
            state.mean[measured], state.cov[measured] = new
        out.mean[at], out.cov[at] = state
    return out
