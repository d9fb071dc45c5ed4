"""Writing a log: a new one, or one that stands with channels added and others left out.

A log is written beside its final name and takes it when it is complete, checked and on the disk. Chunks that stand are
copied as they are; only a chunk that mixes kept and dropped channels is opened. Pictures go to chunks of their own,
uncompressed, because they are compressed already; rows go to zstd chunks of the stage that made them.
"""

from __future__ import annotations

import zlib
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Final, Literal

from mcap.opcode import Opcode

from mcaptrack import __version__
from mcaptrack.atomic import publish_stream
from mcaptrack.errors import McaptrackError
from mcaptrack.log import records
from mcaptrack.log.index import Index, message_head, open_chunk, read_index
from mcaptrack.log.reader import Log
from mcaptrack.log.records import MAGIC, ChannelRecord, ChunkIndexRecord, SchemaRecord, walk

Kind = Literal["media", "rows"]

_CHUNK_BYTES: Final[Mapping[Kind, int]] = {"media": 4 * 2**20, "rows": 2**20}
_ZSTD_LEVEL: Final = 3
_MAX_NS: Final = 2**63 - 1


@dataclass
class _OpenChunk:
    kind: Kind
    parts: list[bytes] = field(default_factory=list)
    size: int = 0
    entries: dict[int, list[tuple[int, int]]] = field(default_factory=dict)


