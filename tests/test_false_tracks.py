"""Which tracks are people, and which follow nobody: by what is known of the whole log."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.schema import TRACKS, Frame, Rows
from mcaptrack.transforms import PROFILES
from mcaptrack.transforms.retrack.false_tracks import FEATURES, features, log_odds_in_log, stand_throughout
from mcaptrack.transforms.retrack.motion_model import MotionModel, State, Trajectories, smooth
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


def drawn(seed: int, most: int) -> tuple[Paths, Motion, tuple[MotionModel, Trajectories, State]]:
    """Up to so many tracks and more beside them, the reference's model of motion, and all that the package is given."""
    rng = np.random.default_rng(seed)
    model, motion = models(rng)
    paths = with_companions(rng, int(rng.integers(1, most + 1)))
    out, _ = laid_out(paths, model.noise_m)
    return paths, motion, (model, out, smooth(model, out)[2])


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
    first, last = min(min(path) for path in paths.values()), max(max(path) for path in paths.values())
    log = first - int(seed % 4), last + int(seed % 3)
    wanted = in_log(motion, paths, log)
    np.testing.assert_allclose(log_odds_in_log(*given_all, log), [wanted[k] for k in sorted(paths)], atol=1e-3)


@pytest.mark.parametrize(
    ("begins", "ends", "wide_m", "missed", "stands"),
    [
        (0, 39, 0.0, 0, True),
        (4, 35, 0.0, 0, False),  # of 39 steps, a tenth is 3.9
        (3, 36, 0.0, 0, True),
        (0, 35, 0.0, 0, False),
        (4, 39, 0.0, 0, False),
        (0, 39, 1.45, 0, True),
        (0, 39, 1.55, 0, False),
        (0, 39, 0.0, 5, True),  # 2 s
        (0, 39, 0.0, 6, False),
    ],
)
def test_who_stands_for_the_whole_log_by_hand(begins, ends, wide_m, missed, stands):
    """In a log of 40 steps; the track is seen at two places by turns, from one corner of its box to the other."""
    side = wide_m / np.sqrt(2)
    steps = [step for step in range(begins, ends + 1) if not 10 < step <= 10 + missed]
    paths = {1: {s: (side, side) if s % 4 > 1 else (0.0, 0.0) for s in steps}}
    out, _ = laid_out(paths, 1e-3)
    smoothed = smooth(MotionModel(1e-3, 1.0, 100.0, 0.0, 0.4), out)[2]  # it follows the positions
    assert stand_throughout(out, smoothed, np.zeros((1, len(FEATURES))), (0, 39), 0.4).tolist() == [stands]


@pytest.mark.parametrize(
    ("begins", "last", "in_step", "stands"),
    [(5, 399, 0.0, True), (6, 399, 0.0, False), (0, 25, 0.0, True), (0, 24, 0.0, False), (0, 399, 1.0, False)],
)
def test_two_seconds_of_a_long_log_ten_of_a_short_one_and_doubles(begins, last, in_step, stands):
    out, _ = laid_out({1: dict.fromkeys(range(begins, last + 1), (0.0, 0.0))}, 0.1)
    smoothed = smooth(MotionModel(0.1, 1.0, 0.1, 0.1, 0.4), out)[2]
    found = np.where(np.array(FEATURES) == "in step", in_step, 0.0)[None]
    assert stand_throughout(out, smoothed, found, (0, last), 0.4).tolist() == [stands]


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


@pytest.mark.parametrize("seed", range(3))
def test_who_stands_for_the_whole_of_a_short_log_is_left_in_though_seen_now_and_then(seed):
    """Three stand among people who walk, in 16 s; flicker wanders for a second or two at other places."""
    rng = np.random.default_rng(seed)
    paths = walkers(rng, 4, 40)
    for name in (11, 12, 13):
        place = rng.normal(0, 0.2, (40, 2)) + [3.0 * (name - 10), -5.0]
        seen = {0, 39, *np.flatnonzero(rng.random(40) < 0.75).tolist()}
        paths[name] = {s: tuple(place[s].tolist()) for s in sorted(seen)}
    for name in range(20, 28):
        begins, lasts = int(rng.integers(0, 34)), int(rng.integers(2, 6))
        place = rng.uniform(-30, 60, 2) + np.cumsum(rng.normal(0, 0.3, (lasts, 2)), axis=0) - [0, 100]
        paths[name] = {begins + k: tuple(place[k].tolist()) for k in range(lasts)}
    found = tracked(paths)
    assert {11, 12, 13} < set(found)
    assert not {*range(20, 28)} & set(found)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("steps", [40, 600])
def test_a_double_of_a_person_who_stands_for_the_whole_log_is_left_out(steps, seed):
    rng = np.random.default_rng(seed)
    paths = walkers(rng, 4, steps)
    for name in (11, 12, 13):
        place = rng.normal(0, 0.1, (steps, 2)) + [5.0 * (name - 10), -10.0]
        paths[name] = dict(enumerate(map(tuple, place.tolist())))
        double = place + [0.5, 0.6] + rng.normal(0, 0.04, (steps, 2))
        paths[name + 10] = {s: tuple(double[s].tolist()) for s in np.flatnonzero(rng.random(steps) < 0.9).tolist()}
    found = tracked(paths)
    assert {11, 12, 13} < set(found)
    assert not {21, 22, 23} & set(found)
