"""The rollback journal beside a log: the tail of the file before a change, and proof of which file it belongs to.

LOG.journal lies beside a log while the tail of the log is rewritten (``log/in_place.py``), and stays there if that is
interrupted. It holds the old tail, the identity of the file, and checksums of each piece that was going to be written.
A reader can therefore decide whether the file holds the old tail, the new one, or a mixture that only this change can
have left. Only such a mixture is rolled back. Processes that only read see the old tail through the journal
(``Journal.old_content``) and change nothing.

Format: the magic line; a head (``_HEAD``); a SHA-256 of both; the old tail; then for each piece a record
(``_PIECE_HEAD``), a CRC-32 of every row of 512 bytes that the piece touches (rows count from the beginning of the log),
and a SHA-256 of this record and of the previous digest. An incomplete record at the end belongs to a piece that was
never written to the log.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shlex
import stat
import struct
import zlib
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError, call
from mcaptrack.files import follow_links, sync_folder
from mcaptrack.location import Location, Url, sibling
from mcaptrack.log.byte_source import ByteSource, OpenFile, Piece, ReadFile, file_type, read_exactly
from mcaptrack.log.chunks import chunk_record, open_chunk
from mcaptrack.log.index import read_index, starts_with_magic
from mcaptrack.log.records import MAGIC, Damaged

State = Literal["busy", "old", "new", "between"]

_MAGIC: Final = b"mcaptrack journal 2\n"
#: The length of the journal up to the end of the old tail; device, file system and inode of the log; the size of the
#: log and the offset of its old tail; digests of the bytes before the old tail (see ``_identity``) and of the old tail.
_HEAD: Final = struct.Struct("<QQQQQQ32s32s")
#: Offset and size of a piece; the final size of the log if it is the last piece, else ``_NOT_LAST``.
_PIECE_HEAD: Final = struct.Struct("<QQQ")
_NOT_LAST: Final = 2**64 - 1
_DIGEST_SIZE: Final = 32
_HEAD_SIZE: Final = len(_MAGIC) + _HEAD.size + _DIGEST_SIZE
#: The first bytes of a log and the bytes before its old tail identify it: this many of each.
_IDENTITY_BYTES: Final = 64 * 2**10
#: Pieces are compared in rows of one disk sector, the unit in which disks write.
ROW: Final = 512
_BLOCK: Final = 2**20
_CHANGED: Final = "does not fit any more: the log has been changed since"
#: A killed write and a killed rollback can each leave one row that is only partly written.
_MAX_TORN_ROWS: Final = 2


class UnusableJournal(Exception):
    """The file at LOG.journal can't be used; the message goes on after its name."""


def journal_of(path: Path) -> Path:
    """The path of the journal of a log."""
    return sibling(path, ".journal", of=path.name)


def remove_hint(path: Path) -> str:
    """The shell command that removes the file or folder at LOG.journal."""
    journal = journal_of(path)
    folder = journal.is_dir() and not journal.is_symlink()
    return f"`rm {'-r ' if folder else ''}{shlex.quote(str(journal))}`"


