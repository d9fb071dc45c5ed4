"""Identities over a whole log: tracklets, what may have become of each, how likely that is, and the best of it.

A tracklet is what is certain: samples that the online tracker gave to one track in a row, all with one input id. At
its end a person goes on as a later tracklet or leaves; at its beginning one goes on from an earlier tracklet or comes.
Each end chooses one of these, and so does each beginning, with probabilities in proportion to exp(score) (a multinomial
logit: McFadden 1974). Scores are sums of named terms with fitted weights. What the log itself says of how many people
leave, and for how long they are missed, shifts them (Saerens et al. 2002: the expectation-maximisation of priors). The
best set of links is one assignment over the log, and the probability of each link comes of the same choices.

Letters: C assignments, K tracklets, E candidate links, F terms of a link, G terms of an end.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints, taken
from mcaptrack.geometry.neighbours import touching_pairs
from mcaptrack.geometry.ragged import group_index, ragged_range, run_ends, run_starts
from mcaptrack.transforms.retrack.linking import (
    MIN_LOG_ODDS,
    TrackEnds,
    best_links,
    chains,
    log_odds,
    motion_terms,
    pairs_in_reach,
)
from mcaptrack.transforms.retrack.motion_model import MotionModel, State, Tracks, filtered, to_trajectories
from mcaptrack.transforms.retrack.weights import FILE, Choices, columns

if TYPE_CHECKING:
    from scipy.sparse import csr_array

#: Links have weights by the length of their gap: no step between, and up to so many seconds.
GAPS_S: Final = (1.7, 5.0)
#: The log odds that are added to links of an online track from one step to the next, no farther than at this speed and
#: with no other track beside: however sharply a person turns there, it is the same one.
_ALONE, _WALK_M_PER_S = 8.0, 1.1
#: The number of ends and beginnings with the usual shares that count beside those of a log.
_USUAL_ENDS: Final = 20.0
#: A person who is lost beside another one may be hidden by that one, or in one detection with that one; from this
#: distance on nothing speaks for it, and at half of it half as much.
_BESIDE_M: Final = 2.0
#: Few samples of a tracklet are fewer than that.
_FEW: Final = 4
#: Links are kept from these odds on, as a share of those of the least confidence: pieces of a person that stay apart
#: cost more than wrong ones that go together. (Chosen on synthetic crowds.)
_ENOUGH: Final = 1 / 5
#: What ends and beginnings choose.
CHOICES = Choices.of(FILE["choices"])


class Tracklets(NamedTuple):
    """Tracklets (K,), ordered by their first steps; ``of`` (C,) is the tracklet of each assignment.

    ``first`` and ``last`` (K,) are assignments, ``begins`` and ``ends`` (K,) their steps, ``samples`` the numbers of
    assignments, ``source`` the input ids and ``online`` the ids of online tracks.
    """

    of: Ints
    first: Ints
    last: Ints
    begins: Ints
    ends: Ints
    samples: Ints
    source: Ints
    online: Ints

    @classmethod
    def in_tracks(cls, tracks: Tracks) -> Tracklets:
        """The tracklets of tracks (C,): an online track that was split has one at least for each part."""
        order = tracks.order
        starts = run_starts(tracks.track[order], tracks.online[order], tracks.source[order])
        first, last = order[np.flatnonzero(starts)], order[np.flatnonzero(run_ends(starts))]
        by_begin = np.lexsort((tracks.source[first], tracks.track[first], tracks.step[first]))
        rank = np.empty_like(by_begin)
        rank[by_begin] = np.arange(len(by_begin))
        of = np.empty(len(order), np.int64)
        of[order] = rank[np.cumsum(starts) - 1]
        first, last = first[by_begin], last[by_begin]
        steps = tracks.step[first], tracks.step[last]
        return cls(of, first, last, *steps, np.bincount(of), tracks.source[first], tracks.online[first])


class Hypotheses(NamedTuple):
    """The hypotheses about the tracklets of a log.

    ``before`` and ``after`` (E,) are the tracklets of candidate links, ``gap`` (E,) the class of the seconds between
    them; ``terms`` (E, F) are those of links, ``leaves`` and ``comes`` (K, G) of ends where a
    person leaves, and of beginnings where one comes.
    ``evidence`` (E,) is the log likelihood ratio of what else tells whether both are one person.
    """

    tracklets: Tracklets
    before: Ints
    after: Ints
    gap: Ints
    terms: Floats
    leaves: Floats
    comes: Floats
    evidence: Floats

    @classmethod
    def of(
        cls, model: MotionModel, tracks: Tracks, max_gap_s: float, asked: tuple[Ints, Ints] | None = None
    ) -> Hypotheses:
        """The hypotheses about tracks as they are now, with the ``evidence`` of those that go on alone.

        ``asked`` are assignments before and after that are of one person, however far apart.
        """
        tracklets = Tracklets.in_tracks(tracks)
        tracked, beside = _tracked(model, tracks, tracklets)
        _, row, paths = to_trajectories(tracks.step, tracklets.of, tracks.xy_m)
        forward, backward = filtered(model, paths)
        ends = _ends(model, tracklets, *tracked)
        ends_alone = _ends(model, tracklets, taken(forward, row), taken(backward, row))
        follows = following(tracks.track[tracklets.first], tracklets.begins)
        before, after = _candidates(ends, follows, max_gap_s)
        if asked is not None and len(asked[0]):
            more = tracklets.of[np.stack(asked)]
            more = more[:, tracklets.ends[more[0]] < tracklets.begins[more[1]]]
            before, after = np.unique(np.concatenate([[before, after], more], axis=1), axis=1)
        gaps = ends.gaps(before, after)
        gap_s, alone = gaps.seconds, motion_terms(model, ends_alone.gaps(before, after))
        same_track, near = tracklets.online[before] == tracklets.online[after], tuple(map(_largest, beside))
        apart_m = np.hypot(*(tracks.xy_m[tracklets.first[after]] - tracks.xy_m[tracklets.last[before]]).T)
        is_alone = (tracklets.begins[after] - tracklets.ends[before] == 1) & (apart_m < _WALK_M_PER_S * gap_s)
        is_alone &= same_track & (near[0][before] + near[1][after] == 0)
        so_far, left = _samples(tracks, tracklets)
        of_ids, of_tracks = _rates(tracks, tracklets)
        terms = {
            "link": np.ones(len(before)),
            **motion_terms(model, gaps),
            "miss alone": alone["miss"],
            "misfit to noise alone": alone["misfit to noise"],
            "log gap": np.log(gap_s + 0.2),
            "same input id": tracklets.source[before] == tracklets.source[after],
            "same track": same_track,
            "beside one track": _largest(beside[0][before].minimum(beside[1][after])),
            "samples before": np.log(tracklets.samples[before]),
            "samples after": np.log(tracklets.samples[after]),
            "track before": np.log(so_far[before]),
            "track after": np.log(left[after]),
            "rate of input ids": np.full(len(before), of_ids),
            "rate of tracks": np.full(len(before), of_tracks),
        }
        bounds = np.maximum.accumulate([1.5 * model.step_s, *GAPS_S])
        return cls(
            tracklets,
            before,
            after,
            np.searchsorted(bounds, gap_s),
            columns(CHOICES.terms, terms),
            _end_terms(model, tracks, tracklets, tracked[0], near[0], leaving=True),
            _end_terms(model, tracks, tracklets, tracked[1], near[1], leaving=False),
            np.where(is_alone, _ALONE, 0.0),
        )

    def scored(self) -> Scored:
        """The scores of all hypotheses, with the shares of this log."""
        choices = CHOICES
        link = (self.terms * choices.links[self.gap]).sum(axis=1) + self.evidence
        sides = []
        for which, terms, weights, usual in (
            (self.before, self.leaves, choices.leaves, choices.usual_leaves),
            (self.after, self.comes, choices.comes, choices.usual_comes),
        ):
            end = terms @ weights
            shift = _shifts(which, link, end, self.gap, usual)
            sides.append((link + shift[self.gap], end + shift[-1]))
        return Scored(self, *sides[0], *sides[1])


class Scored(NamedTuple):
    """The scores of links as ends see them and as beginnings do, ``out`` and ``into`` (E,), of leaving and of coming,
    ``leaves`` and ``comes`` (K,).
    """

    hypotheses: Hypotheses
    out: Floats
    leaves: Floats
    into: Floats
    comes: Floats

    def best(self, min_confidence: float) -> Ints:
        """The tracks of all assignments (C,) by the best set of links.

        Each has the id of the online track that it begins in; of several the first, and the others have new ids.
        """
        tracklets, before, after, *_ = self.hypotheses
        root = chains(best_next(before, after, self.gain(min_confidence), len(self.leaves)), tracklets.begins)
        return named(root, tracklets.online)[tracklets.of]

    def gain(self, min_confidence: float) -> Floats:
        """The gain of each link (E,) over leaving at its end and coming at its beginning; below 0 it isn't made."""
        _, before, after, *_ = self.hypotheses
        least = np.log(min_confidence / (1 - min_confidence) * _ENOUGH)
        return np.asarray((self.out - self.leaves[before] + self.into - self.comes[after]) / 2 - least)

    def log_odds(self) -> Floats:
        """The log odds of each link against all else that its end, and that its beginning, may choose, (E, 2)."""
        sides = (self.hypotheses.before, self.out, self.leaves), (self.hypotheses.after, self.into, self.comes)
        return np.stack([_against_others(*side) for side in sides], axis=1)


