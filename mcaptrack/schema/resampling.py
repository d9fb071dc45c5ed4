"""Tracks at other times: a row for everybody who is there, on the straight line between the rows before and after.

Letters: N rows in, F frames in, T times, S rows out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Ints
from mcaptrack.schema import TRACKS, Frame, Rows

#: The columns of a track that change steadily.
LINEAR: Final = ("x_px", "y_px", "w_px", "h_px", "x_m", "y_m", "score")
#: A step longer than this many usual frame intervals is a hole: what lies inside was not seen.
_HOLE: Final = 1.5


def resample(frames: Sequence[Frame], at_ns: Ints, max_hole_ns: int) -> tuple[Rows, Ints]:
    """The rows of tracks, brought to the rising times ``at_ns`` (T,).

    Inside one id a row is interpolated where its neighbours are at most ``max_hole_ns`` apart; a row at one of the
    times stays as it is. ``observed`` is false inside holes. Returns S rows ordered by time and id, and which time each
    belongs to (S,).
    """
    frame_ns = np.array([frame.t_ns for frame in frames], np.int64)
    usual_ns = float(np.median(np.diff(frame_ns))) if len(frames) > 1 else 0.0
    rows = TRACKS.joined([frame.rows for frame in frames])
    row_ns = np.repeat(frame_ns, [len(frame.rows) for frame in frames])
    order = np.lexsort((row_ns, rows["track_id"]))
    rows, row_ns = rows[order], row_ns[order]
    same = np.append(rows["track_id"][1:] == rows["track_id"][:-1], False)[: len(rows)]
    step_ns = np.append(np.diff(row_ns), 0)[: len(rows)]
    goes_on = same & (step_ns > 0) & (step_ns <= max_hole_ns)
    low = np.searchsorted(at_ns, row_ns, "left")
    until = np.searchsorted(at_ns, np.where(goes_on, row_ns + step_ns, row_ns), "left")
    high = np.where(goes_on, until, np.searchsorted(at_ns, row_ns, "right"))
    count = high - low

    before = np.repeat(np.arange(len(rows)), count)
    at = np.arange(len(before)) - np.repeat(np.cumsum(count) - count, count) + low[before]
    after = before + goes_on[before]
    span = np.where(goes_on, step_ns, 1)[before]
    share = (at_ns[at] - row_ns[before]) / span

    out = rows[before].copy()
    for name in LINEAR:
        start, end = rows[name][before], rows[name][after]
        out[name] = np.where(share == 0, start, start + share * (end - start))
    between = rows["observed"][before] & rows["observed"][after] & (span <= _HOLE * usual_ns)
    out["observed"] = np.where(share == 0, rows["observed"][before], between)
    order = np.lexsort((out["track_id"], at))
    return out[order], at[order].astype(np.int64)


def looked_at(frame_ns: Ints, at_ns: Ints, max_hole_ns: int) -> NDArray[np.bool_]:
    """At which of the times ``at_ns`` (T,) somebody looked: at a frame, or between two that are no hole apart."""
    if len(frame_ns) == 0:
        return np.zeros(len(at_ns), bool)
    before = np.searchsorted(frame_ns, at_ns, "right") - 1
    after = np.searchsorted(frame_ns, at_ns, "left")
    inside = (before >= 0) & (after < len(frame_ns))
    gap = frame_ns[np.minimum(after, len(frame_ns) - 1)] - frame_ns[np.maximum(before, 0)]
    return inside & (gap <= max_hole_ns)
