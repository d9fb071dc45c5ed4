"""The encodings of rows in a log: protobuf, or CDR in the recordings of ROS 2.

A channel of rows is read by its own encoding. Digests don't depend on it: they are of the messages in protobuf.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import islice
from typing import Any, Final, Literal, NamedTuple, Protocol

import numpy as np
from mcap.well_known import SchemaEncoding
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools, Bytes, Ints
from mcaptrack.geometry.ragged import ragged_range
from mcaptrack.schema import Frame, Rows, Schema
from mcaptrack.schema.codec import RowCodec
from mcaptrack.schema.names import plain_name
from mcaptrack.schema.own import schema_of_channel
from mcaptrack.schema.proto import KINDS, Definition

Encoding = Literal["protobuf", "cdr"]
PROTOBUF: Final = "protobuf"
CDR: Final = "cdr"
#: Encodings of messages with rows.
ROW_ENCODINGS: Final = (PROTOBUF, CDR)
#: The number of frames that are encoded together.
_BATCH: Final = 256


class RowReader(Protocol):
    """Decodes the messages of a channel to rows."""

    def decode_all(self, payloads: Sequence[bytes]) -> tuple[Rows, Ints]:
        """Decode payloads to one array of rows, and the number of rows in each. Raises ValueError."""

    def decode_at(self, raw: Bytes, start: Ints, end: Ints) -> tuple[Rows, Ints] | None:
        """Decode payloads at places of ``raw``; None if one has another layout than the usual one."""


# Rows as ROS 2 messages: CDR payloads as NumPy arrays, without a loop over rows, and their definitions.
#
# Rows in a ROS 2 recording have its own encoding, so that ROS tools read the whole file. The definitions of these
# messages follow from the schema files: mcaptrack_msgs/msg/Tracks has one field, ``mcaptrack_msgs/TracksRow[]
# rows``.
#
# CDR aligns each value to its size, counted from the beginning of the message. So the layout of a row depends on
# where the row begins, modulo 8, and the rows of a message soon repeat a cycle of layouts. A channel is read by the
# definition that it brings, because other versions have other columns, and in either byte order.
#
# Letters: N rows, M messages, K fields.


#: Kinds of columns -> types of ROS.
_TYPES: Final = {kind: np.dtype(form).name for kind, (form, *_) in KINDS.items()}
#: The formats of all types of ROS with a fixed width.
_FORMATS: Final = {kind: np.dtype(KINDS[column][0]) for column, kind in _TYPES.items()} | {
    "bool": np.dtype("u1"),
    "byte": np.dtype("u1"),
    "char": np.dtype("u1"),
    "uint8": np.dtype("u1"),
    "int8": np.dtype("i1"),
    "uint16": np.dtype("<u2"),
    "int16": np.dtype("<i2"),
}
_TOPIC: Final = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_LONGEST_TOPIC: Final = 247
_LINE: Final = "=" * 80
_SECTIONS: Final = re.compile(r"^=+[ \t]*\r?$", re.MULTILINE)
_FIELD: Final = re.compile(r"(\S+)\s+(\w+)(?:\s+[^=\s].*)?", re.ASCII)
_CONSTANT: Final = re.compile(r"\S+\s+\w+\s*=.*", re.ASCII)
#: Longer definitions are refused, because parsing them takes long.
_MAX_DEFINITION: Final = 2**20
_ALIGN: Final = 8
#: The bytes before a message, and those of the number of rows at its beginning.
_HEAD: Final = 4
_COUNT: Final = 4
#: Writers may fill up a message to a multiple of this, so fewer bytes can follow the last row.
_FILL: Final = 8


class RosField(NamedTuple):
    """A field of a row: its name, and its type in ROS."""

    name: str
    kind: str


def ros_name(name: str) -> str:
    """The name of a row schema in ROS: mcaptrack.Tracks -> mcaptrack_msgs/msg/Tracks."""
    package, _, message = name.rpartition(".")
    return f"{package}_msgs/msg/{message}"


def schema_of_ros(name: str) -> str:
    """The name of the row schema that a ROS message would have; "" if its package can't be one of row schemas."""
    package, _, kind = plain_name(name).partition("/")
    return f"{package.removesuffix('_msgs')}.{kind}" if package.endswith("_msgs") else ""