@dataclass
class Journal:
    """A complete journal that belongs to the log beside it.

    ``start`` is the offset of the old tail and ``size`` the old size of the log. ``rows`` are the checksums of all rows
    from the one that contains ``start`` up to offset ``written_to``. ``final`` is the new size of the log, if known.
    """

    file: OpenFile
    log: OpenFile
    start: int
    size: int
    at: int = _HEAD_SIZE
    rows: list[int] = field(default_factory=list)
    written_to: int = 0
    final: int | None = None

    def pieces(self) -> tuple[Piece, ...]:
        """The log before the change: the bytes before the old tail, and the old tail."""
        return Piece(self.log, 0, self.start), Piece(self.file, self.at, self.size - self.start)

    def old_content(self) -> ByteSource:
        """The bytes of the log before the change."""
        return ByteSource(self.pieces())

    def old_tail(self) -> ByteSource:
        """The old bytes of the log from ``start`` on."""
        return ByteSource(self.pieces()[1:])

    def state(self) -> State:
        """The current content of the log. Raises UnusableJournal if the change can't have left that."""
        try:
            fcntl.flock(self.file.handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
            fcntl.flock(self.file.handle, fcntl.LOCK_UN)
        except BlockingIOError:
            return "busy"
        except OSError:  # a file system without locks: no other process can hold one
            pass
        return _Comparison(self).state()

    def restore(self, handle: int) -> None:
        """Write the old tail back. Can be interrupted and repeated."""
        old = self.old_tail()
        for at in range(0, len(old), _BLOCK):
            write_at(handle, old[at : min(at + _BLOCK, len(old))], self.start + at)
        os.ftruncate(handle, self.size)
        os.fsync(handle)


class _Comparison:
    """Compares a log, row by row, with its old content and with the content that was going to be written."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._now = ByteSource.of(journal.log)
        self._first = journal.start // ROW
        final = journal.size if journal.final is None else journal.final
        #: From this offset on the file may hold zeros: it was extended, but the data did not reach the disk.
        self._zeros_from = min(journal.size, final)

    def state(self) -> State:
        journal, now = self._journal, len(self._now)
        if not self._zeros_from <= now <= max(journal.size, journal.written_to):
            raise UnusableJournal(_CHANGED)
        old = journal.old_content()
        is_old, is_new, torn = now == journal.size, now == journal.final, 0
        for low in range(self._first * ROW, now, _BLOCK):
            high = min(low + _BLOCK, now)
            now_rows, before = _rows(self._now, low, high, high), _rows(old, low, min(high, len(old)), high)
            differs = (now_rows != before).any(axis=1)
            is_old &= not differs.any()
            for row in range(len(now_rows)) if is_new else np.flatnonzero(differs).tolist():
                at, pair = low + row * ROW, (now_rows[row], before[row])
                if not self._is_new(at, *pair):
                    is_new = False
                    torn += bool(differs[row]) and not self._is_old_then_zero(at, *pair)
            if torn > _MAX_TORN_ROWS:
                raise UnusableJournal(_CHANGED)
        if torn and self._is_sound():
            raise UnusableJournal(_CHANGED)
        return "old" if is_old else "new" if is_new else "between"

    def _is_new(self, at: int, row_now: NDArray[np.uint8], before: NDArray[np.uint8]) -> bool:
        """Whether the row at offset ``at`` holds what was going to be written."""
        journal = self._journal
        number = at // ROW - self._first
        if number >= len(journal.rows):
            return False
        low, high = max(journal.start - at, 0), min(journal.written_to - at, ROW)
        rest = row_now[high:]
        is_rest_known = not rest.any() or bool((rest == before[high:]).all())
        return is_rest_known and zlib.crc32(row_now[low:high].tobytes()) == journal.rows[number]

    def _is_old_then_zero(self, at: int, row_now: NDArray[np.uint8], before: NDArray[np.uint8]) -> bool:
        if at + ROW <= self._zeros_from:
            return False
        low = max(self._zeros_from - at, 0)
        return bool((row_now[:low] == before[:low]).all() and not row_now[low:].any())

    def _is_sound(self) -> bool:
        """Whether the file is a log with a readable end: then its change was finished and must not be rolled back."""
        try:
            index = read_index(self._now)
            if index.loose and not index.data_crc:
                return False  # nothing tells whether messages outside of chunks are whole
            for chunk in index.chunks:
                if chunk.chunk_start_offset >= self._journal.start:
                    open_chunk(self._now, chunk_record(self._now, chunk))
        except Damaged:
            return False
        return True


def _rows(source: ByteSource, low: int, high: int, until: int) -> NDArray[np.uint8]:
    """The bytes from ``low`` to ``high`` as rows, padded with zeros up to the row that contains ``until``."""
    data = bytes(source[low:high]) if high > low else b""
    return np.frombuffer(data.ljust(-(-(until - low) // ROW) * ROW, b"\0"), np.uint8).reshape(-1, ROW)


def row_checksums(data: bytes, at: int) -> list[int]:
    """The CRC of each row, or part of a row, that ``data`` fills when it is written at offset ``at``."""
    first = -at % ROW
    edges = [0, *range(first or ROW, len(data), ROW), len(data)]
    return [zlib.crc32(data[low:high]) for low, high in pairwise(edges)]


# Writing a journal


def pack_head(handle: int, start: int) -> bytes:
    """The part of a journal before the old tail, for a log that is going to be rewritten from ``start`` on."""
    status = os.fstat(handle)
    old = hashlib.sha256()
    for at in range(start, status.st_size, _BLOCK):
        old.update(read_exactly(handle, at, min(_BLOCK, status.st_size - at)))
    length = _HEAD_SIZE + status.st_size - start
    place = (status.st_dev, os.fstatvfs(handle).f_fsid % 2**64, status.st_ino)
    head = _MAGIC + _HEAD.pack(length, *place, status.st_size, start, _identity(handle, start), old.digest())
    return head + hashlib.sha256(head).digest()


def digest_of(head: bytes) -> bytes:
    """The digest that the first piece record continues."""
    return head[-_DIGEST_SIZE:]


def pack_piece(before: bytes, at: int, data: bytes, *, is_last: bool) -> tuple[bytes, bytes]:
    """The record of a piece that is going to be written, and its digest; ``before`` is the previous digest."""
    final = at + len(data) if is_last else _NOT_LAST
    record = _PIECE_HEAD.pack(at, len(data), final) + np.array(row_checksums(data, at), "<u4").tobytes()
    digest = hashlib.sha256(before + record).digest()
    return record + digest, digest


def write_at(handle: int, data: bytes | memoryview, at: int) -> None:
    """Write all of the data at an offset of an open file."""
    view = memoryview(data)
    while view:
        written = os.pwrite(handle, view, at)
        view, at = view[written:], at + written


def remove(path: Path) -> None:
    """Remove the journal of a log."""
    journal_of(path).unlink()
    sync_folder(path.parent)


# Reading a journal


def find(path: Path, log: OpenFile) -> Journal | None:
    """The journal beside an open log; None if there is none. Raises UnusableJournal if it can't be used."""
    file = _open(journal_of(path), log)
    if file is None:
        return None
    journal, is_known = _read(file, log)
    if not is_known:
        raise UnusableJournal(f"belongs to another file than {path} is now")
    if not starts_with_magic(ByteSource.of(log)):
        raise UnusableJournal(f"can't belong to {path}, which is not an MCAP file")
    return journal


def is_left_behind(path: Path) -> bool:
    """Whether an interrupted change of the file at ``path`` has left its journal behind."""
    try:
        state = None if path.is_symlink() or not path.is_file() else find(path, OpenFile.at(path))
        return state is not None and state.state() != "busy"
    except (UnusableJournal, McaptrackError):
        return False


def load_old_content(path: Path, log: OpenFile) -> ByteSource | None:
    """The old content of the log by any journal with matching checksums: also of a copied log.

    None if there is none. Only for writing the content to another file, because it does not prove that the journal
    belongs to this file.
    """
    try:
        file = _open(journal_of(path), log)
        if file is None:
            return None
        return _read(file, log)[0].old_content()
    except (UnusableJournal, Damaged):
        return None


def _open(path: Path, log: OpenFile) -> OpenFile | None:
    """Open LOG.journal if it is a regular file of a user who may write to the log."""
    try:
        kind = file_type(os.lstat(path).st_mode)
        if kind:
            raise UnusableJournal(f"is {kind}")
        file = OpenFile(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise UnusableJournal(f"can't be opened: {error.strerror}") from None
    status = os.fstat(file.handle)
    if not stat.S_ISREG(status.st_mode):
        raise UnusableJournal(f"is {file_type(status.st_mode)}")
    if status.st_uid not in (os.fstat(log.handle).st_uid, os.geteuid(), 0):
        raise UnusableJournal("belongs to another user than the log")
    return file


def _read(file: OpenFile, log: OpenFile) -> tuple[Journal, bool]:
    """A journal, and whether it names this file. Raises UnusableJournal if it is invalid or the log has changed."""
    source = ByteSource.of(file)
    head = bytes(source[0:_HEAD_SIZE])
    if not head.startswith(_MAGIC):
        raise UnusableJournal("is not a journal of mcaptrack")
    incomplete = UnusableJournal("is an incomplete or damaged journal of mcaptrack")
    digest = digest_of(head)
    if len(head) < _HEAD_SIZE or hashlib.sha256(head[:-_DIGEST_SIZE]).digest() != digest:
        raise incomplete
    length, device, file_system, inode, size, start, identity, old = _HEAD.unpack_from(head, len(_MAGIC))
    if not len(MAGIC) <= start <= size or length != _HEAD_SIZE + size - start or length > len(source):
        raise incomplete
    content = hashlib.sha256()
    for at in range(_HEAD_SIZE, length, _BLOCK):
        content.update(source[at : min(at + _BLOCK, length)])
    if content.digest() != old:
        raise incomplete
    try:
        is_known = _identity(log.handle, start) == identity
    except Damaged:  # the log is shorter than that
        is_known = False
    if not is_known:
        raise UnusableJournal("belongs to a log with another beginning")
    journal = Journal(file, log, start, size, written_to=start)
    _read_pieces(journal, source, length, digest)
    status = os.fstat(log.handle)
    is_there = device == status.st_dev or file_system == os.fstatvfs(log.handle).f_fsid % 2**64
    return journal, is_there and inode == status.st_ino


def _read_pieces(journal: Journal, source: ByteSource, at: int, digest: bytes) -> None:
    """Read the complete piece records of a journal."""
    while at + _PIECE_HEAD.size <= len(source) and journal.final is None:
        place, size, final = _PIECE_HEAD.unpack(source[at : at + _PIECE_HEAD.size])
        rows = -(-(place + size) // ROW) - place // ROW
        end = at + _PIECE_HEAD.size + 4 * rows
        if place != journal.written_to or not size or end + _DIGEST_SIZE > len(source):
            return
        digest = hashlib.sha256(digest + bytes(source[at:end])).digest()
        if digest != bytes(source[end : end + _DIGEST_SIZE]):
            return
        journal.rows += np.frombuffer(source[at + _PIECE_HEAD.size : end], "<u4").tolist()
        journal.written_to = place + size
        journal.final = None if final == _NOT_LAST else final
        at = end + _DIGEST_SIZE


def _identity(handle: int, start: int) -> bytes:
    """A digest that identifies a log: of its first bytes and of the bytes just before ``start``."""
    first = max(0, start - _IDENTITY_BYTES)
    parts = (read_exactly(handle, 0, min(_IDENTITY_BYTES, start)), read_exactly(handle, first, start - first))
    return hashlib.sha256(b"".join(parts)).digest()


# Detect the journal that lies beside a log, and the messages about logs that changed or are damaged.


class JournalFinding(NamedTuple):
    """A file at LOG.journal: a message about it, and ``journal`` if the log must be read through it."""

    message: str
    journal: Journal | None = None
    is_busy: bool = False


def find_journal(path: Location, file: ReadFile) -> JournalFinding | None:
    """The state of the journal beside a log that is opened for reading; None if there is no journal."""
    if isinstance(path, Url) or not isinstance(file, OpenFile):
        return None  # objects are replaced as a whole
    real_path = follow_links(path)
    try:
        journal = find(real_path, file)
        state = journal.state() if journal else None
    except UnusableJournal as why:
        message = f"{journal_of(real_path)} {why}; it is ignored, and {path} is read as it is. "
        if load_old_content(real_path, file):
            message += (
                f"If it was left half written, {recover_command(path)} restores its state before the change. Then"
            )
        else:
            message += "If no other program needs it,"
        return JournalFinding(f"{message} remove it with {remove_hint(real_path)}")
    if state == "busy":
        return JournalFinding(
            f"{path} is being written to by another process; its state before that is read", journal, True
        )
    if state == "between":
        half = f"{path} was left half written by an interrupted change; its state before that change is read"
        return JournalFinding(f"{half}. The next command that writes to it restores that state on the disk", journal)
    left = f"{journal_of(real_path)} was left behind by an interrupted change of {path}; the log is complete"
    return JournalFinding(f"{left}. The next command that writes to it removes the journal") if state else None


def changed(path: Location) -> McaptrackError:
    """The error for a file that another process changed while it was read."""
    return McaptrackError(f"{path} was changed by another process while it was being read; try again")


def recover_hint(path: Location) -> str:
    """The hint for a damaged log: the command that recovers what is intact."""
    return f"{recover_command(path)} saves what is intact"


def recover_command(path: Location) -> str:
    """The command that recovers a damaged log."""
    return call("recover", path)
