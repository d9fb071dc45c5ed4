"""The messages of a channel in time order: located by index, read chunk by chunk, within a memory limit.

Letters: M messages.
"""

from __future__ import annotations

import hashlib
import heapq
import zlib
from array import array
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator, Sequence
from itertools import islice, repeat
from typing import Final, NamedTuple, TypeVar

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from mcap.records import Message as MessageRecord
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.ragged import gather_bytes, group_index, ragged_range, run_starts
from mcaptrack.log import records
from mcaptrack.log.byte_source import GAP_BYTES, ByteSource
from mcaptrack.log.chunks import (
    MAX_NS,
    Entries,
    checksum_at,
    chunk_record,
    is_left_in_file,
    message_head,
    message_heads_at,
    open_chunk_with_checksum,
    read_index_entries,
)
from mcaptrack.log.index import Index
from mcaptrack.log.records import (
    BLOCK,
    CHUNK_HEAD_BYTES,
    MESSAGE_HEAD,
    Bytes,
    Damaged,
    Record,
    crc_of,
    read_chunk,
    record_at,
)
from mcaptrack.schema import Rows, Schema
from mcaptrack.schema.encodings import RowReader

T = TypeVar("T")

#: Limit for open chunks in bytes; above it, overlapping chunks are closed and opened again later.
OPEN_BYTES: Final = 128 * 2**20
#: Limit for chunks that stay open for the other channels in them, in bytes.
_KEPT_BYTES: Final = 8 * 2**20
#: Limit for locations of messages that are kept, 16 bytes each.
_KEPT_MESSAGES: Final = 4 * 2**20
#: Messages outside of chunks are read one by one if their average distance in the file is larger.
_MAX_GAP_BYTES: Final = 16 * 2**10
#: Payloads come in batches of this many bytes at least: fewer make each step for few messages, more exceed the caches.
_BATCH_BYTES: Final = 4 * 2**20
#: Longer messages, on average, are not packed if they need not wait.
_LONG_BYTES: Final = 2048
#: Chunks are read together until they have so many bytes; of a batch, where nothing else is read.
_WINDOW_BYTES: Final = 16 * 2**20
#: Payloads of all topics together wait for others of their batch in so many bytes at most.
_WAITING_BYTES: Final = 64 * 2**20
#: Chunks in a store that are smaller together are read with their indexes, others after them. Indexes that are nearer
#: to each other come in one request.
_READ_AT_ONCE_BYTES: Final = 16 * 2**20
_MIN_GAP_BYTES: Final = 64 * 2**10


class Message(NamedTuple):
    """A recorded message; times in nanoseconds.

    ``t_ns`` is the log time and ``publish_ns`` the publish time; ``sequence`` is its number.
    """

    t_ns: int
    sequence: int
    publish_ns: int
    payload: bytes


class ChannelRows(NamedTuple):
    """All rows of a channel in time order, and for each message its time, sequence number and number of rows, (M,)."""

    rows: Rows
    t_ns: Ints
    sequence: Ints
    counts: Ints


class Payloads(NamedTuple):
    """Messages in time order, (M,): times in ns, bytes (``data`` from ``start`` to before ``end``), and locations as in
    ``MessageLocations``. ``start`` is -1 for messages in damaged chunks.
    """

    t_ns: Ints
    data: NDArray[np.uint8]
    start: Ints
    end: Ints
    chunk_offset: Ints
    offset: Ints


class MessageLocations(NamedTuple):
    """The locations of a channel's messages in time order, (M,): chunk in the file, message in the uncompressed chunk.

    Outside of chunks ``chunk_offset`` is -1 and ``offset`` is an offset in the file.
    """

    t_ns: Ints
    chunk_offset: Ints
    offset: Ints


# Fingerprints of logs and channels, made of index records and checksums instead of messages.


class Checksums:
    """The checksums of chunks by their number, as far as they are known, (C,); digests of those without a checksum."""

    def __init__(self) -> None:
        self._numbers: Ints = np.empty(0, np.int64)
        self._digests: dict[int, str] = {}

    def of(self, buffer: Bytes, index: Index, row: int) -> int | str:
        """The checksum of a chunk, which is read once."""
        if not len(self._numbers):
            self._numbers = np.full(len(index.chunks), -1)
        checksum = int(self._numbers[row])
        if checksum > 0:
            return checksum
        if checksum < 0:
            chunk = index.chunks[row]
            head = records.read_chunk(buffer, chunk_record(buffer, chunk))
            self._numbers[row] = head.uncompressed_crc
            if head.uncompressed_crc:
                return head.uncompressed_crc
            whole = hashlib.sha256()
            _take(whole, buffer, head.start, head.end)
            self._digests[row] = whole.hexdigest()
        return self._digests[row]


