"""Recordings that were made to harm: one line, soon, in little memory, with nothing changed beside the output."""

from __future__ import annotations

import bz2
import io
import json
import os
import shutil
import signal
import socket
import sqlite3
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path

import lz4.frame
import pytest
import yaml
import zstandard
from mcap.reader import make_reader

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.bags import sqlite_tables as bag_database
from mcaptrack.extensions.bags.metadata_yaml import read_metadata
from mcaptrack.sources.ingest import IngestOptions, ingest, plain_yaml
from tests import bounded
from tests.commands import start
from tests.extensions.bags import bag_mutants
from tests.extensions.bags.bags import ROS2, STRING1, database
from tests.tiers import one_in, thorough

TOPICS = [(1, "/a", STRING1, "cdr", "")]


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "in").mkdir()
    return tmp_path / "in"


def changed(path: Path, *statements: str, messages: Sequence[tuple] = ()) -> Path:
    """A bag that was changed by SQL."""
    database(path, 3, messages, TOPICS)
    db = sqlite3.connect(path)
    for statement in statements:
        db.execute(statement)
    db.commit()
    db.close()
    return path


def refused(commands, source: Path, words: str) -> bounded.Outcome:
    """Ingesting it is refused in a line, within bounds, and changes nothing."""
    there = source if source.is_dir() else source.parent
    before = bounded.on_disk(there)
    outcome = commands.run("ingest", source, "-o", there.parent / "out.mcap")
    assert outcome.code == 1, outcome
    assert outcome.err.count("\n") == 1
    assert words in outcome.err
    assert bounded.on_disk(there) == before
    assert not (there.parent / "out.mcap").exists()
    return outcome


def kept(commands, source: Path) -> list[tuple[str, int, bytes]]:
    """Ingesting it works, within bounds, and changes nothing; returns the messages of the log."""
    there = source if source.is_dir() else source.parent
    before = bounded.on_disk(there)
    outcome = commands.run("ingest", source, "-o", there.parent / "out.mcap", "-v")
    assert outcome.code == 0, outcome
    assert bounded.on_disk(there) == before
    with (there.parent / "out.mcap").open("rb") as stream:
        return [(c.topic, m.log_time, m.data) for _, c, m in make_reader(stream).iter_messages()]


# metadata.yaml


GOOD = """\
rosbag2_bagfile_information:
  relative_file_paths: [{name}]
  compression_mode: ""
  compression_format: ""
  topics_with_message_count:
    - topic_metadata: {{name: /a, type: std_msgs/msg/String, serialization_format: cdr, offered_qos_profiles: ""}}
      message_count: 1
"""


def aliases(levels: int) -> str:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, levels)]
    return "\n".join(lines) + "\n"


YAML = {
    "nested aliases": (aliases(60) + GOOD, "anchors and aliases are not read"),
    "one alias": (GOOD.replace("/a,", "&x /a,"), "anchors and aliases are not read"),
    "a tag": (GOOD.replace("/a,", "!!python/name:os.system /a,"), "tags are not read"),
    "directives": ("".join(f"%TAG !a{n}! tag:x\n" for n in range(20_000)) + "---\n" + GOOD, "directives are not read"),
    "a long flow list": (GOOD + "x: [" + "a," * 510_000 + "]", "more than 500000 values"),
    "too long": (GOOD + "#" * plain_yaml.MAX_BYTES, "at most 8388608 are read"),
    "deep": (GOOD + "x: " + "[" * 100_000, "nested more than 32 deep"),
    "deep maps": (GOOD + "x: " + "{a: " * 100_000, "nested more than 32 deep"),
    "a list as a key": (GOOD + "? [a]\n: 1\n", "a list or a map is a key"),
    "a key twice": (GOOD + "rosbag2_bagfile_information: {}\n", "is there twice"),
    "two documents": (GOOD + "---\na: 1\n", "holds 2 documents"),
    "not UTF-8": (GOOD + "x: \udcff", "is no UTF-8"),
    "no YAML": (GOOD + "x: [", "did not find expected"),
    "no name": (GOOD.replace("[{name}]", '[""]'), "which is no file"),
    "a list as a name": (GOOD.replace("[{name}]", "[[{name}]]"), "which is no file"),
    "a folder as a name": (GOOD.replace("{name}", "."), "which is no file"),
    "a name outside": (GOOD.replace("{name}", "../../etc/passwd"), "outside of the bag's folder"),
    "an absolute name": (GOOD.replace("{name}", "/etc/passwd"), "outside of the bag's folder"),
    "a name twice": (GOOD.replace("[{name}]", "[{name}, {name}]"), "names a.db3 twice"),
    "no names": (GOOD.replace("[{name}]", "12"), "relative_file_paths is '12', not a list"),
    "topics of another kind": (GOOD.replace("    - topic", "      topic"), "topics_with_message_count is a map"),
    "an unknown compression": (GOOD.replace('mode: ""', "mode: file"), "compressed with ''; zstd is read"),
} | {
    f"a count of {count}": (GOOD.replace("count: 1", f"count: {count}"), "message_count is")
    for count in (".inf", ".nan", "-1", "1e3", "0x10", "[1]", "null", "9223372036854775808", "1" * 5000)
}


