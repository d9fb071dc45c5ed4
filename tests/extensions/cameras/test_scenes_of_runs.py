"""The scene of a run of several cameras: it is made of those that see the same people, and grows with later ones."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import mcaptrack
from mcaptrack import RunResult, log
from mcaptrack.extensions.cameras.scenes import scenes
from mcaptrack.notices import collected
from mcaptrack.schema import TRACKS
from mcaptrack.testing import check_scene_maker
from tests.commands import done
from tests.places import CAMERAS, NS, PEOPLE, ran_copy, said, topics, walk, write_log, write_parts
from tests.tiers import thorough


@pytest.fixture(scope="module")
def boxes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with the boxes of three cameras of one place."""
    return write_log(tmp_path_factory.mktemp("scene") / "boxes.mcap", CAMERAS[:3])


@pytest.fixture(scope="module")
def ran(boxes: Path) -> tuple[Path, RunResult]:
    """The log after a run."""
    return ran_copy(boxes)


@pytest.fixture
def path(boxes: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(boxes, tmp_path / "log.mcap"))


def test_the_scene_is_tracked(ran: tuple[Path, RunResult]) -> None:
    path, result = ran
    assert [name for name, camera in result.cameras.items() if camera.is_scene] == ["world"]
    assert "/world/retracks" in topics(path)
    assert result.summary == result.cameras["world"].summary
    assert result.summary is not None
    assert result.summary.tracks == PEOPLE
    assert result.not_fused == ""
    told = done("run", path, "--no-tables").err
    lines = {line.split()[0]: line for line in told.splitlines() if line.startswith("  ")}
    assert lines["fused"].split(maxsplit=1)[1] == "world, the scene"


def test_the_maker_of_scenes_obeys_the_laws(boxes: Path) -> None:
    check_scene_maker(scenes, boxes)


def test_options_for_scenes_are_named_where_one_camera_is_run(path: Path) -> None:
    with collected() as warnings:
        mcaptrack.run(path, camera="east", fuser="feet", tables=False, predictor="cv")
    said = [notice.message for notice in warnings if notice.code == "option-not-used"]
    assert said == ["`fuser=` changes nothing here: one camera is run"]


@thorough
def test_named_cameras_are_run_and_fused_alone_and_others_join_later(path: Path) -> None:
    with collected():
        result = mcaptrack.run(path, camera=["east", "south"], tables=False, predictor="cv")
        assert list(result.cameras) == ["east", "south", "world"]
        assert "/north/tracks" not in topics(path)
        later = mcaptrack.run(path, tables=False)
    assert "/world/detections was made without north: fusing east, north, south again, as before" in later.notes
    (channel,) = (one for one in mcaptrack.info(path).channels if one.topic == "/world/detections")
    assert channel.parameters is not None
    assert channel.parameters["cameras"] == ["east", "north", "south"]


@thorough
def test_a_tracker_of_boxes_is_for_the_cameras(path: Path) -> None:
    with collected():
        result = mcaptrack.run(path, camera="east,south", tracker="ocsort", predictor="cv", tables=False)
    assert "world is not tracked by ocsort, which is for other boxes" in result.notes
    made = {channel.topic: channel.parameters for channel in mcaptrack.info(path).channels}
    assert [(made[f"/{name}/tracks"] or {})["tracker"] for name in ("east", "world")] == ["ocsort", "ground"]


@thorough
def test_cameras_of_different_places_are_not_fused(tmp_path: Path) -> None:
    path = write_log(tmp_path / "rooms.mcap", CAMERAS[:2], moved_m={"east": 2.0})
    with collected():
        result = mcaptrack.run(path, tables=False, predictor="cv")
    assert list(result.cameras) == ["north", "east"][::-1]
    assert "people that two cameras should see, two see" in result.not_fused
    assert not [topic for topic in topics(path) if topic.startswith("/world")]
    assert "ground planes may be of different places" in said(mcaptrack.fuse(path), "cameras-disagree")[0]


def test_ids_of_a_scene_of_several_cameras_go_on(tmp_path: Path) -> None:
    """Each of five people has one id over both parts, in the tracks of the scene and in all that is made of them."""
    several = write_parts(tmp_path)
    with collected():
        mcaptrack.run(several[0], follows=several, tables=False, predictor="cv", events=False)
        result = mcaptrack.run(several[1], follows=several, tables=False, predictor="cv", events=False)
    assert result.continued is not None
    assert result.continued.kept["/world/tracks"] == result.continued.kept["/world/retracks"] == PEOPLE
    for name in ("tracks", "retracks", "retracks/online", "retracks/full"):
        ids: dict[int, set[int]] = {}
        for path in several:
            with log.read(path) as opened:
                for frame in opened.frames(f"/world/{name}", TRACKS):
                    rows = frame.rows[frame.rows["observed"]]
                    at = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
                    away = np.linalg.norm(walk(frame.t_ns / NS - 1)[:, None] - at, axis=-1)
                    for person, row in zip(away.argmin(axis=0), rows, strict=True):
                        ids.setdefault(int(person), set()).add(int(row["track_id"]))
        assert sorted(map(len, ids.values())) == [1] * PEOPLE, name
        assert len(set.union(*ids.values())) == PEOPLE
