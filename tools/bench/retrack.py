"""How fast re-tracking is: frames of the clock of prediction a second, and how often faster than the authors' profile.

    .venv/bin/python tools/bench/retrack.py SCENES [--homographies FOLDER]

Takes the folders that tools/reproduce.py takes. The peer runs beside it, on the same samples, in the same process:
Algorithm 1 as its authors' program reads it, with constant velocity for its network.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))
from reproduce import scenes

from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.frame_columns import collect
from mcaptrack.transforms import PROFILES, Predict, Retrack
from mcaptrack.transforms.retrack.passes import LikelihoodPass, Movers


def online(samples: list[Frame]) -> None:
    """Online tracks and their predictions only."""
    run = LikelihoodPass(Retrack(), Movers(), collect(TRACKS, samples))
    for _ in zip(*run.outputs(), strict=True):
        pass


def best(what: Callable[[list[Frame]], object], members: list[list[Frame]], rounds: int = 3) -> float:
    """The least processor time of a few rounds, in seconds."""
    times = []
    for _ in range(rounds):
        began = time.process_time()
        for samples in members:
            what(samples)
        times.append(time.process_time() - began)
    return min(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--homographies", type=Path)
    parser.add_argument("--fps", type=float, default=30.0)
    given = parser.parse_args()
    members = [samples for _, _, samples in scenes(given.folder, given.homographies, given.fps)]
    frames = sum(len(samples) for samples in members)
    rows = sum(len(frame.rows) for samples in members for frame in samples)
    runs: dict[str, Callable[[list[Frame]], object]] = {
        "authors' profile": lambda samples: list(PROFILES["authors"](samples)),
        "online": online,
        "online and offline": lambda samples: list(Retrack()(samples)),
        "predict alone": lambda samples: list(Predict()(samples)),
    }
    print(f"{frames} frames, {rows} rows")
    peer = 0.0
    for name, run in runs.items():
        seconds = best(run, members)
        peer = peer or seconds
        print(
            f"{name:20}{frames / seconds:>10.0f} frames/s{rows / seconds:>10.0f} rows/s{peer / seconds:>8.1f} x",
            flush=True,
        )


if __name__ == "__main__":
    main()
