"""All cameras of a log in one run: each as if it were alone, then the scene that they see together."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import mcaptrack
from mcaptrack import McaptrackError, RunResult, log, pipeline
from mcaptrack.notices import collected
from tests.commands import call, done
from tests.places import CAMERAS, HEIGHT, PEOPLE, WIDTH, said, write_log


@pytest.fixture(scope="module")
def boxes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with the boxes of three cameras of one place, and of a fourth one that has ground truth only."""
    path = write_log(tmp_path_factory.mktemp("several") / "boxes.mcap", CAMERAS[:3])
    labels = path.with_name("labels.txt")
    labels.write_text(f"1,1,{WIDTH - 20},{HEIGHT - 50},20,50,1,-1,-1,-1\n")
    mcaptrack.ingest(labels, fps=2, role="truth", camera="labelled", into=path)
    return path


@pytest.fixture(scope="module")
def ran(boxes: Path) -> tuple[Path, RunResult]:
    """The log after a run."""
    path = Path(shutil.copy(boxes, boxes.with_name("ran.mcap")))
    with collected():
        return path, mcaptrack.run(path, tables=False)


@pytest.fixture
def path(boxes: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(boxes, tmp_path / "log.mcap"))


def topics(path: Path) -> set[str]:
    return {channel.topic for channel in mcaptrack.info(path).channels}


class TestAllCameras:
    def test_each_camera_and_the_scene_are_tracked(self, ran: tuple[Path, RunResult]) -> None:
        path, result = ran
        assert list(result.cameras) == ["east", "north", "south", "world"]
        assert [one.is_scene for one in result.cameras.values()] == [False, False, False, True]
        assert {f"/{name}/retracks" for name in result.cameras} <= topics(path)
        assert result.summary == result.cameras["world"].summary
        assert result.summary is not None
        assert result.summary.tracks == PEOPLE
        assert result.not_fused == ""

    def test_info_shows_the_channels_of_each_camera_together(
        self, ran: tuple[Path, RunResult], boxes: Path, tmp_path: Path
    ) -> None:
        path, _ = ran
        owners = {channel.topic: channel.camera for channel in mcaptrack.info(path).channels}
        assert all(topic.startswith(f"/{name}/") for topic, name in owners.items())
        lines = [line.strip() for line in call("info", path, environment={"COLUMNS": "200"}).out.splitlines()]
        first = [lines.index(f"/{name}") for name in ("east", "labelled", "north", "south", "world")]
        ends = [*first[1:], lines.index("lineage")]
        assert first == sorted(first)
        for begin, end in zip(first, ends, strict=True):
            shown = [line.split()[0] for line in lines[begin + 1 : end]]
            assert shown == sorted(topic for topic, name in owners.items() if f"/{name}" == lines[begin])
        alone = tmp_path / "alone.mcap"
        mcaptrack.drop(boxes, ["/east*", "/south*", "/labelled*"], output=alone)
        with mcaptrack.open(alone) as opened:
            opened.write("/north/more", [mcaptrack.detections([[1, 2, 3, 4]], [0.5], [1], 1, box_format="xywh")])
        assert "/north" not in [line.strip() for line in call("info", alone).out.splitlines()]

    def test_a_camera_with_labels_alone_is_left_out_and_named(self, ran: tuple[Path, RunResult]) -> None:
        path, result = ran
        assert dict(result.left_out) == {"labelled": "has neither pictures nor boxes, but /labelled/truth"}
        assert said(result, "left-out")[0].startswith("the camera labelled is left out")
        assert not [topic for topic in topics(path) if topic.startswith("/labelled/tracks")]

    def test_a_camera_is_run_as_if_it_were_alone(self, ran: tuple[Path, RunResult], path: Path) -> None:
        alone = mcaptrack.run(path, camera="north", tables=False)
        assert not alone.cameras
        with log.read(path) as opened, log.read(ran[0]) as other:
            for topic in ("/north/tracks", "/north/retracks/full", "/north/predictions", "/north/tracks/view/scene"):
                assert [one.payload for one in opened.messages(topic)] == [one.payload for one in other.messages(topic)]

    def test_a_second_run_changes_nothing(self, ran: tuple[Path, RunResult]) -> None:
        before = ran[0].read_bytes()
        with collected():
            again = mcaptrack.run(ran[0], tables=False)
        assert again.is_up_to_date
        assert list(again.cameras) == list(ran[1].cameras)
        assert ran[0].read_bytes() == before

    def test_the_command_prints_a_line_for_each_camera(self, ran: tuple[Path, RunResult]) -> None:
        told = done("run", ran[0], "--no-tables").err
        lines = {line.split()[0]: line for line in told.splitlines() if line.startswith("  ")}
        assert "tracks" in lines["south"]
        assert "left out: it has neither pictures nor boxes" in lines["labelled"]
        assert lines["fused"].split(maxsplit=1)[1] == "world, the scene"