def is_ros_topic(topic: str) -> bool:
    """Whether ROS 2 accepts the name of a topic."""
    return bool(_TOPIC.fullmatch(topic)) and len(topic) <= _LONGEST_TOPIC


def ros_definition(definition: Definition) -> str:
    """The text of the ROS definition (encoding "ros2msg") of a schema."""
    package, _, message = definition.name.rpartition(".")
    row = f"{package}_msgs/{message}Row"
    lines = [f"# {definition.doc}", f"{row}[] rows", _LINE, f"MSG: {row}"]
    width = max(len(_TYPES[column.kind]) + len(column.name) for column in definition.columns) + 1
    for column in definition.columns:
        missing = "" if not column.optional else "NaN if missing" if column.is_nullable else "-1 if missing"
        unit = f"in {column.stated_unit}" if column.stated_unit else ""
        comment = "; ".join(filter(None, (column.doc, unit, missing)))
        lines.append(f"{_TYPES[column.kind]} {column.name}".ljust(width) + (f" # {comment}" if comment else ""))
    return "\n".join(lines) + "\n"


def fields_of(definition: Definition) -> list[RosField]:
    """The fields of the rows of a schema, in order."""
    return [RosField(column.name, _TYPES[column.kind]) for column in definition.columns]


def read_definition(text: bytes, definition: Definition) -> list[RosField]:
    """The fields of rows by the ROS definition of a channel, in order.

    Raises ValueError unless the definition is of rows of this schema: with all columns that every version has, each of
    its type. It may have other fields, too.
    """
    if len(text) > _MAX_DEFINITION:
        raise ValueError(f"its definition has {len(text)} bytes")
    head, *others = _SECTIONS.split(text.decode("utf-8", "replace"))
    outer = _fields_in(head)
    if len(outer) != 1 or outer[0].name != "rows" or not outer[0].kind.endswith("[]"):
        raise ValueError("its definition has not one field, rows")
    row = outer[0].kind.removesuffix("[]")
    fields = None
    for section in others:
        name, _, body = section.strip().partition("\n")
        if name.startswith("MSG:") and _plain(name.removeprefix("MSG:").strip()) == _plain(row):
            fields = _fields_in(body)
    if not fields:
        raise ValueError(f"its definition does not say what {row} is")
    kinds = {field.name: field.kind for field in fields}
    if len(kinds) < len(fields):
        raise ValueError(f"its definition of {row} has two fields of one name")
    odd = next((field for field in fields if field.kind not in _FORMATS), None)
    if odd:
        raise ValueError(f"its definition of {row} has {odd.kind} {odd.name}; rows have numbers only")
    for column in definition.columns:
        kind = kinds.get(column.name)
        if kind is None and not column.optional and not column.since:
            raise ValueError(f"its definition of {row} lacks {column.name}")
        if kind not in (None, _TYPES[column.kind]):
            raise ValueError(f"its definition of {row} has {kind} {column.name}, not {_TYPES[column.kind]}")
    return fields


def _fields_in(section: str) -> list[RosField]:
    """The fields in a section of a definition, without comments and constants. Raises ValueError for other lines."""
    out = []
    for line in section.splitlines():
        text = line.partition("#")[0].strip()
        if not text or _CONSTANT.fullmatch(text):
            continue
        match = _FIELD.fullmatch(text)
        if not match:
            raise ValueError(f"its definition has the line {text[:80]!r}")
        out.append(RosField(match[2], match[1]))
    return out


def _plain(name: str) -> str:
    return name.replace("/msg/", "/")


