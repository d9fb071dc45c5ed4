"""Forecasts of vehicles are mixtures, by class and by whether they stand."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mcaptrack.predictors import Forecast, vehicle_tails
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.transforms import Predict
from mcaptrack.transforms.motion_limits import LIMITS

TABLE = {"ahead_s": [1.0, 2.0], "wide_weight": [0.2, 0.4], "narrow_scale": [0.1, 0.4], "wide_scale": [2.0, 8.0]}
TABLES = {
    "red": {kind: {"standing": TABLE, "moving": TABLE | {"wide_weight": [0.5, 0.5]}} for kind in ("car", "truck")}
}


def forecast(count: int, steps: int = 3) -> Forecast:
    half = np.random.default_rng(0).normal(size=(count, steps, 2, 2))
    return Forecast(np.zeros((count, steps, 2)), half @ half.transpose(0, 1, 3, 2))


def test_mixtures_by_hand(monkeypatch: pytest.MonkeyPatch):
    """A standing car, a moving bus, a person, and a car whose speed is unknown; steps at 0.75, 1.5 and 2.25 s."""
    monkeypatch.setattr(vehicle_tails, "_tables", lambda: TABLES)
    given = forecast(4)
    names, speed = ["car", "bus", "person", "car"], np.array([0.4, 0.5, 9.0, np.nan])
    made, shapes = vehicle_tails.calibrated("red", given, 0.75, names, speed)
    assert shapes is not None
    narrow, wide = np.array([0.1, 0.2, 0.4]), np.array([2.0, 4.0, 8.0])  # the logarithms are interpolated
    for row, weight in ((0, np.array([0.2, 0.3, 0.4])), (1, np.full(3, 0.5))):
        whole = (1 - weight) * narrow + weight * wide
        np.testing.assert_allclose(made.cov[row], given.cov[row] * whole[:, None, None])
        np.testing.assert_allclose([part[row] for part in shapes], [weight, narrow / whole, wide / whole])
    np.testing.assert_array_equal(made.cov[2:], given.cov[2:])
    assert np.isnan([part[2:] for part in shapes]).all()
    np.testing.assert_array_equal(made.mean, given.mean)
    assert vehicle_tails.calibrated("cv", given, 0.75, names, speed) == (given, None)


def test_the_tables_that_ship_are_distributions_for_all_vehicles():
    tables = json.loads(vehicle_tails.TABLES.read_text())
    assert "no recordings" in tables["card"]["data"]
    assert {name for name, row in LIMITS.items() if row.turns} == set(vehicle_tails.TABLE_OF)
    names = sorted(vehicle_tails.TABLE_OF)
    for speed in (0.0, 5.0):
        _, shapes = vehicle_tails.calibrated("red", forecast(len(names)), 0.4, names, np.full(len(names), speed))
        assert shapes is not None
        weight, narrow, wide = shapes
        np.testing.assert_allclose((1 - weight) * narrow + weight * wide, 1.0)
        assert (weight > 0).all()
        assert (weight < 1).all()
        assert (narrow > 0).all()
        assert (narrow < wide).all()


def test_only_forecasts_of_vehicles_in_metres_are_mixtures():
    frames = []
    for tick in range(10):
        rows = TRACKS.rows(
            track_id=[1, 2], class_id=[3, 1], x_m=[4.0 * tick, 0.5 * tick], y_m=[0.0, 9.0], observed=[True] * 2,
            source_id=[1, 2], vx_m_per_s=[10.0, 1.25], vy_m_per_s=[0.0] * 2,
        )  # fmt: skip
        frames.append(Frame(tick * 400_000_000, tick, rows))
    last = [rows.rows for (rows,) in Predict(predictor="red", class_names=((1, "person"), (3, "car")))(frames)][-1]
    is_mixture = {one: np.isfinite(last["wide_weight"][last["track_id"] == one]) for one in (1, 2)}
    assert len(is_mixture[1]) == 12
    assert is_mixture[1].all()
    assert len(is_mixture[2]) == 12
    assert not is_mixture[2].any()