def fingerprint(buffer: Bytes, index: Index, channel_id: int | None = None, checksums: Checksums | None = None) -> str:
    """SHA-256 of a channel, or of the whole log: of schemas, channels, and the times and checksum of each chunk.

    Chunks and attachments without checksum, and messages outside of chunks, are hashed themselves. ``checksums`` keeps
    those of chunks for further calls with the same ``buffer`` and ``index``.
    """
    checksums = checksums or Checksums()
    total = hashlib.sha256()

    def say(*values: object) -> None:
        total.update(repr(values).encode())

    for number in sorted(index.channels) if channel_id is None else [channel_id]:
        channel = index.channels[number]
        schema = index.schemas.get(channel.schema_id)
        described = (schema.name, schema.encoding, hashlib.sha256(schema.data).hexdigest()) if schema else ()
        kept = sorted(channel.metadata.items())
        say(channel.topic, channel.message_encoding, kept, described, index.counts.get(number, 0))
    rows = range(len(index.chunks)) if channel_id is None else index.chunks.rows_with([channel_id]).tolist()
    for row in rows:
        chunk = index.chunks[row]
        # Offsets of chunks matter for the whole log, because they locate its messages, but not for one channel.
        place = (chunk.chunk_start_offset, *sorted(chunk.message_index_offsets)) if channel_id is None else ()
        span = (chunk.message_start_time, chunk.message_end_time)
        say(place, *span, chunk.uncompressed_size, checksums.of(buffer, index, row))
    for number in sorted(index.loose) if channel_id is None else [channel_id]:
        for offset in index.loose[number][:, 1].tolist() if number in index.loose else []:
            record = record_at(buffer, offset)
            _take(total, buffer, record.start, record.end)
    if channel_id is None:
        for listed in index.metadata:
            record = record_at(buffer, listed.offset)
            _take(total, buffer, record.start, record.end)
        for listed in index.attachments:
            record = record_at(buffer, listed.offset)
            checksum = bytes(buffer[record.end - 4 : record.end])
            say(listed.name, listed.offset, record.end - record.start, checksum)
            if checksum == bytes(4):
                _take(total, buffer, record.start, record.end)
    return total.hexdigest()


def _take(total: hashlib._Hash, buffer: Bytes, start: int, end: int) -> None:
    for at in range(start, end, BLOCK):
        total.update(buffer[at : min(at + BLOCK, end)])


def _in_order_of_time(channel: ChannelRows) -> ChannelRows:
    """Put messages, and their rows, in the order of their times."""
    rows, t_ns, sequence, counts = channel
    order = np.argsort(t_ns, kind="stable")
    if (np.diff(order) != 1).any():
        rows = rows[ragged_range((np.cumsum(counts) - counts)[order], counts[order])]
    return ChannelRows(rows, t_ns[order], sequence[order], counts[order])


# Where the messages of channels are, in batches that are read together; held as columns, 16 bytes a message.
#
# Letters: M messages, B batches.


Times = NDArray[np.uint64]
Span = tuple[int | None, int | None]
Lose = Callable[[int, int, Damaged], None]

_NO_ENTRIES: Final[Entries] = np.empty((0, 2), "<u8")
_OUTSIDE: Final = -1


class TimeOutOfRange(Exception):
    """``count`` messages of a channel are later than ``MAX_NS``, the first of them at ``t_ns``."""

    def __init__(self, count: int, t_ns: int) -> None:
        super().__init__(count, t_ns)
        self.count, self.t_ns = count, t_ns


class MessageBatch(NamedTuple):
    """Messages that are read together, in time order, (M,) each: of one chunk, or near each other in the file.

    ``channel`` is that of all messages, or of each, (M,).
    ``is_direct``: the messages are read from the file itself, because they are outside of chunks or in an uncompressed
    chunk that is too large for memory.
    """

    channel: int | NDArray[np.uint16]
    chunk: ChunkIndex | None
    is_direct: bool
    t_ns: Times
    offset: Ints

    @property
    def place(self) -> int:
        """Where it is read in the file."""
        return int(self.offset[0]) if self.chunk is None else int(self.chunk.chunk_start_offset)

    @property
    def size(self) -> int:
        """The memory in bytes that the open batch takes."""
        if self.chunk is not None and not self.is_direct:
            return self.chunk.uncompressed_size
        return int(self.offset.max() - self.offset.min()) if len(self.offset) else 0


