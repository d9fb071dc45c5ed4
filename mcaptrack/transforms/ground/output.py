"""Rows that wait: a row is written once it is known whether its track is one, and gaps are closed meanwhile.

Letters: K tracks, N rows, F frames that wait.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence

import numpy as np

from mcaptrack.geometry.angles import wrapped
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.ragged import group_index, ragged_range
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.framing import split_rows
from mcaptrack.transforms.ground.state import (
    BOX,
    CLASS,
    DETECTION_ROWS,
    HEADING,
    HEIGHT,
    ID,
    LAST,
    LAST_FRAME,
    LENGTH,
    MISSED_S,
    SCORE,
    SOURCE,
    VX,
    VY,
    WIDTH,
    X,
    Y,
    Z,
)

_OBSERVED, _ID = DETECTION_ROWS, DETECTION_ROWS + 1
_ROWS = DETECTION_ROWS + 2
#: Columns of tracks by the row that they come from.
_COLUMNS = {
    "x_m": X,
    "y_m": Y,
    "z_m": Z,
    "length_m": LENGTH,
    "width_m": WIDTH,
    "height_m": HEIGHT,
    "heading_rad": HEADING,
    "vx_m_per_s": VX,
    "vy_m_per_s": VY,
    "score": SCORE,
    "class_id": CLASS,
    "source_id": SOURCE,
    "observed": _OBSERVED,
    "track_id": _ID,
}


class Waiting:
    """Frames and their rows that are not written yet. Frames are numbered from 0."""

    def __init__(self) -> None:
        self._frames: deque[tuple[Frame, list[Floats]]] = deque()
        self._first = 0
        self._written_as = np.zeros(256, np.int64)

    def confirm(self, ids: Floats, written_as: Floats) -> None:
        """Tracks of these ids (K,) are confirmed: their rows are written under other ids (K,), also those before."""
        if len(ids):
            while ids.max() >= len(self._written_as):
                self._written_as = np.concatenate([self._written_as, np.zeros_like(self._written_as)])
            self._written_as[ids.astype(np.int64)] = written_as

    def add(self, frame: Frame, tracks: Floats) -> None:
        """Add a frame with the rows of the tracks that were detected in it, as of their table (rows, K)."""
        rows = np.empty((_ROWS, tracks.shape[1]))
        rows[:DETECTION_ROWS] = tracks[:DETECTION_ROWS]
        rows[_OBSERVED], rows[_ID] = 1.0, tracks[ID]
        self._frames.append((frame, [rows]))

    def close_gaps(self, before: Floats, after: Floats, frame: int, now_ns: int) -> None:
        """Interpolate tracks that are detected again, (rows, K) before and after: rows for the frames before ``frame``.

        ``now_ns`` is the time of this frame. Frames that were written already get none.
        """
        low = np.maximum(before[LAST_FRAME].astype(np.int64) + 1, self._first)
        count = np.maximum(frame - low, 0)
        if not count.any():
            return
        track, at = group_index(count), ragged_range(low, count)
        ahead_s = np.array([now_ns - waits.t_ns for waits, _ in self._frames]) / NS_PER_S
        share = 1 - ahead_s[at - self._first] / np.maximum(before[MISSED_S, track], 1e-9)
        rows = np.empty((_ROWS, len(track)))
        rows[:DETECTION_ROWS] = after[:DETECTION_ROWS, track]
        start, end = before[LAST, track], after[BOX, track]
        step = end - start
        step[HEADING] = wrapped(step[HEADING])
        rows[BOX] = start + share * step
        rows[HEADING] = wrapped(rows[HEADING])
        rows[[VX, VY]] = before[[VX, VY]][:, track] * (1 - share) + after[[VX, VY]][:, track] * share
        rows[SCORE], rows[SOURCE] = np.nan, -1.0
        rows[_OBSERVED], rows[_ID] = 0.0, after[ID, track]
        for number in np.unique(at).tolist():
            self._frames[number - self._first][1].append(rows[:, at == number])

    def due(self, until_ns: float) -> Iterator[tuple[Frame, Floats]]:
        """Frames up to a time, and the rows of confirmed tracks in each."""
        while self._frames and self._frames[0][0].t_ns <= until_ns:
            frame, parts = self._frames.popleft()
            self._first += 1
            rows = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
            ids = rows[_ID].astype(np.int64)
            known = np.minimum(ids, len(self._written_as) - 1)
            rows[_ID] = np.where(ids == known, self._written_as[known], 0)
            yield frame, rows.compress(rows[_ID] > 0, axis=1)


def rows_to_frames(parts: Sequence[tuple[Frame, Floats]]) -> list[Frame]:
    """Frames of Tracks; rows are ordered by id within each."""
    counts = [rows.shape[1] for _, rows in parts]
    table = np.concatenate([rows for _, rows in parts], axis=1) if parts else np.empty((_ROWS, 0))
    table = table[:, np.lexsort((table[_ID], group_index(counts)))]
    out = TRACKS.empty(table.shape[1])
    for name, row in _COLUMNS.items():
        out[name] = table[row]
    frames = [frame for frame, _ in parts]
    return split_rows([f.t_ns for f in frames], [f.index for f in frames], out, np.cumsum(counts))
