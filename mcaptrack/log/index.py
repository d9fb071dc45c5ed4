"""The index of a log: read from its summary, or from a scan of the whole file if the summary can't be used."""

from __future__ import annotations

import zlib
from array import array
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.log import records
from mcaptrack.log.byte_source import ByteSource, RunningChecksum
from mcaptrack.log.chunk_list import ChunkList
from mcaptrack.log.chunks import Entries, message_head, open_chunk, scan_entries
from mcaptrack.log.records import (
    MAGIC,
    Bytes,
    ChannelRecord,
    ChunkIndexRecord,
    Damaged,
    Opcode,
    Reader,
    Record,
    SchemaRecord,
    walk,
)

FOOTER_SIZE: Final = 9 + records.FOOTER_BODY.size + len(MAGIC)
DATA_END_SIZE: Final = 9 + 4


class SummaryEntry(NamedTuple):
    """An attachment or metadata record: its name, its offset, and its entry in the summary."""

    name: str
    offset: int
    entry: bytes


@dataclass
class Index:
    """The contents of a log. ``data_end`` is the end of the data section, ``data_crc`` its CRC if the file has one.

    A ``regular`` log has a consistent summary, and all its messages are in indexed chunks. For other logs ``entries``
    and ``loose`` hold log time and offset of each message: offsets in the chunk, or in the file outside of chunks.
    """

    data_end: int = 0
    data_crc: int = 0
    regular: bool = False
    schemas: dict[int, SchemaRecord] = field(default_factory=dict)
    channels: dict[int, ChannelRecord] = field(default_factory=dict)
    chunks: ChunkList = field(default_factory=ChunkList)
    entries: dict[int, dict[int, Entries]] = field(
        default_factory=dict
    )  # by offset of the chunk and channel, for scanned chunks
    loose: dict[int, Entries] = field(default_factory=dict)  # by channel, of messages outside of chunks
    counts: dict[int, int] = field(default_factory=dict)  # number of messages by channel
    attachments: list[SummaryEntry] = field(default_factory=list)
    metadata: list[SummaryEntry] = field(default_factory=list)
    start_ns: int = 0
    end_ns: int = 0

    def has_same_channel(self, other: Index, channel_id: int) -> bool:
        """Whether a channel has the same index entries in another index."""
        for name in ("channels", "counts"):
            if getattr(self, name).get(channel_id) != getattr(other, name).get(channel_id):
                return False
        if not _equal(self.loose.get(channel_id), other.loose.get(channel_id)):
            return False
        channel = self.channels.get(channel_id)
        if channel and self.schemas.get(channel.schema_id) != other.schemas.get(channel.schema_id):
            return False
        rows = (index.chunks.rows_with([channel_id]) for index in (self, other))
        if len({len(those) for those in rows}) > 1:
            return False
        both = zip(*(index.chunks.with_channels([channel_id]) for index in (self, other)), strict=True)
        return all(
            chunk == theirs
            and (
                chunk.offset not in self.entries
                or _equal(self.entries[chunk.offset][channel_id], other.entries[chunk.offset][channel_id])
            )
            for chunk, theirs in both
        )

    def equals(self, other: Index) -> bool:
        """Whether another index is equal."""
        plain = ("data_end", "data_crc", "schemas", "channels", "chunks", "counts", "attachments", "metadata")
        if any(getattr(self, name) != getattr(other, name) for name in plain):
            return False
        ours, theirs = ({0: index.loose, **index.entries} for index in (self, other))
        return ours.keys() == theirs.keys() and all(
            ours[at].keys() == theirs[at].keys() and all(_equal(ours[at][n], theirs[at][n]) for n in ours[at])
            for at in ours
        )


def _equal(entries: Entries | None, other: Entries | None) -> bool:
    return entries is other or (entries is not None and other is not None and np.array_equal(entries, other))


def read_index(source: ByteSource) -> Index:
    """Read the index of a log. Raises Damaged if the file is not an MCAP file or is cut off."""
    if not starts_with_magic(source):
        raise Damaged("it does not begin as an MCAP file does")
    if not ends_with_magic(source):
        raise Damaged("it is cut off: the end of an MCAP file is missing")
    return read_summary(source) or _scan(source.sequential())


