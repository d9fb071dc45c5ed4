"""Answers of people, and of judges, to questions about identities: they bind what offline re-tracking decides.

An answer is a row of Decisions in a channel of its own. Of kind "joined": with this probability ``source_id`` from then
on is the person that ``previous_id`` was until ``duration_s`` before. Of kind "kept": ``source_id`` is a person then.
What is certain (0 or 1, a person said it) holds whatever else speaks against it; other probabilities, of judges, take
the place of colours as evidence of the link.

Corrections of people are in ``fix_tracks``.

Letters: A answers, C assignments, K tracklets, E candidate links, P pieces of tracks.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.ragged import find_rows, run_ends, run_starts
from mcaptrack.notices import warn
from mcaptrack.schema import DECISIONS, DecisionKind, Frame
from mcaptrack.schema.framing import join_frames, nearest_times
from mcaptrack.transforms.retrack.assignments import Tracks
from mcaptrack.transforms.retrack.decisions import favouring
from mcaptrack.transforms.retrack.hypotheses import Hypotheses, best_next, following, named
from mcaptrack.transforms.retrack.linking import chains

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
