"""Offline re-tracking: tracks of the whole log, linked, with identity swaps resolved, interpolated and smoothed.

Letters: C assignments (a track has a sample at a step), R rows, K tracks, N rows of trajectories.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import pairwise, repeat
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.angles import wrapped
from mcaptrack.geometry.arrays import Bools, Floats, Ints, taken
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.colour_histograms import BINS, mean_shares
from mcaptrack.geometry.plane import Planes
from mcaptrack.geometry.ragged import group_index, ragged_range, run_ends, run_starts
from mcaptrack.notices import warn
from mcaptrack.schema import APPEARANCE, DECISIONS, TRACKS, WORLDS, BodyPart, DecisionKind, Frame, Rows
from mcaptrack.schema.classes import first_classes, majority
from mcaptrack.schema.frame_columns import FrameColumns
from mcaptrack.schema.framing import JoinedFrames, joined_parts, mapped_rows, spans_of
from mcaptrack.schema.resampling import ANGLES, LINEAR
from mcaptrack.transforms.retrack.answers import CERTAIN, Answers
from mcaptrack.transforms.retrack.appearance import Appearance, AppearanceCalibration, Descriptors
from mcaptrack.transforms.retrack.assignments import PEOPLE, Movers, OnlinePass, Tracks, column
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
from mcaptrack.transforms.retrack.weights import Logistic, probability
from mcaptrack.transforms.retrack.worlds import Worlds, draw_worlds, world_rows

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


# Tracks that people have corrected: re-tracking neither cuts nor joins them, and leaves none of their samples out.
#
# Letters: C assignments (a track has a sample at a step), N samples.


def fix_tracks(tracks: Tracks, fixed: Collection[int]) -> Tracks:
    """Tracks in which all samples of a fixed input id have one track, and no other fixed one.

    Parameters
    ----------
    tracks : Tracks
        The tracks so far.
    fixed : collection of int
        Input ids of corrected tracks.

    Returns
    -------
    Tracks
        What a track has before the first sample of a fixed id, or after its last one, stays with it: a person who was
        followed into the corrected part keeps the id. All else keeps its track, or gets a new one where a fixed id has
        taken it.
    """
    step, track, source = tracks[:3]
    is_fixed = np.isin(source, np.array(sorted(fixed), np.int64))
    if not is_fixed.any():
        return tracks
    out = np.full(len(track), -1, np.int64)
    following = int(track.max()) + 1
    ends: dict[int, tuple[int, int]] = {}
    for name in np.unique(source[is_fixed]).tolist():
        own = np.flatnonzero(source == name)
        ends[name] = int(own[step[own].argmin()]), int(own[step[own].argmax()])
    used: set[int] = set()
    node: dict[int, int] = {}
    for name in sorted(ends, key=lambda key: -int((source == key).sum())):
        names, counts = np.unique(track[source == name], return_counts=True)
        free = [int(name) for name in names[np.argsort(-counts, kind="stable")] if int(name) not in used]
        node[name] = free[0] if free else following
        following += not free
        used.add(node[name])
        out[source == name] = node[name]
    for name in np.unique(track[is_fixed]).tolist():
        own = np.flatnonzero(track == name)
        own = own[np.argsort(step[own], kind="stable")]
        rest = following  # of this track, what belongs to no fixed id, if one has taken its name
        for low, high in _runs(is_fixed[own]):
            run = own[low:high]
            before = int(source[own[low - 1]]) if low else None
            after = int(source[own[high]]) if high < len(own) else None
            if before is not None and ends[before][1] == own[low - 1]:
                out[run] = node[before]
            elif after is not None and ends[after][0] == own[high]:
                out[run] = node[after]
            else:
                out[run] = rest if name in used else name
                following = rest + 1
    return tracks._replace(track=np.where(out < 0, track, out))


def _runs(is_fixed: Bools) -> list[tuple[int, int]]:
    """The runs of assignments that are not of fixed ids, as begin and end."""
    edges = np.flatnonzero(np.diff(np.concatenate([[True], is_fixed, [True]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


# The decisions of offline re-tracking as rows: how likely each is right, and what would be the case otherwise.
#
# Joins are judged once all tracks are decided, whatever step made them: association, a link over a gap, or a swap
# that was resolved. Tracks are people or false with the odds of the test of false tracks. Probabilities are
# logistic regressions, fitted on synthetic scenes (see ``weights``), where of the decisions with a probability of
# 0.9 about 90 % are right.
#
# Letters: C assignments, K tracks, J joins, D decisions.


#: Whether a join is right, from its log odds as its end and as its beginning see them.
JOINS: Final = Logistic.of("joins", ("end", "beginning"))
#: The log odds that a track is a person, from those of the test of false tracks: that one weighs rows, not tracks.
PERSON: Final = Logistic.of("decided", ("log odds",))
#: The same of tracks that are too short: there is less to see of these, so they are more doubtful.
SHORT: Final = Logistic.of("decided short", ("log odds",))
#: An alternative is at least so likely as log odds.
_MAY_BE: Final = -4.0
#: Samples of another input id that last less, between two parts with one, are no join. Seconds.
_BRIEF_S: Final = 1.0
_NO_ID: Final = -1


class Decided(NamedTuple):
    """The tracks (C,) of a log as they were decided, those that are left out included, ordered by track and step.

    ``log_odds`` (K,) that tracks are people, of the test of false tracks, and which were ``kept`` (K,), are ordered by
    id. ``hypotheses`` are those about these tracks.
    """

    tracks: Tracks
    log_odds: Floats
    kept: Bools
    hypotheses: Hypotheses


def decision_rows(decided: Decided, model: MotionModel, samples: FrameColumns, steps: Ints) -> Iterator[Rows]:
    """The decisions at each of ``steps``: rows of Decisions, ordered by kind and track."""
    parts = _joined(decided, model.step_s), _persons(decided, model.step_s)
    at, rows = np.concatenate([places for places, _ in parts]), DECISIONS.joined([rows for _, rows in parts])
    places = samples.take(decided.tracks.sample[at])
    rows["x_m"], rows["y_m"] = places["x_m"], places["y_m"]
    rows["x_px"], rows["y_px"] = places["x_px"] + places["w_px"] / 2, places["y_px"] + places["h_px"] / 2
    step = decided.tracks.step[at]
    order = np.lexsort((rows["source_id"], rows["track_id"], rows["kind"], step))
    ends = np.append(0, np.searchsorted(step[order], steps, "right")).tolist()
    rows = DECISIONS.check(rows.take(order))
    yield from (rows[low:high] for low, high in pairwise(ends))


class Joins(NamedTuple):
    """Where tracks go on with another input id (J,): assignments before and after, and the candidate links there."""

    before: Ints
    after: Ints
    link: Ints


def find_joins(decided: Decided, step_s: float) -> Joins:
    """The joins of the tracks that were kept."""
    tracks, (tracklets, before, after, *_) = decided.tracks, decided.hypotheses
    starts = np.flatnonzero(run_starts(tracks.track, tracks.source))
    track, source, step = (values[starts] for values in (tracks.track, tracks.source, tracks.step))
    is_brief = np.zeros(len(starts), bool)
    lasts_s = (step[2:] - step[1:-1]) * step_s
    is_brief[1:-1] = (track[2:] == track[:-2]) & (source[2:] == source[:-2]) & (lasts_s < _BRIEF_S)
    starts = starts[~is_brief]
    starts = starts[run_starts(tracks.track[starts], tracks.source[starts])]
    number = np.cumsum(run_starts(tracks.track)) - 1
    follows = starts[1:][(number[starts[1:]] == number[starts[:-1]]) & decided.kept[number[starts[1:]]]]
    pair = tracklets.of[follows - 1] * len(tracklets.first) + tracklets.of[follows]
    return Joins(follows - 1, follows, np.searchsorted(before * len(tracklets.first) + after, pair))


def _joined(decided: Decided, step_s: float) -> tuple[Ints, Rows]:
    """The assignment of each join (J,), and its row."""
    step, track, source = decided.tracks[:3]
    joins, log_odds = find_joins(decided, step_s), decided.hypotheses.scored().log_odds()
    rows = DECISIONS.empty(len(joins.after))
    rows["kind"], rows["track_id"] = DecisionKind.JOINED, track[joins.after]
    rows["previous_id"], rows["source_id"] = source[joins.before], source[joins.after]
    rows["probability"] = JOINS.probability(log_odds[joins.link])
    rows["alternative_id"] = _alternatives(decided.hypotheses, log_odds[:, 0])[joins.link]
    rows["duration_s"] = (step[joins.after] - step[joins.before]) * step_s
    return joins.after, rows


def _alternatives(hypotheses: Hypotheses, log_odds: Floats) -> Ints:
    """The input id of the likeliest other link of the end of each link (E,), or -1 if there is none that may be."""
    order = np.lexsort((-log_odds, hypotheses.before))
    rank = np.arange(len(order)) - np.maximum.accumulate(
        np.where(run_starts(hypotheses.before[order]), np.arange(len(order)), 0)
    )
    other = np.full((2, len(hypotheses.tracklets.first)), _NO_ID)  # the best of each end, and the second
    for place in (0, 1):
        link = order[(rank == place) & (log_odds[order] >= _MAY_BE)]
        other[place, hypotheses.before[link]] = hypotheses.tracklets.source[hypotheses.after[link]]
    best = np.zeros(len(order), bool)
    best[order[rank == 0]] = True
    return np.asarray(np.where(best, other[1, hypotheses.before], other[0, hypotheses.before]))


def _persons(decided: Decided, step_s: float) -> tuple[Ints, Rows]:
    """The first assignment of each track (K,), and the row that says whether it is a person."""
    step, track, source = decided.tracks[:3]
    starts = run_starts(track)
    first, last = np.flatnonzero(starts), np.flatnonzero(run_ends(starts))
    rows = DECISIONS.empty(len(first))
    rows["kind"] = np.where(decided.kept, DecisionKind.KEPT, DecisionKind.LEFT_OUT)
    rows["track_id"] = np.where(decided.kept, track[first], _NO_ID)
    rows["previous_id"] = rows["alternative_id"] = _NO_ID
    rows["source_id"] = _usual(track, source)
    is_person = probability(decided.log_odds)
    rows["probability"] = np.where(decided.kept, is_person, 1 - is_person)
    rows["duration_s"] = (step[last] - step[first]) * step_s
    rows["frames"] = last - first + 1
    return first, rows


def _usual(track: Ints, source: Ints) -> Ints:
    """The input id of most samples of each track (K,), of several the lowest. Assignments (C,) are by track."""
    order = np.lexsort((source, track))
    starts = np.flatnonzero(run_starts(track[order], source[order]))
    count = np.diff(np.append(starts, len(order)))
    of, ids = track[order][starts], source[order][starts]
    best = np.lexsort((ids, -count, of))
    return np.asarray(ids[best[run_starts(of[best])]])


# The appearance of tracks as rows: the mean histograms of the pictures in which they are seen clearly.
#
# Letters: S descriptors, T frames, K tracks.


def appearance_rows(descriptors: Descriptors, track: Ints, times_ns: Ints) -> Iterator[Rows]:
    """The rows of Appearance at each of ``times_ns`` (T,), ordered by track and part of the body.

    ``track`` (S,) is the track that each descriptor is of, or -1. The rows of a track stand at the last of its
    descriptors that count, which is at one of the times; a track without any has none.
    """
    used = np.flatnonzero(descriptors.is_clear & (track >= 0))
    ids, group = np.unique(track[used], return_inverse=True)
    t_ns = descriptors.t_ns[used]
    first, last = np.full(len(ids), np.iinfo(np.int64).max), np.zeros(len(ids), np.int64)
    np.minimum.at(first, group, t_ns)
    np.maximum.at(last, group, t_ns)
    rows = APPEARANCE.empty(len(ids) * len(BodyPart))
    of_parts = {
        "track_id": ids,
        "pictures": np.bincount(group, minlength=len(ids)),
        "duration_s": (last - first) / NS_PER_S,
    }
    for name, values in of_parts.items():
        rows[name] = np.repeat(values, len(BodyPart))
    rows["body_part"] = np.tile(list(BodyPart), len(ids))
    shares = mean_shares(descriptors.values[used], group, len(ids)).reshape(len(rows), len(BINS))
    for name, share in zip(BINS, shares.T, strict=True):
        rows[name] = share
    at = np.repeat(last, len(BodyPart))
    order = np.argsort(at, kind="stable")
    ends = np.append(0, np.searchsorted(at[order], times_ns, "right")).tolist()
    rows = APPEARANCE.check(rows.take(order))
    yield from (rows[low:high] for low, high in pairwise(ends))


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


def move_rows(rows: Rows, xy_m: Floats, planes: Planes, t_ns: Ints) -> Rows:
    """Move rows (R,) to other positions (R, 2), and their boxes with them if there is a ground plane at their times."""
    out = rows.copy()
    which = np.maximum(np.searchsorted([since_ns for since_ns, _ in planes], t_ns, side="right") - 1, 0)
    for number in np.unique(which).tolist() if planes else ():
        plane, here = planes[number][1], which == number
        before, size_px = rows[here], columns_to_boxes(rows[here])[:, 2:]
        from_m = np.stack([before["x_m"], before["y_m"]], axis=-1)
        shift_px = plane.standing_boxes(xy_m[here], size_px) - plane.standing_boxes(from_m, size_px)
        out["x_px"][here], out["y_px"][here] = (
            before[name] + np.where(np.isfinite(shift_px).all(axis=1), shift_px[:, axis], 0.0)
            for axis, name in enumerate(("x_px", "y_px"))
        )
    out["x_m"], out["y_m"] = xy_m.T
    return out


# The class of a track, where its rows are of several: that of most of them.
#
# Letters: N rows, K tracks.


def settle_classes(frames: Sequence[Frame]) -> Sequence[Frame]:
    """Give each track one class, that of most of its rows; of several, the one that it had first.

    Warns of the tracks that have rows of several classes. Frames are unchanged if there are none.
    """
    pairs = np.empty((2, 0), np.int64)
    for _, _, joined in joined_parts(TRACKS, frames):
        those = np.stack([joined.rows["track_id"].astype(np.int64), joined.rows["class_id"].astype(np.int64)])
        pairs = np.unique(np.concatenate([pairs, those], axis=1), axis=1)
    ids, count = np.unique(pairs[0], return_counts=True)
    if not (count > 1).any():
        return frames
    changed = ids[count > 1]
    parts = [
        joined.rows[["track_id", "class_id"]][np.isin(joined.rows["track_id"], changed)]
        for _, _, joined in joined_parts(TRACKS, frames)
    ]
    rows = np.concatenate(parts)
    track = np.searchsorted(changed, rows["track_id"])
    class_id = majority(track, rows["class_id"], len(changed))

    def settled(joined: JoinedFrames) -> Rows:
        place = np.minimum(np.searchsorted(changed, joined.rows["track_id"]), len(changed) - 1)
        mine = changed[place] == joined.rows["track_id"]
        joined.rows["class_id"][mine] = class_id[place[mine]]
        return joined.rows

    warn(
        f"{len(changed)} of {len(ids)} tracks have detections of several classes; each has the class of most of its "
        "detections",
        "classes",
    )
    return mapped_rows(TRACKS, frames, settled)


def vote(rows: Rows) -> tuple[int, int]:
    """Give each track the class of most of its rows (N,), in place; rows are ordered by time.

    Returns the number of tracks that had several classes, and of all tracks.
    """
    ids, track = np.unique(rows["track_id"], return_inverse=True)
    changed = rows["class_id"] != first_classes(track, rows["class_id"], len(ids))[track]
    if changed.any():
        rows["class_id"] = majority(track, rows["class_id"], len(ids))[track]
    return len(np.unique(track[changed])), len(ids)


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
    votes = np.empty(len(order), [("track_id", np.int64), ("class_id", np.uint32)])
    votes["track_id"], votes["class_id"] = rows.track, column(samples, "class_id")[rows.before]
    vote(votes)
    for low, high in spans_of(ends):
        here = slice(ends[low], ends[high])
        those = taken(rows, here)
        part = _rows(those, samples)
        part["class_id"] = votes["class_id"][here]
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