def starts_with_magic(buffer: Bytes) -> bool:
    """Whether the file begins with the magic bytes of MCAP."""
    return bytes(buffer[0 : len(MAGIC)]) == MAGIC


def ends_with_magic(buffer: Bytes) -> bool:
    """Whether the file ends with the magic bytes of MCAP, which are not the ones at its beginning."""
    return len(buffer) >= 2 * len(MAGIC) and bytes(buffer[len(buffer) - len(MAGIC) : len(buffer)]) == MAGIC


def read_footer(buffer: Bytes) -> tuple[int, int, int, int] | None:
    """Offset of the footer, start of the summary, start of the summary offsets, and their CRC.

    None if there is none.
    """
    at = len(buffer) - FOOTER_SIZE
    if at < len(MAGIC) or buffer[at] != Opcode.FOOTER:
        return None
    return at, *records.FOOTER_BODY.unpack(buffer[at + 9 : len(buffer) - len(MAGIC)])


def read_summary(buffer: Bytes) -> Index | None:
    """The index by the summary; None if the summary lacks something that reading by index needs."""
    footer = read_footer(buffer)
    if footer is None:
        raise Damaged("it has no footer at its end")
    at, summary_start, _, summary_crc = footer
    data_end = summary_start - DATA_END_SIZE
    if not len(MAGIC) <= data_end < at or buffer[data_end] != Opcode.DATA_END:
        return None
    index, statistics = Index(data_end), None
    index.data_crc = Reader(buffer, data_end + 9, data_end + DATA_END_SIZE).number(4)
    summary = buffer[summary_start : len(buffer) - len(MAGIC) - 4]
    if summary_crc and zlib.crc32(summary) != summary_crc:
        return None  # the scan gives the same, and the data section has its own checksums
    try:
        for record in walk(summary, 0, at - summary_start):
            if record.opcode == Opcode.STATISTICS:
                statistics = record
            add_summary_record(index, summary, record)
    except Damaged as error:
        raise error.moved(summary_start) from None
    index.chunks.sort_by_offset()
    index.regular = statistics is not None and _is_consistent(index, Reader(summary, statistics.body, statistics.end))
    return index if index.regular else None


def summary_start(buffer: Bytes) -> int:
    """The start of the summary according to the footer; 0 if there is none."""
    footer = read_footer(buffer) if ends_with_magic(buffer) else None
    return footer[1] if footer and len(MAGIC) < footer[1] <= footer[0] else 0


def read_intact_summary(buffer: Bytes, start: int) -> Index | None:
    """The summary of a damaged log, if it begins at ``start`` and its checksum is right; else None."""
    footer = read_footer(buffer)
    if footer is None or not len(MAGIC) < start <= footer[0]:
        return None
    at, _, _, crc = footer
    summary = buffer[start : len(buffer) - len(MAGIC) - 4]
    if not crc or zlib.crc32(summary) != crc:
        return None
    index = Index(start - DATA_END_SIZE)
    with suppress(Damaged):
        for record in walk(summary, 0, at - start):
            add_summary_record(index, summary, record)
        index.chunks.sort_by_offset()
        return index
    return None


def _is_consistent(index: Index, statistics: Reader) -> bool:
    """Whether the summary describes all channels and lists all messages, and no chunks overlap."""
    statistics.skip(8)
    declared = [statistics.number(size) for size in (2, 4, 4, 4, 4)]
    listed = [len(part) for part in (index.schemas, index.channels, index.attachments, index.metadata, index.chunks)]
    schemas = {0, *index.schemas}
    described = index.chunks.channels <= set(index.channels)
    described = described and all(c.schema_id in schemas for c in index.channels.values())
    # The number of index entries follows from the length of the message indexes. If it is less than the number of
    # messages, some are outside of chunks or were never indexed.
    indexed = index.chunks.are_all_indexed and index.chunks.listed == 16 * sum(index.counts.values())
    apart = index.chunks.are_apart(len(MAGIC), index.data_end)
    return declared == listed and described and indexed and apart


def add_summary_record(index: Index, buffer: Bytes, record: Record) -> None:
    """Add a summary record to the index."""
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
        index.attachments.append(SummaryEntry(reader.text(), offset, bytes(buffer[record.start : record.end])))
    elif record.opcode == Opcode.METADATA_INDEX:
        offset = reader.number(8)
        reader.skip(8)
        index.metadata.append(SummaryEntry(reader.text(), offset, bytes(buffer[record.start : record.end])))


