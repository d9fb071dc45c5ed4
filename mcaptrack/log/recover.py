"""What is whole in a damaged log, as a log.

The file is walked record by record. Where that leads nowhere, the walk goes on at the next place that the summary knows
of, or, without a summary, at the next bytes that can only be a chunk (or messages, in logs without chunks). A chunk is
whole if it opens, its checksum is right and its channels are known; it is passed on as it stands, with new indexes.
Nothing is taken out of a chunk that is not whole: nobody can say which of its messages are.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, TypeVar

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.log import records
from mcaptrack.log.byte_source import ByteSource, RunningChecksum
from mcaptrack.log.check import best_content, open_bytes
from mcaptrack.log.check_summary import record_name
from mcaptrack.log.chunks import Entries, chunk_entries, message_head, open_chunk
from mcaptrack.log.index import Index, begins_as_log, summary_start, whole_summary
from mcaptrack.log.records import (
    BLOCK,
    MAGIC,
    Bytes,
    ChannelRecord,
    ChunkIndexRecord,
    Damaged,
    Opcode,
    Reader,
    Record,
    SchemaRecord,
    crc_of,
    walk,
)
from mcaptrack.log.writer import LogWriter, create

Progress = Callable[[str, int, int], None]
Described = TypeVar("Described", SchemaRecord, ChannelRecord)

#: How a chunk begins: its opcode; sizes below 2^48; times; a checksum; a compression that is known.
_CHUNK: Final = re.compile(
    rb"\x06.{6}\0\0.{16}.{6}\0\0.{4}(?:\x04\0\0\0zstd|\x03\0\0\0lz4|\0\0\0\0).{6}\0\0", re.DOTALL
)
#: How a message outside of chunks begins: its opcode, and a size below 2^32.
_MESSAGE: Final = re.compile(rb"\x05.{4}\0\0\0\0", re.DOTALL)
#: How much is searched for a beginning first; then more each time.
_FIRST_STEP: Final = 64 * 2**10
#: No beginning is longer than this.
_LONGEST: Final = 64
#: So many messages in a row are no accident.
_CHAIN: Final = 3
_IN_DATA: Final = (
    Opcode.HEADER,
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.MESSAGE,
    Opcode.CHUNK,
    Opcode.MESSAGE_INDEX,
    Opcode.ATTACHMENT,
    Opcode.METADATA,
    Opcode.DATA_END,
)
_NOT_BEHIND: Final = (Opcode.MESSAGE, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA)


@dataclass
class RecoverResult:
    """What was saved, and what was lost and where."""

    path: Path
    output: Path
    messages: int = 0
    chunks: int = 0
    lost: list[str] = field(default_factory=list)


def recover(path: Path, output: Path, progress: Progress = lambda *_: None) -> RecoverResult:
    """Write what is whole in the log ``path`` to a new log ``output``.

    Raises McaptrackError, and writes nothing, if there is no message to be saved.
    """
    report = RecoverResult(path, output)
    with open_bytes(path) as (there, file), ExitStack() as stack:
        source = best_content(path, there, file)
        writer = stack.enter_context(create(output, header=_header(source)))
        try:
            report.messages = _Rescue(source.front_to_back(), writer, report, progress).all()
        except Damaged as error:  # damage that can be passed over was passed over
            raise McaptrackError(f"{path} can't be read to its end: {error}") from None
        if not report.messages and report.lost:
            raise McaptrackError(f"{path}: no message in it is whole; {report.lost[0]}")
    report.chunks = len(writer.chunks)
    return report


def _header(buffer: Bytes) -> bytes | None:
    """The header record of a log, if it is whole."""
    try:
        record = records.record_at(buffer, len(MAGIC))
        if record.opcode != Opcode.HEADER or not begins_as_log(buffer):
            return None
        records.read_header(buffer, record)
    except Damaged:
        return None
    return bytes(buffer[record.start : record.end])


class _Rescue:
    """Walks through a log and passes on what is whole."""

    def __init__(self, buffer: ByteSource, writer: LogWriter, report: RecoverResult, progress: Progress) -> None:
        self._buffer, self._writer, self._report, self._progress = buffer, writer, report, progress
        self._said = whole_summary(buffer, summary_start(buffer)) or Index()
        places = {chunk.offset for chunk in self._said.chunks} | {self._said.data_end}
        places |= {listed.offset for listed in (*self._said.attachments, *self._said.metadata)}
        self._places = sorted(places - {0})  # where records stand, if anybody says so
        self._schemas: dict[int, SchemaRecord] = dict(self._said.schemas)
        self._channels: dict[int, ChannelRecord] = dict(self._said.channels)
        self._described: set[int] = set()  # channels that what was written describes
        self._seen: set[tuple[int, int]] = set()  # size and checksum of chunks
        self._saved: Counter[int] = Counter()  # messages of each channel
        self._waiting: Record | None = None  # a message outside of chunks, until what follows shows that it ends there
        self._is_chunked = bool(self._said.chunks)
        self._checksum = RunningChecksum(buffer)
        self._ended = False

    def all(self) -> int:
        """Save what there is. Returns how many messages that was."""
        buffer = self._buffer
        if not begins_as_log(buffer):
            self._lose(0, len(MAGIC), "these are not the first bytes of an MCAP file")
        at = shown = len(MAGIC)
        doubtful: int | None = None  # where the last record starts, if there is but its own word for where it ends
        while at < len(buffer) and not self._ended:
            record = self._record_at(at)
            self._checksum.pass_over(at)
            if record is None:
                at = self._resume(at, doubtful)
                doubtful = None
                continue
            self._pass_on_waiting()
            at, is_certain = self._save(record)
            doubtful = None if is_certain else record.start
            if at - shown >= BLOCK:
                shown = at
                self._progress("recover", at, len(buffer))
        self._pass_on_waiting()
        if not self._ended and not self._places:
            self._report.lost.append(f"byte {len(buffer)}: the file is cut off; if anything stood behind, it is lost")
        self._compare()
        for number in self._said.channels.keys() - self._described:  # those without messages
            with suppress(Damaged):
                self._describe_once(number)
        return self._saved.total()

    def _record_at(self, at: int) -> Record | None:
        """The record that stands there, if it can be one."""
        try:
            record = records.record_at(self._buffer, at)
        except Damaged:
            return None
        following = bisect_right(self._places, at)
        reaches_over = following < len(self._places) and self._places[following] < record.end
        return record if (record.opcode in _IN_DATA or record.opcode >= 0x80) and not reaches_over else None

    def _resume(self, at: int, doubtful: int | None) -> int:
        """Where to go on when there is no record at ``at``."""
        following = self._next((at if doubtful is None else doubtful) + 1)
        if following == at:
            following = self._next(at + 1)
        if doubtful is not None and following < at:  # it was not as long as it said
            self._waiting, at = None, doubtful
        self._pass_on_waiting()
        is_half = following == len(self._buffer) and not self._places and self._buffer[at] in _IN_DATA
        words = f"half of a {record_name(self._buffer[at])} record" if is_half else "no record can be read here"
        self._lose(at, following, self._words(at, words))
        return following

    def _next(self, start: int) -> int:
        """The next place, from ``start`` on, where records begin."""
        if self._places:
            following = bisect_right(self._places, start - 1)
            return self._places[following] if following < len(self._places) else len(self._buffer)
        pattern, is_one = (_CHUNK, self._is_chunk) if self._is_chunked else (_ANY, self._is_any)
        low, step, size = start, _FIRST_STEP, len(self._buffer)
        while low < size:
            block = self._buffer[low : min(low + step + _LONGEST, size)]  # what begins in this step may end in the next
            found = pattern.search(block)
            while found and found.start() < step:
                if is_one(low + found.start()):
                    return low + found.start()
                found = pattern.search(block, found.start() + 1)
            low, step = low + step, min(2 * step, BLOCK)
        return size

    def _is_chunk(self, at: int) -> bool:
        try:
            record = records.record_at(self._buffer, at)
            return records.read_chunk(self._buffer, record).end == record.end
        except Damaged:
            return False

    def _is_any(self, at: int) -> bool:
        """Whether a chunk stands there, or several messages of channels that are known."""
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
        """The data section ends here, unless more of it follows."""
        buffer = self._buffer
        if self._places:
            self._ended = record.start >= self._places[-1]
        else:
            # Its offsets may be wrong, its numbers are not.
            self._said = whole_summary(buffer, record.end) or self._said
            self._ended = record.end == len(buffer) or buffer[record.end] not in _NOT_BEHIND
        said = Reader(buffer, record.body, record.end).number(4)
        if self._ended and said and not self._report.lost and said != self._checksum.upto(record.start):
            self._report.lost.append(
                f"byte {record.start}: the checksum of the data section is wrong; chunks with checksums of their own "
                "are as they were, other records may not be"
            )

    def _save(self, record: Record) -> tuple[int, bool]:
        """Pass a record on, or say that it is lost. Returns where it ends, and whether that is certain."""
        buffer, writer = self._buffer, self._writer
        try:
            if record.opcode == Opcode.CHUNK:
                return self._save_chunk(record), True
            if record.opcode == Opcode.DATA_END:
                self._end(record)
                return record.end, True
            if record.opcode == Opcode.MESSAGE:
                message_head(buffer, record)
                if self._is_chunked:  # a flipped bit makes one of a message index
                    raise Damaged("a message outside of chunks, in a log with chunks")
                self._waiting = record
                return record.end, False
            if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._describe(record)
            elif record.opcode == Opcode.ATTACHMENT:
                records.read_attachment(buffer, record)
                if not records.attachment_is_whole(buffer, record):
                    raise Damaged("the checksum of an attachment is wrong")
                writer.put_attachment(bytes(buffer[record.start : record.end]))
            elif record.opcode == Opcode.METADATA:
                records.read_metadata(buffer, record)
                writer.put_metadata(bytes(buffer[record.start : record.end]))
            elif record.opcode >= 0x80:  # somebody's own
                writer.write(bytes(buffer[record.start : record.end]))
        except Damaged as error:
            self._lose(record.start, record.end, self._words(record.start, str(error)))
        return record.end, False

    def _pass_on_waiting(self) -> None:
        record, self._waiting = self._waiting, None
        if record is None:
            return
        channel, _, t_ns, _ = message_head(self._buffer, record)
        try:
            self._describe_once(channel)
            self._writer.put_message(channel, t_ns, self._buffer[record.start : record.end])
            self._saved[channel] += 1
        except Damaged as error:
            self._lose(record.start, record.end, str(error))

    def _save_chunk(self, record: Record) -> int:
        """Pass on a chunk that is whole. Returns where it ends."""
        self._is_chunked = True
        head = records.read_chunk(self._buffer, record)
        content = open_chunk(self._buffer, record)
        key = (head.end - record.start, crc_of(self._buffer, record.body, head.end))
        if key in self._seen:
            raise Damaged("a chunk that stands here a second time, to the byte")
        schemas, channels = dict(self._schemas), dict(self._channels)
        described = set()
        for inner in walk(content, 0, len(content)):
            if inner.opcode == Opcode.SCHEMA:
                _agree(schemas, records.read_schema(content, inner))
            elif inner.opcode == Opcode.CHANNEL:
                channel = records.read_channel(content, inner)
                _agree(channels, channel)
                described.add(channel.id)
        entries = chunk_entries(content)
        for number in entries.keys() | described:
            if number not in channels or channels[number].schema_id not in {0, *schemas}:
                raise Damaged(f"messages of channel {number}, which is described nowhere")
        self._schemas, self._channels = schemas, channels
        self._seen.add(key)
        if not entries:
            for number in described:
                self._describe_once(number)
            return head.end
        for number in entries.keys() - described:
            self._describe_once(number)
        for number in described - self._described:
            self._introduce(number)
        self._write_chunk(record, head, entries)
        # The size of a record is no part of what the chunk's checksum covers.
        is_padded = head.end != record.end and self._record_at(head.end) is None
        return record.end if is_padded else head.end

    def _write_chunk(self, record: Record, head: records.ChunkHead, entries: Mapping[int, Entries]) -> None:
        """The chunk as it stands, but that its head says where its messages are, which no checksum covers."""
        t_ns = np.concatenate([listed[:, 0] for listed in entries.values()])
        first, last = int(t_ns.min()), int(t_ns.max())
        whole = bytes(self._buffer[record.start : record.end])
        if (head.start_ns, head.end_ns, head.end) != (first, last, record.end):
            numbers = (first, last, head.uncompressed_size, head.uncompressed_crc)
            whole = records.pack_chunk(numbers, head.compression, bytes(self._buffer[head.start : head.end]))
        sizes = (head.compression, head.end - head.start, head.uncompressed_size)
        known = ChunkIndexRecord(first, last, 0, len(whole), {}, 0, *sizes)
        self._saved.update({number: len(listed) for number, listed in entries.items()})
        self._writer.put_chunk(whole, known, {number: listed.tobytes() for number, listed in entries.items()})

    def _describe(self, record: Record) -> None:
        if record.opcode == Opcode.SCHEMA:
            _agree(self._schemas, records.read_schema(self._buffer, record))
        else:
            channel = records.read_channel(self._buffer, record)
            _agree(self._channels, channel)
            self._describe_once(channel.id)

    def _introduce(self, number: int) -> ChannelRecord:
        """Make a channel known to the new log, which describes it somewhere."""
        channel = self._channels.get(number)
        if channel is None or channel.schema_id not in {0, *self._schemas}:
            raise Damaged(f"a message of channel {number}, which is described nowhere")
        if channel.schema_id:
            self._writer.schemas[channel.schema_id] = self._schemas[channel.schema_id]
        self._writer.channels[number] = channel
        self._described.add(number)
        return channel

    def _describe_once(self, number: int) -> None:
        """Describe a channel outside of chunks, unless that was done."""
        if number not in self._described:
            self._introduce(number)
            self._writer.put_description(number)

    def _words(self, at: int, why: str) -> str:
        """Why something is lost, and, if the summary knows a chunk there, what that held."""
        known = next((chunk for chunk in self._said.chunks if chunk.offset == at), None)
        if known is None or not self._places:
            return why
        topics = [self._said.channels[n].topic for n in known.message_index_offsets if n in self._said.channels]
        span = f"{known.start_ns / 1e9:.3f} to {known.end_ns / 1e9:.3f} s"
        return f"{why}; it held messages of {', '.join(sorted(topics)) or 'no topic'} from {span}"

    def _lose(self, start: int, end: int, words: str) -> None:
        self._report.lost.append(f"byte {start} to {end}: {words.removeprefix(f'byte {start}: ')}")

    def _compare(self) -> None:
        """What the statistics count, and what was saved."""
        for number, count in sorted(self._said.counts.items()):
            saved = self._saved[number]
            if saved != count and number in self._said.channels:
                self._report.lost.append(f"{self._said.channels[number].topic}: {saved} of {count} messages are saved")


_ANY: Final = re.compile(_CHUNK.pattern + b"|" + _MESSAGE.pattern, re.DOTALL)


def _agree(known: dict[int, Described], record: Described) -> None:
    """Raises Damaged if a schema or channel of that number is known as another."""
    if known.setdefault(record.id, record) != record:
        raise Damaged(f"schema or channel {record.id} is described otherwise than elsewhere")
