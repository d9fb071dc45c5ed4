"""Frames as columns: their rows in blocks, most of which are in a temporary file.

A log of hours has more rows than fit into memory, and a frame of a few rows takes more memory as objects than as
bytes. What is read of a log, and what stages make of it, is therefore kept in blocks of about a megabyte. The first
block of a channel stays in memory; the others go, compressed, into a file without a name, which disappears with the
process.

Letters: F frames, N rows, B blocks.
"""

from __future__ import annotations

import weakref
from array import array
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from itertools import count
from threading import RLock
from typing import Final, overload

import numpy as np
from numpy.typing import ArrayLike

from mcaptrack.geometry.arrays import Ints
from mcaptrack.schema import Frame, Rows, Schema
from mcaptrack.schema.spill import SpillFile, Stored

#: The size of a block in bytes of rows.
BLOCK_BYTES: Final = 2**20
#: Blocks of a channel that stay in memory, and blocks of files that are kept after they were read, of all channels.
_IN_MEMORY: Final = 1
_CACHED: Final = 8
#: A block ends after so many frames, even if they have few rows.
_MOST_PARTS: Final = 4096


#: The blocks that were read last, by the number of their FrameColumns and of the block.
_READ: Final[OrderedDict[tuple[int, int], Rows]] = OrderedDict()
_READING: Final = RLock()
_NUMBERS: Final = count()


def _forget(number: int) -> None:
    """Let go of the blocks of FrameColumns that are gone."""
    with _READING:
        for key in [key for key in _READ if key[0] == number]:
            del _READ[key]


class FrameColumns(Sequence[Frame]):
    """Frames of one schema, made by ``FrameCollector``: times, numbers and rows as columns.

    A sequence of Frame; iterating it reads block by block.

    Parameters
    ----------
    schema : Schema
    t_ns, numbers : (F,) of int64
        Times and numbers of the frames.
    ends : (F + 1,) of int64
        The rows of frame f are ``ends[f]`` to ``ends[f + 1]``.
    first : sequence of int
        The first frame of each block, and the number of frames.
    blocks : sequence of Rows or Stored
        Rows in memory, or their place in the file.
    file : SpillFile
        The file with the blocks that are not in memory.
    """

    def __init__(
        self,
        schema: Schema,
        t_ns: Ints,
        numbers: Ints,
        ends: Ints,
        first: Sequence[int],
        blocks: Sequence[Rows | Stored],
        file: SpillFile,
    ) -> None:
        self.schema: Schema = schema
        self.t_ns: Ints = t_ns
        self.numbers: Ints = numbers
        self.ends: Ints = ends
        self._first, self._blocks, self._file = first, blocks, file
        self._number = next(_NUMBERS)
        weakref.finalize(self, _forget, self._number)

    def __len__(self) -> int:
        return len(self.t_ns)

    def __iter__(self) -> Iterator[Frame]:
        for number in range(len(self._blocks)):
            yield from self._frames(number, self._first[number], self._first[number + 1])

    @overload
    def __getitem__(self, key: int) -> Frame: ...

    @overload
    def __getitem__(self, key: slice) -> list[Frame]: ...

    def __getitem__(self, key: int | slice) -> Frame | list[Frame]:
        if isinstance(key, slice):
            first, last, step = key.indices(len(self))
            if step != 1:  # copies, so that blocks of which they are parts don't stay in memory
                return [self[at]._replace(rows=self.rows(at, at + 1)) for at in range(first, last, step)]
            out: list[Frame] = []
            for number, low, high in self._touched(first, last):
                out += self._frames(number, low, high)
            return out
        at = key + len(self) if key < 0 else key
        if not 0 <= at < len(self):
            raise IndexError(key)
        return self[at : at + 1][0]

    def rows(self, first: int = 0, last: int | None = None) -> Rows:
        """The rows of frames from ``first`` to before ``last``, (N,); a copy."""
        parts = []
        for number, low, high in self._touched(first, len(self) if last is None else last):
            start = self.ends[self._first[number]]
            parts.append(self._rows(number)[self.ends[low] - start : self.ends[high] - start])
        return self.schema.joined(parts)

    def take(self, places: Ints) -> Rows:
        """The rows at ``places`` (N,) of all rows laid end to end, in any order; a copy.

        Each block is read once, so places that are near one another in time are quick.
        """
        width = self.schema.dtype.itemsize
        out = np.empty((len(places), width), np.uint8)
        starts = self.ends[np.asarray(self._first, np.int64)]
        block = np.searchsorted(starts, places, "right") - 1
        for number in np.unique(block).tolist():
            here = block == number
            raw = self._rows(number).view(np.uint8).reshape(-1, width)
            out[here] = raw[places[here] - starts[number]]
        return out.view(self.schema.dtype)[:, 0]

    def _touched(self, first: int, last: int) -> Iterator[tuple[int, int, int]]:
        """The blocks with frames from ``first`` to before ``last``: number, and first and last of these frames."""
        number = max(bisect_right(self._first, first) - 1, 0)
        while first < last:
            until = min(self._first[number + 1], last)
            yield number, first, until
            first, number = until, number + 1

    def _frames(self, number: int, low: int, high: int) -> list[Frame]:
        """Frames ``low`` to before ``high``, all of one block."""
        rows = self._rows(number)
        ends = (self.ends[low : high + 1] - self.ends[self._first[number]]).tolist()
        named = zip(self.t_ns[low:high].tolist(), self.numbers[low:high].tolist(), ends[:-1], ends[1:], strict=True)
        return [Frame(t_ns, index, rows[start:end]) for t_ns, index, start, end in named]

    def _rows(self, number: int) -> Rows:
        block = self._blocks[number]
        if not isinstance(block, Stored):
            return block
        key = self._number, number
        with _READING:
            rows = _READ.pop(key, None)
            if rows is None:
                rows = np.frombuffer(self._file.get(block), self.schema.dtype)
            _READ[key] = rows
            if len(_READ) > _CACHED:
                _READ.popitem(last=False)
        return rows


