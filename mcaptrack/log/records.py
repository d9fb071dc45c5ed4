"""MCAP records <-> bytes, from the MCAP specification (version 0). Only this package knows them.

Numbers are little endian; strings, arrays and maps carry their length in bytes before them.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

from mcap.opcode import Opcode

from mcaptrack.errors import McaptrackError

MAGIC: Final = b"\x89MCAP0\r\n"
#: How much of a file is worked on at once where all of it is.
BLOCK: Final = 8 * 2**20

_HEAD: Final = struct.Struct("<BQ")
MESSAGE_HEAD: Final = struct.Struct("<HIQQ")
RECORD_MESSAGE_HEAD: Final = struct.Struct("<BQHIQQ")
FOOTER_BODY: Final = struct.Struct("<QQI")
_CRC_POLYNOMIAL: Final = 0xEDB88320


class Record(NamedTuple):
    """A record in a buffer: its opcode, where it starts, where its body starts, and where it ends."""

    opcode: int
    start: int
    body: int
    end: int


class SchemaRecord(NamedTuple):
    id: int
    name: str
    encoding: str
    data: bytes


class ChannelRecord(NamedTuple):
    id: int
    schema_id: int
    topic: str
    message_encoding: str
    metadata: dict[str, str]


class ChunkHead(NamedTuple):
    """A chunk without its records, which stand in the buffer from ``start`` to ``end``."""

    start_ns: int
    end_ns: int
    uncompressed_size: int
    uncompressed_crc: int
    compression: str
    start: int
    end: int


class ChunkIndexRecord(NamedTuple):
    start_ns: int
    end_ns: int
    offset: int
    length: int
    message_index_offsets: dict[int, int]
    message_index_length: int
    compression: str
    compressed_size: int
    uncompressed_size: int


class Damaged(McaptrackError):
    """Bytes that are no MCAP, and at which byte, if that is known."""

    def __init__(self, words: str, at: int | None = None) -> None:
        super().__init__(words if at is None else f"byte {at}: {words}")
        self._words, self._at = words, at

    def moved(self, base: int) -> Damaged:
        """The same, found in a part of a file that begins at byte ``base``."""
        return Damaged(self._words, None if self._at is None else self._at + base)


class Reader:
    """Reads fields of one record body; never beyond its end."""

    def __init__(self, buffer: memoryview, start: int, end: int) -> None:
        self._buffer, self.at, self._end = buffer, start, end

    def _take(self, size: int) -> int:
        at = self.at
        if size > self._end - at:
            raise Damaged(f"a field at byte {at} needs {size} bytes; its record has {self._end - at} left")
        self.at = at + size
        return at

    def number(self, size: int) -> int:
        at = self._take(size)
        return int.from_bytes(self._buffer[at : at + size], "little")

    def skip(self, size: int) -> None:
        self._take(size)

    def raw(self, length_size: int = 4) -> memoryview:
        size = self.number(length_size)
        at = self._take(size)
        return self._buffer[at : at + size]

    def text(self) -> str:
        at = self.at
        try:
            return bytes(self.raw()).decode("utf-8")
        except UnicodeDecodeError:
            raise Damaged(f"the text at byte {at} is not UTF-8") from None

    def text_map(self) -> dict[str, str]:
        inner = self._inner()
        out = {}
        while not inner.done:
            key = inner.text()
            out[key] = inner.text()
        return out

    def number_map(self, key_size: int, value_size: int) -> dict[int, int]:
        inner = self._inner()
        out = {}
        while not inner.done:
            key = inner.number(key_size)
            out[key] = inner.number(value_size)
        return out

    def _inner(self) -> Reader:
        size = self.number(4)
        at = self._take(size)
        return Reader(self._buffer, at, at + size)

    @property
    def done(self) -> bool:
        return self.at >= self._end


def walk(buffer: memoryview, start: int, end: int) -> Iterator[Record]:
    """The records that stand one after another between two offsets. Raises Damaged where there is none."""
    at = start
    while at < end:
        if end - at < _HEAD.size:
            raise Damaged(f"{end - at} bytes are too few for a record", at)
        opcode, length = _HEAD.unpack_from(buffer, at)
        body = at + _HEAD.size
        if opcode == 0:
            raise Damaged("no record begins with 0", at)
        if length > end - body:
            raise Damaged(f"a record of {length} bytes where {end - body} are left", at)
        yield Record(opcode, at, body, body + length)
        at = body + length


def record_at(buffer: memoryview, offset: int) -> Record:
    """The record that stands at an offset. Raises Damaged if there is none."""
    if not 0 <= offset < len(buffer):
        raise Damaged(f"a record is said to stand at byte {offset} of {len(buffer)}")
    return next(walk(buffer, offset, len(buffer)))


def crc_before(crc: int, tail: bytes | memoryview) -> int:
    """The CRC-32 of some bytes, from that of the same bytes with ``tail`` behind them.

    The CRC of a whole is that of its first part, shifted by as many zeros as the second part is long, plus that of the
    second part (as zlib's crc32_combine has it); a shift can be undone.
    """
    shifted = crc ^ zlib.crc32(tail)
    # One zero bit back, as what becomes of each of the 32 bits; squared, it goes back two, four, eight.
    back = [1 << bit + 1 for bit in range(31)] + [(1 << 31 ^ _CRC_POLYNOMIAL) << 1 & 0xFFFFFFFF | 1]
    bits = 8 * len(tail)
    while bits:
        if bits & 1:
            shifted = _times(back, shifted)
        back = [_times(back, column) for column in back]
        bits >>= 1
    return shifted


def _times(columns: Sequence[int], vector: int) -> int:
    """A matrix over bits times a vector of bits."""
    out = 0
    for column in columns:
        if vector & 1:
            out ^= column
        vector >>= 1
    return out


def read_schema(buffer: memoryview, record: Record) -> SchemaRecord:
    r = Reader(buffer, record.body, record.end)
    return SchemaRecord(r.number(2), r.text(), r.text(), bytes(r.raw()))


def read_channel(buffer: memoryview, record: Record) -> ChannelRecord:
    r = Reader(buffer, record.body, record.end)
    return ChannelRecord(r.number(2), r.number(2), r.text(), r.text(), r.text_map())


def read_chunk(buffer: memoryview, record: Record) -> ChunkHead:
    r = Reader(buffer, record.body, record.end)
    head = (r.number(8), r.number(8), r.number(8), r.number(4), r.text())
    size = r.number(8)
    if size > record.end - r.at:
        raise Damaged(f"a chunk of {size} bytes in a record with {record.end - r.at} left", record.start)
    return ChunkHead(*head, r.at, r.at + size)


def read_message_index(buffer: memoryview, record: Record) -> tuple[int, int]:
    """The channel of a message index and how many messages it lists."""
    channel, entries = read_message_entries(buffer, record)
    return channel, len(entries) // 16


def read_message_entries(buffer: memoryview, record: Record) -> tuple[int, memoryview]:
    """The channel of a message index and its entries, log time and offset of 8 bytes each."""
    if record.opcode != Opcode.MESSAGE_INDEX:
        raise Damaged("no message index where one belongs", record.start)
    r = Reader(buffer, record.body, record.end)
    return r.number(2), r.raw()


def read_metadata(buffer: memoryview, record: Record) -> tuple[str, dict[str, str]]:
    r = Reader(buffer, record.body, record.end)
    return r.text(), r.text_map()


def read_attachment(buffer: memoryview, record: Record) -> tuple[int, int, str, str, memoryview]:
    """Log time, create time, name, media type and data of an attachment."""
    r = Reader(buffer, record.body, record.end)
    return r.number(8), r.number(8), r.text(), r.text(), r.raw(8)


def attachment_is_whole(buffer: memoryview, record: Record) -> bool:
    """Whether the checksum of an attachment is right, or 0 for none."""
    crc = int.from_bytes(buffer[record.end - 4 : record.end], "little")
    return not crc or zlib.crc32(buffer[record.body : record.end - 4]) == crc


def read_header(buffer: memoryview, record: Record) -> tuple[str, str]:
    """Profile and library."""
    r = Reader(buffer, record.body, record.end)
    return r.text(), r.text()


def pack(opcode: int, *fields: bytes) -> bytes:
    """A record."""
    body = b"".join(fields)
    return _HEAD.pack(opcode, len(body)) + body


def number(value: int, size: int) -> bytes:
    return value.to_bytes(size, "little")


def raw(data: bytes, length_size: int = 4) -> bytes:
    return len(data).to_bytes(length_size, "little") + data


def text(value: str) -> bytes:
    return raw(value.encode("utf-8"))


def text_map(values: Mapping[str, str]) -> bytes:
    return raw(b"".join(text(key) + text(value) for key, value in values.items()))


def number_map(values: Mapping[int, int], key_size: int, value_size: int) -> bytes:
    return raw(b"".join(number(key, key_size) + number(value, value_size) for key, value in values.items()))


def pack_schema(schema: SchemaRecord) -> bytes:
    return pack(Opcode.SCHEMA, number(schema.id, 2), text(schema.name), text(schema.encoding), raw(schema.data))


def pack_channel(channel: ChannelRecord) -> bytes:
    head = number(channel.id, 2) + number(channel.schema_id, 2)
    return pack(Opcode.CHANNEL, head, text(channel.topic), text(channel.message_encoding), text_map(channel.metadata))


def pack_message_index(channel_id: int, entries: bytes) -> bytes:
    """``entries`` are pairs of log time and offset inside the chunk, 8 bytes each."""
    return pack(Opcode.MESSAGE_INDEX, number(channel_id, 2), raw(entries))


def pack_chunk(head: tuple[int, int, int, int], compression: str, data: bytes) -> bytes:
    """``head`` is start time, end time, uncompressed size and CRC."""
    start_ns, end_ns, size, crc = head
    fields = number(start_ns, 8) + number(end_ns, 8) + number(size, 8) + number(crc, 4)
    return pack(Opcode.CHUNK, fields, text(compression), raw(data, 8))


def pack_chunk_index(index: ChunkIndexRecord) -> bytes:
    return pack(
        Opcode.CHUNK_INDEX,
        *(number(value, 8) for value in index[:4]),
        number_map(index.message_index_offsets, 2, 8),
        number(index.message_index_length, 8),
        text(index.compression),
        number(index.compressed_size, 8),
        number(index.uncompressed_size, 8),
    )


def read_chunk_index(buffer: memoryview, record: Record) -> ChunkIndexRecord:
    r = Reader(buffer, record.body, record.end)
    head = (r.number(8), r.number(8), r.number(8), r.number(8))
    return ChunkIndexRecord(*head, r.number_map(2, 8), r.number(8), r.text(), r.number(8), r.number(8))