class CdrCodec:
    """Rows of one schema <-> CDR payloads with these fields in each row. ``rows`` is the schema's own codec."""

    def __init__(self, rows: RowCodec, fields: Sequence[RosField]) -> None:
        self._rows = rows
        names = rows.dtype.names or ()
        self._formats = [(field.name, _FORMATS[field.kind]) for field in fields]
        self._known = [number for number, field in enumerate(fields) if field.name in names]
        # By where a row begins, modulo 8: where its fields lie, and its length.
        self._offsets = np.zeros((_ALIGN, len(fields)), np.int64)
        self._sizes = np.zeros(_ALIGN, np.int64)
        for begin in range(_ALIGN):
            at = begin
            for number, (_, form) in enumerate(self._formats):
                at += -at % form.itemsize
                self._offsets[begin, number] = at - begin
                at += form.itemsize
            self._sizes[begin] = at - begin
        # Where the rows of a message begin, up to the end of the first cycle of layouts.
        starts, seen = [_COUNT], [_COUNT % _ALIGN]
        while (then := (starts[-1] + int(self._sizes[seen[-1]])) % _ALIGN) not in seen:
            starts.append(starts[-1] + int(self._sizes[seen[-1]]))
            seen.append(then)
        self._lead = seen.index(then)
        self._starts = np.array(starts, np.int64)
        self._cycle = starts[-1] + int(self._sizes[seen[-1]]) - starts[self._lead]

    def encode_all(self, rows: Rows, counts: Ints) -> list[bytes]:
        """Encode the rows (N,) of M messages, which have ``counts`` (M,) rows each, one after another."""
        lengths = _HEAD + self._lengths(counts)
        ends = np.cumsum(lengths)
        begins = ends - lengths
        raw = np.zeros(int(lengths.sum()), np.uint8)
        raw[begins + 1] = 1  # little-endian
        _put(raw, begins + _HEAD, counts.astype("<u4"))
        starts = self._starts_of(ragged_range(0, counts))
        row_at = np.repeat(begins + _HEAD, counts) + starts
        for number, (name, form) in enumerate(self._formats):
            _put(raw, row_at + self._offsets[starts % _ALIGN, number], rows[name].astype(form))
        data = raw.tobytes()
        return [data[begin:end] for begin, end in zip(begins.tolist(), ends.tolist(), strict=True)]

    def decode_all(self, payloads: Sequence[bytes]) -> tuple[Rows, Ints]:
        """Decode payloads to one array of rows, and the number of rows in each.

        Raises ValueError if a payload is not a message with these fields.
        """
        ends = np.cumsum([len(payload) for payload in payloads], dtype=np.int64)
        starts = np.append(0, ends[:-1])[: len(ends)]
        raw = np.frombuffer(b"".join(payloads), np.uint8)
        decoded = self.decode_at(raw, starts, ends)
        if decoded is None:
            fits = [self.decode_at(raw, starts[n : n + 1], ends[n : n + 1]) is not None for n in range(len(ends))]
            bad = payloads[fits.index(False)]
            raise ValueError(f"{len(bad)} bytes are not a CDR message of its definition")
        return decoded

    def decode_at(self, raw: Bytes, start: Ints, end: Ints) -> tuple[Rows, Ints] | None:
        """Decode the payloads from ``start`` (M,) to ``end`` (M,) in ``raw``, as ``decode_all`` does.

        None if one is not a message with these fields.
        """
        length = end - start
        if (length < _HEAD + _COUNT).any():
            return None
        head = _take(raw, start, np.dtype("u1"), 2)
        if (head[:, 0] != 0).any() or (head[:, 1] > 1).any():
            return None
        is_big: Bools = head[:, 1] == 0
        counts = _swapped(_take(raw, start + _HEAD, np.dtype("<u4"))[:, 0], is_big).astype(np.int64)
        left = length - _HEAD - self._lengths(counts)
        if (left < 0).any() or (left >= _FILL).any():
            return None
        starts = self._starts_of(ragged_range(0, counts))
        row_at, big_rows = np.repeat(start + _HEAD, counts) + starts, np.repeat(is_big, counts)
        rows = self._rows.blank(len(starts))
        for number in self._known:
            name, form = self._formats[number]
            values = _take(raw, row_at + self._offsets[starts % _ALIGN, number], form)[:, 0]
            rows[name] = _swapped(values, big_rows)
        return rows, counts

    def _starts_of(self, number: Ints) -> Ints:
        """Where rows (N,) begin in their message, by their number in it."""
        cycles, place = np.divmod(np.maximum(number - self._lead, 0), len(self._starts) - self._lead)
        return np.where(number < self._lead, self._starts[np.minimum(number, self._lead)],
                        self._starts[self._lead + place] + cycles * self._cycle)  # fmt: skip

    def _lengths(self, counts: Ints) -> Ints:
        """The lengths (M,) of messages with so many rows, without the bytes before them."""
        last = self._starts_of(np.maximum(counts - 1, 0))
        return np.where(counts > 0, last + self._sizes[last % _ALIGN], _COUNT)


