"""Messages as Arrow columns equal what other software reads: rosbags and the protobuf runtime."""

from __future__ import annotations

import importlib
import math
import random
import tracemalloc
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mcaptrack.columns import Malformed, ProtobufColumns, RosColumns, Unsupported
from mcaptrack.columns.cdr import FEW
from tests.tiers import one_in

NS = 10**9
#: Types whose alignment, lengths and nesting are awkward.
CUSTOM = {
    "test_msgs/msg/Deep": "bool flag\nfloat64 x\nuint8 tail\n",
    "test_msgs/msg/Odd": (
        "uint8 a\nfloat64 b\nint16 c\nuint8[3] d\nint8[] e\nbool[] f\nstring[2] g\nint64[] h\nuint16[] i\n"
        "string j\nuint8 k\nstring<=3 l\nint16[<=3] m\n"
    ),
    "test_msgs/msg/All": (
        "test_msgs/Odd[] odds\ntest_msgs/Deep[] deeps\ntest_msgs/Odd[2] pair\ntest_msgs/Deep[3] three\nint8 z\n"
        "test_msgs/Odd one\nfloat32[4] q\nbyte w\nchar v\nstring[] words\nint32 tail\nstd_msgs/Empty[] nothings\n"
    ),
    "test_msgs/msg/Spans": "DURATION[] spans\nTIME[] times\nTIME at\nDURATION lasting\n",
}
TIMES = ({"sec", "nanosec"}, {"sec", "nsec"}, {"secs", "nsecs"})
PLACEHOLDER = "structure_needs_at_least_one_member"


def store_of(encoding: str) -> Any:
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.LATEST)
    types: dict[str, Any] = {}
    is_ros1 = encoding == "ros1"
    for name, definition in CUSTOM.items():
        text = definition.replace("TIME", "time" if is_ros1 else "builtin_interfaces/Time")
        types |= get_types_from_msg(
            text.replace("DURATION", "duration" if is_ros1 else "builtin_interfaces/Duration"), name
        )
    store.register(types)
    return store


class Draw:
    """Random messages of the types of a store."""

    def __init__(self, store: Any, seed: str) -> None:
        self.random, self.store = random.Random(seed), store
        self.counts = self.random.choice([[0], [1], [3], [0, 1, 2, 3, 7], [0, 20], [2]])

    def base(self, kind: str) -> Any:
        draw = self.random
        if kind == "string":
            count = draw.choice([0, 1, 2, 3, 5, 8, 13, 30])
            return "".join(draw.choice("abcé日/_ ") for _ in range(count))
        if kind == "bool":
            return draw.random() < 0.5
        if kind.startswith("float"):
            return float(np.dtype(kind).type(draw.choice([0.0, 1.5, -2.25e10, math.nan, math.inf, draw.random()])))
        if kind in ("byte", "char", "octet"):
            return draw.choice([0, 1, 127, 33])
        limits = np.iinfo(kind)
        return draw.choice([0, 1, int(limits.max), int(limits.min), draw.randint(int(limits.min), int(limits.max))])

    def value(self, form: Any) -> Any:
        node, what = int(form[0]), form[1]
        if node == 1:
            return self.base(what[0])
        if node == 2:
            fields = self.store.fielddefs[what][1]
            is_time = {name for name, _ in fields} in TIMES
            inner = {name: self.random.randint(0, 2**31 - 1) % NS if is_time else self.value(of) for name, of in fields}
            return self.store.types[what](**inner)
        member, count = what
        size = count if node == 3 else self.random.choice(self.counts)
        values = [self.value(member) for _ in range(size)]
        is_number = int(member[0]) == 1 and member[1][0] != "string"
        plain = {"bool": "bool", "byte": "uint8", "char": "uint8", "octet": "uint8"}
        return np.array(values, plain.get(member[1][0], member[1][0])) if is_number else values


def as_python(store: Any, form: Any, value: Any) -> Any:
    """What rosbags read, in the form that the columns have."""
    node, what = int(form[0]), form[1]
    if node == 1:
        value = value.item() if isinstance(value, np.generic) else value
        return value % 256 if what[0] == "byte" else value  # rosbags reads a sign, which ROS 2 doesn't know
    if node == 2:
        fields = store.fielddefs[what][1]
        if is_time(store, form):
            seconds, parts = (int(getattr(value, name)) for name, _ in fields)
            return seconds * NS + parts
        return {
            f"{name}_ns" if is_time(store, of) and of[1].endswith("Duration") else name: as_python(
                store, of, getattr(value, name)
            )
            for name, of in fields
            if name != PLACEHOLDER
        }
    member = what[0]
    if int(member[0]) == 1 and member[1][0] in ("uint8", "int8", "byte", "char", "octet"):
        return value if isinstance(value, bytes) else np.array(value, np.int64).astype(np.uint8).tobytes()
    return [as_python(store, member, inner) for inner in value]


