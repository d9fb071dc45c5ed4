"""Recordings become logs with everything that is in them: read again by the stock MCAP library, message for message."""

from __future__ import annotations

import bz2
import sqlite3
import struct
from collections import Counter
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import Writer as Writer1

from mcaptrack import log
from mcaptrack.contracts import ReadingNotes
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.bags.formats import RosBags
from mcaptrack.extensions.bags.metadata_yaml import names_file, read_metadata
from mcaptrack.extensions.bags.rosbag2 import open_bag, open_files
from mcaptrack.extensions.bags.sqlite_tables import SqliteTables
from mcaptrack.extensions.bags.unpacking import decompress_steps
from mcaptrack.notices import collected
from mcaptrack.schema import GROUND_PLANE, TRACKS
from mcaptrack.schema.as_rows import rows_to_plane
from mcaptrack.sources.foreign import definitions
from mcaptrack.sources.ingest import IngestOptions, decompression, ingest, recording
from mcaptrack.testing import check_recording_format
from tests.extensions.bags.bags import MOT, ROS1, ROS2, STRING1, T0, bag1, bag2, camera_bag, database
from tests.logs import plain, recorder


def recorded(path: Path) -> list[tuple[str, int, int, bytes]]:
    """Topic, log time, publish time and payload of all messages, as the stock reader finds them, by time."""
    with path.open("rb") as stream:
        found = [(c.topic, m.log_time, m.publish_time, m.data) for _, c, m in make_reader(stream).iter_messages()]
    return sorted(found)


def summary(path: Path):
    with path.open("rb") as stream:
        reader = make_reader(stream)
        return reader.get_header(), reader.get_summary()


def channels(path: Path) -> list[tuple]:
    """Topic, encoding, schema and metadata of all channels, and how many messages they have."""
    _, found = summary(path)
    counts = found.statistics.channel_message_counts
    out = []
    for channel in found.channels.values():
        schema = found.schemas.get(channel.schema_id)
        words = (schema.name, schema.encoding, schema.data) if schema else None
        out.append((channel.topic, channel.message_encoding, words, channel.metadata, counts.get(channel.id, 0)))
    return out


def make(source: Path, output: Path, **options):
    return ingest(source, output, IngestOptions(**options))


