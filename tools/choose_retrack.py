"""How the settings of re-tracking were chosen: scores on true tracks that are corrupted in many ways.

Takes a folder of TrajNet text files (frame id x y, in metres, annotated at 2.5 Hz), puts their chopped pieces together
again, corrupts them (`corruptions.py`), and prints IDF1 / MOTA / switches at 1 m for every candidate and every kind of
corruption. With --fit it prints the weights of what tells people from false tracks and right links from wrong ones,
from the scenes that are not scored.
Use training scenes; scenes that are reported on must not be looked at here.

    .venv/bin/python tools/choose_retrack.py FOLDER [--scenes 6] [--seed 0] [--fit]
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from corruptions import CORRUPTIONS, STEP_S, corrupt, whole_people
from reproduce import on_clock

from mcaptrack.evaluation.aligned import make_matchup
from mcaptrack.evaluation.metrics import combine, score, summary
from mcaptrack.geometry.assignment import assign, solve
from mcaptrack.schema import Frame
from mcaptrack.transforms import PROFILES, Sample
from mcaptrack.transforms.retrack import Retracking, false_tracks, linking
from mcaptrack.transforms.retrack.likelihood import LikelihoodPass, motion_model
from mcaptrack.transforms.retrack.motion_model import MotionModel, State, Trajectories, smooth, to_trajectories

GATE_M = 1.0
#: What links are fitted on, and with which of all pairs: in other scenes hardly any are right.
LINKED, MAX_GAP_S, LEAST = ("hidden long", "merges"), 30.0, -4.0
SCENES = ("coupa_3", "gates_1", "hyang_5", "nexus_2", "bookstore_2", "deathCircle_3")
LIMIT_STEPS = 900

DEFAULT = PROFILES["default"]
CANDIDATES: dict[str, Retracking] = {
    **PROFILES,
    **{f"same source {bonus:g}": replace(DEFAULT, same_id_bonus=bonus) for bonus in (0.0, 6.0, 18.0)},
    **{f"age {age:g} s": replace(DEFAULT, max_age_s=age) for age in (1.2, 3.2)},
    **{f"noise {noise:g} m": replace(DEFAULT, noise_m=noise) for noise in (0.1, 0.2, 0.3)},
    **{f"drift {drift:g}": replace(DEFAULT, drift_m_per_s=drift) for drift in (0.1, 0.18)},
    **{f"links within {most:g} s": replace(DEFAULT, link_s=most) for most in (0.0, 8.0, 14.0, 30.0)},
    "swaps not resolved": replace(DEFAULT, resolve_swaps=False),
    **{f"certainty {least:g}": replace(DEFAULT, track_confidence=least) for least in (0.0, 0.3, 0.7)},
    "not smoothed": replace(DEFAULT, smooth=False),
}

World = dict[str, tuple[list[Frame], list[Frame]]]


def worlds(files: list[Path], seed: int) -> dict[str, World]:
    """Truth and samples of every scene, by the kind of corruption."""
    out: dict[str, World] = {}
    for kind, how in CORRUPTIONS.items():
        out[kind] = {}
        for number, path in enumerate(files):
            truth = whole_people(path)
            truth = truth[truth[:, 0] < truth[:, 0].min() + LIMIT_STEPS]
            steps = np.arange(int(truth[:, 0].min()), int(truth[:, 0].max()) + 1)
            tracks = on_clock(corrupt(truth, how, np.random.default_rng([seed, number])), steps)
            true = on_clock(truth, steps)
            out[kind][path.stem] = true, [f for (f,) in Sample(start_ns=true[0].t_ns)(tracks)]
    return out


def table(everything: dict[str, World], output: int) -> None:
    """One row a candidate: IDF1 / MOTA / switches of each kind, and the means."""
    print(f"{'IDF1 / MOTA / switches':24}" + "".join(f"{kind:>20}" for kind in everything) + f"{'mean':>14}")
    for name, candidate in {"input": None, **CANDIDATES}.items():
        cells, means = [], []
        for world in everything.values():
            parts = []
            for true, samples in world.values():
                found = [result[output] for result in candidate(samples)] if candidate else samples
                parts.append(score(make_matchup(true, found, "metres", GATE_M), "motmetrics"))
            row = summary(combine(parts))
            means.append((row["IDF1"], row["MOTA"]))
            cells.append(f"{100 * row['IDF1']:.1f} / {100 * row['MOTA']:.1f} / {row['IDSW']}")
        id_f1, mota = 100 * np.mean(means, axis=0)
        mean = f"{id_f1:.1f} / {mota:.1f}"
        print(f"{name:24}" + "".join(f"{cell:>20}" for cell in cells) + f"{mean:>14}", flush=True)


def _online_tracks(true: list[Frame], samples: list[Frame]) -> tuple:
    """The online tracks as trajectories, and the true id of each row, or -1."""
    run = LikelihoodPass(DEFAULT)
    for frame in samples:
        run.step(frame)
    step, track, _, key = run.assignments.of(run.samples, run.steps)
    xy = np.stack([run.samples.column(name)[key] for name in ("x_m", "y_m")], axis=-1)
    model = motion_model(DEFAULT, run.noise_m)
    ids, at, paths = to_trajectories(step, track, xy, model.noise_m)
    owner = np.full(len(paths.step), -1)
    length = np.diff(paths.first)
    number = np.searchsorted(ids, track)
    for tick in np.unique(step):
        here, people = np.flatnonzero(step == tick), true[run.steps.index(int(tick))].rows
        off = np.hypot(xy[here, 0][:, None] - people["x_m"], xy[here, 1][:, None] - people["y_m"])
        off = np.where(off < GATE_M, off + 1.5 * (1 - length[number[here]] / length.max())[:, None], np.inf)
        row, column = assign(off, 10.0)  # the longer track is the person, a duplicate beside it is not
        owner[at[here[row]]] = people["track_id"][column]
    return model, paths, owner


def _logistic(
    features: np.ndarray, right: np.ndarray, weight: np.ndarray, group: np.ndarray | None = None
) -> np.ndarray:
    """The weights of the features and the bias; of the first group's, where each of several has a bias of its own."""
    from scipy.optimize import minimize

    mean, spread = features.mean(axis=0), features.std(axis=0) + 1e-9
    groups = np.eye(1 if group is None else int(group.max()) + 1)
    biases = groups[np.zeros(len(features), int) if group is None else group]
    z, share = np.column_stack([(features - mean) / spread, biases]), weight / weight.sum()
    count = features.shape[1]

    def loss(t: np.ndarray) -> tuple[float, np.ndarray]:
        value = z @ t
        off = share * (1 / (1 + np.exp(-value)) - right)
        shrunk = np.append(t[:count], np.zeros(len(groups)))
        return float(
            share @ (np.logaddexp(0, value) - right * value) + 1e-5 * shrunk @ shrunk
        ), z.T @ off + 2e-5 * shrunk

    t = minimize(loss, np.zeros(z.shape[1]), jac=True, method="BFGS").x
    return np.append(t[:count] / spread, t[count] - (t[:count] * mean / spread).sum())


