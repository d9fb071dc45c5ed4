"""Re-tracking by likelihood over one log: online tracks and their predictions, each from the past alone.

Letters: R rows of online tracks, L past positions.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints, taken
from mcaptrack.geometry.histories import Histories
from mcaptrack.geometry.ragged import group_index, run_starts
from mcaptrack.predictors import Forecast, Predictor, make, predict_together, uses_people
from mcaptrack.predictors.position_noise import PAST, PositionNoise
from mcaptrack.predictors.tail_calibration import TailCalibration
from mcaptrack.schema import PREDICTIONS, TRACKS, Rows
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns
from mcaptrack.schema.framing import JoinedFrames, join_frames, mapped_rows, spans_of
from mcaptrack.schema.predictions import forecast_to_rows
from mcaptrack.transforms.retrack.assignments import PEOPLE, Movers, OnlinePass
from mcaptrack.transforms.retrack.motion_model import DEFAULT_NOISE_M, MotionModel, State
from mcaptrack.transforms.retrack.online_tracker import (
    HITS,
    IDS,
    Alive,
    Association,
    OnlineLinks,
    OnlineTracker,
    ShownTracks,
)
from mcaptrack.transforms.retrack.options import LikelihoodOptions, RetrackOptions
from mcaptrack.transforms.to_video_rate import move_rows

#: Frames with about so many samples are read, and their online tracks written, at once.
_SAMPLES: Final = 2**12
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


class InputNoise:
    """Limits the noise of positions, step by step, from the input up to each; steps have ``step_s`` seconds."""

    def __init__(self, step_s: float) -> None:
        self._noise = PositionNoise(step_s)
        self._recent = Histories(PAST)

    def most_m(self, passed: Ints, ends: Ints, source: Ints, xy: Floats) -> list[float]:
        """The largest noise that there may be at each of R steps, infinite as long as little is known.

        ``passed`` (R,) are the steps since the one before. ``source`` (N,) are the input ids of observations at ``xy``
        (N, 2); those of step r are ``ends[r]`` to ``ends[r + 1]``.
        """
        past, _ = self._recent.push_all(passed, ends, source, xy)
        bends_m2 = self._noise.bends_m2(passed, group_index(np.diff(ends)), past)
        most = np.maximum(_FACTOR * np.sqrt(np.fmax.reduce(bends_m2, axis=1)), _LEAST_M)
        out: list[float] = np.where(np.isnan(most), np.inf, most).tolist()
        return out


# Predictions of online tracks, made for many tracks at once and calibrated step by step.
#
# Letters: R rows of online tracks, L past positions.


#: The number of tracks in a product of matrices: of larger ones threads would only wait for each other.
_BLOCK: Final = 32


class Unpredicted(NamedTuple):
    """Tracks without predictions yet: ids, past positions (R, L, 2), which are known, whether tracks coast, steps."""

    ids: Ints
    past: Floats
    known: Bools
    coasts: Bools
    step: Ints


class OnlineForecasts:
    """Predictions of the tracks of some frames at a time."""

    def __init__(self, options: LikelihoodOptions, unit_m: float) -> None:
        horizon = max(1, round(options.horizon_s * options.rate_hz))
        self._name, self._unit_m = options.predictor, unit_m
        self._predictor: Predictor = make(options.predictor, horizon, 1 / options.rate_hz)
        self._calibration = TailCalibration.of(options.predictor, self._predictor, options.follows_log)
        self._out = FrameCollector(PREDICTIONS)

    @property
    def past(self) -> int:
        """The number of past positions that predictions are made from."""
        return self._predictor.past

    def add(self, t_ns: Ints, numbers: Ints, ends: Ints, tracks: Unpredicted) -> None:
        """Predict the tracks of frames, ``ends[f]`` to ``ends[f + 1]`` of frame f."""
        mean, cov = self._forecast(tracks.past / self._unit_m, tracks.known, tracks.step)
        forecast, tails = Forecast(mean * self._unit_m, cov * self._unit_m**2), None
        if self._calibration is not None:  # by the predictions of the steps before
            forecast, tails = self._calibration(tracks.step, tracks.ids, forecast, tracks.past, tracks.coasts)
        rows = forecast_to_rows(tracks.ids, forecast, self._predictor.step_s, tails)
        self._out.extend(t_ns, numbers, ends * self._predictor.steps, rows)

    def done(self) -> FrameColumns:
        """The predictions; nothing can be added any more."""
        if self._calibration is not None:
            self._calibration.warn(self._name)
        return self._out.done()

    def _forecast(self, past: Floats, is_known: Bools, steps: Ints) -> Forecast:
        """The forecasts of tracks, step by step if the predictor looks at others.

        The last digits of a product of matrices depend on their size: all blocks have the same, the last one by
        repeating its last track, so that forecasts don't depend on later tracks.
        """
        count = len(steps)
        if uses_people(self._predictor):
            bounds = pairwise([*np.flatnonzero(run_starts(steps)), count])
            parts = [predict_together(self._predictor, past[low:high], is_known[low:high]) for low, high in bounds]
        else:
            blocks = np.minimum(np.arange(count + -count % _BLOCK), count - 1).reshape(-1, _BLOCK)
            parts = [self._predictor.predict(past[rows], is_known[rows]) for rows in blocks]
        nothing = Forecast(np.empty((0, self._predictor.steps, 2)), np.empty((0, self._predictor.steps, 2, 2)))
        return Forecast(*(np.concatenate(part)[:count] for part in zip(nothing, *parts, strict=True)))


class LikelihoodPass(OnlinePass):
    """Online tracking over one log.

    Frames are read some at a time, and rows of online tracks are made of as many, because one frame has few of them.
    What later steps need is kept: the last sample of each track, and its past positions.
    """

    def __init__(self, options: LikelihoodOptions, movers: Movers, frames: FrameColumns) -> None:
        super().__init__(frames, options.rate_hz, options.bridged_s)
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
        # what is known of earlier frames: tracks and their last samples
        self._ids, self._last_rows = np.empty(0, np.int64), TRACKS.empty()
        self._online = FrameCollector(TRACKS)
        self._coasting: list[tuple[Ints, Floats, Ints]] = []  # places of rows in _online, positions in m, times
        self._forecasts = OnlineForecasts(options, movers.unit_m)
        self._recent = Histories(self._forecasts.past)  # of tracks, in m
        self._input = InputNoise(1 / rate) if options.noise_m is None else None
        self._written = 0
        for low, high in spans_of(frames.ends, _SAMPLES):
            self._track(join_frames(TRACKS, frames, low, high), frames.numbers[low:high], slice(low, high))
        self.noise_m = self._tracker.noise_m

    def outputs(self) -> tuple[FrameColumns, FrameColumns]:
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

    def _track(self, part: JoinedFrames, numbers: Ints, here: slice) -> None:
        """Track through some frames, and write these steps."""
        steps, passed, samples = self.steps[here], self.passed[here], part.rows
        # observations of each step, ordered by their input ids
        tick, source = part.frame, samples["track_id"]
        observed = np.lexsort((source, tick))
        if not self._options.interpolated:
            observed = observed[samples["observed"][observed]]
        tick, source = tick[observed], source[observed]
        xy_m = np.stack([samples["x_m"][observed], samples["y_m"][observed]]) / self._unit_m
        ends = np.searchsorted(tick, np.arange(len(steps) + 1))
        most_m = self._input.most_m(passed, ends, source, xy_m.T) if self._input else [np.inf] * len(steps)
        each = zip(pairwise(ends.tolist()), passed.tolist(), most_m, strict=True)
        results = [
            self._tracker.step(xy_m[:, low:high], source[low:high], steps_passed, limit)
            for (low, high), steps_passed, limit in each
        ]
        tracks, row, mean, cov = (np.concatenate(all_, axis=-1) for all_ in zip(*results, strict=True))
        tick = group_index([len(result.row) for result in results])
        has = row >= 0
        row[has] = observed[ends[tick[has]] + row[has]]
        self.assignments.add(steps[tick[has]], tracks[IDS, has], samples["track_id"][row[has]])
        alive = Alive(steps, passed, tick, row >= 0, tracks, State(mean.T, cov.T))
        self._write(alive, part, numbers, row)

    def _write(self, alive: Alive, part: JoinedFrames, numbers: Ints, row: Ints) -> None:
        """Make the rows of online tracks, and their predictions, of some steps; ``row`` (R,) is the sample of each
        track alive, or -1.
        """
        steps, tick, ids, place = alive.steps, alive.tick, alive.tracks[IDS], alive.state.mean[:, :2]
        samples = TRACKS.joined([self._last_rows, part.rows])
        before = len(self._last_rows)
        sample = np.where(row >= 0, before + row, -1)
        # the last sample of each track up to each step: before the first of these steps, that of ``_last_rows``
        earlier = np.concatenate([np.arange(before), sample])
        order = np.lexsort((np.concatenate([np.full(before, -1), tick]), np.concatenate([self._ids, ids])))
        last = np.maximum.accumulate(np.where(earlier[order] >= 0, np.arange(len(order)), -1))
        last_sample = np.empty_like(earlier)
        last_sample[order] = earlier[order][last]
        last_sample = last_sample[before:]
        names, is_shown = self._links(alive, self._shown(alive) & np.isfinite(place[:, 0]))
        shown = np.flatnonzero(is_shown)
        shown = shown[np.lexsort((names[shown], tick[shown]))]

        rows = samples[last_sample[shown]].copy()
        coasts = row[shown] < 0
        rows["source_id"] = np.where(coasts, -1, rows["track_id"])
        rows["track_id"] = names[shown]
        rows["observed"] &= ~coasts
        xy_m = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
        xy_m[coasts] = place[shown[coasts]] * self._unit_m
        self._coasting.append((self._written + np.flatnonzero(coasts), xy_m[coasts], part.t_ns[tick[shown[coasts]]]))
        self._written += len(rows)
        ticks = np.arange(len(steps) + 1)
        seen_m = np.full((len(ids), 2), np.nan)
        seen_m[row >= 0] = np.stack([part.rows[name][row[row >= 0]] for name in ("x_m", "y_m")], axis=-1)
        past = self._recent.push_all(alive.passed, np.searchsorted(tick, ticks), ids, seen_m)[0][shown]
        past[:, -1] = xy_m
        self._online.extend(part.t_ns, numbers, np.searchsorted(tick[shown], ticks), rows)
        confirmed = np.flatnonzero(alive.tracks[HITS, shown] >= self._confirm_hits)  # before, velocities are unknown
        known = np.isfinite(past[..., 0])
        waiting = taken(Unpredicted(names[shown], past, known, coasts, steps[tick[shown]]), confirmed)
        self._forecasts.add(part.t_ns, numbers, np.searchsorted(tick[shown[confirmed]], ticks), waiting)
        is_last = tick == len(steps) - 1
        self._ids, self._last_rows = ids[is_last], samples[last_sample[is_last]]


def motion_model(options: RetrackOptions, noise_m: float, movers: Movers = PEOPLE) -> MotionModel:
    """The motion model of the options, with this noise of measured positions."""
    noise_m, speed_m_per_s = max(noise_m, _MIN_SPREAD), max(options.speed_m_per_s, _MIN_SPREAD)
    if movers.drift_m_per_s is not None:
        return MotionModel(noise_m, speed_m_per_s, movers.drift_m_per_s / movers.unit_m, 0.0, 1 / options.rate_hz)
    return MotionModel(noise_m, speed_m_per_s, options.drift_m_per_s, options.drift_ratio, 1 / options.rate_hz)
