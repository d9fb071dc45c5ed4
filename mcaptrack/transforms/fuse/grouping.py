"""Group the boxes of several cameras that are the same object, on the ground. Letters: N boxes, G groups, P pairs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints


class Places(NamedTuple):
    """Places on the ground: positions (N, 2) in m, and covariances (N, 3) in m^2: xx, xy, yy."""

    xy_m: Floats
    cov: Floats

    def information(self) -> tuple[Floats, Floats]:
        """The inverse covariances (N, 3), and these times the positions (N, 2)."""
        xx, xy, yy = self.cov.T
        inverse = np.stack([yy, -xy, xx], axis=-1) / (xx * yy - xy * xy)[:, None]
        a, b, c = inverse.T
        x, y = self.xy_m.T
        return inverse, np.stack([a * x + b * y, b * x + c * y], axis=-1)


def distances(x: Floats, y: Floats, xx: Floats, xy: Floats, yy: Floats) -> Floats:
    """Squared Mahalanobis distances of differences, each with its covariance."""
    out: Floats = (yy * x * x - 2 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
    return out


def group(camera: Ints, places: Places, gate: float, farthest_m: float) -> Ints:
    """Join boxes until no two groups fit together; returns the group of each box (N,).

    Pairs are joined in order of their distance, if the groups that they are in by then still fit: no camera is twice in
    a group, and the means of the two are within the gate. A box that fits no other is a group of its own.

    Parameters
    ----------
    camera : (N,) int
        The camera of each box.
    places : Places
        Where they stand.
    gate : float
        Largest squared Mahalanobis distance of two groups.
    farthest_m : float
        Largest distance of two boxes in metres.
    """
    count = len(camera)
    first, second = np.triu_indices(count, 1)
    x, y = (places.xy_m[first] - places.xy_m[second]).T
    may = (camera[first] != camera[second]) & (x * x + y * y <= farthest_m**2)
    first, second, x, y = first[may], second[may], x[may], y[may]
    distance = distances(x, y, *(places.cov[first] + places.cov[second]).T)
    near = distance <= gate
    order = np.flatnonzero(near)[np.argsort(distance[near], kind="stable")]
    owner = list(range(count))
    # Numbers of Python, because a step concerns two groups and NumPy takes longer for so few.
    inverse, weighted = (part.tolist() for part in places.information())
    seen = [1 << one for one in camera.tolist()]
    for one, other in zip(first[order].tolist(), second[order].tolist(), strict=True):
        i, j = _root(owner, one), _root(owner, other)
        if i == j or seen[i] & seen[j] or _apart(inverse[i], weighted[i], inverse[j], weighted[j]) > gate:
            continue
        low, high = min(i, j), max(i, j)
        owner[high] = low
        seen[low] |= seen[high]
        inverse[low] = [a + b for a, b in zip(inverse[low], inverse[high], strict=True)]
        weighted[low] = [a + b for a, b in zip(weighted[low], weighted[high], strict=True)]
    roots = np.array([_root(owner, one) for one in range(count)], np.int64)
    return np.unique(roots, return_inverse=True)[1].astype(np.int64)


def _root(owner: list[int], one: int) -> int:
    while owner[one] != one:
        owner[one] = owner[owner[one]]
        one = owner[one]
    return one


def _apart(a: list[float], u: list[float], b: list[float], v: list[float]) -> float:
    """Squared Mahalanobis distance of the means of two groups, by their summed information."""
    det_a, det_b = a[0] * a[2] - a[1] * a[1], b[0] * b[2] - b[1] * b[1]
    x = (a[2] * u[0] - a[1] * u[1]) / det_a - (b[2] * v[0] - b[1] * v[1]) / det_b
    y = (a[0] * u[1] - a[1] * u[0]) / det_a - (b[0] * v[1] - b[1] * v[0]) / det_b
    xx, xy, yy = a[2] / det_a + b[2] / det_b, -a[1] / det_a - b[1] / det_b, a[0] / det_a + b[0] / det_b
    return (yy * x * x - 2 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)


def means(places: Places, of: Ints, count: int) -> Places:
    """The mean of each group (G,), each box weighted by its certainty."""
    inverse, weighted = places.information()
    a, b, c = (np.bincount(of, part, count) for part in inverse.T)
    u, v = (np.bincount(of, part, count) for part in weighted.T)
    det = a * c - b * b
    xy_m = np.stack([c * u - b * v, a * v - b * u], axis=-1) / det[:, None]
    return Places(xy_m, np.stack([c, -b, a], axis=-1) / det[:, None])
