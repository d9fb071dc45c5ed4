"""Add channels to an existing log, and drop others.

Everything before the first dropped record stays untouched. The tail from there on is rewritten: kept chunks unchanged,
new chunks behind them, then a new summary. This happens in place if it is less work than a copy, so the cost of adding
is proportional to what is added. It also happens in place if a copy could not keep the file's hard links, owner,
permissions or extended attributes. A log without a usable summary, or with messages outside of chunks, is normalised.
"""

from __future__ import annotations

import zlib
from collections.abc import Collection, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import IO

from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import ChunkIndex

from mcaptrack.errors import McaptrackError
from mcaptrack.files import can_replace, publish_stream
from mcaptrack.location import Url, is_remote
from mcaptrack.log import records
from mcaptrack.log.byte_source import ByteSource, OpenFile
from mcaptrack.log.chunks import chunk_record, message_head, open_chunk
from mcaptrack.log.in_place import rewrite_tail
from mcaptrack.log.index import Index
from mcaptrack.log.reader import Log
from mcaptrack.log.records import BLOCK, MAGIC, Bytes, Damaged, Record, crc_before, crc_of, walk
from mcaptrack.log.remote import publish_object, refuse_replaced
from mcaptrack.log.writer import LogWriter, Sink, refuse_earlier_results, verify
from mcaptrack.schema.provenance import Provenance


@contextmanager
def extend(
    log: Log,
    output: Path | None = None,
    *,
    drop: Collection[str] = (),
    drop_metadata: Collection[str] = (),
    drop_attachments: Collection[str] = (),
) -> Iterator[LogWriter]:
    """Add channels to a log and drop these topics, metadata records and attachments; complete when the block succeeds.

    ``output`` is another file to write to, instead of the log itself. If the log's results are in a sidecar, the
    sidecar is extended instead. Raises McaptrackError if the log is damaged, can't be written to, or is being written
    to by another process.
    """
    whole = log
    if log.results is not None:
        if output is not None:
            raise McaptrackError(f"{log.path} has its results in {log.results.path}; they can't also go to {output}")
        log = log.results
    if output is None:
        log.lock()
    with log.snapshot.reporting_damage():
        change = _Rewrite.plan(log, drop, drop_metadata, drop_attachments)
        place = log.real_path if output is None and not is_remote(log.path) else None
        is_in_place = isinstance(place, Path) and change.is_better_in_place(place)
        opened = _in_place(log, change) if is_in_place else _as_copy(log, change, output)
        with opened as writer:
            yield writer
            if whole is not log and isinstance(whole.path, Url):
                refuse_replaced(whole.path, whole.version)
    log.is_outdated = output is None


def refuse_to_replace_recorded(log: Log, topics: Collection[str], instead: str) -> None:
    """Raise McaptrackError if a channel of these topics was recorded by other software: results never replace it.

    All channels of a topic are checked, in the log and in its sidecar. ``instead`` says what to do.
    """
    for part in log.parts:
        for channel in part.index.channels.values():
            if channel.topic in topics and not Provenance.from_metadata(channel.metadata):
                schema = part.index.schemas.get(channel.schema_id)
                name = schema.name if schema else "no schema"
                raise McaptrackError(
                    f"{part.path} has {channel.topic}, which other software recorded ({name}) and which is "
                    "never replaced; "
                    f"{instead}"
                )


@contextmanager
def _in_place(log: Log, change: _Rewrite) -> Iterator[LogWriter]:
    index = log.index
    crc = change.crc_before()
    assert isinstance(log.real_path, Path)
    assert isinstance(log.snapshot.file, OpenFile)
    try:
        with rewrite_tail(log.real_path, log.lock(), change.cut, log.snapshot.file) as end:
            log.snapshot.source.pieces = end.journal.pieces()  # readers of this log continue to see the old content
            writer = LogWriter(end, change.cut, crc, change.index_before())
            change.copy_kept(writer, end.journal.old_tail().part(0, index.data_end - change.cut), change.cut)
            yield writer
            messages = writer.finish()
            end.close()
            verify(log.real_path, writer, messages, change.cut, crc or 0)
    except OSError as error:
        raise McaptrackError(f"{log.path} can't be written: {error.strerror or error}; it is unchanged") from error


@contextmanager
def _as_copy(log: Log, change: _Rewrite, output: Path | None) -> Iterator[LogWriter]:
    """Write a copy under a temporary name; it gets its final name when it is complete, verified and synced to disk."""
    if output is not None:
        refuse_earlier_results(output)
    with _published(log, output) as stream:
        crc = change.crc_before()
        _copy_bytes(log.snapshot.source, change.cut, stream)
        writer = LogWriter(stream, change.cut, crc, change.index_before())
        change.copy_kept(writer, log.snapshot.source.part(0, log.index.data_end), 0)
        yield writer
        messages = writer.finish()
        stream.flush()
        copy = Path(stream.name)
        _compare(log.snapshot.source, copy, change.cut)
        verify(copy, writer, messages, change.cut, crc or 0)


