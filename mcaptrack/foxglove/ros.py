"""Messages of viewers as ROS 2 messages: foxglove_msgs/msg/SceneUpdate instead of foxglove.SceneUpdate.

Viewers draw both. In the recordings of ROS 2 only the first can be read by all tools. The definitions follow from those
in protobuf, as those that foxglove_msgs publishes do: the same fields in the same order, and the types of ROS for
times, points and poses. A message is written in protobuf first and converted then: lists of parts many at once
(``ros_batches``), others field by field.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from itertools import chain, islice
from operator import attrgetter
from typing import Any, Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.foxglove.messages import message_class, schema_record
from mcaptrack.foxglove.ros_batches import Batches, FieldType, UnusualMessage
from mcaptrack.schema.encodings import CDR, ROS2MSG, Encoding

#: Types of ROS for messages of protobuf, and their definitions.
_STANDARD: Final = {
    "google.protobuf.Timestamp": "builtin_interfaces/Time",
    "google.protobuf.Duration": "builtin_interfaces/Duration",
    "foxglove.Vector3": "geometry_msgs/Vector3",
    "foxglove.Point3": "geometry_msgs/Point",
    "foxglove.Quaternion": "geometry_msgs/Quaternion",
    "foxglove.Pose": "geometry_msgs/Pose",
}
_XYZ: Final = ("float64 x", "float64 y", "float64 z")
_DEFINITIONS: Final = {
    "builtin_interfaces/Time": ("int32 sec", "uint32 nanosec"),
    "builtin_interfaces/Duration": ("int32 sec", "uint32 nanosec"),
    "geometry_msgs/Vector3": _XYZ,
    "geometry_msgs/Point": _XYZ,
    "geometry_msgs/Quaternion": (*_XYZ, "float64 w"),
    "geometry_msgs/Pose": ("geometry_msgs/Point position", "geometry_msgs/Quaternion orientation"),
}
#: Types of ROS for the scalars of protobuf, by the names of descriptors, and their formats.
_SCALARS: Final = {
    "DOUBLE": ("float64", "<f8"),
    "FLOAT": ("float32", "<f4"),
    "BOOL": ("bool", "<u1"),
    "ENUM": ("uint8", "<u1"),
    "UINT32": ("uint32", "<u4"),
    "FIXED32": ("uint32", "<u4"),
    "INT32": ("int32", "<i4"),
    "SFIXED32": ("int32", "<i4"),
    "UINT64": ("uint64", "<u8"),
    "FIXED64": ("uint64", "<u8"),
    "INT64": ("int64", "<i8"),
    "SFIXED64": ("int64", "<i8"),
}
_LINE: Final = "=" * 80
_LITTLE_ENDIAN: Final = b"\0\1\0\0"
_LAST_S: Final = 2**31 - 1
#: Number of messages that are converted at once.
_BLOCK: Final = 64
#: Appends a message, or a field of it, to the bytes of a message.
_Append = Callable[[Any, bytearray], None]
_U4: Final = struct.Struct("<I")
_TIME: Final = struct.Struct("<iI")
_PADDING: Final = bytes(8)
_NO_MEMBERS: Final = bytes(4)


def record_in(schema_name: str, encoding: Encoding) -> tuple[str, str, bytes]:
    """Name, encoding and data of the schema record of a Foxglove schema, for messages in this encoding."""
    if encoding != CDR:
        return schema_record(schema_name)
    descriptor = message_class(schema_name).DESCRIPTOR
    sections, waiting, done = [], [descriptor], {descriptor.full_name}
    while waiting:
        current = waiting.pop(0)
        name = _ros_type(current)
        lines = _DEFINITIONS.get(name) or tuple(chain.from_iterable(map(_field_lines, current.fields)))
        sections.append("\n".join(lines if current is descriptor else (_LINE, f"MSG: {name}", *lines)))
        inner = [field.message_type for field in current.fields if field.message_type]
        if name == "geometry_msgs/Pose":  # its position is another type there
            inner = [message_class("foxglove.Point3").DESCRIPTOR, message_class("foxglove.Quaternion").DESCRIPTOR]
        for member in inner:
            if member.full_name not in done:
                done.add(member.full_name)
                waiting.append(member)
    return _ros_type(descriptor).replace("/", "/msg/"), ROS2MSG, ("\n".join(sections) + "\n").encode()


def messages_in(
    schema_name: str, messages: Iterable[tuple[int, int, bytes]], encoding: Encoding
) -> Iterator[tuple[int, int, bytes]]:
    """Convert messages (time in ns, number, payload in protobuf) of a Foxglove schema to this encoding.

    Raises McaptrackError for times that ROS can't express.
    """
    if encoding != CDR:
        yield from messages
        return
    cls, append = message_class(schema_name), _appender(message_class(schema_name).DESCRIPTOR)
    fields = _field_types(cls.DESCRIPTOR)
    batches = Batches(fields, _check_seconds) if Batches.take(fields) else None
    coming = iter(messages)
    while block := list(islice(coming, _BLOCK if batches else 1)):
        try:
            converted = batches.convert([payload for *_, payload in block]) if batches else []
        except UnusualMessage:
            converted = []
        for place, (t_ns, number, payload) in enumerate(block):
            out = bytearray(converted[place] if converted else b"")
            if not converted:
                append(cls.FromString(payload), out)
            yield t_ns, number, _LITTLE_ENDIAN + out


@cache
def _field_types(descriptor: Any) -> dict[int, FieldType]:
    """The fields of a message by number, in their order."""
    return {
        field.number: FieldType(
            _kind(field),
            _is_list(field),
            _field_types(field.message_type) if field.message_type else {},
            bool(field.message_type and field.message_type.full_name.startswith("google.protobuf.")),
        )
        for field in descriptor.fields
    }


def _ros_type(descriptor: Any) -> str:
    package, _, name = descriptor.full_name.rpartition(".")
    return _STANDARD.get(descriptor.full_name, f"{package}_msgs/{name}")


def _is_list(field: Any) -> bool:
    return bool(field.is_repeated) if hasattr(field, "is_repeated") else field.label == field.LABEL_REPEATED


def _kind(field: Any) -> str:
    """The name of a field's type: "DOUBLE", "MESSAGE"."""
    return _kinds()[field.type]


