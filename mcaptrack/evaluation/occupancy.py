"""Where people spend their time: a grid on the ground with the person-seconds of each cell.

Letters: N positions, H rows and W columns of cells.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.geometry.ragged import group_index, ragged_range, run_ends, run_starts

__all__ = ["Occupancy", "occupancy"]

#: Two positions of a track that are further apart in time don't say where the person was in between.
MAX_GAP_S: Final = 2.0
#: The usual size of a cell, and the largest number of cells along a side; larger places have larger cells.
_CELL_M: Final = 0.5
_MOST_CELLS: Final = 200
_ROUND: Final = (1.0, 2.0, 5.0)
#: The share of the time at either end of each axis that doesn't count for the extent: positions near the horizon.
_BEYOND: Final = 0.002
#: A step is divided into pieces of an eighth of a cell, but not into more than this.
_MOST_PIECES: Final = 64
#: About how many pieces are computed with at once.
_PART: Final = 2**18


class Occupancy(NamedTuple):
    """The time that people spent in each cell of a grid on the ground.

    Attributes
    ----------
    person_s : (H, W) of float64
        Person-seconds. Row 0 has the lowest y, column 0 the lowest x.
    low_m : tuple of float
        x and y of the lower corner of the first cell, multiples of ``cell_m``.
    cell_m : float
        The side of a cell.
    outside_s : float
        Person-seconds outside of the grid.
    """

    person_s: Floats
    low_m: tuple[float, float]
    cell_m: float
    outside_s: float

    @property
    def high_m(self) -> tuple[float, float]:
        """The corner of x and y opposite to ``low_m``."""
        rows, columns = self.person_s.shape
        return self.low_m[0] + columns * self.cell_m, self.low_m[1] + rows * self.cell_m


def occupancy(t_ns: Ints, track_id: NDArray[Any], xy_m: Floats) -> Occupancy:
    """Count the person-seconds in each cell of the ground.

    People move evenly from one position of their track to the next. So the sum over all cells, and outside, is the
    duration of all tracks, whatever their rate, except for gaps; one person is counted once at a time.

    Parameters
    ----------
    t_ns : (N,) of int64
        Times of the positions, in any order.
    track_id : (N,) of int
    xy_m : (N, 2) of float64
        Positions; rows that are not finite are left out.

    Returns
    -------
    Occupancy
        All places but those where less than 0.2 % of the time is spent at either end of an axis; an empty grid (0, 0)
        if no track has two positions. Cells have 0.5 m, and as much more as large places need.

    Examples
    --------
    >>> import numpy as np
    >>> t_ns = np.array([0, 1, 2]) * 10**9
    >>> heat = occupancy(t_ns, np.ones(3, int), np.array([[0.25, 0.25], [0.25, 0.25], [1.25, 0.25]]))
    >>> heat.person_s.tolist()
    [[1.25, 0.5, 0.25]]
    """
    start_m, step_m, seconds = _steps(t_ns, track_id, xy_m, seconds_to_ns(MAX_GAP_S))
    if not len(seconds):
        return Occupancy(np.zeros((0, 0)), (0.0, 0.0), _CELL_M, 0.0)
    ends, weight = np.concatenate([start_m, start_m + step_m]), np.tile(seconds, 2)
    low, high = (_weighted(ends, weight, share) for share in (_BEYOND, 1 - _BEYOND))
    cell = _cell_of(float((high - low).max()))
    first = np.floor(low / cell).astype(np.int64)
    count = np.floor(high / cell).astype(np.int64) - first + 1
    grid, outside = np.zeros(int(count.prod())), 0.0
    pieces = np.clip(np.ceil(8 * np.abs(step_m).max(axis=1, initial=0.0) / cell), 1, _MOST_PIECES).astype(np.int64)
    for part in _parts(pieces):
        size = pieces[part]
        of = group_index(size)
        share = (ragged_range(0, size) + 0.5) / size[of]
        at = start_m[part][of] + share[:, None] * step_m[part][of]
        weight = (seconds[part] / size)[of]
        place = np.floor(at / cell).astype(np.int64) - first
        inside = ((place >= 0) & (place < count)).all(axis=1)
        grid += np.bincount(place[inside, 1] * count[0] + place[inside, 0], weight[inside], len(grid))
        outside += float(weight[~inside].sum())
    low_x, low_y = (first * cell).tolist()
    return Occupancy(grid.reshape(int(count[1]), int(count[0])), (low_x, low_y), cell, outside)


def _steps(t_ns: Ints, track_id: NDArray[Any], xy_m: Floats, max_gap_ns: int) -> tuple[Floats, Floats, Floats]:
    """The steps of all tracks: where each begins, how far it goes, and how long it takes, in seconds."""
    has_place = np.isfinite(xy_m).all(axis=1)
    times, ids, at = t_ns[has_place], track_id[has_place], xy_m[has_place]
    order = np.lexsort((times, ids))
    times, ids, at = times[order], ids[order], at[order]
    last = run_ends(run_starts(ids, times=times, max_gap=max_gap_ns))
    begin = np.flatnonzero(~last)
    return at[begin], at[begin + 1] - at[begin], (times[begin + 1] - times[begin]) / NS_PER_S


def _weighted(at: Floats, weight: Floats, share: float) -> Floats:
    """The quantile of each axis of places (N, 2) with weights (N,)."""
    out = np.zeros(2)
    for axis in range(2):
        order = np.argsort(at[:, axis], kind="stable")
        total = np.cumsum(weight[order])
        which = np.searchsorted(total, share * total[-1])
        out[axis] = at[order[min(int(which), len(order) - 1)], axis]
    return out


def _cell_of(extent_m: float) -> float:
    """The side of a cell for a place of this extent: 0.5 m, or the next of 1, 2, 5, 10, 20, 50 m and so on."""
    cell, power = _CELL_M, 1.0
    while extent_m > cell * _MOST_CELLS:
        cell = next((step * power for step in _ROUND if step * power > cell), cell)
        power *= 10.0 if cell >= _ROUND[-1] * power else 1.0
    return cell


def _parts(pieces: Ints) -> list[slice]:
    """Slices of the steps with about as many pieces as are computed with at once."""
    ends = np.cumsum(pieces)
    total = int(ends[-1]) if len(ends) else 0
    if not total:
        return []
    bounds = np.unique(np.searchsorted(ends, np.arange(0, total, _PART)))
    return [slice(a, b) for a, b in zip(bounds.tolist(), [*bounds.tolist()[1:], len(pieces)], strict=True)]
