"""Parts of the tracker in metres against plain algebra: covariances over both axes, association by them, and output."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.geometry.neighbours import Pairing
from mcaptrack.schema import Frame
from mcaptrack.transforms import ground as tracker
from mcaptrack.transforms.ground import Covariances, Waiting, _Apart, associate
from tests.worlds import ns

#: Of a state of x, its velocity and acceleration, then the same of y, the position.
SEEN = np.array([[1.0, 0, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0]])


def along_one_axis(rng: np.random.Generator, count: int) -> np.ndarray:
    """Covariances of one axis as six numbers each, (6, count)."""
    half = rng.normal(size=(count, 3, 3))
    full = half @ half.transpose(0, 2, 1)
    return full[:, *np.triu_indices(3)].T


def tables(rng: np.random.Generator, tracks: int, found: int) -> tuple[np.ndarray, np.ndarray]:
    """Tracks, and detections with covariances; one score isn't known."""
    table, rows = np.zeros((len(tracker.no_tracks()), tracks)), np.zeros((tracker.DETECTION_ROWS + 3, found))
    table[tracker.PLACE], rows[tracker.PLACE] = rng.uniform(0, 4, (2, tracks)), rng.uniform(0, 4, (2, found))
    table[tracker.NOISE], table[tracker.GATE_M] = rng.uniform(0.1, 0.4, tracks), rng.uniform(1.5, 4, tracks)
    table[tracker.MISSED_S] = rng.uniform(0, 1, tracks)
    rows[tracker.COVARIANCE] = [
        rng.uniform(0.1, 0.5, found),
        rng.uniform(-0.1, 0.1, found),
        rng.uniform(0.1, 0.5, found),
    ]
    rows[tracker.SCORE] = rng.choice([0.0, 0.3, 0.9, 1.0, np.nan], found)
    return table, rows


class TestAssociation:
    @pytest.mark.parametrize("seed", range(4))
    def test_distances_and_gains_are_those_of_both_covariances(self, seed: int):
        rng = np.random.default_rng(seed)
        table, rows = tables(rng, 4, 5)
        known = Covariances(along_one_axis(rng, 4))
        reach = rng.uniform(0.5, 4, 4)
        apart = _Apart(table, rows, known, Pairing(table[tracker.PLACE], rows[tracker.PLACE], reach))
        within, (k, n) = apart.within(4.0, reach), np.indices((4, 5)).reshape(2, -1)
        gain = apart.gain(np.ones((4, 5), bool), k, n).reshape(4, 5)
        for i, j in np.ndindex(4, 5):
            xx, xy, yy = rows[tracker.COVARIANCE, j]
            spread = SEEN @ known.values[i] @ SEEN.T + [[xx, xy], [xy, yy]] + table[tracker.NOISE, i] ** 2 * np.eye(2)
            off = rows[tracker.PLACE, j] - table[tracker.PLACE, i]
            squared = off @ np.linalg.inv(spread) @ off
            assert within[i, j] == (squared <= 4 and np.linalg.norm(off) <= reach[i])
            score = rows[tracker.SCORE, j]
            share = 0.5 if np.isnan(score) else min(max(score, 0.02), 0.98)
            odds = 2 * np.log(share / (1 - share))
            assert gain[i, j] == pytest.approx(30 - squared - np.log(np.linalg.det(spread)) + odds)

    def test_without_covariances_both_axes_have_the_variance_of_the_track(self):
        rng = np.random.default_rng(7)
        table, rows = tables(rng, 3, 4)
        table[tracker.PLACE], rows[tracker.PLACE] = 0.0, np.arange(8).reshape(2, 4) / 4
        spread = tracker.variance(table)
        np.testing.assert_allclose(spread, table[tracker._PP] + table[tracker.NOISE] ** 2)
        reach = np.array([1.2, 0.7, 9.0])
        apart = _Apart(table, rows, None, Pairing(table[tracker.PLACE], rows[tracker.PLACE], reach))
        for i, j in np.ndindex(3, 4):
            squared = (rows[tracker.PLACE, j] ** 2).sum()
            assert apart.within(9.0, reach)[i, j] == (squared <= 9.0 * spread[i] and squared <= reach[i] ** 2)
            which = np.zeros((3, 4), bool)
            which[i, j] = True
            (gain,) = apart.gain(which, np.array([i]), np.array([j]))
            assert gain == pytest.approx(30 - squared / spread[i] - 2 * np.log(spread[i]))

    def test_nothing_is_associated_with_nothing(self):
        table, rows = np.zeros((len(tracker.no_tracks()), 2)), np.zeros((tracker.DETECTION_ROWS, 3))
        for pair in ((table[:, :0], rows), (table, rows[:, :0])):
            assert [len(part) for part in associate(*pair, "metres", 0.1, across_classes=False)] == [0, 0, 0]


