"""One-to-one assignment. Letters: M rows (tracks, ground truth), N columns (detections, tracks), P pairs."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats

Pairs = tuple[NDArray[np.intp], NDArray[np.intp]]

#: Up to so many pairs, solving the whole is faster than finding the part that needs a solver.
_SMALL: Final = 600
#: Larger tables are not made: of so many rows and columns most pairs are no candidates.
LARGE_TABLE: Final = 2**20


def solve(cost: Floats) -> Pairs:
    """The assignment with the lowest total cost (M, N): the rows and columns of its min(M, N) pairs, rows rising."""
    if cost.shape[0] == 1 or cost.shape[1] == 1:  # common, and faster without the solver
        best = np.unravel_index(np.argmin(cost), cost.shape)
        return np.array([best[0]]), np.array([best[1]])
    rows, columns = _solver()(cost)
    return rows, columns


@cache
def _solver() -> Callable[[Floats], Pairs]:
    """SciPy's solver, imported when it is first needed."""
    from scipy.optimize import linear_sum_assignment

    return linear_sum_assignment  # type: ignore[no-any-return]


def assign(cost: Floats, gate: float) -> Pairs:
    """The largest set of pairs with a cost (M, N) of at most ``gate``, and of those sets the one with the lowest cost.

    Gating: pairs beyond the gate are excluded before solving, so a far pair can't take the place of a near one. NaN is
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
    # One forbidden pair must cost more than all allowed ones together.
    forbidden = (part[ok].max() - lowest + 1.0) * (min(part.shape) + 1)
    rows, columns = solve(np.where(ok, part - lowest, forbidden))
    kept = ok[rows, columns]
    return row_at[rows[kept]], column_at[columns[kept]]


def assign_by_gain(gain: Floats) -> Pairs:
    """The assignment with the largest total gain (M, N); pairs that gain nothing are left out."""
    if gain.size == 0:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    best = gain.argmax(axis=1)
    row = np.flatnonzero(gain[np.arange(len(best)), best] > 0)
    column = best[row]
    if len(column) == 0 or np.bincount(column).max() == 1:  # the best column of each row is free
        return row, column
    cost = np.maximum(gain, 0.0)
    rows, columns = solve(np.negative(cost, out=cost))  # in place: whole logs have large tables
    kept = gain[rows, columns] > 0
    return rows[kept], columns[kept]


def assign_pairs_by_gain(pairs: Pairs, gain: Floats, shape: tuple[int, int]) -> tuple[Pairs, Floats]:
    """The assignment with the largest total gain, of pairs (P,) with positive gains (P,) and no table of them.

    For large and sparse problems: memory grows with P + M, where that of ``assign_by_gain`` grows with M N. ``shape``
    is (M, N). Returns the pairs that were chosen and their gains.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import min_weight_full_bipartite_matching

    count, width = shape
    alone = np.arange(count)
    # Each row may also take a column of its own, which gains nothing. The solver wants all rows assigned, and takes 0
    # for no pair; so all gains are one higher.
    rows, columns = np.concatenate([pairs[0], alone]), np.concatenate([pairs[1], width + alone])
    graph = csr_array((np.append(gain, np.zeros(count)) + 1, (rows, columns)), shape=(count, width + count))
    row, column = min_weight_full_bipartite_matching(graph, maximize=True)
    row, column = row[column < width], column[column < width]
    place = pairs[0] * width + pairs[1]
    order = np.argsort(place, kind="stable")
    return (row, column), gain[order[np.searchsorted(place[order], row * width + column)]]


def one_to_one(rows: NDArray[np.intp], columns: NDArray[np.intp]) -> bool:
    """Whether no row and no column is in more than one pair."""
    return len(set(rows.tolist())) == len(rows) == len(set(columns.tolist()))


def max_weight_matching(pairs: Pairs, weight: Floats, shape: tuple[int, int]) -> tuple[Pairs, Floats]:
    """Choose from sparse candidate pairs (P,) a one-to-one matching with the largest total weight (P,).

    Weights are positive; ``shape`` is (M, N). Pairs that compete with no other are taken at once: only the rest needs
    the solver, however large the whole is. Returns the chosen pairs and their weights.
    """
    rows, columns = pairs
    if shape[0] * shape[1] <= _SMALL:
        return _solved(rows, columns, weight, shape)
    free = (np.bincount(rows)[rows] == 1) & (np.bincount(columns)[columns] == 1)
    if free.all():
        return pairs, weight
    left = np.flatnonzero(~free)
    row_names, row_at = _compact(rows[left])
    column_names, column_at = _compact(columns[left])
    (more_rows, more_columns), more = _solved(row_at, column_at, weight[left], (len(row_names), len(column_names)))
    chosen_rows = np.concatenate([rows[free], row_names[more_rows]])
    chosen_columns = np.concatenate([columns[free], column_names[more_columns]])
    return (chosen_rows, chosen_columns), np.concatenate([weight[free], more])


def _solved(
    rows: NDArray[np.intp], columns: NDArray[np.intp], weight: Floats, shape: tuple[int, int]
) -> tuple[Pairs, Floats]:
    """The pairs that the solver chooses among candidates (P,), and their weights."""
    if shape[0] * shape[1] > LARGE_TABLE:
        return assign_pairs_by_gain((rows, columns), weight, shape)
    dense = np.zeros(shape)
    dense[rows, columns] = weight
    chosen = solve(-dense)
    chosen_weight = dense[chosen]
    is_candidate = chosen_weight > 0
    return (chosen[0][is_candidate], chosen[1][is_candidate]), chosen_weight[is_candidate]


def _compact(numbers: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The unique values of small non-negative integers, rising, and the index of each among them."""
    occurs = np.zeros(int(numbers.max()) + 1, np.intp)
    occurs[numbers] = 1
    return occurs.nonzero()[0], (np.cumsum(occurs) - 1)[numbers]
