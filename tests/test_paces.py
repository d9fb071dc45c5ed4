"""Who came fast mostly goes on fast: paces before and after an encounter, as evidence of who is who."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.transforms.retrack import offline
from mcaptrack.transforms.retrack.identity_swaps import swapped_by_pace
from mcaptrack.transforms.retrack.motion_model import MotionModel
from tests.references.offline import by_pace
from tests.test_offline_reference import laid_out, models, tracks_of, with_gaps

STEP_S = 0.4


def ratio(paths: dict[int, dict[int, tuple[float, float]]], met: int, parted: int, noise_m: float = 0.0) -> float:
    out, _ = laid_out(paths, noise_m)
    model = MotionModel(noise_m, 1.0, 0.4, 0.3, STEP_S)
    (found,) = swapped_by_pace(model, out, np.array([[0], [1]]), np.array([met]), np.array([parted]))
    return float(found)


def along(speeds: list[float], y: float) -> dict[int, tuple[float, float]]:
    """A path along x with these speeds in m/s, step by step."""
    return {step: (float(x), y) for step, x in enumerate(np.cumsum([0, *speeds]) * STEP_S)}


def test_by_hand():
    """0.8 and 0.4 m/s before, 0.5 and 0.9 m/s after: -(0.8 - 0.4) (0.5 - 0.9) / 0.4^2 = 1."""
    one, other = along([0.8] * 20 + [0.5] * 20, 0.0), along([0.4] * 20 + [0.9] * 20, 1.0)
    assert ratio({1: one, 2: other}, 20, 20) == pytest.approx(1.0)
    assert ratio({1: other, 2: one}, 20, 20) == pytest.approx(1.0)
    assert ratio({1: along([0.8] * 40, 0.0), 2: along([0.4] * 40, 1.0)}, 20, 20) == pytest.approx(-1.0)


def test_noise_of_positions_makes_paces_count_less():
    """Paces of 8 s: the noise of the mean of both adds 2 * 2 * 0.8^2 / 8^2 / 2 * 2 = 0.04 to 0.16 m^2/s^2."""
    paths = {1: along([0.8] * 20 + [0.5] * 20, 0.0), 2: along([0.4] * 20 + [0.9] * 20, 1.0)}
    assert ratio(paths, 20, 20, 0.8) == pytest.approx(0.16 / (0.16 + 2 * 2 * 0.8**2 / 8**2))


def test_what_is_known_too_briefly_says_nothing():
    """Three steps are 1.2 s, two are 0.8 s."""
    one, other = along([0.8] * 20 + [0.5] * 3, 0.0), along([0.4] * 20 + [0.9] * 3, 1.0)
    assert ratio({1: one, 2: other}, 20, 20) == pytest.approx(1.0)
    del other[23]
    assert ratio({1: one, 2: other}, 20, 20) == 0.0


def test_paces_alone_count_no_more_than_3():
    assert ratio({1: along([0.0] * 20 + [2.0] * 20, 0.0), 2: along([2.0] * 20 + [0.0] * 20, 1.0)}, 20, 20) == 3.0


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25)
def test_paces_equal_the_reference_and_exchanging_the_tracks_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    model, motion = models(rng)
    walk = np.cumsum(rng.normal(0, 1, (2, 1, 2)) * rng.uniform(0, 0.6) + rng.normal(0, 0.3, (2, 60, 2)), axis=1)
    starts = rng.integers(0, 25, 2).tolist()
    paths = {name: with_gaps(rng, start, places) for name, start, places in zip((3, 8), starts, walk, strict=True)}
    met, parted = np.sort(rng.integers(20, 60, 2)).tolist()
    out, _ = laid_out(paths, model.noise_m)
    times = np.array([met]), np.array([parted])
    found = swapped_by_pace(model, out, np.array([[0], [1]]), *times)
    assert found.tolist() == swapped_by_pace(model, out, np.array([[1], [0]]), *times).tolist()
    assert found[0] == pytest.approx(by_pace(motion, paths[3], paths[8], met, parted), abs=1e-9)


def goes_on_as(rng: np.random.Generator) -> list[int]:
    """Two come at 1.8 and 0.5 m/s, stand at one place for 6 s, and go on: the tracks of each after it, by those before.

    The tracker exchanged them meanwhile.
    """
    steps = np.arange(56)
    moves = np.where(steps < 20, steps - 20, np.maximum(steps - 35, 0)) * STEP_S
    people = np.stack(
        [np.column_stack([moves * pace, np.full(56, side)]) for pace, side in ((1.8, 0.05), (0.5, -0.05))]
    )
    track = np.array([[0], [1]]) ^ (steps >= 28)
    xy = (people + rng.normal(0, 0.1, people.shape)).reshape(-1, 2)
    ids = track + np.where(steps < 28, 10, 20)  # new ones: they say nothing
    model = MotionModel(0.1, 1.0, 0.4, 0.3, 0.4)
    found = offline._without_swaps(model, tracks_of(np.tile(steps, 2), track.ravel(), ids.ravel(), xy), None)
    found = found.track.reshape(2, -1)
    before, after = found[:, :20], found[:, 38:]
    assert (before == before[:, :1]).all()
    assert (after == after[:, :1]).all()
    return (before[:, 0] == after[:, 0]).tolist()


def test_two_who_stop_at_one_place_go_on_at_their_own_paces():
    """Without paces none of these 20 is right: a filter keeps what the tracker says, as nothing speaks against it."""
    right = [goes_on_as(np.random.default_rng(seed)) for seed in range(20)]
    assert right.count([True, True]) >= 14
