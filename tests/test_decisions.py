"""Decisions of re-tracking: which there are, how likely they are said to be, and joins that are cut."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from mcaptrack import log
from mcaptrack.evaluation.events import lifecycle_of
from mcaptrack.schema import DecisionKind, EventKind, Frame
from mcaptrack.transforms import Retrack
from tests.commands import done
from tests.worlds import noisy_tracks, tracks_at

STEP_S = 0.4
QUICK = [Phase.explicit, Phase.generate]


def decided(frames: list[Frame], transform: Retrack | None = None) -> tuple[list[Frame], list[Frame]]:
    offline, _, _, decisions = (list(part) for part in zip(*(transform or Retrack())(frames), strict=True))
    return offline, decisions


def rows_of(frames: list[Frame]) -> np.ndarray:
    return np.concatenate([frame.rows for frame in frames])


def walking(path, ticks: int = 60) -> list[Frame]:
    """Frames of tracks: ``path(tick)`` gives positions by input id."""
    return [Frame(round(tick * STEP_S * 1e9), tick, tracks_at(path(tick))) for tick in range(ticks)]


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=6, phases=QUICK)
def test_joins_are_the_repairs_among_events_and_tracks_are_kept_or_left_out(seed):
    """Events are found in the tracks that were written; decisions come from the tracks before they are written."""
    frames = noisy_tracks(np.random.default_rng(seed), ticks=60)
    offline, decisions = decided(frames)
    assert [frame.t_ns for frame in decisions] == [frame.t_ns for frame in frames]
    by_kind = {
        kind: [(f.t_ns, row) for f in decisions for row in f.rows if row["kind"] == kind] for kind in DecisionKind
    }
    t_ns, events = lifecycle_of(offline).repairs()
    repairs = [(at, row) for at, row in zip(t_ns.tolist(), events, strict=True) if row["kind"] == EventKind.JOINED]
    wanted, found = (
        {(at, *(int(row[name]) for name in ("track_id", "previous_id", "source_id"))) for at, row in some}
        for some in (repairs, by_kind[DecisionKind.JOINED])
    )
    assert found == wanted
    kept = {int(row["track_id"]): row for _, row in by_kind[DecisionKind.KEPT]}
    written = rows_of(offline)
    assert set(kept) == set(written["track_id"].tolist())
    for name, row in kept.items():
        mine = written[(written["track_id"] == name) & (written["source_id"] >= 0)]
        assert row["frames"] == len(mine)
        assert row["source_id"] == np.bincount(mine["source_id"]).argmax()
    every = rows_of(decisions)
    assert ((every["probability"] >= 0) & (every["probability"] <= 1)).all()
    left_out = every[every["kind"] == DecisionKind.LEFT_OUT]
    assert (left_out["track_id"] == -1).all()
    assert (left_out["probability"] > 0.5).all()  # that it is no person


def test_the_alternative_is_the_neighbour_and_a_join_in_a_crowd_is_less_certain():
    def beside(tick: int, apart_m: float) -> dict:
        people = {1 if tick < 30 else 4: (0.5 * tick, 0.0), 2 if tick < 30 else 5: (0.5 * tick, apart_m)}
        return people if not 27 <= tick < 30 else {}

    likely = []
    for apart_m in (0.4, 8.0):
        _, decisions = decided(walking(lambda tick, far=apart_m: beside(tick, far)))
        found = [row for row in rows_of(decisions) if row["kind"] == DecisionKind.JOINED]
        assert {(int(row["previous_id"]), int(row["source_id"])) for row in found} == {(1, 4), (2, 5)}
        likely.append(min(float(row["probability"]) for row in found))
        if apart_m < 1:
            assert {(int(row["source_id"]), int(row["alternative_id"])) for row in found} == {(4, 5), (5, 4)}
        else:
            assert {int(row["alternative_id"]) for row in found} == {-1}
    assert likely[0] < likely[1]


def test_what_is_left_out_is_a_row_with_its_place_and_the_input_id():
    def scene(tick: int) -> dict:
        people = {1: (0.5 * tick, 0.0)}
        return people | ({7: (20.0 + tick % 3, 30.0)} if 20 <= tick < 27 else {})

    offline, decisions = decided(walking(scene))
    assert 7 not in rows_of(offline)["source_id"]
    (at,) = (frame for frame in decisions if DecisionKind.LEFT_OUT in frame.rows["kind"])
    (row,) = (one for one in at.rows if one["kind"] == DecisionKind.LEFT_OUT)
    assert at.index == 20
    assert (row["source_id"], row["frames"], row["x_m"], row["y_m"]) == (7, 7, 22.0, 30.0)
    assert row["duration_s"] == pytest.approx(6 * STEP_S)
    assert row["probability"] > 0.5  # that it is no person


def test_who_is_too_short_is_rather_no_person_however_straight_the_walk():
    """Eight people cross a scene of 24 s; each of twelve others is seen for 1.2 s, walking as straight."""

    def scene(tick: int) -> dict:
        people = {name: (0.5 * tick, 9.0 * name) for name in range(1, 9)}
        return people | {20 + k: (0.5 * tick - 40, 9.0 * k) for k in range(12) if 4 * k <= tick < 4 * k + 4}

    _, decisions = decided(walking(scene))
    rows = rows_of(decisions)
    short = rows[(rows["source_id"] >= 20) & (rows["kind"] != DecisionKind.JOINED)]
    assert len(short) == 12
    assert (short["kind"] == DecisionKind.LEFT_OUT).all()
    assert (short["probability"] > 0.5).all()


def test_decisions_do_not_outlive_the_method_that_made_them(template, tmp_path):
    path, topic = shutil.copy(template, tmp_path / "a.mcap"), "/camera/retracks/decisions"
    done("retrack", path, "-q")
    with log.read(path) as opened:
        assert topic in opened.channels
    said = done("retrack", path, "--profile", "paper").err
    assert f"{topic} is removed: retrack by consistency makes none" in said
    with log.read(path) as opened:
        assert topic not in opened.channels
    assert json.loads(done("run", path, "--no-tables", "--no-events", "--json").out)["results"][0]["stages"] == [
        "views"
    ]
    done("retrack", path, "-q")
    with log.read(path) as opened:
        assert topic in opened.channels
