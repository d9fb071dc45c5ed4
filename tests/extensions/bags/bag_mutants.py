"""Recordings with something wrong in them, made by a seed: in their records, rows, schemas and words, and in their bytes."""

from __future__ import annotations

import bz2
import json
import random
import sqlite3
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import lz4.frame
import zstandard
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from tests.extensions.bags.bags import QOS, ROS2, STRING1

#: Numbers at the edges of what fields hold.
EDGES = (0, 1, 2, 3, 7, 127, 128, 255, 256, 65535, 2**16, 2**24, 2**31 - 1, 2**31, 2**32 - 1)
BIG = (*EDGES, -1, -(2**63), 2**62, 2**63 - 1)
KINDS = ("ros1", "ros1 bytes", "database", "database bytes", "metadata", "metadata bytes", "packed", "logs", "beside")


def mutant(seed: int, folder: Path) -> Path:
    """Make a recording in a folder; returns what is to be ingested."""
    dice = random.Random(seed)
    kind = KINDS[seed % len(KINDS)]
    if kind.startswith("ros1"):
        path = folder / "a.bag"
        path.write_bytes(damaged(ros1(dice, 0 if "bytes" in kind else 3), dice if "bytes" in kind else None))
        return path
    if kind.startswith("database"):
        path = folder / "a.db3"
        database(path, dice, 0 if "bytes" in kind else 3)
        if "bytes" in kind:
            path.write_bytes(damaged(path.read_bytes(), dice))
        return path
    bag = folder / "bag"
    rosbag2(bag, dice, kind)
    return bag


def damaged(data: bytes, dice: random.Random | None) -> bytes:
    """Bytes changed, cut, doubled or moved."""
    out = bytearray(data)
    for _ in range(dice.randint(1, 4) if dice else 0):
        at = dice.randrange(len(out) + 1)
        how = dice.randrange(6)
        size = dice.choice((1, 2, 4, 8, 100, 4096))
        if how == 0:
            out[at : at + size] = dice.randbytes(size)
        elif how == 1:
            out[at : at + 4] = struct.pack(dice.choice("<>") + "I", dice.choice(EDGES))
        elif how == 2:
            del out[at : at + size]
        elif how == 3:
            out[at:at] = out[at : at + size]
        elif how == 4:
            del out[at:]
        else:
            out[at : at + size] = bytes(size)
    return bytes(out)


# ROS 1


def field(name: bytes, value: bytes) -> bytes:
    return struct.pack("<I", len(name) + 1 + len(value)) + name + b"=" + value


class Record:
    """A record of a bag, by its parts: any of them can be wrong while the rest is right."""

    def __init__(self, fields: dict[bytes, bytes], data: bytes | list[Record]) -> None:
        self.fields, self.data = fields, data
        self.pack = b"none"
        self.lie: tuple[int | None, int | None] = (None, None)

    def encode(self) -> bytes:
        data = self.data if isinstance(self.data, bytes) else b"".join(record.encode() for record in self.data)
        packed = {b"bz2": bz2.compress, b"lz4": lz4.frame.compress}.get(self.pack, bytes)(data)
        fields = dict(self.fields)
        if not isinstance(self.data, bytes):
            fields.setdefault(b"size", struct.pack("<I", len(data)))
            fields.setdefault(b"compression", self.pack)
        head = b"".join(field(name, value) for name, value in fields.items())
        sizes = (len(head) if self.lie[0] is None else self.lie[0], len(packed) if self.lie[1] is None else self.lie[1])
        return struct.pack("<I", sizes[0]) + head + struct.pack("<I", sizes[1]) + packed


