"""Rows that wait: a row is written once it is known whether its track is one, and gaps are closed meanwhile.

Letters: K tracks, N rows, F frames that wait.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mcaptrack.geometry.angles import wrapped
from mcaptrack.geometry.arrays import Floats, Ints
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


class _Gaps(NamedTuple):
    """Tracks (K,) that are detected again at a frame: their table before and after, (rows, K); the first frame of each
    gap, (K,), and the frame and the time at which they are detected.
    """

    before: Floats
    after: Floats
    first: Floats
    frame: int
    now_ns: int


class Waiting:
    """Frames and their rows that are not written yet. Frames are numbered from 0.

    ``add``, ``close_gaps`` and ``confirm`` tell what happens at one frame, ``release`` ends it; ``written`` gives
    frames for many of them at once.
    """

    def __init__(self) -> None:
        # The frames that are not written yet, the rows of tracks that were detected in each, and those in gaps.
        self._frames: list[Frame] = []
        self._rows: list[Floats] = []
        self._late, self._late_in = np.empty((_ROWS, 0)), np.empty(0, np.int64)
        self._gaps: list[_Gaps] = []
        # The number of frames that were written and released so far; when each of those between was released, which is
        # counted in calls of ``release``.
        self._written = self._released = 0
        self._released_at: list[int] = []
        self._calls = 0
        # By id: what a track is written as, and since when it is confirmed.
        self._written_as, self._since = np.zeros(256, np.int64), np.zeros(256, np.int64)

    def confirm(self, ids: Floats, written_as: Floats) -> None:
        """Tracks of these ids (K,) are confirmed: their rows are written under other ids (K,), also those before."""
        if len(ids):
            while ids.max() >= len(self._written_as):
                self._written_as = np.concatenate([self._written_as, np.zeros_like(self._written_as)])
                self._since = np.concatenate([self._since, np.zeros_like(self._since)])
            self._written_as[ids.astype(np.int64)] = written_as
            self._since[ids.astype(np.int64)] = self._calls

    def add(self, frame: Frame, tracks: Floats) -> None:
        """Add a frame with the rows of the tracks that were detected in it, as of their table (rows, K)."""
        rows = np.empty((_ROWS, tracks.shape[1]))
        rows[:DETECTION_ROWS] = tracks[:DETECTION_ROWS]
        rows[_OBSERVED], rows[_ID] = 1.0, tracks[ID]
        self._frames.append(frame)
        self._rows.append(rows)

    def close_gaps(self, before: Floats, after: Floats, frame: int, now_ns: int) -> None:
        """Interpolate tracks that are detected again, (rows, K) before and after: rows for the frames before ``frame``.

        ``now_ns`` is the time of this frame. Frames that were released already get none.
        """
        first = np.maximum(before[LAST_FRAME] + 1, self._released)
        (missed,) = (first < frame).nonzero()
        if len(missed):
            both = before.take(missed, axis=1), after.take(missed, axis=1)
            self._gaps.append(_Gaps(*both, first[missed], frame, now_ns))

    def release(self, until_ns: float) -> None:
        """Let frames up to a time be written, with the rows of the tracks that are confirmed by now."""
        while len(self._released_at) < len(self._frames):
            if self._frames[len(self._released_at)].t_ns > until_ns:
                break
            self._released_at.append(self._calls)
            self._released += 1
        self._calls += 1

    def written(self) -> list[Frame]:
        """The frames that were released since the last call: frames of Tracks, rows ordered by id within each."""
        if self._gaps:
            self._interpolate()
        count = len(self._released_at)
        frames, self._frames = self._frames[:count], self._frames[count:]
        own, self._rows = self._rows[:count], self._rows[count:]
        waits = self._late_in >= self._released
        rows = np.concatenate([self._late.compress(~waits, axis=1), *own], axis=1)
        number = np.append(self._late_in[~waits] - self._written, group_index([part.shape[1] for part in own]))
        self._late, self._late_in = self._late.compress(waits, axis=1), self._late_in[waits]
        ids = rows[_ID].astype(np.int64)
        written_id = np.minimum(ids, len(self._written_as) - 1)
        is_in_time = (ids == written_id) & (self._since[written_id] <= np.array(self._released_at, np.int64)[number])
        rows[_ID] = np.where(is_in_time, self._written_as[written_id], 0)
        self._written, self._released_at = self._released, []
        kept = rows[_ID] > 0
        return _to_frames(frames, rows.compress(kept, axis=1), number[kept])

    def _interpolate(self) -> None:
        """Make the rows in gaps."""
        before, after, first = (
            np.concatenate(parts, axis=-1) for parts in zip(*(gaps[:3] for gaps in self._gaps), strict=True)
        )
        times = np.array([gaps[3:] for gaps in self._gaps], np.int64)
        frame, now_ns = times.T.repeat([len(gaps.first) for gaps in self._gaps], axis=1)
        self._gaps = []
        count = frame - first.astype(np.int64)
        track, number = group_index(count), ragged_range(first, count)
        before, after = before.take(track, axis=1), after.take(track, axis=1)
        t_ns = np.array([frame.t_ns for frame in self._frames], np.int64)[number - self._written]
        ahead_s = (now_ns[track] - t_ns) / NS_PER_S
        share = 1 - ahead_s / np.maximum(before[MISSED_S], 1e-9)
        rows = np.empty((_ROWS, len(track)))
        rows[:DETECTION_ROWS] = after[:DETECTION_ROWS]
        start, end = before[LAST], after[BOX]
        step = end - start
        step[HEADING] = wrapped(step[HEADING])
        rows[BOX] = start + share * step
        rows[HEADING] = wrapped(rows[HEADING])
        rows[[VX, VY]] = before[[VX, VY]] * (1 - share) + after[[VX, VY]] * share
        rows[SCORE], rows[SOURCE] = np.nan, -1.0
        rows[_OBSERVED], rows[_ID] = 0.0, after[ID]
        self._late = np.concatenate([self._late, rows], axis=1)
        self._late_in = np.append(self._late_in, number)


def _to_frames(frames: Sequence[Frame], table: Floats, number: Ints) -> list[Frame]:
    """Frames of Tracks, of rows (rows, N) and the index of the frame of each (N,)."""
    table = table.take(np.lexsort((table[_ID], number)), axis=1)
    out = TRACKS.empty(table.shape[1])
    for name, row in _COLUMNS.items():
        out[name] = table[row]
    ends = np.cumsum(np.bincount(number, minlength=len(frames)))
    return split_rows([f.t_ns for f in frames], [f.index for f in frames], out, ends)