def fit(everything: dict[str, World]) -> None:
    """Print the weights of `false_tracks.py` and `linking.py`."""
    people: list[np.ndarray] = []
    pairs: list[Pairs] = []
    for kind, world in everything.items():
        for true, samples in world.values():
            model, paths, owner = _online_tracks(true, samples)
            forward, backward, smoothed = smooth(model, paths, STEP_S)
            first = paths.first[:-1]
            seen = np.isfinite(paths.xy_m[:, 0])
            count = np.add.reduceat(seen.astype(float), first)
            share = np.add.reduceat((owner >= 0).astype(float), first) / count
            people.append(np.column_stack([false_tracks.features(model, paths, smoothed, STEP_S), share, count]))
            if kind in LINKED:
                pairs.append(_pairs(LINKED.index(kind), model, paths, forward, backward, owner))
    rows = np.concatenate(people)
    weights = _logistic(rows[:, :-2], rows[:, -2], rows[:, -1]).round(3).tolist()
    print("false tracks:", dict(zip((*false_tracks.FEATURES, "1"), weights, strict=True)))
    right = np.concatenate([one.right for one in pairs])
    group = np.concatenate([np.full(len(one.right), one.kind) for one in pairs])
    weights = _logistic(np.concatenate([one.features for one in pairs]), right, np.ones(len(right)), group)
    # The best of several competing links is right more often than its own score says: fit that in a second step.
    best = [_best(one, one.features @ weights[:-1] + weights[-1]) for one in pairs if one.kind == 0]
    gain, right = (np.concatenate(parts) for parts in zip(*best, strict=True))
    scale, shift = _logistic(gain[:, None], right, np.ones(len(right)))
    final = [*(scale * weights[:-1]), scale * weights[-1] + shift]
    print(
        "link:",
        dict(zip((*linking.FEATURES, "1"), np.round(final, 3).tolist(), strict=True)),
        f"usual {right.mean():.3f}",
    )
    print(f"      least {scale * LEAST + shift:.2f}")


