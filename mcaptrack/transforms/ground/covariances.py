"""The filter of the ground tracker for detections that have covariances, such as those of several cameras.

The noise of such a detection differs along the axes and from one to the next, so each track has a covariance of its own
over both axes: of position, velocity and acceleration along the first axis, then of those along the second one. The
motion is that of ``state``.

Letters: K tracks, N detections.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats, Indices

#: Rows of a covariance that are positions, velocities and accelerations, one of each axis.
_PLACE, _VELOCITY, _ACCELERATION = [0, 3], [1, 4], [2, 5]
_SIZE: Final = 6


class Covariances:
    """The covariances of tracks, ``values`` (K, 6, 6)."""

    def __init__(self, along_one_axis: Floats) -> None:
        """Begin with the same covariance (6, K) along both axes: pp, pv, pa, vv, va, aa."""
        self.values: Floats = _of_axes(along_one_axis)

    def add(self, along_one_axis: Floats, noise: Floats) -> None:
        """Add tracks, as in the constructor, but with these covariances (N, 3) of their positions."""
        new = _of_axes(along_one_axis)
        new[:, _PLACE[0], _PLACE[0]], new[:, _PLACE[1], _PLACE[1]] = noise[:, 0], noise[:, 2]
        new[:, _PLACE[0], _PLACE[1]] = new[:, _PLACE[1], _PLACE[0]] = noise[:, 1]
        self.values = np.concatenate([self.values, new])

    def places(self) -> Floats:
        """The covariances of positions, (3, K): xx, xy, yy."""
        p = self.values
        return np.stack([p[:, 0, 0], p[:, 0, 3], p[:, 3, 3]])

    def widen(self, track: Indices, more: Floats, passed_s: Floats) -> None:
        """Add ``more`` (N,) to the variance that the velocities of tracks (N,) had ``passed_s`` seconds (N,) ago."""
        for place, velocity in zip(_PLACE, _VELOCITY, strict=True):
            self.values[track, place, place] += more * passed_s**2
            self.values[track, place, velocity] += more * passed_s
            self.values[track, velocity, place] += more * passed_s
            self.values[track, velocity, velocity] += more

    def predict(self, transition: Floats, drift: Floats) -> None:
        """Predict with the transition (3, 3) of one axis and what is added for each track, (K, 3, 3), to each axis."""
        both = np.zeros((_SIZE, _SIZE))
        both[:3, :3] = both[3:, 3:] = transition
        self.values = both @ self.values @ both.T
        self.values[:, :3, :3] += drift
        self.values[:, 3:, 3:] += drift

    def correct(self, track: Indices, noise: Floats) -> Floats:
        """Correct tracks (N,) with a detection each, with these covariances (N, 3); returns the gains (N, 6, 2)."""
        p = self.values[track]
        cross = p[:, :, _PLACE]
        xx, xy, yy = p[:, 0, 0] + noise[:, 0], p[:, 0, 3] + noise[:, 1], p[:, 3, 3] + noise[:, 2]
        inverse = np.stack([yy, -xy, -xy, xx], axis=-1).reshape(-1, 2, 2) / (xx * yy - xy * xy)[:, None, None]
        gain: Floats = cross @ inverse
        p = p - gain @ np.swapaxes(cross, 1, 2)
        self.values[track] = (p + np.swapaxes(p, 1, 2)) / 2
        return gain

    def means(self) -> Floats:
        """The means over both axes, (6, K), as in the constructor."""
        p = self.values
        one = (p[:, :3, :3] + p[:, 3:, 3:]) / 2
        return np.stack([one[:, i, j] for i in range(3) for j in range(i, 3)])


def _of_axes(along_one_axis: Floats) -> Floats:
    """Covariances (K, 6, 6) of independent axes with the same covariance (6, K)."""
    count = along_one_axis.shape[1]
    one = np.empty((count, 3, 3))
    upper = [(i, j) for i in range(3) for j in range(i, 3)]
    for (i, j), values in zip(upper, along_one_axis, strict=True):
        one[:, i, j] = one[:, j, i] = values
    out = np.zeros((count, _SIZE, _SIZE))
    out[:, :3, :3] = out[:, 3:, 3:] = one
    return out


def along_axes(gain: Floats, off: Floats) -> tuple[Floats, Floats, Floats]:
    """Corrections of positions, velocities and accelerations, (2, N) each: gains (N, 6, 2) times innovations (2, N)."""
    by = np.einsum("nij,jn->in", gain, off)
    return by[_PLACE], by[_VELOCITY], by[_ACCELERATION]
