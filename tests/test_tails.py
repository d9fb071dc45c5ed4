"""Calibrated forecasts: what the table says, and how it follows a log."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from mcaptrack.evaluation.metrics.calibration import ellipse_levels
from mcaptrack.geometry.mixtures import Tails, squared_radius
from mcaptrack.notices import Notice, listening
from mcaptrack.predictors import NAMES, Forecast, make
from mcaptrack.predictors.tails import TABLES, TailCalibration, counts_of, fit_mixture, table_of
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.predictions import tails_of
from mcaptrack.transforms import PROFILES
from mcaptrack.transforms.predict import Predict

STEP_NS = 400_000_000


def walkers(count: int = 6, ticks: int = 80, noise_m: float = 0.01, seed: int = 1) -> list[Frame]:
    """People on parallel straight lines, each 8 m from the next, measured with noise."""
    rng = np.random.default_rng(seed)
    out = []
    for tick in range(ticks):
        ids = np.arange(1, count + 1)
        xy = np.stack([0.5 * tick + np.zeros(count), 8.0 * ids], axis=-1) + noise_m * rng.normal(size=(count, 2))
        rows = TRACKS.rows(
            track_id=ids, x_m=xy[:, 0], y_m=xy[:, 1], observed=np.ones(count, bool), source_id=np.full(count, -1)
        )
        out.append(Frame(tick * STEP_NS, tick, rows))
    return out


class TestTable:
    @pytest.mark.parametrize("name", NAMES)
    def test_every_predictor_has_one(self, name):
        table = table_of(name)
        assert len({len(part) for part in table}) == 1
        assert (table.narrow_scale < table.wide_scale).all()
        assert ((table.wide_weight > 0) & (table.wide_weight < 1)).all()
        assert table.short[0] > 1
        assert (table.coasting > 1).all()

    def test_the_file_says_what_it_was_made_of(self):
        card = json.loads(TABLES.read_text())["card"]
        assert "synthetic" in card["data"]
        assert card["licence"] == "Apache-2.0"
        assert "tools/fit_tails.py" in card["made_by"]

    def test_networks_with_other_weights_and_other_predictors_have_none(self):
        assert table_of("red:mine.safetensors") is None
        assert table_of("package:Class") is None

    def test_at_other_times_it_is_between_its_neighbours(self):
        table = table_of("red")
        (one,) = zip(*table.at(np.array([0.6])), strict=True)
        for value, part in zip(one[1:], table[1:], strict=True):
            assert min(part[:2]) <= value <= max(part[:2])
        assert table.at(np.array([0.1, 9.0])).wide_scale.tolist() == pytest.approx(table.wide_scale[[0, -1]].tolist())


def test_a_mixture_is_found_again_from_its_samples():
    rng = np.random.default_rng(2)
    scale = np.where(rng.random(50_000) < 0.3, 6.0, 0.5)
    half = scale * (rng.normal(size=(50_000, 2)) ** 2).sum(axis=1) / 2
    counts = counts_of(np.zeros(len(half), np.int64), half, 1)
    assert counts.sum() == len(half)
    found = fit_mixture(counts, Tails(*(np.array([part]) for part in (0.5, 0.2, 2.0))), 200)
    assert [part.item() for part in found] == pytest.approx([0.3, 0.5, 6.0], rel=0.08)


class TestCalibration:
    def forecasts(self, sd_m: float, noise_m: float = 0.0, steps: int = 60, tracks: int = 40):
        """Errors of a known size of a predictor that says 1 m; the levels of the ellipses that hold them, by time."""
        rng = np.random.default_rng(4)
        predictor = make("kalman", 3, 0.4)
        calibration = TailCalibration.of("kalman", predictor)
        ids, levels = np.arange(tracks), []
        place = np.zeros((steps + 4, tracks, 2))
        for step in range(steps):
            mean = np.stack([place[step + k] + sd_m * rng.normal(size=(tracks, 2)) for k in (1, 2, 3)], axis=1)
            cov = np.tile(np.eye(2), (tracks, 3, 1, 1))
            past = noise_m * rng.normal(size=(tracks, 8, 2))
            made, tails = calibration(step, ids, Forecast(mean, cov), past, np.zeros(tracks, bool))
            truth = np.stack([place[step + k] for k in (1, 2, 3)], axis=1)
            levels.append(ellipse_levels(made.mean - truth, made.cov, tails))
        return np.array(levels)

    @pytest.mark.parametrize("sd_m", [0.05, 0.5, 3.0])
    def test_ellipses_come_to_hold_what_they_say(self, sd_m):
        levels = self.forecasts(sd_m)[30:]
        for level in (0.5, 0.95):
            assert (levels <= level).mean() == pytest.approx(level, abs=0.04)

    def test_ellipses_are_of_true_positions_though_measured_ones_have_noise(self):
        levels = self.forecasts(0.3, noise_m=0.3, steps=200)[100:]
        assert (levels <= 0.5).mean() == pytest.approx(0.5, abs=0.08)

    def test_the_covariance_is_that_of_the_mixture(self):
        predictor = make("red", 12, 0.4)
        calibration = TailCalibration.of("red", predictor)
        past = np.cumsum(np.full((2, 8, 2), 0.3), axis=1)
        plain = predictor.predict(past, np.ones((2, 8), bool))
        made, tails = calibration(0, np.array([1, 2]), plain, past, np.zeros(2, bool))
        weight, narrow, wide = tails
        assert ((1 - weight) * narrow + weight * wide).ravel().tolist() == pytest.approx([1.0] * 24)
        assert made.mean.tolist() == plain.mean.tolist()
        assert (squared_radius(0.5, tails) < 2 * np.log(2)).all()  # most errors are small

    def test_short_and_coasting_tracks_have_larger_ellipses(self):
        predictor = make("kalman", 12, 0.4)
        past = np.cumsum(np.full((3, 8, 2), 0.3), axis=1)
        past[1, :4] = np.nan
        given = Forecast(np.zeros((3, 12, 2)), np.tile(np.eye(2), (3, 12, 1, 1)))
        made, _ = TailCalibration.of("kalman", predictor)(0, np.arange(3), given, past, np.array([False, False, True]))
        whole, short, coasting = made.cov[:, :, 0, 0]
        assert (short > whole).all()
        assert (coasting > short).all()


def spread(frames: list[Frame]) -> np.ndarray:
    """The squared half axes of the 50 % ellipses of the last step, by time."""
    out = []
    for frame in frames:
        rows = frame.rows[frame.rows["step"] == 12]
        out.append(np.mean(rows["cov_xx_m2"] * squared_radius(0.5, tails_of(rows))) if len(rows) else np.nan)
    return np.array(out)


class TestInTransforms:
    def test_predictions_follow_the_log(self):
        """People who walk straight on come to have small ellipses, others keep theirs."""
        calm = spread([frame for (frame,) in Predict()(walkers())])
        assert calm[-1] < 0.3 * calm[5]

    @pytest.mark.parametrize("name", ["predictions", "retracks"])
    def test_predictions_depend_on_the_past_alone(self, name):
        def run(frames: list[Frame]) -> list[Frame]:
            if name == "predictions":
                return [frame for (frame,) in Predict()(frames)]
            return [frames[2] for frames in PROFILES["default"](frames)]

        frames = walkers(ticks=50, noise_m=0.1)
        whole, begun = run(frames), run(frames[:30])
        for one, other in zip(whole[:30], begun, strict=True):
            assert one.rows.dtype == other.rows.dtype
            for column in one.rows.dtype.names:
                np.testing.assert_allclose(one.rows[column], other.rows[column], rtol=1e-6)
        assert any(len(frame.rows) for frame in begun)

    def test_the_profiles_of_the_paper_have_none(self):
        for name in ("paper", "authors"):
            made = [frames[2].rows for frames in PROFILES[name](walkers(ticks=20))]
            assert sum(len(rows) for rows in made) > 100
            assert all(np.isnan(part).all() for rows in made for part in tails_of(rows))

    def test_a_network_that_loses_to_constant_velocity_says_so(self):
        warned: list[Notice] = []
        for transform in (Predict(predictor="lstm"), replace(PROFILES["default"], predictor="lstm")):
            with listening(warned.append):
                list(transform(walkers(ticks=8)))
            assert [warned.pop().code] == ["weak-predictor"]
        with listening(warned.append):
            for name in ("red", "cv"):
                list(Predict(predictor=name)(walkers(ticks=8)))
        assert warned == []

    def test_means_are_those_of_the_predictor(self):
        frames = walkers(ticks=20)
        *_, (last,) = Predict()(frames)
        past = np.stack([[frame.rows["x_m"], frame.rows["y_m"]] for frame in frames[-8:]], axis=0).transpose(2, 0, 1)
        mean, _ = make("red", 12, 0.4).predict(past, np.ones(past.shape[:2], bool))
        np.testing.assert_allclose(np.stack([last.rows["x_m"], last.rows["y_m"]], -1).reshape(-1, 12, 2), mean)
