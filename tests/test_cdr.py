"""Rows as ROS 2 messages, against rosbags, which reads and writes them by the definition alone."""

from __future__ import annotations

import dataclasses
import random
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mcaptrack.schema import COUNTS, DETECTIONS, EVENTS, SCHEMAS, TRACKS, Frame, Rows, Schema
from mcaptrack.schema.encodings import (
    CDR,
    CdrCodec,
    RosField,
    cdr_codec,
    encoded,
    is_ros_topic,
    read_definition,
    reader_of,
    record_of,
    ros_name,
    schema_name_of,
    schema_of_ros,
)

EVERY = pytest.mark.parametrize("schema", SCHEMAS.values(), ids=lambda schema: schema.name)


def bits(schema: Schema, counts: list[int], seed: int) -> Rows:
    """Rows of any bits, some of them missing, for messages with so many rows."""
    draw = np.random.default_rng(seed)
    rows = schema.empty(sum(counts))
    for column in schema.columns:
        form = schema.dtype[column.name]
        raw = draw.integers(0, 2 if form.kind == "b" else 256, (len(rows), form.itemsize), np.uint8)
        keep = draw.random(len(rows)) < (0.7 if column.optional else 1.1)
        rows[column.name][keep] = raw.view(form)[:, 0][keep]
    return rows


def plain(rows: Rows) -> list[list[bytes]]:
    """The bytes of each value, by column: NaN has many forms."""
    return [rows[name].tobytes() for name in rows.dtype.names or ()]  # type: ignore[misc]


@cache
def store_of(schema: Schema, text: str = "") -> tuple[Any, str]:
    """Types by the definition alone."""
    name, encoding, data = record_of(schema, CDR)
    assert encoding == "ros2msg"
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text or data.decode(), name))
    return store, name


def split(rows: Rows, counts: list[int]) -> list[Rows]:
    return np.split(rows, np.cumsum(counts)[:-1])


@EVERY
@settings(max_examples=6, deadline=None)
@given(counts=st.lists(st.integers(0, 9), min_size=1, max_size=5), seed=st.integers(0, 10**6))
def test_rows_are_what_rosbags_reads_and_writes_by_the_definition(schema, counts, seed):
    rows = bits(schema, counts, seed)
    payloads = cdr_codec(schema).encode_all(rows, np.array(counts))
    store, name = store_of(schema)
    for payload, part in zip(payloads, split(rows, counts), strict=True):
        message, has_nan = store.deserialize_cdr(payload, name), False
        for field in part.dtype.names or ():
            values = np.array([getattr(row, field) for row in message.rows], part.dtype[field])
            assert np.array_equal(values, part[field], equal_nan=values.dtype.kind == "f"), field
            has_nan |= bool(np.isnan(values).any())
        assert has_nan or bytes(store.serialize_cdr(message, name)) == payload
    decoded, found = cdr_codec(schema).decode_all(payloads)
    assert found.tolist() == counts
    assert plain(decoded) == plain(rows)
    assert decoded.dtype == schema.dtype


@EVERY
def test_rows_are_the_same_as_in_protobuf(schema):
    counts = [3, 0, 1, 7]
    rows = bits(schema, counts, 5)
    by_protobuf, _ = schema.codec.decode_all([schema.codec.encode(part) for part in split(rows, counts)])
    frames = [Frame(t, 10 + t, part) for t, part in enumerate(split(rows, counts))]
    messages = list(encoded(schema, frames, CDR))
    assert [(t, number) for t, number, _ in messages] == [(0, 10), (1, 11), (2, 12), (3, 13)]
    by_cdr, _ = reader_of(schema, CDR, record_of(schema, CDR)[2]).decode_all([data for *_, data in messages])
    assert plain(by_cdr) == plain(by_protobuf)


