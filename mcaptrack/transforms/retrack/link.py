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
#: How fast people are at most in a hole.
_REACH_M_PER_S: Final = 2.5
#: The log odds of a link: for each unit of evidence, each second of hole, the log odds that a track is of nobody,
#: and without any, where 43 in 100 are right (tools/choose_retrack.py).
_EVIDENCE, _HOLE, _NOBODY, _START, _USUAL = 0.152, -0.193, 0.119, 2.31, 0.43
#: How far people move who stand, and what it costs to take it that they did, as a log likelihood of both sides.
_STAY_M2_PER_S, _STAY_COST = 0.02, 3.0
#: Links that are less likely than this by their log odds are not looked at.
_LEAST: Final = -4.0


def link(
    walker: Walker,
    paths: Paths,
    forward: State,
    backward: State,
    step_s: float,
    max_hole_s: float,
    least: float,
    odds: Floats,
) -> Ints:
    """For each track the one that goes on from it, or -1; (K,).

    ``odds`` (K,) are the log odds that a track is of a person. A link is made if it is right with a probability of
    ``least``. How many links are right at all differs from log to log, from hardly any (where holes are short, and who
    is gone has left) to most of them, and is found out from the links themselves (expectation maximisation).
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
    walked, stayed = evidence(
        walker, paths, forward.take(last[i]), backward.take(first[j]), last[i], first[j], hole_s, step_s
    )
    nobody = np.minimum(odds, 0.0)
    gain = _START + _EVIDENCE * np.maximum(walked, stayed) + _HOLE * hole_s + _NOBODY * (nobody[i] + nobody[j]) - _LEAST
    good = gain > 0
    i, j, gain = i[good], j[good], gain[good]
    best = np.full(count, -np.inf)
    for group in _components(i, j, count):
        who, them = np.unique(i[group]), np.unique(j[group])
        table = np.full((len(who), len(them)), -1.0)
        table[np.searchsorted(who, i[group]), np.searchsorted(them, j[group])] = np.round(gain[group], 6)
        row, column = pairs(table)
        follows[who[row]], best[who[row]] = them[column], table[row, column] + _LEAST
    return np.where(best + _usual_here(best[follows >= 0]) > np.log(least / (1 - least)), follows, -1)


def _usual_here(odds: Floats) -> float:
    """What to add to the log odds of links (E,) in this log, where others are right than usual."""
    shift = 0.0
    for _ in range(100):
        right = (1 / (1 + np.exp(-(odds + shift)))).sum()
        share = (right + 1) / (len(odds) + 3)
        before, shift = shift, float(np.log(share / (1 - share)) - np.log(_USUAL / (1 - _USUAL)))
        if abs(shift - before) < 1e-4:
            break
    return shift


def _components(i: Ints, j: Ints, count: int) -> list[Ints]:
    """The edges of each connected component of a graph from ends ``i`` to beginnings ``j``."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(i)), (i, count + j)), shape=(2 * count, 2 * count))
    _, label = connected_components(graph, directed=False)
    order = np.argsort(label[i], kind="stable")
    bounds = np.flatnonzero(np.diff(label[i][order])) + 1
    return list(np.split(order, bounds)) if len(order) else []


def evidence(
    walker: Walker, paths: Paths, before: State, after: State, last: Ints, first: Ints, hole_s: Floats, step_s: float
) -> tuple[Floats, Floats]:
    """Log likelihoods (E,), of both sides together, that somebody walked on, or stood, against two different people.

    ``before`` is who was there at the rows ``last`` by what came before, ``after`` who is at ``first`` by what comes
    after.
    """
    turned = State(after.mean * [1, 1, -1, -1], after.cov)
    ahead = _along(walker, paths, walker.predict(before, hole_s), first, 1, step_s)
    behind = _along(walker, paths, walker.predict(turned, hole_s), last, -1, step_s)
    walked = ahead + behind - _fresh(walker, paths, first, 1, step_s) - _fresh(walker, paths, last, -1, step_s)
    spread = before.cov[:, 0] + after.cov[:, 0] + _STAY_M2_PER_S * hole_s
    off = before.mean[:, :2] - after.mean[:, :2]
    stayed = -(off**2).sum(axis=1) / spread - 2 * np.log(2 * np.pi * spread) - _STAY_COST
    return walked, stayed


def _fresh(walker: Walker, paths: Paths, start: Ints, way: int, step_s: float) -> Floats:
    """Log likelihood of the first rows from ``start`` on, going ``way``, for somebody new who was seen first there.

    The first position itself counts nothing.
    """
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
