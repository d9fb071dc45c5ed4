"""Offline re-tracking: tracks of the whole log, linked, with identity swaps resolved, interpolated and smoothed.

Letters: C assignments (a track has a sample at a step), R rows, K tracks, N rows of trajectories.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise, repeat
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.angles import wrapped
from mcaptrack.geometry.arrays import Bools, Floats, Ints, taken
from mcaptrack.geometry.plane import Planes
from mcaptrack.geometry.ragged import group_index, ragged_range, run_ends, run_starts
from mcaptrack.schema import APPEARANCE, DECISIONS, WORLDS, Rows
from mcaptrack.schema.classes import majority
from mcaptrack.schema.frame_columns import FrameColumns
from mcaptrack.schema.framing import spans_of
from mcaptrack.schema.resampling import ANGLES, LINEAR
from mcaptrack.transforms.retrack.answers import CERTAIN, Answers, fix_tracks
from mcaptrack.transforms.retrack.appearance import Appearance, AppearanceCalibration, Descriptors, appearance_rows
from mcaptrack.transforms.retrack.assignments import PEOPLE, Movers, OnlinePass, Tracks, column
from mcaptrack.transforms.retrack.decisions import (
    PERSON,
    SHORT,
    Decided,
    Worlds,
    decision_rows,
    draw_worlds,
    world_rows,
)
from mcaptrack.transforms.retrack.false_tracks import log_odds_in_log, scored_log_odds
from mcaptrack.transforms.retrack.hypotheses import Hypotheses
from mcaptrack.transforms.retrack.identity_swaps import resolve_swaps
from mcaptrack.transforms.retrack.motion_model import (
    MotionModel,
    State,
    Trajectories,
    smooth,
    smooth_in_log,
    to_trajectories,
)
from mcaptrack.transforms.retrack.options import RetrackOptions
from mcaptrack.transforms.retrack.weights import probability
from mcaptrack.transforms.to_video_rate import move_rows

#: Tracks in metres were confirmed by the scores of their detections: they may be shorter by this factor.
_CONFIRMED_SHARE: Final = 0.25
#: Tracks with samples in a smaller share of their steps are as long as they were seen at once.
_SPARSE: Final = 0.25
#: The log odds of tracks that are left out because they are too short are no larger.
_SHORT: Final = -0.05
#: Identities are decided so often, each time with the motion of the tracks that were decided before.
_SWEEPS: Final = 2
#: The number of times that encounters are examined again after identities were swapped.
_ROUNDS: Final = 5


class Offline(NamedTuple):
    """The rows of all tracks at each step, ordered by id; the decisions at each step, what tracks look like, and the
    identities in worlds, if they were asked for; how appearance tells people apart, None if nothing was seen of them.
    """

    tracks: Iterator[Rows]
    decisions: Iterator[Rows]
    looks: Iterator[Rows]
    worlds: Iterator[Rows]
    calibration: AppearanceCalibration | None


# Rows of offline tracks: described by a few numbers each while tracks are decided about, then made part by part.
#
# Letters: C assignments, R rows, N samples.


class TrackRows(NamedTuple):
    """Rows (R,) that are interpolated between samples.

    Attributes
    ----------
    track, step : (R,) of int
    before, after : (R,) of int
        The samples of the track before and after the row; both are the row's own where it has one.
    share : (R,) of float
        How far the row is on the way between the two, from 0 to 1.
    """

    track: Ints
    step: Ints
    before: Ints
    after: Ints
    share: Floats

    @classmethod
    def of(cls, step: Ints, track: Ints, sample: Ints) -> TrackRows:
        """A row for every step of every track from its first to its last; assignments (C,) are by track, then step."""
        is_last = run_ends(run_starts(track))
        count = np.where(is_last, 1, np.append(step[1:], 0)[: len(step)] - step)
        before, within = group_index(count), ragged_range(0, count)
        after = np.where(within > 0, before + 1, before)
        return cls(track[before], step[before] + within, sample[before], sample[after], within / count[before])

    @property
    def is_sample(self) -> Bools:
        """Whether each row is a sample, (R,), and not between two."""
        return np.asarray(self.share == 0)

    def between(self, values: NDArray[Any]) -> NDArray[Any]:
        """A column of the samples (N,), linearly interpolated, (R,)."""
        out = values[self.before]
        out += self.share * (values[self.after] - out)
        return out


def rows_by_step(
    rows: TrackRows, samples: FrameColumns, xy_m: Floats | None, planes: Planes, steps: Ints, times_ns: Ints
) -> Iterator[Rows]:
    """The rows of tracks at each of ``steps``, at ``times_ns``, ordered by id; each track has the class of most of its
    rows.

    Rows are moved to ``xy_m`` (R, 2), if any; boxes in the picture move with those between samples, those of samples
    stay.
    """
    order = np.lexsort((rows.track, rows.step))
    rows = taken(rows, order)
    ends = np.append(0, np.searchsorted(rows.step, steps, "right"))
    ids, track = np.unique(rows.track, return_inverse=True)
    class_id = majority(track, column(samples, "class_id")[rows.before], len(ids))[track]
    for low, high in spans_of(ends):
        here = slice(ends[low], ends[high])
        those = taken(rows, here)
        part = _rows(those, samples)
        part["class_id"] = class_id[here]
        if xy_m is not None:
            to_m, between = xy_m[order[here]], np.flatnonzero(~those.is_sample)
            at_ns = times_ns[np.searchsorted(steps, those.step[between])]
            part[between] = move_rows(part.take(between), to_m[between], planes, at_ns)
            part["x_m"], part["y_m"] = to_m.T
        bounds = (ends[low : high + 1] - ends[low]).tolist()
        yield from (part[start:end] for start, end in pairwise(bounds))


def _rows(which: TrackRows, samples: FrameColumns) -> Rows:
    """Rows (R,) of tracks."""
    before, is_sample = samples.take(which.before), which.is_sample
    after, rows = before.copy(), before.copy()
    after[~is_sample] = samples.take(which.after[~is_sample])
    for name in LINEAR:
        rows[name] += which.share * (after[name] - before[name])
    for name in ANGLES:
        step_rad = wrapped(after[name] - before[name])
        rows[name] = np.where(is_sample, rows[name], wrapped(rows[name] + which.share * step_rad))
    rows["source_id"] = np.where(is_sample, rows["track_id"], -1)
    rows["observed"] &= is_sample
    rows["track_id"] = which.track
    return rows


def offline_tracks(options: RetrackOptions, model: MotionModel, run: OnlinePass, movers: Movers = PEOPLE) -> Offline:
    """The rows of all tracks at each step, and those of further outputs if ``options`` writes them.

    ``model`` is in the unit of ``movers``. A sample that was assigned to two tracks goes to the one that had it first,
    unless both keep it (``shares_samples``), as in the authors' program.
    """
    samples, steps, times_ns = run.samples, run.steps, run.samples.t_ns
    step, track, source, sample = run.assignments.of(samples, steps)
    xy = np.stack([column(samples, name)[sample] for name in ("x_m", "y_m")], axis=-1) / movers.unit_m
    descriptors = options.stored_looks if options.looks is None else options.looks
    seen_ns = times_ns[np.searchsorted(steps, step)]
    look = np.full(len(step), -1) if descriptors is None else descriptors.find(seen_ns, source)
    tracks = Tracks(step, track, source, sample, xy, look, track)
    if not options.shares_samples:
        tracks = taken(tracks, np.unique(sample, return_index=True)[1])
    seen = Appearance.of(options.looks, tracks, model.step_s)
    appearance = seen if seen and seen.calibration.tells_apart else None
    answers = Answers.of(options.answers, steps, times_ns)

    def hypotheses_in(tracks: Tracks, is_final: bool = False) -> Hypotheses:
        return hypotheses_of(model, tracks, options.link_s / movers.unit_m, appearance, answers, is_final)

    if options.link_s > 0 and len(tracks.step):
        tracks = _linked(hypotheses_in, tracks, options.link_confidence)
    if options.resolve_swaps and len(tracks.step) and not movers.on_ground:
        tracks = _without_swaps(model, tracks, appearance)
    if len(tracks.step) and answers.is_certain.any():
        tracks = answers.obeyed(tracks, hypotheses_in(tracks), options.link_confidence)
    tracks = fix_tracks(tracks, options.fixed_ids)
    tracks = taken(tracks, tracks.order)
    rows = TrackRows.of(tracks.step, tracks.track, tracks.sample)
    is_decided = DECISIONS in options.writes.values()
    moved_m: Floats | None = None
    ids, of = np.unique(tracks.track, return_inverse=True)
    is_fixed = np.isin(ids, tracks.track[np.isin(tracks.source, np.array(options.fixed_ids, np.int64))])
    is_fixed |= np.isin(ids, answers.persons(tracks, yes=True))
    is_clutter = np.isin(ids, answers.persons(tracks, yes=False)) & ~is_fixed
    of_row = np.searchsorted(ids, rows.track)
    least_s = options.shortest_s((steps[-1] - steps[0]) * model.step_s if len(steps) else 0.0)
    least_s *= _CONFIRMED_SHARE if movers.on_ground else 1.0
    is_short = _are_short(of_row, rows.is_sample, len(ids), round(least_s * options.rate_hz) + 1)
    odds = np.full(len(ids), np.inf)
    if len(ids) and (options.smooth or options.track_confidence > 0 or is_decided):
        _, _, trajectories = to_trajectories(tracks.step, tracks.track, tracks.xy_m)
        smoothed = smooth(model, trajectories)
        if options.smooth:  # rows and trajectories are both ordered by track, then by step
            moved_m = movers.unit_m * smooth_in_log(model, trajectories, options.noise_m is not None, movers.unit_m)
        log = steps[0], steps[-1]
        odds = _log_odds(model, trajectories, smoothed, rows, samples, movers, log, is_short)
    odds = np.where(is_short, np.minimum(odds, _SHORT), odds)
    odds = np.where(is_clutter, -CERTAIN, odds)
    keeps = is_fixed | ((probability(odds) >= options.track_confidence) & ~is_short & ~is_clutter)
    has_frame = np.isin(rows.step, np.array(steps, np.int64))  # inside gaps of the log there are none
    left = np.flatnonzero(keeps[of_row] & has_frame)
    decisions: Iterator[Rows] = repeat(DECISIONS.empty(), len(steps))
    worlds: Iterator[Rows] = repeat(WORLDS.empty(), len(steps))
    if is_decided and len(ids):
        hypotheses = hypotheses_in(tracks, is_final=True)
        decided = Decided(tracks, np.where(is_fixed, np.inf, odds), keeps, hypotheses)
        if options.drawn_worlds:
            drawn = _worlds(options, decided, round(least_s * options.rate_hz), samples)
            worlds = world_rows(drawn, hypotheses, model.step_s, steps)
        decisions = decision_rows(decided, model, samples, steps)
    shown_m = None if moved_m is None else moved_m[left]
    by_step = rows_by_step(taken(rows, left), samples, shown_m, options.ground_planes, steps, times_ns)
    looks: Iterator[Rows] = repeat(APPEARANCE.empty(), len(steps))
    if (stored := options.stored_looks) is not None:
        looks = _looks(stored, taken(tracks, keeps[of] & (tracks.look >= 0)), times_ns)
    return Offline(by_step, decisions, looks, worlds, seen and seen.calibration)


def _are_short(of_row: Ints, is_sample: Bools, count: int, least: int) -> Bools:
    """Which of so many tracks have fewer than ``least`` rows (R,); in a row, if they were hardly seen in between.

    What flickers at one place, as leaves do, is joined to long tracks with a sample now and then.
    """
    length, seen = np.bincount(of_row, minlength=count), np.bincount(of_row[is_sample], minlength=count)
    starts = np.flatnonzero(run_starts(of_row, is_sample))
    lasts = np.where(is_sample[starts], np.diff(np.append(starts, len(of_row))), 0)
    longest = np.zeros(count, np.int64)
    np.maximum.at(longest, of_row[starts], lasts)
    return np.asarray(np.where(seen < _SPARSE * length, longest, length) < least)


def _looks(stored: Descriptors, kept: Tracks, times_ns: Ints) -> Iterator[Rows]:
    """The rows of Appearance of the tracks that were kept, at each of ``times_ns``."""
    track_of = np.full(len(stored.t_ns), -1)
    track_of[kept.look] = kept.track
    return appearance_rows(stored, track_of, times_ns)


def _log_odds(
    model: MotionModel,
    trajectories: Trajectories,
    smoothed: State,
    rows: TrackRows,
    samples: FrameColumns,
    movers: Movers,
    log: tuple[int, int],
    is_short: Bools,
) -> Floats:
    """The log odds (K,) that tracks are people, or what else moves; ``log`` are its first and last steps."""
    if not movers.on_ground:
        odds = log_odds_in_log(model, trajectories, smoothed, log)[:, None]
        return np.where(is_short, SHORT.log_odds(odds), PERSON.log_odds(odds))
    return scored_log_odds(
        smoothed.mean[:, :2] * movers.unit_m,
        trajectories.first,
        rows.between(column(samples, "score")),
        column(samples, "observed")[rows.before] & rows.is_sample,
        movers.usual_score,
        model.step_s,
    )


def _worlds(options: RetrackOptions, decided: Decided, least_steps: int, samples: FrameColumns) -> Worlds:
    """The worlds of what was decided."""
    tracks, log_odds, kept, hypotheses = decided
    tracklets = hypotheses.tracklets
    of_class = int(column(samples, "class_id")[0])
    worlds = draw_worlds(
        options.drawn_worlds,
        hypotheses,
        tracks.track[tracklets.first],
        log_odds,
        kept,
        options.link_confidence,
        least_steps,
        of_class,
    )
    if options.fixed_ids:
        for track in worlds.track:
            track[:] = fix_tracks(tracks._replace(track=track[tracklets.of]), options.fixed_ids).track[tracklets.first]
    return worlds


def _without_swaps(model: MotionModel, tracks: Tracks, appearance: Appearance | None) -> Tracks:
    """Undo swaps of tracks that met."""
    examined: Ints | None = None  # tracks that were changed: the encounters of all others stay as they are
    for _ in range(_ROUNDS):
        ids, row, trajectories = to_trajectories(tracks.step, tracks.track, tracks.xy_m)
        which = None if examined is None else np.isin(ids, examined)
        seen = None if appearance is None else appearance.between(tracks)
        owner, changed = resolve_swaps(model, trajectories, row, tracks.source, which, seen)
        tracks = tracks._replace(track=ids[owner[row]])
        if not changed:
            break
        own = group_index(np.diff(trajectories.first))
        examined = ids[np.unique(own[owner != own])]
    return tracks


def _linked(hypotheses_in: Callable[[Tracks], Hypotheses], tracks: Tracks, min_confidence: float) -> Tracks:
    """Decide about identities."""
    for _ in range(_SWEEPS):
        tracks = tracks._replace(track=hypotheses_in(tracks).scored().best(min_confidence))
    return tracks


def hypotheses_of(
    model: MotionModel,
    tracks: Tracks,
    max_gap_s: float,
    appearance: Appearance | None,
    answers: Answers,
    is_final: bool = False,
) -> Hypotheses:
    """The hypotheses about identities in tracks, with what the log shows of their looks, and what was answered."""
    hypotheses = Hypotheses.of(model, tracks, max_gap_s, answers.joined(tracks))
    looks = np.zeros(len(hypotheses.before))
    if appearance is not None:
        sides = appearance.between(tracks._replace(track=hypotheses.tracklets.of))
        looks = sides.of_tracks(hypotheses.before, hypotheses.after)
    looks = answers.weighed(hypotheses, tracks, looks, is_final)
    return hypotheses._replace(evidence=hypotheses.evidence + looks)
