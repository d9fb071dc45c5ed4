"""The encodings of rows in a log: protobuf, or CDR in the recordings of ROS 2.

A channel of rows is read by its own encoding. Digests don't depend on it: they are of the messages in protobuf.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from itertools import islice
from typing import Final, Literal, Protocol

import numpy as np

from mcaptrack.geometry.arrays import Bytes, Ints
from mcaptrack.schema import SCHEMAS, Frame, Rows, Schema
from mcaptrack.schema.cdr import CdrCodec, fields_of, read_definition, ros_definition, ros_name, schema_of_ros

Encoding = Literal["protobuf", "cdr"]
PROTOBUF: Final = "protobuf"
CDR: Final = "cdr"
#: Encodings of messages with rows.
ROW_ENCODINGS: Final = (PROTOBUF, CDR)
#: The encoding of the definitions of ROS 2 messages.
ROS2MSG: Final = "ros2msg"
#: The number of frames that are encoded together.
_BATCH: Final = 256


class RowReader(Protocol):
    """Decodes the messages of a channel to rows."""

    def decode_all(self, payloads: Sequence[bytes]) -> tuple[Rows, Ints]:
        """Decode payloads to one array of rows, and the number of rows in each. Raises ValueError."""

    def decode_at(self, raw: Bytes, start: Ints, end: Ints) -> tuple[Rows, Ints] | None:
        """Decode payloads at places of ``raw``; None if one has another layout than the usual one."""


def record_of(schema: Schema, encoding: Encoding) -> tuple[str, str, bytes]:
    """Name, encoding and data of the schema record of a channel with rows in this encoding."""
    if encoding == CDR:
        return ros_name(schema.name), ROS2MSG, ros_definition(schema.definition).encode()
    return schema.name, PROTOBUF, schema.descriptor


def schema_name_of(name: str, schema_encoding: str, message_encoding: str) -> str:
    """The name of the schema of a channel: mcaptrack.Tracks also for its rows as ROS messages."""
    rows = schema_of_ros(name) if (schema_encoding, message_encoding) == (ROS2MSG, CDR) else ""
    return rows if rows in SCHEMAS else name


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
