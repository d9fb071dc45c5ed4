"""Offline re-tracking: tracks of the whole log, linked, with identity swaps resolved, interpolated and smoothed.

Letters: C assignments (a track has a sample at a step), R rows, K tracks, N rows of trajectories.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import repeat
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.ragged import group_index
from mcaptrack.schema import APPEARANCE, DECISIONS, Rows
from mcaptrack.transforms.retrack.appearance import Appearance
from mcaptrack.transforms.retrack.appearance_calibration import AppearanceCalibration
from mcaptrack.transforms.retrack.appearance_rows import appearance_rows
from mcaptrack.transforms.retrack.assignments import Assignments
from mcaptrack.transforms.retrack.by_class import PEOPLE, Movers
from mcaptrack.transforms.retrack.cut_links import CutTracks, link_pieces
from mcaptrack.transforms.retrack.decisions import Decided, decision_rows
from mcaptrack.transforms.retrack.false_tracks import log_odds_in_log, probability, scored_log_odds
from mcaptrack.transforms.retrack.fixed_tracks import fix_tracks
from mcaptrack.transforms.retrack.identity_swaps import resolve_swaps
from mcaptrack.transforms.retrack.joins import Tracked, cut_joins
from mcaptrack.transforms.retrack.linking import link_tracks
from mcaptrack.transforms.retrack.motion_model import MotionModel, State, filtered, smooth, to_trajectories
from mcaptrack.transforms.retrack.offline_rows import Moved, TrackRows, moved_to, rows_by_step
from mcaptrack.transforms.retrack.options import RetrackOptions
from mcaptrack.transforms.retrack.samples import LogSamples

#: Links of tracks in metres miss by at most so much, and so much more for each second of the gap.
MAX_MISFIT: Final = (0.6, 0.2)
#: Tracks in metres were confirmed by the scores of their detections: they may be shorter by this factor.
_CONFIRMED_SHARE: Final = 0.25
#: The number of times that encounters are examined again after identities were swapped.
_ROUNDS: Final = 5


class Offline(NamedTuple):
    """The rows of all tracks at each step, ordered by id; the decisions at each step, and what tracks look like, if
    they were asked for; and how appearance tells people apart, None if nothing was seen of them.
    """

    tracks: Iterator[Rows]
    decisions: Iterator[Rows]
    looks: Iterator[Rows]
    calibration: AppearanceCalibration | None


def offline_tracks(
    options: RetrackOptions,
    model: MotionModel,
    assignments: Assignments,
    samples: LogSamples,
    steps: Sequence[int],
    times_ns: Ints,
    movers: Movers = PEOPLE,
) -> Offline:
    """The rows of all tracks at each of ``steps``, and those of further outputs if ``options`` writes them.

    ``samples`` are those of all steps, ``times_ns`` the times of these; ``model`` is in the unit of ``movers``. A
    sample that was assigned to two tracks goes to the one that had it first, unless both keep it (``shares_samples``),
    as in the authors' program.
    """
    step, track, source, sample = assignments.of(samples, steps)
    if not options.shares_samples:
        _, kept = np.unique(sample, return_index=True)
        step, track, source, sample = step[kept], track[kept], source[kept], sample[kept]
    xy = np.stack([samples.column(name)[sample] for name in ("x_m", "y_m")], axis=-1) / movers.unit_m
    step_s = 1 / options.rate_hz
    seen_ns = times_ns[np.searchsorted(steps, step)]
    seen = Appearance.of(options.looks, seen_ns, step, source, xy, step_s)
    appearance = seen if seen and seen.calibration.tells_apart else None
    if options.link_s > 0 and len(track):
        pieces: CutTracks | None = None
        if not movers.on_ground:
            track, cuts = cut_joins(model, step, track, source, xy, step_s, options.link_confidence, appearance)
            pieces = CutTracks.of(step, track, source, cuts)
        track = _linked(options, model, step, track, xy, step_s, movers, pieces, appearance)
    if options.resolve_swaps and len(track) and not movers.on_ground:
        track = _without_swaps(model, step, track, source, xy, step_s, appearance)
    track = fix_tracks(step, track, source, options.fixed_ids)
    kept_tracks = np.unique(track[np.isin(source, np.array(options.fixed_ids, np.int64))])
    order = np.lexsort((step, track))
    step, track, source, sample = step[order], track[order], source[order], sample[order]
    rows = TrackRows.of(step, track, sample)
    is_kept = np.isin(rows.step, np.array(steps, np.int64))  # inside gaps of the log there are no frames
    is_decided = DECISIONS in options.writes.values()
    moved: Moved | None = None
    states: tuple[State, State] | None = None
    ids = np.unique(track)
    odds = np.full(len(ids), np.inf)
    if len(step) and (options.smooth or options.track_confidence > 0 or is_decided):
        _, row, trajectories = to_trajectories(step, track, xy[order], model.noise_m)
        forward, backward, smoothed = smooth(model, trajectories, step_s)
        states = forward.take(row), backward.take(row)
        if options.smooth:  # rows and trajectories are both ordered by track, then by step
            when = times_ns[np.minimum(np.searchsorted(steps, rows.step), len(times_ns) - 1)]
            moved = moved_to(smoothed.mean[:, :2] * movers.unit_m, rows, samples, options.ground_planes, when)
        if movers.on_ground:
            odds = scored_log_odds(
                smoothed.mean[:, :2] * movers.unit_m,
                trajectories.first,
                rows.between(samples.column("score")),
                samples.column("observed")[rows.before] & rows.is_sample,
                movers.usual_score,
                step_s,
            )
        else:
            odds = log_odds_in_log(model, trajectories, smoothed, step_s, (steps[0], steps[-1]))
    is_sure = probability(odds) >= options.track_confidence
    is_fixed = np.isin(ids, kept_tracks)
    min_track_s = options.min_track_s * (_CONFIRMED_SHARE if movers.on_ground else 1.0)
    length = np.bincount(np.searchsorted(ids, rows.track), minlength=len(ids))
    keeps = is_fixed | (is_sure & (length >= round(min_track_s * options.rate_hz) + 1))
    left = np.flatnonzero(is_kept & keeps[np.searchsorted(ids, rows.track)])
    decisions: Iterator[Rows] = repeat(DECISIONS.empty(), len(steps))
    if is_decided and states is not None:
        tracked = Tracked(step, track, source, *states)
        ordered = None if appearance is None else appearance.take(order)
        decided = Decided(tracked, sample, np.where(is_fixed, np.inf, odds), keeps, ordered)
        decisions = decision_rows(decided, model, samples, steps, step_s)
    made = rows_by_step(rows.take(left), samples, moved and moved.take(left), steps)
    looks: Iterator[Rows] = repeat(APPEARANCE.empty(), len(steps))
    if (stored := options.stored_looks) is not None:
        kept = np.flatnonzero(keeps[np.searchsorted(ids, track)])
        seen_ns = times_ns[np.searchsorted(steps, step[kept])]
        looks = appearance_rows(stored, stored.tracks_of(seen_ns, source[kept], track[kept]), times_ns)
    return Offline(made, decisions, looks, seen and seen.calibration)


def _without_swaps(
    model: MotionModel,
    step: Ints,
    track: Ints,
    source: Ints,
    xy: Floats,
    step_s: float,
    appearance: Appearance | None = None,
) -> Ints:
    """The track of each assignment (C,) after deciding again which track is which where two of them met."""
    examined: Ints | None = None  # tracks that were changed: the encounters of all others stay as they are
    for _ in range(_ROUNDS):
        ids, row, trajectories = to_trajectories(step, track, xy, model.noise_m)
        which = None if examined is None else np.isin(ids, examined)
        seen = None if appearance is None else appearance.between(step, track, step_s)
        owner, changed = resolve_swaps(model, trajectories, row, source, step_s, which, seen)
        track = ids[owner[row]]
        if not changed:
            break
        own = group_index(np.diff(trajectories.first))
        examined = ids[np.unique(own[owner != own])]
    return track


def _linked(
    options: RetrackOptions,
    model: MotionModel,
    step: Ints,
    track: Ints,
    xy: Floats,
    step_s: float,
    movers: Movers,
    pieces: CutTracks | None,
    appearance: Appearance | None = None,
) -> Ints:
    """The track of each assignment (C,) after linking tracks of the same person."""
    ids, _, trajectories = to_trajectories(step, track, xy, model.noise_m)
    forward, backward = filtered(model, trajectories, step_s)
    limits = options.link_s / movers.unit_m, options.link_confidence
    seen = None if appearance is None else appearance.between(step, track, step_s).of_tracks
    if pieces is None:
        continued_by = link_tracks(model, trajectories, forward, backward, step_s, *limits, MAX_MISFIT, seen)
    else:
        continued_by = link_pieces(model, trajectories, forward, backward, step_s, *limits, pieces, seen)
    root = np.arange(len(ids))
    order = np.argsort(trajectories.step[trajectories.first[:-1]], kind="stable")  # a continuation begins later
    for one in order[continued_by[order] >= 0].tolist():
        root[continued_by[one]] = root[one]
    return np.asarray(ids[root][np.searchsorted(ids, track)])
