"""Messages of viewers as ROS 2 messages: foxglove_msgs/msg/SceneUpdate instead of foxglove.SceneUpdate.

Viewers draw both. In the recordings of ROS 2 only the first can be read by all tools. The definitions follow from those
in protobuf, as those that foxglove_msgs publishes do: the same fields in the same order, and the types of ROS for
times, points and poses. A message is written in protobuf first and converted then: lists of parts many at once
(``ros_batches``), others field by field.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import chain, islice
from typing import Any, Final, NamedTuple

import numpy as np
from mcap.well_known import SchemaEncoding

from mcaptrack.errors import McaptrackError
from mcaptrack.foxglove.messages import message_class, schema_record
from mcaptrack.geometry.arrays import Bools, Bytes, Ints
from mcaptrack.geometry.ragged import ragged_range
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
#: Number of messages that are converted at once.
_BLOCK: Final = 64


# Many messages of viewers from protobuf to ROS 2 at once.
#
# Scenes and annotations are lists of parts, and most parts have the same tags and lengths as others: they differ in
# numbers and letters only. So for each such *shape* it is found out once which bytes of protobuf become which bytes
# of ROS; all parts of a shape are then converted by a few array operations.
#
# Letters: N parts of one shape, L bytes of a part.


_ALIGN: Final = 8
_U4: Final = struct.Struct("<I")
#: Types of protobuf with a fixed width: that width.
_FIXED: Final = {"DOUBLE": 8, "FIXED64": 8, "SFIXED64": 8, "FLOAT": 4, "FIXED32": 4, "SFIXED32": 4}
#: Whole numbers of varying width that are part of a shape: their formats in ROS.
_WHOLE: Final = {"BOOL": "<B", "ENUM": "<B", "UINT32": "<I", "INT32": "<i"}
_LONGEST_VARINT: Final = 9
#: Shapes that are remembered.
_MOST_SHAPES: Final = 4096


class UnusualMessage(Exception):
    """A message is written in another way than this module knows."""


class FieldType(NamedTuple):
    """A field: its kind as protobuf names it, whether it is a list, and the fields of its messages, if any.

    ``is_time`` says that it is a time or a duration.
    """

    kind: str
    is_list: bool
    fields: Mapping[int, FieldType]
    is_time: bool


class _Step(NamedTuple):
    """Bytes of a ROS message: aligned to ``align``; ``constant``, or ``length`` bytes from ``start`` of the part.

    With ``is_number`` these are a varint, which becomes four bytes.
    """

    align: int
    constant: bytes = b""
    start: int = 0
    length: int = 0
    is_number: bool = False


class _Layout(NamedTuple):
    """The bytes of a part in ROS where it begins at one of eight places.

    ``constant`` are the bytes that are not 0, and their places. ``letters`` are where a byte is from, and its place;
    ``words`` the same for eight bytes, with places in units of eight. ``numbers`` are the begin and length of a varint,
    and its place.
    """

    size: int
    constant: tuple[Bytes, Ints]
    words: tuple[Ints, Ints]
    letters: tuple[Ints, Ints]
    numbers: tuple[tuple[int, int, int], ...]


class _Shape:
    """The tags and lengths of a part, and what becomes of the other bytes."""

    def __init__(self, field: FieldType, part: bytes) -> None:
        mask = np.full(len(part), 0xFF, np.uint8)
        single = field._replace(is_list=False)
        self._steps = list(_field_steps(single, part, 0, len(part), mask))
        self._places = np.flatnonzero(mask)
        self._mask = mask[self._places]
        self._tags = np.frombuffer(part, np.uint8)[self._places] & self._mask
        self._layouts: dict[int, _Layout] = {}

    def fits(self, raw: Bytes, starts: Ints) -> Bools:
        """Which parts, that begin at ``starts`` (N,) of ``raw`` and have the same length, have this shape."""
        return np.asarray(((raw[starts[:, None] + self._places] & self._mask) == self._tags).all(axis=1))

    def layout(self, phase: int) -> _Layout:
        """The layout of a part that begins ``phase`` bytes after a multiple of eight."""
        if phase not in self._layouts:
            base, numbers = bytearray(), list[tuple[int, int, int]]()
            copies: dict[int, list[tuple[int, int, int]]] = {1: [], _ALIGN: []}
            for align, constant, start, length, is_number in self._steps:
                base += bytes(-(phase + len(base)) % align)
                if is_number:
                    numbers.append((start, length, len(base)))
                elif length:
                    copies[_ALIGN if align == _ALIGN else 1].append((start, len(base), length))
                base += constant or bytes(_U4.size if is_number else length)
            whole = np.frombuffer(bytes(base), np.uint8)
            nonzero = np.flatnonzero(whole)
            source, places = _places(copies[_ALIGN], _ALIGN)
            eights = source, (places + phase) // _ALIGN
            letters = _places(copies[1], 1)
            self._layouts[phase] = _Layout(len(base), (whole[nonzero], nonzero), eights, letters, tuple(numbers))
        return self._layouts[phase]


def _places(copies: Sequence[tuple[int, int, int]], width: int) -> tuple[Ints, Ints]:
    """Return source and target of each item of this width in ``copies`` (from, to, length)."""
    table = np.array(copies, np.int64).reshape(-1, 3)
    counts = table[:, 2] // width
    steps = ragged_range(0, counts) * width
    return np.repeat(table[:, 0], counts) + steps, np.repeat(table[:, 1], counts) + steps


def _steps(fields: Mapping[int, FieldType], data: bytes, low: int, high: int, mask: Bytes) -> Iterator[_Step]:
    """Convert the bytes of a message from ``low`` to ``high``; those that are copied are taken out of ``mask``."""
    by_number: dict[int, list[tuple[int, int, int]]] = {}
    for number, wire, start, end in _wire(data, low, high):
        by_number.setdefault(number, []).append((wire, start, end))
    if by_number.keys() - fields.keys():
        raise UnusualMessage
    for number, field in fields.items():
        values = by_number.get(number, [])
        if field.is_list:
            yield from _list_steps(field, data, values, mask)
        elif len(values) > 1:
            raise UnusualMessage
        else:
            yield from _field_steps(field, data, *(values[0][1:] if values else (0, 0)), mask)


def _list_steps(field: FieldType, data: bytes, values: Sequence[tuple[int, int, int]], mask: Bytes) -> Iterator[_Step]:
    if field.kind == "MESSAGE":
        yield _Step(4, _U4.pack(len(values)))
        for _, start, end in values:
            yield from _steps(field.fields, data, start, end, mask)
        return
    width = _FIXED.get(field.kind, 0)
    if not width or len(values) > 1 or any(wire != 2 for wire, *_ in values):
        raise UnusualMessage
    start, end = values[0][1:] if values else (0, 0)
    yield _Step(4, _U4.pack((end - start) // width))
    if end > start:
        mask[start:end] = 0
        yield _Step(width, b"", start, end - start)


def _field_steps(field: FieldType, data: bytes, start: int, end: int, mask: Bytes) -> Iterator[_Step]:
    if field.is_time:
        places = {number: place for number, _, *place in _wire(data, start, end)}
        for number in (1, 2):
            first, last = places.get(number, (0, 0))
            if last - first > _LONGEST_VARINT:
                raise UnusualMessage
            mask[first:last] = 0x80
            yield _Step(4, b"", first, last - first, True)
    elif field.kind == "MESSAGE":
        yield from _steps(field.fields, data, start, end, mask)
    elif field.kind in ("STRING", "BYTES"):
        yield _Step(4, _U4.pack(end - start + (field.kind == "STRING")))
        mask[start:end] = 0
        yield _Step(1, b"", start, end - start)
        yield _Step(1, b"\0" if field.kind == "STRING" else b"")
    elif field.kind in _FIXED:
        width = _FIXED[field.kind]
        mask[start:end] = 0
        yield _Step(width, b"", start, width) if end > start else _Step(width, bytes(width))
    else:
        form = _WHOLE.get(field.kind)
        value = _varint(data, start)[0] if end > start else 0
        if form is None or value > 0x7F:
            raise UnusualMessage
        yield _Step(struct.calcsize(form), struct.pack(form, value))


def _wire(data: bytes, low: int, high: int) -> Iterator[tuple[int, int, int, int]]:
    """The fields of a message: number, kind of its bytes, and where its content begins and ends."""
    at = low
    while at < high:
        tag, at = _varint(data, at)
        wire = tag & 7
        if wire == 0:
            start, at = at, _varint(data, at)[1]
        elif wire == 2:
            length, start = _varint(data, at)
            at = start + length
        elif wire in (1, 5):
            start, at = at, at + (8 if wire == 1 else 4)
        else:
            raise UnusualMessage
        yield tag >> 3, wire, start, at
    if at != high:
        raise UnusualMessage


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A whole number, 7 bits a byte, and where it ends."""
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


