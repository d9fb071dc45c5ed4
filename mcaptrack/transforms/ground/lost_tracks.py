"""Lost tracks: which of them a new track continues, after an occlusion that lasted longer than tracks coast.

A lost track either stood still and is where it was, or has gone on at its last velocity, less certainly the longer and
the faster. A new track continues the lost track that makes its first position likely, unless another object is more
likely to be there. Everything is computed from the past alone.

Letters: K lost tracks, N new tracks.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Indices
from mcaptrack.geometry.assignment import max_weight_matching
from mcaptrack.geometry.neighbours import Pairing
from mcaptrack.transforms.ground.state import (
    AGE_S,
    CLASS,
    FIRST,
    LAST,
    LAST_SPREAD,
    LAST_VELOCITY,
    MISSED_S,
    NOISE,
    SPEED,
    no_tracks,
)

#: How much velocities change within a second during an occlusion: at rest, as a share of the usual speed, and with
#: speed, as a share of it.
_DRIFT_AT_REST: Final = 0.07
_DRIFT_WITH_SPEED: Final = 0.1
#: A track stood still if it was slower than this share of the usual speed; then it stays with this probability.
_REST: Final = 0.12
_STAYS: Final = 0.8
#: How far an object at rest seems to move, in metres per square root of a second.
_CREEP_M: Final = 0.15
#: The density of new objects: their number in a square with the distance of one second at the usual speed as side.
_NEW: Final = 0.06


class LostTracks:
    """Confirmed tracks that ended at most ``link_s`` seconds after their last detection."""

    def __init__(self, link_s: float) -> None:
        self._link_s = link_s
        self.table: Floats = no_tracks()

    def add(self, table: Floats) -> None:
        """Remember tracks that end, (rows, K)."""
        self.table = np.concatenate([self.table, table], axis=1)

    def wait(self, dt: float) -> None:
        """Let ``dt`` seconds pass."""
        if self.table.shape[1]:
            self.table[MISSED_S] += dt
            self.keep(self.table[MISSED_S] <= self._link_s)

    def keep(self, which: Bools) -> None:
        """Keep some of the tracks."""
        self.table = self.table.compress(which, axis=1)


def continuations(lost: Floats, new: Floats) -> tuple[Indices, Indices]:
    """Lost tracks (rows, K) and new ones (rows, N) that continue them: numbers of both, (P,) each."""
    if not lost.shape[1] or not new.shape[1]:
        nothing = np.empty(0, np.intp)
        return nothing, nothing
    # Farther than twice the way of a second, from where a track was or would be, none of the two densities below is
    # above that of new objects, however long the gap is.
    longest = np.maximum(lost[MISSED_S] - new[AGE_S].min(), 1e-3)
    pairs = Pairing(lost[LAST][:2], new[FIRST], 2 * lost[SPEED] + np.hypot(*lost[LAST_VELOCITY]) * longest)
    gap = pairs.of_first(lost[MISSED_S]) - pairs.of_second(new[AGE_S])
    seconds = np.maximum(gap, 1e-3)
    way = pairs.of_second(new[FIRST]) - pairs.of_first(lost[LAST][:2])
    velocity, usual = pairs.of_first(lost[LAST_VELOCITY]), pairs.of_first(lost[SPEED])
    speed = np.hypot(*velocity)
    noise = 2 * pairs.of_first(lost[NOISE]) ** 2
    drift = _DRIFT_AT_REST * usual + _DRIFT_WITH_SPEED * speed
    goes = noise + pairs.of_first(lost[LAST_SPREAD]) * seconds**2 + drift**2 * seconds**3 / 3
    stays = noise + _CREEP_M**2 * seconds
    off = way - velocity * seconds
    share = np.where(speed < _REST * usual, _STAYS, 0.0)
    density = (1 - share) * np.exp(-(off * off).sum(0) / goes / 2) / goes
    density += share * np.exp(-(way * way).sum(0) / stays / 2) / stays
    gain = np.log(np.maximum(density / (2 * np.pi) * usual**2 / _NEW, 1e-12))
    fits = (gain > 0) & (gap > 0) & (pairs.of_first(lost[CLASS]) == pairs.of_second(new[CLASS]))
    i, j = pairs.chosen(fits)
    if not len(i):
        return i, j
    (i, j), _ = max_weight_matching((i, j), np.round(gain[fits], 6), pairs.shape)
    return i, j
