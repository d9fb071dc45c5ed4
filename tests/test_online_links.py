"""Online, a person who comes back keeps the id: links of new tracks to lost ones, from the past alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.schema import Frame
from mcaptrack.transforms import PROFILES, Retrack
from mcaptrack.transforms.retrack import likelihood
from tests.references.online import OnlineTracker
from tests.test_retracking_reference import PLAIN, QUICK, black_box, compare
from tests.worlds import ids, noisy_tracks, walk

SEEDS = st.integers(0, 2**32 - 1)
#: A gap of more than 5 steps ends a track online.
MOST_AGE = 5


def online(frames: list[Frame], **options: object) -> list[Frame]:
    return [result[1] for result in replace(PROFILES["default"], **options)(frames)]


def hidden(gap: int, y_m: float = 0.0) -> Callable[[int], dict[int, tuple[float, float]]]:
    """One walks at 1.25 m/s, is hidden for ``gap`` steps from step 20 on, and goes on, shifted, with another id."""

    def path(n: int) -> dict[int, tuple[float, float]]:
        if 20 <= n < 20 + gap:
            return {}
        return {1: (0.5 * n, 0.0)} if n < 20 else {2: (0.5 * n, y_m)}

    return path


def passers(rng: np.random.Generator, people: int = 8, ticks: int = 120, flickers: bool = False) -> list[Frame]:
    """People walk straight on; at times they are hidden for up to 6 s, and come back with another id.

    Where it ``flickers``, most tracks are soon over, so that new ones are not written at once.
    """
    begins, speed = rng.integers(0, ticks // 2, people), rng.normal(0, 1.2, (people, 2))
    start, noise_m = rng.uniform(-8, 8, (people, 2)), rng.choice([0.02, 0.1])
    hidden = [set(np.concatenate([np.arange(a, a + rng.integers(6, 15)) for a in (15, 50)])) for _ in range(people)]
    seen = rng.random((people, ticks)) > rng.choice([0.0, 0.1])

    def path(n: int) -> dict[int, tuple[float, float]]:
        out = {1000 + n: tuple(rng.uniform(-12, 12, 2))} if flickers else {}
        for who in range(people):
            age = n - begins[who]
            if 0 <= age < 90 and age not in hidden[who] and seen[who, n]:
                name = who + 10 * sum(age > a for a in (15, 50))
                out[name] = tuple(start[who] + 0.4 * age * speed[who] + rng.normal(0, noise_m, 2))
        return out

    return walk(path, ticks)


def names(frames: list[Frame]) -> list[int]:
    return sorted({one for frame in frames for one in ids(frame)})


@pytest.mark.parametrize("gap", [2, MOST_AGE + 1, 10, 20])
def test_who_comes_back_where_expected_keeps_the_id(gap):
    assert names(online(walk(hidden(gap), 60))) == [1]


@pytest.mark.parametrize(("gap", "options"), [(10, {"link_s": 0.0}), (10, {"link_s": 3.0}), (60, {})])
def test_links_are_over_gaps_of_link_s_at_most(gap, options):
    """A gap of 10 steps is one of 4.4 s, with the step on which the person is seen again; one of 60 is over 20 s."""
    assert len(names(online(walk(hidden(gap), 100), **options))) == 2


def test_another_one_elsewhere_is_another_one():
    assert len(names(online(walk(hidden(10, y_m=8.0), 60)))) == 2


@pytest.mark.parametrize(("hits", "waits"), [(20, 0), (3, 3)])
def test_who_surely_comes_back_is_written_at_once_if_confirmed_before(hits, waits):
    """Most detections flicker, so that others wait for 1.2 s. One that was seen three times was never written."""

    def path(n: int) -> dict[int, tuple[float, float]]:
        out = {1000 + n: (100.0 * (n + 1), -500.0)} if n % 2 else {}
        if 60 - hits <= n < 60 or n >= 70:
            out[1 if n < 60 else 2] = (0.5 * n, 0.0)
        return out

    found = [[one for one in frame.rows if one["y_m"] > -1] for frame in online(walk(path, 90))]
    assert [len(rows) for rows in found[70:]] == [0] * waits + [1] * (20 - waits)
    assert len({int(row["track_id"]) for rows in found for row in rows}) == 1


def test_who_has_come_back_is_not_taken_for_another_one_who_is_lost():
    """Two walk side by side and are lost; one comes back, and is written before it is confirmed."""

    def path(n: int) -> dict[int, tuple[float, float]]:
        out = {1000 + n: (100.0 * (n + 1), -500.0)} if n % 2 else {}
        if 40 <= n < 60:
            out |= {1: (0.5 * n, 0.0), 2: (0.5 * n, 1.0)}
        return out | {3: (0.5 * n, 0.2)} if n >= 70 else out

    found = [[one for one in frame.rows if one["y_m"] > -1] for frame in online(walk(path, 90))]
    assert len({int(row["track_id"]) for rows in found[70:] for row in rows}) == 1
    assert len(found[70]) == 1


def test_a_lost_track_is_continued_once():
    """Two come out where one went in: one of them is new."""

    def path(n: int) -> dict[int, tuple[float, float]]:
        if n < 20:
            return {1: (0.5 * n, 0.0)}
        return {} if n < 30 else {2: (0.5 * n, 0.2), 3: (0.5 * n, -1.5)}

    found = online(walk(path, 60))
    assert Counter(len(ids(frame)) for frame in found[30:]) == {2: 30}
    assert names(found)[0] == 1
    assert len(names(found[30:])) == 2
    assert {1} < set(names(found[30:]))


@pytest.mark.parametrize("steps", [1, 256])
def test_a_track_that_began_before_another_was_lost_does_not_continue_it(steps, monkeypatch):
    """Tracks are written after 4 s: then the other one, 1.2 m aside, has been over for long."""
    monkeypatch.setattr(likelihood, "_STEPS", steps)

    def path(n: int) -> dict[int, tuple[float, float]]:
        out = {1: (0.5 * n, 0.0)} if n < 22 else {}
        return out | {2: (0.5 * n, 1.2)} if n >= 20 else out

    assert len(names(online(walk(path, 60), confirm_s=4.0, adapt_online=False, link_confidence=0.01))) == 2


def test_many_who_leave_are_not_those_who_come_after_them():
    """People pass one after another, four seconds apart; who comes in at the left is not who went out at the right."""

    def path(n: int) -> dict[int, tuple[float, float]]:
        return {100 + k: (0.5 * (n - 34 * k), 0.0) for k in range(n // 34 + 1) if 0 <= n - 34 * k < 24}

    assert len(names(online(walk(path, 34 * 12)))) == 12


@given(seed=SEEDS, link_s=st.sampled_from([4.0, 20.0]), confidence=st.sampled_from([0.2, 0.5, 0.9]))
@settings(max_examples=12, phases=QUICK)
def test_online_links_equal_the_reference(seed, link_s, confidence):
    rng = np.random.default_rng(seed)
    transform = Retrack(**(PLAIN | {"link_s": link_s}), link_confidence=confidence, predictor="cv", horizon_s=2.0)
    scene = rng.choice(3)
    frames = noisy_tracks(rng, ticks=90, hidden=0.05) if scene == 0 else passers(rng, 4, flickers=scene == 1)
    reference = OnlineTracker(transform, *black_box("cv", 5, 0.4))
    compare(transform, frames, reference)


@given(seed=SEEDS)
@settings(max_examples=10)
def test_no_id_is_written_twice_at_one_step_and_the_past_never_changes(seed):
    rng = np.random.default_rng(seed)
    frames = passers(rng, ticks=80, flickers=bool(rng.choice(2)))
    found = online(frames)
    assert all(len(set(ids(frame))) == len(ids(frame)) for frame in found)
    count = int(rng.integers(20, 80))
    assert [ids(frame) for frame in online(frames[:count])] == [ids(frame) for frame in found[:count]]


@pytest.mark.parametrize("scene", ["people", "and false detections", "all at one place"])
def test_links_do_not_depend_on_how_many_steps_are_read_at_once(scene, monkeypatch):
    """Nor where they have equal odds."""
    frames = passers(np.random.default_rng(5), flickers=scene == "and false detections")
    if scene == "all at one place":
        for frame in frames:
            for name in ("x_m", "y_m"):
                frame.rows[name] = 0.0
    wanted = [ids(frame) for frame in online(frames)]
    assert wanted != [ids(frame) for frame in online(frames, link_s=0.0)]
    for steps in (1, 7):
        monkeypatch.setattr(likelihood, "_STEPS", steps)
        assert [ids(frame) for frame in online(frames)] == wanted
