"""The paper's Table I and its curve, from a folder of scenes: SORT, SORT with smoothing, and re-tracking.

    .venv/bin/python tools/reproduce.py SCENES --homographies FOLDER -o OUT

"SORT + smoothing" is the paper's ablation: the displacements of SORT's tracks are smoothed by Eq. 3 before the same
predictor predicts.

A folder has either a folder for each scene with detections (det.txt: frame,-1,x,y,w,h,score,... in pixels) and truth
(gt.txt: frame id x y in metres), or folders world/ and gt/ with a file for each scene, both in metres. Homographies
(SCENE.txt, with or without its underscores) bring detections to metres. A folder with views of WILDTRACK gives two
tables: each view by itself, and all of them fused (tools/wildtrack.py). Writes table.csv, curve.csv and curve.svg.
Scores are motmetrics', by distance; ADE is the paper's: squared, in m^2.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import wildtrack

from mcaptrack.evaluation import Candidate, EvaluateOptions, EvaluationInput, EvaluationResult, evaluate
from mcaptrack.evaluation.forecasts import smoothed_predictions
from mcaptrack.evaluation.metrics import summary
from mcaptrack.evaluation.metrics.displacement import Displacement
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import DETECTIONS, TRACKS, Frame
from mcaptrack.transforms import PROFILES, TRANSFORMS, Predict, Sample
from mcaptrack.transforms.retrack import Retracking
from mcaptrack.viewing.formatting import curves_svg

RATE_HZ = 2.5


def truth_frames(path: Path, fps: float, steps: np.ndarray) -> list[Frame]:
    rows = np.loadtxt(path, ndmin=2)
    return on_clock(np.column_stack([rows[:, 0] * RATE_HZ / fps, rows[:, 1:4]]), steps)


def on_clock(rows: np.ndarray, steps: np.ndarray) -> list[Frame]:
    """Rows of step, id, x, y as frames of tracks."""
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    bounds = np.searchsorted(rows[:, 0].round().astype(int), np.append(steps, steps[-1] + 1))
    out = []
    for step, low, high in zip(steps.tolist(), bounds[:-1], bounds[1:], strict=True):
        now = rows[low:high]
        content = TRACKS.rows(
            track_id=now[:, 1].astype(int),
            x_m=now[:, 2],
            y_m=now[:, 3],
            observed=np.ones(len(now), bool),
            source_id=np.full(len(now), -1),
        )
        out.append(Frame(round(step / RATE_HZ * 1e9), step, content))
    return out


def scenes(folder: Path, homographies: Path | None, fps: float) -> Iterator[tuple[str, list[Frame], list[Frame]]]:
    """Name, truth and samples of each scene."""
    if (folder / "world").is_dir():
        for path in sorted((folder / "gt").glob("*.txt")):
            rows = np.loadtxt(folder / "world" / path.name, delimiter=",", ndmin=2)
            rows[:, 0] *= RATE_HZ / fps
            last = max(rows[:, 0].max(), np.loadtxt(path, ndmin=2)[:, 0].max() * RATE_HZ / fps)
            steps = np.arange(round(last) + 1)
            yield path.stem, truth_frames(path, fps, steps), [f for (f,) in Sample(start_ns=0)(on_clock(rows, steps))]
        return
    for place in sorted(path.parent for path in folder.glob("*/det.txt")):
        samples = _tracked(place / "det.txt", homographies or place, fps)
        steps = np.array([round(frame.t_ns * RATE_HZ / 1e9) for frame in samples])
        yield place.name, truth_frames(place / "gt.txt", fps, steps), samples


def _tracked(path: Path, homographies: Path, fps: float) -> list[Frame]:
    """Detections through SORT and onto the clock of prediction."""
    name = path.parent.name
    found = [homographies / f"{stem}.txt" for stem in (name, name.replace("_", ""), "homography")]
    matrix = np.loadtxt(next(p for p in found if p.exists()), delimiter=",")
    planes = ((0, GroundPlane(tuple(matrix.ravel()), 1, 1, "center")),)
    rows = np.loadtxt(path, delimiter=",", ndmin=2)
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    bounds = np.searchsorted(rows[:, 0], np.arange(int(rows[-1, 0]) + 2))
    frames = []
    for number, (low, high) in enumerate(itertools.pairwise(bounds)):
        x, y, w, h, score = rows[low:high, 2:7].T
        kind = np.ones(high - low, np.uint32)
        content = DETECTIONS.rows(x_px=x, y_px=y, w_px=w, h_px=h, score=score, class_id=kind)
        frames.append(Frame(round(number / fps * 1e9), number, content))
    tracks = [frame for (frame,) in TRANSFORMS["track"](ground_planes=planes)(frames)]
    return [frame for (frame,) in Sample(start_ns=0, ground_planes=planes)(tracks)]


def methods(predictor: str, profile: str, **protocol: float) -> dict[str, Callable[[list[Frame]], Candidate]]:
    """What is compared: from samples to tracks and forecasts; ``protocol`` has options of predictions."""

    given: dict[str, Any] = dict(protocol)
    predict = Predict(predictor=predictor, **given)

    def sort(samples: list[Frame]) -> Candidate:
        return Candidate("SORT", None, samples, [frame for (frame,) in predict(samples)], "SORT")

    def smoothed(samples: list[Frame]) -> Candidate:
        name = "SORT + smoothing"
        return Candidate(name, None, samples, list(smoothed_predictions(samples, predict)), name)

    def retrack(name: str, options: Retracking, online: bool) -> Callable[[list[Frame]], Candidate]:
        def run(samples: list[Frame]) -> Candidate:
            offline, causal, forecasts, *_ = (list(part) for part in zip(*options(samples), strict=True))
            return Candidate(name, None, causal if online else offline, forecasts if online else None, name)

        return run

    out = {"SORT": sort, "SORT + smoothing": smoothed}
    for name in ("paper", "authors", "default") if profile == "all" else (profile,):
        options = replace(PROFILES[name], **given)
        options = replace(options, predictor=predictor) if name != "default" else options
        out[f"re-tracking, {name}, online"] = retrack(f"re-tracking, {name}, online", options, online=True)
        out[f"re-tracking, {name}"] = retrack(f"re-tracking, {name}", options, online=False)
    return out


def score(
    members: list[tuple[str, list[Frame], list[Frame]]], method: Callable[[list[Frame]], Candidate]
) -> EvaluationResult:
    options = EvaluateOptions(similarities=("metres",), gates_m=(0.5, 1.0, 2.0), rules="motmetrics")
    return evaluate([EvaluationInput(name, true, [method(samples)]) for name, true, samples in members], options)


def of_all(outcome: EvaluationResult) -> list:
    """The results over all scenes."""
    combined = [result for result in outcome.results if result.sequence == "COMBINED"]
    return combined or outcome.results


def line(result) -> list[object]:
    s = summary(result.score)
    return [f"{100 * s['IDF1']:.1f}", f"{100 * s['MOTA']:.1f}", s["IDSW"], s["FP"], s["FN"]]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--homographies", type=Path, help="folder with the homographies of the scenes")
    parser.add_argument("--fps", type=float, default=30.0, help="frames a second of the frame numbers")
    parser.add_argument("--predictor", default="cv", help="what predicts, but for the default profile")
    parser.add_argument("--profile", default="all", choices=("all", *PROFILES), help="whose re-tracking")
    parser.add_argument("-o", "--output", type=Path, default=Path("reproduced"))
    given = parser.parse_args()
    if wildtrack.is_wildtrack(given.folder):
        print(wildtrack.NOTE)
        groups, protocol = wildtrack.groups(given.folder), wildtrack.PROTOCOL
    else:
        groups, protocol = {"": list(scenes(given.folder, given.homographies, given.fps))}, {}
    if not any(groups.values()):
        parser.error(f"{given.folder} has neither world/ and gt/ nor SCENE/det.txt, nor views of WILDTRACK")
    given.output.mkdir(parents=True, exist_ok=True)
    curves: dict[str, Displacement] = {}
    table = [
        ["method", "gate_m", "IDF1", "MOTA", "IDSW", "FP", "FN", "recall_at_tau", "ADE_m2_at_tau", "ADE_m2_at_0.5"]
    ]
    print(
        f"{'':40}{'gate':>6}{'IDF1':>7}{'MOTA':>7}{'IDSW':>7}{'FP':>7}{'FN':>7}{'recall':>8}{'ADE m²':>8}{'at 0.5':>8}"
    )
    for group, members in groups.items():
        for method_name, method in methods(given.predictor, given.profile, **protocol).items():
            began = time.process_time()
            outcome = score(members, method)
            for result in of_all(outcome) if not group else outcome.results:
                name = method_name.replace("SORT", "ground") if result.sequence == wildtrack.FUSED else method_name
                name = f"{result.sequence}: {name}" if group and result.sequence != "COMBINED" else name
                forecast: list[object] = ["", "", ""]
                if result.displacement is not None:
                    curves[name] = result.displacement
                    one = result.displacement.summary()
                    values = (one["recall"], one["ADE_squared_m2"], result.displacement.squared_at(0.5))
                    forecast = ["" if value is None else f"{value:.3f}" for value in values]
                row = [name, result.gate, *line(result), *forecast]
                table.append(row)
                widths = (6, 7, 7, 7, 7, 7, 8, 8, 8)
                cells = [f"{name:40}", *(f"{v!s:>{w}}" for v, w in zip(row[1:], widths, strict=True))]
                print("".join(cells))
            print(f"{'':40}{time.process_time() - began:.1f} s with scoring", flush=True)
    with (given.output / "table.csv").open("w", newline="") as file:
        csv.writer(file).writerows(table)
    with (given.output / "curve.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["method", "d_obs_m2", "recall", "ADE_m2", "ADE_m"])
        for name, one in curves.items():
            (recall, ade), (_, squared) = one.curve(), one.curve(squared=True)
            d_obs = np.sort(one.d_obs_m2, kind="stable")
            writer.writerows(zip([name] * len(d_obs), d_obs, recall, squared, ade, strict=True))
    (given.output / "curve.svg").write_text(curves_svg(curves))
    print(f"wrote table.csv, curve.csv and curve.svg to {given.output}")


if __name__ == "__main__":
    main()
