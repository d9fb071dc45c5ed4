"""Candidate pairs of detections and tracks, and their assignment. Letters: N detections, K tracks, P pairs."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Indices
from mcaptrack.geometry.assignment import max_weight_matching, one_to_one
from mcaptrack.geometry.boxes import overlapping
from mcaptrack.geometry.neighbours import Pairing
from mcaptrack.geometry.plane import GroundPlane

Cost = Literal["iou", "pixels", "metres"]


class CandidatePairs(NamedTuple):
    """Pairs that pass the gate: detection (P,), track (P,), similarity (P,) in (0, 1]; ``shape`` is (N, K).

    ``class_id`` (P,) are their classes, None if all are associated together.
    """

    detection: Indices
    track: Indices
    similarity: Floats
    shape: tuple[int, int]
    class_id: Floats | None = None

    def select(self, kept: Bools | Indices) -> CandidatePairs:
        """Some of the pairs."""
        of = None if self.class_id is None else self.class_id[kept]
        return CandidatePairs(self.detection[kept], self.track[kept], self.similarity[kept], self.shape, of)


def iou_pairs(boxes: Floats, predicted: Floats, area: Floats, predicted_area: Floats) -> CandidatePairs:
    """Pairs of detected boxes (4, N) and predicted ones (4, K) that overlap; their similarity is IoU.

    Boxes are left, top, right, bottom; areas are (N,) and (K,).
    """
    return CandidatePairs(*overlapping(boxes, predicted, area, predicted_area), (boxes.shape[1], predicted.shape[1]))


def distance_pairs(boxes: Floats, predicted: Floats, gate: float, plane: GroundPlane | None) -> CandidatePairs:
    """Pairs by the distance of centres in pixels or, given a plane, of positions on the ground in metres.

    Similarity is 1 at distance 0 and falls to 0 at the gate; gating excludes pairs beyond it.
    """
    here, there = (_positions(corners, plane) for corners in (boxes, predicted))
    pairs = Pairing(here, there, np.full(here.shape[1], gate))
    distance = np.hypot(*(pairs.of_first(here) - pairs.of_second(there)))
    is_near = distance < gate  # NaN, above the horizon, is beyond every gate
    return CandidatePairs(*pairs.chosen(is_near), 1 - distance[is_near] / gate, pairs.shape)


def _positions(corners: Floats, plane: GroundPlane | None) -> Floats:
    if plane is None:
        return (corners[:2] + corners[2:]) / 2
    return plane.boxes_to_metres(np.concatenate([corners[:2], corners[2:] - corners[:2]]).T).T


def associate(pairs: CandidatePairs, min_similarity: float) -> tuple[Indices, Indices]:
    """Assign detections to tracks; returns the detections and the tracks of pairs of at least ``min_similarity``.

    If no detection and no track is in two pairs, these are the assignment. Otherwise the assignment with the largest
    total similarity is taken, and pairs below ``min_similarity`` are removed afterwards, as in the original program.

    Each class is associated by itself, as if there were no others.
    """
    if not len(pairs.detection):
        return pairs.detection, pairs.track
    if pairs.class_id is not None:
        alone = pairs._replace(class_id=None)
        found = [associate(alone.select(pairs.class_id == one), min_similarity) for one in np.unique(pairs.class_id)]
        return np.concatenate([one for one, _ in found]), np.concatenate([one for _, one in found])
    above = pairs.similarity > min_similarity
    count = np.count_nonzero(above)
    if count:
        near = pairs if count == len(above) else pairs.select(above)
        if one_to_one(near.detection, near.track):
            return near.detection, near.track
    (detection, track), similarity = max_weight_matching((pairs.detection, pairs.track), pairs.similarity, pairs.shape)
    if count == len(above):
        return detection, track
    enough = similarity >= min_similarity
    return detection[enough], track[enough]