class TestRos1:
    @pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
    def test_every_message_is_there(self, tmp_path, compression):
        bag = tmp_path / "a.bag"
        said = bag1(bag, size=9_000, compression=compression)
        report = make(bag, tmp_path / "a.mcap")
        assert recorded(tmp_path / "a.mcap") == sorted(said)
        assert report.messages == {"/talk": 60, "/silent": 0}
        assert report.lost == []

    def test_a_channel_for_each_connection(self, tmp_path):
        bag1(tmp_path / "a.bag")
        make(tmp_path / "a.bag", tmp_path / "a.mcap")
        left, right, silent = channels(tmp_path / "a.mcap")
        assert summary(tmp_path / "a.mcap")[0].profile == "ros1"
        definition, md5 = ROS1.generate_msgdef(STRING1)
        assert left[:3] == right[:3] == ("/talk", "ros1", ("std_msgs/String", "ros1msg", definition.encode()))
        assert left[3].items() >= {"callerid": "/left", "latching": "true", "md5sum": md5}.items()
        assert right[3].items() >= {"callerid": "/right", "latching": "false", "md5sum": md5}.items()
        assert (left[4], right[4]) == (40, 20)
        assert silent[0] == "/silent"
        assert b"MSG: std_msgs/Header" in silent[2][2]
        assert silent[4] == 0

    @pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
    def test_of_a_cut_bag_what_is_complete_is_read(self, tmp_path, compression):
        whole = tmp_path / "whole.bag"
        said = bag1(whole, 30, 20_000, compression)
        data, seen = whole.read_bytes(), set()
        for share in (0.1, 0.35, 0.5, 0.77, 0.9):
            cut = tmp_path / f"{share}.bag"
            cut.write_bytes(data[: int(len(data) * share)])
            report = make(cut, tmp_path / f"{share}.mcap")
            there = recorded(tmp_path / f"{share}.mcap")
            assert there == sorted(said[: len(there)])
            assert f"{cut} is cut off" in report.lost[0]
            seen.add(len(there))
            # Not more than a chunk is lost, and without compression not more than a message.
            complete = len(said) * share
            assert len(there) >= complete - (2 if compression is None else 12)
        assert len(seen) >= 3

    def test_a_recording_that_was_killed_is_read_to_its_end(self, tmp_path):
        """As the recorder leaves it: no index, and the last chunk says that it has 0 bytes."""
        said = bag1(tmp_path / "a.bag", 30, 20_000)
        data = bytearray((tmp_path / "a.bag").read_bytes())
        with Reader1(tmp_path / "a.bag") as reader:
            last = max(reader.chunk_infos, key=lambda chunk: chunk.pos).pos
            size = reader.chunks[last].datasize
        index = data.index(b"index_pos=") + 10
        end = struct.unpack("<Q", data[index : index + 8])[0]
        head = struct.unpack("<I", data[last : last + 4])[0]
        data[index : index + 8] = bytes(8)
        data[last + 4 + head : last + 8 + head] = bytes(4)
        said_size = data.index(b"size=", last) + 5
        data[said_size : said_size + 4] = bytes(4)
        assert last + 8 + head + size < end
        (tmp_path / "a.bag.active").write_bytes(data[: last + 8 + head + size])
        report = make(tmp_path / "a.bag.active", tmp_path / "b.mcap")
        assert recorded(tmp_path / "b.mcap") == sorted(said)
        assert report.lost == []
        assert "was never closed" in report.notes[0]

    def test_of_a_damaged_chunk_the_others_are_read(self, tmp_path):
        said = bag1(tmp_path / "a.bag", 60, 20_000, "BZ2")
        data = bytearray((tmp_path / "a.bag").read_bytes())
        with Reader1(tmp_path / "a.bag") as reader:
            position = sorted(reader.chunks)[2]
            chunk = reader.chunks[position]
            gone = sum(next(c for c in reader.chunk_infos if c.pos == position).connection_counts.values())
        data[chunk.datapos : chunk.datapos + 4] = b"...."
        (tmp_path / "a.bag").write_bytes(data)
        report = make(tmp_path / "a.bag", tmp_path / "a.mcap")
        there = recorded(tmp_path / "a.mcap")
        assert len(there) == len(said) - gone
        assert set(there) < set(said)
        assert "can't be decompressed" in report.lost[0]
        assert sum(int(words.split(": ")[-1].split(" of ")[0]) for words in report.lost[1:]) == gone

    def test_an_index_that_counts_otherwise_is_refused(self, tmp_path):
        bag1(tmp_path / "a.bag", 5, 100)
        data = (tmp_path / "a.bag").read_bytes()
        # The last chunk info ends with pairs of connection and count; one message more than there is.
        right = data[:-4] + struct.pack("<I", struct.unpack("<I", data[-4:])[0] + 1)
        (tmp_path / "a.bag").write_bytes(right)
        with pytest.raises(McaptrackError, match="does not add up: its index counts"):
            make(tmp_path / "a.bag", tmp_path / "a.mcap")
        assert not (tmp_path / "a.mcap").exists()

    def test_definitions_in_latin_letters_become_readable(self, tmp_path):
        with Writer1(tmp_path / "a.bag") as writer:
            writer.add_connection("/t", "a/msg/B", msgdef="string x # 20 ~~C", md5sum="0" * 32)
        data = (tmp_path / "a.bag").read_bytes().replace(b"20 ~~C", b"20 \xb0\xb0C")
        (tmp_path / "a.bag").write_bytes(data)
        make(tmp_path / "a.bag", tmp_path / "a.mcap")
        assert channels(tmp_path / "a.mcap")[0][2][2].decode() == "string x # 20 \u00b0\u00b0C"

    def test_what_is_no_bag_is_refused_in_a_line(self, tmp_path):
        for data, words in (
            (b"", "is empty"),
            (b"#ROSBAG V1.2\nwhatever", "of version 1.2; 2.0 is read"),
            (b"#ROSBAG V2.0\n", "a record is cut off"),
            (b"#ROSBAG V2.0\n" + b"\xff" * 5000, "a record is cut off or invalid"),
            (b"hello", "does not begin as one does"),
        ):
            (tmp_path / "a.bag").write_bytes(data)
            with pytest.raises(McaptrackError, match=words):
                make(tmp_path / "a.bag", tmp_path / "a.mcap")
            assert not (tmp_path / "a.mcap").exists()

    def test_whatever_is_done_to_a_bag_it_is_read_or_refused(self, tmp_path):
        said = set(bag1(tmp_path / "a.bag", 12, 500))
        check_recording_format(RosBags(), tmp_path / "a.bag")
        data = (tmp_path / "a.bag").read_bytes()
        dice = np.random.default_rng(11)
        outcomes = Counter()
        for _ in range(150):
            broken = bytearray(data)
            for at in dice.integers(0, len(data), 4):
                broken[at] = dice.integers(256)
            (tmp_path / "b.bag").write_bytes(broken)
            try:
                report = make(tmp_path / "b.bag", tmp_path / "b.mcap")
            except McaptrackError as error:
                assert "\n" not in str(error)
                outcomes["refused"] += 1
            else:
                there = recorded(tmp_path / "b.mcap")
                assert len(there) == 12 or report.lost
                outcomes["lost" if report.lost else "whole"] += 1
                # Times and payloads have no checksum in a bag.
                assert report.lost or len(set(there) & said) >= len(there) - 4
        assert min(outcomes[word] for word in ("refused", "lost", "whole")) > 0


