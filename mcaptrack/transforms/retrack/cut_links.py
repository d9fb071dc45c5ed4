"""Links of tracks that were cut: which piece goes on as which other one, or as none.

Where a track was cut a person goes on, and it is known how the track went on before the cut. So links at cuts have
weights of their own: the other piece of the same track is one candidate among others, and that both have the same input
id counts. Links from a track's own end to another's own beginning are judged as without cuts, and the share of
these that is right is estimated from these alone: links at cuts are many, and would make all long gaps look crossed.

Letters: C assignments, K tracks, E candidate links, F features.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.ragged import run_ends, run_starts
from mcaptrack.transforms.retrack import linking
from mcaptrack.transforms.retrack.appearance import MOST, Evidence
from mcaptrack.transforms.retrack.assignments import Tracks
from mcaptrack.transforms.retrack.joins import Cuts
from mcaptrack.transforms.retrack.linking import TrackEnds
from mcaptrack.transforms.retrack.weights import Logistic

#: The features of a link at a cut: those of a link; whether both are pieces of one track, and if so the log odds of
#: that join; whether they have one input id; the log odds of the joins that it would replace; whether the one was cut
#: at its end and the other at its beginning; the logarithms of their numbers of samples; and whether there is no gap,
#: and one of less than ``_SHORT_S``.
FEATURES: Final = (
    *linking.FEATURES,
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
_RELINKS: Final = Logistic.of("relinks", FEATURES)


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
    i, j = linking.candidates(sides, max_gap_s)
    gaps = sides.gaps(i, j)
    usual, gap_s = linking.features(sides.model, gaps), gaps.seconds
    cut_before, cut_after = np.isfinite(pieces.odds_after[i]), np.isfinite(pieces.odds_before[j])
    same_track, same_id = pieces.went_on[i] == j, pieces.last_source[i] == pieces.first_source[j]
    is_known = same_track | (same_id & (cut_before | cut_after) & (gap_s < _SAME_ID_S))
    log_odds, beside = linking.log_odds(usual), np.zeros(len(i))
    if evidence is not None:
        near = np.flatnonzero(is_known | linking.has_chance(log_odds + MOST))
        beside[near] = evidence(i[near], j[near])
        log_odds = log_odds + beside
    may_be = linking.has_chance(log_odds) | is_known
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
    features = np.column_stack([usual, *extra]).astype(np.float64)
    all_of = CandidateLinks(i, j, gap_s, cut_before | cut_after, log_odds, features, beside)
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
        links = linking.best_links(
            candidates.ends, candidates.begins, log_odds + np.where(candidates.at_cut, 0.0, shift), count
        )
        elsewhere = links[~candidates.at_cut[links]]
        shifts = linking.prior_shifts(log_odds[elsewhere], candidates.gap_s[elsewhere])
        shift = shifts[linking.gap_classes(candidates.gap_s)]
    log_odds += np.where(candidates.at_cut, -np.log(_ENOUGH_AT_CUTS), shift - np.log(linking.ENOUGH))
    links = links[log_odds[links] > np.log(min_confidence / (1 - min_confidence))]
    continued_by[candidates.ends[links]] = candidates.begins[links]
    return continued_by
