"""The errors of trackers that choose the settings of re-tracking: each kind does what it says, and only that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.tiers import one_in
from tools.corruptions import CORRUPTIONS, STEP_S, Corruption, corrupt

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


def test_two_people_who_meet_are_one_detection_for_ten_seconds():
    """They stand 1 m apart throughout: one for 25 steps, two for 25, and so on."""
    truth = np.array([(step, person, float(person), 0.0) for step in range(150) for person in (0, 1)], float)
    rows = rows_of(replace(NONE, merge_m=1.2, merge_s=10.0), truth)
    count = np.bincount(rows[:, 0].astype(int), minlength=150)
    assert count.tolist() == ([1] * 25 + [2] * 25) * 3
    assert (rows[count[rows[:, 0].astype(int)] == 1, 2] == 0.5).all()
    assert len(np.unique(rows[:, 1])) in (4, 5)  # one more id after each time


def test_gaps_last_up_to_eight_seconds():
    how = CORRUPTIONS["long gaps"]
    rows = rows_of(replace(NONE, seen_s=how.seen_s, hidden_s=how.hidden_s, new_id=how.new_id))
    gaps = np.concatenate([np.diff(rows[person_of(rows) == lane, 0]) - 1 for lane in range(5)])
    gaps = gaps[gaps > 0] * STEP_S
    assert len(gaps) > 20
    assert 6 < gaps.max() <= 8.01
    assert gaps.min() < 2


def test_tracks_break_every_second_without_a_gap():
    how = CORRUPTIONS["broken every second"]
    rows = rows_of(replace(NONE, breaks_per_min=how.breaks_per_min, new_id=how.new_id))
    assert len(rows) == len(APART)
    assert len(rows) * STEP_S / len(np.unique(rows[:, 1])) == pytest.approx(1.0, abs=0.1)
    assert all(len(np.unique(person_of(rows[rows[:, 1] == one]))) == 1 for one in np.unique(rows[:, 1]))


@pytest.mark.parametrize("false", [{"lit": 0.2}, {"beside": 0.2}])
def test_false_tracks_leave_the_rows_of_people_alone(false):
    """So kinds that were measured before a new kind of false track was added are drawn as they were."""
    how = CORRUPTIONS["broken ids"]
    rows, alone = rows_of(replace(how, **false)), rows_of(how)
    assert len(rows) > 1.19 * len(alone)
    assert set(map(tuple, alone.tolist())) <= set(map(tuple, rows.tolist()))
