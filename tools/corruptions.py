"""What goes wrong with tracks of people: true tracks in, what a tracker might have made of them out.

Rows are (step, id, x, y): whole steps of the clock of prediction, metres. No two kinds share a cause, so that settings
that are good for all of them fit no one model of noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Final

import numpy as np

STEP_S: Final = 0.4
Rows = np.ndarray


def whole_people(path: Path) -> Rows:
    """Rows of a TrajNet file (frame id x y) whose ids are people.

    TrajNet chops people into pieces with ids of their own; pieces that go on where another ended are put together.
    """
    rows = np.loadtxt(path, delimiter="," if "," in path.read_text()[:200] else None)
    pieces = {who: rows[rows[:, 1] == who] for who in np.unique(rows[:, 1])}
    pieces = {who: piece[np.argsort(piece[:, 0])] for who, piece in pieces.items() if len(piece) > 1}
    step = np.gcd.reduce(np.diff(np.unique(rows[:, 0])).astype(int))
    starts: dict[float, list[float]] = {}
    for who, piece in pieces.items():
        starts.setdefault(float(piece[0, 0]), []).append(who)
    follows: dict[float, float] = {}
    taken: set[float] = set()
    for who, piece in pieces.items():
        expected = 2 * piece[-1, 2:] - piece[-2, 2:]
        later = [
            (float(np.hypot(*(pieces[name][0, 2:] - expected))), name)
            for name in starts.get(float(piece[-1, 0] + step), ())
            if name not in taken
        ]
        if later and min(later)[0] < 0.6:
            follows[who] = min(later)[1]
            taken.add(follows[who])
    out = []
    for person, start in enumerate(who for who in pieces if who not in taken):
        who: float | None = start
        while who is not None:
            piece = pieces[who].copy()
            piece[:, 0] /= step
            piece[:, 1] = person
            out.append(piece)
            who = follows.get(who)
    return np.concatenate(out)


@dataclass(frozen=True)
class Corruption:
    """What goes wrong, in seconds and metres; rates are per person.

    ``noise_m`` of every position, which varies with a time constant of ``noise_s``. People are seen for ``seen_s`` on
    average and then hidden for ``hidden_s`` (least, most), ``standing`` times as long if they stand; after that they
    have a new id with probability ``new_id``. ``breaks_per_min`` are new ids without a hole, ``swap`` the probability
    of an exchange at each step of two who are within 1.5 m. Who is within ``merge_m`` of somebody is one box with them.
    ``doubles`` is the share of rows that somebody else's boxes beside a person add, ``flicker`` that of false tracks
    that wander for less than 4 s, ``clutter`` that of those which stay in one place for up to half a minute.
    """

    noise_m: float = 0.12
    noise_s: float = 0.0
    seen_s: float = 6.0
    hidden_s: tuple[float, float] = (0.4, 1.2)
    standing: float = 1.0
    new_id: float = 0.5
    breaks_per_min: float = 0.0
    swap: float = 0.02
    merge_m: float = 0.0
    doubles: float = 0.0
    flicker: float = 0.03
    clutter: float = 0.0


_BASE: Final = Corruption()
CORRUPTIONS: Final = {
    "holes": replace(_BASE, noise_m=0.2, seen_s=1.9, swap=0.05, flicker=0.1),
    "very noisy": replace(_BASE, noise_m=0.35),
    "slow noise": replace(_BASE, noise_m=0.25, noise_s=1.5),
    "hidden long": replace(_BASE, seen_s=20.0, hidden_s=(2.0, 8.0), standing=2.0, new_id=1.0),
    "clutter": replace(_BASE, clutter=0.15, flicker=0.08),
    "doubles": replace(_BASE, doubles=0.12),
    "merges": replace(_BASE, merge_m=0.9, swap=0.0),
    "broken ids": replace(_BASE, breaks_per_min=12.0, new_id=1.0, swap=0.06),
}


def corrupt(truth: Rows, how: Corruption, rng: np.random.Generator) -> Rows:
    """True rows -> rows as a tracker might give them, ordered by step."""
    ids = count(1)
    rows = np.concatenate([_one(truth[truth[:, 1] == who], how, rng, ids) for who in np.unique(truth[:, 1])])
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    if how.merge_m:
        rows = _merged(rows, how.merge_m, ids)
    rows = _exchanged(rows, how.swap, rng)
    extra = [rows[:, :4]]
    for share, make in ((how.flicker, _flicker), (how.clutter, _clutter), (how.doubles, _double)):
        wanted = share * len(rows)
        while wanted > 0:
            ghost = make(truth, rng)
            extra.append(np.column_stack([ghost[:, 0], np.full(len(ghost), next(ids)), ghost[:, 1:]]))
            wanted -= len(ghost)
    rows = np.concatenate(extra)
    rows = rows[(rows[:, 0] >= truth[:, 0].min()) & (rows[:, 0] <= truth[:, 0].max())]
    return rows[np.argsort(rows[:, 0], kind="stable")]


def _one(path: Rows, how: Corruption, rng: np.random.Generator, ids: count) -> Rows:
    """One person's rows: hidden now and then, with noise; the last column is who it is."""
    path = path[np.argsort(path[:, 0])]
    total = len(path)
    keep = np.exp(-STEP_S / how.noise_s) if how.noise_s else 0.0
    noise = rng.normal(0, how.noise_m, (total, 2))
    for row in range(1, total):
        noise[row] = keep * noise[row - 1] + np.sqrt(1 - keep**2) * noise[row]
    moved = np.zeros(total)
    moved[1:] = np.hypot(*np.diff(path[:, 2:], axis=0).T) / STEP_S
    seen, name = np.ones(total, bool), np.empty(total, int)
    row, now = 0, next(ids)
    while row < total:
        end = min(row + int(rng.geometric(min(1.0, STEP_S / how.seen_s))), total)
        for at in range(row, end):
            if rng.random() < how.breaks_per_min * STEP_S / 60:
                now = next(ids)
            name[at] = now
        least, most = how.hidden_s
        longer = how.standing if moved[end - 1] < 0.3 else 1.0
        hidden = max(1, round(rng.uniform(least, most) * longer / STEP_S))
        seen[end : end + hidden] = False
        name[end : end + hidden] = now
        row = end + hidden
        if rng.random() < how.new_id:
            now = next(ids)
    return np.column_stack([path[:, 0], name, path[:, 2:] + noise, path[:, 1]])[seen]


