"""ByteTrack (Zhang et al., ECCV 2022): boxes that a detector doubts go on with tracks, but begin none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mcaptrack.geometry.arrays import Bools, Indices
from mcaptrack.transforms.protocol import option
from mcaptrack.transforms.sort.affinity import pair
from mcaptrack.transforms.sort.tracker import Moment, Sort
from mcaptrack.transforms.sort.tracks import MISSED, Seen


@dataclass(frozen=True, kw_only=True)
class ByteTrack(Sort):
    """ByteTrack: association in two steps.

    Detections with a high score are matched with all tracks first, then those with a low score with the remaining
    tracks that were detected in the previous frame: people who are partly hidden score low, but stand where predicted.
    """

    high_score: float = option(
        0.5, "detections with at least this score, or without a score, are matched first", search=(0.2, 0.9)
    )
    new_score: float = option(0.6, "detections with at least this score may begin a track", search=(0.2, 0.9))
    low_min_iou: float = option(
        0.5,
        "least overlap (IoU) for detections with a low score, which are matched second",
        least=0.0,
        most=1.0,
        search=(0.2, 0.8),
    )

    def _pair(self, moment: Moment) -> tuple[Indices, Indices]:
        pairs, least = self._likeness(moment, self.min_iou)
        high = ~(moment.seen.score < self.high_score)
        if high.all():
            return pair(pairs, least)
        sure = high[pairs.box]
        box, track = pair(pairs.where(sure), least)
        left = moment.tracks.table[MISSED] == moment.age  # seen in the frame before
        left[track] = False
        rest = pairs.where(~sure & left[pairs.track])
        low_box, low_track = pair(rest, self.low_min_iou if self.cost == "iou" else least)
        return np.concatenate([box, low_box]), np.concatenate([track, low_track])

    def _may_begin(self, seen: Seen) -> Bools:
        begins: Bools = ~(seen.score < self.new_score)
        return begins
