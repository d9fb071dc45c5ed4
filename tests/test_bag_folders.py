"""Folders of rosbag2, laid out by hand: which files are one recording, what each holds, and what is missing."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import pytest
import zstandard
from mcap.writer import Writer

from mcaptrack.errors import McaptrackError
from mcaptrack.notices import collected
from mcaptrack.sources.ingest.bags import decompression
from mcaptrack.sources.ingest.bags.metadata_yaml import is_packed, names_file, read_metadata
from mcaptrack.sources.ingest.bags.recording import ReadingNotes
from mcaptrack.sources.ingest.bags.rosbag2 import open_bag, open_files
from tests.bags import database, plain

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
    assert bag.connections == list(bag.declared_counts)
    first, second, other = bag.connections
    found = list(bag.messages(ReadingNotes()))
    assert [(known, message.t_ns, message.publish_ns) for known, message in found] == [
        (first, 10, 10), (second, 20, 20), (first, 30, 30), (second, 40, 40), (second, 50, 50), (other, 60, 60),
    ]  # fmt: skip
    assert [message.sequence for _, message in found] == [0, 0, 1, 1, 2, 0]
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
    assert [message.t_ns for _, message in bag.messages(ReadingNotes())] == [10, 20, 30, 40, 50, 60]
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
        assert names_file(path, name) == is_packed(path, name) == is_its_own
    for text, is_named in (("rosbag2_bagfile_information: [", True), ("else: 1", False)):
        path.write_text(text)
        assert (names_file(path, "a"), is_packed(path, "a")) == (is_named, False)


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_messages_that_are_compressed_one_by_one_share_a_limit(tmp_path, monkeypatch, kind):
    sizes = [300, 200, 100]
    packed = [zstandard.compress(bytes(size)) for size in sizes]
    name = f"a.{kind}"
    if kind == "db3":
        database(tmp_path / name, 3, [(1, n, data) for n, data in enumerate(packed)], [TALK])
    else:
        with (tmp_path / name).open("wb") as stream:
            writer = Writer(stream)
            writer.start("ros2", "robot")
            number = writer.register_channel("/talk", "cdr", 0)
            for n, data in enumerate(packed):
                writer.add_message(number, n, data, n)
            writer.finish()
    (tmp_path / "metadata.yaml").write_text(described(name, topics={"/talk": 3}, mode="MESSAGE"))

    def read(limit: int) -> list[int]:
        own = (tmp_path / name).stat().st_size
        monkeypatch.setattr(decompression, "limit_of", lambda size: limit if size == own else 0)
        with closing(open_bag(tmp_path)) as bag:
            return [len(message.payload) for _, message in bag.messages(ReadingNotes())]

    assert read(600) == sizes
    with pytest.raises(McaptrackError, match=f"{name}: the message at 2 ns can't be decompressed"):
        read(599)
    (tmp_path / "metadata.yaml").write_text(described(name, topics={"/talk": 3}))
    if kind == "mcap":
        assert read(0) == [len(data) for data in packed]


def test_metadata_of_old_and_new_versions(folder):
    path = folder / "metadata.yaml"
    text = path.read_text()
    for old, new in (
        ("[a.db3, b.db3]", "[bag/a.db3, bag/b.db3]"),
        ("compression_mode: ''", "compression_mode: NONE"),
        ("offered_qos_profiles: 'q'", "offered_qos_profiles: [{depth: 3}], type_description_hash: R1"),
    ):
        text = text.replace(old, new)
    path.write_text(text)
    bag, names = read_metadata(path)
    assert names == ["a.db3", "b.db3"]
    assert (bag.distro, bag.packed, bag.text) == ("humble", False, path.read_bytes())
    ((name, kind, encoding, qos, digest, count), _) = bag.topics
    assert (name, kind, encoding, digest, count) == ("/talk", "std_msgs/msg/String", "cdr", "R1", 5)
    assert "depth: 3" in qos