@pytest.mark.parametrize("name", one_in(5, YAML))
def test_metadata_that_is_no_plain_data_is_refused(commands, folder, name):
    database(folder / "a.db3", 3, [(1, 5, b"\0\1\0\0")], TOPICS)
    text, words = YAML[name]
    text = text.replace("{name}", "a.db3").replace("{{", "{").replace("}}", "}")
    (folder / "metadata.yaml").write_bytes(text.encode("utf-8", "surrogateescape"))
    outcome = refused(commands, folder, words)
    assert len(outcome.err) < 700


@pytest.mark.parametrize(
    "name",
    one_in(2, ["bag/a.db3", "a.db3", "'a.db3'", "./a.db3"]),
    ids=["with its folder", "name", "quoted", "here"],
)
def test_metadata_as_recorders_wrote_it_is_read(commands, folder, name):
    database(folder / "a.db3", 3, [(1, 5, b"\0\1\0\0")], TOPICS)
    (folder / "metadata.yaml").write_text(GOOD.format(name=name))
    assert kept(commands, folder) == [("/a", 5, b"\0\1\0\0")]


def test_quality_of_service_stays_the_same_data(folder):
    """As YAML's own reader has it, whatever the words look like."""
    database(folder / "a.db3", 3, [], TOPICS)
    qos = [{"history": "keep_last", "depth": 10, "text": "10", "nothing": None, "d": {"sec": 1, "n": ["a", "b c"]}}]
    text = GOOD.replace("{{", "{").replace("}}", "}").replace("{name}", "a.db3")
    text = text.replace('offered_qos_profiles: ""', f"offered_qos_profiles: {json.dumps(qos)}")
    (folder / "metadata.yaml").write_text(text)
    ((*_, profiles, _, _),) = read_metadata(folder / "metadata.yaml")[0].topics
    assert yaml.load(profiles, Loader=yaml.SafeLoader) == qos


def test_files_that_are_one_are_not_read_twice(commands, folder):
    database(folder / "a.db3", 3, [(1, 5, b"\0\1\0\0")], TOPICS)
    os.link(folder / "a.db3", folder / "b.db3")
    (folder / "metadata.yaml").write_text(GOOD.format(name="a.db3, b.db3"))
    refused(commands, folder, "names a.db3 and b.db3, which are one file")


def test_a_link_to_elsewhere_is_followed_and_said(commands, folder, tmp_path):
    database(tmp_path / "there.db3", 3, [(1, 5, b"\0\1\0\0")], TOPICS)
    (folder / "a.db3").symlink_to(tmp_path / "there.db3")
    (folder / "metadata.yaml").write_text(GOOD.format(name="a.db3"))
    outcome = commands.run("ingest", folder, "-o", tmp_path / "out.mcap", "-v")
    assert outcome.code == 0
    assert f"{folder / 'a.db3'} is a link out of the folder, to {tmp_path / 'there.db3'}" in outcome.err