def ros1(dice: random.Random, faults: int) -> bytes:
    """A bag of two chunks with an index."""
    definition = b"string data\n"

    def number(value: int) -> bytes:
        return struct.pack("<I", value)

    def connection(key: int) -> Record:
        said = field(b"topic", b"/a%d" % key) + field(b"type", b"std_msgs/String")
        said += field(b"md5sum", b"0" * 32) + field(b"message_definition", definition)
        return Record({b"op": b"\7", b"conn": number(key), b"topic": b"/a%d" % key}, said)

    def message(key: int, t_s: int) -> Record:
        return Record({b"op": b"\2", b"conn": number(key), b"time": struct.pack("<II", t_s, 5)}, b"\4\0\0\0text")

    chunks = []
    for chunk in range(2):
        inside = [connection(0), connection(1), *(message(n % 2, 10 * chunk + n) for n in range(6))]
        record = Record({b"op": b"\5"}, inside)
        record.pack = dice.choice((b"none", b"bz2", b"lz4"))
        chunks.append(record)
    head = Record({b"op": b"\3"}, b" " * 50)
    tail: list[Record] = [connection(0), connection(1)]
    records = [head, *chunks, *tail]
    everything = [*records, *(inner for chunk in chunks for inner in chunk.data)]  # type: ignore[union-attr]
    counts = b"".join(number(key) + number(3) for key in range(2))
    infos = [
        Record({b"op": b"\6", b"ver": number(1), b"chunk_pos": bytes(8), b"count": number(2)}, counts) for _ in chunks
    ]
    tail += infos
    head.fields |= {b"index_pos": bytes(8), b"conn_count": number(2), b"chunk_count": number(2)}
    index_at = 13 + len(head.encode()) + sum(len(chunk.encode()) for chunk in chunks)
    head.fields[b"index_pos"] = struct.pack("<Q", index_at)
    for _ in range(faults and dice.randint(1, faults)):
        spoil(dice.choice([*everything, *infos]), chunks, tail, dice)
    return b"#ROSBAG V2.0\n" + b"".join(record.encode() for record in (head, *chunks, *tail))


def spoil(record: Record, chunks: list[Record], tail: list[Record], dice: random.Random) -> None:
    how = dice.randrange(10)
    name = dice.choice(list(record.fields) or [b"op"])
    if how == 0:
        record.fields.pop(name, None)
    elif how == 1:
        record.fields[name] = dice.randbytes(dice.choice((0, 1, 4, 8, 300)))
    elif how == 2:
        record.fields[name] = struct.pack("<I", dice.choice(EDGES))
    elif how == 3:
        record.fields[dice.choice((b"size", b"compression", b"encryptor", b"", b"op", b"conn"))] = dice.choice(
            (b"", b"x", b"bz2", b"none", struct.pack("<I", dice.choice(EDGES)))
        )
    elif how == 4:
        record.lie = (dice.choice((None, *EDGES)), dice.choice((None, *EDGES)))
    elif how == 5 and isinstance(record.data, bytes):
        record.data = dice.choice((b"", dice.randbytes(30), record.data[:-3], record.data * 3, bytes(10**6)))
    elif how == 6 and isinstance(record.data, list):
        dice.shuffle(record.data)
    elif how == 7 and isinstance(record.data, list):
        record.data = record.data[:1] * dice.choice((0, 2, 2000))
    elif how == 8 and not isinstance(record.data, bytes):
        record.data = [Record({b"op": b"\2", b"conn": bytes(4), b"time": bytes(8)}, bytes(10**7))] * 20
        record.pack = dice.choice((b"bz2", b"lz4"))
    else:
        dice.shuffle(dice.choice((chunks, tail)))


# SQLite


