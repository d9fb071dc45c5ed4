"""Sampling and prediction against second, slow implementations, row by row, on random walkers."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mcaptrack.geometry.histories import Histories
from mcaptrack.predictors import make
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.frame_columns import collect
from mcaptrack.transforms import Predict, Sample, forecasts
from tests.worlds import noisy_tracks, ns

LINEAR = ("x_px", "y_px", "w_px", "h_px", "x_m", "y_m", "score")
SEEDS = st.integers(0, 2**32 - 1)


def as_rows(frames: list[Frame]) -> list[tuple[int, dict[str, float]]]:
    return [(f.t_ns, {name: row[name].item() for name in row.dtype.names}) for f in frames for row in f.rows]


def ticks_of(frames: list[Frame], start_ns: int, rate_hz: float, max_gap_s: float) -> list[int]:
    """The ticks at a frame, or between two frames that are no further apart than a gap may be, or than two ticks."""
    times = [frame.t_ns for frame in frames]
    limit = max(round(max_gap_s * 1e9), round(2e9 / rate_hz))
    out, number = [], 0
    while (t := start_ns + round(number * 1e9 / rate_hz)) <= times[-1]:
        spans = [(a, b) for a, b in zip(times, [*times[1:], times[-1]], strict=True) if a <= t <= b]
        if t in times or any(b - a <= limit for a, b in spans):
            out.append(t)
        number += 1
    return out


def slow_sample(frames: list[Frame], options: Sample) -> list[tuple[int, int, list[dict[str, float]]]]:
    times = [frame.t_ns for frame in frames]
    usual = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    paths: dict[int, list] = {}
    for t, row in as_rows(frames):
        paths.setdefault(row["track_id"], []).append((t, row))
    out = []
    for tick in ticks_of(frames, options.start_ns or times[0], options.rate_hz, options.max_gap_s):
        rows = []
        for who in sorted(paths):
            before = [(t, row) for t, row in paths[who] if t <= tick]
            after = [(t, row) for t, row in paths[who] if t > tick]
            if not before:
                continue
            (low, one), made = before[-1], dict(before[-1][1])
            if low != tick:
                if not after or after[0][0] - low > round(options.max_gap_s * 1e9):
                    continue
                high, other = after[0]
                for name in LINEAR:
                    made[name] += (tick - low) / (high - low) * (other[name] - one[name])
                made["observed"] = one["observed"] and other["observed"] and high - low <= 1.5 * usual
            rows.append(made | {"source_id": who})
        out.append((tick, max(frame.index for frame in frames if frame.t_ns <= tick), rows))
    return out


@given(
    seed=SEEDS,
    rate_hz=st.sampled_from([1.0, 2.5, 3.0, 10.0]),
    gap_s=st.sampled_from([0.0, 0.3, 0.4, 1.0, 2.0]),
    late=st.sampled_from([None, -3.0, 0.7]),
)
@settings(max_examples=30)
def test_samples_equal_the_reference(seed, rate_hz, gap_s, late):
    rng = np.random.default_rng(seed)
    frames = noisy_tracks(rng, ticks=25, rate_hz=7.0, hidden=0.05)
    if rng.random() < 0.5:  # some frames are exactly on ticks
        frames = [frame._replace(t_ns=ns(round(frame.t_ns / 1e9 * 10) / 10)) for frame in frames]
        frames = [a for a, b in zip(frames, [*frames[1:], None], strict=True) if b is None or a.t_ns < b.t_ns]
    start_ns = None if late is None else max(frames[0].t_ns + ns(late), 1)
    sample = Sample(rate_hz=rate_hz, max_gap_s=gap_s, start_ns=start_ns)
    wanted = slow_sample(frames, sample)
    found = [frame for (frame,) in sample(frames)]
    assert [(frame.t_ns, frame.index) for frame in found] == [(t, index) for t, index, _ in wanted]
    for frame, (_, _, rows) in zip(found, wanted, strict=True):
        mine = [row for _, row in as_rows([frame])]
        assert [row["track_id"] for row in mine] == [row["track_id"] for row in rows]
        for a, b in zip(mine, rows, strict=True):
            assert a == pytest.approx(b, rel=1e-6, abs=1e-6, nan_ok=True)


def test_gaps_of_up_to_two_ticks_have_ticks_and_longer_ones_have_none():
    """No row is interpolated there (the gap limit is 0), but the ticks exist, as frames without rows."""
    for apart_s, ticks in ((0.8, [0.0, 0.4, 0.8]), (0.81, [0.0])):
        frames = [Frame(ns(k * apart_s), k, noisy_tracks(np.random.default_rng(0), ticks=1)[0].rows) for k in range(2)]
        found = [frame for (frame,) in Sample(max_gap_s=0.0)(frames)]
        assert [frame.t_ns for frame in found] == [ns(t) for t in ticks]


@given(seed=SEEDS, least=st.sampled_from([1, 2, 4, 9]), name=st.sampled_from(["cv", "holt-cv", "red"]))
@settings(max_examples=25)
def test_forecasts_equal_those_made_one_by_one(seed, least, name):
    rate_hz = 2.5
    frames = noisy_tracks(np.random.default_rng(seed), ticks=25, rate_hz=rate_hz)
    predictor = make(name, 5, 1 / rate_hz)
    length = max(predictor.past, least)
    places: dict[tuple[int, int], tuple[float, float]] = {}
    step = 0
    found = [frame for (frame,) in Predict(predictor=name, min_history=least, horizon_s=2.0, rate_hz=rate_hz)(frames)]
    for at, (frame, made) in enumerate(zip(frames, found, strict=True)):
        if at:
            step += max(1, round((frame.t_ns - frames[at - 1].t_ns) / 1e9 * rate_hz))
        for row in frame.rows:
            places[step, int(row["track_id"])] = (float(row["x_m"]), float(row["y_m"]))
        wanted = []
        for row in frame.rows:
            past = [places.get((step - back, int(row["track_id"]))) for back in range(length - 1, -1, -1)]
            if None in past[-least:] or not row["observed"]:
                continue
            known = np.array([[place is not None for place in past]])
            mean, cov = predictor.predict(np.array([[place or (np.nan, np.nan) for place in past]]), known)
            for ahead in range(5):
                xx, xy, yy = cov[0, ahead, [0, 0, 1], [0, 1, 1]]
                ahead_s = (ahead + 1) / rate_hz
                wanted.append((row["track_id"], ahead + 1, ahead_s, *mean[0, ahead], xx, xy, yy))
        assert (made.t_ns, made.index) == (frame.t_ns, frame.index)
        columns = ["track_id", "step", "ahead_s", "x_m", "y_m", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2"]
        mine = np.array(made.rows[columns].tolist()).reshape(-1, 8)
        theirs = np.array(wanted).reshape(-1, 8)
        np.testing.assert_allclose(mine[:, :5], theirs[:, :5], atol=1e-9)
        # The calibration scales the predictor's covariance.
        scale = mine[:, 5] / theirs[:, 5]
        np.testing.assert_allclose(mine[:, 5:], scale[:, None] * theirs[:, 5:], rtol=1e-9, atol=1e-12)
        assert (scale > 0.01).all()


# Predictions of many frames at once: to the last bit those that are made frame by frame


NAMES = ((1, "pedestrian"), (2, "bicycle"), (3, "car"), (4, "blob"))


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
