"""Boxes, the ground plane, assignment, clocks, filters and histories."""

from __future__ import annotations

import itertools
import math
from itertools import groupby

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry import kalman
from mcaptrack.geometry.assignment import assign, max_weight_matching
from mcaptrack.geometry.boxes import (
    bev_corners,
    bev_intersection_of_pairs,
    bev_iou_of_pairs,
    iou,
    iou_3d_of_pairs,
    overlapping,
)
from mcaptrack.geometry.clocks import FrameClock, seconds_to_ns
from mcaptrack.geometry.histories import fill_gaps
from mcaptrack.geometry.neighbours import near_pairs
from mcaptrack.geometry.pinhole import Lens, ground_homography, project
from mcaptrack.geometry.plane import GroundPlane, assumed_plane, plane_at
from mcaptrack.geometry.ragged import group_index, ragged_range, run_ends, run_starts
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.resampling import is_observed_at, resample
from mcaptrack.sources.demo import demo_scene
from tests.worlds import tracks_at

BOXES = hnp.arrays(float, st.tuples(st.integers(0, 5), st.just(4)), elements=st.floats(0.5, 100))


def test_overlap_of_boxes_by_hand():
    a = np.array([[0, 0, 2, 2], [0, 0, 4, 4.0]])
    b = np.array([[1, 1, 2, 2], [10, 10, 1, 1], [0, 0, 2, 2], [5, 5, 0, 0.0]])
    np.testing.assert_allclose(iou(a, b), [[1 / 7, 0, 1, 0], [4 / 16, 0, 4 / 16, 0]])


@given(BOXES, BOXES)
def test_overlap_is_symmetric_and_between_nothing_and_all(a, b):
    np.testing.assert_allclose(iou(a, b), iou(b, a).T)
    assert ((iou(a, b) >= 0) & (iou(a, b) <= 1 + 1e-12)).all()
    np.testing.assert_allclose(np.diag(iou(a, a)), 1)


class TestGroundPlane:
    oblique = demo_scene().ground_plane()

    @given(hnp.arrays(float, (5, 2), elements=st.floats(-4, 4)))
    def test_there_and_back(self, offsets):
        places = offsets + [0, 12]
        np.testing.assert_allclose(
            self.oblique.pixels_to_metres(self.oblique.metres_to_pixels(places)), places, atol=1e-6
        )

    def test_there_is_no_ground_above_the_horizon_and_none_behind_the_camera(self):
        assert np.isnan(self.oblique.pixels_to_metres(np.array([[480.0, -400.0]]))).all()
        assert np.isnan(self.oblique.metres_to_pixels(np.array([[0.0, -30.0]]))).all()

    def test_foot_and_centre_by_hand(self):
        plain = (0.1, 0, 0, 0, 0.1, 0, 0, 0, 1)
        box = np.array([[10.0, 20.0, 4.0, 8.0]])
        np.testing.assert_allclose(GroundPlane(plain, 100, 100, "foot").boxes_to_metres(box), [[1.2, 2.8]])
        np.testing.assert_allclose(GroundPlane(plain, 100, 100, "center").boxes_to_metres(box), [[1.2, 2.4]])

    @pytest.mark.parametrize("point", ["foot", "center"])
    def test_a_box_stands_where_it_is_put(self, point):
        plane = GroundPlane(self.oblique.homography, 960, 540, point)
        places = np.array([[1.0, 10.0], [-3.0, 15.0]])
        boxes = plane.standing_boxes(places, np.array([[20.0, 50.0], [10.0, 30.0]]))
        np.testing.assert_allclose(plane.boxes_to_metres(boxes), places, atol=1e-9)

    def test_what_is_no_plane_is_refused_and_metres_may_be_much_larger_or_smaller_than_pixels(self):
        for homography in ((1, 0, 0, 0, 1, 0), (1, 0, 0, 0, float("nan"), 0, 0, 0, 1)):
            with pytest.raises(McaptrackError, match="9 finite numbers"):
                GroundPlane(homography, 640, 480)
        for homography in ((1, 0, 0, 2, 0, 0, 0, 0, 1), (0,) * 9):
            with pytest.raises(McaptrackError, match="singular"):
                GroundPlane(homography, 640, 480)
        GroundPlane((1e-5, 0, 0, 0, 1e-5, 0, 0, 0, 1), 4000, 3000)
        GroundPlane((0.03, 0, 5e5, 0, -0.03, 4e6, 0, 0, 1), 4000, 3000)  # metres of a map

    def test_the_plane_that_holds_is_the_last_one_before(self):
        first, second = (GroundPlane((s, 0, 0, 0, s, 0, 0, 0, 1), 10, 10) for s in (1, 2))
        planes = [(100, first), (200, second)]
        assert [plane_at(planes, t) for t in (0, 100, 199, 200, 999)] == [first, first, first, second, second]
        assert plane_at((), 5) is None

    def test_a_guessed_scale_makes_the_median_box_a_person_high(self):
        plane = assumed_plane(np.array([10.0, 34.0, 200.0, np.nan]), 640, 480)
        np.testing.assert_allclose(
            plane.pixels_to_metres(np.array([[320.0, 240.0], [354.0, 206.0]])), [[0, 0], [1.7, 1.7]]
        )
        assert plane.assumed
        with pytest.raises(McaptrackError, match="no boxes to guess a scale from"):
            assumed_plane(np.array([np.nan]), 640, 480)


