"""Predictions of online tracks, made for many tracks at once and calibrated step by step.

Letters: R rows of online tracks, L past positions.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.predictors import Forecast, PeopleSeen, Predictor, predict_among, uses_people
from mcaptrack.predictors.tail_calibration import TailCalibration
from mcaptrack.schema import PREDICTIONS
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns
from mcaptrack.schema.predictions import forecast_to_rows

#: Predictions that are made at once: more take memory, fewer take time.
_BATCH: Final = 4096


class Unpredicted(NamedTuple):
    """Tracks without predictions yet: ids, past positions (R, L, 2), which are known, whether tracks coast, steps."""

    ids: Ints
    past: Floats
    known: Bools
    coasts: Bools
    step: Ints

    def part(self, which: slice | Ints) -> Unpredicted:
        ids, past, known, coasts, step = self
        return Unpredicted(ids[which], past[which], known[which], coasts[which], step[which])


class _Made(NamedTuple):
    """Predictions as the predictor made them: ids, past positions, whether tracks coast, means and covariances."""

    ids: Ints
    past: Floats
    coasts: Bools
    mean: Floats
    cov: Floats

    def part(self, which: slice) -> _Made:
        return _Made(self.ids[which], self.past[which], self.coasts[which], self.mean[which], self.cov[which])

    def copied(self) -> _Made:
        return _Made(self.ids.copy(), self.past.copy(), self.coasts.copy(), self.mean.copy(), self.cov.copy())


class OnlineForecasts:
    """Predictions of tracks, frame by frame, made for ``_BATCH`` tracks at once."""

    def __init__(self, name: str, predictor: Predictor, unit_m: float, adapt: bool) -> None:
        self._name, self._predictor, self._unit_m = name, predictor, unit_m
        self._calibration = TailCalibration.of(name, predictor, adapt)
        self._out = FrameCollector(PREDICTIONS)
        self._waiting: list[Unpredicted] = []
        nothing = np.empty((0, predictor.steps, 2, 2))
        ids, past, coasts = np.empty(0, np.int64), np.empty((0, predictor.past, 2)), np.empty(0, bool)
        self._left = _Made(ids, past, coasts, nothing[..., 0], nothing)  # of a frame that is not complete
        self._frames: list[tuple[int, int, int, int]] = []  # time, number, step and tracks of frames in neither

    def add(self, t_ns: Ints, numbers: Ints, steps: Ints, ends: Ints, tracks: Unpredicted) -> None:
        """Add the tracks of frames, ``ends[f]`` to ``ends[f + 1]`` of frame f, with their past positions."""
        self._frames += zip(t_ns.tolist(), numbers.tolist(), steps.tolist(), np.diff(ends).tolist(), strict=True)
        self._waiting.append(tracks)
        self._predict(_BATCH)

    def done(self) -> FrameColumns:
        """The predictions; nothing can be added any more."""
        self._predict(1)
        if self._calibration is not None:
            self._calibration.warn(self._name)
        return self._out.done()

    def _predict(self, least: int) -> None:
        """Predict in batches, as long as at least so many tracks wait, and write the frames that are complete."""
        waiting = Unpredicted(*(np.concatenate(parts) for parts in zip(*self._waiting, strict=True)))
        done = 0
        while len(waiting.ids) - done >= least:
            end = done + _BATCH
            if uses_people(self._predictor):  # whole steps, because their tracks are predicted together
                end = int(np.searchsorted(waiting.step, waiting.step[min(end, len(waiting.ids)) - 1], "right"))
            ids, past, known, coasts, steps = waiting.part(slice(done, end))
            units = past / self._unit_m
            people = PeopleSeen(units, known, steps, np.arange(len(ids)))
            mean, cov = predict_among(self._predictor, units, known, people)
            self._write(_Made(ids, past, coasts, mean * self._unit_m, cov * self._unit_m**2))
            done += len(ids)
        self._waiting = [waiting.part(slice(done, None))]
        self._write(self._left.part(slice(0)))  # frames without tracks

    def _write(self, new: _Made) -> None:
        """Write the frames that are complete with these predictions."""
        made = (
            new if new is self._left else _Made(*(np.concatenate(both) for both in zip(self._left, new, strict=True)))
        )
        ends = np.cumsum([0, *(count for *_, count in self._frames)])
        count = int(np.searchsorted(ends, len(made.ids), "right")) - 1
        self._left = made.part(slice(ends[count], None)).copied()  # so that the larger arrays are not held
        if not count:
            return
        ids, past, coasts, mean, cov = made.part(slice(ends[count]))
        tails = None
        if self._calibration is not None:  # by the predictions of the steps before
            step = np.repeat([step for _, _, step, _ in self._frames[:count]], np.diff(ends[: count + 1]))
            (_, cov), tails = self._calibration(step, ids, Forecast(mean, cov), past, coasts)
        rows = forecast_to_rows(ids, Forecast(mean, cov), self._predictor.step_s, tails)
        t_ns, numbers, *_ = zip(*self._frames[:count], strict=True)
        self._out.extend(t_ns, numbers, ends[: count + 1] * self._predictor.steps, rows)
        self._frames = self._frames[count:]
