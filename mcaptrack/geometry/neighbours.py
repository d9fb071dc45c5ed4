"""Pairs of points that are near each other, and how far apart they are. Letters: N points, P pairs."""

from __future__ import annotations

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints


def near_pairs(group: Ints, xy: Floats, distance: float) -> tuple[Ints, Ints]:
    """Pairs of points of the same group that are nearer to each other than a distance.

    Takes memory for the points of all groups and time for the pairs of each: groups are meant to be small, such as the
    people of one frame.

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
    order = np.argsort(group, kind="stable")
    in_order = group[order]
    first, second = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for offset in range(1, len(order)):
        same = in_order[offset:] == in_order[:-offset]
        if not same.any():
            break
        a, b = order[:-offset][same], order[offset:][same]
        near = ((xy[a] - xy[b]) ** 2).sum(axis=1) < distance**2
        first.append(a[near])
        second.append(b[near])
    return np.concatenate(first), np.concatenate(second)


def squared_sigmas(x: Floats, y: Floats, xx: Floats, xy: Floats, yy: Floats) -> Floats:
    """Squared Mahalanobis distances (P,) of differences x and y, each with its covariance xx, xy, yy, (P,) each."""
    out: Floats = (yy * x * x - 2 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
    return out
