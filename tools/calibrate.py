"""What predictors are worth: errors and what their ellipses hold, with more and less noise of the past.

Takes sources as `mcaptrack train` does (label files, tables, logs, folders of these; nothing for made-up walks), cuts
all windows of eight past and twelve future positions, and scores every predictor on the same ones. Noise is added to
the past only, with a memory of a half from step to step.

With --tracks sources are logs with ground truth, or folders with world/ and gt/ as `reproduce.py` reads them, and
predictors are scored as `mcaptrack evaluate` does it: from the true tracks, from those of the tracker, and from those
after re-tracking online. ADE and FDE in metres.

    .venv/bin/python tools/calibrate.py [SOURCE ...] [--past 8] [--predictors red,kalman] [--fps 7 --ground-plane FILE]
    .venv/bin/python tools/calibrate.py --tracks demo.mcap pets.mcap [--predictors cv,blend]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import missing_extension  # noqa: F401
from reproduce import scenes

from mcaptrack import log as logs
from mcaptrack import pipeline
from mcaptrack.evaluation import sequence_of_log
from mcaptrack.evaluation.forecasts import score_forecasts
from mcaptrack.evaluation.metrics.displacement import combine_displacements, forecast_scores
from mcaptrack.extensions.training.recipe import RECIPES
from mcaptrack.extensions.training.sources import SourceOptions, read_scenes, synthetic, windows_of
from mcaptrack.extensions.training.windows import Windows, ar1
from mcaptrack.pipeline.rebuild import rebuild
from mcaptrack.predictors import NAMES, make
from mcaptrack.schema import Frame
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.ingest import IngestOptions
from mcaptrack.transforms import PROFILES, STAGES, Predict, Sample

NOISES_M = (0.0, 0.1, 0.2, 0.3)
#: From which tracks predictions are made with --tracks.
WAYS = ("true", "tracker", "online")


def sequences(source: Path) -> Iterator[tuple[list[Frame], list[Frame], Any]]:
    """Ground truth, samples and re-tracking of a log, or of the scenes of a folder."""
    if source.is_dir():
        for _, truth, samples in scenes(source, None, 30):
            yield truth, samples, PROFILES["default"]
        return
    with logs.read(source) as opened:
        prefix = pipeline.find_camera(opened, None)
        names = f"{prefix}/{STAGES['retrack'].input_topic}", f"{prefix}/{STAGES['retrack'].output_topic}"
        sequence = sequence_of_log(opened, prefix, names)
        how = Provenance.from_metadata(opened.channel(names[1]).metadata)
        assert how is not None
        samples = list(sequence.candidates[0].frames)
        yield list(sequence.ground_truth), samples, rebuild(STAGES["retrack"], how, {})


def on_tracks(sources: list[Path], names: list[str]) -> None:
    """Score predictors on the tracks of all sources together."""
    print(f"{'':12}" + "".join(f"{way:>20}" for way in WAYS))
    members = [member for source in sources for member in sequences(source)]
    for name in names:
        cells = []
        for way in WAYS:
            parts = []
            for truth, samples, retrack in members:
                if way == "online":
                    results = replace(retrack, predictor=name)(samples)
                    _, tracks, forecasts, *_ = map(list, zip(*results, strict=True))
                else:
                    tracks = samples if way == "tracker" else [frame for (frame,) in Sample()(truth)]
                    forecasts = [frame for (frame,) in Predict(predictor=name)(tracks)]
                scored = score_forecasts(forecasts, tracks, truth, name)
                parts += [] if scored is None else [scored]
            scores = combine_displacements(parts).summary()
            cells.append(f"{scores['ADE_m']:.2f} / {scores['FDE_m']:.2f}")
        print(f"{name:<12}" + "".join(f"{cell:>20}" for cell in cells), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*", type=Path)
    parser.add_argument("--past", type=int, default=8)
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--predictors", default=",".join(NAMES))
    parser.add_argument("--fps", type=Fraction)
    parser.add_argument("--tracks", action="store_true")
    parser.add_argument("--ground-plane", type=Path)
    given = parser.parse_args()
    if given.tracks:
        on_tracks(given.sources, given.predictors.split(","))
        return
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
