"""Errors of trackers: true tracks of people in, tracks as a tracker might have made them out.

Rows are (step, id, x, y): whole steps of the prediction clock, metres. No two kinds of corruption share a cause, so
that settings which are good for all of them fit no single model of noise. A kind, a truth and a seed give the same rows
every time, and new kinds don't change what the others draw.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import count
from pathlib import Path
from typing import Final

import numpy as np

STEP_S: Final = 0.4
Rows = np.ndarray


def whole_people(path: Path) -> Rows:
    """Rows (step, person, x, y) of a TrajNet file (frame id x y).

    TrajNet chops people into pieces with ids of their own; pieces that continue where another ended are joined.
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
    """The errors of a tracker, in seconds and metres; rates are per person.

    ``noise_m`` of every position, which varies with a time constant of ``noise_s``. People are seen for ``seen_s`` on
    average and then missed for ``hidden_s`` (least, most), ``standing`` times as long if they stand; after that they
    have a new id with probability ``new_id``. ``breaks_per_min`` are new ids without a gap, ``swap`` is the probability
    at each step that two people within 1.5 m exchange ids. People within ``merge_m`` of each other are one detection:
    while they are so near, or, with ``merge_s``, two of them for that long, unless they part by more than
    ``_APART_M``, and then not again for as long.

    False tracks are given as shares of the rows of people. ``flicker`` wanders for less than 4 s, ``clutter`` stays at
    one place for up to half a minute, ``lit`` are places that give detections again and again for minutes. ``doubles``
    are beside a person for a few seconds, ``beside`` at a constant offset from a person's detections for longer.
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
    merge_s: float = 0.0
    lit: float = 0.0
    beside: float = 0.0


#: Two people who are farther apart than this are no longer one detection.
_APART_M: Final = 3.0
#: Seconds: how long a place gives detections again and again, how long at once, and how long it doesn't in between.
_LIT_S, _ON_S, _OFF_S = (60.0, 240.0), (2.0, 30.0), (0.8, 15.0)
#: Seconds that a double at a constant offset lasts, and the offset in metres.
_BESIDE_S, _BESIDE_M = (10.0, 60.0), (0.5, 1.2)

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
    "lit places": replace(_BASE, lit=0.15),
    "constant doubles": replace(_BASE, beside=0.15),
    "long merges": replace(_BASE, merge_m=1.2, merge_s=10.0, swap=0.0),
    "long gaps": replace(_BASE, seen_s=8.0, hidden_s=(0.4, 8.0), new_id=0.7),
    "broken every second": replace(_BASE, breaks_per_min=60.0, new_id=1.0),
    "mixed": replace(
        _BASE,
        noise_m=0.18,
        seen_s=5.0,
        hidden_s=(0.4, 5.0),
        new_id=0.7,
        breaks_per_min=4.0,
        merge_m=0.9,
        swap=0.04,
        clutter=0.04,
        doubles=0.03,
        lit=0.06,
        beside=0.04,
    ),
}


def corrupt(truth: Rows, how: Corruption, rng: np.random.Generator) -> Rows:
    """Tracks (step, id, x, y) as a tracker might make them of true rows, ordered by step."""
    return with_people(truth, how, rng)[:, :4]


def with_people(truth: Rows, how: Corruption, rng: np.random.Generator) -> Rows:
    """The same with the person that each row is of in a last column, -1 for nobody."""
    ids = count(1)
    rows = np.concatenate([_one(truth[truth[:, 1] == who], how, rng, ids) for who in np.unique(truth[:, 1])])
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    if how.merge_s:
        rows = _merged_for(rows, how.merge_m, how.merge_s, rng, ids)
    elif how.merge_m:
        rows = _merged(rows, how.merge_m, ids)
    rows = _exchanged(rows, how.swap, rng)
    extra = [rows]
    for share, make in ((how.flicker, _flicker), (how.clutter, _clutter), (how.doubles, _double)):
        wanted = share * len(rows)
        while wanted > 0:
            ghost = make(truth, rng)
            extra.append(
                np.column_stack([ghost[:, 0], np.full(len(ghost), next(ids)), ghost[:, 1:], np.full(len(ghost), -1)])
            )
            wanted -= len(ghost)
    for share, parts_of in ((how.lit, _lit(truth, rng)), (how.beside, _beside(rows, rng))):
        wanted = share * len(rows)
        while wanted > 0:
            ghost = next(parts_of)
            extra.append(
                np.column_stack([ghost[:, 0], np.full(len(ghost), next(ids)), ghost[:, 1:], np.full(len(ghost), -1)])
            )
            wanted -= len(ghost)
    rows = np.concatenate(extra)
    rows = rows[(rows[:, 0] >= truth[:, 0].min()) & (rows[:, 0] <= truth[:, 0].max())]
    return rows[np.argsort(rows[:, 0], kind="stable")]


def _nobody(ghost: Rows, name: int) -> Rows:
    """A false track (step, x, y) as rows with an id, of no person."""
    return np.column_stack([ghost[:, 0], np.full(len(ghost), name), ghost[:, 1:], np.full(len(ghost), -1)])


def _one(path: Rows, how: Corruption, rng: np.random.Generator, ids: count) -> Rows:
    """The rows of one person, with gaps and noise; the last column is the person."""
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
    """People nearer than ``merge_m`` are one detection with the id of one; the others get new ids once they part."""
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


def _merged_for(rows: Rows, merge_m: float, merge_s: float, rng: np.random.Generator, ids: count) -> Rows:
    """Two people who come within ``merge_m`` are one detection for ``merge_s``: midway, with the id of one.

    The other gets a new id afterwards. The two then stay apart for as long.
    """
    length = round(merge_s / STEP_S)
    merges: dict[float, tuple[float, float]] = {}  # of the hidden person: the other one, and the last step
    rests: dict[tuple[float, float], float] = {}
    parted: set[float] = set()  # people who get a new id when they are seen again
    name: dict[float, float] = {}
    out = []
    for group in np.split(rows, np.flatnonzero(np.diff(rows[:, 0])) + 1):
        now, step = group.copy(), float(group[0, 0])
        place = {person: row[2:4] for person, row in zip(now[:, 4].tolist(), group, strict=True)}
        for hidden, (shown, last) in list(merges.items()):
            both = hidden in place and shown in place
            if step > last or (both and np.hypot(*(place[hidden] - place[shown])) > _APART_M):
                del merges[hidden]
                parted.add(hidden)
                rests[min(hidden, shown), max(hidden, shown)] = step + length
        people = sorted(place)
        pairs = [(float(np.hypot(*(place[a] - place[b]))), a, b) for k, a in enumerate(people) for b in people[k + 1 :]]
        for apart_m, *pair in sorted(pairs):
            busy = {*merges, *(shown for shown, _ in merges.values())}
            if apart_m < merge_m and not busy & set(pair) and rests.get((pair[0], pair[1]), step) <= step:
                hidden, shown = pair if rng.random() < 0.5 else pair[::-1]
                merges[hidden] = shown, step + length - 1
        for row in now:
            if row[4] in parted and row[4] not in merges:
                name[row[1]] = next(ids)
                parted.discard(row[4])
            row[1] = name.get(row[1], row[1])
        gone = np.zeros(len(now), bool)
        for hidden, (shown, _) in merges.items():
            if hidden in place and shown in place:
                now[now[:, 4] == shown, 2:4] = (place[hidden] + place[shown]) / 2
                gone |= now[:, 4] == hidden
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


def _lit(truth: Rows, rng: np.random.Generator) -> Iterator[Rows]:
    """False tracks (step, x, y), one after another: each place gives some before the next does."""
    low, high = truth[:, 2:].min(axis=0), truth[:, 2:].max(axis=0)
    while True:
        place, step = rng.uniform(low, high), float(rng.choice(truth[:, 0]))
        until = min(step + rng.uniform(*_LIT_S) / STEP_S, truth[:, 0].max())
        while step <= until:
            steps = step + np.arange(max(1, round(rng.uniform(*_ON_S) / STEP_S)))
            steps = steps[steps <= until]
            yield np.column_stack([steps, place + rng.normal(0, 0.1, (len(steps), 2))])
            step = float(steps[-1]) + 1 + round(rng.uniform(*_OFF_S) / STEP_S)


def _beside(rows: Rows, rng: np.random.Generator) -> Iterator[Rows]:
    """False tracks (step, x, y) at a constant offset from the rows of a person (the last column)."""
    people = np.unique(rows[:, 4])
    while True:
        own = rows[rows[:, 4] == rng.choice(people)]
        start = float(rng.choice(own[:, 0]))
        part = own[(own[:, 0] >= start) & (own[:, 0] < start + rng.uniform(*_BESIDE_S) / STEP_S)]
        angle, far_m = rng.uniform(0, 2 * np.pi), rng.uniform(*_BESIDE_M)
        offset = far_m * np.array([np.cos(angle), np.sin(angle)])
        yield np.column_stack([part[:, 0], part[:, 2:4] + offset + rng.normal(0, 0.05, (len(part), 2))])


@cache
def crowds(count: int, steps: int, seed: int) -> list[Rows]:
    """The true rows (step, person, x, y) of synthetic crowds: people walk through a place that a camera sees.

    The place is the middle of the square in which they walk, so that people enter and leave it; a person who comes back
    is another one.
    """
    from mcaptrack.sources import walks

    people, parts = walks.PEOPLE, walks.WALKS_EACH  # consecutive walks of one person follow each other
    paths, _ = walks.walks(count * people * parts, -(-steps // parts), STEP_S, seed)
    out = []
    for places in paths.reshape(count, people, -1, 2)[:, :, :steps]:
        low, high = np.quantile(places.reshape(-1, 2), [0.1, 0.9], axis=0)
        seen = ((places > low) & (places < high)).all(axis=-1)
        enters = seen & ~np.pad(seen, ((0, 0), (1, 0)))[:, :-1]
        person = enters.ravel().cumsum().reshape(seen.shape)
        row, step = np.nonzero(seen)
        rows = np.column_stack([step, person[row, step], places[row, step]])
        out.append(rows[np.argsort(rows[:, 0], kind="stable")])
    return out
