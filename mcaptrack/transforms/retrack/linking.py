"""Tracklet linking: which track continues another one after a gap, decided over the whole log at once.

A link is judged by how well the motion before a gap and the motion after it fit together: people walk on as they
walked, or stay where they stood. Since links are scored pair by pair, the best set of them is one assignment of ends to
beginnings.

Letters: K tracks, E candidate links, F features.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints, taken
from mcaptrack.geometry.assignment import Pairs, assign_by_gain, assign_pairs_by_gain
from mcaptrack.geometry.ragged import batches, group_index, ragged_range, run_ends, run_starts
from mcaptrack.transforms.retrack.appearance import MOST, Appearance, Evidence
from mcaptrack.transforms.retrack.assignments import Tracks
from mcaptrack.transforms.retrack.motion_model import MotionModel, State, Trajectories, filtered, to_trajectories
from mcaptrack.transforms.retrack.weights import Logistic, probability

#: A track that continues another begins no farther from its end than this, and so much more for each second between.
_REACH_M, _MAX_SPEED_M_PER_S = 1.0, 2.5
#: The features of a link, see ``features``.
FEATURES: Final = ("miss", "misfit", "gap", "misfit or stay", "turn", "distance and speed", "misfit and speed")
#: Weight of each feature as a log odds ratio; and the log odds without any, in logs where a share of ``_PRIOR`` of the
#: best links is right. Links with log odds below ``_MIN_LOG_ODDS`` are not considered.
_LINKS: Final = Logistic.of("links", FEATURES)
_PRIOR, _MIN_LOG_ODDS = (float(_LINKS.numbers[name]) for name in ("usual", "least"))
#: Gaps are of classes with these bounds in seconds; the mean probability of the best links of each, where as many are
#: right as usual; and with how many links more this is taken to be so in a log.
_GAPS_S: Final = (0.9, 1.7, 3.3, 6.5, 13.0)
_BY_GAP: Final = np.array(_LINKS.numbers["usual by gap"])
_GAP_LINKS: Final = 5.0
#: Added to distances and speeds before taking logarithms: differences below these mean nothing.
_NEAR_M, _SPEED_M_PER_S = 0.3, 0.15
#: Odds that are enough for a link, as a share of those of the least confidence: pieces of a person that stay apart cost
#: more than wrong ones that go together. (Chosen on synthetic crowds.)
ENOUGH: Final = 1 / 3
#: The number of pairs that are examined at once.
_BATCH: Final = 1_000_000
#: So few links are decided together: splitting them would take longer.
_FEW: Final = 50
#: The largest table of ends and beginnings that is made: 16 MB.
_TABLE_CELLS: Final = 2_000_000


class Gaps(NamedTuple):
    """Gaps (E,): the states before them, filtered forward, those after them, filtered backward, and their seconds."""

    before: State
    after: State
    seconds: Floats


class TrackEnds(NamedTuple):
    """The first and last steps of tracks (K,), and their states there: filtered backward, and forward."""

    model: MotionModel
    trajectories: Trajectories
    begins: Ints
    ends: Ints
    begun: State
    ended: State

    @classmethod
    def of(cls, model: MotionModel, trajectories: Trajectories) -> TrackEnds:
        """The ends of trajectories."""
        forward, backward = filtered(model, trajectories)
        first, last = trajectories.first[:-1], trajectories.first[1:] - 1
        steps = trajectories.step[first], trajectories.step[last]
        return cls(model, trajectories, *steps, taken(backward, first), taken(forward, last))

    def gaps(self, i: Ints, j: Ints) -> Gaps:
        """The gaps (E,) from the ends of tracks ``i`` to the beginnings of tracks ``j``."""
        seconds = np.asarray((self.begins[j] - self.ends[i]) * self.model.step_s, np.float64)
        return Gaps(taken(self.ended, i), taken(self.begun, j), seconds)


def link_tracks(
    ends: TrackEnds,
    max_gap_s: float,
    min_confidence: float,
    max_misfit: tuple[float, float] = (np.inf, 0.0),
    evidence: Evidence | None = None,
) -> Ints:
    """For each track the one that continues it, or -1; (K,).

    A link is made if it is right with a probability of at least ``min_confidence``. How many links are right at all
    differs from log to log: hardly any where gaps are short and people who disappear have left, most where they are
    occluded for long. That share is estimated from the links themselves (expectation maximisation). ``evidence`` is
    what else tells whether both sides are one person.
    """
    continued_by = np.full(len(ends.begins), -1)
    i, j = candidates(ends, max_gap_s)
    gaps = ends.gaps(i, j)
    if np.isfinite(max_misfit[0]):
        fits = misfits(gaps) <= max_misfit[0] + max_misfit[1] * gaps.seconds
        i, j, gaps = i[fits], j[fits], taken(gaps, fits)
    if len(i) == 0:
        return continued_by
    gain = log_odds(features(ends.model, gaps))
    if evidence is not None:
        gain = gain + evidence(i, j)
    links = best_links(i, j, gain, len(continued_by))
    shift = prior_shift(gain[links])
    links = links[gain[links] + shift > np.log(min_confidence / (1 - min_confidence))]
    continued_by[i[links]] = j[links]
    return continued_by


def log_odds(values: Floats) -> Floats:
    """The log odds that links with these features (E, F) are right, where as many are as usual."""
    return _LINKS.log_odds(values)


def has_chance(log_odds: Floats) -> Bools:
    """Whether links with these log odds (E,) are considered at all."""
    return np.asarray(log_odds > _MIN_LOG_ODDS)


def best_links(i: Ints, j: Ints, log_odds: Floats, count: int) -> Ints:
    """The best set of the links (E,) between ends ``i`` and beginnings ``j`` of so many tracks, by ends."""
    continued_by = np.full(count, -1)
    good = np.flatnonzero(has_chance(log_odds))
    ends, begins, gain = i[good], j[good], np.round(log_odds[good] - _MIN_LOG_ODDS, 6)
    parts = [np.arange(len(good))] if len(good) <= _FEW else _components(ends, begins, count)
    for edges in parts:
        own, other = np.unique(ends[edges]), np.unique(begins[edges])
        pairs = np.searchsorted(own, ends[edges]), np.searchsorted(other, begins[edges])
        row, column = _assigned(pairs, gain[edges], (len(own), len(other)))
        continued_by[own[row]] = other[column]
    links = good[continued_by[ends] == begins]
    return np.asarray(links[np.argsort(i[links], kind="stable")])


def candidates(ends: TrackEnds, max_gap_s: float) -> tuple[Ints, Ints]:
    """Pairs (E,) of a track and a later one within reach of its end."""
    order = np.argsort(ends.begins, kind="stable")
    begins = ends.begins[order]
    low = np.searchsorted(begins, ends.ends + 1)
    count = np.searchsorted(begins, ends.ends + round(max_gap_s / ends.model.step_s), "right") - low
    parts = [(np.empty(0, np.int64), np.empty(0, np.int64))]
    for part in batches(count, _BATCH):
        i = part.start + group_index(count[part])
        j: Ints = order[ragged_range(low[part], count[part])]
        near = are_in_reach(ends.gaps(i, j))
        parts.append((i[near], j[near]))
    i, j = (np.concatenate(members) for members in zip(*parts, strict=True))
    return i, j


def reach_m(gap_s: Floats) -> Floats:
    """The distance that people walk within gaps (E,), at most."""
    return np.asarray(_REACH_M + _MAX_SPEED_M_PER_S * gap_s)


def are_in_reach(gaps: Gaps) -> Bools:
    """Whether people may get from the one side to the other within the gaps (E,)."""
    return np.asarray(_length(gaps.before.mean[:, :2] - gaps.after.mean[:, :2]) <= reach_m(gaps.seconds))


def _assigned(pairs: Pairs, gain: Floats, shape: tuple[int, int]) -> Pairs:
    """The best set of links among candidates (E,) of ends and beginnings.

    Thousands of broken tracks that hang together would have a table of gigabytes, nearly all of it empty.
    """
    if shape[0] * shape[1] > _TABLE_CELLS:
        return assign_pairs_by_gain(pairs, gain, shape)[0]
    table = np.full(shape, -1.0)
    table[pairs] = gain
    return assign_by_gain(table)


def prior_shift(log_odds: Floats) -> float:
    """The shift of the log odds of links (E,), because another share of them is right in this log than usual."""
    shift = 0.0
    for _ in range(100):
        right = probability(log_odds + shift).sum()
        share = (right + 0.3) / (len(log_odds) + 3)  # in most logs few are
        before, shift = shift, float(np.log(share / (1 - share)) - np.log(_PRIOR / (1 - _PRIOR)))
        if abs(shift - before) < 1e-4:
            break
    return shift


def gap_classes(gap_s: Floats) -> Ints:
    """The class of each gap (E,) by its length, from 0 on."""
    return np.searchsorted(_GAPS_S, gap_s)


def prior_shifts(log_odds: Floats, gap_s: Floats) -> Floats:
    """The shifts of the log odds of links over gaps of each class (see ``gap_classes``), from the best links (E,).

    How long people are missed differs from log to log, too, so gaps of about the same length are shifted together: few
    of them as all links are.
    """
    count = len(_BY_GAP)
    gap = gap_classes(gap_s)
    usual = np.log(_BY_GAP / (1 - _BY_GAP))
    expected = probability(usual + prior_shift(log_odds))
    links = np.bincount(gap, minlength=count) + _GAP_LINKS
    shifts = np.zeros(count)
    for _ in range(50):
        right = np.bincount(gap, probability(log_odds + shifts[gap]), minlength=count)
        share = (right + _GAP_LINKS * expected) / links
        shifts = np.log(share / (1 - share)) - usual
    return shifts


def _components(i: Ints, j: Ints, count: int) -> list[Ints]:
    """The edges of each connected component of the graph from ends ``i`` to beginnings ``j``."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(i)), (i, count + j)), shape=(2 * count, 2 * count))
    _, label = connected_components(graph, directed=False)
    order = np.argsort(label[i], kind="stable")
    starts = np.flatnonzero(run_starts(label[i][order]))
    return list(np.split(order, starts[1:])) if len(order) else []