class FrameCollector:
    """Collects the frames of a channel: ``append`` or ``extend``, then ``done``.

    Parameters
    ----------
    schema : Schema
        Of the rows.
    """

    def __init__(self, schema: Schema) -> None:
        self._schema = schema
        self._t_ns, self._index, self._counts = array("q"), array("q"), array("q")
        self._open: list[Rows] = []
        self._size = 0
        self._first, self._blocks = [0], list[Rows | Stored]()
        self._file = SpillFile()

    def append(self, frame: Frame) -> None:
        """Add a frame. Raises ValueError if its rows have other columns."""
        rows = frame.rows
        if rows.dtype != self._schema.dtype:
            rows = self._converted(rows)
        elif len(rows) and rows.base is not None:
            rows = rows.copy()  # else it would keep the array of many frames that it is a part of
        self._t_ns.append(frame.t_ns)
        self._index.append(frame.index)
        self._counts.append(len(rows))
        self._add(rows)

    def extend(self, t_ns: ArrayLike, index: ArrayLike, ends: ArrayLike, rows: Rows) -> None:
        """Add many frames at once.

        Parameters
        ----------
        t_ns, index : (F,) of int
            Their times and numbers.
        ends : (F + 1,) of int
            The rows of frame f are ``ends[f]`` to ``ends[f + 1]``; all of ``rows`` are used.
        rows : (N,) structured array
        """
        if rows.dtype != self._schema.dtype:
            rows = self._converted(rows)
        bounds, times, numbers = (np.asarray(values, np.int64) for values in (ends, t_ns, index))
        most = max(BLOCK_BYTES // self._schema.dtype.itemsize, 1)
        low = 0
        while low < len(times):
            high = max(int(np.searchsorted(bounds, bounds[low] + most, "right")) - 1, low + 1)
            high = min(high, len(times))
            for kept, values in ((self._t_ns, times), (self._index, numbers)):
                kept.frombytes(np.ascontiguousarray(values[low:high]).tobytes())
            self._counts.frombytes(np.diff(bounds[low : high + 1]).tobytes())
            self._add(rows[bounds[low] : bounds[high]])
            low = high

    def _add(self, rows: Rows) -> None:
        self._open.append(rows)
        self._size += rows.nbytes
        if self._size >= BLOCK_BYTES or len(self._open) >= _MOST_PARTS:
            self._close()

    def done(self) -> FrameColumns:
        """The frames; nothing can be added any more."""
        self._close()
        ends = np.concatenate([[0], np.cumsum(np.array(self._counts, np.int64))]).astype(np.int64)
        times, numbers = np.array(self._t_ns, np.int64), np.array(self._index, np.int64)
        return FrameColumns(self._schema, times, numbers, ends, self._first, self._blocks, self._file)

    def _converted(self, rows: Rows) -> Rows:
        """Rows in the layout of the schema."""
        checked = self._schema.check(rows)
        out = self._schema.empty(len(checked))
        for name in self._schema.dtype.names or ():
            out[name] = checked[name]
        return out

    def _close(self) -> None:
        if len(self._t_ns) == self._first[-1]:
            return
        rows = self._schema.joined(self._open)
        self._open, self._size = [], 0
        self._first.append(len(self._t_ns))
        if len(self._blocks) < _IN_MEMORY:
            rows.flags.writeable = False
            self._blocks.append(rows)
        else:
            self._blocks.append(self._file.put(rows.tobytes()))


def collect(schema: Schema, frames: Iterable[Frame]) -> FrameColumns:
    """Keep frames as columns. Raises ValueError if rows have other columns than the schema.

    Parameters
    ----------
    schema : Schema
    frames : iterable of Frame

    Returns
    -------
    FrameColumns
        ``frames`` itself if it is one.

    Examples
    --------
    >>> from mcaptrack.schema import DETECTIONS
    >>> row = DETECTIONS.rows(x_px=[1.0], y_px=[2.0], w_px=[3.0], h_px=[4.0], class_id=[1])
    >>> kept = collect(DETECTIONS, [Frame(0, 0, row), Frame(5, 1, DETECTIONS.empty())])
    >>> [(frame.t_ns, len(frame.rows)) for frame in kept], kept.rows()["w_px"].tolist()
    ([(0, 1), (5, 0)], [3.0])
    """
    if isinstance(frames, FrameColumns):
        return frames
    collector = FrameCollector(schema)
    for frame in frames:
        collector.append(frame)
    return collector.done()
