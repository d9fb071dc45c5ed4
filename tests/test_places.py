"""Where tracks last and where lost ones come back: the odds at places, by hand, and what is written by them online."""

from __future__ import annotations

import pytest

from mcaptrack.transforms import PROFILES
from mcaptrack.transforms.retrack.places import PlaceOdds
from tests.worlds import places, walk

Positions = dict[int, tuple[float, float]]


def test_the_ratio_of_odds_by_hand():
    """Six of ten went well; all four here did: (4 / 0.6 + 8) / 8, with 7 of 12 as the share (one more of each)."""
    odds = PlaceOdds()
    assert odds.ratio((0.0, 0.0)) == 1.0
    for place, good, bad in (((0.0, 0.0), 4, 0), ((50.0, 0.0), 2, 4)):
        for is_good in [True] * good + [False] * bad:
            odds.add(place, is_good)
    share = 7 / 12
    assert odds.ratio((0.0, 0.0)) == pytest.approx((4 / share + 8) / 8)
    assert odds.ratio((1.9, 0.0)) == odds.ratio((0.0, 0.0))
    assert odds.ratio((2.1, 0.0)) == 1.0
    assert odds.ratio((50.0, 0.0)) == pytest.approx((2 / share + 8) / (4 / (1 - share) + 8))


def test_only_the_last_2000_count():
    odds = PlaceOdds()
    for _ in range(500):
        odds.add((0.0, 0.0), False)
    for _ in range(1000):
        odds.add((9.0, 9.0), True)
        odds.add((9.0, 9.0), False)
    assert odds.ratio((0.0, 0.0)) == 1.0


def gate(n: int, every: int) -> Positions:
    """Each 12 steps one comes in at a gate and walks on for 10 m; every so many steps something flickers far away."""
    out: Positions = {1000 + n: (20.0, 20.0)} if n % every == 0 and n < 92 else {}
    for k in range(n // 12 + 1):
        if (age := n - 12 * k) < 20:
            out[k] = (0.5 * age, 0.0)
    return out


@pytest.mark.parametrize(
    ("x_m", "y_m", "every", "waits"), [(-0.5, 0.0, 6, 0), (-30.0, 0.0, 6, 1), (-30.0, 0.0, 16, 0), (20.0, 21.0, 16, 1)]
)
def test_who_comes_where_others_came_is_written_sooner_than_where_it_flickers(x_m, y_m, every, waits):
    """Elsewhere that depends on what most tracks of the log were."""

    def path(n: int) -> Positions:
        return gate(n, every) | ({500: (x_m, y_m + 0.5 * (n - 98))} if n >= 98 else {})

    found = [places(result[1]) for result in PROFILES["default"](walk(path, 104))]
    near = [any(abs(x - x_m) < 0.3 and y > y_m - 0.3 for x, y in here.values()) for here in found]
    assert near[98:] == [False] * waits + [True] * (6 - waits)


@pytest.mark.parametrize(("place", "waits"), [(0, 0), (1, 3)], ids=["they return", "they are gone"])
def test_lost_tracks_are_written_where_others_came_back(place, waits):
    """Each 20 steps one is missed for a step after five, and goes on for six more, and another one is gone after five."""

    def path(n: int) -> Positions:
        k, age = divmod(n, 20)
        out: Positions = {200 + c: (60.0 * (c % 2) - 20, 60.0 * (c // 2) - 20) for c in range(4)}
        if age != 5 and age < 12:
            out[2 * k] = (0.1 * age, 0.0)
        if age < 5:
            out[2 * k + 1] = (20.0 + 0.1 * age, 20.0)
        return out

    found = [places(result[1]) for result in PROFILES["default"](walk(path, 206))]
    near = [any(abs(x - 20 * place) < 1 and abs(y - 20 * place) < 1 for x, y in here.values()) for here in found]
    assert near[200:] == [False] * waits + [True] * (5 - waits) + [place == 0]


def test_places_far_away_are_places_too():
    frames = walk(lambda n: {1: (1e12, 0.0), 3: (0.1 * (n % 3), 1.0)}, 12)
    assert [len(result[1].rows) for result in PROFILES["default"](frames)] == [2] * 12
