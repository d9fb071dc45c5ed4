"""The scenes that the demonstration draws: what their names say, for every seed, and the same scene for the same seed."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.sources import demo
from mcaptrack.sources.demo import SCENES
from tools.bench.demo import page

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
