"""Trackers and the pipeline with a camera that moves: what it does to tracks, when it is estimated, and what is said."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from mcaptrack.evaluation.metrics import Matchup, score, summary
from mcaptrack.geometry import kalman
from mcaptrack.geometry.affine import IDENTITY, move_boxes, move_points
from mcaptrack.geometry.boxes import columns_to_boxes, iou
from mcaptrack.geometry.camera_path import CameraPath, Verdict, poses_of
from mcaptrack.geometry.plane import GroundPlane, moved_planes, plane_at
from mcaptrack.schema import DETECTIONS, Frame
from mcaptrack.transforms import TRACKERS
from mcaptrack.transforms.sort.ocsort import _CENTRES, _LAST_BOX, _LAST_STATE, OcSort
from mcaptrack.transforms.sort.tracker import Measurements
from tests.worlds import detections, ids, ns

every_tracker = pytest.mark.parametrize("kind", TRACKERS.values(), ids=TRACKERS)
SIZE = (640, 480)


def crowd(seed: int, frames: int = 60) -> list[Frame]:
    """People who walk at random and are missed now and then."""
    rng = np.random.default_rng(seed)
    place, speed = rng.uniform(100, 500, (12, 2)), rng.normal(0, 3, (12, 2))
    return detections(lambda n: [tuple(xy) for xy in (place + n * speed)[rng.random(12) > 0.1]], frames)


def moved(frames: list[Frame], motions: np.ndarray) -> tuple[list[Frame], CameraPath]:
    """What a camera sees that moves so from picture to picture (F, 2, 3), and its path."""
    out, total = [], np.eye(3)
    for frame, motion in zip(frames, motions, strict=True):
        total = np.vstack([motion, [0, 0, 1]]) @ total if out else total
        rows = frame.rows.copy()
        rows["x_px"], rows["y_px"], rows["w_px"], rows["h_px"] = move_boxes(total[:2], columns_to_boxes(rows)).T
        out.append(frame._replace(rows=rows))
    return out, CameraPath(np.array([frame.t_ns for frame in frames]), poses_of(motions, *SIZE))


def shifts(seed: int, count: int, by: float = 30.0) -> np.ndarray:
    offset = np.random.default_rng(seed).uniform(-by, by, (count, 2))
    return np.array([[[1.0, 0, x], [0, 1, y]] for x, y in offset])


@every_tracker
def test_tracks_are_the_same_whichever_way_the_camera_shakes(kind):
    """A law: filters know no origin, so that a moved picture gives moved tracks with the same ids."""
    still = crowd(1)
    seen, path = moved(still, shifts(2, len(still)))
    options = {"min_hits_s": 0.0, "min_score": None}
    wanted = [frame for (frame,) in kind(**options)(still)]
    found = [frame for (frame,) in kind(camera_motion="on", camera_path=path, **options)(seen)]
    assert [ids(frame) for frame in found] == [ids(frame) for frame in wanted]
    without = [frame for (frame,) in kind(**options)(seen)]
    assert len({one for frame in without for one in ids(frame)}) > 3 * len({i for frame in wanted for i in ids(frame)})


@every_tracker
def test_a_still_camera_changes_nothing_to_the_bit(kind):
    frames = crowd(3)
    path = CameraPath(np.array([frame.t_ns for frame in frames]), poses_of(np.array([IDENTITY] * len(frames)), *SIZE))
    with_path = [frame.rows.tobytes() for (frame,) in kind(camera_motion="on", camera_path=path)(frames)]
    assert with_path == [frame.rows.tobytes() for (frame,) in kind()(frames)]


@every_tracker
def test_a_camera_that_zooms_and_rolls_keeps_its_tracks(kind):
    still = crowd(4)
    turn = np.deg2rad(2.0)
    motion = 1.03 * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    motions = np.array([np.column_stack([motion, [4.0, -30.0]])] * 20)
    seen, path = moved(still[:20], motions)
    names = [ids(frame) for (frame,) in kind(min_hits_s=0.0)(still[:20])]
    found = [ids(frame) for (frame,) in kind(min_hits_s=0.0, camera_path=path)(seen)]
    assert path.verdict is Verdict.MOVING
    assert len({one for name in found for one in name}) <= len({one for name in names for one in name}) + 1


@every_tracker
def test_tracks_end_at_a_cut(kind):
    frames = detections(lambda n: [(100, 100)], 20)
    poses = poses_of(np.array([IDENTITY] * 20), *SIZE)
    poses[10] = poses[10]._replace(verdict=Verdict.CUT)
    path = CameraPath(np.array([frame.t_ns for frame in frames]), poses)
    found = [ids(frame) for (frame,) in kind(min_hits_s=0.0, camera_path=path)(frames)]
    assert found == [[1]] * 10 + [[2]] * 10


def test_a_camera_that_only_shakes_is_left_alone_unless_it_is_asked_for():
    frames = detections(lambda n: [(100 + 30 * (n % 2), 100)], 20)
    motions = np.array([[[1.0, 0, 30 * (-1) ** (n + 1)], [0, 1, 0]] for n in range(20)])
    path = CameraPath(np.array([frame.t_ns for frame in frames]), poses_of(motions, *SIZE))
    assert path.verdict is Verdict.SHAKING
    for use, count in (("auto", 20), ("off", 20), ("on", 1)):
        tracker = TRACKERS["sort"](camera_path=path, camera_motion=use, min_hits_s=0.0, max_age_frames=0)
        assert len({one for (frame,) in tracker(frames) for one in ids(frame)}) == count, use


def test_states_of_filters_move_as_boxes_do():
    rng = np.random.default_rng(5)
    boxes = np.column_stack([rng.uniform(0, 300, (6, 2)), rng.uniform(10, 90, (6, 2))])
    state = np.empty((kalman.STATE_ROWS, 6))
    kalman.start(state, kalman.measure(boxes.T))
    kalman.correct(state, kalman.measure((boxes + 1.0).T))
    before, motion = state.copy(), np.array([[0.0, -2.0, 5.0], [2.0, 0.0, 7.0]])  # a quarter turn, twice as large
    left, top, right, bottom = kalman.corners(before)
    kalman.move(state, motion)
    wanted = move_boxes(motion, np.stack([left, top, right - left, bottom - top], axis=1))
    assert pytest.approx(wanted[:, :2]) == kalman.corners(state)[:2].T
    assert pytest.approx(wanted[:, 2:]) == (kalman.corners(state)[2:] - kalman.corners(state)[:2]).T
    speed = before[4:6]
    assert state[4:7] == pytest.approx(np.stack([-2 * speed[1], 2 * speed[0], 4 * before[6]]))
    variances = np.array([4.0, 16.0, 1.0] * 3)[:, None]  # of centre, area and ratio: place, covariance, rate
    assert state[8:] == pytest.approx(variances * before[8:])


def test_all_places_that_ocsort_remembers_move_with_the_camera():
    tracker, rng = OcSort(direction_frames=4), np.random.default_rng(6)
    tracks, motion = tracker._empty_tracks(), np.array([[0.5, 0.0, 5.0], [0.0, 0.5, 7.0]])
    boxes = np.concatenate([rng.uniform(0, 300, (2, 3)), rng.uniform(10, 90, (2, 3))])
    columns = np.concatenate([boxes[:2], boxes[:2] + boxes[2:], kalman.measure(boxes), np.ones((2, 3))])
    tracker._initiate(tracks, 1, Measurements(columns))
    centres = rng.uniform(0, 300, (10, 3))
    centres[4:6, 1] = np.nan
    tracks.table[_CENTRES:] = centres
    before = tracks.table.copy()
    tracker._move(tracks, motion)
    after = tracks.table
    np.testing.assert_allclose(after[_CENTRES::2], 0.5 * centres[::2] + 5)
    np.testing.assert_allclose(after[_CENTRES + 1 :: 2], 0.5 * centres[1::2] + 7)
    np.testing.assert_allclose(after[_LAST_BOX][::2], 0.5 * before[_LAST_BOX][::2] + 5)
    np.testing.assert_allclose(after[_LAST_BOX][1::2], 0.5 * before[_LAST_BOX][1::2] + 7)
    np.testing.assert_allclose(after[_LAST_STATE], tracks.state)
    rest = slice(kalman.STATE_ROWS, _LAST_BOX.start)
    assert after[rest].tolist() == before[rest].tolist()


DATA = os.environ.get("MCAPTRACK_DATA", "")


@pytest.mark.skipif(not DATA or not Path(DATA, "camera-motion").is_dir(), reason="MCAPTRACK_DATA has no camera-motion")
@pytest.mark.parametrize(
    ("name", "size", "least_idf1", "most_switches"),
    [("MOT17-10", (1920, 1080), 0.65, 60), ("MOT17-05", (640, 480), 0.58, 45), ("MOT17-02", (1920, 1080), None, None)],
)
def test_published_motions_of_cameras_keep_identities(name, size, least_idf1, most_switches):
    """True boxes with noise (4 % of their size, a tenth missed), every third picture of 30 a second, plain SORT."""
    folder = Path(DATA, "camera-motion")
    truth = np.loadtxt(folder / f"{name}.gt.txt", delimiter=",")
    motions = np.loadtxt(folder / f"GMC-{name}.txt")[:, 1:].reshape(-1, 2, 3)
    path = CameraPath(np.array([ns(k / 30) for k in range(len(motions))]), poses_of(motions, *size))
    rng = np.random.default_rng(0)
    boxes, kept = truth[:, 2:6].copy(), rng.random(len(truth)) >= 0.1
    boxes[:, :2] += boxes[:, 2:] * (0.5 + rng.normal(0, 0.04, (len(truth), 2)))
    boxes[:, 2:] *= np.exp(rng.normal(0, 0.04, (len(truth), 2)))
    boxes[:, :2] -= boxes[:, 2:] / 2
    frames = []
    for k in range(0, int(truth[:, 0].max()), 3):
        x, y, w, h = boxes[kept & (truth[:, 0] == k + 1)].T
        frames.append(Frame(ns(k / 30), k, DETECTIONS.rows(x_px=x, y_px=y, w_px=w, h_px=h, class_id=[1] * len(x))))
    found = {}
    for use in ("off", "auto"):
        tracks = [frame for (frame,) in TRACKERS["sort"](camera_motion=use, camera_path=path)(frames)]
        found[use] = _scores(truth, tracks)
    if least_idf1 is None:
        assert found["auto"] == found["off"]
    else:
        assert found["auto"][0] >= max(least_idf1, found["off"][0] + 0.05)
        assert found["auto"][1] <= min(most_switches, found["off"][1] / 2)


def _scores(truth: np.ndarray, tracks: list[Frame]) -> tuple[float, int]:
    """IDF1 and identity switches, matched by an overlap of 0.5."""
    people, there, given, alike = np.unique(truth[:, 1]), [], [], []
    names = np.unique(np.concatenate([frame.rows["track_id"] for frame in tracks]))
    for frame in tracks:
        rows = truth[truth[:, 0] == frame.index + 1]
        there.append(np.searchsorted(people, rows[:, 1]))
        given.append(np.searchsorted(names, frame.rows["track_id"]))
        alike.append(iou(rows[:, 2:6], columns_to_boxes(frame.rows)))
    found = summary(score(Matchup(tuple(there), tuple(given), tuple(alike), 0.5, len(people), len(names))))
    return found["IDF1"], found["IDSW"]


def plane(*shift: float) -> GroundPlane:
    return GroundPlane((0.05, 0.0, *shift[:1], 0.0, -0.05, *shift[1:], 0.0, 0.0, 1.0), *SIZE, assumed=True)


def test_a_plane_moves_with_the_camera():
    """What stands still stands still in metres, also where the camera pans, rolls and zooms."""
    rng, motions = np.random.default_rng(1), []
    for _ in range(12):
        turn, scale = np.deg2rad(rng.normal(0, 4)), np.exp(rng.normal(0, 0.05))
        linear = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        motions.append(np.column_stack([linear, rng.uniform(-60, 60, 2)]))
    motions[0] = IDENTITY
    path = CameraPath(10 * np.arange(12), poses_of(np.array(motions), *SIZE))
    planes = moved_planes([(0, plane(1.0, 2.0))], path)
    points = rng.uniform(0, 400, (5, 2))
    wanted = plane(1.0, 2.0).pixels_to_metres(points)
    for number, motion in enumerate(motions):
        points = move_points(motion, points)
        now = plane_at(planes, 10 * number + 5)
        assert now.pixels_to_metres(points) == pytest.approx(wanted)
        assert now.assumed
    later = moved_planes([(0, plane(1.0, 2.0)), (60, plane(3.0, 4.0))], path)  # measured again at picture 6
    assert plane_at(later, 50).homography == plane_at(planes, 50).homography
    assert plane_at(later, 60) == plane(3.0, 4.0)
    after = plane_at(later, 70).pixels_to_metres(move_points(motions[7], points))
    assert after == pytest.approx(plane(3.0, 4.0).pixels_to_metres(points))


def test_planes_of_a_still_camera_and_without_a_path_stay_as_they_are():
    planes = [(0, plane(1.0, 2.0)), (50, plane(3.0, 4.0))]
    still = CameraPath(10 * np.arange(12), poses_of(np.array([IDENTITY] * 12), *SIZE))
    assert moved_planes(planes, None) is planes
    assert moved_planes(planes, still) == planes
    assert moved_planes((), still) == ()


@every_tracker
def test_people_who_stand_before_a_camera_that_moves_stand_in_metres(kind):
    still = detections(lambda n: [(300, 200), (420, 260)], 40)
    seen, path = moved(still, np.array([[[1.0, 0, -9.0], [0, 1, 2.0]]] * 40))
    planes = ((0, plane(0.0, 0.0)),)
    spread = {}
    for use in ("auto", "off"):
        tracker = kind(min_hits_s=0.0, camera_path=path, ground_planes=planes, camera_motion=use)
        rows = np.concatenate([frame.rows for (frame,) in tracker(seen)])
        spread[use] = np.ptp(rows["x_m"][rows["track_id"] == 1])
    assert spread["auto"] < 0.2
    assert spread["off"] > 5.0
