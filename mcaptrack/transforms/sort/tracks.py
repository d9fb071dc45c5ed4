"""What frames show, what is remembered of tracks, and how both become arrays and frames again.

Frames are read and written several at a time: what a call of NumPy costs is then shared.

Letters: N boxes in a frame, K tracks, F frames.
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

#: Rows of a table of tracks, below those of the filter: score and class of the last box; how long the track has been
#: missed, 0 if it was just seen; how long it has been seen without a break; its name.
SCORE, CLASS, MISSED, STREAK, ID = range(kalman.STATE_ROWS, kalman.STATE_ROWS + 5)
#: How many rows every tracker's table has; a tracker may add its own below.
SHARED_ROWS: Final = ID + 1
#: What can be a box: numbers whose areas and ratios are numbers.
_LEAST_PX: Final = 1e-4
_MOST_PX: Final = 1e12


@dataclass(slots=True)
class Seen:
    """The boxes of a frame, a column each: left, top, right, bottom; what the filter measures; score and class."""

    columns: Floats

    def __len__(self) -> int:
        return int(self.columns.shape[1])

    @property
    def corners(self) -> Floats:
        """Left, top, right, bottom (4, N)."""
        return self.columns[:4]

    @property
    def measured(self) -> Floats:
        """Centre, area and ratio (4, N)."""
        return self.columns[4:8]

    @property
    def score(self) -> Floats:
        """Scores (N,), NaN where there is none."""
        row: Floats = self.columns[8]
        return row

    @property
    def class_id(self) -> Floats:
        """Classes (N,)."""
        row: Floats = self.columns[9]
        return row

    def take(self, at: Indices) -> Seen:
        """The boxes ``at`` these places, in this order."""
        return Seen(self.columns.take(at, axis=1))


def look(frames: Sequence[Frame], min_score: float | None, class_id: int | None) -> tuple[Floats, NDArray[np.int64]]:
    """What F frames show: boxes that are neither empty nor beyond all measure, that score enough and are of the class.

    A box without a score passes. Returns the columns of ``Seen`` for all frames, and where those of each begin and end
    (F + 1,).
    """
    joined = join_frames(DETECTIONS, frames)
    rows, ends = joined.rows, joined.ends
    boxes = columns_to_boxes(rows)
    kept = (boxes[:, 2:] > _LEAST_PX).all(axis=1) & (np.abs(boxes) < _MOST_PX).all(axis=1)
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
    """K tracks, a column each of ``table``: the filter's state first, then the rows named above, then ``more``."""

    def __init__(self, more: int = 0) -> None:
        self.table: Floats = np.empty((SHARED_ROWS + more, 0))

    def __len__(self) -> int:
        return int(self.table.shape[1])

    @property
    def state(self) -> Floats:
        """The states of the filters (17, K); writing to it writes to the tracks."""
        return self.table[: kalman.STATE_ROWS]

    def keep(self, kept: Bools) -> None:
        """Forget all other tracks."""
        self.table = self.table.compress(kept, axis=1)  # rows stay whole in memory, unlike with [:, kept]

    def add(self, first_id: int, seen: Seen) -> None:
        """Tracks that begin with these boxes, named ``first_id`` and on."""
        new = np.empty((len(self.table), len(seen)))
        kalman.start(new[: kalman.STATE_ROWS], seen.measured)
        new[SCORE : CLASS + 1] = seen.columns[8:]
        new[MISSED : STREAK + 1] = 0.0
        new[ID] = range(first_id, first_id + len(seen))
        new[SHARED_ROWS:] = np.nan
        self.table = np.concatenate([self.table, new], axis=1)

    def see(self, at: Indices, seen: Seen, hit: float) -> None:
        """Track ``at[i]`` is seen in box i (N,); its streak grows by ``hit``."""
        table = self.table.take(at, axis=1)
        kalman.correct(table[: kalman.STATE_ROWS], seen.measured)
        table[SCORE : CLASS + 1] = seen.columns[8:]
        table[MISSED] = 0.0
        table[STREAK] += hit
        self.table[:, at] = table


def write(frames: Sequence[Frame], table: Floats, ends: Sequence[int], planes: Planes) -> list[Frame]:
    """The columns of a table that are shown in F frames, ``ends`` (F + 1,) of each, as rows of these frames."""
    boxes = kalman.corners(table)
    boxes[2:] -= boxes[:2]
    rows = TRACKS.empty(table.shape[1])
    rows["track_id"] = table[ID]
    rows["x_px"], rows["y_px"], rows["w_px"], rows["h_px"] = boxes
    rows["x_m"] = rows["y_m"] = np.nan
    rows["score"] = table[SCORE]
    rows["observed"] = True
    rows["source_id"] = -1
    spans = list(pairwise(ends))
    if planes:
        for frame, (low, high) in zip(frames, spans, strict=True):
            plane = plane_at(planes, frame.t_ns)
            if plane is not None and low < high:
                rows["x_m"][low:high], rows["y_m"][low:high] = plane.boxes_to_metres(boxes[:, low:high].T).T
    return [Frame(frame.t_ns, frame.index, rows[low:high]) for frame, (low, high) in zip(frames, spans, strict=True)]
