"""Fit what tells right links from wrong ones and people from false tracks, on synthetic scenes with faults.

Writes mcaptrack/transforms/retrack/weights.json. Scenes are those of `crowds.py`: squares, streets, crossings and open
places with groups, people who stand, and bicycles; each is corrupted by `corruptions.py` with faults of its own. They
are sampled and re-tracked, and what re-tracking decides about is compared with who was there: links first, then the
tracks that come of these links. No recording is used. With --check it says whether the same comes out now. With --held
nothing is written: scenes of other seeds score the weights of the file. A few minutes of one core.

    .venv/bin/python tools/fit_retrack.py [--check | --held] [--seeds 101 102] [--steps 300]

Letters: K tracks, E candidate links, F features, N rows of trajectories.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from corruptions import corrupt
from crowds import drawn
from reproduce import on_clock

from mcaptrack import __version__
from mcaptrack.evaluation.aligned import make_matchup
from mcaptrack.evaluation.metrics import combine, score, summary
from mcaptrack.geometry.assignment import assign, solve
from mcaptrack.schema import Frame
from mcaptrack.transforms import PROFILES, Sample
from mcaptrack.transforms.retrack import false_tracks, linking, offline
from mcaptrack.transforms.retrack.likelihood import LikelihoodPass, motion_model
from mcaptrack.transforms.retrack.motion_model import Trajectories
from mcaptrack.transforms.retrack.weights import WEIGHTS

DEFAULT = PROFILES["default"]
#: Who is who at encounters changes neither links nor how likely a track is, and takes longest.
FITTED = replace(DEFAULT, resolve_swaps=False)
SEEDS, HELD, STEPS = (101, 102), (201,), 300
#: A track is that of a person who is as near, by most of its first or last so many rows.
GATE_M, ROWS = 1.0, 8
#: The longest gap of pairs that weights are fitted on; and the least log odds of the best set of links.
MAX_GAP_S, LEAST = 30.0, -4.0
#: How strongly weights are drawn to 0, and how strongly those that scenes have of their own (shares of right links).
RIDGE, OWN_RIDGE = 1e-5, 1e-4


class Run(NamedTuple):
    """A scene: its truth, and all that offline re-tracking is given."""

    true: list[Frame]
    samples: list[Frame]
    args: tuple[Any, ...]


def runs(seeds: Iterable[int], steps: int) -> Iterator[Run]:
    """Scenes, tracked online."""
    for seed in seeds:
        for number, (truth, how) in enumerate(drawn(seed, steps)):
            yield prepare(truth, corrupt(truth, how, np.random.default_rng([seed, number, 2])))


def prepare(truth: np.ndarray, made: np.ndarray) -> Run:
    """A scene from the rows of the truth and of a tracker."""
    clock = np.arange(int(truth[:, 0].min()), int(truth[:, 0].max()) + 1)
    true = on_clock(truth, clock)
    samples = [frame for (frame,) in Sample(start_ns=true[0].t_ns)(on_clock(made, clock))]
    run = LikelihoodPass(DEFAULT)
    for frame in samples:
        run.step(frame)
    times = np.array([frame.t_ns for frame in samples])
    return Run(
        true, samples, (DEFAULT, motion_model(DEFAULT, run.noise_m), run.assignments, run.samples, run.steps, times)
    )


@contextmanager
def calls(name: str) -> Iterator[list[tuple[Any, ...]]]:
    """What a function of offline re-tracking is called with."""
    function, seen = getattr(offline, name), []

    def kept(*given: Any) -> Any:
        seen.append(given)
        return function(*given)

    setattr(offline, name, kept)
    try:
        yield seen
    finally:
        setattr(offline, name, function)


def owners(run: Run, trajectories: Trajectories) -> np.ndarray:
    """The true id of each row of the trajectories (N,), or -1."""
    owner = np.full(len(trajectories.step), -1)
    length = np.diff(trajectories.first)
    track = np.repeat(np.arange(len(length)), length)
    seen = np.flatnonzero(np.isfinite(trajectories.xy_m[:, 0]))
    seen = seen[np.argsort(trajectories.step[seen], kind="stable")]
    where = dict(zip(run.args[4], run.true, strict=True))
    for here in np.split(seen, np.flatnonzero(np.diff(trajectories.step[seen])) + 1):
        people = where[int(trajectories.step[here[0]])].rows
        off = np.hypot(*(trajectories.xy_m[here, None, k] - people[name] for k, name in enumerate(("x_m", "y_m"))))
        # The longer track is the person; one beside it is a double.
        off = np.where(off < GATE_M, off + 1.5 * (1 - length[track[here]] / length.max())[:, None], np.inf)
        row, column = assign(off, 10.0)
        owner[here[row]] = people["track_id"][column]
    return owner


def usual(owner: np.ndarray, paths: Trajectories, way: int) -> np.ndarray:
    """The true id of each track (K,) at its beginning (``way`` 1) or end (-1); -1 for none."""
    out = np.full(len(paths.first) - 1, -1)
    for track, (low, high) in enumerate(zip(paths.first[:-1], paths.first[1:], strict=True)):
        ids = owner[low:high][::way]
        ids = ids[ids >= 0][:ROWS]
        out[track] = np.bincount(ids).argmax() if len(ids) else -1
    return out


@dataclass
class Pairs:
    """Candidate links (E,) of one scene, from ends to beginnings of ``count`` tracks, and which are right."""

    count: int
    ends: np.ndarray
    begins: np.ndarray
    features: np.ndarray
    right: np.ndarray

    def best(self, gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The log odds of the best set of links, and which of them are right."""
        table, right = np.zeros((2, self.count, self.count))
        good = gain > LEAST
        table[self.ends[good], self.begins[good]] = gain[good] - LEAST
        right[self.ends, self.begins] = self.right
        row, column = solve(-table)
        made = table[row, column] > 0
        return table[row[made], column[made]] + LEAST, right[row[made], column[made]]


