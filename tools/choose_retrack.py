"""How the settings of re-tracking were chosen: scores on true tracks that are corrupted in eight ways.

Takes a folder of TrajNet text files (frame id x y, in metres, annotated at 2.5 Hz), puts their chopped pieces together
again, corrupts them (`corruptions.py`), and prints IDF1 / MOTA / switches at 1 m for every candidate and every kind of
corruption. With --fit it prints the weights of what tells people from false tracks and right links from wrong ones.
Use training scenes; scenes that are reported on must not be looked at here.

    .venv/bin/python tools/choose_retrack.py FOLDER [--scenes 6] [--seed 0] [--fit]
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from corruptions import CORRUPTIONS, STEP_S, corrupt, whole_people

from mcaptrack.evaluation.aligned import matchup
from mcaptrack.match import assign
from mcaptrack.metrics import combine, score, summary
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.transforms import PROFILES, Retrack, Sample
from mcaptrack.transforms.retrack import doubt, link
from mcaptrack.transforms.retrack.following import Following, walker
from mcaptrack.transforms.retrack.motion import State, smooth
from mcaptrack.transforms.retrack.whole import laid

GATE_M = 1.0
SCENES = ("coupa_3", "gates_1", "hyang_5", "nexus_2", "bookstore_2", "deathCircle_3")
LIMIT_STEPS = 900

DEFAULT = PROFILES["default"]
CANDIDATES: dict[str, Retrack] = {
    **PROFILES,
    **{f"same source {bonus:g}": replace(DEFAULT, same_source=bonus) for bonus in (0.0, 6.0, 18.0)},
    **{f"age {age:g} s": replace(DEFAULT, max_age_s=age) for age in (1.2, 3.2)},
    **{f"noise {noise:g} m": replace(DEFAULT, noise_m=noise) for noise in (0.1, 0.2, 0.3)},
    **{f"drift {drift:g}": replace(DEFAULT, drift=drift) for drift in (0.08, 0.18)},
    **{f"links within {most:g} s": replace(DEFAULT, link_s=most) for most in (0.0, 8.0, 20.0)},
    "meetings as they are": replace(DEFAULT, part=False),
    **{f"certainty {least:g}": replace(DEFAULT, min_certainty=least) for least in (0.0, 0.3, 0.7)},
    "not smoothed": replace(DEFAULT, smooth=False),
}

World = dict[str, tuple[list[Frame], list[Frame]]]


def frames(rows: np.ndarray, steps: np.ndarray) -> list[Frame]:
    """Rows as frames on the clock of prediction, empty ones too."""
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    bounds = np.searchsorted(rows[:, 0], np.append(steps, steps[-1] + 1))
    out = []
    for step, low, high in zip(steps.astype(int).tolist(), bounds[:-1], bounds[1:], strict=True):
        now = rows[low:high]
        content = TRACKS.rows(
            track_id=now[:, 1].astype(int),
            x_m=now[:, 2],
            y_m=now[:, 3],
            observed=np.ones(len(now), bool),
            source_id=np.full(len(now), -1),
        )
        out.append(Frame(round(step * STEP_S * 1e9), step, content))
    return out


def worlds(files: list[Path], seed: int) -> dict[str, World]:
    """Truth and samples of every scene, by the kind of corruption."""
    out: dict[str, World] = {}
    for kind, how in CORRUPTIONS.items():
        out[kind] = {}
        for number, path in enumerate(files):
            truth = whole_people(path)
            truth = truth[truth[:, 0] < truth[:, 0].min() + LIMIT_STEPS]
            steps = np.arange(truth[:, 0].min(), truth[:, 0].max() + 1)
            tracks = frames(corrupt(truth, how, np.random.default_rng([seed, number])), steps)
            true = frames(truth, steps)
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
                parts.append(score(matchup(true, found, "metres", GATE_M), "motmetrics"))
            row = summary(combine(parts))
            means.append((row["IDF1"], row["MOTA"]))
            cells.append(f"{100 * row['IDF1']:.1f} / {100 * row['MOTA']:.1f} / {row['IDSW']}")
        id_f1, mota = 100 * np.mean(means, axis=0)
        mean = f"{id_f1:.1f} / {mota:.1f}"
        print(f"{name:24}" + "".join(f"{cell:>20}" for cell in cells) + f"{mean:>14}", flush=True)


def _followed(true: list[Frame], samples: list[Frame]) -> tuple:
    """The tracks before anything is done to them, laid end to end, and the true person of each row, or -1."""
    run = Following(DEFAULT)
    for frame in samples:
        run.tick(frame)
    rows = np.concatenate(run.samples)
    step, track, _, key = run.claims.on(rows, run.steps, [len(part) for part in run.samples])
    xy = np.stack([rows["x_m"][key], rows["y_m"][key]], axis=-1)
    who = walker(DEFAULT, run.noise_m)
    ids, at, paths = laid(step, track, xy, who.noise_m)
    owner = np.full(len(paths.step), -1)
    length = np.diff(paths.first)
    number = np.searchsorted(ids, track)
    for tick in np.unique(step):
        here, people = np.flatnonzero(step == tick), true[run.steps.index(int(tick))].rows
        off = np.hypot(xy[here, 0][:, None] - people["x_m"], xy[here, 1][:, None] - people["y_m"])
        off = np.where(off < GATE_M, off + 1.5 * (1 - length[number[here]] / length.max())[:, None], np.inf)
        row, column = assign(off, 10.0)  # who is tracked for long is the person, who is beside them is not
        owner[at[here[row]]] = people["track_id"][column]
    return who, paths, owner


def _logistic(features: np.ndarray, right: np.ndarray, weight: np.ndarray) -> np.ndarray:
    from scipy.optimize import minimize

    mean, spread = features.mean(axis=0), features.std(axis=0) + 1e-9
    z = np.column_stack([(features - mean) / spread, np.ones(len(features))])

    def loss(t: np.ndarray) -> float:
        return float(
            (weight / weight.mean() * (np.logaddexp(0, z @ t) - right * (z @ t))).mean() + 1e-3 * t[:-1] @ t[:-1]
        )

    t = minimize(loss, np.zeros(z.shape[1]), method="BFGS").x
    return np.append(t[:-1] / spread, t[-1] - (t[:-1] * mean / spread).sum())


def fit(everything: dict[str, World]) -> None:
    """Print the weights of `doubt.py` and `link.py`."""
    people: list[np.ndarray] = []
    links: list[np.ndarray] = []
    for kind, world in everything.items():
        for true, samples in world.values():
            who, paths, owner = _followed(true, samples)
            forward, backward, smoothed = smooth(who, paths, STEP_S)
            first, last = paths.first[:-1], paths.first[1:] - 1
            seen = np.isfinite(paths.xy_m[:, 0])
            count = np.add.reduceat(seen.astype(float), first)
            share = np.add.reduceat((owner >= 0).astype(float), first) / count
            people.append(np.column_stack([doubt.features(who, paths, smoothed, STEP_S), share, count]))
            if kind not in ("hidden long", "merges"):
                continue  # elsewhere hardly any link is right, and how many are is found out in each log
            odds = doubt.log_odds(who, paths, smoothed, STEP_S)
            follows = link.link(who, paths, forward, backward, STEP_S, 24.0, 1e-9, odds)
            i = np.flatnonzero(follows >= 0)
            j = follows[i]
            hole = (paths.step[first[j]] - paths.step[last[i]]) * STEP_S
            back = backward.take(first[j])
            walked, stayed = link.evidence(
                who, paths, forward.take(last[i]), State(back.mean, back.cov), last[i], first[j], hole, STEP_S
            )
            same = [
                owner[a] >= 0 and owner[a] == owner[b]
                for a, b in zip(_end(owner, paths, i), _begin(owner, paths, j), strict=True)
            ]
            nobody = np.minimum(odds, 0.0)
            links.append(np.column_stack([np.maximum(walked, stayed), hole, nobody[i] + nobody[j], same]))
    rows = np.concatenate(people)
    print(
        "doubt:",
        dict(
            zip((*doubt.NAMES, "1"), _logistic(rows[:, :-2], rows[:, -2], rows[:, -1]).round(3).tolist(), strict=True)
        ),
    )
    rows = np.concatenate(links)
    weights = _logistic(rows[:, :-1], rows[:, -1], np.ones(len(rows))).round(3).tolist()
    print(
        "link:", dict(zip(("evidence", "hole", "nobody", "1"), weights, strict=True)), f"right {rows[:, -1].mean():.3f}"
    )


def _end(owner: np.ndarray, paths, tracks: np.ndarray) -> list[int]:
    """The last row of each track that is somebody's."""
    return [
        int(np.max(np.flatnonzero(owner[paths.first[k] : paths.first[k + 1]] >= 0), initial=-1) + paths.first[k])
        for k in tracks
    ]


def _begin(owner: np.ndarray, paths, tracks: np.ndarray) -> list[int]:
    out = []
    for k in tracks:
        there = np.flatnonzero(owner[paths.first[k] : paths.first[k + 1]] >= 0)
        out.append(int(there[0] + paths.first[k]) if len(there) else int(paths.first[k]))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", type=int, default=len(SCENES), help="how many scenes to use")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--online", action="store_true", help="score what was known at the time")
    parser.add_argument("--fit", action="store_true", help="print weights instead of scores")
    given = parser.parse_args()
    named = [given.folder / f"{name}.txt" for name in SCENES]
    files = [path for path in named if path.exists()] or sorted(given.folder.glob("*.txt"))
    everything = worlds(files[: given.scenes], given.seed)
    if given.fit:
        fit(everything)
    else:
        table(everything, int(given.online))


if __name__ == "__main__":
    main()
