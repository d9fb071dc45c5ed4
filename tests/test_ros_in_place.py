"""Results in a recording of ROS 2 itself: ROS tools read the whole file, and mcaptrack the same as from elsewhere."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import mcaptrack
from mcaptrack import log
from mcaptrack.schema import SCHEMAS
from mcaptrack.schema.provenance import Provenance
from tests.bags import MOT
from tests.commands import done
from tests.space_logs import WAYS, Robot, write
from tests.test_ros_recordings import record

Raw = tuple[str, int, bytes]


def drive(folder: Path, version: int = 9, shots: int = 14) -> Path:
    """A rosbag2 folder with the boxes and the transforms of a robot; returns its file."""
    robot = Robot(shots=shots)
    for number, shot in enumerate(robot.shots):
        shot.boxes[:] = [replace(one, centre=one.centre + 0.02 * number) for one in robot.shots[0].boxes]
    source = write(folder.with_suffix(".mcap"), robot, WAYS["detections since humble"])
    with source.open("rb") as stream, Writer2(folder, version=version, storage_plugin=StoragePlugin.MCAP) as writer:
        known: dict[str, Any] = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            if channel.topic not in known:
                store = get_typestore(Stores.ROS2_HUMBLE)
                store.register(get_types_from_msg(schema.data.decode(), schema.name))
                known[channel.topic] = writer.add_connection(channel.topic, schema.name, typestore=store)
            writer.write(known[channel.topic], message.log_time, message.data)
    source.unlink()
    return folder / f"{folder.name}.mcap"


def by_rosbags(path: Path) -> tuple[list[Raw], list[str]]:
    """All messages of a folder or file by rosbags, each of them decoded, and all topics."""
    out = []
    with AnyReader([path]) as reader:
        for connection, t_ns, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)
            out.append((connection.topic, t_ns, bytes(raw)))
        assert reader.message_count == len(out)
        return out, [connection.topic for connection in reader.connections]


def by_mcap_ros2(path: Path) -> Counter[str]:
    """The number of messages of a file by topic, each of them decoded by mcap_ros2."""
    factory = pytest.importorskip("mcap_ros2.decoder").DecoderFactory()
    with path.open("rb") as stream:
        decoded = make_reader(stream, decoder_factories=[factory]).iter_decoded_messages()
        return Counter(channel.topic for _, channel, _, _ in decoded)


def raw(path: Path) -> list[Raw]:
    with path.open("rb") as stream:
        return [(channel.topic, one.log_time, one.data) for _, channel, one in make_reader(stream).iter_messages()]


def metadata(path: Path) -> dict[str, Any]:
    return dict(yaml.safe_load(path.with_name("metadata.yaml").read_text())["rosbag2_bagfile_information"])


def ours(path: Path) -> list[str]:
    with log.read(path, sidecar=False) as opened:
        return sorted(c.topic for c in opened.recorded if Provenance.from_metadata(c.metadata))


def rows_of(path: Path) -> dict[str, tuple[Any, ...]]:
    """The rows of all channels as bytes, with their frames and their making."""
    out = {}
    with log.read(path) as opened:
        for topic, channel in opened.channels.items():
            if channel.schema_name in SCHEMAS:
                found = opened.rows(topic, SCHEMAS[channel.schema_name])
                columns = [found.rows[name].tobytes() for name in found.rows.dtype.names or ()]
                times = (found.t_ns.tolist(), found.sequence.tolist(), found.counts.tolist())
                out[topic] = (channel.schema_name, columns, times, channel.metadata)
    return out


def check_whole(path: Path, recorded: list[Raw]) -> None:
    """Every message of the whole recording is decoded by ROS tools, and those that were recorded are unchanged."""
    names = {topic for topic, *_ in recorded}
    for place in (path.parent, path):
        messages, topics = by_rosbags(place)
        assert [one for one in messages if one[0] in names] == recorded, place
        assert Counter(one[0] for one in messages) == Counter(one[0] for one in raw(path))
        assert set(ours(path)) | names == set(topics)
    assert by_mcap_ros2(path) == Counter(one[0] for one in messages)
    info = metadata(path)
    counts = {one["topic_metadata"]["name"]: one["message_count"] for one in info["topics_with_message_count"]}
    assert counts == Counter(one[0] for one in messages)
    times = [t_ns for _, t_ns, _ in messages]
    for entry in (info, *info["files"]):
        assert entry["message_count"] == len(messages)
        assert entry["starting_time"]["nanoseconds_since_epoch"] == min(times)
        assert entry["duration"]["nanoseconds"] == max(times) - min(times)


RUNS = {
    "pictures": (record, ("--detector", "frame-difference")),
    "boxes": (drive, ("--topic", "/lidar/boxes")),
}


@pytest.fixture(scope="module", params=RUNS)
def ran(request, tmp_path_factory) -> dict[str, Any]:
    """Two copies of a recording, with ground truth and results in it and beside it. Not to be changed."""
    make, words = RUNS[request.param]
    folder = tmp_path_factory.mktemp(request.param)
    path = make(folder / "drive")
    (folder / "gt.txt").write_text(MOT)
    shutil.copytree(path.parent, folder / "beside" / "drive")
    beside = folder / "beside" / "drive" / path.name
    before = raw(path), path.with_name("metadata.yaml").read_bytes()
    told = {}
    for one, how in ((path, ["--in-place"]), (beside, [])):
        if request.param == "pictures":
            done("ingest", folder / "gt.txt", "--into", one, "--as", "truth", "--camera", "robot/front", *how)
        told[one] = done("run", one, *words, "--no-tables", *how)
    return {"path": path, "beside": beside, "recorded": before[0], "metadata": before[1], "words": words, "told": told}


def test_ros_tools_read_the_whole_recording(ran):
    check_whole(ran["path"], ran["recorded"])
    with ran["path"].open("rb") as stream:
        channels = make_reader(stream).get_summary().channels.values()
    assert {channel.message_encoding for channel in channels} == {"cdr"}
    line = f"results are in {ran['path']}: --in-place was given; they are ROS messages, for it is named in"
    assert line in ran["told"][ran["path"]].err


def test_rows_are_those_that_stand_beside(ran):
    there, beside = rows_of(ran["path"]), rows_of(ran["beside"])
    assert len(there) > 6
    assert there == beside
    with mcaptrack.open(ran["path"]) as one, mcaptrack.open(ran["beside"]) as other:
        for name in ("detections", "tracks", "predictions", "events", "counts", "track_summary"):
            drop = {"recording", "file", "chunk_offset", "message_offset"}
            tables = [found.table(name) for found in (one, other)]
            tables = [table.drop_columns([c for c in table.column_names if c in drop]) for table in tables]
            assert tables[0].num_rows or name == "detections"
            assert tables[0].equals(tables[1]), name


def test_a_second_run_does_nothing_and_a_stage_again_stays_whole(ran, tmp_path):
    shutil.copytree(ran["path"].parent, tmp_path / "drive")
    path = tmp_path / "drive" / ran["path"].name
    before = {one.name: one.read_bytes() for one in path.parent.iterdir() if one.is_file()}
    told = done("run", path, "--no-tables", "--json")
    (result,) = json.loads(told.out)["results"]
    assert result["stages"] == []
    assert {one.name: one.read_bytes() for one in path.parent.iterdir() if one.is_file()} == before
    topic = next(one for one in ours(path) if one.endswith("/retracks"))
    done("events", path, "--force")
    check_whole(path, ran["recorded"])
    assert topic in ours(path)


def test_drop_gives_the_recording_back(ran, tmp_path):
    shutil.copytree(ran["path"].parent, tmp_path / "drive")
    path = tmp_path / "drive" / ran["path"].name
    done("drop", path, *ours(path))
    assert ours(path) == []
    assert raw(path) == ran["recorded"]
    assert metadata(path) == yaml.safe_load(ran["metadata"])["rosbag2_bagfile_information"]
    check_whole(path, ran["recorded"])
