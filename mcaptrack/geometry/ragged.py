"""Ragged arrays: groups of different lengths, laid end to end in one flat array. Letters: G groups, N members."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mcaptrack.geometry.arrays import Bools, Ints

__all__ = ["find_rows", "group_index", "ragged_range", "run_ends", "run_starts", "table_of"]


def group_index(counts: ArrayLike) -> Ints:
    """For each member the group it belongs to.

    Parameters
    ----------
    counts : (G,) of int
        Number of members of each group, 0 or more.

    Returns
    -------
    (N,) of int64
        0 ``counts[0]`` times, then 1 ``counts[1]`` times, and so on.

    Examples
    --------
    >>> group_index([2, 0, 3]).tolist()
    [0, 0, 2, 2, 2]
    """
    sizes = np.asarray(counts, np.int64)
    return np.repeat(np.arange(len(sizes)), sizes)


def ragged_range(starts: ArrayLike, counts: ArrayLike, step: int = 1) -> Ints:
    """Consecutive numbers for each group, all groups laid end to end.

    Parameters
    ----------
    starts : (G,) of int, or one int for all groups
        First number of each group.
    counts : (G,) of int
        The size of each group, 0 or more.
    step : int
        Difference between consecutive numbers of a group.

    Returns
    -------
    (N,) of int64
        ``starts[0], starts[0] + step, ...`` (``counts[0]`` numbers), then those of the next group.

    Examples
    --------
    >>> ragged_range([10, 20, 30], [2, 0, 3]).tolist()
    [10, 11, 30, 31, 32]
    >>> ragged_range(0, [2, 3]).tolist()
    [0, 1, 0, 1, 2]
    """
    sizes = np.asarray(counts, np.int64)
    before = np.cumsum(sizes) - sizes
    offset = np.asarray(starts, np.int64) - step * before
    return np.repeat(np.broadcast_to(offset, sizes.shape), sizes) + step * np.arange(int(sizes.sum()))


def gather_bytes(data: NDArray[np.uint8], at: Ints, sizes: Ints, to: Ints, out: NDArray[np.uint8]) -> None:
    """Copy pieces of bytes, of any sizes, without a loop over them; long ones are copied one by one.

    Parameters
    ----------
    data : (B,) of uint8
    at, sizes : (G,) of int64
        Where each piece begins in ``data``, and its bytes.
    to : (G,) of int64
        Where it begins in ``out``; pieces don't overlap there.
    out : (C,) of uint8

    Raises
    ------
    IndexError
        If a piece is not within ``data`` or ``out``.

    Examples
    --------
    >>> out = np.zeros(5, np.uint8)
    >>> gather_bytes(np.frombuffer(b"abcdef", np.uint8), np.array([4, 0]), np.array([2, 1]), np.array([0, 3]), out)
    >>> out.tolist() == [*b"ef", 0, *b"a", 0]
    True
    """
    if not len(sizes):
        return
    if at.min() < 0 or to.min() < 0 or (at + sizes).max() > len(data) or (to + sizes).max() > len(out):
        raise IndexError("a piece is not within the bytes")
    widest = int(sizes.max())
    if int(sizes.sum()) > _LONG * len(sizes):
        for begin, size, place in zip(at.tolist(), sizes.tolist(), to.tolist(), strict=True):
            out[place : place + size] = data[begin : begin + size]
    elif widest == sizes.min():
        if widest:
            _windows(out, widest)[to] = _windows(data, widest)[at]
    else:
        for bit in range(widest.bit_length()):  # a part of each piece for each bit of its size, the small ones first
            width = 1 << bit
            rows = np.flatnonzero(sizes & width)
            if len(rows):
                before = sizes[rows] & (width - 1)
                _windows(out, width)[to[rows] + before] = _windows(data, width)[at[rows] + before]


#: Longer pieces, on average, are copied one by one.
_LONG: Final = 2048


def _windows(data: NDArray[np.uint8], width: int) -> NDArray[np.void]:
    """So many bytes at each byte of ``data``, as a view."""
    return np.ndarray((len(data) - width + 1,), f"V{width}", data, 0, (1,))


def batches(counts: Ints, size: int) -> list[slice]:
    """Consecutive groups (G,) that have about ``size`` members together: all at once would take much memory.

    Examples
    --------
    >>> batches(np.array([2, 1, 3]), 3)
    [slice(0, 1, None), slice(1, 2, None), slice(2, 3, None)]
    """
    starts = np.flatnonzero(run_starts(np.cumsum(counts) // size))
    return [slice(low, high) for low, high in pairwise([*starts.tolist(), len(counts)])]


def find_rows(have: tuple[Ints, ...], wanted: tuple[Ints, ...]) -> Ints:
    """The row of ``have`` (N,) with the same keys as each of ``wanted`` (M,), the first of several; -1 for none.

    Examples
    --------
    >>> find_rows((np.array([3, 3, 5]), np.array([0, 1, 0])), (np.array([5, 3, 4]), np.array([0, 1, 1]))).tolist()
    [2, 1, -1]
    """
    count = len(have[0])
    key = np.zeros(count + len(wanted[0]), np.int64)
    for pair in zip(have, wanted, strict=True):
        names, number = np.unique(np.concatenate(pair), return_inverse=True)
        key = key * len(names) + number
    order = np.argsort(key[:count], kind="stable")
    place = np.searchsorted(key[:count][order], key[count:])
    row = np.append(order, -1)[place]
    return np.where((row >= 0) & (key[row] == key[count:]), row, -1)


def run_starts(*keys: NDArray[Any], times: Ints | None = None, max_gap: int = 0) -> Bools:
    """Mask the members where a run of equal keys begins: the first, and those with another key than the one before.

    Parameters
    ----------
    *keys : (N,) each
        Keys of the members, equal ones side by side.
    times : (N,) of int, optional
        A run also ends where the next member comes more than ``max_gap`` later.
    max_gap : int
        In the unit of ``times``.

    Returns
    -------
    (N,) of bool

    Examples
    --------
    >>> run_starts(np.array([4, 4, 7, 7, 4])).tolist()
    [True, False, True, False, True]
    >>> run_starts(np.array([1, 1, 1]), np.array([5, 6, 6])).tolist()
    [True, True, False]
    >>> run_starts(np.array([1, 1, 1]), times=np.array([0, 10, 21]), max_gap=10).tolist()
    [True, False, True]
    """
    starts = np.zeros(len(keys[0]), np.bool_)
    starts[:1] = True
    for key in keys:
        starts[1:] |= key[1:] != key[:-1]
    if times is not None:
        starts[1:] |= np.diff(times) > max_gap
    return starts


def run_ends(starts: Bools) -> Bools:
    """Mask the members where runs end, given where they begin (see ``run_starts``).

    Parameters
    ----------
    starts : (N,) of bool

    Returns
    -------
    (N,) of bool
        Whether each member is the last one of its run.

    Examples
    --------
    >>> run_ends(np.array([True, False, True])).tolist()
    [False, True, True]
    """
    return np.append(starts[1:], True)[: len(starts)]


def cross_pairs(a_counts: ArrayLike, b_counts: ArrayLike) -> tuple[Ints, Ints, Ints]:
    """All pairs of a member of one side with a member of the other, within each group.

    Members of each side are numbered through all groups, in the order of groups.

    Parameters
    ----------
    a_counts, b_counts : (G,) of int
        Number of members of each group on either side, 0 or more.

    Returns
    -------
    group, a, b : (P,) of int64 each
        Group and members of each pair, ordered by group, then by ``a``, then by ``b``.

    Examples
    --------
    >>> group, a, b = cross_pairs([1, 2], [2, 1])
    >>> list(zip(group.tolist(), a.tolist(), b.tolist()))
    [(0, 0, 0), (0, 0, 1), (1, 1, 2), (1, 2, 2)]
    """
    a_sizes, b_sizes = np.asarray(a_counts, np.int64), np.asarray(b_counts, np.int64)
    size = a_sizes * b_sizes
    group = group_index(size)
    within = ragged_range(0, size)
    local = within // b_sizes[group]
    a = (np.cumsum(a_sizes) - a_sizes)[group] + local
    b = (np.cumsum(b_sizes) - b_sizes)[group] + within - local * b_sizes[group]
    return group, a, b


def table_of(counts: ArrayLike) -> Ints:
    """The members of each group as the rows of a table.

    Parameters
    ----------
    counts : (G,) of int
        Number of members of each group, 0 or more.

    Returns
    -------
    (G, M) of int64
        Numbers of members, and -1 after those of a group that has fewer than M.

    Examples
    --------
    >>> table_of([2, 0, 3]).tolist()
    [[0, 1, -1], [-1, -1, -1], [2, 3, 4]]
    """
    sizes = np.asarray(counts, np.int64)
    within = np.arange(int(sizes.max(initial=0)))
    return np.where(within < sizes[:, None], (np.cumsum(sizes) - sizes)[:, None] + within, -1)