def features(model: MotionModel, gaps: Gaps) -> Floats:
    """The features that distinguish right links from wrong ones, (E, F): see ``FEATURES``.

    The miss is the distance from one side to where the other, extrapolated at its own velocity, expects it (the smaller
    of the two); the misfit is that distance with the mean of both velocities.
    """
    before, after, gap_s = gaps
    span = gap_s[:, None]
    way = after.mean[:, :2] - before.mean[:, :2]
    left, came = before.mean[:, 2:], after.mean[:, 2:]
    miss = np.minimum(_length(way - left * span), _length(way - came * span))
    misfit, stay = _length(way - (left + came) / 2 * span), _length(way)
    speed = np.maximum(_length(left), _length(came))
    spread = _spread(model, gaps)
    log_speed = np.log(speed + _SPEED_M_PER_S)
    return np.stack(
        [
            np.log(miss + _NEAR_M),
            np.log1p(misfit**2 / spread / 2),
            gap_s,
            np.log(np.minimum(misfit, stay) + _NEAR_M) * np.log(gap_s + 0.4),
            np.log(_length(came - left) + _SPEED_M_PER_S),
            np.log(stay + _NEAR_M) * log_speed,
            np.log(misfit + _NEAR_M) * log_speed,
        ],
        axis=1,
    )


