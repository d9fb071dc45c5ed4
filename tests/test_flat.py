"""Channels of any schema as flat tables: protobuf, JSON, ROS 1 and ROS 2, written by their own libraries."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from grpc_tools import protoc
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError, call
from mcaptrack.notices import collected
from mcaptrack.sources.foreign import MessageType
from mcaptrack.sources.foreign.flatten import flattener

PROTO = """
syntax = "proto3";
package robot;
import "google/protobuf/timestamp.proto";
import "google/protobuf/duration.proto";
enum Mode { IDLE = 0; DRIVE = 1; }
message Point { double x = 1; float y = 2; }
message Track { Point at = 1; bytes blob = 2; repeated Point more = 3; }
message State {
  google.protobuf.Timestamp stamp = 1;
  google.protobuf.Duration took = 2;
  Track track = 3;
  repeated sint32 ids = 4;
  repeated Mode modes = 5;
  Mode mode = 6;
  uint64 big = 7;
  optional double maybe = 8;
  map<string, int32> counts = 9;
  string words = 10;
  bytes picture = 11;
  repeated Point points = 12;
  State inner = 13;
}
"""
ROS1_IMU = """std_msgs/Header header
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
uint8[] raw
string[] names
geometry_msgs/Vector3[] more
duration took
================================================================================
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""


def one_channel(path, name, encoding, schema, message_encoding, payloads):
    with log.create(path) as writer:
        number = writer.add_channel("/x", (name, encoding, schema), message_encoding, {})
        for n, payload in enumerate(payloads):
            writer.add_message(number, n, n, payload)
    with mcaptrack.open(path) as opened:
        return opened.table("/x")


def fields(table):
    """The columns after those that say when and where."""
    return table.column_names[7:-1]


def ns(table, name):
    return table.column(name).cast("timestamp[ns]").cast("int64").to_pylist()


@pytest.fixture(scope="module")
def state(tmp_path_factory):
    """The class of robot.State and its schema record, made by protoc."""
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message_factory import GetMessageClass

    folder = tmp_path_factory.mktemp("proto")
    (folder / "robot.proto").write_text(PROTO)
    include = str(__import__("pathlib").Path(protoc.__file__).parent / "_proto")
    words = [
        "",
        f"-I{folder}",
        f"-I{include}",
        "--include_imports",
        f"--descriptor_set_out={folder / 'out'}",
        "robot.proto",
    ]
    assert protoc.main(words) == 0
    schema = (folder / "out").read_bytes()
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(schema).file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName("robot.State")), schema


def test_protobuf_is_read_by_the_definition_in_the_log(tmp_path, state):
    make, schema = state
    full = make(mode=1, modes=[0, 1], big=2**64 - 1, maybe=-0.0, words='a,"b"\n', picture=b"\x00\xff", ids=[-1, 2])
    full.stamp.seconds, full.stamp.nanos = 5, 7
    full.took.seconds, full.took.nanos = -1, -5
    full.track.at.x, full.track.at.y = 5e-324, 0.1
    full.track.more.add(x=math.inf)
    full.counts["a"] = 3
    full.inner.words = "within"
    table = one_channel(
        tmp_path / "a.mcap", "robot.State", "protobuf", schema, "protobuf", [full.SerializeToString(), b""]
    )
    first, second = table.to_pylist()
    assert (ns(table, "stamp"), first["took_ns"]) == ([5_000_000_007, None], -1_000_000_005)
    assert (first["track_at_x"], first["track_at_y"]) == (5e-324, float(np.float32(0.1)))
    assert (first["ids"], first["modes"], first["mode"], first["big"]) == (
        [-1, 2], ["IDLE", "DRIVE"], "DRIVE", 2**64 - 1,
    )  # fmt: skip
    assert math.copysign(1, first["maybe"]) == -1
    assert (first["counts"], first["words"], first["inner_words"]) == ([{"key": "a", "value": 3}], 'a,"b"\n', "within")
    assert first["track_more"] == [{"x": math.inf, "y": 0.0}]
    assert first["points"] == second["points"] == []
    assert (second["maybe"], second["mode"], second["big"]) == (None, "IDLE", 0)
    assert "picture" not in fields(table)
    assert str(table.schema.field("track_at_y").metadata[b"path"], "utf-8") == "track.at.y"
    assert table.column("frame").to_pylist() == [0, 1]


