"""Sampling, predictors, prediction."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.stats import chi2, multivariate_normal

from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.forecasts import score_forecasts
from mcaptrack.evaluation.metrics.displacement import RELIABILITY_LEVELS, negative_log_likelihood
from mcaptrack.foxglove.views.people import ellipses, forecasts
from mcaptrack.geometry.mixtures import Tails, half_radius, mass_within, squared_radius
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.predictors import Forecast, make
from mcaptrack.predictors.linear import (
    DRIFT_M2_PER_S3,
    POSITION_NOISE_M,
    SPEED_M_PER_S,
    LinearPredictor,
)
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.as_rows import forecast_to_rows, tails_of
from mcaptrack.schema.encodings import CdrCodec, fields_of
from mcaptrack.transforms import Predict, Sample
from tests.worlds import ids, ns, places, walk

LINEAR = ["cv", "holt-cv", "kalman"]
every_linear = pytest.mark.parametrize("name", LINEAR)


def sampled(frames, **options):
    return [frame for (frame,) in Sample(**options)(frames)]


class TestSample:
    def test_boxes_are_projected_by_the_plane_valid_at_their_time(self):
        rows = TRACKS.rows(
            track_id=[1], x_px=[10.0], y_px=[20.0], w_px=[4.0], h_px=[8.0], observed=[True], source_id=[-1]
        )
        planes = [
            (0, GroundPlane((0.1, 0, 0, 0, 0.1, 0, 0, 0, 1), 99, 99)),
            (ns(0.4), GroundPlane((1, 0, 0, 0, 1, 0, 0, 0, 1), 99, 99)),
        ]
        out = sampled([Frame(0, 0, rows), Frame(ns(0.4), 1, rows)], ground_planes=planes)
        assert [places(frame) for frame in out] == [{1: (1.2, 2.8)}, {1: (12.0, 28.0)}]
        with pytest.raises(McaptrackError, match="tracks are in pixels, and there is no ground plane"):
            sampled([Frame(0, 0, rows)])

    def test_boxes_above_the_horizon_are_left_out(self):
        tilted = GroundPlane((0.01, 0, 0, 0, 0.01, 0, 0, 0.01, -1), 200, 200)
        rows = TRACKS.rows(
            track_id=[1, 2],
            x_px=[10.0, 10],
            y_px=[20.0, 150],
            w_px=[4.0, 4],
            h_px=[8.0, 8],
            observed=[True] * 2,
            source_id=[-1] * 2,
        )
        (frame,) = sampled([Frame(0, 0, rows)], ground_planes=[(0, tilted)])
        assert ids(frame) == [2]


class TestPredictors:
    @every_linear
    def test_straight_lines_are_extrapolated(self, name):
        steps = np.arange(8)[:, None] * [0.5, -0.2]
        forecast = make(name, 12, 0.4).predict(steps[None], np.ones((1, 8), bool))
        ahead = 7 + np.arange(1, 13)
        wanted = ahead[:, None] * [0.5, -0.2]
        # The Kalman filter starts from "at rest, perhaps" and never quite forgets it.
        np.testing.assert_allclose(forecast.mean[0], wanted, rtol=0.02 if name == "kalman" else 1e-9)

    @every_linear
    @pytest.mark.parametrize("known", [1, 3, 8])
    def test_variance_equals_that_of_simulated_motion(self, name, known):
        rng, step, fine, people = np.random.default_rng(known), 0.4, 8, 20_000
        speed = rng.normal(0, SPEED_M_PER_S, people)
        place, path = np.zeros(people), []
        for _ in range(known + 12):
            path.append(place.copy())
            for _ in range(fine):
                kick = rng.normal(0, np.sqrt(DRIFT_M2_PER_S3 * step / fine), people)
                place += (speed + kick / 2) * step / fine
                speed = speed + kick
        path = np.array(path).T
        seen = path[:, :known] + rng.normal(0, POSITION_NOISE_M, (people, known))
        forecast = make(name, 12, step).predict(np.stack([seen, seen], -1), np.ones((people, known), bool))
        errors = forecast.mean[:, :, 0] - path[:, known:]
        predictor = LinearPredictor(name, 12, step)
        said = np.sqrt(predictor.table[1][min(known, predictor.past)])
        np.testing.assert_allclose(errors.std(axis=0), said, rtol=0.04)

    @pytest.mark.parametrize("known", [2, 3, 5, 8])
    def test_the_scale_is_that_of_the_innovations_of_a_kalman_filter(self, known):
        """Four innovations of variance 1 are assumed beside those that are seen, along both axes; then 1.5 times."""
        rng, step_s = np.random.default_rng(known), 0.4
        pasts = np.cumsum(rng.normal(0.3, [[[0.1]], [[0.25]], [[0.3]], [[0.4]]], (4, known, 2)), axis=1)
        total = np.zeros(4)
        move = np.array([[1.0, step_s], [0.0, 1.0]])
        noise = 0.06 * np.array([[step_s**3 / 3, step_s**2 / 2], [step_s**2 / 2, step_s]])
        for track in range(4):
            for axis in range(2):
                state, cov = np.array([pasts[track, 0, axis], 0.0]), np.diag([0.04, 1.0])
                for seen in pasts[track, 1:, axis]:
                    state, cov = move @ state, move @ cov @ move.T + noise
                    spread = cov[0, 0] + 0.04
                    innovation, gain = seen - state[0], cov[:, 0] / spread
                    total[track] += innovation**2 / spread
                    state, cov = state + gain * innovation, cov - np.outer(gain, cov[0])
        wanted = 1.5 * np.clip((4 + total) / (4 + 2 * (known - 1)), 0.7, 2.0)
        assert len(set(wanted.tolist())) > 2 or known < 5
        for name in LINEAR:
            predictor = LinearPredictor(name, 3, step_s)
            cov = predictor.predict(pasts, np.ones((4, known), bool)).cov
            plain = predictor.table[1][min(known, predictor.past)]
            np.testing.assert_allclose(cov[:, :, 0, 0], wanted[:, None] * plain, rtol=1e-9)
            np.testing.assert_allclose(cov[:, :, 1, 1], cov[:, :, 0, 0])
            assert not cov[:, :, 0, 1].any()


class TestPredict:
    def run(self, frames, **options):
        return [frame for (frame,) in Predict(**options)(frames)]

    @pytest.mark.parametrize(("horizon_s", "steps"), [(0.1, 1), (0.6, 2), (0.61, 2), (1.0, 2), (1.01, 3)])
    def test_there_is_one_step_at_least_and_as_many_as_fit_best(self, horizon_s, steps):
        """At 2.5 steps a second; a half is rounded to the even number."""
        out = self.run(walk(lambda n: {1: (float(n), 0.0)}, 6), horizon_s=horizon_s, predictor="cv")
        assert out[-1].rows["step"].tolist() == list(range(1, steps + 1))


# Mixtures of a narrow and a wide normal distribution: laws, SciPy, and samples drawn from them; and their columns


WEIGHTS = st.floats(0.01, 0.9)
NARROW = st.floats(0.05, 1.0)
WIDE = st.floats(1.0, 50.0)


def tails(*parts: float) -> Tails:
    return Tails(*(np.array([part]) for part in parts))


def drawn(rng: np.random.Generator, cov: np.ndarray, shape: tuple[float, float, float], count: int) -> np.ndarray:
    weight, narrow, wide = shape
    scale = np.where(rng.random(count) < weight, wide, narrow)
    return np.sqrt(scale)[:, None] * rng.multivariate_normal([0, 0], cov, count)


@given(WEIGHTS, NARROW, WIDE)
def test_levels_and_radii_are_monotone_and_inverse(weight, narrow, wide):
    shape = tails(weight, narrow, wide)
    radii = [squared_radius(level, shape).item() for level in RELIABILITY_LEVELS]
    assert radii == sorted(set(radii))
    for level, radius in zip(RELIABILITY_LEVELS, radii, strict=True):
        assert mass_within(np.array([radius]), shape).item() == pytest.approx(level, abs=1e-12)
    assert mass_within(np.zeros(1), shape).item() == 0
    assert mass_within(np.array([1e9]), shape).item() == pytest.approx(1)


@given(WEIGHTS, st.floats(-2, 0), st.floats(0, 2), st.floats(0.01, 0.995))
@example(0.5, -2.0, 2.0, 0.5)
def test_radii_in_few_operations_are_those_of_halvings(weight, narrow, wide, level):
    shape = tails(weight, 10**narrow, 10**wide)
    assert 2 * half_radius(np.array([level]), shape).item() == pytest.approx(squared_radius(level, shape).item(), 1e-6)


@given(WEIGHTS, NARROW, WIDE, st.tuples(st.floats(-5, 5), st.floats(-5, 5)))
def test_the_likelihood_equals_that_of_scipy(weight, narrow, wide, error):
    cov = np.array([[2.0, 0.6], [0.6, 0.5]])
    parts = [multivariate_normal.pdf(error, [0, 0], scale * cov) for scale in (narrow, wide)]
    wanted = -np.log((1 - weight) * parts[0] + weight * parts[1])
    found = negative_log_likelihood(np.array([error]), cov[None], tails(weight, narrow, wide))
    assert found.item() == pytest.approx(wanted)


def forecast(count: int = 2, steps: int = 3) -> Forecast:
    return Forecast(np.ones((count, steps, 2)), np.tile(np.diag([4.0, 1.0]), (count, steps, 1, 1)))


def mixture(count: int = 2, steps: int = 3) -> Tails:
    return Tails(*(np.full((count, steps), part) for part in (0.25, 0.5, 2.5)))


IDS = np.array([1, 2])


class TestColumns:
    def test_a_mixture_survives_a_round_trip(self):
        rows = forecast_to_rows(IDS, forecast(), 0.4, mixture())
        cdr = CdrCodec(PREDICTIONS.codec, fields_of(PREDICTIONS.definition))
        from_ros, counts = cdr.decode_all(cdr.encode_all(rows, np.array([3, 3])))
        assert counts.tolist() == [3, 3]
        for back in (PREDICTIONS.codec.decode(PREDICTIONS.codec.encode(rows)), from_ros):
            assert [part.tolist() for part in tails_of(back, 3)] == [part.tolist() for part in mixture()]

    def test_tables_have_null_where_there_is_no_mixture(self):
        assert all(PREDICTIONS.arrow.field(name).nullable for name in Tails._fields)

    def test_views_draw_the_ellipse_of_the_mixture(self):
        frames = [Frame(0, 0, forecast_to_rows(IDS, forecast(), 0.4, shape)) for shape in (None, mixture())]
        (normal,), (mixed,) = (forecasts([frame]) for frame in frames)
        half, _ = ellipses(normal.spread_m2)
        assert half[0].tolist() == pytest.approx([2 * np.sqrt(chi2.ppf(0.5, 2)), np.sqrt(chi2.ppf(0.5, 2))])
        half, _ = ellipses(mixed.spread_m2)
        samples = drawn(np.random.default_rng(1), np.diag([4.0, 1.0]), (0.25, 0.5, 2.5), 40_000)
        inside = ((samples / half[0]) ** 2).sum(axis=1) <= 1
        assert inside.mean() == pytest.approx(0.5, abs=0.01)


def walker(offset_m: float = 0.0) -> list[Frame]:
    """One person at 1 m/s, and perhaps beside."""
    return [
        Frame(
            tick * 400_000_000,
            tick,
            TRACKS.rows(track_id=[1], x_m=[0.4 * tick], y_m=[offset_m], observed=[True], source_id=[-1]),
        )
        for tick in range(12)
    ]


def test_scores_are_those_of_the_mixture():
    """A forecast 2 m beside the person, in variances of 1: outside of 50 % of the normal distribution, not of a mixture
    with a part that is four times as wide."""
    made = Forecast(np.array([[[0.4 * 6, 2.0]]]), np.eye(2)[None, None])
    wide = Tails(*(np.array([[part]]) for part in (0.9, 0.5, 4.0)))
    found = {}
    for name, shape in (("normal", None), ("mixture", wide)):
        frames = [Frame(5 * 400_000_000, 5, forecast_to_rows(np.array([1]), made, 0.4, shape))]
        result = score_forecasts(frames, walker(), walker(), name)
        found[name] = result
        assert [part["level"] for part in result.reliability()] == list(RELIABILITY_LEVELS)
    assert found["normal"].summary()["coverage_50"] == 0
    assert found["mixture"].summary()["coverage_50"] == 1
    assert found["normal"].summary()["NLL"] == pytest.approx(2 + np.log(2 * np.pi))
    wanted = 0.1 / 0.5 * np.exp(-2 / 0.5) + 0.9 / 4 * np.exp(-2 / 4)
    assert found["mixture"].summary()["NLL"] == pytest.approx(-np.log(wanted / (2 * np.pi)))
    # 1 - exp(-2) = 86.5 % of the normal distribution lie nearer
    assert [part["held"] for part in found["normal"].reliability()] == [0.0] * 8 + [1.0] * 3


def test_forecasts_without_covariance_have_no_reliability():
    made = Forecast(np.array([[[2.4, 0.0]]]), np.full((1, 1, 2, 2), np.nan))
    frames = [Frame(5 * 400_000_000, 5, forecast_to_rows(np.array([1]), made, 0.4))]
    result = score_forecasts(frames, walker(), walker(), "forecasts")
    assert result.reliability() == []
    assert result.summary()["NLL"] is None
    assert result.summary()["ADE_m"] == pytest.approx(0)