def log_likelihood(model: MotionModel, gaps: Gaps) -> Floats:
    """The log likelihood (E,) of states after gaps if they are of the same person as those before.

    The misfit has Student's distribution with two degrees of freedom, because people also turn and stop.
    """
    return np.asarray(-2 * features(model, gaps)[:, FEATURES.index("misfit")] - np.log(_spread(model, gaps)))


def _spread(model: MotionModel, gaps: Gaps) -> Floats:
    """The variance (E,) of the misfit per axis."""
    before, after, gap_s = gaps
    speed = np.maximum(_length(before.mean[:, 2:]), _length(after.mean[:, 2:]))
    power = (model.drift_m_per_s + model.drift_ratio * speed) ** 2
    spread = before.cov[:, 0] + after.cov[:, 0] + gap_s**2 / 4 * (before.cov[:, 2] + after.cov[:, 2])
    spread += power * gap_s**3 / 12
    return np.asarray(spread)


def misfits(gaps: Gaps) -> Floats:
    """The distances (E,) of ends of tracks to continuations, extrapolated at the mean velocity or at rest."""
    before, after, gap_s = gaps
    way = after.mean[:, :2] - before.mean[:, :2]
    return np.minimum(_length(way - (before.mean[:, 2:] + after.mean[:, 2:]) / 2 * gap_s[:, None]), _length(way))


