"""Online passes over one log: what each leaves for offline re-tracking, and which tracks it writes.

Each reads all samples, and leaves which track had which of them: ``LikelihoodPass`` tracks by likelihood, ``KeptIds``
keeps the ids of the input; ``consistency`` has that of the paper. Online tracks and predictions know the past alone.

Letters: C assignments, F frames, R rows of online tracks, L past positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools, Ints, taken
from mcaptrack.geometry.clocks import LAST_NS, NS_PER_S, steps_passed
from mcaptrack.geometry.histories import Histories
from mcaptrack.geometry.ragged import find_rows, group_index
from mcaptrack.schema import TRACKS, Frame, Rows
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns
from mcaptrack.schema.framing import (
    JoinedFrames,
    frame_numbers,
    has_any,
    join_frames,
    joined_parts,
    mapped_rows,
    spans_of,
)
from mcaptrack.transforms.forecasts import Forecaster, OnlineForecasts, Unpredicted
from mcaptrack.transforms.motion_limits import ClassNames, limits_by_class, units_m
from mcaptrack.transforms.retrack.motion_model import DEFAULT_NOISE_M, WALK_M_PER_S, MotionModel, State
from mcaptrack.transforms.retrack.online_tracker import (
    HITS,
    IDS,
    SAMPLE,
    Alive,
    OnlineLinks,
    OnlineTracker,
    ShownTracks,
)
from mcaptrack.transforms.retrack.options import LikelihoodOptions, RetrackOptions
from mcaptrack.transforms.to_video_rate import move_rows


def column(frames: Sequence[Frame], name: str) -> NDArray[Any]:
    """A column of all rows of tracks, (N,).

    A person who is seen for an hour has 9,000 samples at 2.5 Hz. What re-tracking holds for each of them, from the
    first step to the last, are numbers: some columns, assignments, the states of its filters, and what is seen of it
    (74 bytes, see ``appearance``). Rows of tracks (153 bytes) and of predictions (840 bytes for each sample) are made
    part by part, and kept as ``FrameColumns``, most of which is not in memory.
    """
    parts = [part.rows[name].copy() for _, _, part in joined_parts(TRACKS, frames)]
    return np.concatenate([np.empty(0, TRACKS.dtype[name]), *parts])


class Assignments:
    """Assignments: each has a step, a track and a sample. Samples are named by step and input id."""

    def __init__(self) -> None:
        self._parts = [np.empty((3, 0), np.int64)]
        self._confirmed: list[tuple[int, Ints]] = []

    def add(self, step: Ints | int, tracks: Ints, sources: Ints) -> None:
        """Assign the samples of the input ids ``sources`` (C,) at ``step`` to ``tracks`` (C,)."""
        self._parts.append(np.stack([np.broadcast_to(step, tracks.shape), tracks, sources]))

    def confirm(self, step: int, tracks: Ints) -> None:
        """Confirm assignments of ``tracks`` (C,) up to ``step``; once this was called, unconfirmed ones are dropped."""
        self._confirmed.append((step, tracks))

    def of(self, samples: FrameColumns, steps: Ints) -> tuple[Ints, Ints, Ints, Ints]:
        """Steps, tracks, input ids and samples of the assignments, in the order in which they were made; (C,) each.

        ``samples`` are those of all ``steps``. A track has one sample a step.
        """
        step, track, source = np.concatenate(self._parts, axis=1)
        row = find_rows((column(samples, "track_id"), np.repeat(steps, np.diff(samples.ends))), (source, step))
        kept = np.flatnonzero((row >= 0) & self._is_confirmed(step, track))
        return step[kept], track[kept], source[kept], row[kept]

    def _is_confirmed(self, step: Ints, track: Ints) -> Bools:
        """Mask the assignments (C,) that are not later than the last confirmation of their track."""
        if not self._confirmed:
            return np.ones(len(step), bool)
        until = np.full(int(track.max(initial=0)) + 1, np.iinfo(np.int64).min)
        for when, tracks in self._confirmed:  # rising
            until[tracks] = when
        return step <= until[track]


class OnlinePass:
    """Online re-tracking of one log: made of its samples, of which it has read all then.

    It leaves for ``offline`` which track had which sample, the ``steps`` (F,) of the frames, and the noise of measured
    positions. ``passed`` (F,) is by how many steps time advanced. It holds for the whole log what ``column`` says, and
    no rows.
    """

    noise_m: float

    def __init__(self, frames: FrameColumns, rate_hz: float, bridged_s: float) -> None:
        self.assignments, self.samples = Assignments(), frames
        passed = [steps_passed(ns, rate_hz, bridged_s) for ns in np.diff(frames.t_ns).tolist()]
        self.passed = np.array([1, *passed][: len(frames)], np.int64)
        self.steps = np.cumsum(self.passed) - 1

    def outputs(self) -> tuple[FrameColumns, FrameColumns]:
        """The online tracks and their predictions, from the past alone, a frame for each step."""
        raise NotImplementedError


# The unit and the kind of the tracks of one class: each class is re-tracked by itself.


class Movers(NamedTuple):
    """The unit and the kind of the tracks of one class.

    All of re-tracking is made for people. Other classes are re-tracked in a unit of length in which they move as people
    do: ``unit_m`` metres. ``on_ground`` says that a tracker made their tracks in metres, with velocities, and not
    from boxes in pictures: detections don't merge where objects occlude one another, and the tracker has confirmed each
    track by the scores of its detections. It knows more than samples say, unless people were detected at no higher rate
    than that of the samples; those are re-tracked like others. ``usual_score`` is the median score of the log,
    ``drift_m_per_s`` how much velocities change within a second, None for what the options say.
    """

    unit_m: float = 1.0
    on_ground: bool = False
    usual_score: float = 1.0
    drift_m_per_s: float | None = None


#: Speeds are measured over so many steps, and so many say something. What is slower stands; where most go so much
#: faster than walkers, units are larger.
_PACE_STEPS, _LEAST_SPEEDS = 3, 30
_STANDS_M_PER_S, _FAST = 0.5, 1.5
#: People in pictures.
PEOPLE: Final[Movers] = Movers()


def usual_score(frames: Sequence[Frame]) -> float:
    """The median score of the observed rows of a log; 1 where there are none."""
    scores = column(frames, "score")[column(frames, "observed")]
    scores = scores[np.isfinite(scores)]
    return max(float(np.median(scores)), 1e-6) if len(scores) else 1.0


def movers_of(frames: Sequence[Frame], class_names: ClassNames, usual_score: float, class_limits: str = "") -> Movers:
    """The unit and the kind of the tracks in frames of one class."""
    first = next((frame for frame in frames if len(frame.rows)), None)
    if first is None:
        return PEOPLE
    number = int(first.rows["class_id"][0])
    limits = limits_by_class([number], class_names, class_limits)[number]
    has_velocities = not has_any(TRACKS, frames, lambda rows: ~np.isfinite(rows["vx_m_per_s"]))
    on_ground = has_velocities and not (limits.name == "person" and _is_slow(frames))
    drift_m_per_s = limits.drift_m_per_s if on_ground else None
    (unit_m,) = units_m([number], class_names, class_limits)
    return Movers(unit_m, on_ground, usual_score, drift_m_per_s)


def at_pace_of_log(movers: Movers, frames: Sequence[Frame]) -> Movers:
    """The same kind of tracks in a larger unit, if most of those that go anywhere go faster than people walk.

    Runners and skaters, bicycles, a recording that is read at another rate: in this unit they walk. It takes the whole
    log to know it, so that it is for offline tracks.
    """
    speeds = [np.empty(0)]
    for _, _, part in joined_parts(TRACKS, frames):
        order = np.lexsort((part.row_ns, part.rows["track_id"]))
        track, x_m, y_m = (part.rows[name][order] for name in ("track_id", "x_m", "y_m"))
        before, after = order[:-_PACE_STEPS], order[_PACE_STEPS:]
        passed_s = (part.row_ns[after] - part.row_ns[before]) / NS_PER_S
        way_m = np.hypot(*(values[_PACE_STEPS:] - values[:-_PACE_STEPS] for values in (x_m, y_m)))
        usable = (track[_PACE_STEPS:] == track[:-_PACE_STEPS]) & (passed_s > 0)
        speeds.append(way_m[usable] / passed_s[usable] / movers.unit_m)
    going = np.concatenate(speeds)
    going = going[going > _STANDS_M_PER_S]
    faster = float(np.median(going)) / WALK_M_PER_S if len(going) >= _LEAST_SPEEDS else 0.0
    return movers._replace(unit_m=movers.unit_m * faster) if faster > _FAST else movers


def _is_slow(frames: Sequence[Frame]) -> bool:
    """Whether tracks are at no higher rate than their samples: pictures are counted by the frames' ``index``."""
    passed = np.diff(frame_numbers(frames))
    return bool(len(passed)) and float(np.median(passed)) <= 1


