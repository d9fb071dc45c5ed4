"""Online tracking by likelihood: data association step by step, from the past alone.

Every track is a Kalman filter. An observation is assigned to the track that makes it likely, and the input's track ids
count as evidence: much where a person walks alone, little in a crowd, where trackers confuse people. A track without
an observation is coasting: its filter predicts on until the track terminates. Tracks that are occluded stay alive while
they are merged into one detection with another track.

The numbers of tracks are rows of arrays, with a column for each track. A step has few tracks, so what takes time is the
number of operations on arrays. Letters: K tracks, N observations of one step, P pairs of both, L lost tracks.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints, joined, taken
from mcaptrack.geometry.assignment import LARGE_TABLE, assign_by_gain, assign_pairs_by_gain
from mcaptrack.geometry.neighbours import Pairing, near_pairs
from mcaptrack.geometry.ragged import run_starts
from mcaptrack.transforms.retrack import linking
from mcaptrack.transforms.retrack.motion_model import MotionModel, State, StateRows, update
from mcaptrack.transforms.retrack.weights import Logistic

#: Limits of the estimated noise of measured positions, in metres.
NOISE_M: Final = (0.03, 0.8)
#: The share of positions expected outside the circle by which the noise is judged, and the lowest rate of adaptation.
_OUTSIDE: Final = 0.1
_MIN_RATE: Final = 0.01
#: The squared radius of that circle, for a variance of 1.
_CIRCLE: Final = -2 * np.log(_OUTSIDE)
#: The rows of the whole numbers of tracks: id, input id of the last observation (-1: of a merged detection), number of
#: observations, steps since the last one, steps for which the track is merged into the detection of another one, all
#: of its steps, how many of its observations have another input id than the one before, and how many steps were missed
#: before the last one.
IDS, SOURCE, HITS, MISSED, MERGED, STEPS, CHANGES, GAP = range(8)


# Online links: which new track continues a lost one, decided when the new one is first written, or before.
#
# A track that is lost for longer than its filter can bridge terminates, and the same person comes back as a new
# track. Where that is likely, the new one is written under the id of the lost one, and if it is likelier than not,
# it is written at once: a person who was confirmed needs no more proof. Links are judged by motion as they are
# offline, but from the past alone: by the state of the lost track when it was last observed, that of the new one
# now, and by how many earlier links of this log seem right. Offline re-tracking doesn't depend on these links.
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
    """Tracks (K,): ids, the steps at which they began, were last observed and are over, the number of observations, and
    the state at the last one.
    """

    ids: Ints
    began: Ints
    last: Ints
    over: Ints
    hits: Ints
    state: State


_NONE: Final = np.empty(0, np.int64)
_NO_TRACKS: Final = _Known(_NONE, _NONE, _NONE, _NONE, _NONE, State(np.empty((0, 4)), np.empty((0, 3))))


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
        self._model, self._step_s, self._max_gap_s = model, model.step_s, max_gap_s
        self._confirm_hits = confirm_hits
        self._sure = float(np.log(min_confidence / (1 - min_confidence)))
        self._least = self._sure + float(np.log(linking.ENOUGH))
        self._names: dict[int, int] = {}  # the ids under which tracks are written, of those that were
        self._alive, self._lost = (
            _NO_TRACKS,
            _NO_TRACKS,
        )  # lost ones are over, were written, and are continued by no other
        self._links: deque[tuple[float, float]] = deque(maxlen=_LINKS)  # log odds and seconds
        self._link_count, self._estimated = 0, 0
        self._shifts = linking.prior_shifts(np.empty(0), np.empty(0))

    def __call__(
        self, steps: Ints, tick: Ints, tracks: Ints, state: State, is_observed: Bools, is_written: Bools
    ) -> tuple[Ints, Bools]:
        """The ids under which the tracks alive at each of F steps are written, (R,), and whether they are, (R,).

        ``steps`` (F,) are the numbers of the steps, ``tick`` (R,) the index of the step of each track, rising;
        ``tracks`` (8, R) and ``state`` (R,) are as in ``Step``. ``is_written`` (R,) says which are written in any case.
        Nothing is known at a step that was not known then.
        """
        if self._max_gap_s <= 0:
            return np.asarray(tracks[IDS]), is_written
        alive, which = self._known(steps, tick, tracks, state, is_observed)
        count = len(tick)
        first = np.full(len(alive.ids), count)  # the row from which on a track is written in any case
        written = np.flatnonzero(is_written)
        np.minimum.at(first, which[written], written)
        rows = np.flatnonzero(
            (is_written | is_observed) & (np.arange(count) <= first[which]) & ~self._are_named(alive.ids)[which]
        )
        of = which[rows]
        new = taken(alive, of)._replace(last=steps[tick[rows]], hits=tracks[HITS, rows], state=taken(state, rows))
        over = np.flatnonzero(alive.over < _NEVER)
        lost = joined([self._lost, taken(alive, over)])
        # a lost track was written before it was over; or else it has to continue another one
        was_written = np.append(np.ones(len(self._lost.ids), bool), first[over] < count)
        order = np.argsort(lost.ids)  # however many steps are read at once, links of equal odds are chosen by ids
        lost, was_written = taken(lost, order), was_written[order]
        is_first = rows == first[of]
        links = self._candidates(lost, new, is_first)
        since = np.full(len(alive.ids), count)  # those that continue another one are written whenever they are observed
        since[[self._names.get(track, track) != track for track in alive.ids.tolist()]] = 0
        used = np.zeros(len(lost.ids), bool)
        for at_once in np.split(np.arange(len(links.new)), np.flatnonzero(np.diff(tick[rows[links.new]])) + 1):
            may_be = ~used[links.lost[at_once]] & (since[of[links.new[at_once]]] == count)
            may_be &= was_written[links.lost[at_once]] | self._are_named(lost.ids[links.lost[at_once]])
            edges = taken(links, at_once[may_be])
            chosen = self._decide(edges, is_first[edges.new])
            for ended, other in zip(edges.lost[chosen].tolist(), edges.new[chosen].tolist(), strict=True):
                self._names[int(new.ids[other])] = self._names.get(int(lost.ids[ended]), int(lost.ids[ended]))
                used[ended], since[of[other]] = True, rows[other]
        for track in alive.ids[first < count].tolist():
            self._names.setdefault(track, track)
        reached = lost.last >= steps[-1] - self._max_gap_s / self._step_s
        self._lost = taken(lost, reached & ~used & self._are_named(lost.ids))
        self._alive = taken(alive, alive.over == _NEVER)
        names = np.array([self._names.get(track, track) for track in alive.ids.tolist()], np.int64)
        kept = {*self._alive.ids.tolist(), *self._lost.ids.tolist()}
        self._names = {track: name for track, name in self._names.items() if track in kept}
        return np.asarray(names[which]), is_written | (is_observed & (np.arange(count) >= since[which]))

    def _are_named(self, ids: Ints) -> Bools:
        return np.array([track in self._names for track in ids.tolist()], bool)

    def _candidates(self, lost: _Known, new: _Known, is_written: Bools) -> _Links:
        """The links with a chance from lost tracks (L,) to new ones (N,), ordered by these, at the steps ``new.last``.

        Those that are not ``is_written`` (N,) may continue only tracks that were confirmed.
        """
        parts = [_NO_LINKS]
        each = max(1, _BATCH // max(len(lost.ids), 1))
        for low in range(0, len(new.ids), each):
            part = slice(low, low + each)
            gaps_s = (new.last[part, None] - lost.last) * self._step_s
            fits = (lost.over <= new.last[part, None]) & (gaps_s <= self._max_gap_s)
            fits &= (lost.last < new.began[part, None]) & (is_written[part, None] | (lost.hits >= self._confirm_hits))
            row, candidate = np.nonzero(fits)
            row, gap_s = row + low, np.asarray(gaps_s[row, candidate], np.float64)
            gaps = linking.Gaps(taken(lost.state, candidate), taken(new.state, row), gap_s)
            is_near = linking.are_in_reach(gaps)
            candidate, row, gaps = candidate[is_near], row[is_near], taken(gaps, is_near)
            before, after, gap_s = gaps
            # nothing is known of the velocity of what was observed once: it may be that of the lost one
            single = new.hits[row] == 1
            after.mean[single, 2:], after.cov[single, 2] = before.mean[single, 2:], before.cov[single, 2]
            log_odds = linking.log_odds(linking.features(self._model, gaps))
            parts.append(taken(_Links(candidate, row, gap_s, log_odds), linking.has_chance(log_odds)))
        return joined(parts)

    def _decide(self, links: _Links, is_written: Bools) -> Bools:
        """Which of the links (E,) at one step are made, to tracks that are written in any case or not."""
        is_made = np.zeros(len(links.new), bool)
        if not len(is_made):
            return is_made
        ends, begins = (np.unique(side, return_inverse=True)[1] for side in (links.lost, links.new))
        best = linking.best_links(ends, begins, links.log_odds, len(is_made))
        shifted = links.log_odds[best] + self._shifts[linking.gap_classes(links.gap_s[best])]
        is_right = shifted > np.where(is_written[best], self._least, self._sure)
        # one that is not written yet is judged again at the next step: it counts once it is
        counts = best[is_written[best] | is_right]
        self._learn(links.log_odds[counts], links.gap_s[counts])
        is_made[best[is_right]] = True
        return is_made

    def _known(self, steps: Ints, tick: Ints, tracks: Ints, state: State, is_observed: Bools) -> tuple[_Known, Ints]:
        """All tracks as known at the last step or when they were over, (K,), and the one that each row (R,) is of."""
        before = self._alive
        names, which = np.unique(np.concatenate([before.ids, tracks[IDS]]), return_inverse=True)
        had, which = which[: len(before.ids)], which[len(before.ids) :]
        ends = np.full(len(names), -1)
        ends[which] = tick  # rising, so the last one stays
        last_row = np.full(len(names), -1)
        seen = np.flatnonzero(is_observed)
        last_row[which[seen]] = seen
        began = np.full(len(names), _NEVER)
        np.minimum.at(began, which, steps[tick])
        began[had] = before.began
        (last, hits), mean, cov = (
            np.zeros((2, len(names)), np.int64),
            np.zeros((len(names), 4)),
            np.zeros((len(names), 3)),
        )
        earlier, now = (before.last, before.hits, *before.state), (steps[tick], tracks[HITS], *state)
        is_seen = last_row >= 0
        for values, was, is_now in zip((last, hits, mean, cov), earlier, now, strict=True):
            values[had] = was
            values[is_seen] = is_now[last_row[is_seen]]
        return _Known(names, began, last, np.append(steps, _NEVER)[ends + 1], hits, State(mean, cov)), which

    def _learn(self, log_odds: Floats, gap_s: Floats) -> None:
        """Learn from the best links so far how many are right after gaps of what length."""
        self._links.extend(zip(log_odds.tolist(), gap_s.tolist(), strict=True))
        self._link_count += len(log_odds)
        if self._link_count > self._estimated + min(_GROWS * self._estimated, _GROWS * _LINKS):
            self._estimated = self._link_count
            self._shifts = linking.prior_shifts(*np.array(self._links).T)


_NOTHING: Final = np.empty(0, np.intp), np.empty(0, np.intp)


@dataclass(frozen=True, kw_only=True)
class Association:
    """The evidence for and against pairs of tracks and observations, in squared standard deviations.

    That is twice a log likelihood ratio. ``same_id`` and ``same_id_crowded`` count for a pair if the observation has
    the input id that the track had last: alone, and with another observation within ``crowd_m``. ``new_id`` counts
    against an input id that was never seen before if the track missed nothing. ``unmatched`` is the cost of leaving a
    pair unmatched, and ``gate`` the largest squared Mahalanobis distance of a pair. ``extra_noise_m`` is added to the
    noise of positions. Two tracks may be merged into one detection that lies within ``merge_distance_m`` of both, for
    at most ``merge_timeout_s``, if the middle between them makes it likelier by ``merge_evidence`` than the position of
    the track that has it: otherwise a missed detection beside another person would be taken for a merged one. Tracks
    that are merged stay so without it, because the detection soon draws the track that has it to the middle.
    """

    same_id: float
    same_id_crowded: float
    merge_distance_m: float
    merge_timeout_s: float
    merge_evidence: float = 4.0
    unmatched: float = 26.0
    gate: float = 40.0
    crowd_m: float = 1.7
    new_id: float = 4.0
    extra_noise_m: float = 0.1


class Step(NamedTuple):
    """The tracks alive after a step.

    ``tracks`` (8, K) are their whole numbers (``IDS`` to ``GAP``), ``row`` (K,) is the observation that each has, or
    -1, and ``mean`` (4, K) and ``cov`` (3, K) are their states, as in ``StateRows``.
    """

    tracks: Ints
    row: Ints
    mean: Floats
    cov: Floats


@dataclass
class OnlineTracker:
    """The tracks that are alive. Ages are in steps.

    Tracks are tentative before ``confirm_hits`` observations; they terminate after ``max_age`` steps without one,
    tentative ones after ``max_age_tentative``. ``noise_m`` is the noise of positions: that of the model, or as it was
    estimated so far.
    """

    model: MotionModel
    association: Association
    max_age: int
    confirm_hits: int
    max_age_tentative: int
    estimate_noise: bool = True
    tracks: Ints = field(default_factory=lambda: np.empty((8, 0), np.int64))
    state: StateRows = field(default_factory=lambda: StateRows(np.empty((4, 0)), np.empty((3, 0))))
    next_id: int = 1
    judged: int = 0
    known_sources: set[int] = field(default_factory=set)
    noise_m: float = field(init=False)

    def __post_init__(self) -> None:
        self.noise_m = self.model.noise_m

    def step(self, xy_m: Floats, source: Ints, passed: int, most_noise_m: float = np.inf) -> Step:
        """Advance by ``passed`` steps and associate observations at (2, N) with the input ids ``source`` (N,).

        The noise of positions is estimated as no larger than ``most_noise_m``.
        """
        self._limit_noise(most_noise_m)
        self.tracks[MISSED] += passed
        self.tracks[STEPS] += passed
        is_over = np.where(self.tracks[HITS] >= self.confirm_hits, self.max_age, self.max_age_tentative)
        is_over = is_over < self.tracks[MISSED]
        if is_over.any():
            kept = (~is_over).nonzero()[0]
            self.tracks, self.state = self.tracks[:, kept], self.state.take(kept)
        if self.tracks.shape[1]:
            self.model.predict(self.state, passed * self.model.step_s, self.state)
        track, row = self._assigned(xy_m, source)
        observed = xy_m[:, row]
        occluded, occluder = self._merged_detections(track, observed)
        if len(occluded):
            self._update_occluded(occluded, observed[:, occluder], passed)
        if len(track):
            self._update(track, observed, source[row], occluder)
            self._limit_noise(most_noise_m)
        row_of = np.full(self.tracks.shape[1], -1)
        row_of[track] = row
        if len(row) < len(source):
            is_free = np.ones(len(source), bool)
            is_free[row] = False
            free = is_free.nonzero()[0]
            row_of = np.concatenate([row_of, free])
            self._start(xy_m[:, free], source[free])
        self.known_sources.update(source.tolist())
        return Step(self.tracks.copy(), row_of, self.state.mean.copy(), self.state.cov.copy())

    def _merged_detections(self, track: Ints, observed: Floats) -> tuple[Ints, Ints]:
        """Find pairs of tracks merged into one detection (occlusion), and which track has that detection.

        A lost track becomes occluded by another one if the observation of the latter lies between both, and the middle
        makes it likelier than its own track does. ``observed`` (2, P) are the observations of the tracks ``track``
        (P,). Returns the occluded tracks, and for each the index into ``track`` of the one that occludes it.
        """
        tracks, (p, _, _) = self.tracks, self.state.cov
        is_confirmed = tracks[HITS] >= self.confirm_hits
        is_lost = is_confirmed & (tracks[MERGED] * self.model.step_s < self.association.merge_timeout_s)
        is_lost[track] = False
        lost = is_lost.nonzero()[0]
        if len(lost) == 0:
            return _NOTHING
        confirmed = is_confirmed[track].nonzero()[0]
        if len(confirmed) == 0:
            return _NOTHING
        seen, expected = observed[:, confirmed], self.state.mean[:2, lost]
        if len(lost) * len(confirmed) > LARGE_TABLE:
            from scipy.spatial import cKDTree

            distance, nearest = cKDTree(seen.T).query(expected.T)
            is_merged = distance < self.association.merge_distance_m
        else:
            squared = _squared(expected[:, :, None] - seen[:, None])
            nearest = squared.argmin(axis=1)
            is_merged = squared.min(axis=1) < self.association.merge_distance_m**2
        if not is_merged.any():
            return _NOTHING
        lost, expected, nearest = lost[is_merged], expected[:, is_merged], nearest[is_merged]
        seen, owner = seen[:, nearest], track[confirmed[nearest]]
        own = self.state.mean[:2, owner]
        to_own, to_middle = _squared(seen - own), _squared(seen - (own + expected) / 2)
        noise = self.noise_m**2
        alone, together = p[owner] + noise, (p[owner] + p[lost]) / 4 + noise  # the middle of two: a quarter of both
        evidence = to_own / alone - to_middle / together + 2 * np.log(alone / together)
        was_merged = (tracks[MERGED, lost] > 0) | (tracks[SOURCE, lost] == -1)  # they may take turns at having it
        is_merged = (to_middle < to_own) & (was_merged | (evidence > self.association.merge_evidence))
        return lost[is_merged], confirmed[nearest[is_merged]]

    def _update_occluded(self, occluded: Ints, xy_m: Floats, passed: int) -> None:
        """Update occluded tracks with the merged detection, which says little about the position of each.

        Its input id says nothing about either track once they separate.
        """
        state = self.state.take(occluded)
        update(state, xy_m, np.full(len(occluded), self.association.merge_distance_m / 2))
        self.state.mean[:, occluded], self.state.cov[:, occluded] = state
        self.tracks[MISSED, occluded] = np.maximum(self.tracks[MISSED, occluded] - passed, 1)
        self.tracks[MERGED, occluded] += passed

    def _update(self, track: Ints, xy_m: Floats, source: Ints, occluder: Ints) -> None:
        """Update tracks (P,) with their observations (2, P); those of ``occluder`` are merged with others."""
        state = self.state.take(track)
        noise_m = np.full(len(track), self.noise_m)
        noise_m[occluder] = self.association.merge_distance_m / 2
        if self.estimate_noise:
            self._adapt_noise(state, xy_m, (self.tracks[HITS, track] >= self.confirm_hits) & (noise_m == self.noise_m))
        update(state, xy_m, noise_m)
        self.state.mean[:, track], self.state.cov[:, track] = state
        source[occluder] = -1
        self.tracks[CHANGES, track] += self.tracks[SOURCE, track] != source
        self.tracks[SOURCE, track] = source
        self.tracks[HITS, track] += 1
        self.tracks[GAP, track] = self.tracks[MISSED, track] - 1
        self.tracks[MISSED : MERGED + 1, track] = 0

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

    def _limit_noise(self, most_noise_m: float) -> None:
        if self.estimate_noise:
            self.noise_m = min(self.noise_m, most_noise_m)

    def _assigned(self, xy_m: Floats, source: Ints) -> tuple[Ints, Ints]:
        """Tracks and observations that belong together, (P,) each."""
        association, tracks = self.association, self.tracks
        if tracks.shape[1] == 0 or len(source) == 0:
            return _NOTHING
        s = self.state.cov[0] + self.noise_m**2 + association.extra_noise_m**2
        pairs = Pairing(self.state.mean[:2], xy_m, np.sqrt(association.gate * s))
        squared = _squared(pairs.of_second(xy_m) - pairs.of_first(self.state.mean[:2]))
        squared /= pairs.of_first(s)
        gain = association.unmatched - squared
        gain -= pairs.of_first(2 * np.log(s))
        bonus = np.where(_is_crowded(xy_m, association.crowd_m), association.same_id_crowded, association.same_id)
        gain += (pairs.of_first(tracks[SOURCE]) == pairs.of_second(source)) * pairs.of_second(bonus)
        names = source.tolist()
        if not self.known_sources.issuperset(names):
            is_new = np.array([name not in self.known_sources for name in names])
            gain -= association.new_id * (pairs.of_second(is_new) & pairs.of_first(tracks[MISSED] == 1))
        gain = np.where(squared <= association.gate, np.round(gain, 6), -1.0)
        if gain.ndim == 2:
            return assign_by_gain(gain)
        return assign_pairs_by_gain(pairs.chosen(gain > 0), gain[gain > 0], pairs.shape)[0]

    def _start(self, xy_m: Floats, source: Ints) -> None:
        """Birth: start a track for each observation (2, N) that was not matched."""
        count = len(source)
        born = np.zeros((8, count), np.int64)
        born[IDS] = range(self.next_id, self.next_id + count)
        born[SOURCE], born[HITS], born[STEPS] = source, 1, 1
        self.next_id += count
        self.tracks = np.concatenate([self.tracks, born], axis=1)
        new = self.model.initial(xy_m, self.noise_m)
        self.state = StateRows(*(np.concatenate(both, axis=1) for both in zip(self.state, new, strict=True)))


def _is_crowded(xy_m: Floats, crowd_m: float) -> Bools:
    """Whether others are nearer than ``crowd_m`` to each position (2, N)."""
    count = xy_m.shape[1]
    if count * count > LARGE_TABLE:
        pairs = np.concatenate(near_pairs(np.zeros(count, np.int64), xy_m.T, crowd_m))
        return np.bincount(pairs, minlength=count) > 0
    near = _squared(xy_m[:, :, None] - xy_m[:, None]) < crowd_m**2
    return np.asarray(near.sum(axis=0) > 1)


def _squared(off: Floats) -> Floats:
    """The squared lengths of differences (2, ...)."""
    off *= off
    out: Floats = off[0] + off[1]
    return out


# Which online tracks are written, step by step: those that are likelier than not a person who is here now.
#
# The probability is a logistic regression over what is known of a track so far, fitted on synthetic scenes (see
# ``weights``). What tells a person from a false detection is another matter for a track that has just begun than for
# one that has lasted or is lost, so each of these has weights of its own.
#
# Letters: F steps, R tracks alive at these steps, end to end; V values, E features, D directions.


#: The features of a track at a step. Of itself: logarithms of the number of its observations, of the seconds since the
#: last one, of how far it is from where it began, and of how far its observations are from its filter, as a ratio to
#: the noise; and the share of them that have another input id than the one before. Among others: how near the nearest
#: older track is that was observed; whether it is outside of the area in which confirmed tracks were seen, and how far.
#: Of this log so far, as logarithms: the share of steps at which lasting tracks were missed; the share of other ones,
#: here called new, that came back when they were lost; how many new ones were over inside of the area, and how many
#: steps they had, as ratios to lasting ones; the odds that what begins is false; and how rare gaps are that are as long
#: as this one.
PRESENT_FEATURES: Final = (
    "log hits",
    "log missed",
    "log distance",
    "log roughness",
    "changes",
    "beside",
    "outside",
    "outside by",
    "lasting missed",
    "new came back",
    "new over",
    "new steps",
    "log odds of false births",
    "rare gap",
)
#: The kinds of tracks that have weights of their own: observed before and after confirmation, and lost, before and
#: after they lasted.
PRESENT_KINDS: Final = ("new", "confirmed", "lost", "lasting lost")
#: The log odds from which each kind is written. A new track has to be surer, because it may be written under an id that
#: it turns out not to have. (Chosen on synthetic crowds.)
_LEAST_LOG_ODDS: Final = np.array([1.0, 0.0, 0.0, 0.0])
#: A track has lasted once it was observed for so many times as long as its confirmation takes.
_LASTING: Final = 3
#: An older track is beside another one up to this distance; the border counts up to the other one.
_BESIDE_M, _BORDER_M = 1.5, 3.0
#: Gaps are counted by so many lengths.
_GAP_LEVELS: Final = 10
#: The area in which tracks were seen is bounded in so many directions.
_ANGLES: Final = 2 * np.pi * np.arange(16) / 16
_DIRECTIONS: Final = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])


class PresentTracks:
    """Tells which tracks are likely a person who is here now: called with the steps of a log, some at a time.

    Parameters
    ----------
    confirm_hits : int
        Tracks are confirmed by so many observations.
    max_age : int
        Tracks terminate after so many steps without an observation.
    step_s : float
        The seconds of a step.
    """

    def __init__(self, confirm_hits: int, max_age: int, step_s: float) -> None:
        self._confirm_hits, self._max_age, self._step_s = confirm_hits, max_age, step_s
        self._lasting = _LASTING * (confirm_hits - 1) + 1
        self._models = [Logistic.of(f"online {kind}", PRESENT_FEATURES) for kind in PRESENT_KINDS]
        # of the tracks alive at the last step: ids, rising, and totals of what is added up over their steps
        self._ids, self._totals = np.empty(0, np.int64), np.empty((0, 3))
        self._border = np.full(len(_DIRECTIONS.T), -np.inf)
        self._levels = min(max_age, _GAP_LEVELS)
        self._counts = np.zeros(8 + self._levels)

    def __call__(self, tick: Ints, tracks: Ints, state: StateRows, xy_m: Floats, noise_m: Floats) -> Bools:
        """Mask the tracks (R,) alive at F steps that are written, because each is likely a person who is here now.

        ``noise_m`` (F,) is the noise of positions at each step, ``tick`` (R,) the index of the step of each track,
        rising; ``tracks`` (8, R) and ``state`` (R,) are as in ``Step``, and ``xy_m`` (2, R) the observations, or where
        the others are expected. Nothing is known at a step that was not known then.
        """
        values, kind = self.features(tick, tracks, state, xy_m, noise_m), self.kinds(tracks)
        log_odds = np.empty(len(tick))
        for number, model in enumerate(self._models):
            here = kind == number
            log_odds[here] = model.log_odds(values[here])
        return np.asarray(log_odds >= _LEAST_LOG_ODDS[kind])

    def kinds(self, tracks: Ints) -> Ints:
        """The kind of each track (R,), an index into ``PRESENT_KINDS``."""
        hits, is_lost = tracks[HITS], tracks[MISSED] > 0
        kinds: Ints = np.where(is_lost, 2 + (hits >= self._lasting), hits >= self._confirm_hits)
        return kinds

    def features(self, tick: Ints, tracks: Ints, state: StateRows, xy_m: Floats, noise_m: Floats) -> Floats:
        """The features of each track at each step, (R, E): see ``PRESENT_FEATURES``. The arguments are those above."""
        hits, missed = tracks[HITS], tracks[MISSED]
        off = _squared(xy_m - state.mean[:2]) / noise_m[tick] ** 2
        begins = np.where(tracks[STEPS] == 1, xy_m, 0.0)
        rough, *begin_m = self._added_up(tick, tracks[IDS], np.stack([off, *begins]))
        outside_m = self._outside(tick, hits >= self._confirm_hits, missed == 0, xy_m, len(noise_m))
        return np.stack(
            [
                np.log(hits),
                np.log(missed * self._step_s + 0.1),
                np.log(np.hypot(*(xy_m - begin_m)) + 0.3),
                np.log(rough / np.maximum(hits - 1, 1) + 0.05),
                tracks[CHANGES] / hits,
                self._beside(tick, tracks, xy_m),
                outside_m > 0,
                outside_m,
                *self._of_log(tick, tracks, outside_m > 0, len(noise_m)),
            ],
            axis=-1,
        )

    def _added_up(self, tick: Ints, ids: Ints, values: Floats) -> Floats:
        """The sums (V, R) of values (V, R) of each track over its steps so far."""
        order = np.lexsort((tick, ids))
        first = np.flatnonzero(run_starts(ids[order]))
        each = values.T[order]
        at = np.minimum(np.searchsorted(self._ids, ids[order][first]), max(len(self._ids) - 1, 0))
        had = np.zeros((len(first), len(values)))
        if len(self._ids):
            had = np.where((self._ids[at] == ids[order][first])[:, None], self._totals[at], had)
        total = each.cumsum(axis=0)
        before = had - total[first] + each[first]
        total += np.repeat(before, np.diff(np.append(first, len(order))), axis=0)
        out = np.empty_like(total)
        out[order] = total
        last = np.flatnonzero(tick == tick.max(initial=0))
        last = last[np.argsort(ids[last])]
        self._ids, self._totals = ids[last], out[last]
        return out.T

    def _beside(self, tick: Ints, tracks: Ints, xy_m: Floats) -> Floats:
        """The nearness of the nearest older track that was observed, (R,): from 0 at ``_BESIDE_M`` on to 1."""
        ids, is_seen = tracks[IDS], tracks[MISSED] == 0
        place = np.where(np.isfinite(xy_m), xy_m, np.inf).T
        pair = np.stack(near_pairs(tick, place, _BESIDE_M))
        older, younger = np.where(ids[pair[0]] < ids[pair[1]], pair, pair[::-1])
        older, younger = older[is_seen[older]], younger[is_seen[older]]
        out = np.zeros(len(ids))
        np.maximum.at(out, younger, 1 - _squared(xy_m[:, older] - xy_m[:, younger]) / _BESIDE_M**2)
        return out

    def _outside(self, tick: Ints, confirmed: Bools, is_seen: Bools, xy_m: Floats, count: int) -> Floats:
        """The metres by which tracks (R,) are outside of the area in which confirmed ones were seen before."""
        along = _DIRECTIONS.T @ xy_m
        counts = np.flatnonzero(confirmed & is_seen & np.isfinite(xy_m[0]))
        reached = np.full((len(self._border), count + 1), -np.inf)
        reached[:, 0] = self._border
        np.maximum.at(reached.T, tick[counts] + 1, along.T[counts])
        reached = np.maximum.accumulate(reached, axis=1)
        self._border = reached[:, -1]
        outside_m: Floats = np.nan_to_num((along - reached[:, tick]).max(axis=0), nan=np.inf)
        return outside_m.clip(-_BORDER_M, _BORDER_M)

    def _of_log(self, tick: Ints, tracks: Ints, is_outside: Bools, count: int) -> Floats:
        """The features that say how tracks (R,) fared so far in this log, (6, R)."""
        hits, missed = tracks[HITS], tracks[MISSED]
        lasts, is_lost = hits >= self._lasting, missed > 0
        # the same as in ``OnlineTracker``: those that are not observed at the next step are over
        longest = np.where(hits >= self._confirm_hits, self._max_age, min(self._confirm_hits, self._max_age))
        is_over = (missed == longest) & ~is_outside
        returned = np.where(is_lost, 0, self._level(tracks[GAP]))
        happened = [
            lasts,
            lasts & is_lost,
            ~lasts & (missed == 1),
            ~lasts & (returned > 0),
            lasts & is_over,
            ~lasts & is_over,
            ~lasts,
            tracks[STEPS] == 1,
            *(returned >= np.arange(1, self._levels + 1)[:, None]),
        ]
        counts = np.stack([np.bincount(tick[rows], minlength=count) for rows in happened])
        counts = self._counts[:, None] + counts.cumsum(axis=1)
        self._counts = counts[:, -1]
        lasting, lasting_missed, lost, back, over, new_over, new, born, gaps, *_ = counts[:, tick]
        # people are lost at any time: new tracks that are over more often than lasting ones were false
        false = new_over - (over + 1) / (lasting + 50) * new
        false_share = np.clip(np.maximum(false, 0.3) / (born + 1), 0.01, 0.97)
        as_long = counts[7 + np.maximum(self._level(missed), 1), tick]
        return np.stack(
            [
                np.log((lasting_missed + 1) / (lasting + 10)),
                np.log((back + 1) / (lost + 1)),
                np.log((new_over + 0.5) / (over + 0.5)),
                np.log((new + 1) / (lasting + 10)),
                np.log(false_share / (1 - false_share)),
                np.where(is_lost, -np.log((as_long + 0.5) / (gaps + 3)), 0.0),
            ]
        )

    def _level(self, steps: Ints) -> Ints:
        """The level (R,) of gaps of so many steps (R,), from 1 on; 0 for none."""
        return -(-np.minimum(steps, self._max_age) * self._levels // self._max_age)
