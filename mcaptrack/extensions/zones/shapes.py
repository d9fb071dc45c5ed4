"""Zones and lines on the ground or in a picture: distances of points, crossings of paths, visits without jitter.

A path that touches an edge goes in and out of it many times, by the noise of its positions. Hysteresis (a Schmitt
trigger) takes a side as changed only where the path is farther than a margin from the edge, or where it begins or ends;
the change counts from where the path crossed the edge before that. So times are those of the edge, and reversing a path
in time swaps its enters and leaves.

Letters: N points, E edges, R rings, K pieces of paths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.ragged import run_starts

Units = Literal["metres", "pixels"]

#: The number of pairs of points and edges that are compared at once, to limit memory.
_PAIRS_AT_ONCE: Final = 1_000_000


@dataclass(frozen=True)
class Zone:
    """A zone or a line, as a file gives it.

    ``parts`` are polygons, each a tuple of rings (the first is its outline, others are holes), each ring a tuple of
    points without the first one again; a line has one part with one ring, its points. ``camera`` is the name of the
    camera that it belongs to, "" for any; ``classes`` are the names of the classes that it counts, none for all.
    ``number`` is its id in rows, from 1.
    """

    number: int
    name: str
    units: Units
    parts: tuple[tuple[tuple[tuple[float, float], ...], ...], ...]
    is_line: bool = False
    camera: str = ""
    classes: tuple[str, ...] = ()

    def shape(self) -> Shape:
        """Its geometry, in its own units."""
        return Shape(tuple(tuple(np.array(ring, float) for ring in part) for part in self.parts), self.is_line)


@dataclass(frozen=True)
class Shape:
    """The geometry of a zone or a line, as arrays: parts of rings (P, 2), as in ``Zone``."""

    parts: tuple[tuple[Floats, ...], ...]
    is_line: bool = False

    @cached_property
    def edges(self) -> tuple[tuple[Floats, Floats], ...]:
        """The beginnings and ends of the edges of each part, (E, 2) each."""
        return tuple(
            (
                np.concatenate([ring[:-1] if self.is_line else ring for ring in part]),
                np.concatenate([ring[1:] if self.is_line else np.roll(ring, -1, axis=0) for ring in part]),
            )
            for part in self.parts
        )

    @cached_property
    def box(self) -> tuple[Floats, Floats]:
        """The least and the largest coordinates, (2,) each."""
        points = np.concatenate([ring for part in self.parts for ring in part])
        return points.min(axis=0), points.max(axis=0)

    @cached_property
    def area(self) -> float:
        """The area without holes; 0 for a line."""
        if self.is_line:
            return 0.0
        return sum(abs(_area(part[0])) - sum(abs(_area(hole)) for hole in part[1:]) for part in self.parts)

    @cached_property
    def length(self) -> float:
        """The length of all edges."""
        return float(sum(np.hypot(*(end - start).T).sum() for start, end in self.edges))

    def margin(self, wanted: float) -> float:
        """The margin of hysteresis: as wanted, but at most half of what a narrow zone has room for.

        The radius of the largest circle inside a region without holes is at least its area by its circumference.
        """
        return wanted if self.is_line else min(wanted, self.area / self.length / 2)

    def depth(self, points: Floats, reach: float = np.inf) -> Floats:
        """Return the distances of points (N, 2) inside a zone from its edge, (N,); below 0 outside.

        Of a line: the distance from it, below 0. Beyond ``reach`` from all edges' bounding box it is minus infinity.
        """
        out = np.full(len(points), -np.inf)
        low, high = self.box
        near = np.flatnonzero(((points >= low - reach) & (points <= high + reach)).all(axis=1))
        most = max(1, _PAIRS_AT_ONCE // max(len(start) for start, _ in self.edges))
        for first in range(0, len(near), most):
            some = near[first : first + most]
            for start, end in self.edges:
                depth = _distance(points[some], start, end)
                is_inside = np.zeros(len(some), bool) if self.is_line else _is_inside(points[some], start, end)
                out[some] = np.maximum(out[some], np.where(is_inside, depth, -depth))
        return out

    def crossed(self, before: Floats, after: Floats) -> Ints:
        """Count how often paths from ``before`` to ``after`` (N, 2) cross a line from its left to its right, (N,).

        Crossings from right to left count as -1. Left is counter-clockwise from the direction of the line, with the
        second axis upwards.
        """
        out = np.zeros(len(before), np.int64)
        low, high = self.box
        near = (np.maximum(before, after) >= low).all(axis=1) & (np.minimum(before, after) <= high).all(axis=1)
        where = np.flatnonzero(near)
        ((start, end),) = self.edges
        most = max(1, _PAIRS_AT_ONCE // len(start))
        for first in range(0, len(where), most):
            some = where[first : first + most]
            out[some] = _crossings(before[some], after[some], start, end)
        return out


def _area(ring: Floats) -> float:
    """The area of a polygon (P, 2), above 0 if counter-clockwise."""
    x, y = (ring - ring[0]).T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def _distance(points: Floats, start: Floats, end: Floats) -> Floats:
    """The distance of points (N, 2) from the nearest of the edges (E, 2), (N,)."""
    along = end - start
    length = np.maximum((along**2).sum(axis=1), np.finfo(float).tiny)
    from_start = points[:, None] - start
    share = np.clip((from_start * along).sum(axis=2) / length, 0.0, 1.0)
    apart = from_start - share[..., None] * along
    return np.asarray(np.sqrt((apart**2).sum(axis=2).min(axis=1)))


def _is_inside(points: Floats, start: Floats, end: Floats) -> Bools:
    """Whether a ray to the right from points (N, 2) crosses an odd number of edges (E, 2)."""
    x, y = points[:, :1], points[:, 1:]
    is_between = (start[:, 1] > y) != (end[:, 1] > y)
    is_right = _cross(end - start, points[:, None] - start) * np.where(end[:, 1] > start[:, 1], 1, -1) > 0
    return np.asarray((is_between & is_right).sum(axis=1) % 2 == 1) if x.size else np.zeros(0, bool)


def _crossings(before: Floats, after: Floats, start: Floats, end: Floats) -> Ints:
    """The number of edges (E, 2) that paths (N, 2) cross from left to right, less those from right to left.

    An end that lies on an edge belongs to its left side, so that a path is not counted twice where it is cut.
    """
    was_left = _cross(end - start, before[:, None] - start) >= 0
    is_left = _cross(end - start, after[:, None] - start) >= 0
    path = (after - before)[:, None]
    is_met = (_cross(path, start - before[:, None]) >= 0) != (_cross(path, end - before[:, None]) >= 0)
    return np.asarray((is_met * (was_left.astype(np.int64) - is_left)).sum(axis=1))


def _cross(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def first_crossing(rings: Sequence[Floats]) -> tuple[float, float] | None:
    """A point where the edges of rings (P, 2) of one polygon cross or touch one another; None if they don't.

    Neighbours share their end; they touch elsewhere only if the outline turns back on itself.
    """
    start = np.concatenate(rings)
    end = np.concatenate([np.roll(ring, -1, axis=0) for ring in rings])
    first = np.cumsum([0, *(len(ring) for ring in rings)])
    following = np.concatenate([np.roll(np.arange(len(ring)), -1) for ring in rings])
    following += np.repeat(first[:-1], np.diff(first))
    for edge in range(len(start)):
        others = np.arange(edge + 1, len(start))
        a, b, c, d = start[edge], end[edge], start[others], end[others]
        sides = [_side(a, b, c), _side(a, b, d), _side(c, d, a), _side(c, d, b)]
        is_crossed = (sides[0] * sides[1] < 0) & (sides[2] * sides[3] < 0)
        ends = zip(sides, ((a, b, c), (a, b, d), (c, d, a), (c, d, b)), strict=True)
        touched = [(side == 0) & _is_between(*three) for side, three in ends]
        is_next = (following[edge] == others) | (following[others] == edge)
        # The end that neighbours share is an end of both; any other touch is a fault.
        is_fault = is_crossed | (np.sum(touched, axis=0) > np.where(is_next, 2, 0))
        if is_fault.any():
            at = int(np.flatnonzero(is_fault)[0])
            return _meeting(a, b, c[at], d[at])
    return None


def _side(a: Floats, b: Floats, point: Floats) -> Floats:
    return np.asarray(np.sign(_cross(b - a, point - a)))


def _is_between(a: Floats, b: Floats, point: Floats) -> Bools:
    """Whether points on the line through a and b are between both."""
    return np.asarray(((point >= np.minimum(a, b)) & (point <= np.maximum(a, b))).all(axis=-1))


def _meeting(a: Floats, b: Floats, c: Floats, d: Floats) -> tuple[float, float]:
    """Where two edges meet; the end of the first if they are parallel."""
    turn = float(_cross(b - a, d - c))
    share = float(_cross(c - a, d - c)) / turn if turn else 1.0
    x, y = a + share * (b - a)
    return float(x), float(y)


class Paths(NamedTuple):
    """Positions of tracks in order of track and time: (N, 2) points, times in ns and track of each (N,).

    ``begins`` marks the first row of each piece: of a track, or after a gap that is too long.
    """

    points: Floats
    t_ns: Ints
    track: Ints
    begins: Bools

    @classmethod
    def of(cls, points: Floats, t_ns: Ints, track: Ints, max_gap_ns: int) -> Paths:
        """Paths of rows that are in order; a gap of more than ``max_gap_ns`` ends a piece."""
        return cls(points, t_ns, track, run_starts(track, times=t_ns, max_gap=max_gap_ns))

    @property
    def ends(self) -> Bools:
        """The last row of each piece."""
        return np.append(self.begins[1:], True)[: len(self.begins)]


class Visits(NamedTuple):
    """Visits of a zone: the first row inside, the last one, and the first outside again, -1 if the piece ended inside.

    ``began`` says whether the piece began inside.
    """

    first: Ints
    last: Ints
    left: Ints
    began: Bools


def visits(paths: Paths, depth: Floats, margin: float) -> Visits:
    """Find visits by hysteresis. ``depth`` (N,) is how far each position is inside (see ``Shape.depth``)."""
    count = len(depth)
    if not count:
        none = np.zeros(0, np.int64)
        return Visits(none, none, none, np.zeros(0, bool))
    at, ends = np.arange(count), paths.ends
    is_in = depth >= 0
    side = np.where(depth >= margin, 1, np.where(depth < -margin, -1, 0))
    is_decided = (side != 0) | paths.begins | ends
    state = is_in[np.maximum.accumulate(np.where(is_decided, at, 0))]
    before = np.append(False, state[:-1]) & ~paths.begins
    enters = np.flatnonzero(state & ~before)
    leaves = np.flatnonzero(~state & before)
    # The change counts from the row after the last one on the other side.
    last_out = np.maximum.accumulate(np.where(is_in, -1, at))
    last_in = np.maximum.accumulate(np.where(is_in, at, -1))
    began = paths.begins[enters]
    first = np.where(began, enters, last_out[enters] + 1)
    done = np.flatnonzero(state & ends)
    stops = np.sort(np.concatenate([leaves, done]))
    has_left = ~state[stops]
    left = np.where(has_left, last_in[stops] + 1, -1)
    return Visits(first, np.where(has_left, left - 1, stops), left, began)


def crossings(paths: Paths, line: Shape, margin: float) -> tuple[Ints, Ints]:
    """Find crossings of a line by hysteresis: the first row after each (C,), and +1 from left to right or -1 (C,).

    Between two rows that are farther than ``margin`` from the line, only the sum of crossings counts.
    """
    count = len(paths.points)
    if count < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    raw = np.zeros(count, np.int64)
    raw[1:] = line.crossed(paths.points[:-1], paths.points[1:])
    raw[paths.begins] = 0
    some = np.flatnonzero(raw)
    if not len(some):
        return some, some
    is_far = (line.depth(paths.points, margin) < -margin) | paths.begins | paths.ends
    # Crossings up to the same row far from the line belong together.
    window = np.searchsorted(np.flatnonzero(is_far), some)
    windows, which = np.unique(window, return_inverse=True)
    net = np.sign(np.bincount(which, raw[some], len(windows))).astype(np.int64)
    agrees = np.sign(raw[some]) == net[which]
    row = np.full(len(windows), -1)
    np.maximum.at(row, which[agrees], some[agrees])
    kept = net != 0
    return row[kept], net[kept]