def best_by_trying(cost: np.ndarray, gate: float) -> tuple[int, float]:
    rows, columns = cost.shape
    best = (0, 0.0)
    for count in range(1, min(rows, columns) + 1):
        for chosen in itertools.combinations(range(rows), count):
            for others in itertools.permutations(range(columns), count):
                values = [cost[pair] for pair in zip(chosen, others, strict=True)]
                if all(value <= gate for value in values) and (count > best[0] or sum(values) < best[1]):
                    best = (count, sum(values))
    return best


@given(hnp.arrays(float, st.tuples(st.integers(0, 4), st.integers(0, 4)), elements=st.floats(-5, 5)), st.floats(-6, 6))
def test_assignment_takes_the_most_pairs_and_then_the_cheapest(cost, gate):
    rows, columns = assign(cost, gate)
    assert len(set(rows.tolist())) == len(rows) == len(set(columns.tolist()))
    count, total = best_by_trying(cost, gate)
    assert len(rows) == count
    assert (cost[rows, columns] <= gate).all()
    assert cost[rows, columns].sum() == pytest.approx(total, abs=1e-9)


def test_a_far_pair_takes_no_place_from_a_near_one():
    cost = np.array([[1.0, 2.0], [100.0, 1.5]])
    assert [part.tolist() for part in assign(cost, 3.0)] == [[0, 1], [0, 1]]
    cost = np.array([[np.nan, 2.0], [np.inf, 1.5]])
    assert [part.tolist() for part in assign(cost, 3.0)] == [[1], [1]]


@given(hnp.arrays(float, (4, 5), elements=st.integers(0, 6).map(float)), st.integers(0, 5))
def test_the_matching_has_the_largest_weight_of_all_combinations(table, rows):
    """By brute force, in a small table and in the same one as a part of a large one with pairs of its own."""
    table = table[:rows]
    at = np.nonzero(table)
    (first, second), much = max_weight_matching(at, table[at], table.shape)
    least = -min((solve_by_hand(-table),), default=0.0)
    assert table[first, second].tolist() == much.tolist()
    assert much.sum() == pytest.approx(least)
    assert len(set(first)) == len(set(second)) == len(much)
    wide = np.zeros((40, 40))
    wide[: len(table), :5] = table
    wide[np.arange(10, 40), np.arange(39, 9, -1)] = 1.0
    at = np.nonzero(wide)
    pairs, much = max_weight_matching(at, wide[at], wide.shape)
    assert wide[pairs].tolist() == much.tolist()
    assert much.sum() == pytest.approx(least + 30)


def solve_by_hand(cost):
    return min(
        sum(cost[pair] for pair in zip(chosen, others, strict=True))
        for chosen in itertools.combinations(range(cost.shape[0]), min(cost.shape))
        for others in itertools.permutations(range(cost.shape[1]), min(cost.shape))
    )


@pytest.mark.parametrize("count", [0, 1, 7, 60])
def test_overlapping_boxes_are_those_of_the_table_of_overlaps(count):
    rng = np.random.default_rng(count)
    a, b = (np.concatenate([rng.uniform(0, 300, (n, 2)), rng.uniform(1, 60, (n, 2))], axis=1) for n in (count, 50))
    table = iou(a, b)
    corners = (np.concatenate([x[:, :2], x[:, :2] + x[:, 2:]], axis=1).T for x in (a, b))
    first, second, much = overlapping(*corners, a[:, 2] * a[:, 3], b[:, 2] * b[:, 3])
    wanted = np.nonzero(table)
    assert sorted(zip(first, second, strict=True)) == sorted(zip(*wanted, strict=True))
    np.testing.assert_allclose(much, table[first, second])
    assert (np.diff(first) >= 0).all()


