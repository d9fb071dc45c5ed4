"""The weights of links and of false tracks: what they were fitted on, the scenes, and the fit itself."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import mcaptrack
from mcaptrack.predictors.weights import load
from mcaptrack.transforms.retrack import false_tracks, linking
from mcaptrack.transforms.retrack.weights import WEIGHTS, Logistic
from tools import crowds
from tools.fit_retrack import (
    logistic,
)

STEPS = 60
PACKAGE = Path(mcaptrack.__file__).parent


@pytest.fixture(scope="module")
def scenes():
    return crowds.scenes(5, STEPS)


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
    names = ("gap", "miss")
    found = json.loads(WEIGHTS.read_text())["links"]["weights"]
    assert Logistic.of("links", names).weights.tolist() == [found["gap"], found["miss"]]
    of_joins = linking.JOIN_FEATURES
    models = {"links": linking.FEATURES, "people": false_tracks.FEATURES, "cuts": of_joins, "joins": of_joins}
    for model, features in (models | {"relinks": linking.RELINK_FEATURES}).items():
        assert set(json.loads(WEIGHTS.read_text())[model]["weights"]) == set(features)


def test_a_seed_gives_the_same_scenes_again_and_another_one_others(scenes):
    crowds.scenes.cache_clear()
    again = crowds.scenes(5, STEPS)
    assert all(np.array_equal(one, two) for one, two in zip(scenes, again, strict=True))
    first = scenes[0][scenes[0][:, 0] < 2]
    assert not np.array_equal(first[:, 2:], crowds.scenes(6, 2)[0][:, 2:])


def test_the_fit_finds_the_weights_that_drew_the_data():
    rng = np.random.default_rng(1)
    features = rng.normal([1.0, -2.0], [1.0, 3.0], (40_000, 2))
    odds = features @ [1.5, -0.4] + 0.7
    right = rng.random(len(odds)) < 1 / (1 + np.exp(-odds))
    assert logistic(features, right * 1.0, np.ones(len(odds))) == pytest.approx([1.5, -0.4, 0.7], abs=0.06)


def test_what_differs_from_scene_to_scene_is_not_put_down_to_features():
    """In one scene most links are right and gaps long, in the other few and short: gaps say nothing within either."""
    rng = np.random.default_rng(2)
    scene = np.repeat([0, 1], 20_000)
    gap = rng.normal(np.where(scene == 0, 3.0, 1.0), 1.0)
    right = rng.random(len(gap)) < np.where(scene == 0, 0.8, 0.2)
    together = logistic(gap[:, None], right * 1.0, np.ones(len(gap)))
    apart = logistic(gap[:, None], right * 1.0, np.ones(len(gap)), scene)
    assert together[0] > 0.5
    assert abs(apart[0]) < 0.15
