"""What is in a log and where: from its summary where that can be had, otherwise from a walk over the whole file."""

from __future__ import annotations

import zlib
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode

from mcaptrack.log import records
from mcaptrack.log.chunks import Entries, chunk_entries, forget, message_head, open_chunk
from mcaptrack.log.records import (
    BLOCK,
    MAGIC,
    ChannelRecord,
    ChunkIndexRecord,
    Damaged,
    Reader,
    Record,
    SchemaRecord,
    walk,
)

FOOTER_SIZE: Final = 9 + records.FOOTER_BODY.size + len(MAGIC)
DATA_END_SIZE: Final = 9 + 4


class Listed(NamedTuple):
    """An attachment or metadata record: its name, where it starts, and its entry in the summary."""

    name: str
    offset: int
    entry: bytes


@dataclass
class Index:
    """The contents of a log. ``data_end`` is where the data section ends, ``data_crc`` its CRC if the file has one.

    ``regular`` logs have a summary that reading can rely on, and all their messages in indexed chunks. For other logs
    times and offsets of messages are kept here, by channel: offsets in the chunk, or in the file outside of chunks.
    """

    data_end: int = 0
    data_crc: int = 0
    regular: bool = False
    schemas: dict[int, SchemaRecord] = field(default_factory=dict)
    channels: dict[int, ChannelRecord] = field(default_factory=dict)
    chunks: list[ChunkIndexRecord] = field(default_factory=list)
    entries: dict[int, dict[int, Entries]] = field(default_factory=dict)  # of chunks at these offsets, where scanned
    loose: dict[int, Entries] = field(default_factory=dict)  # of messages outside of chunks
    counts: dict[int, int] = field(default_factory=dict)  # messages of each channel
    attachments: list[Listed] = field(default_factory=list)
    metadata: list[Listed] = field(default_factory=list)
    start_ns: int = 0
    end_ns: int = 0


def read_index(buffer: memoryview) -> Index:
    """The contents of the log in ``buffer``. Raises Damaged if it is none or is cut off."""
    if bytes(buffer[: len(MAGIC)]) != MAGIC:
        raise Damaged("it does not begin as an MCAP file does")
    if len(buffer) < 2 * len(MAGIC) or bytes(buffer[-len(MAGIC) :]) != MAGIC:
        raise Damaged("it is cut off: the end of an MCAP file is missing")
    return read_summary(buffer) or _from_scan(buffer)


def read_summary(buffer: memoryview) -> Index | None:
    """The contents as the summary has them; None where it lacks something that reading by index stands on."""
    at = len(buffer) - FOOTER_SIZE
    if at < len(MAGIC) or buffer[at] != Opcode.FOOTER:
        raise Damaged("it has no footer where one belongs")
    summary_start, _, summary_crc = records.FOOTER_BODY.unpack_from(buffer, at + 9)
    data_end = summary_start - DATA_END_SIZE
    if not len(MAGIC) <= data_end < at or buffer[data_end] != Opcode.DATA_END:
        return None
    if summary_crc and zlib.crc32(buffer[summary_start : len(buffer) - len(MAGIC) - 4]) != summary_crc:
        return None  # the data section says the same, with checksums of its own
    index, statistics = Index(data_end), None
    index.data_crc = Reader(buffer, data_end + 9, data_end + DATA_END_SIZE).number(4)
    for record in walk(buffer, summary_start, at):
        if record.opcode == Opcode.STATISTICS:
            statistics = record
        take(index, buffer, record)
    index.chunks.sort(key=lambda chunk: chunk.offset)
    index.regular = statistics is not None and _adds_up(index, Reader(buffer, statistics.body, statistics.end))
    return index if index.regular else None


def _adds_up(index: Index, statistics: Reader) -> bool:
    """Whether the summary describes all channels and lists all messages, and no part of the file twice."""
    statistics.skip(8)
    said = [statistics.number(size) for size in (2, 4, 4, 4, 4)]
    found = [len(part) for part in (index.schemas, index.channels, index.attachments, index.metadata, index.chunks)]
    known = {channel for chunk in index.chunks for channel in chunk.message_index_offsets}
    described = known <= set(index.channels) and all(
        c.schema_id in {0, *index.schemas} for c in index.channels.values()
    )
    # The length of the message indexes says how many messages they list; fewer than there are means that some stand
    # outside of chunks or were never indexed.
    listed = sum(c.message_index_length - 15 * len(c.message_index_offsets) for c in index.chunks)
    indexed = all(chunk.message_index_offsets for chunk in index.chunks) and listed == 16 * sum(index.counts.values())
    ends = [len(MAGIC), *(chunk.offset + chunk.length for chunk in index.chunks)]
    starts = [*(chunk.offset for chunk in index.chunks), index.data_end]
    apart = all(end <= start for end, start in zip(ends, starts, strict=True))
    return said == found and described and indexed and apart


