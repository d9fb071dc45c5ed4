"""Rewrite the tail of a log in place, so that a kill at any moment leaves the old tail or the new one.

Before the first byte changes, the old tail is complete and synced to disk in a journal beside the log. Before each
piece is written, its checksums are in the journal too (``log/journal.py``). The journal is removed when the new tail is
on the disk.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from mcaptrack import notices
from mcaptrack.errors import McaptrackError
from mcaptrack.files import keep_attributes, publish, sweep
from mcaptrack.log import journal
from mcaptrack.log.byte_source import OpenFile
from mcaptrack.log.journal import Journal, UnusableJournal, journal_of
from mcaptrack.log.records import Damaged

#: The number of bytes that are written at once.
_PIECE: Final = 4 * 2**20
_BLOCK: Final = 2**20


def lock(path: Path, handle: int) -> None:
    """Lock an open file for writing until the handle is closed.

    Raises McaptrackError if another process holds the lock.
    """
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        raise _busy_error(path) from None
    try:
        same = os.path.samestat(path.stat(), os.fstat(handle))
    except OSError:
        same = False
    if not same:
        raise McaptrackError(f"{path} was replaced while it was being read; try again")


def sweep_left(path: Path) -> None:
    """Remove what processes that were killed have left of new contents of a locked log, and of its journal."""
    for name in (path.name, journal_of(path).name):
        sweep(path.parent, name)


def resolve_journal(path: Path, handle: int, file: OpenFile) -> None:
    """Roll back an interrupted change of a locked log and remove its journal; warn about both.

    Raises McaptrackError if the journal's path holds something else.
    """
    try:
        left_behind = journal.find(path, file)
        if left_behind is None:
            return
        state = left_behind.state()
        if state == "busy":
            raise _busy_error(path)
        if state == "between":
            left_behind.restore(handle)
    except UnusableJournal as why:
        raise McaptrackError(
            f"{journal_of(path)} {why}; changing {path} needs that name for its journal. "
            f"If no other program needs it, remove it with {journal.remove_hint(path)}"
        ) from None
    journal.remove(path)
    if state == "between":
        message = f"{path} was left half written by an interrupted change; its state before that has been restored"
    else:
        message = f"{journal_of(path)} was left behind by an interrupted change; it has been removed"
    notices.warn(message, "journal")


def _busy_error(path: Path) -> McaptrackError:
    return McaptrackError(f"{path} is being written to by another process; try again when it is done")


class TailWriter:
    """Writes the new tail of a locked log. ``journal`` holds the old one."""

    def __init__(self, handle: int, written: Journal, digest: bytes) -> None:
        self._handle, self.journal, self._digest = handle, written, digest
        self._at = written.start
        self._pending: list[bytes] = []
        self._size = 0

    def write(self, data: bytes) -> None:
        """Append bytes."""
        self._pending.append(data)
        self._size += len(data)
        if self._size >= _PIECE:
            self._flush()

    def close(self) -> None:
        """Truncate the file here, and sync it to disk."""
        self._flush(is_last=True)
        if os.fstat(self._handle).st_size > self._at:
            os.ftruncate(self._handle, self._at)
        os.fsync(self._handle)

    def _flush(self, *, is_last: bool = False) -> None:
        """Write the buffered bytes: whole rows only, unless this is the last piece."""
        data = b"".join(self._pending)
        size = len(data) if is_last else len(data) - (self._at + len(data)) % journal.ROW
        record, self._digest = journal.pack_piece(self._digest, self._at, data[:size], is_last=is_last)
        _append(self.journal.file.handle, record)
        os.fsync(self.journal.file.handle)
        journal.write_at(self._handle, memoryview(data)[:size], self._at)
        self._at += size
        self._pending, self._size = [data[size:]], len(data) - size


@contextmanager
def rewrite_tail(path: Path, handle: int, start: int, log: OpenFile) -> Iterator[TailWriter]:
    """Rewrite the tail of a locked log from ``start`` on; if the block fails, the old tail is restored.

    ``handle`` is open for reading and writing. The block must call ``close`` at its end. Raises McaptrackError if the
    journal can't be written.
    """
    journal_path = journal_of(path)
    if os.path.lexists(journal_path):  # created since the log was locked
        raise McaptrackError(f"{journal_path} can't be written: there is something else with that name")
    try:
        written, digest = _write_journal(path, handle, start, log)
    except BaseException as why:
        journal_path.unlink(missing_ok=True)  # the log has not been changed yet
        if isinstance(why, OSError):
            raise McaptrackError(f"{journal_path} can't be written: {why.strerror or why}") from why
        raise
    try:
        try:
            yield TailWriter(handle, written, digest)
        except BaseException as why:
            _roll_back(path, handle, written, why)
            raise
        try:
            journal.remove(path)
        except OSError as error:  # the change itself is complete
            notices.warn(
                f"{path} is complete, but {journal_path} can't be removed ({error.strerror}); the next command that "
                "writes to the log removes it",
                "journal",
            )
    finally:
        fcntl.flock(written.file.handle, fcntl.LOCK_UN)


def _roll_back(path: Path, handle: int, written: Journal, why: BaseException) -> None:
    """Restore the old tail. Raises McaptrackError if that fails."""
    try:
        written.restore(handle)
        journal.remove(path)
    except (OSError, Damaged) as error:
        raise McaptrackError(
            f"{path} can't be written ({why}), and its old state can't be restored ({error}); while {journal_of(path)} "
            "exists, commands that read it see the old state, and the next command that writes to it restores that"
        ) from why


def _write_journal(path: Path, handle: int, start: int, log: OpenFile) -> tuple[Journal, bytes]:
    """Write a journal with the old tail beside a log and sync it to disk; it stays open and locked."""
    status = os.fstat(handle)
    head = journal.pack_head(handle, start)
    with publish(journal_of(path)) as part:
        file = OpenFile(os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC, 0o600))
        fcntl.flock(file.handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if keep_attributes(path, part):  # users who may not read the log may not read its tail either
            part.chmod(status.st_mode & 0o700)
        _append(file.handle, head)
        for at in range(start, status.st_size, _BLOCK):
            _append(file.handle, os.pread(handle, min(_BLOCK, status.st_size - at), at))
    return Journal(file, log, start, status.st_size, written_to=start), journal.digest_of(head)


def _append(handle: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(handle, view) :]
