"""What predictors are worth: errors and what their ellipses hold, with more and less noise of the past.

Takes sources as `mcaptrack train` does (label files, tables, logs, folders of these; nothing for made-up walks), cuts
all windows of eight past and twelve future positions, and scores every predictor on the same ones. Noise is added to
the past only, with a memory of a half from step to step.

    .venv/bin/python tools/calibrate.py [SOURCE ...] [--past 8] [--predictors red,kalman] [--fps 7 --ground-plane FILE]
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np

from mcaptrack.evaluation.metrics.displacement import forecast_scores
from mcaptrack.predictors import NAMES, make
from mcaptrack.sources.ingest import IngestOptions
from mcaptrack.training.recipe import RECIPES
from mcaptrack.training.sources import SourceOptions, read_scenes, synthetic, windows_of
from mcaptrack.training.windows import Windows, ar1

NOISES_M = (0.0, 0.1, 0.2, 0.3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*", type=Path)
    parser.add_argument("--past", type=int, default=8)
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--predictors", default=",".join(NAMES))
    parser.add_argument("--fps", type=Fraction)
    parser.add_argument("--ground-plane", type=Path)
    given = parser.parse_args()
    recipe = replace(RECIPES["red"], past=given.past, least=given.past, stride=given.stride)
    if given.sources:
        options = SourceOptions(IngestOptions(fps=given.fps, ground_plane=given.ground_plane))
        windows = windows_of(read_scenes(given.sources, options, recipe.step_s), recipe)
    else:
        windows = synthetic(recipe, 10_000, seed=77)
    print(f"{len(windows)} windows of {given.past} past positions")
    columns = ("ADE_m", "FDE_m", "ADE_squared_m2", "NLL", "coverage_50", "coverage_90", "coverage_95")
    print(f"{'noise':>7} {'predictor':<12}" + "".join(f"{name:>16}" for name in columns))
    for noise_m in NOISES_M:
        noise = noise_m * ar1(np.random.default_rng(5), *windows.known.shape)
        seen = Windows(windows.past + noise, windows.known, windows.future, windows.scene)
        for name in given.predictors.split(","):
            predictor = make(name, recipe.steps, recipe.step_s)
            scores = forecast_scores(*predictor.predict(seen.past, seen.known), seen.future)
            print(f"{noise_m:>5} m {name:<12}" + "".join(f"{scores[column]:>16.3f}" for column in columns))


if __name__ == "__main__":
    main()
