"""``Recording.messages``: what the mcap package reads of the same file, in its types, decoded by its factories or by ours."""

from __future__ import annotations

import json
import random
import struct
import warnings
from collections.abc import Iterator, Sequence
from copy import deepcopy
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from typing import Any

import mcap_protobuf.decoder
import mcap_ros2.decoder
import mcap_ros2.writer
import numpy as np
import pandas as pd
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from mcap.decoder import DecoderFactory
from mcap.exceptions import DecoderNotFoundError
from mcap.reader import make_reader
from mcap.records import Channel, Message, Schema
from mcap.writer import CompressionType

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.log import messages as batches
from tests.logs import recorder

FILES: dict[str, dict[str, Any]] = {
    "one chunk": {},
    "small chunks": {"chunk_size": 300},
    "plain chunks": {"chunk_size": 300, "compression": CompressionType.NONE},
    "no chunks": {"use_chunking": False},
    "no statistics": {"chunk_size": 300, "use_statistics": False},
}
TOPICS: list[str | Sequence[str] | None] = [None, "/a", ["/a", "/c"], ("/b",), []]
RANGES = [(None, None), (20, None), (None, 40), (20, 40), (30, 30), (-5, 2**63), (2**64 - 1, None)]


def write_mixed(path: Path, **options: Any) -> Path:
    """Messages that are out of order, with equal times in and across chunks; two channels of a topic, one without schema."""
    chance = random.Random(5)
    with recorder(path, **options) as writer:
        schema = writer.register_schema("test.Thing", "jsonschema", b"{}")
        other = writer.register_schema("test.Other", "jsonschema", b"{}")
        channels = [
            writer.register_channel(topic, "json", schema_id, {"of": topic})
            for topic, schema_id in (("/a", schema), ("/b", schema), ("/c", 0), ("/a", other))
        ]
        for n in range(300):
            t_ns = chance.choice([n // 4, chance.randint(0, 80), 2**63 + n % 3])
            writer.add_message(chance.choice(channels), t_ns, json.dumps({"n": n}).encode(), t_ns // 2, n)
    return path


def by_mcap(path: Path, *args: Any, **options: Any) -> list[tuple[Schema | None, Channel, Message]]:
    with path.open("rb") as stream, warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # for the names of the range that all versions have
        return list(make_reader(stream).iter_messages(*args, **options))


@pytest.fixture(scope="module")
def mixed(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("mixed")
    return {name: write_mixed(folder / f"{name}.mcap", **options) for name, options in FILES.items()}


@pytest.mark.parametrize("small", [False, True])
@pytest.mark.parametrize("name", FILES)
def test_messages_are_those_of_the_mcap_package_in_the_same_order(mixed, name, small, monkeypatch):
    if small:  # chunks are closed while they have messages to come, and opened again
        monkeypatch.setattr(batches, "OPEN_BYTES", 500)
        monkeypatch.setattr(batches, "_KEPT_BYTES", 0)
    with mcaptrack.open(mixed[name]) as opened:
        for topics, (start, end) in [*product(TOPICS[:1], RANGES), *product(TOPICS[1:], RANGES[:4:3])]:
            wanted = by_mcap(mixed[name], topics, start, end)
            assert [found[:3] for found in opened.messages(topics, start, end, decode=False)] == wanted
            backwards = opened.messages(topics, start, end, decode=False, reverse=True)
            assert [found[:3] for found in backwards] == wanted[::-1]
            if "chunks" in name and name != "no chunks":
                assert wanted[::-1] == by_mcap(mixed[name], topics, start, end, reverse=True)
        assert all(found.decoded["n"] == found.message.sequence for found in opened.messages())


def test_the_tuple_is_that_of_the_mcap_package(mixed):
    with mcaptrack.open(mixed["one chunk"]) as opened:
        found = next(opened.messages("/b"))
    schema, channel, message, decoded = found
    assert (type(schema), type(channel), type(message)) == (Schema, Channel, Message)
    assert (schema, channel, message, decoded) == (found.schema, found.channel, found.message, found.decoded_message)


def test_what_is_given_is_the_callers_own(mixed):
    with mcaptrack.open(mixed["small chunks"]) as opened:
        before = deepcopy(list(opened.messages("/b")))
        for schema, channel, message, _ in opened.messages("/b"):
            schema.name, channel.topic, message.log_time = "x", "x", 0
            channel.metadata.clear()
        assert list(opened.messages("/b")) == before


def test_times_are_numbers_or_moments(mixed):
    moments = [
        20, np.int64(20), np.uint8(20), np.datetime64(20, "ns"), pd.Timestamp(20), pd.Timestamp(20, tz="Europe/Berlin"),
    ]  # fmt: skip
    wanted = [m.log_time for _, _, m in by_mcap(mixed["one chunk"]) if m.log_time == 20]
    assert wanted
    with mcaptrack.open(mixed["one chunk"]) as opened:
        for start in moments:
            assert [m.log_time for _, _, m, _ in opened.messages(start=start, end=21)] == wanted, start
        later = datetime(1970, 1, 1, 0, 0, 1, tzinfo=UTC)
        assert {m.log_time >= 2**63 for _, _, m, _ in opened.messages(start=later)} == {True}
        for wrong, why in (
            (0.5, "whole nanoseconds"), ("0", "whole nanoseconds"), (np.datetime64("NaT"), "NaT"), (pd.NaT, "NaT"),
            (datetime(1970, 1, 1), "time zone"), ([1], "whole nanoseconds"), (float("nan"), "whole nanoseconds"),
        ):  # fmt: skip
            with pytest.raises(McaptrackError, match=rf"`start=` needs .*{why}"):
                opened.messages(start=wrong)
        with pytest.raises(McaptrackError, match=r"`end=` is before `start=`: 1 and 2 ns"):
            opened.messages(start=2, end=1)


def test_only_chunks_in_the_period_are_read(tmp_path):
    path = tmp_path / "a.mcap"
    with recorder(path, chunk_size=100) as writer:
        channel = writer.register_channel("/a", "json", 0)
        for n in range(40):
            writer.add_message(channel, n, bytes(90), n)
    with log.read(path) as opened:
        content, chunks = bytearray(path.read_bytes()), list(opened.index.chunks)
    assert len(chunks) > 10
    for chunk in [*chunks[:4], *chunks[-4:]]:  # damaged: they can't be read
        content[chunk.chunk_start_offset + 60] ^= 0xFF
    path.write_bytes(content)
    start, end = chunks[4].message_start_time, chunks[-5].message_end_time + 1
    with mcaptrack.open(path) as opened:
        for reverse in (False, True):
            found = opened.messages("/a", start, end, decode=False, reverse=reverse)
            assert [m.log_time for _, _, m, _ in found] == list(range(start, end))[:: -1 if reverse else 1]
        with pytest.raises(McaptrackError, match=r"/|a.mcap is damaged"):
            list(opened.messages("/a", end=end, decode=False))


# Decoding


def decoded_by_mcap(path: Path, factory: DecoderFactory) -> list[Any]:
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[factory])
        return [found.decoded_message for found in reader.iter_decoded_messages()]


def plain(value: Any) -> Any:
    """A decoded message of any library as plain values."""
    if hasattr(value, "DESCRIPTOR"):
        return {field.name: plain(getattr(value, field.name)) for field in value.DESCRIPTOR.fields}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, bytes | str | int | float | bool | None):
        return value
    if isinstance(value, Sequence) or hasattr(value, "append"):
        return [plain(member) for member in value]
    names = getattr(value, "__slots__", None) or vars(value)
    return {name: plain(getattr(value, name)) for name in names if not name.startswith("_")}


TYPES = """std_msgs/Header header
geometry_msgs/Vector3 gyro
float64[3] cov
float32[] more
string[] names
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
IMU = {
    "header": {"stamp": {"sec": 1, "nanosec": 5}, "frame_id": "imu"}, "gyro": {"x": 0.5, "y": -1.0, "z": 2.0},
    "cov": [1.5, 2.0, 3.0], "more": [0.25], "names": ["ü", ""],
}  # fmt: skip


def write_ros2(path: Path) -> Path:
    with path.open("wb") as stream:
        writer = mcap_ros2.writer.Writer(stream)
        schema = writer.register_msgdef("robot/msg/Imu", TYPES)
        for n in range(3):
            writer.write_message("/imu", schema, IMU | {"more": [0.25] * n}, n, n, n)
        writer.finish()
    return path


def test_protobuf_is_decoded_as_the_mcap_package_does(template):
    wanted = decoded_by_mcap(template, mcap_protobuf.decoder.DecoderFactory())
    with mcaptrack.open(template) as opened:
        theirs = opened.messages(decoder_factories=[mcap_protobuf.decoder.DecoderFactory()])
        for found, ours, theirs_again in zip(wanted, opened.messages(), theirs, strict=True):
            for decoded in (ours.decoded, theirs_again.decoded):
                assert decoded.DESCRIPTOR.full_name == found.DESCRIPTOR.full_name == ours.schema.name
                assert decoded.SerializeToString(deterministic=True) == found.SerializeToString(deterministic=True)


def test_ros_2_is_decoded_as_the_mcap_package_does(tmp_path):
    path = write_ros2(tmp_path / "a.mcap")
    wanted = [IMU | {"more": [0.25] * n} for n in range(3)]
    assert [plain(found) for found in decoded_by_mcap(path, mcap_ros2.decoder.DecoderFactory())] == wanted
    with mcaptrack.open(path) as opened:
        theirs = opened.messages(decoder_factories=[mcap_ros2.decoder.DecoderFactory()])
        assert [plain(found.decoded) for found in theirs] == wanted
        assert [plain(found.decoded) for found in opened.messages()] == wanted


class Texts(DecoderFactory):
    """Decodes texts of ROS 1, and counts what it is asked."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, str]] = []

    def decoder_for(self, message_encoding: str, schema: Schema | None) -> Any:
        self.asked.append((message_encoding, schema.name if schema else ""))
        if message_encoding != "ros1" or schema is None or schema.encoding != "ros1msg":
            return None
        return lambda data: data[4 : 4 + struct.unpack("<I", data[:4])[0]].decode()


@pytest.fixture
def strange(tmp_path) -> Path:
    """A recording of ROS 1, with a channel of JSON and one in an encoding that nobody reads."""
    path = tmp_path / "strange.mcap"
    with recorder(path, "ros1") as writer:
        said = writer.add_channel("/said", ("std_msgs/String", "ros1msg", b"string data\n"), "ros1")
        plain_json = writer.register_channel("/json", "json", 0)
        own = writer.add_channel("/own", ("own", "own", b""), "own")
        for n in range(2):
            writer.add_message(said, 3 * n, struct.pack("<I", 2) + b"hi", 0)
            writer.add_message(plain_json, 3 * n + 1, json.dumps({"n": [n, None]}).encode(), 0)
            writer.add_message(own, 3 * n + 2, b"?", 0)
    return path


def test_factories_come_first_and_are_asked_once_a_channel(strange):
    factory = Texts()
    with mcaptrack.open(strange) as opened:
        found = opened.messages(["/said", "/json"], decoder_factories=[factory])
        assert [one.decoded for one in found] == ["hi", {"n": [0, None]}, "hi", {"n": [1, None]}]
        assert factory.asked == [("ros1", "std_msgs/String"), ("json", "")]
        assert [one.decoded.data for one in opened.messages("/said")] == ["hi", "hi"]


def test_what_nothing_decodes_is_refused_as_the_mcap_package_does(strange):
    with mcaptrack.open(strange) as opened:
        for kind in (DecoderNotFoundError, McaptrackError):
            found = opened.messages()
            assert [next(found).channel.topic for _ in range(2)] == ["/said", "/json"]
            with pytest.raises(
                kind, match=r"strange.mcap: /own at 2 ns: own in the encoding 'own' is not read.*`decode=False`"
            ):
                next(found)
        assert [(one.decoded, one.message.data) for one in opened.messages("/own", decode=False)] == [(None, b"?")] * 2


def test_payloads_that_are_damaged_are_refused_in_a_line_and_given_as_they_are(tmp_path):
    path = tmp_path / "a.mcap"
    with recorder(path) as writer:
        channel = writer.register_channel("/a", "json", 0)
        for payload in (b"{}", b"{", b"\xff"):
            writer.add_message(channel, 5, payload, 0)
    with mcaptrack.open(path) as opened:
        found = opened.messages("/a")
        assert next(found).decoded == {}
        with pytest.raises(McaptrackError, match=r"^\S+a.mcap: /a at 5 ns: 1 bytes are not a json message"):
            next(found)
        assert [one.message.data for one in opened.messages("/a", decode=False)] == [b"{}", b"{", b"\xff"]


def test_what_a_factory_raises_comes_as_it_is(strange):
    class Broken(DecoderFactory):
        def decoder_for(self, message_encoding: str, schema: Schema | None) -> Any:
            return lambda data: 1 // 0

    with mcaptrack.open(strange) as opened, pytest.raises(ZeroDivisionError):
        next(opened.messages(decoder_factories=[Broken()]))


class Kept(DecoderFactory):
    """Keeps decoders by the ids of schemas, as those of the mcap package do."""

    def __init__(self) -> None:
        self._kept: dict[int, Any] = {}

    def decoder_for(self, message_encoding: str, schema: Schema | None) -> Any:
        assert schema is not None
        name = schema.name
        return self._kept.setdefault(schema.id, lambda data: (name, data))


def write_named(path: Path, name: str, topics: Sequence[str]) -> Path:
    with recorder(path) as writer:
        schema = writer.register_schema(name, "jsonschema", b"")
        for topic in topics:
            channel = writer.register_channel(topic, "json", schema)
            writer.add_message(channel, 7, name.encode(), 0)
    return path


@pytest.fixture
def pair(tmp_path) -> Path:
    """A log with results beside it, which have the same ids, equal times, and a channel in place of one of the log."""
    write_named(tmp_path / "a.results.mcap", "of.Results", ["/new", "/both"])
    return write_named(tmp_path / "a.mcap", "of.Log", ["/both", "/old"])


def test_a_log_and_its_results_are_one_file(pair):
    wanted = [("/old", "of.Log"), ("/new", "of.Results"), ("/both", "of.Results")]
    with mcaptrack.open(pair) as opened:
        for reverse in (False, True):
            found = list(opened.messages(decoder_factories=[Kept()], reverse=reverse))
            assert [(one.channel.topic, one.schema.name) for one in found] == wanted[:: -1 if reverse else 1]
            for schema, channel, message, decoded in found:
                assert (channel.schema_id, message.channel_id) == (schema.id, channel.id)
                assert decoded == (schema.name, schema.name.encode())
        ids = {(one.channel.topic, one.channel.id, one.schema.id) for one in found}
        assert len({number for _, number, _ in ids}) == 3
        assert len({number for _, _, number in ids}) == 2


def test_factories_can_be_used_for_several_logs(pair, tmp_path):
    other = write_named(tmp_path / "b.mcap", "of.Other", ["/old"])
    factory = Kept()
    for path, name in ((pair, "of.Log"), (other, "of.Other"), (pair, "of.Log")):
        with mcaptrack.open(path) as opened:
            (found,) = opened.messages("/old", decoder_factories=[factory])
            assert (found.schema.id, found.decoded[0]) == (1, name)


# Odd input


@pytest.mark.parametrize("wrong", [Kept, [Kept], 5, "x", [None], object(), {"a": 1}])
def test_factories_are_instances(strange, wrong):
    with mcaptrack.open(strange) as opened:
        with pytest.raises(McaptrackError, match=r"^`decoder_factories=` has decoder factories of the mcap package, "):
            opened.messages(decoder_factories=wrong)
        assert next(opened.messages("/said", decoder_factories=Kept())).decoded[0] == "std_msgs/String"


def test_topics_are_names_of_channels_or_their_ends(strange, tmp_path):
    def names() -> Iterator[str]:
        yield from ("said", "/json")

    with mcaptrack.open(strange) as opened:
        for topics in (names(), {"said", "json"}, ["/said", "said", "/json"], ("said", "json")):
            assert {one.channel.topic for one in opened.messages(topics)} == {"/said", "/json"}
        with pytest.raises(McaptrackError, match=r"has no channel /nowhere; it has /json, /own, /said"):
            opened.messages(["/said", "/nowhere"])
        for wrong in (5, [5], [None], b"/said", [["/said"]]):
            with pytest.raises(McaptrackError, match="`topics=` is a topic, or several, not "):
                opened.messages(wrong)
        with pytest.raises(McaptrackError, match="`reverse=` is True or False, not 'no'"):
            opened.messages(reverse="no")
    write_named(tmp_path / "b.mcap", "x", ["/left/boxes", "/right/boxes", "/boxes/left"])
    with mcaptrack.open(tmp_path / "b.mcap") as opened:
        with pytest.raises(McaptrackError, match="has 2 channels boxes: /left/boxes, /right/boxes"):
            opened.messages("boxes")
        assert len(list(opened.messages("right/boxes", decode=False))) == 1


def test_a_log_without_messages_has_none(tmp_path):
    with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
        assert list(opened.messages()) == list(opened.messages(reverse=True)) == list(opened.messages([], 0, 0)) == []


def test_files_of_a_protobuf_definition_come_in_any_order(tmp_path):
    inner = FileDescriptorProto(name="a.proto", package="p")
    inner.message_type.add(name="Inner").field.add(name="x", number=1, type=5, label=1)
    outer = FileDescriptorProto(name="b.proto", package="p", dependency=["a.proto"])
    outer.message_type.add(name="Outer").field.add(name="inner", number=1, type=11, label=1, type_name=".p.Inner")
    for files in ([inner, outer], [outer, inner]):
        path = tmp_path / "a.mcap"
        with recorder(path) as writer:
            schema = writer.register_schema("p.Outer", "protobuf", FileDescriptorSet(file=files).SerializeToString())
            writer.add_message(writer.register_channel("/a", "protobuf", schema), 1, b"\x0a\x02\x08\x05", 1)
        with mcaptrack.open(path) as opened:
            assert [plain(one.decoded) for one in opened.messages()] == [{"inner": {"x": 5}}]
            assert opened.table("/a").column("inner_x").to_pylist() == [5]
