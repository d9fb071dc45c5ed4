"""Following people through a log by likelihood: who goes with whom, step by step, from the past alone.

Every track is a Kalman filter. A row goes to the track that makes it likely, and what the input says of identity
counts as evidence: much where somebody walks alone, little in a crowd, where trackers confuse people.

Letters: K tracks, N rows of one step.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.assignment import solve
from mcaptrack.transforms.retrack.motion import State, Walker

#: No noise of seen positions is smaller or larger than this.
NOISE_M = (0.03, 0.8)
#: The share of positions that noise is judged by, and how fast it follows them in the end.
_WIDE = 0.1
_SLOWEST = 0.01


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What speaks for a pair of track and row, in units of squared standard deviations (twice a log likelihood).

    ``cap`` is what a pair may cost at most, ``gate`` how many squared standard deviations it may be off. ``alone`` and
    ``crowded`` are what the same id of the input counts for, with nobody else within ``crowd_m`` and with somebody;
    ``fresh`` speaks against a new id of the input that would go on a track that missed nothing. ``floor_m`` is added to
    the noise of positions. Two tracks are one sample for at most ``share_s`` where it is within ``share_m`` of both.
    """

    alone: float
    crowded: float
    share_m: float
    share_s: float
    cap: float = 26.0
    gate: float = 40.0
    crowd_m: float = 1.7
    fresh: float = 4.0
    floor_m: float = 0.1


class Seen(NamedTuple):
    """What is known at a step: the tracks alive, ``row`` (K,) of the step that each has, or -1; their states, hits."""

    ids: Ints
    row: Ints
    mean: Floats
    hits: Ints
    missed: Ints


def pairs(gain: Floats) -> tuple[Ints, Ints]:
    """The pairs of rows and columns of ``gain`` (K, N) with the largest total; pairs that gain nothing are left out."""
    if gain.size == 0:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    best = gain.argmax(axis=1)
    row = np.flatnonzero(gain[np.arange(len(best)), best] > 0)
    column = best[row]
    if len(np.unique(column)) == len(column):  # everybody gets the best there is
        return row, column
    rows, columns = solve(-np.maximum(gain, 0.0))
    kept = gain[rows, columns] > 0
    return rows[kept], columns[kept]


