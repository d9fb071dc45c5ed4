"""The active tracks of re-tracking, as arrays along the track; and their past, smoothed.

Letters: K tracks, N observations, L past positions that the predictor looks at.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.histories import Holt, rebuild_positions
from mcaptrack.predictors import Forecast


@dataclass
class Motion:
    """What smoothing remembers of K tracks: O(1) for each, whatever its age.

    ``last_m`` (K, 2) is the last observed position. ``level``, ``trend`` (K, 2) are Holt's, ``smooth`` (K, L - 1, 2)
    the last smoothed displacements, of which the last ``known`` (K,) exist.
    """

    last_m: Floats
    level: Floats
    trend: Floats
    smooth: Floats
    known: Ints

    @classmethod
    def along(cls, holt: Holt, past_m: Floats, valid: Bools) -> Motion:
        """The motion of N observations along their own past (N, L, 2), of which a run up to now is ``valid`` (N, L)."""
        count, length = valid.shape
        motion = cls(
            past_m[:, -1],
            np.zeros((count, 2)),
            np.zeros((count, 2)),
            np.zeros((count, length - 1, 2)),
            np.zeros(count, int),
        )
        for step in range(1, length):
            usable = valid[:, step] & valid[:, step - 1]
            motion._smooth(holt, usable, past_m[:, step] - past_m[:, step - 1])
        return motion

    def see(self, holt: Holt, xy_m: Floats, steps: Ints) -> None:
        """The K tracks are seen at ``xy_m`` (K, 2), ``steps`` (K,) after the last time; a hole is filled linearly."""
        displacement = (xy_m - self.last_m) / steps[:, None]
        for done in range(int(steps.max(initial=0))):
            self._smooth(holt, steps > done, displacement)
        self.last_m = xy_m

    def _smooth(self, holt: Holt, which: Bools, displacement: Floats) -> None:
        started = (self.known > 0)[:, None]
        first, flat = holt.start(displacement)
        level, trend = holt.step(self.level, self.trend, displacement)
        self.level = np.where(which[:, None], np.where(started, level, first), self.level)
        self.trend = np.where(which[:, None], np.where(started, trend, flat), self.trend)
        shifted = np.concatenate([self.smooth[:, 1:], self.level[:, None]], axis=1)
        self.smooth = np.where(which[:, None, None], shifted, self.smooth)
        self.known = np.where(which, np.minimum(self.known + 1, self.smooth.shape[1]), self.known)

    def past(self) -> tuple[Floats, Bools]:
        """The past (K, L, 2), rebuilt from smoothed displacements back from now, and what of it is known (K, L)."""
        length = self.smooth.shape[1] + 1
        valid = np.arange(length) >= length - 1 - self.known[:, None]
        return rebuild_positions(self.last_m, self.smooth), valid


@dataclass
class Tracks:
    """K active tracks: when each was last seen, how often in a row (``hits``), and as whom (``source``, input id)."""

    ids: Ints
    seen_step: Ints
    hits: Ints
    source: Ints
    motion: Motion
    forecast: Forecast

    @classmethod
    def none(cls, length: int, horizon: int) -> Tracks:
        """No tracks yet."""
        nothing = np.empty(0, np.int64)
        flat = np.empty((0, 2))
        motion = Motion(flat, flat, flat, np.empty((0, length - 1, 2)), nothing)
        forecast = Forecast(np.empty((0, horizon, 2)), np.empty((0, horizon, 2, 2)))
        return cls(nothing, nothing, nothing, nothing, motion, forecast)

    def __getitem__(self, which: Ints | Bools) -> Tracks:
        motion = Motion(*(getattr(self.motion, field.name)[which] for field in fields(Motion)))
        forecast = Forecast(self.forecast.mean[which], self.forecast.cov[which])
        return Tracks(self.ids[which], self.seen_step[which], self.hits[which], self.source[which], motion, forecast)

    def __add__(self, other: Tracks) -> Tracks:
        motion = Motion(
            *(np.concatenate([getattr(self.motion, f.name), getattr(other.motion, f.name)]) for f in fields(Motion))
        )
        forecast = Forecast(*(np.concatenate(pair) for pair in zip(self.forecast, other.forecast, strict=True)))
        return Tracks(
            np.concatenate([self.ids, other.ids]),
            np.concatenate([self.seen_step, other.seen_step]),
            np.concatenate([self.hits, other.hits]),
            np.concatenate([self.source, other.source]),
            motion,
            forecast,
        )
