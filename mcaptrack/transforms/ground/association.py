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
from mcaptrack.geometry.neighbours import Pairing
from mcaptrack.geometry.oriented_boxes import bev_iou_of_pairs
from mcaptrack.transforms.ground.covariances import Covariances
from mcaptrack.transforms.ground.state import (
    BOX,
    CLASS,
    GATE_M,
    HITS,
    MISSED_S,
    NOISE,
    SCORE,
    X,
    Y,
    measured,
    own_covariances,
    variance,
)

Cost = Literal["metres", "iou"]

#: The gate in squared standard deviations, and that between different classes.
_GATE: Final = 16.0
_OTHER_GATE: Final = 9.0
#: How much of the gate in metres counts between different classes.
_OTHER_SHARE: Final = 0.4
#: The gain of a pair without any distance.
_GAIN: Final = 30.0
#: Scores count as probabilities from this one to 1 minus it.
_LEAST_SCORE: Final = 0.02
#: Detections that a track of another class needs before.
_OTHER_HITS: Final = 2


def associate(
    table: Floats,
    found: Floats,
    cost: Cost,
    min_iou: float,
    across_classes: bool,
    covariances: Covariances | None = None,
) -> tuple[Indices, Indices, Bools]:
    """Tracks and detections that belong together, (P,) each, and whether they have the same class.

    With the ``covariances`` of the tracks, these and those of the detections count instead of usual ones.
    """
    if not table.shape[1] or not found.shape[1]:
        nothing = np.empty(0, np.intp)
        return nothing, nothing, np.empty(0, bool)
    reach = table[GATE_M] * (1 + table[MISSED_S])
    pairs = Pairing(table[[X, Y]], found[[X, Y]], reach)
    apart = _Apart(table, found, covariances, pairs)
    same = pairs.of_first(table[CLASS]) == pairs.of_second(found[CLASS])
    near = apart.within(_GATE, reach)
    if across_classes:
        same = np.ones_like(same)
    track, row = _assigned(table, found, apart, near & same, cost, min_iou)
    is_same = np.ones(len(track), bool)
    if across_classes or len(row) == found.shape[1]:
        return track, row, is_same
    lost, free = table[HITS] >= _OTHER_HITS, np.ones(found.shape[1], bool)
    lost[track], free[row] = False, False
    if not lost.any() or len({*table[CLASS].tolist(), *found[CLASS].tolist()}) == 1:
        return track, row, is_same
    other = near & pairs.of_first(lost) & pairs.of_second(free)
    if not other.any():
        return track, row, is_same
    nearer = apart.within(_OTHER_GATE, np.maximum(_OTHER_SHARE * reach, 3 * table[NOISE]))
    more = _assigned(table, found, apart, other & nearer, cost, min_iou)
    is_same = np.concatenate([is_same, np.zeros(len(more[0]), bool)])
    return np.concatenate([track, more[0]]), np.concatenate([row, more[1]]), is_same


class _Apart:
    """Distances of detections (rows, N) from the predicted positions of tracks (rows, K), for each of their pairs."""

    def __init__(self, table: Floats, found: Floats, covariances: Covariances | None, pairs: Pairing) -> None:
        self.pairs = pairs
        x = pairs.of_second(found[X]) - pairs.of_first(table[X])
        y = pairs.of_second(found[Y]) - pairs.of_first(table[Y])
        self._squared = x * x + y * y
        self._spread = variance(table)
        self._deviations: Floats | None = None
        if covariances is not None:
            place = pairs.of_first(covariances.places())
            noise = pairs.of_first(measured(table[NOISE], found[:0]).T) + pairs.of_second(own_covariances(found).T)
            xx, xy, yy = place + noise
            #: Twice the log-odds that detections are true; their scores are probabilities.
            share = np.clip(np.where(np.isnan(found[SCORE]), 0.5, found[SCORE]), _LEAST_SCORE, 1 - _LEAST_SCORE)
            self._odds = 2 * np.log(share / (1 - share))
            self._area = xx * yy - xy * xy
            self._deviations = (yy * x * x - 2 * xy * x * y + xx * y * y) / self._area

    def within(self, gate: float, reach_m: Floats) -> Bools:
        """Whether pairs are within ``gate`` squared standard deviations, and ``reach_m`` of their track (K,)."""
        if self._deviations is None:
            return np.asarray(self._squared <= self.pairs.of_first(np.minimum(gate * self._spread, reach_m * reach_m)))
        return np.asarray((self._deviations <= gate) & (self._squared <= self.pairs.of_first(reach_m * reach_m)))

    def gain(self, which: Bools, track: Indices, row: Indices) -> Floats:
        """The gain of the chosen pairs (P,): twice the logarithm of their likelihood, but for a constant.

        Where detections have covariances it is twice that of a ratio: to the detection being false.
        """
        if self._deviations is None:
            s = self._spread[track]
            return np.asarray(_GAIN - self._squared[which] / s - 2 * np.log(s))
        return np.asarray(_GAIN - self._deviations[which] - np.log(self._area[which]) + self._odds[row])


def _assigned(
    table: Floats, found: Floats, apart: _Apart, allowed: Bools, cost: Cost, min_iou: float
) -> tuple[Indices, Indices]:
    """The best assignment of the allowed pairs."""
    track, row = apart.pairs.chosen(allowed)
    if not len(track):
        return track, row
    if cost == "iou":
        gain = bev_iou_of_pairs(table[BOX, track].T, found[BOX, row].T)
        good = gain >= max(min_iou, 1e-6)
        track, row, gain = track[good], row[good], gain[good]
    else:
        gain = apart.gain(allowed, track, row)
    if not len(track):
        return track, row
    (track, row), _ = max_weight_matching((track, row), np.round(gain, 6), apart.pairs.shape)
    return track, row