def is_time(store: Any, form: Any) -> bool:
    return int(form[0]) == 2 and {name for name, _ in store.fielddefs[form[1]][1]} in TIMES


def python_of(array: pa.Array) -> list[Any]:
    """The values of an Arrow array; times in nanoseconds."""
    if pa.types.is_timestamp(array.type):
        return array.cast(pa.int64()).to_pylist()
    if pa.types.is_list(array.type):
        offsets, values = array.offsets.to_pylist(), python_of(array.values)
        pairs = zip(offsets[:-1], offsets[1:], array.is_valid().to_pylist(), strict=True)
        return [values[low:high] if valid else None for low, high, valid in pairs]
    if pa.types.is_struct(array.type):
        columns = {field.name: python_of(array.field(number)) for number, field in enumerate(array.type)}
        valid = array.is_valid().to_pylist()
        return [
            {name: values[row] for name, values in columns.items()} if valid[row] else None for row in range(len(array))
        ]
    return array.to_pylist()


def rows_of(columns: dict[tuple[str, ...], pa.Array], count: int) -> list[dict[str, Any]]:
    out: list[dict[str, Any]] = [{} for _ in range(count)]
    for path, column in columns.items():
        column.validate(full=True)
        for row, value in enumerate(python_of(column)):
            inner = out[row]
            for name in path[:-1]:
                inner = inner.setdefault(name, {})
            inner[path[-1]] = value
    return out


def same(first: Any, second: Any) -> bool:
    if isinstance(first, dict) and isinstance(second, dict):
        return first.keys() == second.keys() and all(same(value, second[key]) for key, value in first.items())
    if isinstance(first, list) and isinstance(second, list):
        return len(first) == len(second) and all(map(same, first, second))
    if isinstance(first, float) and isinstance(second, float):
        return first == second or (math.isnan(first) and math.isnan(second))
    return type(first) is type(second) and bool(first == second)


def laid_out(payloads: Sequence[bytes], draw: random.Random | None) -> tuple[Any, Any, Any]:
    """Payloads in one buffer, with random gaps between them."""
    data, start, end = b"", [], []
    for payload in payloads:
        data += bytes(draw.randint(0, 9)) if draw else b""
        start.append(len(data))
        data += payload
        end.append(len(data))
    return np.frombuffer(data, np.uint8), np.array(start, np.int64), np.array(end, np.int64)


def batches(encoding: str, name: str, store: Any, seeds: int) -> Iterator[tuple[Draw, list[bytes]]]:
    for seed in range(seeds):
        draw = Draw(store, f"{name} {seed}")
        count = draw.random.choice([1, 2, 5, 13, 40] if name != "test_msgs/msg/All" else [1, 3, 15])
        messages = [draw.value((2, name)) for _ in range(count)]
        if draw.random.random() < 0.2:
            messages = messages[:1] * count
        order = draw.random.choice([True, True, False, None])
        if encoding == "ros1":
            payloads = [bytes(store.serialize_ros1(message, name)) for message in messages]
        else:
            orders = [draw.random.random() < 0.5 if order is None else order for _ in messages]
            payloads = [
                bytes(store.serialize_cdr(message, name, little_endian=little))
                for message, little in zip(messages, orders, strict=True)
            ]
            if draw.random.random() < 0.3:
                payloads = [payload + bytes(-len(payload) % 4) for payload in payloads]
        yield draw, payloads


def read_by_rosbags(store: Any, encoding: str, name: str, payload: bytes) -> Any:
    read = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    message = read(payload, name)
    if is_time(store, (2, name)):  # a time that is a message, not a field of one, stays what it is
        return {field: int(getattr(message, field)) for field, _ in store.fielddefs[name][1]}
    return as_python(store, (2, name), message)


def without_empty(message: dict[str, Any]) -> dict[str, Any]:
    """A message without the messages in it that have no fields: they have no columns."""
    inner = {name: without_empty(value) if isinstance(value, dict) else value for name, value in message.items()}
    return {name: value for name, value in inner.items() if value != {}}