def best_next(before: Ints, after: Ints, gain: Floats, count: int) -> Ints:
    """The tracklet that follows each one (K,) by the best set of links (E,) with these gains; -1 where none does."""
    out = np.full(count, -1)
    links = best_links(before, after, gain, count)
    out[before[links]] = after[links]
    return out


def named(root: Ints, ids: Ints) -> Ints:
    """The ids of chains of tracklets (K,) by their first ones, ``root``: of ``ids`` (K,) those that they begin with.

    Of several chains with one id the first has it, and the others have new ones.
    """
    first = np.unique(root)
    names = ids[first]
    again = np.ones(len(first), bool)
    again[np.unique(names, return_index=True)[1]] = False
    names[again] = ids.max(initial=0) + 1 + np.arange(np.count_nonzero(again))
    return np.asarray(names[np.searchsorted(first, root)])


def _tracked(
    model: MotionModel, tracks: Tracks, tracklets: Tracklets
) -> tuple[tuple[State, State], tuple[csr_array, csr_array]]:
    """The states of each assignment (C,) from those of its track before it, and from those after it; and how near each
    track is to the ends and to the beginnings of tracklets of others, from 0 to 1: sparse, (K, tracks).

    Tracks are also where they are expected while they are missed.
    """
    from scipy.sparse import csr_array

    ids, row, paths = to_trajectories(tracks.step, tracks.track, tracks.xy_m)
    forward, backward = filtered(model, paths)
    track, at = group_index(np.diff(paths.first)), np.concatenate([tracklets.last, tracklets.first])
    here, xy_m = tracks.xy_m[at], forward.mean[:, :2]
    own, others = (np.concatenate([xy - _BESIDE_M / 2, xy + _BESIDE_M / 2], axis=1) for xy in (here, xy_m))
    which, other = touching_pairs(own, others, tracks.step[at], paths.step)
    is_other = track[other] != track[row[at[which]]]
    which, other = which[is_other], other[is_other]
    near = np.maximum(1 - np.hypot(*(here[which] - xy_m[other]).T) / _BESIDE_M, 0.0)
    beside = csr_array((near, (which, track[other])), shape=(len(at), len(ids)))
    count = len(tracklets.last)
    return (taken(forward, row), taken(backward, row)), (beside[:count], beside[count:])


