"""Tracks of detections with covariances, such as those of several cameras: associations stay open for some seconds.

People who stand close together can't be told apart by one frame, but by where they go. So which detection continues
which is decided again as long as its frame waits to be written. At each cut between two frames, whatever was before it
has a prediction from a Kalman filter forwards in time, and whatever comes after it one from a filter backwards. How
well each past fits each future is then one number, and the cut is one assignment: it exchanges futures, closes gaps,
and begins and ends tracks.

Letters: N detections that are open or may still be continued, P pairs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Indices, Ints, joined, taken
from mcaptrack.geometry.assignment import max_weight_matching
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.neighbours import Pairing
from mcaptrack.schema import Frame
from mcaptrack.transforms.motion_limits import MotionLimits

#: The logarithm of how many tracks begin in a square metre and a frame, times the share that ends in a frame; what a
#: detection counts beside its score and place: how rarely false ones are in a square metre. (Chosen on drawn squares.)
_BEGINS_AND_ENDS: Final = -9.7
_DETECTED: Final = 2.0
#: The share of people who are detected in a frame.
_SEEN: Final = 0.85
#: Scores count as probabilities from this one to 1 minus it.
_LEAST_SCORE: Final = 0.02
#: A filter backwards begins with no idea of the velocity: its standard deviation in m/s.
_ANY_SPEED: Final = 20.0
#: Of a window of more frames than this, associations are decided again after every so manieth part of it.
_STEPS: Final = 8


class _States(NamedTuple):
    """The states of a filter at each detection: means (N, 4) of position and velocity, and covariances (N, 4, 4)."""

    mean: Floats
    cov: Floats

    @classmethod
    def of(cls, xy_m: Floats, noise: Floats, speed: Floats) -> _States:
        """At first detections, with noise (N, 2, 2), of tracks with these usual speeds (N,)."""
        cov = np.zeros((len(xy_m), 4, 4))
        cov[:, :2, :2] = noise
        cov[:, 2, 2] = cov[:, 3, 3] = speed**2
        return cls(np.concatenate([xy_m, np.zeros_like(xy_m)], axis=1), cov)

    def after(self, which: Indices, dt: Floats, drift: Floats) -> _States:
        """Predict some of them by ``dt`` seconds (P,), which may be negative."""
        mean, move = self.mean[which], np.tile(np.eye(4), (len(which), 1, 1))
        move[:, 0, 2] = move[:, 1, 3] = dt
        cov = move @ self.cov[which] @ np.swapaxes(move, 1, 2)
        power, passed = drift[which] ** 2, np.abs(dt)
        for axis in (0, 1):
            cov[:, axis, axis] += power * passed**3 / 3
            cov[:, axis, axis + 2] += power * passed * dt / 2
            cov[:, axis + 2, axis] += power * passed * dt / 2
            cov[:, axis + 2, axis + 2] += power * passed
        mean[:, :2] += mean[:, 2:] * dt[:, None]
        return _States(mean, cov)

    def corrected(self, xy_m: Floats, noise: Floats) -> tuple[_States, Floats]:
        """Correct all by positions (N, 2) with noise (N, 2, 2); also returns how likely these were: logarithms (N,)."""
        off, spread = xy_m - self.mean[:, :2], self.cov[:, :2, :2] + noise
        gain = self.cov[:, :, :2] @ np.linalg.inv(spread)
        mean = self.mean + np.einsum("nij,nj->ni", gain, off)
        cov = self.cov - gain @ self.cov[:, :2]
        return _States(mean, (cov + np.swapaxes(cov, 1, 2)) / 2), _log_density(off, spread)

    def put(self, which: Indices, states: _States) -> None:
        """Set some of them, in place."""
        self.mean[which], self.cov[which] = states


def _log_density(off: Floats, cov: Floats) -> Floats:
    """The logarithms (N,) of normal densities with covariances (N, D, D) at distances (N, D) from their means."""
    half = np.linalg.cholesky(cov)
    scaled = np.linalg.solve(half, off[:, :, None])[:, :, 0]
    area = np.log(np.diagonal(half, axis1=1, axis2=2)).sum(axis=1)
    return np.asarray(-(scaled**2).sum(axis=1) / 2 - area - off.shape[1] / 2 * np.log(2 * np.pi))


class Measured(NamedTuple):
    """Detections (N,) of one frame: columns as the rows in the tables of the tracker ``ground`` (N, rows), positions
    (N, 2), covariances (N, 2, 2) with the noise of their class, scores (N,) with 0.5 where none is known, and classes
    (N,).
    """

    rows: Floats
    xy_m: Floats
    noise: Floats
    score: Floats
    class_id: Ints


class _Open(NamedTuple):
    """Detections (N,) that are open or may still be continued: their frame, the detections before and after in their
    track, their number in the recording and that of the first one of their track; limits of motion; and of each with
    all before it: log odds, sum of scores, and highest score (N, 3), and its state.
    """

    seen: Measured
    frame: Ints
    time_s: Floats
    prev: Ints
    next: Ints
    serial: Ints
    root: Ints
    drift: Floats
    speed: Floats
    reach: Floats
    worth: Floats
    ahead: _States


class Written(NamedTuple):
    """A frame that is decided: rows (R,) of detections as in ``Measured``, with filtered positions and velocities, of
    rows in gaps the mean of those before and after; whether they are detections, and their tracks.
    """

    frame: Frame
    rows: Floats
    observed: Bools
    track_id: Ints


class FixedLag:
    """Detections with associations that may still change, and the ends of tracks that may go on.

    Parameters
    ----------
    delay_s : float
        A frame is decided this many seconds later.
    gap_s : float
        The longest time without a detection that a track bridges.
    confirm_score, birth_score : float
        A track is written if it is likelier one than not, the scores of its detections add up to the first, and one of
        them is as high as the second.
    across_classes : bool
        Whether a track may continue with a detection of another class.
    limits : mapping of int to MotionLimits
        Limits of motion by class; it may grow.
    rows : int and two slices
        How many rows tables of detections have, and those of positions and of velocities.
    """

    def __init__(
        self,
        delay_s: float,
        gap_s: float,
        confirm_score: float,
        birth_score: float,
        across_classes: bool,
        limits: Mapping[int, MotionLimits],
        rows: tuple[int, slice, slice],
    ) -> None:
        self._delay_s, self._gap_s, self._across_classes = delay_s, gap_s, across_classes
        self._confirm_score, self._birth_score = confirm_score, birth_score
        self._limits, (columns, self._place, self._velocity) = limits, rows
        self._frames: list[Frame] = []
        self._now = -1
        self._t_s = 0.0
        self._ids: dict[int, int] = {}
        self._serials = 0
        none, nowhere, unknown = np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2, 2))
        self._open = self._begun(Measured(np.empty((0, columns)), nowhere, unknown, np.empty(0), none))

    def add(self, frame: Frame, seen: Measured) -> list[Written]:
        """Add a frame; returns the frames that are decided by now."""
        self._append(frame, seen)
        first = self._now - len(self._frames) + 1
        step = max(1, len(self._frames) // _STEPS)
        lows = [self._now] if self._now % step else range(max(first, 1), self._now + 1)
        self._decide(list(lows))
        out = []
        while self._frames and self._frames[0].t_ns <= frame.t_ns - self._delay_s * NS_PER_S:
            out.append(self._release())
        self._forget()
        return out

    def finish(self) -> list[Written]:
        """Decide all frames that are left."""
        if self._frames:
            self._decide(list(range(max(self._now - len(self._frames) + 1, 1), self._now + 1)))
        return [self._release() for _ in range(len(self._frames))]

    def _append(self, frame: Frame, seen: Measured) -> None:
        self._now += 1
        self._t_s = frame.t_ns / NS_PER_S
        self._frames.append(frame)
        begun = self._begun(seen)
        self._open = joined([self._open, begun])
        self._serials += len(begun.frame)
        self._filter(np.arange(len(self._open.frame) - len(begun.frame), len(self._open.frame)))

    def _begun(self, seen: Measured) -> _Open:
        """Detections of the frame that was added last, each a track of its own."""
        count = len(seen.score)
        motion = [self._limits[number] for number in seen.class_id.tolist()]
        limits = [(limit.drift_m_per_s, limit.speed_m_per_s, limit.gate_m) for limit in motion]
        drift, speed, reach = np.array(limits, float).reshape(count, 3).T
        return _Open(
            seen,
            np.full(count, self._now),
            np.full(count, self._t_s),
            np.full(count, -1),
            np.full(count, -1),
            self._serials + np.arange(count),
            self._serials + np.arange(count),
            drift,
            speed,
            reach,
            np.zeros((count, 3)),
            _States.of(seen.xy_m, seen.noise, speed),
        )

    def _filter(self, which: Indices) -> None:
        """Filter detections of one frame forwards, those before them being done."""
        held, seen = self._open, self._open.seen
        share = np.clip(seen.score[which], _LEAST_SCORE, 1 - _LEAST_SCORE)
        own = np.stack([np.log(share / (1 - share)) + _DETECTED, seen.score[which], seen.score[which]], axis=1)
        states = _States.of(seen.xy_m[which], seen.noise[which], held.speed[which])
        goes_on = held.prev[which] >= 0
        own[~goes_on, 0] += _BEGINS_AND_ENDS
        now, before = which[goes_on], held.prev[which[goes_on]]
        predicted = held.ahead.after(before, held.time_s[now] - held.time_s[before], held.drift)
        corrected, likely = predicted.corrected(seen.xy_m[now], seen.noise[now])
        states.put(goes_on.nonzero()[0], corrected)
        own[goes_on, 0] += likely + self._missed(before, now)
        own[goes_on, :2] += held.worth[before, :2]
        own[goes_on, 2] = np.maximum(own[goes_on, 2], held.worth[before, 2])
        held.root[which] = held.serial[which]
        held.root[now] = held.root[before]
        held.ahead.put(which, states)
        held.worth[which] = own

    def _missed(self, before: Indices, after: Indices) -> Floats:
        return np.asarray((self._open.frame[after] - self._open.frame[before] - 1) * np.log(1 - _SEEN))

    def _backwards(self, low: int) -> _States:
        """Filter backwards: the states of each detection from frame ``low`` on, of it and what follows."""
        held, seen = self._open, self._open.seen
        states = _States.of(seen.xy_m, seen.noise, np.full(len(held.frame), _ANY_SPEED))
        for number in range(self._now - 1, low - 1, -1):
            now = np.flatnonzero((held.frame == number) & (held.next >= 0))
            after = held.next[now]
            predicted = states.after(after, held.time_s[now] - held.time_s[after], held.drift)
            states.put(now, predicted.corrected(seen.xy_m[now], seen.noise[now])[0])
        return states

    def _decide(self, cuts: list[int]) -> None:
        """Decide again at cuts before frames of these numbers, which rise."""
        if not cuts:
            return
        behind = self._backwards(cuts[0])
        for cut in cuts:
            self._cut(cut, behind)
            self._filter(np.flatnonzero(self._open.frame == cut))

    def _cut(self, cut: int, behind: _States) -> None:
        """Assign what comes after a cut to what was before it."""
        held, seen = self._open, self._open.seen
        is_before = held.frame < cut
        first = np.flatnonzero(is_before & ((held.next < 0) | ~is_before[held.next]))
        second = np.flatnonzero(~is_before & ((held.prev < 0) | is_before[held.prev]))
        if not len(first) or not len(second):
            return
        wait_s = held.time_s[second].max() - held.time_s[first]
        pairs = Pairing(seen.xy_m[first].T, seen.xy_m[second].T, held.reach[first] + 2 * held.speed[first] * wait_s)
        dt = pairs.of_second(held.time_s[second]) - pairs.of_first(held.time_s[first])
        x, y = (
            pairs.of_second(seen.xy_m[second].T[axis]) - pairs.of_first(seen.xy_m[first].T[axis]) for axis in (0, 1)
        )
        near_m = pairs.of_first(held.reach[first]) + 2 * pairs.of_first(held.speed[first]) * dt
        allowed = (dt <= self._gap_s) & (x * x + y * y <= near_m * near_m)
        if not self._across_classes:
            allowed &= pairs.of_first(seen.class_id[first]) == pairs.of_second(seen.class_id[second])
        i, j = pairs.chosen(allowed)
        before, after = first[i], second[j]
        held.next[first], held.prev[second] = -1, -1
        if not len(i):
            return
        predicted = held.ahead.after(before, held.time_s[after] - held.time_s[before], held.drift)
        fits = _log_density(predicted.mean - behind.mean[after], predicted.cov + behind.cov[after])
        prior = np.zeros((len(after), 2, 2))
        prior[:, 0, 0] = prior[:, 1, 1] = held.speed[after] ** 2
        apart = _log_density(behind.mean[after, 2:], behind.cov[after, 2:, 2:] + prior)
        gain = fits - apart + self._missed(before, after) - _BEGINS_AND_ENDS
        good = gain > 0
        if good.any():
            (i, j), _ = max_weight_matching((i[good], j[good]), np.round(gain[good], 6), pairs.shape)
            held.next[first[i]], held.prev[second[j]] = second[j], first[i]

    def _release(self) -> Written:
        """The first frame that waits, as it is decided."""
        held = self._open
        number, frame = self._now - len(self._frames) + 1, self._frames.pop(0)
        here = np.flatnonzero(held.frame == number)
        over = np.flatnonzero((held.frame < number) & (held.next >= 0))
        over = over[held.frame[held.next[over]] > number]
        last = np.concatenate([here, over])
        while len(ahead := np.flatnonzero(held.next[last] >= 0)):
            last[ahead] = held.next[last[ahead]]
        worth = held.worth[last]
        sure = (worth[:, 0] > 0) & (worth[:, 1] >= self._confirm_score) & (worth[:, 2] >= self._birth_score)
        roots = np.concatenate([held.root[here], held.root[over]])
        sure |= np.array([root in self._ids for root in roots.tolist()], bool)
        for root in roots[sure].tolist():
            self._ids.setdefault(root, len(self._ids) + 1)
        rows = np.concatenate([self._rows(here), self._between(over, frame.t_ns / NS_PER_S)], axis=1)[:, sure]
        track_id = np.array([self._ids[root] for root in roots[sure].tolist()], np.int64)
        observed = (np.arange(len(sure)) < len(here))[sure]
        order = np.argsort(track_id)
        return Written(frame, rows[:, order], observed[order], track_id[order])

    def _rows(self, which: Indices) -> Floats:
        rows, mean = self._open.seen.rows[which].T.copy(), self._open.ahead.mean[which].T
        rows[self._place], rows[self._velocity] = mean[:2], mean[2:]
        return rows

    def _between(self, before: Indices, t_s: float) -> Floats:
        """Rows between detections and the next ones of their tracks."""
        held = self._open
        after = held.next[before]
        share = (t_s - held.time_s[before]) / np.maximum(held.time_s[after] - held.time_s[before], 1e-9)
        start, end = self._rows(before), self._rows(after)
        rows = start + 0.0
        for part in (self._place, self._velocity):
            rows[part] = start[part] + share * (end[part] - start[part])
        return rows

    def _forget(self) -> None:
        """Forget detections of decided frames that nothing can continue any more."""
        held = self._open
        is_open = held.frame > self._now - len(self._frames)
        ends = (held.next < 0) & (held.time_s >= self._t_s - self._gap_s)
        kept = is_open | ends | ((held.next >= 0) & is_open[held.next])
        if kept.all():
            return
        new = np.append(np.cumsum(kept) - 1, -1)
        before, after = (np.where((links >= 0) & kept[links], new[links], -1) for links in (held.prev, held.next))
        self._open = taken(held._replace(prev=before, next=after), kept)
