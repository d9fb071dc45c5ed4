"""Following people through a log by likelihood: who goes with whom, step by step, from the past alone.

Every track is a Kalman filter. A row goes to the track that makes it likely, and what the input says of identity
counts as evidence: much where somebody walks alone, little in a crowd, where trackers confuse people.

Letters: K tracks, N rows of one step.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.match import solve
from mcaptrack.transforms.retrack.motion import State, Walker

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


#: No noise of seen positions is smaller or larger than this.
NOISE_M = (0.03, 0.8)
#: The share of positions that noise is judged by, and how fast it follows them in the end.
_WIDE = 0.1
_SLOWEST = 0.01


@dataclass(frozen=True)
class Evidence:
    """What speaks for a pair of track and row, in units of squared standard deviations (twice a log likelihood).

    ``cap`` is what a pair may cost at most, ``gate`` how many squared standard deviations it may be off. ``alone`` and
    ``crowded`` are what the same id of the input counts for, with nobody else within ``crowd_m`` and with somebody;
    ``fresh`` speaks against a new id of the input that would go on a track that missed nothing. ``floor_m`` is added to
    the noise of positions. Two tracks are one sample for at most ``share_s`` where it is within ``share_m`` of both.
    """

    cap: float = 26.0
    gate: float = 40.0
    alone: float = 12.0
    crowded: float = 4.0
    crowd_m: float = 1.7
    fresh: float = 4.0
    share_m: float = 1.0
    share_s: float = 3.0
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
        old = np.where(self.hits >= self.sure_hits, self.max_age, self.young_age) < self.missed - 0
        if old.any():
            self._keep(~old)
        if len(self.ids):
            self.state = self.walker.predict(self.state, passed * self.step_s)
        gain = self._gain(xy_m, source)
        track, row = pairs(gain)
        before_m = self.state.mean[:, :2].copy()
        if len(track):
            before = self.state.take(track)
            self._learn(before, xy_m[row], track)
            new, _ = self.walker.update(before, xy_m[row])
            self.state.mean[track], self.state.cov[track] = new
            self.missed[track] = 0
            self.hits[track] += 1
            self.source[track] = source[row]
            self.shared[track] = 0
        self._share(track, row, xy_m, passed, before_m)
        row_of = np.full(len(self.ids), -1)
        row_of[track] = row
        free = np.ones(len(xy_m), bool)
        free[row] = False
        if free.any():
            row_of = np.concatenate([row_of, np.flatnonzero(free)])
            self._start(xy_m[free], source[free])
        self.known.update(source.tolist())
        return Seen(self.ids, row_of, self.state.mean.copy(), self.hits.copy(), self.missed)

    def _share(self, track: Ints, row: Ints, xy_m: Floats, passed: int, before_m: Floats) -> None:
        """Who is lost where somebody else is seen, between the two, lives on there for a while: they are one box.

        Where that is says little of who is lost, and what it is called says nothing of who is who once they part.
        ``before_m`` (K, 2) is where everybody was expected.
        """
        lost = (self.missed > 0) & (self.hits >= self.sure_hits)
        lost &= self.shared * self.step_s < self.evidence.share_s
        sure = self.hits[track] >= self.sure_hits
        track, row = track[sure], row[sure]
        if not lost.any() or len(track) == 0:
            return
        guest = np.flatnonzero(lost)
        off = self.state.mean[guest, None, :2] - xy_m[row][None]
        far = np.einsum("knd,knd->kn", off, off)
        host = far.argmin(axis=1)
        inside = far[np.arange(len(guest)), host] < self.evidence.share_m**2
        middle = (before_m[track[host]] + before_m[guest]) / 2
        seen, alone = xy_m[row[host]], before_m[track[host]]
        inside &= ((seen - middle) ** 2).sum(axis=1) < ((seen - alone) ** 2).sum(axis=1)
        guest, host = guest[inside], host[inside]
        if len(guest) == 0:
            return
        noise = np.full(len(guest), self.evidence.share_m / 2)
        new, _ = self.walker.update(self.state.take(guest), xy_m[row[host]], noise)
        self.state.mean[guest], self.state.cov[guest] = new
        self.missed[guest] = np.maximum(self.missed[guest] - passed, 1)
        self.shared[guest] += passed
        self.source[track[host]] = -1

    def _learn(self, before: State, xy_m: Floats, track: Ints) -> None:
        """A share ``_WIDE`` of positions lies further off than so much, if the noise is what it is taken to be."""
        settled = self.hits[track] >= self.sure_hits
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
