"""Joins: where a track goes on with another input track, how likely that is right, and what it would be otherwise.

Trackers give a new id when they are not sure that a person is the same, so that places where ids change are those at
which most mistakes are made. A join is judged by all of a track before it and after it, and by who else was there.
Probabilities are logistic regressions, fitted on synthetic scenes (see ``weights``).

Letters: C assignments, K tracks, J joins, F features.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.ragged import batches, group_index, ragged_range, run_starts
from mcaptrack.transforms.retrack import linking
from mcaptrack.transforms.retrack.appearance import Appearance
from mcaptrack.transforms.retrack.assignments import Tracks
from mcaptrack.transforms.retrack.linking import Gaps
from mcaptrack.transforms.retrack.motion_model import MotionModel, State, filtered, to_trajectories
from mcaptrack.transforms.retrack.weights import Logistic

#: The features of a join: those of a link, and by how much it is likelier than the best alternative (see
#: ``_alternatives``); whether there is one; whether another track had the samples of the new input id just before, and
#: has those of the old one just after; and the logarithms of the numbers of samples that both last. Two are the same
#: for all joins of a log: how often input ids change in it, and how often other tracks have samples of the same ids.
FEATURES: Final = (
    *linking.FEATURES,
    "margin",
    "alternative",
    "taken over",
    "given away",
    "log before",
    "log after",
    "log rate",
    "log elsewhere",
)
#: The limit of margins: an assignment that is less likely by this much is no alternative.
_MARGIN: Final = 12.0
#: Samples of another input track that last less, within one of the same input track, are no joins. Seconds.
_BRIEF_S: Final = 1.0
#: Joins that are right with less than this probability are questioned. (Linking also looks at who else ends and begins
#: there, and most right ones are made again: with as few cuts as were wrong, more wrong joins would stay.)
_QUESTIONED: Final = 0.7
#: Samples that are added to those of a log before the rate of joins is taken.
_RATE_SAMPLES: Final = 50
#: The number of pairs that are examined at once.
_BATCH: Final = 500_000
#: Weights of joins of online tracks, which may be cut.
_CUTS: Final = Logistic.of("cuts", FEATURES)


class Tracked(NamedTuple):
    """Tracks (C,), ordered by track, then step, and the filtered states of each assignment.

    ``forward`` is from all samples of the track up to it, ``backward`` from it on.
    """

    tracks: Tracks
    forward: State
    backward: State

    def gaps(self, before: Ints, after: Ints, step_s: float) -> Gaps:
        """The gaps (J,) from assignments ``before`` to ``after``."""
        steps = self.tracks.step[after] - self.tracks.step[before]
        seconds = np.asarray(steps * step_s, np.float64)
        return Gaps(self.forward.take(before), self.backward.take(after), seconds)


class Joins(NamedTuple):
    """Joins (J,): assignments ``before`` and ``after`` each, that of the ``alternative`` or -1, and features (J, F)."""

    before: Ints
    after: Ints
    alternative: Ints
    features: Floats


class Cuts(NamedTuple):
    """Tracks that were cut (J,): the ids of both pieces, and the probability that they belong together."""

    before: Ints
    after: Ints
    probability: Floats


def cut_joins(
    model: MotionModel, tracks: Tracks, min_confidence: float, appearance: Appearance | None = None
) -> tuple[Tracks, Cuts]:
    """Tracks (C,) that are cut at questionable joins, and where they are cut.

    Those are joins that are right with a smaller probability than ``_QUESTIONED`` or ``min_confidence``. What comes
    after a cut is a track of its own, for linking to decide about, with an id above all others. The probability at cuts
    is that by motion alone: linking looks at ``appearance``, too.
    """
    ordered = tracks.take(order := tracks.order)
    joins = find_joins(tracked_of(model, ordered), model)
    is_right = _CUTS.probability(joins.features)
    questioned = with_appearance(is_right, joins, ordered, appearance) < max(_QUESTIONED, min_confidence)
    begins = np.zeros(len(order), bool)
    begins[joins.after[questioned]] = True
    piece = np.maximum.accumulate(np.where(begins | run_starts(ordered.track), np.arange(len(order)), 0))
    name = np.where(begins, int(ordered.track.max(initial=0)) + np.cumsum(begins), ordered.track)[piece]
    out = np.empty_like(name)
    out[order] = name
    cuts = Cuts(name[joins.before[questioned]], name[joins.after[questioned]], is_right[questioned])
    return tracks._replace(track=out), cuts


def with_appearance(is_right: Floats, joins: Joins, tracks: Tracks, appearance: Appearance | None) -> Floats:
    """The probability that joins are right (J,), from that by motion and from what tracks look like."""
    if appearance is None:
        return is_right
    _, part = np.unique(np.stack([tracks.track, tracks.source]), axis=1, return_inverse=True)
    sides = appearance.between(tracks._replace(track=part.ravel()))
    odds = is_right / np.maximum(1 - is_right, np.finfo(float).tiny)
    odds = odds * np.exp(sides.of_assignments(joins.before, joins.after))
    return np.asarray(odds / (1 + odds))


def tracked_of(model: MotionModel, tracks: Tracks) -> Tracked:
    """Tracks (C,), ordered by track, then step, with their states."""
    _, row, trajectories = to_trajectories(tracks.step, tracks.track, tracks.xy_m)
    forward, backward = filtered(model, trajectories)
    return Tracked(tracks, forward.take(row), backward.take(row))


def find_joins(tracked: Tracked, model: MotionModel) -> Joins:
    """Where tracks go on with another input track."""
    tracks = tracked.tracks
    first, last = _runs(tracks, model.step_s)
    log_length = np.log(last - first + 1)
    goes_on = np.flatnonzero(tracks.track[first[1:]] == tracks.track[first[:-1]])
    before, after = last[goes_on], first[goes_on + 1]
    margin, alternative = _alternatives(tracked, model, before, after)
    elsewhere = _elsewhere(tracks, before, after)
    count = len(before)
    extra = (
        margin,
        alternative >= 0,
        *elsewhere,
        log_length[goes_on],
        log_length[goes_on + 1],
        np.full(count, np.log((count + 1) / (len(tracks.track) + _RATE_SAMPLES))),
        np.full(count, np.log((np.count_nonzero(elsewhere) + 0.5) / (count + 1))),
    )
    usual = linking.features(model, tracked.gaps(before, after, model.step_s))
    return Joins(before, after, alternative, np.column_stack([usual, *extra]).astype(np.float64))


def _runs(tracks: Tracks, step_s: float) -> tuple[Ints, Ints]:
    """Runs of samples of one track with one input id: their first and last assignments.

    Brief ones between two of the same input id belong to these, as in events.
    """
    starts = np.flatnonzero(run_starts(tracks.track, tracks.source))
    track, source, step = tracks.track[starts], tracks.source[starts], tracks.step[starts]
    is_brief = np.zeros(len(starts), bool)
    lasts_s = (step[2:] - step[1:-1]) * step_s
    is_brief[1:-1] = (track[2:] == track[:-2]) & (source[2:] == source[:-2]) & (lasts_s < _BRIEF_S)
    starts = starts[~is_brief]
    starts = starts[run_starts(tracks.track[starts], tracks.source[starts])]
    return starts, np.append(starts[1:], len(tracks.track))[: len(starts)] - 1


def _alternatives(tracked: Tracked, model: MotionModel, before: Ints, after: Ints) -> tuple[Floats, Ints]:
    """By how much each join (J,) is likelier than the best alternative, as a log likelihood; its assignment, or -1.

    An alternative is another track with a sample at the time of the join: the track would go on with these samples, and
    the other track with those of the join (the two are exchanged), or it would begin there.
    """

    def fit(earlier: Ints, other: Ints) -> Floats:
        return linking.log_likelihood(model, tracked.gaps(earlier, other, model.step_s))

    step, track = tracked.tracks.step, tracked.tracks.track
    by_step = np.argsort(step, kind="stable")
    low, high = (np.searchsorted(step[by_step], step[after], side) for side in ("left", "right"))
    best, which = np.full(len(after), _MARGIN), np.full(len(after), -1)
    own = fit(before, after)
    previous = np.where(run_starts(track), -1, np.arange(len(track)) - 1)
    count = high - low
    for part in batches(count, _BATCH):
        join = part.start + group_index(count[part])
        other = by_step[ragged_range(low[part], count[part])]
        reach_m = linking.reach_m((step[after] - step[before])[join] * model.step_s)
        off = tracked.backward.mean[other, :2] - tracked.forward.mean[before[join], :2]
        near = (np.hypot(off[:, 0], off[:, 1]) <= reach_m) & (other != after[join])
        join, other = join[near], other[near]
        margin = own[join] - fit(before[join], other)
        has_previous = np.flatnonzero(previous[other] >= 0)
        theirs = previous[other[has_previous]]
        margin[has_previous] += fit(theirs, other[has_previous]) - fit(theirs, after[join[has_previous]])
        order = np.lexsort((tracked.tracks.source[other], margin, join))
        order = order[run_starts(join[order])]
        order = order[margin[order] < _MARGIN]
        best[join[order]], which[join[order]] = margin[order], other[order]
    return np.maximum(best, -_MARGIN), which


def _elsewhere(tracks: Tracks, before: Ints, after: Ints) -> tuple[Bools, Bools]:
    """Whether another track had the last samples of the new input id before each join (J,); and whether one has the
    next samples of the old input id after it.
    """
    order = np.lexsort((tracks.step, tracks.source))
    place = np.empty_like(order)
    place[order] = np.arange(len(order))

    def other(at: Ints, way: int) -> Bools:
        beside = place[at] + way
        row = order[np.clip(beside, 0, len(order) - 1)]
        inside = (beside >= 0) & (beside < len(order))
        same = inside & (tracks.source[row] == tracks.source[at])
        return np.asarray(same & (tracks.track[row] != tracks.track[at]))

    return other(after, -1), other(before, 1)