class MessageBatches:
    """The batches of channels that have messages in a span of times, in the order of channels, chunks and the file.

    Raises Damaged if the message indexes contradict the index of the log.
    """

    def __init__(self, source: ByteSource, index: Index, channels: Sequence[int], span: Span) -> None:
        self._index, self._span = index, span
        self._found = array("Q"), array("Q")  # log times and offsets of all messages
        self._ends = array("Q", [0])
        self._chunk = array("q")  # the number of the chunk of each batch
        self._channel, self._direct = array("H"), array("B")
        for channel in channels:
            self._locate(source, channel)
        self.t_ns, self._offset = (np.frombuffer(column, np.uint64) for column in self._found)
        self.edges = np.frombuffer(self._ends, np.uint64).astype(np.int64)  # (B + 1,)

    def _locate(self, source: ByteSource, channel_id: int) -> None:
        """Add the batches of a channel in the chunks that overlap the span."""
        index, (first, last), listed = self._index, self._span, 0
        for row in index.chunks.rows_with([channel_id]).tolist():
            chunk = index.chunks[row]
            if not overlaps(chunk, self._span):
                continue
            if at := chunk.message_index_offsets[channel_id]:
                entries = read_index_entries(source, at, channel_id)
            else:
                entries = index.entries[chunk.chunk_start_offset][channel_id]
            listed += len(entries)
            if is_left_in_file(chunk.compression, chunk.compressed_size):
                self._add_pieces(channel_id, row, entries)
            else:
                self._add(channel_id, row, False, entries)
        loose = index.loose.get(channel_id, _NO_ENTRIES)
        self._add_pieces(channel_id, _OUTSIDE, loose)
        listed += len(loose)
        declared = index.counts.get(channel_id, 0)
        if first is None and last is None and listed != declared:
            raise Damaged(f"its indexes list {listed} messages of channel {channel_id}, and there are {declared}")

    def _add(self, channel_id: int, row: int, is_direct: bool, entries: Entries) -> None:
        first, last = self._span
        t_ns, offset = entries.astype(np.uint64).T
        if first is not None or last is not None:
            inside = np.ones(len(t_ns), bool) if first is None or first <= 0 else t_ns >= first
            if last is not None:
                inside &= t_ns < max(last, 0)
            t_ns, offset = t_ns[inside], offset[inside]
        order = np.argsort(t_ns, kind="stable") if len(t_ns) > 1 else slice(None)
        for column, values in zip(self._found, (t_ns, offset), strict=True):
            column.frombytes(values[order].tobytes())
        self._ends.append(len(self._found[0]))
        self._chunk.append(row)
        self._channel.append(channel_id)
        self._direct.append(is_direct)

    def _add_pieces(self, channel_id: int, row: int, entries: Entries) -> None:
        """Add messages that are read from the file itself, as batches of nearby ones."""
        if not len(entries):
            return
        in_file = entries[np.argsort(entries[:, 1], kind="stable")]
        starts = np.flatnonzero(run_starts(in_file[:, 1] // BLOCK))
        for piece in np.split(in_file, starts[1:]):
            self._add(channel_id, row, True, piece)

    def __len__(self) -> int:
        return len(self._chunk)

    def __getitem__(self, number: int) -> MessageBatch:
        low, high = self.edges[number], self.edges[number + 1]
        row = self._chunk[number]
        chunk = None if row == _OUTSIDE else self._index.chunks[row]
        part = slice(low, high)
        return MessageBatch(
            self._channel[number],
            chunk,
            bool(self._direct[number]),
            self.t_ns[part],
            self._offset[part].astype(np.int64),
        )

    def __iter__(self) -> Iterator[MessageBatch]:
        return map(self.__getitem__, range(len(self)))

    @property
    def times(self) -> Ints:
        """The times of all messages, (M,) ns. Raises TimeOutOfRange if one doesn't fit into int64."""
        return to_int64(self.t_ns)

    @property
    def offset(self) -> Ints:
        """The offsets of all messages in their uncompressed chunks, (M,); outside of chunks those in the file."""
        return self._offset.astype(np.int64)

    @property
    def batch(self) -> Ints:
        """The number of each message's batch, (M,)."""
        return group_index(np.diff(self.edges))

    @property
    def chunk_offset(self) -> Ints:
        """The offset of each message's chunk in the file, (M,); -1 outside of chunks."""
        rows = np.frombuffer(self._chunk, np.int64)
        offsets = np.append(self._index.chunks.offsets.astype(np.int64), -1)  # the last one is that of _OUTSIDE
        return np.repeat(offsets[rows], np.diff(self.edges))

    def in_order(self) -> Iterator[list[MessageBatch]]:
        """Batches in groups that follow one another in time; batches of one group overlap, and keep their order."""
        group: list[int] = []
        last = (-1, -1)  # time and number of the last message and batch so far
        for number, first, until in zip(*(values.tolist() for values in self._spans()), strict=True):
            if group and (first, number) > last:
                yield [self[member] for member in sorted(group)]
                group = []
            group.append(number)
            last = max(last, (until, max(group)))
        if group:
            yield [self[member] for member in sorted(group)]

    def apart(self) -> list[list[int]]:
        """The numbers of batches in groups: all messages of a group are earlier than those of the next."""
        numbers, first_ns, last_ns = self._spans()
        starts = 1 + np.flatnonzero(first_ns[1:] > np.maximum.accumulate(last_ns)[:-1])
        return [group.tolist() for group in np.split(numbers, starts) if len(group)]

    def _spans(self) -> tuple[Ints, Times, Times]:
        """The numbers of batches that are not empty, and their first and last times, in the order of the first."""
        numbers = np.flatnonzero(np.diff(self.edges))
        first_ns, last_ns = self.t_ns[self.edges[numbers]], self.t_ns[self.edges[numbers + 1] - 1]
        order = np.argsort(first_ns, kind="stable")
        return numbers[order], first_ns[order], last_ns[order]


def joined_by_chunk(batches: Sequence[MessageBatch], *, reverse: bool) -> tuple[list[MessageBatch], Ints]:
    """Batches of several channels as one for each chunk, and the batch of each message in the order of time, (M,).

    Messages of equal time are in the order of the file. ``reverse`` gives the reverse of all of that.
    """
    counts = [len(batch.t_ns) for batch in batches]
    channel = np.repeat(np.array([batch.channel for batch in batches], np.uint16), counts)
    t_ns = np.concatenate([batch.t_ns for batch in batches])
    offset = np.concatenate([batch.offset for batch in batches])
    chunk = np.repeat([-1 if batch.chunk is None else batch.chunk.chunk_start_offset for batch in batches], counts)
    in_order = np.lexsort((offset, np.where(chunk < 0, offset, chunk), t_ns))[:: -1 if reverse else 1]
    firsts: dict[int, int] = {}  # by chunk the first of its batches; what is read from the file stays as it is
    joined = [
        number if batch.chunk is None or batch.is_direct else firsts.setdefault(batch.chunk.chunk_start_offset, number)
        for number, batch in enumerate(batches)
    ]
    numbers, of_batches = np.unique(joined, return_inverse=True)
    of = np.repeat(of_batches, counts)[in_order]
    parts = np.split(in_order[np.argsort(of, kind="stable")], np.cumsum(np.bincount(of))[:-1])
    return [
        batches[number]._replace(channel=channel[part], t_ns=t_ns[part], offset=offset[part])
        for number, part in zip(numbers.tolist(), parts, strict=True)
    ], of


def _packed(parts: Sequence[Payloads]) -> Payloads:
    """Payloads behind each other in a buffer of their own, without the bytes of other channels.

    Messages begin 4 bytes behind multiples of 8, so that the numbers behind the head of a CDR message are aligned.
    """

    def joined(name: str) -> Ints:
        return np.concatenate([getattr(part, name) for part in parts])

    before = joined("start")
    sizes = np.where(before < 0, 0, joined("end") - before)
    slots = (sizes + 4 + 7) // 8 * 8
    start = np.cumsum(slots) - slots + 4
    data, low = np.empty(int(slots.sum()), np.uint8), 0
    for part in parts:
        high = low + len(part.t_ns)
        place = int(start[low]) - 4 if high > low else 0
        if high > low and np.array_equal(part.start, start[low:high] - place):  # it is packed
            data[place : place + len(part.data)] = part.data
        else:
            gather_bytes(part.data, np.maximum(part.start, 0), sizes[low:high], start[low:high], data)
        low = high
    places = joined("chunk_offset"), joined("offset")
    return Payloads(joined("t_ns"), data, np.where(before < 0, -1, start), start + sizes, *places)


def _batch(parts: Sequence[Payloads]) -> Payloads:
    return parts[0] if len(parts) == 1 else _packed(parts)


class _Window:
    """Batches of several topics in some chunks, of which the bytes stand behind each other.

    ``places`` says where the bytes of each chunk begin.
    """

    def __init__(self) -> None:
        self.blocks: list[NDArray[np.uint8]] = []
        self.size, self.places = 0, dict[int | None, int]()
        self._batches: dict[int, list[tuple[MessageBatch, Ints | None]]] = {}

    def add(self, number: int, batch: MessageBatch, at: Ints | None) -> None:
        """Add a batch of a topic, and where its messages begin (M,); None if they are lost."""
        self._batches.setdefault(number, []).append((batch, at))

    def topics(self, lose: Lose | None) -> Iterator[tuple[int, Payloads]]:
        """The messages of each topic. Without ``lose``, raises Damaged where the index names a message that is none."""
        data = self.blocks[0] if len(self.blocks) == 1 else np.concatenate([np.empty(0, np.uint8), *self.blocks])
        for number, batches in self._batches.items():
            try:
                part = _located_in(data, batches)
            except Damaged:
                if lose is None:
                    raise
                part = _located_in(data, [(batch, _checked(data, number, batch, at, lose)) for batch, at in batches])
            size = int((part.end - part.start).sum())
            is_long = size >= max(_BATCH_BYTES, _LONG_BYTES * len(part.start))  # they don't wait, and are far apart
            if 2 * size < len(data) and not is_long:  # what waits holds no bytes of others
                part = _packed([part])
            yield number, part


def _checked(data: NDArray[np.uint8], number: int, batch: MessageBatch, at: Ints | None, lose: Lose) -> Ints | None:
    """Where the messages of a batch begin; None, if they are no messages, which are lost then."""
    try:
        _located_in(data, [(batch, at)])
    except Damaged as error:
        lose(number, len(batch.t_ns), error)
        return None
    return at


def _located_in(data: NDArray[np.uint8], batches: Sequence[tuple[MessageBatch, Ints | None]]) -> Payloads:
    """The messages of batches of a topic in the order of time. Raises Damaged if one is none."""
    counts = [len(batch.t_ns) for batch, _ in batches]
    channel = np.repeat([batch.channel for batch, _ in batches], counts).astype(np.uint16)
    times = np.concatenate([batch.t_ns for batch, _ in batches])
    at = np.concatenate([np.full(len(b.t_ns), -1) if places is None else places for b, places in batches])
    chunk = [_OUTSIDE if batch.chunk is None else batch.chunk.chunk_start_offset for batch, _ in batches]
    start, end, good = np.full(len(at), -1), np.zeros(len(at), np.int64), np.flatnonzero(at >= 0)
    if len(good):
        heads = message_heads_at(data.data, channel[good], times[good], at[good])
        start[good], end[good] = heads.start, heads.end
    t_ns = to_int64(times)
    order = np.argsort(t_ns, kind="stable")
    offset = np.concatenate([batch.offset for batch, _ in batches])
    columns = (values[order] for values in (start, end, np.repeat(chunk, counts), offset))
    return Payloads(t_ns[order], data, *columns)


def overlaps(chunk: ChunkIndex, span: Span) -> bool:
    """Whether a chunk may have messages in a span of times."""
    first, last = span
    return (first is None or chunk.message_end_time >= first) and (last is None or chunk.message_start_time < last)


def to_int64(t_ns: Times) -> Ints:
    """Times as int64, as all arithmetic needs them. Raises TimeOutOfRange if one doesn't fit."""
    late = t_ns[t_ns > np.uint64(MAX_NS)]
    if len(late):
        raise TimeOutOfRange(len(late), int(late.min()))
    return t_ns.astype(np.int64)


class Messages:
    """The messages of a log. All methods raise Damaged where the bytes contradict the index.

    Channels are given by id; the messages of several channels are read as if they were of one.
    """

    def __init__(self, source: ByteSource, index: Index) -> None:
        self.source: ByteSource = source
        self.index: Index = index
        self._opened: OrderedDict[int, Bytes] = OrderedDict()  # the last chunks that were opened, for other channels
        self._opened_bytes = 0
        self._asked: OrderedDict[tuple[tuple[int, ...], Span], MessageBatches] = OrderedDict()
        # Checksums of what was read, to detect changes: of chunks by number (-1: not read), of pieces by start with
        # their end.
        self._chunks = array("q")
        self._pieces: dict[int, tuple[int, int]] = {}
        self._fingerprints: dict[int | None, str] = {}
        self._checksums = Checksums()

    def times(self, channels: Sequence[int], span: Span = (None, None)) -> Ints:
        """The sorted times of messages, (M,)."""
        return np.sort(self._located(channels, span, are_read=False).times)

    def places(self, channels: Sequence[int]) -> MessageLocations:
        """The locations of messages, in the order of ``by_time``."""
        batches = self._located(channels, (None, None), are_read=False)
        t_ns = batches.times
        order = np.argsort(t_ns, kind="stable")
        return MessageLocations(t_ns[order], batches.chunk_offset[order], batches.offset[order])

    def at(self, chunk_offset: int | None, offset: int) -> tuple[int, Message]:
        """The message at a location, and the id of its channel."""
        content: Bytes = self.source
        if chunk_offset is not None:
            chunk = self.index.chunks.at(chunk_offset)
            if chunk is None:
                raise Damaged(f"no chunk begins at byte {chunk_offset}")
            content = self._content(chunk)
        record = record_at(content, offset)
        if record.opcode != Opcode.MESSAGE:
            raise Damaged(f"there is no message at byte {offset} of the chunk at {chunk_offset}")
        whole = memoryview(bytes(content[record.start : record.end]))
        if chunk_offset is None:
            self._remember(record.start, whole)
        head = Record(record.opcode, 0, record.body - record.start, len(whole))
        channel, sequence, t_ns, publish_ns = message_head(whole, head)
        return channel, Message(t_ns, sequence, publish_ns, bytes(whole[head.body + MESSAGE_HEAD.size :]))

    def by_time(self, channels: Sequence[int], span: Span = (None, None)) -> Iterator[Message]:
        """Messages in time order; those of equal time by channel, then in file order.

        ``span`` is a half-open interval of times.
        """
        batches = self._located(channels, span)
        in_order = batches.batch[np.argsort(batches.t_ns, kind="stable")]
        return self._interleaved(batches, in_order, self._read)

    def records(
        self, channels: Sequence[int], span: Span = (None, None), *, reverse: bool = False, first_id: int = 0
    ) -> Iterator[MessageRecord]:
        """Message records in time order; those of equal time in file order.

        ``first_id`` is added to the ids of channels, so that channels of two files have different ones.
        """
        batches = self._located(channels, span)

        def read(batch: MessageBatch, skip: int) -> Iterator[MessageRecord]:
            head, payloads = self._parsed(batch, skip)
            ids = (head["channel"].astype(np.int64) + first_id).tolist()
            return map(
                MessageRecord,
                ids,
                head["t_ns"].tolist(),
                payloads,
                head["publish_ns"].tolist(),
                head["sequence"].tolist(),
            )

        groups = batches.apart()
        for numbers in reversed(groups) if reverse else groups:
            yield from self._interleaved(*joined_by_chunk([batches[n] for n in numbers], reverse=reverse), read)

    def before(self, channel_id: int, t_ns: int) -> Iterator[Message]:
        """The messages of a channel before a time, the latest first. Little more is read than what is taken."""
        starts = np.unique(self.index.chunks.start_ns[self.index.chunks.rows_with([channel_id])]).tolist()
        starts = [0, *(start for start in starts if 0 < start < t_ns)]
        until, step = t_ns, 1
        while until > 0:
            since = starts[-min(step, len(starts))]
            for message in self.records([channel_id], (since, until), reverse=True):
                yield Message(message.log_time, message.sequence, message.publish_time, message.data)
            until, step = since, 2 * step

    def _interleaved(
        self,
        batches: MessageBatches | Sequence[MessageBatch],
        in_order: Ints,
        read: Callable[[MessageBatch, int], Iterator[T]],
    ) -> Iterator[T]:
        """The messages of batches, each time the next one of the batch that ``in_order`` names, (M,).

        ``read`` gives those of a batch but the first few. Chunks stay open while they have messages to come, within the
        limit ``OPEN_BYTES``.
        """
        if not len(in_order):
            return
        # Chunks rarely overlap: consecutive messages of one chunk are yielded together.
        starts = np.append(np.flatnonzero(run_starts(in_order)), len(in_order))
        opened: OrderedDict[int, Iterator[T]] = OrderedDict()
        taken = array("Q", bytes(8 * len(batches)))
        size = 0
        for number, run in zip(in_order[starts[:-1]].tolist(), np.diff(starts).tolist(), strict=True):
            batch = batches[number]
            if number not in opened:
                size += batch.size
                while size > OPEN_BYTES and opened:
                    size -= batches[opened.popitem(last=False)[0]].size
                opened[number] = read(batch, taken[number])
            opened.move_to_end(number)
            yield from islice(opened[number], run)
            taken[number] += run
            if taken[number] == len(batch.t_ns):
                del opened[number]
                size -= batch.size

    def payloads(
        self, topics: Sequence[Sequence[int]], span: Span = (None, None), lose: Lose | None = None
    ) -> Iterator[tuple[int, Payloads]]:
        """The bytes of messages of several topics in batches, with the number of the topic; ``topics`` are the ids of
        their channels. The batches of each topic are in time order.

        Each chunk is opened once for all topics, if chunks hardly overlap. ``lose`` is called for messages that are
        lost with a damaged chunk, with the number of the topic, that of messages, and the damage; without it, Damaged
        is raised.
        """
        located = self._located_each(topics, span)
        streams = [zip(repeat(number), batches.in_order(), strict=False) for number, batches in enumerate(located)]
        waiting: dict[int, list[Payloads]] = {}
        held: Counter[int] = Counter()
        total = 0
        most = min(_BATCH_BYTES, _WINDOW_BYTES) if len(topics) == 1 else _WINDOW_BYTES
        window = _Window()

        def batches() -> Iterator[tuple[int, Payloads]]:
            nonlocal total
            for number, part in window.topics(lose):
                waiting.setdefault(number, []).append(part)
                held[number] += len(part.data)
                total += len(part.data)
                while total >= _WAITING_BYTES or held[number] >= _BATCH_BYTES:
                    largest = number if held[number] >= _BATCH_BYTES else max(held, key=held.__getitem__)
                    yield largest, _batch(waiting.pop(largest))
                    total -= held.pop(largest)

        for number, group in heapq.merge(*streams, key=lambda numbered: numbered[1][0].place):
            for batch in group:
                self._take(window, number, batch, lose)
            if window.size >= most:
                yield from batches()
                window = _Window()
        yield from batches()
        for number, parts in waiting.items():
            yield number, _batch(parts)

    def _take(self, window: _Window, number: int, batch: MessageBatch, lose: Lose | None) -> None:
        """Open the bytes of a batch, and add it to the window."""
        place = batch.place if batch.chunk is not None and not batch.is_direct else None
        if place in window.places:
            window.add(number, batch, batch.offset + window.places[place])
            return
        try:
            content, offset = self._open(batch)
        except Damaged as error:
            if lose is None:
                raise
            lose(number, len(batch.t_ns), error)
            window.add(number, batch, None)
            return
        if place is not None:
            window.places[place] = window.size
        window.add(number, batch, offset + window.size)
        window.blocks.append(np.frombuffer(content, np.uint8))
        window.size += len(content)

    def columns(self, channels: Sequence[int], schema: Schema, reader: RowReader) -> ChannelRows | None:
        """Rows without a loop over messages; None if a message has another layout than the reader's."""
        batches = self._located(channels, (None, None))
        t_ns = batches.times
        sequence, counts = np.empty_like(t_ns), np.empty_like(t_ns)
        rows, done, taken = schema.empty(), 0, 0
        for batch in batches:
            decoded = self._decoded(batch, reader)
            if decoded is None:
                return None
            part, until = decoded[0], done + len(batch.t_ns)
            sequence[done:until], counts[done:until] = decoded[1:]
            if taken + len(part) > len(rows):  # room for the rest, if it has as many rows a message as so far
                share = (len(t_ns) - done) / max(until - done, 1)
                rows = schema.codec.longer(rows, taken, taken + int(len(part) * share * 1.02) + 1)
            schema.codec.put(rows, taken, part)
            done, taken = until, taken + len(part)
        out = _in_order_of_time(ChannelRows(rows[:taken], t_ns, sequence, counts))
        out.rows.flags.writeable = False
        return out

    def parts(self, channels: Sequence[int], schema: Schema, reader: RowReader) -> Iterator[ChannelRows | None]:
        """Yield the rows that ``columns`` returns, chunk by chunk; None where a message has another layout."""
        for group in self._located(channels, (None, None)).in_order():
            t_ns = to_int64(np.concatenate([batch.t_ns for batch in group]))
            decoded = [part for batch in group if (part := self._decoded(batch, reader)) is not None]
            if len(decoded) < len(group):
                yield None
                return
            rows, sequence, counts = zip(*decoded, strict=True)
            members = schema.joined(rows)
            yield _in_order_of_time(ChannelRows(members, t_ns, np.concatenate(sequence), np.concatenate(counts)))

    def _decoded(self, batch: MessageBatch, reader: RowReader) -> tuple[Rows, Ints, Ints] | None:
        """The rows of a batch, and sequence number and number of rows of each message; None for another layout."""
        content, offset = self._open(batch)
        heads = message_heads_at(content, batch.channel, batch.t_ns, offset)
        decoded = reader.decode_at(np.frombuffer(content, np.uint8), heads.start, heads.end)
        return None if decoded is None else (decoded[0], heads.head["sequence"].astype(np.int64), decoded[1])

    def fingerprint(self, channel_id: int | None = None) -> str:
        """The fingerprint of a channel, or of the whole log; computed once."""
        if channel_id not in self._fingerprints:
            if self.source.is_remote:
                chunks = self.index.chunks
                rows = slice(None) if channel_id is None else chunks.rows_with([channel_id])
                self.source.expect([(at, at + CHUNK_HEAD_BYTES) for at in chunks.offsets[rows].tolist()])
            self._fingerprints[channel_id] = fingerprint(self.source, self.index, channel_id, self._checksums)
        return self._fingerprints[channel_id]

    def are_unchanged_in(self, source: ByteSource) -> bool:
        """Whether everything that was read so far is unchanged in ``source``."""
        pieces = all(crc_of(source, start, end) == crc for start, (end, crc) in self._pieces.items())
        return pieces and all(
            checksum_at(source, int(offset)) == crc
            for offset, crc in zip(self.index.chunks.offsets, self._chunks, strict=False)
            if crc >= 0
        )

    def _located(self, channels: Sequence[int], span: Span, *, are_read: bool = True) -> MessageBatches:
        """The batches of channels."""
        (batches,) = self._located_each([channels], span, are_read=are_read)
        return batches

    def _located_each(
        self, topics: Sequence[Sequence[int]], span: Span, *, are_read: bool = True
    ) -> list[MessageBatches]:
        """The batches of several topics. A store learns what will be read of them: their indexes, and if they
        ``are_read`` their chunks.
        """
        if not self.source.is_remote:
            return [self._batches(channels, span) for channels in topics]
        indexes, wholes = [], []
        for chunk in self.index.chunks.with_channels([channel for channels in topics for channel in channels]):
            if not overlaps(chunk, span):
                continue
            end = chunk.chunk_start_offset + chunk.chunk_length  # its message indexes follow
            indexes.append((end, end + chunk.message_index_length))
            is_direct = is_left_in_file(chunk.compression, chunk.compressed_size)
            wholes.append((end if is_direct else chunk.chunk_start_offset, end + chunk.message_index_length))
        is_one = are_read and sum(end - start for start, end in wholes) <= _READ_AT_ONCE_BYTES
        self.source.expect(wholes if is_one else indexes, GAP_BYTES if is_one or not are_read else _MIN_GAP_BYTES)
        batches = [self._batches(channels, span) for channels in topics]
        if are_read and not is_one:
            self.source.expect(wholes)
        return batches

    def _batches(self, channels: Sequence[int], span: Span) -> MessageBatches:
        """The batches of channels; those that were asked for last are kept."""
        key = (tuple(channels), span)
        batches = self._asked.pop(key, None) or MessageBatches(self.source, self.index, channels, span)
        self._asked[key] = batches
        while sum(len(kept.t_ns) for kept in self._asked.values()) > _KEPT_MESSAGES:
            self._asked.popitem(last=False)
        return batches

    def _content(self, chunk: ChunkIndex) -> Bytes:
        """The records in a chunk."""
        content = self._opened.pop(chunk.chunk_start_offset, None)
        if content is None:
            content, mark = open_chunk_with_checksum(self.source, chunk_record(self.source, chunk))
            self._remember_chunk(chunk.chunk_start_offset, mark)
        else:
            self._opened_bytes -= len(content)
        if len(chunk.message_index_offsets) == 1 and isinstance(content, memoryview):
            return content  # no other channel needs it
        self._opened[chunk.chunk_start_offset] = content
        self._opened_bytes += len(content)
        while self._opened_bytes > _KEPT_BYTES and len(self._opened) > 1:
            self._opened_bytes -= len(self._opened.popitem(last=False)[1])
        return content

    def _open(self, batch: MessageBatch) -> tuple[memoryview, Ints]:
        """The bytes that contain a batch, and the offsets of its messages in them."""
        base = 0
        if batch.chunk is not None:
            content = self._content(batch.chunk)
            if isinstance(content, memoryview):
                return content, batch.offset
            base = read_chunk(self.source, chunk_record(self.source, batch.chunk)).start
            if not batch.is_direct:
                raise Damaged("a chunk is larger than its index says", batch.chunk.chunk_start_offset)
        if not len(batch.offset):
            return memoryview(b""), batch.offset
        places = batch.offset + base
        low, last = int(places.min()), int(places.max())
        end = record_at(self.source, last).end
        if end - low <= len(places) * _MAX_GAP_BYTES:
            self._remember(low, whole := self.source[low:end])
            return whole, places - low
        parts = {}  # far apart
        for at in np.sort(places).tolist():
            record = record_at(self.source, at)
            self._remember(at, whole := self.source[at : record.end])
            parts[at] = whole
        starts = np.cumsum([0, *map(len, parts.values())])[:-1]
        return memoryview(b"".join(parts.values())), starts[np.searchsorted(list(parts), places)]

    def _remember_chunk(self, offset: int, mark: int) -> None:
        """Remember the checksum of a chunk that was read."""
        if not self._chunks:
            self._chunks = array("q", [-1]) * len(self.index.chunks)
        row = self.index.chunks.row_at(offset)
        assert row is not None
        self._chunks[row] = mark

    def _remember(self, start: int, data: memoryview) -> None:
        """Remember the checksum of bytes that were read outside of chunks."""
        self._pieces[start] = (start + len(data), zlib.crc32(data))

    def _read(self, batch: MessageBatch, skip: int) -> Iterator[Message]:
        """The messages of a batch except the first ``skip``."""
        head, payloads = self._parsed(batch, skip)
        return map(Message, head["t_ns"].tolist(), head["sequence"].tolist(), head["publish_ns"].tolist(), payloads)

    def _parsed(self, batch: MessageBatch, skip: int) -> tuple[NDArray[np.void], Iterator[bytes]]:
        """The heads of the messages of a batch except the first ``skip``, of ``HEAD``, and their payloads."""
        content, offset = self._open(batch)
        channel = batch.channel if isinstance(batch.channel, int) else batch.channel[skip:]
        message_heads = message_heads_at(content, channel, batch.t_ns[skip:], offset[skip:])
        whole = content.obj
        data = whole if isinstance(whole, bytes) and len(whole) == len(content) else content
        spans = zip(message_heads.start.tolist(), message_heads.end.tolist(), strict=True)
        return message_heads.head, (bytes(data[start:end]) for start, end in spans)
