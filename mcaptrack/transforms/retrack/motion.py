"""How people move: velocities that drift, positions seen with noise. Kalman filters for many at once.

Both axes have the same covariance, so that three numbers of it are enough for each track: of position, of position and
velocity, of velocity.

Letters: K tracks or pairs, N rows (a track has one a step, also inside its holes).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats, Ints

#: Noise of a seen position, per axis, where nothing is known of it.
USUAL_NOISE_M: Final = 0.2


class State(NamedTuple):
    """``mean`` (K, 4): x, y in m and their rates in m/s. ``cov`` (K, 3): of position, position x rate, rate."""

    mean: Floats
    cov: Floats

    def take(self, which: NDArray[np.bool_] | Ints | slice) -> State:
        """Some of them."""
        return State(self.mean[which], self.cov[which])


@dataclass(frozen=True)
class Walker:
    """Noise of a seen position, spread of velocities at first, and how fast velocity drifts: at rest, and with speed.

    ``drift`` and ``drift_share`` are the change of velocity in a second: m/s, and as a share of the speed.
    """

    noise_m: float
    speed_m_per_s: float
    drift: float
    drift_share: float

    def born(self, xy_m: Floats) -> State:
        """Seen once at (K, 2)."""
        mean = np.concatenate([xy_m, np.zeros_like(xy_m)], axis=1)
        return State(mean, np.tile([self.noise_m**2, 0.0, self.speed_m_per_s**2], (len(xy_m), 1)))

    def predict(self, state: State, elapsed_s: Floats | float) -> State:
        """Some time on, (K,) or one for all."""
        mean, (p, c, v) = state.mean, state.cov.T
        speed = np.hypot(mean[:, 2], mean[:, 3])
        drift = (self.drift + self.drift_share * speed) ** 2
        t = np.broadcast_to(elapsed_s, speed.shape)
        out = mean.copy()
        out[:, :2] += mean[:, 2:] * t[:, None]
        cov = np.empty_like(state.cov)
        cov[:, 0] = p + t * (2 * c + t * (v + t * drift / 3))
        cov[:, 1] = c + t * (v + t * drift / 2)
        cov[:, 2] = v + t * drift
        return State(out, cov)

    def update(self, state: State, xy_m: Floats, noise_m: Floats) -> State:
        """Seen at (K, 2) with noise (K,)."""
        mean, cov = state
        s = cov[:, 0] + noise_m**2
        off = xy_m - mean[:, :2]
        gain = cov[:, :2] / s[:, None]
        new = mean + np.concatenate([gain[:, :1] * off, gain[:, 1:] * off], axis=1)
        p = cov[:, 0] * (1 - gain[:, 0])
        c = cov[:, 1] * (1 - gain[:, 0])
        v = cov[:, 2] - gain[:, 1] * cov[:, 1]
        return State(new, np.stack([p, c, v], axis=1))


class Paths(NamedTuple):
    """Tracks laid end to end: a row for every step from a track's first to its last.

    ``first`` (K + 1,) is where each begins. ``step`` (N,); ``xy_m`` (N, 2) with NaN inside holes; ``noise_m`` (N,).
    """

    first: Ints
    step: Ints
    xy_m: Floats
    noise_m: Floats


def _by_length(first: Ints) -> tuple[Ints, Ints]:
    """Tracks from the longest to the shortest, and how many have a row k for each k."""
    length = np.diff(first)
    order = np.argsort(-length, kind="stable")
    longest = int(length.max(initial=0))
    alive = np.searchsorted(-length[order], -np.arange(longest), "left")
    return order, alive


def smooth(walker: Walker, paths: Paths, step_s: float) -> tuple[State, State, State]:
    """Every row's state from the past and present alone, from present and future alone, and from all (RTS).

    The filters run over all tracks at once. Source: Rauch, Tung, Striebel 1965.
    """
    forward = _filter(walker, paths, step_s)
    backward = _filter(walker, _turned(paths), step_s)
    backward = State(*(part[::-1] for part in backward))
    backward.mean[:, 2:] *= -1
    order, alive = _by_length(paths.first)
    mean, cov = forward.mean.copy(), forward.cov.copy()
    last = paths.first[1:][order] - 1
    for back in range(1, len(alive)):
        at = last[: alive[back]] - back
        now, later = forward.take(at), State(mean[at + 1], cov[at + 1])
        ahead = walker.predict(now, step_s)
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


def _turned(paths: Paths) -> Paths:
    total = paths.first[-1]
    return Paths((total - paths.first)[::-1], -paths.step[::-1], paths.xy_m[::-1], paths.noise_m[::-1])


def _filter(walker: Walker, paths: Paths, step_s: float) -> State:
    order, alive = _by_length(paths.first)
    start = paths.first[:-1][order]
    out = State(np.empty((len(paths.step), 4)), np.empty((len(paths.step), 3)))
    state = walker.born(paths.xy_m[start])
    state.cov[:, 0] = paths.noise_m[start] ** 2
    for row in range(len(alive)):
        at = start[: alive[row]] + row
        if row:
            state = walker.predict(state.take(slice(alive[row])), step_s)
            seen = np.isfinite(paths.xy_m[at, 0])
            new = walker.update(state.take(seen), paths.xy_m[at[seen]], paths.noise_m[at[seen]])
            state.mean[seen], state.cov[seen] = new
        out.mean[at], out.cov[at] = state
    return out
