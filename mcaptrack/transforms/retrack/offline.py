"""Offline re-tracking: tracks of the whole log, linked, with identity swaps resolved, interpolated and smoothed.

Letters: C assignments (a track has a sample at a step), R rows, K tracks, N rows of trajectories.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise, repeat
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools, Floats, Ints, taken
from mcaptrack.geometry.plane import Planes
from mcaptrack.geometry.ragged import group_index, ragged_range, run_ends, run_starts
from mcaptrack.schema import APPEARANCE, DECISIONS, TRACKS, WORLDS, Rows
from mcaptrack.schema.classes import majority
from mcaptrack.schema.frame_columns import FrameColumns
from mcaptrack.schema.framing import spans_of
from mcaptrack.schema.resampling import between
from mcaptrack.transforms.retrack.appearance import Appearance, AppearanceCalibration, Sides, appearance_rows
from mcaptrack.transforms.retrack.decisions import (
    CERTAIN,
    PERSON,
    SHORT,
    Answers,
    Decided,
    Worlds,
    decision_rows,
    draw_worlds,
    fix_tracks,
    world_rows,
)
from mcaptrack.transforms.retrack.false_tracks import log_odds_in_log, scored_log_odds
from mcaptrack.transforms.retrack.hypotheses import Hypotheses
from mcaptrack.transforms.retrack.identity_swaps import resolve_swaps
from mcaptrack.transforms.retrack.motion_model import (
    MotionModel,
    Tracks,
    Trajectories,
    smooth,
    smooth_in_log,
    to_trajectories,
)
from mcaptrack.transforms.retrack.options import APPEARANCE_OUTPUT, WORLDS_OUTPUT, RetrackOptions
from mcaptrack.transforms.retrack.passes import PEOPLE, Movers, OnlinePass, column
from mcaptrack.transforms.retrack.weights import probability
from mcaptrack.transforms.to_video_rate import move_rows

#: Tracks in metres were confirmed by the scores of their detections: they may be shorter by this factor.
_CONFIRMED_SHARE: Final = 0.25
#: The log odds of tracks that are left out because they are too short are no larger.
_SHORT: Final = -0.05


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
    after = before.copy()
    after[~is_sample] = samples.take(which.after[~is_sample])
    rows = between(before, after, which.share)
    rows["source_id"] = np.where(is_sample, rows["track_id"], -1)
    rows["observed"] &= is_sample
    rows["track_id"] = which.track
    return rows


class WholeLog(NamedTuple):
    """A log that is decided about: the options, how what moves in it moves, and what was done online.

    ``model`` is in the unit of ``movers``. ``appearance`` and ``answers`` also tell which tracks are one person.
    """

    options: RetrackOptions
    model: MotionModel
    movers: Movers
    run: OnlinePass
    appearance: Appearance | None
    answers: Answers

    @property
    def max_gap_s(self) -> float:
        """The longest gap of links."""
        return self.options.link_s / self.movers.unit_m

    @property
    def least_steps(self) -> int:
        """The least steps that tracks last."""
        steps, share = self.run.steps, _CONFIRMED_SHARE if self.movers.on_ground else 1.0
        least_s = share * self.options.shortest_s((steps[-1] - steps[0]) * self.model.step_s)
        return round(least_s * self.options.rate_hz)


def offline_tracks(
    options: RetrackOptions, model: MotionModel, run: OnlinePass, movers: Movers = PEOPLE
) -> tuple[dict[str, Iterator[Rows]], AppearanceCalibration | None]:
    """The rows of each output at each step, those of tracks ordered by id, and how appearance tells people apart.

    ``model`` is in the unit of ``movers``. A sample that was assigned to two tracks goes to the one that had it first,
    unless both keep it (``shares_samples``), as in the authors' program.
    """
    samples, steps, times_ns = run.samples, run.steps, run.samples.t_ns
    tracks = _as_assigned(options, run, movers)
    seen = Appearance.of(options.looks, tracks, model.step_s)
    calibration = seen and seen.calibration
    appearance = seen if calibration and calibration.tells_apart else None
    log = WholeLog(options, model, movers, run, appearance, Answers.of(options.answers, steps, times_ns))
    empty = {"": TRACKS, "decisions": DECISIONS, APPEARANCE_OUTPUT: APPEARANCE, WORLDS_OUTPUT: WORLDS}
    out: dict[str, Iterator[Rows]] = {name: repeat(schema.empty(), len(steps)) for name, schema in empty.items()}
    if not len(tracks.step):
        return out, calibration
    tracks = _identified(log, tracks)
    rows = TrackRows.of(tracks.step, tracks.track, tracks.sample)
    _, _, paths = to_trajectories(tracks.step, tracks.track, tracks.xy_m)
    log_odds, kept = _people(log, tracks, rows, paths)
    moved_m = None
    if options.smooth:  # rows and trajectories are both ordered by track, then by step
        moved_m = movers.unit_m * smooth_in_log(model, paths, options.noise_m is not None, movers.unit_m)
    is_kept = kept[group_index(np.diff(paths.first))]
    left = np.flatnonzero(is_kept & np.isin(rows.step, steps))  # inside gaps of the log there are no frames
    shown_m = None if moved_m is None else moved_m[left]
    out[""] = rows_by_step(taken(rows, left), samples, shown_m, options.ground_planes, steps, times_ns)
    if DECISIONS in options.writes.values():
        decided = Decided(tracks, log_odds, kept, hypotheses_of(log, tracks, is_final=True))
        if options.worlds:
            out[WORLDS_OUTPUT] = world_rows(_worlds(log, decided), decided.hypotheses, model.step_s, steps)
        out["decisions"] = decision_rows(decided, model, samples, steps)
    if (stored := options.stored_looks) is not None:
        track_of, shown = np.full(len(stored.t_ns), -1), kept[np.unique(tracks.track, return_inverse=True)[1]]
        looked = taken(tracks, shown & (tracks.look >= 0))
        track_of[looked.look] = looked.track
        out[APPEARANCE_OUTPUT] = appearance_rows(stored, track_of, times_ns)
    return out, calibration


def _as_assigned(options: RetrackOptions, run: OnlinePass, movers: Movers) -> Tracks:
    """The tracks as they were online, with what was seen of them."""
    step, track, source, sample = run.assignments.of(run.samples, run.steps)
    xy = np.stack([column(run.samples, name)[sample] for name in ("x_m", "y_m")], axis=-1) / movers.unit_m
    descriptors = options.stored_looks if options.looks is None else options.looks
    seen_ns = run.samples.t_ns[np.searchsorted(run.steps, step)]
    look = np.full(len(step), -1) if descriptors is None else descriptors.find(seen_ns, source)
    tracks = Tracks(step, track, source, sample, xy, look, track)
    return tracks if options.shares_samples else taken(tracks, np.unique(sample, return_index=True)[1])


def _identified(log: WholeLog, tracks: Tracks) -> Tracks:
    """Tracks as they are decided to be, ordered by track and step."""
    options = log.options
    for _ in range(2 if options.link_s > 0 else 0):  # the second time with the motion over gaps
        tracks = tracks._replace(track=hypotheses_of(log, tracks).scored().best(options.link_confidence))
    if options.resolve_swaps and not log.movers.on_ground:
        tracks = _without_swaps(log, tracks)
    if log.answers.is_certain.any():
        tracks = log.answers.obeyed(tracks, hypotheses_of(log, tracks), options.link_confidence)
    tracks = fix_tracks(tracks, options.fixed_ids)
    return taken(tracks, tracks.order)


def hypotheses_of(log: WholeLog, tracks: Tracks, is_final: bool = False) -> Hypotheses:
    """The hypotheses about identities in tracks, with what the log shows of their looks, and what was answered."""
    hypotheses = Hypotheses.of(log.model, tracks, log.max_gap_s, log.answers.joined(tracks))
    looks = np.zeros(len(hypotheses.before))
    if log.appearance is not None:
        sides = Sides(log.appearance, tracks._replace(track=hypotheses.tracklets.of))
        looks = sides.of_tracks(hypotheses.before, hypotheses.after)
    looks = log.answers.weighed(hypotheses, tracks, looks, is_final)
    return hypotheses._replace(evidence=hypotheses.evidence + looks)


def _without_swaps(log: WholeLog, tracks: Tracks) -> Tracks:
    """Undo swaps of tracks that met."""
    ids, row, trajectories = to_trajectories(tracks.step, tracks.track, tracks.xy_m)
    seen = None if log.appearance is None else Sides(log.appearance, tracks)
    owner, _ = resolve_swaps(log.model, trajectories, seen)
    return tracks._replace(track=ids[owner[row]])


def _people(log: WholeLog, tracks: Tracks, rows: TrackRows, paths: Trajectories) -> tuple[Floats, Bools]:
    """The log odds (K,) that tracks are people, or what else moves, infinite for certain; and which are kept, (K,)."""
    options, movers, steps, ids = log.options, log.movers, log.run.steps, np.unique(tracks.track)
    is_fixed = np.isin(ids, tracks.track[np.isin(tracks.source, np.array(options.fixed_ids, np.int64))])
    is_fixed |= np.isin(ids, log.answers.persons(tracks, yes=True))
    is_clutter = np.isin(ids, log.answers.persons(tracks, yes=False)) & ~is_fixed
    is_short = np.diff(paths.first) <= log.least_steps
    smoothed = smooth(log.model, paths)
    if movers.on_ground:
        odds = scored_log_odds(
            smoothed.mean[:, :2] * movers.unit_m,
            paths.first,
            rows.between(column(log.run.samples, "score")),
            column(log.run.samples, "observed")[rows.before] & rows.is_sample,
            movers.usual_score,
            log.model.step_s,
        )
    else:
        in_log = log_odds_in_log(log.model, paths, smoothed, (steps[0], steps[-1]))[:, None]
        odds = np.where(is_short, SHORT.log_odds(in_log), PERSON.log_odds(in_log))
    odds = np.where(is_short, np.minimum(odds, _SHORT), odds)
    odds = np.where(is_clutter, -CERTAIN, odds)
    is_likely = (probability(odds) >= options.track_confidence) & ~is_short & ~is_clutter
    return np.where(is_fixed, np.inf, odds), is_fixed | is_likely


def _worlds(log: WholeLog, decided: Decided) -> Worlds:
    """The worlds of what was decided; those of each class have a seed of their own."""
    options, tracks, first = log.options, decided.tracks, decided.hypotheses.tracklets.first
    of_class = int(column(log.run.samples, "class_id")[0])
    worlds = draw_worlds(options.worlds, decided, options.link_confidence, log.least_steps, of_class)
    if options.fixed_ids:
        for track in worlds.track:
            whole = tracks._replace(track=track[decided.hypotheses.tracklets.of])
            track[:] = fix_tracks(whole, options.fixed_ids).track[first]
    return worlds
