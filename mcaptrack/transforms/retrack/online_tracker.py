"""Online tracking by likelihood: data association step by step, from the past alone.

Every track is a Kalman filter. An observation is assigned to the track that makes it likely, and the input's track ids
count as evidence: much where a person walks alone, little in a crowd, where trackers confuse people. A track without
an observation is coasting: its filter predicts on until the track terminates. Tracks that are occluded stay alive while
they are merged into one detection with another track.

The numbers of tracks are rows of arrays, with a column for each track. A step has few tracks, so what takes time is the
number of operations on arrays. Letters: K tracks, N observations of one step or points, P pairs of both, L lost tracks,
V vertices of a hull.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints, joined, taken
from mcaptrack.geometry.assignment import LARGE_TABLE, assign_by_gain, assign_pairs_by_gain
from mcaptrack.geometry.neighbours import Pairing, near_pairs
from mcaptrack.transforms.retrack import linking
from mcaptrack.transforms.retrack.motion_model import MotionModel, State, StateRows, update

#: Limits of the estimated noise of measured positions, in metres.
NOISE_M: Final = (0.03, 0.8)
#: The share of positions expected outside the circle by which the noise is judged, and the lowest rate of adaptation.
_OUTSIDE: Final = 0.1
_MIN_RATE: Final = 0.01
#: The squared radius of that circle, for a variance of 1.
_CIRCLE: Final = -2 * np.log(_OUTSIDE)
#: The rows of the whole numbers of tracks: id, input id of the last observation (-1: of a merged detection), its number
#: in the log, how many there were, steps since the last one, and steps for which the track is merged into the detection
#: of another one.
IDS, SOURCE, SAMPLE, HITS, MISSED, MERGED = range(6)


# Online links: which new track continues a lost one, decided from when the new one begins until it has lasted.
#
# A track that is lost for longer than its filter can bridge terminates, and the same person comes back as a new
# track. Where that is likely, the new one is written under the id of the lost one, and if it is likelier than not,
# it is written at once: a person who was confirmed needs no more proof. While it goes on its motion is known better,
# so that one that was begun under an id of its own may get that of the lost one later; what was written before stays.
# Links are judged by motion as they are offline, but from the past alone: by the state of the lost track when it was
# last observed, that of the new one where it began, at its velocity now, and by how many earlier links of this log
# seem right. Offline re-tracking doesn't depend on these links.
#
# Letters: R tracks alive at the steps of some frames, end to end; F frames; K tracks; L lost and N new ones; E
# links.


#: So many of the last links say how many are right. That is estimated again when their number has grown by this share,
#: because it takes longer than a decision.
_LINKS: Final = 500
_GROWS: Final = 0.1
_NEVER: Final = np.iinfo(np.int64).max
#: The number of pairs that are examined at once.
_BATCH: Final = 200_000


class _Known(NamedTuple):
    """Tracks (K,): ids, those under which they are written, or -1, the steps at which they began, were last observed
    and are over, the number of observations, the state at the first one, and at the last one.
    """

    ids: Ints
    names: Ints
    began: Ints
    last: Ints
    over: Ints
    hits: Ints
    begun: State
    state: State


_NONE: Final = np.empty(0, np.int64)
_NO_STATE: Final = State(np.empty((0, 4)), np.empty((0, 3)))
_NO_TRACKS: Final = _Known(_NONE, _NONE, _NONE, _NONE, _NONE, _NONE, _NO_STATE, _NO_STATE)


class _Links(NamedTuple):
    """Candidate links (E,): from a lost track to a new one, by index, the seconds between them, and their log odds."""

    lost: Ints
    new: Ints
    gap_s: Floats
    log_odds: Floats


_NO_LINKS: Final = _Links(_NONE, _NONE, np.empty(0), np.empty(0))


class OnlineLinks:
    """Which tracks are written under which ids: called with the steps of a log, some at a time.

    Parameters
    ----------
    model : MotionModel
        How people move.
    max_gap_s : float
        Links are made over gaps of at most so many seconds; 0 for none.
    min_confidence : float
        The least probability of a link. As offline, odds of a third of this are enough, but not for a track to be
        written sooner.
    confirm_hits : int
        Only tracks with so many observations are continued by one that is not written otherwise.
    """

    def __init__(self, model: MotionModel, max_gap_s: float, min_confidence: float, confirm_hits: int) -> None:
        self._model, self._step_s, self._max_gap_steps = model, model.step_s, max_gap_s / model.step_s
        self._confirm_hits, self._settled_hits = confirm_hits, _lasting(confirm_hits)
        self._sure = float(np.log(min_confidence / (1 - min_confidence)))
        self._least = self._sure + float(np.log(linking.ENOUGH))
        self._alive, self._lost = _NO_TRACKS, _NO_TRACKS  # lost ones were written, and are continued by no other
        self._links: deque[tuple[float, float]] = deque(maxlen=_LINKS)  # log odds and seconds
        self._link_count, self._estimated = 0, 0
        self._shifts = linking.prior_shifts(np.empty(0), np.empty(0))

    def __call__(self, seen: Alive, is_written: Bools) -> tuple[Ints, Bools]:
        """The ids under which the tracks alive at some steps are written, (R,), and whether they are, (R,).

        ``is_written`` (R,) says which are written in any case. Nothing is known at a step that was not known then.
        """
        steps, _, tick, tracks, state = seen
        if self._max_gap_steps <= 0:
            return np.asarray(tracks[IDS]), is_written
        alive, which = self._known(seen)
        count, is_observed = len(tick), seen.is_observed
        is_named, is_own = alive.names >= 0, (alive.names < 0) | (alive.names == alive.ids)
        first = np.full(len(alive.ids), count)  # the row from which on a track is written that was not written before
        written = np.flatnonzero(is_written & ~is_named[which])
        np.minimum.at(first, which[written], written)
        is_early = (np.arange(count) <= first[which]) & ~is_named[which]
        is_judged = is_early | (tracks[HITS] <= self._settled_hits)
        rows = np.flatnonzero(((is_written & is_early) | is_observed) & is_judged & is_own[which])
        of = which[rows]
        new = taken(alive, of)._replace(last=steps[tick[rows]], hits=tracks[HITS, rows], state=taken(state, rows))
        known, before = joined([self._lost, alive]), len(self._lost.ids)
        is_over = known.over < _NEVER
        lost_at = np.flatnonzero(is_over)
        lost_at = lost_at[np.argsort(known.ids[lost_at])]  # links of equal odds are chosen by ids
        lost, names = taken(known, lost_at), known.names.copy()
        # a lost track was written before it was over; or else it has to continue another one
        was_written = np.append(np.ones(before, bool), first < count)[lost_at]
        is_first = rows == first[of]
        is_settled = new.hits >= self._settled_hits
        links = self._candidates(lost, new, is_first)
        since = np.full(len(alive.ids), count)  # those that continue another one are written whenever they are observed
        since[~is_own] = 0
        used = np.zeros(len(lost_at), bool)
        for at_once in np.split(np.arange(len(links.new)), np.flatnonzero(np.diff(tick[rows[links.new]])) + 1):
            may_be = ~used[links.lost[at_once]] & (since[of[links.new[at_once]]] == count)
            may_be &= was_written[links.lost[at_once]] | (names[lost_at[links.lost[at_once]]] >= 0)
            edges = taken(links, at_once[may_be])
            chosen = self._decide(edges, is_first[edges.new], is_settled[edges.new])
            ended, other = edges.lost[chosen], edges.new[chosen]
            own = names[lost_at[ended]]
            names[before + of[other]] = np.where(own >= 0, own, lost.ids[ended])
            used[ended], since[of[other]] = True, rows[other]
        is_new = np.append(np.zeros(before, bool), first < count) & (names < 0)
        names[is_new] = known.ids[is_new]
        known = known._replace(names=names)
        reached = lost.last >= steps[-1] - self._max_gap_steps
        self._lost = taken(known, lost_at[reached & ~used & (names[lost_at] >= 0)])
        self._alive = taken(known, ~is_over)
        shown = np.where(names < 0, known.ids, names)[before:]
        continues = np.arange(count) >= since[which]
        return np.where(continues, shown[which], tracks[IDS]), is_written | (is_observed & continues)

    def _candidates(self, lost: _Known, new: _Known, is_written: Bools) -> _Links:
        """The links with a chance from lost tracks (L,) to new ones (N,), ordered by these, at the steps ``new.last``.

        Those that are not ``is_written`` (N,) may continue only tracks that were confirmed.
        """
        parts = [_NO_LINKS]
        each = max(1, _BATCH // max(len(lost.ids), 1))
        for low in range(0, len(new.ids), each):
            part = slice(low, low + each)
            fits = (lost.over <= new.last[part, None]) & (new.last[part, None] - lost.last <= self._max_gap_steps)
            fits &= (lost.last < new.began[part, None]) & (is_written[part, None] | (lost.hits >= self._confirm_hits))
            row, candidate = np.nonzero(fits)
            row += low
            gap_s = np.asarray((new.began[row] - lost.last[candidate]) * self._step_s, np.float64)
            begun, now = taken(new.begun, row), taken(new.state, row)
            after = State(
                np.concatenate([begun.mean[:, :2], now.mean[:, 2:]], axis=1),
                np.stack([begun.cov[:, 0], 0 * begun.cov[:, 0], now.cov[:, 2]], axis=1),
            )
            gaps = linking.Gaps(taken(lost.state, candidate), after, gap_s)
            is_near = linking.are_in_reach(gaps)
            candidate, row, gaps = candidate[is_near], row[is_near], taken(gaps, is_near)
            before, after, gap_s = gaps
            # nothing is known of the velocity of what was observed once: it may be that of the lost one
            single = new.hits[row] == 1
            after.mean[single, 2:], after.cov[single, 2] = before.mean[single, 2:], before.cov[single, 2]
            log_odds = linking.log_odds(self._model, gaps)
            parts.append(taken(_Links(candidate, row, gap_s, log_odds), log_odds > linking.MIN_LOG_ODDS))
        return joined(parts)

    def _decide(self, links: _Links, is_first: Bools, is_settled: Bools) -> Bools:
        """Which of the links (E,) at one step are made, to tracks that are written in any case from now on or not.

        How likely links are right is learned from those that are made, and from those to tracks that have settled.
        """
        is_made = np.zeros(len(links.new), bool)
        if not len(is_made):
            return is_made
        ends, begins = (np.unique(side, return_inverse=True)[1] for side in (links.lost, links.new))
        best = linking.best_links(ends, begins, links.log_odds - linking.MIN_LOG_ODDS, len(is_made))
        shifted = links.log_odds[best] + self._shifts[linking.gap_classes(links.gap_s[best])]
        is_right = shifted > np.where(is_first[best], self._least, self._sure)
        counts = best[is_settled[best] | is_right]
        self._learn(links.log_odds[counts], links.gap_s[counts])
        is_made[best[is_right]] = True
        return is_made

    def _known(self, seen: Alive) -> tuple[_Known, Ints]:
        """All tracks as known at the last step or when they were over, (K,), and the one that each row (R,) is of."""
        before, count = self._alive, len(self._alive.ids)
        at, hits = seen.steps[seen.tick], seen.tracks[HITS]
        ids, first, which = np.unique(
            np.concatenate([before.ids, seen.tracks[IDS]]), return_index=True, return_inverse=True
        )
        observed = np.concatenate([np.arange(count), count + np.flatnonzero(seen.is_observed)])
        last = np.empty(len(ids), np.int64)
        last[which[observed]] = observed  # rising, so the last one stays
        ends = np.full(len(ids), -1)
        ends[which[count:]] = seen.tick
        known = _Known(
            ids,
            np.append(before.names, np.full(len(hits), -1))[first],
            np.concatenate([before.began, at])[first],
            np.concatenate([before.last, at])[last],
            np.append(seen.steps, _NEVER)[ends + 1],
            np.concatenate([before.hits, hits])[last],
            taken(joined([before.begun, seen.state]), first),
            taken(joined([before.state, seen.state]), last),
        )
        return known, which[count:]

    def _learn(self, log_odds: Floats, gap_s: Floats) -> None:
        """Learn from the best links so far how many are right after gaps of what length."""
        self._links.extend(zip(log_odds.tolist(), gap_s.tolist(), strict=True))
        self._link_count += len(log_odds)
        if self._link_count > self._estimated + min(_GROWS * self._estimated, _GROWS * _LINKS):
            self._estimated = self._link_count
            self._shifts = linking.prior_shifts(*np.array(self._links).T)


_NOTHING: Final = np.empty(0, np.intp), np.empty(0, np.intp)


# The evidence for pairs of tracks and observations is in squared standard deviations: twice a log likelihood ratio.
#
# Two tracks may be merged into one detection if the middle between them makes it likelier, by ``_MERGE_EVIDENCE``, than
# the position of the track that has it: otherwise a missed detection beside another person would be taken for a merged
# one. Tracks that are merged stay so without it, because the detection soon draws the track that has it to the middle.


#: The cost of leaving a pair unmatched, and the largest squared Mahalanobis distance of a pair.
_UNMATCHED, _GATE = 26.0, 40.0
#: What counts against an input id that was never seen before if the track missed nothing; and what is added to the
#: noise of positions, in metres.
_NEW_ID, _EXTRA_NOISE_M = 4.0, 0.1
_MERGE_EVIDENCE: Final = 4.0
#: The same input id counts a third where another observation is as near.
_CROWD_M: Final = 1.7


class Alive(NamedTuple):
    """The tracks alive at each of F steps, R in all, laid end to end.

    ``steps`` (F,) are the numbers of the steps, ``passed`` (F,) is by how many time advanced to each, and ``tick`` (R,)
    the index of the step of each track, rising. ``tracks`` (6, R) are their whole numbers (``IDS`` to ``MERGED``),
    ``state`` (R,) their states.
    """

    steps: Ints
    passed: Ints
    tick: Ints
    tracks: Ints
    state: State

    @property
    def is_observed(self) -> Bools:
        """Which tracks have an observation at that step, (R,)."""
        return np.asarray(self.tracks[MISSED] == 0)


@dataclass
class OnlineTracker:
    """The tracks that are alive. Ages are in steps.

    Tracks are tentative before ``confirm_hits`` observations; they terminate after ``max_age`` steps without one,
    tentative ones after ``max_age_tentative``. ``same_id`` counts for a pair if the observation has the input id that
    the track had last. Two tracks may be merged into one detection that lies within ``merge_distance_m`` of both, for
    at most ``merge_timeout_s``. ``noise_m`` is the noise of positions: that of the model, or as estimated so far.
    """

    model: MotionModel
    same_id: float
    merge_distance_m: float
    merge_timeout_s: float
    max_age: int
    confirm_hits: int
    max_age_tentative: int
    estimate_noise: bool = True
    tracks: Ints = field(default_factory=lambda: np.empty((6, 0), np.int64))
    state: StateRows = field(default_factory=lambda: StateRows(np.empty((4, 0)), np.empty((3, 0))))
    next_id: int = 1
    judged: int = 0
    known_sources: set[int] = field(default_factory=set)
    noise_m: float = field(init=False)

    def __post_init__(self) -> None:
        self.noise_m = self.model.noise_m

    def step(self, xy_m: Floats, source: Ints, sample: Ints, passed: int) -> tuple[Ints, Floats, Floats]:
        """Advance by ``passed`` steps and associate observations at (2, N) with the input ids ``source`` (N,).

        ``sample`` (N,) are the numbers of the observations in the log. Returns the tracks alive then: their whole
        numbers (6, K), means (4, K) and covariances (3, K), as in ``StateRows``.
        """
        self.tracks[MISSED] += passed
        is_over = np.where(self.tracks[HITS] >= self.confirm_hits, self.max_age, self.max_age_tentative)
        is_over = is_over < self.tracks[MISSED]
        if is_over.any():
            kept = (~is_over).nonzero()[0]
            self.tracks, self.state = self.tracks[:, kept], self.state.take(kept)
        if self.tracks.shape[1]:
            self.model.predict(self.state, passed * self.model.step_s, self.state)
        track, row = self._assigned(xy_m, source)
        if len(track):
            occluder = self._merge(track, xy_m[:, row], passed)
            self._update(track, xy_m[:, row], source[row], occluder)
            self.tracks[SAMPLE, track] = sample[row]
        if len(row) < len(source):
            is_free = np.ones(len(source), bool)
            is_free[row] = False
            free = is_free.nonzero()[0]
            self._start(xy_m[:, free], source[free], sample[free])
        self.known_sources.update(source.tolist())
        return self.tracks.copy(), self.state.mean.copy(), self.state.cov.copy()

    def _merge(self, track: Ints, observed: Floats, passed: int) -> Ints:
        """Update lost tracks that are merged into one detection with another track (occlusion).

        A lost track becomes occluded by another one if the observation of the latter lies between both, and the middle
        makes it likelier than its own track does. It says little about the position of each, and its input id nothing
        about either track once they separate. ``observed`` (2, P) are the observations of the tracks ``track`` (P,).
        Returns the indices into ``track`` of those that occlude others.
        """
        tracks, (p, _, _) = self.tracks, self.state.cov
        is_confirmed = tracks[HITS] >= self.confirm_hits
        is_lost = is_confirmed & (tracks[MERGED] * self.model.step_s < self.merge_timeout_s)
        is_lost[track] = False
        lost, confirmed = is_lost.nonzero()[0], is_confirmed[track].nonzero()[0]
        if not len(lost) or not len(confirmed):
            return np.empty(0, np.int64)
        seen, expected = observed[:, confirmed], self.state.mean[:2, lost]
        distance_m, nearest = _nearest(expected, seen)
        is_near = distance_m < self.merge_distance_m
        lost, expected, host = lost[is_near], expected[:, is_near], confirmed[nearest[is_near]]
        seen, owner = observed[:, host], track[host]
        own, noise = self.state.mean[:2, owner], self.noise_m**2
        to_own, to_middle = _squared(seen - own), _squared(seen - (own + expected) / 2)
        alone, together = p[owner] + noise, (p[owner] + p[lost]) / 4 + noise  # the middle of two: a quarter of both
        evidence = to_own / alone - to_middle / together + 2 * np.log(alone / together)
        was_merged = (tracks[MERGED, lost] > 0) | (tracks[SOURCE, lost] == -1)  # they may take turns at having it
        is_merged = (to_middle < to_own) & (was_merged | (evidence > _MERGE_EVIDENCE))
        lost, host = lost[is_merged], host[is_merged]
        state = self.state.take(lost)
        update(state, observed[:, host], self.merge_distance_m / 2)
        self.state.mean[:, lost], self.state.cov[:, lost] = state
        tracks[MISSED, lost] = np.maximum(tracks[MISSED, lost] - passed, 1)
        tracks[MERGED, lost] += passed
        return np.asarray(host)

    def _update(self, track: Ints, xy_m: Floats, source: Ints, occluder: Ints) -> None:
        """Update tracks (P,) with their observations (2, P); those of ``occluder`` are merged with others."""
        state, noise_m = self.state.take(track), np.full(len(track), self.noise_m)
        noise_m[occluder] = self.merge_distance_m / 2
        if self.estimate_noise:
            self._adapt_noise(state, xy_m, (self.tracks[HITS, track] >= self.confirm_hits) & (noise_m == self.noise_m))
        update(state, xy_m, noise_m)
        self.state.mean[:, track], self.state.cov[:, track] = state
        source[occluder] = -1
        self.tracks[SOURCE, track] = source
        self.tracks[HITS, track] += 1
        self.tracks[MISSED:, track] = 0

    def _adapt_noise(self, before: StateRows, xy_m: Floats, usable: Bools) -> None:
        """Estimate the noise of positions: a share ``_OUTSIDE`` of them lies outside a circle if it is right."""
        off = (xy_m - before.mean[:2])[:, usable]
        if not off.shape[1]:
            return
        outside = _squared(off) > _CIRCLE * (before.cov[0, usable] + self.noise_m**2)
        self.judged += len(outside)
        rate = max(_MIN_RATE, 5 / (self.judged + 50))  # fast at first
        log_noise = np.log(self.noise_m) + rate * float((outside - _OUTSIDE).sum())
        self.noise_m = min(max(float(np.exp(log_noise)), NOISE_M[0]), NOISE_M[1])

    def _assigned(self, xy_m: Floats, source: Ints) -> tuple[Ints, Ints]:
        """Tracks and observations that belong together, (P,) each."""
        tracks = self.tracks
        if tracks.shape[1] == 0 or len(source) == 0:
            return _NOTHING
        s = self.state.cov[0] + self.noise_m**2 + _EXTRA_NOISE_M**2
        pairs = Pairing(self.state.mean[:2], xy_m, np.sqrt(_GATE * s))
        squared = _squared(pairs.of_second(xy_m) - pairs.of_first(self.state.mean[:2]))
        squared /= pairs.of_first(s)
        gain = _UNMATCHED - squared
        gain -= pairs.of_first(2 * np.log(s))
        bonus = np.where(_is_crowded(xy_m), self.same_id / 3, self.same_id)
        gain += (pairs.of_first(tracks[SOURCE]) == pairs.of_second(source)) * pairs.of_second(bonus)
        names = source.tolist()
        if not self.known_sources.issuperset(names):
            is_new = np.array([name not in self.known_sources for name in names])
            gain -= _NEW_ID * (pairs.of_second(is_new) & pairs.of_first(tracks[MISSED] == 1))
        gain = np.where(squared <= _GATE, np.round(gain, 6), -1.0)
        if gain.ndim == 2:
            return assign_by_gain(gain)
        return assign_pairs_by_gain(pairs.chosen(gain > 0), gain[gain > 0], pairs.shape)[0]

    def _start(self, xy_m: Floats, source: Ints, sample: Ints) -> None:
        """Birth: start a track for each observation (2, N) that was not matched."""
        count = len(source)
        born = np.zeros((6, count), np.int64)
        born[IDS] = range(self.next_id, self.next_id + count)
        born[SOURCE], born[SAMPLE], born[HITS] = source, sample, 1
        self.next_id += count
        self.tracks = np.concatenate([self.tracks, born], axis=1)
        new = self.model.initial(xy_m, self.noise_m)
        self.state = StateRows(*(np.concatenate(both, axis=1) for both in zip(self.state, new, strict=True)))


def _is_crowded(xy_m: Floats) -> Bools:
    """Whether others are nearer than ``_CROWD_M`` to each position (2, N)."""
    count = xy_m.shape[1]
    if count * count > LARGE_TABLE:
        pairs = np.concatenate(near_pairs(np.zeros(count, np.int64), xy_m.T, _CROWD_M))
        return np.bincount(pairs, minlength=count) > 0
    near = _squared(xy_m[:, :, None] - xy_m[:, None]) < _CROWD_M**2
    return np.asarray(near.sum(axis=0) > 1)


def _nearest(points: Floats, others: Floats) -> tuple[Floats, Ints]:
    """The distance of each point (2, N) to the nearest one of others (2, M), and which it is, (N,)."""
    if points.shape[1] * others.shape[1] > LARGE_TABLE:
        from scipy.spatial import cKDTree

        distance, nearest = cKDTree(others.T).query(points.T)
        return distance, nearest
    squared = _squared(points[:, :, None] - others[:, None])
    return np.sqrt(squared.min(axis=1)), squared.argmin(axis=1)


def _squared(off: Floats) -> Floats:
    """The squared lengths of differences (2, ...)."""
    off *= off
    out: Floats = off[0] + off[1]
    return out


# Which online tracks are written, step by step, by what the log says so far of how long tracks last.
#
# A track is confirmed once it was observed for a while, because false detections flicker. But if all tracks of a
# tracker follow people, this delay hides people; and if many are false, even those that were confirmed are soon
# over. Both are seen in the log: for each number of observations, how many of the tracks so far were observed again
# (the estimator of E. L. Kaplan and P. Meier, 1958, which also counts tracks that are not over yet). A track that
# lasts with a probability of at least a half is written from its first observation.
#
# A track that is lost is written for a while, because most come back. Those that don't have left, or were false.
# Which is likelier is learned in the same way, for each number of steps without an observation, for tracks that
# have not lasted yet, and for those that would be outside of the area in which tracks were seen so far: most of
# these have left it. It also depends on where the track was lost (``PlacesOfLosses``).
#
# Letters: F steps, R tracks of all steps, end to end; H levels of observations, the last one of tracks that have
# lasted; A levels of steps without an observation.


#: A track has lasted once it was observed for so many times as long as its confirmation takes.
_LASTING: Final = 3


def _lasting(confirm_hits: int) -> int:
    """The number of observations after which tracks that so many confirm have lasted."""
    return _LASTING * (confirm_hits - 1) + 1


#: Before anything is known: the probability that a track lasts, and that a lost one comes back; and for how many tracks
#: this counts at each number of observations and steps.
_LASTS, _RETURNS, _WEIGHT = 0.6, 0.8, 2.0
#: Numbers of observations, and of steps without one, are counted in at most so many levels.
_LEVELS: Final = 200


# Where lost tracks come back and where they don't, as far as the log has shown.
#
# People go out at some places, and are missed for a moment at others. Whether a lost track comes back is told by
# what became of those that were lost nearby, compared with the whole log. (Where a track began tells less of
# whether it will last: people who are soon occluded look like false detections.)
#
# Letters: F steps; R tracks alive at these steps, end to end.


Place: TypeAlias = tuple[float, float]

#: Places are as near as this to be one.
_NEAR_M: Final = 2.0
#: Each place counts as if so many tracks like all others had been there before.
_USUAL: Final = 8.0
#: So many of the last tracks count.
_LAST: Final = 2000


class PlaceOdds:
    """The odds that something turns out well at places, compared with everywhere."""

    def __init__(self) -> None:
        self._xy_m = np.empty((2, _LAST))
        self._is_good = np.zeros(_LAST, bool)
        self._count = 0

    def add(self, place: Place, is_good: bool) -> None:
        """Count what became of something that was at a place."""
        at = self._count % _LAST
        self._xy_m[:, at], self._is_good[at] = place, is_good
        self._count += 1

    def ratio(self, place: Place) -> float:
        """The odds that something at a place turns out well, as a ratio to those everywhere."""
        count = min(self._count, _LAST)
        is_good = self._is_good[:count]
        share = (int(is_good.sum()) + 1) / (count + 2)
        (x, y), (x_m, y_m) = place, self._xy_m[:, :count]
        near = is_good[(x_m - x) ** 2 + (y_m - y) ** 2 <= _NEAR_M**2]
        good = int(near.sum())
        return (good / share + _USUAL) / ((len(near) - good) / (1 - share) + _USUAL)


class PlacesOfLosses:
    """Where tracks were lost, and what became of them: called with each step of a log."""

    def __init__(self) -> None:
        self._odds = PlaceOdds()
        self._lost: dict[int, tuple[Place, float]] = {}  # where each lost track was lost, and the ratio there

    def __call__(self, passed: int, ids: list[int], is_observed: Bools, xy_m: Floats) -> list[float]:
        """The odds that lost tracks (K,) come back, as ratios to those of the whole log; 1 for others.

        ``passed`` is by how many steps time advanced, and ``xy_m`` (2, K) where tracks are.
        """
        alive = dict(zip(ids, is_observed.tolist(), strict=True))
        for name in [name for name in self._lost if alive.get(name, True)]:
            place, _ = self._lost.pop(name)
            if name in alive or passed == 1:  # a gap of the log ends tracks without telling anything of them
                self._odds.add(place, name in alive)
        for k in np.flatnonzero(~is_observed).tolist():
            if ids[k] not in self._lost:
                place = float(xy_m[0, k]), float(xy_m[1, k])
                self._lost[ids[k]] = place, self._odds.ratio(place)
        return [self._lost[name][1] if name in self._lost else 1.0 for name in ids]


class ShownTracks:
    """Which tracks are written: called with the steps of a log, some at a time.

    Parameters
    ----------
    confirm_hits : int
        A track with so many observations is written in any case.
    coast : int
        A lost track is written for at most so many steps.
    max_age : int
        Tracks terminate after so many steps without an observation.
    adapts : bool
        Whether it follows the log. Otherwise tracks are written once they are confirmed, and if they are lost once they
        were observed half as often again.
    """

    def __init__(self, confirm_hits: int, coast: int, max_age: int, adapts: bool) -> None:
        self._adapts = adapts
        self._confirm_hits, self._coast, self._max_age = confirm_hits, coast, max_age
        self._lasting = _lasting(confirm_hits)
        self._levels, self._ages = min(self._lasting, _LEVELS), min(max_age, _LEVELS)
        self._seen = GrowingHull()
        self._places = PlacesOfLosses()
        # By level of observations: tracks that reached the next one or terminated, and those that terminated. By inside
        # and outside and level of steps without an observation: tracks that went on from there, and that came back.
        self._counts = np.zeros((2, self._levels + 1))
        self._returns = np.zeros((2, 2, self._ages + 1))
        self._prior = _WEIGHT * (1 - _LASTS ** (1 / max(self._levels - 1, 1)))
        self._prior_returns = _WEIGHT * (1 - (1 - _RETURNS) ** (1 / self._ages))
        #: Of the last step: id, levels of observations and of steps without one, and whether outside, (4, K).
        self._last: Ints = np.empty((4, 0), np.int64)

    def __call__(self, alive: Alive) -> Bools:
        """Which of the tracks alive at some steps are written, (R,). Nothing is known that was not known then."""
        (_, passed, tick, tracks, _), is_observed = alive, alive.is_observed
        is_confirmed, may_coast = tracks[HITS] >= self._confirm_hits, tracks[MISSED] <= self._coast
        if not self._adapts:
            is_old = tracks[HITS] * 2 >= self._confirm_hits * 3
            return np.asarray(np.where(is_observed, is_confirmed, may_coast & is_old))
        inside, ratio = self._where(alive, is_observed & is_confirmed)
        outside = ~inside
        level, next_level = (self._level(tracks[HITS] + more) for more in (0, 1))
        age = np.where(is_observed, 0, -(-np.minimum(tracks[MISSED], self._max_age) * self._ages // self._max_age))
        lasts, returns = self._learn(passed, tick, np.stack([tracks[IDS], level, age, outside]))
        lasting, where = level >= self._levels, outside.astype(np.intp)
        early = lasts[tick, level] >= 0.5
        comes_back = _at_odds(returns[tick, where, age], ratio) * lasts[tick, next_level] >= 0.5
        stays = may_coast & ((lasting & ~outside) | comes_back)
        return np.asarray(np.where(is_observed, early | is_confirmed, stays))

    def _level(self, hits: Ints) -> Ints:
        return -(-np.minimum(hits, self._lasting) * self._levels // self._lasting)

    def _where(self, alive: Alive, is_sure: Bools) -> tuple[Bools, Floats]:
        """Which tracks (R,) are in the area in which others, or they themselves, were seen before; and how much better
        or worse than everywhere the odds are that lost ones come back, where they were lost, (R,).
        """
        xy_m, ids = alive.state.mean[:, :2].T, alive.tracks[IDS].tolist()
        bounds, is_observed = np.searchsorted(alive.tick, np.arange(len(alive.steps) + 1)).tolist(), alive.is_observed
        inside, ratio = np.zeros(len(ids), bool), np.ones(len(ids))
        for passed, (low, high) in zip(alive.passed.tolist(), pairwise(bounds), strict=True):
            here = xy_m[:, low:high]
            inside[low:high] = self._seen.holds(here)
            if (is_sure[low:high] & ~inside[low:high]).any():
                self._seen.add(here[:, is_sure[low:high]])
            ratio[low:high] = self._places(passed, ids[low:high], is_observed[low:high], here)
        return inside, ratio

    def _learn(self, passed: Ints, tick: Ints, now: Ints) -> tuple[Floats, Floats]:
        """Learn from what became of tracks, of which ``now`` (4, R) is known at each step.

        Returns the probability that a track lasts at each step by its level of observations, (F, H + 1), and that a
        lost one comes back, by whether it is outside and the level of steps without an observation, (F, 2, A + 1).
        """
        count, levels = len(passed), self._levels + 1
        all_, at = np.concatenate([self._last, now], axis=1), np.append(np.full(self._last.shape[1], -1), tick)
        order = np.lexsort((at, all_[0]))
        (ids, level, age, outside), at = all_[:, order], at[order]
        goes_on = np.append(ids[1:] == ids[:-1], False)[: len(ids)]
        is_judged = goes_on | (at < count - 1)  # what became of those of the last step is not known yet
        then = np.minimum(at + 1, count - 1)
        is_judged &= passed[then] == 1  # a gap of the log ends tracks, and says nothing about them
        next_level, next_age = (np.append(values[1:], 0)[: len(ids)] for values in (level, age))
        lasting, back = level >= self._levels, goes_on & (next_age == 0)
        is_new = is_judged & ~lasting & (~goes_on | (next_level > level))
        is_lost = is_judged & (age > 0) & (~lasting | (outside > 0)) & (~goes_on | back | (next_age > age))
        place = then * levels + level
        counts = np.stack([_counted(place[which], count, (levels,)) for which in (is_new, is_new & ~goes_on)])
        shape = 2, self._ages + 1
        place = (then * 2 + outside) * shape[1] + age
        returns = np.stack([_counted(place[which], count, shape) for which in (is_lost, is_lost & back)])
        counts[:, 0] += self._counts
        returns[:, 0] += self._returns
        counts, returns = counts.cumsum(axis=1), returns.cumsum(axis=1)
        self._counts, self._returns, self._last = counts[:, -1], returns[:, -1], now[:, tick == count - 1]
        survives: Floats = 1 - (counts[1] + self._prior) / (counts[0] + _WEIGHT)
        survives[:, -1] = 1.0
        stays_lost: Floats = 1 - (returns[1] + self._prior_returns) / (returns[0] + _WEIGHT)
        return _from_here_on(survives), 1 - _from_here_on(stays_lost)


def _at_odds(probability: Floats, ratio: Floats) -> Floats:
    """Probabilities (R,) with odds multiplied by ``ratio`` (R,)."""
    return np.asarray(probability * ratio / (1 - probability + probability * ratio))


def _counted(place: Ints, count: int, shape: tuple[int, ...]) -> Floats:
    """Count each of the places of ``count`` tables, laid end to end."""
    size = count * int(np.prod(shape))
    return np.bincount(place, minlength=size).reshape(count, *shape).astype(np.float64)


def _from_here_on(survives: Floats) -> Floats:
    """The products of the last elements along the last axis, from each of them on."""
    return np.asarray(np.cumprod(survives[..., ::-1], axis=-1)[..., ::-1], np.float64)


#: Points so little outside are taken for inside, in units of length.
_SLACK: Final = 1e-6


@dataclass
class GrowingHull:
    """The convex hull of all points so far.

    Attributes
    ----------
    vertices : (V, 2) of float
        Its vertices, anticlockwise; fewer than three if no area was seen yet, which has no inside.

    Examples
    --------
    >>> hull = GrowingHull()
    >>> hull.add(np.array([[0.0, 4.0, 4.0, 0.0, 2.0], [0.0, 0.0, 4.0, 4.0, 2.0]]))
    >>> hull.vertices.tolist()
    [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]]
    >>> hull.holds(np.array([[1.0, 5.0], [1.0, 1.0]])).tolist()
    [True, False]
    """

    vertices: Floats = field(default_factory=lambda: np.empty((0, 2)))
    _normals: Floats = field(init=False, default_factory=lambda: np.empty((0, 2)))
    _limits: Floats = field(init=False, default_factory=lambda: np.empty((0, 1)))

    def holds(self, xy: Floats) -> Bools:
        """Which points (2, N) are inside, (N,); those that are NaN are not."""
        if not len(self._normals):
            return np.zeros(xy.shape[1], bool)
        return np.asarray((self._normals @ xy <= self._limits).all(axis=0))

    def add(self, xy: Floats) -> None:
        """Add points (2, N); those that are NaN are left out."""
        new = xy[:, np.isfinite(xy).all(axis=0) & ~self.holds(xy)]
        if not new.shape[1]:
            return
        points = sorted({(x, y) for x, y in [*self.vertices.tolist(), *new.T.tolist()]})
        ring = [*_chain(points), *_chain(points[::-1])]
        self.vertices = np.array(ring)
        if len(ring) > 2:
            edges = np.roll(self.vertices, -1, axis=0) - self.vertices
            outwards = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
            self._normals = outwards / np.hypot(*outwards.T)[:, None]
            self._limits = (self._normals * self.vertices).sum(axis=1)[:, None] + _SLACK


def _chain(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """One side of the hull of sorted points, without the last one (A. M. Andrew, 1979)."""
    out: list[tuple[float, float]] = []
    for x, y in points:
        while len(out) > 1:
            (ax, ay), (bx, by) = out[-2:]
            if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                break
            out.pop()
        out.append((x, y))
    return out[:-1] if len(out) > 1 else out
