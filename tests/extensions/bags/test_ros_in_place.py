"""Results in a recording of ROS 2 itself: ROS tools read the whole file, and mcaptrack the same as from elsewhere."""

from __future__ import annotations

import json
import shlex
import shutil
import sys
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.bags import metadata_yaml
from mcaptrack.registry import BUILT_IN
from mcaptrack.schema import PREDICTIONS, SCHEMAS, TRACKS, Frame
from mcaptrack.schema.encodings import CDR, cdr_codec, record_of
from mcaptrack.schema.provenance import Provenance
from tests.commands import GROUP, call, done
from tests.extensions.bags.bags import FRAMES, MOT, ROS2, T0, bag1, bag2, record
from tests.logs import READING, on_a_log, plain, recorder
from tests.space_logs import WAYS, Robot, write
from tests.tiers import one_in, thorough

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
    entries = {one["topic_metadata"]["name"]: one for one in info["topics_with_message_count"]}
    counts = {topic: one["message_count"] for topic, one in entries.items()}
    assert counts == Counter(one[0] for one in messages)
    theirs = entries[recorded[0][0]]["topic_metadata"]
    for one in entries.values():
        assert one["topic_metadata"].keys() == theirs.keys()
        assert one["topic_metadata"]["offered_qos_profiles"] == theirs["offered_qos_profiles"]
    times = [t_ns for _, t_ns, _ in messages]
    for entry in (info, *info["files"]):
        assert entry["message_count"] == len(messages)
        assert entry["starting_time"]["nanoseconds_since_epoch"] == min(times)
        assert entry["duration"]["nanoseconds"] == max(times) - min(times)


RUNS = {"pictures": (record, ("--detector", "knn")), "boxes": (drive, ("--topic", "/lidar/boxes"))}


@pytest.fixture(scope="module", params=one_in(len(RUNS), RUNS))
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
    with log.read(ran["beside"]) as opened:
        assert {channel.message_encoding for channel in opened.results.recorded} == {"protobuf"}
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


@pytest.fixture(scope="module")
def tracked(tmp_path_factory) -> Path:
    """A recording of two files with tracks in the first one. Not to be changed."""
    folder = tmp_path_factory.mktemp("two") / "drive"
    path = drive(folder, version=8, shots=4)
    info = yaml.safe_load((folder / "metadata.yaml").read_text())
    inner = info["rosbag2_bagfile_information"]
    shutil.copy(path, folder / "drive_1.mcap")
    for counted in (inner, *inner["topics_with_message_count"]):
        counted["message_count"] *= 2
    silent = {"topic_metadata": inner["topics_with_message_count"][0]["topic_metadata"] | {"name": "/silent"}}
    inner["topics_with_message_count"].append(silent | {"message_count": 0})
    inner["files"].append(inner["files"][0] | {"path": "drive_1.mcap"})
    inner["relative_file_paths"].append("drive/drive_1.mcap")
    (folder / "metadata.yaml").write_text(json.dumps(info))  # which is YAML, too
    (folder / "before.yaml").write_bytes((folder / "metadata.yaml").read_bytes())
    mcaptrack.track(path, topic="/lidar/boxes", sidecar=False, views=True)
    return path


@pytest.fixture
def copied(tracked, tmp_path) -> Path:
    shutil.copytree(tracked.parent, tmp_path / "drive")
    return tmp_path / "drive" / "drive.mcap"


@thorough
def test_a_recording_of_several_files_is_counted_as_a_whole(copied):
    other = copied.with_name("drive_1.mcap")
    done("track", other, "--topic", "/lidar/boxes", "--in-place")
    messages, topics = by_rosbags(copied.parent)
    assert Counter(one[0] for one in messages) == Counter(one[0] for path in (copied, other) for one in raw(path))
    assert topics.count("/lidar/tracks") == 1
    info = metadata(copied)
    assert [one["message_count"] for one in info["files"]] == [len(raw(copied)), len(raw(other))]
    assert info["message_count"] == len(messages)
    done("drop", other, *ours(other))
    done("drop", copied, *ours(copied))
    before = yaml.safe_load(copied.with_name("before.yaml").read_text())
    assert metadata(copied) == before["rosbag2_bagfile_information"]