@cache
def _kinds() -> dict[int, str]:
    from google.protobuf.descriptor import FieldDescriptor

    names = [name for name in dir(FieldDescriptor) if name.startswith("TYPE_")]
    return {getattr(FieldDescriptor, name): name.removeprefix("TYPE_") for name in names}


def _field_lines(field: Any) -> Iterator[str]:
    """The lines of a definition for a field: the values of an enumeration, and the field."""
    kind = _kind(field)
    if field.enum_type:
        yield from (f"uint8 {value.name}={value.number}" for value in field.enum_type.values)
    if kind == "MESSAGE":
        name = _ros_type(field.message_type)
    elif kind == "BYTES":
        name = "uint8[]"
    else:
        name = "string" if kind == "STRING" else _SCALARS[kind][0]
    yield f"{name}{'[]' if _is_list(field) else ''} {field.name}"


@cache
def _numbers(descriptor: Any) -> tuple[str, ...]:
    """The paths of the fields of a message that consists of float64 alone; empty for others."""
    out: list[str] = []
    for field in descriptor.fields:
        inner = _numbers(field.message_type) if field.message_type else ()
        if _is_list(field) or (_kind(field) != "DOUBLE" and not inner):
            return ()
        out += [f"{field.name}.{name}" for name in inner] or [field.name]
    return tuple(out)


@cache
def _appender(descriptor: Any) -> _Append:
    """A function that appends messages of a type."""
    steps: list[_Append] = []
    numbers: list[str] = []  # fields of float64 next to one another

    def flush() -> None:
        if numbers:
            steps.append(_append_numbers(tuple(numbers)))
            numbers.clear()

    for field in descriptor.fields:
        inner = _numbers(field.message_type) if field.message_type else ()
        if not _is_list(field) and (_kind(field) == "DOUBLE" or inner):
            numbers += [f"{field.name}.{name}" for name in inner] or [field.name]
        else:
            flush()
            steps.append(_append_field(field))
    flush()

    def append(message: Any, out: bytearray) -> None:
        for step in steps:
            step(message, out)

    return append


def _align(out: bytearray, width: int) -> None:
    if rest := len(out) % width:
        out += _PADDING[rest - width :]


def _append_numbers(names: tuple[str, ...]) -> _Append:
    values, pack = _getter(names), struct.Struct(f"<{len(names)}d").pack

    def append(message: Any, out: bytearray) -> None:
        _align(out, 8)
        out += pack(*values(message))

    return append


def _getter(names: tuple[str, ...]) -> Callable[[Any], tuple[float, ...]]:
    get: Callable[[Any], Any] = attrgetter(*names)
    return get if len(names) > 1 else lambda message: (get(message),)


def _append_field(field: Any) -> _Append:
    get, kind = attrgetter(field.name), _kind(field)
    if _is_list(field):
        return _append_list(field, get)
    if kind == "MESSAGE" and field.message_type.full_name.startswith("google.protobuf."):
        return lambda message, out: _append_time(get(message), out)
    if kind == "MESSAGE":
        inner = _appender(field.message_type)
        return lambda message, out: inner(get(message), out)
    if kind in ("STRING", "BYTES"):
        end = b"\0" if kind == "STRING" else b""
        return lambda message, out: _append_bytes(get(message), end, out)
    pack = struct.Struct("<" + np.dtype(_SCALARS[kind][1]).char).pack
    width = np.dtype(_SCALARS[kind][1]).itemsize

    def append(message: Any, out: bytearray) -> None:
        _align(out, width)
        out += pack(get(message))

    return append


def _append_list(field: Any, get: Callable[[Any], Any]) -> _Append:
    numbers = _numbers(field.message_type) if field.message_type else ()
    if numbers:
        values = _getter(numbers)

        def content(members: Any, out: bytearray) -> None:
            _align(out, 8)
            out += np.fromiter(chain.from_iterable(map(values, members)), "<f8").tobytes()

    elif field.message_type:
        inner = _appender(field.message_type)

        def content(members: Any, out: bytearray) -> None:
            for member in members:
                inner(member, out)

    else:
        form = np.dtype(_SCALARS[_kind(field)][1])

        def content(members: Any, out: bytearray) -> None:
            _align(out, form.itemsize)
            out += np.array(members, form).tobytes()

    def append(message: Any, out: bytearray) -> None:
        _align(out, _U4.size)
        members = get(message)
        if members:
            out += _U4.pack(len(members))
            content(members, out)
        else:
            out += _NO_MEMBERS

    return append


def _check_seconds(seconds: int) -> None:
    if not 0 <= seconds <= _LAST_S:
        raise McaptrackError(f"a view at {seconds} s can't be a ROS message: ROS has times from 1970 to 2038 only")


def _append_time(time: Any, out: bytearray) -> None:
    _check_seconds(time.seconds)
    _align(out, _TIME.size // 2)
    out += _TIME.pack(time.seconds, time.nanos)


def _append_bytes(value: str | bytes, end: bytes, out: bytearray) -> None:
    data = (value.encode() if isinstance(value, str) else value) + end
    _align(out, _U4.size)
    out += _U4.pack(len(data)) + data
