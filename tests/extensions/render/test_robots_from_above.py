"""Videos of a robot's log: from above, with all objects in their places."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.foxglove import colour
from tests.robot_runs import passing_robot, place, write_passing

SHOTS = 20


@pytest.fixture(scope="module")
def passed(tmp_path_factory) -> Path:
    """A log of a robot after ``run``."""
    path, _ = write_passing(tmp_path_factory.mktemp("robot"), shots=SHOTS)
    mcaptrack.run(path, sidecar=False, tables=False)
    return path


def test_a_video_from_above_follows_the_robot_and_has_all_objects_in_their_places(passed, tmp_path):
    result = mcaptrack.render(passed, tmp_path / "a.mp4", start_s=1.15, end_s=1.35)
    assert result.views == ("/lidar/retracks/full/view/scene", "/lidar/retracks/predictions/view/scene")
    with log.read(passed) as opened:
        t_ns = opened.times(result.views[0])[12:14]
    with av.open(str(tmp_path / "a.mp4")) as container:
        frames = [frame.to_ndarray(format="bgr24").astype(int) for frame in container.decode(video=0)]
    assert len(frames) == len(t_ns) == result.pictures
    robot = passing_robot(SHOTS)
    start_ns = robot.shots[0].stamp_ns
    image, at_ns = frames[0], int(t_ns[0])
    base = [np.interp(at_ns, robot.stamps.astype(float), robot.place[:, axis]) for axis in (0, 1)]
    assert image.shape[0] > 720  # a legend below
    assert image.shape[1:] == (960, 3)
    assert image[360, 480].min() > 180  # the robot is in the middle, in white
    x, y = (place(3, at_ns, start_ns)[:2] - base) * 12 * [1, -1] + [480, 360]
    near = image[round(y) + 3 : round(y) + 6, round(x) - 12 : round(x) - 2].reshape(-1, 3)  # beside the label
    with mcaptrack.open(passed) as opened:
        rows = opened.array("tracks", "/lidar/retracks/full")
    now = rows[rows["t_ns"] == at_ns]
    nearest = np.hypot(now["x_m"] - place(3, at_ns, start_ns)[0], now["y_m"] - place(3, at_ns, start_ns)[1]).argmin()
    wanted = np.array(colour(int(now["track_id"][nearest]))[2::-1]) * 255
    paint = near - [32, 28, 26]
    share = (paint * (wanted - [32, 28, 26])).sum(axis=1) / np.sum((wanted - [32, 28, 26]) ** 2)
    assert np.median(share) == pytest.approx(0.625, abs=0.12)
    away = image[round(720 - y), round(960 - x)]
    assert np.abs(away - [32, 28, 26]).max() < 40


def test_without_a_robot_all_places_are_in_the_video(tmp_path):
    rows = [f"{n * 100_000_000},{k},{100 + 300 * k + n},{50 - 20 * k},0.5,4,2,1.5,0" for n in range(16) for k in (1, 2)]
    (tmp_path / "truth.csv").write_text("\n".join(["t_ns,id,x_m,y_m,z_m,length_m,width_m,height_m,heading_rad", *rows]))
    path = tmp_path / "a.mcap"
    mcaptrack.ingest(tmp_path / "truth.csv", output=path, role="tracks", frame="map")
    mcaptrack.run(path, tables=False, events=False)
    result = mcaptrack.render(path, tmp_path / "a.gif", topic="/camera/tracks", width=320)
    assert (result.pictures, result.views) == (16, ("/camera/tracks/view/scene",))
    with av.open(str(tmp_path / "a.gif")) as container:
        image = next(container.decode(video=0)).to_ndarray(format="bgr24").astype(int)
    bright = np.argwhere(image[:240].max(axis=2) > 120)[:, 1]
    assert image.shape[0] > 240  # a legend below
    assert image.shape[1:] == (320, 3)
    assert (bright < 60).any()
    assert (bright > 260).any()
