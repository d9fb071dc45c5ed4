"""Recover the intact parts of a damaged log as a new log.

The file is read record by record. After damage, reading continues at the next offset that the summary names, or without
a summary at the next bytes that can only be a chunk (in logs without chunks: consecutive messages). A chunk is intact
if it can be decompressed, its checksum is right and its channels are known; it is copied unchanged, with new indexes.
Nothing is taken out of a damaged chunk, because there is no way to tell which of its messages are intact.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections import ChainMap, Counter
from collections.abc import Mapping, MutableMapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import Schema as SchemaRecord

from mcaptrack.errors import McaptrackError
from mcaptrack.location import Location
from mcaptrack.log import records
from mcaptrack.log.byte_source import ByteSource, RunningChecksum
from mcaptrack.log.check import content_to_recover, open_bytes, record_name
from mcaptrack.log.chunks import Entries, contents_of, message_head, open_chunk, scan_entries
from mcaptrack.log.index import Index, read_intact_summary, starts_with_magic, summary_start
from mcaptrack.log.records import (
    BLOCK,
    DATA_OPCODES,
    MAGIC,
    Bytes,
    Damaged,
    Reader,
    Record,
    attachment_is_whole,
    crc_of,
    walk,
)
from mcaptrack.log.writer import LogWriter, create
from mcaptrack.notices import Progress

Described = TypeVar("Described", SchemaRecord, ChannelRecord)

#: The first bytes of a chunk: its opcode; sizes below 2^48; times; a checksum; a known compression.
_CHUNK: Final = re.compile(
    rb"\x06.{6}\0\0.{16}.{6}\0\0.{4}(?:\x04\0\0\0zstd|\x03\0\0\0lz4|\0\0\0\0).{6}\0\0", re.DOTALL
)
#: The first bytes of a message outside of chunks: its opcode, and a size below 2^32.
_MESSAGE: Final = re.compile(rb"\x05.{4}\0\0\0\0", re.DOTALL)
#: The first search window in bytes; it doubles with each step.
_FIRST_STEP: Final = 64 * 2**10
#: The patterns match at most this many bytes.
_LONGEST: Final = 64
#: This many consecutive messages are not a coincidence.
_CHAIN: Final = 3
_NOT_BEHIND: Final = (Opcode.MESSAGE, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA)


@dataclass
class RecoverResult:
    """The result of ``recover``: how much was recovered, and what was lost where."""

    path: Location
    output: Path
    messages: int = 0
    chunks: int = 0
    lost: list[str] = field(default_factory=list)


def recover(path: Location, output: Path, progress: Progress = lambda *_: None) -> RecoverResult:
    """Write the intact parts of a damaged log to a new log.

    Parameters
    ----------
    path : Path or Url
        The damaged log, a file or an object; it is not changed.
    output : Path
        The new log.
    progress : callable, optional
        Called with "recover", the bytes read, and the size of the file.

    Returns
    -------
    RecoverResult
        The numbers of messages and chunks, and one line for each part that is lost.

    Raises
    ------
    McaptrackError
        If no message can be recovered; then nothing is written.
    """
    report = RecoverResult(path, output)
    with open_bytes(path) as (damaged, file), ExitStack() as stack:
        source = content_to_recover(path, damaged, file)
        writer = stack.enter_context(create(output, header=_header(source)))
        try:
            report.messages = _Recovery(source.sequential(), writer, report, progress).all()
        except Damaged as error:  # an unreadable file; damaged parts are skipped
            raise McaptrackError(f"{path} can't be read to its end: {error}") from None
        if not report.messages and report.lost:
            raise McaptrackError(f"{path}: no message in it is intact; {report.lost[0]}")
    report.chunks = len(writer.chunks)
    return report


def _header(buffer: Bytes) -> bytes | None:
    """The header record of a log, if it is intact."""
    try:
        record = records.record_at(buffer, len(MAGIC))
        if record.opcode != Opcode.HEADER or not starts_with_magic(buffer):
            return None
        records.read_header(buffer, record)
    except Damaged:
        return None
    return bytes(buffer[record.start : record.end])


class _Recovery:
    """Reads a damaged log and copies what is intact."""

    def __init__(self, buffer: ByteSource, writer: LogWriter, report: RecoverResult, progress: Progress) -> None:
        self._buffer, self._writer, self._report, self._progress = buffer, writer, report, progress
        self._summary_index = read_intact_summary(buffer, summary_start(buffer)) or Index()
        places = {*self._summary_index.chunks.offsets.tolist(), self._summary_index.data_end}
        places |= {listed.offset for listed in (*self._summary_index.attachments, *self._summary_index.metadata)}
        self._known_offsets = sorted(places - {0})  # offsets of records by the summary; empty without one
        self._schemas: dict[int, SchemaRecord] = dict(self._summary_index.schemas)
        self._channels: dict[int, ChannelRecord] = dict(self._summary_index.channels)
        self._described: set[int] = set()  # channels that the new log already describes
        self._seen_chunks: set[tuple[int, int]] = set()  # size and checksum of copied chunks
        self._saved: Counter[int] = Counter()  # copied messages by channel
        self._pending: Record | None = None  # a message outside of chunks, until a valid record follows it
        self._is_chunked = len(self._summary_index.chunks) > 0
        self._checksum = RunningChecksum(buffer)
        self._is_done = False

    def all(self) -> int:
        """Recover everything. Returns the number of messages."""
        buffer = self._buffer
        if not starts_with_magic(buffer):
            self._report_lost(0, len(MAGIC), "the file does not begin with the magic bytes of MCAP")
        at = shown = len(MAGIC)
        uncertain_from: int | None = None  # start of the last record, if its length is not confirmed
        while at < len(buffer) and not self._is_done:
            record = self._record_at(at)
            self._checksum.advance(at)
            if record is None:
                at = self._skip_damage(at, uncertain_from)
                uncertain_from = None
                continue
            self._copy_pending()
            at, is_certain = self._save(record)
            uncertain_from = None if is_certain else record.start
            if at - shown >= BLOCK:
                shown = at
                self._progress("recover", at, len(buffer))
        self._copy_pending()
        if not self._is_done and not self._known_offsets:
            self._report.lost.append(f"byte {len(buffer)}: the file is cut off; anything that followed is lost")
        self._compare()
        self._report_behind(at)
        for number in self._summary_index.channels.keys() - self._described:  # channels without messages
            with suppress(Damaged):
                self._describe_if_new(number)
        return self._saved.total()

    def _record_at(self, at: int) -> Record | None:
        """The record at an offset, if it is plausible."""
        try:
            record = records.record_at(self._buffer, at)
        except Damaged:
            return None
        following = bisect_right(self._known_offsets, at)
        reaches_over = following < len(self._known_offsets) and self._known_offsets[following] < record.end
        return record if (record.opcode in DATA_OPCODES or record.opcode >= 0x80) and not reaches_over else None

    def _skip_damage(self, at: int, uncertain_from: int | None) -> int:
        """The offset at which to continue when there is no record at ``at``."""
        following = self._next((at if uncertain_from is None else uncertain_from) + 1)
        if following == at:
            following = self._next(at + 1)
        if uncertain_from is not None and following < at:  # the length of the last record is wrong
            self._pending, at = None, uncertain_from
        self._copy_pending()
        is_half = following == len(self._buffer) and not self._known_offsets and self._buffer[at] in DATA_OPCODES
        text = f"an incomplete {record_name(self._buffer[at])} record" if is_half else "no record can be read here"
        self._report_lost(at, following, self._words(at, text))
        return following

    def _next(self, start: int) -> int:
        """The next offset, from ``start`` on, where records begin."""
        if self._known_offsets:
            following = bisect_right(self._known_offsets, start - 1)
            return self._known_offsets[following] if following < len(self._known_offsets) else len(self._buffer)
        pattern, is_one = (_CHUNK, self._is_chunk) if self._is_chunked else (_ANY, self._is_any)
        low, step, size = start, _FIRST_STEP, len(self._buffer)
        while low < size:
            block = self._buffer[low : min(low + step + _LONGEST, size)]  # a match may end in the next step
            match = pattern.search(block)
            while match and match.start() < step:
                if is_one(low + match.start()):
                    return low + match.start()
                match = pattern.search(block, match.start() + 1)
            low, step = low + step, min(2 * step, BLOCK)
        return size

    def _is_chunk(self, at: int) -> bool:
        try:
            record = records.record_at(self._buffer, at)
            return records.read_chunk(self._buffer, record).end == record.end
        except Damaged:
            return False

    def _is_any(self, at: int) -> bool:
        """Whether there is a chunk, or several consecutive messages of known channels."""
        if self._buffer[at] == Opcode.CHUNK:
            return self._is_chunk(at)
        with suppress(Damaged):
            for count, record in enumerate(walk(self._buffer, at, len(self._buffer))):
                if record.opcode == Opcode.DATA_END and count:
                    return True
                if record.opcode != Opcode.MESSAGE or message_head(self._buffer, record)[0] not in self._channels:
                    return False
                if count + 1 == _CHAIN:
                    return True
        return False

    def _end(self, record: Record) -> None:
        """Handle the end of the data section, unless more of it follows."""
        buffer = self._buffer
        if self._known_offsets:
            self._is_done = record.start >= self._known_offsets[-1]
        else:
            # Its offsets may be wrong, but its counts are right.
            self._summary_index = read_intact_summary(buffer, record.end) or self._summary_index
            self._is_done = record.end == len(buffer) or buffer[record.end] not in _NOT_BEHIND
        declared = Reader(buffer, record.body, record.end).number(4)
        if self._is_done and declared and not self._report.lost and declared != self._checksum.up_to(record.start):
            self._report.lost.append(
                f"byte {record.start}: the checksum of the data section is wrong; chunks with their own checksums "
                "are intact, other records may not be"
            )

    def _save(self, record: Record) -> tuple[int, bool]:
        """Copy a record, or report it as lost. Returns its end, and whether that is certain."""
        buffer, writer = self._buffer, self._writer
        try:
            if record.opcode == Opcode.CHUNK:
                return self._save_chunk(record), True
            if record.opcode == Opcode.DATA_END:
                self._end(record)
                return record.end, True
            if record.opcode == Opcode.MESSAGE:
                message_head(buffer, record)
                if self._is_chunked:  # a message index with a flipped bit looks like one
                    raise Damaged("a message outside of chunks, in a log with chunks")
                self._pending = record
                return record.end, False
            if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._describe(record)
            elif record.opcode == Opcode.ATTACHMENT:
                records.read_attachment(buffer, record)
                if not attachment_is_whole(buffer, record):
                    raise Damaged("the checksum of an attachment is wrong")
                writer.copy_attachment(bytes(buffer[record.start : record.end]))
            elif record.opcode == Opcode.METADATA:
                records.read_metadata(buffer, record)
                writer.copy_metadata(bytes(buffer[record.start : record.end]))
            elif record.opcode >= 0x80:  # private records of applications
                writer.write(bytes(buffer[record.start : record.end]))
        except Damaged as error:
            self._report_lost(record.start, record.end, self._words(record.start, str(error)))
        return record.end, False

    def _copy_pending(self) -> None:
        record, self._pending = self._pending, None
        if record is None:
            return
        channel, _, t_ns, _ = message_head(self._buffer, record)
        try:
            self._describe_if_new(channel)
            self._writer.copy_message(channel, t_ns, self._buffer[record.start : record.end])
            self._saved[channel] += 1
        except Damaged as error:
            self._report_lost(record.start, record.end, str(error))

    def _save_chunk(self, record: Record) -> int:
        """Copy an intact chunk. Returns its end."""
        self._is_chunked = True
        head = records.read_chunk(self._buffer, record)
        content = open_chunk(self._buffer, record)
        key = (head.end - record.start, crc_of(self._buffer, record.body, head.end))
        if key in self._seen_chunks:
            raise Damaged("an exact copy of an earlier chunk")
        schemas: ChainMap[int, SchemaRecord] = ChainMap({}, self._schemas)
        channels: ChainMap[int, ChannelRecord] = ChainMap({}, self._channels)
        described = set()
        for inner in walk(content, 0, len(content)):
            if inner.opcode == Opcode.SCHEMA:
                _register(schemas, records.read_schema(content, inner))
            elif inner.opcode == Opcode.CHANNEL:
                channel = records.read_channel(content, inner)
                _register(channels, channel)
                described.add(channel.id)
        entries = scan_entries(content)
        for number in entries.keys() | described:
            if number not in channels or not _has_schema(channels[number], schemas):
                raise Damaged(f"messages of channel {number}, which has no intact channel record")
        self._schemas |= schemas.maps[0]
        self._channels |= channels.maps[0]
        self._seen_chunks.add(key)
        if not entries:
            for number in described:
                self._describe_if_new(number)
            return head.end
        for number in entries.keys() - described:
            self._describe_if_new(number)
        for number in described - self._described:
            self._add_channel(number)
        self._write_chunk(record, head, entries)
        # The checksum of a chunk does not cover the length of its record.
        is_padded = head.end != record.end and self._record_at(head.end) is None
        return record.end if is_padded else head.end

    def _write_chunk(self, record: Record, head: records.ChunkHead, entries: Mapping[int, Entries]) -> None:
        """Copy a chunk; times and length in its head, which no checksum covers, are corrected."""
        t_ns = np.concatenate([listed[:, 0] for listed in entries.values()])
        first, last = int(t_ns.min()), int(t_ns.max())
        whole = bytes(self._buffer[record.start : record.end])
        if (head.start_ns, head.end_ns, head.end) != (first, last, record.end):
            numbers = (first, last, head.uncompressed_size, head.uncompressed_crc)
            whole = records.pack_chunk(numbers, head.compression, bytes(self._buffer[head.start : head.end]))
        sizes = (head.compression, head.end - head.start, head.uncompressed_size)
        entry = records.chunk_index((first, last), (0, len(whole)), {}, 0, sizes)
        self._saved.update({number: len(listed) for number, listed in entries.items()})
        self._writer.copy_chunk(whole, entry, {number: listed.tobytes() for number, listed in entries.items()})

    def _describe(self, record: Record) -> None:
        if record.opcode == Opcode.SCHEMA:
            _register(self._schemas, records.read_schema(self._buffer, record))
        else:
            channel = records.read_channel(self._buffer, record)
            _register(self._channels, channel)
            self._describe_if_new(channel.id)

    def _add_channel(self, number: int) -> ChannelRecord:
        """Add a channel to the new log; the chunks that are copied describe it."""
        channel = self._channels.get(number)
        if channel is None or not _has_schema(channel, self._schemas):
            raise Damaged(f"a message of channel {number}, which has no intact channel record")
        if channel.schema_id:
            self._writer.schemas[channel.schema_id] = self._schemas[channel.schema_id]
        self._writer.channels[number] = channel
        self._described.add(number)
        return channel

    def _describe_if_new(self, number: int) -> None:
        """Write the records of a channel outside of chunks, unless the new log has them."""
        if number not in self._described:
            self._add_channel(number)
            self._writer.write_description(number)

    def _report_behind(self, at: int) -> None:
        """Report a log that follows this one, as where files were joined; ``at`` is the end of the data section."""
        with suppress(Damaged):
            footers = (record for record in walk(self._buffer, at, len(self._buffer)) if record.opcode == Opcode.FOOTER)
            end = next((record.end + len(MAGIC) for record in footers), at)
            if bytes(self._buffer[end : end + len(MAGIC)]) == MAGIC:
                self._report_lost(end, len(self._buffer), "another log follows; cut the file in two there")

    def _words(self, at: int, why: str) -> str:
        """Why something is lost, and what it held, if the summary lists a chunk there."""
        listed = self._summary_index.chunks.at(at)
        if listed is None or not self._known_offsets:
            return why
        return f"{why}; it held {contents_of(listed, self._summary_index.channels)}"

    def _report_lost(self, start: int, end: int, reason: str) -> None:
        self._report.lost.append(f"byte {start} to {end}: {reason.removeprefix(f'byte {start}: ')}")

    def _compare(self) -> None:
        """Compare the recovered messages with the statistics."""
        for number, count in sorted(self._summary_index.counts.items()):
            saved = self._saved[number]
            if saved != count and number in self._summary_index.channels:
                self._report.lost.append(
                    f"{self._summary_index.channels[number].topic}: {saved} of {count} messages are recovered"
                )


_ANY: Final = re.compile(_CHUNK.pattern + b"|" + _MESSAGE.pattern, re.DOTALL)


def _has_schema(channel: ChannelRecord, schemas: Mapping[int, SchemaRecord]) -> bool:
    return not channel.schema_id or channel.schema_id in schemas


def _register(registered: MutableMapping[int, Described], record: Described) -> None:
    """Register a schema or channel. Raises Damaged if its id belongs to a different one."""
    if registered.setdefault(record.id, record) != record:
        raise Damaged(f"schema or channel {record.id} differs from another record with the same id")
