"""Convex hulls that grow. Letters: N points, V vertices."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats

#: Points so little outside are taken for inside, in units of length.
_SLACK: Final = 1e-6


@dataclass
class GrowingHull:
    """The convex hull of all points so far.

    Attributes
    ----------
    vertices : (V, 2) of float
        Its vertices, anticlockwise; fewer than three if no area was seen yet, which has no inside.

    Examples
    --------
    >>> hull = GrowingHull()
    >>> hull.add(np.array([[0.0, 4.0, 4.0, 0.0, 2.0], [0.0, 0.0, 4.0, 4.0, 2.0]]))
    >>> hull.vertices.tolist()
    [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]]
    >>> hull.holds(np.array([[1.0, 5.0], [1.0, 1.0]])).tolist()
    [True, False]
    """

    vertices: Floats = field(default_factory=lambda: np.empty((0, 2)))
    _normals: Floats = field(init=False, default_factory=lambda: np.empty((0, 2)))
    _limits: Floats = field(init=False, default_factory=lambda: np.empty((0, 1)))

    def holds(self, xy: Floats) -> Bools:
        """Which points (2, N) are inside, (N,); those that are NaN are not."""
        if not len(self._normals):
            return np.zeros(xy.shape[1], bool)
        return np.asarray((self._normals @ xy <= self._limits).all(axis=0))

    def add(self, xy: Floats) -> None:
        """Add points (2, N); those that are NaN are left out."""
        new = xy[:, np.isfinite(xy).all(axis=0) & ~self.holds(xy)]
        if not new.shape[1]:
            return
        points = sorted({(x, y) for x, y in [*self.vertices.tolist(), *new.T.tolist()]})
        ring = [*_chain(points), *_chain(points[::-1])]
        self.vertices = np.array(ring)
        if len(ring) > 2:
            edges = np.roll(self.vertices, -1, axis=0) - self.vertices
            outwards = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
            self._normals = outwards / np.hypot(*outwards.T)[:, None]
            self._limits = (self._normals * self.vertices).sum(axis=1)[:, None] + _SLACK


def _chain(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """One side of the hull of sorted points, without the last one (A. M. Andrew, 1979)."""
    out: list[tuple[float, float]] = []
    for x, y in points:
        while len(out) > 1:
            (ax, ay), (bx, by) = out[-2:]
            if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                break
            out.pop()
        out.append((x, y))
    return out[:-1] if len(out) > 1 else out
