"""Online tracking by likelihood: data association step by step, from the past alone.

Every track is a Kalman filter. An observation is assigned to the track that makes it likely, and the input's track ids
count as evidence: much where a person walks alone, little in a crowd, where trackers confuse people. A track without
an observation is coasting: its filter predicts on until the track terminates. Tracks that are occluded stay alive while
they are merged into one detection with another track.

The numbers of tracks are rows of arrays, with a column for each track. A step has few tracks, so what takes time is the
number of operations on arrays. Letters: K tracks, N observations of one step, P pairs of both, L lost tracks.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.assignment import LARGE_TABLE, assign_by_gain, assign_pairs_by_gain
from mcaptrack.geometry.neighbours import Pairing, near_pairs
from mcaptrack.transforms.retrack.motion_model import MotionModel, StateRows, update

#: Limits of the estimated noise of measured positions, in metres.
NOISE_M: Final = (0.03, 0.8)
#: The share of positions expected outside the circle by which the noise is judged, and the lowest rate of adaptation.
_OUTSIDE: Final = 0.1
_MIN_RATE: Final = 0.01
#: The squared radius of that circle, for a variance of 1.
_CIRCLE: Final = -2 * np.log(_OUTSIDE)
#: The rows of the whole numbers of tracks: id, input id of the last observation (-1: of a merged detection), number of
#: observations, steps since the last one, and steps for which the track is merged into the detection of another one.
IDS, SOURCE, HITS, MISSED, MERGED = range(5)
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

    ``tracks`` (5, K) are their whole numbers (``IDS`` to ``MERGED``), ``row`` (K,) is the observation that each has, or
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
    tracks: Ints = field(default_factory=lambda: np.empty((5, 0), np.int64))
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
        born = np.zeros((5, count), np.int64)
        born[IDS] = range(self.next_id, self.next_id + count)
        born[SOURCE], born[HITS] = source, 1
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
