"""Changing the end of a file so that a kill at any instant leaves the old end or the new one.

Before the first byte changes, the old end stands complete and on the disk in a journal beside the file, LOG.journal. It
goes when the new end is on the disk. Whoever finds a journal, and nobody at work on the file, puts the old end back.
"""

from __future__ import annotations

import fcntl
import os
import struct
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from mcaptrack.atomic import publish, sync_folder
from mcaptrack.errors import McaptrackError
from mcaptrack.log.source import OpenFile, Source

_MAGIC: Final = b"mcaptrack journal 1\n"
#: Where the old end starts, how long the file was, a CRC of the bytes before that end, a CRC of the end itself.
_HEAD: Final = struct.Struct("<QQII")
#: How much before the old end shows that a journal belongs to a file.
_ANCHOR: Final = 64 * 1024
_BLOCK: Final = 2**20
#: How long to wait for somebody who is writing the end of a file just now.
_PATIENCE_S: Final = 10.0


def journal_of(path: Path) -> Path:
    """Where the journal of a file stands while its end is being changed."""
    return path.with_name(path.name + ".journal")


def lock(path: Path, handle: int) -> None:
    """Be the only one to write to an open file until the handle is closed. Raises McaptrackError if somebody is."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        raise McaptrackError(f"{path} is being written to by another process; try again when it is done") from None
    try:
        same = os.path.samestat(path.stat(), os.fstat(handle))
    except OSError:
        same = False
    if not same:
        raise McaptrackError(f"{path} was replaced while it was being read; try again")


class End:
    """The end of a file, from ``start`` on, being written anew. ``old`` are the bytes that stood there."""

    def __init__(self, handle: int, start: int, old: Source) -> None:
        self._handle, self.old = handle, old
        self._at = start
        self._waiting: list[bytes] = []
        self._size = 0

    def write(self, data: bytes) -> None:
        """Put more behind what was written."""
        self._waiting.append(data)
        self._size += len(data)
        if self._size >= _BLOCK:
            self.flush()

    def flush(self) -> None:
        """Give what waits to the operating system."""
        _write_at(self._handle, b"".join(self._waiting), self._at)
        self._at += self._size
        self._waiting, self._size = [], 0

    def close(self) -> None:
        """The file ends here; everything is on the disk."""
        self.flush()
        if os.fstat(self._handle).st_size > self._at:
            os.ftruncate(self._handle, self._at)
        os.fsync(self._handle)


@contextmanager
def new_end(path: Path, handle: int, start: int) -> Iterator[End]:
    """Write the end of a locked file anew, from ``start`` on; all of it, or as it was if the block fails.

    ``handle`` is open for reading and writing. The block must call ``close`` when it is done. Raises McaptrackError if
    the journal can't be written.
    """
    journal = journal_of(path)
    try:
        with publish(journal) as part, part.open("xb", buffering=0) as stream:
            there = os.fstat(handle)
            part.chmod(there.st_mode & 0o777)  # whoever may not read the log may not read its end either
            size, crc = there.st_size, 0
            for block in _blocks(handle, start, size):
                crc = zlib.crc32(block, crc)
            head = _HEAD.pack(start, size, _anchor(handle, start), crc)
            stream.write(_MAGIC + head + zlib.crc32(head).to_bytes(4, "little"))
            for block in _blocks(handle, start, size):
                _write_all(stream.fileno(), block)
    except OSError as error:
        raise McaptrackError(f"{journal} can't be written: {error.strerror or error}") from error
    try:
        kept = Source.of(OpenFile(journal))
        yield End(handle, start, kept.part(len(_MAGIC) + _HEAD.size + 4, len(kept)))
    except BaseException:
        _put_back(path, handle)
        raise
    journal.unlink()
    sync_folder(journal.parent)


def settle(path: Path) -> None:
    """Undo what somebody who is gone began to write to ``path``; waits for somebody who is at it.

    Raises McaptrackError if that takes too long, or if it can't be undone.
    """
    waited_until = time.monotonic() + _PATIENCE_S
    while journal_of(path).exists():
        try:
            handle = os.open(path, os.O_RDWR)
        except OSError as error:
            raise McaptrackError(
                f"{path} was left half written, and can't be mended: {error.strerror}; "
                f"whoever may write to it can, with {journal_of(path).name} beside it"
            ) from None
        try:
            with suppress(BlockingIOError):
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if journal_of(path).exists():
                    _put_back(path, handle)
                return
        finally:
            os.close(handle)
        if time.monotonic() > waited_until:
            raise McaptrackError(f"{path} is being written to by another process; try again when it is done")
        time.sleep(0.05)


def _put_back(path: Path, handle: int) -> None:
    """The old end takes its place again. May be done any number of times, and be interrupted."""
    journal = journal_of(path)
    with journal.open("rb") as stream:
        magic, head, check = stream.read(len(_MAGIC)), stream.read(_HEAD.size), stream.read(4)
        broken = f"{path} was left half written, and {journal.name} beside it is damaged; `mcaptrack recover {path}`"
        if magic != _MAGIC or len(head) != _HEAD.size or zlib.crc32(head).to_bytes(4, "little") != check:
            raise McaptrackError(f"{broken} saves what is whole")
        start, size, anchor, crc = _HEAD.unpack(head)
        if _anchor(handle, start) != anchor:
            raise McaptrackError(f"{journal} does not belong to {path}, which has been replaced; remove the journal")
        kept = stream.tell()
        found = 0
        while block := stream.read(_BLOCK):
            found = zlib.crc32(block, found)
        if found != crc or stream.tell() - kept != size - start:
            raise McaptrackError(f"{broken} saves what is whole")
        stream.seek(kept)
        at = start
        while block := stream.read(_BLOCK):
            _write_at(handle, block, at)
            at += len(block)
    os.ftruncate(handle, size)
    os.fsync(handle)
    journal.unlink()
    sync_folder(journal.parent)


def _anchor(handle: int, start: int) -> int:
    first = max(0, start - _ANCHOR)
    return zlib.crc32(b"".join(_blocks(handle, first, start)))


def _blocks(handle: int, start: int, end: int) -> Iterator[bytes]:
    at = start
    while at < end:
        block = os.pread(handle, min(_BLOCK, end - at), at)
        if not block:
            return
        yield block
        at += len(block)


def _write_at(handle: int, data: bytes, at: int) -> None:
    view = memoryview(data)
    while view:
        written = os.pwrite(handle, view, at)
        view, at = view[written:], at + written


def _write_all(handle: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(handle, view) :]
