"""New tracks of fast objects: second detections that are beyond the gate, because no velocity is known yet.

After one detection an object may be anywhere that it can reach at the highest speed of its class. That is too far for
the gate of tracks: on a motorway, or at few frames a second, the next detection is several metres away. So what is left
after the association is looked at once more. A vehicle moves along its length, and its detections have one heading and
size; of other objects, pairs count that could be no others.

Letters: K tracks, N detections, P pairs.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Indices
from mcaptrack.geometry.assignment import max_weight_matching
from mcaptrack.geometry.neighbours import Pairing
from mcaptrack.transforms.ground.state import (
    CLASS,
    FIRST,
    HEADING,
    HITS,
    LENGTH,
    MAX_SPEED,
    MISSED_S,
    NOISE,
    TURNS,
    X,
    Y,
)

#: How far a vehicle moves across its heading, as a share of the way, and beyond this many standard deviations of noise.
_ACROSS: Final = 0.15
_NOISE: Final = 4.0
#: How much two headings of an object differ at most, in rad, up to half a turn; and two lengths, as a ratio.
_TURNED_RAD: Final = 0.35
_LENGTHS: Final = 1.6
#: How much longer a way backwards counts than one ahead.
_BACKWARDS: Final = 2.0


def fast_starts(
    table: Floats, found: Floats, taken: tuple[Indices, Indices], across_classes: bool
) -> tuple[Indices, Indices]:
    """Tracks with one detection (rows, K), and detections (rows, N) of the same objects: numbers of both, (P,) each.

    Those of ``taken``, which are associated already, are no others.
    """
    nothing = np.empty(0, np.intp)
    if len(taken[1]) == found.shape[1]:
        return nothing, nothing
    is_free, is_left = table[HITS] == 1, np.ones(found.shape[1], bool)
    is_free[taken[0]] = is_left[taken[1]] = False
    if not is_free.any():
        return nothing, nothing
    first, left = is_free.nonzero()[0], is_left.nonzero()[0]
    old, new = table[:, first], found[:, left]
    reach = old[MAX_SPEED] * old[MISSED_S] + _NOISE * old[NOISE]
    pairs = Pairing(old[FIRST], new[[X, Y]], reach)
    x = pairs.of_second(new[X]) - pairs.of_first(old[FIRST][0])
    y = pairs.of_second(new[Y]) - pairs.of_first(old[FIRST][1])
    far, noise = np.hypot(x, y), _NOISE * pairs.of_first(old[NOISE])
    can_be = far <= pairs.of_first(old[MAX_SPEED] * old[MISSED_S]) + noise
    if not across_classes:
        can_be &= pairs.of_first(old[CLASS]) == pairs.of_second(new[CLASS])
    if not can_be.any():
        return nothing, nothing
    heading, other_heading = pairs.of_first(old[HEADING]), pairs.of_second(new[HEADING])
    along, across = x * np.cos(heading) + y * np.sin(heading), np.abs(y * np.cos(heading) - x * np.sin(heading))
    cost = np.where(along < 0, _BACKWARDS * far, far)
    has_heading = np.isfinite(heading) & np.isfinite(other_heading) & pairs.of_first(old[TURNS] == 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        turned = np.abs(np.sin(heading - other_heading))
        longer = np.abs(np.log(pairs.of_first(old[LENGTH]) / pairs.of_second(new[LENGTH])))
        is_along = (across <= noise + _ACROSS * far) & (turned <= np.sin(_TURNED_RAD)) & ~(longer > np.log(_LENGTHS))
    can_be &= np.where(has_heading, is_along, _is_only(can_be, pairs))
    i, j = pairs.chosen(can_be)
    if not len(i):
        return nothing, nothing
    gain = cost[can_be].max() + 1 - cost[can_be]
    (i, j), _ = max_weight_matching((i, j), np.round(gain, 6), pairs.shape)
    return first[i], left[j]


def _is_only(can_be: Bools, pairs: Pairing) -> Bools:
    """Pairs of a track and a detection that have no other."""
    track, row = pairs.chosen(can_be)
    out = can_be.copy()
    out[can_be] = (np.bincount(track)[track] == 1) & (np.bincount(row)[row] == 1)
    return out
