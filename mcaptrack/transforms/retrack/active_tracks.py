"""The active tracks of Algorithm 1 as arrays, one element per track, and their smoothed histories.

Letters: K tracks, N observations, L past positions that the predictor looks at.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.histories import Holt, rebuild_positions
from mcaptrack.predictors import Forecast


@dataclass
class SmoothedHistory:
    """The smoothed histories of K tracks, of constant size whatever their age.

    ``last_m`` (K, 2) is the last observed position. ``level`` and ``trend`` (K, 2) are those of Holt's smoothing,
    ``displacements`` (K, L - 1, 2) the last smoothed displacements, of which the last ``known`` (K,) exist.
    """

    last_m: Floats
    level: Floats
    trend: Floats
    displacements: Floats
    known: Ints

    @classmethod
    def of_observations(cls, holt: Holt, past_m: Floats, valid: Bools) -> SmoothedHistory:
        """The smoothed histories of N observations: their pasts (N, L, 2) are ``valid`` (N, L) in a run up to now."""
        count, length = valid.shape
        history = cls(
            past_m[:, -1],
            np.zeros((count, 2)),
            np.zeros((count, 2)),
            np.zeros((count, length - 1, 2)),
            np.zeros(count, int),
        )
        for step in range(1, length):
            usable = valid[:, step] & valid[:, step - 1]
            history._smooth(holt, usable, past_m[:, step] - past_m[:, step - 1])
        return history

    def append(self, holt: Holt, xy_m: Floats, steps: Ints) -> None:
        """Append observations at ``xy_m`` (K, 2), ``steps`` (K,) after the last ones; interpolate gaps linearly."""
        displacement = (xy_m - self.last_m) / steps[:, None]
        for done in range(int(steps.max(initial=0))):
            self._smooth(holt, steps > done, displacement)
        self.last_m = xy_m

    def _smooth(self, holt: Holt, which: Bools, displacement: Floats) -> None:
        """Eq. 3 of the paper: smooth one more displacement (K, 2) of some tracks (K,)."""
        started = (self.known > 0)[:, None]
        first, flat = holt.start(displacement)
        level, trend = holt.step(self.level, self.trend, displacement)
        self.level = np.where(which[:, None], np.where(started, level, first), self.level)
        self.trend = np.where(which[:, None], np.where(started, trend, flat), self.trend)
        shifted = np.concatenate([self.displacements[:, 1:], self.level[:, None]], axis=1)
        self.displacements = np.where(which[:, None, None], shifted, self.displacements)
        self.known = np.where(which, np.minimum(self.known + 1, self.displacements.shape[1]), self.known)

    def positions(self) -> tuple[Floats, Bools]:
        """Past positions (K, L, 2), rebuilt from the smoothed displacements, and which of them are known (K, L)."""
        length = self.displacements.shape[1] + 1
        valid = np.arange(length) >= length - 1 - self.known[:, None]
        return rebuild_positions(self.last_m, self.displacements), valid


@dataclass
class ActiveTracks:
    """K active tracks: step of the last match, number of matches in a row (``hits``), input id of the last one.

    ``prediction`` is that made at the last match.
    """

    ids: Ints
    last_step: Ints
    hits: Ints
    source: Ints
    history: SmoothedHistory
    prediction: Forecast

    @classmethod
    def none(cls, length: int, horizon: int) -> ActiveTracks:
        """No tracks."""
        nothing = np.empty(0, np.int64)
        flat = np.empty((0, 2))
        history = SmoothedHistory(flat, flat, flat, np.empty((0, length - 1, 2)), nothing)
        prediction = Forecast(np.empty((0, horizon, 2)), np.empty((0, horizon, 2, 2)))
        return cls(nothing, nothing, nothing, nothing, history, prediction)

    def __getitem__(self, which: Ints | Bools) -> ActiveTracks:
        history = SmoothedHistory(*(getattr(self.history, field.name)[which] for field in fields(SmoothedHistory)))
        prediction = Forecast(self.prediction.mean[which], self.prediction.cov[which])
        return ActiveTracks(
            self.ids[which], self.last_step[which], self.hits[which], self.source[which], history, prediction
        )

    def __add__(self, other: ActiveTracks) -> ActiveTracks:
        names = [field.name for field in fields(SmoothedHistory)]
        history = SmoothedHistory(
            *(np.concatenate([getattr(self.history, name), getattr(other.history, name)]) for name in names)
        )
        prediction = Forecast(*(np.concatenate(pair) for pair in zip(self.prediction, other.prediction, strict=True)))
        return ActiveTracks(
            np.concatenate([self.ids, other.ids]),
            np.concatenate([self.last_step, other.last_step]),
            np.concatenate([self.hits, other.hits]),
            np.concatenate([self.source, other.source]),
            history,
            prediction,
        )