def _published(log: Log, output: Path | None) -> AbstractContextManager[IO[bytes]]:
    """A stream to write the new content of a log to, or ``output``."""
    if output is None and is_remote(log.path):
        return publish_object(log.path, log.version)
    assert isinstance(log.real_path, Path)
    return publish_stream(output or log.real_path)


def _copy_bytes(source: ByteSource, end: int, stream: Sink) -> None:
    for at in range(0, end, BLOCK):
        stream.write(bytes(source[at : min(at + BLOCK, end)]))


def _compare(source: ByteSource, copy: Path, end: int) -> None:
    """Raise McaptrackError if the copied bytes differ from the source."""
    with copy.open("rb") as stream:
        for at in range(0, end, BLOCK):
            until = min(at + BLOCK, end)
            if stream.read(until - at) != source[at:until]:
                raise McaptrackError(f"{copy} does not hold what was written to it; the disk is not reliable")


@dataclass
class _Rewrite:
    """The parts to drop from a log, and the offset of the first record that is rewritten (``cut``).

    ``open_all``: any chunk may describe a dropped channel, so all chunks have to be opened.
    """

    index: Index
    source: ByteSource
    dropped: set[int]
    metadata: Collection[str]
    attachments: Collection[str]
    cut: int = len(MAGIC)
    open_all: bool = False

    @classmethod
    def plan(cls, log: Log, drop: Collection[str], metadata: Collection[str], attachments: Collection[str]) -> _Rewrite:
        index = log.index
        dropped = {channel.id for channel in index.channels.values() if channel.topic in drop}
        change = cls(index, log.snapshot.source, dropped, metadata, attachments)
        if not index.regular:
            change.open_all = True
            return change
        places = [index.data_end]
        first = islice(index.chunks.with_channels(dropped), 1)  # in the file
        places += [chunk.chunk_start_offset for chunk in first]
        places += [listed.offset for listed in index.metadata if listed.name in metadata]
        places += [listed.offset for listed in index.attachments if listed.name in attachments]
        undescribed = dropped - change._described_by_first_chunk()
        if undescribed:
            for record in walk(log.snapshot.source.sequential(), len(MAGIC), index.data_end):
                if record.opcode == Opcode.CHANNEL:
                    channel = records.read_channel(log.snapshot.source, record).id
                    places += [record.start] if channel in dropped else []
                    undescribed.discard(channel)
        change.open_all = bool(undescribed)
        change.cut = len(MAGIC) if undescribed else min(places)
        return change

    def _described_by_first_chunk(self) -> set[int]:
        """The dropped channels that their first chunk with messages describes: no record outside of chunks does."""
        out: set[int] = set()
        for row, channels in self.index.chunks.first_rows(self.dropped).items():
            chunk = self.index.chunks[row]
            out |= _described_in(open_chunk(self.source, chunk_record(self.source, chunk)))[0].intersection(channels)
        return out

    @cached_property
    def dropped_schemas(self) -> set[int]:
        """The schemas of dropped channels that no kept channel has."""
        channels = self.index.channels.values()
        kept = {channel.schema_id for channel in channels if channel.id not in self.dropped}
        return {channel.schema_id for channel in channels if channel.id in self.dropped} - kept

    def is_better_in_place(self, path: Path) -> bool:
        """Whether writing the tail twice (to the journal and in place) is less work than writing everything once, or
        whether a copy can't replace the file.
        """
        return (self.index.regular and self.cut > len(self.source) - self.cut) or not can_replace(path)

    def crc_before(self) -> int | None:
        """The checksum of all bytes before the cut; None if the log has no checksum."""
        index = self.index
        if self.cut == len(MAGIC):
            return zlib.crc32(MAGIC)
        if not index.data_crc:
            return None
        tail = crc_of(self.source, self.cut, index.data_end)
        return crc_before(index.data_crc, tail, index.data_end - self.cut)

    def index_before(self) -> Index:
        """The index of the kept records before the cut."""
        index = self.index
        channels = {number: channel for number, channel in index.channels.items() if number not in self.dropped}
        schemas = {number: schema for number, schema in index.schemas.items() if number not in self.dropped_schemas}
        if self.cut <= len(MAGIC):
            return Index(schemas=schemas, channels=channels)
        counts = dict(index.counts)
        for chunk in index.chunks:
            if chunk.chunk_start_offset >= self.cut:
                for offset in chunk.message_index_offsets.values():
                    record = records.record_at(self.source, offset)
                    channel, entries = records.read_message_entries(self.source, record)
                    counts[channel] = counts.get(channel, 0) - len(entries) // 16
        return replace(
            index,
            schemas=schemas,
            channels=channels,
            counts={number: count for number, count in counts.items() if number in channels and count},
            chunks=index.chunks.before(self.cut),
            attachments=[listed for listed in index.attachments if listed.offset < self.cut],
            metadata=[listed for listed in index.metadata if listed.offset < self.cut],
        )

    def copy_kept(self, writer: LogWriter, source: ByteSource, base: int) -> None:
        """Write the kept records after the cut. ``source`` is the file from ``base`` to the end of its data section."""
        try:
            self._copy_kept(writer, source.sequential(), base)
        except Damaged as error:
            raise error.moved(base) from None

    def _copy_kept(self, writer: LogWriter, buffer: Bytes, base: int) -> None:
        lost = _Descriptions(writer.chunks.channels)
        for record in walk(buffer, self.cut - base, len(buffer)):
            if record.opcode == Opcode.CHUNK:
                listed = self.index.chunks.at(base + record.start)
                if listed is None:
                    raise Damaged("a chunk is missing in the index", record.start)
                self._copy_kept_chunk(writer, buffer, base, record, listed, lost)
            elif record.opcode == Opcode.MESSAGE:
                channel, _, t_ns, _ = message_head(buffer, record)
                if channel not in self.dropped:
                    writer.copy_message(channel, t_ns, buffer[record.start : record.end])
            elif record.opcode != Opcode.MESSAGE_INDEX and self._is_kept(buffer, record):
                whole = bytes(buffer[record.start : record.end])
                if record.opcode == Opcode.ATTACHMENT:
                    writer.copy_attachment(whole)
                elif record.opcode == Opcode.METADATA:
                    writer.copy_metadata(whole)
                else:
                    writer.write(whole)
        for channel in lost.of(writer.channels.values()):
            writer.write_description(channel)

    def _is_kept(self, buffer: Bytes, record: Record) -> bool:
        if record.opcode == Opcode.SCHEMA:
            return records.read_schema(buffer, record).id not in self.dropped_schemas
        if record.opcode == Opcode.CHANNEL:
            return records.read_channel(buffer, record).id not in self.dropped
        if record.opcode == Opcode.ATTACHMENT:
            return records.read_attachment(buffer, record).name not in self.attachments
        if record.opcode == Opcode.METADATA:
            return records.read_metadata(buffer, record).name not in self.metadata
        return True

    def _copy_kept_chunk(
        self,
        writer: LogWriter,
        buffer: Bytes,
        base: int,
        record: Record,
        listed: ChunkIndex,
        lost: _Descriptions,
    ) -> None:
        holds = set(listed.message_index_offsets)
        content = None
        undescribed = lost.of(writer.channels[channel] for channel in sorted(holds) if channel in writer.channels)
        if self.open_all or not holds.isdisjoint(self.dropped) or undescribed:
            content = open_chunk(buffer, record)
            channels, schemas = _described_in(content)
            if holds and holds <= self.dropped:
                lost.channels |= channels
                lost.schemas |= schemas
                return
            if not self.dropped.isdisjoint(holds | channels):
                kind = "rows" if listed.compression else "media"
                writer.write_kept_records(kind, self._kept_records(content))  # type: ignore[arg-type]
                return
            schemas.add(0)  # none
            for channel in undescribed:
                if channel not in channels or writer.channels[channel].schema_id not in schemas:
                    writer.write_description(channel)
        lost.described |= holds
        indexes: dict[int, bytes] = {}
        if self.index.regular:
            for offset in listed.message_index_offsets.values():
                index = records.record_at(buffer, offset - base)
                channel, entries = records.read_message_entries(buffer, index)
                indexes[channel] = bytes(entries)
        else:
            entries_of = self.index.entries[listed.chunk_start_offset]
            indexes = {channel: entries.tobytes() for channel, entries in entries_of.items()}
            low = min((int(entries[:, 0].min()) for entries in entries_of.values()), default=0)
            high = max((int(entries[:, 0].max()) for entries in entries_of.values()), default=0)
            listed = replace(listed, message_start_time=low, message_end_time=high)
        writer.copy_chunk(bytes(buffer[record.start : record.end]), listed, indexes)

    def _kept_records(self, content: Bytes) -> Iterator[tuple[int, int, memoryview]]:
        """The kept records of a chunk: channel (-1 if it is not a message), log time, and the record."""
        for inner in walk(content, 0, len(content)):
            whole = content[inner.start : inner.end]
            if inner.opcode == Opcode.MESSAGE:
                channel, _, t_ns, _ = message_head(content, inner)
                if channel not in self.dropped:
                    yield channel, t_ns, whole
            elif self._is_kept(content, inner):
                yield -1, 0, whole


@dataclass
class _Descriptions:
    """The channels that kept chunks have ``described``, and the channels and schemas that dropped chunks described."""

    described: set[int]
    channels: set[int] = field(default_factory=set)
    schemas: set[int] = field(default_factory=set)

    def of(self, channels: Iterable[ChannelRecord]) -> list[int]:
        """The ids of kept channels that need a new description: no kept chunk holds one so far."""
        return [
            channel.id
            for channel in channels
            if (channel.id in self.channels or channel.schema_id in self.schemas) and channel.id not in self.described
        ]


def _described_in(content: Bytes) -> tuple[set[int], set[int]]:
    """The channels and the schemas that a chunk describes."""
    channels, schemas = set(), set()
    for inner in walk(content, 0, len(content)):
        if inner.opcode == Opcode.CHANNEL:
            channels.add(records.read_channel(content, inner).id)
        elif inner.opcode == Opcode.SCHEMA:
            schemas.add(records.read_schema(content, inner).id)
    return channels, schemas