#: Frames with about so many samples are read, and their online tracks written, at once.
_SAMPLES: Final = 2**12
#: The least noise (m) and speed (m/s): a covariance of 0 can't be inverted.
_MIN_SPREAD: Final = 1e-3


class LikelihoodPass(OnlinePass):
    """Online tracking over one log.

    Frames are read some at a time, and rows of online tracks are made of as many, because one frame has few of them.
    What later steps need is kept: the past positions of each track.
    """

    def __init__(self, options: LikelihoodOptions, movers: Movers, frames: FrameColumns) -> None:
        super().__init__(frames, options.rate_hz, options.bridged_s)
        rate, self._options, self._unit_m = options.rate_hz, options, movers.unit_m
        confirm_hits = self._confirm_hits = round(options.confirm_s * rate) + 1
        max_age = max(1, round(options.max_age_s * rate))
        noise = DEFAULT_NOISE_M if options.noise_m is None else options.noise_m / movers.unit_m
        self._tracker = OnlineTracker(
            model=motion_model(options, noise, movers),
            same_id=options.same_id_bonus,
            merge_distance_m=options.merge_distance_m / movers.unit_m,
            merge_timeout_s=options.merge_timeout_s,
            max_age=max_age,
            confirm_hits=confirm_hits,
            max_age_tentative=min(confirm_hits, max_age),
            estimate_noise=options.noise_m is None,
        )
        self._shown = ShownTracks(confirm_hits, round(options.coast_s * rate), max_age, options.adapt_online)
        self._links = OnlineLinks(self._tracker.model, options.link_s, options.link_confidence, confirm_hits)
        self._online = FrameCollector(TRACKS)
        self._forecasts = OnlineForecasts(options.predictor, options.horizon_s, rate, options.adapt, movers.unit_m)
        self._recent = Histories(self._forecasts.past)  # of tracks, in m
        for low, high in spans_of(frames.ends, _SAMPLES):
            self._track(join_frames(TRACKS, frames, low, high), frames.numbers[low:high], slice(low, high))
        self.noise_m = self._tracker.noise_m

    def outputs(self) -> tuple[FrameColumns, FrameColumns]:
        return self._online.done(), self._forecasts.done()

    def _track(self, part: JoinedFrames, numbers: Ints, here: slice) -> None:
        """Track through some frames, and write these steps."""
        steps, passed, first = self.steps[here], self.passed[here], self.samples.ends[here.start]
        # observations of each step, ordered by their input ids
        row = np.lexsort((part.rows["track_id"], part.frame))
        if not self._options.interpolated:
            row = row[part.rows["observed"][row]]
        source = part.rows["track_id"][row]
        xy_m = np.stack([part.rows["x_m"][row], part.rows["y_m"][row]]) / self._unit_m
        bounds = pairwise(np.searchsorted(part.frame[row], np.arange(len(steps) + 1)).tolist())
        results = [
            self._tracker.step(xy_m[:, low:high], source[low:high], first + row[low:high], by)
            for (low, high), by in zip(bounds, passed.tolist(), strict=True)
        ]
        tracks, mean, cov = (np.concatenate(all_, axis=-1) for all_ in zip(*results, strict=True))
        tick = group_index([numbers.shape[1] for numbers, *_ in results])
        self._write(Alive(steps, passed, tick, tracks, State(mean.T, cov.T)), part, numbers, first)

    def _write(self, alive: Alive, part: JoinedFrames, numbers: Ints, first: int) -> None:
        """Make the rows of online tracks, and their predictions, of steps of which ``first`` is the first sample."""
        steps, tick, ids, place = alive.steps, alive.tick, alive.tracks[IDS], alive.state.mean[:, :2]
        is_observed, seen_m = alive.is_observed, np.full((len(ids), 2), np.nan)
        seen = part.rows[alive.tracks[SAMPLE, is_observed] - first]
        seen_m[is_observed] = np.stack([seen["x_m"], seen["y_m"]], axis=-1)
        self.assignments.add(steps[tick[is_observed]], ids[is_observed], seen["track_id"])
        names, is_shown = self._links(alive, self._shown(alive) & np.isfinite(place[:, 0]))
        shown = np.flatnonzero(is_shown)
        shown = shown[np.lexsort((names[shown], tick[shown]))]

        rows, coasts = self.samples.take(alive.tracks[SAMPLE, shown]), ~is_observed[shown]
        rows["source_id"] = np.where(coasts, -1, rows["track_id"])
        rows["track_id"] = names[shown]
        rows["observed"] &= ~coasts
        xy_m = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
        xy_m[coasts] = place[shown[coasts]] * self._unit_m
        rows = move_rows(rows, xy_m, self._options.ground_planes, part.t_ns[tick[shown]])
        ticks = np.arange(len(steps) + 1)
        past = self._recent.push_all(alive.passed, np.searchsorted(tick, ticks), ids, seen_m)[0][shown]
        past[:, -1] = xy_m
        self._online.extend(part.t_ns, numbers, np.searchsorted(tick[shown], ticks), rows)
        confirmed = np.flatnonzero(alive.tracks[HITS, shown] >= self._confirm_hits)  # before, velocities are unknown
        known = np.isfinite(past[..., 0])
        waiting = taken(Unpredicted(names[shown], past, known, coasts, steps[tick[shown]]), confirmed)
        self._forecasts.add(part.t_ns, numbers, np.searchsorted(tick[shown[confirmed]], ticks), waiting)


