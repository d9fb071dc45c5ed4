"""The index entries of all chunks as columns: 80 bytes a chunk, where objects take a kilobyte.

Letters: C chunks.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections.abc import Collection, Iterable, Iterator
from itertools import chain, pairwise
from typing import Final, overload

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.ragged import ragged_range
from mcaptrack.log.records import ChunkIndexRecord

#: The numbers of an entry in the order of their columns, and how many there are.
_NUMBERS: Final = (
    "start_ns",
    "end_ns",
    "offset",
    "length",
    "message_index_length",
    "compressed_size",
    "uncompressed_size",
)
_WIDTH: Final = len(_NUMBERS)
_START, _END, _OFFSET, _LENGTH, _INDEX_LENGTH = range(5)
#: Entries of chunks with so many channels are kept, and how many of them.
_MANY_CHANNELS: Final = 256
_MOST_KEPT: Final = 8


class ChunkList:
    """Index entries of chunks in the order in which they were added.

    ``at``, ``row_at`` and ``before`` need them in the order of the file, which ``sort_by_offset`` establishes.
    """

    def __init__(self, chunks: Iterable[ChunkIndexRecord] = ()) -> None:
        self._numbers = array("Q")  # _WIDTH for each chunk
        self._compression = array("H")  # an index into _names
        self._names: list[str] = []
        self._ends = array("Q")  # for each chunk, the end of its channels in the following two
        self._channels = array("H")
        self._indexes = array("Q")  # offsets of message indexes
        #: Entries of large chunks that were asked for last: each of their channels asks again.
        self._kept: dict[int, ChunkIndexRecord] = {}
        self._by_channel: tuple[Ints, Ints] | None = None
        for chunk in chunks:
            self.append(chunk)

    def append(self, chunk: ChunkIndexRecord) -> None:
        """Add an entry."""
        first, last, offset, length, indexes, index_length, compression, stored, opened = chunk
        self._by_channel = None
        if compression not in self._names:
            self._names.append(compression)
        self._compression.append(self._names.index(compression))
        self._numbers.extend((first, last, offset, length, index_length, stored, opened))
        self._channels.extend(indexes)
        self._indexes.extend(indexes.values())
        self._ends.append(len(self._channels))

    def __len__(self) -> int:
        return len(self._ends)

    def __iter__(self) -> Iterator[ChunkIndexRecord]:
        return map(self._entry, range(len(self)))

    @overload
    def __getitem__(self, row: int, /) -> ChunkIndexRecord: ...

    @overload
    def __getitem__(self, row: slice, /) -> list[ChunkIndexRecord]: ...

    def __getitem__(self, row: int | slice, /) -> ChunkIndexRecord | list[ChunkIndexRecord]:
        rows = range(len(self))[row]
        return self._entry(rows) if isinstance(rows, int) else list(map(self._entry, rows))

    def _entry(self, row: int) -> ChunkIndexRecord:
        low, high = self._ends[row - 1] if row else 0, self._ends[row]
        if high - low < _MANY_CHANNELS:
            return self._made(row, low, high)
        if row not in self._kept:
            if len(self._kept) == _MOST_KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[row] = self._made(row, low, high)
        return self._kept[row]

    def _made(self, row: int, low: int, high: int) -> ChunkIndexRecord:
        first, last, offset, length, index_length, stored, opened = self._numbers[row * _WIDTH : (row + 1) * _WIDTH]
        indexes = dict(zip(self._channels[low:high], self._indexes[low:high], strict=True))
        compression = self._names[self._compression[row]]
        return ChunkIndexRecord(first, last, offset, length, indexes, index_length, compression, stored, opened)

    def __eq__(self, other: object) -> bool:
        """Whether the same entries follow in the same order."""
        if not isinstance(other, ChunkList):
            return NotImplemented
        return self._numbers == other._numbers and all(mine == two for mine, two in zip(self, other, strict=True))

    __hash__ = None  # type: ignore[assignment]

    def at(self, offset: int) -> ChunkIndexRecord | None:
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

    def with_channels(self, channels: Collection[int]) -> Iterator[ChunkIndexRecord]:
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
