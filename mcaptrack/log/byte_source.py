"""The bytes of a log, read on demand.

Files are not mapped into memory. When another process truncates a mapped file, the kernel kills every process that
touches a page behind the new end. A read comes back short instead, which raises Damaged.
"""

from __future__ import annotations

import os
import stat
import time
import weakref
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final, NamedTuple, Protocol, overload

from mcaptrack.errors import McaptrackError
from mcaptrack.files import unreadable
from mcaptrack.location import Location, Url
from mcaptrack.log.recording_files import refuse_non_mcap
from mcaptrack.log.records import BLOCK, Damaged, crc_of

#: Read-ahead of small reads in bytes: it starts with the minimum and doubles with every sequential read.
MIN_AHEAD: Final = 4 * 2**10
_MAX_AHEAD: Final = 256 * 2**10
#: Ranges of an object with a smaller gap between them are read as one: that is as quick as another request.
GAP_BYTES: Final = 512 * 2**10
#: The running checksum is updated in steps of at least this many bytes.
_MIN_SUMMED: Final = 64 * 2**10
#: Resolution of file times: two changes within this time may get the same timestamp.
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
    """The type of a file that is not a regular one, in words; "" for a regular file."""
    return "" if stat.S_ISREG(mode) else _KINDS.get(stat.S_IFMT(mode), "something special")


class Signature(NamedTuple):
    """Size and change times of a file: another signature means that the file was changed."""

    size: int
    written_ns: int
    changed_ns: int

    @classmethod
    def of(cls, handle: int) -> Signature:
        """The current signature of an open file."""
        status = os.fstat(handle)
        return cls(status.st_size, status.st_mtime_ns, status.st_ctime_ns)

    @property
    def is_certain(self) -> bool:
        """Whether every later change will give another signature."""
        return abs(time.time() - self.changed_ns / 1e9) > _TICK_S


class ReadFile(Protocol):
    """The interface of a file or of an object in a store (``log/remote.py``) that a log is read from."""

    @property
    def size(self) -> int:
        """The present size in bytes."""

    def signature(self) -> Signature:
        """The present signature: another one means that the content was changed."""

    def expect(self, ranges: Iterable[tuple[int, int]], gap: int, /) -> None:
        """Announce which bytes will be read, from start to end: a store can then give them in few requests."""

    def read(self, at: int, size: int) -> bytes:
        """``size`` bytes from offset ``at``. Raises Damaged if there are fewer."""

    def close(self) -> object:
        """Close it; further reads are refused."""


class OpenFile:
    """A regular file, open for reading; closed by ``close`` or by garbage collection."""

    def __init__(self, handle: int) -> None:
        self.handle = handle
        self.close = weakref.finalize(self, os.close, handle)

    @classmethod
    def at(cls, path: Path) -> OpenFile:
        """Open a file without ever blocking on a pipe.

        Raises McaptrackError if it is missing, not readable or not a regular file.
        """
        refuse_non_mcap(path)
        try:
            kind = file_type(path.stat().st_mode)
            if not kind:
                file = cls(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC))
        except OSError as error:
            raise unreadable(path, error) from None
        kind = kind or file_type(os.fstat(file.handle).st_mode)  # the path may have been replaced since
        if kind:
            hint = "; give the logs in it, as in 'FOLDER/*.mcap'" if path.is_dir() else ""
            raise McaptrackError(f"{path} is {kind}, not an MCAP file{hint}")
        return file

    @property
    def size(self) -> int:
        """The present size in bytes."""
        return os.fstat(self.handle).st_size

    def signature(self) -> Signature:
        """The present signature."""
        return Signature.of(self.handle)

    def expect(self, ranges: Iterable[tuple[int, int]], gap: int, /) -> None:
        """Nothing is gained from knowing what will be read of a file."""

    def read(self, at: int, size: int) -> bytes:
        """``size`` bytes from offset ``at``. Raises Damaged if the file has become shorter or can't be read."""
        if not self.close.alive:
            raise McaptrackError("the log is closed; what is read bit by bit, such as pictures, needs it open")
        return read_exactly(self.handle, at, size)


def open_file(location: Location) -> ReadFile:
    """Open a file or an object for reading. Raises McaptrackError if it is missing or can't be read."""
    if isinstance(location, Url):
        from mcaptrack.log.remote import RemoteFile

        return RemoteFile(location)
    return OpenFile.at(location)


def read_exactly(handle: int, at: int, size: int) -> bytes:
    """``size`` bytes of an open file from offset ``at``. Raises Damaged if it is shorter or can't be read."""
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

    file: ReadFile
    at: int
    size: int


class ByteSource:
    """The bytes of one file, or of pieces of several files laid end to end; ``source[start:end]`` reads them.

    Slices need both a start and an end, as offsets from the beginning. ``ahead`` is the read-ahead in bytes; by default
    it grows while reads are sequential.
    """

    def __init__(self, pieces: Sequence[Piece], ahead: int = 0) -> None:
        self.pieces: tuple[Piece, ...] = tuple(pieces)
        self._size = sum(piece.size for piece in pieces)
        self._ahead = ahead or int(self.is_remote)  # what is read of a store, reads ahead itself
        self._next_ahead = ahead or MIN_AHEAD
        self._window: tuple[int, memoryview] = (0, memoryview(b""))
        #: Offset from which bytes stay in the read-ahead window, because they will be read again.
        self.anchor: int | None = None

    @classmethod
    def of(cls, file: ReadFile) -> ByteSource:
        """The whole file, at its current size."""
        return cls([Piece(file, 0, file.size)])

    @property
    def is_remote(self) -> bool:
        """Whether reading takes requests to a store."""
        return any(not isinstance(piece.file, OpenFile) for piece in self.pieces)

    def expect(self, ranges: Sequence[tuple[int, int]], gap: int = GAP_BYTES) -> None:
        """Announce which bytes will be read, from start to end each, in place of what was announced before. Those with
        a smaller ``gap`` between them come in one request.
        """
        for piece in self.pieces:
            piece.file.expect(((piece.at + low, piece.at + high) for low, high in ranges), gap)

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
            is_next = behind - MIN_AHEAD <= start <= behind + MIN_AHEAD
            self._next_ahead = min(self._next_ahead * 2, _MAX_AHEAD) if is_next else MIN_AHEAD
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

    def sequential(self) -> ByteSource:
        """The same bytes with a large read-ahead, for reading all of them in order."""
        return ByteSource(self.pieces, 2 * BLOCK)

    def part(self, start: int, end: int) -> ByteSource:
        """The bytes from ``start`` to ``end`` as a separate source."""
        pieces = []
        for piece in self.pieces:
            low, high = max(start, 0), min(end, piece.size)
            if low < high:
                pieces.append(Piece(piece.file, piece.at + low, high - low))
            start, end = start - piece.size, end - piece.size
        return ByteSource(pieces)


class RunningChecksum:
    """The CRC-32 of the first ``done`` bytes of a source, updated while its records are read."""

    def __init__(self, source: ByteSource) -> None:
        self._source, self._crc, self.done = source, 0, 0
        source.anchor = 0

    def advance(self, end: int) -> None:
        """Include the bytes before ``end``, if there are enough new ones; short records are summed together."""
        if end - self.done >= _MIN_SUMMED:
            self.up_to(end)

    def up_to(self, end: int) -> int:
        """The checksum of all bytes before ``end``."""
        self._crc = crc_of(self._source, self.done, end, self._crc)
        self.done = self._source.anchor = end
        return self._crc
