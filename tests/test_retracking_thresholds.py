"""Decisions of re-tracking flip at the same distance as in the slow reference.

Random tracks seldom come near a threshold; here bisection finds the scene that is at one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mcaptrack.schema import Frame
from mcaptrack.transforms import PROFILES
from mcaptrack.transforms.retrack.false_tracks import FEATURES, features
from mcaptrack.transforms.retrack.identity_swaps import find_encounters, resolve_swaps
from mcaptrack.transforms.retrack.linking import TrackEnds, pairs_in_reach
from mcaptrack.transforms.retrack.motion_model import MotionModel, State, smooth, to_trajectories
from tests.references.false_tracks import person_features
from tests.references.offline import Motion, Path, encounters, exchanged
from tests.references.online import OnlineTracker
from tests.tiers import one_in
from tests.worlds import walk

NUMBERS = (0.2, 1.75, 0.12, 0.08)
MODEL, MOTION = MotionModel(*NUMBERS, 0.4), Motion(*NUMBERS, 0.4)
FEW = replace(
    PROFILES["default"],
    predictor="cv",
    noise_m=0.2,
    link_s=0.0,
    resolve_swaps=False,
    smooth=False,
    track_confidence=0.0,
    adapt_online=False,
)


def edge(decides: Callable[[float], bool], low: float, high: float) -> float:
    """Bisect for the value at which a decision flips that holds at ``low`` and not at ``high``."""
    assert decides(low)
    assert not decides(high)
    for _ in range(12):
        middle = (low + high) / 2
        low, high = (middle, high) if decides(middle) else (low, middle)
    return (low + high) / 2


def compare(ours: Callable[[float], bool], reference: Callable[[float], bool], low: float, high: float) -> None:
    assert edge(ours, low, high) == pytest.approx(edge(reference, low, high), abs=(high - low) / 2**11)


def by_reference(frames: list[Frame]):
    """Offline tracks, online tracks and forecasts of the slow reference, which predicts nothing here."""
    samples = [[dict(zip(row.dtype.names, row.tolist(), strict=True)) for row in frame.rows] for frame in frames]
    tracker = OnlineTracker(FEW, lambda points: (np.zeros((1, 2)), np.zeros((1, 2, 2))), 1)
    return tracker.run(samples, [frame.t_ns for frame in frames])


def jump(to_m: float, name: int, gap: int, beside_m: float | None) -> list[Frame]:
    """Person 7 stands at 0 m and, after a gap, at ``to_m`` under the id ``name``; 9 stood far away before.

    Another person appears ``beside_m`` away from 7 after the gap.
    """

    def path(tick: int):
        if tick < 12:
            return {7: (0.0, 0.0)} | ({9: (90.0, 0.0)} if tick < 4 else {})
        if tick < 12 + gap:
            return {}
        return {name: (to_m, 0.0)} | ({8: (to_m, beside_m)} if beside_m is not None else {})

    return walk(path, 15 + gap)


#: The id after the gap, the ticks of the gap, and how far beside somebody else is.
JUMPS = {
    "same id": (7, 0, None), "known id": (9, 0, None), "new id": (99, 0, None), "new id after a gap": (99, 1, None),
    "same id after a gap": (7, 2, None), "in a crowd": (7, 0, 1.65), "beside a crowd": (7, 0, 1.75),
    "known id in a crowd": (9, 2, 1.0),
}  # fmt: skip


@pytest.mark.parametrize(("name", "gap", "beside_m"), one_in(4, JUMPS.values()), ids=JUMPS)
def test_the_longest_jump_that_a_track_follows(name, gap, beside_m):
    def sources(rows) -> list[tuple[int, int]]:
        return [(int(row["track_id"]), int(row["source_id"])) for row in rows]

    def ours(to_m: float) -> bool:
        *_, (offline, *_) = FEW(jump(to_m, name, gap, beside_m))
        return (1, name) in sources(offline.rows)

    def reference(to_m: float) -> bool:
        offline, _, _ = by_reference(jump(to_m, name, gap, beside_m))
        return (1, name) in sources(offline[-1])

    compare(ours, reference, 0.0, 20.0)


def laid_out(paths: dict[int, Path]):
    step, name, x, y = (
        np.array(column)
        for column in zip(*((s, n, *at) for n, path in paths.items() for s, at in path.items()), strict=True)
    )
    _, at, out = to_trajectories(step, name, np.stack([x, y], axis=-1))
    return out, at


def line(first: int, steps: int, start: tuple[float, float], speed: tuple[float, float]) -> Path:
    return {first + k: (start[0] + speed[0] * k * 0.4, start[1] + speed[1] * k * 0.4) for k in range(steps)}


def feature(name: str, paths: dict[int, Path]) -> tuple[float, float]:
    """A feature of the second of two tracks: of the package, and of the reference."""
    out, _ = laid_out(paths)
    smoothed = smooth(MODEL, out)
    return float(features(MODEL, out, smoothed)[1, FEATURES.index(name)]), person_features(MOTION, paths)[2][name]


def test_the_distance_within_which_a_track_is_beside_a_longer_one():
    def share(beside_m: float) -> tuple[float, float]:
        paths = {1: line(0, 40, (0.0, 0.0), (1.0, 0.0)), 2: line(12, 10, (4.8, beside_m), (1.0, 0.0))}
        return feature("beside", paths)

    assert share(1.79) == pytest.approx((1.0, 1.0))
    assert share(1.81) == (0.0, 0.0)


@pytest.mark.parametrize(("count", "wanted"), [(4, 1.0), (3, 0.0)])
def test_the_samples_that_a_track_needs_to_be_beside_another(count, wanted):
    paths = {1: line(0, 40, (0.0, 0.0), (1.0, 0.0)), 2: line(12, count, (4.8, 0.5), (1.0, 0.0))}
    assert feature("beside", paths) == (wanted, wanted)


def crossing(beside_m: float, gap: int) -> dict[int, Path]:
    """Two people cross, and their track ids are swapped where they meet, in a gap of the tracks."""
    one, two = line(0, 51, (-10.0, 0.0), (1.0, 0.0)), line(0, 51, (10.0, beside_m), (-1.0, 0.0))
    when = 25
    unseen = range(when - gap, when)
    return {
        3: {s: (one if s < when else two)[s] for s in one if s not in unseen},
        5: {s: (two if s < when else one)[s] for s in one if s not in unseen},
    }


def ours_exchanged(paths: dict[int, Path]) -> bool:
    return resolve_swaps(MODEL, laid_out(paths)[0])[1] > 0


@pytest.mark.parametrize("gap", [0, 4])
def test_the_least_distance_at_which_swapped_ids_are_noticed(gap):
    """Two stand beside each other, and their ids are swapped: the nearer they are, the smaller the evidence."""

    def beside(near: float):
        paths = crossing(0.0, gap)
        side = 1.5 - near
        for track, low, high in ((3, 0.0, side), (5, side, 0.0)):
            paths[track] = {step: (low if step < 25 else high, 0.0) for step in paths[track]}
        return paths

    compare(lambda near: ours_exchanged(beside(near)), lambda near: exchanged(MOTION, beside(near))[1] > 0, 0.0, 1.49)


def test_people_more_than_2_m_apart_have_no_encounter():
    for beside_m, met in ((1.99, True), (2.01, False)):
        paths = crossing(beside_m, 0)
        assert (exchanged(MOTION, paths)[1] > 0) == met
        assert ours_exchanged(paths) == met


def test_encounters_begin_and_end_as_in_the_reference():
    """Two walk abreast and come near each other twice, with any number of steps between."""
    for between in range(15, 26):
        one = {s: (0.4 * s, 0.0) for s in range(5, 90)}
        two = {
            s: (0.4 * s, 1.0 if s in range(20, 24) or s in range(23 + between, 26 + between) else 3.0)
            for s in range(80)
        }
        paths = {4: one, 9: two, 12: {s: (0.4 * s, -1.0) for s in range(28, 33)}}
        out, _ = laid_out(paths)
        found = zip(*(column.tolist() for column in find_encounters(out)), strict=True)
        names = sorted(paths)
        assert [(names[i], names[j], *steps) for i, j, *steps in found] == encounters(paths)


def abreast(apart_m: float, aside_m: float, until: int, since: int = 15) -> list[Frame]:
    """Two walk so far apart; from tick 15 on one is missed, and from ``since`` on the other is so far aside, towards her."""

    def path(tick: int):
        if tick >= 15:
            return {1: (0.4 * tick, aside_m if tick >= since else 0.0)}
        return {1: (0.4 * tick, 0.0), 2: (0.4 * tick, apart_m)}

    return walk(path, until)


@pytest.mark.parametrize(
    ("apart_m", "aside_m", "is_merged"), [(0.5, 0.15, False), (0.5, 0.25, False), (1.2, 0.6, True)]
)
def test_a_missed_detection_beside_a_person_is_no_merged_one(apart_m, aside_m, is_merged):
    """The noise of positions is 0.2 m, so that 0.25 m aside, half way, says nothing, and 0.6 m does."""
    shown = [len(frame.rows) for _, frame, *_ in FEW(abreast(apart_m, aside_m, 21))]
    assert shown[15:] == ([2] * 6 if is_merged else [2] * 3 + [1] * 3)


def test_how_far_aside_a_detection_is_that_of_two():
    """As in the reference, a step after the last detection of one, of whom less is known then."""
    apart_m, since = 1.5, 16
    last = since + 3  # longer than tracks coast

    def ours(aside_m: float) -> bool:
        *_, (_, online, *_) = FEW(abreast(apart_m, aside_m, last + 1, since))
        return len(online.rows) == 1

    def reference(aside_m: float) -> bool:
        _, online, _ = by_reference(abreast(apart_m, aside_m, last + 1, since))
        return len(online[-1]) == 1

    compare(ours, reference, 0.0, apart_m / 2)


def test_a_swap_at_the_last_step_of_both_is_undone():
    """Two stand 1.5 m apart, and only their last positions are swapped."""
    paths = {
        track: {step: (left if step < 39 else 1.5 - left, 0.0) for step in range(40)}
        for track, left in ((3, 0.0), (5, 1.5))
    }
    owner, changed = resolve_swaps(MODEL, laid_out(paths)[0])
    assert changed == 1
    assert owner.tolist() == [0] * 39 + [1] + [1] * 39 + [0]


@pytest.mark.parametrize(
    ("gap", "aside_m", "is_candidate"),
    [(-1, 0, False), (0, 0, False), (1, 0, True), (50, 0, True), (51, 0, False), (2, 2.99, True), (2, 3.01, False)],
)
def test_a_link_leads_forward_in_time_and_no_farther_than_its_limits(gap, aside_m, is_candidate):
    """Up to 20 s, which are 50 steps, and 1 m and 2.5 m for each second, which is 3 m in two steps."""
    states = State(np.array([[0, 0, 0, 0], [0, aside_m, 0, 0]], float), np.ones((2, 3)))
    ends = TrackEnds(MODEL, np.array([0, 14 + gap]), np.array([14, 28 + gap]), states, states)
    pairs = [
        (i, j, gaps.seconds)
        for first, second, gaps in pairs_in_reach(ends, 20.0)
        for i, j in zip(first, second, strict=True)
    ]
    assert pairs == [(0, 1, pytest.approx([0.4 * gap]))] * is_candidate
