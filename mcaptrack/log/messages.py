"""The messages of a channel, by time: found by index, opened a chunk at a time, within bounds of memory.

Letters: M messages.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from mcaptrack.log.chunks import (
    MAX_NS,
    Entries,
    check_times,
    chunk_record,
    forget,
    heads_at,
    listed_entries,
    message_head,
    open_chunk,
)
from mcaptrack.log.index import Index
from mcaptrack.log.records import BLOCK, MESSAGE_HEAD, ChunkIndexRecord, Damaged, record_at
from mcaptrack.schema import Rows, Schema

Ints = NDArray[np.int64]
Span = tuple[int | None, int | None]

#: Beyond this much, chunks that overlap are closed and opened again when their turn comes.
OPEN_BYTES: Final = 128 * 2**20
_NONE: Final = np.empty(0, np.int64)


class Message(NamedTuple):
    """A message as it stands in a log; times in nanoseconds."""

    t_ns: int
    sequence: int
    publish_ns: int
    payload: bytes


class Columns(NamedTuple):
    """All rows of a channel by time, and of each message its time, sequence number and how many rows are its own."""

    rows: Rows
    t_ns: Ints
    sequence: Ints
    counts: Ints


class Places(NamedTuple):
    """Where the messages of a channel stand, by time, (M,): chunks in the file, messages in their chunk, uncompressed.

    Outside of chunks ``chunk_offset`` is -1 and ``offset`` a place in the file.
    """

    t_ns: Ints
    chunk_offset: Ints
    offset: Ints


class _Source(NamedTuple):
    """Messages of one channel in a chunk, or in the file outside of chunks: times and places, by time, (M,) each.

    ``start`` and ``end`` are the part of the file that reading them touches.
    """

    channel: int
    chunk: ChunkIndexRecord | None
    start: int
    end: int
    t_ns: Ints
    offset: Ints

    @property
    def size(self) -> int:
        """The memory that it takes to have it open."""
        return self.chunk.uncompressed_size if self.chunk and self.chunk.compression else 0


class Messages:
    """What is in the chunks of a log. Everything here raises Damaged where the bytes are not what the index says.

    Channels are given by their ids, one or several; the messages of several are read as those of one.
    """

    def __init__(self, buffer: memoryview, index: Index) -> None:
        self._buffer, self._index = buffer, index
        self._opened: OrderedDict[int, memoryview] = OrderedDict()  # contents of the last chunks, for other channels

    def times(self, channels: Sequence[int], span: Span = (None, None)) -> Ints:
        """The times of messages, rising, (M,)."""
        return np.sort(np.concatenate([np.empty(0, np.int64), *(s.t_ns for s in self._sources(channels, span))]))

    def places(self, channels: Sequence[int]) -> Places:
        """Where messages stand, in the order of ``by_time``."""
        sources = self._sources(channels)
        t_ns = np.concatenate([_NONE, *(source.t_ns for source in sources)])
        offset = np.concatenate([_NONE, *(source.offset for source in sources)])
        starts = np.array([source.chunk.offset if source.chunk else -1 for source in sources], np.int64)
        chunk_offset = np.repeat(starts, [len(source.t_ns) for source in sources])
        order = np.argsort(t_ns, kind="stable")
        return Places(t_ns[order], chunk_offset[order], offset[order])

    def at(self, chunk_offset: int | None, offset: int) -> tuple[int, Message]:
        """The message that stands at a place, and the number of its channel."""
        content = self._buffer
        if chunk_offset is not None:
            chunk = next((chunk for chunk in self._index.chunks if chunk.offset == chunk_offset), None)
            if chunk is None:
                raise Damaged(f"no chunk begins at byte {chunk_offset}")
            content = self._open(_Source(-1, chunk, chunk.offset, chunk.offset + chunk.length, _NONE, _NONE))
        record = record_at(content, offset)
        if record.opcode != Opcode.MESSAGE:
            raise Damaged(f"no message stands at byte {offset} of the chunk at {chunk_offset}")
        channel, sequence, t_ns, publish_ns = message_head(content, record)
        payload = bytes(content[record.body + MESSAGE_HEAD.size : record.end])
        return channel, Message(t_ns, sequence, publish_ns, payload)

    def by_time(self, channels: Sequence[int], span: Span = (None, None)) -> Iterator[Message]:
        """Messages by time; those of one time channel by channel, as they stand in the file.

        ``span`` is from the first to before the last.

        A chunk is open while its messages are due, unless too many are.
        """
        sources = self._sources(channels, span)
        if not any(len(source.t_ns) for source in sources):
            return
        t_ns = np.concatenate([source.t_ns for source in sources])
        source_of = np.repeat(np.arange(len(sources)), [len(source.t_ns) for source in sources])
        in_order = source_of[np.argsort(t_ns, kind="stable")]
        # Chunks rarely overlap: as long as one goes on, its messages are passed on without a look at the others.
        turns = np.flatnonzero(np.diff(in_order)) + 1
        starts = np.concatenate([[0], turns, [len(in_order)]])
        opened: OrderedDict[int, Iterator[Message]] = OrderedDict()
        taken = [0] * len(sources)
        size = 0
        for number, run in zip(in_order[starts[:-1]].tolist(), np.diff(starts).tolist(), strict=True):
            source = sources[number]
            if number not in opened:
                size += source.size
                while size > OPEN_BYTES and opened:
                    size -= sources[opened.popitem(last=False)[0]].size
                opened[number] = self._read(source, taken[number])
            opened.move_to_end(number)
            yield from islice(opened[number], run)
            taken[number] += run
            if taken[number] == len(source.t_ns):
                del opened[number]
                size -= source.size
                forget(self._buffer, source.start, source.end)

    def columns(self, channels: Sequence[int], schema: Schema) -> Columns | None:
        """Rows without a loop over messages; None where a message is laid out otherwise than ours."""
        sources = self._sources(channels)
        t_ns = np.concatenate([np.empty(0, np.int64), *(source.t_ns for source in sources)])
        sequence, counts = np.empty_like(t_ns), np.empty_like(t_ns)
        rows, done, taken = schema.empty(), 0, 0
        for source in sources:
            content = self._open(source)
            found = heads_at(content, source.channel, source.t_ns, source.offset)
            decoded = schema.codec.decode_at(np.frombuffer(content, np.uint8), found.start, found.end)
            if decoded is None:
                return None
            part, counts_of = decoded
            until = done + len(source.t_ns)
            sequence[done:until], counts[done:until] = found.head["sequence"], counts_of
            if taken + len(part) > len(rows):  # as many more as the messages to come have if they are like those so far
                share = (len(t_ns) - done) / max(until - done, 1)
                rows = schema.codec.longer(rows, taken, taken + int(len(part) * share * 1.02) + 1)
            schema.codec.put(rows, taken, part)
            done, taken = until, taken + len(part)
        rows = rows[:taken]
        order = np.argsort(t_ns, kind="stable")
        if (np.diff(order) != 1).any():
            first, kept = (np.cumsum(counts) - counts)[order], counts[order]
            rows = rows[np.repeat(first - (np.cumsum(kept) - kept), kept) + np.arange(len(rows))]
        rows.flags.writeable = False
        return Columns(rows, t_ns[order], sequence[order], counts[order])

    def _sources(self, channels: Sequence[int], span: Span = (None, None)) -> list[_Source]:
        return [source for channel_id in channels for source in self._sources_of(channel_id, span)]

    def _sources_of(self, channel_id: int, span: Span) -> list[_Source]:
        """Where the messages of a channel stand; only chunks that reach into the span are looked at."""
        first, last = span
        is_all = first is None and last is None
        found, listed = [], 0
        for chunk in self._index.chunks:
            at = chunk.message_index_offsets.get(channel_id)
            if at is None or (last is not None and chunk.start_ns >= last):
                continue
            if first is not None and chunk.end_ns < first:
                continue
            if at:
                entries = listed_entries(self._buffer, at, channel_id)
            else:
                entries = self._index.entries[chunk.offset][channel_id]
            listed += len(entries)
            found.append(_source(channel_id, chunk, chunk.offset, chunk.offset + chunk.length, entries, span))
        loose = self._index.loose.get(channel_id, np.empty((0, 2), "<u8"))
        listed += len(loose)
        # Outside of chunks, pieces of the file stand for them.
        turns = np.flatnonzero(np.diff(loose[:, 1] // BLOCK)) + 1
        pieces = np.split(loose, turns) if len(loose) else []
        found += [_source(channel_id, None, int(piece[0, 1]), int(piece[-1, 1]), piece, span) for piece in pieces]
        said = self._index.counts.get(channel_id, 0)
        if is_all and listed != said:
            raise Damaged(f"its indexes list {listed} messages of channel {channel_id}, and there are {said}")
        return found

    def _open(self, source: _Source) -> memoryview:
        """The records around the messages of a source."""
        if source.chunk is None:
            return self._buffer
        content = self._opened.pop(source.start, None)
        if content is None:
            content = open_chunk(self._buffer, chunk_record(self._buffer, source.chunk))
        if len(source.chunk.message_index_offsets) == 1:
            return content  # nobody else will ask for it
        self._opened[source.start] = content
        while sum(map(len, self._opened.values())) > OPEN_BYTES // 4 and len(self._opened) > 1:
            self._opened.popitem(last=False)
        return content

    def _read(self, source: _Source, skip: int) -> Iterator[Message]:
        """The messages of a source without the first ``skip``."""
        content = self._open(source)
        found = heads_at(content, source.channel, source.t_ns[skip:], source.offset[skip:])
        whole = content.obj
        data = whole if isinstance(whole, bytes) and len(whole) == len(content) else content
        spans = zip(found.start.tolist(), found.end.tolist(), strict=True)
        payloads = (bytes(data[start:end]) for start, end in spans)
        head = found.head
        return map(Message, head["t_ns"].tolist(), head["sequence"].tolist(), head["publish_ns"].tolist(), payloads)


def _source(
    channel_id: int, chunk: ChunkIndexRecord | None, start: int, end: int, entries: Entries, span: Span
) -> _Source:
    check_times(entries)
    t_ns, offset = entries.astype(np.int64).T
    first, last = span
    if first is not None or last is not None:
        inside = (t_ns >= (0 if first is None else first)) & (t_ns < (MAX_NS if last is None else last))
        t_ns, offset = t_ns[inside], offset[inside]
    order = np.argsort(t_ns, kind="stable")
    return _Source(channel_id, chunk, start, end, t_ns[order], offset[order])