class LogWriter:
    """Writes one MCAP file from front to back; made by ``create`` and ``extend``."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._offset = self._crc = 0
        self._schemas: dict[int, SchemaRecord] = {}
        self._channels: dict[int, ChannelRecord] = {}
        self._counts: dict[int, int] = {}
        self._kinds: dict[int, Kind] = {}
        self._chunks: list[ChunkIndexRecord] = []
        self._open: dict[Kind, _OpenChunk] = {}
        self._attachments: list[bytes] = []
        self._metadata: list[bytes] = []
        self._times: tuple[int, int] | None = None
        self._next_schema = self._next_channel = 1
        self._write(MAGIC)

    # Adding

    def header(self, profile: str = "") -> None:
        """The first record; ``profile`` as in the MCAP registry, "" for none."""
        self._write(records.pack(Opcode.HEADER, records.text(profile), records.text(f"mcaptrack {__version__}")))

    def add_channel(
        self,
        topic: str,
        schema: tuple[str, str, bytes],
        message_encoding: str,
        metadata: Mapping[str, str],
        kind: Kind = "rows",
    ) -> int:
        """A new channel; returns its id. ``schema`` is its name, encoding and data.

        Raises McaptrackError if the topic is taken.
        """
        if any(channel.topic == topic for channel in self._channels.values()):
            raise McaptrackError(f"there is a channel {topic} already")
        schema_id = next((s.id for s in self._schemas.values() if (s.name, s.encoding, s.data) == schema), 0)
        if not schema_id:
            schema_id = self._next_schema
            self._put_schema(SchemaRecord(schema_id, *schema))
            self._write(records.pack_schema(self._schemas[schema_id]))
        channel = ChannelRecord(self._next_channel, schema_id, topic, message_encoding, dict(metadata))
        self._put_channel(channel)
        self._kinds[channel.id] = kind
        self._write(records.pack_channel(channel))
        return channel.id

    def add_message(self, channel_id: int, t_ns: int, sequence: int, payload: bytes) -> None:
        """A message of a channel that was added. Raises McaptrackError for times that no log can hold."""
        if not 0 <= t_ns <= _MAX_NS:
            raise McaptrackError(f"{t_ns} ns is no time for a log; times run from 0 (1970) to {_MAX_NS} ns (2262)")
        message = records.pack_message(channel_id, sequence, t_ns, t_ns, payload)
        self._put_message(self._kinds[channel_id], channel_id, t_ns, message)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """A metadata record."""
        record = records.pack(Opcode.METADATA, records.text(name), records.text_map(values))
        self._index_metadata(name, len(record))
        self._write(record)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """A file inside the log."""
        times = bytes(16)
        body = times + records.text(name) + records.text(media_type) + records.raw(data, 8)
        record = records.pack(Opcode.ATTACHMENT, body, records.number(zlib.crc32(body), 4))
        self._index_attachment(times, name, media_type, len(data), len(record))
        self._write(record)

    # Copying

    def copy(
        self, source: Log, drop: Collection[str], drop_metadata: Collection[str], drop_attachments: Collection[str]
    ) -> None:
        """All of a log but these channels, metadata and attachments; ids, chunks and checksums stay as they are."""
        buffer, index = source.buffer, source.index
        dropped = {channel.id for channel in index.channels.values() if channel.topic in drop}
        kept_channels = {id_: channel for id_, channel in index.channels.items() if id_ not in dropped}
        kept_schemas = {channel.schema_id for channel in kept_channels.values()}
        named_outside = set()
        for record in walk(buffer, len(MAGIC), index.data_end):
            if record.opcode == Opcode.CHANNEL:
                named_outside.add(records.read_channel(buffer, record).id)
        may_be_inside = bool(dropped - named_outside)
        self._next_schema = max(index.schemas, default=0) + 1
        self._next_channel = max(index.channels, default=0) + 1
        skip_index = False
        for record in walk(buffer, len(MAGIC), index.data_end):
            whole = bytes(buffer[record.start : record.end])
            if record.opcode == Opcode.SCHEMA:
                schema = records.read_schema(buffer, record)
                if schema.id not in kept_schemas and dropped:
                    continue
            elif record.opcode == Opcode.CHANNEL:
                if records.read_channel(buffer, record).id in dropped:
                    continue
            elif record.opcode == Opcode.MESSAGE:
                channel, _, t_ns, _ = message_head(buffer, record)
                if channel not in dropped:
                    # Readers that go by the index of chunks would never find it outside of one.
                    self._put_message("rows", channel, t_ns, whole)
                continue
            elif record.opcode == Opcode.CHUNK:
                skip_index = self._copy_chunk(buffer, index, record, dropped, may_be_inside)
                continue
            elif record.opcode == Opcode.MESSAGE_INDEX:
                if not skip_index and not self._chunks:
                    raise records.Damaged(f"byte {record.start}: a message index without a chunk")
                if not skip_index:
                    channel = records.read_message_index(buffer, record)[0]
                    self._chunks[-1].message_index_offsets[channel] = self._offset
                    self._chunks[-1] = self._chunks[-1]._replace(
                        message_index_length=self._chunks[-1].message_index_length + len(whole)
                    )
                    self._write(whole)
                continue
            elif record.opcode == Opcode.ATTACHMENT:
                log_ns, create_ns, name, media_type, data = records.read_attachment(buffer, record)
                if name in drop_attachments:
                    continue
                times = records.number(log_ns, 8) + records.number(create_ns, 8)
                self._index_attachment(times, name, media_type, len(data), len(whole))
            elif record.opcode == Opcode.METADATA:
                name = records.read_metadata(buffer, record)[0]
                if name in drop_metadata:
                    continue
                self._index_metadata(name, len(whole))
            self._write(whole)
        self._schemas = {id_: s for id_, s in index.schemas.items() if id_ in kept_schemas or not dropped}
        self._channels = dict(kept_channels)

    def _copy_chunk(
        self, buffer: memoryview, index: Index, record: records.Record, dropped: set[int], may_be_inside: bool
    ) -> bool:
        """Copy a chunk as it is if nothing in it goes, or what is kept of it; returns whether its indexes go too."""
        known = next((chunk for chunk in index.chunks if chunk.offset == record.start), None)
        if known is None:
            raise records.Damaged(f"byte {record.start}: a chunk that no index knows")
        content = None
        counts: dict[int, int] = {}
        indexes = known.message_index_offsets
        if all(indexes.values()) and not dropped & set(indexes) and not may_be_inside:
            for offset in indexes.values():
                channel, count = records.read_message_index(buffer, records.record_at(buffer, offset))
                counts[channel] = count
        if not counts:
            content = open_chunk(buffer, record)
            goes = False
            for inner in walk(content, 0, len(content)):
                if inner.opcode == Opcode.MESSAGE:
                    channel = message_head(content, inner)[0]
                    counts[channel] = counts.get(channel, 0) + 1
                    goes |= channel in dropped
                elif inner.opcode == Opcode.CHANNEL:
                    goes |= records.read_channel(content, inner).id in dropped
            if goes:
                self._rewrite_chunk(content, known, dropped)
                return True
        self._chunks.append(known._replace(offset=self._offset, message_index_offsets={}, message_index_length=0))
        for channel, count in counts.items():
            self._counts[channel] = self._counts.get(channel, 0) + count
        if counts:
            self._times_seen(known.start_ns, known.end_ns)
        self._write(bytes(buffer[record.start : record.end]))
        return False

    def _rewrite_chunk(self, content: memoryview, known: ChunkIndexRecord, dropped: set[int]) -> None:
        chunk = _OpenChunk("rows" if known.compression else "media")
        for inner in walk(content, 0, len(content)):
            if inner.opcode == Opcode.MESSAGE:
                channel, _, t_ns, _ = message_head(content, inner)
                if channel in dropped:
                    continue
                chunk.entries.setdefault(channel, []).append((t_ns, chunk.size))
                self._count(channel, t_ns)
            elif inner.opcode == Opcode.CHANNEL and records.read_channel(content, inner).id in dropped:
                continue
            chunk.parts.append(bytes(content[inner.start : inner.end]))
            chunk.size += inner.end - inner.start
        if chunk.parts:
            self._put_chunk(chunk)

    # Finishing

    def finish(self) -> int:
        """Close the open chunks, write the summary and the footer. Returns how many messages the file holds."""
        for kind in tuple(self._open):
            self._close_chunk(kind)
        crc = self._crc
        self._write(records.pack(Opcode.DATA_END, records.number(crc, 4)))
        start = self._offset
        groups = {
            Opcode.SCHEMA: [records.pack_schema(schema) for schema in self._schemas.values()],
            Opcode.CHANNEL: [records.pack_channel(channel) for channel in self._channels.values()],
            Opcode.STATISTICS: [self._statistics()],
            Opcode.CHUNK_INDEX: [records.pack_chunk_index(chunk) for chunk in self._chunks],
            Opcode.ATTACHMENT_INDEX: self._attachments,
            Opcode.METADATA_INDEX: self._metadata,
        }
        summary, offsets = bytearray(), bytearray()
        for opcode, parts in groups.items():
            if parts:  # an empty group has no offset: some readers take one for damage
                group = b"".join(parts)
                where = records.number(start + len(summary), 8) + records.number(len(group), 8)
                offsets += records.pack(Opcode.SUMMARY_OFFSET, records.number(opcode, 1), where)
                summary += group
        offset_start = start + len(summary)
        body = bytes(summary + offsets)
        footer = records.number(Opcode.FOOTER, 1) + records.number(records.FOOTER_BODY.size, 8)
        footer += records.number(start, 8) + records.number(offset_start, 8)
        checksum = zlib.crc32(footer, zlib.crc32(body))
        self._write(body + footer + records.number(checksum, 4) + MAGIC)
        self._stream.flush()
        return sum(self._counts.values())

    def _statistics(self) -> bytes:
        first, last = self._times or (0, 0)
        sizes = (
            (sum(self._counts.values()), 8),
            (len(self._schemas), 2),
            (len(self._channels), 4),
            (len(self._attachments), 4),
            (len(self._metadata), 4),
            (len(self._chunks), 4),
            (first, 8),
            (last, 8),
        )
        counts = records.number_map(self._counts, 2, 8)
        return records.pack(Opcode.STATISTICS, *(records.number(value, size) for value, size in sizes), counts)

    # Inside

    def _put_schema(self, schema: SchemaRecord) -> None:
        self._schemas[schema.id] = schema
        self._next_schema = max(self._next_schema, schema.id + 1)

    def _put_channel(self, channel: ChannelRecord) -> None:
        self._channels[channel.id] = channel
        self._next_channel = max(self._next_channel, channel.id + 1)

    def _count(self, channel_id: int, t_ns: int) -> None:
        self._counts[channel_id] = self._counts.get(channel_id, 0) + 1
        self._times_seen(t_ns, t_ns)

    def _times_seen(self, first_ns: int, last_ns: int) -> None:
        low, high = self._times or (first_ns, last_ns)
        self._times = (min(low, first_ns), max(high, last_ns))

    def _index_metadata(self, name: str, length: int) -> None:
        fields = records.number(self._offset, 8) + records.number(length, 8)
        self._metadata.append(records.pack(Opcode.METADATA_INDEX, fields, records.text(name)))

    def _index_attachment(self, times: bytes, name: str, media_type: str, size: int, length: int) -> None:
        fields = records.number(self._offset, 8) + records.number(length, 8) + times + records.number(size, 8)
        self._attachments.append(
            records.pack(Opcode.ATTACHMENT_INDEX, fields, records.text(name), records.text(media_type))
        )

    def _put_message(self, kind: Kind, channel_id: int, t_ns: int, message: bytes) -> None:
        chunk = self._open.setdefault(kind, _OpenChunk(kind))
        chunk.entries.setdefault(channel_id, []).append((t_ns, chunk.size))
        chunk.parts.append(message)
        chunk.size += len(message)
        self._count(channel_id, t_ns)
        if chunk.size >= _CHUNK_BYTES[kind]:
            self._close_chunk(kind)

    def _close_chunk(self, kind: Kind) -> None:
        self._put_chunk(self._open.pop(kind))

    def _put_chunk(self, chunk: _OpenChunk) -> None:
        content = b"".join(chunk.parts)
        times = [t_ns for entries in chunk.entries.values() for t_ns, _ in entries]
        first, last = (min(times), max(times)) if times else (0, 0)
        compression, data = "", content
        if chunk.kind == "rows":
            import zstandard

            compression, data = "zstd", zstandard.ZstdCompressor(_ZSTD_LEVEL).compress(content)
        record = records.pack_chunk((first, last, len(content), zlib.crc32(content)), compression, data)
        start = self._offset
        self._write(record)
        index_start, offsets = self._offset, {}
        for channel_id, entries in chunk.entries.items():
            offsets[channel_id] = self._offset
            self._write(records.pack_message_index(channel_id, entries))
        length = self._offset - index_start
        self._chunks.append(
            ChunkIndexRecord(first, last, start, len(record), offsets, length, compression, len(data), len(content))
        )

    def _write(self, data: bytes) -> None:
        self._stream.write(data)
        self._crc = zlib.crc32(data, self._crc)
        self._offset += len(data)


@contextmanager
def create(path: Path) -> Iterator[LogWriter]:
    """A new log at ``path``, there once the block has ended well."""
    with publish_stream(path) as stream:
        writer = LogWriter(stream)
        writer.header()
        yield writer
        _finish(writer, stream)


@contextmanager
def extend(
    log: Log,
    output: Path | None = None,
    *,
    drop: Collection[str] = (),
    drop_metadata: Collection[str] = (),
    drop_attachments: Collection[str] = (),
) -> Iterator[LogWriter]:
    """The log with channels added and these topics, metadata and attachments left out, there once the block ends well.

    ``output`` is another file to write it to; the log itself stays as it is then. Raises McaptrackError if another
    process is writing to it.
    """
    if output is None:
        log.lock()
    with publish_stream(output or log.path) as stream:
        writer = LogWriter(stream)
        try:
            writer.copy(log, drop, drop_metadata, drop_attachments)
        except records.Damaged as error:
            raise McaptrackError(f"{log.path} is damaged: {error}") from None
        yield writer
        _finish(writer, stream)


def _finish(writer: LogWriter, stream: IO[bytes]) -> None:
    """Write the end, then read the file's summary back: what can't be read again is not published."""
    written = writer.finish()
    with Path(stream.name).open("rb") as check:
        import mmap

        index = read_index(memoryview(mmap.mmap(check.fileno(), 0, access=mmap.ACCESS_READ)))
    readable = sum(index.counts.values())
    if readable != written:
        raise McaptrackError(
            f"of {written} messages that were written {readable} can be read again; "
            "the log does not add up, and is left as it was"
        )