def types_of(encoding: str) -> list[tuple[Any, str]]:
    """The types of all distributions with their stores, each definition once, and the awkward ones."""
    version = 1 if encoding == "ros1" else 2
    different = {(name, ""): (store_of(encoding), name) for name in CUSTOM}
    for distribution in Stores:
        if distribution is not Stores.EMPTY and distribution.name.startswith("ROS1") == (version == 1):
            store = get_typestore(distribution)
            for name in store.fielddefs:
                different.setdefault((name, store.generate_msgdef(name, ros_version=version)[1]), (store, name))
    return list(different.values())


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_columns_equal_what_rosbags_reads(encoding: str) -> None:
    for store, name in types_of(encoding):
        columns = RosColumns(store.fielddefs, name, encoding)
        for draw, payloads in batches(encoding, name, store, 8 if name in CUSTOM else 1):
            rows = rows_of(
                columns.read(*laid_out(payloads, draw.random if draw.random.random() < 0.6 else None)), len(payloads)
            )
            for row, payload in zip(rows, payloads, strict=True):
                assert same(without_empty(read_by_rosbags(store, encoding, name, payload)), row), (name, payload)


def damaged(draw: random.Random, payload: bytes, has_head: bool) -> bytes:
    out = bytearray(payload)
    how = draw.choice(["cut", "bytes", "length", "longer", "noise"])
    if how == "cut":
        return bytes(out[: draw.randrange(len(out) + 1)])
    if how == "bytes" and out:
        for _ in range(draw.randint(1, 4)):
            out[draw.randrange(len(out))] = draw.randrange(256)
    elif how == "length" and len(out) >= 8:
        place = draw.randrange(4, len(out) - 3)
        place -= place % 4 if has_head else 0
        number = draw.choice([2**32 - 1, 2**31, len(out), len(out) - place, 1000, 2**28, 5])
        out[place : place + 4] = number.to_bytes(4, "little")
    elif how == "longer":
        out += draw.randbytes(draw.randint(1, 20))
    else:
        noise = draw.randbytes(draw.randint(0, 200))
        return (b"\0\1\0\0" if has_head else b"") + noise[4:]
    return bytes(out)


@pytest.mark.parametrize("encoding", one_in(2, ["ros1", "cdr"]))
def test_damaged_messages_are_refused_where_rosbags_refuses_them(encoding: str) -> None:
    refused = 0
    for store, name in types_of(encoding):
        columns = RosColumns(store.fielddefs, name, encoding)
        for draw, payloads in batches(encoding, name, store, 8 if name in CUSTOM else 1):
            bad = draw.random.randrange(len(payloads))
            payloads[bad] = damaged(draw.random, payloads[bad], encoding == "cdr")
            store.max_sequence_length = max(len(payloads[bad]), 1)
            try:
                expected = read_by_rosbags(store, encoding, name, payloads[bad])
            except Exception:  # of a decoder that raises various exceptions
                expected = None
            try:
                rows = rows_of(columns.read(*laid_out(payloads, draw.random)), len(payloads))
            except Unsupported as error:
                assert "encapsulation" in str(error)
            except Malformed as error:
                assert error.message == bad
                refused += 1
                assert expected is None, (name, payloads[bad], str(error))
            else:
                assert expected is not None, (name, payloads[bad])
                assert same(without_empty(expected), rows[bad])
    assert refused > 50


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_messages_that_only_say_they_are_large_take_no_room(encoding: str) -> None:
    store = store_of(encoding)
    name = "test_msgs/msg/Large"
    for kind in (
        "string", "string[]", "float64[]", "float64[9000000]", "string[9000000]", "std_msgs/Empty[]", "test_msgs/Odd[]",
        "test_msgs/Odd[9000000]",
    ):  # fmt: skip
        definitions = store.fielddefs | get_types_from_msg(f"{kind} values", name)
        columns = RosColumns(definitions, name, encoding)
        payloads = [b"\0\1\0\0" + b"\xff\xff\xff\0" * 9] * 20
        tracemalloc.start()
        with pytest.raises(Malformed):
            columns.read(*laid_out(payloads, None))
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 2**20, kind


# Protobuf


LIMITS = {
    FieldDescriptor.TYPE_UINT32: (0, 2**32 - 1), FieldDescriptor.TYPE_FIXED32: (0, 2**32 - 1),
    FieldDescriptor.TYPE_UINT64: (0, 2**64 - 1), FieldDescriptor.TYPE_FIXED64: (0, 2**64 - 1),
    FieldDescriptor.TYPE_INT32: (-(2**31), 2**31 - 1), FieldDescriptor.TYPE_SINT32: (-(2**31), 2**31 - 1),
    FieldDescriptor.TYPE_SFIXED32: (-(2**31), 2**31 - 1),
}  # fmt: skip


