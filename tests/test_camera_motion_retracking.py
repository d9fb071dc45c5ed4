"""Re-tracking before a camera that moves: boxes in gaps stand on the people, with and without a ground plane."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mcaptrack import log
from mcaptrack.geometry.affine import IDENTITY, move_boxes
from mcaptrack.geometry.camera_path import CameraPath, poses_of
from mcaptrack.geometry.plane import GroundPlane, scene_planes
from mcaptrack.schema import EVENT_KINDS, EVENTS, TRACKS
from mcaptrack.sources.camera_motion import read_ground_truth
from tests.commands import done

#: Left edges and tops of people who stand, 20 px wide and 60 px high, in the first picture.
PEOPLE = [(500.0, 60.0), (700.0, 300.0), (950.0, 520.0)]
SIZE = (1280, 720)


def sway(frame: int) -> float:
    """By how much the scene has moved to the right in a frame, in pixels."""
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


@pytest.mark.parametrize("given", [("plane",), ()], ids=["plane", "no plane"])
def test_tracks_are_linked_where_people_stand_and_not_where_they_are_seen(tmp_path, monkeypatch, given):
    """A person is missed for longer than a track lasts, while the camera turns by 170 px or more."""
    monkeypatch.chdir(tmp_path)
    write(tmp_path, 90, range(30, 55))

    def ids(*options: object) -> int:
        frames = run(tmp_path, *given, *options)["retracks"]
        return len(np.unique(np.concatenate([frame.rows["track_id"] for frame in frames])))

    assert ids() == len(PEOPLE)
    assert ids("--camera-motion", "off") != len(PEOPLE)


def test_boxes_go_to_the_scene_and_back():
    """What stands is at one place of the scene, also between pictures, where the camera turns evenly."""
    rng, motions, boxes = np.random.default_rng(3), [IDENTITY], [np.array([300.0, 200.0, 20.0, 60.0])]
    for _ in range(9):
        turn, scale = np.deg2rad(rng.normal(0, 3)), np.exp(rng.normal(0, 0.04))
        linear = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        motions.append(np.column_stack([linear, rng.uniform(-40, 40, 2)]))
        boxes.append(move_boxes(motions[-1], boxes[-1][None])[0])
    times = 100 * np.arange(10)
    path = CameraPath(times, poses_of(np.array(motions), *SIZE))
    assert path.to_scene(np.array(boxes), times) == pytest.approx(np.tile(boxes[0], (10, 1)))
    assert path.to_pictures(np.tile(boxes[0], (10, 1)), times) == pytest.approx(np.array(boxes))
    pan = CameraPath(times, poses_of(np.array([[[1.0, 0, -6], [0, 1, 0]]] * 10), *SIZE))
    assert pan.to_pictures(boxes[0][None], np.array([250]))[0].tolist() == [285, 200, 20, 60]
    assert pan.to_scene(np.array([[285.0, 200, 20, 60]]), np.array([250]))[0].tolist() == [300, 200, 20, 60]
    assert pan.to_pictures(boxes[0][None], np.array([5000]))[0].tolist() == [246, 200, 20, 60]  # it stands after that


def test_planes_stand_in_the_scene():
    path = CameraPath(10 * np.arange(8), poses_of(np.array([[[1.0, 0, -6], [0, 1, 0]]] * 8), *SIZE))
    first, later = (GroundPlane((0.1, 0, x, 0, 0.1, 0, 0, 0, 1), *SIZE) for x in (0.0, 5.0))
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
