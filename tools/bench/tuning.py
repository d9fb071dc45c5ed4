"""One trial of a search, tracking and scoring several sequences, against Roboflow's `trackers`.

Needs `pip install trackers optuna` in the environment. Reads FOLDER/mot15 (det/det.txt, gt/gt.txt, seqinfo.ini). Both
run SORT on the same boxes and score CLEAR, identity and HOTA; the peer as its own tuner does, with files already in
memory where it allows that. Prints milliseconds and the ratio, the best of several rounds in turn.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import tools.missing_extension  # noqa: F401
from mcaptrack.evaluation import EvaluateOptions
from mcaptrack.extensions.tuning.search import Task, trial_scores
from mcaptrack.sources.ingest import IngestOptions
from mcaptrack.tables.compared import detections_and_ground_truth
from mcaptrack.transforms import STAGES, Sort


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rounds", type=int, default=4)
    options = parser.parse_args()
    folders = sorted(path for path in (options.folder / "mot15").iterdir() if path.is_dir())
    tasks = []
    for path in folders:
        both = detections_and_ground_truth(path / "det/det.txt", path / "gt/gt.txt", IngestOptions())
        tasks.append(Task(path.name, both.detections, both.ground_truth, {}))
    scoring, entry = EvaluateOptions(similarities=("iou",)), STAGES["track"].entry(Sort)
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        for part, source in (("gt", "gt/gt.txt"), ("det", "det/det.txt")):
            (scratch / part).mkdir()
            for path in folders:
                rows = [line.split(",") for line in (path / source).read_text().split()]
                if part == "gt":  # the peer reads a class there, and wants a 1
                    rows = [[*row[:7], "1", "1"] for row in rows if float(row[6]) != 0]
                (scratch / part / f"{path.name}.txt").write_text("\n".join(",".join(row[:9]) for row in rows) + "\n")
        from trackers.tune import Tuner

        def peer(trials: int) -> float:
            tuner = Tuner(
                "sort", scratch / "gt", scratch / "det", metrics=["CLEAR", "HOTA", "Identity"], n_trials=trials
            )
            start = time.perf_counter()
            tuner.run()
            return time.perf_counter() - start

        def ours(trials: int) -> float:
            start = time.perf_counter()
            for number in range(trials):
                trial_scores(Sort(min_iou=0.2 + 0.01 * number), tasks, scoring, entry)
            return time.perf_counter() - start

        ours(1)
        peer(1)
        times = [(ours(3) / 3, peer(3) / 3) for _ in range(options.rounds)]
    a, b = min(t for t, _ in times), min(t for _, t in times)
    frames = sum(len(task.frames) for task in tasks)
    print(f"one trial over {len(tasks)} sequences, {frames} frames: {1e3 * a:.0f} ms")
    print(f"trackers: {1e3 * b:.0f} ms, {b / a:.1f} times as fast")


if __name__ == "__main__":
    main()
