"""Pairs of points that are near each other, and how far apart they are. Letters: N points, P pairs."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.ragged import cross_pairs, group_index, ragged_range

#: Points of a group from which on only neighbours are compared.
_MANY: Final = 256
#: Pairs that are compared at once, to limit memory.
_PAIRS_AT_ONCE: Final = 2**18
#: Larger tables of pairs are not made.
_LARGE_TABLE: Final = 2**20


def near_pairs(group: Ints, xy: Floats, distance: float) -> tuple[Ints, Ints]:
    """Pairs of points of the same group that are nearer to each other than a distance.

    Of many points only those of neighbouring cells are compared (see ``touching_pairs``).

    Parameters
    ----------
    group : (N,) of int
        Group of each point, such as the number of its frame.
    xy : (N, 2)
        Positions, in any unit.
    distance : float
        In the same unit; points that are exactly so far apart are no pair.

    Returns
    -------
    first, second : (P,) of int64 each
        Each pair once, in no particular order.

    Examples
    --------
    >>> first, second = near_pairs(np.array([5, 5, 6]), np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]), 2.0)
    >>> first.tolist(), second.tolist()
    ([0], [1])
    """
    if np.unique(group, return_counts=True)[1].max(initial=0) > _MANY:
        reach = distance * (0.5 + 1e-9)
        around = np.concatenate([xy - reach, xy + reach], axis=1)
        first, second = touching_pairs(around, around, group, group)
        once = first < second
        first, second = first[once], second[once]
        near = ((xy[first] - xy[second]) ** 2).sum(axis=1) < distance**2
        return first[near], second[near]
    order = np.argsort(group, kind="stable")
    in_order = group[order]
    firsts, seconds = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for offset in range(1, len(order)):
        same = in_order[offset:] == in_order[:-offset]
        if not same.any():
            break
        a, b = order[:-offset][same], order[offset:][same]
        near = ((xy[a] - xy[b]) ** 2).sum(axis=1) < distance**2
        firsts.append(a[near])
        seconds.append(b[near])
    return np.concatenate(firsts), np.concatenate(seconds)


def touching_pairs(a: Floats, b: Floats, a_group: Ints, b_group: Ints) -> tuple[Ints, Ints]:
    """Pairs of rectangles of the same group that overlap or touch.

    The plane is divided into cells of the size of usual rectangles, and only rectangles that reach into the same cell
    are compared: memory and time grow with the rectangles and with how many lie on each other, not with their square.

    Parameters
    ----------
    a, b : (M, 4) and (N, 4)
        Left, top, right and bottom, in any unit; rectangles without a finite edge touch nothing.
    a_group, b_group : (M,) and (N,) of int
        Group of each rectangle, such as the number of its frame.

    Returns
    -------
    first, second : (P,) of int64 each
        Indices into ``a``, rising, and into ``b``, rising within one of ``a``.

    Examples
    --------
    >>> boxes, group = np.array([[0.0, 0.0, 2.0, 2.0], [1.0, 1.0, 3.0, 3.0]]), np.array([7, 7])
    >>> first, second = touching_pairs(boxes[:1], boxes, group[:1], group)
    >>> first.tolist(), second.tolist()
    ([0, 0], [0, 1])
    """
    a_at, b_at = (np.flatnonzero(np.isfinite(part).all(axis=1)) for part in (a, b))
    a, b, a_group, b_group = a[a_at], b[b_at], a_group[a_at], b_group[b_at]
    if not len(a) or not len(b):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    low = np.minimum(a[:, :2].min(axis=0), b[:, :2].min(axis=0))
    extent = np.maximum(a[:, 2:].max(axis=0), b[:, 2:].max(axis=0)) - low
    usual = np.maximum(*(np.median(part[:, 2:] - part[:, :2], axis=0) for part in (a, b)))
    # At most as many cells as rectangles: one that covers all then is listed no more often than all others.
    most = max(1, math.isqrt(max(len(a), len(b))))
    count = np.clip(extent / np.maximum(usual, 1e-9), 1, most).astype(np.int64)
    cell = np.maximum(extent / count, 1e-300)
    _, of = np.unique(np.concatenate([a_group, b_group]), return_inverse=True)
    sides = [_cells(part, numbers, low, cell, count) for part, numbers in ((a, of[: len(a)]), (b, of[len(a) :]))]
    (a_key, a_row), (b_key, b_row) = sides
    keys = np.intersect1d(a_key, b_key)
    a_low, b_low = a_key.searchsorted(keys), b_key.searchsorted(keys)
    a_count, b_count = a_key.searchsorted(keys, "right") - a_low, b_key.searchsorted(keys, "right") - b_low
    pairs = [(np.empty(0, np.int64), np.empty(0, np.int64))]
    part_of = np.cumsum(a_count * b_count) // _PAIRS_AT_ONCE
    for part in np.split(np.arange(len(keys)), np.flatnonzero(np.diff(part_of)) + 1):
        key, left, right = cross_pairs(a_count[part], b_count[part])
        first = a_row[ragged_range(a_low[part], a_count[part])[left]]
        second = b_row[ragged_range(b_low[part], b_count[part])[right]]
        corner = np.maximum(a[first, :2], b[second, :2])
        meet = (corner <= np.minimum(a[first, 2:], b[second, 2:])).all(axis=1)
        # Each pair once: in the cell that holds the left upper corner of what both share.
        first, second, key = first[meet], second[meet], keys[part][key[meet]]
        own = _key(_cell(corner[meet], low, cell, count), of[first], count) == key
        pairs.append((first[own], second[own]))
    first, second = (np.concatenate(side) for side in zip(*pairs, strict=True))
    order = np.lexsort((second, first))
    return a_at[first[order]], b_at[second[order]]


class Pairing:
    """Pairs of M points with N others: a table (M, N) of all, or of very many points only of those within reach, (P,).

    Formulas on ``of_first`` and ``of_second`` are the same for both.

    Parameters
    ----------
    first, second : (2, M) and (2, N)
        Positions, in any unit.
    reach : (M,)
        In the same unit; points of ``second`` that are farther away are no pair, or one that the caller leaves out.
    """

    def __init__(self, first: Floats, second: Floats, reach: Floats) -> None:
        self.shape = (first.shape[1], second.shape[1])
        self._pairs: tuple[Ints, Ints] | None = None
        if self.shape[0] * self.shape[1] > _LARGE_TABLE:
            around = np.clip(np.nan_to_num(reach, nan=0.0), 0, 1e9) * (1 + 1e-9)
            boxes = np.concatenate([first - around, first + around]).T
            groups = (np.zeros(count, np.int64) for count in self.shape)
            self._pairs = touching_pairs(boxes, np.concatenate([second, second]).T, *groups)

    def of_first(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values (..., M) of the first points, for each pair."""
        return values[..., None] if self._pairs is None else values[..., self._pairs[0]]

    def of_second(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values (..., N) of the others, for each pair."""
        return values[..., None, :] if self._pairs is None else values[..., self._pairs[1]]

    def chosen(self, which: Bools) -> tuple[Ints, Ints]:
        """The points of the pairs that a mask chooses, ordered by the first ones."""
        if self._pairs is None:
            first, second = np.nonzero(which)
            return first, second
        return self._pairs[0][which], self._pairs[1][which]


def _cell(xy: Floats, low: Floats, cell: Floats, count: Ints) -> Ints:
    return np.clip((xy - low) / cell, 0, count - 1).astype(np.int64)


def _key(at: Ints, group: Ints, count: Ints) -> Ints:
    return np.asarray((group * count[1] + at[..., 1]) * count[0] + at[..., 0])


def _cells(boxes: Floats, group: Ints, low: Floats, cell: Floats, count: Ints) -> tuple[Ints, Ints]:
    """The keys of all cells that rectangles (N, 4) reach into, rising, and the rectangle of each."""
    first, last = _cell(boxes[:, :2], low, cell, count), _cell(boxes[:, 2:], low, cell, count)
    wide, tall = (last - first + 1).T
    size = np.maximum(wide, 0) * np.maximum(tall, 0)  # of those with negative sizes no cell
    row, within = group_index(size), ragged_range(0, size)
    at = first[row] + np.stack([within % wide[row], within // wide[row]], axis=1)
    key = _key(at, group[row], count)
    order = np.argsort(key, kind="stable")
    return key[order], row[order]


def squared_sigmas(x: Floats, y: Floats, xx: Floats, xy: Floats, yy: Floats) -> Floats:
    """Squared Mahalanobis distances (P,) of differences x and y, each with its covariance xx, xy, yy, (P,) each."""
    out: Floats = (yy * x * x - 2 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
    return out
