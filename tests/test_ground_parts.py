"""Parts of the tracker in metres against plain algebra: covariances over both axes, association by them, and output."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.geometry.neighbours import Pairing
from mcaptrack.schema import Frame
from mcaptrack.transforms.ground import state
from mcaptrack.transforms.ground.output import Waiting
from mcaptrack.transforms.ground.state import Covariances, along_axes
from mcaptrack.transforms.ground.tracker import _Apart, associate
from tests.worlds import ns

#: Of a state of x, its velocity and acceleration, then the same of y, the position.
SEEN = np.array([[1.0, 0, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0]])


def along_one_axis(rng: np.random.Generator, count: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Covariances of one axis as six numbers each, (6, count), and as matrices."""
    half = rng.normal(size=(count, 3, 3))
    full = half @ half.transpose(0, 2, 1)
    return np.array([[one[i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))] for one in full]).T, [
        *full
    ]


def both_axes(one: np.ndarray) -> np.ndarray:
    return np.block([[one, np.zeros((3, 3))], [np.zeros((3, 3)), one]])


class TestCovariances:
    def test_prediction_and_correction_are_those_of_a_kalman_filter(self):
        rng = np.random.default_rng(2)
        numbers, full = along_one_axis(rng, 3)
        found = Covariances(numbers)
        more, others = along_one_axis(rng, 2)
        noise = np.array([[0.4, 0.1, 0.3], [0.2, -0.05, 0.6]])
        found.add(more, noise)
        wanted = [both_axes(one) for one in (*full, *others)]
        for own, (xx, xy, yy) in zip(wanted[3:], noise, strict=True):
            own[0, 0], own[3, 3], own[0, 3], own[3, 0] = xx, yy, xy, xy
        np.testing.assert_allclose(found.values, wanted)
        np.testing.assert_allclose(found.places().T, [(one[0, 0], one[0, 3], one[3, 3]) for one in wanted])

        transition, drift = rng.normal(size=(3, 3)), along_one_axis(rng, 5)[1]
        found.predict(transition, np.array(drift))
        step = both_axes(transition)
        wanted = [step @ one @ step.T + both_axes(own) for one, own in zip(wanted, drift, strict=True)]
        np.testing.assert_allclose(found.values, wanted)
        means = [(one[:3, :3] + one[3:, 3:]) / 2 for one in wanted]
        upper = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
        np.testing.assert_allclose(found.means().T, [[one[at] for at in upper] for one in means])

        track, noise = np.array([4, 1]), np.array([[0.5, 0.2, 0.4], [0.3, -0.1, 0.2]])
        gain = found.correct(track, noise)
        for at, (xx, xy, yy), own in zip(track, noise, gain, strict=True):
            spread = np.array([[xx, xy], [xy, yy]])
            right = wanted[at] @ SEEN.T @ np.linalg.inv(SEEN @ wanted[at] @ SEEN.T + spread)
            np.testing.assert_allclose(own, right)
            keep = np.eye(6) - right @ SEEN  # the form of Joseph, which holds for any gain
            wanted[at] = keep @ wanted[at] @ keep.T + right @ spread @ right.T
        np.testing.assert_allclose(found.values, wanted, atol=1e-9)
        np.testing.assert_array_equal(found.values[track], found.values[track].transpose(0, 2, 1))

        off = rng.normal(size=(2, 2))
        moved = np.array([own @ one for own, one in zip(gain, off.T, strict=True)])
        places, velocities, accelerations = along_axes(gain, off)
        np.testing.assert_allclose(places.T, moved[:, [0, 3]])
        np.testing.assert_allclose(velocities.T, moved[:, [1, 4]])
        np.testing.assert_allclose(accelerations.T, moved[:, [2, 5]])


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
        known = Covariances(along_one_axis(rng, 4)[0])
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

    @pytest.mark.parametrize(
        ("x", "missed_s", "hits", "kind", "pairs"),
        [
            (0.39, 0.0, 9, 2, [(0, 0, True)]),  # 4 standard deviations of 0.1 m
            (0.41, 0.0, 9, 2, []),
            (0.29, 0.0, 9, 3, [(0, 0, False)]),  # 3 between classes
            (0.31, 0.0, 9, 3, []),
            (0.29, 0.0, 2, 3, [(0, 0, False)]),
            (0.29, 0.0, 1, 3, []),  # too new to be another class
        ],
    )
    def test_gates_at_their_ends(self, x, missed_s, hits, kind, pairs):
        table, rows = np.zeros((len(state.no_tracks()), 1)), np.zeros((state.DETECTION_ROWS, 1))
        table[state.NOISE], table[state.GATE_M], table[state.CLASS] = 0.1, 2.0, 2
        table[state.MISSED_S], table[state.HITS] = missed_s, hits
        rows[state.X], rows[state.CLASS] = x, kind
        found = associate(table, rows, "metres", 0.1, across_classes=False)
        assert [*zip(*(part.tolist() for part in found), strict=True)] == pairs
        track, _, is_same = associate(table, rows, "metres", 0.1, across_classes=True)
        assert is_same.tolist() == [True] * len(track) == [True] * (x < 0.4)

    @pytest.mark.parametrize(
        ("gate_m", "missed_s", "x", "is_near"),
        [
            (5.0, 0.0, 1.99, 1),  # two fifths of the gate between classes
            (5.0, 0.0, 2.01, 0),
            (5.0, 1.0, 3.99, 1),
            (5.0, 1.0, 4.01, 0),
            (1.0, 0.0, 0.89, 1),  # but three times the noise
            (1.0, 0.0, 0.91, 0),
        ],
    )
    def test_the_gate_in_metres_is_smaller_between_classes(self, gate_m, missed_s, x, is_near):
        table, rows = np.zeros((len(state.no_tracks()), 1)), np.zeros((state.DETECTION_ROWS, 1))
        table[state._PP], table[state.NOISE], table[state.GATE_M], table[state.HITS] = 4.0, 0.3, gate_m, 5
        table[state.CLASS], table[state.MISSED_S], rows[state.X], rows[state.CLASS] = 2, missed_s, x, 3
        assert len(associate(table, rows, "metres", 0.1, across_classes=False)[0]) == is_near

    def test_nothing_is_associated_with_nothing(self):
        table, rows = np.zeros((len(state.no_tracks()), 2)), np.zeros((state.DETECTION_ROWS, 3))
        for pair in ((table[:, :0], rows), (table, rows[:, :0])):
            assert [len(part) for part in associate(*pair, "metres", 0.1, across_classes=False)] == [0, 0, 0]

    @pytest.mark.parametrize(
        ("missed_s", "x", "is_near"), [(0.0, 0.99, 1), (0.0, 1.01, 0), (1.0, 1.99, 1), (1.0, 2.01, 0)]
    )
    def test_the_gate_in_metres_grows_with_the_time_without_a_detection(self, missed_s, x, is_near):
        table, rows = np.zeros((len(state.no_tracks()), 1)), np.zeros((state.DETECTION_ROWS, 1))
        table[state.NOISE], table[state.GATE_M], table[state.MISSED_S], rows[state.X] = 5.0, 1.0, missed_s, x
        assert len(associate(table, rows, "metres", 0.1, across_classes=False)[0]) == is_near


