"""Group the boxes of several cameras that are the same object, on the ground. Letters: N boxes, G groups, P pairs."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.neighbours import squared_sigmas
from mcaptrack.geometry.ragged import group_index, ragged_range

#: Pairs are looked for within a little more than their largest distance, which is compared exactly afterwards: this
#: share of the numbers that are compared.
_MARGIN: Final = 1e-12


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


def group(camera: Ints, places: Places, gate: float, farthest_m: float, part: Ints | None = None) -> Ints:
    """Join boxes that fit together, until as few groups are left as there can be; returns the group of each box (N,).

    Pairs are joined in order of their distance, if the groups that they are in by then still fit: no camera is twice in
    a group, and the means of the two are within the gate. A box that fits no other is a group of its own. Then a
    group is dissolved if all its boxes fit others (``_dissolved``). Groups are numbered by their first boxes.

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
    part : (N,) int, optional
        Boxes of different parts, as of different frames, are never joined.
    """
    count = len(camera)
    part = np.zeros(count, np.int64) if part is None else part
    first, second = pairs_along_x(places.xy_m, part, farthest_m)
    x, y = (places.xy_m[first] - places.xy_m[second]).T
    may = (camera[first] != camera[second]) & (x * x + y * y <= farthest_m**2)
    first, second, x, y = first[may], second[may], x[may], y[may]
    distance = squared_sigmas(x, y, *(places.cov[first] + places.cov[second]).T)
    fits = np.flatnonzero(distance <= gate)
    order = fits[np.lexsort((second[fits], first[fits], distance[fits]))]
    # Numbers of Python, because a step concerns two groups and NumPy takes longer for so few.
    owner, members = list(range(count)), [[box] for box in range(count)]
    seen = [1 << number for number in camera.tolist()]
    sums = list(zip(*(column.tolist() for part_ in places.information() for column in part_.T), strict=True))
    at = _mean(*np.array(sums, float).reshape(-1, 5).T)
    x_, y_, xx_, xy_, yy_ = (column.tolist() for column in at)
    for box, other in zip(first[order].tolist(), second[order].tolist(), strict=True):
        i, j = owner[box], owner[other]
        if i == j or seen[i] & seen[j]:
            continue
        dx, dy = x_[i] - x_[j], y_[i] - y_[j]
        xx, xy, yy = xx_[i] + xx_[j], xy_[i] + xy_[j], yy_[i] + yy_[j]
        if (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy) > gate:
            continue
        low, high = (i, j) if i < j else (j, i)
        seen[low] |= seen[high]
        (a, b, c, u, v), (d, e, f, w, z) = sums[low], sums[high]
        sums[low] = joint = (a + d, b + e, c + f, u + w, v + z)
        x_[low], y_[low], xx_[low], xy_[low], yy_[low] = _mean(*joint)
        for member in members[high]:
            owner[member] = low
        members[low] += members[high]
    of = np.unique(owner, return_inverse=True)[1].astype(np.int64)
    return _dissolved(camera, places, of, gate, farthest_m, part)


def pairs_along_x(xy_m: Floats, part: Ints, farthest_m: float) -> tuple[Ints, Ints]:
    """Pairs (P,) of places of one part that are at most so far apart along the first axis, the lower number first."""
    order = np.lexsort((xy_m[:, 0], part))
    x, part = xy_m[order, 0], part[order]
    low, high = float(x.min(initial=0.0)), float(x.max(initial=0.0))
    # Parts follow one another along the axis.
    along = x - low + part * (high - low + 2 * farthest_m + 1.0)
    reach = farthest_m + _MARGIN * float(along.max(initial=0.0))
    after = np.arange(1, len(x) + 1)
    count = np.searchsorted(along, along + reach, "right") - after
    near, other = group_index(count), ragged_range(after, count)
    same = part[near] == part[other]
    near, other = order[near[same]], order[other[same]]
    return np.minimum(near, other), np.maximum(near, other)


def _dissolved(camera: Ints, places: Places, of: Ints, gate: float, farthest_m: float, part: Ints) -> Ints:
    """Give the boxes of a group to others near it, where all of them fit there; returns the group of each box (N,).

    Where people stand close together, boxes of two of them may have been joined to a third person. Then the two lack
    these boxes. The group with the fewest boxes goes first. A box takes a place in another group if this has none of
    its camera, or if the one that it has fits another group.
    """
    count = int(of.max(initial=-1)) + 1
    centre = means(places, of, count)
    part_of = np.zeros(count, np.int64)
    part_of[of] = part
    mine, other = pairs_along_x(centre.xy_m, part_of, 2 * farthest_m)
    x, y = (centre.xy_m[mine] - centre.xy_m[other]).T
    near = x * x + y * y <= (2 * farthest_m) ** 2
    mine, other = np.concatenate([mine[near], other[near]]), np.concatenate([other[near], mine[near]])
    if not len(mine):
        return of
    # Each box with each group near its own one.
    size = np.bincount(of, minlength=count)
    by_group = np.argsort(of, kind="stable")
    begins = np.cumsum(size) - size
    box, to = by_group[ragged_range(begins[mine], size[mine])], np.repeat(other, size[mine])
    apart = places.xy_m[box] - centre.xy_m[to]
    away = squared_sigmas(*apart.T, *(places.cov[box] + centre.cov[to]).T)
    fits = (away <= gate) & ((apart**2).sum(axis=1) <= farthest_m**2)
    box, to, away = box[fits], to[fits], away[fits]
    order = np.lexsort((to, away, box))
    choices: dict[int, list[tuple[float, int]]] = {}
    for number, group_, value in zip(box[order].tolist(), to[order].tolist(), away[order].tolist(), strict=True):
        choices.setdefault(number, []).append((value, group_))
    # A group can go only if each of its boxes fits another one.
    may_go = np.bincount(of[np.unique(box)], minlength=count) == size
    tried = np.flatnonzero(may_go)
    owner, cameras = of.tolist(), camera.tolist()
    slots = [dict[int, int]() for _ in range(count)]
    for number, (group_, of_camera) in enumerate(zip(owner, cameras, strict=True)):
        slots[group_][of_camera] = number
    for group_ in tried[np.argsort(size[tried], kind="stable")].tolist():
        moves = _moves(group_, slots, cameras, choices)
        if moves is None:
            continue
        for number, _ in moves:
            slots[owner[number]].pop(cameras[number])
        for number, new in moves:
            slots[new][cameras[number]] = number
            owner[number] = new
    return np.unique(owner, return_inverse=True)[1].astype(np.int64)


def _moves(
    group_: int, slots: list[dict[int, int]], cameras: list[int], choices: dict[int, list[tuple[float, int]]]
) -> list[tuple[int, int]] | None:
    """The boxes that move if a group is dissolved, each with its new group; None if one has no place."""
    moves: list[tuple[int, int]] = []
    for of_camera, slot in slots[group_].items():
        best: tuple[float, list[tuple[int, int]]] | None = None
        for away, to in choices.get(slot, ()):
            if not slots[to] or (best and away >= best[0]):
                continue
            other = slots[to].get(of_camera)
            if other is None:
                best = away, [(slot, to)]
                continue
            for further, next_ in choices.get(other, ()):
                if next_ != group_ and slots[next_] and of_camera not in slots[next_]:
                    if not best or away + further < best[0]:
                        best = away + further, [(slot, to), (other, next_)]
                    break
        if best is None:
            return None
        moves += best[1]
    return moves


def _mean(a: Any, b: Any, c: Any, u: Any, v: Any) -> tuple[Any, ...]:
    """The mean of a group and its covariance, x, y, xx, xy, yy, by its information: xx, xy, yy, and that times x, y.

    Each is a number, or an array for as many groups.
    """
    det = a * c - b * b
    return (c * u - b * v) / det, (a * v - b * u) / det, c / det, -b / det, a / det


def means(places: Places, of: Ints, count: int) -> Places:
    """The mean of each group (G,), each box weighted by its certainty."""
    inverse, weighted = places.information()
    a, b, c = (np.bincount(of, part, count) for part in inverse.T)
    u, v = (np.bincount(of, part, count) for part in weighted.T)
    x, y, xx, xy, yy = _mean(a, b, c, u, v)
    return Places(np.stack([x, y], axis=-1), np.stack([xx, xy, yy], axis=-1))
