"""Which tracks are people, and which follow nobody: by what is known of the whole log."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.schema import TRACKS, Frame, Rows
from mcaptrack.transforms import PROFILES
from mcaptrack.transforms.retrack.false_tracks import log_odds_in_log
from mcaptrack.transforms.retrack.motion_model import MotionModel, State, Trajectories, smooth
from mcaptrack.transforms.retrack.track_features import FEATURES, features
from tests.references.false_tracks import log_odds_in_log as in_log
from tests.references.false_tracks import person_features
from tests.references.offline import Motion
from tests.test_offline_reference import Paths, laid_out, models, scattered, walk_of

SEEDS = st.integers(0, 2**32 - 1)


def with_companions(rng: np.random.Generator, count: int) -> Paths:
    """Scattered tracks, some with another at a constant offset, with or without the same noise, for some of the time."""
    paths = scattered(rng, count)
    for name, path in list(paths.items()):
        if rng.random() < 0.5:
            offset, noise_m = rng.uniform(-1.2, 1.2, 2), rng.choice([0.0, 0.15])
            kept = {s: at for s, at in path.items() if rng.random() < 0.9} or path
            moved = {s: np.array(at) + offset + rng.normal(0, noise_m, 2) for s, at in kept.items()}
            paths[name + 1] = {s: tuple(at.tolist()) for s, at in moved.items()}
    return paths


def drawn(seed: int, most: int) -> tuple[Paths, Motion, tuple[MotionModel, Trajectories, State, float]]:
    """Up to so many tracks and more beside them, the reference's model of motion, and all that the package is given."""
    rng = np.random.default_rng(seed)
    model, motion = models(rng)
    paths = with_companions(rng, int(rng.integers(1, most + 1)))
    out, _ = laid_out(paths, model.noise_m)
    return paths, motion, (model, out, smooth(model, out, 0.4)[2], 0.4)


@given(seed=SEEDS)
@settings(max_examples=25)
def test_features_equal_the_reference(seed):
    paths, motion, given_all = drawn(seed, 7)
    wanted = person_features(motion, paths)
    for name, row in zip(sorted(paths), features(*given_all), strict=True):
        assert dict(zip(FEATURES, row.tolist(), strict=True)) == pytest.approx(wanted[name], abs=1e-9)


@given(seed=SEEDS)
@settings(max_examples=10)
def test_weights_follow_the_log_to_where_few_tracks_are_doubtful(seed):
    paths, motion, given_all = drawn(seed, 12)
    wanted = in_log(motion, paths)
    np.testing.assert_allclose(log_odds_in_log(*given_all), [wanted[k] for k in sorted(paths)], atol=1e-3)


def frames_of(paths: Paths) -> list[Frame]:
    """Samples of tracks at each step."""

    def rows(step: int) -> Rows:
        here = {name: path[step] for name, path in paths.items() if step in path}
        x, y = np.array(list(here.values())).reshape(-1, 2).T
        count = len(here)
        seen = {"observed": np.ones(count, bool), "source_id": np.full(count, -1)}
        return TRACKS.rows(track_id=list(here), x_m=x, y_m=y, **seen)

    return [Frame(round(step * 4e8), step, rows(step)) for step in range(max(max(path) for path in paths.values()) + 1)]


def tracked(paths: Paths) -> dict[int, int]:
    """How many rows the tracks of each input id have after re-tracking."""
    count: dict[int, int] = {}
    for found, *_ in PROFILES["default"](frames_of(paths)):
        for name in found.rows["source_id"].tolist():
            count[name] = count.get(name, 0) + 1
    return count


def walkers(rng: np.random.Generator, count: int, steps: int = 60) -> Paths:
    """People who walk on lanes that are 4 m apart."""
    places = [walk_of(rng, np.array([0.0, 4.0 * k]), np.array([1.2, 0.0]), steps, 0.1) for k in range(count)]
    return {k + 1: dict(enumerate(map(tuple, place.tolist()))) for k, place in enumerate(places)}


@pytest.mark.parametrize("seed", range(3))
def test_a_double_that_shares_the_errors_of_a_person_is_left_out_and_a_companion_is_not(seed):
    rng = np.random.default_rng(seed)
    paths = walkers(rng, 6)
    part = range(10, 60)
    paths[11] = {s: (paths[1][s][0] + 0.3, paths[1][s][1] + 0.7) for s in part}
    companion = walk_of(rng, np.array([0.3, 4.7]), np.array([1.2, 0.0]), 60, 0.1)
    paths[12] = {s: tuple(companion[s].tolist()) for s in part}
    found = tracked(paths)
    assert 11 not in found
    assert found[12] == len(part)


def test_a_place_that_is_missed_for_longer_than_people_are_is_left_out_and_somebody_who_stands_is_not():
    """Both are at one place for the whole log; people are missed for a step or two, and the place for ten."""
    rng = np.random.default_rng(4)
    paths = walkers(rng, 6)
    for name, path in paths.items():
        for missed in range(5 + name, 55, 12):
            path.pop(missed)
    stands, place = (
        walk_of(rng, np.array([30.0, -6.0]), np.zeros(2), 60, 0.1),
        rng.normal(0, 0.1, (60, 2)) + (30.0, 40.0),
    )
    paths[11] = {s: tuple(stands[s].tolist()) for s in range(60) if s % 12 != 5}
    paths[12] = {s: tuple(place[s].tolist()) for s in range(60) if s % 15 < 5}
    found = tracked(paths)
    assert found[11] == 55
    assert 12 not in found
