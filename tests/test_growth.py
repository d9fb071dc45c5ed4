"""Work grows with what can be a pair, not with the square of the boxes of a frame or with the channels of a log.

The bounds are of memory and of numbers of calls, not of seconds. `tools/bench/growth.py` measures whole commands.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import mcaptrack
from mcaptrack import log
from mcaptrack.evaluation.aligned import compare_rows
from mcaptrack.evaluation.events import MatchRule
from mcaptrack.evaluation.metrics import clear, hota, identity
from mcaptrack.evaluation.metrics import matchup as matchups
from mcaptrack.evaluation.people import person_scores
from mcaptrack.geometry import assignment, boxes, neighbours
from mcaptrack.geometry.neighbours import near_pairs, touching_pairs
from mcaptrack.geometry.plane_from_boxes import whole_people
from mcaptrack.log import chunks
from mcaptrack.schema import DETECTIONS, TRACKS, Frame
from mcaptrack.transforms import Retrack
from mcaptrack.transforms.ground import GroundTracker
from mcaptrack.transforms.sort import ByteTrack, OcSort, Sort
from tests.bounded import held
from tests.tiers import one_in

RECTANGLES = st.lists(st.tuples(*[st.integers(0, 12)] * 2, *[st.integers(0, 9)] * 2, st.integers(0, 2)), max_size=14)


@given(RECTANGLES, RECTANGLES)
def test_touching_pairs_are_all_pairs_of_a_group_that_touch(one, other):
    a, b = (np.array(part, float).reshape(-1, 5) for part in (one, other))
    sides = [np.concatenate([part[:, :2], part[:, :2] + part[:, 2:4]], axis=1) for part in (a, b)]
    first, second = touching_pairs(*sides, a[:, 4].astype(int), b[:, 4].astype(int))
    low, high = sides[0][:, None, :2], sides[0][:, None, 2:]
    meet = ((low <= sides[1][None, :, 2:]) & (high >= sides[1][None, :, :2])).all(axis=2)
    wanted = np.nonzero(meet & (a[:, None, 4] == b[None, :, 4]))
    assert [first.tolist(), second.tolist()] == [side.tolist() for side in wanted]


def test_near_pairs_of_large_groups_are_those_of_all_pairs():
    rng = np.random.default_rng(0)
    xy, group = rng.uniform(0, 60, (900, 2)), rng.integers(0, 2, 900)
    found = set(zip(*(side.tolist() for side in near_pairs(group, xy, 2.0)), strict=True))
    near = (np.hypot(*(xy[:, None] - xy).transpose(2, 0, 1)) < 2.0) & (group[:, None] == group)
    assert found == set(zip(*(side.tolist() for side in np.nonzero(np.triu(near, 1))), strict=True))


def crowd(count: int, frames: int = 6, seed: int = 0) -> tuple[list[Frame], list[Frame]]:
    """Detections and tracks of people, as dense whatever their number, who walk and are missed now and then."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(count)))
    place = 2.0 * np.stack(np.divmod(np.arange(count), side), axis=1) + rng.uniform(-0.4, 0.4, (count, 2))
    speed = rng.normal(0, 0.6, (count, 2))
    detected, tracked = [], []
    for number in range(frames):
        seen = np.flatnonzero(rng.random(count) < 0.9)
        xy = (place + 0.1 * number * speed)[seen] + rng.normal(0, 0.05, (len(seen), 2))
        ones = np.ones(len(seen))
        where = {
            "x_m": xy[:, 0], "y_m": xy[:, 1], "x_px": 20 * xy[:, 0], "y_px": 20 * xy[:, 1],
            "w_px": 20 * ones, "h_px": 44 * ones, "class_id": ones.astype(int), "source_id": -ones.astype(int),
        }  # fmt: skip
        detected.append(
            Frame(number * 100_000_000, number, DETECTIONS.rows(score=0.4 + 0.6 * rng.random(len(seen)), **where))
        )
        tracks = TRACKS.rows(track_id=seen, observed=ones.astype(bool), **where)
        tracked.append(Frame(number * 100_000_000, number, tracks))
    return detected, tracked


