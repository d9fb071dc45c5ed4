"""Channels of one recording as tables, in one pass over its chunks: against mcap's own reader."""

from __future__ import annotations

import json
import random
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.log import chunks, messages
from mcaptrack.notices import collected
from mcaptrack.tables import export, files
from mcaptrack.tables import messages as tables_of_messages
from tests.logs import recorder
from tests.tiers import one_in

DEFINITION = b"float64 x\nstring name\nuint8[] blob\n"
TOPICS = ("/fast", "/large", "/a b/\u00fc", "/rare", "/empty")


def payload(draw: random.Random, most: int) -> bytes:
    name = draw.choice(["", "a", "base_link", "x" * 40]).encode() + b"\0"
    out = b"\0\1\0\0" + struct.pack("<dI", draw.random(), len(name)) + name
    out += bytes(-(len(out) - 4) % 4)
    blob = bytes(draw.randrange(most))
    return out + struct.pack("<I", len(blob)) + blob


def recording(path: Path, seed: int, compression: CompressionType = CompressionType.ZSTD) -> Path:
    draw = random.Random(seed)
    events = [(n * 1000, "/fast", payload(draw, 8)) for n in range(400)]
    events += [(n * 50_000 + 7, "/large", payload(draw, 9000)) for n in range(8)]
    events += [(draw.randrange(400_000), "/a b/\u00fc", payload(draw, 60)) for _ in range(50)]
    events += [(5, "/rare", payload(draw, 1))]
    events.sort(key=lambda event: event[0] + draw.choice([0, 0, 0, 30_000]))
    with recorder(path, chunk_size=draw.choice([600, 4000, 20_000]), compression=compression) as writer:
        schema = writer.register_schema("test_msgs/msg/A", "ros2msg", DEFINITION)
        of_lists = writer.register_schema("test_msgs/msg/B", "ros2msg", DEFINITION + b"string[] names\n")
        kinds = {"/empty": of_lists}
        numbers = {topic: writer.register_channel(topic, "cdr", kinds.get(topic, schema)) for topic in TOPICS}
        for t_ns, topic, data in events:
            writer.add_message(numbers[topic], t_ns, data, t_ns)
    return path