# What is no file


def special(path: Path, kind: str) -> str:
    """Make something that is no file; returns what it is called."""
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "socket":
        here = os.open(path.parent, os.O_RDONLY)  # the name of a socket has to be short
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(f"/proc/self/fd/{here}/{path.name}")
        os.close(here)
    elif kind == "loop":
        path.symlink_to(path.name)
    return kind


@pytest.mark.parametrize("kind", one_in(2, ["pipe", "folder", "device", "socket", "loop"]))
@pytest.mark.parametrize("place", ["part", "alone", "metadata"])
def test_what_is_no_file_is_not_waited_for(commands, folder, kind, place):
    if kind == "socket" and not os.path.isdir("/proc/self/fd"):
        pytest.skip("sockets are made with the help of /proc")
    database(folder / "b.db3", 3, [], TOPICS)
    name = "metadata.yaml" if place == "metadata" else "a.db3"
    if place == "part":
        (folder / "metadata.yaml").write_text(GOOD.format(name="a.db3"))
    special(folder / name, kind)
    source = folder / name if place == "alone" else folder
    outcome = commands.run("ingest", source, "-o", folder.parent / "out.mcap")
    assert outcome.cpu_s < bounded.CPU_S
    assert "Traceback" not in outcome.err
    if place == "metadata":  # a folder without metadata, then
        assert outcome.code == 0
    else:
        assert outcome.code == 1
        assert outcome.err.count("\n") == 1
        assert "a.db3" in outcome.err


# Databases


COUNTED = "WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM r LIMIT {})"
RECURSIVE = "WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM r) SELECT"
SCHEMAS = {
    "a recursive view": f"CREATE VIEW messages AS {RECURSIVE} 1 AS topic_id, n AS timestamp, x'00' AS data FROM r",
    "a view of zeros": "CREATE VIEW messages AS SELECT 1 AS topic_id, 1 AS timestamp, zeroblob(999999999) AS data",
    "computed zeros": "CREATE TABLE messages(topic_id, timestamp, data AS (zeroblob(900000000)))",
    "stored zeros": "CREATE TABLE messages(topic_id, timestamp, data AS (zeroblob(90)) STORED)",
    "full text": "CREATE VIRTUAL TABLE messages USING fts4(topic_id, timestamp, data)",
}


@pytest.mark.parametrize("name", SCHEMAS)
def test_only_tables_are_read(commands, folder, name):
    path = changed(folder / "a.db3", "DROP TABLE messages", SCHEMAS[name])
    why = "is computed" if "zeros" in name and "view" not in name else "is not an ordinary table"
    refused(commands, path, why)


def test_a_view_that_calls_itself_a_table_is_not_read(commands, folder):
    path = changed(
        folder / "a.db3",
        "DROP TABLE messages",
        SCHEMAS["a recursive view"],
        "PRAGMA writable_schema=ON",
        "UPDATE sqlite_master SET type = 'table' WHERE name = 'messages'",
    )
    refused(commands, path, "messages")


def test_a_database_is_read_with_the_guards_of_sqlite(folder, monkeypatch):
    """Functions in its schema are not trusted, cells are checked, and nothing is mapped into memory."""
    database(folder / "a.db3", 3, [], TOPICS)
    monkeypatch.setattr(bag_database.SqliteTables, "_restrict_to_tables", lambda _: None)
    opened = bag_database.SqliteTables(folder / "a.db3", ["topics"])
    for name, wanted in (("trusted_schema", [(0,)]), ("cell_size_check", [(1,)]), ("mmap_size", [(0,)])):
        assert list(opened._query(f"PRAGMA {name}")) == wanted
    opened.close()


def test_damaged_words_of_a_database_that_are_no_text_are_said_as_such(commands, folder):
    """SQLite quotes them in its message, which Python then can't decode."""
    damage = "UPDATE sqlite_master SET sql = CAST(x'637265617465ff' AS TEXT) WHERE name = 'messages'"
    path = changed(folder / "a.db3", "PRAGMA writable_schema=ON", damage)
    refused(commands, path, "a.db3 is damaged: it can't be understood")


