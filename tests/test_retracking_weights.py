"""The weights of links and of false tracks: what they were fitted on, the scenes, and the fit itself."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import mcaptrack
from mcaptrack.predictors.weights import load
from mcaptrack.transforms.retrack import cut_links, false_tracks, joins, linking
from mcaptrack.transforms.retrack.weights import WEIGHTS, weights_of
from tools.fit_retrack import (
    logistic,
)

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
    names = ("gap", "miss")
    found = json.loads(WEIGHTS.read_text())["links"]["weights"]
    assert weights_of("links", names)[0].tolist() == [found["gap"], found["miss"]]
    models = {"links": linking, "people": false_tracks, "cuts": joins, "relinks": cut_links, "joins": joins}
    for model, features in ((name, module.FEATURES) for name, module in models.items()):
        assert set(json.loads(WEIGHTS.read_text())[model]["weights"]) == set(features)


def test_the_fit_finds_the_weights_that_drew_the_data():
    rng = np.random.default_rng(1)
    features = rng.normal([1.0, -2.0], [1.0, 3.0], (40_000, 2))
    odds = features @ [1.5, -0.4] + 0.7
    right = rng.random(len(odds)) < 1 / (1 + np.exp(-odds))
    assert logistic(features, right * 1.0, np.ones(len(odds))) == pytest.approx([1.5, -0.4, 0.7], abs=0.06)
