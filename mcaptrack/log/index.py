"""The index of a log: read from its summary, or from a scan of the whole file if the summary can't be used."""

from __future__ import annotations

import zlib
from array import array
from bisect import bisect_left
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain, pairwise
from operator import attrgetter
from typing import ClassVar, Final, NamedTuple, overload

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import ChunkIndex
from mcap.records import Schema as SchemaRecord
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.ragged import ragged_range
from mcaptrack.log import records
from mcaptrack.log.byte_source import ByteSource, RunningChecksum
from mcaptrack.log.chunks import Entries, message_head, open_chunk, scan_entries
from mcaptrack.log.records import MAGIC, Bytes, Damaged, Reader, Record, walk

FOOTER_SIZE: Final = 9 + records.FOOTER_BODY.size + len(MAGIC)
DATA_END_SIZE: Final = 9 + 4


class SummaryEntry(NamedTuple):
    """An attachment or metadata record: its name, its offset, and its entry in the summary."""

    name: str
    offset: int
    entry: bytes


# The index entries of all chunks as columns: 80 bytes a chunk, where objects take a kilobyte.
#
# Letters: C chunks.


#: The numbers of an entry in the order of their columns, and how many there are.
_NUMBERS: Final = (
    "message_start_time",
    "message_end_time",
    "chunk_start_offset",
    "chunk_length",
    "message_index_length",
    "compressed_size",
    "uncompressed_size",
)
_numbers_of: Final = attrgetter(*_NUMBERS)
_WIDTH: Final = len(_NUMBERS)
_START, _END, _OFFSET, _LENGTH, _INDEX_LENGTH = range(5)
#: So many entries of chunks are kept: all, but of very long logs.
_MOST_KEPT: Final = 4096


