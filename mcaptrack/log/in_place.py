"""Writing the end of a log anew, in place, so that a kill at any instant leaves the old end or the new one.

Before the first byte changes, the old end stands complete and on the disk in a journal beside the log; before each
piece is written, its checksums stand there too (``log/journal.py``). The journal goes when the new end is on the disk.
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
from mcaptrack.files import keep_attributes, publish
from mcaptrack.log import journal
from mcaptrack.log.byte_source import OpenFile
from mcaptrack.log.journal import Journal, Unfit, journal_of
from mcaptrack.log.records import Damaged

#: How much is written at once.
_PIECE: Final = 4 * 2**20
_BLOCK: Final = 2**20


def lock(path: Path, handle: int) -> None:
    """Be the only one to write to an open file until the handle is closed. Raises McaptrackError if another is."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        raise _is_busy(path) from None
    try:
        same = os.path.samestat(path.stat(), os.fstat(handle))
    except OSError:
        same = False
    if not same:
        raise McaptrackError(f"{path} was replaced while it was being read; try again")


def settle(path: Path, handle: int, file: OpenFile) -> None:
    """Undo what an interrupted change left in a locked log, and remove its journal; both are said as warnings.

    Raises McaptrackError if something else lies where the journal goes.
    """
    try:
        found = journal.find(path, file)
        if found is None:
            return
        state = found.state()
        if state == "busy":
            raise _is_busy(path)
        if state == "between":
            found.put_back(handle)
    except Unfit as why:
        raise McaptrackError(
            f"{journal_of(path)} {why}; it lies where the journal goes while {path} is changed. "
            f"If nothing else needs it, remove it with {journal.remove_words(path)}"
        ) from None
    journal.remove(path)
    if state == "between":
        words = f"{path} was left half written by a change that was interrupted; it has been put back as it was before"
    else:
        words = f"{journal_of(path)} was left behind by a change that was interrupted; it has been removed"
    notices.warn(words, "journal")


def _is_busy(path: Path) -> McaptrackError:
    return McaptrackError(f"{path} is being written to by another process; try again when it is done")


class End:
    """The end of a locked log, being written anew. ``journal`` has what stood there."""

    def __init__(self, handle: int, written: Journal, digest: bytes) -> None:
        self._handle, self.journal, self._digest = handle, written, digest
        self._at = written.start
        self._waiting: list[bytes] = []
        self._size = 0

    def write(self, data: bytes) -> None:
        """Put more behind what was written."""
        self._waiting.append(data)
        self._size += len(data)
        if self._size >= _PIECE:
            self._flush()

    def close(self) -> None:
        """The file ends here; everything is on the disk."""
        self._flush(is_last=True)
        if os.fstat(self._handle).st_size > self._at:
            os.ftruncate(self._handle, self._at)
        os.fsync(self._handle)

    def _flush(self, *, is_last: bool = False) -> None:
        """Give what waits to the operating system, whole rows of it if more is to follow."""
        data = b"".join(self._waiting)
        size = len(data) if is_last else len(data) - (self._at + len(data)) % journal.ROW
        record, self._digest = journal.pack_added(self._digest, self._at, data[:size], is_last=is_last)
        _append(self.journal.file.handle, record)
        os.fsync(self.journal.file.handle)
        journal.write_at(self._handle, memoryview(data)[:size], self._at)
        self._at += size
        self._waiting, self._size = [data[size:]], len(data) - size


@contextmanager
def new_end(path: Path, handle: int, start: int, log: OpenFile) -> Iterator[End]:
    """Write the end of a locked log anew, from ``start`` on; all of it, or as it was if the block fails.

    ``handle`` is open for reading and writing. The block must call ``close`` when it is done. Raises McaptrackError if
    the journal can't be written.
    """
    beside = journal_of(path)
    if os.path.lexists(beside):  # it came since the log was locked
        raise McaptrackError(f"{beside} can't be written: something lies there already")
    try:
        written, digest = _begin(path, handle, start, log)
    except BaseException as why:
        beside.unlink(missing_ok=True)  # nothing has been changed yet
        if isinstance(why, OSError):
            raise McaptrackError(f"{beside} can't be written: {why.strerror or why}") from why
        raise
    try:
        try:
            yield End(handle, written, digest)
        except BaseException as why:
            _undo(path, handle, written, why)
            raise
        try:
            journal.remove(path)
        except OSError as error:  # what was to be done is done
            notices.warn(
                f"{path} is complete, but {beside} can't be removed ({error.strerror}); the next command that writes "
                "to the log removes it",
                "journal",
            )
    finally:
        fcntl.flock(written.file.handle, fcntl.LOCK_UN)


def _undo(path: Path, handle: int, written: Journal, why: BaseException) -> None:
    """Put the old end back. Raises McaptrackError if that can't be done now."""
    try:
        written.put_back(handle)
        journal.remove(path)
    except (OSError, Damaged) as error:
        raise McaptrackError(
            f"{path} can't be written ({why}), nor put back as it was ({error}); while {journal_of(path)} is there, "
            "commands that read see it as it was, and the next that writes to it puts it back"
        ) from why


def _begin(path: Path, handle: int, start: int, log: OpenFile) -> tuple[Journal, bytes]:
    """Put a journal with the old end beside a log, on the disk; it stays open, and locked."""
    there = os.fstat(handle)
    head = journal.pack_head(handle, start)
    with publish(journal_of(path)) as part:
        file = OpenFile(os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC, 0o600))
        fcntl.flock(file.handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if keep_attributes(path, part):  # whoever may not read the log may not read its end either
            part.chmod(there.st_mode & 0o700)
        _append(file.handle, head)
        for at in range(start, there.st_size, _BLOCK):
            _append(file.handle, os.pread(handle, min(_BLOCK, there.st_size - at), at))
    return Journal(file, log, start, there.st_size, written_to=start), journal.digest_of(head)


def _append(handle: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(handle, view) :]