@dataclass
class Follower:
    """The tracks that are alive. Ages in steps."""

    walker: Walker
    evidence: Evidence
    step_s: float
    max_age: int
    sure_hits: int
    young_age: int
    ids: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    state: State = field(default_factory=lambda: State(np.empty((0, 4)), np.empty((0, 3))))
    source: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    hits: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    missed: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    shared: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    next_id: int = 1
    learning: bool = True
    judged: int = 0
    known: set[int] = field(default_factory=set)

    def step(self, xy_m: Floats, source: Ints, passed: int) -> Seen:
        """Go on by ``passed`` steps and see rows at (N, 2) that the input calls ``source`` (N,)."""
        self.missed = self.missed + passed
        old = np.where(self.hits >= self.sure_hits, self.max_age, self.young_age) < self.missed
        if old.any():
            self._keep(~old)
        if len(self.ids):
            self.state = self.walker.predict(self.state, passed * self.step_s)
        gain = self._gain(xy_m, source)
        track, row = pairs(gain)
        guest, host = self._sharing(track, row, xy_m)
        if len(guest):
            self._live_on(guest, xy_m[row[host]], passed)
        if len(track):
            before = self.state.take(track)
            noise_m = np.full(len(track), self.walker.noise_m)
            noise_m[host] = self.evidence.share_m / 2
            self._learn(before, xy_m[row], track, noise_m == self.walker.noise_m)
            new = self.walker.update(before, xy_m[row], noise_m)
            self.state.mean[track], self.state.cov[track] = new
            self.missed[track] = 0
            self.hits[track] += 1
            self.shared[track] = 0
            self.source[track] = source[row]
            self.source[track[host]] = -1
        row_of = np.full(len(self.ids), -1)
        row_of[track] = row
        free = np.ones(len(xy_m), bool)
        free[row] = False
        if free.any():
            row_of = np.concatenate([row_of, np.flatnonzero(free)])
            self._start(xy_m[free], source[free])
        self.known.update(source.tolist())
        return Seen(self.ids, row_of, self.state.mean.copy(), self.hits.copy(), self.missed)

    def _sharing(self, track: Ints, row: Ints, xy_m: Floats) -> tuple[Ints, Ints]:
        """Tracks that are lost where somebody else is seen between the two of them: both are one box. And in whose.

        Who they share it with is given as places in ``track``.
        """
        nobody = np.empty(0, np.intp), np.empty(0, np.intp)
        lost = (self.hits >= self.sure_hits) & (self.shared * self.step_s < self.evidence.share_s)
        lost[track] = False
        sure = np.flatnonzero(self.hits[track] >= self.sure_hits)
        guest = np.flatnonzero(lost)
        if len(guest) == 0 or len(sure) == 0:
            return nobody
        seen, expected = xy_m[row[sure]], self.state.mean[:, :2]
        off = expected[guest, None] - seen[None]
        far = np.einsum("knd,knd->kn", off, off)
        host = far.argmin(axis=1)
        inside = far[np.arange(len(guest)), host] < self.evidence.share_m**2
        own = expected[track[sure[host]]]
        to_middle = seen[host] - (own + expected[guest]) / 2
        inside &= (to_middle**2).sum(axis=1) < ((seen[host] - own) ** 2).sum(axis=1)
        return guest[inside], sure[host[inside]]

    def _live_on(self, guest: Ints, xy_m: Floats, passed: int) -> None:
        """Where the box is says little of each, and what it is called says nothing of who is who once they part."""
        noise_m = np.full(len(guest), self.evidence.share_m / 2)
        new = self.walker.update(self.state.take(guest), xy_m, noise_m)
        self.state.mean[guest], self.state.cov[guest] = new
        self.missed[guest] = np.maximum(self.missed[guest] - passed, 1)
        self.shared[guest] += passed

    def _learn(self, before: State, xy_m: Floats, track: Ints, single: Bools) -> None:
        """A share ``_WIDE`` of positions lies further off than so much, if the noise is what it is taken to be."""
        settled = (self.hits[track] >= self.sure_hits) & single
        if self.learning and settled.any():
            off = (xy_m - before.mean[:, :2])[settled]
            limit = -2 * np.log(_WIDE) * (before.cov[settled, 0] + self.walker.noise_m**2)
            wide = (off**2).sum(axis=1) > limit
            self.judged += len(wide)
            rate = max(_SLOWEST, 5 / (self.judged + 50))  # fast at first
            log_noise = np.log(self.walker.noise_m) + rate * float((wide - _WIDE).sum())
            self.walker = replace(self.walker, noise_m=float(np.clip(np.exp(log_noise), *NOISE_M)))

    def _gain(self, xy_m: Floats, source: Ints) -> Floats:
        e = self.evidence
        if len(self.ids) == 0 or len(xy_m) == 0:
            return np.empty((len(self.ids), len(xy_m)))
        s = self.state.cov[:, 0] + self.walker.noise_m**2 + e.floor_m**2
        off = xy_m[None] - self.state.mean[:, None, :2]
        squared = np.einsum("knd,knd->kn", off, off) / s[:, None]
        gain = e.cap - squared - 2 * np.log(s)[:, None]
        same = self.source[:, None] == source[None]
        if len(xy_m) > 1:
            apart = xy_m[:, None] - xy_m[None]
            near = np.einsum("mnd,mnd->mn", apart, apart) < e.crowd_m**2
            crowded = near.sum(axis=0) > 1
        else:
            crowded = np.zeros(1, bool)
        gain += same * np.where(crowded, e.crowded, e.alone)
        fresh = np.array([one not in self.known for one in source.tolist()])
        if fresh.any():
            gain -= e.fresh * (fresh[None] & (self.missed == 1)[:, None])
        return np.where(squared <= e.gate, np.round(gain, 6), -1.0)

    def _start(self, xy_m: Floats, source: Ints) -> None:
        count = len(xy_m)
        born = self.walker.born(xy_m)
        self.ids = np.concatenate([self.ids, np.arange(self.next_id, self.next_id + count)])
        self.next_id += count
        self.state = State(*(np.concatenate(both) for both in zip(self.state, born, strict=True)))
        self.source = np.concatenate([self.source, source])
        self.hits = np.concatenate([self.hits, np.ones(count, np.int64)])
        self.missed = np.concatenate([self.missed, np.zeros(count, np.int64)])
        self.shared = np.concatenate([self.shared, np.zeros(count, np.int64)])

    def _keep(self, kept: Bools) -> None:
        self.ids, self.source = self.ids[kept], self.source[kept]
        self.hits, self.missed, self.shared = self.hits[kept], self.missed[kept], self.shared[kept]
        self.state = self.state.take(kept)