def pairs_of(run: Run) -> Pairs:
    """The candidate links of a scene."""
    with calls("link_tracks") as seen:
        next(offline.offline_tracks(FITTED, *run.args[1:]))
    model, paths, forward, backward, step_s = seen[0][:5]
    i, j, gap_s = linking.candidates(paths, forward, backward, step_s, MAX_GAP_S)
    first, last = paths.first[:-1], paths.first[1:] - 1
    found = linking.features(model, forward.take(last[i]), backward.take(first[j]), gap_s)
    owner = owners(run, paths)
    ends, begins = usual(owner, paths, -1), usual(owner, paths, 1)
    same = np.flatnonzero((ends[i] >= 0) & (ends[i] == begins[j]))
    nearest = same[np.lexsort((gap_s[same], i[same]))]
    _, at = np.unique(i[nearest], return_index=True)  # later returns are links of later tracks
    right = np.zeros(len(i))
    right[nearest[at]] = 1
    return Pairs(len(first), i, j, found, right)


def people_of(run: Run) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The features of the tracks of a scene (K, F), the share of each that is a person, and its number of rows."""
    with calls("track_confidence") as seen:
        next(offline.offline_tracks(FITTED, *run.args[1:]))
    model, paths, smoothed, step_s = seen[0]
    observed = np.isfinite(paths.xy_m[:, 0])
    count = np.add.reduceat(observed.astype(float), paths.first[:-1])
    own = np.add.reduceat((owners(run, paths) >= 0).astype(float), paths.first[:-1])
    return false_tracks.features(model, paths, smoothed, step_s), own / count, count


def logistic(
    features: np.ndarray, right: np.ndarray, weight: np.ndarray, group: np.ndarray | None = None, ridge: float = RIDGE
) -> np.ndarray:
    """The weights of the features and the bias. Members of a group have a bias of their own in addition."""
    from scipy.optimize import minimize
    from scipy.sparse import coo_array

    mean, spread = features.mean(axis=0), features.std(axis=0) + 1e-9
    z = np.column_stack([(features - mean) / spread, np.ones(len(features))])
    count, share = z.shape[1], weight / weight.sum()
    group = np.zeros(len(z), int) if group is None else group
    own = coo_array((np.ones(len(z)), (group, np.arange(len(z)))), shape=(int(group.max()) + 1, len(z))).tocsr()
    shrink = np.full(count + own.shape[0], OWN_RIDGE)
    shrink[:count], shrink[count - 1] = ridge, 0.0

    def loss(t: np.ndarray) -> tuple[float, np.ndarray]:
        value = z @ t[:count] + t[count:][group]
        off = share * (1 / (1 + np.exp(-value)) - right)
        slope = np.concatenate([z.T @ off, own @ off]) + 2 * shrink * t
        return float(share @ (np.logaddexp(0, value) - right * value) + shrink @ t**2), slope

    t = minimize(loss, np.zeros(len(shrink)), jac=True, method="L-BFGS-B", options={"maxiter": 2000, "gtol": 1e-9}).x
    weights = t[: count - 1] / spread
    return np.append(weights, t[count - 1] - weights @ mean)


def fit_links(pairs: list[Pairs]) -> dict[str, Any]:
    """The weights of links.

    The best of several competing links is right more often than its own score says: that is fitted in a second step.
    """
    group = np.repeat(np.arange(len(pairs)), [len(one.right) for one in pairs])
    features, right = (np.concatenate([getattr(one, name) for one in pairs]) for name in ("features", "right"))
    weights = logistic(features, right, np.ones(len(right)), group)
    best = [one.best(one.features @ weights[:-1] + weights[-1]) for one in pairs]
    gain, is_right = (np.concatenate(parts) for parts in zip(*best, strict=True))
    scale, shift = logistic(gain[:, None], is_right, np.ones(len(gain)))
    return {
        "weights": named(linking.FEATURES, scale * weights[:-1]),
        "bias": round(float(scale * weights[-1] + shift), 3),
        "usual": round(float(is_right.mean()), 3),
        "least": round(float(scale * LEAST + shift), 2),
    }


def fit_people(parts: list[tuple[np.ndarray, ...]]) -> dict[str, Any]:
    """The weights of tracks."""
    features, share, count = (np.concatenate(members) for members in zip(*parts, strict=True))
    weights = logistic(features, share, count)
    return {"weights": named(false_tracks.FEATURES, weights[:-1]), "bias": round(float(weights[-1]), 3)}


def named(names: tuple[str, ...], weights: np.ndarray) -> dict[str, float]:
    """Weights by the names of their features."""
    return dict(zip(names, np.round(weights, 3).tolist(), strict=True))


def install(links: dict[str, Any]) -> None:
    """Let links be decided by these weights, in this process."""
    linking._WEIGHTS = np.array([links["weights"][name] for name in linking.FEATURES])
    linking._BIAS, linking._PRIOR, linking._MIN_LOG_ODDS = links["bias"], links["usual"], links["least"]


def held(seeds: list[int], steps: int) -> None:
    """Print IDF1 / MOTA / switches of scenes, before and after re-tracking by the weights of the file."""
    parts: tuple[list, list] = ([], [])
    for run in runs(seeds, steps):
        rows = offline.offline_tracks(*run.args)
        found = [frame._replace(rows=new) for frame, new in zip(run.samples, rows, strict=True)]
        for side, frames in zip(parts, (run.samples, found), strict=True):
            side.append(score(make_matchup(run.true, frames, "metres", GATE_M), "motmetrics"))
    for name, side in zip(("input", "re-tracked"), parts, strict=True):
        row = summary(combine(side))
        print(f"{name:12}{100 * row['IDF1']:.1f} / {100 * row['MOTA']:.1f} / {row['IDSW']}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", help=f"by default {SEEDS}; with --held {HELD}")
    parser.add_argument("--steps", type=int, default=STEPS, help="how many steps of each scene")
    either = parser.add_mutually_exclusive_group()
    either.add_argument("--check", action="store_true", help="compare the file with what comes out now")
    either.add_argument("--held", action="store_true", help="score the weights of the file on other scenes")
    given = parser.parse_args()
    seeds = given.seeds or list(HELD if given.held else SEEDS)
    if given.held:
        held(seeds, given.steps)
        return
    scenes, pairs = [], []
    for run in runs(seeds, given.steps):
        scenes.append(run)
        pairs.append(pairs_of(run))
        print(
            f"{len(scenes)} scenes, {sum(len(one.right) for one in pairs)} possible links", file=sys.stderr, flush=True
        )
    links = fit_links(pairs)
    install(links)
    people = fit_people([people_of(run) for run in scenes])
    card = {
        "made_by": f"tools/fit_retrack.py --seeds {' '.join(map(str, seeds))} --steps {given.steps}, "
        f"mcaptrack {__version__}",
        "data": f"{len(scenes)} synthetic scenes of mcaptrack with faults of trackers; no recordings",
        "licence": "Apache-2.0",
        "links": str(sum(int(one.right.sum()) for one in pairs)),
    }
    text = json.dumps({"card": card, "links": links, "people": people}, indent=1) + "\n"
    if given.check:
        print("the same" if WEIGHTS.read_text(encoding="utf-8") == text else text)
        return
    WEIGHTS.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
