"""Joining of boxes of several cameras, slowly and by matrices, from the documentation of ``group``."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

Box = tuple[int, np.ndarray, np.ndarray]  # camera, position (2,), covariance (2, 2)


def mean_of(members: Sequence[Box]) -> tuple[np.ndarray, np.ndarray]:
    cov = np.linalg.inv(sum(np.linalg.inv(one) for _, _, one in members))
    return cov @ sum(np.linalg.inv(one) @ at for _, at, one in members), cov


def apart(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> float:
    way = a[0] - b[0]
    return float(way @ np.linalg.inv(a[1] + b[1]) @ way)


def joined(boxes: Sequence[Box], gate: float, farthest_m: float) -> list[set[int]]:
    """The groups, as sets of the numbers of boxes."""
    group = {number: {number} for number in range(len(boxes))}
    pairs = []
    for i, j in itertools.combinations(range(len(boxes)), 2):
        if boxes[i][0] != boxes[j][0] and np.linalg.norm(boxes[i][1] - boxes[j][1]) <= farthest_m:
            pairs.append((apart(boxes[i][1:], boxes[j][1:]), i, j))
    for distance, i, j in sorted(pairs):
        both = [boxes[one] for one in group[i] | group[j]]
        if distance > gate or group[i] is group[j] or len({one[0] for one in both}) < len(both):
            continue
        if apart(mean_of([boxes[one] for one in group[i]]), mean_of([boxes[one] for one in group[j]])) <= gate:
            united = group[i] | group[j]
            for one in united:
                group[one] = united
    found = sorted({id(one): one for one in group.values()}.values(), key=min)
    return dissolved(boxes, found, gate, farthest_m)


def dissolved(boxes: Sequence[Box], groups: list[set[int]], gate: float, farthest_m: float) -> list[set[int]]:
    centres = [mean_of([boxes[one] for one in members]) for members in groups]
    now = [set(members) for members in groups]

    def options(one: int) -> list[tuple[float, int]]:
        own = next(number for number, members in enumerate(groups) if one in members)
        out = []
        for number, centre in enumerate(centres):
            near = np.linalg.norm(centres[own][0] - centre[0]) <= 2 * farthest_m
            fits = np.linalg.norm(boxes[one][1] - centre[0]) <= farthest_m and apart(boxes[one][1:], centre) <= gate
            if number != own and near and fits:
                out.append((apart(boxes[one][1:], centre), number))
        return sorted(out)

    def place(one: int, leaves: int) -> tuple[float, list[tuple[int, int]]] | None:
        """The cheapest place of a box: a free one, or that of a box that finds a free one."""
        best = None
        for away, number in options(one):
            there = [other for other in now[number] if boxes[other][0] == boxes[one][0]]
            cost, moves = away, [(one, number)]
            if not now[number]:
                continue
            if there:
                free = [
                    (more, to)
                    for more, to in options(there[0])
                    if to != leaves and now[to] and all(boxes[x][0] != boxes[one][0] for x in now[to])
                ]
                if not free:
                    continue
                cost, moves = away + free[0][0], [*moves, (there[0], free[0][1])]
            if best is None or cost < best[0]:
                best = cost, moves
        return best

    for number in sorted(range(len(groups)), key=lambda one: len(groups[one])):
        places = [place(one, number) for one in sorted(now[number])]
        if any(one is None for one in places):
            continue
        moves = [move for one in places for move in one[1]]
        for one, _ in moves:
            next(members for members in now if one in members).discard(one)
        for one, to in moves:
            now[to].add(one)
    return [members for members in now if members]
