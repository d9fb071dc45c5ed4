"""Which tracks are people: a slow reference that uses nothing of the package. A path is positions by step.

As in `offline`, constants stand here a second time, and only what was fitted is read from its file.
"""

from __future__ import annotations

from itertools import pairwise
from math import hypot, log, sqrt

import numpy as np
from scipy.optimize import minimize

from tests.references.offline import FITTED, Motion, Path, State

PEOPLE, PERSON_BIAS = FITTED["people"]["weights"], FITTED["people"]["bias"]
DECIDED, DECIDED_BIAS = FITTED["decided"]["weights"]["log odds"], FITTED["decided"]["bias"]
THROUGHOUT = FITTED["people"]["stands throughout"]
DUPLICATE_M, BESIDE_M, BESIDE_SAMPLES, GOES_M = 1.2, 1.8, 4, 3.0


def person_features(motion: Motion, paths: dict[int, Path]) -> dict[int, dict[str, float]]:
    """For each track its features by name."""
    where = {name: motion.smoothed(path) for name, path in paths.items()}
    goes = [name for name, states in where.items() if extent(states) > GOES_M]
    out = {}
    for name, path in paths.items():
        states = where[name]
        length, count = len(states), len(path)
        off = sum(((np.array(at) - states[step].mean[:, 0]) ** 2).sum() for step, at in path.items())
        speed = sum(hypot(*state.mean[:, 1]) for state in states.values()) / length
        errors = min(sqrt(off / count / 2) / motion.noise_m, 1)
        share, in_step = companion(name, paths, where, motion.noise_m, errors)
        out[name] = {
            "log length": log(length * motion.step_s),
            "log count": log(count),
            "log extent": log(extent(states) + 0.3),
            "log speed": log(speed + 0.1),
            "log roughness": log(off / count / (2 * motion.noise_m**2) + 0.1),
            "observed": count / length,
            "duplicate": max((inside(states, other) for who, other in where.items() if who != name), default=0.0),
            "beside": share,
            "in step": in_step,
            "rare gaps": rarity(
                gaps(path),
                [gap for who in goes if who != name for gap in gaps(paths[who])]
                + [gap for gap in gaps(path) if name in goes],
                name in goes,
            ),
        }
    return out


def stands_throughout(motion: Motion, path: Path, in_step: float, log: tuple[int, int]) -> bool:
    """Whether a track stands still from the first step of the log to the last, and is no double.

    It may be missed for 2 s, at its ends for a tenth of the log at most, which lasts at least 10 s.
    """
    lasts = (log[1] - log[0]) * motion.step_s
    late, early = (min(path) - log[0]) * motion.step_s, (log[1] - max(path)) * motion.step_s
    is_there = max(late, early) <= min(2.0, 0.1 * lasts) + 1e-9 and max(gaps(path), default=0) * motion.step_s <= 2.0
    return is_there and lasts >= 10 - 1e-9 and in_step < 1.0 and extent(motion.smoothed(path)) < 1.5


def log_odds_in_log(motion: Motion, paths: dict[int, Path], log: tuple[int, int]) -> dict[int, float]:
    """For each track the log odds that it is a person, by weights that follow the log, of these steps.

    For these the entropy of the tracks plus the distance from the fitted weights is least.
    """
    found = person_features(motion, paths)
    stand = [stands_throughout(motion, path, found[name]["in step"], log) for name, path in paths.items()]
    extra = np.array(stand) * THROUGHOUT
    mean, spread = (np.array([FITTED["people"][what][one] for one in PEOPLE]) for what in ("mean", "spread"))
    fitted = np.array(list(PEOPLE.values()))
    known = np.array([[*((np.array([of[one] for one in PEOPLE]) - mean) / spread), 1.0] for of in found.values()])
    counts = np.array([min(len(path), 20) / 8 for path in paths.values()])
    start = np.append(fitted * spread, PERSON_BIAS + fitted @ mean)

    def loss(weights: np.ndarray) -> float:
        likely = np.clip(1 / (1 + np.exp(-known @ weights - extra)), 1e-12, 1 - 1e-12)
        entropy = -likely * np.log(likely) - (1 - likely) * np.log(1 - likely)
        return float(counts @ entropy + 10 * ((weights - start) ** 2).sum())

    best = minimize(loss, start, method="BFGS", options={"gtol": 1e-6}).x
    return dict(zip(found, (known @ best + extra).tolist(), strict=True))


def extent(states: dict[int, State]) -> float:
    """The diagonal of the box around the places of a track."""
    places = np.array([state.mean[:, 0] for state in states.values()])
    return hypot(*(places.max(axis=0) - places.min(axis=0)))


def inside(mine: dict[int, State], theirs: dict[int, State]) -> float:
    """The share of a track's steps beside another track that began well before it and ended well after it."""
    if not (min(theirs) + 3 < min(mine) and max(theirs) - 3 > max(mine)):
        return 0.0
    near = [s for s in mine if s in theirs and hypot(*(mine[s].mean[:, 0] - theirs[s].mean[:, 0])) < DUPLICATE_M]
    return len(near) / len(mine)


def companion(name: int, paths: dict[int, Path], where: dict, noise_m: float, errors: float) -> tuple[float, float]:
    """The share of a track's samples beside the longer track with which it is most in step; and how much it is."""
    best = (0.0, 0.0)
    mine = paths[name]
    for who, theirs in paths.items():
        if (len(theirs), -who) <= (len(mine), -name):
            continue
        off = [where[name][s].mean[:, 0] - where[who][s].mean[:, 0] for s in sorted(mine) if s in theirs]
        both = [s for s, by in zip(sorted(set(mine) & set(theirs)), off, strict=True) if hypot(*by) < BESIDE_M]
        if len(both) < BESIDE_SAMPLES:
            continue
        apart = np.array([np.subtract(mine[s], theirs[s]) for s in both])
        variance = apart.var(axis=0, ddof=1).mean() / 2  # of one of the two, on one axis
        share = len(both) / len(mine)
        steadier = log(2) + log((errors + 0.05) / 1.05) - log(sqrt(variance) / noise_m + 0.05)
        best = max(best, (share * max(steadier, 0.0), share))
    return best[1], best[0]


def gaps(path: Path) -> list[int]:
    """The steps without a sample between two with one."""
    return [b - a - 1 for a, b in pairwise(sorted(path)) if b > a + 1]


def rarity(own: list[int], usual: list[int], is_among: bool) -> float:
    """The mean of -log of the share of gaps that are as long as each of a track's own, itself not counted."""
    others = len(usual) - is_among
    rare = [-log((sum(gap >= one for gap in usual) - is_among + 1) / (others + 2)) for one in own]
    return sum(rare) / max(len(rare), 1)
