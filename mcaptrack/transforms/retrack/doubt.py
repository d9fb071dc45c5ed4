"""Which tracks are of nobody: what flickers, what stays, what walks beside somebody for a while.

Letters: K tracks, N rows, F features.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.transforms.retrack.motion import Paths, State, Walker

#: Somebody's double is nearer than this to them.
_BESIDE_M: Final = 1.2


def features(walker: Walker, paths: Paths, smoothed: State, step_s: float) -> Floats:
    """What tells people from false tracks, (K, F): see ``NAMES``."""
    first, last = paths.first[:-1], paths.first[1:] - 1
    length = last - first + 1
    track = np.repeat(np.arange(len(first)), length)
    seen = np.isfinite(paths.xy_m[:, 0])
    count = np.add.reduceat(seen.astype(float), first)
    xy = smoothed.mean[:, :2]
    low, high = np.minimum.reduceat(xy, first), np.maximum.reduceat(xy, first)
    extent = np.hypot(*(high - low).T)
    off = np.where(seen[:, None], paths.xy_m - xy, 0.0)
    rough = np.add.reduceat((off**2).sum(axis=1), first) / count / (2 * walker.noise_m**2)
    speed = np.hypot(smoothed.mean[:, 2], smoothed.mean[:, 3])
    mean_speed = np.add.reduceat(speed, first) / length
    return np.stack(
        [
            np.log(length * step_s),
            np.log(count),
            np.log(extent + 0.3),
            np.log(mean_speed + 0.1),
            np.log(rough + 0.1),
            count / length,
            _inside(paths, xy, track, length),
        ],
        axis=1,
    )


NAMES: Final = ("log length", "log count", "log extent", "log speed", "log rough", "seen", "inside")
#: What each feature says for a person, as a log odds ratio, and the log odds without any (tools/choose_retrack.py).
_WEIGHTS: Final = (1.58, -0.58, 1.736, -1.126, -0.559, 0.59, -1.993)
_BIAS: Final = -3.342


def log_odds(walker: Walker, paths: Paths, smoothed: State, step_s: float) -> Floats:
    """For each track the log odds that it is a person, (K,)."""
    return np.asarray(features(walker, paths, smoothed, step_s) @ np.array(_WEIGHTS) + _BIAS)


def _inside(paths: Paths, xy: Floats, track: Ints, length: Ints) -> Floats:
    """The share of each track's rows that lie beside one and the same track that began before and ended after it."""
    order = np.argsort(paths.step, kind="stable")
    step = paths.step[order]
    mine, theirs = [np.empty(0, int)], [np.empty(0, int)]
    for apart in range(1, len(order)):
        same = step[apart:] == step[:-apart]
        if not same.any():
            break
        a, b = order[:-apart][same], order[apart:][same]
        near = ((xy[a] - xy[b]) ** 2).sum(axis=1) < _BESIDE_M**2
        mine.append(track[a[near]])
        theirs.append(track[b[near]])
    total = len(length)
    a, b = np.concatenate(mine), np.concatenate(theirs)
    short, long = np.where(length[a] <= length[b], a, b), np.where(length[a] <= length[b], b, a)
    pair, count = np.unique(short * total + long, return_counts=True)
    short, long = pair // total, pair % total
    share = count / length[short]
    begins, ends = paths.step[paths.first[:-1]], paths.step[paths.first[1:] - 1]
    within = (begins[long] + 3 < begins[short]) & (ends[long] - 3 > ends[short])
    inside = np.zeros(total)
    np.maximum.at(inside, short, share * within)
    return inside