class ChunkList:
    """Index entries of chunks in the order in which they were added.

    ``at``, ``row_at`` and ``before`` need them in the order of the file, which ``sort_by_offset`` establishes.
    """

    def __init__(self, chunks: Iterable[ChunkIndex] = ()) -> None:
        self._numbers = array("Q")  # _WIDTH for each chunk
        self._compression = array("H")  # an index into _names
        self._names: list[str] = []
        self._ends = array("Q")  # for each chunk, the end of its channels in the following two
        self._channels = array("H")
        self._indexes = array("Q")  # offsets of message indexes
        #: Entries of chunks that were asked for last: each of their channels asks again.
        self._kept: dict[int, ChunkIndex] = {}
        self._by_channel: tuple[Ints, Ints] | None = None
        for chunk in chunks:
            self.append(chunk)

    def append(self, chunk: ChunkIndex) -> None:
        """Add an entry."""
        self._by_channel = None
        if chunk.compression not in self._names:
            self._names.append(chunk.compression)
        self._compression.append(self._names.index(chunk.compression))
        self._numbers.extend(_numbers_of(chunk))
        self._channels.extend(chunk.message_index_offsets)
        self._indexes.extend(chunk.message_index_offsets.values())
        self._ends.append(len(self._channels))

    def __len__(self) -> int:
        return len(self._ends)

    def __iter__(self) -> Iterator[ChunkIndex]:
        return map(self._entry, range(len(self)))

    @overload
    def __getitem__(self, row: int, /) -> ChunkIndex: ...

    @overload
    def __getitem__(self, row: slice, /) -> list[ChunkIndex]: ...

    def __getitem__(self, row: int | slice, /) -> ChunkIndex | list[ChunkIndex]:
        rows = range(len(self))[row]
        return self._entry(rows) if isinstance(rows, int) else list(map(self._entry, rows))

    def _entry(self, row: int) -> ChunkIndex:
        if (entry := self._kept.get(row)) is None:
            if len(self._kept) >= _MOST_KEPT:
                self._kept.pop(next(iter(self._kept)), None)
            entry = self._kept[row] = self._made(row)
        return entry

    def _made(self, row: int) -> ChunkIndex:
        low, high = self._ends[row - 1] if row else 0, self._ends[row]
        first, last, offset, length, index_length, stored, opened = self._numbers[row * _WIDTH : (row + 1) * _WIDTH]
        indexes = dict(zip(self._channels[low:high], self._indexes[low:high], strict=True))
        sizes = (self._names[self._compression[row]], stored, opened)
        return records.chunk_index((first, last), (offset, length), indexes, index_length, sizes)

    def __eq__(self, other: object) -> bool:
        """Whether the same entries follow in the same order."""
        if not isinstance(other, ChunkList):
            return NotImplemented
        return self._numbers == other._numbers and all(mine == two for mine, two in zip(self, other, strict=True))

    __hash__: ClassVar[None] = None  # type: ignore[assignment]

    def at(self, offset: int) -> ChunkIndex | None:
        """The entry of the chunk at an offset of the file; None if there is none."""
        row = self.row_at(offset)
        return None if row is None else self._entry(row)

    def row_at(self, offset: int) -> int | None:
        """The number of the entry of the chunk at an offset of the file; None if there is none."""
        row = bisect_left(range(len(self)), offset, key=lambda row: self._numbers[row * _WIDTH + _OFFSET])
        is_there = row < len(self) and self._numbers[row * _WIDTH + _OFFSET] == offset
        return row if is_there else None

    def rows_with(self, channels: Collection[int]) -> Ints:
        """The numbers of entries of chunks with messages of any of these channels, ascending."""
        order, rows = self._rows_by_channel()
        wanted = np.unique(np.fromiter(channels, np.int64))
        low, high = order.searchsorted(wanted, "left"), order.searchsorted(wanted, "right")
        return np.unique(rows[ragged_range(low, high - low)])

    def first_rows(self, channels: Collection[int]) -> dict[int, list[int]]:
        """Return the numbers of the first entries with messages of these channels, and for each its channels."""
        order, rows = self._rows_by_channel()
        out: dict[int, list[int]] = {}
        for channel in channels:
            at = int(order.searchsorted(channel))
            if at < len(order) and order[at] == channel:
                out.setdefault(int(rows[at]), []).append(channel)
        return out

    def _rows_by_channel(self) -> tuple[Ints, Ints]:
        """All channels of all entries, ascending, and the number of the entry of each, ascending within a channel."""
        if self._by_channel is None:
            listed = np.array(self._channels, np.int64)
            order = np.argsort(listed, kind="stable")
            ends = np.array(self._ends, np.int64)
            self._by_channel = listed[order], np.searchsorted(ends, order, "right")
        return self._by_channel

    def with_channels(self, channels: Collection[int]) -> Iterator[ChunkIndex]:
        """The entries of chunks with messages of any of these channels."""
        return map(self._entry, self.rows_with(channels).tolist())

    def before(self, offset: int) -> ChunkList:
        """The entries of chunks that begin before an offset; as ``at``, it needs them in the order of the file."""
        count = bisect_left(range(len(self)), offset, key=lambda row: self._numbers[row * _WIDTH + _OFFSET])
        members = self._ends[count - 1] if count else 0
        out = ChunkList()
        out._numbers, out._compression = self._numbers[: count * _WIDTH], self._compression[:count]
        out._ends, out._names = self._ends[:count], self._names.copy()
        out._channels, out._indexes = self._channels[:members], self._indexes[:members]
        return out

    def sort_by_offset(self) -> None:
        """Bring the entries into the order of the file."""
        order = np.argsort(self._column(_OFFSET), kind="stable")
        if (np.diff(order) != 1).any():
            self.__dict__ = ChunkList(map(self._entry, order.tolist())).__dict__

    # Columns

    @property
    def offsets(self) -> NDArray[np.uint64]:
        """The offsets of all chunks in the file, (C,)."""
        return self._column(_OFFSET)

    @property
    def ends(self) -> NDArray[np.uint64]:
        """The offsets behind all chunks and their message indexes, (C,)."""
        return self.offsets + self._column(_LENGTH) + self._column(_INDEX_LENGTH)

    @property
    def start_ns(self) -> NDArray[np.uint64]:
        """The time of the first message of each chunk, (C,)."""
        return self._column(_START)

    @property
    def end_ns(self) -> NDArray[np.uint64]:
        """The time of the last message of each chunk, (C,)."""
        return self._column(_END)

    @property
    def channels(self) -> set[int]:
        """The channels of all messages."""
        return set(self._channels)

    @property
    def are_all_indexed(self) -> bool:
        """Whether each chunk has a message index."""
        return all(low < high for low, high in pairwise(chain([0], self._ends)))

    @property
    def listed(self) -> int:
        """The number of messages in message indexes by the length of these, times 16."""
        return sum(self._numbers[_INDEX_LENGTH::_WIDTH]) - 15 * len(self._channels)

    def are_apart(self, start: int, end: int) -> bool:
        """Whether no two chunks overlap, and all lie between two offsets."""
        for offset, length in zip(self._numbers[_OFFSET::_WIDTH], self._numbers[_LENGTH::_WIDTH], strict=True):
            if offset < start:
                return False
            start = offset + length
        return start <= end

    def times(self) -> tuple[int, int] | None:
        """The first and the last time of chunks with messages; None if there are none."""
        full = np.diff(np.frombuffer(self._ends, np.uint64), prepend=np.uint64(0)) > 0
        if not full.any():
            return None
        return int(self._column(_START)[full].min()), int(self._column(_END)[full].max())

    def _column(self, number: int) -> NDArray[np.uint64]:
        """A copy of a column: an array can't grow while NumPy looks into it."""
        return np.frombuffer(self._numbers, np.uint64)[number::_WIDTH].copy()


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
                (at := chunk.chunk_start_offset) not in self.entries
                or _equal(self.entries[at][channel_id], other.entries[at][channel_id])
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
        records.chunk_index(
            (min(edges, default=head.start_ns), max(edges, default=head.end_ns)),  # the head of the chunk may be wrong
            (record.start, record.end - record.start),
            dict.fromkeys(entries, 0),  # 0: without message index
            0,
            (head.compression, head.end - head.start, head.uncompressed_size),
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
    name = records.read_metadata(buffer, record).name
    packed = records.number(offset, 8) + records.number(record.end - record.start, 8)
    return SummaryEntry(name, offset, records.pack(Opcode.METADATA_INDEX, packed, records.text(name)))
