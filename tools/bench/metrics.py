"""CLEAR, identity and HOTA against TrackEval and Roboflow's `trackers.eval`, from the same arrays in the same run.

Needs `pip install trackeval trackers` in the environment. Reads sequences of FOLDER/mot15 (gt/gt.txt and the tracks in
reference/sort.txt), or makes walkers of its own without one. Checks that all agree to 1e-9, then prints milliseconds
and ratios, the best of several rounds in turn; loading files and comparing boxes is left out for all three.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from mcaptrack.evaluation.metrics import Matchup, score, summary
from mcaptrack.geometry.boxes import iou

# This file's folder is where Python looks first, and a file in it is named like a peer.
sys.path.pop(0)

SHARED = {"MOTA": "MOTA", "IDSW": "IDSW", "Frag": "Frag", "MT": "MT", "FP": "CLR_FP", "FN": "CLR_FN"}
SHARED |= {name: name for name in ("IDF1", "HOTA", "DetA", "AssA", "LocA")}


def load(folder: Path) -> Matchup:
    truth, tracks = (np.loadtxt(folder / name, delimiter=",") for name in ("gt/gt.txt", "reference/sort.txt"))
    return matchup(truth[truth[:, 6] != 0], tracks)


def walkers(people: int, frames: int, seed: int) -> Matchup:
    """People who are missed now and then, and whose tracks change names."""
    rng = np.random.default_rng(seed)
    place, speed, names = rng.uniform(0, 900, (people, 2)), rng.normal(0, 3, (people, 2)), np.arange(people)
    truth, tracks = [], []
    for number in range(1, frames + 1):
        place = place + speed
        for who in range(people):
            truth.append([number, who, *place[who], 40, 90])
            if rng.random() < 0.01:
                names[who] = people + len(tracks)
            if rng.random() > 0.1:
                tracks.append([number, names[who], *(place[who] + rng.normal(0, 4, 2)), 40, 90])
    return matchup(np.array(truth), np.array(tracks))


def matchup(truth: np.ndarray, tracks: np.ndarray) -> Matchup:
    (true_ids, true_at), (track_ids, track_at) = (
        np.unique(part[:, 1], return_inverse=True) for part in (truth, tracks)
    )
    last = int(max(truth[:, 0].max(), tracks[:, 0].max()))
    frames = [(truth[:, 0] == n, tracks[:, 0] == n) for n in range(1, last + 1)]
    return Matchup(
        tuple(true_at[a] for a, _ in frames),
        tuple(track_at[b] for _, b in frames),
        tuple(iou(truth[a, 2:6], tracks[b, 2:6]) for a, b in frames),
        0.5,
        len(true_ids),
        len(track_ids),
    )


def by_us(part: Matchup) -> dict:
    return summary(score(replace(part)))  # a copy, which has computed nothing yet


def by_trackeval(part: Matchup) -> dict:
    from trackeval.metrics import CLEAR, HOTA, Identity

    data = {
        "num_tracker_dets": part.track_rows,
        "num_gt_dets": part.ground_truth_rows,
        "num_gt_ids": part.n_ground_truth,
        "num_tracker_ids": part.n_tracks,
        "num_timesteps": len(part.ground_truth),
        "gt_ids": list(part.ground_truth),
        "tracker_ids": list(part.tracks),
        "similarity_scores": list(part.similarity),
    }
    quiet = {"PRINT_CONFIG": False}
    results = [metric.eval_sequence(data) for metric in (CLEAR(quiet), Identity(quiet), HOTA())]
    return {key: value for result in results for key, value in result.items()}


def by_trackers(part: Matchup) -> dict:
    from trackers.eval.clear import compute_clear_metrics
    from trackers.eval.hota import compute_hota_metrics
    from trackers.eval.identity import compute_identity_metrics

    given = (list(part.ground_truth), list(part.tracks), list(part.similarity))
    return compute_clear_metrics(*given) | compute_identity_metrics(*given) | compute_hota_metrics(*given)


def timed(call: Callable[[Matchup], object], parts: list[Matchup]) -> float:
    start = time.perf_counter()
    for part in parts:
        call(part)
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    if options.folder:
        parts = [load(path) for path in sorted((options.folder / "mot15").iterdir()) if path.is_dir()]
    else:
        parts = [walkers(people, 300, people) for people in (3, 6, 12, 40)]
    with contextlib.redirect_stdout(io.StringIO()):
        for part in parts:
            ours, theirs, others = summary(score(part)), by_trackeval(part), by_trackers(part)
            for mine, name in SHARED.items():
                assert abs(ours[mine] - np.mean(theirs[name])) < 1e-9, mine
                assert mine not in others or abs(ours[mine] - np.mean(others[mine])) < 1e-9, mine
        calls = by_us, by_trackeval, by_trackers
        times = np.array([[timed(call, parts) for call in calls] for _ in range(options.rounds)]).min(axis=0)
    frames = sum(len(part.ground_truth) for part in parts)
    print(f"{len(parts)} sequences, {frames} frames: {1e3 * times[0]:.0f} ms")
    for name, peer in zip(("trackeval", "trackers.eval"), times[1:], strict=True):
        print(f"{name:>14}: {1e3 * peer:5.0f} ms, {peer / times[0]:4.1f} times as fast")


if __name__ == "__main__":
    main()