@pytest.fixture
def no_tables(monkeypatch):
    """No table of pairs is made, however small."""
    for module in (assignment, matchups):
        monkeypatch.setattr(module, "LARGE_TABLE", 0)
    monkeypatch.setattr("mcaptrack.transforms.retrack.online_tracker.LARGE_TABLE", 0)
    monkeypatch.setattr(neighbours, "_LARGE_TABLE", 0)
    monkeypatch.setattr(neighbours, "_MANY", 0)
    monkeypatch.setattr(boxes, "_MANY", 0)
    monkeypatch.setattr(boxes, "_VERY_MANY", 0)
    monkeypatch.setattr("mcaptrack.evaluation.aligned._PAIRS_AT_ONCE", 1)


TRACKERS = [Sort(), ByteTrack(), OcSort(), Sort(cost="pixels"), GroundTracker(class_names=((1, "person"),))]


def transformed(transform, frames) -> list[str]:
    return [repr(frame.rows.tolist()) for result in transform(frames) for frame in result]


SMALL = {
    **{f"{type(one).__name__} {one.cost}": (lambda one=one: transformed(one, crowd(60, 20)[0])) for one in TRACKERS},
    "Retrack": lambda: transformed(Retrack(predictor="cv"), crowd(40, 60)[1]),
    "scores": lambda: [scores(crowd(60, seed=1)[1], crowd(60, seed=2)[1], how) for how in ("iou", "metres")],
}


def scores(truth: list[Frame], tracks: list[Frame], similarity: str):
    compared = compare_rows(truth, tracks, similarity, 1.0 if similarity == "metres" else 0.3).matchup
    people = person_scores(truth, tracks, MatchRule(similarity, 1.0 if similarity == "metres" else 0.3))
    located = {name: np.round(values, 9).tolist() for name, values in hota(compared).items()}
    counts = [{k: round(v, 9) for k, v in clear(compared, rules).items()} for rules in ("trackeval", "motmetrics")]
    return located, counts, identity(compared), people.hits.sum(), people.matched.tolist(), people.switches.tolist()


@pytest.mark.parametrize("name", one_in(3, SMALL))
def test_results_are_the_same_with_and_without_tables_of_all_pairs(name, request):
    wanted = SMALL[name]()
    request.getfixturevalue("no_tables")
    assert SMALL[name]() == wanted


def all_scores(count: int) -> Callable[[], object]:
    truth, tracks = crowd(count, 2, seed=1)[1], crowd(count, 2, seed=2)[1]
    return lambda: scores(truth, tracks, "iou")


def whole(count: int) -> Callable[[], object]:
    boxes_px = np.random.default_rng(0).uniform([0, 0, 15, 40], [4000, 3000, 25, 60], (count, 4))
    return lambda: whole_people(boxes_px, np.zeros(count, np.int64), np.ones(count), 4000, 3000)


LARGE = {
    "whole people": whole,
    **{
        f"{type(one).__name__} {one.cost}": (lambda count, one=one: lambda: transformed(one, crowd(count, 3)[0]))
        for one in TRACKERS
    },
    "scores": all_scores,
}


@pytest.mark.parametrize("name", one_in(3, LARGE))
def test_twice_the_boxes_of_a_frame_take_twice_the_memory(name):
    """A table of 3000 x 3000 alone takes 72 MB, four times as much for twice the boxes."""
    LARGE[name](100)()  # what is imported, and made once
    short, long = (held(LARGE[name](count))[1] for count in (1500, 3000))
    assert long < 2.8 * short
    assert long < 60e6


def test_however_many_channels_are_dropped_each_chunk_is_opened_few_times(tmp_path, monkeypatch):
    with log.create(tmp_path / "a.mcap") as writer:
        ids = [writer.add_channel(f"/x/{n}", (f"S{n}", "jsonschema", b"{}"), "json", {}) for n in range(400)]
        for one in ids:
            writer.add_message(one, one, 0, b"{}")
    opened = []
    monkeypatch.setattr(
        sys.modules["mcaptrack.log.extend"], "open_chunk", lambda *a: opened.append(a) or chunks.open_chunk(*a)
    )
    found = mcaptrack.drop(tmp_path / "a.mcap", [f"/x/{n}" for n in range(0, 400, 4)], output=tmp_path / "b.mcap")
    assert len(found.dropped) == 100
    assert len(opened) <= 2 * len(log.Log(tmp_path / "a.mcap").index.chunks)
    assert mcaptrack.check(tmp_path / "b.mcap").is_sound