def _candidates(ends: TrackEnds, follows: Ints, max_gap_s: float) -> tuple[Ints, Ints]:
    """Pairs (E,) of a tracklet and a later one that may be one person, and all with which tracks go on, ``follows``."""
    joined = np.flatnonzero(follows >= 0)
    pairs = [joined * len(follows) + follows[joined]]
    for before, after, gaps in pairs_in_reach(ends, max_gap_s):
        likely = log_odds(ends.model, gaps) > MIN_LOG_ODDS
        pairs.append(before[likely] * len(follows) + after[likely])
    before, after = np.divmod(np.unique(np.concatenate(pairs)), max(len(follows), 1))
    return before, after


def following(track: Ints, begins: Ints) -> Ints:
    """The tracklet that follows each one in its track (K,), or -1."""
    order = np.lexsort((begins, track))
    out = np.full(len(order), -1)
    same = np.flatnonzero(track[order][1:] == track[order][:-1])
    out[order[same]] = order[same + 1]
    return out


def _ends(model: MotionModel, tracklets: Tracklets, forward: State, backward: State) -> TrackEnds:
    """The ends of tracklets, from the states of all assignments (C,)."""
    begun, ended = taken(backward, tracklets.first), taken(forward, tracklets.last)
    return TrackEnds(model, tracklets.begins, tracklets.ends, begun, ended)


