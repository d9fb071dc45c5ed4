"""A log as it was when it was opened, even if its file changes afterwards."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final, TypeVar

from mcaptrack import notices
from mcaptrack.errors import DamagedError, McaptrackError, call
from mcaptrack.location import Location, Url
from mcaptrack.log import records
from mcaptrack.log.byte_source import ByteSource, OpenFile, ReadFile, Signature, open_file
from mcaptrack.log.index import Index, read_index
from mcaptrack.log.journal import changed, find_journal, recover_hint
from mcaptrack.log.located import TimeOutOfRange
from mcaptrack.log.messages import Messages
from mcaptrack.log.records import Damaged

T = TypeVar("T")

#: The time to wait for another process that is changing the file, and the pause between two attempts.
_WAIT_S: Final = 1.0
_PAUSE_S: Final = 0.02


class Snapshot:
    """An open log, as it was when its file had ``signature``.

    If the file has changed since, everything that was read is compared with its present content. A difference is an
    error, so that no result is based on a mixture of old and new bytes.
    """

    def __init__(
        self, path: Location, file: ReadFile, source: ByteSource, index: Index, signature: Signature, is_certain: bool
    ) -> None:
        self.path, self.file, self.source, self.index = path, file, source, index
        self.messages = Messages(source, index)
        self._signature = signature
        self._is_certain = is_certain
        self._fresh: Messages | None = None  # the changed log, read again when it had this signature
        self._fresh_at: Signature | None = None

    def confirm_unchanged(self, channels: Sequence[int]) -> None:
        """Raise McaptrackError if the messages read from these channels may be a mixture of old and new content."""
        try:
            fresh = self._now()
            if fresh is None:
                return
            if all(
                self.index.has_same_channel(fresh.index, channel) for channel in channels
            ) and self.messages.are_unchanged_in(fresh.source):
                return
        except Damaged:
            pass
        raise changed(self.path)

    def confirm_file_unchanged(self) -> None:
        """Raise McaptrackError if the file was changed at all."""
        if self.file.signature() != self._signature and not self.is_through_journal:
            raise changed(self.path)

    def consistent(self, look: Callable[[Messages], T], are_equal: Callable[[T, T], bool]) -> T:
        """The result of ``look``; if the file was changed meanwhile, a second look must give an equal result."""
        result, fresh = look(self.messages), self._now()
        if fresh is not None and not are_equal(result, look(fresh)):
            raise changed(self.path)
        return result

    def record(self, offset: int) -> memoryview:
        """The record at an offset of the file."""

        def whole(messages: Messages) -> memoryview:
            record = records.record_at(messages.source, offset)
            return messages.source[record.start : record.end]

        return self.consistent(whole, memoryview.__eq__)

    @contextmanager
    def reporting_damage(self, topic: str = "") -> Iterator[None]:
        """Turn Damaged, raised in the block, into an error that names the log and says what to do."""
        try:
            yield
        except Damaged as error:
            if self.file.signature() != self._signature:
                raise changed(self.path) from None
            where = f"{self.path}: {topic}" if topic else str(self.path)
            raise DamagedError(f"{where} is damaged: {error}; {recover_hint(self.path)}") from None

    @contextmanager
    def reporting_bad_times(self, topic: str) -> Iterator[None]:
        """The same, and an error for times that don't fit into int64."""
        try:
            with self.reporting_damage(topic):
                yield
        except TimeOutOfRange as late:
            raise McaptrackError(
                f"{self.path}: {topic} has {late.count} messages later than the year 2262, the first at {late.t_ns} "
                "ns; they are kept as they are, but nothing is computed with such times "
                f"({call('drop', self.path, topic, output='OTHER.mcap')} leaves them out)"
            ) from None

    # The file

    @property
    def is_through_journal(self) -> bool:
        """Whether the log is read through a journal, as it was before an unfinished change."""
        return len(self.source.pieces) > 1

    def is_on_disk(self, status: os.stat_result) -> bool:
        """Whether a file is the one that was opened, with the same content on the disk."""
        try:
            if not isinstance(self.file, OpenFile) or not os.path.samestat(status, os.fstat(self.file.handle)):
                return False
            if self.file.signature() == self._signature and self._is_certain:
                return not self.is_through_journal
            on_disk = ByteSource.of(self.file)
            if not self.index.equals(read_index(on_disk)):
                return False
        except Damaged:
            return False
        self.source.pieces = on_disk.pieces
        return True

    def _now(self) -> Messages | None:
        """The present content of the file; None if it has not changed.

        Raises Damaged if it is no longer a log, and McaptrackError if it is being changed.
        """
        now = self.file.signature()
        is_certain = now.is_certain
        if now == self._signature and self._is_certain:
            return None
        if now != self._fresh_at:
            source = ByteSource(self.source.pieces) if self.is_through_journal else ByteSource.of(self.file)
            self._fresh, self._fresh_at = Messages(source, read_index(source)), None
            if self.index.equals(self._fresh.index) and self.messages.are_unchanged_in(self._fresh.source):
                self._signature, self._is_certain = now, is_certain
            elif is_certain:
                self._fresh_at = now
            if self.file.signature() != now:
                raise changed(self.path)
        return self._fresh


def open_snapshot(path: Location) -> Snapshot:
    """Open a log. Raises McaptrackError if it is not an MCAP file, is damaged, or keeps changing."""
    until = time.monotonic() + _WAIT_S
    while True:
        file = open_file(path)
        try:
            outcome = _look(path, file)
        except BaseException:
            file.close()
            raise
        if isinstance(outcome, Snapshot):
            return outcome
        file.close()
        if time.monotonic() > until:
            raise outcome
        time.sleep(_PAUSE_S)


def _look(path: Location, file: ReadFile) -> Snapshot | McaptrackError:
    """Read an open file. Returns an error if another attempt may succeed; raises it if none will."""
    signature = file.signature()
    is_certain = signature.is_certain
    try:
        journal = find_journal(path, file)
        source = journal.journal.old_content() if journal and journal.journal else ByteSource.of(file)
        if not len(source):
            raise Damaged("it is empty")
        index = read_index(source)
    except Damaged as error:
        hint = f"; {recover_hint(path)}" if _looks_like_mcap(file, signature.size) else ""
        refusal = McaptrackError(f"{path} can't be read as an MCAP file: {error}{hint}")
        if not _is_unchanged(path, file, signature):
            return refusal
        if journal:
            notices.warn(journal.message, "journal")
        raise refusal from None
    if file.signature() != signature and not (journal and journal.is_busy):
        return McaptrackError(f"{path} is being changed by another process; try again when it is done")
    if journal:
        notices.warn(journal.message, "journal")
    return Snapshot(path, file, source, index, signature, is_certain)


def _looks_like_mcap(file: ReadFile, size: int) -> bool:
    """Whether a file begins or ends with the MCAP magic bytes, so that `recover` may find something in it."""
    source = ByteSource.of(file)
    ends = (source[at : at + len(records.MAGIC)] for at in (0, max(size - len(records.MAGIC), 0)))
    return any(bytes(end) == records.MAGIC for end in ends)


def _is_unchanged(path: Location, file: ReadFile, signature: Signature) -> bool:
    """Whether the path still leads to this file, and the file has not changed."""
    if isinstance(path, Url) or not isinstance(file, OpenFile):
        return True
    try:
        return os.path.samestat(path.stat(), os.fstat(file.handle)) and file.signature() == signature
    except OSError:
        return False
