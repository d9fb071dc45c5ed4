"""The messages of a channel in time order: located by index, read chunk by chunk, within a memory limit.

Letters: M messages.
"""

from __future__ import annotations

import zlib
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.ragged import group_index, ragged_range, run_starts
from mcaptrack.log.byte_source import GAP_BYTES, ByteSource
from mcaptrack.log.checksums import crc_of
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
from mcaptrack.log.fingerprint import fingerprint
from mcaptrack.log.index import Index
from mcaptrack.log.records import (
    BLOCK,
    CHUNK_HEAD_BYTES,
    MESSAGE_HEAD,
    Bytes,
    ChunkIndexRecord,
    Damaged,
    Opcode,
    Record,
    read_chunk,
    record_at,
)
from mcaptrack.schema import Rows, Schema
from mcaptrack.schema.encodings import RowReader

Times = NDArray[np.uint64]
Span = tuple[int | None, int | None]

#: Limit for open chunks in bytes; above it, overlapping chunks are closed and opened again later.
OPEN_BYTES: Final = 128 * 2**20
#: Limit for chunks that stay open for the other channels in them, in bytes.
_KEPT_BYTES: Final = 8 * 2**20
#: Messages outside of chunks are read one by one if their average distance in the file is larger.
_MAX_GAP_BYTES: Final = 16 * 2**10
#: Chunks in a store that are smaller together are read with their indexes, others after them. Indexes that are nearer
#: to each other come in one request.
_READ_AT_ONCE_BYTES: Final = 16 * 2**20
_MIN_GAP_BYTES: Final = 64 * 2**10
_NONE: Final = np.empty(0, np.int64)
_NO_TIMES: Final = np.empty(0, np.uint64)


class Message(NamedTuple):
    """A recorded message; times in nanoseconds."""

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


class MessageLocations(NamedTuple):
    """The locations of a channel's messages in time order, (M,): chunk in the file, message in the uncompressed chunk.

    Outside of chunks ``chunk_offset`` is -1 and ``offset`` is an offset in the file.
    """

    t_ns: Ints
    chunk_offset: Ints
    offset: Ints


class TimeOutOfRange(Exception):
    """``count`` messages of a channel are later than ``MAX_NS``, the first of them at ``t_ns``."""

    def __init__(self, count: int, t_ns: int) -> None:
        super().__init__(count, t_ns)
        self.count, self.t_ns = count, t_ns


class _Batch(NamedTuple):
    """Messages of one channel that are read together, in time order, (M,) each: of one chunk, or near each other.

    ``is_direct``: the messages are read from the file itself, because they are outside of chunks or in an uncompressed
    chunk that is too large for memory.
    """

    channel: int
    chunk: ChunkIndexRecord | None
    is_direct: bool
    t_ns: Times
    offset: Ints

    @property
    def size(self) -> int:
        """The memory in bytes that the open batch takes."""
        if self.chunk is not None and not self.is_direct:
            return self.chunk.uncompressed_size
        return int(self.offset.max() - self.offset.min()) if len(self.offset) else 0


