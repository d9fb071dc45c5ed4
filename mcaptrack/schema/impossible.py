"""Find what rows of detections and tracks can't hold, whether a package or a user gave them. Letters: N rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mcaptrack.schema import BOX_PX, DETECTIONS, PLACE_M, SIZES, TRACKS, Rows, Schema


def first_impossible(schema: Schema, rows: Rows, frame: NDArray[np.int64] | None = None) -> tuple[int, str] | None:
    """Find a row that is impossible: its number, and its problem in words; None if all rows are possible.

    ``frame`` (N,) numbers the frame of each row; without it all rows are of one frame.
    """
    for name in rows.dtype.names or ():
        if rows.dtype[name].kind == "f" and (row := _first(np.isinf(rows[name]))) is not None:
            return row, f"{name} is infinite"
        if name in SIZES and (row := _first(rows[name] < 0)) is not None:
            return row, f"{name} is {rows[name][row]:g}; sizes are not below 0"
    if schema in (DETECTIONS, TRACKS):
        has_any = np.zeros(len(rows), bool)
        for group in (BOX_PX, PLACE_M):
            missing = np.isnan([rows[name] for name in group])
            if (row := _first(np.asarray(missing.any(axis=0) & ~missing.all(axis=0)))) is not None:
                return row, f"there is only a part of {', '.join(group)}"
            has_any |= ~missing[0]
        if (row := _first(~has_any)) is not None:
            return row, "there is neither a box nor a position"
    return _repeated(rows, frame) if schema is TRACKS else None


def _repeated(rows: Rows, frame: NDArray[np.int64] | None) -> tuple[int, str] | None:
    """The first row of tracks with an id that is negative, or that an earlier row of its frame has."""
    track_id = rows["track_id"]
    if (row := _first(track_id < 0)) is not None:
        return row, f"track_id is {track_id[row]}; ids are not below 0"
    frame = np.zeros(len(rows), np.int64) if frame is None else frame
    order = np.lexsort((track_id, frame))
    again = np.zeros(len(rows), bool)
    again[order[1:]] = (np.diff(frame[order]) == 0) & (np.diff(track_id[order]) == 0)
    if (row := _first(again)) is None:
        return None
    count = int(((track_id == track_id[row]) & (frame == frame[row])).sum())
    return row, f"track_id {track_id[row]} stands in {count} rows of one frame; a track has one"


def _first(wrong: NDArray[np.bool_]) -> int | None:
    return int(wrong.argmax()) if wrong.any() else None