def _merged(rows: Rows, merge_m: float, ids: count) -> Rows:
    """Who is nearer than ``merge_m`` to another is one box with them, under the id of one; apart, the other is new."""
    swallowed: set[float] = set()
    name: dict[float, float] = {}
    out = []
    for group in np.split(rows, np.flatnonzero(np.diff(rows[:, 0])) + 1):
        now, gone = group.copy(), np.zeros(len(group), bool)
        for a in range(len(now)):
            off = np.hypot(*(now[:, 2:4] - now[a, 2:4]).T)
            others = np.flatnonzero((off < merge_m) & ~gone & (np.arange(len(now)) > a))
            if not gone[a] and len(others):
                gone[others] = True
                now[a, 2:4] = now[[a, *others], 2:4].mean(axis=0)
        for row, hidden in zip(now, gone, strict=True):
            if not hidden and row[4] in swallowed:
                name[row[1]] = next(ids)
            row[1] = name.get(row[1], row[1])
        swallowed = (swallowed - set(now[~gone, 4])) | set(now[gone, 4])
        out.append(now[~gone])
    return np.concatenate(out)


def _exchanged(rows: Rows, swap: float, rng: np.random.Generator) -> Rows:
    """Neighbours exchange ids now and then, for good."""
    rows = rows.copy()
    name: dict[float, float] = {}
    for low, high in zip(
        np.searchsorted(rows[:, 0], np.unique(rows[:, 0])),
        np.searchsorted(rows[:, 0], np.unique(rows[:, 0]), "right"),
        strict=True,
    ):
        now = rows[low:high]
        for row in now:
            row[1] = name.get(row[1], row[1])
        near = np.argwhere(np.triu(np.hypot(*(now[:, None, 2:4] - now[None, :, 2:4]).transpose(2, 0, 1)) < 1.5, 1))
        for a, b in near[rng.random(len(near)) < swap]:
            first, second = now[a, 1], now[b, 1]
            back = {shown: own for own, shown in name.items()}
            own_a, own_b = back.get(first, first), back.get(second, second)
            name[own_a], name[own_b] = second, first
            now[a, 1], now[b, 1] = second, first
    return rows


def _walk(start: Rows, steps: int, size_m: float, rng: np.random.Generator) -> Rows:
    places = start + np.concatenate([np.zeros((1, 2)), np.cumsum(rng.normal(0, size_m, (steps - 1, 2)), axis=0)])
    return np.asarray(places)


def _flicker(truth: Rows, rng: np.random.Generator) -> Rows:
    steps = int(rng.integers(2, 10))
    place = rng.uniform(truth[:, 2:].min(axis=0), truth[:, 2:].max(axis=0))
    return np.column_stack([rng.choice(truth[:, 0]) + np.arange(steps), _walk(place, steps, 0.3, rng)])


def _clutter(truth: Rows, rng: np.random.Generator) -> Rows:
    steps = int(rng.integers(12, 76))
    place = rng.uniform(truth[:, 2:].min(axis=0), truth[:, 2:].max(axis=0))
    rows = np.column_stack([rng.choice(truth[:, 0]) + np.arange(steps), place + rng.normal(0, 0.12, (steps, 2))])
    return rows[rng.random(steps) < 0.85]


def _double(truth: Rows, rng: np.random.Generator) -> Rows:
    path = truth[truth[:, 1] == rng.choice(np.unique(truth[:, 1]))]
    steps = int(rng.integers(5, 31))
    start = int(rng.integers(0, max(1, len(path) - steps)))
    angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(0.4, 0.9)
    part = path[np.argsort(path[:, 0])][start : start + steps]
    off = far * np.array([np.cos(angle), np.sin(angle)]) + rng.normal(0, 0.12, (len(part), 2))
    return np.column_stack([part[:, 0], part[:, 2:] + off])
