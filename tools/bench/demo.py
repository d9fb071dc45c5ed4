"""What the demonstration scores on every scene, over ten seeds: the mean and the range that it prints.

    .venv/bin/python tools/bench/demo.py  # measures all, writes mcaptrack/sources/demo_scores.json and docs/demo.md
    .venv/bin/python tools/bench/demo.py --check 3  # three of them at random, against what is written

Runs `mcaptrack demo` itself, in a process of its own, and reads its JSON. Half a minute of one core a run.
"""

from __future__ import annotations

import argparse
import json
import random
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from mcaptrack import __version__
from mcaptrack.sources import demo
from mcaptrack.sources.demo import SCENES

ROOT = Path(__file__).parent.parent.parent
PAGE = ROOT / "docs" / "demo.md"
SEEDS = range(1, 11)
MODES = ("SORT", "re-tracked")
#: What is kept of the scores, and of the forecasts of SORT's tracks.
SCORES = ("IDF1", "MOTA", "IDSW", "FP", "FN")
FORECASTS = ("ADE_m", "FDE_m", "coverage_50", "coverage_90", "coverage_95")
#: The columns of the page, with what they are multiplied by and the digits that are shown.
COLUMNS = (("IDF1", 100, 1), ("MOTA", 100, 1), ("IDSW", 1, 1))
FORECAST_COLUMNS = (
    ("ADE_m", 1, 2),
    ("FDE_m", 1, 2),
    ("coverage_50", 100, 0),
    ("coverage_90", 100, 0),
    ("coverage_95", 100, 0),
)


HEAD = """\
# What the demonstration scores

`mcaptrack demo --scene NAME --seed N` for seeds {first} to {last}, measured with version {version}: the mean, and the
lowest and highest in brackets, within 1 m on the ground, at 2.5 Hz. A seed draws the noise and the shaking of the
camera, and the routes in all scenes but `square`. Written by `tools/bench/demo.py`.

| scene | IDF1: SORT | re-tracked | MOTA: SORT | re-tracked | switches: SORT | re-tracked |
|---|---|---|---|---|---|---|"""


def measure(scene: str, seed: int) -> dict[str, dict[str, float]]:
    """The scores of one run, by SORT and re-tracked."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["-m", "mcaptrack", "demo", "--scene", scene, "--seed", str(seed), "-o", folder, "--json", "--quiet"]
        ended = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=True)
    sort, retracked = json.loads(ended.stdout)["results"]
    found = {
        mode: {name: result[name] for name in SCORES} for mode, result in zip(MODES, (sort, retracked), strict=True)
    }
    return {**found, "forecasts": {name: sort["displacement"][name] for name in FORECASTS}}


def page(scores: dict[str, Any]) -> str:
    """docs/demo.md."""
    lines = [HEAD.format(first=SEEDS[0], last=SEEDS[-1], version=scores["version"])]
    for scene, values in scores["scenes"].items():
        cells = [demo.mean_and_range(values[mode][name], *how) for name, *how in COLUMNS for mode in MODES]
        lines.append(f"| `{scene}` | {' | '.join(cells)} |")
    lines += [
        "",
        "How far forecasts of SORT's tracks are off 4.8 s ahead, and how many of the true steps lie in their ellipses:",
        "",
        "| scene | ADE, m | FDE, m | in 50 %, % | in 90 %, % | in 95 %, % |",
        "|---|---|---|---|---|---|",
    ]
    for scene, values in scores["scenes"].items():
        cells = [demo.mean_and_range(values["forecasts"][name], *how) for name, *how in FORECAST_COLUMNS]
        lines.append(f"| `{scene}` | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--check", type=int, metavar="N", help="measure N at random and compare them with what is written"
    )
    given = parser.parse_args()
    if given.check:
        kept = demo.read_scores()
        for scene, seed in random.sample([(scene, seed) for scene in SCENES for seed in SEEDS], given.check):
            now = measure(scene, seed)
            then = {part: {name: kept["scenes"][scene][part][name][seed - 1] for name in now[part]} for part in now}
            print(f"{scene} {seed}: {'the same' if now == then else f'now {now}, written {then}'}", flush=True)
        return
    scenes: dict[str, Any] = {}
    for scene in SCENES:
        runs = []
        for seed in SEEDS:
            runs.append(measure(scene, seed))
            print(scene, seed, *(f"{mode} IDF1 {100 * runs[-1][mode]['IDF1']:.1f}" for mode in MODES), flush=True)
        scenes[scene] = {part: {name: [run[part][name] for run in runs] for name in runs[0][part]} for part in runs[0]}
    scores = {"version": __version__, "seeds": [*SEEDS], "scenes": scenes}
    (ROOT / "mcaptrack" / "sources" / demo.SCORES).write_text(json.dumps(scores, indent=1) + "\n")
    PAGE.write_text(page(scores))


if __name__ == "__main__":
    main()
