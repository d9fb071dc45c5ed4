"""How much noise the tracks of the input allow for."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.transforms import PROFILES, Sample
from mcaptrack.transforms.retrack.likelihood import InputNoise, LikelihoodPass
from mcaptrack.transforms.retrack.motion_model import MotionModel
from mcaptrack.transforms.retrack.online_tracker import Association, OnlineTracker
from tests.references.online import Bends
from tests.tiers import thorough
from tools.corruptions import STEP_S, corrupt
from tools.crowds import drawn
from tools.reproduce import on_clock


def observed(seed: int, steps: int, people: int, noise_m: float, missed: float = 0.1):
    """Steps, those before each, and which of them, input ids and places of observations: people who walk and turn."""
    rng = np.random.default_rng(seed)
    step = np.cumsum(rng.choice([1, 1, 1, 4], steps)) - 1
    speed = rng.normal(0, 0.4, (people, step[-1] + 1, 2)).cumsum(axis=1) * rng.choice([0.0, 0.3], (people, 1, 1))
    at = speed.cumsum(axis=1) * STEP_S + rng.normal(0, noise_m, speed.shape)
    place, source = np.nonzero(rng.random((steps, people)) > missed)
    return step, np.diff(step, prepend=step[0] - 1), place, source, at[source, step[place]]


@given(seed=st.integers(0, 2**32 - 1), noise_m=st.sampled_from([0.0, 0.1, 0.4, 1.0]), cut=st.integers(1, 59))
@settings(max_examples=20)
def test_the_limit_is_that_of_the_reference_however_many_steps_come_at_once(seed, noise_m, cut):
    step, passed, place, source, xy = observed(seed, 60, 4, noise_m)
    bends, wanted = Bends(STEP_S), []
    for at, now in enumerate(step.tolist()):
        here = zip(source[place == at].tolist(), xy[place == at].tolist(), strict=True)
        wanted.append(bends.limit(now, [{"track_id": one, "x_m": x, "y_m": y} for one, (x, y) in here]))
    noise, found = InputNoise(STEP_S), []
    for low, high in ((0, cut), (cut, 60)):
        part = (place >= low) & (place < high)
        found += noise.most_m(passed[low:high], step[low:high], place[part] - low, source[part], xy[part])
    assert found == pytest.approx(wanted)


@pytest.mark.parametrize("noise_m", [0.3, 0.6])
def test_noise_may_be_half_as_large_again_as_tracks_of_people_who_stand_bend(noise_m):
    rng = np.random.default_rng(5)
    place, source = np.divmod(np.arange(4000), 10)
    at = 5.0 * source[:, None] + rng.normal(0, noise_m, (4000, 2))
    found = InputNoise(STEP_S).most_m(np.ones(400, int), np.arange(400), place, source, at)
    assert found[-1] == pytest.approx(1.5 * noise_m, rel=0.1)


def test_without_tracks_noise_has_no_limit():
    """Detections that have an id each show no bends."""
    place, source = np.arange(200), np.arange(200)
    found = InputNoise(STEP_S).most_m(np.ones(200, int), place, place, source, np.zeros((200, 2)))
    assert set(found) == {np.inf}


@thorough
def test_people_merged_into_one_detection_are_not_taken_for_noise():
    """In this synthetic crowd positions are off by 0.17 m; the estimate went to its highest value, 0.8 m."""
    (truth, how) = next(islice(drawn(1, 150), 4, None))
    assert how.noise_m == pytest.approx(0.173, abs=0.001)
    rows = corrupt(truth, how, np.random.default_rng([1, 4, 2]))
    clock = np.arange(int(truth[:, 0].min()), int(truth[:, 0].max()) + 1)
    run = LikelihoodPass(PROFILES["default"])
    for (frame,) in Sample(start_ns=round(clock[0] * STEP_S * 1e9))(on_clock(rows, clock)):
        run.step(frame)
    run.finish()
    assert run.noise_m < 0.5


def test_ids_of_any_size_give_the_same_limit():
    """256 steps: with these ids, products of both wrap around."""
    place, source = np.divmod(np.arange(256 * 20), 20)
    at = 5.0 * source[:, None] + np.random.default_rng(3).normal(0, 0.4, (256 * 20, 2))
    one, steps = np.ones(256, int), np.arange(256)
    found = [InputNoise(STEP_S).most_m(one, steps, place, source * size, at) for size in (1, 2**56)]
    assert found[0][-1] == pytest.approx(0.6, rel=0.1)
    assert found[0] == found[1]


def test_the_estimate_keeps_the_limit_at_once():
    """Forty people jump about by metres: all of them are outside of their circles at the same step."""
    tracker = OnlineTracker(
        model=MotionModel(0.2, 1.5, 0.12, 0.08, 0.4),
        association=Association(same_id=12.0, same_id_crowded=4.0, merge_distance_m=0.0, merge_timeout_s=0.0),
        max_age=5,
        confirm_hits=2,
        max_age_tentative=2,
    )
    home = 20.0 * np.stack(np.divmod(np.arange(40), 8)).astype(float)
    for step in range(8):
        tracker.step(home + (step % 2) * 0.9, np.arange(40), 1, most_noise_m=0.3)
        assert tracker.noise_m <= 0.3
    tracker.step(home, np.arange(40), 1)
    assert tracker.noise_m > 0.3
