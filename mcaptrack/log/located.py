"""Where the messages of channels are, in batches that are read together; held as columns, 16 bytes a message.

Letters: M messages, B batches.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.ragged import group_index, run_starts
from mcaptrack.log.byte_source import ByteSource
from mcaptrack.log.chunks import MAX_NS, Entries, is_left_in_file, read_index_entries
from mcaptrack.log.index import Index
from mcaptrack.log.records import BLOCK, ChunkIndexRecord, Damaged

Times = NDArray[np.uint64]
Span = tuple[int | None, int | None]

_NO_ENTRIES: Final[Entries] = np.empty((0, 2), "<u8")
_OUTSIDE: Final = -1


class TimeOutOfRange(Exception):
    """``count`` messages of a channel are later than ``MAX_NS``, the first of them at ``t_ns``."""

    def __init__(self, count: int, t_ns: int) -> None:
        super().__init__(count, t_ns)
        self.count, self.t_ns = count, t_ns


class MessageBatch(NamedTuple):
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
            at = chunk.message_index_offsets[channel_id]
            entries = read_index_entries(source, at, channel_id) if at else index.entries[chunk.offset][channel_id]
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
        numbers = np.flatnonzero(np.diff(self.edges))
        first_ns, last_ns = self.t_ns[self.edges[numbers]], self.t_ns[self.edges[numbers + 1] - 1]
        order = np.argsort(first_ns, kind="stable")
        group: list[int] = []
        last = (-1, -1)  # time and number of the last message and batch so far
        for first, until, number in zip(
            first_ns[order].tolist(), last_ns[order].tolist(), numbers[order].tolist(), strict=True
        ):
            if group and (first, number) > last:
                yield [self[member] for member in sorted(group)]
                group = []
            group.append(number)
            last = max(last, (until, max(group)))
        if group:
            yield [self[member] for member in sorted(group)]


def overlaps(chunk: ChunkIndexRecord, span: Span) -> bool:
    """Whether a chunk may have messages in a span of times."""
    first, last = span
    return (first is None or chunk.end_ns >= first) and (last is None or chunk.start_ns < last)


def to_int64(t_ns: Times) -> Ints:
    """Times as int64, as all arithmetic needs them. Raises TimeOutOfRange if one doesn't fit."""
    late = t_ns[t_ns > np.uint64(MAX_NS)]
    if len(late):
        raise TimeOutOfRange(len(late), int(late.min()))
    return t_ns.astype(np.int64)