def motion_model(options: RetrackOptions, noise_m: float, movers: Movers = PEOPLE) -> MotionModel:
    """The motion model of the options, with this noise of measured positions."""
    noise_m, speed_m_per_s = max(noise_m, _MIN_SPREAD), max(options.speed_m_per_s, _MIN_SPREAD)
    if movers.drift_m_per_s is not None:
        return MotionModel(noise_m, speed_m_per_s, movers.drift_m_per_s / movers.unit_m, 0.0, 1 / options.rate_hz)
    return MotionModel(noise_m, speed_m_per_s, options.drift_m_per_s, options.drift_ratio, 1 / options.rate_hz)


# Online re-tracking of tracks in metres: input ids are kept.
#
# A tracker of 3D boxes associates in metres and at the boxes' own rate, which is more than samples can add. What is
# left is done offline: to link tracks over long gaps, to leave out false ones, and to smooth. Letters: R rows, K
# tracks.


class KeptIds(OnlinePass):
    """Online re-tracking that keeps the ids of the input.

    Parameters
    ----------
    options : RetrackOptions
    movers : Movers
    frames : FrameColumns
        Samples of tracks; each goes to the track of its input id.
    """

    def __init__(self, options: RetrackOptions, movers: Movers, frames: FrameColumns) -> None:
        super().__init__(frames, options.rate_hz, LAST_NS / NS_PER_S)
        self.noise_m = (DEFAULT_NOISE_M if options.noise_m is None else options.noise_m) / movers.unit_m
        settings = options.predictor, options.horizon_s, options.min_history, options.rate_hz
        self._forecaster = Forecaster(*settings, options.class_names, options.class_limits, adapt=options.adapt)
        source = column(frames, "track_id")
        ids, first, which = np.unique(source, return_index=True, return_inverse=True)
        number = np.empty(len(ids), np.int64)
        frame = group_index(np.diff(frames.ends))
        number[np.lexsort((ids, frame[first]))] = np.arange(1, len(ids) + 1)  # in the order in which they come
        self.assignments.add(self.steps[frame], number[which], source)

        def numbered(joined: JoinedFrames) -> Rows:
            rows = joined.rows.take(np.lexsort((joined.rows["track_id"], joined.frame)))
            rows["source_id"] = rows["track_id"]
            rows["track_id"] = number[np.searchsorted(ids, rows["track_id"])]
            return rows

        self.online = mapped_rows(TRACKS, frames, numbered)

    def outputs(self) -> tuple[FrameColumns, FrameColumns]:
        return self.online, self._forecaster.predict_all(self.online)
