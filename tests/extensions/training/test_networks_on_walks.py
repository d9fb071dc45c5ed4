"""Networks of training and shipped weights, on walks and on recordings that they were not trained on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mcaptrack.evaluation.metrics.displacement import forecast_scores
from mcaptrack.extensions.training.recipe import RECIPES
from mcaptrack.extensions.training.sources import SourceOptions, read_scenes, windows_of
from mcaptrack.extensions.training.windows import Windows, ar1
from mcaptrack.predictors import PeopleSeen, make
from mcaptrack.predictors.lstm import Lstm
from mcaptrack.predictors.red import Red
from mcaptrack.predictors.weights import Weights
from mcaptrack.sources.walks import walks


def test_networks_for_training_give_the_same_forecasts():
    torch = pytest.importorskip("torch", reason="training needs torch")
    from mcaptrack.extensions.training.network import LstmNetwork, RedNetwork

    torch.manual_seed(1)
    path = walks(32, 20, 0.4, seed=3)[0]
    windows = Windows.of(path, 8)
    for network, kind, card in (
        (RedNetwork(12, 0.4), Red, {"network": "red", "steps": "12", "step_s": "0.4"}),
        (LstmNetwork(12), Lstm, {"network": "lstm", "steps": "12", "step_s": "0.4"}),
    ):
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.normal_(0, 0.2)
            part = windows if kind is Red else windows.last(4)
            given = network.prepare(part)
            there = network(given)[0] if kind is Red else network(given["past"]).cumsum(1)
        tensors = {name: np.asarray(value, float) for name, value in network.tensors().items()}
        here = kind.of(Weights(Path("w"), tensors, card, "")).predict(part.past, part.known).mean
        here = here if kind is Red else here - part.past[:, -1:]
        np.testing.assert_allclose(here, there.numpy(), atol=2e-4)


def test_red_has_less_error_than_linear_predictors_and_is_calibrated_and_social_has_less():
    """On walks that it was not trained on, as they are and with the noise of a tracker."""
    paths, scene = walks(3000, 20, 0.4, seed=12345)
    windows = Windows.of(paths, 8)
    moment = 5 * scene + np.arange(len(scene)) % 5  # the walks of a person follow one another
    noise = 0.2 * ar1(np.random.default_rng(0), 3000, 8)
    for seen in (windows.past, windows.past + noise):
        scores = {
            name: forecast_scores(*make(name, 12, 0.4).predict(seen, windows.known), windows.future)
            for name in ("red", "cv", "kalman")
        }
        people = PeopleSeen(seen, windows.known, moment, np.arange(len(seen)))
        among = forecast_scores(*make("social", 12, 0.4).predict(seen, windows.known, people), windows.future)
        assert among["ADE_m"] < 0.97 * scores["red"]["ADE_m"]
        assert among["NLL"] < scores["red"]["NLL"]
        assert scores["red"]["ADE_m"] < 0.95 * min(scores["cv"]["ADE_m"], scores["kalman"]["ADE_m"])
        assert scores["red"]["NLL"] < min(scores["cv"]["NLL"], scores["kalman"]["NLL"]) - 0.3
        assert 0.93 < scores["red"]["coverage_95"] < 0.97


@pytest.mark.parametrize(("past", "noise_m", "most_m"), [(4, 0.0, 0.61), (8, 0.2, 0.90)])
def test_weights_that_never_saw_a_recording_foretell_one(data, past, noise_m, most_m):
    """Scenes of Stanford Drone: errors in metres, what the ellipses hold, and constant velocity beside it."""
    recipe = replace(RECIPES["red"], past=past, least=past)
    windows = windows_of(read_scenes([data / "sdd" / "val"], SourceOptions(), recipe.step_s), recipe)
    seen = windows.past + noise_m * ar1(np.random.default_rng(3), *windows.known.shape)
    red, cv = (
        forecast_scores(*make(name, 12, 0.4).predict(seen, windows.known), windows.future) for name in ("red", "cv")
    )
    assert red["ADE_m"] < most_m
    assert red["ADE_m"] < cv["ADE_m"]
    assert 0.90 < red["coverage_95"] < 0.97
