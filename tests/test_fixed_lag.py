"""Tracks of detections with covariances, whose associations wait for what comes after them."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.schema import DETECTIONS, Frame
from mcaptrack.transforms import GroundTracker
from mcaptrack.transforms.fixed_lag import _log_density, _States

NAMES = ((1, "person"),)
NS = 1_000_000_000


def joint(t_s: np.ndarray, noise: np.ndarray, drift: float, speed: float) -> np.ndarray:
    """The covariance (2T, 2T) of positions at rising times (T,) of who begins at 0 with a normal velocity, measured with
    noise (T, 2, 2): of a velocity that is a random walk, by its integral.
    """
    passed = t_s - t_s[0]
    low, high = np.minimum(passed, passed[:, None]), np.maximum(passed, passed[:, None])
    moved = speed**2 * passed * passed[:, None] + drift**2 * (low**2 * high / 2 - low**3 / 6)
    out = np.kron(moved, np.eye(2))
    for number, part in enumerate(noise):
        out[2 * number : 2 * number + 2, 2 * number : 2 * number + 2] += part
    return out


def likely(t_s: np.ndarray, xy_m: np.ndarray, noise: np.ndarray, drift: float, speed: float) -> float:
    """The log likelihood of places (T, 2), of which the first may be anywhere."""
    cov = joint(t_s, noise, drift, speed) + 1e4 * np.kron(np.ones((len(t_s), len(t_s))), np.eye(2))
    return float(_log_density(xy_m.reshape(1, -1), cov[None])[0])


def filtered(t_s: np.ndarray, xy_m: np.ndarray, noise: np.ndarray, drift: float, speed: float) -> _States:
    states = _States.of(xy_m[:1], noise[:1], np.array([speed]))
    for number in range(1, len(t_s)):
        after = states.after(np.array([0]), np.diff(t_s)[number - 1 : number], np.array([drift]))
        states, _ = after.corrected(xy_m[number : number + 1], noise[number : number + 1])
    return states


@pytest.mark.parametrize("seed", range(4))
def test_how_well_a_past_fits_a_future_is_the_likelihood_of_both_as_one_track(seed: int):
    """By how much one past is better than another, against normal distributions of all places of a track at once."""
    rng = np.random.default_rng(seed)
    drift, speed = 0.4, 1.5
    t_s = np.cumsum(rng.uniform(0.2, 0.7, 8))
    half = rng.normal(0, 0.1, (8, 2, 2))
    noise = half @ np.swapaxes(half, 1, 2) + 0.02 * np.eye(2)
    future = rng.normal(0, 0.5, (4, 2))
    found, expected = [], []
    behind = filtered(t_s[:3:-1], future[::-1], noise[:3:-1], drift, 1e3)
    for _ in range(2):
        past = rng.normal(0, 0.5, (4, 2))
        ahead = filtered(t_s[:4], past, noise[:4], drift, speed).after(
            np.array([0]), t_s[4:5] - t_s[3:4], np.array([drift])
        )
        found.append(float(_log_density(ahead.mean - behind.mean, ahead.cov + behind.cov)[0]))
        both = likely(t_s, np.concatenate([past, future]), noise, drift, speed)
        expected.append(both - likely(t_s[:4], past, noise[:4], drift, speed))
    assert found[1] - found[0] == pytest.approx(expected[1] - expected[0], abs=0.01)


def crossing(seed: int) -> tuple[list[Frame], np.ndarray]:
    """Two people who walk through each other at a small angle, missed now and then; their places (T, 2, 2)."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(24) / 2
    side = rng.uniform(0.15, 0.3)
    walk = np.stack([np.stack([1.2 * t_s, sign * side * (t_s - 6)], axis=-1) for sign in (1, -1)], axis=1)
    frames = []
    for number, now in enumerate(walk):
        at = (now + rng.normal(0, 0.12, (2, 2)))[rng.random(2) > 0.15]
        cov = {"cov_xx_m2": 0.02, "cov_xy_m2": 0.0, "cov_yy_m2": 0.02, "score": 0.95, "class_id": 1}
        columns = {name: np.full(len(at), value) for name, value in cov.items()}
        rows = DETECTIONS.rows(x_m=at[:, 0], y_m=at[:, 1], **columns) if len(at) else DETECTIONS.empty()
        frames.append(Frame(number * NS // 2, number, rows))
    return frames, walk


def exchanged(seed: int, delay_s: float) -> bool:
    """Whether the two have not the same ids after they met as before."""
    frames, walk = crossing(seed)
    tracker = GroundTracker(class_names=NAMES, delay_s=delay_s, class_limits="person=:0.4::1.2", confirm_score=1.0)
    rows = [frame.rows for (frame,) in tracker(frames)]
    ids = []
    for number in (5, 20):
        for place in walk[number]:
            away = np.hypot(rows[number]["x_m"] - place[0], rows[number]["y_m"] - place[1])
            ids.append(rows[number]["track_id"][away.argmin()] if len(away) and away.min() < 0.8 else -1)
    return ids[:2] != ids[2:]


def test_people_who_meet_are_told_apart_by_where_they_go_then():
    late, at_once = (sum(exchanged(seed, delay_s) for seed in range(12)) for delay_s in (4.0, 0.0))
    assert late <= 2
    assert late < at_once / 2
