"""Parts of the tracker in metres against plain algebra: covariances over both axes, association by them, and output."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.geometry.neighbours import Pairing
from mcaptrack.transforms.ground import state
from mcaptrack.transforms.ground.state import Covariances
from mcaptrack.transforms.ground.tracker import _Apart, associate

#: Of a state of x, its velocity and acceleration, then the same of y, the position.
SEEN = np.array([[1.0, 0, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0]])


def along_one_axis(rng: np.random.Generator, count: int) -> np.ndarray:
    """Covariances of one axis as six numbers each, (6, count)."""
    half = rng.normal(size=(count, 3, 3))
    full = half @ half.transpose(0, 2, 1)
    return full[:, *np.triu_indices(3)].T


def tables(rng: np.random.Generator, tracks: int, found: int) -> tuple[np.ndarray, np.ndarray]:
    """Tracks, and detections with covariances; one score isn't known."""
    table, rows = np.zeros((len(state.no_tracks()), tracks)), np.zeros((state.DETECTION_ROWS + 3, found))
    table[state.PLACE], rows[state.PLACE] = rng.uniform(0, 4, (2, tracks)), rng.uniform(0, 4, (2, found))
    table[state.NOISE], table[state.GATE_M] = rng.uniform(0.1, 0.4, tracks), rng.uniform(1.5, 4, tracks)
    table[state.MISSED_S] = rng.uniform(0, 1, tracks)
    rows[state.COVARIANCE] = [rng.uniform(0.1, 0.5, found), rng.uniform(-0.1, 0.1, found), rng.uniform(0.1, 0.5, found)]
    rows[state.SCORE] = rng.choice([0.0, 0.3, 0.9, 1.0, np.nan], found)
    return table, rows


class TestAssociation:
    @pytest.mark.parametrize("seed", range(4))
    def test_distances_and_gains_are_those_of_both_covariances(self, seed: int):
        rng = np.random.default_rng(seed)
        table, rows = tables(rng, 4, 5)
        known = Covariances(along_one_axis(rng, 4))
        reach = rng.uniform(0.5, 4, 4)
        apart = _Apart(table, rows, known, Pairing(table[state.PLACE], rows[state.PLACE], reach))
        within, (k, n) = apart.within(4.0, reach), np.indices((4, 5)).reshape(2, -1)
        gain = apart.gain(np.ones((4, 5), bool), k, n).reshape(4, 5)
        for i, j in np.ndindex(4, 5):
            xx, xy, yy = rows[state.COVARIANCE, j]
            spread = SEEN @ known.values[i] @ SEEN.T + [[xx, xy], [xy, yy]] + table[state.NOISE, i] ** 2 * np.eye(2)
            off = rows[state.PLACE, j] - table[state.PLACE, i]
            squared = off @ np.linalg.inv(spread) @ off
            assert within[i, j] == (squared <= 4 and np.linalg.norm(off) <= reach[i])
            score = rows[state.SCORE, j]
            share = 0.5 if np.isnan(score) else min(max(score, 0.02), 0.98)
            odds = 2 * np.log(share / (1 - share))
            assert gain[i, j] == pytest.approx(30 - squared - np.log(np.linalg.det(spread)) + odds)

    def test_without_covariances_both_axes_have_the_variance_of_the_track(self):
        rng = np.random.default_rng(7)
        table, rows = tables(rng, 3, 4)
        table[state.PLACE], rows[state.PLACE] = 0.0, np.arange(8).reshape(2, 4) / 4
        spread = state.variance(table)
        np.testing.assert_allclose(spread, table[state._PP] + table[state.NOISE] ** 2)
        reach = np.array([1.2, 0.7, 9.0])
        apart = _Apart(table, rows, None, Pairing(table[state.PLACE], rows[state.PLACE], reach))
        for i, j in np.ndindex(3, 4):
            squared = (rows[state.PLACE, j] ** 2).sum()
            assert apart.within(9.0, reach)[i, j] == (squared <= 9.0 * spread[i] and squared <= reach[i] ** 2)
            which = np.zeros((3, 4), bool)
            which[i, j] = True
            (gain,) = apart.gain(which, np.array([i]), np.array([j]))
            assert gain == pytest.approx(30 - squared / spread[i] - 2 * np.log(spread[i]))

    def test_nothing_is_associated_with_nothing(self):
        table, rows = np.zeros((len(state.no_tracks()), 2)), np.zeros((state.DETECTION_ROWS, 3))
        for pair in ((table[:, :0], rows), (table, rows[:, :0])):
            assert [len(part) for part in associate(*pair, "metres", 0.1, across_classes=False)] == [0, 0, 0]