@EVERY
def test_big_endian_messages_are_read_also_among_others(schema):
    counts = [2, 0, 5]
    rows = bits(schema, counts, 8)
    store, name = store_of(schema)
    little = cdr_codec(schema).encode_all(rows, np.array(counts))
    big = [bytes(store.serialize_cdr(store.deserialize_cdr(one, name), name, little_endian=False)) for one in little]
    assert big[0] != little[0]
    mixed = [big[0], little[1], big[2], little[0]]
    decoded, found = cdr_codec(schema).decode_all(mixed)
    assert found.tolist() == [2, 0, 5, 2]
    expected = np.concatenate([rows, rows[:2]])
    for field in rows.dtype.names or ():
        assert np.array_equal(decoded[field], expected[field], equal_nan=decoded[field].dtype.kind == "f")


@EVERY
def test_no_part_of_a_message_is_taken_for_one(schema):
    (payload,) = cdr_codec(schema).encode_all(bits(schema, [3], 1), np.array([3]))
    for end in [*range(9), *range(9, len(payload), 37), len(payload) - 1]:
        with pytest.raises(ValueError, match=rf"{end} bytes are not a CDR message"):
            cdr_codec(schema).decode_all([payload, payload[:end]])
    assert cdr_codec(schema).decode_all([payload + bytes(7)])[1].tolist() == [3]  # filled up by its writer
    wrong = [payload + bytes(8), b"\0\x07" + payload[2:], b"\1" + payload[1:], payload[:4] + b"\xff" * 4 + bytes(90)]
    for odd in wrong:
        with pytest.raises(ValueError, match="bytes are not a CDR message"):
            cdr_codec(schema).decode_all([odd])


def test_hostile_bytes_are_refused_or_read_as_rosbags_reads_them():
    draw, (store, name) = random.Random(3), store_of(EVENTS)
    (payload,) = cdr_codec(EVENTS).encode_all(bits(EVENTS, [2], 1), np.array([2]))
    read = 0
    for _ in range(300):
        odd = bytearray(payload)
        for _ in range(draw.randint(1, 3)):
            odd[draw.randrange(len(odd))] = draw.randrange(256)
        try:
            rows, counts = cdr_codec(EVENTS).decode_all([bytes(odd)])
        except ValueError:
            continue
        theirs = store.deserialize_cdr(bytes(odd), name).rows
        assert counts.tolist() == [len(theirs)]
        assert rows["track_id"].tolist() == [row.track_id for row in theirs]
        read += 1
    assert read > 100


def test_rows_whose_layout_depends_on_their_place():
    """Nine bytes, then two: each row begins elsewhere, modulo 8."""
    fields = [
        RosField("kind", "uint32"), RosField("odd", "uint8"), RosField("track_id", "int64"), RosField("b", "uint8"),
    ]  # fmt: skip
    text = "X[] rows\n" + "=" * 80 + "\nMSG: mcaptrack_msgs/X\n" + "\n".join(f"{f.kind} {f.name}" for f in fields)
    store, name = store_of(EVENTS, text)
    rows = [store.types["mcaptrack_msgs/msg/X"](kind=n, odd=n, track_id=-n, b=7) for n in range(40)]
    counts = [0, 1, 2, 13, 24]
    bounds = np.cumsum([0, *counts])
    parts = [rows[a:b] for a, b in pairwise(bounds.tolist())]
    messages = [bytes(store.serialize_cdr(store.types[name](rows=part), name)) for part in parts]
    decoded, found = CdrCodec(EVENTS.codec, fields).decode_all(messages)
    assert found.tolist() == counts
    assert decoded["kind"].tolist() == list(range(40))
    assert decoded["track_id"].tolist() == [-n for n in range(40)]
    assert decoded["source_id"].tolist() == [0] * 40


def definition(schema: Schema) -> str:
    return record_of(schema, CDR)[2].decode()


def without(text: str, name: str) -> str:
    return "".join(line for line in text.splitlines(keepends=True) if f" {name} " not in line.split("#")[0] + " ")


