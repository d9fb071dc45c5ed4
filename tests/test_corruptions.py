"""The errors of trackers that choose the settings of re-tracking: each kind does what it says, and only that."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mcaptrack
from mcaptrack.predictors.weights import load
from mcaptrack.sources import demo
from mcaptrack.sources.demo import SCENES
from mcaptrack.transforms.retrack import false_tracks, linking
from mcaptrack.transforms.retrack.weights import WEIGHTS, Logistic
from tests.tiers import one_in
from tools.bench.demo import page
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
    names = ("gap", "miss")
    found = json.loads(WEIGHTS.read_text())["links"]["weights"]
    assert Logistic.of("links", names).weights.tolist() == [found["gap"], found["miss"]]
    for model, features in {"links": linking.FEATURES, "people": false_tracks.FEATURES}.items():
        assert set(json.loads(WEIGHTS.read_text())[model]["weights"]) == set(features)


def test_the_fit_finds_the_weights_that_drew_the_data():
    rng = np.random.default_rng(1)
    features = rng.normal([1.0, -2.0], [1.0, 3.0], (40_000, 2))
    odds = features @ [1.5, -0.4] + 0.7
    right = rng.random(len(odds)) < 1 / (1 + np.exp(-odds))
    assert logistic(features, right * 1.0, np.ones(len(odds))) == pytest.approx([1.5, -0.4, 0.7], abs=0.06)


# The scenes that the demonstration draws: what their names say, for every seed, and the same scene for the same seed


ROOT = Path(__file__).parent.parent
seeds = st.integers(0, 2**32)


@given(st.sampled_from([name for name in SCENES if name != "square"]), seeds)
@settings(max_examples=30)
def test_a_seed_draws_the_same_people_again_and_another_one_others(name, seed):
    assert SCENES[name](seed).people == SCENES[name](seed).people != SCENES[name](seed + 1).people


@pytest.mark.parametrize("name", SCENES)
def test_a_seed_draws_the_pixels(name):
    def first(seed):
        return next(SCENES[name](seed).shots()).image

    assert np.array_equal(first(3), first(3))
    assert not np.array_equal(first(3), first(4))


@given(seeds)
@settings(max_examples=30)
def test_people_walk_at_the_speed_of_walkers_and_are_as_many_as_said(seed):
    for name, count in (("walkers", 10), ("crowd", 20), ("side-by-side", 6), ("standing", 6)):
        people = SCENES[name](seed).people
        assert [walker.id for walker in people] == [*range(1, count + 1)]
        for walker in people:
            for (t0, x0, y0), (t1, x1, y1) in pairwise(walker.route):
                speed = np.hypot(x1 - x0, y1 - y0) / (t1 - t0)
                # A person who joins another takes a detour in the time that the straight way takes.
                assert 0.85 < speed < 1.65 or (name == "standing" and (speed == 0 or walker.id == 2))


@given(seeds)
@settings(max_examples=30)
def test_pairs_stay_side_by_side_and_people_who_stand_stay_for_a_while(seed):
    people = SCENES["side-by-side"](seed).people
    for one, other in zip(people[::2], people[1::2], strict=True):
        for seconds in np.linspace(one.route[0][0], one.route[-1][0], 9):
            assert np.hypot(*np.subtract(one.at(seconds), other.at(seconds))) == pytest.approx(0.7)
    standing = SCENES["standing"](seed).people
    for walker in standing:
        (arrival, *there), (leaving, *still_there) = walker.route[1:3]
        assert 8 <= leaving - arrival <= 15
        assert there == still_there
    assert np.hypot(*np.subtract(standing[0].route[1][1:], standing[1].route[1][1:])) < 1


def test_the_scores_that_the_demonstration_prints_are_of_all_its_scenes_and_stand_in_the_documents():
    scores = demo.read_scores()
    assert scores["seeds"] == [*range(1, 11)]
    assert list(scores["scenes"]) == list(SCENES)
    for values in scores["scenes"].values():
        assert {len(column) for part in values.values() for column in part.values()} == {10}
    assert (ROOT / "docs" / "demo.md").read_text() == page(scores)
    rows = re.findall(r"^\| `([a-z-]+)` \| ([^|]+) \| ([^|]+) \|$", (ROOT / "README.md").read_text(), re.M)
    shown = [
        (name, *(demo.mean_and_range(values[mode]["IDF1"], 100) for mode in ("SORT", "re-tracked")))
        for name, values in scores["scenes"].items()
    ]
    assert [row for row in rows if row[0] in SCENES] == shown


def test_a_mean_and_its_range():
    assert demo.mean_and_range([0.5, 0.25, 0.9], 100) == "55.0 (25.0 to 90.0)"
    assert demo.mean_and_range([2.0], digits=0) == "2 (2 to 2)"
