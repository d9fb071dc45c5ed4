"""Putting together what belongs to one person: ends of tracks and later beginnings, over the whole log at once.

A link is judged by how well what came before a hole and what comes after it fit together: people go on as they went, or
stay where they stood.
Where links are judged pair by pair the best set of them is one assignment of ends to beginnings.

Letters: K tracks, E links, F features.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.transforms.retrack.follow import pairs
from mcaptrack.transforms.retrack.motion import Paths, State, Walker

#: How fast people are at most in a hole.
_REACH_M_PER_S: Final = 2.5
#: What a link is judged by, see ``features``.
NAMES: Final = ("miss", "misfit", "hole", "misfit or stay", "turn", "way and speed", "misfit and speed")
#: What each says for a link, as a log odds ratio; the log odds without any, in logs where a share of ``_USUAL`` of the
#: best links is right (tools/choose_retrack.py).
_WEIGHTS: Final = (-0.996, -0.798, -0.205, -0.304, 0.247, 0.482, -0.324)
_BIAS, _USUAL = 3.702, 0.666
#: Distances and speeds below these are as good as none.
_NEAR_M, _SPEED_M_PER_S = 0.3, 0.15
#: Links that are less likely than this by their log odds are not looked at.
_LEAST: Final = -2.52


def link(
    walker: Walker,
    paths: Paths,
    forward: State,
    backward: State,
    step_s: float,
    max_hole_s: float,
    least: float,
) -> Ints:
    """For each track the one that goes on from it, or -1; (K,).

    A link is made if it is right with a probability of ``least``. How many links are right at all differs from log to
    log, from hardly any (where holes are short, and who is gone has left) to most of them, and is found out from the
    links themselves (expectation maximisation).
    """
    first, last = paths.first[:-1], paths.first[1:] - 1
    follows = np.full(len(first), -1)
    i, j, hole_s = candidates(paths, forward, backward, step_s, max_hole_s)
    if len(i) == 0:
        return follows
    found = features(walker, forward.take(last[i]), backward.take(first[j]), hole_s)
    gain = found @ np.array(_WEIGHTS) + _BIAS - _LEAST
    good = gain > 0
    i, j, gain = i[good], j[good], gain[good]
    best = np.full(len(first), -np.inf)
    for group in _components(i, j, len(first)):
        who, them = np.unique(i[group]), np.unique(j[group])
        table = np.full((len(who), len(them)), -1.0)
        table[np.searchsorted(who, i[group]), np.searchsorted(them, j[group])] = np.round(gain[group], 6)
        row, column = pairs(table)
        follows[who[row]], best[who[row]] = them[column], table[row, column] + _LEAST
    return np.where(best + _usual_here(best[follows >= 0]) > np.log(least / (1 - least)), follows, -1)


def candidates(
    paths: Paths, forward: State, backward: State, step_s: float, max_hole_s: float
) -> tuple[Ints, Ints, Floats]:
    """Pairs (E,) of a track and a later one that is within reach of its end, and the seconds between them."""
    first, last = paths.first[:-1], paths.first[1:] - 1
    begins, ends = paths.step[first], paths.step[last]
    order = np.argsort(begins, kind="stable")
    low = np.searchsorted(begins[order], ends + 1)
    high = np.searchsorted(begins[order], ends + round(max_hole_s / step_s), "right")
    many = high - low
    i = np.repeat(np.arange(len(first)), many)
    j = order[np.arange(len(i)) - np.repeat(np.cumsum(many) - many, many) + low[i]]
    hole_s = (begins[j] - ends[i]) * step_s
    near = _length(forward.mean[last[i], :2] - backward.mean[first[j], :2]) <= 1.0 + _REACH_M_PER_S * hole_s
    return i[near], j[near], hole_s[near]


def _usual_here(odds: Floats) -> float:
    """What to add to the log odds of links (E,) in this log, where others are right than usual."""
    shift = 0.0
    for _ in range(100):
        right = (1 / (1 + np.exp(-(odds + shift)))).sum()
        share = (right + 0.3) / (len(odds) + 3)  # in most logs few are
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


def features(walker: Walker, before: State, after: State, hole_s: Floats) -> Floats:
    """What tells right links from wrong ones, (E, F): see ``NAMES``.

    ``before`` is who was there where the hole begins by what came before it, ``after`` who is there where it ends by
    what comes after it. A miss is how far off one side is of where the other, going straight on, expects it, the nearer
    of the two; a misfit, how far off one walks with the mean of both velocities.
    """
    span = hole_s[:, None]
    way = after.mean[:, :2] - before.mean[:, :2]
    left, came = before.mean[:, 2:], after.mean[:, 2:]
    miss = np.minimum(_length(way - left * span), _length(way - came * span))
    misfit, stay = _length(way - (left + came) / 2 * span), _length(way)
    speed = np.maximum(_length(left), _length(came))
    drift = (walker.drift + walker.drift_share * speed) ** 2
    spread = before.cov[:, 0] + after.cov[:, 0] + hole_s**2 / 4 * (before.cov[:, 2] + after.cov[:, 2])
    spread += drift * hole_s**3 / 12
    walking = np.log(speed + _SPEED_M_PER_S)
    return np.stack(
        [
            np.log(miss + _NEAR_M),
            np.log1p(misfit**2 / spread / 2),
            hole_s,
            np.log(np.minimum(misfit, stay) + _NEAR_M) * np.log(hole_s + 0.4),
            np.log(_length(came - left) + _SPEED_M_PER_S),
            np.log(stay + _NEAR_M) * walking,
            np.log(misfit + _NEAR_M) * walking,
        ],
        axis=1,
    )


def _length(vector: Floats) -> Floats:
    return np.asarray(np.hypot(vector[:, 0], vector[:, 1]))
