"""Re-tracking by likelihood over one log: online tracks and their predictions, each from the past alone.

Letters: R rows of online tracks, L past positions.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import steps_passed
from mcaptrack.geometry.ragged import group_index
from mcaptrack.predictors import Predictor, make
from mcaptrack.schema import TRACKS, Frame, Rows
from mcaptrack.schema.frame_columns import FrameCollector
from mcaptrack.transforms.retrack.assignments import Assignments
from mcaptrack.transforms.retrack.by_class import PEOPLE, Movers
from mcaptrack.transforms.retrack.input_noise import InputNoise
from mcaptrack.transforms.retrack.motion_model import DEFAULT_NOISE_M, MotionModel, State, StateRows
from mcaptrack.transforms.retrack.offline_rows import move_rows
from mcaptrack.transforms.retrack.online_forecasts import OnlineForecasts, Unpredicted
from mcaptrack.transforms.retrack.online_links import OnlineLinks
from mcaptrack.transforms.retrack.online_tracker import HITS, IDS, Association, OnlineTracker
from mcaptrack.transforms.retrack.options import LikelihoodOptions, RetrackOptions
from mcaptrack.transforms.retrack.recent_positions import RecentPositions
from mcaptrack.transforms.retrack.samples import LogSamples
from mcaptrack.transforms.retrack.shown_tracks import ShownTracks

#: So many frames are read at once, and online tracks written, or fewer with so many samples.
_STEPS, _SAMPLES = 256, 2**14
#: The least noise (m) and speed (m/s): a covariance of 0 can't be inverted.
_MIN_SPREAD: Final = 1e-3


class LikelihoodPass:
    """Online tracking over one log: ``step`` for each frame, then ``outputs``.

    Frames are read some at once (``_track``), and rows of online tracks are made of as many (``_write``), because one
    frame has few of them. What later steps need is kept: the last sample of each track, and its past positions.
    """

    def __init__(self, options: LikelihoodOptions, movers: Movers = PEOPLE) -> None:
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
            step_s=1 / rate,
            max_age=max_age,
            confirm_hits=confirm_hits,
            max_age_tentative=min(confirm_hits, max_age),
            estimate_noise=options.noise_m is None,
        )
        self._shown = ShownTracks(confirm_hits, round(options.coast_s * rate), max_age, options.adapt_online)
        self._links = OnlineLinks(self._tracker.model, 1 / rate, options.link_s, options.link_confidence, confirm_hits)
        self._assignments = Assignments()
        self._samples = LogSamples()
        self.steps: list[int] = []
        self._last_ns = 0
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

    @property
    def noise_m(self) -> float:
        """The noise of measured positions: as given, or as estimated so far; in the unit of the objects."""
        self._track()
        return self._tracker.noise_m

    @property
    def assignments(self) -> Assignments:
        """Which track had which sample so far."""
        self._track()
        return self._assignments

    @property
    def samples(self) -> LogSamples:
        """The samples so far."""
        self._track()
        return self._samples

    def step(self, frame: Frame) -> None:
        """One step: association, update, birth and termination of tracks."""
        passed = 1
        if self.steps:
            passed = steps_passed(frame.t_ns - self._last_ns, self._options.rate_hz, self._options.bridged_s)
        self.steps.append(self.steps[-1] + passed if self.steps else 0)
        self._last_ns = frame.t_ns
        self._frames.append(frame)
        self._unread += len(frame.rows)
        if len(self._frames) >= _STEPS or self._unread >= _SAMPLES:
            self._track()

    def outputs(self) -> Iterator[tuple[Frame, Frame]]:
        """For each step the online tracks and their predictions, from the past alone."""
        if not self.steps:
            return
        self._track()
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

    def _track(self) -> None:
        """Track through the frames that are not read yet, and write these steps."""
        frames, self._frames, self._unread = self._frames, [], 0
        if not frames:
            return
        t_ns, numbers = (np.array(values, np.int64) for values in zip(*(frame[:2] for frame in frames), strict=True))
        ends = np.cumsum([0, *(len(frame.rows) for frame in frames)])
        samples = TRACKS.joined([frame.rows for frame in frames])
        self._samples.extend(t_ns, numbers, ends, samples)
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
        self._assignments.add(steps[tick[has]], tracks[IDS, has], samples["track_id"][row[has]])
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
        past, known = self._recent.before(ids[shown], steps[tick[shown]], xy_m)
        ticks = np.arange(len(steps) + 1)
        self._online.extend(read.t_ns, read.numbers, np.searchsorted(tick[shown], ticks), rows)
        confirmed = np.flatnonzero(tracks[HITS, shown] >= self._confirm_hits)  # before, little is known of velocities
        waiting = Unpredicted(names[shown], past, known, coasts, steps[tick[shown]]).part(confirmed)
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
        return MotionModel(noise_m, speed_m_per_s, movers.drift_m_per_s / movers.unit_m, 0.0)
    return MotionModel(noise_m, speed_m_per_s, options.drift_m_per_s, options.drift_ratio)