def test_a_command_that_was_killed_before_it_wrote_the_metadata_is_made_good(copied):
    whole = metadata(copied)
    copied.with_name("metadata.yaml").write_bytes(copied.with_name("before.yaml").read_bytes())
    assert metadata(copied) != whole
    done("track", copied, "--topic", "/lidar/boxes")
    assert metadata(copied) == whole


def test_metadata_behind_a_link_is_brought_up_to_date_there(copied):
    path, whole = copied.with_name("metadata.yaml"), metadata(copied)
    elsewhere = copied.parent.parent / "elsewhere.yaml"
    elsewhere.write_bytes(copied.with_name("before.yaml").read_bytes())
    path.unlink()
    path.symlink_to(elsewhere)
    metadata_yaml.update_metadata(copied)
    assert path.is_symlink()
    assert metadata(copied) == whole


def test_files_of_one_recording_may_be_written_at_once(copied, monkeypatch):
    """Another process that counted before this one began may write after it."""
    whole, before = metadata(copied), copied.with_name("before.yaml").read_bytes()
    copied.with_name("metadata.yaml").write_bytes(before)
    published = []

    def publish(path: Path, data: bytes) -> None:
        path.write_bytes(before if len(published) == 1 else data)
        published.append(data)

    monkeypatch.setattr(metadata_yaml, "publish_bytes", publish)
    metadata_yaml.update_metadata(copied)
    assert len(published) == 1
    assert metadata(copied) == whole
    copied.with_name("metadata.yaml").write_bytes(before)
    metadata_yaml.update_metadata(copied)
    assert len(published) == 3
    assert metadata(copied) == whole


def test_metadata_that_can_not_be_brought_up_to_date_is_said(copied):
    copied.with_name("drive_1.mcap").unlink()
    result = done("track", copied, "--topic", "/lidar/boxes", "--force")
    (line,) = [line for line in result.err.splitlines() if "metadata.yaml does not count" in line]
    assert "drive_1.mcap" in line


def test_a_killed_write_leaves_the_recording_as_it_was(copied, monkeypatch):
    before = copied.read_bytes(), metadata(copied)

    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["mcaptrack.log.extend"], "verify", fail)
    with pytest.raises(KeyboardInterrupt):
        mcaptrack.predict(copied, topic="/lidar/tracks", predictor="cv")
    assert (copied.read_bytes(), metadata(copied)) == before


def test_rows_of_a_user_are_counted(copied):
    with mcaptrack.open(copied) as opened:
        rows = opened.table("tracks", "/lidar/tracks")
        assert opened.write("/lidar/tracks/mine/tracks", rows, sidecar=False)
    topics = {one["topic_metadata"]["name"]: one for one in metadata(copied)["topics_with_message_count"]}
    assert topics["/lidar/tracks/mine/tracks"]["topic_metadata"] == {
        "name": "/lidar/tracks/mine/tracks", "type": "mcaptrack_msgs/msg/Tracks", "serialization_format": "cdr",
        "offered_qos_profiles": "", "type_description_hash": "",
    }  # fmt: skip
    first_ns = metadata(copied)["starting_time"]["nanoseconds_since_epoch"]
    with mcaptrack.open(copied) as opened:
        early = [mcaptrack.detections([[1, 2, 3, 4]], t_ns=first_ns - 5, box_format="xywh")]
        assert opened.write("/mine/detections", early, sidecar=False) == 1
    messages = by_rosbags(copied.parent)[0]
    assert {"/lidar/tracks/mine/tracks", "/mine/detections"} < {one[0] for one in messages}
    assert metadata(copied)["starting_time"]["nanoseconds_since_epoch"] == first_ns - 5
    assert metadata(copied)["duration"]["nanoseconds"] == max(one[1] for one in messages) - first_ns + 5


def test_results_that_stand_twice_are_said(copied):
    other = copied.with_name("other")
    shutil.copytree(copied.parent, other)
    lone = other / "drive.mcap"
    done("drop", lone, *ours(lone))
    mcaptrack.track(lone, topic="/lidar/boxes", sidecar=True, views=True)
    shutil.copy(lone.with_name("drive.results.mcap"), copied.with_name("drive.results.mcap"))
    result = mcaptrack.predict(copied, topic="/lidar/tracks", predictor="cv", views=True)
    (line,) = [notice.message for notice in result.warnings if "and in drive.results.mcap" in notice.message]
    assert f"stand in {copied} and in drive.results.mcap; the second is read and replaced" in line