class TestFrameClock:
    def test_a_steady_clock_counts_one_frame_at_a_time(self):
        clock = FrameClock()
        assert [clock.tick(round(n * 1e9 / 7)) for n in range(50)] == [1] * 50
        assert clock.frames(1.0) == 7
        assert FrameClock().frames(100.0) == 1  # before two frames nothing is known

    def test_a_gap_counts_the_frames_that_are_missing(self):
        clock = FrameClock()
        times = [0.0, 0.1, 0.2, 0.3, 0.8, 0.9]
        assert [clock.tick(seconds_to_ns(t)) for t in times] == [1, 1, 1, 1, 5, 1]

    @given(st.lists(st.floats(-0.0099, 0.0099), min_size=5, max_size=60))
    def test_a_jitter_of_the_clock_changes_nothing(self, jitter):
        """Up to a tenth of the interval: then no two intervals differ by half."""
        clock = FrameClock()
        assert {clock.tick(seconds_to_ns(1 + n / 10 + off)) for n, off in enumerate(jitter)} == {1}
        assert clock.frames(0.5) in (4, 5, 6, 7)

    def test_a_new_frame_rate_is_noticed_once_and_jitter_never(self):
        rng = np.random.default_rng(2)
        times = np.cumsum([1000] * 60 + [2000] * 60).astype(float)
        clock, factors = FrameClock(), []
        for t in times + rng.uniform(-150, 150, len(times)):
            clock.tick(int(t))
            factors.append(clock.stretch)
        changes = [(n, f) for n, f in enumerate(factors) if f != 1.0]
        assert len(changes) == 1
        assert 60 < changes[0][0] < 90
        assert changes[0][1] == pytest.approx(2.0, rel=0.2)


class TestBoxFilter:
    def test_an_area_that_would_vanish_stops_shrinking(self):
        state = np.empty((kalman.STATE_ROWS, 1))
        kalman.start(state, kalman.measure(np.array([[0.0], [0], [4], [4]])))
        state[6] = -20.0
        kalman.predict(state)
        assert state[2, 0] == 16
        assert state[6, 0] == 0

    def test_a_frame_that_takes_twice_as_long_is_two_frames(self):
        """Where a box is expected, and how sure that is but for the noise, does not depend on what is called a frame."""
        state = np.full((kalman.STATE_ROWS, 1), 3.0)
        longer = state.copy()
        kalman.predict(state)
        kalman.predict(state)
        kalman.stretch(longer, 2.0)
        kalman.predict(longer)
        np.testing.assert_allclose(longer[:3], state[:3])
        np.testing.assert_allclose(longer[8:11], state[8:11], rtol=0.2)


class TestHistories:
    def test_holes_are_filled_linearly(self):
        nan = np.nan
        xy = np.array([[[nan, nan], [0, 0], [nan, nan], [nan, nan], [3, 6.0]]])
        filled, known = fill_gaps(xy, np.isfinite(xy[..., 0]))
        np.testing.assert_allclose(filled[0], [[0, 0], [0, 0], [1, 2], [2, 4], [3, 6]])
        assert known.tolist() == [4]


class TestResample:
    frames = (
        Frame(0, 0, tracks_at({1: (0, 0), 2: (5, 5)})), Frame(10, 1, tracks_at({1: (1, 2)})),
        Frame(20, 2, tracks_at({})), Frame(30, 3, tracks_at({})), Frame(40, 4, tracks_at({1: (4, 8), 2: (9, 9)})),
    )  # fmt: skip

    def at(self, times, hole=100):
        out, at = resample(self.frames, np.array(times), hole)
        return [
            (times[k], int(r["track_id"]), float(r["x_m"]), bool(r["observed"])) for k, r in zip(at, out, strict=True)
        ]

    def test_rows_lie_on_the_line_between_their_neighbours(self):
        wanted = [
            (0, 1, 0.0), (0, 2, 5.0), (5, 1, 0.5), (5, 2, 5.5), (10, 1, 1.0), (10, 2, 6.0), (20, 1, 2.0), (20, 2, 7.0),
        ]  # fmt: skip
        assert [row[:3] for row in self.at([0, 5, 10, 20])] == wanted

    @given(st.lists(st.integers(0, 100), min_size=1).map(sorted))
    def test_at_their_own_times_rows_stay_as_they_are_and_of_one_time_the_last(self, times):
        frames = [Frame(t, k, tracks_at({3: (t * 0.1, k * 7.3)})) for k, t in enumerate(times)]
        last = {frame.t_ns: TRACKS.codec.encode(frame.rows) for frame in frames}
        out, at = resample(frames, np.array(list(last)), 1000)
        assert at.tolist() == list(range(len(last)))
        assert TRACKS.codec.encode(out) == b"".join(last.values())

    def test_looking_is_known_between_frames_that_are_close(self):
        frames, times = np.array([0, 10, 50]), np.array([-1, 0, 5, 10, 30, 50, 51])
        assert is_observed_at(frames, times, 20).tolist() == [False, True, True, True, False, True, False]
        assert not is_observed_at(np.empty(0, int), times, 20).any()