def scalar(draw: random.Random, field: Any) -> Any:
    kind = field.type
    if kind == field.TYPE_STRING:
        return "".join(draw.choice("abcé日/_ ") for _ in range(draw.choice([0, 1, 3, 8, 200])))
    if kind == field.TYPE_BYTES:
        return draw.randbytes(draw.choice([0, 1, 3, 20]))
    if kind == field.TYPE_BOOL:
        return draw.random() < 0.5
    if kind == field.TYPE_ENUM:
        return draw.choice([value.number for value in field.enum_type.values])
    if kind in (field.TYPE_DOUBLE, field.TYPE_FLOAT):
        return float(np.float32(draw.choice([0.0, 1.5, -2e10, draw.random(), math.inf])))
    low, high = LIMITS.get(kind, (-(2**63), 2**63 - 1))
    return draw.choice([0, 1, 127, 128, low, high, draw.randint(low, high), draw.randint(max(low, -300), 300)])


def fill(draw: random.Random, message: Any, counts: Sequence[int]) -> None:
    for field in message.DESCRIPTOR.fields:
        if draw.random() < 0.25:
            continue
        if field.is_repeated:
            for _ in range(draw.choice(counts)):
                if field.message_type:
                    fill(draw, getattr(message, field.name).add(), counts)
                else:
                    getattr(message, field.name).append(scalar(draw, field))
        elif field.message_type and field.message_type.full_name.startswith("google.protobuf."):
            time = getattr(message, field.name)
            time.seconds, time.nanos = draw.randint(0, 2**31), draw.randint(0, NS - 1)
        elif field.message_type:
            getattr(message, field.name).SetInParent()
            fill(draw, getattr(message, field.name), counts)
        else:
            setattr(message, field.name, scalar(draw, field))


def of_protobuf(message: Any, kind: Any, is_nested: bool = False) -> dict[str, Any] | None:
    """A message of the protobuf runtime, None for one that isn't set, in the form that the columns have."""
    if message is None and is_nested:
        return None
    out: dict[str, Any] = {}
    for field in kind.fields:
        inner = field.message_type
        is_time = inner is not None and inner.full_name.startswith("google.protobuf.")

        def value_of(value: Any, field: Any = field, is_time: bool = is_time) -> Any:
            if field.enum_type:
                return field.enum_type.values_by_number[value].name
            if is_time:
                return value.seconds * NS + value.nanos
            return of_protobuf(value, field.message_type, True) if field.message_type else value

        is_set = message is not None and (not field.has_presence or message.HasField(field.name))
        name = field.name + ("_ns" if is_time and inner.name == "Duration" and not field.is_repeated else "")
        if field.is_repeated:
            out[name] = None if message is None else [value_of(value) for value in getattr(message, field.name)]
        elif inner and not is_time and not is_nested:
            out[name] = of_protobuf(getattr(message, field.name) if is_set else None, inner)
        else:
            out[name] = value_of(getattr(message, field.name)) if is_set else None
    return out


@pytest.mark.parametrize(
    "name",
    ["SceneUpdate", "FrameTransforms", "PointCloud", "LocationFix", "PosesInFrame", "CameraCalibration", "Grid", "Log"],
)
def test_columns_equal_what_protobuf_reads(name: str) -> None:
    kind = getattr(importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)
    columns = ProtobufColumns(kind.DESCRIPTOR)
    for seed in range(20):
        draw = random.Random(f"{name} {seed}")
        counts = draw.choice([[0, 1], [1], [0, 1, 2]])
        messages = [kind() for _ in range(draw.choice([1, 3, 13, 40]))]
        for message in messages:
            fill(draw, message, counts)
        payloads = [message.SerializeToString() for message in messages]
        rows = rows_of(columns.read(*laid_out(payloads, draw)), len(messages))
        for row, message in zip(rows, messages, strict=True):
            assert same(of_protobuf(message, kind.DESCRIPTOR), row), (seed, message)


