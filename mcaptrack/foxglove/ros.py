"""Messages of viewers as ROS 2 messages: foxglove_msgs/msg/SceneUpdate instead of foxglove.SceneUpdate.

Viewers draw both. In the recordings of ROS 2 only the first can be read by all tools. The definitions follow from those
in protobuf, as those that foxglove_msgs publishes do: the same fields in the same order, and the types of ROS for
times, points and poses. A message is written in protobuf first, and converted then.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from functools import cache, partial
from itertools import chain
from operator import attrgetter
from typing import Any, Final

from mcap.well_known import SchemaEncoding

from mcaptrack.errors import McaptrackError
from mcaptrack.foxglove.messages import message_class, schema_record
from mcaptrack.schema.encodings import CDR, Encoding

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
    "DOUBLE": ("float64", "<d"),
    "FLOAT": ("float32", "<f"),
    "BOOL": ("bool", "<B"),
    "ENUM": ("uint8", "<B"),
    "UINT32": ("uint32", "<I"),
    "FIXED32": ("uint32", "<I"),
    "INT32": ("int32", "<i"),
    "SFIXED32": ("int32", "<i"),
    "UINT64": ("uint64", "<Q"),
    "FIXED64": ("uint64", "<Q"),
    "INT64": ("int64", "<q"),
    "SFIXED64": ("int64", "<q"),
}
_LINE: Final = "=" * 80
_LITTLE_ENDIAN: Final = b"\0\1\0\0"
_LAST_S: Final = 2**31 - 1


_U4: Final = struct.Struct("<I")
_TIME: Final = struct.Struct("<iI")
_PADDING: Final = bytes(8)


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
    return _ros_type(descriptor).replace("/", "/msg/"), SchemaEncoding.ROS2, ("\n".join(sections) + "\n").encode()


def messages_in(
    schema_name: str, messages: Iterable[tuple[int, int, bytes]], encoding: Encoding
) -> Iterator[tuple[int, int, bytes]]:
    """Convert messages (time in ns, number, payload in protobuf) of a Foxglove schema to this encoding.

    Raises McaptrackError for times that ROS can't express.
    """
    if encoding != CDR:
        yield from messages
        return
    cls = message_class(schema_name)
    for t_ns, number, payload in messages:
        out = bytearray()
        _append(cls.FromString(payload), out)
        yield t_ns, number, _LITTLE_ENDIAN + out


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


def _append(message: Any, out: bytearray) -> None:
    """Append a message field by field."""
    for name, is_list, write in _writers(message.DESCRIPTOR):
        value = getattr(message, name)
        if is_list:
            _align(out, _U4.size)
            out += _U4.pack(len(value))
            for member in value:
                write(member, out)
        else:
            write(value, out)


@cache
def _writers(descriptor: Any) -> list[tuple[str, bool, Callable[[Any, bytearray], None]]]:
    """The fields of a message: the name, whether it is a list, and what appends a value."""
    return [(field.name, _is_list(field), _writer(field)) for field in descriptor.fields]


def _writer(field: Any) -> Callable[[Any, bytearray], None]:
    kind = _kind(field)
    if kind == "MESSAGE" and field.message_type.full_name.startswith("google.protobuf."):
        return _append_time
    if kind == "MESSAGE":
        names = [*_doubles(field.message_type)]
        return (
            _of_struct(8, struct.Struct(f"<{len(names)}d"), attrgetter(*names))
            if len(names) > 1 and all(names)
            else _append
        )
    if kind in ("STRING", "BYTES"):
        return partial(_append_bytes, b"\0" if kind == "STRING" else b"")
    form = struct.Struct(_SCALARS[kind][1])
    return _of_struct(form.size, form, lambda value: (value,))


def _of_struct(
    width: int, form: struct.Struct, values: Callable[[Any], tuple[Any, ...]]
) -> Callable[[Any, bytearray], None]:
    def write(value: Any, out: bytearray) -> None:
        _align(out, width)
        out += form.pack(*values(value))

    return write


def _doubles(descriptor: Any, before: str = "") -> Iterator[str]:
    """The places of the numbers of a message, such as a pose; "" for what isn't a number of 64 bits."""
    for field in descriptor.fields:
        if _is_list(field) or _kind(field) not in ("DOUBLE", "MESSAGE"):
            yield ""
        elif field.message_type:
            yield from _doubles(field.message_type, f"{before}{field.name}.")
        else:
            yield f"{before}{field.name}"


def _align(out: bytearray, width: int) -> None:
    if rest := len(out) % width:
        out += _PADDING[rest - width :]


def _check_seconds(seconds: int) -> None:
    if not 0 <= seconds <= _LAST_S:
        raise McaptrackError(f"a view at {seconds} s can't be a ROS message: ROS has times from 1970 to 2038 only")


def _append_time(time: Any, out: bytearray) -> None:
    _check_seconds(time.seconds)
    _align(out, _TIME.size // 2)
    out += _TIME.pack(time.seconds, time.nanos)


def _append_bytes(end: bytes, value: str | bytes, out: bytearray) -> None:
    data = (value.encode() if isinstance(value, str) else value) + end
    _align(out, _U4.size)
    out += _U4.pack(len(data)) + data