# Groups laid end to end, and pairs of near points: against plain loops


GROUPS = st.lists(st.tuples(st.integers(-9, 9), st.integers(0, 4)), max_size=8)


@given(GROUPS, st.sampled_from([1, 3, -2]))
def test_ranges_are_those_of_python_laid_end_to_end(groups, step):
    starts, counts = [start for start, _ in groups], [count for _, count in groups]
    wanted = [n for start, count in groups for n in range(start, start + step * count, step)]
    assert ragged_range(starts, counts, step).tolist() == wanted
    assert group_index(counts).tolist() == [k for k, count in enumerate(counts) for _ in range(count)]


@given(st.lists(st.tuples(st.integers(0, 1), st.integers(0, 1), st.integers(0, 3)), max_size=12))
def test_runs_are_those_of_groupby_and_end_at_long_gaps(members):
    one, other, gaps = np.array(members, int).reshape(-1, 3).T
    runs = [len(list(run)) for _, run in groupby(members, key=lambda member: member[:2])]
    starts = run_starts(one, other)
    assert np.diff(np.append(np.flatnonzero(starts), len(members))).tolist() == runs
    assert (np.flatnonzero(run_ends(starts)) + 1).tolist() == np.cumsum(runs).tolist()
    split = run_starts(one, other, times=np.cumsum(gaps), max_gap=2)
    assert split.tolist() == [first or gap > 2 for first, gap in zip(starts.tolist(), gaps.tolist(), strict=True)]


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 5), st.integers(0, 5)), max_size=12))
def test_near_pairs_are_all_pairs_of_a_group_nearer_than_the_distance(points):
    group, *xy = np.array(points, int).reshape(-1, 3).T
    first, second = near_pairs(group, np.stack(xy, axis=-1).astype(float), 2.0)
    found = sorted(tuple(sorted(pair)) for pair in zip(first.tolist(), second.tolist(), strict=True))
    assert found == [
        (a, b)
        for a in range(len(points))
        for b in range(a + 1, len(points))
        if points[a][0] == points[b][0] and np.hypot(*np.subtract(points[a][1:], points[b][1:])) < 2.0
    ]


# Cameras with known intrinsics, compared with OpenCV's projection


FOCAL, CENTRE = (800.0, 790.0), (641.0, 355.0)
LENSES = {
    "none": Lens(FOCAL, CENTRE),
    "four": Lens(FOCAL, CENTRE, (-0.2, 0.05, 0.001, -0.002)),
    "plumb_bob": Lens(FOCAL, CENTRE, (-0.3, 0.1, 0.001, -0.002, -0.01)),
    "rational": Lens(FOCAL, CENTRE, (0.4, -0.2, 0.001, 0.0005, 0.01, 0.75, -0.1, 0.03)),
    "fisheye": Lens((400.0, 405.0), CENTRE, (-0.01, 0.02, -0.005, 0.001), is_fisheye=True),
}
#: A camera 1.5 m above the ground that looks along x, 10 degrees down: its axes in the ground frame.
TURN = Rotation.from_euler("y", 10, degrees=True) * Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
ROTATION = TURN.inv().as_matrix()
TRANSLATION = -ROTATION @ np.array([0.3, 0.1, 1.5])


def by_opencv(points, lens):
    turn = cv2.Rodrigues(ROTATION)[0]
    given = np.array(lens.distortion)
    if lens.is_fisheye:
        found, _ = cv2.fisheye.projectPoints(points[:, None], turn, TRANSLATION, lens.matrix, given)
    else:
        found, _ = cv2.projectPoints(points[:, None], turn, TRANSLATION, lens.matrix, given)
    return found[:, 0]