@pytest.mark.parametrize("name", ["FrameTransforms", "LocationFix", "CameraCalibration", "PackedElementField", "Log"])
def test_damaged_messages_are_refused_where_protobuf_refuses_them(name: str) -> None:
    kind = getattr(importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)
    columns = ProtobufColumns(kind.DESCRIPTOR)
    refused = 0
    for seed in range(100):
        draw = random.Random(f"{name} {seed}")
        message = kind()
        fill(draw, message, [0, 1, 2])
        payload = damaged(draw, message.SerializeToString(), has_head=False)
        if draw.random() < 0.5:  # a field of it with other bytes, and a number of more bytes than it needs
            place, size = draw.choice([0, len(payload), draw.randrange(len(payload) + 1)]), draw.randrange(12)
            tag = bytes([draw.choice(kind.DESCRIPTOR.fields).number << 3 | draw.choice([2, 2, 0])])
            more = draw.choice([0, 0, 3, 4, 5, 9])
            number = bytes([size | 128]) + b"\x80" * more + b"\0" if more else bytes([size])
            tag = bytes([tag[0] | 128]) + b"\x80" * more + b"\0" if draw.random() < 0.3 else tag
            payload = payload[:place] + tag + number + draw.randbytes(size) + payload[place:]
        try:
            expected = kind.FromString(payload)
        except DecodeError:
            expected = None
        for count in (1, 2 * FEW):  # one by one, and all together
            try:
                rows = rows_of(columns.read(*laid_out([payload] * count, draw)), count)
            except Malformed as error:
                assert error.message == 0
                assert expected is None, (seed, payload, str(error))
                refused += 1
            except Unsupported:
                continue
            else:
                assert expected is not None, (seed, payload)
                with suppress(KeyError):  # enumerations have more values than names
                    assert all(same(of_protobuf(expected, kind.DESCRIPTOR), row) for row in rows), (seed, payload)
    assert refused > 12


def test_times_are_timestamps_and_durations_nanoseconds() -> None:
    store = store_of("cdr")
    name = "test_msgs/msg/Spans"
    time, duration = (store.types[f"builtin_interfaces/msg/{kind}"] for kind in ("Time", "Duration"))
    message = store.types[name](
        spans=[duration(1, 5)], times=[time(2, 0)], at=time(1_700_000_000, 7), lasting=duration(-1, 0)
    )
    columns = RosColumns(store.fielddefs, name).read(*laid_out([bytes(store.serialize_cdr(message, name))], None))
    assert columns["at",].type == pa.timestamp("ns", tz="UTC")
    assert columns["at",].cast(pa.int64()).to_pylist() == [1_700_000_000 * NS + 7]
    assert columns["times",][0][0].value == 2 * NS
    assert columns["lasting_ns",].to_pylist() == [-NS]
    assert columns["spans",].to_pylist() == [[NS + 5]]


def test_times_that_64_bits_do_not_hold_are_null() -> None:
    kind = importlib.import_module("foxglove_schemas_protobuf.Log_pb2").Log
    messages = [kind() for _ in range(4)]
    for message, seconds in zip(messages, (2**62, -(2**62), 5, 2**33), strict=True):
        message.timestamp.seconds = seconds
    columns = ProtobufColumns(kind.DESCRIPTOR).read(*laid_out([m.SerializeToString() for m in messages], None))
    assert columns["timestamp",].cast(pa.int64()).to_pylist() == [None, None, 5 * NS, 2**33 * NS]


def test_only_fields_that_are_wanted_are_read() -> None:
    store = store_of("cdr")
    name = "sensor_msgs/msg/Imu"
    [(_, payloads), *_] = batches("cdr", name, store, 1)
    wanted = RosColumns(
        store.fielddefs, name, wanted=lambda path: path in {("angular_velocity",), ("angular_velocity", "z")}
    )
    everything = RosColumns(store.fielddefs, name).read(*laid_out(payloads, None))
    assert list(columns := wanted.read(*laid_out(payloads, None))) == [("angular_velocity", "z")]
    assert same(columns["angular_velocity", "z"].to_pylist(), everything["angular_velocity", "z"].to_pylist())


def test_only_fields_of_protobuf_that_are_wanted_are_read() -> None:
    image = importlib.import_module("foxglove_schemas_protobuf.CompressedImage_pb2").CompressedImage
    without = ProtobufColumns(image.DESCRIPTOR, blobs=False)
    columns = without.read(*laid_out([image(format="jpeg", data=b"x").SerializeToString()], None))
    assert (("format",) in columns, ("data",) in columns, list(without.left_out)) == (True, False, [("data",)])
    scene = importlib.import_module("foxglove_schemas_protobuf.SceneUpdate_pb2").SceneUpdate
    bare = ProtobufColumns(scene.DESCRIPTOR, wanted=lambda path: path == ("entities",))
    payload = scene(entities=[{"id": "a"}, {"id": "b"}]).SerializeToString()
    assert bare.read(*laid_out([payload, b""], None))["entities",].to_pylist() == [[{}, {}], []]