class TestRosbag2:
    @pytest.mark.parametrize("version", [8, 9])
    @pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
    def test_a_folder_is_kept_whole(self, tmp_path, storage, version):
        said = bag2(tmp_path / "bag", storage, version=version)
        report = make(tmp_path / "bag", tmp_path / "a.mcap")
        assert recorded(tmp_path / "a.mcap") == sorted(said)
        assert report.messages == {"/talk": 30, "/image": 10, "/silent": 0}
        check_recording_format(RosBags(), tmp_path / "bag")
        header, _ = summary(tmp_path / "a.mcap")
        assert header.profile == "ros2"
        kept = {topic: about for topic, *about, _ in channels(tmp_path / "a.mcap")}
        encoding, schema, _ = kept["/image"]
        definition = ROS2.generate_msgdef("sensor_msgs/msg/CompressedImage", ros_version=2)[0]
        assert (encoding, schema[:2]) == ("cdr", ("sensor_msgs/msg/CompressedImage", "ros2msg"))
        assert schema[2].decode().split() == definition.split()
        assert "depth: 10" in kept["/talk"][2]["offered_qos_profiles"]
        if storage == "SQLITE3":
            assert kept["/talk"][2]["topic_type_hash"] == ROS2.hash_rihs01(STRING1)
        with (tmp_path / "a.mcap").open("rb") as stream:
            attached = {a.name: a.data for a in make_reader(stream).iter_attachments()}
        assert attached == {"metadata.yaml": (tmp_path / "bag" / "metadata.yaml").read_bytes()}

    @pytest.mark.parametrize("mode", ["FILE", "MESSAGE"])
    def test_compressed_databases(self, tmp_path, mode):
        said = bag2(tmp_path / "bag", compression=mode)
        make(tmp_path / "bag", tmp_path / "a.mcap")
        assert recorded(tmp_path / "a.mcap") == sorted(said)
        single = next(path for path in (tmp_path / "bag").iterdir() if ".db3" in path.name)
        make(single, tmp_path / "b.mcap")
        assert recorded(tmp_path / "b.mcap") == sorted(said)
        (tmp_path / "bag" / "metadata.yaml").unlink()
        make(single, tmp_path / "c.mcap")
        assert recorded(tmp_path / "c.mcap") == sorted(said)

    @pytest.mark.parametrize("with_metadata", [True, False])
    @pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
    def test_parts_become_one(self, tmp_path, storage, with_metadata):
        said, names = [], []
        (tmp_path / "bag").mkdir()
        for part in range(11):
            said += bag2(tmp_path / f"part{part}", storage, start=40 * part)
            suffix = "db3" if storage == "SQLITE3" else "mcap"
            file = next((tmp_path / f"part{part}").glob(f"*.{suffix}"))
            names.append(f"bag_{part}.{suffix}")
            file.rename(tmp_path / "bag" / names[-1])
        if with_metadata:
            text = (tmp_path / "part0" / "metadata.yaml").read_text().splitlines()
            at = next(number for number, line in enumerate(text) if "relative_file_paths" in line)
            indent = text[at][: len(text[at]) - len(text[at].lstrip())]
            text[at : at + 2] = [f"{indent}relative_file_paths:", *(f"{indent}  - {name}" for name in names)]
            (tmp_path / "bag" / "metadata.yaml").write_text("\n".join(text) + "\n")
        report = make(tmp_path / "bag", tmp_path / "a.mcap")
        assert recorded(tmp_path / "a.mcap") == sorted(said)
        counts = {topic: count for topic, *_, count in channels(tmp_path / "a.mcap")}
        assert [*counts.items()] == [("/talk", 330), ("/image", 110), ("/silent", 0)]
        assert summary(tmp_path / "a.mcap")[0].profile == "ros2"
        assert report.lost == []
        (tmp_path / "bag" / names[5]).unlink()
        if with_metadata:
            with pytest.raises(McaptrackError, match=f"names .*{names[5]}, which does not exist"):
                make(tmp_path / "bag", tmp_path / "b.mcap")

    @pytest.mark.parametrize("version", [1, 2, 3, 4])
    def test_databases_without_definitions_get_those_of_their_distribution(self, tmp_path, version):
        extra = [("qos",), ("qos",), ("qos",), ("qos", "")][version - 1] if version >= 2 else ()
        types = [STRING1, "sensor_msgs/msg/Image", "robot_msgs/msg/Secret", STRING1]
        topics = [(n + 1, name, kind, "cdr", *extra) for n, (name, kind) in enumerate(zip("abca", types, strict=True))]
        word, image, head, time = (
            ROS2.types[kind] for kind in (*types[:2], "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
        )
        picture = image(head(time(1, 2), "eye"), 0, 0, "", 0, 0, np.empty(0, np.uint8))
        payloads = [
            bytes(ROS2.serialize_cdr(word("hello"), STRING1)),
            bytes(ROS2.serialize_cdr(picture, types[1])),
            b"\0\1\0\0?",
            bytes(ROS2.serialize_cdr(word("there"), STRING1)),
        ]
        messages = [(1 + number % 4, T0 + number, payloads[number % 4]) for number in range(9)]
        database(tmp_path / "a.db3", version, messages, topics)
        with collected() as warnings:
            report = make(tmp_path / "a.db3", tmp_path / "a.mcap")
        assert recorded(tmp_path / "a.mcap") == sorted(("abca"[key - 1], t, t, data) for key, t, data in messages)
        found = channels(tmp_path / "a.mcap")
        wanted = [("a", STRING1, 3), ("b", types[1], 2), ("c", types[2], 2), ("a", STRING1, 2)]
        assert [(channel[0], channel[2][0], channel[4]) for channel in found] == wanted
        assert found[1][2][1] == "ros2msg"
        assert b"MSG: std_msgs/Header" in found[1][2][2]
        assert found[2][2] == ("robot_msgs/msg/Secret", "", b"")
        assert found[0][3]["offered_qos_profiles"] == ("qos" if version >= 2 else "")
        words = " ".join(report.notes)
        assert "does not say what sensor_msgs/msg/Image is; its definition is that of ROS 2" in words
        assert "its definition is that of ROS 2 Dashing to Lyrical, which fits its messages" in words
        (warning,) = warnings
        assert "robot_msgs/msg/Secret is; its definition is not known" in warning.message
        assert warning.code == "definitions"

    def test_definitions_are_kept_as_they_are(self, tmp_path):
        idl = "=" * 80 + "\nIDL: robot_msgs/msg/Secret\nmodule robot_msgs {};"
        database(tmp_path / "a.db3", 4, [], [(1, "/s", "robot_msgs/msg/Secret", "cdr", "", "")])
        with sqlite3.connect(tmp_path / "a.db3") as db:
            db.execute(
                "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, encoding TEXT,"
                " encoded_message_definition TEXT, type_description_hash TEXT)"
            )
            db.execute(
                "INSERT INTO message_definitions VALUES (1, 'robot_msgs/msg/Secret', 'ros2idl', ?, 'RIHS01_x')", (idl,)
            )
        db.close()
        make(tmp_path / "a.db3", tmp_path / "a.mcap")
        ((_, _, schema, metadata, count),) = channels(tmp_path / "a.mcap")
        assert schema == ("robot_msgs/msg/Secret", "ros2idl", idl.encode())
        assert metadata["topic_type_hash"] == "RIHS01_x"
        assert count == 0

    def test_a_definition_of_another_hash_is_not_taken(self, tmp_path):
        topics = [(1, "/a", STRING1, "cdr", "", "RIHS01_" + "0" * 64)]
        topics.append((2, "/b", "sensor_msgs/msg/Image", "cdr", "", ROS2.hash_rihs01("sensor_msgs/msg/Image")))
        database(tmp_path / "a.db3", 4, [], topics)
        make(tmp_path / "a.db3", tmp_path / "a.mcap")
        first, second = channels(tmp_path / "a.mcap")
        assert first[2] == (STRING1, "", b"")
        assert second[2][1] == "ros2msg"

    def test_messages_of_no_topic_are_missed(self, tmp_path):
        database(tmp_path / "a.db3", 3, [(1, 5, b"a"), (7, 6, b"b")], [(1, "/a", STRING1, "cdr", "")])
        report = make(tmp_path / "a.db3", tmp_path / "a.mcap")
        assert recorded(tmp_path / "a.mcap") == [("/a", 5, 5, b"a")]
        assert "1 messages of topic 7, which is not described" in report.lost[0]

    def test_faults_are_lines(self, tmp_path):
        faults = {
            "a.db3": b"SQLite format 3\0" + bytes(500), "b.db3": b"x", "c.mcap": b"\x89MCAP0\r\nxx", "d.mcap": b"",
        }  # fmt: skip
        for name, data in faults.items():
            (tmp_path / name).write_bytes(data)
            with pytest.raises(McaptrackError, match=rf"{name} (is|can't)[^\n]*$"):
                make(tmp_path / name, tmp_path / "out.mcap")
        sqlite3.connect(tmp_path / "e.db3").execute("CREATE TABLE cats(name)").connection.close()
        with pytest.raises(McaptrackError, match="is a database, but none of rosbag2"):
            make(tmp_path / "e.db3", tmp_path / "out.mcap")
        (tmp_path / "g").mkdir()
        for name in ("one.mcap", "two.mcap"):
            (tmp_path / "g" / name).write_bytes(b"")
        with pytest.raises(
            McaptrackError,
            match=r"holds several recordings, which are no parts of one; give one.mcap and so on by name",
        ):
            make(tmp_path / "g", tmp_path / "out.mcap")
        assert not (tmp_path / "out.mcap").exists()

    @pytest.mark.parametrize("has_metadata", [False, True])
    def test_hidden_files_are_no_parts(self, tmp_path, has_metadata):
        said = bag2(tmp_path / "bag")
        [part] = (tmp_path / "bag").glob("*.db3")
        part.with_name(f"._{part.name}").write_bytes(b"\0\5\x16\7")
        if not has_metadata:
            (tmp_path / "bag" / "metadata.yaml").unlink()
        make(tmp_path / "bag", tmp_path / "out.mcap")
        assert recorded(tmp_path / "out.mcap") == sorted(said)


PLANE = "0.1 0 0\n0 0.1 0\n0 0 1\n"


class TestBesideLabels:
    @pytest.fixture
    def files(self, tmp_path) -> dict[str, Path]:
        (tmp_path / "gt.txt").write_text(MOT)
        (tmp_path / "plane.txt").write_text(PLANE)
        return {"labels": {"truth": tmp_path / "gt.txt"}, "ground_plane": tmp_path / "plane.txt"}

    def test_labels_have_the_times_of_pictures(self, tmp_path, files):
        """Of a bag, of the log made of it, and of the bag added to another log: the same."""
        times = camera_bag(tmp_path / "a.bag", "/robot/front/image/compressed")
        make(tmp_path / "a.bag", tmp_path / "a.mcap", **files)
        make(tmp_path / "a.bag", tmp_path / "plain.mcap")
        make(tmp_path / "plain.mcap", tmp_path / "b.mcap", **files)
        with log.create(tmp_path / "c.mcap"):
            pass
        with log.read(tmp_path / "c.mcap") as opened:
            ingest(tmp_path / "a.bag", tmp_path / "c.mcap", IngestOptions(**files), into=opened)
        for name in ("a.mcap", "b.mcap", "c.mcap"):
            with log.read(tmp_path / name) as opened:
                frames = opened.frames("/robot/front/image/truth", TRACKS)
                assert [frame.t_ns for frame in frames] == times[:20]  # the file labels no others
                assert [frame.rows["x_px"].tolist() for frame in frames] == [[2 + n] for n in range(20)]
                assert frames[0].rows["x_m"].tolist() == pytest.approx([0.7])
                (plane,) = opened.frames("/robot/front/image/ground_plane", GROUND_PLANE)
                plane = rows_to_plane(plane.rows)
                assert (plane.width_px, plane.height_px) == (64, 48)
                assert opened.channel("/robot/front/image/compressed").messages == 30

    def test_of_several_cameras_one_is_chosen(self, tmp_path, files):
        camera_bag(tmp_path / "a.bag", "/left/image", "/right/image")
        with pytest.raises(McaptrackError, match=r"/left/image, /right/image; .* choose with `camera='left'`"):
            make(tmp_path / "a.bag", tmp_path / "a.mcap", **files)
        assert not (tmp_path / "a.mcap").exists()
        assert make(tmp_path / "a.bag", tmp_path / "a.mcap", camera="right", **files).messages["/right/truth"] == 20

    def test_without_pictures_there_is_nothing_to_label(self, tmp_path, files):
        bag1(tmp_path / "a.bag", 5, 100)
        with pytest.raises(McaptrackError, match="the log has none"):
            make(tmp_path / "a.bag", tmp_path / "a.mcap", **files)


class TestInto:
    @pytest.mark.parametrize("chunks", [True, False])
    def test_an_mcap_file_is_added_with_all_that_is_in_it(self, tmp_path, chunks):
        with recorder(tmp_path / "a.mcap", compression=CompressionType.LZ4, use_chunking=chunks) as writer:
            channel = writer.register_channel("/a", "json", 0, {"k": "v"})
            for number in range(5):
                writer.add_message(channel, 10 + number, b"{}", 3, sequence=90 + number)
            writer.add_metadata("m", {"a": "b"})
            writer.add_attachment(1, 2, "file", "text/plain", b"hello")
        bag2(tmp_path / "bag")
        make(tmp_path / "bag", tmp_path / "b.mcap")
        with log.read(tmp_path / "b.mcap") as opened:
            report = ingest(tmp_path / "a.mcap", tmp_path / "b.mcap", IngestOptions(), into=opened)
        assert report.messages == {"/a": 5}
        with (tmp_path / "b.mcap").open("rb") as stream:
            reader = make_reader(stream)
            found = [(c.metadata, m.log_time, m.publish_time, m.sequence) for _, c, m in reader.iter_messages(["/a"])]
            assert found == [({"k": "v"}, 10 + number, 3, 90 + number) for number in range(5)]
            assert ("m", {"a": "b"}) in [(m.name, m.metadata) for m in reader.iter_metadata()]
            attached = [(a.create_time, a.log_time, a.name, a.data) for a in reader.iter_attachments()]
            assert (1, 2, "file", b"hello") in attached
        with log.read(tmp_path / "b.mcap") as opened, pytest.raises(McaptrackError, match="can't be added to itself"):
            ingest(tmp_path / "b.mcap", tmp_path / "x.mcap", IngestOptions(), into=opened)


def test_results_beside_a_recording_are_left_out_and_that_is_said(tmp_path):
    bag1(tmp_path / "a.bag", 2, 100)
    make(tmp_path / "a.bag", tmp_path / "a.mcap")
    beside = tmp_path / "a.results.mcap"
    make(tmp_path / "a.bag", beside)
    report = make(tmp_path / "a.mcap", tmp_path / "b.mcap")
    words = f"{beside} holds results of a.mcap; they are left out"
    assert [(one.message, one.code) for one in report.warnings] == [(words, "left-out")]
    assert len(recorded(tmp_path / "b.mcap")) == len(recorded(tmp_path / "a.mcap"))


def test_real_recordings_are_kept_whole(data, tmp_path):
    """Every message of every recording there is, by rosbags and by the stock reader."""
    seen = 0
    for path in sorted((data / "mcap").glob("*/*")):
        out = tmp_path / (path.name + ".out.mcap")
        if path.suffix == ".bag":
            with AnyReader([path]) as reader:
                said = sorted((c.topic, t, t, bytes(raw)) for c, t, raw in reader.messages())
        elif path.suffix == ".db3":
            db = sqlite3.connect(f"file:{path}?immutable=1", uri=True)
            query = "SELECT name, timestamp, timestamp, data FROM messages JOIN topics ON topics.id = topic_id"
            said = sorted(db.execute(query))
            db.close()
        elif path.suffix == ".mcap":
            said = recorded(path)
        else:
            continue
        report = make(path, out)
        assert recorded(out) == said
        assert sum(report.messages.values()) == len(said)
        assert report.lost == []
        seen += 1
    assert seen >= 10


@pytest.mark.parametrize(("left", "most"), [(1000, 2000), (2000, 1000)])
def test_a_packed_message_is_within_what_is_left_and_within_the_limit_of_one(left, most, monkeypatch):
    monkeypatch.setattr(definitions, "_MAX_MESSAGE_BYTES", most)
    pack = zstandard.ZstdCompressor().compress
    assert recording._unpack_message(pack(bytes(1000)), Path("a"), 7, left) == bytes(1000)
    with pytest.raises(McaptrackError, match="a: the message at 7 ns can't be decompressed: it says that it has 1001 "):
        recording._unpack_message(pack(bytes(1001)), Path("a"), 7, left)


def test_a_database_may_run_nothing_of_its_own(tmp_path, monkeypatch):
    """Where Python can say so to SQLite, which it can from 3.12 on."""
    told = {}

    class Database(sqlite3.Connection):
        def setconfig(self, what, enable=True):
            told[what] = enable

    names = {"DEFENSIVE": 1010, "ENABLE_TRIGGER": 1003, "ENABLE_VIEW": 1015}
    for name, number in names.items():
        monkeypatch.setattr(sqlite3, f"SQLITE_DBCONFIG_{name}", number, raising=False)
    connect = sqlite3.connect
    monkeypatch.setattr(sqlite3, "connect", lambda *some, **more: connect(*some, **more, factory=Database))
    with closing(connect(tmp_path / "a.db3")) as made:
        made.execute("create table topics (id integer)")
    with closing(SqliteTables(tmp_path / "a.db3", ["topics"])) as tables:
        assert tables.count("topics") == 0
    assert told == {1010: True, 1003: False, 1015: False}


# Folders of rosbag2, laid out by hand: which files are one recording, what each holds, and what is missing


TALK = (1, "/talk", "std_msgs/msg/String", "cdr", "qos")
SAME = (2, *TALK[1:])
OTHER = (5, "/other", "std_msgs/msg/String", "cdr", "qos")
CDR = b"\x00\x01\x00\x00\x02\x00\x00\x00a\x00"


def described(*files: str, topics: dict[str, int] | None = None, mode: str = "") -> str:
    """A metadata.yaml that names these files, and the number of messages of topics."""
    lines = ["rosbag2_bagfile_information:", "  version: 5", f"  relative_file_paths: [{', '.join(files)}]"]
    lines += [f"  compression_mode: '{mode}'", f"  compression_format: '{'zstd' if mode else ''}'"]
    lines += ["  ros_distro: humble", "  topics_with_message_count:"] if topics else ["  topics_with_message_count: []"]
    for name, count in (topics or {}).items():
        about = f"name: {name}, type: std_msgs/msg/String, serialization_format: cdr, offered_qos_profiles: 'q'"
        lines.append(f"    - {{topic_metadata: {{{about}}}, message_count: {count}}}")
    return "\n".join(lines) + "\n"


@pytest.fixture
def folder(tmp_path) -> Path:
    """Two databases, each with two topics of one name."""
    database(tmp_path / "a.db3", 3, [(1, 10, CDR), (2, 20, CDR), (1, 30, CDR)], [TALK, SAME])
    database(tmp_path / "b.db3", 3, [(2, 40, CDR), (2, 50, CDR), (5, 60, CDR)], [TALK, SAME, OTHER])
    (tmp_path / "metadata.yaml").write_text(described("a.db3", "b.db3", topics={"/talk": 5, "/other": 1}))
    return tmp_path


def refused(folder: Path, said: str) -> None:
    with pytest.raises(McaptrackError) as error:
        open_bag(folder)
    assert said in str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_files_of_a_folder_are_one_recording(folder):
    with collected() as warnings:
        bag = open_bag(folder)
    assert not warnings
    counts = [(one.topic, count) for one, count in bag.declared_counts.items()]
    assert counts == [("/talk", 2), ("/talk", 3), ("/other", 1)]
    assert bag.channels == list(bag.declared_counts)
    first, second, other = bag.channels
    found = list(bag.messages(ReadingNotes()))
    assert [(message.channel, message.t_ns) for message in found] == [
        (first, 10), (second, 20), (first, 30), (second, 40), (second, 50), (other, 60),
    ]  # fmt: skip
    make(folder, folder / "out.mcap")
    with (folder / "out.mcap").open("rb") as stream:
        messages = [message for _, _, message in make_reader(stream).iter_messages()]
    assert [message.sequence for message in messages] == [0, 0, 1, 1, 2, 0]
    assert [message.publish_time for message in messages] == [10, 20, 30, 40, 50, 60]
    assert bag.findings.lost == []
    (note,) = bag.findings.notes
    assert note.startswith(f"{folder} does not say what std_msgs/msg/String is; its definition is that of ")
    bag.close()


def test_what_metadata_counts_and_the_files_lack(folder):
    counts = {"/talk": 6, "/other": 1, "/gone": 2, "/silent": 0}
    (folder / "metadata.yaml").write_text(described("a.db3", "b.db3", topics=counts))
    bag = open_bag(folder)
    assert bag.findings.lost == [
        f"{folder}: metadata.yaml counts 6 messages of /talk, and 5 are there",
        f"{folder}: metadata.yaml counts 2 messages of /gone, and 0 are there",
    ]
    alone = "(std_msgs/msg/String) is in metadata.yaml alone; its channel has no schema"
    assert [note for note in bag.findings.notes if alone in note] == [f"/gone {alone}", f"/silent {alone}"]
    made = {one.topic: (one.schema, one.metadata, count) for one, count in bag.declared_counts.items()}
    assert made["/gone"] == (("std_msgs/msg/String", "", b""), {"offered_qos_profiles": "q", "topic_type_hash": ""}, 0)
    bag.close()


def test_which_files_are_a_recording(folder):
    whole = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text("bag: 1")
    refused(folder, "is not the metadata of a rosbag2 bag")
    (folder / "metadata.yaml").write_text(described("a.db3", "d.db3", "e.db3"))
    refused(folder, f"names {folder / 'd.db3'}, which does not exist; a part of the bag is missing")
    plain(folder / "f.mcap", "ros2")
    (folder / "metadata.yaml").write_text(described("a.db3", "f.mcap"))
    refused(folder, f"{folder} holds both MCAP files and databases; one bag is made of either")
    (folder / "g.db3").write_bytes(b"no database")
    (folder / "metadata.yaml").write_text(described("a.db3", "f.mcap", "g.db3"))
    refused(folder, f"{folder / 'g.db3'} is neither an MCAP file nor a rosbag2 database; it may be damaged")
    (folder / "metadata.yaml").write_text(whole)
    (folder / "f.results.mcap").write_bytes(b"")
    with collected() as warnings:
        open_bag(folder).close()
    assert [one.message for one in warnings] == [
        f"{folder / name} is not named in metadata.yaml; it is left out"
        for name in ("f.mcap", "f.results.mcap", "g.db3")
    ]


def test_a_compressed_file_is_found_without_its_ending(folder):
    whole = (folder / "b.db3").read_bytes()
    (folder / "b.db3.zstd").write_bytes(zstandard.compress(whole))
    (folder / "b.db3").unlink()
    bag = open_bag(folder)
    assert [message.t_ns for message in bag.messages(ReadingNotes())] == [10, 20, 30, 40, 50, 60]
    assert [path.name for path in bag.paths] == ["a.db3", "b.db3"]
    bag.close()
    assert not bag.paths[1].exists()  # the decompressed copy
    (folder / "b.db3.zstd").unlink()
    refused(folder, f"names {folder / 'b.db3'}, which does not exist")


def test_one_file_has_what_metadata_beside_it_says_of_it(folder):
    for name, distro in (("a.db3", "humble"), ("z.db3", "")):
        (folder / "metadata.yaml").write_text(described(name, topics={"/talk": 9}, mode="message"))
        bag = open_files([folder / "a.db3"], folder / "a.db3")
        assert (bag.bag.distro, bag.bag.packed, bag.bag.topics, bag.bag.text) == (distro, bool(distro), (), b"")
        assert bag.findings.lost == []
        bag.close()
    path = folder / "metadata.yaml"
    for name, is_its_own in (("z.db3", True), ("a.db3", False)):
        assert names_file(path, name) == is_its_own
    for text, is_named in (("rosbag2_bagfile_information: [", True), ("else: 1", False)):
        path.write_text(text)
        assert names_file(path, "a") == is_named


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_messages_that_are_compressed_one_by_one_share_a_limit(tmp_path, monkeypatch, kind):
    sizes = [300, 200, 100]
    packed = [zstandard.compress(bytes(size)) for size in sizes]
    name = f"a.{kind}"
    if kind == "db3":
        database(tmp_path / name, 3, [(1, n, data) for n, data in enumerate(packed)], [TALK])
    else:
        with recorder(tmp_path / name, "ros2") as writer:
            number = writer.register_channel("/talk", "cdr", 0)
            for n, data in enumerate(packed):
                writer.add_message(number, n, data, n)
    (tmp_path / "metadata.yaml").write_text(described(name, topics={"/talk": 3}, mode="MESSAGE"))

    def read(limit: int) -> list[int]:
        own = (tmp_path / name).stat().st_size
        monkeypatch.setattr(decompression, "limit_of", lambda size: limit if size == own else 0)
        with closing(open_bag(tmp_path)) as bag:
            return [len(message.payload) for message in bag.messages(ReadingNotes())]

    assert read(600) == sizes
    with pytest.raises(McaptrackError, match=f"{name}: the message at 2 ns can't be decompressed"):
        read(599)
    (tmp_path / "metadata.yaml").unlink()  # it is found by the messages
    monkeypatch.undo()
    with closing(open_files([tmp_path / name], tmp_path / name)) as bag:
        assert bag.as_log is None
        assert [len(message.payload) for message in bag.messages(ReadingNotes())] == sizes


def test_what_metadata_leaves_out_has_its_usual_value(tmp_path):
    topic = "{topic_metadata: {name: /a, type: t/msg/T}, message_count: 3}"
    path = tmp_path / "metadata.yaml"
    path.write_text(
        f"rosbag2_bagfile_information:\n  topics_with_message_count: [{topic}]\n  relative_file_paths: [x/a.db3]\n",
    )
    bag, names = read_metadata(path)
    assert (names, list(bag.topics)) == (["a.db3"], [("/a", "t/msg/T", "cdr", "", "", 3)])
    assert (bag.distro, bag.packed, bag.text) == ("", False, path.read_bytes())
    more = "  ros_distro: jazzy\n  compression_mode: {}\n  compression_format: {}\n"
    for mode, packing, is_packed in (
        ("MESSAGE", "ZSTD", True),
        ("file", "zstd", False),
        ("none", "lz4", False),
        ("FILE", "lz4", None),
    ):
        path.write_text(bag.text.decode() + more.format(mode, packing))
        if is_packed is None:
            with pytest.raises(McaptrackError, match="the bag is compressed with 'lz4'; zstd is read"):
                read_metadata(path)
            continue
        found, _ = read_metadata(path)
        assert (found.packed, found.distro) == (is_packed, "jazzy")


def test_decompression_in_steps_ends_at_its_limit():
    data = bytes(range(256)) * 20
    steps = [decompress_steps(bz2.BZ2Decompressor(), bz2.compress(data), most) for most in (0, 7, 10**6)]
    assert steps == [b"", data[:7], data]
    assert decompress_steps(bz2.BZ2Decompressor(), bz2.compress(data)[:-9], 10**6) in (b"", data)
