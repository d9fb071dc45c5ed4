"""Which channels are of which camera: by what they were made from, wherever they were written and however they came in."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.provenance import Provenance, digest
from mcaptrack.sources.cameras import camera_at, cameras, find_camera, name_above, repaired_tracks
from mcaptrack.transforms import STAGES, TRANSFORMS
from tests.commands import GROUP, call, done
from tests.logs import on_a_log, provenance_of
from tests.robots import write_log
from tests.tiers import one_in, thorough
from tests.worlds import tracks_at

#: Where a stage may be told to write: beside its usual channel, below it, elsewhere, and under names that mean something
#: below another camera.
TARGETS = [
    "/camera/other", "/camera/retracks/mine", "/elsewhere", "/x/y/predictions", "/x/retracks", "/other/truth", "bare",
]  # fmt: skip
#: Every stage somewhere, and something everywhere.
PLACES = [*zip([*STAGES, *STAGES], TARGETS, strict=False)]
#: Commands that are told a camera that is there.
HAVING = [name for name, command in GROUP.commands.items() if "camera" in command.settings and name != "ingest"]


@pytest.fixture
def path(template, tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return Path(shutil.copy(template, tmp_path / "a.mcap"))


def answer(command: str, path: Path) -> Any:
    """Return a command's output for a log, without parts that depend on the file's name or on time."""
    folder = path.with_name("asked")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    copied = Path(shutil.copy(path, folder))
    given = json.loads(done(command, *on_a_log(command, copied, folder), "--json", "-q").out)
    if command == "run":
        return [result["summary"] for result in given["results"]]
    for result in given.get("results", []):
        for name in ("seconds", "seconds_by_part"):
            result.pop(name, None)
    for name in ("channels", "bytes", "messages", "digest"):
        [one.pop(name, None) for one in given.get("logs", [])]
    return given


@thorough
def test_commands_give_the_same_output_for_results_at_other_topics(path):
    before = {command: answer(command, path) for command in HAVING}
    for stage, target in PLACES:
        done(stage, path, "--to", f"{target}/{stage}", "-q")
    done("run", path, "--no-tables", "-q")
    after = {command: answer(command, path) for command in HAVING}
    for command in HAVING:
        assert after[command] == before[command], command


@pytest.mark.parametrize(("stage", "target"), one_in(4, PLACES))
def test_outputs_belong_to_the_camera_of_their_source(path, stage, target):
    done(stage, path, "--to", target, "-q")
    with log.read(path) as opened:
        assert [camera.prefix for camera in cameras(opened)] == ["/camera"]
        assert find_camera(opened) == find_camera(opened, "camera") == find_camera(opened, None, target) == "/camera"
        assert target in camera_at(opened, "/camera").topics
    done("run", path, "--no-tables", "-q")
    for again in list(STAGES)[list(STAGES).index(stage) + 1 :]:  # and what is made from it stands with all the rest
        if TRANSFORMS[again].reads is TRANSFORMS[stage].writes[""] and stage != "retrack":
            done(again, path, "--topic", target, "-q")
            assert provenance_of(path, f"/camera/{STAGES[again].output_topic}").input == target


def test_a_stage_does_not_replace_the_source_of_its_input(path):
    before = path.read_bytes()
    outcome = call("sample", path, "--topic", "/camera/retracks")
    assert (outcome.code, path.read_bytes()) == (1, before)
    assert "/camera/retracks was itself made from /camera/samples, which sample would replace" in outcome.err
    done("sample", path, "--topic", "/camera/retracks", "--to", "/camera/sampled", "-q")


@thorough
def test_stages_do_not_replace_channels_of_other_stages(path):
    before = path.read_bytes()
    names = {"video", "truth", "ground_plane", *(stage.output_topic for stage in STAGES.values())}
    for stage, one in STAGES.items():
        for name in names - {one.output_topic}:
            outcome = call(stage, path, "--to", f"/camera/{name}")
            assert (outcome.code, "another --to" in outcome.err) == (1, True), outcome.err
    assert path.read_bytes() == before


LAYOUTS = [
    ("/front/image_raw", "/front/detections", "beside"),
    ("/front/image_raw", "/front/boxes", "/camera/truth"),
    ("/front/camera/image", "/front/yolo/boxes", "beside"),
    ("/cam0/image", "/detector/out", "beside"),
    ("/image", "/boxes", None),
]


def label(path: Path, topic: str) -> None:
    """Write a ground truth track into a log, as ingest does."""
    with log.read(path) as opened:
        times = opened.times(next(name for name in opened.channels))
    frames = [Frame(t_ns, n, tracks_at({1: (n / 10, 1.0)})) for n, t_ns in enumerate(times.tolist())]
    messages = [(frame.t_ns, frame.index, TRACKS.codec.encode(frame.rows)) for frame in frames]
    how = Provenance("ingest", {}, digest=digest(messages)).to_metadata()
    with log.read(path) as opened, log.extend(opened) as writer:
        number = writer.add_channel(topic, (TRACKS.name, "protobuf", TRACKS.descriptor), "protobuf", how)
        for message in messages:
            writer.add_message(number, *message)


@pytest.mark.parametrize(("pictures", "boxes", "truth"), one_in(8, LAYOUTS))
def test_recorded_detections_and_pictures_are_one_camera(tmp_path, pictures, boxes, truth):
    path = tmp_path / "boxes.mcap"
    write_log(path, pictures, boxes=boxes)
    if truth:
        label(path, f"{name_above(pictures)}/truth" if truth == "beside" else truth)
    done("run", path, "--topic", boxes, "--no-tables", "-q")
    with log.read(path) as opened:
        (camera,) = cameras(opened)
        assert (camera.pictures, camera.boxes) == (pictures, boxes)
        assert camera.truth in opened.channels or not truth
        assert [topic for topic in opened.channels if topic.endswith("/tracks")] == [f"{camera.prefix}/tracks"]
    again = json.loads(done("run", path, "--no-tables", "--json", "-q").out)["results"][0]
    assert (again["stages"], again["summary"]["tracks"] > 0) == ([], True)
    again = json.loads(done("run", path, "--topic", boxes, "--no-tables", "--json", "-q").out)["results"][0]
    assert again["stages"] == []
    if truth:
        assert json.loads(done("evaluate", path, "--json", "-q").out)["results"]
    if truth == "beside":
        return  # the rest is slow
    done("events", path, "-q")


def test_two_cameras_keep_their_detections_and_results_apart(tmp_path):
    path = tmp_path / "two.mcap"
    write_log(path, "/front/image", boxes="/front/yolo/boxes")
    write_log(tmp_path / "other.mcap", "/rear/image", boxes="/rear/yolo/boxes")
    with log.read(tmp_path / "other.mcap") as other, log.read(path) as opened, log.extend(opened) as writer:
        for topic in ("/rear/image", "/rear/yolo/boxes"):
            channel = other.channel(topic)
            schema = other.index.schemas[other.index.channels[channel.id].schema_id]
            number = writer.add_channel(topic, (schema.name, schema.encoding, bytes(schema.data)), "cdr", {})
            for message in other.messages(topic):
                writer.add_message(number, message.t_ns, message.sequence, message.payload)
    for side in ("front", "rear"):
        done("run", path, "--topic", f"/{side}/yolo/boxes", "--no-tables", "-q")
    with log.read(path) as opened:
        assert [camera.pictures for camera in cameras(opened)] == ["/front/image", "/rear/image"]
        words = "has several cameras, /front/yolo, /rear/yolo; choose one with `camera=`"
        with pytest.raises(McaptrackError, match=words):
            find_camera(opened)
        assert find_camera(opened, "front") == find_camera(opened, "front/yolo") == "/front/yolo"
    outcome = call("run", path, "--topic", "/front/yolo/boxes", "--camera", "rear")
    assert (outcome.code, "belongs to the camera front/yolo, not to rear" in outcome.err) == (1, True)


def test_a_circular_chain_of_inputs_ends(tmp_path):
    path = tmp_path / "round.mcap"
    with log.create(path) as writer:
        for name, source in (("a", "/x/b"), ("b", "/x/a"), ("c", "/x/c")):
            how = Provenance("track", {}, f"{source}").to_metadata()
            writer.add_channel(f"/x/{name}", (TRACKS.name, "protobuf", TRACKS.descriptor), "protobuf", how)
    with log.read(path) as opened:
        assert [camera.prefix for camera in cameras(opened)] == ["/x"]
    assert call("run", path).code == 1


def test_two_sensors_of_3d_boxes_are_no_cameras(tmp_path):
    lines = "t,class,x_m,y_m,z_m,length_m,width_m,height_m,heading_rad,score\n0,car,1,2,0,4,2,1.5,0,0.5\n"
    (tmp_path / "boxes.csv").write_text(lines)
    path = tmp_path / "a.mcap"
    for sensor in ("lidar", "radar"):
        into = {"into": path} if path.exists() else {"output": path}
        mcaptrack.ingest(tmp_path / "boxes.csv", role="detections", camera=sensor, frame="map", **into)
    with log.read(path) as opened, pytest.raises(McaptrackError, match="has several sensors, /lidar, /radar; choose"):
        find_camera(opened)


def test_only_repaired_tracks_name_the_tracks_that_they_were():
    frames = [Frame(0, 0, TRACKS.rows(track_id=[1, 2], observed=[True, True], source_id=[7, -1]))]
    assert repaired_tracks(frames, None) is frames
    assert repaired_tracks(frames, Provenance("retrack", {})) is frames
    (frame,) = repaired_tracks(frames, Provenance("track", {}))
    assert frame.rows["source_id"].tolist() == [-1, -1]
    assert frames[0].rows["source_id"].tolist() == [7, -1]