def _length(vector: Floats) -> Floats:
    return np.asarray(np.hypot(vector[:, 0], vector[:, 1]))


# Joins: where a track goes on with another input track, how likely that is right, and what it would be otherwise.
#
# Trackers give a new id when they are not sure that a person is the same, so that places where ids change are those
# at which most mistakes are made. A join is judged by all of a track before it and after it, and by who else was
# there. Probabilities are logistic regressions, fitted on synthetic scenes (see ``weights``).
#
# Letters: C assignments, K tracks, J joins, F features.


#: The features of a join: those of a link, and by how much it is likelier than the best alternative (see
#: ``_alternatives``); whether there is one; whether another track had the samples of the new input id just before, and
#: has those of the old one just after; and the logarithms of the numbers of samples that both last. Two are the same
#: for all joins of a log: how often input ids change in it, and how often other tracks have samples of the same ids.
JOIN_FEATURES: Final[tuple[str, ...]] = (
    *FEATURES,
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
#: Weights of joins of online tracks, which may be cut.
_CUTS: Final = Logistic.of("cuts", JOIN_FEATURES)


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
        return Gaps(taken(self.forward, before), taken(self.backward, after), seconds)


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
    ordered = taken(tracks, order := tracks.order)
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
    return Tracked(tracks, taken(forward, row), taken(backward, row))


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
    usual = features(model, tracked.gaps(before, after, model.step_s))
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
        return log_likelihood(model, tracked.gaps(earlier, other, model.step_s))

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
        within_m = reach_m((step[after] - step[before])[join] * model.step_s)
        off = tracked.backward.mean[other, :2] - tracked.forward.mean[before[join], :2]
        near = (np.hypot(off[:, 0], off[:, 1]) <= within_m) & (other != after[join])
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


# Links of tracks that were cut: which piece goes on as which other one, or as none.
#
# Where a track was cut a person goes on, and it is known how the track went on before the cut. So links at cuts
# have weights of their own: the other piece of the same track is one candidate among others, and that both have the
# same input id counts. Links from a track's own end to another's own beginning are judged as without cuts, and the
# share of these that is right is estimated from these alone: links at cuts are many, and would make all long gaps
# look crossed.
#
# Letters: C assignments, K tracks, E candidate links, F features.


#: The features of a link at a cut: those of a link; whether both are pieces of one track, and if so the log odds of
#: that join; whether they have one input id; the log odds of the joins that it would replace; whether the one was cut
#: at its end and the other at its beginning; the logarithms of their numbers of samples; and whether there is no gap,
#: and one of less than ``_SHORT_S``.
RELINK_FEATURES: Final = (
    *FEATURES,
    "same track",
    "odds of join",
    "same input id",
    "odds before",
    "odds after",
    "cut before",
    "cut after",
    "log before",
    "log after",
    "next step",
    "short gap",
)
_SHORT_S: Final = 1.0
#: Pieces with one input id are candidates over gaps of less than this, however unlikely by their motion. Seconds.
_SAME_ID_S: Final = 6.0
#: As ``linking.ENOUGH``, where a person surely goes on.
_ENOUGH_AT_CUTS: Final = 1 / 11
#: Probabilities of joins are taken for no closer to 0 and 1 than this.
_CLOSEST: Final = 1e-6
_RELINKS: Final = Logistic.of("relinks", RELINK_FEATURES)


class CutTracks(NamedTuple):
    """Tracks (K,) after cutting, by ascending id: the input ids of the first and last sample, the number of samples,
    the track that it was cut from at its end or -1, and the log odds of the joins at its beginning and end, or NaN.
    """

    first_source: Ints
    last_source: Ints
    length: Ints
    went_on: Ints
    odds_before: Floats
    odds_after: Floats

    @classmethod
    def of(cls, tracks: Tracks, cuts: Cuts) -> CutTracks:
        """The tracks, and where they were cut."""
        order = tracks.order
        track, source = tracks.track[order], tracks.source[order]
        starts = run_starts(track)
        first, last = np.flatnonzero(starts), np.flatnonzero(run_ends(starts))
        ids = track[first]
        before, after = np.searchsorted(ids, cuts.before), np.searchsorted(ids, cuts.after)
        likely = np.clip(cuts.probability, _CLOSEST, 1 - _CLOSEST)
        went_on = np.full(len(ids), -1)
        odds = np.full((2, len(ids)), np.nan)
        went_on[before] = after
        odds[0, after] = odds[1, before] = np.log(likely / (1 - likely))
        return cls(source[first], source[last], last - first + 1, went_on, *odds)


class CandidateLinks(NamedTuple):
    """Candidate links (E,): from the end of one track to the beginning of another, and the seconds between them;
    whether one of them was cut there; their log odds as a link without cuts; the features (E, F) of one at a cut; and
    the log likelihood ratio of what is known of both beside their motion.
    """

    ends: Ints
    begins: Ints
    gap_s: Floats
    at_cut: Bools
    log_odds: Floats
    features: Floats
    evidence: Floats


def find_candidates(
    sides: TrackEnds, max_gap_s: float, pieces: CutTracks, evidence: Evidence | None = None
) -> CandidateLinks:
    """Candidate links: plausible ones as without cuts, and at cuts those within one track or input id.

    ``evidence`` is what else tells whether both sides are one person.
    """
    i, j = candidates(sides, max_gap_s)
    gaps = sides.gaps(i, j)
    usual, gap_s = features(sides.model, gaps), gaps.seconds
    cut_before, cut_after = np.isfinite(pieces.odds_after[i]), np.isfinite(pieces.odds_before[j])
    same_track, same_id = pieces.went_on[i] == j, pieces.last_source[i] == pieces.first_source[j]
    is_known = same_track | (same_id & (cut_before | cut_after) & (gap_s < _SAME_ID_S))
    odds, beside = log_odds(usual), np.zeros(len(i))
    if evidence is not None:
        near = np.flatnonzero(is_known | has_chance(odds + MOST))
        beside[near] = evidence(i[near], j[near])
        odds = odds + beside
    may_be = has_chance(odds) | is_known
    extra = (
        same_track,
        np.where(same_track, pieces.odds_after[i], 0.0),
        same_id,
        np.where(same_track | ~cut_before, 0.0, pieces.odds_after[i]),
        np.where(same_track | ~cut_after, 0.0, pieces.odds_before[j]),
        cut_before,
        cut_after,
        np.log(pieces.length[i]),
        np.log(pieces.length[j]),
        gap_s < 1.5 * sides.model.step_s,
        gap_s < _SHORT_S,
    )
    columns = np.column_stack([usual, *extra]).astype(np.float64)
    all_of = CandidateLinks(i, j, gap_s, cut_before | cut_after, odds, columns, beside)
    return CandidateLinks(*(values[may_be] for values in all_of))


def link_pieces(
    sides: TrackEnds, max_gap_s: float, min_confidence: float, pieces: CutTracks, evidence: Evidence | None = None
) -> Ints:
    """For each of the tracks after cutting the one that continues it, or -1; (K,)."""
    count = len(sides.begins)
    continued_by = np.full(count, -1)
    candidates = find_candidates(sides, max_gap_s, pieces, evidence)
    if len(candidates.ends) == 0:
        return continued_by
    at_cut = _RELINKS.log_odds(candidates.features) + candidates.evidence
    log_odds = np.where(candidates.at_cut, at_cut, candidates.log_odds)
    shift = np.zeros(len(log_odds))
    links = np.empty(0, np.int64)
    for _ in range(2):  # the share of right links that is usual in this log is known after the first round
        links = best_links(
            candidates.ends, candidates.begins, log_odds + np.where(candidates.at_cut, 0.0, shift), count
        )
        elsewhere = links[~candidates.at_cut[links]]
        shifts = prior_shifts(log_odds[elsewhere], candidates.gap_s[elsewhere])
        shift = shifts[gap_classes(candidates.gap_s)]
    log_odds += np.where(candidates.at_cut, -np.log(_ENOUGH_AT_CUTS), shift - np.log(ENOUGH))
    links = links[log_odds[links] > np.log(min_confidence / (1 - min_confidence))]
    continued_by[candidates.ends[links]] = candidates.begins[links]
    return continued_by
