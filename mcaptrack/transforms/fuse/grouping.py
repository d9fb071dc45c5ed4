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
    """Join boxes that fit together, until as few groups are left as there can be; returns the group of each box (N,).

    Pairs are joined in order of their distance, if the groups that they are in by then still fit: no camera is twice in
    a group, and the means of the two are within the gate. A box that fits no other is a group of its own. Then a
    group is dissolved if all its boxes fit others (``_dissolved``).

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
    of = np.unique([_root(owner, one) for one in range(count)], return_inverse=True)[1].astype(np.int64)
    return _dissolved(camera, places, of, gate, farthest_m)


def _dissolved(camera: Ints, places: Places, of: Ints, gate: float, farthest_m: float) -> Ints:
    """Give the boxes of a group to others near it, where all of them fit there; returns the group of each box (N,).

    Where people stand close together, boxes of two of them may have been joined to a third person. Then the two lack
    these boxes. The group with the fewest boxes goes first. A box takes a place in another group if this has none of
    its camera, or if the one that it has fits another group.
    """
    count = int(of.max(initial=-1)) + 1
    centre = means(places, of, count)
    x, y = (centre.xy_m[:, None] - centre.xy_m).transpose(2, 0, 1)
    near = x * x + y * y <= (2 * farthest_m) ** 2
    np.fill_diagonal(near, False)
    size = np.bincount(of, minlength=count)
    tried = np.flatnonzero(near.any(axis=1))
    if not len(tried):
        return of
    box, to = np.nonzero(near[of])
    apart = places.xy_m[box] - centre.xy_m[to]
    away = distances(*apart.T, *(places.cov[box] + centre.cov[to]).T)
    fits = (away <= gate) & ((apart**2).sum(axis=1) <= farthest_m**2)
    choices: dict[int, list[tuple[float, int]]] = {}
    for one, group_, value in zip(box[fits].tolist(), to[fits].tolist(), away[fits].tolist(), strict=True):
        choices.setdefault(one, []).append((value, group_))
    for options in choices.values():
        options.sort()
    owner, cameras = of.tolist(), camera.tolist()
    slots = [dict[int, int]() for _ in range(count)]
    for one, (group_, of_camera) in enumerate(zip(owner, cameras, strict=True)):
        slots[group_][of_camera] = one
    for group_ in tried[np.argsort(size[tried], kind="stable")].tolist():
        moves = _moves(group_, slots, cameras, choices)
        if moves is None:
            continue
        for one, _ in moves:
            slots[owner[one]].pop(cameras[one])
        for one, new in moves:
            slots[new][cameras[one]] = one
            owner[one] = new
    return np.unique(owner, return_inverse=True)[1].astype(np.int64)


def _moves(
    group_: int, slots: list[dict[int, int]], cameras: list[int], choices: dict[int, list[tuple[float, int]]]
) -> list[tuple[int, int]] | None:
    """The boxes that move if a group is dissolved, each with its new group; None if one has no place."""
    moves: list[tuple[int, int]] = []
    for of_camera, one in slots[group_].items():
        best: tuple[float, list[tuple[int, int]]] | None = None
        for away, to in choices.get(one, ()):
            if not slots[to] or (best and away >= best[0]):
                continue
            other = slots[to].get(of_camera)
            if other is None:
                best = away, [(one, to)]
                continue
            for further, next_ in choices.get(other, ()):
                if next_ != group_ and slots[next_] and of_camera not in slots[next_]:
                    if not best or away + further < best[0]:
                        best = away + further, [(one, to), (other, next_)]
                    break
        if best is None:
            return None
        moves += best[1]
    return moves


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