def test_topics_that_ros_does_not_accept_are_said(copied):
    result = mcaptrack.track(copied, topic="/lidar/boxes", to="/lidar/2nd", views=True)
    said = "ROS 2 accepts no topic like /lidar/2nd, /lidar/2nd/view/scene: its tools read these messages"
    assert any(said in notice.message for notice in result.warnings)
    by_rosbags(copied.parent)
    result = done("drop", copied, "/lidar/2nd*")
    assert "ROS 2 accepts" not in result.err


def odd(path: Path, topic: str, record: tuple[str, str, bytes], payloads: list[bytes], t_ns: int = T0) -> Path:
    """A recording of ROS 2 with a channel as other software, or another version, wrote it."""
    with recorder(path, "ros2") as writer:
        channel = writer.add_channel(topic, record, "cdr")
        for number, payload in enumerate(payloads):
            writer.add_message(channel, t_ns + number * 100_000_000, payload, t_ns, number)
    return path


def test_rows_of_another_version_are_read_and_wrong_ones_are_refused_in_one_line(tmp_path):
    name, encoding, data = record_of(TRACKS, CDR)
    rows = TRACKS.rows(
        track_id=[3, 4], x_px=[1, 2], y_px=[1, 2], w_px=[1, 2], h_px=[1, 2], x_m=[1.5, 2], y_m=[0, 1], score=[0.5, 1],
        observed=[True, False], source_id=[-1, 7],
    )  # fmt: skip
    payloads = cdr_codec(TRACKS).encode_all(rows, np.array([2]))
    path = odd(tmp_path / "a.mcap", "/own/tracks", (name, encoding, data), [*payloads, *payloads])
    with mcaptrack.open(path) as opened:
        assert opened.array("tracks")["track_id"].tolist() == [3, 3, 4, 4]
        assert opened.array("tracks")["x_m"].tolist() == [1.5, 1.5, 2, 2]
    for number, (wrong, said) in enumerate(
        [
            (
                (name, encoding, data.replace(b"int64 track_id", b"int32 track_id")),
                "its definition of mcaptrack_msgs/TracksRow has int32 track_id, not int64",
            ),
            ((name, encoding, b"string data\n"), "its definition has not one field, rows"),
            ((name, encoding, b""), "its definition has not one field, rows"),
        ]
    ):
        path = odd(tmp_path / f"{number}.mcap", "/own/tracks", wrong, payloads)
        result = call("export", path)
        assert (result.code, result.err.count("\n")) == (1, 1), result.err
        assert f"/own/tracks can't be read as mcaptrack.Tracks: {said}" in result.err
    path = odd(tmp_path / "cut.mcap", "/own/tracks", (name, encoding, data), [payloads[0][:-9]])
    result = call("export", path)
    assert (result.code, result.err.count("\n")) == (1, 1)
    assert f"{len(payloads[0]) - 9} bytes are not a CDR message of its definition" in result.err


def test_times_that_ros_does_not_have_are_refused_in_one_line(tmp_path):
    name, encoding, data = record_of(TRACKS, CDR)
    rows = TRACKS.rows(
        track_id=[3], x_px=[1], y_px=[1], w_px=[1], h_px=[1], x_m=[1.5], y_m=[0], score=[0.5], observed=[True],
        source_id=[-1],
    )  # fmt: skip
    payloads = cdr_codec(TRACKS).encode_all(rows, np.array([1])) * 20
    path = odd(tmp_path / "a.mcap", "/own/tracks", (name, encoding, data), payloads, 2**31 * 10**9)
    before = path.read_bytes()
    with pytest.raises(McaptrackError, match="ROS has times from 1970 to 2038 only"):
        mcaptrack.predict(path, topic="/own/tracks", sidecar=False, predictor="cv", views=True)
    assert path.read_bytes() == before


def test_a_recording_of_ros_1_gets_protobuf_and_that_is_said(tmp_path):
    path = odd(tmp_path / "a.mcap", "/own/tracks", record_of(TRACKS, CDR), [])
    data = path.read_bytes().replace(b"ros2", b"ros1", 1)
    path.write_bytes(data)
    (tmp_path / "gt.txt").write_text(MOT)
    result = done(
        "ingest", tmp_path / "gt.txt", "--as", "truth", "--into", path, "--in-place", "--frames", "30", "--fps", "10"
    )
    assert "--in-place was given; ROS tools may stumble over them, for it is a ROS 1 recording" in result.err
    with log.read(path) as opened:
        assert opened.channel("/camera/truth").message_encoding == "protobuf"


