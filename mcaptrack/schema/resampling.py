"""Resample tracks to other times, by linear interpolation between the rows before and after.

Letters: N rows in, F frames in, T times, S rows out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import wrapped
from mcaptrack.geometry.clocks import LAST_NS
from mcaptrack.geometry.ragged import group_index, ragged_range, run_ends, run_starts
from mcaptrack.schema import TRACKS, Frame, Rows, framing
from mcaptrack.schema.framing import frame_times, join_frames, row_ends

#: The columns of a track that are interpolated, and those that are angles.
_LINEAR: Final = (
    *("x_px", "y_px", "w_px", "h_px", "x_m", "y_m", "score"),
    *("z_m", "length_m", "width_m", "height_m", "vx_m_per_s", "vy_m_per_s"),
)
_ANGLES: Final = ("heading_rad",)
#: A step longer than this many median frame intervals is a gap: rows in it are not observed.
_MAX_STEP: Final = 1.5


def resample(frames: Sequence[Frame], at_ns: Ints, max_gap_ns: int, usual_ns: float | None = None) -> tuple[Rows, Ints]:
    """Resample tracks to the times ``at_ns``.

    Parameters
    ----------
    frames : sequence of Frame
        Rows of tracks. Only those near the times are read.
    at_ns : (T,) of int64
        Sorted times in nanoseconds.
    max_gap_ns : int
        Rows of one id are interpolated if they are at most this far apart.
    usual_ns : float, optional
        The usual time between two frames, by default the median; a longer one is a gap.

    Returns
    -------
    rows : (S,) structured array
        Rows of tracks, sorted by time and id, one for each of these. Rows at one of the times are unchanged (of several
        of one id the last); ``observed`` is false in gaps.
    at : (S,) of int64
        Index of the time of each row in ``at_ns``.
    """
    t_ns, first, last = frame_times(frames), 0, len(frames)
    usual_ns = interval_ns(t_ns) if usual_ns is None else usual_ns
    if len(at_ns):  # a row that is farther away is not linked over any of the times
        first = int(np.searchsorted(t_ns, max(int(at_ns[0]) - max_gap_ns, 0), "left"))
        last = int(np.searchsorted(t_ns, min(int(at_ns[-1]) + max_gap_ns, LAST_NS), "right"))
    joined = join_frames(TRACKS, frames, first, last)
    order = np.lexsort((joined.row_ns, joined.rows["track_id"]))
    rows, row_ns = joined.rows.take(order), joined.row_ns[order]
    has_next = ~run_ends(run_starts(rows["track_id"]))
    step_ns = np.append(np.diff(row_ns), 0)[: len(rows)]
    is_replaced = has_next & (step_ns == 0)  # the last row of an id at a time counts
    is_linked = has_next & (step_ns > 0) & (step_ns <= max_gap_ns)
    low = np.searchsorted(at_ns, row_ns, "left")
    until = np.searchsorted(at_ns, np.where(is_linked, row_ns + step_ns, row_ns), "left")
    high = np.where(is_linked, until, np.searchsorted(at_ns, row_ns, "right"))
    count = np.where(is_replaced, 0, high - low)

    before, at = group_index(count), ragged_range(low, count)
    after = before + is_linked[before]
    span = np.where(is_linked, step_ns, 1)[before]
    share = (at_ns[at] - row_ns[before]) / span

    start, end = rows.take(before), rows.take(after)
    out = between(start, end, share)
    is_seen = start["observed"] & end["observed"] & (span <= _MAX_STEP * usual_ns)
    out["observed"] = np.where(share == 0, start["observed"], is_seen)
    order = np.lexsort((out["track_id"], at))
    return out.take(order), at[order].astype(np.int64)


def between(before: Rows, after: Rows, share: Floats) -> Rows:
    """Copies of rows of tracks (S,), moved by a ``share`` (S,) of the way to others; a share of 0 changes nothing."""
    out = before.copy()
    for name in _LINEAR:
        start, end = before[name], after[name]
        out[name] = np.where(share == 0, start, start + share * (end - start))
    for name in _ANGLES:
        start, end = before[name], after[name]
        out[name] = np.where(share == 0, start, wrapped(start + share * wrapped(end - start)))
    return out


def resample_parts(frames: Sequence[Frame], at_ns: Ints, max_gap_ns: int) -> Iterator[tuple[int, int, Rows, Ints]]:
    """Resample tracks as ``resample`` does, to some of the times at once: all rows may take more than the memory.

    Parameters
    ----------
    frames, at_ns, max_gap_ns
        As for ``resample``.

    Yields
    ------
    first, last : int
        The times ``at_ns[first:last]``; the first ones first.
    rows, at
        What ``resample`` returns for these times; ``at`` are indices in ``at_ns``.
    """
    usual_ns, total = interval_ns(frame_times(frames)), int(row_ends(frames)[-1])
    most = max(total, round(total / max(len(frames), 1) * len(at_ns)))
    cuts = (
        np.linspace(0, len(at_ns), max(min(-(-most // framing.PART_ROWS), len(at_ns)), 1) + 1).astype(np.int64).tolist()
    )
    for first, last in pairwise(cuts):
        out, at = resample(frames, at_ns[first:last], max_gap_ns, usual_ns)
        yield first, last, out, at + first


def interval_ns(t_ns: Ints) -> float:
    """The usual time between two frames at these times: the median."""
    return float(np.median(np.diff(t_ns))) if len(t_ns) > 1 else 0.0


def is_observed_at(frame_ns: Ints, at_ns: Ints, max_gap_ns: int) -> NDArray[np.bool_]:
    """At which of the times ``at_ns`` (T,) there are observations: at a frame, or between two without a gap."""
    if len(frame_ns) == 0:
        return np.zeros(len(at_ns), bool)
    before = np.searchsorted(frame_ns, at_ns, "right") - 1
    after = np.searchsorted(frame_ns, at_ns, "left")
    inside = (before >= 0) & (after < len(frame_ns))
    gap = frame_ns[np.minimum(after, len(frame_ns) - 1)] - frame_ns[np.maximum(before, 0)]
    return inside & (gap <= max_gap_ns)
