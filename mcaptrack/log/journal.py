"""The journal beside a log: what stood at its end before it was changed, and proof of whose end that is.

LOG.journal lies beside a log while its end is written anew (``log/in_place.py``), and stays if that is interrupted. It
holds the old end, what tells the log from every other file, and checksums of each piece that was going to be written.
So it can be told whether what stands in the file now is the old end, the new one, or a state between the two that
only this change can have left. Only such a state is ever undone. Whoever only reads sees the old end through the
journal (``Journal.overlay``) and changes nothing.

The file: the magic line; a head (``_HEAD``); a SHA-256 of both; the old end; then for each piece a record
(``_ADDED``), a CRC-32 of every row of 512 bytes that the piece touches, counted from the beginning of the log, and a
SHA-256 of all that and of the digest before. What is torn off at the end was never begun to be written.
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
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.files import sync_folder
from mcaptrack.log.byte_source import ByteSource, OpenFile, Piece, file_type, read_exactly
from mcaptrack.log.chunks import chunk_record, open_chunk
from mcaptrack.log.index import begins_as_log, read_index
from mcaptrack.log.records import MAGIC, Damaged

State = Literal["busy", "old", "new", "between"]

_FIRST_MAGIC: Final = b"mcaptrack journal 1\n"
_MAGIC: Final = b"mcaptrack journal 2\n"
#: The length of everything up to the end of the old end; device, file system and inode of the log; its size and where
#: its old end starts; digests of what stands before the old end, and of the old end.
_HEAD: Final = struct.Struct("<QQQQQQ32s32s")
#: Where a piece goes and its size; where the file ends when it is written, if it is the last, else ``_NOT_LAST``.
_ADDED: Final = struct.Struct("<QQQ")
_NOT_LAST: Final = 2**64 - 1
_DIGEST_SIZE: Final = 32
_HEAD_SIZE: Final = len(_MAGIC) + _HEAD.size + _DIGEST_SIZE
#: How version 1 began: where the old end starts, the size of the log, a CRC of what stood before, one of the old end.
_FIRST_HEAD: Final = struct.Struct("<QQII")
#: How much of the beginning of a log, and of what stands before its old end, shows that it is the same.
_KNOWN: Final = 64 * 2**10
#: Pieces are compared in rows as disks write them.
ROW: Final = 512
_BLOCK: Final = 2**20
_CHANGED: Final = "does not fit any more: the log has been changed since"
#: A write that was killed, and a rollback that was, can leave so many rows of which a part is written.
_TORN: Final = 2


class Unfit(Exception):
    """Why what lies at LOG.journal is not to be used, in words that follow its name."""


def journal_of(path: Path) -> Path:
    """Where the journal of a file lies while its end is being changed."""
    return path.with_name(path.name + ".journal")


def remove_words(path: Path) -> str:
    """How to remove what lies at LOG.journal."""
    journal = journal_of(path)
    folder = journal.is_dir() and not journal.is_symlink()
    return f"`rm {'-r ' if folder else ''}{shlex.quote(str(journal))}`"


@dataclass
class Journal:
    """A journal that is whole, and fits the file that it was found beside.

    ``start`` is where the old end began, ``size`` how long the log was, ``rows`` the checksums of all rows from the one
    that ``start`` is in to the one that ends at or holds ``written_to``; ``final`` is where the new end ends, if known.
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
        """The log as it was: what is before the old end, and the old end."""
        return Piece(self.log, 0, self.start), Piece(self.file, self.at, self.size - self.start)

    def overlay(self) -> ByteSource:
        """The bytes of the log as it was."""
        return ByteSource(self.pieces())

    def old_end(self) -> ByteSource:
        """The bytes that stood from ``start`` on."""
        return ByteSource(self.pieces()[1:])

    def state(self) -> State:
        """What stands in the log. Raises Unfit if it is nothing that the change can have left."""
        try:
            fcntl.flock(self.file.handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
            fcntl.flock(self.file.handle, fcntl.LOCK_UN)
        except BlockingIOError:
            return "busy"
        except OSError:  # without locks no other process can be at work
            pass
        return _Comparison(self).state()

    def put_back(self, handle: int) -> None:
        """The old end takes its place again. May be done any number of times, and be interrupted."""
        old = self.old_end()
        for at in range(0, len(old), _BLOCK):
            write_at(handle, old[at : min(at + _BLOCK, len(old))], self.start + at)
        os.ftruncate(handle, self.size)
        os.fsync(handle)


class _Comparison:
    """A log, row by row, beside what it was and what it was to become."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._now = ByteSource.of(journal.log)
        self._first = journal.start // ROW
        final = journal.size if journal.final is None else journal.final
        #: From here on the file may hold zeros: it was made longer, and what follows did not reach the disk.
        self._zeros_from = min(journal.size, final)

    def state(self) -> State:
        journal, now = self._journal, len(self._now)
        if not self._zeros_from <= now <= max(journal.size, journal.written_to):
            raise Unfit(_CHANGED)
        old = journal.overlay()
        is_old, is_new, torn = now == journal.size, now == journal.final, 0
        for low in range(self._first * ROW, now, _BLOCK):
            high = min(low + _BLOCK, now)
            there, before = _rows(self._now, low, high, high), _rows(old, low, min(high, len(old)), high)
            differs = (there != before).any(axis=1)
            is_old &= not differs.any()
            for row in range(len(there)) if is_new else np.flatnonzero(differs).tolist():
                at, pair = low + row * ROW, (there[row], before[row])
                if not self._is_new(at, *pair):
                    is_new = False
                    torn += bool(differs[row]) and not self._is_old_then_zero(at, *pair)
            if torn > _TORN:
                raise Unfit(_CHANGED)
        if torn and self._is_sound():
            raise Unfit(_CHANGED)
        return "old" if is_old else "new" if is_new else "between"

    def _is_new(self, at: int, there: NDArray[np.uint8], before: NDArray[np.uint8]) -> bool:
        """Whether the row at byte ``at`` says what was going to be written."""
        journal = self._journal
        number = at // ROW - self._first
        if number >= len(journal.rows):
            return False
        low, high = max(journal.start - at, 0), min(journal.written_to - at, ROW)
        rest = there[high:]
        is_rest_known = not rest.any() or bool((rest == before[high:]).all())
        return is_rest_known and zlib.crc32(there[low:high].tobytes()) == journal.rows[number]

    def _is_old_then_zero(self, at: int, there: NDArray[np.uint8], before: NDArray[np.uint8]) -> bool:
        if at + ROW <= self._zeros_from:
            return False
        low = max(self._zeros_from - at, 0)
        return bool((there[:low] == before[:low]).all() and not there[low:].any())

    def _is_sound(self) -> bool:
        """Whether the file is a log whose end can be read: then it was finished, and is not to be undone."""
        try:
            index = read_index(self._now)
            for chunk in index.chunks:
                if chunk.offset >= self._journal.start:
                    open_chunk(self._now, chunk_record(self._now, chunk))
        except Damaged:
            return False
        return True


def _rows(source: ByteSource, low: int, high: int, until: int) -> NDArray[np.uint8]:
    """The bytes from ``low`` to ``high`` in rows, with zeros behind them up to ``until`` and to the end of its row."""
    data = bytes(source[low:high]) if high > low else b""
    return np.frombuffer(data.ljust(-(-(until - low) // ROW) * ROW, b"\0"), np.uint8).reshape(-1, ROW)


def row_checksums(data: bytes, at: int) -> list[int]:
    """The CRC of the part of each row that ``data`` fills, when it goes to byte ``at`` of a file."""
    first = -at % ROW
    edges = [0, *range(first or ROW, len(data), ROW), len(data)]
    return [zlib.crc32(data[low:high]) for low, high in pairwise(edges)]


# Writing one


def pack_head(handle: int, start: int) -> bytes:
    """Everything before the old end, of the journal for a log whose end from ``start`` on is to be changed."""
    there = os.fstat(handle)
    old = hashlib.sha256()
    for at in range(start, there.st_size, _BLOCK):
        old.update(read_exactly(handle, at, min(_BLOCK, there.st_size - at)))
    length = _HEAD_SIZE + there.st_size - start
    place = (there.st_dev, os.fstatvfs(handle).f_fsid % 2**64, there.st_ino)
    head = _MAGIC + _HEAD.pack(length, *place, there.st_size, start, _known(handle, start), old.digest())
    return head + hashlib.sha256(head).digest()


def digest_of(head: bytes) -> bytes:
    """The digest that the records of pieces go on from."""
    return head[-_DIGEST_SIZE:]


def pack_added(before: bytes, at: int, data: bytes, *, is_last: bool) -> tuple[bytes, bytes]:
    """The record of a piece that is going to be written, and its digest, ``before`` being that of the record before."""
    final = at + len(data) if is_last else _NOT_LAST
    record = _ADDED.pack(at, len(data), final) + np.array(row_checksums(data, at), "<u4").tobytes()
    digest = hashlib.sha256(before + record).digest()
    return record + digest, digest


def write_at(handle: int, data: bytes | memoryview, at: int) -> None:
    """All of the data, at a place of an open file."""
    view = memoryview(data)
    while view:
        written = os.pwrite(handle, view, at)
        view, at = view[written:], at + written


def remove(path: Path) -> None:
    """Remove the journal of a log."""
    journal_of(path).unlink()
    sync_folder(path.parent)


# Reading one


def find(path: Path, log: OpenFile) -> Journal | None:
    """The journal beside an open log; None if nothing lies there. Raises Unfit if what lies there is of no use."""
    file = _open(journal_of(path), log)
    if file is None:
        return None
    journal, is_known = _read(file, log)
    if not is_known:
        raise Unfit(f"is of another file than {path} is now")
    if not begins_as_log(ByteSource.of(log)):
        raise Unfit(f"can't be of {path}, which is no MCAP file")
    return journal


def is_left(path: Path) -> bool:
    """Whether the file at ``path`` has a journal of its own that an interrupted change left."""
    try:
        found = None if path.is_symlink() or not path.is_file() else find(path, OpenFile.at(path))
        return found is not None and found.state() != "busy"
    except (Unfit, McaptrackError):
        return False


def find_content(path: Path, log: OpenFile) -> ByteSource | None:
    """The log as it was by a journal whose content fits, be it of version 1 or of a log that was copied since.

    None if there is none. For whoever writes that elsewhere: it does not prove that the journal is of this file.
    """
    try:
        file = _open(journal_of(path), log)
        if file is None:
            return None
        if bytes(ByteSource.of(file)[0 : len(_MAGIC)]) == _FIRST_MAGIC:
            return _read_first(file, log)
        return _read(file, log)[0].overlay()
    except (Unfit, Damaged):
        return None


def _open(path: Path, log: OpenFile) -> OpenFile | None:
    """What lies at LOG.journal, if it is a file of a user who may be trusted with the log."""
    try:
        kind = file_type(os.lstat(path).st_mode)
        if kind:
            raise Unfit(f"is {kind}")
        file = OpenFile(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise Unfit(f"can't be opened: {error.strerror}") from None
    found = os.fstat(file.handle)
    if not stat.S_ISREG(found.st_mode):
        raise Unfit(f"is {file_type(found.st_mode)}")
    if found.st_uid not in (os.fstat(log.handle).st_uid, os.geteuid(), 0):
        raise Unfit("belongs to another user than the log")
    return file


def _read(file: OpenFile, log: OpenFile) -> tuple[Journal, bool]:
    """A journal and whether it names the log as its own. Raises Unfit if it is none, or the log is not what it was."""
    source = ByteSource.of(file)
    head = bytes(source[0:_HEAD_SIZE])
    if head.startswith(_FIRST_MAGIC):
        raise Unfit("was left by version 0.1.0, whose journals don't say which file they are of")
    if not head.startswith(_MAGIC):
        raise Unfit("is no journal of mcaptrack")
    incomplete = Unfit("is an incomplete or damaged journal of mcaptrack")
    digest = digest_of(head)
    if len(head) < _HEAD_SIZE or hashlib.sha256(head[:-_DIGEST_SIZE]).digest() != digest:
        raise incomplete
    length, device, file_system, inode, size, start, known, old = _HEAD.unpack_from(head, len(_MAGIC))
    if not len(MAGIC) <= start <= size or length != _HEAD_SIZE + size - start or length > len(source):
        raise incomplete
    found = hashlib.sha256()
    for at in range(_HEAD_SIZE, length, _BLOCK):
        found.update(source[at : min(at + _BLOCK, length)])
    if found.digest() != old:
        raise incomplete
    try:
        is_known = _known(log.handle, start) == known
    except Damaged:  # it is shorter than that
        is_known = False
    if not is_known:
        raise Unfit("is of a log that began differently")
    journal = Journal(file, log, start, size, written_to=start)
    _read_added(journal, source, length, digest)
    there = os.fstat(log.handle)
    is_there = device == there.st_dev or file_system == os.fstatvfs(log.handle).f_fsid % 2**64
    return journal, is_there and inode == there.st_ino


def _read_added(journal: Journal, source: ByteSource, at: int, digest: bytes) -> None:
    """Take what was going to be written into a journal, as far as that is whole."""
    while at + _ADDED.size <= len(source) and journal.final is None:
        place, size, final = _ADDED.unpack(source[at : at + _ADDED.size])
        rows = -(-(place + size) // ROW) - place // ROW
        end = at + _ADDED.size + 4 * rows
        if place != journal.written_to or not size or end + _DIGEST_SIZE > len(source):
            return
        digest = hashlib.sha256(digest + bytes(source[at:end])).digest()
        if digest != bytes(source[end : end + _DIGEST_SIZE]):
            return
        journal.rows += np.frombuffer(source[at + _ADDED.size : end], "<u4").tolist()
        journal.written_to = place + size
        journal.final = None if final == _NOT_LAST else final
        at = end + _DIGEST_SIZE


def _read_first(file: OpenFile, log: OpenFile) -> ByteSource | None:
    """The log as it was by a journal of version 1, if its checksums are right."""
    source = ByteSource.of(file)
    begin = len(_FIRST_MAGIC) + _FIRST_HEAD.size + 4
    head = bytes(source[len(_FIRST_MAGIC) : begin])
    if len(head) < begin - len(_FIRST_MAGIC) or zlib.crc32(head[:-4]).to_bytes(4, "little") != head[-4:]:
        return None
    start, size, before, old = _FIRST_HEAD.unpack_from(head)
    if not len(MAGIC) <= start <= size or len(source) - begin != size - start:
        return None
    journal = Journal(file, log, start, size, at=begin)
    first = max(0, start - _KNOWN)
    is_right = zlib.crc32(log.read(first, start - first)) == before
    return journal.overlay() if is_right and zlib.crc32(bytes(source[begin : len(source)])) == old else None


def _known(handle: int, start: int) -> bytes:
    """A digest of the beginning of a log and of what stands just before ``start``."""
    first = max(0, start - _KNOWN)
    parts = (read_exactly(handle, 0, min(_KNOWN, start)), read_exactly(handle, first, start - first))
    return hashlib.sha256(b"".join(parts)).digest()
