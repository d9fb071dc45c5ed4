"""Recent positions of tracks on a regular clock: histories, gaps, smoothed displacements.

Letters: K tracks remembered, N tracks at one time, B batch, L past positions (the last one is the current one).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints


@dataclass
class Histories:
    """The last L positions of all tracks that were observed within L steps."""

    length: int
    ids: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    xy_m: Floats = field(init=False)

    def __post_init__(self) -> None:
        self.xy_m = np.empty((0, self.length, 2))

    def push(self, ids: Ints, xy_m: Floats, steps: int) -> tuple[Floats, Bools]:
        """Advance by ``steps`` and add the positions ``xy_m`` (N, 2) of the tracks ``ids`` (N,).

        Returns the histories of these tracks, (N, L, 2) with NaN at unknown positions, and which are known, (N, L).
        """
        steps = min(steps, self.length)
        moved = np.full_like(self.xy_m, np.nan)
        moved[:, : self.length - steps] = self.xy_m[:, steps:]
        slot = np.searchsorted(self.ids, ids)
        is_old = np.zeros(len(ids), bool)
        inside = slot < len(self.ids)
        is_old[inside] = self.ids[slot[inside]] == ids[inside]
        remembered = np.asarray(np.isfinite(moved[:, :, 0]).any(axis=1))
        remembered[slot[is_old]] = True
        if not (is_old.all() and remembered.all()):
            new = np.unique(ids[~is_old])
            kept_ids = np.concatenate([self.ids[remembered], new])
            order = np.argsort(kept_ids, kind="stable")
            self.ids = kept_ids[order]
            moved = np.concatenate([moved[remembered], np.full((len(new), self.length, 2), np.nan)])[order]
            slot = np.searchsorted(self.ids, ids)
        self.xy_m = moved
        self.xy_m[slot, -1] = xy_m
        past = self.xy_m[slot]
        return past, np.isfinite(past[:, :, 0])

    def push_all(self, steps: Ints, ends: Ints, ids: Ints, xy_m: Floats) -> tuple[Floats, Bools]:
        """Add positions as ``push`` does, F times in a row; returns the results of each time, end to end.

        ``steps`` (F,) and ``ends`` (F + 1,): time f comes ``steps[f]`` after the one before, and has the tracks
        ``ids[ends[f] : ends[f + 1]]``, each of them once. ``ids`` is (N,), ``xy_m`` (N, 2).
        """
        if not len(steps):
            return np.empty((0, self.length, 2)), np.empty((0, self.length), bool)
        length, count = self.length, len(ids)
        at = np.cumsum(np.minimum(steps, length))
        old, back = np.nonzero(~np.isnan(self.xy_m).all(axis=2))
        track = np.concatenate([self.ids[old], ids])
        step = np.concatenate([back - (length - 1), np.repeat(at, np.diff(ends))])
        place = np.concatenate([self.xy_m[old, back], xy_m])
        order = np.lexsort((step, track))
        track, step, place = track[order], step[order], place[order]
        windows = np.full((len(track), length, 2), np.nan)
        windows[:, -1] = place
        for before in range(1, min(length, len(track))):  # a track has one position a step, so these are all
            passed = step[before:] - step[:-before]
            row = ((track[before:] == track[:-before]) & (passed < length)).nonzero()[0]
            windows[row + before, length - 1 - passed[row]] = place[row]
        past = np.empty((len(track), length, 2))
        past[order] = windows
        past = past[len(track) - count :]
        # What is remembered: the last position of each track, as far back as it is now.
        passed = int(at[-1]) - step
        is_last = np.append(track[1:] != track[:-1], True)[: len(track)].nonzero()[0]
        moved = np.full((len(is_last), length, 2), np.nan)
        for passed_steps in range(length):
            row = (passed[is_last] == passed_steps).nonzero()[0]
            moved[row, : length - passed_steps] = windows[is_last[row], passed_steps:]
        kept = np.isfinite(moved[:, :, 0]).any(axis=1) | (passed[is_last] == 0)
        self.ids, self.xy_m = track[is_last[kept]], moved[kept]
        return past, np.isfinite(past[:, :, 0])


def last_positions(xy_m: Floats, valid: Bools, length: int) -> tuple[Floats, Bools]:
    """The last ``length`` positions of histories (B, L, 2), padded with unknown ones, and which of them are known."""
    xy_m, valid = xy_m[:, -length:], valid[:, -length:]
    batch, short = len(valid), length - valid.shape[1]
    if short == 0:
        return xy_m, valid
    padding, unknown = np.full((batch, short, 2), np.nan), np.zeros((batch, short), bool)
    return np.concatenate([padding, xy_m], axis=1), np.concatenate([unknown, valid], axis=1)


def fill_gaps(xy_m: Floats, valid: Bools) -> tuple[Floats, Ints]:
    """Interpolate gaps between known positions (B, L, 2) linearly; also returns the lengths (B,) from the first known.

    Positions before the first known one are set to it. The last position has to be known.
    """
    batch, length = valid.shape
    if valid.all():
        return xy_m, np.full(batch, length)
    steps = np.arange(length)
    before = np.maximum.accumulate(np.where(valid, steps, -1), axis=1)
    after = np.minimum.accumulate(np.where(valid, steps, length)[:, ::-1], axis=1)[:, ::-1]
    before = np.where(before < 0, after, before)
    row = np.arange(batch)[:, None]
    span = np.maximum(after - before, 1)
    share = ((steps - before) / span)[..., None]
    low, high = xy_m[row, before], xy_m[row, after]
    filled = np.where(after[..., None] == before[..., None], low, low + share * (high - low))
    return filled, length - valid.argmax(axis=1).astype(np.int64)


@dataclass
class Holt:
    """Double exponential smoothing of displacements (Holt; Eq. 3 of the paper), for K tracks at once.

    ``level`` is the smoothed displacement and ``trend`` its change per step, both (K, 2) in metres. The first level is
    the first displacement, the first trend is 0.
    """

    alpha: float
    beta: float

    def start(self, displacement: Floats) -> tuple[Floats, Floats]:
        """Level and trend (K, 2) after the first displacement."""
        return displacement.copy(), np.zeros_like(displacement)

    def step(self, level: Floats, trend: Floats, displacement: Floats) -> tuple[Floats, Floats]:
        """Level and trend (K, 2) after one more displacement."""
        new = self.alpha * displacement + (1 - self.alpha) * (level + trend)
        return new, self.beta * (new - level) + (1 - self.beta) * trend


def rebuild_positions(last_m: Floats, displacements: Floats) -> Floats:
    """Positions (K, L, 2) that end at ``last_m`` (K, 2), from the ``displacements`` (K, L - 1, 2) before it."""
    back = np.cumsum(displacements[:, ::-1], axis=1)[:, ::-1]
    return np.concatenate([last_m[:, None] - back, last_m[:, None]], axis=1)


class SmoothedHistory(NamedTuple):
    """The smoothed histories of K tracks, of constant size whatever their age.

    ``last_m`` (K, 2) is the last observed position. ``level`` and ``trend`` (K, 2) are those of Holt's smoothing,
    ``displacements`` (K, L - 1, 2) the last smoothed displacements, of which the last ``known`` (K,) exist.
    """

    last_m: Floats
    level: Floats
    trend: Floats
    displacements: Floats
    known: Ints

    @classmethod
    def of_observations(cls, holt: Holt, past_m: Floats, valid: Bools) -> SmoothedHistory:
        """The smoothed histories of N observations: their pasts (N, L, 2) are ``valid`` (N, L) in a run up to now."""
        count, length = valid.shape
        history = cls(
            past_m[:, -1],
            np.zeros((count, 2)),
            np.zeros((count, 2)),
            np.zeros((count, length - 1, 2)),
            np.zeros(count, int),
        )
        for step in range(1, length):
            usable = valid[:, step] & valid[:, step - 1]
            history = history._smoothed(holt, usable, past_m[:, step] - past_m[:, step - 1])
        return history

    def extended(self, holt: Holt, xy_m: Floats, steps: Ints) -> SmoothedHistory:
        """With observations at ``xy_m`` (K, 2), ``steps`` (K,) after the last ones; gaps are interpolated linearly."""
        displacement, history = (xy_m - self.last_m) / steps[:, None], self
        for done in range(int(steps.max(initial=0))):
            history = history._smoothed(holt, steps > done, displacement)
        return history._replace(last_m=xy_m)

    def _smoothed(self, holt: Holt, which: Bools, displacement: Floats) -> SmoothedHistory:
        """Eq. 3 of the paper: smooth one more displacement (K, 2) of some tracks (K,)."""
        started = (self.known > 0)[:, None]
        first, flat = holt.start(displacement)
        level, trend = holt.step(self.level, self.trend, displacement)
        level = np.where(which[:, None], np.where(started, level, first), self.level)
        trend = np.where(which[:, None], np.where(started, trend, flat), self.trend)
        shifted = np.concatenate([self.displacements[:, 1:], level[:, None]], axis=1)
        displacements = np.where(which[:, None, None], shifted, self.displacements)
        known = np.where(which, np.minimum(self.known + 1, displacements.shape[1]), self.known)
        return SmoothedHistory(self.last_m, level, trend, displacements, known)

    def positions(self) -> tuple[Floats, Bools]:
        """Past positions (K, L, 2), rebuilt from the smoothed displacements, and which of them are known (K, L)."""
        length = self.displacements.shape[1] + 1
        valid = np.arange(length) >= length - 1 - self.known[:, None]
        return rebuild_positions(self.last_m, self.displacements), valid