def ground_points(count=300):
    rng = np.random.default_rng(1)
    along = rng.uniform(4, 30, count)
    return np.stack([along, along * rng.uniform(-0.6, 0.6, count), np.zeros(count)], axis=1)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
class TestAsOpenCV:
    def test_points_in_front(self, lens):
        points = ground_points() + [0, 0, 0.5]
        found, in_front = project(points, lens, ROTATION, TRANSLATION)
        assert in_front.all()
        assert np.abs(found - by_opencv(points, lens)).max() < 1e-6

    def test_distortion_is_taken_out(self, lens):
        straight = Lens(lens.focal_px, lens.centre_px)
        points = ground_points()
        distorted = by_opencv(points, lens)
        assert np.abs(lens.undistort(distorted) - by_opencv(points, straight)).max() < 1e-4

    def test_metres_on_the_ground(self, lens):
        points = ground_points()
        plane = np.reshape(ground_homography(lens, ROTATION, TRANSLATION, np.eye(3)), (3, 3))
        straight = lens.undistort(by_opencv(points, lens))
        x, y, w = plane @ np.column_stack([straight, np.ones(len(points))]).T
        assert (w > 0).all()
        assert np.abs(np.stack([x / w, y / w], 1) - points[:, :2]).max() < 1e-3

    def test_points_behind(self, lens):
        found, in_front = project(np.array([[-5.0, 0, 0], [5, 0, 0]]), lens, ROTATION, TRANSLATION)
        assert in_front.tolist() == [False, True]
        assert np.isnan(found).all(axis=1).tolist() == [True, False]

    def test_no_points(self, lens):
        assert project(np.empty((0, 3)), lens, ROTATION, TRANSLATION)[0].shape == (0, 2)
        assert lens.undistort(np.empty((0, 2))).shape == (0, 2)


def test_points_beyond_the_edge_of_a_lens_are_nowhere():
    """A polynomial folds back: OpenCV draws a point 70 degrees to the side into the picture."""
    lens = LENSES["plumb_bob"]
    aside = np.array([[5.0, 5 * np.tan(np.radians(70)), 0]])
    folded = by_opencv(aside, lens)
    assert not np.isfinite(folded).all() or np.abs(lens.undistort(folded) - folded).max() < 1e5
    assert np.isnan(project(aside, lens, ROTATION, TRANSLATION)[0]).all()
    assert np.isfinite(project(aside * [1, 0.2, 1], lens, ROTATION, TRANSLATION)[0]).all()


def test_pixels_of_another_picture():
    """The camera has moved by 7 pixels to the right and 2 down since: its lens bends what it sees now."""
    lens = LENSES["plumb_bob"]
    moved = lens.after(np.array([[1.0, 0, 7], [0, 1, 2]]))
    xy = np.array([[100.0, 200], [640, 360], [1200, 700]])
    assert moved.undistort(xy) == pytest.approx(lens.undistort(xy + [7, 2]))
    assert moved.distort(lens.undistort(xy + [7, 2])) == pytest.approx(xy, abs=1e-4)
    again = moved.after(np.array([[2.0, 0, 1], [0, 2, 0]]))
    assert again.undistort(xy / 4) == pytest.approx(lens.undistort(xy / 2 + [8, 2]))


@pytest.mark.parametrize(
    "bad",
    [
        {"focal_px": (0.0, 1.0)},
        {"focal_px": (float("nan"), 1.0)},
        {"distortion": (0.1,) * 6},
        {"distortion": (float("inf"), 0.0, 0.0, 0.0)},
        {"distortion": (0.1,) * 5, "is_fisheye": True},
    ],
)
def test_lenses_that_are_none(bad):
    with pytest.raises(McaptrackError):
        Lens(**{"focal_px": FOCAL, "centre_px": CENTRE, **bad})


def test_a_camera_below_the_ground():
    with pytest.raises(McaptrackError, match=r"the camera is 2\.00 m below the ground"):
        ground_homography(LENSES["none"], ROTATION, -ROTATION @ np.array([0, 0, -2.0]), np.eye(3))


# Overlap of boxes with a heading, against OpenCV, polygons that are clipped one by one, and numbers by hand.


COUNT = 400