VALUES: tuple[Callable[[random.Random], Any], ...] = (
    lambda _: None,
    lambda dice: dice.choice(BIG),
    lambda dice: dice.choice((0.5, float("inf"), -1e300)),
    lambda dice: dice.choice(("", "x", "a/b/C", "/", "std_msgs/msg/String", "\0", "\ud7ff\U0010ffff", "x" * 10**5)),
    lambda dice: dice.choice((b"", b"\0\1\0\0", b"\xff\xfe", zstandard.compress(bytes(10**7)), b"\x28\xb5\x2f\xfd")),
    lambda dice: dice.randbytes(dice.choice((1, 9, 1000))),
)
SCHEMA_FAULTS = (
    "DROP TABLE messages",
    "DROP TABLE topics",
    "ALTER TABLE topics RENAME COLUMN name TO n",
    "ALTER TABLE messages RENAME COLUMN timestamp TO rowid",
    "ALTER TABLE topics ADD COLUMN offered_qos_profiles",
    "ALTER TABLE topics ADD COLUMN type_description_hash DEFAULT 'RIHS01_x'",
    "ALTER TABLE messages ADD COLUMN extra BLOB DEFAULT (zeroblob(100000000))",
    "ALTER TABLE messages RENAME TO m; CREATE VIEW messages AS SELECT * FROM m JOIN m AS n",
    "ALTER TABLE messages RENAME TO m; CREATE VIEW messages AS SELECT * FROM messages",
    "ALTER TABLE topics RENAME TO t; CREATE VIEW topics AS WITH RECURSIVE r(id) AS (SELECT 1 UNION ALL SELECT id + 1"
    " FROM r) SELECT id, 'a' AS name, 'b' AS type, 'cdr' AS serialization_format FROM r",
    "ALTER TABLE messages RENAME TO m; CREATE TABLE messages(topic_id, timestamp, data AS (zeroblob(10000000)))",
    "ALTER TABLE messages RENAME TO m; CREATE TABLE messages(topic_id PRIMARY KEY, timestamp, data) WITHOUT ROWID",
    "ALTER TABLE messages RENAME TO m; CREATE TABLE MESSAGES(Topic_Id, Timestamp, Data)",
    "CREATE TRIGGER t AFTER INSERT ON messages BEGIN DELETE FROM topics; END",
    "CREATE INDEX timestamp_idx ON messages(timestamp ASC)",
    "CREATE INDEX i ON messages(length(data))",
    "CREATE TABLE schema(schema_version, ros_distro)",
    "CREATE TABLE metadata(id, metadata)",
    "CREATE TABLE message_definitions(topic_type, encoding, encoded_message_definition)",
    "CREATE VIEW metadata AS SELECT zeroblob(900000000) AS metadata",
    "CREATE VIRTUAL TABLE metadata USING fts4(metadata)",
    "PRAGMA user_version = 7",
    "DELETE FROM messages",
    "DELETE FROM topics",
)


def database(path: Path, dice: random.Random, faults: int) -> None:
    encoding = dice.choice(("UTF-8", "UTF-16le"))
    db = sqlite3.connect(path, isolation_level=None)
    db.execute(f"PRAGMA encoding = '{encoding}'")
    db.execute(f"PRAGMA page_size = {dice.choice((512, 1024, 4096))}")
    db.execute(f"PRAGMA journal_mode = {dice.choice(('DELETE', 'WAL'))}")
    db.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
    db.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
    db.executemany("INSERT INTO topics VALUES (?, ?, ?, 'cdr')", [(1, "/a", STRING1), (2, "/b", "x/msg/Y")])
    rows = [(1 + n % 2, 1000 + n, b"\0\1\0\0" + bytes([n]) * 200) for n in range(50)]
    db.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    for _ in range(faults and dice.randint(1, faults)):
        with suppress(sqlite3.Error, UnicodeError):
            how = dice.randrange(3)
            if how == 0:
                db.executescript(dice.choice(SCHEMA_FAULTS))
            elif how == 1:
                table, column = dice.choice(
                    (("topics", "name"), ("topics", "type"), ("topics", "serialization_format"))
                )
                db.execute(f"UPDATE {table} SET {column} = ? WHERE id = 1", (dice.choice(VALUES)(dice),))
            else:
                column = dice.choice(("topic_id", "timestamp", "data"))
                db.execute(f"UPDATE messages SET {column} = ? WHERE id % 9 = 1", (dice.choice(VALUES)(dice),))
    db.close()


# rosbag2


