"""Mixtures of a narrow and a wide normal distribution: laws, SciPy, and samples drawn from them; and their columns."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.stats import chi2, multivariate_normal

from mcaptrack.evaluation.forecasts import score_forecasts
from mcaptrack.evaluation.metrics.displacement import RELIABILITY_LEVELS, negative_log_likelihood
from mcaptrack.foxglove.views.people import ellipses, forecasts
from mcaptrack.geometry.mixtures import Tails, half_radius, mass_within, squared_radius
from mcaptrack.predictors import Forecast
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.encodings import CdrCodec, fields_of
from mcaptrack.schema.predictions import forecast_to_rows, tails_of

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


def walk(offset_m: float = 0.0) -> list[Frame]:
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
        result = score_forecasts(frames, walk(), walk(), name)
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
    result = score_forecasts(frames, walk(), walk(), "forecasts")
    assert result.reliability() == []
    assert result.summary()["NLL"] is None
    assert result.summary()["ADE_m"] == pytest.approx(0)