class Pairs(NamedTuple):
    """Candidate links (E,) from ends to beginnings of ``count`` tracks, and which are right."""

    kind: int
    count: int
    ends: np.ndarray
    begins: np.ndarray
    features: np.ndarray
    right: np.ndarray


def _pairs(kind: int, model: MotionModel, paths: Trajectories, forward: State, backward: State, owner: np.ndarray):
    first, last = paths.first[:-1], paths.first[1:] - 1
    i, j, gap_s = linking.candidates(paths, forward, backward, STEP_S, MAX_GAP_S)
    found = linking.features(model, forward.take(last[i]), backward.take(first[j]), gap_s)
    ends, begins = (np.array([_usual(owner, paths, k, way) for k in range(len(first))]) for way in (-1, 1))
    same = np.flatnonzero((ends[i] >= 0) & (ends[i] == begins[j]))
    nearest = same[np.lexsort((gap_s[same], i[same]))]
    _, at = np.unique(i[nearest], return_index=True)  # later returns are links of later tracks
    right = np.zeros(len(i))
    right[nearest[at]] = 1
    return Pairs(kind, len(first), i, j, found, right)


def _usual(owner: np.ndarray, paths: Trajectories, track: int, way: int) -> int:
    """The true id of a track at its beginning (``way`` 1) or end (-1); -1 for none."""
    ids = owner[paths.first[track] : paths.first[track + 1]][::way]
    ids = ids[ids >= 0][:8]
    return int(np.bincount(ids).argmax()) if len(ids) else -1


def _best(pairs: Pairs, gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The gains of the best set of links, and which of them are right."""
    table, right = np.zeros((pairs.count, pairs.count)), np.zeros((pairs.count, pairs.count))
    good = gain > LEAST
    table[pairs.ends[good], pairs.begins[good]] = gain[good] - LEAST
    right[pairs.ends, pairs.begins] = pairs.right
    row, column = solve(-table)
    made = table[row, column] > 0
    return table[row[made], column[made]] + LEAST, right[row[made], column[made]]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", type=int, default=len(SCENES), help="how many scenes to use")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--online", action="store_true", help="score online tracks")
    parser.add_argument("--fit", action="store_true", help="print weights instead of scores")
    given = parser.parse_args()
    files = sorted(given.folder.glob("*.txt"))
    scored = [path for path in files if path.stem in SCENES] or files
    rest = [path for path in files if path not in scored] or files
    everything = worlds(rest if given.fit else scored[: given.scenes], given.seed)
    if given.fit:
        fit(everything)
    else:
        table(everything, int(given.online))


if __name__ == "__main__":
    main()
