"""What is written online follows the log so far: who is lost for how long, and what begins false; from the past alone."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.schema import Frame
from mcaptrack.transforms import PROFILES
from tests.worlds import assert_same_rows, noisy_tracks, places, walk

Positions = dict[int, tuple[float, float]]


def online(frames: list[Frame]) -> list[Frame]:
    return [result[1] for result in PROFILES["default"](frames)]


def corners(n: int) -> Positions:
    """Four people walk a little at the corners of a square, so that what is between them is inside."""
    return {200 + c: (60.0 * (c % 2) - 20 + 0.05 * abs(n % 40 - 20), 60.0 * (c // 2) - 20) for c in range(4)}


@pytest.mark.parametrize("flickers", [False, True])
def test_a_new_track_is_written_at_once_unless_most_were_soon_over(flickers):
    """One comes in each 20 steps, and in the one log 50 more are seen for two steps before the last one comes."""

    def path(n: int) -> Positions:
        out = corners(n)
        if n % 20 < 15:
            out[n // 20] = (0.3 * (n % 20) - 19.9, 3.0 * (n // 20 % 4))
        if flickers and n < 205:
            out[1000 + n // 4] = (10.0 + n % 7, 15.0 + n % 5) if n % 4 < 2 else (10.0, -12.0)
        return out

    frames = online(walk(path, 242))
    is_written = [any(-20 <= x < -15 and -1 < y < 10 for x, y in places(frames[n]).values()) for n in (240, 241)]
    assert all(is_written) is not flickers


@pytest.mark.parametrize("missed", [1, 3])
def test_lost_tracks_are_written_as_long_as_gaps_of_the_log_are(missed):
    """Each of the four is missed for so many steps, again and again; then one is for three."""

    def path(n: int) -> Positions:
        gone = {200 + c for c in range(4) if (n + 5 * c) % 20 < missed} if n < 240 else {200}
        return {who: place for who, place in corners(n).items() if who not in gone}

    frames = online(walk(path, 243))
    assert len(places(frames[240])) == 4
    assert len(places(frames[242])) == (3 if missed == 1 else 4)


@pytest.mark.parametrize("end", [1, 17, 60])
def test_online_tracks_do_not_depend_on_what_comes(end):
    frames = noisy_tracks(np.random.default_rng(3), ticks=80)
    for found, wanted in zip(online(frames[:end]), online(frames), strict=False):
        assert_same_rows(found.rows, wanted.rows)


def test_places_far_away_are_written():
    frames = online(walk(lambda n: {1: (1e12, 0.0), 3: (0.1 * (n % 3), 1.0)}, 12))
    assert [len(frame.rows) for frame in frames[4:]] == [2] * 8
