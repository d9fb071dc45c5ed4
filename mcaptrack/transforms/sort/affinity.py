"""What makes a box and a track alike, and which go together. Letters: N boxes, K tracks, P pairs that are possible."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Indices
from mcaptrack.geometry.assignment import max_weight_matching, one_to_one
from mcaptrack.geometry.boxes import overlapping
from mcaptrack.geometry.plane import GroundPlane

Cost = Literal["iou", "pixels", "metres"]
COSTS: tuple[Cost, ...] = get_args(Cost)


class Pairs(NamedTuple):
    """Possible pairs: which box (P,), which track (P,), how alike (P,): above 0, at most 1. Of ``shape`` (N, K)."""

    box: Indices
    track: Indices
    likeness: Floats
    shape: tuple[int, int]

    def where(self, kept: Bools | Indices) -> Pairs:
        """Some of the pairs."""
        return Pairs(self.box[kept], self.track[kept], self.likeness[kept], self.shape)


def by_overlap(boxes: Floats, expected: Floats, area: Floats, expected_area: Floats) -> Pairs:
    """Pairs by the overlap of boxes (4, N) with tracks' expected boxes (4, K), both left, top, right, bottom.

    Their areas are (N,) and (K,).
    """
    return Pairs(*overlapping(boxes, expected, area, expected_area), (boxes.shape[1], expected.shape[1]))


def by_distance(boxes: Floats, expected: Floats, gate: float, plane: GroundPlane | None) -> Pairs:
    """Pairs by the distance of centres in pixels or, given a plane, of where the boxes stand in metres.

    Likeness is 1 at no distance and falls to 0 at the gate; gating excludes pairs beyond it.
    """
    here, there = (_places(corners, plane) for corners in (boxes, expected))
    apart = np.hypot(here[0][:, None] - there[0][None, :], here[1][:, None] - there[1][None, :])
    box, track = np.nonzero(apart < gate)  # NaN, above the horizon, is beyond every gate
    return Pairs(box, track, 1 - apart[box, track] / gate, (len(apart), apart.shape[1]))


def _places(corners: Floats, plane: GroundPlane | None) -> Floats:
    if plane is None:
        return (corners[:2] + corners[2:]) / 2
    return plane.boxes_to_metres(np.concatenate([corners[:2], corners[2:] - corners[:2]]).T).T


def pair(pairs: Pairs, least: float) -> tuple[Indices, Indices]:
    """Which boxes and tracks go together, at least ``least`` alike.

    Where no box and no track has a choice there is nothing to weigh. Otherwise the whole is paired for the largest
    total likeness, and pairs that are too little alike are let go afterwards, as the original program does.
    """
    if not len(pairs.box):
        return pairs.box, pairs.track
    close = pairs.likeness > least
    count = np.count_nonzero(close)
    if count:
        near = pairs if count == len(close) else pairs.where(close)
        if one_to_one(near.box, near.track):
            return near.box, near.track
    (box, track), likeness = max_weight_matching((pairs.box, pairs.track), pairs.likeness, pairs.shape)
    if count == len(close):
        return box, track
    enough = likeness >= least
    return box[enough], track[enough]