def drawn(seed: int, count: int = COUNT) -> np.ndarray:
    rng = np.random.default_rng(seed)
    headings = np.where(rng.random(count) < 0.3, rng.integers(-4, 5, count) * math.pi / 4, rng.uniform(-4, 4, count))
    return np.column_stack(
        [rng.uniform(-3, 3, (count, 2)), rng.uniform(-1, 1, count), rng.uniform(0.2, 5, (count, 3)), headings]
    )


def box(x=0.0, y=0.0, z=0.0, length=4.0, width=2.0, height=1.5, heading=0.0) -> np.ndarray:
    return np.array([[x, y, z, length, width, height, heading]])


def clipped(subject: np.ndarray, clip: np.ndarray) -> float:
    """The area that two convex polygons share, counter-clockwise: cut off side by side (Sutherland, Hodgman)."""
    points = [tuple(point) for point in subject]
    for a, b in zip(clip, np.roll(clip, -1, axis=0), strict=True):
        side = [(b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) for x, y in points]
        out = []
        for here, there, s, e in zip(points, points[1:] + points[:1], side, side[1:] + side[:1], strict=True):
            if s >= 0:
                out.append(here)
            if (s >= 0) != (e >= 0):
                share = s / (s - e)
                out.append((here[0] + share * (there[0] - here[0]), here[1] + share * (there[1] - here[1])))
        points = out
        if not points:
            return 0.0
    return abs(sum(x * v - y * u for (x, y), (u, v) in zip(points, points[1:] + points[:1], strict=True))) / 2


def test_shared_areas_are_those_of_clipped_polygons_and_of_opencv():
    a, b = drawn(1), drawn(2)
    found = bev_intersection_of_pairs(a, b)
    slow = [clipped(p, r) for p, r in zip(bev_corners(a), bev_corners(b), strict=True)]
    np.testing.assert_allclose(found, slow, atol=1e-9)
    assert 0.2 < (found > 0).mean() < 0.9

    def opencv(one, other):
        both = [((c[0], c[1]), (c[3], c[4]), math.degrees(c[6])) for c in (one, other)]
        corners = cv2.rotatedRectangleIntersection(*both)[1]
        return 0.0 if corners is None else cv2.contourArea(cv2.convexHull(corners))

    np.testing.assert_allclose(found, [opencv(p, r) for p, r in zip(a, b, strict=True)], atol=2e-3)


@pytest.mark.parametrize("iou", [bev_iou_of_pairs, iou_3d_of_pairs])
def test_laws(iou):
    a, b = drawn(3), drawn(4)
    found = iou(a, b)
    assert 0 < found.max() < 1
    np.testing.assert_allclose(iou(b, a), found, atol=1e-12)
    np.testing.assert_allclose(iou(a, a), 1, atol=1e-12)
    half_turn = a + [0, 0, 0, 0, 0, 0, math.pi]
    np.testing.assert_allclose(iou(half_turn, b), found, atol=1e-12)
    across = a[:, [0, 1, 2, 4, 3, 5, 6]] + [0, 0, 0, 0, 0, 0, math.pi / 2]
    np.testing.assert_allclose(iou(across, b), found, atol=1e-12)
    cos, sin = math.cos(0.7), math.sin(0.7)

    def elsewhere(boxes):
        x, y = boxes[:, 0], boxes[:, 1]
        moved = boxes + [5000, -2000, 60, 0, 0, 0, 0.7]
        moved[:, 0], moved[:, 1] = cos * x - sin * y + 5000, sin * x + cos * y - 2000
        return moved

    np.testing.assert_allclose(iou(elsewhere(a), elsewhere(b)), found, atol=1e-9)


@pytest.mark.parametrize("iou", [bev_iou_of_pairs, iou_3d_of_pairs])
def test_boxes_that_touch_are_empty_or_have_missing_columns_share_nothing(iou):
    pairs = [
        (box(), box(x=4)),
        (box(), box(y=2)),
        (box(heading=1), box(x=100)),
        (box(length=0), box()),
        (box(length=0), box(length=0)),
        (box(heading=np.nan), box()),
        (box(), box(width=np.nan)),
    ]
    for a, b in pairs:
        assert iou(a, b)[0] == pytest.approx(0, abs=1e-12), (a, b)
    assert iou(np.empty((0, 7)), np.empty((0, 7))).shape == (0,)
    assert iou_3d_of_pairs(box(), box(z=1.5))[0] == 0
    assert bev_iou_of_pairs(box(), box(z=1.5))[0] == 1
