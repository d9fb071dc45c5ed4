"""Re-tracking by likelihood over one log: online tracks and their predictions, each from the past alone.

Letters: R rows of online tracks, L past positions.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.ragged import group_index
from mcaptrack.predictors import Forecast, Predictor, make
from mcaptrack.schema import PREDICTIONS, Frame, Rows
from mcaptrack.schema.predictions import forecast_to_rows
from mcaptrack.transforms.retrack.assignments import Assignments
from mcaptrack.transforms.retrack.by_class import PEOPLE, Movers
from mcaptrack.transforms.retrack.motion_model import DEFAULT_NOISE_M, MotionModel
from mcaptrack.transforms.retrack.offline import move_rows
from mcaptrack.transforms.retrack.online_tracker import Association, OnlineTracker, Step
from mcaptrack.transforms.retrack.options import LikelihoodOptions, RetrackOptions

#: Predictions that are made at once: more take memory, fewer take time.
_BATCH: Final = 4096
#: The least noise (m) and speed (m/s): a covariance of 0 can't be inverted.
_MIN_SPREAD: Final = 1e-3


class LikelihoodPass:
    """Online tracking over one log: ``step`` for each frame, then ``outputs``."""

    def __init__(self, options: LikelihoodOptions, movers: Movers = PEOPLE) -> None:
        rate, self._options, self._unit_m = options.rate_hz, options, movers.unit_m
        self._confirm_hits = round(options.confirm_s * rate) + 1
        max_age = max(1, round(options.max_age_s * rate))
        noise = DEFAULT_NOISE_M if options.noise_m is None else options.noise_m / movers.unit_m
        self._tracker = OnlineTracker(
            model=motion_model(options, noise, movers),
            association=Association(
                same_id=options.same_id_bonus,
                same_id_crowded=options.same_id_bonus / 3,
                merge_distance_m=options.merge_distance_m / movers.unit_m,
                merge_timeout_s=options.merge_timeout_s,
            ),
            step_s=1 / rate,
            max_age=max_age,
            confirm_hits=self._confirm_hits,
            max_age_tentative=min(self._confirm_hits, max_age),
            estimate_noise=options.noise_m is None,
        )
        self.assignments = Assignments()
        self.samples: list[Rows] = []
        self.steps: list[int] = []
        self._frames: list[Frame] = []
        self._results: list[Step] = []
        self._observed: list[Ints] = []

    @property
    def noise_m(self) -> float:
        """The noise of measured positions: as given, or as estimated so far; in the unit of the objects."""
        return self._tracker.model.noise_m

    def step(self, frame: Frame) -> None:
        """One step: association, update, birth and termination of tracks."""
        passed = 1
        if self._frames:
            passed = max(1, round((frame.t_ns - self._frames[-1].t_ns) * self._options.rate_hz / NS_PER_S))
        step = self.steps[-1] + passed if self.steps else 0
        rows = frame.rows
        observed = np.flatnonzero(rows["observed"]) if not self._options.interpolated else np.arange(len(rows))
        observed = observed[np.argsort(rows["track_id"][observed], kind="stable")]
        xy = np.stack([rows["x_m"][observed], rows["y_m"][observed]], axis=-1) / self._unit_m
        source = rows["track_id"][observed]
        result = self._tracker.step(xy, source, passed)
        is_matched = result.row >= 0
        self.assignments.add(step, result.ids[is_matched], source[result.row[is_matched]])
        self._frames.append(frame)
        self.samples.append(rows)
        self.steps.append(step)
        self._results.append(result)
        self._observed.append(observed)

    def outputs(self) -> list[tuple[Frame, Frame]]:
        """For each step the online tracks and their predictions, from the past alone."""
        options = self._options
        if not self._frames:
            return []
        rate = options.rate_hz
        tick = group_index([len(result.ids) for result in self._results])
        ids, row, mean, hits, missed = (np.concatenate([result[k] for result in self._results]) for k in range(5))
        offset = np.concatenate([[0], np.cumsum([len(rows) for rows in self.samples])])
        at = np.concatenate(
            [
                np.where(s.row >= 0, o[s.row] if len(o) else -1, -1)
                for s, o in zip(self._results, self._observed, strict=True)
            ]
        )
        sample = np.where(row >= 0, offset[tick] + at, -1)
        order = np.lexsort((tick, ids))
        # the last sample of each track up to each step
        last = np.maximum.accumulate(np.where(sample[order] >= 0, np.arange(len(order)), -1))
        last_sample = np.empty_like(sample)
        last_sample[order] = sample[order][last]
        is_coasting = (row < 0) & (hits * 2 >= self._confirm_hits * 3) & (missed <= round(options.coast_s * rate))
        is_confirmed = (row >= 0) & (hits >= self._confirm_hits)
        shown = np.flatnonzero((is_confirmed | is_coasting) & np.isfinite(mean[:, 0]))
        shown = shown[np.lexsort((ids[shown], tick[shown]))]

        samples = np.concatenate(self.samples)
        rows = samples[last_sample[shown]].copy()
        rows["source_id"] = np.where(row[shown] >= 0, rows["track_id"], -1)
        rows["track_id"] = ids[shown]
        coasts = row[shown] < 0
        rows["observed"] &= ~coasts
        t_ns = np.array([frame.t_ns for frame in self._frames], np.int64)
        rows[coasts] = move_rows(
            rows[coasts], mean[shown[coasts], :2] * self._unit_m, options.ground_planes, t_ns[tick[shown[coasts]]]
        )
        steps = np.array(self.steps, np.int64)
        xy_m = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
        predictions = PREDICTIONS.empty()
        if len(rows):
            forecast = self._predict(*self._past(ids[shown], steps[tick[shown]], xy_m, samples))
            predictions = forecast_to_rows(rows["track_id"], forecast, self._predictor.step_s)
        horizon = self._predictor.steps
        bounds = np.searchsorted(tick[shown], np.arange(len(self._frames) + 1)).tolist()
        return [
            (
                Frame(frame.t_ns, frame.index, rows[low:high]),
                Frame(frame.t_ns, frame.index, predictions[low * horizon : high * horizon]),
            )
            for frame, low, high in zip(self._frames, bounds[:-1], bounds[1:], strict=True)
        ]

    @property
    def _predictor(self) -> Predictor:
        options = self._options
        return make(options.predictor, max(1, round(options.horizon_s * options.rate_hz)), 1 / options.rate_hz)

    def _past(self, ids: Ints, steps: Ints, now_m: Floats, samples: Rows) -> tuple[Floats, Bools]:
        """Last positions of tracks as known at ``steps`` (R,), (R, L, 2), and which of them are known, (R, L)."""
        length = self._predictor.past
        step, track, _, sample = self.assignments.of(samples, self.steps, [len(rows) for rows in self.samples])
        width = self.steps[-1] + 2
        have = track * width + step
        order = np.argsort(have)
        have, sample = have[order], sample[order]
        past = np.full((len(ids), length, 2), np.nan)
        for back in range(1, length):
            want = ids * width + steps - back
            place = np.minimum(np.searchsorted(have, want), len(have) - 1)
            found = (have[place] == want) & (steps >= back)
            rows = samples[sample[place[found]]]
            past[found, length - 1 - back] = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
        past[:, -1] = now_m
        return past, np.isfinite(past[..., 0])

    def _predict(self, past: Floats, known: Bools) -> Forecast:
        predictor, past = self._predictor, past / self._unit_m
        parts = [predictor.predict(past[k : k + _BATCH], known[k : k + _BATCH]) for k in range(0, len(past), _BATCH)]
        mean, cov = (np.concatenate(members) for members in zip(*parts, strict=True))
        return Forecast(mean * self._unit_m, cov * self._unit_m**2)


def motion_model(options: RetrackOptions, noise_m: float, movers: Movers = PEOPLE) -> MotionModel:
    """The motion model of the options, with this noise of measured positions."""
    noise_m, speed_m_per_s = max(noise_m, _MIN_SPREAD), max(options.speed_m_per_s, _MIN_SPREAD)
    if movers.drift_m_per_s is not None:
        return MotionModel(noise_m, speed_m_per_s, movers.drift_m_per_s / movers.unit_m, 0.0)
    return MotionModel(noise_m, speed_m_per_s, options.drift_m_per_s, options.drift_ratio)