def rosbag2(folder: Path, dice: random.Random, kind: str) -> None:
    """A folder with a metadata.yaml; faults are where ``kind`` says."""
    storage = StoragePlugin.MCAP if kind == "logs" else dice.choice((StoragePlugin.MCAP, StoragePlugin.SQLITE3))
    if kind == "beside":
        storage = StoragePlugin.SQLITE3
    writer = Writer2(folder, version=dice.choice((8, 9)), storage_plugin=storage)
    if kind == "packed":
        mode = dice.choice((CompressionMode.FILE, CompressionMode.MESSAGE))
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        known = [
            writer.add_connection(f"/a{key}", STRING1, typestore=ROS2, offered_qos_profiles=QOS) for key in range(2)
        ]
        for n in range(20):
            words = ROS2.types[STRING1](data=f"number {n}")
            writer.write(known[n % 2], 1000 + n, bytes(ROS2.serialize_cdr(words, STRING1)))
    metadata = folder / "metadata.yaml"
    (file,) = (entry for entry in folder.iterdir() if entry != metadata)
    if kind == "metadata":
        metadata.write_bytes(spoiled_metadata(metadata.read_bytes(), dice))
    elif kind == "metadata bytes":
        metadata.write_bytes(spoiled_text(metadata.read_bytes(), dice))
    elif kind == "beside":
        for end in dice.sample(("-wal", "-journal", "-shm", ".zstd", ".results.mcap"), 2):
            content = dice.choice((b"", dice.randbytes(5000), file.read_bytes(), hot_journal(dice)))
            file.with_name(file.name + end).write_bytes(content)
    elif kind == "packed" and dice.random() < 0.3:
        data = dice.choice((bytes(200 * 2**20), file.read_bytes() + bytes(2**24)))
        file.write_bytes(zstandard.compress(data, 19))
    else:
        file.write_bytes(damaged(file.read_bytes(), dice))
    if dice.random() < 0.1:
        metadata.unlink()


def hot_journal(dice: random.Random) -> bytes:
    """A rollback journal that asks for pages to be put back."""
    count, nonce, pages, sector, size = (dice.choice(EDGES) for _ in range(5))
    head = bytes.fromhex("d9d505f920a163d7") + struct.pack(">IIIII", count, nonce, pages, sector or 512, size or 4096)
    return head.ljust(512, b"\0") + dice.randbytes(4096)


def spoiled_metadata(text: bytes, dice: random.Random) -> bytes:
    """Some values are others. JSON is YAML."""
    import yaml

    data = yaml.safe_load(text)
    places: list[tuple[Any, Any]] = []

    def walk(value: Any) -> None:
        for key in value if isinstance(value, dict) else range(len(value)):
            places.append((value, key))
            if isinstance(value[key], dict | list):
                walk(value[key])

    walk(data)
    others = ("", " ", "x", "../x", "/etc/passwd", "zstd", "file", "message", None, True, 0.5, [], {}, [[]], {"a": 1})
    for _ in range(dice.randint(1, 3)):
        value, key = dice.choice(places)
        how = dice.randrange(4)
        with suppress(KeyError, IndexError):
            if how == 0:
                del value[key]
            elif how == 1 and isinstance(value, list):
                value.append(value[key])
            elif how == 2 and isinstance(value[key], int):
                value[key] = dice.choice((*BIG, value[key] + 1, value[key] - 1))
            else:
                value[key] = dice.choice(others)
    return json.dumps(data).encode()


SNIPPETS = (b"&a ", b"*a", b"!!str ", b"!x ", b".inf", b"[" * 5000, b"{" * 5000, b"- ", b"? ", b": ", b"\n", b"\t", b"%YAML 1.1\n", b"---\n", b"...\n", b"\xff", b"\0", b"|\n", b">\n", b"#", b"'", b'"', b"<<: ", b"\xef\xbb\xbf", b"a: " * 3000)  # fmt: skip


def spoiled_text(text: bytes, dice: random.Random) -> bytes:
    """Characters that mean something to YAML at places where they meant nothing."""
    out = bytearray(text)
    for _ in range(dice.randint(1, 3)):
        at = dice.randrange(len(out) + 1)
        words = dice.choice(SNIPPETS)
        out[at : at + dice.choice((0, 0, 1))] = words * dice.choice((1, 1, 200))
    return damaged(bytes(out), dice) if dice.random() < 0.3 else bytes(out)
