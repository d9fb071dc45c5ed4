"""Find what rows can't hold, whether a package or a user gave them. Letters: N rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools, Ints
from mcaptrack.schema import BOX_PX, DETECTIONS, EVENTS, PLACE_M, PREDICTIONS, SIZES, TRACKS, EventKind, Rows, Schema

_COVARIANCE: Final = ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2")
_MIXTURE: Final = ("wide_weight", "narrow_scale", "wide_scale")
_PLACE_PX: Final = ("x_px", "y_px")
#: A covariance may be out of what is possible by its last digits.
_LAST_DIGITS: Final = 1e-6

Fault = tuple[int, str] | None


def first_impossible(schema: Schema, rows: Rows, frame: Ints | None = None) -> Fault:
    """Find a row that is impossible: its number, and its problem in words; None if all rows are possible.

    ``frame`` (N,) numbers the frame of each row; without it all rows are of one frame. Numbers of a user's own schema
    may be anything.
    """
    if schema.is_own:
        return None
    for name in rows.dtype.names or ():
        if rows.dtype[name].kind == "f" and (row := _first(np.isinf(rows[name]))) is not None:
            return row, f"{name} is infinite"
        if name in SIZES and (row := _first(rows[name] < 0)) is not None:
            return row, f"{name} is {rows[name][row]:g}; sizes are not below 0"
    frame = np.zeros(len(rows), np.int64) if frame is None else frame
    return _CHECKS[schema](rows, frame) if schema in _CHECKS else None


def _detections(rows: Rows, _frame: Ints) -> Fault:
    """A row with neither a box nor a position, or with a part of one."""
    if fault := _in_part(rows, (BOX_PX, PLACE_M)):
        return fault
    row = _first(np.isnan(rows[BOX_PX[0]]) & np.isnan(rows[PLACE_M[0]]))
    return None if row is None else (row, "there is neither a box nor a position")


def _tracks(rows: Rows, frame: Ints) -> Fault:
    """A row that is no detection, or with an id that is negative or stands in an earlier row of its frame, too."""
    if fault := _detections(rows, frame) or _below(rows, "track_id", 0):
        return fault
    if (row := _first(_repeated(frame, rows["track_id"]))) is None:
        return None
    track_id = rows["track_id"][row]
    count = int(((rows["track_id"] == track_id) & (frame == frame[row])).sum())
    return row, f"track_id {track_id} stands in {count} rows of one frame; a track has one"


def _predictions(rows: Rows, frame: Ints) -> Fault:
    """A row of no step after the one before, or with a covariance or a mixture that can't be one."""
    if fault := _below(rows, "track_id", 0) or _in_part(rows, (_COVARIANCE, _MIXTURE)):
        return fault
    order = np.lexsort((rows["step"], rows["track_id"], frame))
    track, of, step, ahead_s = rows["track_id"][order], frame[order], rows["step"][order], rows["ahead_s"][order]
    follows = np.append(False, (np.diff(track) == 0) & (np.diff(of) == 0))[: len(rows)]
    before = np.append(0, step[:-1])[: len(rows)].astype(np.int64)
    if (at := _first(step != np.where(follows, before + 1, 1))) is not None:
        wanted = before[at] + 1 if follows[at] else 1
        return int(order[at]), f"step {step[at]} of track {track[at]} stands where {wanted} is due; steps are 1, 2, ..."
    since_s = np.where(follows, np.append(0.0, ahead_s[:-1])[: len(rows)], 0.0)
    if (at := _first(ahead_s <= since_s)) is not None:
        return int(order[at]), f"ahead_s is {ahead_s[at]:g}, not after {since_s[at]:g}; later steps are further ahead"
    xx, xy, yy = (rows[name].astype(np.float64) for name in _COVARIANCE)
    if (row := _first((xx < 0) | (yy < 0) | (xy**2 > xx * yy * (1 + _LAST_DIGITS)))) is not None:
        return row, f"cov_xx_m2, cov_xy_m2, cov_yy_m2 are {xx[row]:g}, {xy[row]:g}, {yy[row]:g}: no covariance"
    weight, narrow, wide = (rows[name] for name in _MIXTURE)
    if (row := _first((weight < 0) | (weight > 1) | (narrow <= 0) | (wide <= 0))) is not None:
        values = f"{weight[row]:g}, {narrow[row]:g}, {wide[row]:g}"
        return row, f"{', '.join(_MIXTURE)} are {values}; a weight is from 0 to 1, and scales are above 0"
    return None


def _events(rows: Rows, _frame: Ints) -> Fault:
    """A row of an unknown kind, with an id or a duration that is negative, or with a part of a place."""
    if (row := _first(~np.isin(rows["kind"], list(EventKind)))) is not None:
        kinds = ", ".join(f"{kind:d} {kind.name.lower()}" for kind in EventKind)
        return row, f"kind is {rows['kind'][row]}; kinds are {kinds}"
    for name in ("track_id", "truth_id", "previous_id", "source_id"):
        if fault := _below(rows, name, -1):
            return fault
    return _in_part(rows, (PLACE_M, _PLACE_PX)) or _below(rows, "duration_s", 0)


#: What rows of a schema can't be; N rows of frames (N,).
_CHECKS: Final[Mapping[Schema, Callable[[Rows, Ints], Fault]]] = {
    DETECTIONS: _detections,
    TRACKS: _tracks,
    PREDICTIONS: _predictions,
    EVENTS: _events,
}


def _in_part(rows: Rows, groups: Sequence[tuple[str, ...]]) -> Fault:
    """The first row that has some columns of a group but not all."""
    for group in groups:
        missing = np.isnan([rows[name] for name in group])
        if (row := _first(np.asarray(missing.any(axis=0) & ~missing.all(axis=0)))) is not None:
            return row, f"there is only a part of {', '.join(group)}"
    return None


def _below(rows: Rows, name: str, least: int) -> Fault:
    """The first row with a value below the least one."""
    row = _first(rows[name] < least)
    if row is None:
        return None
    what = "ids are" if name.endswith("_id") else "it is"
    return row, f"{name} is {rows[name][row]}; {what} not below {least}"


def _repeated(frame: Ints, track_id: NDArray[np.int64]) -> Bools:
    """Which rows (N,) have the id of an earlier row of their frame."""
    order = np.lexsort((track_id, frame))
    again = np.zeros(len(track_id), bool)
    again[order[1:]] = (np.diff(frame[order]) == 0) & (np.diff(track_id[order]) == 0)
    return again


def _first(wrong: NDArray[np.bool_]) -> int | None:
    return int(wrong.argmax()) if wrong.any() else None