class Messages:
    """The messages of a log. All methods raise Damaged where the bytes contradict the index.

    Channels are given by id; the messages of several channels are read as if they were of one.
    """

    def __init__(self, source: ByteSource, index: Index) -> None:
        self.source, self.index = source, index
        self._opened: OrderedDict[int, Bytes] = OrderedDict()  # the last chunks that were opened, for other channels
        # Checksums of what was read, to detect changes: of chunks by offset, of pieces by start with their end.
        self._chunks: dict[int, int] = {}
        self._pieces: dict[int, tuple[int, int]] = {}
        self._fingerprints: dict[int | None, str] = {}
        self._checksums: dict[int, int | str] = {}

    def times(self, channels: Sequence[int], span: Span = (None, None)) -> Ints:
        """The sorted times of messages, (M,)."""
        batches = self._located(channels, span, are_read=False)
        return np.sort(to_int64(np.concatenate([_NO_TIMES, *(batch.t_ns for batch in batches)])))

    def places(self, channels: Sequence[int]) -> MessageLocations:
        """The locations of messages, in the order of ``by_time``."""
        batches = self._located(channels, (None, None), are_read=False)
        t_ns = to_int64(np.concatenate([_NO_TIMES, *(batch.t_ns for batch in batches)]))
        offset = np.concatenate([_NONE, *(batch.offset for batch in batches)])
        starts = np.array([batch.chunk.offset if batch.chunk else -1 for batch in batches], np.int64)
        chunk_offset = np.repeat(starts, [len(batch.t_ns) for batch in batches])
        order = np.argsort(t_ns, kind="stable")
        return MessageLocations(t_ns[order], chunk_offset[order], offset[order])

    def at(self, chunk_offset: int | None, offset: int) -> tuple[int, Message]:
        """The message at a location, and the id of its channel."""
        content: Bytes = self.source
        if chunk_offset is not None:
            chunk = next((chunk for chunk in self.index.chunks if chunk.offset == chunk_offset), None)
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

        ``span`` is a half-open interval of times. Chunks stay open while they have messages to come, within the limit
        ``OPEN_BYTES``.
        """
        batches = self._located(channels, span)
        if not any(len(batch.t_ns) for batch in batches):
            return
        t_ns = np.concatenate([batch.t_ns for batch in batches])
        batch_of = group_index([len(batch.t_ns) for batch in batches])
        in_order = batch_of[np.argsort(t_ns, kind="stable")]
        # Chunks rarely overlap: consecutive messages of one chunk are yielded together.
        starts = np.append(np.flatnonzero(run_starts(in_order)), len(in_order))
        opened: OrderedDict[int, Iterator[Message]] = OrderedDict()
        taken = [0] * len(batches)
        size = 0
        for number, run in zip(in_order[starts[:-1]].tolist(), np.diff(starts).tolist(), strict=True):
            batch = batches[number]
            if number not in opened:
                size += batch.size
                while size > OPEN_BYTES and opened:
                    size -= batches[opened.popitem(last=False)[0]].size
                opened[number] = self._read(batch, taken[number])
            opened.move_to_end(number)
            yield from islice(opened[number], run)
            taken[number] += run
            if taken[number] == len(batch.t_ns):
                del opened[number]
                size -= batch.size

    def columns(self, channels: Sequence[int], schema: Schema, reader: RowReader) -> ChannelRows | None:
        """Rows without a loop over messages; None if a message has another layout than the reader's."""
        batches = self._located(channels, (None, None))
        t_ns = to_int64(np.concatenate([_NO_TIMES, *(batch.t_ns for batch in batches)]))
        sequence, counts = np.empty_like(t_ns), np.empty_like(t_ns)
        rows, done, taken = schema.empty(), 0, 0
        for batch in batches:
            content, offset = self._open(batch)
            found = message_heads_at(content, batch.channel, batch.t_ns, offset)
            decoded = reader.decode_at(np.frombuffer(content, np.uint8), found.start, found.end)
            if decoded is None:
                return None
            part, counts_of = decoded
            until = done + len(batch.t_ns)
            sequence[done:until], counts[done:until] = found.head["sequence"], counts_of
            if taken + len(part) > len(rows):  # room for the rest, if it has as many rows a message as so far
                share = (len(t_ns) - done) / max(until - done, 1)
                rows = schema.codec.longer(rows, taken, taken + int(len(part) * share * 1.02) + 1)
            schema.codec.put(rows, taken, part)
            done, taken = until, taken + len(part)
        rows = rows[:taken]
        order = np.argsort(t_ns, kind="stable")
        if (np.diff(order) != 1).any():
            rows = rows[ragged_range((np.cumsum(counts) - counts)[order], counts[order])]
        rows.flags.writeable = False
        return ChannelRows(rows, t_ns[order], sequence[order], counts[order])

    def parts(self, channels: Sequence[int], schema: Schema, reader: RowReader) -> Iterator[ChannelRows | None]:
        """Yield the rows that ``columns`` returns, chunk by chunk; None where a message has another layout."""
        for group in _in_order(self._located(channels, (None, None))):
            t_ns = to_int64(np.concatenate([batch.t_ns for batch in group]))
            rows, sequence, counts = [], [], []
            for batch in group:
                content, offset = self._open(batch)
                found = message_heads_at(content, batch.channel, batch.t_ns, offset)
                decoded = reader.decode_at(np.frombuffer(content, np.uint8), found.start, found.end)
                if decoded is None:
                    yield None
                    return
                rows.append(decoded[0])
                counts.append(decoded[1])
                sequence.append(found.head["sequence"].astype(np.int64))
            members, numbers, sizes = schema.joined(rows), np.concatenate(sequence), np.concatenate(counts)
            order = np.argsort(t_ns, kind="stable")
            if (np.diff(order) != 1).any():
                members = members[ragged_range((np.cumsum(sizes) - sizes)[order], sizes[order])]
            yield ChannelRows(members, t_ns[order], numbers[order], sizes[order])

    def fingerprint(self, channel_id: int | None = None) -> str:
        """The fingerprint of a channel, or of the whole log; computed once."""
        if channel_id not in self._fingerprints:
            if self.source.is_remote:
                chunks = [c for c in self.index.chunks if channel_id in (None, *c.message_index_offsets)]
                self.source.expect([(chunk.offset, chunk.offset + CHUNK_HEAD_BYTES) for chunk in chunks])
            self._fingerprints[channel_id] = fingerprint(self.source, self.index, channel_id, self._checksums)
        return self._fingerprints[channel_id]

    def are_unchanged_in(self, source: ByteSource) -> bool:
        """Whether everything that was read so far is unchanged in ``source``."""
        pieces = all(crc_of(source, start, end) == crc for start, (end, crc) in self._pieces.items())
        return pieces and all(checksum_at(source, start) == crc for start, crc in self._chunks.items())

    def _located(self, channels: Sequence[int], span: Span, *, are_read: bool = True) -> list[_Batch]:
        """The batches of channels. A store learns what will be read of them: their indexes, and if they ``are_read``
        their chunks.
        """
        if not self.source.is_remote:
            return self._batches(channels, span)
        first, last = span
        indexes, wholes = [], []
        for chunk in self.index.chunks:
            is_before = first is not None and chunk.end_ns < first
            if is_before or (last is not None and chunk.start_ns >= last):
                continue
            if not chunk.message_index_offsets.keys().isdisjoint(channels):
                end = chunk.offset + chunk.length  # its message indexes follow
                indexes.append((end, end + chunk.message_index_length))
                is_direct = is_left_in_file(chunk.compression, chunk.compressed_size)
                wholes.append((end if is_direct else chunk.offset, end + chunk.message_index_length))
        is_one = are_read and sum(end - start for start, end in wholes) <= _READ_AT_ONCE_BYTES
        self.source.expect(wholes if is_one else indexes, GAP_BYTES if is_one or not are_read else _MIN_GAP_BYTES)
        batches = self._batches(channels, span)
        if are_read and not is_one:
            self.source.expect(wholes)
        return batches

    def _batches(self, channels: Sequence[int], span: Span) -> list[_Batch]:
        return [batch for channel_id in channels for batch in self._batches_of(channel_id, span)]

    def _batches_of(self, channel_id: int, span: Span) -> list[_Batch]:
        """The batches of a channel in the chunks that overlap the span."""
        first, last = span
        found, listed = [], 0
        for chunk in self.index.chunks:
            at = chunk.message_index_offsets.get(channel_id)
            if at is None or (last is not None and chunk.start_ns >= last):
                continue
            if first is not None and chunk.end_ns < first:
                continue
            if at:
                entries = read_index_entries(self.source, at, channel_id)
            else:
                entries = self.index.entries[chunk.offset][channel_id]
            listed += len(entries)
            if is_left_in_file(chunk.compression, chunk.compressed_size):
                found += _pieces(channel_id, chunk, entries, span)
            else:
                found.append(_batch(channel_id, chunk, False, entries, span))
        loose = self.index.loose.get(channel_id, np.empty((0, 2), "<u8"))
        found += _pieces(channel_id, None, loose, span)
        listed += len(loose)
        declared = self.index.counts.get(channel_id, 0)
        if first is None and last is None and listed != declared:
            raise Damaged(f"its indexes list {listed} messages of channel {channel_id}, and there are {declared}")
        return found

    def _content(self, chunk: ChunkIndexRecord) -> Bytes:
        """The records in a chunk."""
        content = self._opened.pop(chunk.offset, None)
        if content is None:
            content, mark = open_chunk_with_checksum(self.source, chunk_record(self.source, chunk))
            self._chunks[chunk.offset] = mark
        if len(chunk.message_index_offsets) == 1 and isinstance(content, memoryview):
            return content  # no other channel needs it
        self._opened[chunk.offset] = content
        while sum(map(len, self._opened.values())) > _KEPT_BYTES and len(self._opened) > 1:
            self._opened.popitem(last=False)
        return content

    def _open(self, batch: _Batch) -> tuple[memoryview, Ints]:
        """The bytes that contain a batch, and the offsets of its messages in them."""
        base = 0
        if batch.chunk is not None:
            content = self._content(batch.chunk)
            if isinstance(content, memoryview):
                return content, batch.offset
            base = read_chunk(self.source, chunk_record(self.source, batch.chunk)).start
            if not batch.is_direct:
                raise Damaged("a chunk is larger than its index says", batch.chunk.offset)
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

    def _remember(self, start: int, data: memoryview) -> None:
        """Remember the checksum of bytes that were read outside of chunks."""
        self._pieces[start] = (start + len(data), zlib.crc32(data))

    def _read(self, batch: _Batch, skip: int) -> Iterator[Message]:
        """The messages of a batch except the first ``skip``."""
        content, offset = self._open(batch)
        found = message_heads_at(content, batch.channel, batch.t_ns[skip:], offset[skip:])
        whole = content.obj
        data = whole if isinstance(whole, bytes) and len(whole) == len(content) else content
        spans = zip(found.start.tolist(), found.end.tolist(), strict=True)
        payloads = (bytes(data[start:end]) for start, end in spans)
        head = found.head
        return map(Message, head["t_ns"].tolist(), head["sequence"].tolist(), head["publish_ns"].tolist(), payloads)


