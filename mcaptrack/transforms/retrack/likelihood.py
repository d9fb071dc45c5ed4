"""Re-tracking by likelihood over one log: online tracks and their predictions, each from the past alone.

Letters: R rows of online tracks, L past positions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.ragged import group_index
from mcaptrack.predictors import Forecast, PeopleSeen, Predictor, make, predict_among, uses_people
from mcaptrack.predictors.tails import TailCalibration
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame, Rows
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns
from mcaptrack.schema.predictions import forecast_to_rows
from mcaptrack.transforms.retrack.assignments import Assignments
from mcaptrack.transforms.retrack.by_class import PEOPLE, Movers
from mcaptrack.transforms.retrack.motion_model import DEFAULT_NOISE_M, MotionModel
from mcaptrack.transforms.retrack.offline_rows import move_rows
from mcaptrack.transforms.retrack.online_tracker import Association, OnlineTracker, Step
from mcaptrack.transforms.retrack.options import LikelihoodOptions, RetrackOptions
from mcaptrack.transforms.retrack.samples import LogSamples

#: Predictions that are made at once: more take memory, fewer take time.
_BATCH: Final = 4096
#: Online tracks are written of so many steps at once.
_STEPS: Final = 256
#: The least noise (m) and speed (m/s): a covariance of 0 can't be inverted.
_MIN_SPREAD: Final = 1e-3


class LikelihoodPass:
    """Online tracking over one log: ``step`` for each frame, then ``outputs``.

    Rows of online tracks are made of some steps at once (``_write``), because one step has few of them. What later
    steps need of these is kept: the last sample of each track, and its past positions.
    """

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
        self.samples = LogSamples()
        self.steps: list[int] = []
        self._last_ns = 0
        # steps that are not written yet
        self._frames: list[Frame] = []
        self._results: list[Step] = []
        self._observed: list[Ints] = []
        # what is known of earlier ones: tracks and their last samples, and their positions in the recent past
        self._ids, self._last_rows = np.empty(0, np.int64), TRACKS.empty()
        self._recent = _Positions(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)))
        self._online = FrameCollector(TRACKS)
        self._coasting: list[tuple[Ints, Floats, Ints]] = []  # places of rows in _online, positions in m, times
        horizon = max(1, round(options.horizon_s * rate))
        self._predictor: Predictor = make(options.predictor, horizon, 1 / rate)
        self._forecasts = _Forecasts(options.predictor, self._predictor, movers.unit_m, options.follows_log)
        self._written = 0

    @property
    def noise_m(self) -> float:
        """The noise of measured positions: as given, or as estimated so far; in the unit of the objects."""
        return self._tracker.model.noise_m

    def step(self, frame: Frame) -> None:
        """One step: association, update, birth and termination of tracks."""
        passed = 1
        if self.steps:
            passed = max(1, round((frame.t_ns - self._last_ns) * self._options.rate_hz / NS_PER_S))
        step = self.steps[-1] + passed if self.steps else 0
        rows = frame.rows
        observed = np.flatnonzero(rows["observed"]) if not self._options.interpolated else np.arange(len(rows))
        observed = observed[np.argsort(rows["track_id"][observed], kind="stable")]
        xy = np.stack([rows["x_m"][observed], rows["y_m"][observed]], axis=-1) / self._unit_m
        source = rows["track_id"][observed]
        result = self._tracker.step(xy, source, passed)
        is_matched = result.row >= 0
        self.assignments.add(step, result.ids[is_matched], source[result.row[is_matched]])
        self.samples.add(frame)
        self.steps.append(step)
        self._last_ns = frame.t_ns
        self._frames.append(frame)
        self._results.append(result)
        self._observed.append(observed)
        if len(self._frames) >= _STEPS:
            self._write()

    def outputs(self) -> Iterator[tuple[Frame, Frame]]:
        """For each step the online tracks and their predictions, from the past alone."""
        if not self.steps:
            return
        if self._frames:
            self._write()
        online, predictions = self._online.done(), self._forecasts.done()
        # All at once, because the last digits of a product of matrices depend on their size.
        nothing = np.empty(0, np.int64), np.empty((0, 2)), np.empty(0, np.int64)
        places, xy_m, t_ns = (np.concatenate(parts) for parts in zip(nothing, *self._coasting, strict=True))
        coasting = move_rows(online.take(places), xy_m, self._options.ground_planes, t_ns)
        bounds = np.searchsorted(places, online.ends).tolist()
        edges = zip(online.ends.tolist(), bounds[:-1], bounds[1:], strict=False)
        for (start, low, high), tracks, forecast in zip(edges, online, predictions, strict=True):
            if low == high:
                yield tracks, forecast
                continue
            rows = tracks.rows.copy()
            rows[places[low:high] - start] = coasting[low:high]
            yield tracks._replace(rows=rows), forecast

    def _write(self) -> None:
        """Make the rows of online tracks, and their predictions, of the steps that are not written yet."""
        options, results, frames = self._options, self._results, self._frames
        tick = group_index([len(result.ids) for result in results])
        ids, row, mean, hits, missed = (np.concatenate([result[k] for result in results]) for k in range(5))
        samples = TRACKS.joined([self._last_rows, *(frame.rows for frame in frames)])
        known = len(self._last_rows)
        offset = known + np.cumsum([0, *(len(frame.rows) for frame in frames)])
        at = np.concatenate(
            [np.where(s.row >= 0, o[s.row] if len(o) else -1, -1) for s, o in zip(results, self._observed, strict=True)]
        )
        sample = np.where(row >= 0, offset[tick] + at, -1)
        # the last sample of each track up to each step: before the first of these steps, that of ``_last_rows``
        earlier = np.concatenate([np.arange(known), sample])
        order = np.lexsort((np.concatenate([np.full(known, -1), tick]), np.concatenate([self._ids, ids])))
        last = np.maximum.accumulate(np.where(earlier[order] >= 0, np.arange(len(order)), -1))
        last_sample = np.empty_like(earlier)
        last_sample[order] = earlier[order][last]
        last_sample = last_sample[known:]
        is_coasting = (row < 0) & (hits * 2 >= self._confirm_hits * 3)
        is_coasting &= missed <= round(options.coast_s * options.rate_hz)
        is_confirmed = (row >= 0) & (hits >= self._confirm_hits)
        shown = np.flatnonzero((is_confirmed | is_coasting) & np.isfinite(mean[:, 0]))
        shown = shown[np.lexsort((ids[shown], tick[shown]))]

        rows = samples[last_sample[shown]].copy()
        rows["source_id"] = np.where(row[shown] >= 0, rows["track_id"], -1)
        rows["track_id"] = ids[shown]
        coasts = row[shown] < 0
        rows["observed"] &= ~coasts
        t_ns = np.array([frame.t_ns for frame in frames], np.int64)
        xy_m = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
        xy_m[coasts] = mean[shown[coasts], :2] * self._unit_m
        self._coasting.append((self._written + np.flatnonzero(coasts), xy_m[coasts], t_ns[tick[shown[coasts]]]))
        steps = np.array(self.steps[-len(frames) :], np.int64)
        is_matched = sample >= 0
        self._remember(ids[is_matched], steps[tick[is_matched]], samples[sample[is_matched]])
        past = self._past(ids[shown], steps[tick[shown]], xy_m)
        ends = np.searchsorted(tick[shown], np.arange(len(frames) + 1))
        numbers = [frame.index for frame in frames]
        self._online.extend(t_ns, numbers, ends, rows)
        self._forecasts.add(t_ns, numbers, steps, ends, _Waiting(rows["track_id"], *past, coasts, steps[tick[shown]]))
        self._written += len(rows)
        is_last = tick == len(frames) - 1
        self._ids, self._last_rows = ids[is_last], samples[last_sample[is_last]]
        self._frames, self._results, self._observed = [], [], []

    def _remember(self, track: Ints, step: Ints, samples: Rows) -> None:
        """Add positions of tracks to their past; only that which predictions need is kept."""
        recent = self._recent
        xy_m = np.stack([samples["x_m"], samples["y_m"]], axis=-1)
        kept = recent.step > self.steps[-1 - len(self._frames)] - self._predictor.past if len(recent.step) else slice(0)
        both = zip(recent, (track, step, xy_m), strict=True)
        self._recent = _Positions(*(np.concatenate([before[kept], new]) for before, new in both))

    def _past(self, ids: Ints, steps: Ints, now_m: Floats) -> tuple[Floats, Bools]:
        """Last positions of tracks as known at ``steps`` (R,), (R, L, 2), and which of them are known, (R, L)."""
        length, recent = self._predictor.past, self._recent
        width = self.steps[-1] + 2
        have = recent.track * width + recent.step
        order = np.argsort(have)
        have, xy_m = have[order], recent.xy_m[order]
        past = np.full((len(ids), length, 2), np.nan)
        for back in range(1, length if len(have) else 0):
            want = ids * width + steps - back
            place = np.minimum(np.searchsorted(have, want), len(have) - 1)
            found = (have[place] == want) & (steps >= back)
            past[found, length - 1 - back] = xy_m[place[found]]
        past[:, -1] = now_m
        return past, np.isfinite(past[..., 0])


class _Positions(NamedTuple):
    """Positions of tracks: the track of each, its step, and x and y in m."""

    track: Ints
    step: Ints
    xy_m: Floats


class _Waiting(NamedTuple):
    """Tracks without predictions yet: ids, past positions (R, L, 2), which are known, whether tracks coast, steps."""

    ids: Ints
    past: Floats
    known: Bools
    coasts: Bools
    step: Ints

    def part(self, which: slice) -> _Waiting:
        ids, past, known, coasts, step = self
        return _Waiting(ids[which], past[which], known[which], coasts[which], step[which])


class _Made(NamedTuple):
    """Predictions as the predictor made them: ids, past positions, whether tracks coast, means and covariances."""

    ids: Ints
    past: Floats
    coasts: Bools
    mean: Floats
    cov: Floats

    def part(self, which: slice) -> _Made:
        return _Made(self.ids[which], self.past[which], self.coasts[which], self.mean[which], self.cov[which])


class _Forecasts:
    """Predictions of tracks, frame by frame, made for ``_BATCH`` tracks at once."""

    def __init__(self, name: str, predictor: Predictor, unit_m: float, adapt: bool) -> None:
        self._name, self._predictor, self._unit_m = name, predictor, unit_m
        self._calibration = TailCalibration.of(name, predictor, adapt)
        self._out = FrameCollector(PREDICTIONS)
        self._waiting: list[_Waiting] = []
        nothing = np.empty((0, predictor.steps, 2, 2))
        self._made = [
            _Made(np.empty(0, np.int64), np.empty((0, predictor.past, 2)), np.empty(0, bool), nothing[..., 0], nothing)
        ]
        self._frames: list[tuple[int, int, int, int]] = []  # time, number, step and tracks of frames in neither

    def add(self, t_ns: Ints, numbers: Sequence[int], steps: Ints, ends: Ints, tracks: _Waiting) -> None:
        """Add the tracks of frames, ``ends[f]`` to ``ends[f + 1]`` of frame f, with their past positions."""
        self._frames += zip(t_ns.tolist(), numbers, steps.tolist(), np.diff(ends).tolist(), strict=True)
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
        waiting = _Waiting(*(np.concatenate(parts) for parts in zip(*self._waiting, strict=True)))
        done = 0
        while len(waiting.ids) - done >= least:
            end = done + _BATCH
            if uses_people(self._predictor):  # whole steps, because their tracks are predicted together
                end = int(np.searchsorted(waiting.step, waiting.step[min(end, len(waiting.ids)) - 1], "right"))
            ids, past, known, coasts, steps = waiting.part(slice(done, end))
            units = past / self._unit_m
            people = PeopleSeen(units, known, steps, np.arange(len(ids)))
            mean, cov = predict_among(self._predictor, units, known, people)
            self._made.append(_Made(ids, past, coasts, mean * self._unit_m, cov * self._unit_m**2))
            done += len(ids)
        self._waiting = [waiting.part(slice(done, None))]
        made = _Made(*(np.concatenate(parts) for parts in zip(*self._made, strict=True)))
        ends = np.cumsum([0, *(count for *_, count in self._frames)])
        complete = int(np.searchsorted(ends, len(made.ids), "right")) - 1
        for (t_ns, number, step, _), low, high in zip(self._frames, ends[:complete], ends[1:], strict=False):
            rows = self._rows(step, made.part(slice(low, high)))
            self._out.append(Frame(t_ns, number, rows))
        self._frames = self._frames[complete:]
        left = made.part(slice(ends[complete], None))  # copied, so that the larger arrays are not held
        self._made = [_Made(left.ids.copy(), left.past.copy(), left.coasts.copy(), left.mean.copy(), left.cov.copy())]

    def _rows(self, step: int, made: _Made) -> Rows:
        """The predictions of a step; calibrated by those of the steps before."""
        forecast, tails = Forecast(made.mean, made.cov), None
        if self._calibration is not None:
            forecast, tails = self._calibration(step, made.ids, forecast, made.past, made.coasts)
        return forecast_to_rows(made.ids, forecast, self._predictor.step_s, tails)


def motion_model(options: RetrackOptions, noise_m: float, movers: Movers = PEOPLE) -> MotionModel:
    """The motion model of the options, with this noise of measured positions."""
    noise_m, speed_m_per_s = max(noise_m, _MIN_SPREAD), max(options.speed_m_per_s, _MIN_SPREAD)
    if movers.drift_m_per_s is not None:
        return MotionModel(noise_m, speed_m_per_s, movers.drift_m_per_s / movers.unit_m, 0.0)
    return MotionModel(noise_m, speed_m_per_s, options.drift_m_per_s, options.drift_ratio)
