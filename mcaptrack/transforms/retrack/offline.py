"""Offline re-tracking: tracks of the whole log, linked, with identity swaps resolved, interpolated and smoothed.

Letters: C assignments (a track has a sample at a step), R rows, K tracks, N rows of trajectories.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from mcaptrack.geometry.angles import wrapped
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.plane import Planes
from mcaptrack.geometry.ragged import group_index, ragged_range, run_ends, run_starts
from mcaptrack.schema import TRACKS, Rows
from mcaptrack.schema.resampling import ANGLES, LINEAR
from mcaptrack.transforms.retrack.assignments import Assignments
from mcaptrack.transforms.retrack.by_class import PEOPLE, Movers
from mcaptrack.transforms.retrack.false_tracks import scored_confidence, track_confidence
from mcaptrack.transforms.retrack.identity_swaps import resolve_swaps
from mcaptrack.transforms.retrack.linking import link_tracks
from mcaptrack.transforms.retrack.motion_model import MotionModel, smooth, to_trajectories
from mcaptrack.transforms.retrack.options import RetrackOptions

#: Links of tracks in metres miss by at most so much, and so much more for each second of the gap.
MAX_MISFIT: Final = (0.6, 0.2)
#: Tracks in metres were confirmed by the scores of their detections: they may be shorter by this factor.
_CONFIRMED_SHARE: Final = 0.25
#: The number of times that encounters are examined again after identities were swapped.
_ROUNDS: Final = 3


def offline_tracks(
    options: RetrackOptions,
    model: MotionModel,
    assignments: Assignments,
    sample_rows: Sequence[Rows],
    steps: Sequence[int],
    times_ns: Sequence[int],
    movers: Movers = PEOPLE,
) -> tuple[Rows, Ints]:
    """The rows of all tracks, ordered by step and id, and the step of each.

    ``sample_rows`` are the input rows of each of ``steps``; ``model`` is in the unit of ``movers``. A sample that was
    assigned to two tracks goes to the one that had it first, unless both keep it (``shares_samples``), as in the
    authors' program.
    """
    samples = TRACKS.joined(sample_rows)
    step, track, source, sample = assignments.of(samples, steps, [len(rows) for rows in sample_rows])
    if not options.shares_samples:
        _, kept = np.unique(sample, return_index=True)
        step, track, source, sample = step[kept], track[kept], source[kept], sample[kept]
    xy = np.stack([samples["x_m"][sample], samples["y_m"][sample]], axis=-1) / movers.unit_m
    step_s = 1 / options.rate_hz
    if options.link_s > 0 and len(track):
        track = _linked(options, model, step, track, xy, step_s, movers)
    if options.resolve_swaps and len(track) and not movers.on_ground:
        for _ in range(_ROUNDS):
            ids, row, trajectories = to_trajectories(step, track, xy, model.noise_m)
            owner, changed = resolve_swaps(model, trajectories, row, source, step_s)
            track = ids[owner[row]]
            if not changed:
                break
    order = np.lexsort((step, track))
    step, track, sample = step[order], track[order], sample[order]
    rows, row_step = _interpolated(samples, step, track, sample)
    if len(rows) and (options.smooth or options.track_confidence > 0):
        ids, _, trajectories = to_trajectories(step, track, xy[order], model.noise_m)
        _, _, smoothed = smooth(model, trajectories, step_s)
        if options.smooth:  # rows and trajectories are both ordered by track, then by step
            when = np.array(times_ns, np.int64)[np.minimum(np.searchsorted(steps, row_step), len(times_ns) - 1)]
            rows = move_rows(rows, smoothed.mean[:, :2] * movers.unit_m, options.ground_planes, when)
        if movers.on_ground:
            confidence = scored_confidence(
                smoothed.mean[:, :2] * movers.unit_m,
                trajectories.first,
                rows["score"],
                rows["observed"],
                movers.usual_score,
                step_s,
            )
        else:
            confidence = track_confidence(model, trajectories, smoothed, step_s)
        kept_rows = (confidence >= options.track_confidence)[np.searchsorted(ids, rows["track_id"])]
        rows, row_step = rows[kept_rows], row_step[kept_rows]
    min_track_s = options.min_track_s * (_CONFIRMED_SHARE if movers.on_ground else 1.0)
    min_rows = round(min_track_s * options.rate_hz) + 1
    ids, which, lengths = np.unique(rows["track_id"], return_inverse=True, return_counts=True)
    has_frame = np.isin(row_step, np.array(steps, np.int64))  # inside gaps of the log there are no frames
    is_long = lengths[which] >= min_rows if len(ids) else np.zeros(0, bool)
    rows, row_step = rows[is_long & has_frame], row_step[is_long & has_frame]
    order = np.lexsort((rows["track_id"], row_step))
    return rows[order], row_step[order]


def _linked(
    options: RetrackOptions, model: MotionModel, step: Ints, track: Ints, xy: Floats, step_s: float, movers: Movers
) -> Ints:
    """The track of each assignment (C,) after linking tracks of the same person."""
    ids, _, trajectories = to_trajectories(step, track, xy, model.noise_m)
    forward, backward, _ = smooth(model, trajectories, step_s)
    limits = (options.link_s / movers.unit_m, options.link_confidence, *((MAX_MISFIT,) if movers.on_ground else ()))
    continued_by = link_tracks(model, trajectories, forward, backward, step_s, *limits)
    root = np.arange(len(ids))
    order = np.argsort(trajectories.step[trajectories.first[:-1]], kind="stable")  # a continuation begins later
    for one in order[continued_by[order] >= 0].tolist():
        root[continued_by[one]] = root[one]
    return np.asarray(ids[root][np.searchsorted(ids, track)])


def _interpolated(samples: Rows, step: Ints, track: Ints, sample: Ints) -> tuple[Rows, Ints]:
    """A row for every step of every track from its first to its last, linearly interpolated inside gaps."""
    is_last = run_ends(run_starts(track))
    count = np.where(is_last, 1, np.append(step[1:], 0)[: len(step)] - step)
    before, within = group_index(count), ragged_range(0, count)
    after = np.where(within > 0, before + 1, before)
    share = within / count[before]
    rows = samples[sample[before]].copy()
    for name in LINEAR:
        rows[name] += share * (samples[name][sample[after]] - samples[name][sample[before]])
    for name in ANGLES:
        step_rad = wrapped(samples[name][sample[after]] - samples[name][sample[before]])
        rows[name] = np.where(within == 0, rows[name], wrapped(rows[name] + share * step_rad))
    rows["source_id"] = np.where(within == 0, rows["track_id"], -1)
    rows["observed"] &= within == 0
    rows["track_id"] = track[before]
    return rows, step[before] + within


def move_rows(rows: Rows, xy_m: Floats, planes: Planes, t_ns: Ints) -> Rows:
    """Move rows (R,) to other positions (R, 2), and their boxes with them if there is a ground plane at their times."""
    out = rows.copy()
    which = np.maximum(np.searchsorted([since_ns for since_ns, _ in planes], t_ns, side="right") - 1, 0)
    for number in np.unique(which).tolist() if planes else ():
        plane, here = planes[number][1], which == number
        size = columns_to_boxes(rows[here])[:, 2:]
        shift = plane.standing_boxes(xy_m[here], size) - plane.standing_boxes(
            np.stack([rows["x_m"][here], rows["y_m"][here]], axis=-1), size
        )
        shift = np.where(np.isfinite(shift), shift, 0.0)
        out["x_px"][here] += shift[:, 0]
        out["y_px"][here] += shift[:, 1]
    out["x_m"], out["y_m"] = xy_m.T
    return out
