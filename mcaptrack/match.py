"""Assignment: who goes with whom. Letters: M rows (tracks, truth), N columns (observations, tracks)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Pairs = tuple[NDArray[np.intp], NDArray[np.intp]]


def solve(cost: Floats) -> Pairs:
    """The assignment of least total cost (M, N); the rows and columns of its min(M, N) pairs, rows rising."""
    if cost.shape[0] == 1 or cost.shape[1] == 1:  # common, and not worth a solver
        best = np.unravel_index(np.argmin(cost), cost.shape)
        return np.array([best[0]]), np.array([best[1]])
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(cost)
    return rows, columns


def assign(cost: Floats, gate: float) -> Pairs:
    """The largest set of pairs with a cost (M, N) of at most ``gate``, and of those sets the one of least total cost.

    Pairs beyond the gate are no pairs: they take no part, so a far pair can't take a place from a near one. NaN is
    beyond every gate.
    """
    allowed = cost <= gate
    rows_with, columns_with = allowed.any(axis=1), allowed.any(axis=0)
    if not rows_with.any():
        return np.empty(0, np.intp), np.empty(0, np.intp)
    if (allowed.sum(axis=0) <= 1).all() and (allowed.sum(axis=1) <= 1).all():
        rows, columns = np.nonzero(allowed)
        return rows, columns
    row_at, column_at = np.flatnonzero(rows_with), np.flatnonzero(columns_with)
    part, ok = cost[np.ix_(row_at, column_at)], allowed[np.ix_(row_at, column_at)]
    lowest = part[ok].min()
    # One forbidden pair must weigh more than all allowed ones together.
    forbidden = (part[ok].max() - lowest + 1.0) * (min(part.shape) + 1)
    rows, columns = solve(np.where(ok, part - lowest, forbidden))
    kept = ok[rows, columns]
    return row_at[rows[kept]], column_at[columns[kept]]
