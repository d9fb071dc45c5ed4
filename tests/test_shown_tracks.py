"""Which online tracks are written: what the log said so far of how long tracks last, and where they were seen."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from mcaptrack.schema import Frame
from mcaptrack.transforms import PROFILES
from mcaptrack.transforms.retrack.shown_tracks import GrowingHull
from tests.worlds import places, walk

#: Positions of people by their input ids, at each tick.
People = Callable[[int], Mapping[int, tuple[float, float]]]
NS_PER_TICK = 400_000_000


def online(path: People, ticks: int, **options: object) -> list[dict[int, tuple[float, float]]]:
    """The places of online tracks at each tick."""
    return [places(result[1]) for result in replace(PROFILES["default"], **options)(walk(path, ticks))]


def written(found: list[dict[int, tuple[float, float]]], along: Callable[[float, float], bool]) -> list[int]:
    """The ticks at which a track is written at one of the places that ``along`` names."""
    return [tick for tick, here in enumerate(found) if any(along(*place) for place in here.values())]


def flickers(ticks: range, lasting: int) -> People:
    """Every third tick there is another false detection, far from all others, for so many ticks."""

    def path(n: int) -> dict[int, tuple[float, float]]:
        first = [tick for tick in ticks if tick % 3 == 0 and tick <= n < tick + lasting]
        return {1000 + tick: (100.0 * (tick + 1), -500.0) for tick in first}

    return path


def walker(name: int, ticks: range, y_m: float, speed: float = 0.4) -> People:
    return lambda n: {name: (speed * n, y_m)} if n in ticks else {}


def together(*paths: People) -> People:
    return lambda n: {name: place for path in paths for name, place in path(n).items()}


@pytest.mark.parametrize(("lasting", "first"), [(1, 41), (2, 42), (3, 43), (30, 40)])
def test_a_new_track_waits_where_most_tracks_of_the_log_were_soon_over(lasting, first):
    """One that was observed more often than those is taken for a person; it is confirmed by its fourth observation."""
    found = online(together(flickers(range(30), lasting), walker(1, range(40, 60), 0.0)), 60)
    assert written(found, lambda x, y: y > -1)[0] == first


def test_what_a_gap_of_the_log_ends_was_not_short():
    """Ten people are there for two ticks before each gap, which ends their tracks."""
    frames = walk(lambda n: {100 * n + k: (10.0 * k, 0.0) for k in range(10)} if n < 8 else {1: (50.0, 50.0)}, 9)
    times = [(n + 50 * (n // 2)) * NS_PER_TICK for n in range(9)]
    named = [frame.rows.copy() for frame in frames]
    for n, rows in enumerate(named[:8]):
        rows["track_id"] = 100 * (n // 2) + np.arange(10)
    apart = [Frame(t, n, rows) for n, (t, rows) in enumerate(zip(times, named, strict=True))]
    assert [len(result[1].rows) for result in PROFILES["default"](apart)] == [10] * 8 + [1]


def crossing(last: int, ticks: int) -> list[int]:
    """The ticks at which the last one is written of some who walk through a square of 20 m, one after another.

    Four stand at its corners. All leave it at its right side, but the last one, who is seen until tick ``last``.
    """

    def path(n: int) -> dict[int, tuple[float, float]]:
        out = {corner: (20.0 * (corner % 2), 20.0 * (corner // 2)) for corner in range(4)}
        number, tick = divmod(n, 40)
        if tick <= (20 if number < 3 else last):
            out[10 + number] = (1.0 * tick, 10.0)
        return out

    found = online(path, 160)
    return [n - 120 for n in written(found, lambda x, y: abs(y - 10) < 2) if n >= 120][:ticks]


@pytest.mark.parametrize(("last", "shown"), [(12, 3), (20, 0)])
def test_lost_tracks_are_written_inside_of_the_area_that_was_seen_and_not_outside(last, shown):
    """One is lost in the middle; the other at the edge, where those before have left."""
    assert crossing(last, 40) == list(range(last + 1 + shown))


def test_until_the_first_have_left_lost_tracks_are_written_outside():
    found = online(lambda n: {7: (0.5 * n, 0.0)} if n < 20 else {}, 40)
    assert written(found, lambda x, y: True) == list(range(23))


def test_long_ages_and_confirmation_take_no_memory():
    """Every step counted by itself would take tables of a gigabyte."""
    options = {"max_age_s": 1e6, "confirm_s": 1e5, "coast_s": 1e6}
    assert len(online(walker(1, range(20), 0.0), 20, **options)[-1]) == 1


def test_who_comes_back_from_outside_is_written_there():
    """One walks round a square, twice as large each time, and is missed for a tick at each third step."""

    def path(n: int) -> dict[int, tuple[float, float]]:
        if n > 8 and n % 3 == 0:
            return {}
        angle = n / 8
        return {7: (0.15 * n * np.cos(angle), 0.15 * n * np.sin(angle))}

    found = online(path, 90)
    missed = [n for n in range(60, 90) if n % 3 == 0]
    assert all(len(found[n]) == 1 for n in missed)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_a_growing_hull_is_the_hull_of_all_points(seed):
    """Compared with Qhull; points inside are those that don't change its area."""
    rng = np.random.default_rng(seed)
    hull, seen = GrowingHull(), np.empty((0, 2))
    for count in rng.integers(1, 6, 8):
        new = np.round(rng.normal(0, 3, (count, 2)), int(rng.integers(0, 3)))
        hull.add(new.T)
        seen = np.concatenate([seen, new])
        if np.linalg.matrix_rank(seen - seen[0]) < 2:
            assert not hull.holds(seen.T).any()
            continue
        wanted = ConvexHull(seen)
        x, y = hull.vertices.T
        assert (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2 == pytest.approx(wanted.volume)
        assert hull.holds(seen.T).all()
        others = rng.normal(0, 4, (10, 2))
        larger = [ConvexHull([*seen, other]).volume > wanted.volume + 1e-5 for other in others]
        assert hull.holds(others.T).tolist() == [not one for one in larger]


def test_a_hull_leaves_out_what_is_no_place():
    hull = GrowingHull()
    hull.add(np.array([[0.0, 1.0, 0.0, np.nan], [0.0, 0.0, 1.0, 5.0]]))
    assert len(hull.vertices) == 3
    assert hull.holds(np.array([[0.2, np.nan], [0.2, 0.2]])).tolist() == [True, False]
