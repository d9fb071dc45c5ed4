"""Where people spend their time: person-seconds on a grid."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from mcaptrack.evaluation.occupancy import occupancy

S = 10**9


def test_nothing_is_an_empty_grid():
    t_ns, ids = np.array([0, 1, 0, 1]) * S, np.array([1, 1, 2, 2])
    for rows in (0, 1):
        heat = occupancy(t_ns[:rows], ids[:rows], np.zeros((rows, 2)))
        assert heat.person_s.shape == (0, 0)
    unknown = np.array([[np.nan, 0.0], [0.0, 0.0], [1.0, np.inf], [0.0, 0.0]])
    assert occupancy(t_ns, ids, unknown).person_s.size == 0


def slowly(t_ns, ids, xy, cell, gap_s):
    """Step by step, piece by piece; the extent by adding up the time of ends of steps along each axis."""
    steps = []
    for one in sorted(set(ids.tolist())):
        mine = sorted((int(t), *at) for t, at in zip(t_ns[ids == one], xy[ids == one].tolist(), strict=True))
        steps += [
            (a, b) for a, b in pairwise([row for row in mine if np.isfinite(row).all()]) if b[0] - a[0] <= gap_s * S
        ]
    bounds = []
    for axis in (0, 1):
        ends = sorted((end[1 + axis], (b[0] - a[0]) / S) for a, b in steps for end in (a, b))
        total = np.cumsum([time for _, time in ends])
        place = [
            next(at for (at, _), so_far in zip(ends, total, strict=True) if so_far >= share * total[-1])
            for share in (0.002, 0.998)
        ]
        bounds.append(tuple(math.floor(at / cell) for at in place))
    (x0, x1), (y0, y1) = bounds
    grid, outside = np.zeros((max(y1 - y0 + 1, 1), max(x1 - x0 + 1, 1))), 0.0
    for a, b in steps:
        way = [b[1] - a[1], b[2] - a[2]]
        pieces = min(max(math.ceil(8 * max(map(abs, way)) / cell), 1), 64)
        for piece in range(pieces):
            x, y = (a[1 + axis] + (piece + 0.5) / pieces * way[axis] for axis in (0, 1))
            column, row = math.floor(x / cell) - x0, math.floor(y / cell) - y0
            if 0 <= row < len(grid) and 0 <= column < grid.shape[1]:
                grid[row, column] += (b[0] - a[0]) / S / pieces
            else:
                outside += (b[0] - a[0]) / S / pieces
    return grid, (x0 * cell, y0 * cell), outside


@pytest.mark.parametrize(("part", "gap_s"), [(1 << 18, 2.0), (40, 2.0), (40, 0.5)])
def test_the_grid_is_that_of_a_slow_count(part, gap_s, monkeypatch):
    for name, value in {"_PART": part, "_CELL_M": 0.7, "MAX_GAP_S": gap_s}.items():
        monkeypatch.setattr(f"mcaptrack.evaluation.occupancy.{name}", value)
    rng = np.random.default_rng(5)
    count = 120
    ids = rng.integers(0, 5, count)
    t_ns = np.sort(rng.choice(400, count, replace=False)) * (S // 10)
    xy = rng.normal(0, 3, (count, 2))
    xy[7, 0], xy[30] = np.nan, 60.0  # not known, and farther than 64 pieces tell
    heat = occupancy(t_ns, ids, xy)
    grid, low_m, outside = slowly(t_ns, ids, xy, 0.7, gap_s)
    np.testing.assert_allclose(heat.person_s, grid, atol=1e-9)
    assert heat.low_m == pytest.approx(low_m)
    assert heat.high_m == pytest.approx((low_m[0] + 0.7 * grid.shape[1], low_m[1] + 0.7 * grid.shape[0]))
    assert heat.outside_s == pytest.approx(outside)


def test_cells_grow_where_there_would_be_more_than_two_hundred():
    t_ns, ids = np.array([0, 1]) * S, np.array([1, 1])
    for extent, cell in (
        *((100.0, 0.5), (100.5, 1.0), (200.0, 1.0), (200.5, 2.0), (400.0, 2.0), (401.0, 5.0), (1000.0, 5.0)),
        *((1001.0, 10.0), (2000.0, 10.0), (2001.0, 20.0), (4001.0, 50.0), (10_001.0, 100.0), (1e6, 5000.0)),
    ):
        for way in ((extent, 1.0), (1.0, -extent)):
            assert occupancy(t_ns, ids, np.array([(0.0, 0.0), way])).cell_m == cell
    nothing = occupancy(t_ns[:1], ids[:1], np.zeros((1, 2)))
    assert (nothing.low_m, nothing.high_m, nothing.cell_m, nothing.outside_s) == ((0.0, 0.0), (0.0, 0.0), 0.5, 0.0)
