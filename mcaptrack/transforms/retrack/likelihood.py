"""Re-tracking by likelihood over one log: online tracks and their predictions, each from the past alone.

Letters: R rows of online tracks, L past positions.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints, joined, taken
from mcaptrack.geometry.ragged import group_index, run_starts
from mcaptrack.predictors import Forecast, Predictor, make, predict_together, uses_people
from mcaptrack.predictors.position_noise import PAST, PositionNoise
from mcaptrack.predictors.tail_calibration import TailCalibration
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame, Rows
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns
from mcaptrack.schema.framing import JoinedFrames, mapped_rows
from mcaptrack.schema.predictions import forecast_to_rows
from mcaptrack.transforms.retrack.assignments import PEOPLE, Movers, OnlinePass
from mcaptrack.transforms.retrack.motion_model import DEFAULT_NOISE_M, MotionModel, State, StateRows
from mcaptrack.transforms.retrack.offline import move_rows
from mcaptrack.transforms.retrack.online_tracker import HITS, IDS, Association, OnlineLinks, OnlineTracker, ShownTracks
from mcaptrack.transforms.retrack.options import LikelihoodOptions, RetrackOptions

#: So many frames are read at once, and online tracks written, or fewer with so many samples.
_STEPS, _SAMPLES = 256, 2**14
#: The least noise (m) and speed (m/s): a covariance of 0 can't be inverted.
_MIN_SPREAD: Final = 1e-3


# The most that the noise of positions can be, as far as the tracks of the input show it.
#
# Online tracking estimates noise from how far observations are from where tracks expect them. Where many are given
# to the wrong track, as in crowds in which people are merged into one detection now and then, these distances say
# little about noise; a larger estimate lets more of them be wrong, and it would grow without end. Tracks of the
# input don't depend on what is decided here: noise bends them, and so does the motion of people, so that there is
# hardly more noise than bends.
#
# Letters: R steps, N observations of all of them, L past positions.


#: The limit of noise, as a multiple of what bends of the input show: trackers smooth their tracks.
_FACTOR: Final = 1.5
#: Noise may be so large in any case: smooth tracks may be off for long. In metres.
_LEAST_M: Final = 0.3


# The recent positions of tracks, looked up for many tracks and steps at once. Letters: N positions, L past ones.


class RecentPositions:
    """Positions by track and step, of which the last ``length`` steps are looked up."""

    def __init__(self, length: int) -> None:
        self._length = length
        self._track, self._step = np.empty((2, 0), np.int64)
        self._xy = np.empty((0, 2))

    def add(self, first: int, track: Ints, step: Ints, xy: Floats) -> None:
        """Add positions (N, 2) of tracks (N,) at ``step`` (N,), from step ``first`` on; what is too old is dropped."""
        kept = self._step > first - 1 - self._length
        self._track = np.concatenate([self._track[kept], track])
        self._step = np.concatenate([self._step[kept], step])
        self._xy = np.concatenate([self._xy[kept], xy])

    def before(self, track: Ints, step: Ints, now: Floats) -> tuple[Floats, Bools]:
        """The last positions of tracks (N,) as known at ``step`` (N,), (N, L, 2), and which are known, (N, L).

        ``now`` (N, 2) are those at ``step``; NaN where a track has none.
        """
        width = max(self._step.max(initial=0), step.max(initial=0)) + 1
        # ids of the input may be as large as they like
        _, number = np.unique(np.concatenate([self._track, track]), return_inverse=True)
        had, track = number[: len(self._track)], number[len(self._track) :]
        have = had * width + self._step
        order = np.argsort(have)
        have, xy = have[order], self._xy[order]
        past = np.full((len(track), self._length, 2), np.nan)
        for back in range(1, self._length if len(have) else 0):
            want = track * width + step - back
            place = np.minimum(np.searchsorted(have, want), len(have) - 1)
            is_stored = (have[place] == want) & (step >= back)
            past[is_stored, self._length - 1 - back] = xy[place[is_stored]]
        past[:, -1] = now
        return past, np.isfinite(past[..., 0])


class InputNoise:
    """Limits the noise of positions, step by step, from the input up to each; steps have ``step_s`` seconds."""

    def __init__(self, step_s: float) -> None:
        self._noise = PositionNoise(step_s)
        self._recent = RecentPositions(PAST)

    def most_m(self, passed: Ints, steps: Ints, place: Ints, source: Ints, xy: Floats) -> list[float]:
        """The largest noise that there may be at each of ``steps`` (R,), infinite as long as little is known.

        ``passed`` (R,) are the steps since the one before. ``source`` (N,) are the input ids of observations at ``xy``
        (N, 2), and ``place`` (N,) says of which step they are.
        """
        step = steps[place]
        self._recent.add(int(steps[0]), source, step, xy)
        past, _ = self._recent.before(source, step, xy)
        bends_m2 = self._noise.bends_m2(passed, place, past)
        most = np.maximum(_FACTOR * np.sqrt(np.fmax.reduce(bends_m2, axis=1)), _LEAST_M)
        out: list[float] = np.where(np.isnan(most), np.inf, most).tolist()
        return out


# Predictions of online tracks, made for many tracks at once and calibrated step by step.
#
# Letters: R rows of online tracks, L past positions.


#: Predictions that are made at once: more take memory, fewer take time.
_BATCH: Final = 4096
#: Products of matrices are computed at once for so many tracks: more would start threads that wait for each other.
_BLOCK: Final = 32


class Unpredicted(NamedTuple):
    """Tracks without predictions yet: ids, past positions (R, L, 2), which are known, whether tracks coast, steps."""

    ids: Ints
    past: Floats
    known: Bools
    coasts: Bools
    step: Ints


class _Predicted(NamedTuple):
    """Predictions as the predictor made them: ids, past positions, whether tracks coast, means and covariances."""

    ids: Ints
    past: Floats
    coasts: Bools
    mean: Floats
    cov: Floats


class OnlineForecasts:
    """Predictions of tracks, frame by frame, made for ``_BATCH`` tracks at once."""

    def __init__(self, name: str, predictor: Predictor, unit_m: float, adapt: bool) -> None:
        self._name, self._predictor, self._unit_m = name, predictor, unit_m
        self._calibration = TailCalibration.of(name, predictor, adapt)
        self._out = FrameCollector(PREDICTIONS)
        nothing = np.empty((0, predictor.steps, 2, 2))
        ids, past, coasts = np.empty(0, np.int64), np.empty((0, predictor.past, 2)), np.empty(0, bool)
        self._waiting = [Unpredicted(ids, past, np.isfinite(past[..., 0]), coasts, ids)]
        self._left = _Predicted(ids, past, coasts, nothing[..., 0], nothing)  # of a frame that is not complete
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
        waiting = joined(self._waiting)
        done = 0
        while len(waiting.ids) - done >= least:
            end = done + _BATCH
            if uses_people(self._predictor):
                end = int(np.searchsorted(waiting.step, waiting.step[min(end, len(waiting.ids)) - 1], "right"))
            ids, past, is_known, coasts, steps = taken(waiting, slice(done, end))
            mean, cov = self._forecast(past / self._unit_m, is_known, steps)
            self._write(_Predicted(ids, past, coasts, mean * self._unit_m, cov * self._unit_m**2))
            done += len(ids)
        self._waiting = [taken(waiting, slice(done, None))]
        self._write(taken(self._left, slice(0)))  # frames without tracks

    def _forecast(self, past: Floats, is_known: Bools, steps: Ints) -> Forecast:
        """The forecasts of a batch of tracks, step by step if the predictor looks at others.

        The last digits of a product of matrices depend on their size: all blocks have the same, the last one of a log
        by repeating its last track, so that forecasts don't depend on later tracks.
        """
        count = len(steps)
        if uses_people(self._predictor):
            bounds = pairwise([*np.flatnonzero(run_starts(steps)), count])
            parts = [predict_together(self._predictor, past[low:high], is_known[low:high]) for low, high in bounds]
        else:
            blocks = np.minimum(np.arange(count + -count % _BLOCK), count - 1).reshape(-1, _BLOCK)
            parts = [self._predictor.predict(past[rows], is_known[rows]) for rows in blocks]
        return Forecast(*(np.concatenate(part)[:count] for part in zip(*parts, strict=True)))

    def _write(self, new: _Predicted) -> None:
        """Write the frames that are complete with these predictions."""
        waiting = joined([self._left, new])
        ends = np.cumsum([0, *(count for *_, count in self._frames)])
        count = int(np.searchsorted(ends, len(waiting.ids), "right")) - 1
        self._left = taken(waiting, np.arange(ends[count], len(waiting.ids)))  # so that the larger arrays are not held
        if not count:
            return
        ids, past, coasts, mean, cov = taken(waiting, slice(ends[count]))
        tails = None
        if self._calibration is not None:  # by the predictions of the steps before
            step = np.repeat([step for _, _, step, _ in self._frames[:count]], np.diff(ends[: count + 1]))
            (_, cov), tails = self._calibration(step, ids, Forecast(mean, cov), past, coasts)
        rows = forecast_to_rows(ids, Forecast(mean, cov), self._predictor.step_s, tails)
        t_ns, numbers, *_ = zip(*self._frames[:count], strict=True)
        self._out.extend(t_ns, numbers, ends[: count + 1] * self._predictor.steps, rows)
        self._frames = self._frames[count:]


class LikelihoodPass(OnlinePass):
    """Online tracking over one log.

    Frames are read some at once (``_track``), and rows of online tracks are made of as many (``_write``), because one
    frame has few of them. What later steps need is kept: the last sample of each track, and its past positions.
    """

    def __init__(self, options: LikelihoodOptions, movers: Movers = PEOPLE) -> None:
        super().__init__(options.rate_hz, options.bridged_s)
        rate, self._options, self._unit_m = options.rate_hz, options, movers.unit_m
        confirm_hits = self._confirm_hits = round(options.confirm_s * rate) + 1
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
            max_age=max_age,
            confirm_hits=confirm_hits,
            max_age_tentative=min(confirm_hits, max_age),
            estimate_noise=options.noise_m is None,
        )
        self._shown = ShownTracks(confirm_hits, round(options.coast_s * rate), max_age, options.adapt_online)
        self._links = OnlineLinks(self._tracker.model, options.link_s, options.link_confidence, confirm_hits)
        self._frames: list[Frame] = []  # those that are not read yet, and their number of samples
        self._unread = 0
        # what is known of earlier ones: tracks and their last samples
        self._ids, self._last_rows = np.empty(0, np.int64), TRACKS.empty()
        self._online = FrameCollector(TRACKS)
        self._coasting: list[tuple[Ints, Floats, Ints]] = []  # places of rows in _online, positions in m, times
        horizon = max(1, round(options.horizon_s * rate))
        self._predictor: Predictor = make(options.predictor, horizon, 1 / rate)
        self._forecasts = OnlineForecasts(options.predictor, self._predictor, movers.unit_m, options.follows_log)
        self._recent = RecentPositions(self._predictor.past)  # of tracks, in m
        self._input = InputNoise(1 / rate) if options.noise_m is None else None
        self._written = 0

    def step(self, frame: Frame) -> None:
        self.advance(frame.t_ns)
        self._frames.append(frame)
        self._unread += len(frame.rows)
        if len(self._frames) >= _STEPS or self._unread >= _SAMPLES:
            self._track()

    def finish(self) -> None:
        self._track()
        self.noise_m = self._tracker.noise_m

    def outputs(self) -> tuple[FrameColumns, FrameColumns]:
        self._track()
        online, predictions = self._online.done(), self._forecasts.done()
        # All at once, because the last digits of a product of matrices depend on their size.
        nothing = np.empty(0, np.int64), np.empty((0, 2)), np.empty(0, np.int64)
        places, xy_m, t_ns = (np.concatenate(parts) for parts in zip(nothing, *self._coasting, strict=True))
        coasting = move_rows(online.take(places), xy_m, self._options.ground_planes, t_ns)
        done = 0

        def moved(part: JoinedFrames) -> Rows:
            nonlocal done
            here = slice(*np.searchsorted(places, [done, done + len(part.rows)]))
            part.rows[places[here] - done] = coasting[here]
            done += len(part.rows)
            return part.rows

        return (mapped_rows(TRACKS, online, moved) if len(places) else online), predictions

    def _track(self) -> None:
        """Track through the frames that are not read yet, and write these steps."""
        frames, self._frames, self._unread = self._frames, [], 0
        if not frames:
            return
        t_ns, numbers = (np.array(values, np.int64) for values in zip(*(frame[:2] for frame in frames), strict=True))
        ends = np.cumsum([0, *(len(frame.rows) for frame in frames)])
        samples = TRACKS.joined([frame.rows for frame in frames])
        self.samples.extend(t_ns, numbers, ends, samples)
        steps = np.array(self.steps[-len(frames) :], np.int64)
        before = self.steps[-len(frames) - 1] if len(self.steps) > len(frames) else steps[0] - 1
        # observations of each step, ordered by their input ids
        tick, source = group_index(np.diff(ends)), samples["track_id"]
        observed = np.lexsort((source, tick))
        if not self._options.interpolated:
            observed = observed[samples["observed"][observed]]
        tick, source = tick[observed], source[observed]
        xy_m = np.stack([samples["x_m"][observed], samples["y_m"][observed]]) / self._unit_m
        bounds = np.searchsorted(tick, np.arange(len(frames) + 1))
        passed = np.diff(steps, prepend=before)
        most_m = self._input.most_m(passed, steps, tick, source, xy_m.T) if self._input else [np.inf] * len(frames)
        each = zip(bounds.tolist(), bounds[1:].tolist(), passed.tolist(), most_m, strict=False)
        results = [
            self._tracker.step(xy_m[:, low:high], source[low:high], steps_passed, limit)
            for low, high, steps_passed, limit in each
        ]
        tracks, row, mean, cov = (np.concatenate(all_, axis=-1) for all_ in zip(*results, strict=True))
        tick = group_index([len(result.row) for result in results])
        has = row >= 0
        row[has] = observed[bounds[tick[has]] + row[has]]
        self.assignments.add(steps[tick[has]], tracks[IDS, has], samples["track_id"][row[has]])
        self._write(_Read(t_ns, numbers, steps, passed, samples), tick, row, tracks, StateRows(mean, cov))

    def _write(self, read: _Read, tick: Ints, row: Ints, tracks: Ints, state: StateRows) -> None:
        """Make the rows of online tracks, and their predictions, of some steps.

        Of the tracks alive at each of the steps, end to end: the index of the step, the row that each has, or -1; whole
        numbers and states as in ``Step``.
        """
        steps = read.steps
        ids = tracks[IDS]
        samples = TRACKS.joined([self._last_rows, read.samples])
        before = len(self._last_rows)
        sample = np.where(row >= 0, before + row, -1)
        # the last sample of each track up to each step: before the first of these steps, that of ``_last_rows``
        earlier = np.concatenate([np.arange(before), sample])
        order = np.lexsort((np.concatenate([np.full(before, -1), tick]), np.concatenate([self._ids, ids])))
        last = np.maximum.accumulate(np.where(earlier[order] >= 0, np.arange(len(order)), -1))
        last_sample = np.empty_like(earlier)
        last_sample[order] = earlier[order][last]
        last_sample = last_sample[before:]
        place = state.mean[:2]
        is_shown = self._shown(read.passed, tick, row >= 0, tracks, place) & np.isfinite(place[0])
        names, is_shown = self._links(steps, tick, tracks, State(state.mean.T, state.cov.T), row >= 0, is_shown)
        shown = np.flatnonzero(is_shown)
        shown = shown[np.lexsort((names[shown], tick[shown]))]

        rows = samples[last_sample[shown]].copy()
        rows["source_id"] = np.where(row[shown] >= 0, rows["track_id"], -1)
        rows["track_id"] = names[shown]
        coasts = row[shown] < 0
        rows["observed"] &= ~coasts
        xy_m = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
        xy_m[coasts] = place.T[shown[coasts]] * self._unit_m
        self._coasting.append((self._written + np.flatnonzero(coasts), xy_m[coasts], read.t_ns[tick[shown[coasts]]]))
        is_matched = sample >= 0
        seen = samples[sample[is_matched]]
        seen_m = np.stack([seen["x_m"], seen["y_m"]], axis=-1)
        self._recent.add(int(steps[0]), ids[is_matched], steps[tick[is_matched]], seen_m)
        past, is_known = self._recent.before(ids[shown], steps[tick[shown]], xy_m)
        ticks = np.arange(len(steps) + 1)
        self._online.extend(read.t_ns, read.numbers, np.searchsorted(tick[shown], ticks), rows)
        confirmed = np.flatnonzero(tracks[HITS, shown] >= self._confirm_hits)  # before, little is known of velocities
        waiting = taken(Unpredicted(names[shown], past, is_known, coasts, steps[tick[shown]]), confirmed)
        self._forecasts.add(read.t_ns, read.numbers, steps, np.searchsorted(tick[shown[confirmed]], ticks), waiting)
        self._written += len(rows)
        is_last = tick == len(steps) - 1
        self._ids, self._last_rows = ids[is_last], samples[last_sample[is_last]]


class _Read(NamedTuple):
    """Frames that were read: times in ns, numbers, steps, and how many passed; and their samples, end to end."""

    t_ns: Ints
    numbers: Ints
    steps: Ints
    passed: Ints
    samples: Rows


def motion_model(options: RetrackOptions, noise_m: float, movers: Movers = PEOPLE) -> MotionModel:
    """The motion model of the options, with this noise of measured positions."""
    noise_m, speed_m_per_s = max(noise_m, _MIN_SPREAD), max(options.speed_m_per_s, _MIN_SPREAD)
    if movers.drift_m_per_s is not None:
        return MotionModel(noise_m, speed_m_per_s, movers.drift_m_per_s / movers.unit_m, 0.0, 1 / options.rate_hz)
    return MotionModel(noise_m, speed_m_per_s, options.drift_m_per_s, options.drift_ratio, 1 / options.rate_hz)
