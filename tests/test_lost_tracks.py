"""Which new tracks in metres continue a lost one after an occlusion of three seconds, and which don't."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from mcaptrack.schema import Frame
from mcaptrack.transforms import GroundTracker
from mcaptrack.transforms import ground as tracker
from mcaptrack.transforms.ground import LostTracks, continuations
from tests.effects.ground import NAMES, Box, boxes

GAP = range(20, 50)


def tracked(found, count: int = 70, **options) -> list[Frame]:
    return [frame for (frame,) in GroundTracker(class_names=NAMES, **options)(boxes(found, count))]


def last_id(frames: list[Frame]) -> int:
    return int(frames[-1].rows["track_id"].max())


def occluded(after: Box, speed: float = 0.0, gap: range = GAP):
    """A car along x, and after the gap a box at ``after`` that goes on at the same speed."""
    x, y, *more = after

    def found(n: int) -> list[Box]:
        if n in gap:
            return []
        return [(speed * n / 10, 0.0)] if n < gap.start else [(x + speed * (n - gap.stop) / 10, y, *more)]

    return found


@pytest.mark.parametrize(
    ("after", "speed", "is_same"),
    [
        ((0.3, 0.0), 0.0, True),
        ((6.0, 0.0), 0.0, False),
        ((0.3, 0.0, {"class_id": 1}), 0.0, False),
        ((50.0, 0.0), 10.0, True),
        ((22.0, 0.0), 10.0, False),
    ],
    ids=["stands", "stands elsewhere", "of another class", "goes on", "stays behind"],
)
def test_a_new_track_continues_the_lost_one_that_it_fits(after: Box, speed: float, is_same: bool):
    assert last_id(tracked(occluded(after, speed))) == (1 if is_same else 2)


def test_a_continued_track_keeps_its_size():
    frames = tracked(occluded((0.3, 0.0, {"length_m": 8.0})), 52)
    assert frames[-1].rows["length_m"][0] < 5.0


def odds(lost: np.ndarray, new: np.ndarray) -> float:
    """The log odds that a new track continues a lost one, by densities of normal distributions; -inf where it can't."""
    gap = lost[tracker.MISSED_S] - new[tracker.AGE_S]
    if gap <= 0 or lost[tracker.CLASS] != new[tracker.CLASS]:
        return -np.inf
    begin, end, velocity = new[tracker.FIRST], lost[tracker.LAST][:2], lost[tracker.LAST_VELOCITY]
    speed, usual = np.linalg.norm(velocity), lost[tracker.SPEED]
    noise = 2 * lost[tracker.NOISE] ** 2
    drift = 0.07 * usual + 0.1 * speed
    goes = noise + lost[tracker.LAST_SPREAD] * gap**2 + drift**2 * gap**3 / 3
    density = multivariate_normal.pdf(begin, end + velocity * gap, goes * np.eye(2))
    if speed < 0.12 * usual:
        stays = multivariate_normal.pdf(begin, end, (noise + 0.15**2 * gap) * np.eye(2))
        density = 0.2 * density + 0.8 * stays
    return float(np.log(max(density * usual**2 / 0.06, 1e-12)))


@pytest.mark.parametrize("seed", range(12))
def test_new_tracks_continue_lost_ones_as_is_most_likely_for_all(seed):
    """Beside all ways of pairing them, one by one."""
    rng = np.random.default_rng(seed)
    lost, new = (np.zeros((len(tracker.no_tracks()), count)) for count in (3, 2))
    lost[tracker.LAST][:2], new[tracker.FIRST] = rng.uniform(-4, 4, (2, 3)), rng.uniform(-4, 4, (2, 2))
    lost[tracker.LAST_VELOCITY] = rng.normal(0, 1.5, (2, 3)) * (rng.random(3) < 0.6)
    lost[tracker.MISSED_S], new[tracker.AGE_S] = rng.uniform(0.5, 4, 3), rng.uniform(0, 1, 2)
    lost[tracker.SPEED], lost[tracker.NOISE] = rng.choice([2.0, 7.0], 3), rng.uniform(0.1, 0.4, 3)
    lost[tracker.LAST_SPREAD] = rng.uniform(0.01, 0.3, 3)
    lost[tracker.CLASS], new[tracker.CLASS] = rng.integers(0, 2, 3), rng.integers(0, 2, 2)
    gain = np.array([[odds(one, other) for other in new.T] for one in lost.T])
    best = max(
        (
            [(i, j) for i, j in zip(order, range(2), strict=True) if i < 3]
            for order in itertools.permutations(range(5), 2)
            if all(i >= 3 or gain[i, j] > 0 for i, j in zip(order, range(2), strict=True))
        ),
        key=lambda pairs: sum(gain[pair] for pair in pairs),
    )
    i, j = continuations(lost, new)
    assert sorted(zip(i.tolist(), j.tolist(), strict=True)) == sorted(best)
    assert [len(part) for part in continuations(lost[:, :0], new)] == [0, 0]
    assert [len(part) for part in continuations(lost, new[:, :0])] == [0, 0]


@pytest.mark.parametrize(("speed", "which"), [(0.239, "stayed"), (0.241, "went")])
def test_what_is_slow_may_have_stood_still(speed, which):
    """At a usual speed of 2 m/s. Two begin after 3 s: one where it was, and one where it has gone at its speed."""
    lost = np.zeros((len(tracker.no_tracks()), 1))
    lost[tracker.MISSED_S], lost[tracker.SPEED], lost[tracker.NOISE], lost[tracker.LAST_SPREAD] = 3.0, 2.0, 0.02, 1e-6
    lost[tracker.LAST_VELOCITY] = [[speed], [0.0]]
    new = np.zeros((len(lost), 2))
    new[tracker.FIRST] = [[0.0, 3 * speed], [0.0, 0.0]]
    i, j = continuations(lost, new)
    assert (i.tolist(), j.tolist()) == ([0], [0 if which == "stayed" else 1])


def test_lost_tracks_are_remembered_until_their_time_is_over():
    lost = LostTracks(2.0)
    lost.wait(1.0)
    table = np.zeros((len(tracker.no_tracks()), 2))
    table[tracker.MISSED_S], table[tracker.ID] = [0.5, 1.0], [4, 7]
    lost.add(table)
    lost.wait(1.0)
    assert lost.table[tracker.ID].tolist() == [4, 7]  # 2 s is not over yet
    lost.wait(0.25)
    assert lost.table[tracker.ID].tolist() == [4]
    assert lost.table[tracker.MISSED_S].tolist() == [1.75]


def test_a_track_that_still_coasts_may_be_continued_too_and_lost_ones_stay_lost():
    """Boxes have to overlap here: a narrow car that is seen 0.7 m aside after half a second begins a track, which continues it.

    Another one was lost before, far away, and comes back where it stood.
    """

    def found(n: int) -> list[Box]:
        narrow = {"width_m": 0.4}
        first = [(0.0, 0.0, narrow)] if n < 40 else [(0.0, 0.7, narrow)] if n >= 45 else []
        return first + ([(60.0, 0.0)] if n < 15 or n >= 60 else [])

    frames = tracked(found, 80, cost="iou", max_age_s=1.0)
    assert last_id(frames) == 2
    assert sorted(frames[5].rows["track_id"].tolist()) == sorted(frames[-1].rows["track_id"].tolist())
    assert [len(one.rows) for one in (frames[30], frames[50], frames[-1])] == [1, 1, 2]
    assert frames[50].rows["y_m"][0] == pytest.approx(0.7, abs=0.1)