def expected(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    out: dict[str, list[tuple[int, bytes]]] = {topic: [] for topic in TOPICS}
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            out[channel.topic].append((message.log_time, message.data))
    return out


def fields(data: bytes) -> tuple[float, str, bytes]:
    x, size = struct.unpack_from("<dI", data, 4)
    at = 16 + size + -(12 + size) % 4
    return x, data[16 : 15 + size].decode(), data[at + 4 : at + 4 + struct.unpack_from("<I", data, at)[0]]


def table_of(folder: Path, topic: str) -> Any:
    (manifest,) = folder.glob("manifest/*/part-0.json")
    (about,) = [row for row in json.loads(manifest.read_text()) if row["topic"] == topic]
    assert (about["file"] is None) == (about["messages"] == 0) == (about["reason"] == "it has no messages")
    columns = ("t_ns", "x", "name", "blob", "chunk_offset")
    empty = pa.table([[]] * len(columns), columns)
    return pq.read_table(folder / about["file"], partitioning=None) if about["messages"] else empty, about


def rows(table: Any) -> list[tuple[Any, ...]]:
    return list(zip(*(table.column(name).to_pylist() for name in ("t_ns", "x", "name", "blob")), strict=True))


@pytest.mark.parametrize("seed", one_in(4, range(4)))
def test_tables_of_all_channels_hold_what_mcap_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    path = recording(tmp_path / "a.mcap", seed)
    monkeypatch.setattr(messages, "_BATCH_BYTES", random.Random(seed).choice([1, 1000, 2**22]))
    monkeypatch.setattr(messages, "_WAITING_BYTES", 30_000)
    monkeypatch.setattr(messages, "_WINDOW_BYTES", random.Random(seed).choice([1, 5000, 2**24]))
    monkeypatch.setattr(export, "_WAITING_BYTES", 50_000)
    monkeypatch.setattr(export, "_MOST_AT_ONCE", 2 + seed)
    written = []
    for threads in ("1", "3"):
        monkeypatch.setenv("OMP_NUM_THREADS", threads)
        folder = tmp_path / threads
        mcaptrack.export(path, folder, topic=TOPICS, blobs=True)
        written.append({file.relative_to(folder): file.read_bytes() for file in folder.glob("topics/*/*/*")})
    assert written[0] == written[1]
    for topic, read in expected(path).items():
        table, about = table_of(tmp_path / "1", topic)
        assert sorted(rows(table)) == sorted((t_ns, *fields(data)) for t_ns, data in read)
        times = [t_ns for t_ns, _ in read]
        assert table.column("t_ns").to_pylist() == sorted(times)
        assert (about["rows"], about["messages"]) == (len(read), len(read))
        assert about["first_t_ns"] == min(times, default=None)
        assert about["largest_gap_s"] == (np.diff(sorted(times)).max() / 1e9 if len(times) > 1 else None)
        with log.read(path) as opened:
            for row in table.slice(0, 3).to_pylist():
                found, message = opened.message_at(row["chunk_offset"], row["message_offset"])
                assert (found, fields(message.payload)[0]) == (topic, row["x"])


def test_a_damaged_chunk_costs_its_messages_only(tmp_path: Path) -> None:
    path = recording(tmp_path / "a.mcap", 5, CompressionType.NONE)
    read = expected(path)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    bad = summary.chunk_indexes[len(summary.chunk_indexes) // 2]
    raw = bytearray(path.read_bytes())
    raw[bad.chunk_start_offset + 100] ^= 1
    path.write_bytes(raw)
    with collected() as warnings:
        mcaptrack.export(path, tmp_path / "t", topic=TOPICS, blobs=True)
    lost = 0
    for topic, intact in read.items():
        table, _ = table_of(tmp_path / "t", topic)
        is_lost = [place == bad.chunk_start_offset for place in table.column("chunk_offset").to_pylist()]
        assert table.column("x").is_null().to_pylist() == is_lost
        kept = [row for row, of_bad in zip(rows(table), is_lost, strict=True) if not of_bad]
        assert len(table) == len(intact)
        assert set(kept) <= {(t_ns, *fields(data)) for t_ns, data in intact}
        text = f"{topic}: {sum(is_lost)} of {len(intact)} messages are in damaged chunks"
        assert any(text in str(warning) for warning in warnings) == any(is_lost)
        lost += sum(is_lost)
    assert lost


def test_fields_and_periods_are_those_of_the_whole_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = recording(tmp_path / "a.mcap", 0)
    opened_chunks: list[int] = []
    real = chunks.open_chunk_with_checksum

    def counted(buffer: Any, record: Any) -> Any:
        opened_chunks.append(record.start)
        return real(buffer, record)

    monkeypatch.setattr(messages, "open_chunk_with_checksum", counted)
    with mcaptrack.open(path) as opened:
        whole = opened.table("/fast", blobs=True)
    everything = len(set(opened_chunks))
    opened_chunks.clear()
    with mcaptrack.open(path) as opened:
        some = opened.table("/fast", columns=["name", "x"], start=100_000, end=150_000)
        assert some.column_names == [name for name in whole.column_names if name != "blob"]
        times = whole.column("t_ns").to_numpy()
        assert some.equals(whole.filter((times >= 100_000) & (times < 150_000)).select(some.column_names))
        assert 0 < len(set(opened_chunks)) < everything / 2
        with pytest.raises(McaptrackError, match="no field z; it has x, name"):
            opened.table("/fast", columns="z")
        with pytest.raises(McaptrackError, match="tracks is read whole"):
            opened.table("tracks", start=5)


def test_a_channel_that_can_not_be_read_loses_its_table_and_the_manifest_says_why(tmp_path: Path) -> None:
    for bad in (False, True):
        with recorder(tmp_path / "a.mcap") as writer:
            schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data")
            for topic in ("/good", "/bad"):
                number = writer.register_channel(topic, "cdr", schema)
                data = b"\0" if bad and topic == "/bad" else b"\0\1\0\0" + bytes(8)
                writer.add_message(number, 1, data, 1)
        with collected():
            done = mcaptrack.export(tmp_path / "a.mcap", tmp_path / "t", all_topics=True)
    (text,) = (tmp_path / "t").glob("manifest/*/*.json")
    about = {row["topic"]: row for row in json.loads(text.read_text())}
    assert [file.parent.parent.name for file in (tmp_path / "t").glob("topics/*/*/*")] == ["good"]
    assert "topics/bad" not in done.rows
    assert about["/good"]["reason"] is None
    assert "/bad at 1 ns: it has no head" in about["/bad"]["reason"]


def test_pages_of_lists_and_structs_have_dictionaries_of_text() -> None:
    import pyarrow as pa

    kind = pa.list_(pa.struct([("name", pa.string()), ("x", pa.list_(pa.float64()))]))
    encodings = files._encodings(pa.schema([("a", kind), ("b", pa.int64())]))
    assert encodings["use_dictionary"] == ["a.list.element.name"]
    assert encodings["column_encoding"] == {
        "a.list.element.x.list.element": "BYTE_STREAM_SPLIT",
        "b": "DELTA_BINARY_PACKED",
    }


#: Messages that Arrow reads in another way than Python, or that others make so.
ODD = (
    (b'{"a": 9007199254740993}', b'{"a": 0.5}'), (b'{"a": 18446744073709551615}',), (b'{"a": [9007199254740993, 0.5]}',),
    (b'{"s": "2020-01-01 00:00:00"}',), (b'{"s": ["2020-01-01"]}',), (b'{"s": "\\ud800"}',), (b'{"s": "\xff"}',),
    (b'{"a":',), (b"",), (b"[1]",), (b"{}",), (b'{"a": 1, "a": 2}',), (b'{\n"a": 1\n}',), (b' {"a": 1}',), (b'{"a": Inf}',),
    (b'{"a": Infinity}',), (b'{"a": 1e400}',), (b'{"a": 1}{"a": 2}',), (b'{"a": 1,', b'"b": 2}', b'{"a": 1}{"a": 2}'),
    (b'{"a": 1}', b'{"a": 1}{"a": 2}'), (b'{"a": 1, "b": 2}', b'{"a": 1, "b": 2}{"a": 1, "b": 2}', b'{"a": 1,', b'"b": 2}'),
    (b'{"v": [1, "x"]}',), (b'{"v": [[1]]}',), (b'{"v": [{"x": 1}]}',), (b'{"a": true}', b'{"a": 1}'),
    (b'{"v": [{"at": {"sec": 1, "nanosec": 2}}]}',), (b'{"at": {"sec": 1}}',), (b'{"at": {"sec": 1, "nanosec": 2.5}}',),
    (b'{"at": {"sec": 1, "nanosec": 5}}', b'{"at": {"sec": 1}}'), (b'{"at": {"sec": 1, "nanosec": 5}}', b'{"at": null}'),
    (b'{"at": {"nanosec": 1, "sec": 2}}',), (b'{"at": {"sec": 99999999999, "nanosec": 1}}',), (b'{"sec": 1, "nanosec": 2}',),
    (b'{"at": {"sec": 1, "nanosec": true}}',), (b'{"in": {"z": true}}', b'{"in": null}'), (b'{"in": {"y": 1}, "z": 1}',),
    (b'{"in": {"x": 1}}', b'{"z": 1, "in": {"y": 1}}'), (b'{"in": {}}', b'{"in": 1}'), (b'{"a": 1}', b'{"b": 1}'),
    (b'{"a": []}', b'{"a": ' + b"[" * 40 + b"]" * 40 + b"}"), (b'{"s": "' + b"]" * 10**5 + b'", "a": ' + b"[" * 10**5 + b"]" * 10**5 + b"}",),
)  # fmt: skip


def json_messages(draw: random.Random) -> Iterator[bytes]:
    left_out = draw.choice(["", "", "a", "inner"])
    for number in range(draw.choice([1, 30])):
        message = {
            "a": draw.choice([number, number + 0.5, None, -0.0]),
            "at": {"sec": number, "nanosec": draw.randrange(10**9)},
            "inner": {"v": [draw.random()] * draw.randrange(3), "s": draw.choice(["", "é\u0000日"])},
            "s": draw.choice(["text", "a\nb"]),
            "n": [],
        }
        if number or draw.random() < 0.5:
            message.pop(left_out, None)
        yield json.dumps(message, ensure_ascii=draw.random() < 0.5).encode()


@pytest.mark.parametrize("part", one_in(4, range(4)))
def test_messages_in_json_read_at_once_equal_those_read_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: int
) -> None:
    at_once, read = 0, tables_of_messages._json_columns

    def counted(*arguments: Any) -> Any:
        nonlocal at_once
        columns = read(*arguments)
        at_once += bool(columns)
        return columns

    for seed in range(part * 35, part * 35 + 35):
        draw = random.Random(seed)
        payloads = list(json_messages(draw)) if draw.random() < 0.5 else []
        for odd in draw.sample(ODD, draw.choice([0, 0, 1])) + [ODD[seed % len(ODD)]] * (not payloads or seed % 3 > 0):
            place = draw.randrange(len(payloads) + 1)
            payloads[place:place] = odd
        path = tmp_path / f"{seed}.mcap"
        with path.open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            channel = writer.register_channel("/j", "json", writer.register_schema("J", "jsonschema", b"{}"))
            for number, payload in enumerate(payloads):
                writer.add_message(channel, number, payload, number)
            writer.finish()
        tables = []
        for reader in (counted, lambda *_: {}):
            monkeypatch.setattr(tables_of_messages, "_json_columns", reader)
            with mcaptrack.open(path) as opened, collected():
                try:
                    table = opened.table("/j")
                    tables.append((table.schema.to_string(), str(table.to_pylist())))  # NaN is not NaN
                except McaptrackError as error:
                    tables.append(("", str(error)))
        assert tables[0] == tables[1], seed
    assert at_once > 2


def test_types_without_fields_have_tables_and_others_without_one_say_why(tmp_path: Path) -> None:
    with recorder(tmp_path / "a.mcap") as writer:
        for topic, name, definition, data in (
            ("/CASE", "std_msgs/msg/Empty", b"", b"\0\1\0\0\0"),
            ("/case", "std_msgs/msg/Empty", b"", b"\0\1\0\0\0"),
            ("/wide", "my_msgs/msg/Wide", b"wstring text", b"\0\1\0\0\0\0\0\0"),
        ):
            schema = writer.register_schema(name, "ros2msg", definition)
            writer.add_message(writer.register_channel(topic, "cdr", schema), 1, data, 1)
    with collected() as warnings:
        done = mcaptrack.export(tmp_path / "a.mcap", tmp_path / "t", all_topics=True)
    assert {topic: done.rows[f"topics/{topic}"] for topic in ("CASE", "case")} == {"CASE": 1, "case": 1}
    texts = " ".join(map(str, warnings))
    assert "the tables of /CASE and /case are in one folder where capitals don't count" in texts
    assert "a field is a wstring, which is not read" in texts
    assert "does not say what std_msgs/msg/Empty is" not in texts
