"""ByteTrack (Zhang et al., ECCV 2022): detections with a low score continue tracks, but start none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mcaptrack.geometry.arrays import Bools, Indices
from mcaptrack.transforms.protocol import parameters, setting
from mcaptrack.transforms.sort.tracker import SINCE_UPDATE, AssociationInput, Measurements, Sort, associate


@dataclass(frozen=True, kw_only=True)
@parameters
class ByteTrack(Sort):
    """ByteTrack: association in two steps.

    Detections with a high score are matched with all tracks first, then those with a low score with the remaining
    tracks that were detected in the previous frame: people who are partly hidden score low, but stand where predicted.

    Parameters
    ----------
    high_score : float
        Detections with at least this score, or without a score, are matched first.
    new_score : float
        Detections with at least this score may begin a track.
    low_min_iou : float
        Least overlap (IoU) for detections with a low score, which are matched second.

    Examples
    --------
    A detection with a low score continues a track, and starts none:

    >>> from mcaptrack.schema import DETECTIONS, Frame
    >>> def row(score):
    ...     box = {"x_px": [100.0], "y_px": [50.0], "w_px": [40.0], "h_px": [120.0]}
    ...     return DETECTIONS.rows(score=[score], class_id=[1], **box)
    >>> frames = [Frame(t * 100_000_000, t, row(0.9 if 5 <= t < 10 else 0.3)) for t in range(15)]
    >>> [len(tracks.rows) for (tracks,) in ByteTrack()(frames)]
    [0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1]

    References
    ----------
    Y. Zhang et al., "ByteTrack: Multi-Object Tracking by Associating Every Detection Box", ECCV 2022.
    """

    high_score: float = setting(0.5, search=(0.2, 0.9))
    new_score: float = setting(0.6, search=(0.2, 0.9))
    low_min_iou: float = setting(0.5, least=0.0, most=1.0, search=(0.2, 0.8))

    def _associate(self, step: AssociationInput) -> tuple[Indices, Indices]:
        pairs, min_similarity = self._candidate_pairs(step, self.min_iou)
        high = ~(step.detections.score < self.high_score)  # NaN is high
        if high.all():
            return associate(pairs, min_similarity)
        is_high = high[pairs.detection]
        detection, track = associate(pairs.select(is_high), min_similarity)
        remaining = step.tracks.table[SINCE_UPDATE] == step.age  # detected in the previous frame
        remaining[track] = False
        low = pairs.select(~is_high & remaining[pairs.track])
        low_detection, low_track = associate(low, self.low_min_iou if self.cost == "iou" else min_similarity)
        return np.concatenate([detection, low_detection]), np.concatenate([track, low_track])

    def _can_start(self, detections: Measurements) -> Bools:
        starts: Bools = ~(detections.score < self.new_score)
        return starts