class TestWaiting:
    @staticmethod
    def tracks(**columns: list[float]) -> np.ndarray:
        names = {name.upper(): values for name, values in columns.items()}
        table = np.zeros((len(state.no_tracks()), len(next(iter(columns.values())))))
        for name, values in names.items():
            table[getattr(state, name)] = values
        return table

    def test_rows_are_written_once_their_track_is_confirmed_under_its_id(self):
        waiting = Waiting()
        for number, ids in enumerate(([1, 300], [300, 2], [2])):
            waiting.add(Frame(ns(number), number + 5, np.empty(0)), self.tracks(id=ids, x=[float(one) for one in ids]))
        waiting.confirm(np.array([300.0, 2.0]), np.array([7.0, 8.0]))
        waiting.confirm(np.empty(0), np.empty(0))
        waiting.release(ns(1))
        early = waiting.written()
        assert [frame.index for frame in early] == [5, 6]
        assert waiting.written() == []
        waiting.release(np.inf)
        late = waiting.written()
        assert [frame.index for frame in late] == [7]
        waiting.release(np.inf)
        assert waiting.written() == []
        frames = [*early, *late]
        assert [(frame.t_ns, frame.index) for frame in frames] == [(ns(n), n + 5) for n in range(3)]
        assert [frame.rows["track_id"].tolist() for frame in frames] == [[7], [7, 8], [8]]
        assert [frame.rows["x_m"].tolist() for frame in frames] == [[300.0], [300.0, 2.0], [2.0]]
        assert all(frame.rows["observed"].all() for frame in frames)

    @pytest.mark.parametrize("is_written_at_once", [True, False])
    def test_a_track_that_is_confirmed_later_has_no_row_in_what_was_released(self, is_written_at_once):
        """However many frames are written at once. Another id is beyond those that were ever confirmed."""
        waiting, frames = Waiting(), []
        for number in range(4):
            waiting.add(Frame(ns(number), number, np.empty(0)), self.tracks(id=[1, 900]))
            if number == 2:
                waiting.confirm(np.array([1.0, 255.0]), np.array([4.0, 5.0]))
            waiting.release(ns(number - 1))
            frames += waiting.written() if is_written_at_once else []
        waiting.release(np.inf)
        frames += waiting.written()
        assert [(frame.index, frame.rows["track_id"].tolist()) for frame in frames] == [
            (0, []), (1, [4]), (2, [4]), (3, [4]),
        ]  # fmt: skip

    @pytest.mark.parametrize("is_written_at_once", [True, False])
    def test_gaps_are_interpolated_in_frames_that_wait(self, is_written_at_once):
        """Lost after the first frame, found in the fourth, 2 s later; the first of the two between is written already."""
        waiting = Waiting()
        times_s = (0.0, 0.5, 1.5, 2.0)
        for number, t_s in enumerate(times_s[:3]):
            waiting.add(Frame(ns(t_s), number, np.empty(0)), self.tracks(id=[1, 2] if number == 0 else [2]))
        before = self.tracks(id=[1, 2], last_frame=[0, 2], missed_s=[2.0, 0.5], vx=[2.0, 0.0], vy=[0.0, 1.0])
        after = self.tracks(
            id=[1, 2], x=[8.0, 0.0], heading=[-3.0, 0.0], length=[5.0, 0.0], vx=[4.0, 0.0], vy=[-1.0, 1.0]
        )
        before[state.LAST.start + state.HEADING, 0] = 3.0  # by less than half a turn, over the back
        before[state.LAST.start + state.LENGTH, 0] = 3.0
        waiting.confirm(np.array([1.0, 2.0]), np.array([1.0, 2.0]))
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
        waiting.close_gaps(before[:, 1:], after[:, 1:], 3, ns(2.0))  # nothing is missing