def _largest(near: csr_array) -> Floats:
    """The largest of each row."""
    return np.asarray(near.max(axis=1).todense()).ravel()


def _samples(tracks: Tracks, tracklets: Tracklets) -> tuple[Ints, Ints]:
    """The numbers of samples of tracks up to the ends of tracklets (K,), and from their beginnings on, (K,)."""
    order = tracks.order
    length = np.diff(np.append(np.flatnonzero(run_starts(tracks.track[order])), len(order)))
    place, rest = np.empty_like(order), np.empty_like(order)
    place[order], rest[order] = ragged_range(0, length), np.repeat(length, length)
    return place[tracklets.last] + 1, (rest - place)[tracklets.first]


def _rates(tracks: Tracks, tracklets: Tracklets) -> Floats:
    """The logarithms of the numbers of tracklets and of online tracks of the log, for each of its samples."""
    counts = np.array([len(tracklets.first), len(np.unique(tracks.online))])
    return np.asarray(np.log((counts + 1) / (len(tracks.step) + 50)))


def _end_terms(
    model: MotionModel, tracks: Tracks, tracklets: Tracklets, state: State, beside: Floats, leaving: bool
) -> Floats:
    """The terms of leaving at the ends of tracklets, or of coming at their beginnings, (K, G).

    ``state`` (C,) are the states of assignments, ``beside`` (K,) is how near another track is there, from 0 to 1.
    """
    at = tracklets.last if leaving else tracklets.first
    here, (low, high) = tracks.xy_m[at], np.percentile(tracks.xy_m, [1, 99], axis=0)
    border_m = np.maximum(np.minimum(here - low, high - here).min(axis=1), 0.0)
    steps = tracks.step.max() - tracklets.ends if leaving else tracklets.begins - tracks.step.min()
    left_s = steps * model.step_s
    terms = {
        "end": np.ones(len(at)),
        "beside a track": beside,
        "border": np.log(border_m + 0.5),
        "speed": np.log(np.hypot(*state.mean[at, 2:].T) + 0.1),
        "last second": left_s < 1,
        "log left": np.log(left_s + 1),
        "long left": left_s > 20,
        "samples": np.log(tracklets.samples),
        "single": tracklets.samples == 1,
        "few": tracklets.samples < _FEW,
    }
    return columns(CHOICES.end_terms, terms)


def _shifts(which: Ints, link: Floats, end: Floats, gap: Ints, usual: Floats) -> Floats:
    """The shifts of the scores of links by the classes of their gaps, and of leaving (the last one), in this log.

    ``which`` (E,) is the end that may choose each link. What ends choose on average is what is usual where weights were
    fitted, ``usual``; in this log it is what its own ends choose under these shifts, which is found by iteration.
    """
    count, classes = len(end), len(usual) - 1
    shift = np.zeros(classes + 1)
    for _ in range(30):
        chosen = _shares(which, link + shift[gap], end + shift[-1], gap, classes)
        share = (chosen.sum(axis=0) + _USUAL_ENDS * usual) / (count + _USUAL_ENDS)
        before, shift = shift, np.log(share / usual)
        if np.abs(shift - before).max() < 1e-3:
            break
    return shift


def _shares(which: Ints, link: Floats, end: Floats, gap: Ints, classes: int) -> Floats:
    """The probability that each end (K,) chooses a link of each class, and that it chooses none, (K, classes + 1)."""
    top = end.copy()
    np.maximum.at(top, which, link)
    odds = np.column_stack([np.zeros((len(end), classes)), np.exp(end - top)])
    np.add.at(odds, (which, gap), np.exp(link - top[which]))
    return np.asarray(odds / odds.sum(axis=1, keepdims=True))


def _against_others(which: Ints, link: Floats, end: Floats) -> Floats:
    """The log odds (E,) of each link against all others of its end (K,), and against none."""
    top = end.copy()
    np.maximum.at(top, which, link)
    own = np.exp(link - top[which])
    total = (np.exp(end - top) + np.bincount(which, own, minlength=len(end)))[which]
    rest = np.maximum(total - own, 1e-9 * total)
    return np.asarray(np.log(np.maximum(own, 1e-12) / rest))
