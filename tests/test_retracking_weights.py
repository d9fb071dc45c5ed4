"""The weights of links and of false tracks: what they were fitted on, the scenes, and the fit itself."""

from __future__ import annotations

import json
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

import mcaptrack
from mcaptrack.predictors.weights import load
from mcaptrack.transforms.retrack import cut_links, false_tracks, joins, linking
from mcaptrack.transforms.retrack.false_tracks import FEATURES
from mcaptrack.transforms.retrack.motion_model import to_trajectories
from mcaptrack.transforms.retrack.weights import WEIGHTS, weights_of
from tools import crowds
from tools.corruptions import STEP_S
from tools.fit_retrack import (
    Pairs,
    cuts_of,
    decisions_of,
    logistic,
    owners_of,
    pairs_of,
    people_of,
    prepare,
    relinks_of,
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
    assert weights_of("links", names)[0].tolist() == [found["gap"], found["miss"]]
    models = {"links": linking, "people": false_tracks, "cuts": joins, "relinks": cut_links, "joins": joins}
    for model, features in ((name, module.FEATURES) for name, module in models.items()):
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


def test_the_best_set_of_links_is_that_of_all_permutations():
    rng = np.random.default_rng(3)
    ends, begins = (side.ravel() for side in np.indices((5, 5)))
    gain = rng.uniform(-3.5, 4, 25)
    right = (ends == begins) * 1.0
    features = np.full((25, len(linking.FEATURES)), np.nan)
    features[:, linking.FEATURES.index("gap")] = np.arange(25)
    found, is_right, gap_s = Pairs(5, ends, begins, features, right).best(gain)
    table = gain.reshape(5, 5) + 4.0
    best = max(permutations(range(5)), key=lambda order: table[range(5), order].sum())
    assert found.sum() == pytest.approx((table[range(5), best] - 4.0).sum())
    assert is_right.sum() == sum(a == b for a, b in enumerate(best))
    assert sorted(gap_s.tolist()) == [5 * a + b for a, b in enumerate(best)]


def test_tracks_belong_to_the_person_they_follow_and_doubles_and_clutter_to_nobody():
    steps = np.arange(40)
    walk = np.column_stack([steps, np.full(40, 3), steps * 0.4, np.zeros(40)])
    double = walk[10:25] + [0, 4, 0, 0.6]
    clutter = np.column_stack([steps[:20], np.full(20, 9), np.full(20, 8.0), np.full(20, 30.0)])
    run = prepare(walk, np.concatenate([walk, double, clutter]))
    step, track, source, _ = run.args[2].of(run.args[3], run.args[4])
    truth = {3: walk, 7: double, 9: clutter}
    xy = np.array(
        [truth[who][np.flatnonzero(truth[who][:, 0] == at)[0], 2:] for at, who in zip(step, source, strict=True)]
    )
    _, row, paths = to_trajectories(step, track, xy, 0.2)
    found = owners_of(run, paths)[row]
    assert (found[source == 3] == 3).mean() > 0.95
    assert (found[np.isin(source, (7, 9))] == -1).all()


def test_a_person_is_told_from_a_double_and_a_broken_track_has_a_right_link():
    """All that the fit asks of re-tracking, in a scene where the answers are known."""
    steps = np.arange(60)
    walk = np.column_stack([steps, np.full(60, 3), steps * 0.4, np.zeros(60)])
    other = walk + [0, 1, 0, 9.0]
    made = np.concatenate([walk, other[:20], other[30:] + [0, 4, 0, 0], walk[10:25] + [0, 6, 0, 0.7]])
    run = prepare(np.concatenate([walk, other]), made)
    pairs, cuts, links = pairs_of(run), cuts_of(run), relinks_of(run)
    assert pairs.right.sum() == 1
    assert pairs.features[pairs.right > 0, linking.FEATURES.index("gap")] == pytest.approx(11 * STEP_S)
    assert len(cuts.are_right) == len(cuts.features)
    assert len(links.are_right) == len(links.features)
    features, share, count, throughout = people_of(run)
    assert not throughout.any()
    assert sorted(zip(share.tolist(), count.tolist(), strict=True)) == [(0.0, 15.0), (1.0, 50.0), (1.0, 60.0)]
    assert features.shape == (3, len(FEATURES))
    joined, people = decisions_of(run)
    assert people.are_right.tolist().count(True) == 2
    assert joined.are_right.all()
