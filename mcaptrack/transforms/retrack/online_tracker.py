"""Online tracking by likelihood: data association step by step, from the past alone.

Every track is a Kalman filter. An observation is assigned to the track that makes it likely, and the input's track ids
count as evidence: much where a person walks alone, little in a crowd, where trackers confuse people. A track without
an observation is coasting: its filter predicts on until the track terminates. Tracks that are occluded stay alive while
they are merged into one detection with another track.

Letters: K tracks, N observations of one step.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.assignment import assign_by_gain
from mcaptrack.transforms.retrack.motion_model import MotionModel, State

#: Limits of the estimated noise of measured positions, in metres.
NOISE_M: Final = (0.03, 0.8)
#: The share of positions expected outside the circle by which the noise is judged, and the lowest rate of adaptation.
_OUTSIDE: Final = 0.1
_MIN_RATE: Final = 0.01


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
    """The tracks alive after a step: ``row`` (K,) of the observation that each has, or -1; means, hits and misses."""

    ids: Ints
    row: Ints
    mean: Floats
    hits: Ints
    missed: Ints


@dataclass
class OnlineTracker:
    """The tracks that are alive. Ages are in steps.

    Tracks are tentative before ``confirm_hits`` observations; they terminate after ``max_age`` steps without one,
    tentative ones after ``max_age_tentative``.
    """

    model: MotionModel
    association: Association
    step_s: float
    max_age: int
    confirm_hits: int
    max_age_tentative: int
    ids: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    state: State = field(default_factory=lambda: State(np.empty((0, 4)), np.empty((0, 3))))
    source: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    hits: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    missed: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    merged: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    next_id: int = 1
    estimate_noise: bool = True
    judged: int = 0
    known_sources: set[int] = field(default_factory=set)

    def step(self, xy_m: Floats, source: Ints, passed: int) -> Step:
        """Advance by ``passed`` steps and associate observations at (N, 2) with the input ids ``source`` (N,)."""
        self.missed = self.missed + passed
        is_over = np.where(self.hits >= self.confirm_hits, self.max_age, self.max_age_tentative) < self.missed
        if is_over.any():
            self._keep(~is_over)
        if len(self.ids):
            self.state = self.model.predict(self.state, passed * self.step_s)
        track, row = assign_by_gain(self._gain(xy_m, source))
        occluded, occluder = self._merged_detections(track, row, xy_m)
        if len(occluded):
            self._update_occluded(occluded, xy_m[row[occluder]], passed)
        if len(track):
            before = self.state.take(track)
            noise_m = np.full(len(track), self.model.noise_m)
            noise_m[occluder] = self.association.merge_distance_m / 2
            self._adapt_noise(before, xy_m[row], track, noise_m == self.model.noise_m)
            new = self.model.update(before, xy_m[row], noise_m)
            self.state.mean[track], self.state.cov[track] = new
            self.missed[track] = 0
            self.hits[track] += 1
            self.merged[track] = 0
            self.source[track] = source[row]
            self.source[track[occluder]] = -1
        row_of = np.full(len(self.ids), -1)
        row_of[track] = row
        free = np.ones(len(xy_m), bool)
        free[row] = False
        if free.any():
            row_of = np.concatenate([row_of, np.flatnonzero(free)])
            self._start(xy_m[free], source[free])
        self.known_sources.update(source.tolist())
        return Step(self.ids, row_of, self.state.mean.copy(), self.hits.copy(), self.missed)

    def _merged_detections(self, track: Ints, row: Ints, xy_m: Floats) -> tuple[Ints, Ints]:
        """Find pairs of tracks merged into one detection (occlusion), and which track has that detection.

        A lost track becomes occluded by another one if the observation of the latter lies between both, and the middle
        makes it likelier than its own track does. Returns the occluded tracks, and for each the index into ``track`` of
        the one that occludes it.
        """
        nothing = np.empty(0, np.intp), np.empty(0, np.intp)
        is_lost = (self.hits >= self.confirm_hits) & (self.merged * self.step_s < self.association.merge_timeout_s)
        is_lost[track] = False
        confirmed = np.flatnonzero(self.hits[track] >= self.confirm_hits)
        lost = np.flatnonzero(is_lost)
        if len(lost) == 0 or len(confirmed) == 0:
            return nothing
        observed, expected = xy_m[row[confirmed]], self.state.mean[:, :2]
        off = expected[lost, None] - observed[None]
        squared = np.einsum("knd,knd->kn", off, off)
        nearest = squared.argmin(axis=1)
        is_merged = squared[np.arange(len(lost)), nearest] < self.association.merge_distance_m**2
        owner = track[confirmed[nearest]]
        to_own = ((observed[nearest] - expected[owner]) ** 2).sum(axis=1)
        to_middle = ((observed[nearest] - (expected[owner] + expected[lost]) / 2) ** 2).sum(axis=1)
        of_own, of_lost, noise = self.state.cov[owner, 0], self.state.cov[lost, 0], self.model.noise_m**2
        alone, together = of_own + noise, (of_own + of_lost) / 4 + noise  # the middle of two has a quarter of both
        evidence = to_own / alone - to_middle / together + 2 * np.log(alone / together)
        was_merged = (self.merged[lost] > 0) | (self.source[lost] == -1)  # they may take turns at having the detection
        is_merged &= (to_middle < to_own) & (was_merged | (evidence > self.association.merge_evidence))
        return lost[is_merged], confirmed[nearest[is_merged]]

    def _update_occluded(self, occluded: Ints, xy_m: Floats, passed: int) -> None:
        """Update occluded tracks with the merged detection, which says little about the position of each.

        Its input id says nothing about either track once they separate.
        """
        noise_m = np.full(len(occluded), self.association.merge_distance_m / 2)
        new = self.model.update(self.state.take(occluded), xy_m, noise_m)
        self.state.mean[occluded], self.state.cov[occluded] = new
        self.missed[occluded] = np.maximum(self.missed[occluded] - passed, 1)
        self.merged[occluded] += passed

    def _adapt_noise(self, before: State, xy_m: Floats, track: Ints, is_single: Bools) -> None:
        """Estimate the noise of positions: a share ``_OUTSIDE`` of them lies outside a circle if it is right."""
        usable = (self.hits[track] >= self.confirm_hits) & is_single
        if self.estimate_noise and usable.any():
            off = (xy_m - before.mean[:, :2])[usable]
            limit = -2 * np.log(_OUTSIDE) * (before.cov[usable, 0] + self.model.noise_m**2)
            outside = (off**2).sum(axis=1) > limit
            self.judged += len(outside)
            rate = max(_MIN_RATE, 5 / (self.judged + 50))  # fast at first
            log_noise = np.log(self.model.noise_m) + rate * float((outside - _OUTSIDE).sum())
            self.model = replace(self.model, noise_m=float(np.clip(np.exp(log_noise), *NOISE_M)))

    def _gain(self, xy_m: Floats, source: Ints) -> Floats:
        """The gain of matching each pair (K, N); negative beyond the gate."""
        association = self.association
        if len(self.ids) == 0 or len(xy_m) == 0:
            return np.empty((len(self.ids), len(xy_m)))
        s = self.state.cov[:, 0] + self.model.noise_m**2 + association.extra_noise_m**2
        off = xy_m[None] - self.state.mean[:, None, :2]
        squared = np.einsum("knd,knd->kn", off, off) / s[:, None]
        gain = association.unmatched - squared - 2 * np.log(s)[:, None]
        same = self.source[:, None] == source[None]
        if len(xy_m) > 1:
            apart = xy_m[:, None] - xy_m[None]
            near = np.einsum("mnd,mnd->mn", apart, apart) < association.crowd_m**2
            crowded = near.sum(axis=0) > 1
        else:
            crowded = np.zeros(1, bool)
        gain += same * np.where(crowded, association.same_id_crowded, association.same_id)
        is_new = np.array([one not in self.known_sources for one in source.tolist()])
        if is_new.any():
            gain -= association.new_id * (is_new[None] & (self.missed == 1)[:, None])
        return np.where(squared <= association.gate, np.round(gain, 6), -1.0)

    def _start(self, xy_m: Floats, source: Ints) -> None:
        """Birth: start a track for each observation that was not matched."""
        count = len(xy_m)
        self.ids = np.concatenate([self.ids, np.arange(self.next_id, self.next_id + count)])
        self.next_id += count
        started = self.model.initial(xy_m)
        self.state = State(*(np.concatenate(both) for both in zip(self.state, started, strict=True)))
        self.source = np.concatenate([self.source, source])
        self.hits = np.concatenate([self.hits, np.ones(count, np.int64)])
        self.missed = np.concatenate([self.missed, np.zeros(count, np.int64)])
        self.merged = np.concatenate([self.merged, np.zeros(count, np.int64)])

    def _keep(self, kept: Bools) -> None:
        self.ids, self.source = self.ids[kept], self.source[kept]
        self.hits, self.missed, self.merged = self.hits[kept], self.missed[kept], self.merged[kept]
        self.state = self.state.take(kept)
