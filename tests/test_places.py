"""Where lost tracks come back: the odds at places, by hand, and what is written by them online."""

from __future__ import annotations

import pytest

from mcaptrack.transforms import PROFILES
from mcaptrack.transforms.retrack.online_tracker import PlaceOdds
from tests.worlds import places, walk

Positions = dict[int, tuple[float, float]]


def test_the_ratio_of_odds_by_hand():
    """Six of ten went well, so the share is 7 of 12 (one more of each); at the first place all four did."""
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


@pytest.mark.parametrize("place", [0, 1], ids=["they return", "they are gone"])
def test_lost_tracks_are_written_where_others_came_back(place):
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
    assert near[200:] == [True] * 5 + [place == 0]


def test_places_far_away_are_places_too():
    frames = walk(lambda n: {1: (1e12, 0.0), 3: (0.1 * (n % 3), 1.0)}, 12)
    assert [len(result[1].rows) for result in PROFILES["default"](frames)] == [2] * 12
