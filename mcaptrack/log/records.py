"""MCAP records <-> bytes, by the MCAP specification (version 0). Only this package knows their bytes.

Records have the types of the ``mcap`` package. Of those with much data only the head is read, and where the data is:
``ChunkHead`` and ``AttachmentHead``. Integers are little endian; strings, arrays and maps are preceded by their length
in bytes. Checksums are CRC-32 of parts of a file; and of the beginning of a file when its end is rewritten.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Final, NamedTuple, Protocol, overload

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Header, Metadata, Schema

from mcaptrack.errors import McaptrackError

MAGIC: Final = b"\x89MCAP0\r\n"
#: Block size in bytes for work on a whole file.
BLOCK: Final = 8 * 2**20

_HEAD: Final = struct.Struct("<BQ")
MESSAGE_HEAD: Final = struct.Struct("<HIQQ")
RECORD_MESSAGE_HEAD: Final = struct.Struct("<BQHIQQ")
#: Where the id of its channel stands in a message record.
MESSAGE_ID_AT: Final = _HEAD.size
FOOTER_BODY: Final = struct.Struct("<QQI")
#: The head of a chunk, by compression: times, size, checksum, length of the name, the name, size of the records.
_CHUNK_HEADS: Final = {name: struct.Struct(f"<QQQII{len(name)}xQ") for name in (b"zstd", b"", b"lz4")}
_CHUNK_NAME_AT: Final = struct.calcsize("<QQQII")
#: Bytes that hold the head of a chunk of a usual compression.
CHUNK_HEAD_BYTES: Final = max(layout.size for layout in _CHUNK_HEADS.values())
_INDEX_HEAD: Final = struct.Struct("<HI")
_CHUNK_INDEX_HEAD: Final = struct.Struct("<QQQQI")
_CHUNK_INDEX_OFFSET: Final = struct.Struct("<HQ")
_CHUNK_INDEX_NAME: Final = struct.Struct("<QI")
_CHUNK_INDEX_SIZES: Final = struct.Struct("<QQ")
#: Bytes read at once: of one record, and of consecutive records.
_LOOKAHEAD: Final = 1024
_WALK_BLOCK: Final = 64 * 2**10

#: The records of a data section.
DATA_OPCODES: Final = (
    Opcode.HEADER,
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.MESSAGE,
    Opcode.CHUNK,
    Opcode.MESSAGE_INDEX,
    Opcode.ATTACHMENT,
    Opcode.METADATA,
    Opcode.DATA_END,
)


class Bytes(Protocol):
    """Bytes that can be sliced: in memory (memoryview) or in a file (``ByteSource``, which reads the slice)."""

    def __len__(self) -> int: ...

    @overload
    def __getitem__(self, key: int, /) -> int: ...

    @overload
    def __getitem__(self, key: slice, /) -> memoryview: ...


class Record(NamedTuple):
    """A record in a buffer: its opcode, its offset, and the start and end of its body."""

    opcode: int
    start: int
    body: int
    end: int


class ChunkHead(NamedTuple):
    """The head of a chunk. Its records are in the buffer from ``start`` to ``end``."""

    start_ns: int
    end_ns: int
    uncompressed_size: int
    uncompressed_crc: int
    compression: str
    start: int
    end: int


class Damaged(McaptrackError):
    """Bytes that violate the MCAP format, and their offset if it is known."""

    def __init__(self, message: str, at: int | None = None) -> None:
        super().__init__(message if at is None else f"byte {at}: {message}")
        self._words, self._at = message, at

    def moved(self, base: int) -> Damaged:
        """The same error with its offset moved by ``base``, where the part of the file begins."""
        return Damaged(self._words, None if self._at is None else self._at + base)


class Reader:
    """Reads the fields of one record, never beyond its end."""

    def __init__(self, buffer: Bytes, start: int, end: int) -> None:
        self._buffer, self.at, self._end = buffer, start, end
        self._near, self._near_from = buffer[start : min(end, start + _LOOKAHEAD)], start  # most records are short

    def _at(self, at: int, size: int) -> memoryview:
        low = at - self._near_from
        return self._near[low : low + size] if low + size <= len(self._near) else self._buffer[at : at + size]

    def _take(self, size: int) -> int:
        at = self.at
        if size > self._end - at:
            raise Damaged(f"a field at byte {at} needs {size} bytes; its record has {self._end - at} left")
        self.at = at + size
        return at

    def number(self, size: int) -> int:
        return int.from_bytes(self._at(self._take(size), size), "little")

    def skip(self, size: int) -> None:
        self._take(size)

    def span(self, length_size: int = 4) -> tuple[int, int]:
        """Start and end of bytes that are preceded by their length."""
        size = self.number(length_size)
        at = self._take(size)
        return at, at + size

    def raw(self, length_size: int = 4) -> memoryview:
        start, end = self.span(length_size)
        return self._at(start, end - start)

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
        return Reader(self._buffer, *self.span())

    @property
    def done(self) -> bool:
        return self.at >= self._end


def walk(buffer: Bytes, start: int, end: int) -> Iterator[Record]:
    """The consecutive records between two offsets. Raises Damaged where there is no record.

    ``start`` and ``end`` are those offsets in ``buffer``, in bytes.
    """
    at = base = start
    near = buffer[start:start]
    while at < end:
        if at + _HEAD.size > base + len(near):
            base, near = at, buffer[at : min(at + _WALK_BLOCK, end)]
        record = _record(near, at - base, at, end)
        yield record
        at = record.end


def record_at(buffer: Bytes, offset: int) -> Record:
    """The record at an offset. Raises Damaged if there is none."""
    if not 0 <= offset < len(buffer):
        raise Damaged(f"an index places a record at byte {offset} of {len(buffer)}")
    return _record(buffer[offset : offset + _HEAD.size], 0, offset, len(buffer))


def _record(near: memoryview, low: int, at: int, end: int) -> Record:
    """The record at offset ``at``, which is byte ``low`` of ``near``."""
    if end - at < _HEAD.size:
        raise Damaged(f"{end - at} bytes are too few for a record", at)
    opcode, length = _HEAD.unpack_from(near, low)
    body = at + _HEAD.size
    if opcode == 0:
        raise Damaged("no record begins with 0", at)
    if length > end - body:
        raise Damaged(f"a record of {length} bytes where {end - body} are left", at)
    return Record(opcode, at, body, body + length)


def read_schema(buffer: Bytes, record: Record) -> Schema:
    r = Reader(buffer, record.body, record.end)
    return Schema(id=r.number(2), name=r.text(), encoding=r.text(), data=bytes(r.raw()))


def read_channel(buffer: Bytes, record: Record) -> Channel:
    r = Reader(buffer, record.body, record.end)
    number, schema_id, topic, message_encoding = r.number(2), r.number(2), r.text(), r.text()
    return Channel(
        id=number, topic=topic, message_encoding=message_encoding, metadata=r.text_map(), schema_id=schema_id
    )


def read_chunk(buffer: Bytes, record: Record) -> ChunkHead:
    near = buffer[record.body : min(record.body + CHUNK_HEAD_BYTES, record.end)]
    for name, layout in _CHUNK_HEADS.items():  # fast path for the usual compressions
        if len(near) >= layout.size:
            first, last, size, crc, length, data_size = layout.unpack_from(near)
            start = record.body + layout.size
            is_known = length == len(name) and near[_CHUNK_NAME_AT : _CHUNK_NAME_AT + length] == name
            if is_known and data_size <= record.end - start:
                return ChunkHead(first, last, size, crc, name.decode(), start, start + data_size)
    r = Reader(buffer, record.body, record.end)
    head = (r.number(8), r.number(8), r.number(8), r.number(4), r.text())
    size = r.number(8)
    if size > record.end - r.at:
        raise Damaged(f"a chunk of {size} bytes in a record with {record.end - r.at} left", record.start)
    return ChunkHead(*head, r.at, r.at + size)


def read_message_entries(buffer: Bytes, record: Record) -> tuple[int, memoryview]:
    """The channel of a message index and its entries: log time and offset, 8 bytes each."""
    if record.opcode != Opcode.MESSAGE_INDEX:
        raise Damaged("there is no message index where the chunk index says", record.start)
    whole = buffer[record.body : record.end]
    if len(whole) < _INDEX_HEAD.size:
        raise Damaged(f"a message index of {len(whole)} bytes", record.start)
    channel, size = _INDEX_HEAD.unpack_from(whole)
    if size > len(whole) - _INDEX_HEAD.size:
        raise Damaged(f"a message index of {size} bytes in a record with {len(whole) - _INDEX_HEAD.size}", record.start)
    return channel, whole[_INDEX_HEAD.size : _INDEX_HEAD.size + size]


def read_metadata(buffer: Bytes, record: Record) -> Metadata:
    r = Reader(buffer, record.body, record.end)
    return Metadata(name=r.text(), metadata=r.text_map())


class AttachmentHead(NamedTuple):
    """The head of an attachment. Its data is in the buffer from ``start`` to ``end``."""

    log_ns: int
    create_ns: int
    name: str
    media_type: str
    start: int
    end: int


def read_attachment(buffer: Bytes, record: Record) -> AttachmentHead:
    r = Reader(buffer, record.body, record.end)
    return AttachmentHead(r.number(8), r.number(8), r.text(), r.text(), *r.span(8))


def read_header(buffer: Bytes, record: Record) -> Header:
    r = Reader(buffer, record.body, record.end)
    return Header(profile=r.text(), library=r.text())


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


def pack_schema(schema: Schema) -> bytes:
    return pack(Opcode.SCHEMA, number(schema.id, 2), text(schema.name), text(schema.encoding), raw(schema.data))


def pack_channel(channel: Channel) -> bytes:
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


def pack_chunk_index(index: ChunkIndex) -> bytes:
    return pack(
        Opcode.CHUNK_INDEX,
        number(index.message_start_time, 8),
        number(index.message_end_time, 8),
        number(index.chunk_start_offset, 8),
        number(index.chunk_length, 8),
        number_map(index.message_index_offsets, 2, 8),
        number(index.message_index_length, 8),
        text(index.compression),
        number(index.compressed_size, 8),
        number(index.uncompressed_size, 8),
    )


def read_chunk_index(buffer: Bytes, record: Record) -> ChunkIndex:
    whole = buffer[record.body : record.end]
    with suppress(struct.error, UnicodeDecodeError):  # the slow path below reports what is wrong
        first, last, offset, length, size = _CHUNK_INDEX_HEAD.unpack_from(whole)
        at = _CHUNK_INDEX_HEAD.size + size
        offsets = dict(_CHUNK_INDEX_OFFSET.iter_unpack(whole[_CHUNK_INDEX_HEAD.size : at]))
        index_length, size = _CHUNK_INDEX_NAME.unpack_from(whole, at)
        at += _CHUNK_INDEX_NAME.size + size
        stored, opened = _CHUNK_INDEX_SIZES.unpack_from(whole, at)
        name = bytes(whole[at - size : at]).decode()
        return chunk_index((first, last), (offset, length), offsets, index_length, (name, stored, opened))
    r = Reader(buffer, record.body, record.end)
    span, place = (r.number(8), r.number(8)), (r.number(8), r.number(8))
    return chunk_index(span, place, r.number_map(2, 8), r.number(8), (r.text(), r.number(8), r.number(8)))


def chunk_index(
    span: tuple[int, int],
    place: tuple[int, int],
    indexes: dict[int, int],
    indexes_length: int,
    sizes: tuple[str, int, int],
) -> ChunkIndex:
    """The index entry of a chunk.

    ``span`` is the first and the last time in ns, ``place`` its offset and its length, ``sizes`` its compression, and
    its size with and without that.
    """
    return ChunkIndex(
        message_start_time=span[0],
        message_end_time=span[1],
        chunk_start_offset=place[0],
        chunk_length=place[1],
        message_index_offsets=indexes,
        message_index_length=indexes_length,
        compression=sizes[0],
        compressed_size=sizes[1],
        uncompressed_size=sizes[2],
    )


_CRC_POLYNOMIAL: Final = 0xEDB88320
#: Bytes read at once.
_CRC_BLOCK: Final = 2**20


def crc_of(buffer: Bytes, start: int, end: int, crc: int = 0) -> int:
    """The CRC-32 of a part of a file, continuing from ``crc``; one block in memory at a time."""
    for at in range(start, end, _CRC_BLOCK):
        crc = zlib.crc32(buffer[at : min(at + _CRC_BLOCK, end)], crc)
    return crc


def attachment_is_whole(buffer: Bytes, record: Record) -> bool:
    """Whether the checksum of an attachment is right; 0 means that it has none."""
    crc = int.from_bytes(buffer[record.end - 4 : record.end], "little")
    return not crc or crc_of(buffer, record.body, record.end - 4) == crc


def crc_before(crc: int, tail_crc: int, tail_size: int) -> int:
    """The CRC-32 of the first part of some bytes, from the CRC of all of them and the CRC and size of the rest.

    The CRC of a concatenation is the CRC of the first part, shifted by the length of the second part, plus the CRC of
    the second part (zlib's crc32_combine). The shift can be inverted.
    """
    shifted = crc ^ tail_crc
    # The inverse shift by one bit as a 32 x 32 bit matrix; its squares shift back by two, four, eight bits.
    back = [1 << bit + 1 for bit in range(31)] + [(1 << 31 ^ _CRC_POLYNOMIAL) << 1 & 0xFFFFFFFF | 1]
    bits = 8 * tail_size
    while bits:
        if bits & 1:
            shifted = _times(back, shifted)
        back = [_times(back, column) for column in back]
        bits >>= 1
    return shifted


def _times(columns: Sequence[int], vector: int) -> int:
    """Product of a bit matrix and a bit vector, over GF(2)."""
    out = 0
    for column in columns:
        if vector & 1:
            out ^= column
        vector >>= 1
    return out