#: Noise, velocity's variance, the gate, time without a detection, hits, class of the detection (the track's is 2), its x
#: in metres; whether they are associated.
GATES = [
    (0.1, 0, 2, 0, 9, 2, 0.39, True),  # 4 standard deviations of 0.1 m
    (0.1, 0, 2, 0, 9, 2, 0.41, False),
    (0.1, 0, 2, 0, 2, 3, 0.29, True),  # 3 between classes
    (0.1, 0, 2, 0, 9, 3, 0.31, False),
    (0.1, 0, 2, 0, 1, 3, 0.29, False),  # too new to be another class
    (0.3, 4, 5, 0, 5, 3, 1.99, True),  # two fifths of the gate in metres between classes
    (0.3, 4, 5, 0, 5, 3, 2.01, False),
    (0.3, 4, 5, 1, 5, 3, 3.99, True),
    (0.3, 4, 5, 1, 5, 3, 4.01, False),
    (0.3, 4, 1, 0, 5, 3, 0.89, True),  # but three times the noise
    (0.3, 4, 1, 0, 5, 3, 0.91, False),
    (5, 0, 1, 0, 5, 2, 0.99, True),
    (5, 0, 1, 0, 5, 2, 1.01, False),
    (5, 0, 1, 1, 5, 2, 1.99, True),  # it grows with the time without a detection
    (5, 0, 1, 1, 5, 2, 2.01, False),
]


def test_gates_at_their_ends():
    for case in GATES:
        noise, variance, gate_m, missed_s, hits, kind, x, is_near = case
        table, rows = np.zeros((len(tracker.no_tracks()), 1)), np.zeros((tracker.DETECTION_ROWS, 1))
        table[tracker.NOISE], table[tracker._PP], table[tracker.GATE_M] = noise, variance, gate_m
        table[tracker.MISSED_S], table[tracker.HITS], table[tracker.CLASS] = missed_s, hits, 2
        rows[tracker.X], rows[tracker.CLASS] = x, kind
        found = associate(table, rows, "metres", 0.1, across_classes=False)
        wanted = [(0, 0, kind == 2)] * is_near
        assert [*zip(*(part.tolist() for part in found), strict=True)] == wanted, case
        if variance == 0 and noise == 0.1:
            assert associate(table, rows, "metres", 0.1, across_classes=True)[2].tolist() == [True] * (x < 0.4), case


def tracks(**columns: list[float]) -> np.ndarray:
    table = np.zeros((len(tracker.no_tracks()), len(next(iter(columns.values())))))
    for name, values in columns.items():
        table[getattr(tracker, name.upper())] = values
    return table


@pytest.mark.parametrize("is_written_at_once", [True, False])
def test_gaps_are_interpolated_in_frames_that_wait(is_written_at_once):
    """Lost after the first frame, found in the fourth, 2 s later; the first of the two between is written already."""
    waiting = Waiting()
    times_s = (0.0, 0.5, 1.5, 2.0)
    for number, t_s in enumerate(times_s[:3]):
        waiting.add(Frame(ns(t_s), number, np.empty(0)), tracks(id=[1, 256] if number == 0 else [256]))
    before = tracks(id=[1, 256], last_frame=[0, 2], missed_s=[2.0, 0.5], vx=[2.0, 0.0], vy=[0.0, 1.0])
    after = tracks(id=[1, 256], x=[8.0, 0.0], heading=[-3.0, 0.0], length=[5.0, 0.0], vx=[4.0, 0.0], vy=[-1.0, 1.0])
    before[tracker.LAST.start + tracker.HEADING, 0] = 3.0  # by less than half a turn, over the back
    before[tracker.LAST.start + tracker.LENGTH, 0] = 3.0
    waiting.confirm(np.array([1.0, 256.0]), np.array([1.0, 2.0]))
    waiting.release(ns(0.5))
    written = waiting.written() if is_written_at_once else []
    waiting.close_gaps(before, after, 3, ns(2.0))
    waiting.add(Frame(ns(2.0), 3, np.empty(0)), after)
    waiting.release(np.inf)
    frames = [*written, *waiting.written()]
    assert [frame.rows["track_id"].tolist() for frame in frames] == [[1, 2], [2], [1, 2], [1, 2]]
    row = frames[2].rows[0]  # three quarters of the way
    assert (row["observed"], row["source_id"], row["x_m"], row["length_m"]) == (False, -1, 6.0, 4.5)
    assert np.isnan(row["score"])
    assert row["heading_rad"] == pytest.approx(-3.0 - (2 * np.pi - 6) / 4)
    assert (row["vx_m_per_s"], row["vy_m_per_s"]) == (3.5, -0.75)
    assert frames[2].rows["observed"].tolist() == [False, True]
