"""The bytes of a log, read when they are asked for.

Files are not mapped into memory: when another process makes a mapped file shorter, the kernel kills whoever touches a
page behind its new end. Here a read comes back short instead, and that is Damaged.
"""

from __future__ import annotations

import os
import stat
import time
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple, overload

from mcaptrack.errors import McaptrackError
from mcaptrack.log.recording_files import refuse_non_mcap
from mcaptrack.log.records import BLOCK, Damaged, crc_of

#: Small reads fetch at least so much, and while they go on one after another twice as much each time, up to the most.
_LEAST_AHEAD: Final = 4 * 2**10
_MOST_AHEAD: Final = 256 * 2**10
#: So many bytes are summed at once at least.
_LEAST_SUMMED: Final = 64 * 2**10
#: File systems keep times in ticks: two changes within this time may carry the same time.
_TICK_S: Final = 0.05

_KINDS: Final = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe (FIFO)",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFLNK: "a symbolic link",
}


def file_type(mode: int) -> str:
    """What something is that is no regular file, in words; "" for a regular file."""
    return "" if stat.S_ISREG(mode) else _KINDS.get(stat.S_IFMT(mode), "something special")


class Signature(NamedTuple):
    """What tells whether a file was changed: its size, and when content and description last changed."""

    size: int
    written_ns: int
    changed_ns: int

    @classmethod
    def of(cls, handle: int) -> Signature:
        """The signature of an open file now."""
        found = os.fstat(handle)
        return cls(found.st_size, found.st_mtime_ns, found.st_ctime_ns)

    @property
    def is_certain(self) -> bool:
        """Whether a change from now on is sure to give another signature."""
        return abs(time.time() - self.changed_ns / 1e9) > _TICK_S


class OpenFile:
    """A regular file, open for reading; closed with ``close``, or when nothing refers to it any more."""

    def __init__(self, handle: int) -> None:
        self.handle = handle
        self.close = weakref.finalize(self, os.close, handle)

    @classmethod
    def at(cls, path: Path) -> OpenFile:
        """Raises McaptrackError for what isn't there, may not be read, or is no file; never waits for a pipe."""
        refuse_non_mcap(path)
        try:
            kind = file_type(path.stat().st_mode)
            if not kind:
                file = cls(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC))
        except OSError as error:
            raise McaptrackError(f"{path} can't be opened: {error.strerror}") from None
        kind = kind or file_type(os.fstat(file.handle).st_mode)  # it may have been replaced meanwhile
        if kind:
            hint = "; give the logs in it, as in 'FOLDER/*.mcap'" if path.is_dir() else ""
            raise McaptrackError(f"{path} is {kind}, not an MCAP file{hint}")
        return file

    def read(self, at: int, size: int) -> bytes:
        """Bytes of the file. Raises Damaged where it has become shorter or can't be read."""
        if not self.close.alive:
            raise ValueError("the file is closed")
        return read_exactly(self.handle, at, size)


def read_exactly(handle: int, at: int, size: int) -> bytes:
    """Bytes of an open file. Raises Damaged where it is shorter or can't be read."""
    try:
        data = os.pread(handle, size, at)
        while len(data) < size:
            more = os.pread(handle, size - len(data), at + len(data))
            if not more:
                raise Damaged(f"the file ends before byte {at + size}; it was longer when it was opened")
            data += more
    except OSError as error:
        raise Damaged(f"it can't be read: {error.strerror}", at) from None
    return data


class Piece(NamedTuple):
    """A part of an open file."""

    file: OpenFile
    at: int
    size: int


class ByteSource:
    """The bytes of one file, or of pieces of several as if they were one; ``source[start:end]`` reads them.

    Both ends of a slice are given, and count from the beginning.

    ``ahead`` is how much a small read fetches for those that follow; by default it grows with their number.
    """

    def __init__(self, pieces: Sequence[Piece], ahead: int = 0) -> None:
        self.pieces: tuple[Piece, ...] = tuple(pieces)
        self._size = sum(piece.size for piece in pieces)
        self._ahead = ahead
        self._next_ahead = ahead or _LEAST_AHEAD
        self._window: tuple[int, memoryview] = (0, memoryview(b""))
        #: Bytes from here on are still wanted when what follows is fetched.
        self.anchor: int | None = None

    @classmethod
    def of(cls, file: OpenFile) -> ByteSource:
        """The whole of a file, as long as it is now."""
        return cls([Piece(file, 0, os.fstat(file.handle).st_size)])

    def __len__(self) -> int:
        return self._size

    @overload
    def __getitem__(self, key: int, /) -> int: ...

    @overload
    def __getitem__(self, key: slice, /) -> memoryview: ...

    def __getitem__(self, key: int | slice, /) -> int | memoryview:
        if isinstance(key, slice):
            start, end = key.start, key.stop
            at, window = self._window
            if at <= start < end <= at + len(window):
                return window[start - at : end - at]
            end = min(end, self._size)
            return self._get(start, end) if start < end else memoryview(b"")
        if not 0 <= key < self._size:
            raise IndexError(key)
        return self[key : key + 1][0]

    def _get(self, start: int, end: int) -> memoryview:
        at, window = self._window
        if not self._ahead:
            behind = at + len(window)
            is_next = behind - _LEAST_AHEAD <= start <= behind + _LEAST_AHEAD
            self._next_ahead = min(self._next_ahead * 2, _MOST_AHEAD) if is_next else _LEAST_AHEAD
        low = start
        if self.anchor is not None and 0 <= start - self.anchor < self._next_ahead:
            low = self.anchor
        if end - low >= self._next_ahead:
            return memoryview(self._read(start, end))
        window = memoryview(self._read(low, min(low + self._next_ahead, self._size)))
        self._window = (low, window)
        return window[start - low : end - low]

    def _read(self, start: int, end: int) -> bytes:
        parts = []
        for piece in self.pieces:
            if start < piece.size and end > 0:
                low = max(start, 0)
                parts.append(piece.file.read(piece.at + low, min(end, piece.size) - low))
            start, end = start - piece.size, end - piece.size
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def front_to_back(self) -> ByteSource:
        """The same for whoever reads all of it in order."""
        return ByteSource(self.pieces, 2 * BLOCK)

    def part(self, start: int, end: int) -> ByteSource:
        """The bytes from ``start`` to ``end`` as a source of their own."""
        pieces = []
        for piece in self.pieces:
            low, high = max(start, 0), min(end, piece.size)
            if low < high:
                pieces.append(Piece(piece.file, piece.at + low, high - low))
            start, end = start - piece.size, end - piece.size
        return ByteSource(pieces)


class RunningChecksum:
    """The CRC-32 of a source from its beginning to ``done``, brought on as records are passed."""

    def __init__(self, source: ByteSource) -> None:
        self._source, self._crc, self.done = source, 0, 0
        source.anchor = 0

    def pass_over(self, end: int) -> None:
        """Everything before ``end`` has been looked at, or is about to be; short records are taken together."""
        if end - self.done >= _LEAST_SUMMED:
            self.upto(end)

    def upto(self, end: int) -> int:
        """The checksum of everything before ``end``."""
        self._crc = crc_of(self._source, self.done, end, self._crc)
        self.done = self._source.anchor = end
        return self._crc