class TestChoice:
    def test_named_cameras_are_run_and_fused_alone_and_others_join_later(self, path: Path) -> None:
        with collected():
            result = mcaptrack.run(path, camera=["east", "south"], tables=False, predictor="cv")
            assert list(result.cameras) == ["east", "south", "world"]
            assert "/north/tracks" not in topics(path)
            later = mcaptrack.run(path, tables=False)
        assert "/world/detections was made without north: fusing east, north, south again, as before" in later.notes
        (channel,) = (one for one in mcaptrack.info(path).channels if one.topic == "/world/detections")
        assert channel.parameters is not None
        assert channel.parameters["cameras"] == ["east", "north", "south"]

    @pytest.mark.parametrize(
        ("camera", "words"),
        [
            ("east,nowhere", "has no camera nowhere; it has east, labelled, north, south"),
            ("east,labelled", "labelled has neither pictures nor boxes, but /labelled/truth; leave it out of"),
            ("east,", "has an empty name"),
        ],
    )
    def test_cameras_that_can_not_be_run_are_refused(self, path: Path, camera: str, words: str) -> None:
        before = path.read_bytes()
        outcome = call("run", path, "--camera", camera)
        assert (outcome.code, path.read_bytes()) == (1, before)
        assert words in outcome.err

    def test_a_channel_is_of_one_camera(self, path: Path) -> None:
        told = call("run", path, "--camera", "east,north", "--topic", "/east/detections")
        words = "--topic /east/detections is of one camera, and --camera names 2; leave one out"
        assert (told.code, told.err) == (1, f"mcaptrack: {words}\n")

    def test_a_tracker_of_boxes_is_for_the_cameras(self, path: Path) -> None:
        with collected():
            result = mcaptrack.run(path, camera="east,south", tracker="ocsort", predictor="cv", tables=False)
        assert "world is not tracked by ocsort, which is for other boxes" in result.notes
        made = {channel.topic: channel.parameters for channel in mcaptrack.info(path).channels}
        assert [(made[f"/{name}/tracks"] or {})["tracker"] for name in ("east", "world")] == ["ocsort", "ground"]


def fake_runs(monkeypatch: pytest.MonkeyPatch, bad: str, error: BaseException) -> list[str]:
    """Let runs write the log as it is, but raise an error for one camera; returns the prefixes of those that are run."""
    seen: list[str] = []

    def run(opened: log.Log, prefix: str, *_: object, output: Path | None, **__: object) -> pipeline.Report:
        seen.append(prefix)
        if prefix == bad:
            raise error
        if output is not None:
            shutil.copy(str(opened.path), output)
        return pipeline.Report()

    monkeypatch.setattr(pipeline, "run", run)
    return seen


class TestFailures:
    def test_a_camera_that_fails_keeps_no_other_from_being_run(
        self, path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        seen = fake_runs(monkeypatch, "/north", McaptrackError("it is broken"))
        with collected(), pytest.raises(McaptrackError, match=r"1 of 3 cameras failed: north: it is broken\. What was"):
            mcaptrack.run(path, tables=False)
        assert seen == ["/east", "/north", "/south"]  # and no scene without one of them

    def test_an_interrupted_run_leaves_no_output(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        fake_runs(monkeypatch, "/south", KeyboardInterrupt())
        there = {one.name for one in path.parent.iterdir()}
        with collected(), pytest.raises(KeyboardInterrupt):
            mcaptrack.run(path, output=path.with_name("new.mcap"), tables=False)
        assert {one.name for one in path.parent.iterdir()} == there

    def test_cameras_of_different_places_are_not_fused(self, tmp_path: Path) -> None:
        path = write_log(tmp_path / "rooms.mcap", CAMERAS[:2], moved_m={"east": 2.0})
        with collected():
            result = mcaptrack.run(path, tables=False, predictor="cv")
        assert list(result.cameras) == ["north", "east"][::-1]
        assert "people that two cameras should see, two see" in result.not_fused
        assert not [topic for topic in topics(path) if topic.startswith("/world")]
        assert "ground planes may be of different places" in said(mcaptrack.fuse(path), "cameras-disagree")[0]