def _take(raw: Bytes, at: Ints, form: np.dtype[Any], count: int = 1) -> NDArray[Any]:
    """Values (N, count) of a format at places (N,) of ``raw``."""
    values: NDArray[Any] = raw[at[:, None] + np.arange(form.itemsize * count)].view(form)
    return values


def _put(raw: Bytes, at: Ints, values: NDArray[Any]) -> None:
    """Write values (N,) at places (N,) of ``raw``."""
    width = values.dtype.itemsize
    raw[at[:, None] + np.arange(width)] = np.ascontiguousarray(values).view(np.uint8).reshape(-1, width)


def _swapped(values: NDArray[Any], which: Bools) -> NDArray[Any]:
    """Values (N,), some of them with their bytes the other way round."""
    return np.where(which, values.byteswap(), values) if which.any() else values


def record_of(schema: Schema, encoding: Encoding) -> tuple[str, str, bytes]:
    """Name, encoding and data of the schema record of a channel with rows in this encoding."""
    if encoding == CDR:
        return ros_name(schema.name), SchemaEncoding.ROS2, ros_definition(schema.definition).encode()
    return schema.name, PROTOBUF, schema.descriptor


def schema_name_of(name: str, schema_encoding: str, message_encoding: str, metadata: Mapping[str, str] = {}) -> str:
    """The name of the schema of a channel: mcaptrack.Tracks also for its rows as ROS messages."""
    rows = schema_of_ros(name) if (schema_encoding, message_encoding) == (SchemaEncoding.ROS2, CDR) else ""
    return rows if schema_of_channel(rows, metadata) else name


def reader_of(schema: Schema, message_encoding: str, definition: bytes) -> RowReader:
    """The decoder of a channel with rows, by the data of its schema record.

    Raises ValueError for a definition that is not of such rows.
    """
    if message_encoding != CDR:
        return schema.codec
    return CdrCodec(schema.codec, read_definition(definition, schema.definition))


@cache
def cdr_codec(schema: Schema) -> CdrCodec:
    """The codec of rows as ROS messages of this version."""
    return CdrCodec(schema.codec, fields_of(schema.definition))


def encoded(schema: Schema, frames: Iterable[Frame], encoding: Encoding) -> Iterator[tuple[int, int, bytes]]:
    """Yield time in ns, frame number and payload of each frame."""
    if encoding != CDR:
        yield from ((frame.t_ns, frame.index, schema.codec.encode(frame.rows)) for frame in frames)
        return
    codec, rest = cdr_codec(schema), iter(frames)
    while batch := list(islice(rest, _BATCH)):
        rows = schema.joined([frame.rows for frame in batch])
        payloads = codec.encode_all(rows, np.array([len(frame.rows) for frame in batch], np.int64))
        yield from ((frame.t_ns, frame.index, payload) for frame, payload in zip(batch, payloads, strict=True))