def take(index: Index, buffer: memoryview, record: Record) -> None:
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
        offset = reader.number(8)
        reader.skip(8 * 4)
        index.attachments.append(Listed(reader.text(), offset, bytes(buffer[record.start : record.end])))
    elif record.opcode == Opcode.METADATA_INDEX:
        offset = reader.number(8)
        reader.skip(8)
        index.metadata.append(Listed(reader.text(), offset, bytes(buffer[record.start : record.end])))


def _from_scan(buffer: memoryview) -> Index:
    """The contents from every record of the file, chunks opened."""
    index = Index()
    loose: dict[int, array[int]] = {}
    done = crc = 0
    for record in walk(buffer, len(MAGIC), len(buffer) - len(MAGIC)):
        if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            take(index, buffer, record)  # those of the summary count too: some writers put them nowhere else
        elif record.opcode == Opcode.CHUNK:
            _scan_chunk(index, buffer, record)
        elif record.opcode == Opcode.MESSAGE:
            channel, _, t_ns, _ = message_head(buffer, record)
            loose.setdefault(channel, array("Q")).extend((t_ns, record.start))
        elif record.opcode == Opcode.ATTACHMENT:
            index.attachments.append(list_attachment(buffer, record, record.start))
        elif record.opcode == Opcode.METADATA:
            index.metadata.append(list_metadata(buffer, record, record.start))
        elif record.opcode == Opcode.DATA_END:
            index.data_end = record.start
            index.data_crc = Reader(buffer, record.body, record.end).number(4)
            if index.data_crc and index.data_crc != zlib.crc32(buffer[done : record.start], crc):
                raise Damaged("the checksum of its data section is wrong")
        if record.end - done >= BLOCK:
            crc = zlib.crc32(buffer[done : record.end], crc)
            forget(buffer, done, record.end)
            done = record.end
    index.loose = {channel: np.array(entries, "<u8").reshape(-1, 2) for channel, entries in loose.items()}
    _count(index, index.loose)
    missing = set(index.counts) - set(index.channels)
    if missing:
        raise Damaged(f"there are messages of channel {min(missing)}, which is not described anywhere")
    if index.data_end == 0:
        raise Damaged("its data section has no end")
    return index


def _count(index: Index, found: Mapping[int, Entries]) -> None:
    """Add messages to the numbers of each channel and to the span of time."""
    for channel, entries in found.items():
        first_ns, last_ns = int(entries[:, 0].min()), int(entries[:, 0].max())
        if not index.counts:
            index.start_ns, index.end_ns = first_ns, last_ns
        index.start_ns, index.end_ns = min(index.start_ns, first_ns), max(index.end_ns, last_ns)
        index.counts[channel] = index.counts.get(channel, 0) + len(entries)


def _scan_chunk(index: Index, buffer: memoryview, record: Record) -> None:
    head = records.read_chunk(buffer, record)
    content = open_chunk(buffer, record)
    for inner in walk(content, 0, len(content)):
        if inner.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            take(index, content, inner)
    entries = chunk_entries(content)
    _count(index, entries)
    index.entries[record.start] = entries
    index.chunks.append(
        ChunkIndexRecord(
            head.start_ns,
            head.end_ns,
            record.start,
            record.end - record.start,
            dict.fromkeys(entries, 0),  # there may be no message index; 0 says so
            0,
            head.compression,
            head.end - head.start,
            head.uncompressed_size,
        )
    )


def list_attachment(buffer: memoryview, record: Record, offset: int) -> Listed:
    """What indexes an attachment that stands at ``offset`` of a file."""
    log_ns, create_ns, name, media_type, data = records.read_attachment(buffer, record)
    numbers = (offset, record.end - record.start, log_ns, create_ns, len(data))
    packed = b"".join(records.number(value, 8) for value in numbers)
    index = records.pack(Opcode.ATTACHMENT_INDEX, packed, records.text(name), records.text(media_type))
    return Listed(name, offset, index)


def list_metadata(buffer: memoryview, record: Record, offset: int) -> Listed:
    """What indexes a metadata record that stands at ``offset`` of a file."""
    name = records.read_metadata(buffer, record)[0]
    packed = records.number(offset, 8) + records.number(record.end - record.start, 8)
    return Listed(name, offset, records.pack(Opcode.METADATA_INDEX, packed, records.text(name)))
