"""Putting together what belongs to one person: ends of tracks and later beginnings, over the whole log at once.

A link is judged from both sides: how likely the first rows of the later track are for who was in the earlier one, and
how likely the last rows of the earlier one are for who is in the later one, walking back; each against somebody new.
Where links are judged pair by pair the best set of them is one assignment of ends to beginnings.

Letters: K tracks, E links, N rows, R rows that are looked at.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.transforms.retrack.follow import pairs
from mcaptrack.transforms.retrack.motion import Paths, State, Walker

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

#: How many rows on the other side of a hole are looked at.
_ROWS: Final = 5
#: What a second of hole costs, and how fast people are at most in one.
_PER_S: Final = 0.5
_REACH_M_PER_S: Final = 2.5


def link(
    walker: Walker,
    paths: Paths,
    forward: State,
    backward: State,
    step_s: float,
    max_hole_s: float,
    cap: float,
    odds: Floats,
) -> Ints:
    """For each track the one that goes on from it, or -1; (K,).

    ``cap`` is what a link may cost, in squared standard deviations as ``Evidence`` counts; ``odds`` (K,) are the log
    odds that a track is of a person, and count where they are against it.
    """
    first, last = paths.first[:-1], paths.first[1:] - 1
    begins, ends = paths.step[first], paths.step[last]
    count = len(first)
    follows = np.full(count, -1)
    order = np.argsort(begins, kind="stable")
    low = np.searchsorted(begins[order], ends + 1)
    high = np.searchsorted(begins[order], ends + round(max_hole_s / step_s) + 1, "right")
    many = high - low
    i = np.repeat(np.arange(count), many)
    j = order[np.arange(len(i)) - np.repeat(np.cumsum(many) - many, many) + low[i]]
    hole_s = (begins[j] - ends[i]) * step_s
    apart = np.hypot(*(forward.mean[last[i], :2] - backward.mean[first[j], :2]).T)
    near = apart <= 1.0 + _REACH_M_PER_S * hole_s
    i, j, hole_s = i[near], j[near], hole_s[near]
    if len(i) == 0:
        return follows
    ahead = _evidence(walker, paths, forward.take(last[i]), first[j], 1, hole_s, step_s)
    back = backward.take(first[j])
    behind = _evidence(walker, paths, State(back.mean * [1, 1, -1, -1], back.cov), last[i], -1, hole_s, step_s)
    fresh = _fresh(walker, paths, first, 1, step_s)[j] + _fresh(walker, paths, last, -1, step_s)[i]
    against = np.minimum(odds, 0.0)
    # The sum of both sides is twice their mean, as `cap` is twice a log likelihood.
    gain = ahead + behind - fresh + cap - _PER_S * hole_s + against[i] + against[j]
    good = gain > 0
    i, j, gain = i[good], j[good], gain[good]
    for group in _components(i, j, count):
        who, them = np.unique(i[group]), np.unique(j[group])
        table = np.full((len(who), len(them)), -1.0)
        table[np.searchsorted(who, i[group]), np.searchsorted(them, j[group])] = np.round(gain[group], 6)
        row, column = pairs(table)
        follows[who[row]] = them[column]
    return follows


def _components(i: Ints, j: Ints, count: int) -> list[Ints]:
    """The edges of each connected component of a graph from ends ``i`` to beginnings ``j``."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(i)), (i, count + j)), shape=(2 * count, 2 * count))
    _, label = connected_components(graph, directed=False)
    order = np.argsort(label[i], kind="stable")
    bounds = np.flatnonzero(np.diff(label[i][order])) + 1
    return list(np.split(order, bounds)) if len(order) else []


def _evidence(
    walker: Walker, paths: Paths, state: State, start: Ints, way: int, hole_s: Floats, step_s: float
) -> Floats:
    """Log likelihood of the first rows from ``start`` on, going ``way``, for E people in ``state``."""
    state = walker.predict(state, hole_s)
    return _along(walker, paths, state, start, way, step_s)


def _fresh(walker: Walker, paths: Paths, start: Ints, way: int, step_s: float) -> Floats:
    """The same for somebody new who was seen first at ``start``; the first position itself counts nothing."""
    state = walker.born(paths.xy_m[start])
    return _along(walker, paths, state, start, way, step_s, skip=True)


def _along(
    walker: Walker, paths: Paths, state: State, start: Ints, way: int, step_s: float, skip: bool = False
) -> Floats:
    total = np.zeros(len(start))
    track = np.searchsorted(paths.first, start, "right") - 1
    low, high = paths.first[track], paths.first[track + 1]
    for row in range(_ROWS):
        at = start + way * row
        there = (at >= low) & (at < high)
        at = np.clip(at, low, high - 1)
        if row:
            state = walker.predict(state, step_s)
        seen = there & np.isfinite(paths.xy_m[at, 0])
        if skip and row == 0:
            continue
        new, evidence = walker.update(state.take(seen), paths.xy_m[at[seen]], paths.noise_m[at[seen]])
        state.mean[seen], state.cov[seen] = new
        total[seen] += evidence
    return total