def test_a_bag_of_ros_1_in_a_recording_of_ros_2_is_said(copied):
    bag1(copied.parent / "a.bag", 3, 50)
    result = done("ingest", copied.parent / "a.bag", "--into", copied, "--in-place")
    assert f"{copied} gets messages that are not of ROS 2 (encoding: ros1); ROS tools may stumble" in result.err
    assert "/talk" not in {one["topic_metadata"]["name"] for one in metadata(copied)["topics_with_message_count"]}
    (copied.parent / "a.bag").unlink()


def test_a_recording_with_compressed_messages_is_not_mixed_with_others(tmp_path):
    bag2(tmp_path / "bag", "MCAP", "MESSAGE")
    path = tmp_path / "bag" / "bag.mcap"
    before = path.read_bytes(), metadata(path)
    (tmp_path / "gt.txt").write_text(MOT)
    words = ["--as", "truth", "--frames", "30", "--fps", "10", "--into", path]
    result = call("ingest", tmp_path / "gt.txt", *words, "--in-place")
    assert (result.code, result.err.count("\n")) == (1, 1)
    assert "compressed one by one; results in bag.mcap would not be" in result.err
    assert "use --sidecar, and neither --in-place nor -o" in result.err
    assert (path.read_bytes(), metadata(path)) == before


@dataclass
class Fix:
    """A position of a receiver."""

    t_ns: int
    lat: Annotated[float, "deg"]
    lon: float | None = None


@thorough
def test_rows_of_a_schema_of_the_user_are_messages_of_the_recording_and_of_a_bag(tmp_path):
    path = drive(tmp_path / "drive", shots=4)
    recorded = raw(path)
    steps = {"track_id": [3], "step": [1], "ahead_s": [0.4], "x_m": [1.0], "y_m": [2.0]}
    forecasts = PREDICTIONS.rows(**{name: np.array(values) for name, values in steps.items()})
    with mcaptrack.open(path) as opened:
        for topic in ("/gps/a", "/gps/b"):
            opened.write(topic, [Fix(T0, 1.0), Fix(T0 + 5, 2.0, 3.0)], sidecar=False)
        opened.write("/gps/predictions", [Frame(T0, 0, forecasts)], sidecar=False)
    check_whole(path, recorded)
    bag = mcaptrack.export(path, form="rosbag2", output=tmp_path / "bag").folder
    with AnyReader([bag]) as reader:
        found = [(c.topic, t, reader.deserialize(content, c.msgtype)) for c, t, content in reader.messages()]
    for topic in ("/gps/a", "/gps/b"):
        mine = [(t_ns, row.lat, row.lon) for name, t_ns, message in found if name == topic for row in message.rows]
        np.testing.assert_array_equal(mine, [(T0, 1, np.nan), (T0 + 5, 2, 3)])


# Recordings that ROS tools read: they stay as they are, and are read together with their results


COMMANDS = GROUP.commands


def on_disk(folder: Path) -> dict[str, tuple[int, bytes]]:
    return {entry.name: (entry.stat().st_mtime_ns, entry.read_bytes()) for entry in folder.iterdir() if entry.is_file()}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """Not to be changed."""
    return record(tmp_path_factory.mktemp("recorded") / "drive")


@pytest.fixture
def path(recorded, tmp_path) -> Path:
    shutil.copytree(recorded.parent, tmp_path / "drive")
    return tmp_path / "drive" / "drive.mcap"


def person(number: int) -> dict[str, float]:
    """Who is seen in a picture."""
    known = {"track_id": 1, "x_px": 2 + number, "y_px": 20, "w_px": 10, "h_px": 16, "score": 1.0}
    return known | {"x_m": np.nan, "y_m": np.nan, "observed": True, "source_id": -1}


