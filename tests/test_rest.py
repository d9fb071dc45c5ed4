"""Predictions of vehicles that stand: they stay, and ellipses are as small as that is certain."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.predictors import Forecast, vehicle_tails
from mcaptrack.predictors.tail_calibration import TailCalibration
from mcaptrack.schema import TRACKS, Frame, Rows
from mcaptrack.transforms import Predict, forecasts
from tests.worlds import ns

NAMES = ((1, "pedestrian"), (3, "car"))
STEPS = 10


def last_forecast(class_id: int, speed_m_per_s: float, in_metres: bool, stops: int = 0, predictor: str = "red") -> Rows:
    """The forecast of an object along x, with or without the velocities that a tracker in metres gives."""
    velocity = {"vx_m_per_s": [speed_m_per_s], "vy_m_per_s": [0.0]} if in_metres else {}
    frames = []
    for tick in range(STEPS):
        x_m = speed_m_per_s * min(tick, STEPS - stops) / 2.5
        rows = TRACKS.rows(
            track_id=[1], x_m=[x_m], y_m=[0.0], observed=[True], source_id=[-1], class_id=[class_id], **velocity
        )
        frames.append(Frame(ns(tick / 2.5), tick, rows))
    return [frame.rows for (frame,) in Predict(predictor=predictor, class_names=NAMES)(frames)][-1]


def axis_m(rows: Rows) -> float:
    """Half of the longer axis of the last 95 % ellipse, by its largest eigenvalue."""
    xx, xy, yy = (float(rows[name][-1]) for name in ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2"))
    return float(np.sqrt(-2 * np.log(0.05) * np.linalg.eigvalsh([[xx, xy], [xy, yy]])[-1]))


@pytest.fixture(autouse=True)
def as_predicted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ellipses as predictors make them: otherwise they follow the log, and those of vehicles are mixtures."""
    monkeypatch.setattr(TailCalibration, "of", lambda *_: None)
    monkeypatch.setattr(vehicle_tails, "_tables", dict)


@pytest.mark.parametrize("predictor", ["red", "kalman", "cv"])
def test_a_car_that_stands_has_an_ellipse_of_a_few_metres(predictor: str):
    before, now = (axis_m(last_forecast(3, 0.0, known, predictor=predictor)) for known in (False, True))
    assert before > 8
    assert 1 < now < 7
    assert now < before / 2


@pytest.mark.parametrize(("class_id", "speed_m_per_s"), [(3, 8.0), (1, 0.0), (1, 1.3)])
def test_what_moves_and_people_are_predicted_as_without_velocities(class_id: int, speed_m_per_s: float):
    given, without = (last_forecast(class_id, speed_m_per_s, known) for known in (True, False))
    for name in ("x_m", "y_m", "cov_xx_m2", "cov_yy_m2"):
        np.testing.assert_allclose(given[name], without[name], rtol=1e-6)


def test_a_car_that_has_just_stopped_may_go_on():
    """Its history still has the way that it went."""
    stopped, stands = (axis_m(last_forecast(3, speed, True, stops=3)) for speed in (8.0, 0.0))
    assert stopped > 3 * stands


@pytest.mark.parametrize("seed", range(3))
def test_what_stands_by_hand(seed: int):
    """Objects with different pasts: their speed over up to seven steps; a single step says nothing."""
    rng = np.random.default_rng(seed)
    past, unit_m = np.cumsum(rng.normal(0, 0.05, (8, 10, 2)), axis=1), rng.choice([1.0, 4.0], 8)
    known_from = [0, 1, 2, 3, 5, 7, 8, 9]
    for one, first in zip(past, known_from, strict=True):
        one[:first] = np.nan
    found = forecasts._standing(past, unit_m, 0.4)
    for one, unit, first, stays in zip(past, unit_m, known_from, found, strict=True):
        begin = max(first, 2)  # seven steps back at most
        steps = 9 - begin
        if steps < 2:
            assert stays == 0
        else:
            speed = np.linalg.norm(one[-1] - one[begin]) / (0.4 * steps * unit)
            assert stays == pytest.approx(0.95 * np.exp(-((speed / 0.15) ** 2)))


def test_a_forecast_with_rest_has_the_mean_and_covariance_of_both():
    """Each step is a mixture of two distributions, whose moments are added up."""
    rng = np.random.default_rng(1)
    now, stay, noise_m, unit_m = (
        rng.normal(size=(3, 2)),
        np.array([0.0, 0.3, 0.95]),
        rng.uniform(0.1, 0.4, 3),
        np.array([4.0, 1.0, 2.0]),
    )
    half = rng.normal(size=(3, 5, 2, 2))
    forecast = Forecast(rng.normal(size=(3, 5, 2)), half @ half.transpose(0, 1, 3, 2))
    found = forecasts._with_rest(forecast, now, stay, noise_m, unit_m, 0.4)
    for one in range(3):
        for step in range(5):
            creep = 0.03 * unit_m[one] * 0.4 * (step + 1)
            parts = (
                (stay[one], now[one], (noise_m[one] ** 2 + creep**2) * np.eye(2)),
                (1 - stay[one], forecast.mean[one, step], forecast.cov[one, step]),
            )
            mean = sum(share * at for share, at, _ in parts)
            cov = sum(share * (spread + np.outer(at - mean, at - mean)) for share, at, spread in parts)
            np.testing.assert_allclose(found.mean[one, step], mean)
            np.testing.assert_allclose(found.cov[one, step], cov)
