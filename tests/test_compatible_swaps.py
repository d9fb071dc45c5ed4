"""Encounters that are changed at once: the best set of which no two need the same track at the same time."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.notices import collected
from mcaptrack.transforms.retrack import identity_swaps, offline
from mcaptrack.transforms.retrack.identity_swaps import compatible
from mcaptrack.transforms.retrack.motion_model import MotionModel
from tests.test_offline_reference import tracks_of

ENCOUNTERS = st.lists(
    st.tuples(
        st.lists(st.integers(0, 5), min_size=2, max_size=2, unique=True),
        st.integers(0, 20),
        st.integers(0, 8),
        st.floats(1, 20),
    ),
    min_size=1,
    max_size=9,
)


def chosen(met: list) -> list[int]:
    pairs, low, lasts, gain = zip(*met, strict=True)
    low = np.array(low)
    return compatible(np.array(pairs), low, low + np.array(lasts), np.array(gain)).tolist()


def are_rivals(one: tuple, other: tuple) -> bool:
    """Whether two encounters need one track at one step, step by step."""
    steps = [set(range(low, low + lasts + 1)) for _, low, lasts, _ in (one, other)]
    return bool(set(one[0]) & set(other[0])) and bool(steps[0] & steps[1])


def allowed(met: list, some: tuple[int, ...] | list[int]) -> bool:
    return not any(are_rivals(met[a], met[b]) for a, b in combinations(some, 2))


@given(met=ENCOUNTERS)
@settings(max_examples=60)
def test_no_other_set_of_encounters_gains_more(met):
    found = chosen(met)
    assert allowed(met, found)
    every = (some for size in range(len(met) + 1) for some in combinations(range(len(met)), size))
    most = max(sum(met[k][3] for k in some) for some in every if allowed(met, some))
    assert sum(met[k][3] for k in found) == pytest.approx(most, abs=1e-5)


def test_two_that_gain_more_together_win_over_a_better_one_between_them():
    """1 meets 2, 2 meets 3 and 3 meets 4: one after another, by gain, the middle one would keep both others away."""
    met = [([1, 2], 0, 9, 4.0), ([2, 3], 5, 9, 5.0), ([3, 4], 10, 9, 4.0)]
    assert chosen(met) == [0, 2]


def test_encounters_of_one_track_at_different_times_are_all_changed():
    assert chosen([([1, other], 10 * other, 9, 2.0) for other in range(2, 12)]) == list(range(10))


def test_where_the_solver_gives_up_encounters_are_decided_one_after_another_and_that_is_said(monkeypatch):
    """A ring of three: three tracks, each of which meets the other two at once."""
    ring = [([1, 2], 0, 9, 3.0), ([2, 3], 0, 9, 5.0), ([1, 3], 0, 9, 4.0), ([4, 5], 0, 9, 1.0)]
    assert chosen(ring) == [1, 3]
    given_up = type("GivenUp", (), {"status": 1, "x": None})()
    monkeypatch.setattr("scipy.optimize.milp", lambda *_, **__: given_up)
    with collected() as said:
        assert chosen(ring) == [1, 3]
    assert [notice.message for notice in said] == [
        "3 encounters were decided one after another: too many people meet to decide them at once"
    ]


def test_the_solver_is_limited_by_nodes_which_are_the_same_on_every_machine(monkeypatch):
    """With the smallest number of nodes a large random problem isn't solved, and the answer still is an allowed one."""
    rng = np.random.default_rng(1)
    pairs = np.array([rng.choice(40, 2, replace=False) for _ in range(400)])
    low = rng.integers(0, 60, 400)
    met = pairs, low, low + 30, rng.uniform(1, 9, 400)
    best = compatible(*met)
    monkeypatch.setattr(identity_swaps, "_NODES", 0)
    with collected() as said:
        found = compatible(*met)
    rows = [(pairs[k].tolist(), int(low[k]), 30, 0.0) for k in found.tolist()]
    assert allowed(rows, list(range(len(rows))))
    assert len(said) == 1
    assert met[3][found].sum() < met[3][best].sum()


def test_who_meets_six_others_in_a_row_keeps_one_identity():
    """One walks by six who stand; at each the tracker exchanges the two ids, so that every track is of several people."""
    rng = np.random.default_rng(3)
    count, gap_steps, noise_m = 6, 40, 0.05
    steps = np.arange((count + 1) * gap_steps)
    walker = np.column_stack([0.4 * 0.5 * steps, np.zeros(len(steps))])
    stands = [np.tile([0.4 * 0.5 * gap_steps * (k + 1), 0.7], (len(steps), 1)) for k in range(count)]
    people = np.stack([walker, *stands])  # (7, T, 2)
    name = np.tile(np.arange(count + 1)[:, None], len(steps))
    for other in range(1, count + 1):
        since = steps >= gap_steps * other
        now = name[:, gap_steps * other]
        mine, theirs = now[0], now[other]
        name[0, since], name[other, since] = theirs, mine
    xy = people + rng.normal(0, noise_m, people.shape)
    step = np.tile(steps, count + 1)
    track = name.ravel()
    model = MotionModel(noise_m, 1.0, 0.1, 0.1, 0.4)
    found = offline._without_swaps(model, tracks_of(step, track, track, xy.reshape(-1, 2)), None).track.reshape(
        name.shape
    )
    assert all(len(set(one.tolist())) == 1 for one in found)


def test_more_encounters_than_a_solver_should_get_at_once_are_decided_one_after_another(monkeypatch):
    met = [([1, 2], 0, 9, 4.0), ([2, 3], 5, 9, 5.0), ([3, 4], 10, 9, 4.0)]
    for most, wanted in ((3, [0, 2]), (2, [1])):
        monkeypatch.setattr(identity_swaps, "_MOST_TOGETHER", most)
        with collected() as said:
            assert chosen(met) == wanted
        assert len(said) == (most < 3)
