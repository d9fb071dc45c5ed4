"""How the settings of re-tracking were chosen: scores on true tracks that are corrupted in several ways.

Takes a folder of TrajNet text files (frame id x y, in metres, annotated at 2.5 Hz), puts their chopped pieces together
again, corrupts them, and prints IDF1 / MOTA / switches at 1 m for every candidate. No candidate is judged by one kind
of corruption alone. Use training scenes; scenes that are reported on must not be looked at here.

    .venv/bin/python tools/choose_retrack.py FOLDER [--scenes 4]
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mcaptrack.evaluation import matchup
from mcaptrack.metrics import combine, score, summary
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.transforms import PROFILES, Retrack, Sample

STEP_S = 0.4
GATE_M = 1.0


@dataclass(frozen=True)
class Corruption:
    """What goes wrong: noise (and how slowly it varies), holes, broken and exchanged ids, tracks of nobody."""

    noise_m: float = 0.2
    slowness: float = 0.0
    kept_steps: float = 4.7
    longest_hole: int = 3
    new_id: float = 0.5
    swap: float = 0.03
    clutter: float = 0.1
    clutter_steps: int = 8


CORRUPTIONS = {
    "noisy": Corruption(),
    "slow noise": Corruption(noise_m=0.1, slowness=0.7),
    "very noisy": Corruption(noise_m=0.4),
    "long holes": Corruption(0.15, 0.5, 15, 8, 1.0, 0.06),
    "clutter": Corruption(noise_m=0.15, clutter=0.3, clutter_steps=20),
}

DEFAULT = PROFILES["default"]
CANDIDATES: dict[str, Retrack] = {
    **PROFILES,
    "first step, 2 sigma": replace(PROFILES["paper"], distance="first", max_distance=2.0),
    **{f"noise {noise:g} m": replace(DEFAULT, noise_m=noise) for noise in (0.2, 0.3)},
    **{f"gate {gate:g}": replace(DEFAULT, max_distance=gate) for gate in (2.0, 4.0)},
    **{f"same source {bonus:g}": replace(DEFAULT, same_source=bonus) for bonus in (0.0, 2.0)},
    **{f"age {age:g} s": replace(DEFAULT, max_age_s=age) for age in (2.0, 3.2)},
    "any jump": replace(DEFAULT, max_jump_m=None),
}


def whole_people(path: Path) -> np.ndarray:
    """Rows of frame, id, x, y whose ids are people: pieces that go on where another ended are put together."""
    rows = np.loadtxt(path, delimiter="," if "," in path.read_text()[:200] else None)
    pieces = {who: rows[rows[:, 1] == who] for who in np.unique(rows[:, 1])}
    pieces = {who: piece[np.argsort(piece[:, 0])] for who, piece in pieces.items() if len(piece) > 1}
    step = np.gcd.reduce(np.diff(np.unique(rows[:, 0])).astype(int))
    follows: dict[float, float] = {}
    for who, piece in pieces.items():
        expected = 2 * piece[-1, 2:] - piece[-2, 2:]
        later = [
            (float(np.hypot(*(other[0, 2:] - expected))), name)
            for name, other in pieces.items()
            if other[0, 0] == piece[-1, 0] + step and name not in follows.values()
        ]
        if later and min(later)[0] < 0.6:
            follows[who] = min(later)[1]
    out = []
    for person, start in enumerate(who for who in pieces if who not in follows.values()):
        who: float | None = start
        while who is not None:
            piece = pieces[who].copy()
            piece[:, 0] /= step
            piece[:, 1] = person
            out.append(piece)
            who = follows.get(who)
    return np.concatenate(out)


def corrupt(truth: np.ndarray, how: Corruption, rng: np.random.Generator) -> np.ndarray:
    """Rows as a tracker might give them."""
    left: dict[int, tuple[bool, int]] = {}  # seen or hidden, and for how many steps still
    name: dict[int, int] = {}
    off: dict[int, np.ndarray] = {}
    rows, names = [], iter(range(1_000_000))
    for step in np.unique(truth[:, 0]):
        there = []
        for _, who, x, y in truth[truth[:, 0] == step]:
            person = int(who)
            if person not in left:
                left[person], name[person] = (True, int(rng.geometric(1 / how.kept_steps))), next(names)
            fresh = rng.normal(0, how.noise_m, 2)
            off[person] = how.slowness * off.get(person, fresh) + np.sqrt(1 - how.slowness**2) * fresh
            seen, steps = left[person]
            if seen:
                rows.append((step, name[person], x + off[person][0], y + off[person][1]))
                there.append((person, x, y))
            if steps > 1:
                left[person] = (seen, steps - 1)
            elif seen:
                left[person] = (False, int(rng.integers(1, how.longest_hole + 1)))
            else:
                left[person] = (True, int(rng.geometric(1 / how.kept_steps)))
                if rng.random() < how.new_id:
                    name[person] = next(names)
        for number, (a, x, y) in enumerate(there):
            for b, u, v in there[number + 1 :]:
                if np.hypot(x - u, y - v) < 1.5 and rng.random() < how.swap:
                    name[a], name[b] = name[b], name[a]
    wanted, low, high = how.clutter * len(rows), truth[:, 2:].min(axis=0), truth[:, 2:].max(axis=0)
    while wanted > 0:
        length, start, place = (
            int(rng.integers(2, how.clutter_steps + 1)),
            rng.choice(truth[:, 0]),
            rng.uniform(low, high),
        )
        ghost = next(names)
        for step in range(length):
            rows.append((start + step, ghost, *place))
            place = place + rng.normal(0, 0.3, 2)
        wanted -= length
    return np.array(rows)


def frames(rows: np.ndarray, steps: np.ndarray) -> list[Frame]:
    """Rows as frames on the clock of prediction, empty ones too."""
    out = []
    for step in steps.astype(int):
        now = rows[rows[:, 0] == step]
        observed, nowhere = np.ones(len(now), bool), np.full(len(now), -1)
        content = TRACKS.rows(
            track_id=now[:, 1].astype(int), x_m=now[:, 2], y_m=now[:, 3], observed=observed, source_id=nowhere
        )
        out.append(Frame(round(step * STEP_S * 1e9), int(step), content))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", type=int, default=6, help="how many of the largest scenes to use")
    given = parser.parse_args()
    files = sorted(given.folder.glob("*.txt"), key=lambda path: -path.stat().st_size)[: given.scenes]
    worlds = {}
    for kind, how in CORRUPTIONS.items():
        worlds[kind] = []
        for number, path in enumerate(files):
            truth = whole_people(path)
            steps = np.arange(truth[:, 0].min(), truth[:, 0].max() + 1)
            tracks = frames(corrupt(truth, how, np.random.default_rng(number)), steps)
            true = frames(truth, steps)
            worlds[kind].append((true, [f for (f,) in Sample(start_ns=true[0].t_ns)(tracks)]))
    print(f"{'IDF1 / MOTA / switches':24}" + "".join(f"{kind:>20}" for kind in worlds) + f"{'mean IDF1':>12}")
    for name, candidate in {"input": None, **CANDIDATES}.items():
        cells, total = [], []
        for members in worlds.values():
            parts = []
            for true, samples in members:
                found = [result[0] for result in candidate(samples)] if candidate else samples
                parts.append(score(matchup(true, found, "metres", GATE_M)))
            row = summary(combine(parts))
            total.append(row["IDF1"])
            cells.append(f"{100 * row['IDF1']:.1f} / {100 * row['MOTA']:.1f} / {row['IDSW']}")
        print(f"{name:24}" + "".join(f"{cell:>20}" for cell in cells) + f"{100 * np.mean(total):>12.1f}", flush=True)


if __name__ == "__main__":
    main()
