"""All cameras of a log in one run: each as if it were alone; and a scene that nothing installed can make again."""

from __future__ import annotations

import base64
import json
import shutil
from pathlib import Path

import cv2
import pytest

import mcaptrack
from mcaptrack import McaptrackError, RunResult, log, pipeline
from mcaptrack.api.finishing import PartsOfRun
from mcaptrack.installed import missing_extension
from mcaptrack.notices import collected
from mcaptrack.pipeline import scenes
from mcaptrack.pipeline.write import Made, RunState, write
from mcaptrack.schema import DETECTIONS, Frame
from mcaptrack.schema.provenance import Provenance
from tests.commands import call
from tests.logs import recorder
from tests.places import CAMERAS, HEIGHT, WIDTH, ran_copy, said, topics, write_log
from tests.tiers import one_in, thorough
from tests.worlds import small_scene


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
    return ran_copy(boxes)


@pytest.fixture
def path(boxes: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(boxes, tmp_path / "log.mcap"))


class TestAllCameras:
    def test_each_camera_is_tracked(self, ran: tuple[Path, RunResult]) -> None:
        path, result = ran
        assert [name for name, camera in result.cameras.items() if not camera.is_scene] == ["east", "north", "south"]
        assert {f"/{name}/retracks" for name in result.cameras} <= topics(path)

    def test_info_shows_the_channels_of_each_camera_together(
        self, ran: tuple[Path, RunResult], boxes: Path, tmp_path: Path
    ) -> None:
        path, _ = ran
        owners = {channel.topic: channel.camera for channel in mcaptrack.info(path).channels}
        assert all(topic.startswith(f"/{name}/") for topic, name in owners.items())
        lines = [line.strip() for line in call("info", path, environment={"COLUMNS": "200"}).out.splitlines()]
        first = [lines.index(f"/{name}") for name in sorted({"labelled", *ran[1].cameras})]
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


class TestChoice:
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


class TestWithoutScenes:
    """Nothing that makes scenes is installed."""

    @pytest.fixture(autouse=True)
    def alone(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(scenes, "names", lambda _: ())
        monkeypatch.setattr("mcaptrack.api.run._PARTS", PartsOfRun())

    def test_each_camera_is_run_and_a_line_says_why_there_is_no_scene(self, path: Path) -> None:
        with collected():
            result = mcaptrack.run(path, tables=False, predictor="cv", camera="east,south")
        assert list(result.cameras) == ["east", "south"]
        assert result.not_fused == (missing_extension("fuse") or "nothing that is installed makes such a scene")
        assert f"no scene is made of the cameras: {result.not_fused}" in result.notes

    @thorough
    def test_a_scene_is_tracked_and_is_said_to_be_out_of_date(self, path: Path) -> None:
        rows = DETECTIONS.rows(x_m=[1.0, 5.0], y_m=[2.0, 2.0], score=[0.9, 0.9], class_id=[1, 1])
        frames = [Frame(10**9 + number * 5 * 10**8, number, rows) for number in range(12)]
        of_earlier = {"/east/detections": "0" * 64}
        how = Provenance("fuse", {"cameras": ["east", "south"], "clock_offset_s": [0.0, 0.0]}, references=of_earlier)
        with log.read(path) as opened:
            write(RunState(opened, "/world", {"/world/detections": Made.of(DETECTIONS, frames, how)}), None, None)
        with log.read(path) as opened:
            before = [message.payload for message in opened.messages("/world/detections")]
        with collected():
            result = mcaptrack.run(path, tables=False, predictor="cv")
        assert list(result.cameras) == ["east", "north", "south", "world"]
        assert result.cameras["world"].summary.tracks == 2
        (line,) = said(result, "out-of-date")
        assert line.startswith("/world/detections is out of date, and stays as it is: ")
        with log.read(path) as opened:
            assert [message.payload for message in opened.messages("/world/detections")] == before


# Pictures that are recorded twice, and depths: one camera is run once


RAW, COMPRESSED, DEPTH = "/cam/color/image_raw", "/cam/color/image_raw/compressed", "/cam/depth/image_rect"


def written(path: Path, *topics: str) -> Path:
    """A log of the same pictures on these topics: as jpeg on one, as distances on the last."""
    with recorder(path) as writer:
        for topic in topics:
            name = "foxglove.CompressedImage" if topic == COMPRESSED else "foxglove.RawImage"
            channel = writer.add_channel(topic, (name, "jsonschema", b"{}"))
            for number, shot in enumerate(small_scene(1.5).shots()):
                image = cv2.cvtColor(shot.image, cv2.COLOR_BGR2GRAY)
                height, width = image.shape
                data, encoding, step = image.tobytes(), "mono8", width
                if topic == DEPTH:
                    data, encoding, step = (image.astype("<u2") * 20).tobytes(), "16UC1", 2 * width
                if topic == COMPRESSED:
                    data = cv2.imencode(".jpg", shot.image)[1].tobytes()
                t_ns = 10**9 + number * 10**8
                stamp = {"timestamp": {"sec": t_ns // 10**9, "nsec": t_ns % 10**9}, "format": "jpeg"}
                about = {"width": width, "height": height, "encoding": encoding, "step": step}
                content = json.dumps(stamp | about | {"data": base64.b64encode(data).decode()}).encode()
                writer.add_message(channel, t_ns, content, t_ns)
    return path


@pytest.mark.parametrize("more", one_in(2, [[COMPRESSED], []]))
def test_a_camera_that_is_recorded_twice_is_run_once(tmp_path, more):
    topics = (RAW, *more, DEPTH)
    result = mcaptrack.run(written(tmp_path / "a.mcap", *topics), tables=False)
    assert {topic for topic in result.channels if topic.endswith("/detections")} == {"/cam/color/detections"}
    assert len(result.left_out) == len(topics) - 1
    assert ("cam/depth" in result.left_out) is (DEPTH in topics)
    name = next(iter(result.left_out))
    if name == "cam/depth":
        with pytest.raises(mcaptrack.McaptrackError, match=r"has depths in .* \(16UC1\)|has depths \(16UC1\)"):
            mcaptrack.run(tmp_path / "a.mcap", camera=name, tables=False)
        named = mcaptrack.run(tmp_path / "a.mcap", topic=DEPTH, tables=False)
    else:
        named = mcaptrack.run(tmp_path / "a.mcap", camera=name, tables=False)
    assert named.stages[0] == "detect"


def test_the_only_pictures_are_run_whatever_their_names(tmp_path):
    assert (
        "/cam/color/image_raw/detections"
        in mcaptrack.run(written(tmp_path / "a.mcap", COMPRESSED), tables=False).channels
    )


def test_the_pictures_of_the_only_camera_need_no_name(tmp_path):
    with mcaptrack.open(written(tmp_path / "a.mcap", RAW)) as opened:
        assert len(list(opened.frames())) == len(list(opened.frames("image_raw"))) == 15
    with (
        mcaptrack.open(written(tmp_path / "b.mcap", RAW, "/other/image")) as opened,
        pytest.raises(
            mcaptrack.McaptrackError, match=f"no channel video with pictures; it has pictures in {RAW}, /other/image"
        ),
    ):
        opened.frames()
