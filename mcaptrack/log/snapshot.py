"""A log as it was at one moment, whatever becomes of its file meanwhile."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final, TypeVar

from mcaptrack import notices
from mcaptrack.errors import DamagedError, McaptrackError, command
from mcaptrack.log import records
from mcaptrack.log.byte_source import ByteSource, OpenFile, Signature
from mcaptrack.log.index import Index, read_index
from mcaptrack.log.journal_check import changed, find_journal, recover_words
from mcaptrack.log.messages import Messages, TimeOutOfRange
from mcaptrack.log.records import Damaged

T = TypeVar("T")

#: How long to wait for another process that is changing the file just now, and between two looks.
_PATIENCE_S: Final = 1.0
_PAUSE_S: Final = 0.02


class Snapshot:
    """An open log, as it was when its file had ``signature``.

    When the file has changed since, what is read from now on is compared with what stands there then, and everything
    that was read before, too: what is not the same is an error, so that nothing is half old and half new.
    """

    def __init__(
        self, path: Path, file: OpenFile, source: ByteSource, index: Index, signature: Signature, is_certain: bool
    ) -> None:
        self.path, self.file, self.source, self.index = path, file, source, index
        self.messages = Messages(source, index)
        self._signature = signature
        self._is_certain = is_certain
        self._fresh: Messages | None = None  # the log as it was found when it had this signature
        self._fresh_at: Signature | None = None

    def confirm(self, channels: Sequence[int]) -> None:
        """Raises McaptrackError if what was read may be half of what was there, and half of what is there now."""
        try:
            fresh = self._now()
            if fresh is None:
                return
            if all(self.index.agrees(fresh.index, one) for one in channels) and self.messages.are_in(fresh.source):
                return
        except Damaged:
            pass
        raise changed(self.path)

    def confirm_all(self) -> None:
        """Raises McaptrackError if the file was changed at all."""
        if Signature.of(self.file.handle) != self._signature and not self.is_through_journal:
            raise changed(self.path)

    def still(self, look: Callable[[Messages], T], are_equal: Callable[[T, T], bool]) -> T:
        """What is found in the log, and found once more if the file was changed meanwhile."""
        found, fresh = look(self.messages), self._now()
        if fresh is not None and not are_equal(found, look(fresh)):
            raise changed(self.path)
        return found

    def record(self, offset: int) -> memoryview:
        """The record that stands at an offset of the file."""

        def whole(messages: Messages) -> memoryview:
            found = records.record_at(messages.source, offset)
            return messages.source[found.start : found.end]

        return self.still(whole, memoryview.__eq__)

    @contextmanager
    def mending(self, topic: str = "") -> Iterator[None]:
        """What is found damaged in the block is said of this log, with what can be done."""
        try:
            yield
        except Damaged as error:
            if Signature.of(self.file.handle) != self._signature:
                raise changed(self.path) from None
            where = f"{self.path}: {topic}" if topic else str(self.path)
            raise DamagedError(f"{where} is damaged: {error}; {recover_words(self.path)}") from None

    @contextmanager
    def computing(self, topic: str) -> Iterator[None]:
        """The same for whoever takes times as signed numbers."""
        try:
            with self.mending(topic):
                yield
        except TimeOutOfRange as late:
            raise McaptrackError(
                f"{self.path}: {topic} has {late.count} messages later than the year 2262, the first at {late.t_ns} "
                "ns; they are kept as they are, but nothing is computed with such times "
                f"({command('drop', self.path, topic, '-o', 'OTHER.mcap')} leaves them out)"
            ) from None

    # The file

    @property
    def is_through_journal(self) -> bool:
        """Whether the log is seen as it was before a change that goes on, or was interrupted."""
        return len(self.source.pieces) > 1

    def is_on_disk(self, there: os.stat_result) -> bool:
        """Whether a file is the one that was opened, and says on the disk what it said then."""
        try:
            if not os.path.samestat(there, os.fstat(self.file.handle)):
                return False
            if Signature.of(self.file.handle) == self._signature and self._is_certain:
                return not self.is_through_journal
            on_disk = ByteSource.of(self.file)
            if not self.index.agrees_in_all(read_index(on_disk)):
                return False
        except Damaged:
            return False
        self.source.pieces = on_disk.pieces
        return True

    def _now(self) -> Messages | None:
        """The log as it is now; None if it has not changed.

        Raises Damaged if it is no log any more, and McaptrackError if it is being changed.
        """
        now = Signature.of(self.file.handle)
        is_certain = now.is_certain
        if now == self._signature and self._is_certain:
            return None
        if now != self._fresh_at:
            source = ByteSource(self.source.pieces) if self.is_through_journal else ByteSource.of(self.file)
            self._fresh, self._fresh_at = Messages(source, read_index(source)), None
            if self.index.agrees_in_all(self._fresh.index) and self.messages.are_in(self._fresh.source):
                self._signature, self._is_certain = now, is_certain
            elif is_certain:
                self._fresh_at = now
            if Signature.of(self.file.handle) != now:
                raise changed(self.path)
        return self._fresh


def take_snapshot(path: Path) -> Snapshot:
    """Open a log. Raises McaptrackError if it is none, is damaged, or goes on being changed."""
    until = time.monotonic() + _PATIENCE_S
    while True:
        file = OpenFile.at(path)
        try:
            found = _look(path, file)
        except BaseException:
            file.close()
            raise
        if isinstance(found, Snapshot):
            return found
        file.close()
        if time.monotonic() > until:
            raise found
        time.sleep(_PAUSE_S)


def _look(path: Path, file: OpenFile) -> Snapshot | McaptrackError:
    """What an open file holds; an error if that can't be told while it is being changed. Raises what won't pass."""
    signature = Signature.of(file.handle)
    is_certain = signature.is_certain
    try:
        found = find_journal(path, file)
        source = found.journal.overlay() if found and found.journal else ByteSource.of(file)
        if not len(source):
            raise Damaged("it is empty")
        index = read_index(source)
    except Damaged as error:
        hint = f"; {recover_words(path)}" if _may_be_log(file, signature.size) else ""
        words = McaptrackError(f"{path} can't be read as an MCAP file: {error}{hint}")
        if not _is_as_it_was(path, file, signature):
            return words
        if found:
            notices.warn(found.words, "journal")
        raise words from None
    if Signature.of(file.handle) != signature and not (found and found.is_busy):
        return McaptrackError(f"{path} is being changed by another process; try again when it is done")
    if found:
        notices.warn(found.words, "journal")
    return Snapshot(path, file, source, index, signature, is_certain)


def _may_be_log(file: OpenFile, size: int) -> bool:
    """Whether a file begins or ends as logs do, so that something can be saved of it."""
    ends = (os.pread(file.handle, len(records.MAGIC), at) for at in (0, max(size - len(records.MAGIC), 0)))
    return records.MAGIC in ends


def _is_as_it_was(path: Path, file: OpenFile, signature: Signature) -> bool:
    """Whether the path still leads to the file, which has not changed since."""
    try:
        return os.path.samestat(path.stat(), os.fstat(file.handle)) and Signature.of(file.handle) == signature
    except OSError:
        return False
