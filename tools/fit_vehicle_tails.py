"""Fit the calibration of forecasts of vehicles on drawn traffic.

Writes mcaptrack/predictors/trained/vehicle_tails.json: for each predictor, class, and standing and moving vehicles
the mixture of a narrow and a wide normal distribution under which the errors of forecasts are likeliest, for each
step ahead. Scenes are those of `traffic.py`; rates of misses, noise, clutter and the share of vehicles that turn or
stop are drawn for each. No recording is used. With --check it says how many positions of other scenes the ellipses
hold.

    .venv/bin/python tools/fit_vehicle_tails.py [--seed 7000] [--scenes 64] [--check]
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from regression import fit_mixture
from traffic import CLASSES, Faults, draw_traffic

from mcaptrack import __version__
from mcaptrack.geometry.mixtures import Tails, mahalanobis_squared, mass_within
from mcaptrack.predictors import tail_calibration as shipped
from mcaptrack.predictors.tail_calibration import counts_of
from mcaptrack.schema import DETECTIONS, Frame
from mcaptrack.schema.as_rows import tails_of
from mcaptrack.transforms import GroundTracker, Retrack, Sample

STEPS, STEP_S, ITERATIONS = 12, 0.4, 300
#: A track is at a true object of its class that is so near.
NEAR_M = 1.5
BOX = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad", "score", "class_id")
STATES = ("standing", "moving")
#: The default predictor and those beside it; of others the distributions stay as they are.
NAMES = ("blend", "kalman", "red")


def scene(seed: int):
    """Drawn traffic whose faults are drawn, too."""
    rng = np.random.default_rng([77, seed])
    u = rng.uniform
    lost = rng.random() < 0.5  # half of the robots know well where they are
    faults = Faults(
        miss_near=u(0.02, 0.12), miss_far=u(0.3, 0.75), occlusions_per_s=u(0.04, 0.25), occlusion_s=u(0.5, 1.4),
        noise_m=u(0.04, 0.16), slow_noise_m=u(0.08, 0.3), half_turns=u(0, 0.08), heading_noise=u(0.04, 0.12),
        confused=u(0, 0.06), false_boxes=u(0.2, 4), clutter=int(rng.integers(1, 11)), hidden=bool(rng.random() < 0.7),
        groups=u(0, 1.5), pose_noise_m=u(0, 0.1) * lost, pose_noise_rad=u(0, 0.004) * lost,
    )  # fmt: skip
    return draw_traffic(seed, seconds=u(12, 24), faults=faults, density=u(0.5, 1.2))


def errors(seed: int) -> Iterator[tuple[str, str, str, np.ndarray, np.ndarray, Tails]]:
    """Predictor, kind and state; steps ahead (M,), squared distances (M,) and shapes (M,) of the forecasts."""
    drawn = scene(seed)
    at = drawn.boxes["frame"]
    frames = [
        Frame(int(t_ns), n, DETECTIONS.rows(**{name: drawn.boxes[name][at == n] for name in BOX}))
        for n, t_ns in enumerate(drawn.t_ns)
    ]
    names = tuple(CLASSES.items())
    tracks = [frame for (frame,) in GroundTracker(class_names=names)(frames)]
    samples = [frame for (frame,) in Sample()(tracks)]
    truth = {key: drawn.truth[key] for key in ("frame", "id", "class_id", "x_m", "y_m")}
    place = {(one, n): k for k, (one, n) in enumerate(zip(truth["id"].tolist(), truth["frame"].tolist(), strict=True))}
    for name in NAMES:
        for _, frame, made, *_ in Retrack(predictor=name, class_names=names)(samples):
            now = int(np.abs(drawn.t_ns - frame.t_ns).argmin())
            true = np.flatnonzero(truth["frame"] == now)
            for row in frame.rows[np.isin(frame.rows["track_id"], made.rows["track_id"])]:
                kind = shipped.TABLE_OF_CLASS.get(CLASSES[int(row["class_id"])])
                same = true[truth["class_id"][true] == row["class_id"]]
                away = np.hypot(truth["x_m"][same] - row["x_m"], truth["y_m"][same] - row["y_m"])
                if kind is None or not len(away) or away.min() > NEAR_M:
                    continue
                own = int(truth["id"][same[away.argmin()]])
                rows = made.rows[made.rows["track_id"] == row["track_id"]]
                step = np.rint(rows["ahead_s"] / STEP_S).astype(int) - 1
                when = now + np.rint(rows["ahead_s"] / np.median(np.diff(drawn.t_ns)) * 1e9).astype(int)
                there = np.array([place.get((own, one), -1) for one in when.tolist()])
                known = there >= 0
                rows, step, there = rows[known], step[known], there[known]
                off = np.stack([truth[axis][there] - rows[axis] for axis in ("x_m", "y_m")], axis=-1)
                cov = np.stack([rows["cov_xx_m2"], rows["cov_xy_m2"], rows["cov_xy_m2"], rows["cov_yy_m2"]], axis=-1)
                speed = np.hypot(row["vx_m_per_s"], row["vy_m_per_s"])
                state = STATES[int(speed >= shipped.STANDING_M_PER_S)]
                squared = mahalanobis_squared(off, cov.reshape(-1, 2, 2).astype(float))
                yield name, kind, state, step, squared, tails_of(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=7000)
    parser.add_argument("--scenes", type=int, default=64)
    parser.add_argument("--check", action="store_true", help="score the tables on scenes that they weren't fitted on")
    given = parser.parse_args()
    if not given.check:  # forecasts without the tables that are made
        shipped.VEHICLE_TABLES.write_text('{"predictors": {}}')
        shipped.tables_in.cache_clear()
    parts: dict[tuple[str, str, str], list] = {}
    first = given.seed + 1000 * given.check
    for seed in range(first, first + given.scenes):
        for name, kind, state, *rest in errors(seed):
            parts.setdefault((name, kind, state), []).append(rest)
    tables: dict[str, dict[str, dict[str, dict[str, list[float]]]]] = {}
    for (name, kind, state), found in sorted(parts.items()):
        step, squared = (np.concatenate([one[n] for one in found]) for n in (0, 1))
        if given.check:
            shapes = Tails(*(np.concatenate([one[2][n] for one in found]) for n in range(3)))
            level = mass_within(squared, shapes)
            held = "  ".join(f"{share:.0%}: {100 * (level <= share).mean():5.1f}" for share in (0.5, 0.8, 0.95))
            print(f"{name:10} {kind:8} {state:9} {len(step):8}  {held}")
            continue
        counts = counts_of(step, squared / 2, STEPS)
        tails = fit_mixture(counts, Tails(np.full(STEPS, 0.2), np.full(STEPS, 0.5), np.full(STEPS, 4.0)), ITERATIONS)
        values = {"ahead_s": STEP_S * np.arange(1, STEPS + 1), **tails._asdict()}
        table = {key: [float(f"{value:.4g}") for value in part] for key, part in values.items()}
        tables.setdefault(name, {}).setdefault(kind, {})[state] = table
    if not given.check:
        how = f"--seed {given.seed} --scenes {given.scenes}"
        card = {
            "made_by": f"tools/fit_vehicle_tails.py {how}, mcaptrack {__version__}",
            "data": "drawn traffic of tools/traffic.py with faults of detectors; no recordings",
            "licence": "Apache-2.0",
        }
        shipped.VEHICLE_TABLES.write_text(
            json.dumps({"card": card, "predictors": tables}, separators=(",", ":")) + "\n"
        )


if __name__ == "__main__":
    main()
