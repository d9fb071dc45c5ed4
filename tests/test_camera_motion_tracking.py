"""Trackers and the pipeline with a camera that moves: what it does to tracks, when it is estimated, and what is said."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from mcaptrack import log
from mcaptrack.evaluation.aligned import make_matchup
from mcaptrack.evaluation.metrics import score, summary
from mcaptrack.geometry import kalman
from mcaptrack.geometry.affine import IDENTITY, move_boxes, move_points
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.camera_path import CameraPath, Verdict, poses_of
from mcaptrack.geometry.plane import GroundPlane, moved_planes, plane_at, scene_planes
from mcaptrack.schema import DETECTIONS, EVENT_KINDS, EVENTS, TRACKS, Frame
from mcaptrack.sources.camera_motion import read_ground_truth
from mcaptrack.transforms import TRACKERS
from tests.commands import done
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
    frames, people = [], []
    for k in range(0, int(truth[:, 0].max()), 3):
        ids, *true = truth[truth[:, 0] == k + 1, 1:6].T
        box = dict(zip(("x_px", "y_px", "w_px", "h_px"), true, strict=True))
        people.append(Frame(ns(k / 30), k, TRACKS.rows(track_id=ids, observed=ids > 0, source_id=ids * 0 - 1, **box)))
        x, y, w, h = boxes[kept & (truth[:, 0] == k + 1)].T
        frames.append(Frame(ns(k / 30), k, DETECTIONS.rows(x_px=x, y_px=y, w_px=w, h_px=h, class_id=[1] * len(x))))
    found = {}
    for use in ("off", "auto"):
        tracks = [frame for (frame,) in TRACKERS["sort"](camera_motion=use, camera_path=path)(frames)]
        scores = summary(score(make_matchup(people, tracks, "iou", 0.5)))
        found[use] = scores["IDF1"], scores["IDSW"]
    if least_idf1 is None:
        assert found["auto"] == found["off"]
    else:
        assert found["auto"][0] >= max(least_idf1, found["off"][0] + 0.05)
        assert found["auto"][1] <= min(most_switches, found["off"][1] / 2)


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


# Re-tracking before a camera that moves: boxes in gaps stand on the people


#: Left edges and tops of people who stand, 20 px wide and 60 px high, in the first picture.
PEOPLE = [(500.0, 60.0), (700.0, 300.0), (950.0, 520.0)]
PICTURE_PX = (1280, 720)


def sway(frame: int) -> float:
    return 170 * float(np.sin(frame / 3.5) - np.sin(0))


def write(folder: Path, frames: int, gap: range) -> None:
    """Detections at 10 frames a second, in which the second person is missed for a while, and the motion."""
    rows, motions = [], []
    for n in range(frames):
        seen = [one for number, one in enumerate(PEOPLE) if number != 1 or n not in gap]
        rows += [f"{n + 1},-1,{x + sway(n):.3f},{y},20,60,1,-1,-1,-1" for x, y in seen]
        motions.append(f"{n} 1 0 {sway(n) - sway(n - 1) if n else 0:.6f} 0 1 0")
    (folder / "det.txt").write_text("\n".join(rows) + "\n")
    (folder / "motion.txt").write_text("\n".join(motions) + "\n")
    (folder / "plane.txt").write_text("0.02 0.004 -9\n0 0.03 -8\n0 0.0004 1\n")


def run(folder: Path, *options: object) -> list:
    given = ["--ground-plane", "plane.txt"] if "plane" in options else []
    done("ingest", "det.txt", "--fps", 10, "--motion", "motion.txt", *given, "-o", "a.mcap", "-q", "--force")
    done("run", "a.mcap", "--no-tables", "-q", *[one for one in options if one != "plane"])
    with log.read(folder / "a.mcap") as opened:
        return {name: opened.frames(f"/camera/{name}", TRACKS) for name in ("samples", "retracks", "retracks/full")}


@pytest.mark.parametrize("given", [("plane",), ()], ids=["plane", "no plane"])
def test_boxes_in_gaps_stand_on_people_while_the_camera_sways(tmp_path, monkeypatch, given):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, 60, range(25, 34))
    found = run(tmp_path, *given)
    between = 0
    for frame in found["retracks/full"]:
        for row in frame.rows:
            away = [np.hypot(row["x_px"] - x - sway(frame.index), row["y_px"] - y) for x, y in PEOPLE]
            assert min(away) < 4, (frame.index, row["track_id"])
        between += int((~frame.rows["observed"]).sum()) if frame.index in range(26, 33) else 0
    assert between == 7
    for name in ("samples", "retracks"):
        for frame in found[name]:
            for row in frame.rows:
                assert min(abs(float(row["y_px"]) - y) for _, y in PEOPLE) < 4
                now = sway(round(frame.t_ns / 1e8))  # samples are at 2.5 Hz, so at times of pictures
                assert min(abs(float(row["x_px"]) - x - now) for x, _ in PEOPLE) < 4


def test_boxes_go_to_the_scene_and_back():
    """What stands is at one place of the scene, also between pictures, where the camera turns evenly."""
    rng, motions, boxes = np.random.default_rng(3), [IDENTITY], [np.array([300.0, 200.0, 20.0, 60.0])]
    for _ in range(9):
        turn, scale = np.deg2rad(rng.normal(0, 3)), np.exp(rng.normal(0, 0.04))
        linear = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        motions.append(np.column_stack([linear, rng.uniform(-40, 40, 2)]))
        boxes.append(move_boxes(motions[-1], boxes[-1][None])[0])
    times = 100 * np.arange(10)
    path = CameraPath(times, poses_of(np.array(motions), *PICTURE_PX))
    assert path.to_scene(np.array(boxes), times) == pytest.approx(np.tile(boxes[0], (10, 1)))
    assert path.to_pictures(np.tile(boxes[0], (10, 1)), times) == pytest.approx(np.array(boxes))
    pan = CameraPath(times, poses_of(np.array([[[1.0, 0, -6], [0, 1, 0]]] * 10), *PICTURE_PX))
    assert pan.to_pictures(boxes[0][None], np.array([250]))[0].tolist() == [285, 200, 20, 60]
    assert pan.to_scene(np.array([[285.0, 200, 20, 60]]), np.array([250]))[0].tolist() == [300, 200, 20, 60]
    assert pan.to_pictures(boxes[0][None], np.array([5000]))[0].tolist() == [246, 200, 20, 60]  # it stands after that


def test_planes_stand_in_the_scene():
    path = CameraPath(10 * np.arange(8), poses_of(np.array([[[1.0, 0, -6], [0, 1, 0]]] * 8), *PICTURE_PX))
    first, later = (GroundPlane((0.1, 0, x, 0, 0.1, 0, 0, 0, 1), *PICTURE_PX) for x in (0.0, 5.0))
    planes = [(0, first), (40, later)]
    assert scene_planes(planes, None) is planes
    assert scene_planes([(30, first)], path) == [(30, first)]  # the first plane is that of the first picture
    (_, one), (since, other) = scene_planes(planes, path)
    assert (one, since) == (first, 40)
    seen = np.array([[100.0, 50.0]])  # in the fifth picture, to which the scene has moved by 24 px
    assert other.pixels_to_metres(seen + [24, 0]) == pytest.approx(later.pixels_to_metres(seen))


def test_ground_truth_is_in_metres_where_the_pictures_show_it(tmp_path, monkeypatch):
    """People who stand: a plane that holds for the first picture would let their ground truth sway with the camera."""
    monkeypatch.chdir(tmp_path)
    write(tmp_path, 60, range(0))
    truth = [f"{n + 1},{k + 1},{x + sway(n):.3f},{y},20,60,1,1,1" for n in range(60) for k, (x, y) in enumerate(PEOPLE)]
    (tmp_path / "gt.txt").write_text("\n".join(truth) + "\n")
    given = "--fps 10 --motion motion.txt --ground-plane plane.txt --truth gt.txt"
    done("ingest", "det.txt", *given.split(), "-o", "a.mcap", "-q")
    summary = json.loads(done("run", "a.mcap", "--no-tables", "-q", "--json").out)["results"][0]
    assert summary["summary"]["scores"]["idf1"][1] > 0.95
    for topic in ("tracks", "retracks"):
        scored = f"evaluate a.mcap --topic /camera/{topic} --similarity metres --gate-m 0.1 --json".split()
        assert json.loads(done(*scored).out)["results"][0]["IDF1"] > 0.9, topic
    with log.read(tmp_path / "a.mcap") as opened:
        kinds = opened.rows("/camera/retracks/events", EVENTS).rows["kind"]
        assert not {"identity switch", "false track"} & {EVENT_KINDS[kind] for kind in kinds.tolist()}
        frames = read_ground_truth(opened, "/camera")
    places = np.array([np.stack([frame.rows["x_m"], frame.rows["y_m"]], axis=1) for frame in frames])
    assert np.ptp(places, axis=0).max() < 0.02
    done("run", "a.mcap", "--camera-motion", "off", "--no-tables", "-q")
    with log.read(tmp_path / "a.mcap") as opened:  # tracks and ground truth are in the same metres
        places = [frame.rows["x_m"][0] for frame in read_ground_truth(opened, "/camera")]
    assert np.ptp(places) > 2.0
