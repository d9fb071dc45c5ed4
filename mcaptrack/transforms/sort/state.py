"""Detections and tracks as arrays: frames to measurements, the table of tracks, and tracks to frames.

Several frames are converted at once, because the overhead of NumPy calls is per call.

Letters: N detections in a frame, K tracks, F frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry import kalman
from mcaptrack.geometry.arrays import Bools, Floats, Indices
from mcaptrack.geometry.assignment import max_weight_matching, one_to_one
from mcaptrack.geometry.boxes import columns_to_boxes, overlapping
from mcaptrack.geometry.neighbours import Pairing
from mcaptrack.geometry.plane import GroundPlane, Planes, plane_at
from mcaptrack.schema import DETECTIONS, TRACKS, Frame
from mcaptrack.schema.framing import join_frames

#: Rows of the table of tracks, below those of the filter: score and class of the last detection; time since it (0 if it
#: is in this frame); how long the track has been detected without a miss; track id. ``tracker`` says the unit of time.
SCORE, CLASS, SINCE_UPDATE, HIT_STREAK, ID = range(kalman.STATE_ROWS, kalman.STATE_ROWS + 5)
#: Number of rows that all trackers have; a tracker may add its own below.
SHARED_ROWS: Final = ID + 1
#: Limits of boxes, so that areas and aspect ratios are finite.
_MIN_PX: Final = 1e-4
_MAX_PX: Final = 1e12


@dataclass(slots=True)
class Measurements:
    """Detections of a frame, one column each: left, top, right, bottom; the filter's measurement; score and class."""

    columns: Floats

    def __len__(self) -> int:
        return int(self.columns.shape[1])

    @property
    def corners(self) -> Floats:
        """Left, top, right, bottom (4, N)."""
        return self.columns[:4]

    @property
    def measured(self) -> Floats:
        """Measurements of the filter: centre, area and aspect ratio (4, N)."""
        return self.columns[4:8]

    @property
    def score(self) -> Floats:
        """Scores (N,), NaN where the detector gives none."""
        row: Floats = self.columns[8]
        return row

    @property
    def class_id(self) -> Floats:
        """Classes (N,)."""
        row: Floats = self.columns[9]
        return row

    def take(self, at: Indices) -> Measurements:
        """The detections with these indices, in this order."""
        return Measurements(self.columns.take(at, axis=1))


def frames_to_measurements(
    frames: Sequence[Frame], min_score: float | None, class_id: int | None
) -> tuple[Floats, NDArray[np.int64]]:
    """The detections of F frames with at least this score, or none, and of this class; degenerate boxes are left out.

    Returns the columns of ``Measurements`` for all frames, and the ends of each frame's columns (F + 1,), from 0.
    """
    joined = join_frames(DETECTIONS, frames)
    rows, ends = joined.rows, joined.ends
    boxes = columns_to_boxes(rows)
    kept = (boxes[:, 2:] > _MIN_PX).all(axis=1) & (np.abs(boxes) < _MAX_PX).all(axis=1)
    if min_score is not None:
        kept &= ~(rows["score"] < min_score)
    if class_id is not None:
        kept &= rows["class_id"] == class_id
    if not kept.all():
        ends = np.concatenate([[0], kept.cumsum()])[ends]
        rows, boxes = rows[kept], boxes[kept]
    boxes = boxes.T
    columns = np.concatenate(
        [boxes[:2], boxes[:2] + boxes[2:], kalman.measure(boxes), [rows["score"]], [rows["class_id"]]]
    )
    return columns, ends


class Tracks:
    """K tracks, one column of ``table`` each: the filter's state, the rows named above, then ``extra_rows``."""

    def __init__(self, extra_rows: int = 0) -> None:
        self.table: Floats = np.empty((SHARED_ROWS + extra_rows, 0))

    def __len__(self) -> int:
        return int(self.table.shape[1])

    @property
    def state(self) -> Floats:
        """The states of the filters (17, K); writing to it writes to the tracks."""
        return self.table[: kalman.STATE_ROWS]

    def keep(self, kept: Bools) -> None:
        """Terminate all other tracks."""
        self.table = self.table.compress(kept, axis=1)  # rows stay whole in memory, unlike with [:, kept]

    def initiate(self, first_id: int, detections: Measurements) -> None:
        """Start a track at each of these detections, with ids from ``first_id``."""
        new = np.empty((len(self.table), len(detections)))
        kalman.start(new[: kalman.STATE_ROWS], detections.measured)
        new[SCORE : CLASS + 1] = detections.columns[8:]
        new[SINCE_UPDATE : HIT_STREAK + 1] = 0.0
        new[ID] = range(first_id, first_id + len(detections))
        new[SHARED_ROWS:] = np.nan
        self.table = np.concatenate([self.table, new], axis=1)

    def update(self, at: Indices, detections: Measurements, hit: float) -> None:
        """Correct track ``at[i]`` with detection i (N,); its hit streak grows by ``hit``."""
        table = self.table.take(at, axis=1)
        kalman.correct(table[: kalman.STATE_ROWS], detections.measured)
        table[SCORE : CLASS + 1] = detections.columns[8:]
        table[SINCE_UPDATE] = 0.0
        table[HIT_STREAK] += hit
        self.table[:, at] = table


def tracks_to_frames(frames: Sequence[Frame], table: Floats, ends: Sequence[int], planes: Planes) -> list[Frame]:
    """Rows of F frames from columns of a table, of which ``ends`` (F + 1,) are the ends of each frame's columns."""
    boxes = kalman.corners(table)
    boxes[2:] -= boxes[:2]
    rows = TRACKS.empty(table.shape[1])
    rows["track_id"] = table[ID]
    rows["x_px"], rows["y_px"], rows["w_px"], rows["h_px"] = boxes
    rows["x_m"] = rows["y_m"] = np.nan
    rows["score"] = table[SCORE]
    rows["observed"] = True
    rows["source_id"] = -1
    rows["class_id"] = table[CLASS]
    spans = list(pairwise(ends))
    if planes:
        for frame, (low, high) in zip(frames, spans, strict=True):
            plane = plane_at(planes, frame.t_ns)
            if plane is not None and low < high:
                rows["x_m"][low:high], rows["y_m"][low:high] = plane.boxes_to_metres(boxes[:, low:high].T).T
    return [Frame(frame.t_ns, frame.index, rows[low:high]) for frame, (low, high) in zip(frames, spans, strict=True)]


# Candidate pairs of detections and tracks, and their assignment. Letters: N detections, K tracks, P pairs.


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
    here, predicted_at = (_positions(corners, plane) for corners in (boxes, predicted))
    pairs = Pairing(here, predicted_at, np.full(here.shape[1], gate))
    distance = np.hypot(*(pairs.of_first(here) - pairs.of_second(predicted_at)))
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
        by_class = [
            associate(alone.select(pairs.class_id == kind), min_similarity) for kind in np.unique(pairs.class_id)
        ]
        detections, tracks = zip(*by_class, strict=True)
        return np.concatenate(detections), np.concatenate(tracks)
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
