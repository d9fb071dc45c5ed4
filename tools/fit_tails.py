"""Fit the calibration of the predictors on synthetic walks with the faults of trackers.

Writes mcaptrack/predictors/trained/tails.json: for each predictor the mixture of a narrow and a wide normal
distribution under which its errors are likeliest, for each step ahead, and the factors for short and for coasting
tracks. Walks are those of `mcaptrack train synthetic` (social forces), corrupted as in `corruptions.py`, sampled and
re-tracked; forecasts are made from the samples and from the tracks after re-tracking, and compared with the true walks.
No recording is used. With --check it says whether the same comes out now. Half a minute of one core.

    .venv/bin/python tools/fit_tails.py [--check] [--seed 11] [--scenes 4]
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from corruptions import CORRUPTIONS, STEP_S, Corruption, corrupt
from regression import fit_mixture
from reproduce import on_clock

from mcaptrack import __version__
from mcaptrack.evaluation.metrics.displacement import TAU_M2, Forecasts, Positions, pair_forecasts
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.histories import Histories
from mcaptrack.geometry.mixtures import Tails, mahalanobis_squared
from mcaptrack.geometry.ragged import find_rows
from mcaptrack.predictors import NAMES, Forecast, PeopleSeen, Predictor, make, predict_among
from mcaptrack.predictors.tail_calibration import TABLES, counts_of
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.frame_columns import collect
from mcaptrack.schema.framing import JoinedFrames, join_frames
from mcaptrack.sources.walks import walks
from mcaptrack.transforms import PROFILES, Sample
from mcaptrack.transforms import forecasts as made_by
from mcaptrack.transforms.retrack.passes import LikelihoodPass, Movers

STEPS, PAST = 12, 8
#: People of a scene of walks, steps of each of their walks, and scenes and walks of a person in one draw.
PEOPLE, WALK, SCENES, WALKS = 24, 60, 48, 5
#: Kinds of faults: none, white noise, and those that settings of re-tracking are chosen with.
KINDS: dict[str, Corruption | None] = {
    "none": None,
    "white noise": Corruption(noise_m=0.1, seen_s=60, new_id=0.2, swap=0, flicker=0),
    **{
        kind: CORRUPTIONS[kind]
        for kind in (
            "holes", "very noisy", "slow noise", "hidden long", "clutter", "doubles", "merges", "broken ids",
        )
    },
}  # fmt: skip
#: Groups of forecasts: of tracks with a whole history, with a short one, and of coasting tracks.
FULL, SHORT, COASTING = range(3)
#: Quantiles of the squared distances by which groups are compared, and the least number of forecasts of a group.
QUANTILES, LEAST = (0.5, 0.8, 0.95), 100
ITERATIONS = 300


def scenes(seed: int, count: int) -> Iterator[np.ndarray]:
    """True rows (step, id, x, y): people who come and go."""
    paths, _ = walks(SCENES * PEOPLE * WALKS, WALK, STEP_S, seed)
    rng = np.random.default_rng([seed, 1])
    length = WALKS * WALK
    for places in paths.reshape(SCENES, PEOPLE, length, 2)[:count]:
        rows, number = [], 0
        for path in places:
            begin = int(rng.integers(0, 40))
            while begin < length - PAST:
                end = min(begin + int(rng.integers(25, 150)), length)
                number += 1
                steps = np.arange(begin, end)
                rows.append(np.column_stack([steps, np.full(len(steps), number), path[begin:end]]))
                begin = end + int(rng.integers(0, 100))
        yield np.concatenate(rows)


def histories(frames: list[Frame], past: int) -> tuple[np.ndarray, ...]:
    """Of each observed row: step, id, past (N, L, 2); whether the track coasts is for those of re-tracking."""
    kept, start = Histories(past), frames[0].t_ns
    parts = []
    for frame in frames:
        rows = frame.rows
        xy, known = kept.push(rows["track_id"], np.stack([rows["x_m"], rows["y_m"]], axis=-1))
        ready = rows["observed"] & known[:, -min(4, past) :].all(axis=1)
        step = round((frame.t_ns - start) / (STEP_S * NS_PER_S))
        parts.append((np.full(int(ready.sum()), step), rows["track_id"][ready], xy[ready], ~rows["observed"][ready]))
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))


class _Kept:
    """A predictor that keeps the pasts that predictions are made from."""

    def __init__(self, inner: Predictor) -> None:
        self.inner, self.pasts = inner, [np.empty((0, inner.past, 2))]

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def predict(self, xy_m: np.ndarray, valid: np.ndarray) -> Forecast:
        self.pasts.append(xy_m.copy())
        return self.inner.predict(xy_m, valid)


def _keys(joined: JoinedFrames, start_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """Step and track id of each row."""
    return np.rint((joined.row_ns - start_ns) / (STEP_S * NS_PER_S)).astype(int), joined.rows["track_id"].astype(int)


def distances(true: Positions, samples: list[Frame]) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """For each predictor squared distances (N, T), and groups (N,), from samples and after re-tracking."""
    start = samples[0].t_ns
    with patch.object(made_by, "make", lambda *given: _Kept(make(*given))):
        run = LikelihoodPass(PROFILES["default"], Movers(), collect(TRACKS, samples))
    kept = run._forecasts._predictor
    online, forecasts = map(list, run.outputs())
    joined, predicted = join_frames(TRACKS, online), join_frames(PREDICTIONS, forecasts)
    tracked, is_first = _keys(joined, start), predicted.rows["step"] == 1
    step, ids = (part[is_first] for part in _keys(predicted, start))
    after = step, ids, np.concatenate(kept.pasts), ~joined.rows["observed"][find_rows(tracked, (step, ids))]
    for frames, (step, ids, past, coasts) in ((samples, histories(samples, PAST)), (online, after)):
        rows = join_frames(TRACKS, frames)
        tracks = Positions(*_keys(rows, start), np.stack([rows.rows["x_m"], rows.rows["y_m"]], -1))
        for name in NAMES:
            predictor = make(name, STEPS, STEP_S)
            seen = past[:, -predictor.past :]
            known = np.isfinite(seen[..., 0])
            people = PeopleSeen(seen, known, step, np.arange(len(step)))
            mean, cov = predict_among(predictor, seen, known, people)
            found = pair_forecasts(true, tracks, Forecasts(step, ids, mean, cov))
            good = np.isfinite(found.offset_m).all(axis=(1, 2)) & (found.d_obs_m2 < TAU_M2)
            which = found.forecast[good]
            group = np.where(coasts[which], COASTING, np.where(known[which].all(axis=1), FULL, SHORT))
            yield name, mahalanobis_squared(found.offset_m[good], cov[which]), group


def fit(squared: np.ndarray, group: np.ndarray) -> dict[str, list[float]]:
    """The table of a predictor, from squared distances (N, T) and groups (N,)."""
    factor = np.ones((3, STEPS))
    whole = np.quantile(squared[group == FULL], QUANTILES, axis=0)
    for one in (SHORT, COASTING):
        if (group == one).sum() >= LEAST:
            factor[one] = np.exp(np.log(np.quantile(squared[group == one], QUANTILES, axis=0) / whole).mean(axis=0))
    step = np.broadcast_to(np.arange(STEPS), squared.shape)
    counts = counts_of(step.ravel(), (squared / factor[group] / 2).ravel(), STEPS)
    begin = Tails(np.full(STEPS, 0.2), np.full(STEPS, 0.5), np.full(STEPS, 3.0))
    tails = fit_mixture(counts, begin, ITERATIONS)
    found = {"ahead_s": STEP_S * np.arange(1, STEPS + 1), **tails._asdict()}
    found |= {"short": factor[SHORT], "coasting": factor[COASTING]}
    return {name: [float(f"{value:.4g}") for value in values] for name, values in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--check", action="store_true", help="compare the file with what comes out now")
    given = parser.parse_args()
    if not TABLES.exists():  # re-tracking reads it, though nothing here depends on it
        TABLES.write_text('{"predictors": {}}')
    parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {name: [] for name in NAMES}
    for number, truth in enumerate(scenes(given.seed, given.scenes)):
        first = int(truth[:, 0].min())
        steps = np.arange(first, int(truth[:, 0].max()) + 1)
        true = Positions(truth[:, 0].astype(int) - first, truth[:, 1].astype(int), truth[:, 2:])
        for how in KINDS.values():
            rows = truth if how is None else corrupt(truth, how, np.random.default_rng([given.seed, number]))
            tracks = on_clock(rows, steps)
            samples = [frame for (frame,) in Sample(start_ns=tracks[0].t_ns)(tracks)]
            for name, squared, group in distances(true, samples):
                parts[name].append((squared, group))
    tables = {name: fit(*(np.concatenate(part) for part in zip(*found, strict=True))) for name, found in parts.items()}
    card = {
        "made_by": f"tools/fit_tails.py --seed {given.seed} --scenes {given.scenes}, mcaptrack {__version__}",
        "data": "synthetic walks of mcaptrack with faults of trackers; no recordings",
        "licence": "Apache-2.0",
        "forecasts": str(sum(len(group) for _, group in parts["red"])),
    }
    text = json.dumps({"card": card, "predictors": tables}, indent=1) + "\n"
    if given.check:
        print("the same" if TABLES.read_text() == text else text)
        return
    TABLES.write_text(text)


if __name__ == "__main__":
    main()
