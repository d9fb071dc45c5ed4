"""Stages on logs that others recorded, in place: what was there stays, and what is drawn matches their pictures."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import mcaptrack
from mcaptrack import log, pipeline
from mcaptrack.api import reading
from mcaptrack.errors import McaptrackError
from mcaptrack.foxglove.views import SUFFIX
from mcaptrack.notices import McaptrackWarning
from mcaptrack.schema import DETECTIONS, TRACKS
from mcaptrack.schema.provenance import Provenance
from mcaptrack.transforms import KnnDetector
from tests.commands import GROUP, call
from tests.logs import recorder
from tests.robots import START_NS, stamp_of, write_log
from tests.ros_messages import pixels, ros_writer, vision
from tests.tiers import thorough
from tests.worlds import ns

IMAGES = "/robot/front/image"


def content(path: Path) -> dict[str, list]:
    out: dict[str, list] = {}
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            out.setdefault(channel.topic, []).append(
                (schema.name, schema.data, channel.metadata, message.log_time, message.publish_time, message.sequence, message.data)
            )  # fmt: skip
    return out


def in_place(*words: object) -> None:
    assert not GROUP([*map(str, words), "--in-place"], standalone_mode=False), words


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """Write a recording with one camera; tests must not change it."""
    path = tmp_path_factory.mktemp("theirs") / "robot.mcap"
    write_log(path, IMAGES)
    return path


@pytest.fixture
def robot(recorded, tmp_path) -> Path:
    return Path(shutil.copy(recorded, tmp_path / "robot.mcap"))


def annotations(path: Path, topic: str) -> list[tuple[int, Any]]:
    """The drawings of a channel: in a recording of ROS 2 they are ROS messages."""
    rows, store = content(path)[topic + SUFFIX], get_typestore(Stores.EMPTY)
    name, definition, *_ = rows[0]
    if name == "foxglove.ImageAnnotations":
        return [(row[3], ImageAnnotations.FromString(row[6])) for row in rows]
    store.register(get_types_from_msg(definition.decode(), name))
    return [(row[3], store.deserialize_cdr(row[6], name)) for row in rows]


def stamped(part: Any) -> int:
    stamp = part.timestamp
    return stamp.sec * 10**9 + stamp.nanosec if hasattr(stamp, "sec") else stamp.ToNanoseconds()


@thorough
def test_stages_in_place_keep_all_channels_and_draw_at_capture_times(robot):
    before = content(robot)
    mcaptrack.detect(robot, topic=IMAGES, sidecar=False, views=True)
    mcaptrack.track(robot, sidecar=False, views=True)
    mcaptrack.retrack(robot, sidecar=False, views=True)
    after = content(robot)
    assert after[IMAGES] == before[IMAGES]
    prefix = "/robot/front"
    with log.read(robot) as opened:
        made = Provenance.from_metadata(opened.channel(f"{prefix}/detections").metadata)
        assert (made.transform, made.input) == ("detect", IMAGES)
        found = opened.frames(f"{prefix}/detections", DETECTIONS)
        assert [f.t_ns for f in found] == [row[3] for row in before[IMAGES]]
        assert [f.index for f in found] == list(range(len(found)))
        assert sum(len(f.rows) for f in found) > 20
        assert any(len(f.rows) for f in opened.frames(f"{prefix}/retracks", TRACKS))
        assert pipeline.find_camera(opened, None) == prefix
    for name in ("detections", "tracks", "retracks/full", "retracks/predictions"):
        drawn = annotations(robot, f"{prefix}/{name}")
        assert [t_ns for t_ns, _ in drawn] == [row[3] for row in before[IMAGES]]
        for number, (_, message) in enumerate(drawn):
            for part in (message, *message.points, *message.texts):
                assert stamped(part) == stamp_of(number)
    layout = json.loads(robot.with_suffix(".layout.json").read_text())
    assert layout["configById"]["Image!picture"]["imageMode"]["imageTopic"] == IMAGES


@thorough
def test_run_with_the_only_topic_equals_run_without_a_topic(robot, tmp_path):
    shutil.copy(robot, tmp_path / "b.mcap")
    in_place("run", robot, "-q", "--topic", IMAGES)
    in_place("run", tmp_path / "b.mcap", "-q")
    assert robot.read_bytes() == (tmp_path / "b.mcap").read_bytes()
    assert (tmp_path / "robot.tables").is_dir()


def test_several_cameras_need_a_choice(tmp_path):
    path = tmp_path / "two.mcap"
    write_log(path, "/left/image", "/right/image")
    with log.read(path) as opened, pytest.raises(McaptrackError) as error:
        pipeline.plan_all(opened, pipeline.find_camera(opened, None))
    assert str(error.value) == (
        f"{path} has no channel /camera/video for detect; it has pictures in /left/image, /right/image. "
        "choose one with `topic=`"
    )
    in_place("run", path, "-q", "--topic", "/left/image")
    in_place("detect", path, "-q", "--topic", "/right/image")
    mcaptrack.track(path, camera="right", sidecar=False, views=True)
    with log.read(path) as opened:
        assert pipeline.camera_at(opened, "/right").pictures == "/right/image"
        assert {"/left/retracks", "/right/tracks", "/right/tracks" + SUFFIX} <= set(opened.channels)
        assert "/right/retracks" not in opened.channels


def test_recorded_channels_are_never_replaced(tmp_path):
    path = tmp_path / "boxes.mcap"
    write_log(path, "/eye/image", boxes="/eye/detections")
    before = path.read_bytes()
    with log.read(path) as opened:
        with pytest.raises(
            McaptrackError, match=r"detect would replace /eye/detections, which was recorded by others \(vision"
        ):
            pipeline.plan_stage(opened, "/eye", "detect", KnnDetector(), "/eye/image")
        with pytest.raises(
            McaptrackError, match=r"/eye/detections is there and was recorded by others .*; leave `topic=` out"
        ):
            pipeline.plan_all(opened, "/eye", source="/eye/image")
    mcaptrack.detect(path, topic="/eye/image", to="/eye/found", sidecar=False, views=True)
    assert content(path)["/eye/detections"] == content_of(before, tmp_path)["/eye/detections"]
    assert [stamped(m) for _, m in annotations(path, "/eye/found")] == [stamp_of(n) for n in range(50)]


def content_of(data: bytes, folder: Path) -> dict[str, list]:
    (folder / "before.mcap").write_bytes(data)
    return content(folder / "before.mcap")


@pytest.mark.parametrize("payload", [b"", b"\0\1\0\0garbage", None])
def test_a_damaged_message_is_reported_and_the_log_left_unchanged(robot, tmp_path, payload):
    path = tmp_path / "bad.mcap"
    ros = ros_writer("sensor_msgs/CompressedImage")
    broken = ros.pack(ros.new("sensor_msgs/CompressedImage", ros.header(), "jpeg", pixels(b"no picture")))
    with recorder(path) as writer:
        channel = writer.add_channel("/eye/image", (ros.kind.name, "ros2msg", ros.kind.schema), "cdr")
        writer.add_message(channel, 77, broken if payload is None else payload, 77)
    before = path.read_bytes()
    with log.read(path) as opened, pytest.raises(McaptrackError, match=r"bad\.mcap: /eye/image at 77 ns: ") as error:
        pipeline.run(opened, "/eye", pipeline.plan_stage(opened, "/eye", "detect", KnnDetector()))
    assert "\n" not in str(error.value)
    assert path.read_bytes() == before


def test_a_real_log_of_images_is_processed_in_place(data, tmp_path):
    path = Path(shutil.copyfile(data / "mcap/images/custom-camera-model.mcap", tmp_path / "real.mcap"))
    before = content(path)
    in_place("detect", path, "-q", "--topic", "/image/compressed")
    in_place("track", path, "-q")
    in_place("retrack", path, "-q")
    after = content(path)
    assert {topic: after[topic] for topic in before} == before
    assert len(after["/image/detections"]) == 10
    for row, (t_ns, message) in zip(before["/image/compressed"], annotations(path, "/image/detections"), strict=True):
        said = json.loads(row[6])["timestamp"]
        assert (t_ns, stamped(message)) == (row[3], said["sec"] * 10**9 + said["nsec"])
    with log.read(path) as opened:
        assert "/image/retracks" in opened.channels


def boxes_log(path: Path, *names: str, damaged: bool = False) -> list[int]:
    """Write messages with one more box each, of these classes in turn; return their numbers of boxes."""
    with recorder(path, "ros2") as writer:
        kind = vision("v4", [])[0]
        channel = writer.register_channel(
            "/lidar/boxes", "cdr", writer.register_schema(kind.name, "ros2msg", kind.schema)
        )
        for number in range(4):
            seen = [(10.0 * n, 20.0, 4.0, 8.0, 0.0, [(names[n % len(names)], 0.5)]) for n in range(number)]
            payload = b"\0\1\0\0damaged" if damaged and number == 2 else vision("v4", seen)[1]
            writer.add_message(channel, START_NS + ns(number / 10), payload, START_NS)
    return [0, 1, 2, 3]


def test_recorded_detections_are_in_the_table_of_detections(tmp_path):
    """Class names have numbers, and rows can be joined with their messages."""
    path = tmp_path / "a.mcap"
    counts = boxes_log(path, "person", "car", "7")
    with reading.open(path) as opened, pytest.warns(McaptrackWarning, match="1 is a person, 8 is 'car'"):
        rows, frames = opened.array("detections"), opened.array("frames")
    assert frames[["topic", "t_ns", "rows"]].tolist() == [
        ("/lidar/boxes", START_NS + ns(n / 10), count) for n, count in enumerate(counts)
    ]
    expected = [(n, 10.0 * k - 2, 16.0, 4.0, 8.0, (1, 8, 7)[k]) for n in counts for k in range(n)]
    assert rows[["frame", "x_px", "y_px", "w_px", "h_px", "class_id"]].tolist() == expected
    outcome = call("export", path, "-o", tmp_path / "t", "--json")
    data = json.loads(outcome.out)
    assert (data["results"][0]["rows"]["detections"], [w["code"] for w in data["warnings"]]) == (
        6,
        ["clock", "classes", "classes"],
    )


def test_an_unreadable_message_of_boxes_costs_itself(tmp_path):
    path = tmp_path / "a.mcap"
    boxes_log(path, "person", damaged=True)
    outcome = call("export", path, "-o", tmp_path / "t", "--json")
    data = json.loads(outcome.out)
    assert (outcome.code, data["results"][0]["rows"]["detections"], data["results"][0]["rows"]["frames"]) == (
        0,
        4,
        4,
    )
    (warning,) = [warning for warning in data["warnings"] if warning["code"] == "lost"]
    assert "not a vision_msgs" in warning["message"]
    assert "it counts as empty" in warning["message"]
