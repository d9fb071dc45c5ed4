"""Which new tracks in metres continue a lost one after an occlusion of three seconds, and which don't."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.schema import Frame
from mcaptrack.transforms import GroundTracker
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


def test_what_stands_is_found_again_after_long():
    assert last_id(tracked(occluded((0.3, 0.0), gap=range(20, 95)), 110)) == 1


def test_a_lost_track_is_continued_once():
    """A car comes back, drives off, and another one stands where it stood."""

    def found(n: int) -> list[Box]:
        first = [] if n in GAP else [(max(0.0, n - 55.0), 0.0)]
        return first + ([(0.0, 0.0)] if n >= 70 else [])

    first, second = tracked(found, 80)[-1].rows["track_id"].tolist()
    assert first == 1 != second


def test_a_continued_track_keeps_its_size():
    frames = tracked(occluded((0.3, 0.0, {"length_m": 8.0})), 52)
    assert frames[-1].rows["length_m"][0] < 5.0


def test_no_track_is_faster_than_its_class():
    rows = np.concatenate([frame.rows for frame in tracked(lambda n: [(0.6 * n, 0.0)], 20, class_limits="car=5")])
    assert len(rows) > 10
    assert np.hypot(rows["vx_m_per_s"], rows["vy_m_per_s"]).max() <= 5.0 + 1e-5
