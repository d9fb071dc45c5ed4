"""Windows of tracks: past positions and the true future. Cut from trajectories; augmented with errors of trackers.

Letters: N windows, L past positions (the last one is now), T future steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints

#: Autocorrelation of the noise of a tracker from one step to the next.
_NOISE_MEMORY: Final = 0.5


@dataclass(frozen=True)
class Windows:
    """``past`` (N, L, 2) in m, of which ``known`` (N, L) are known, ``future`` (N, T, 2) in m, ``scene`` (N,)."""

    past: Floats
    known: Bools
    future: Floats
    scene: Ints

    def __len__(self) -> int:
        return len(self.past)

    def __getitem__(self, at: Ints | Bools) -> Windows:
        return Windows(self.past[at], self.known[at], self.future[at], self.scene[at])

    @classmethod
    def of(cls, paths: Floats, past: int, scene: Ints | None = None) -> Windows:
        """Complete trajectories (N, L + T, 2)."""
        is_known = np.ones((len(paths), past), bool)
        return cls(
            paths[:, :past], is_known, paths[:, past:], np.zeros(len(paths), np.int64) if scene is None else scene
        )

    @classmethod
    def cut(cls, xy_m: Floats, past: int, steps: int, least: int, stride: int = 1, scene: int = 0) -> Windows:
        """All windows in the trajectories (I, S, 2) of a scene, NaN where not observed, every ``stride`` steps.

        The current position and the ``steps`` after it have to be known, and at least ``least`` past positions.
        """
        tracks, length = xy_m.shape[:2]
        padded = np.concatenate([np.full((tracks, past - 1, 2), np.nan), xy_m], axis=1)
        if tracks == 0 or length < steps + 1:
            return cls.of(np.empty((0, past + steps, 2)), past)
        windows = np.lib.stride_tricks.sliding_window_view(padded, past + steps, axis=1).transpose(0, 1, 3, 2)
        is_valid = np.isfinite(windows[..., 0])
        complete = is_valid[:, :, past - 1 :].all(axis=2) & (is_valid[:, :, :past].sum(axis=2) >= least)
        rank = np.cumsum(complete, axis=1) - 1  # among the windows of each track
        track, start = np.nonzero(complete & (rank % stride == 0))
        paths, is_known = windows[track, start], is_valid[track, start, :past]
        return cls(paths[:, :past], is_known, paths[:, past:], np.full(len(paths), scene))

    @classmethod
    def join(cls, parts: list[Windows]) -> Windows:
        """Windows of several scenes as one set."""
        return cls(
            *(np.concatenate([getattr(part, name) for part in parts]) for name in ("past", "known", "future", "scene"))
        )

    def last(self, count: int) -> Windows:
        """The windows with only the last ``count`` past positions."""
        return Windows(self.past[:, -count:], self.known[:, -count:], self.future, self.scene)


@dataclass(frozen=True, kw_only=True)
class Corruption:
    """Random augmentation of windows, drawn again in every epoch.

    Attributes
    ----------
    noise_m : float
        Largest standard deviation of position noise per axis; that of a window is drawn below it, small values more
        often, and the noise is correlated from step to step.
    noisy : float
        Share of windows with noise.
    gaps : float
        Share of past positions to remove, in half of the windows.
    least : int or None
        Shortest past; None keeps all.
    scale : float
        Largest scaling, as a natural logarithm.
    turn, mirror : bool
        Whether to rotate and to mirror windows at random.
    """

    noise_m: float = 0.0
    noisy: float = 0.95
    gaps: float = 0.0
    least: int | None = None
    scale: float = 0.0
    turn: bool = True
    mirror: bool = True

    def __call__(self, windows: Windows, rng: np.random.Generator) -> Windows:
        """Augmented windows, relative to the current position."""
        count, length = windows.known.shape
        now = windows.past[:, -1:]
        past, future = windows.past - now, windows.future - now
        matrix: Floats = np.tile(np.eye(2), (count, 1, 1))
        if self.turn:
            angle = rng.uniform(0, 2 * np.pi, count)
            turned = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], axis=-1)
            matrix = turned.reshape(-1, 2, 2)
        if self.mirror:
            flips = np.stack([np.ones(count), rng.choice([-1.0, 1.0], count)], axis=-1)
            matrix = matrix * flips[:, None]
        if self.scale:
            matrix = matrix * np.exp(rng.uniform(-self.scale, self.scale, count))[:, None, None]
        past, future = past @ matrix.transpose(0, 2, 1), future @ matrix.transpose(0, 2, 1)
        if self.noise_m:
            spread = self.noise_m * rng.random((count, 1, 1)) ** 2 * (rng.random((count, 1, 1)) < self.noisy)
            past = past + spread * ar1(rng, count, length)
        is_known = windows.known.copy()
        if self.gaps:
            is_known &= rng.random((count, length)) >= self.gaps * (rng.random((count, 1)) < 0.5)
        if self.least is not None:
            keep = rng.integers(self.least, length + 1, count)
            is_known &= np.arange(length) >= (length - keep)[:, None]
        is_known[:, -1] = True
        return Windows(past, is_known, future, windows.scene)


def ar1(rng: np.random.Generator, count: int, length: int, memory: float = _NOISE_MEMORY) -> Floats:
    """Noise (N, L, 2) of standard deviation 1 with autocorrelation ``memory`` from step to step (AR(1))."""
    fresh = rng.normal(size=(count, length, 2))
    out = np.empty_like(fresh)
    out[:, 0] = fresh[:, 0]
    for step in range(1, length):
        out[:, step] = memory * out[:, step - 1] + np.sqrt(1 - memory**2) * fresh[:, step]
    return out