def test_bytes_are_kept_where_they_are_asked_for(tmp_path, state):
    make, schema = state
    with log.create(tmp_path / "a.mcap") as writer:
        number = writer.add_channel("/x", ("robot.State", "protobuf", schema), "protobuf", {})
        writer.add_message(number, 0, 0, make(picture=b"\x00\xff").SerializeToString())
        other = writer.add_channel("/y", ("robot.State", "protobuf", schema), "protobuf", {})
        writer.add_message(other, 0, 0, make(picture=b"\x01").SerializeToString())
    from mcaptrack.tables.export import export
    from mcaptrack.tables.export.contents import MessagesPart

    with log.read(tmp_path / "a.mcap") as opened:
        done = export(opened, tmp_path / "t", topics=["/x"])
        assert done.notes == [
            f"/x: picture left out, bytes; {call('export', opened.path, topic='/x', blobs=True)} keeps them"
        ]
        export(opened, tmp_path / "t", topics=["/x"], part=MessagesPart(blobs=True))
        assert export(opened, tmp_path / "t").written == []  # and they stay
        assert export(opened, tmp_path / "t", topics=["/y"], part=MessagesPart(blobs=True)).rows["topics/y"] == 1
        (words,) = export(opened, tmp_path / "t", topics=["/y"]).notes
        assert words == f"/y: picture left out, bytes; {call('export', opened.path, topic='/y', blobs=True)} keeps them"
    import pyarrow.parquet as pq

    (file,) = (tmp_path / "t" / "topics" / "x").rglob("*.parquet")
    assert pq.ParquetFile(file).read().column("picture").to_pylist() == [b"\x00\xff"]


def test_fields_of_json_become_columns_with_names_of_their_own(tmp_path):
    rows = [
        {"i": 1, "a.b": 1, "t": 5, "T_2": 6, "only": [], "half": "\ud800x"},
        {"i": -(2**63), "a": {"b": 2}, "deep": {"l": [1, 2.5]}},
        {"mixed": [1, {"a": 1}], "recording": 3, "far": {"sec": 10**10, "nanosec": 5}},
    ]
    table = one_channel(tmp_path / "a.mcap", "", "", b"", "json", [json.dumps(row).encode() for row in rows])
    got = {name: table.column(name).to_pylist() for name in fields(table)}
    assert got["i"] == [1, -(2**63), None]
    assert (got["a.b"], got["a_b"]) == ([1, None, None], [None, 2, None])
    assert (got["t_2"], got["T_2_2"]) == ([5, None, None], [6, None, None])  # t is the log's time; capitals don't count
    assert got["recording_2"] == [None, None, 3]  # recording is the log's name, in SQL and in folders of tables
    assert got["deep_l"] == [None, [1.0, 2.5], None]
    assert got["mixed"] == [None, None, '[1,{"a":1}]']
    assert got["half"] == ["?x", None, None]
    assert (got["far_sec"][2], got["far_nanosec"][2]) == (10**10, 5)  # no time that 64 bits hold


