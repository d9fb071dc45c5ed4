"""Predictions that are made for many frames at once: to the last bit those that are made frame by frame."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mcaptrack.geometry.histories import Histories
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.frame_columns import collect
from mcaptrack.transforms import forecasts
from tests.worlds import ns

NAMES = ((1, "pedestrian"), (2, "bicycle"), (3, "car"), (4, "blob"))
SEEDS = st.integers(0, 2**32 - 1)


def drive(seed: int, most: float = 1.0) -> list[Frame]:
    """Frames of tracks with velocities: of people or of people and vehicles, with gaps, some not observed."""
    rng = np.random.default_rng(seed)
    at = np.cumsum(rng.choice([1, 1, 1, 2, 30], rng.integers(0, 12)))
    speed, start = rng.choice([0.0, 0.1, 1.5], 6), rng.uniform(-50, 50, 6)
    frames = []
    for n, tick in enumerate(at.tolist()):
        ids = rng.permutation(6 if rng.random() < most else 2)[: rng.integers(0, 7)]
        x_m = start[ids] + speed[ids] * tick * 0.4 + rng.normal(0, 0.05, len(ids))
        rows = TRACKS.rows(
            track_id=ids, x_m=x_m, y_m=0.3 * x_m, observed=rng.random(len(ids)) < 0.8, source_id=-ids - 1,
            class_id=np.minimum(ids // 2 + 1, 4), vx_m_per_s=speed[ids], vy_m_per_s=0.3 * speed[ids],
        )  # fmt: skip
        frames.append(Frame(ns(tick / 2.5), n, rows))
    return frames


def one_by_one(frames: list[Frame], predictor: str) -> list[bytes]:
    forecaster = forecasts.Forecaster(predictor, 2.0, 2, 2.5, NAMES)
    return [PREDICTIONS.codec.encode(forecaster.predict(frame)) for frame in frames]


def together(frames: list[Frame], predictor: str) -> list[bytes]:
    made = forecasts.Forecaster(predictor, 2.0, 2, 2.5, NAMES).predict_all(collect(TRACKS, frames))
    assert [(frame.t_ns, frame.index) for frame in made] == [(frame.t_ns, frame.index) for frame in frames]
    return [PREDICTIONS.codec.encode(frame.rows) for frame in made]


@pytest.mark.parametrize(("predictor", "part_rows"), [("holt-cv", 2048), ("kalman", 5)])
@settings(max_examples=8)
@example(seed=0, most=0.5)
@given(seed=SEEDS, most=st.sampled_from([0.0, 0.5, 1.0]))
def test_many_frames_at_once_give_the_same_bytes(predictor: str, part_rows: int, seed: int, most: float):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(forecasts, "_PART_ROWS", part_rows)
        frames = drive(seed, most)
        assert together(frames, predictor) == one_by_one(frames, predictor)


@pytest.mark.parametrize("change", ["other people", "no velocities", "an id twice"])
def test_what_cannot_be_predicted_together_is_predicted_frame_by_frame(change: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(forecasts, "_PART_ROWS", 9)
    rng, frames = np.random.default_rng(4), []
    for n in range(8):
        x_m, speed = (
            8.0 * np.arange(4) + n / 2 + rng.normal(0, 0.1, 4),
            np.full(4, np.nan if change == "no velocities" else 1),
        )
        ids = [3, 2, 3, 1] if change == "an id twice" and n == 5 else [3, 2, 4, 1]
        rows = TRACKS.rows(
            track_id=ids, x_m=x_m, y_m=x_m, observed=[True] * 4, source_id=ids, class_id=[1, 1, 1, 3],
            vx_m_per_s=speed, vy_m_per_s=speed,
        )  # fmt: skip
        frames.append(Frame(ns(n / 2.5), n, rows))
    predictor = "social" if change == "other people" else "cv"
    made = together(frames, predictor)
    assert made == one_by_one(frames, predictor)
    assert list(map(bool, made)) == [n > 0 for n in range(8)]


@settings(max_examples=25)
@given(seed=SEEDS, length=st.integers(1, 6))
def test_histories_are_the_same_if_many_times_are_pushed_at_once(seed: int, length: int):
    rng, one, all_at_once = np.random.default_rng(seed), Histories(length), Histories(length)
    for _ in range(3):
        steps = rng.choice([1, 2, 3, 50], rng.integers(0, 8))
        seen = [rng.permutation(9)[: rng.integers(0, 7)] for _ in steps]
        ends = np.cumsum([0, *map(len, seen)])
        ids, xy_m = np.concatenate([np.empty(0, np.int64), *seen]), rng.normal(size=(ends[-1], 2))
        xy_m[rng.random(ends[-1]) < 0.2] = np.nan
        bounds = zip(pairwise(ends.tolist()), steps.tolist(), strict=True)
        parts = [one.push(ids[low:high], xy_m[low:high], step) for (low, high), step in bounds]
        past, known = all_at_once.push_all(steps, ends, ids, xy_m)
        np.testing.assert_array_equal(past, np.concatenate([past[:0], *(part[0] for part in parts)]))
        np.testing.assert_array_equal(known, np.concatenate([known[:0], *(part[1] for part in parts)]))
        np.testing.assert_array_equal(one.ids, all_at_once.ids)
        np.testing.assert_array_equal(one.xy_m, all_at_once.xy_m)
