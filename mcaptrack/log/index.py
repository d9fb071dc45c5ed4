"""What is in a log and where: from its summary where that can be had, otherwise from a walk over the whole file."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from mcaptrack.log import records
from mcaptrack.log.records import (
    MAGIC,
    ChannelRecord,
    ChunkIndexRecord,
    Damaged,
    Reader,
    Record,
    SchemaRecord,
    walk,
)

#: A chunk that says it is larger than this is not decompressed.
MAX_CHUNK_BYTES: Final = 256 * 2**20
_FOOTER_SIZE: Final = 9 + records.FOOTER_BODY.size + len(MAGIC)


@dataclass
class Index:
    """The contents of a log. ``data_end`` is where the data section ends, ``data_crc`` its CRC if the file has one."""

    data_end: int = 0
    data_crc: int = 0
    schemas: dict[int, SchemaRecord] = field(default_factory=dict)
    channels: dict[int, ChannelRecord] = field(default_factory=dict)
    chunks: list[ChunkIndexRecord] = field(default_factory=list)
    loose: list[Record] = field(default_factory=list)  # messages outside of chunks
    counts: dict[int, int] = field(default_factory=dict)  # messages of each channel
    attachments: list[str] = field(default_factory=list)
    metadata: list[tuple[str, int]] = field(default_factory=list)  # name and where its record starts
    start_ns: int = 0
    end_ns: int = 0


def read_index(buffer: memoryview) -> Index:
    """The contents of the log in ``buffer``. Raises Damaged if it is none or is cut off."""
    if bytes(buffer[: len(MAGIC)]) != MAGIC:
        raise Damaged("it does not begin as an MCAP file does")
    if len(buffer) < 2 * len(MAGIC) or bytes(buffer[-len(MAGIC) :]) != MAGIC:
        raise Damaged("it is cut off: the end of an MCAP file is missing")
    return _from_summary(buffer) or _from_scan(buffer)


def _from_summary(buffer: memoryview) -> Index | None:
    """None where the summary lacks something that reading by index stands on."""
    at = len(buffer) - _FOOTER_SIZE
    if at < len(MAGIC) or buffer[at] != Opcode.FOOTER:
        raise Damaged("it has no footer where one belongs")
    summary_start, _, summary_crc = records.FOOTER_BODY.unpack_from(buffer, at + 9)
    data_end = summary_start - 13
    if not len(MAGIC) <= data_end < at or buffer[data_end] != Opcode.DATA_END:
        return None
    if summary_crc and zlib.crc32(buffer[summary_start : len(buffer) - len(MAGIC) - 4]) != summary_crc:
        return None  # the data section says the same, with checksums of its own
    index, has_statistics = Index(data_end), False
    index.data_crc = Reader(buffer, data_end + 9, data_end + 13).number(4)
    for record in walk(buffer, summary_start, at):
        has_statistics |= record.opcode == Opcode.STATISTICS
        _take(index, buffer, record)
    known = {channel for chunk in index.chunks for channel in chunk.message_index_offsets}
    complete = known <= set(index.channels) and all(c.schema_id in {0, *index.schemas} for c in index.channels.values())
    # The length of the message indexes says how many messages they list; fewer than there are means that some stand
    # outside of chunks or were never indexed.
    listed = sum(c.message_index_length - 15 * len(c.message_index_offsets) for c in index.chunks)
    indexed = all(chunk.message_index_offsets for chunk in index.chunks) and listed == 16 * sum(index.counts.values())
    return index if has_statistics and complete and indexed else None


def _take(index: Index, buffer: memoryview, record: Record) -> None:
    """Add a record of the summary to the index."""
    reader = Reader(buffer, record.body, record.end)
    if record.opcode == Opcode.SCHEMA:
        schema = records.read_schema(buffer, record)
        index.schemas.setdefault(schema.id, schema)
    elif record.opcode == Opcode.CHANNEL:
        channel = records.read_channel(buffer, record)
        index.channels.setdefault(channel.id, channel)
    elif record.opcode == Opcode.CHUNK_INDEX:
        index.chunks.append(records.read_chunk_index(buffer, record))
    elif record.opcode == Opcode.STATISTICS:
        reader.skip(8 + 2 + 4 + 4 + 4 + 4)
        index.start_ns, index.end_ns = reader.number(8), reader.number(8)
        index.counts = reader.number_map(2, 8)
    elif record.opcode == Opcode.ATTACHMENT_INDEX:
        reader.skip(8 * 5)
        index.attachments.append(reader.text())
    elif record.opcode == Opcode.METADATA_INDEX:
        offset = reader.number(8)
        reader.skip(8)
        index.metadata.append((reader.text(), offset))


def _from_scan(buffer: memoryview) -> Index:
    """The contents from every record of the data section, chunks opened."""
    index, last_chunk = Index(), -1
    times: list[int] = []
    for record in walk(buffer, len(MAGIC), len(buffer) - len(MAGIC)):
        if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            _take(index, buffer, record)
        elif record.opcode == Opcode.CHUNK:
            last_chunk += 1
            times += _scan_chunk(index, buffer, record)
        elif record.opcode == Opcode.MESSAGE:
            index.loose.append(record)
            channel, _, t_ns, _ = message_head(buffer, record)
            index.counts[channel] = index.counts.get(channel, 0) + 1
            times.append(t_ns)
        elif record.opcode == Opcode.ATTACHMENT:
            index.attachments.append(records.read_attachment(buffer, record)[2])
        elif record.opcode == Opcode.METADATA:
            index.metadata.append((records.read_metadata(buffer, record)[0], record.start))
        elif record.opcode == Opcode.DATA_END:
            index.data_end = record.start
            index.data_crc = Reader(buffer, record.body, record.end).number(4)
        # Schemas and channels of the summary count too: some writers put them nowhere else.
    missing = set(index.counts) - set(index.channels)
    if missing:
        raise Damaged(f"there are messages of channel {min(missing)}, which is not described anywhere")
    if index.data_end == 0:
        raise Damaged("its data section has no end")
    index.start_ns, index.end_ns = (min(times), max(times)) if times else (0, 0)
    return index


def _scan_chunk(index: Index, buffer: memoryview, record: Record) -> list[int]:
    head = records.read_chunk(buffer, record)
    content = open_chunk(buffer, record)
    found: dict[int, int] = {}
    times = []
    for inner in walk(content, 0, len(content)):
        if inner.opcode == Opcode.MESSAGE:
            channel, _, t_ns, _ = message_head(content, inner)
            found[channel] = found.get(channel, 0) + 1
            times.append(t_ns)
        elif inner.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            _take(index, content, inner)
    for channel, count in found.items():
        index.counts[channel] = index.counts.get(channel, 0) + count
    size = head.end - head.start
    index.chunks.append(
        ChunkIndexRecord(
            head.start_ns,
            head.end_ns,
            record.start,
            record.end - record.start,
            dict.fromkeys(found, 0),  # there may be no message index; 0 says so
            0,
            head.compression,
            size,
            head.uncompressed_size,
        )
    )
    return times


def message_head(buffer: memoryview, record: Record) -> tuple[int, int, int, int]:
    """Channel, sequence, log time and publish time of a message record."""
    if record.end - record.body < records.MESSAGE_HEAD.size:
        raise Damaged(f"byte {record.start}: a message of {record.end - record.body} bytes")
    head: tuple[int, int, int, int] = records.MESSAGE_HEAD.unpack_from(buffer, record.body)
    return head


def open_chunk(buffer: memoryview, record: Record) -> memoryview:
    """The records inside a chunk, decompressed and checked. Memory is bounded by what the chunk says of itself."""
    head = records.read_chunk(buffer, record)
    if head.uncompressed_size > MAX_CHUNK_BYTES:
        raise Damaged(f"byte {record.start}: a chunk of {head.uncompressed_size} bytes; at most {MAX_CHUNK_BYTES}")
    data = buffer[head.start : head.end]
    content = _decompress(data, head.compression, head.uncompressed_size, record.start)
    if len(content) != head.uncompressed_size:
        raise Damaged(f"byte {record.start}: a chunk of {len(content)} bytes that says {head.uncompressed_size}")
    if head.uncompressed_crc and zlib.crc32(content) != head.uncompressed_crc:
        raise Damaged(f"byte {record.start}: the checksum of a chunk is wrong")
    return content


def _decompress(data: memoryview, compression: str, size: int, where: int) -> memoryview:
    """At most one byte more than ``size``, however much the data would give."""
    if compression == "":
        return data
    try:
        if compression == "zstd":
            return memoryview(_zstd(data, size + 1))
        if compression == "lz4":
            import lz4.frame

            return memoryview(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    except RuntimeError as error:
        raise Damaged(f"byte {where}: a chunk can't be decompressed ({error})") from None
    raise Damaged(f"byte {where}: a chunk is compressed with {compression!r}, which is not known here")


def _zstd(data: memoryview, most: int) -> bytes:
    import zstandard

    try:
        with zstandard.ZstdDecompressor(max_window_size=2**27).stream_reader(data) as stream:
            return stream.read(most)
    except zstandard.ZstdError as error:
        raise RuntimeError(str(error)) from None


def message_times(
    buffer: memoryview, chunk: ChunkIndexRecord, channel_id: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Log times and offsets inside the chunk of one channel's messages."""
    at = chunk.message_index_offsets[channel_id]
    if at:
        record = records.record_at(buffer, at)
        reader = Reader(buffer, record.body, record.end)
        if record.opcode != Opcode.MESSAGE_INDEX or reader.number(2) != channel_id:
            raise Damaged(f"byte {at}: no message index of channel {channel_id} where one belongs")
        listed = reader.raw()
        if len(listed) % 16:
            raise Damaged(f"byte {at}: a message index of {len(listed)} bytes")
        entries = np.frombuffer(listed, "<u8").reshape(-1, 2)
    else:
        content = open_chunk(buffer, chunk_record(buffer, chunk))
        found = [r for r in walk(content, 0, len(content)) if r.opcode == Opcode.MESSAGE]
        heads = [(message_head(content, r), r.start) for r in found]
        entries = np.array([(head[2], start) for head, start in heads if head[0] == channel_id], "<u8").reshape(-1, 2)
    if len(entries) and entries[:, 0].max() > np.iinfo(np.int64).max:
        raise Damaged("a message has a time beyond the year 2262")
    return entries[:, 0].astype(np.int64), entries[:, 1].astype(np.int64)


def chunk_record(buffer: memoryview, chunk: ChunkIndexRecord) -> Record:
    """The chunk that an index points to."""
    record = records.record_at(buffer, chunk.offset)
    if record.opcode != Opcode.CHUNK:
        raise Damaged(f"byte {chunk.offset}: no chunk where one belongs")
    return record