def on_recording(path: Path, elsewhere: Path) -> dict[str, list[object]]:
    """A way to give a recording to each command, so that a command finds what those before it wrote."""
    truth = elsewhere / "truth.mcap"
    with log.create(truth) as writer:
        record = (TRACKS.name, "protobuf", TRACKS.descriptor)
        channel = writer.add_channel("/robot/front/truth", record, "protobuf", {})
        for number in range(FRAMES):
            rows = TRACKS.rows(**{name: [value] for name, value in person(number).items()})
            writer.add_message(channel, T0 + number * 100_000_000, number, TRACKS.codec.encode(rows))
    own = {
        "ingest": [truth, "--into", path],
        "detect": [path, "--detector", "knn"],
        "predict": [path, "--predictor", "cv"],
        "drop": [path, "/robot/front/retracks*"],
    }
    names = [name for name in COMMANDS if name in READING]
    return {name: own.get(name) or on_a_log(name, path, elsewhere) for name in names}


def test_no_command_changes_a_recording_that_ros_tools_read(path, tmp_path):
    """Neither its bytes nor what others read of it; what is written stands beside it, and all commands see it."""
    before, theirs = on_disk(path.parent), by_rosbags(path.parent)
    assert len(theirs[0]) == FRAMES
    results = path.with_name("drive.results.mcap")
    for name, words in on_recording(path, tmp_path).items():
        was = results.read_bytes() if results.exists() else b""
        result = call(name, *words)
        assert result.code == 0 or name == "view" or name not in BUILT_IN["command"], result.err
        now = on_disk(path.parent)
        assert {part: now[part] for part in before} == before, name
        if not result.code and "sidecar" in {parameter.name for parameter in COMMANDS[name].params}:
            assert results.read_bytes() != was, name
            lines = [line for line in result.err.splitlines() if str(results) in line]
            assert len(lines) == 1, (name, result.err)
            assert ("earlier results are there" in lines[0]) == bool(was)
            assert was or "drive.mcap is named in" in lines[0]
            assert was or "--in-place writes into it all the same" in lines[0]
    assert by_rosbags(path.parent) == theirs
    with log.read(path) as opened:
        assert "/robot/front/truth" in opened.channels
        assert "/robot/front/detections" in opened.channels
        assert "/robot/front/retracks" not in opened.channels
    assert not list(path.parent.glob("*.retracks*"))


def test_what_was_written_where_and_why_stands_in_the_data(path):
    for why in ("--in-place writes into it all the same", "earlier results are there"):
        method = "median" if "there" in why else "knn"
        (result,) = json.loads(done("detect", path, "--detector", method, "--json").out)["results"]
        assert result["written_to"] == str(path.with_name("drive.results.mcap"))
        assert why in result["written_there_because"]
    (result,) = json.loads(done("detect", path, "--sidecar", "--json").out)["results"]
    assert result["written_there_because"] == "--sidecar was given"


def test_results_that_a_pattern_matches_too_are_part_of_their_log(path):
    done("detect", path, "--detector", "knn")
    pattern = path.parent / "*.mcap"
    assert len(list(path.parent.glob("*.mcap"))) == 2
    (result,) = json.loads(done("track", pattern, "--json").out)["results"]
    assert result["log"] == str(path)
    checked = json.loads(done("check", pattern, "--json").out)["results"]
    assert [result["log"] for result in checked] == [str(path), str(path.with_name("drive.results.mcap"))]


def test_in_place_insists_and_what_is_in_place_goes_on_there(path):
    result = done("detect", path, "--in-place", "--detector", "knn")
    assert f"results are in {path}: --in-place was given; they are ROS messages, for it is named in" in result.err
    with path.open("rb") as stream:
        assert "/robot/front/detections" in {c.topic for c in make_reader(stream).get_summary().channels.values()}
    result = done("track", path)
    (line,) = [line for line in result.err.splitlines() if "results are in" in line]
    assert f"results are in {path}: earlier results are in it; they are ROS messages, for it is named in" in line
    assert [entry.name for entry in path.parent.glob("*.mcap")] == ["drive.mcap"]
    done("drop", path, "/robot/front/*detections*", "/robot/front/tracks*")  # ours
    result = call("drop", path, "/robot/front/image")
    assert result.code == 1
    assert (
        "/robot/front/image was recorded, and can't be made again; -o writes a copy without, --in-place removes"
        in result.err
    )
    done("drop", path, "/robot/front/image", "--in-place")


