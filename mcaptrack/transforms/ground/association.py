"""Which detection belongs to which track: gates, costs and one assignment for all classes of a frame.

Pairs of different classes are outside the gate, so that one assignment of all is one for each class. Detections that
are left are compared once more, with lost tracks of other classes: detectors confuse classes now and then.

Letters: K tracks, N detections, P pairs.
"""

from __future__ import annotations

from typing import Final, Literal

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Indices
from mcaptrack.geometry.assignment import max_weight_matching
from mcaptrack.geometry.oriented_boxes import bev_iou_of_pairs
from mcaptrack.transforms.ground.state import BOX, CLASS, GATE_M, HITS, MISSED_S, NOISE, X, Y, variance

Cost = Literal["metres", "iou"]

#: The gate in squared standard deviations, and that between different classes.
_GATE: Final = 16.0
_OTHER_GATE: Final = 9.0
#: How much of the gate in metres counts between different classes.
_OTHER_SHARE: Final = 0.4
#: The gain of a pair without any distance.
_GAIN: Final = 30.0
#: Detections that a track of another class needs before.
_OTHER_HITS: Final = 2


def associate(
    table: Floats, found: Floats, cost: Cost, min_iou: float, across_classes: bool
) -> tuple[Indices, Indices, Bools]:
    """Tracks and detections that belong together, (P,) each, and whether they have the same class."""
    if not table.shape[1] or not found.shape[1]:
        nothing = np.empty(0, np.intp)
        return nothing, nothing, np.empty(0, bool)
    x, y = found[X] - table[X, :, None], found[Y] - table[Y, :, None]
    squared = x * x + y * y
    spread = variance(table)
    reach = table[GATE_M] * (1 + table[MISSED_S])
    same = table[CLASS, :, None] == found[CLASS]
    near = squared <= np.minimum(_GATE * spread, reach * reach)[:, None]
    if across_classes:
        same = np.ones_like(same)
    track, row = _assigned(table, found, squared, spread, near & same, cost, min_iou)
    is_same = np.ones(len(track), bool)
    if across_classes or same.all():
        return track, row, is_same
    lost, free = np.ones(table.shape[1], bool), np.ones(found.shape[1], bool)
    lost[track], free[row] = False, False
    lost &= table[HITS] >= _OTHER_HITS
    other = near & lost[:, None] & free
    if not other.any():
        return track, row, is_same
    limit = np.minimum(_OTHER_GATE * spread, np.maximum(_OTHER_SHARE * reach, 3 * table[NOISE]) ** 2)
    more = _assigned(table, found, squared, spread, other & (squared <= limit[:, None]), cost, min_iou)
    is_same = np.concatenate([is_same, np.zeros(len(more[0]), bool)])
    return np.concatenate([track, more[0]]), np.concatenate([row, more[1]]), is_same


def _assigned(
    table: Floats, found: Floats, squared: Floats, spread: Floats, allowed: Bools, cost: Cost, min_iou: float
) -> tuple[Indices, Indices]:
    """The best assignment of the allowed pairs (K, N)."""
    track, row = allowed.nonzero()
    if not len(track):
        return track, row
    if cost == "iou":
        gain = bev_iou_of_pairs(table[BOX, track].T, found[BOX, row].T)
        good = gain >= max(min_iou, 1e-6)
        track, row, gain = track[good], row[good], gain[good]
    else:
        s = spread[track]
        gain = _GAIN - squared[track, row] / s - 2 * np.log(s)
    if not len(track):
        return track, row
    (track, row), _ = max_weight_matching((track, row), np.round(gain, 6), allowed.shape)
    return track, row
