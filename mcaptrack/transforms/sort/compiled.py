"""SORT as one compiled loop over frames, for whoever runs it thousands of times; needs Numba.

The same arithmetic in the same order as in ``tracker``, ``tracks`` and ``kalman``, a number at a time. Rows of tables
are those of ``tracks``; columns of boxes those of ``Seen``.

Letters: N boxes in all frames, K tracks, F frames.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mcaptrack.geometry import kalman
from mcaptrack.transforms.sort.tracks import CLASS, ID, MISSED, SCORE, SHARED_ROWS, STREAK

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_NOISE: Final = kalman.NOISE.ravel().copy()
_R: Final = kalman.R.ravel().copy()
_START: Final = kalman.START.ravel().copy()
_LEAST_AREA: Final = kalman.LEAST_AREA
_OF: Final = np.array([0, 0, 1, 2])


@njit(cache=True)
def track(
    before: Floats, columns: Floats, ends: Ints, moments: Floats, min_iou: float, mix_classes: bool, next_id: int
) -> tuple[Floats, Floats, Ints, int]:
    """Take F frames: boxes (10, N), the frames' ends (F + 1,), and ``moments`` (8, F) as ``_Life.moment`` gives them.

    Returns the table of tracks (22, K) after them, the columns that are shown, their ends (F + 1,), and the next name.
    """
    table = np.empty((SHARED_ROWS, before.shape[1] + columns.shape[1]))
    count = before.shape[1]
    table[:, :count] = before
    shown = np.empty((SHARED_ROWS, columns.shape[1]))
    shown_ends = np.zeros(len(ends), np.int64)
    many = 0
    for frame in range(len(ends) - 1):
        low, high = ends[frame], ends[frame + 1]
        steps, stretch, age, frame_age, max_age, hit, min_hits, early = moments[:, frame]
        for k in range(count):
            if table[MISSED, k] != 0:
                table[STREAK, k] = 0.0
            table[MISSED, k] += age
        if steps > 1:
            count = _keep(table, count, max_age + frame_age)
        for k in range(count):
            if stretch != 1.0:
                for row in range(4):
                    table[4 + row, k] *= stretch
                for row in range(3):
                    table[11 + row, k] *= stretch
                    table[14 + row, k] *= stretch**2
            for _ in range(int(steps)):
                _predict(table, k)
        track_of = _pairs(table, count, columns[:, low:high], min_iou, mix_classes)
        for box in range(high - low):
            k = track_of[box]
            if k >= 0:
                _correct(table, k, columns, low + box)
                table[STREAK, k] += hit
            else:
                k = count
                count += 1
                table[:4, k] = columns[4:8, low + box]
                table[4:17, k] = _START
                table[STREAK, k] = 0.0
                table[ID, k] = next_id
                next_id += 1
            table[SCORE, k], table[CLASS, k] = columns[8, low + box], columns[9, low + box]
            table[MISSED, k] = 0.0
        oldest = 0.0
        for k in range(count):
            if table[MISSED, k] == 0 and (early != 0 or table[STREAK, k] >= min_hits):
                shown[:, many] = table[:, k]
                many += 1
            oldest = max(oldest, table[MISSED, k])
        shown_ends[frame + 1] = many
        if oldest > max_age:
            count = _keep(table, count, max_age)
    return table[:, :count].copy(), shown[:, :many].copy(), shown_ends, next_id


@njit(cache=True)
def _keep(table: Floats, count: int, oldest: float) -> int:
    """Forget tracks that have been missed for longer; returns how many are left, in their order at the front."""
    kept = 0
    for k in range(count):
        if table[MISSED, k] <= oldest:
            if kept != k:
                table[:, kept] = table[:, k]
            kept += 1
    return kept


@njit(cache=True)
def _predict(table: Floats, k: int) -> None:
    for row in range(4):
        table[row, k] += table[4 + row, k]
    if table[2, k] < _LEAST_AREA:
        table[2, k] -= table[6, k]
        table[6, k] = 0.0
    for row in range(3):
        table[8 + row, k] += table[11 + row, k]
        table[11 + row, k] += table[14 + row, k]
        table[8 + row, k] += table[11 + row, k]
    for row in range(9):
        table[8 + row, k] += _NOISE[row]


@njit(cache=True)
def _correct(table: Floats, k: int, columns: Floats, box: int) -> None:
    gain, gain_rate = np.empty(3), np.empty(3)
    for row in range(3):
        total = table[8 + row, k] + _R[row]
        gain[row], gain_rate[row] = table[8 + row, k] / total, table[11 + row, k] / total
    for row in range(4):
        off = columns[4 + row, box] - table[row, k]
        table[row, k] += gain[_OF[row]] * off
        table[4 + row, k] += gain_rate[_OF[row]] * off
    for row in range(3):
        table[14 + row, k] -= gain_rate[row] * table[11 + row, k]
        table[11 + row, k] -= gain[row] * table[11 + row, k]
        table[8 + row, k] -= gain[row] * table[8 + row, k]


@njit(cache=True)
def _pairs(table: Floats, count: int, boxes: Floats, least: float, mix_classes: bool) -> Ints:
    """The track of each box, -1 for none."""
    many = boxes.shape[1]
    track_of = np.full(many, -1)
    likeness = np.zeros((many, count))
    edges = np.empty((4, count))
    for k in range(count):
        wide = np.sqrt(table[2, k] * table[3, k])
        high = table[2, k] / wide
        wide, high = wide * 0.5, high * 0.5
        edges[0, k], edges[1, k] = table[0, k] - wide, table[1, k] - high
        edges[2, k], edges[3, k] = wide + table[0, k], high + table[1, k]
    rows, columns = np.zeros(many, np.int64), np.zeros(count, np.int64)
    close_rows, close_columns = np.zeros(many, np.int64), np.zeros(count, np.int64)
    near = False
    for box in range(many):
        for k in range(count):
            wide = min(boxes[2, box], edges[2, k]) - max(boxes[0, box], edges[0, k])
            if wide <= 0:
                continue
            high = min(boxes[3, box], edges[3, k]) - max(boxes[1, box], edges[1, k])
            if high <= 0 or (not mix_classes and boxes[9, box] != table[CLASS, k]):
                continue
            both = wide * high
            if both == 0:
                continue
            value = both / (boxes[6, box] + table[2, k] - both)
            likeness[box, k] = value
            rows[box] += 1
            columns[k] += 1
            if value > least:
                near = True
                close_rows[box] += 1
                close_columns[k] += 1
    if near and close_rows.max() <= 1 and close_columns.max() <= 1:
        for box in range(many):
            for k in range(count):
                if likeness[box, k] > least:
                    track_of[box] = k
        return track_of
    hard_rows, hard_columns = np.zeros(many, np.bool_), np.zeros(count, np.bool_)
    for box in range(many):
        for k in range(count):
            if likeness[box, k] > 0:
                if rows[box] == 1 and columns[k] == 1:
                    if likeness[box, k] >= least:
                        track_of[box] = k
                else:
                    hard_rows[box] = hard_columns[k] = True
    row_at, column_at = np.flatnonzero(hard_rows), np.flatnonzero(hard_columns)
    if len(row_at) == 0:
        return track_of
    turned = len(row_at) > len(column_at)
    a, b = (column_at, row_at) if turned else (row_at, column_at)
    cost = np.empty((len(a), len(b)))
    for i in range(len(a)):
        for j in range(len(b)):
            cost[i, j] = -likeness[b[j], a[i]] if turned else -likeness[a[i], b[j]]
    partner = _solve(cost)
    for i in range(len(a)):
        box, k = (b[partner[i]], a[i]) if turned else (a[i], b[partner[i]])
        if likeness[box, k] > 0 and likeness[box, k] >= least:
            track_of[box] = k
    return track_of


@njit(cache=True)
def _solve(cost: Floats) -> Ints:
    """The column of each row in the assignment of least total cost (M, N), M <= N: the Hungarian method."""
    rows, columns = cost.shape
    of_row, of_column = np.zeros(rows + 1), np.zeros(columns + 1)
    taken_by, way = np.zeros(columns + 1, np.int64), np.zeros(columns + 1, np.int64)
    for row in range(1, rows + 1):
        taken_by[0] = row
        at = 0
        least = np.full(columns + 1, np.inf)
        used = np.zeros(columns + 1, np.bool_)
        while True:
            used[at] = True
            who, delta, following = taken_by[at], np.inf, 0
            for column in range(1, columns + 1):
                if not used[column]:
                    reduced = cost[who - 1, column - 1] - of_row[who] - of_column[column]
                    if reduced < least[column]:
                        least[column] = reduced
                        way[column] = at
                    if least[column] < delta:
                        delta = least[column]
                        following = column
            for column in range(columns + 1):
                if used[column]:
                    of_row[taken_by[column]] += delta
                    of_column[column] -= delta
                else:
                    least[column] -= delta
            at = following
            if taken_by[at] == 0:
                break
        while at != 0:
            back = way[at]
            taken_by[at] = taken_by[back]
            at = back
    partner = np.empty(rows, np.int64)
    for column in range(1, columns + 1):
        if taken_by[column] > 0:
            partner[taken_by[column] - 1] = column - 1
    return partner
