"""Predictions of vehicles that stand: they stay, and ellipses are as small as that is certain."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.predictors.tails import TailCalibration
from mcaptrack.schema import TRACKS, Frame, Rows
from mcaptrack.transforms import Predict
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
    """Ellipses as predictors make them: where no velocities are measured they follow the log otherwise."""
    monkeypatch.setattr(TailCalibration, "of", lambda *_: None)


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