def test_one_of_two_tables_is_no_bag(commands, folder):
    for gone in ("topics", "messages"):
        path = changed(folder / "a.db3", f"DROP TABLE {gone}")
        refused(commands, path, "none of rosbag2: it has no topics and messages")
        path.unlink()


@pytest.mark.parametrize(("table", "column"), [("topics", "serialization_format"), ("messages", "data")])
def test_each_column_is_needed(commands, folder, table, column):
    path = changed(folder / "a.db3", f"ALTER TABLE {table} RENAME COLUMN {column} TO other")
    refused(commands, path, "none of rosbag2")


def test_a_table_gives_no_more_than_the_file_holds(commands, folder):
    """Rows that are short on the disk get a long default."""
    path = changed(
        folder / "a.db3",
        "DROP TABLE messages",
        "CREATE TABLE messages(topic_id INTEGER, timestamp INTEGER)",
        f"INSERT INTO messages {COUNTED.format(50_000)} SELECT 1, n FROM r",
        f"ALTER TABLE messages ADD COLUMN data BLOB DEFAULT x'{'00' * 300_000}'",
    )
    refused(commands, path, "its table messages holds more than the file can")


def test_pages_that_stand_for_each_other_end(commands, folder):
    """All children of the root of a table are one page, and those of that page are one, and so on."""
    database(folder / "a.db3", 3, [(1, n, bytes(3000)) for n in range(300)], TOPICS)
    with sqlite3.connect(folder / "a.db3") as db:
        (root,) = db.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'").fetchone()
        (size,) = db.execute("PRAGMA page_size").fetchone()
    db.close()
    data = bytearray((folder / "a.db3").read_bytes())
    start = (root - 1) * size
    cells = struct.unpack_from(">H", data, start + 3)[0]
    assert data[start] == 5
    assert cells > 5
    page = data[start : start + size]
    for _ in range(8):  # more and more levels of the same
        copy = len(data) // size + 1
        for cell in range(cells):
            at = struct.unpack_from(">H", page, 12 + 2 * cell)[0]
            struct.pack_into(">I", page, at, copy)
        struct.pack_into(">I", page, 8, copy)
        data[start : start + size] = page
        data += page
        start = (copy - 1) * size
    struct.pack_into(">I", data, 28, len(data) // size)
    leaf = len(data) // size + 1
    page = data[start : start + size]
    original = (folder / "a.db3").read_bytes()
    child = struct.unpack_from(">I", original, (root - 1) * size + 8)[0]
    for cell in range(cells):
        at = struct.unpack_from(">H", page, 12 + 2 * cell)[0]
        struct.pack_into(">I", page, at, leaf)
    struct.pack_into(">I", page, 8, leaf)
    data[start : start + size] = page
    data += original[(child - 1) * size : child * size]
    struct.pack_into(">I", data, 28, len(data) // size)
    (folder / "a.db3").write_bytes(data)
    refused(commands, folder / "a.db3", "is damaged: ")


@pytest.mark.parametrize("raised", [KeyboardInterrupt(), SystemExit(143)], ids=["Ctrl-C", "kill"])
def test_a_signal_ends_a_query(folder, monkeypatch, raised):
    """SQLite calls back between its steps, and would swallow what is raised there."""
    database(folder / "a.db3", 3, [(1, n, b"") for n in range(20_000)], TOPICS)
    monkeypatch.setattr(bag_database, "_STEPS", 1000)

    def handler(*_: object) -> None:
        raise raised

    old = signal.signal(signal.SIGUSR1, handler)
    looks = []

    class Watched(bag_database.SqliteTables):
        @property
        def _max_steps(self) -> int:  # read at every check
            looks.append(len(looks))
            if len(looks) == 30:
                os.kill(os.getpid(), signal.SIGUSR1)
            return 10**15

    opened = Watched(folder / "a.db3", ["messages"])
    try:
        with pytest.raises(type(raised)) as found:
            for _ in range(1000):
                opened.count("messages")
        assert found.value is raised
        assert 30 <= len(looks) < 40
    finally:
        opened.close()
        signal.signal(signal.SIGUSR1, old)


def test_many_unknown_topics_and_types_take_no_longer(commands, folder):
    topics = [(n, f"/t{n}", f"a{n}/msg/B", "cdr", "") for n in range(1, 3000)]
    database(folder / "a.db3", 3, [(-n, n, b"") for n in range(20_000)], topics)
    outcome = commands.run("ingest", folder / "a.db3", "-o", folder.parent / "out.mcap")
    assert outcome.code == 3
    assert outcome.err.count("which is not described") == 11


# What a recorder leaves beside a database


def left_behind(folder: Path, mode: str) -> list[tuple[str, int, bytes]]:
    """A database whose writer was killed in the midst of a transaction; returns its messages."""
    source = folder.parent / "killed.db3"
    database(source, 3, [(1, n, bytes([n]) * 900) for n in range(20)], TOPICS)
    db = sqlite3.connect(source, isolation_level=None)
    db.execute(f"PRAGMA journal_mode={mode}")
    db.execute("PRAGMA wal_autocheckpoint=0")
    db.execute("PRAGMA cache_size=1")
    said = [("/a", n, bytes([n]) * 900) for n in range(20)]
    if mode == "WAL":
        db.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (1, 99, x'63')")
        said.append(("/a", 99, b"c"))
    db.execute("BEGIN")
    db.execute("UPDATE messages SET data = zeroblob(800)")
    for end in ("", "-wal" if mode == "WAL" else "-journal"):
        shutil.copy(f"{source}{end}", folder / f"a.db3{end}")
    db.execute("ROLLBACK")
    db.close()
    return said


@pytest.mark.parametrize("mode", ["WAL", "DELETE"])
def test_what_a_killed_recorder_wrote_is_read_and_nothing_is_left_beside_it(commands, folder, mode):
    said = left_behind(folder, mode)
    assert kept(commands, folder / "a.db3") == said


def test_a_journal_names_no_file_that_is_removed(commands, folder, tmp_path):
    """A rollback journal may end with the name of another one, which SQLite removes when it is done."""
    said = left_behind(folder, "DELETE")
    victim = tmp_path / "victim"
    victim.write_bytes(b"precious")
    name = str(victim).encode()
    checksum = sum(struct.unpack(f"{len(name)}b", name)) & 0xFFFFFFFF
    with (folder / "a.db3-journal").open("ab") as stream:
        stream.write(struct.pack(">I", 0x40000000 // 4096 + 1) + name)
        stream.write(struct.pack(">II", len(name), checksum) + bytes.fromhex("d9d505f920a163d7"))
    assert kept(commands, folder / "a.db3") == said
    assert victim.read_bytes() == b"precious"


def test_a_temporary_copy_needs_space(folder, monkeypatch):
    left_behind(folder, "WAL")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: type("Disk", (), {"free": 100})())
    with pytest.raises(McaptrackError, match=r"a\.db3 needs \d+ bytes or more in .*, where 90 are free; TMPDIR sets"):
        ingest(folder / "a.db3", folder.parent / "out.mcap", IngestOptions())


# Archives


def zeros(size: int) -> bytes:
    return zstandard.ZstdCompressor(19).compress(bytes(size))


def undeclared(size: int) -> bytes:
    """The same without saying how long it is."""
    packer = zstandard.ZstdCompressor(19, write_content_size=False).compressobj()
    return b"".join([packer.compress(bytes(2**20)) for _ in range(size // 2**20)]) + packer.flush()


@pytest.mark.parametrize("pack", one_in(2, [zeros, undeclared]))
def test_a_file_that_becomes_huge_is_not_unpacked(commands, folder, pack):
    (folder / "a.db3.zstd").write_bytes(pack(300 * 2**20))
    refused(commands, folder / "a.db3.zstd", "MCAPTRACK_MAX_UNPACKED_MIB sets another limit")


def test_the_limit_of_unpacking_can_be_set(folder, monkeypatch):
    database(folder / "b.db3", 3, [(1, 5, bytes(3 * 2**20))], TOPICS)
    (folder / "a.db3.zstd").write_bytes(zstandard.compress((folder / "b.db3").read_bytes()))
    monkeypatch.setenv("MCAPTRACK_MAX_UNPACKED_MIB", "2")
    with pytest.raises(
        McaptrackError, match=r"a\.db3\.zstd can't be decompressed: it says that it has \d+ bytes, more"
    ):
        ingest(folder / "a.db3.zstd", folder.parent / "out.mcap", IngestOptions())
    monkeypatch.setenv("MCAPTRACK_MAX_UNPACKED_MIB", "4")
    assert ingest(folder / "a.db3.zstd", folder.parent / "out.mcap", IngestOptions()).messages == {"/a": 1}


@pytest.mark.parametrize(("pack", "storage"), [(zeros, "SQLITE3"), (undeclared, "MCAP")])
def test_messages_that_become_huge_together_are_refused(commands, folder, pack, storage):
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    with Writer2(folder / "bag", version=9, storage_plugin=StoragePlugin[storage]) as writer:
        connection = writer.add_connection("/a", STRING1, typestore=ROS2)
        message = pack(30 * 2**20)
        for t_ns in range(1, 9):
            writer.write(connection, t_ns, message)
    text = (folder / "bag" / "metadata.yaml").read_text()
    text = text.replace("compression_mode: ''", "compression_mode: message")
    text = text.replace("compression_format: ''", "compression_format: zstd")
    (folder / "bag" / "metadata.yaml").write_text(text)
    refused(commands, folder / "bag", "MCAPTRACK_MAX_UNPACKED_MIB sets another limit")


def test_a_message_that_is_cut_off_is_no_message(commands, folder):
    for number, whole in enumerate((zstandard.compress(b"\0\1\0\0" + bytes(500)), undeclared(2**20))):
        database(folder / f"{number}.db3", 3, [(1, 7, whole[:-3])], TOPICS)
        refused(commands, folder / f"{number}.db3", "the message at 7 ns can't be decompressed")


def record(data: bytes, **fields: bytes) -> bytes:
    head = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k.encode() + b"=" + v for k, v in fields.items())
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data


def unfinished_bag(path: Path, compression: bytes, content: bytes, size: int) -> None:
    """A ROS 1 bag without an index, whose only chunk says that it has so many bytes."""
    head = record(b" ", op=b"\3", index_pos=bytes(8), conn_count=bytes(4), chunk_count=bytes(4))
    chunk = record(content, op=b"\5", compression=compression, size=struct.pack("<I", size))
    path.write_bytes(b"#ROSBAG V2.0\n" + head + chunk)


PACK: dict[str, Callable[[bytes], bytes]] = {"bz2": bz2.compress, "lz4": lz4.frame.compress}


@cache
def packed_zeros(kind: str, size: int) -> bytes:
    return PACK[kind](bytes(size))


@pytest.mark.parametrize("kind", PACK)
@pytest.mark.parametrize("said", one_in(3, [None, 1000, 2**32 - 1]))
def test_a_chunk_that_becomes_huge_is_lost(commands, folder, kind, said):
    size = 100 * 2**20
    unfinished_bag(folder / "a.bag", kind.encode(), packed_zeros(kind, size), size if said is None else said)
    outcome = commands.run("ingest", folder / "a.bag", "-o", folder.parent / "out.mcap")
    assert outcome.code == 3, outcome
    assert "Traceback" not in outcome.err
    assert outcome.peak_bytes < 300 * 2**20


def test_a_message_of_a_bag_is_not_larger_than_one_of_a_log(commands, folder):
    """It stands outside of chunks, where only its own length says how long it is."""
    unfinished_bag(folder / "a.bag", b"none", b"", 0)
    with (folder / "a.bag").open("ab") as stream:
        message = record(b"", op=b"\2", conn=bytes(4), time=bytes(8))
        stream.write(message[:-4] + struct.pack("<I", 2**32 - 1))
        stream.truncate(stream.tell() + 2**32 - 1)
    outcome = commands.run("ingest", folder / "a.bag", "-o", folder.parent / "out.mcap")
    assert (outcome.code, outcome.err.count("lost: ")) == (3, 1), outcome
    assert "4294967295 bytes" in outcome.err


def endless_database(path: Path) -> None:
    """Not quite: more messages than are read within a second."""
    columns = "messages(topic_id, timestamp, data)"
    changed(path, f"INSERT INTO {columns} {COUNTED.format(600_000)} SELECT 1, n, x'0001000001000000' || x'00' FROM r")


def endless_bag(path: Path) -> None:
    unfinished_bag(path, b"none", b"", 0)
    said = b"".join(
        struct.pack("<I", len(word)) + word for word in (b"topic=/a", b"type=a/B", b"message_definition=int8 a")
    )
    connection = record(said, op=b"\7", conn=bytes(4), topic=b"/a")
    message = record(b"a", op=b"\2", conn=bytes(4), time=struct.pack("<II", 5, 5))
    with path.open("ab") as stream:
        stream.write(connection + message * 200_000)


@pytest.mark.parametrize(
    ("make", "sent"), one_in(2, [(endless_database, signal.SIGINT), (endless_bag, signal.SIGTERM)])
)
@thorough
def test_a_signal_ends_ingesting_and_leaves_nothing(folder, tmp_path, make, sent):
    name = "a.db3" if make is endless_database else "a.bag"
    make(folder / name)
    before = bounded.on_disk(folder)
    process = start("ingest", folder / name, "-o", tmp_path / "out.mcap")
    while not list(tmp_path.glob(".out.mcap.*.part")):  # it is at the messages
        assert process.poll() is None, process.communicate()
        time.sleep(0.005)
    process.send_signal(sent)
    _, err = process.communicate(timeout=600)
    assert process.returncode in (128 + sent, -sent)
    assert err == ""
    assert list(tmp_path.iterdir()) == [folder]
    assert bounded.on_disk(folder) == before


# Bags with something wrong in them: read or refused in a line, soon, in little memory. See tests/test_damage.py.


MUTANTS = int(os.environ.get("MUTANTS", "0"))
FIRST = int(os.environ.get("FIRST_MUTANT", "0"))


def is_sound(path: Path) -> bool:
    """Whether the stock reader finds all messages of a log. An MCAP file alone is passed on as it is."""
    data = path.read_bytes()
    try:
        if path.suffix == ".zstd":
            data = zstandard.decompress(data)
        reader = make_reader(io.BytesIO(data), validate_crcs=True)
        return reader.get_summary().statistics.message_count == sum(1 for _ in reader.iter_messages())
    except Exception:
        return False


def recordings(seed: int, inside: Path, out: Path) -> Iterator[bounded.Work]:
    source, made = bag_mutants.mutant(seed, inside), out / "out.mcap"

    def holds(code: int) -> bool:
        is_written = [entry.name for entry in out.iterdir()] == ["out.mcap"]
        may_be_odd = not all(map(is_sound, source.glob("*.mcap*")))
        return is_written and (may_be_odd or is_sound(made)) if code in (0, 3) else not any(out.iterdir())

    yield ["ingest", source, "-o", made], holds


@thorough
def test_mutants_are_read_or_refused(commands, tmp_path):
    faults = bounded.faults(commands, range(FIRST, FIRST + (MUTANTS or 27)), tmp_path, recordings)
    assert not faults, "\n".join(faults)


@thorough
def test_the_same_seed_makes_the_same(tmp_path):
    for seed in range(len(bag_mutants.KINDS)):
        names = []
        for folder in (tmp_path / f"{seed} one", tmp_path / f"{seed} two"):
            folder.mkdir()
            bag_mutants.mutant(seed, folder)
            names.append({entry.relative_to(folder) for entry in folder.rglob("*")})
        assert names[0] == names[1]