def test_messages_of_another_version_are_read_by_their_own_definition():
    rows = bits(TRACKS, [4], 2)
    text = definition(TRACKS)
    for name in ("z_m", "vx_m_per_s", "class_id", "score"):
        text = without(text, name)
    lines = text.splitlines()
    text = "\n".join([*lines[:-2], "uint8 KIND=3", "uint8 added 4", *reversed(lines[-2:]), "float32 of_later"])
    store, name = store_of(TRACKS, text)
    row = store.types["mcaptrack_msgs/msg/TracksRow"]
    fields = [field.name for field in dataclasses.fields(row) if field.name not in ("KIND", "__msgtype__")]
    values = {"added": [4] * 4, "of_later": [1.5] * 4} | {f: rows[f].tolist() for f in fields if f in rows.dtype.names}
    message = store.types[name](rows=[row(**{f: values[f][n] for f in fields}) for n in range(4)])
    payload = bytes(store.serialize_cdr(message, name))
    decoded, _ = reader_of(TRACKS, CDR, text.encode()).decode_all([payload])
    for field in rows.dtype.names or ():
        if field in fields:
            assert np.array_equal(decoded[field], rows[field], equal_nan=rows[field].dtype.kind == "f"), field
    assert np.isnan(decoded["z_m"]).all()
    assert np.isnan(decoded["score"]).all()
    assert decoded["class_id"].tolist() == [0] * 4


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("int64 track_id", "int32 track_id", "has int32 track_id, not int64"),
        ("int64 track_id", "string track_id", "has string track_id; rows have numbers only"),
        ("int64 track_id", "int64[2] track_id", r"has int64\[2\] track_id"),
        ("int64 track_id", "int64 other", "lacks track_id"),
        ("bool observed", "int64 track_id", "two fields of one name"),
        ("TracksRow[] rows", "TracksRow[] lines", "not one field, rows"),
        ("TracksRow[] rows", "TracksRow rows", "not one field, rows"),
        ("TracksRow[] rows", "TracksRow[] rows\nint32 more", "not one field, rows"),
        ("MSG: mcaptrack_msgs/TracksRow", "MSG: mcaptrack_msgs/Row", "does not say what mcaptrack_msgs/TracksRow is"),
        ("bool observed", "bool", "the line 'bool'"),
    ],
)
def test_a_definition_that_is_not_of_such_rows_is_refused(old, new, why):
    text = definition(TRACKS)
    assert old in text
    with pytest.raises(ValueError, match=why):
        read_definition(text.replace(old, new).encode(), TRACKS.definition)


def test_definitions_of_all_kinds_of_bytes_are_refused():
    for odd in (b"", b"\xff\xfe", b"=" * 80, b"#" * 2**21):
        with pytest.raises(ValueError, match="its definition"):
            read_definition(odd, COUNTS.definition)


def test_every_column_has_its_comment_and_says_what_is_missing():
    lines = {line.split()[1]: line for line in definition(DETECTIONS).splitlines() if " # " in line}
    for column in DETECTIONS.columns:
        assert column.doc in lines[column.name]
        assert lines[column.name].endswith("; NaN if missing") == column.is_nullable
    assert lines["source_id"].endswith("; -1 if missing")


def test_names_of_schemas_and_topics():
    assert ros_name("mcaptrack.Tracks") == "mcaptrack_msgs/msg/Tracks"
    assert schema_of_ros("mcaptrack_msgs/Tracks") == "mcaptrack.Tracks"
    assert schema_name_of("mcaptrack_msgs/msg/Tracks", "ros2msg", "cdr") == "mcaptrack.Tracks"
    for other in (("mcaptrack_msgs/msg/Track", "ros2msg", "cdr"), ("mcaptrack_msgs/msg/Tracks", "ros2msg", "json")):
        assert schema_name_of(*other) == other[0]
    assert all(map(is_ros_topic, ("/a/b_2/_c", "/a")))
    assert not any(map(is_ros_topic, ("/a/2b", "a", "/a/", "/a//b", "/a-b", "/" + 250 * "a")))