def test_in_place_is_refused_where_results_stand_beside(path):
    mcaptrack.detect(path, detector="knn", views=True)
    before = on_disk(path.parent)
    result = call("track", path, "--in-place")
    assert result.code == 1
    assert "--in-place would leave them there and make others: remove drive.results.mcap first" in result.err
    assert on_disk(path.parent) == before


def test_a_copy_without_channels_has_its_results_beside_it(path, tmp_path):
    mcaptrack.detect(path, detector="knn", views=True)
    before = on_disk(path.parent)
    out = tmp_path / "small.mcap"
    done("drop", path, "/robot/front/image", "/robot/front/detections/*", "-o", out)
    assert on_disk(path.parent) == before
    with log.read(out) as opened:
        assert "/robot/front/image" not in opened.channels
        assert opened.channel("/robot/front/detections").messages == FRAMES
        assert opened.results is not None
    result = call("track", path, "--in-place", "-o", tmp_path / "b.mcap")
    assert (result.code, "--in-place and -o are two places" in result.err) == (1, True)


METADATA = "rosbag2_bagfile_information:\n  relative_file_paths: [{}]\n"


@pytest.mark.parametrize(
    ("profile", "library", "metadata", "is_beside"),
    [
        ("ros1", "robot", "", True),
        ("ros2", "robot", "", True),
        ("", "robot", "", False),
        ("ros2", "mcaptrack 0.1.0", "", False),
        ("", "robot", METADATA.format("a.mcap"), True),
        ("", "robot", METADATA.format("b.mcap"), False),
        ("ros2", "mcaptrack 0.1.0", METADATA.format("a.mcap"), True),
        ("", "robot", METADATA.format("[a"), True),
        ("", "robot", "other: 1\n", False),
    ],
)
def test_recordings_are_told_by_profile_and_by_the_metadata_beside_them(
    tmp_path, profile, library, metadata, is_beside
):
    path = plain(tmp_path / "a.mcap", profile, library)
    before = path.read_bytes()
    if metadata:
        (tmp_path / "metadata.yaml").write_text(metadata)
    bag1(tmp_path / "a.bag", 3, 50)
    result = done("ingest", tmp_path / "a.bag", "--into", path)
    assert path.with_name("a.results.mcap").exists() == is_beside
    assert (path.read_bytes() == before) == is_beside
    assert ("results are in" in result.err) == is_beside
    link = tmp_path / "elsewhere" / "link.mcap"
    link.parent.mkdir()
    link.symlink_to(path)
    with log.read(link, sidecar=False) as opened:
        from mcaptrack.sources.sidecar import recording_of

        assert bool(recording_of(opened)) == is_beside


def others(folder: Path) -> list[Path]:
    """Recordings that are no logs yet, of every kind."""
    bag1(folder / "a.bag", 3, 50)
    bag2(folder / "files")
    bag2(folder / "logs", "MCAP")
    shutil.copytree(folder / "files", folder / "no metadata; 'x' $y")
    (folder / "no metadata; 'x' $y" / "metadata.yaml").unlink()
    writer = Writer2(folder / "packed", version=9)
    writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/a", "std_msgs/msg/String", typestore=ROS2)
        writer.write(connection, 1, b"\0\1\0\0\0\0\0\0")
    files = [folder / "files" / "files.db3", folder / "packed" / "packed.db3.zstd"]
    return [folder / "a.bag", *(folder / name for name in ("files", "logs", "no metadata; 'x' $y")), *files]


def test_whatever_is_given_a_recording_that_is_no_log_says_how_to_make_one(tmp_path, monkeypatch):
    """And what it says works."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    for number, recording in enumerate(others(tmp_path / "there")):
        said = set()
        for name, words in (on_recording(Path("RECORDING"), tmp_path) | {"view": [Path("RECORDING")]}).items():
            if not words or name == "ingest" or (number > 1 and name != "info"):
                continue  # the kinds are told apart in one place
            result = call(name, *(recording if word == Path("RECORDING") else word for word in words))
            assert result.code == 1, (name, recording, result.err)
            assert result.err.count("\n") == 1, (name, recording, result.err)
            said.add(result.err.split("`")[1])
        (command,) = said
        program, *words = shlex.split(command)
        assert (program, words[0]) == ("mcaptrack", "ingest")
        (tmp_path / str(number)).mkdir()
        monkeypatch.chdir(tmp_path / str(number))
        done(*words)
        (made,) = Path.cwd().iterdir()
        done("info", made)