def _scan(buffer: ByteSource) -> Index:
    """The index by reading every record of the file, chunks included."""
    index = Index()
    loose: dict[int, array[int]] = {}
    checksum = RunningChecksum(buffer)
    for record in walk(buffer, len(MAGIC), len(buffer) - len(MAGIC)):
        if record.opcode == Opcode.DATA_END:
            index.data_end = record.start
            index.data_crc = Reader(buffer, record.body, record.end).number(4)
            if index.data_crc and index.data_crc != checksum.up_to(record.start):
                raise Damaged("the checksum of its data section is wrong")
            continue
        checksum.advance(record.end)
        if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            add_summary_record(index, buffer, record)  # also those of the summary: some writers write them only there
        elif record.opcode == Opcode.CHUNK:
            _scan_chunk(index, buffer, record)
        elif record.opcode == Opcode.MESSAGE:
            channel, _, t_ns, _ = message_head(buffer, record)
            loose.setdefault(channel, array("Q")).extend((t_ns, record.start))
        elif record.opcode == Opcode.ATTACHMENT:
            index.attachments.append(attachment_entry(buffer, record, record.start))
        elif record.opcode == Opcode.METADATA:
            index.metadata.append(metadata_entry(buffer, record, record.start))
    index.loose = {channel: np.array(entries, "<u8").reshape(-1, 2) for channel, entries in loose.items()}
    count_messages(index, index.loose)
    missing = set(index.counts) - set(index.channels)
    if missing:
        raise Damaged(f"there are messages of channel {min(missing)}, which has no channel record")
    if index.data_end == 0:
        raise Damaged("its data section has no end")
    return index


def edges_of(entries_of: Mapping[int, Entries]) -> list[int]:
    """The first and the last time of the messages of each channel."""
    return [int(edge) for entries in entries_of.values() for edge in (entries[:, 0].min(), entries[:, 0].max())]


def count_messages(index: Index, entries_of: Mapping[int, Entries]) -> None:
    """Add messages to the counts by channel and to the time span."""
    for channel, entries in entries_of.items():
        first_ns, last_ns = int(entries[:, 0].min()), int(entries[:, 0].max())
        if not index.counts:
            index.start_ns, index.end_ns = first_ns, last_ns
        index.start_ns, index.end_ns = min(index.start_ns, first_ns), max(index.end_ns, last_ns)
        index.counts[channel] = index.counts.get(channel, 0) + len(entries)


def _scan_chunk(index: Index, buffer: Bytes, record: Record) -> None:
    head = records.read_chunk(buffer, record)
    content = open_chunk(buffer, record)
    for inner in walk(content, 0, len(content)):
        if inner.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            add_summary_record(index, content, inner)
    entries = scan_entries(content)
    count_messages(index, entries)
    index.entries[record.start] = entries
    edges = edges_of(entries)
    index.chunks.append(
        ChunkIndexRecord(
            min(edges, default=head.start_ns),  # the head of the chunk may be wrong
            max(edges, default=head.end_ns),
            record.start,
            record.end - record.start,
            dict.fromkeys(entries, 0),  # 0: without message index
            0,
            head.compression,
            head.end - head.start,
            head.uncompressed_size,
        )
    )


def attachment_entry(buffer: Bytes, record: Record, offset: int) -> SummaryEntry:
    """The summary entry of an attachment at ``offset`` of a file."""
    head = records.read_attachment(buffer, record)
    numbers = (offset, record.end - record.start, head.log_ns, head.create_ns, head.end - head.start)
    packed = b"".join(records.number(value, 8) for value in numbers)
    index = records.pack(Opcode.ATTACHMENT_INDEX, packed, records.text(head.name), records.text(head.media_type))
    return SummaryEntry(head.name, offset, index)


def metadata_entry(buffer: Bytes, record: Record, offset: int) -> SummaryEntry:
    """The summary entry of a metadata record at ``offset`` of a file."""
    name = records.read_metadata(buffer, record)[0]
    packed = records.number(offset, 8) + records.number(record.end - record.start, 8)
    return SummaryEntry(name, offset, records.pack(Opcode.METADATA_INDEX, packed, records.text(name)))
