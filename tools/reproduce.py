"""The paper's Table I and its curve, from a folder of scenes: SORT, SORT with smoothing, and re-tracking.

    .venv/bin/python tools/reproduce.py SCENES --homographies FOLDER -o OUT
    .venv/bin/python tools/reproduce.py SCENES -o OUT --ablation docs/ablation.md

A folder has either a folder for each scene with detections (det.txt: frame,-1,x,y,w,h,score,... in pixels) and truth
(gt.txt: frame id x y in metres), or folders world/ and gt/ with a file for each scene, both in metres. Homographies
(SCENE.txt, with or without its underscores) bring detections to metres. Writes table.csv, curve.csv and curve.svg.
Scores are motmetrics', by distance; ADE is the paper's: squared, in m^2.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from mcaptrack.evaluation import Candidate, EvaluateOptions, EvaluationInput, EvaluationResult, evaluate
from mcaptrack.evaluation.metrics import summary
from mcaptrack.evaluation.metrics.displacement import TAU_M2, Displacement
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import DETECTIONS, TRACKS, Frame
from mcaptrack.transforms import PROFILES, TRANSFORMS, Predict, Sample
from mcaptrack.transforms.retrack import Retracking

RATE_HZ = 2.5
COLOURS = ("#888888", "#c58b00", "#c0392b", "#8e44ad", "#1f6fb2", "#2e8b57")

PAPER, AUTHORS, DEFAULT = PROFILES["paper"], PROFILES["authors"], PROFILES["default"]
#: Nothing done after the fact.
_PLAIN = {"link_s": 0.0, "resolve_swaps": False, "smooth": False, "track_confidence": 0.0}
_NOW = replace(
    AUTHORS,
    distance="now",
    priority_distance=0.0,
    birth="raw",
    interpolated=False,
    min_history=2,
    backfill="unclaimed",
    trim_ends=False,
)
#: The way from the paper to the default, one step a row; each row's options are those of `mcaptrack retrack`.
ABLATION: dict[str, tuple[str, Retracking]] = {
    "paper": ("--profile paper", PAPER),
    "authors": ("--profile authors", AUTHORS),
    "distance of current positions": (
        "--profile authors --distance now --priority-distance 0 --birth raw --no-interpolated --min-history 2 "
        "--backfill unclaimed --no-trim-ends",
        _NOW,
    ),
    "computed covariance": (
        "... --covariance predictor --predictor kalman --gate-m 3 --alpha 1 --beta 0",
        replace(_NOW, covariance="predictor", predictor="kalman", gate_m=3.0, alpha=1.0, beta=0.0),
    ),
    "likelihood, estimated noise": (
        "--link-s 0 --no-resolve-swaps --no-smooth --track-confidence 0",
        replace(DEFAULT, **_PLAIN),
    ),
    "+ false-track removal": (
        "--link-s 0 --no-resolve-swaps --no-smooth",
        replace(DEFAULT, **_PLAIN | {"track_confidence": 0.5}),
    ),
    "+ offline linking": ("--no-resolve-swaps --no-smooth", replace(DEFAULT, resolve_swaps=False, smooth=False)),
    "+ identity swaps at encounters": ("--no-smooth", replace(DEFAULT, smooth=False)),
    "+ smoothing (the default)": ("", DEFAULT),
}


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


def methods(predictor: str, profile: str) -> dict[str, Callable[[list[Frame]], Candidate]]:
    """What is compared: from samples to tracks and forecasts."""

    def sort(name: str, which: str) -> Callable[[list[Frame]], Candidate]:
        made = Predict(predictor=which)
        return lambda samples: Candidate(name, None, samples, [frame for (frame,) in made(samples)], name)

    def retrack(name: str, options: Retracking, online: bool) -> Callable[[list[Frame]], Candidate]:
        def run(samples: list[Frame]) -> Candidate:
            offline, causal, forecasts = (list(part) for part in zip(*options(samples), strict=True))
            return Candidate(name, None, causal if online else offline, forecasts if online else None, name)

        return run

    out = {"SORT": sort("SORT", predictor), "SORT + smoothing": sort("SORT + smoothing", "holt-cv")}
    for name in ("paper", "authors", "default") if profile == "all" else (profile,):
        options = replace(PROFILES[name], predictor=predictor) if name != "default" else PROFILES[name]
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


def curve_svg(curves: dict[str, Displacement]) -> str:
    """Squared ADE over recall, with a dot where d_obs reaches tau."""
    width, height, left, low, top = 640, 420, 60, 370, 8.0

    def at(recall: float, ade: float) -> str:
        return f"{left + recall * (width - left - 20):.1f},{low - min(ade, top) / top * (low - 20):.1f}"

    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" font-family="sans-serif">']
    parts.append('<rect width="100%" height="100%" fill="white"/>')
    for tick in np.arange(0, 1.01, 0.2):
        x, y = at(tick, 0).split(",")
        parts.append(f'<text x="{x}" y="{float(y) + 18}" font-size="12" text-anchor="middle">{tick:.1f}</text>')
    for tick in range(0, int(top) + 1, 2):
        x, y = at(0, tick).split(",")
        parts.append(f'<text x="{float(x) - 8}" y="{float(y) + 4}" font-size="12" text-anchor="end">{tick}</text>')
        parts.append(f'<path d="M{at(0, tick)} L{at(1, tick)}" stroke="#ddd"/>')
    parts.append(f'<text x="{width / 2}" y="{height - 12}" font-size="13" text-anchor="middle">recall</text>')
    parts.append(f'<text x="16" y="{low / 2}" font-size="13" transform="rotate(-90 16 {low / 2})">ADE, m²</text>')
    for number, (name, one) in enumerate(curves.items()):
        order = np.argsort(one.d_obs_m2, kind="stable")
        count = np.arange(1, len(order) + 1)
        ade = np.cumsum(one.ade_squared_m2[order]) / count
        shown = np.unique(np.linspace(0, len(order) - 1, 300).astype(int)) if len(order) else np.empty(0, int)
        points = " L".join(at(count[k] / one.people, ade[k]) for k in shown if count[k] > 0.02 * one.people)
        colour = COLOURS[number % len(COLOURS)]
        if points:
            parts.append(f'<path d="M{points}" fill="none" stroke="{colour}" stroke-width="2"/>')
        until = int((one.d_obs_m2 < TAU_M2).sum())
        if until:
            x, y = at(until / one.people, ade[until - 1]).split(",")
            parts.append(f'<circle cx="{x}" cy="{y}" r="4" fill="{colour}"/>')
        y = 36 + 18 * number
        parts.append(f'<text x="{left + 14}" y="{y}" font-size="12" fill="{colour}">{name}</text>')
    return "\n".join([*parts, "</svg>", ""])


def ablate(members: list[tuple[str, list[Frame], list[Frame]]], target: Path, folder: str) -> None:
    """The table of the steps from the paper to the default."""
    rows = ["| step | options of `mcaptrack retrack` | 0.5 m | 1 m | 2 m |", "|---|---|---|---|---|"]
    for name, (flags, options) in ABLATION.items():
        results = of_all(score(members, _offline(options)))
        cells = [" / ".join(str(v) for v in line(result)[:3]) for result in results]
        rows.append(f"| {name} | `{flags}` | " + " | ".join(cells) + " |")
        print(rows[-1], flush=True)
    marker = f"<!-- {folder} -->"
    text = target.read_text() if target.exists() else ""
    before = text.partition(marker)[0]
    after = text.partition(marker)[2].partition(marker)[2]
    target.write_text(
        "\n".join([before.rstrip("\n"), "", marker, "", *rows, "", marker]).lstrip("\n") + (after or "\n")
    )


def _offline(options: Retracking) -> Callable[[list[Frame]], Candidate]:
    return lambda samples: Candidate("tracks", None, [result[0] for result in options(samples)])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--homographies", type=Path, help="folder with the homographies of the scenes")
    parser.add_argument("--fps", type=float, default=30.0, help="frames a second of the frame numbers")
    parser.add_argument("--predictor", default="cv", help="what predicts, but for the default profile")
    parser.add_argument("--profile", default="all", choices=("all", *PROFILES), help="whose re-tracking")
    parser.add_argument("--ablation", type=Path, help="write the table of steps into this file instead")
    parser.add_argument("-o", "--output", type=Path, default=Path("reproduced"))
    given = parser.parse_args()
    members = list(scenes(given.folder, given.homographies, given.fps))
    if not members:
        parser.error(f"{given.folder} has neither world/ and gt/ nor SCENE/det.txt")
    if given.ablation:
        ablate(members, given.ablation, given.folder.name)
        return
    given.output.mkdir(parents=True, exist_ok=True)
    curves: dict[str, Displacement] = {}
    table = [
        ["method", "gate_m", "IDF1", "MOTA", "IDSW", "FP", "FN", "recall_at_tau", "ADE_m2_at_tau", "ADE_m2_at_0.5"]
    ]
    print(
        f"{'':30}{'gate':>6}{'IDF1':>7}{'MOTA':>7}{'IDSW':>7}{'FP':>7}{'FN':>7}{'recall':>8}{'ADE m²':>8}{'at 0.5':>8}"
    )
    for name, method in methods(given.predictor, given.profile).items():
        began = time.process_time()
        results = of_all(score(members, method))
        for result in results:
            forecast: list[object] = ["", "", ""]
            if result.displacement is not None:
                curves[name] = result.displacement
                one = result.displacement.summary()
                values = (one["recall"], one["ADE_squared_m2"], result.displacement.squared_at(0.5))
                forecast = ["" if value is None else f"{value:.3f}" for value in values]
            row = [name, result.gate, *line(result), *forecast]
            table.append(row)
            widths = (30, 6, 7, 7, 7, 7, 7, 8, 8, 8)
            print(f"{name:30}" + "".join(f"{v!s:>{w}}" for v, w in zip(row[1:], widths[1:], strict=True)), flush=True)
        print(f"{'':30}{time.process_time() - began:.1f} s with scoring")
    with (given.output / "table.csv").open("w", newline="") as file:
        csv.writer(file).writerows(table)
    with (given.output / "curve.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["method", "d_obs_m2", "recall", "ADE_m2", "ADE_m"])
        for name, one in curves.items():
            order = np.argsort(one.d_obs_m2, kind="stable")
            recall, ade = one.curve()
            squared = np.cumsum(one.ade_squared_m2[order]) / np.arange(1, len(order) + 1)
            writer.writerows(zip([name] * len(order), one.d_obs_m2[order], recall, squared, ade, strict=True))
    (given.output / "curve.svg").write_text(curve_svg(curves))
    print(f"wrote table.csv, curve.csv and curve.svg to {given.output}")


if __name__ == "__main__":
    main()