class Batches:
    """Converts messages of a type that has only these ``fields``: lists of messages, and times."""

    @staticmethod
    def take(fields: Mapping[int, FieldType]) -> bool:
        """Whether messages with these fields can be converted here."""
        return all(field.fields and (field.is_list or field.is_time) for field in fields.values())

    def __init__(self, fields: Mapping[int, FieldType], check_seconds: Callable[[int], None]) -> None:
        self._fields, self._check_seconds = fields, check_seconds
        self._order = {number: place for place, number in enumerate(fields)}
        self._shapes: dict[tuple[int, int], list[_Shape]] = {}
        self._count = 0

    def convert(self, payloads: Sequence[bytes]) -> list[bytes]:
        """The messages in CDR, without the bytes before each. Raises UnusualMessage if one can't be converted here."""
        if self._count > _MOST_SHAPES:
            self._shapes, self._count = {}, 0
        data = b"".join(payloads)
        raw = np.frombuffer(data, np.uint8)
        parts: list[tuple[int, int, int]] = []  # number of the field, begin and end
        bounds, low = [], 0
        for payload in payloads:
            high = low + len(payload)
            mine = [(number, start, end) for number, _, start, end in _wire(data, low, high)]
            if any(number not in self._fields for number, *_ in mine):
                raise UnusualMessage
            mine.sort(key=lambda item: self._order[item[0]])
            bounds.append((len(parts), len(parts) + len(mine)))
            parts += mine
            low = high
        shapes = self._shapes_of(data, raw, parts)
        return self._written(raw, parts, shapes, bounds)

    def _shapes_of(self, data: bytes, raw: Bytes, parts: Sequence[tuple[int, int, int]]) -> list[_Shape]:
        groups: dict[tuple[int, int], list[int]] = {}
        for index, (number, start, end) in enumerate(parts):
            groups.setdefault((number, end - start), []).append(index)
        out: list[Any] = [None] * len(parts)
        for (number, length), indices in groups.items():
            shapes = self._shapes.setdefault((number, length), [])
            left, starts, tried = np.array(indices), np.array([parts[index][1] for index in indices]), 0
            while len(left):
                if tried == len(shapes):
                    _, start, end = parts[int(left[0])]
                    shapes.append(_Shape(self._fields[number], data[start:end]))
                    self._count += 1
                fits = shapes[tried].fits(raw, starts)
                for index in left[fits].tolist():
                    out[index] = shapes[tried]
                left, starts = left[~fits], starts[~fits]
                tried += 1
        return out

    def _written(
        self,
        raw: Bytes,
        parts: Sequence[tuple[int, int, int]],
        shapes: Sequence[_Shape],
        bounds: Sequence[tuple[int, int]],
    ) -> list[bytes]:
        counts: list[tuple[int, int]] = []  # place and number of the parts of a list
        groups: dict[tuple[int, int], tuple[_Shape, int, list[int], list[int]]] = {}
        ends, at = [], 0
        for first, last in bounds:
            at += -at % _ALIGN
            begin, index = at, first
            for number, field in self._fields.items():
                at += -at % _U4.size
                place, since = at, index
                at += _U4.size if field.is_list else 0
                while index < last and parts[index][0] == number:
                    shape, phase = shapes[index], at % _ALIGN
                    key = (id(shape), phase)
                    if key not in groups:
                        groups[key] = (shape, phase, [], [])
                    groups[key][2].append(parts[index][1])
                    groups[key][3].append(at)
                    at += shape.layout(phase).size
                    index += 1
                if field.is_list:
                    counts.append((place, index - since))
                elif index == since:
                    at += 2 * _U4.size
                elif index > since + 1:
                    raise UnusualMessage
            ends.append((begin, at))
        out = np.zeros(at + -at % _ALIGN, np.uint8)
        places = np.array([place for place, _ in counts], np.intp)
        out[places[:, None] + np.arange(_U4.size)] = (
            np.array([count for _, count in counts], "<u4").view(np.uint8).reshape(-1, _U4.size)
        )
        for shape, phase, starts, targets in groups.values():
            self._fill(out, raw, shape.layout(phase), np.array(starts, np.intp), np.array(targets, np.intp))
        written = out.tobytes()
        return [written[begin:end] for begin, end in ends]

    def _fill(self, out: Bytes, raw: Bytes, layout: _Layout, starts: Ints, targets: Ints) -> None:
        """Write parts (N,) that begin at ``starts`` of ``raw`` to ``targets`` of ``out``."""
        values, places = layout.constant
        out[targets[:, None] + places] = values
        source, places = layout.letters
        out[targets[:, None] + places] = raw[starts[:, None] + source]
        source, places = layout.words
        if len(source):
            at_any_byte = np.ndarray((len(raw) - _ALIGN + 1,), "<u8", raw, strides=(1,))
            out.view("<u8")[(targets // _ALIGN)[:, None] + places] = at_any_byte[starts[:, None] + source]
        for number, (start, length, place) in enumerate(layout.numbers):
            digits = raw[starts[:, None] + np.arange(start, start + length)].astype(np.int64) & 0x7F
            numbers = (digits << (7 * np.arange(length))).sum(axis=1)
            if number % 2 == 0 and len(numbers):  # seconds come before nanoseconds
                self._check_seconds(int(numbers.max()))
            out[targets[:, None] + np.arange(place, place + _U4.size)] = (
                numbers.astype("<u4").view(np.uint8).reshape(-1, _U4.size)
            )


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
                _append(cls.FromString(payload), out)
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


def _append(message: Any, out: bytearray) -> None:
    """Append a message field by field."""
    for field in message.DESCRIPTOR.fields:
        value, kind = getattr(message, field.name), _kind(field)
        if _is_list(field):
            _align(out, _U4.size)
            out += _U4.pack(len(value))
        for member in value if _is_list(field) else (value,):
            if kind == "MESSAGE" and field.message_type.full_name.startswith("google.protobuf."):
                _append_time(member, out)
            elif kind == "MESSAGE":
                _append(member, out)
            elif kind in ("STRING", "BYTES"):
                _append_bytes(member, b"\0" if kind == "STRING" else b"", out)
            else:
                form = _SCALARS[kind][1]
                _align(out, struct.calcsize(form))
                out += struct.pack(form, member)


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


def _append_bytes(value: str | bytes, end: bytes, out: bytearray) -> None:
    data = (value.encode() if isinstance(value, str) else value) + end
    _align(out, _U4.size)
    out += _U4.pack(len(data)) + data
