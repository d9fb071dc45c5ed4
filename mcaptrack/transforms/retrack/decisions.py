"""The decisions of offline re-tracking: their rows, and plausible worlds, in which they are made again with noise.

Joins are judged once all tracks are decided, whatever step made them: association, a link over a gap, or a swap that
was resolved. Tracks are people or false with the odds of the test of false tracks. Probabilities are logistic
regressions, fitted on synthetic scenes (see ``weights``), where of the decisions with a probability of 0.9 about 90 %
are right.

Letters: C assignments, W worlds, K tracklets, E candidate links, P tracks, J joins.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.ragged import find_rows, run_ends, run_starts
from mcaptrack.notices import warn
from mcaptrack.schema import DECISIONS, WORLDS, DecisionKind, Frame, Rows
from mcaptrack.schema.classes import majority
from mcaptrack.schema.frame_columns import FrameColumns
from mcaptrack.schema.framing import join_frames, nearest_times, rows_at
from mcaptrack.transforms.retrack.hypotheses import Hypotheses, best_next, following, named
from mcaptrack.transforms.retrack.linking import chains
from mcaptrack.transforms.retrack.motion_model import MotionModel, Tracks
from mcaptrack.transforms.retrack.weights import Logistic, probability

#: Whether a join is right, from its log odds as its end and as its beginning see them.
JOINS: Final = Logistic.of("joins")
#: The log odds that a track is a person, from those of the test of false tracks: that one weighs rows, not tracks.
PERSON: Final = Logistic.of("decided")
#: The same of tracks that are too short: there is less to see of these, so they are more doubtful.
SHORT: Final = Logistic.of("decided short")
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
    return rows_at(DECISIONS, rows.take(order), step[order], steps)


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
    order = order[log_odds[order] >= _MAY_BE]
    low, high = (np.searchsorted(hypotheses.before[order], hypotheses.before, side) for side in ("left", "right"))
    order = np.append(order, -1)
    other = low + (order[low] == np.arange(len(log_odds)))
    source = hypotheses.tracklets.source[hypotheses.after[order[np.minimum(other, len(order) - 1)]]]
    return np.where(other < high, source, _NO_ID)


def _persons(decided: Decided, step_s: float) -> tuple[Ints, Rows]:
    """The first assignment of each track (K,), and the row that says whether it is a person."""
    step, track, source = decided.tracks[:3]
    starts = run_starts(track)
    first, last = np.flatnonzero(starts), np.flatnonzero(run_ends(starts))
    rows = DECISIONS.empty(len(first))
    rows["kind"] = np.where(decided.kept, DecisionKind.KEPT, DecisionKind.LEFT_OUT)
    rows["track_id"] = np.where(decided.kept, track[first], _NO_ID)
    rows["previous_id"] = rows["alternative_id"] = _NO_ID
    rows["source_id"] = majority(np.cumsum(starts) - 1, source, len(first))
    is_person = probability(decided.log_odds)
    rows["probability"] = np.where(decided.kept, is_person, 1 - is_person)
    rows["duration_s"] = (step[last] - step[first]) * step_s
    rows["frames"] = last - first + 1
    return first, rows


# Plausible worlds: identities of tracks, and which are people, as they may be where offline re-tracking is not sure.
#
# Each world is the best set of links under scores with noise of Gumbel's distribution (perturb and MAP: Papandreou and
# Yuille 2011), by the same solver. What was decided for reasons that no single link has (encounters, corrections of
# people, the sweep before) counts for its links as much as it takes for them to be the best ones without noise.


#: The scale of the noise of scores: joins hold in as many worlds as are right. (Chosen on synthetic crowds.)
NOISE = 1.35
#: The scale of the noise of the log odds that tracks are people.
PERSON_NOISE = 1.0
#: Tracks of one log are people or clutter together: so many log odds in all tracks of a world of synthetic crowds (a
#: standard deviation), and by how much log odds are larger once that is known (Zeger, Liang and Albert 1988).
_OF_LOG: Final = 2.0
_KNOWN: Final = (1 + 0.346 * _OF_LOG**2) ** 0.5
#: Worlds are drawn with this seed, so the same log has the same ones; links and people have noise of their own.
_SEED, _OF_LINKS, _OF_PEOPLE = 2011, 0, 1
#: What was decided is better than anything else by so much at least, without noise.
_LEAST: Final = 1e-3
#: Log odds of what is certain, with or without noise.
_CERTAIN: Final = 50.0


class Worlds(NamedTuple):
    """The track of each tracklet in each world (W, K), and whether it is kept as a person (W, K)."""

    track: Ints
    kept: Bools


def draw_worlds(count: int, decided: Decided, min_confidence: float, least_steps: int, seed: int = 0) -> Worlds:
    """Draw worlds; the first ones are the same whatever the ``count``.

    Parameters
    ----------
    count : int
        The number of worlds W.
    decided : Decided
    min_confidence : float
        As for the decision.
    least_steps : int
        What lasts fewer steps is no person, unless that is certain.
    seed : int
        Worlds of other tracks of the log have another seed.
    """
    tracks, log_odds, kept, hypotheses = decided
    tracklets, before, after, *_ = hypotheses
    size, track = len(tracklets.first), tracks.track[tracklets.first]
    links = np.flatnonzero(following(track, tracklets.begins)[before] == after)
    gain = favouring(links, hypotheses, hypotheses.scored().gain(min_confidence))
    of = np.unique(track, return_inverse=True)[1]
    is_person = np.where(kept, np.maximum(log_odds, _LEAST), np.minimum(log_odds, -_LEAST))
    is_certain = is_person > _CERTAIN
    is_person = np.clip(is_person, -_CERTAIN, _CERTAIN)
    out = Worlds(np.empty((count, size), np.int64), np.empty((count, size), bool))
    for world, root in enumerate(draw_links(count, hypotheses, gain, seed)):
        out.track[world] = named(root, track)
        total = np.bincount(root, draw_people(world, is_person, seed)[of] * tracklets.samples, minlength=size)
        first, last = np.full((2, size), [[np.iinfo(np.int64).max], [0]])
        np.minimum.at(first, root, tracklets.begins)
        np.maximum.at(last, root, tracklets.ends)
        certain = np.bincount(root, is_certain[of], minlength=size) > 0
        out.kept[world] = (certain | ((total > 0) & (last - first >= least_steps)))[root]
    return out


def draw_links(count: int, hypotheses: Hypotheses, gain: Floats, seed: int = 0) -> Iterator[Ints]:
    """For each world the first tracklet of the chain that has each one (K,); ``gain`` (E,) is that without noise."""
    tracklets, before, after, *_ = hypotheses
    size = len(tracklets.first)
    for world in range(count):
        random = np.random.default_rng([_SEED, _OF_LINKS, seed, world])
        leaves, comes = random.gumbel(size=(2, size))
        out, into = random.gumbel(size=(2, len(gain)))
        off = (out - leaves[before] + into - comes[after]) / 2
        yield chains(best_next(before, after, gain + NOISE * off, size), tracklets.begins)


def draw_people(world: int, log_odds: Floats, seed: int = 0) -> Floats:
    """The log odds (P,) that tracks are people in a world: above 0 with the probability that ``log_odds`` (P,) say."""
    random = np.random.default_rng([_SEED, _OF_PEOPLE, seed, world])
    noise = _OF_LOG * random.normal() + random.logistic(size=len(log_odds))
    return np.asarray(_KNOWN * log_odds + PERSON_NOISE * noise)


def world_rows(worlds: Worlds, hypotheses: Hypotheses, step_s: float, steps: Ints) -> Iterator[Rows]:
    """The rows of Worlds at each of ``steps``: those of the tracklets that begin there, by world and input id."""
    tracklets, count = hypotheses.tracklets, len(worlds.track)
    for low, high in pairwise(np.append(0, np.searchsorted(tracklets.begins, steps, "right")).tolist()):
        here = low + np.argsort(tracklets.source[low:high], kind="stable")
        rows = WORLDS.empty(count * len(here))
        rows["world"] = np.repeat(np.arange(1, count + 1), len(here))
        rows["kept"] = kept = worlds.kept[:, here].ravel()
        rows["track_id"] = np.where(kept, worlds.track[:, here].ravel(), -1)
        rows["source_id"] = np.tile(tracklets.source[here], count)
        rows["duration_s"] = np.tile((tracklets.ends - tracklets.begins)[here] * step_s, count)
        rows["frames"] = np.tile(tracklets.samples[here], count)
        yield WORLDS.check(rows)


def favouring(decided: Ints, hypotheses: Hypotheses, gain: Floats) -> Floats:
    """Gains (E,) with which the links ``decided`` are the best set.

    They are raised by as little as possible in all: a linear programme over the prices of ends and of beginnings, the
    dual one of the assignment. Links between ends and beginnings that have none are lowered.
    """
    from scipy.optimize import linprog
    from scipy.sparse import csr_array

    _, before, after, *_ = hypotheses
    size = len(hypotheses.tracklets.first)
    gain = gain.copy()
    ends, begins = np.zeros((2, size), bool)
    ends[before[decided]] = begins[after[decided]] = True
    is_free = ~ends[before] & ~begins[after]
    gain[is_free] = np.minimum(gain[is_free], -_LEAST)
    need = gain + _LEAST
    need[decided] = np.maximum(gain[decided], _LEAST)
    counts = np.flatnonzero(~is_free & (need > 0))
    has_price = np.stack([ends[before[counts]], begins[after[counts]]])
    at = np.stack([before[counts], size + after[counts]])[has_price]
    limits = csr_array((-np.ones(len(at)), (np.nonzero(has_price)[1], at)), shape=(len(counts), 2 * size))
    cost = np.concatenate([ends, begins]).astype(np.float64)
    price = linprog(cost, A_ub=limits, b_ub=-need[counts], method="highs").x
    gain[decided] = price[before[decided]] + price[size + after[decided]]
    return gain


# Answers of people, and of judges, to questions about identities: they bind what offline re-tracking decides.
#
# An answer is a row of Decisions in a channel of its own. Of kind "joined": with this probability ``source_id`` from
# then on is the person that ``previous_id`` was until ``duration_s`` before. Of kind "kept": ``source_id`` is a person
# then. What is certain (0 or 1, a person said it) holds whatever else speaks against it; other probabilities, of
# judges, take the place of colours as evidence of the link.
#
# Letters: A answers, C assignments, K tracklets, E candidate links, P pieces of tracks.


#: The log odds of what is certain: more than all evidence of a link.
CERTAIN: Final = 100.0


class Answers(NamedTuple):
    """Answers (A,): ``step`` and ``source`` (A, 2) of the samples before and after, which ask about a join, and the log
    odds of "yes".
    """

    step: Ints
    source: Ints
    is_join: Bools
    log_odds: Floats

    @classmethod
    def of(cls, frames: Sequence[Frame], steps: Ints, times_ns: Ints) -> Answers:
        """The answers in frames of Decisions, about samples at ``steps``, which are at ``times_ns``."""
        joined = join_frames(DECISIONS, frames)
        rows, after_ns = joined.rows, joined.row_ns
        is_join = rows["kind"] == DecisionKind.JOINED
        before_ns = after_ns - np.where(is_join, np.round(rows["duration_s"] * NS_PER_S), 0).astype(np.int64)
        step = steps[nearest_times(times_ns, np.stack([before_ns, after_ns], axis=1))]
        source = np.stack([np.where(is_join, rows["previous_id"], rows["source_id"]), rows["source_id"]], axis=1)
        yes = np.where(rows["kind"] == DecisionKind.LEFT_OUT, 1 - rows["probability"], rows["probability"])
        with np.errstate(divide="ignore"):
            log_odds = np.clip(np.log(yes) - np.log1p(-yes), -CERTAIN, CERTAIN)
        return cls(step, source, is_join, log_odds)

    @property
    def is_certain(self) -> Bools:
        """Which answers bind, (A,)."""
        return np.asarray(np.abs(self.log_odds) >= CERTAIN)

    def find(self, tracks: Tracks) -> Ints:
        """The assignments before and after, (A, 2), -1 where there are none: of another class, or gone."""
        rows = find_rows((tracks.step, tracks.source), (self.step.ravel(), self.source.ravel())).reshape(-1, 2)
        return np.where((rows < 0).any(axis=1, keepdims=True), -1, rows)

    def joined(self, tracks: Tracks) -> tuple[Ints, Ints]:
        """The assignments that are certainly of one person, before and after."""
        rows = self.find(tracks)[self.is_join & (self.log_odds >= CERTAIN)]
        before, after = rows[rows[:, 0] >= 0].T
        return before, after

    def weighed(self, hypotheses: Hypotheses, tracks: Tracks, evidence: Floats, is_final: bool) -> Floats:
        """``evidence`` (E,) of links, or what was answered in its place; certain answers only if tracks are final."""
        link, clutter = self._links(hypotheses, tracks)
        evidence = evidence.copy()
        those = (link >= 0) & (is_final | ~self.is_certain)
        evidence[link[those]] = self.log_odds[those]
        if is_final:
            evidence[clutter] = -CERTAIN
        return evidence

    def _links(self, hypotheses: Hypotheses, tracks: Tracks) -> tuple[Ints, Bools]:
        """The candidate link that each answer is about, (A,), -1 for none; and which links (E,) are with no person."""
        tracklets, before, after, *_ = hypotheses
        rows = self.find(tracks)
        of, here = tracklets.of[rows], rows[:, 0] >= 0
        link = find_rows((before, after), (of[:, 0], of[:, 1]))
        clutter = of[here & ~self.is_join & (self.log_odds <= -CERTAIN), 0]
        is_with = np.isin(before, clutter) | np.isin(after, clutter)
        return np.where(here & self.is_join, link, -1), is_with

    def persons(self, tracks: Tracks, yes: bool) -> Ints:
        """The tracks that certainly are people, or are none."""
        is_asked = ~self.is_join & (self.log_odds >= CERTAIN if yes else self.log_odds <= -CERTAIN)
        rows = self.find(tracks)[is_asked, 1]
        return np.unique(tracks.track[rows[rows >= 0]])

    def obeyed(self, tracks: Tracks, hypotheses: Hypotheses, min_confidence: float) -> Tracks:
        """Tracks that agree with all that is certain, and are else as they were decided where that is possible.

        They are the best set of links (``hypotheses``) with what was decided favoured as in worlds, so an answer that
        agrees changes nothing. Where no link says it, tracks are taken apart at tracklets and at samples that were
        asked about: pieces of one person are joined; then those that were beside each other, the surest first, if no
        answer speaks against it. Answers that contradict others are left out, with a warning.
        """
        tracklets, before, after, *_ = hypotheses
        follows = following(tracks.track[tracklets.first], tracklets.begins)
        gain = favouring(np.flatnonzero(follows[before] == after), hypotheses, hypotheses.scored().gain(min_confidence))
        link, clutter = self._links(hypotheses, tracks)
        bound = (link >= 0) & self.is_certain
        gain[link[bound]] += 3 * self.log_odds[bound]
        gain[clutter] = -CERTAIN
        root = chains(best_next(before, after, gain, len(tracklets.first)), tracklets.begins)
        return self._separated(
            tracks._replace(track=named(root, tracks.track[tracklets.first])[tracklets.of]), hypotheses, gain
        )

    def _separated(self, tracks: Tracks, hypotheses: Hypotheses, gain: Floats) -> Tracks:
        """Tracks that agree with what is certain, from such that do so in their links (E,) with this ``gain``."""
        rows = self.find(tracks)
        asked = self.is_certain & (rows[:, 0] >= 0)
        rows, is_join, yes = rows[asked], self.is_join[asked], self.log_odds[asked] > 0
        if not len(rows):
            return tracks
        order = tracks.order
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        tracklet = hypotheses.tracklets.of[order]
        starts = run_starts(tracks.track[order], tracklet)
        starts[place[rows[is_join, 1]]] = True
        starts[np.minimum(place[rows[is_join, 0]] + 1, len(order) - 1)] = True
        first = np.flatnonzero(starts)
        last = np.append(first[1:], len(order)) - 1
        number = np.cumsum(starts) - 1
        piece = number[place]  # of each assignment
        pieces = _Pieces(tracks.step[order[first]], tracks.step[order[last]])
        pairs = piece[rows]
        pieces.apart = {frozenset(pair) for pair in pairs[is_join & ~yes].tolist()}
        lost = sum(not pieces.join(*pair) for pair in pairs[is_join & yes].tolist())
        lost += sum(len(pair) == 1 for pair in pieces.apart)
        if lost:
            warn(f"{lost} of {len(rows)} answers contradict others, and are left out", "left-out")
        clutter = np.isin(tracklet[first], hypotheses.tracklets.of[rows[~is_join & ~yes, 1]])
        track = tracks.track[order[first]]
        beside = np.flatnonzero((track[1:] == track[:-1]) & ~(clutter[1:] | clutter[:-1]))
        same = tracklet[first[beside]] == tracklet[first[beside + 1]]
        link = find_rows((hypotheses.before, hypotheses.after), (tracklet[first[beside]], tracklet[first[beside + 1]]))
        strength = np.where(same, np.inf, np.append(gain, 0.0)[link])
        for at in beside[np.argsort(-strength, kind="stable")].tolist():
            pieces.join(at, at + 1)
        return tracks._replace(track=named(pieces.root, track)[piece])


class _Pieces:
    """Pieces of tracks (P,) and which of them are one person: ``root`` (P,) is the first of these."""

    def __init__(self, begins: Ints, ends: Ints) -> None:
        self._begins, self._ends = begins, ends
        self.root = np.arange(len(begins))
        self._of = {number: [number] for number in range(len(begins))}
        self.apart: set[frozenset[int]] = set()

    def join(self, one: int, other: int) -> bool:
        """Join two pieces and all that are joined to them; whether that was possible."""
        low, high = sorted((int(self.root[one]), int(self.root[other])))
        if low == high:
            return True
        mine, theirs = self._of[low], self._of[high]
        meet = self._begins[mine][:, None] <= self._ends[theirs]
        meet &= self._begins[theirs] <= self._ends[mine][:, None]
        if meet.any() or any(frozenset((a, b)) in self.apart for a in mine for b in theirs):
            return False
        self.root[theirs] = low
        self._of[low] = mine + self._of.pop(high)
        return True


def fix_tracks(tracks: Tracks, fixed: Collection[int]) -> Tracks:
    """Tracks that people have corrected: all samples of a fixed input id have one track, and no other fixed one.

    What a track has before the first sample of a fixed id, or after its last one, stays with it: a person who was
    followed into the corrected part keeps the id. All else keeps its track, or gets a new one where a fixed id has
    taken it.
    """
    order = tracks.order
    is_fixed = np.isin(tracks.source[order], np.array(sorted(fixed), np.int64))
    if not is_fixed.any():
        return tracks
    track, source = tracks.track[order], np.where(is_fixed, tracks.source[order], 0)
    starts = run_starts(track, is_fixed, source)
    first, piece = np.flatnonzero(starts), np.cumsum(starts) - 1
    track, person, step, is_person = track[first], source[first], tracks.step[order[first]], is_fixed[first]
    by_time = np.lexsort((step, person, ~is_person))[: np.count_nonzero(is_person)]
    begins = run_starts(person[by_time])
    is_first, is_last = np.zeros((2, len(first)), bool)
    is_first[by_time], is_last[by_time] = begins, run_ends(begins)
    same = track[1:] == track[:-1]
    after, before = same & is_last[:-1] & ~is_person[1:], same & is_first[1:] & ~is_person[:-1]
    person[:-1][before], person[1:][after] = person[1:][before], person[:-1][after]
    is_person[:-1] |= before
    is_person[1:] |= after
    by_time = np.argsort(step, kind="stable")
    names = np.stack([is_person, np.where(is_person, person, track)])[:, by_time]
    _, begin, which = np.unique(names, axis=1, return_index=True, return_inverse=True)
    out, node = np.empty(len(order), np.int64), np.empty(len(first), np.int64)
    node[by_time] = named(begin[which.ravel()], track[by_time])
    out[order] = node[piece]
    return tracks._replace(track=out)