def _in_order(batches: Sequence[_Batch]) -> Iterator[list[_Batch]]:
    """Batches in groups that follow one another in time; batches of one group overlap, and keep their order."""
    there = [(int(batch.t_ns[0]), number, batch) for number, batch in enumerate(batches) if len(batch.t_ns)]
    group: list[tuple[int, int, _Batch]] = []
    last = (-1, -1)  # time and number of the last message and batch so far
    for first_ns, number, batch in sorted(there, key=lambda one: one[:2]):
        if group and (first_ns, number) > last:
            yield [one for _, _, one in sorted(group, key=lambda member: member[1])]
            group = []
        group.append((first_ns, number, batch))
        last = max(last, (int(batch.t_ns[-1]), max(member[1] for member in group)))
    if group:
        yield [one for _, _, one in sorted(group, key=lambda member: member[1])]


def _batch(channel_id: int, chunk: ChunkIndexRecord | None, is_direct: bool, entries: Entries, span: Span) -> _Batch:
    first, last = span
    t_ns, offset = entries.astype(np.uint64).T
    if first is not None or last is not None:
        inside = np.ones(len(t_ns), bool) if first is None or first <= 0 else t_ns >= first
        if last is not None:
            inside &= t_ns < max(last, 0)
        t_ns, offset = t_ns[inside], offset[inside]
    order = np.argsort(t_ns, kind="stable")
    return _Batch(channel_id, chunk, is_direct, t_ns[order], offset[order].astype(np.int64))


def _pieces(channel_id: int, chunk: ChunkIndexRecord | None, entries: Entries, span: Span) -> list[_Batch]:
    """Batches of messages that are read from the file itself, each of nearby messages."""
    if not len(entries):
        return []
    in_file = entries[np.argsort(entries[:, 1], kind="stable")]
    starts = np.flatnonzero(run_starts(in_file[:, 1] // BLOCK))
    return [_batch(channel_id, chunk, True, piece, span) for piece in np.split(in_file, starts[1:])]


def to_int64(t_ns: Times) -> Ints:
    """Times as int64, as all arithmetic needs them. Raises TimeOutOfRange if one doesn't fit."""
    late = t_ns[t_ns > np.uint64(MAX_NS)]
    if len(late):
        raise TimeOutOfRange(len(late), int(late.min()))
    return t_ns.astype(np.int64)
