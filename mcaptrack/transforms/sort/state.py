"""Detections and tracks as arrays: frames to measurements, the table of tracks, and tracks to frames.

Several frames are converted at once, because the overhead of NumPy calls is per call.

Letters: N detections in a frame, K tracks, F frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry import kalman
from mcaptrack.geometry.arrays import Bools, Floats, Indices
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.plane import Planes, plane_at
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
