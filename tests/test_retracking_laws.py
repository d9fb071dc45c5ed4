"""Symmetries of re-tracking: positions, times, ids and distant people don't change the tracks of a crowd."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import DecisionKind, Frame, Rows
from mcaptrack.transforms import PROFILES, RetrackByConsistency
from mcaptrack.transforms.retrack import Retracking, likelihood
from tests.tiers import one_in
from tests.worlds import assert_same_rows, noisy_tracks, ns, places, walk

SEEDS = st.integers(0, 2**32 - 1)
#: "now" compares predictions of the current step, which the other distances of Algorithm 1 don't.
METHODS = dict(PROFILES) | {"now": RetrackByConsistency(distance="now", noise_m=0.3)}
every_method = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)


def outputs(method: Retracking, frames: list[Frame]) -> list[Rows]:
    """The rows of offline tracks, online tracks, predictions and decisions."""
    return [np.concatenate([frame.rows for frame in part]) for part in zip(*method(frames), strict=True)]


def same(found: Rows, wanted: Rows, **changed: np.ndarray) -> None:
    """Compare rows: equal but for the columns ``changed``, positions to a micrometre."""
    for name in found.dtype.names:
        values = changed.get(name, wanted[name])
        np.testing.assert_allclose(found[name], values, rtol=1e-6, atol=1e-6, err_msg=name)


def moved(frames: list[Frame], turn: np.ndarray, shift: np.ndarray) -> list[Frame]:
    out = []
    for frame in frames:
        rows = frame.rows.copy()
        xy = np.stack([rows["x_m"], rows["y_m"]], axis=-1) @ turn.T + shift
        rows["x_m"], rows["y_m"] = xy.T
        out.append(frame._replace(rows=rows))
    return out


@every_method
@given(seed=SEEDS, angle=st.floats(0, 7))
@settings(max_examples=2)
def test_tracks_move_and_turn_with_the_world(method, seed, angle):
    rng = np.random.default_rng(seed)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shift = rng.uniform(-100, 100, 2)
    method = replace(method, track_confidence=0.0)  # the extent of a path is measured along the axes
    frames = noisy_tracks(rng, ticks=40, hidden=0.03)
    for found, wanted in zip(outputs(method, moved(frames, turn, shift)), outputs(method, frames), strict=True):
        x_m, y_m = (np.stack([wanted["x_m"], wanted["y_m"]], axis=-1) @ turn.T + shift).T
        changed = {"x_m": x_m, "y_m": y_m}
        if "cov_xx_m2" in wanted.dtype.names:  # linear predictors have round ellipses
            np.testing.assert_array_equal(wanted["cov_xy_m2"], 0)
        if "probability" in wanted.dtype.names:
            joined = wanted["kind"] == DecisionKind.JOINED
            changed["probability"] = np.where(joined, wanted["probability"], found["probability"])
        same(found, wanted, **changed)


@every_method
@given(seed=SEEDS)
@settings(max_examples=2)
def test_later_times_and_larger_ids_give_the_same_tracks(method, seed):
    frames = noisy_tracks(np.random.default_rng(seed), ticks=40, hidden=0.03)
    later = []
    for frame in frames:
        rows = frame.rows.copy()
        rows["track_id"] += 1000
        later.append(Frame(frame.t_ns + ns(86400.0), frame.index + 7, rows))
    for found, wanted in zip(outputs(method, later), outputs(method, frames), strict=True):
        changed = {}
        for name in {"source_id", "previous_id", "alternative_id"} & set(wanted.dtype.names):
            changed[name] = np.where(wanted[name] >= 0, wanted[name] + 1000, -1)
        same(found, wanted, **changed)


@pytest.mark.parametrize("steps", [1, 3])
def test_rows_do_not_depend_on_how_many_steps_are_written_at_once(steps, monkeypatch):
    """Also of tracks that coast from one part to the next."""
    frames = noisy_tracks(np.random.default_rng(5), ticks=40, hidden=0.2)
    wanted = outputs(PROFILES["default"], frames)
    monkeypatch.setattr(likelihood, "_STEPS", steps)
    for found, rows in zip(outputs(PROFILES["default"], frames), wanted, strict=True):
        same(found, rows)
    assert not wanted[1]["observed"].all()


def standing(first: list[tuple[float, float]], then: list[tuple[float, float]], gap: range, ticks: int) -> list[Frame]:
    """People stand, are occluded for a while, and then stand elsewhere under new ids."""

    def path(tick: int):
        if tick in gap:
            return {}
        here = first if tick < gap.start else then
        return {k + (10 if tick >= gap.stop else 0): place for k, place in enumerate(here)}

    return walk(path, ticks)


TIES = {
    # The corners of a square: which track went left and which right is ambiguous.
    "online": (standing([(1.3, 2.4), (1.3, 1.0)], [(2.0, 1.7), (0.6, 1.7)], range(12, 13), 30), {"gate_m": None}),
    "link": (
        standing([(1.3, 2.1), (1.3, 1.3)], [(1.7, 1.7), (0.9, 1.7)], range(20, 28), 60),
        {"max_age_s": 0.8, "link_s": 20.0},
    ),
}


@every_method
@pytest.mark.parametrize("tie", one_in(2, TIES))
def test_the_last_digits_of_positions_change_no_assignment(method, tie):
    """The last digits of predictions and sums differ between machines and with the size of the batch."""
    frames, options = TIES[tie]
    own = {option.name for option in fields(method)}
    method = replace(method, track_confidence=0.0, **{name: v for name, v in options.items() if name in own})
    wanted = [sorted(places(frame).items()) for frame, *_ in method(frames)]
    assert len({who for frame in wanted for who, _ in frame}) == 2  # both tracks continue
    for seed in range(6):
        rng = np.random.default_rng(seed)
        shaken = []
        for frame in frames:
            rows = frame.rows.copy()
            rows["x_m"] += rng.uniform(-1e-12, 1e-12, len(rows))
            rows["y_m"] += rng.uniform(-1e-12, 1e-12, len(rows))
            shaken.append(frame._replace(rows=rows))
        assert [sorted(places(frame).items()) for frame, *_ in method(shaken)] == wanted


@every_method
def test_boxes_move_by_the_plane_of_their_time(method):
    """Where the ground plane changes, rows before are as with the first plane alone, rows after as with the second."""
    frames = noisy_tracks(np.random.default_rng(3), ticks=40, hidden=0.03)
    change = frames[20].t_ns
    first, second = (GroundPlane((scale, 0, 0, 0, scale, 0, 0, 0, 1), 640, 480) for scale in (0.05, 0.02))
    method = replace(method, smooth=True, track_confidence=0.0)
    before, after, both = (
        list(replace(method, ground_planes=planes)(frames))
        for planes in (((0, first),), ((0, second),), ((0, first), (change, second)))
    )
    assert any((a.rows["x_px"] != b.rows["x_px"]).any() for (a, *_), (b, *_) in zip(before, after, strict=True))
    for frame, earlier, later, found in zip(frames, before, after, both, strict=True):
        for one, wanted in zip(found, later if frame.t_ns >= change else earlier, strict=True):
            assert_same_rows(one.rows, wanted.rows)


def test_noise_and_speed_are_never_taken_for_less_than_a_millimetre():
    frames = noisy_tracks(np.random.default_rng(4), ticks=40)
    none, least = (replace(PROFILES["default"], noise_m=least, speed_m_per_s=least) for least in (0.0, 1e-3))
    for found, wanted in zip(outputs(none, frames), outputs(least, frames), strict=True):
        assert_same_rows(found, wanted)