def test_messages_that_protobuf_merges_are_those_that_are_written_merged(tmp_path):
    """A field that stands twice can't be read as a column: such messages are decoded each for itself."""
    twice = []
    for far in (0, 2**62):
        parts = [FrameTransform(child_frame_id="a"), FrameTransform(parent_frame_id="b")]
        parts[0].translation.x, parts[1].translation.y = 1.5, 2.5
        parts[0].timestamp.seconds, parts[1].timestamp.nanos = 5 + far, 7
        twice.append(b"".join(part.SerializeToString() for part in parts))
    schema = build_file_descriptor_set(FrameTransform).SerializeToString()
    tables = []
    for name, payloads in {
        "twice": twice,
        "merged": [FrameTransform.FromString(payload).SerializeToString() for payload in twice],
    }.items():
        path = tmp_path / f"{name}.mcap"
        tables.append(one_channel(path, "foxglove.FrameTransform", "protobuf", schema, "protobuf", payloads))
    rows = [table.select(fields(table)).to_pylist() for table in tables]
    assert rows[0] == rows[1]
    assert ns(tables[0], "timestamp") == [5_000_000_007, None]
    assert (rows[0][0]["translation_x"], rows[0][0]["translation_y"], rows[0][0]["rotation_x"]) == (1.5, 2.5, None)


@pytest.mark.parametrize("encoding", ["cdr", "json"])
def test_an_unreadable_message_costs_itself_wherever_it_is(tmp_path, monkeypatch, encoding):
    """Also as the first of a recording, alone in its batch; but a channel without any other is refused."""
    monkeypatch.setattr(log.messages, "_BATCH_BYTES", 1)
    good = b"\0\1\0\0" + np.float64(2.5).tobytes() if encoding == "cdr" else b'{"data": 2.5}'
    schema = ("std_msgs/msg/Float64", "ros2msg", b"float64 data") if encoding == "cdr" else ("", "", b"")
    for payloads in ([b"\0", good, good], [good, good, b"\0"], [b"\0"] * 3):
        path = tmp_path / "a.mcap"
        with path.open("wb") as stream:
            writer = Writer(stream, chunk_size=1)  # a chunk for each message
            writer.start()
            channel = writer.register_channel("/x", encoding, writer.register_schema(*schema))
            for payload in payloads:
                writer.add_message(channel, 7, payload, 7)  # all at one time
            writer.finish()
        with mcaptrack.open(path) as opened, collected() as warnings:
            if good not in payloads:
                with pytest.raises(McaptrackError, match=r"/x at 7 ns: .*; 3 of 3 messages are like this"):
                    opened.table("/x")
                continue
            values = opened.table("/x").column("data").to_pylist()
        assert values == [None if payload != good else 2.5 for payload in payloads]
        assert [warning.code for warning in warnings] == ["lost"]


SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4)
JSON = st.deferred(
    lambda: SCALARS | st.lists(JSON, max_size=3) | st.dictionaries(st.text(max_size=3), JSON, max_size=3)
)


@given(st.lists(JSON, max_size=8))
@settings(max_examples=10)
def test_whatever_json_holds_becomes_a_table(tmp_path_factory, values):
    path = tmp_path_factory.mktemp("j") / "a.mcap"
    table = one_channel(path, "", "", b"", "json", [json.dumps(value).encode() for value in values])
    assert table.num_rows == len(values)
    lowered = [name.lower() for name in table.column_names]
    assert len(set(lowered)) == len(lowered)


@given(st.binary(max_size=40), st.sampled_from(["protobuf", "json", "ros1", "cdr"]))
@settings(max_examples=50)
def test_any_bytes_are_a_message_or_a_fault_in_one_line(state, payload, encoding):
    schema = {"protobuf": state[1], "json": b"", "ros1": ROS1_IMU.encode(), "cdr": b"float64[] x\nstring s"}[encoding]
    name = {"protobuf": "robot.State", "json": "", "ros1": "robot/Imu", "cdr": "robot/msg/S"}[encoding]
    read = flattener(MessageType(name, {"ros1": "ros1msg", "cdr": "ros2msg"}.get(encoding, encoding), schema, encoding))
    try:
        assert isinstance(read(payload), dict)
    except McaptrackError as error:
        assert "\n" not in str(error)
