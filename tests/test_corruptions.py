"""The errors of trackers that choose the settings of re-tracking: each kind does what it says, and only that."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mcaptrack
from mcaptrack.predictors.weights import load
from mcaptrack.transforms.retrack.weights import WEIGHTS, Logistic, columns
from tests.tiers import one_in
from tools.corruptions import CORRUPTIONS, STEP_S, Corruption, corrupt
from tools.fit_retrack import (
    logistic,
)

#: Nothing goes wrong.
NONE = Corruption(noise_m=0.0, seen_s=1e9, new_id=0.0, swap=0.0, flicker=0.0)
STEPS = 500
#: Five people who walk side by side, 20 m apart, at 1 m/s.
APART = np.array([(step, person, 0.4 * step, 20.0 * person) for step in range(STEPS) for person in range(5)], float)


def rows_of(how: Corruption, truth: np.ndarray = APART, seed: int = 3) -> np.ndarray:
    return corrupt(truth, how, np.random.default_rng(seed))


def person_of(rows: np.ndarray) -> np.ndarray:
    """The person on the lane of each row; -1 for none within 0.01 m."""
    lane = np.round(rows[:, 3] / 20)
    there = (np.abs(rows[:, 3] - 20 * lane) < 0.01) & (np.abs(rows[:, 2] - 0.4 * rows[:, 0]) < 0.01)
    return np.where(there, lane, -1)


@pytest.mark.parametrize("kind", one_in(3, CORRUPTIONS))
def test_rows_follow_from_a_seed_and_are_in_order_with_an_id_at_one_place_of_a_step(kind):
    rows = rows_of(CORRUPTIONS[kind])
    assert np.array_equal(rows, rows_of(CORRUPTIONS[kind]))
    assert not np.array_equal(rows, rows_of(CORRUPTIONS[kind], seed=4))
    assert (np.diff(rows[:, 0]) >= 0).all()
    assert len(np.unique(rows[:, :2], axis=0)) == len(rows)
    assert np.isfinite(rows).all()


def test_without_errors_the_truth_comes_back():
    rows = rows_of(NONE)
    assert np.array_equal(rows[:, [0, 2, 3]], APART[:, [0, 2, 3]])
    assert len(np.unique(rows[:, 1])) == 5


def test_gaps_last_up_to_eight_seconds():
    how = CORRUPTIONS["long gaps"]
    rows = rows_of(replace(NONE, seen_s=how.seen_s, hidden_s=how.hidden_s, new_id=how.new_id))
    gaps = np.concatenate([np.diff(rows[person_of(rows) == lane, 0]) - 1 for lane in range(5)])
    gaps = gaps[gaps > 0] * STEP_S
    assert len(gaps) > 20
    assert 6 < gaps.max() <= 8.01
    assert gaps.min() < 2


@pytest.mark.parametrize("false", [{"lit": 0.2}, {"beside": 0.2}])
def test_false_tracks_leave_the_rows_of_people_alone(false):
    """So kinds that were measured before a new kind of false track was added are drawn as they were."""
    how = CORRUPTIONS["broken ids"]
    rows, alone = rows_of(replace(how, **false)), rows_of(how)
    assert len(rows) > 1.19 * len(alone)
    assert set(map(tuple, alone.tolist())) <= set(map(tuple, rows.tolist()))


# The weights of links and of false tracks: what they were fitted on, and the fit itself


PACKAGE = Path(mcaptrack.__file__).parent


def test_everything_that_was_fitted_says_that_it_was_fitted_on_synthetic_data():
    cards = {
        path: json.loads(path.read_text())["card"] for path in (WEIGHTS, PACKAGE / "predictors/trained/tails.json")
    }
    cards |= {path: load(path).card for path in (PACKAGE / "predictors/trained").glob("*.safetensors")}
    assert len(cards) == 5
    for path, card in cards.items():
        assert "synthetic" in card["data"], path
        assert card["licence"] == "Apache-2.0", path


def test_weights_go_by_the_names_of_features_in_any_order():
    model = Logistic.of("links")
    values = {name: np.array([1.0 + k]) for k, name in enumerate(sorted(model.names))}
    found = json.loads(WEIGHTS.read_text())["links"]
    wanted = found["bias"] + sum(found["weights"][name] * value for name, value in values.items())
    assert model.log_odds(columns(model.names, values)) == pytest.approx(wanted)


def test_the_fit_finds_the_weights_that_drew_the_data():
    rng = np.random.default_rng(1)
    features = rng.normal([1.0, -2.0], [1.0, 3.0], (40_000, 2))
    odds = features @ [1.5, -0.4] + 0.7
    right = rng.random(len(odds)) < 1 / (1 + np.exp(-odds))
    assert logistic(features, right * 1.0, np.ones(len(odds))) == pytest.approx([1.5, -0.4, 0.7], abs=0.06)
