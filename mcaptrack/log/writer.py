"""Write a log record by record, and its summary.

Pictures are written to separate, uncompressed chunks, because they are compressed already. Rows are written to zstd
chunks, separate for each stage: when a stage is run again, its old chunks are dropped without opening others. Views
also get separate chunks. Every chunk contains the schemas and channels of its messages, so that it can be read even if
it is all that is left of a file.
"""

from __future__ import annotations

import zlib
from array import array
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Final, Literal, Protocol

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import ChunkIndex
from mcap.records import Schema as SchemaRecord

from mcaptrack import __version__
from mcaptrack.errors import McaptrackError
from mcaptrack.files import publish_stream
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.ragged import gather_bytes
from mcaptrack.log import journal, records
from mcaptrack.log.byte_source import ByteSource, OpenFile
from mcaptrack.log.chunks import HEAD, LOG_MAX_NS, MessageHeads
from mcaptrack.log.index import ChunkList, Index, SummaryEntry, attachment_entry, metadata_entry, read_index
from mcaptrack.log.recording_files import RESULTS_SUFFIX, results_path
from mcaptrack.log.records import MAGIC, Damaged, crc_of

#: The library name in the header record, before the version.
LIBRARY: Final = "mcaptrack"

ChunkKind = Literal["media", "rows", "views"]

_CHUNK_BYTES: Final[Mapping[ChunkKind, int]] = {"media": 4 * 2**20, "rows": 2**20, "views": 2**20}
#: Views are so repetitive that the fastest level makes them smaller than the default one.
_ZSTD_LEVEL: Final[Mapping[ChunkKind, int]] = {"rows": 3, "views": 1}
_MAX_ID: Final = 2**16 - 1
#: Bytes of the summary that are written at once.
_SUMMARY_PART: Final = 2**16


class Sink(Protocol):
    """A destination for bytes, written sequentially."""

    def write(self, data: bytes, /) -> object:
        """Append bytes."""


@dataclass
class _OpenChunk:
    """A chunk under construction: its records, and log time and offset of each channel's messages."""

    kind: ChunkKind
    parts: list[bytes] = field(default_factory=list)
    size: int = 0
    entries: dict[int, array[int]] = field(default_factory=dict)  # time, offset, time, offset ...


class LogWriter:
    """Writes an MCAP file sequentially; made by ``create`` and ``extend``.

    With an ``index`` it continues at ``offset`` after the indexed records; ``crc`` is the checksum of all bytes so far,
    None if it is not known.
    """

    def __init__(self, sink: Sink, offset: int = 0, crc: int | None = 0, index: Index | None = None) -> None:
        index = index or Index()
        self._sink = sink
        self.offset: int = offset
        #: The checksum of the data section; only of what this writer added, if the rest is not known.
        self.crc: int = crc or 0
        self._crc_known = crc is not None
        self.schemas: dict[int, SchemaRecord] = index.schemas
        self.channels: dict[int, ChannelRecord] = index.channels
        self.counts: dict[int, int] = index.counts
        self.chunks: ChunkList = index.chunks
        self._attachments: list[SummaryEntry] = index.attachments
        self._metadata: list[SummaryEntry] = index.metadata
        self._times = index.chunks.times()
        self._groups: dict[int, tuple[ChunkKind, str]] = {}
        self._described: set[int] = set()  # outside of chunks
        self._open: dict[tuple[ChunkKind, str], _OpenChunk] = {}
        self._topics = {channel.topic for channel in self.channels.values()}
        self._schema_ids = {(s.name, s.encoding, bytes(s.data)): s.id for s in reversed(self.schemas.values())}
        self._last = max(self.schemas, default=0), max(self.channels, default=0)

    # Adding

    def header(self, profile: str = "", record: bytes | None = None) -> None:
        """Write magic bytes and header: with a ``profile`` of the MCAP registry, or the header ``record`` of another
        log.
        """
        self.write(MAGIC)
        self.write(
            record or records.pack(Opcode.HEADER, records.text(profile), records.text(f"{LIBRARY} {__version__}"))
        )

    def add_channel(
        self,
        topic: str,
        schema: tuple[str, str, bytes],
        message_encoding: str,
        metadata: Mapping[str, str],
        kind: ChunkKind = "rows",
        group: str = "",
        *,
        another: bool = False,
        ids: tuple[int, int] = (0, 0),
    ) -> int:
        """Add a channel and return its id. ``schema`` is name, encoding and data; ("", "", b"") is no schema.

        Channels with the same ``group`` share chunks. ``ids`` are those of the channel and a new schema if they are
        free. Raises McaptrackError if the topic exists already, unless ``another`` channel with it is wanted, and if
        there are 65 535 channels.
        """
        if topic in self._topics and not another:
            raise McaptrackError(f"there is a channel {topic} already")
        schema_id = 0
        if schema != ("", "", b""):
            schema_id = self._schema_ids.get(schema, 0) or _free_id(self.schemas, self._last[0], "schemas", ids[1])
            self._schema_ids[schema] = schema_id
            self.schemas[schema_id] = SchemaRecord(schema_id, name=schema[0], encoding=schema[1], data=schema[2])
        channel_id = _free_id(self.channels, self._last[1], "channels", ids[0])
        self._last = max(schema_id, self._last[0]), max(channel_id, self._last[1])
        self.channels[channel_id] = ChannelRecord(
            id=channel_id,
            topic=topic,
            message_encoding=message_encoding,
            metadata=dict(metadata),
            schema_id=schema_id,
        )
        self._topics.add(topic)
        self._groups[channel_id] = (kind, group)
        return channel_id

    def add_message(
        self, channel_id: int, t_ns: int, sequence: int, payload: bytes, publish_ns: int | None = None
    ) -> None:
        """Write a message of an added channel. Raises McaptrackError for times that MCAP can't store."""
        if not 0 <= t_ns <= LOG_MAX_NS:
            raise McaptrackError(
                f"{t_ns} ns is not a time that a log can store; times run from 0 (1970) to 2^64 - 1 ns (2554)"
            )
        group = self._groups[channel_id]
        chunk = self._open.get(group) or self._new_chunk(group)
        entries = chunk.entries.get(channel_id)
        if entries is None:
            entries = self._describe(chunk, channel_id)
        size = len(payload)
        head = records.RECORD_MESSAGE_HEAD.pack(
            Opcode.MESSAGE, size + 22, channel_id, sequence, t_ns, t_ns if publish_ns is None else publish_ns
        )
        entries.append(t_ns)
        entries.append(chunk.size)
        chunk.parts += (head, payload)
        chunk.size += size + 31
        if chunk.size >= _CHUNK_BYTES[chunk.kind]:
            self._close_chunk(group)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record."""
        self.copy_metadata(records.pack(Opcode.METADATA, records.text(name), records.text_map(values)))

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Write an attachment."""
        body = bytes(16) + records.text(name) + records.text(media_type) + records.raw(data, 8)
        self.copy_attachment(records.pack(Opcode.ATTACHMENT, body, records.number(zlib.crc32(body), 4)))

    # Copying records of another log

    def write_description(self, *channel_ids: int) -> None:
        """Write the schema and channel records of channels, outside of chunks."""
        self.write(self._description(*channel_ids))
        self._described.update(channel_ids)

    def copy_message(self, channel_id: int, t_ns: int, message: memoryview) -> None:
        """Copy a message that was outside of chunks into a chunk, because readers that use the index don't find it
        there.
        """
        group: tuple[ChunkKind, str] = ("rows", "")
        chunk = self._open.get(group) or self._new_chunk(group)
        if channel_id not in chunk.entries:
            self._describe(chunk, channel_id)
        _append(chunk, channel_id, t_ns, message)
        if chunk.size >= _CHUNK_BYTES["rows"]:
            self._close_chunk(group)

    def copy_metadata(self, record: bytes) -> None:
        """Copy a metadata record."""
        buffer = memoryview(record)
        self._metadata.append(metadata_entry(buffer, records.record_at(buffer, 0), self.offset))
        self.write(record)

    def copy_attachment(self, record: bytes) -> None:
        """Copy an attachment record."""
        buffer = memoryview(record)
        self._attachments.append(attachment_entry(buffer, records.record_at(buffer, 0), self.offset))
        self.write(record)

    def copy_chunk(self, record: bytes, listed: ChunkIndex, indexes: Mapping[int, bytes]) -> None:
        """Copy a chunk, and write its message indexes from their entries (time and offset, 8 bytes each)."""
        start = self.offset
        self.write(record)
        index_start, offsets = self.offset, {}
        for channel_id, entries in indexes.items():
            offsets[channel_id] = self.offset
            self.write(records.pack_message_index(channel_id, entries))
            self.counts[channel_id] = self.counts.get(channel_id, 0) + len(entries) // 16
        self.chunks.append(
            replace(
                listed,
                chunk_start_offset=start,
                message_index_offsets=offsets,
                message_index_length=self.offset - index_start,
            )
        )
        if indexes:
            low, high = self._times or (listed.message_start_time, listed.message_end_time)
            self._times = (min(low, listed.message_start_time), max(high, listed.message_end_time))

    def write_kept_records(self, kind: ChunkKind, parts: Iterable[tuple[int, int, memoryview]]) -> None:
        """Write kept records as a new chunk: each with its channel (-1 if it is not a message) and log time."""
        chunk = _OpenChunk(kind)
        for channel_id, t_ns, record in parts:
            _append(chunk, channel_id, t_ns, record)
        if chunk.parts:
            self._put(chunk)

    def copy_messages(self, kind: ChunkKind, content: memoryview, heads: MessageHeads, channels: Ints) -> None:
        """Copy messages (M,) of a chunk of another log as a new chunk; ``channels`` (M,) are their ids in this log."""
        ids = np.unique(channels).tolist()
        description = self._description(*ids)
        chunk = _OpenChunk(kind, [description], len(description))
        start = heads.start - HEAD.itemsize
        sizes = heads.end - start
        to = np.cumsum(sizes) - sizes
        data = np.empty(int(sizes.sum()), np.uint8)
        gather_bytes(np.frombuffer(content, np.uint8), start, sizes, to, data)
        for byte in range(2):
            data[to + records.MESSAGE_ID_AT + byte] = channels >> 8 * byte & 0xFF
        chunk.parts.append(data.tobytes())
        entries = np.stack([heads.head["t_ns"], (to + chunk.size).astype(np.uint64)], axis=1)
        for number in ids:
            chunk.entries[number] = array("Q", entries[channels == number].tobytes())
        self._put(chunk)

    def write(self, data: bytes) -> None:
        """Write bytes of the data section."""
        self._sink.write(data)
        self.crc = zlib.crc32(data, self.crc)
        self.offset += len(data)

    # Finishing

    def finish(self) -> int:
        """Close the open chunks, write summary and footer. Returns the number of messages in the file."""
        self.close_chunks()
        for channel_id in (
            self._groups.keys() - self.counts.keys() - self._described
        ):  # without messages, so no chunk describes them
            self.write_description(channel_id)
        data_crc = self.crc if self._crc_known else 0
        self._sink.write(records.pack(Opcode.DATA_END, records.number(data_crc, 4)))
        for part in self._summary(self.offset + 13):
            self._sink.write(part)
        return sum(self.counts.values())

    def _summary(self, start: int) -> Iterator[bytes]:
        """The summary and the footer, in parts: entries of hundreds of thousands of chunks take tens of megabytes."""
        groups: dict[Opcode, Iterable[bytes]] = {
            Opcode.SCHEMA: map(records.pack_schema, self.schemas.values()),
            Opcode.CHANNEL: map(records.pack_channel, self.channels.values()),
            Opcode.STATISTICS: [self._statistics()],
            Opcode.CHUNK_INDEX: map(records.pack_chunk_index, self.chunks),
            Opcode.ATTACHMENT_INDEX: (listed.entry for listed in self._attachments),
            Opcode.METADATA_INDEX: (listed.entry for listed in self._metadata),
        }
        offsets, at, crc = bytearray(), start, 0
        for opcode, entries in groups.items():
            low = at
            for part in _joined(entries):
                at, crc = at + len(part), zlib.crc32(part, crc)
                yield part
            if at > low:  # no offset for an empty group: some readers report it as damage
                where = records.number(low, 8) + records.number(at - low, 8)
                offsets += records.pack(Opcode.SUMMARY_OFFSET, records.number(opcode, 1), where)
        footer = records.number(Opcode.FOOTER, 1) + records.number(records.FOOTER_BODY.size, 8)
        footer += records.number(start, 8) + records.number(at, 8)
        last = bytes(offsets + footer)
        yield last + records.number(zlib.crc32(last, crc), 4) + MAGIC

    def _statistics(self) -> bytes:
        first, last = self._times or (0, 0)
        sizes = (
            (sum(self.counts.values()), 8),
            (len(self.schemas), 2),
            (len(self.channels), 4),
            (len(self._attachments), 4),
            (len(self._metadata), 4),
            (len(self.chunks), 4),
            (first, 8),
            (last, 8),
        )
        counts = records.number_map(self.counts, 2, 8)
        return records.pack(Opcode.STATISTICS, *(records.number(value, size) for value, size in sizes), counts)

    # Chunks

    def close_chunks(self) -> None:
        """Write the chunks under construction: what is written next stands behind their messages."""
        for group in tuple(self._open):
            self._close_chunk(group)

    def _new_chunk(self, group: tuple[ChunkKind, str]) -> _OpenChunk:
        return self._open.setdefault(group, _OpenChunk(group[0]))

    def _describe(self, chunk: _OpenChunk, channel_id: int) -> array[int]:
        """Write the schema and channel records of a channel into a chunk, before its first message there."""
        description = self._description(channel_id)
        chunk.parts.append(description)
        chunk.size += len(description)
        return chunk.entries.setdefault(channel_id, array("Q"))

    def _description(self, *channel_ids: int) -> bytes:
        try:
            channels = [self.channels[number] for number in channel_ids]
            schemas = [self.schemas[number] for number in dict.fromkeys(it.schema_id for it in channels) if number]
        except KeyError as number:  # in a log of others
            raise Damaged(f"messages name a channel or schema {number} that is defined nowhere") from None
        return b"".join([*map(records.pack_schema, schemas), *map(records.pack_channel, channels)])

    def _close_chunk(self, group: tuple[ChunkKind, str]) -> None:
        self._put(self._open.pop(group))

    def _put(self, chunk: _OpenChunk) -> None:
        content = b"".join(chunk.parts)
        indexes = {channel: np.array(entries, "<u8") for channel, entries in chunk.entries.items() if entries}
        first = min((int(entries[::2].min()) for entries in indexes.values()), default=0)
        last = max((int(entries[::2].max()) for entries in indexes.values()), default=0)
        compression, data = "", content
        if chunk.kind != "media":
            import zstandard

            compression, data = "zstd", zstandard.ZstdCompressor(_ZSTD_LEVEL[chunk.kind]).compress(content)
        record = records.pack_chunk((first, last, len(content), zlib.crc32(content)), compression, data)
        sizes = (compression, len(data), len(content))
        entry = records.chunk_index((first, last), (0, len(record)), {}, 0, sizes)
        self.copy_chunk(record, entry, {channel: entries.tobytes() for channel, entries in indexes.items()})


def _joined(entries: Iterable[bytes]) -> Iterator[bytes]:
    """Join entries to parts of about 64 kB."""
    part = bytearray()
    for entry in entries:
        part += entry
        if len(part) >= _SUMMARY_PART:
            yield bytes(part)
            part.clear()
    if part:
        yield bytes(part)


def _append(chunk: _OpenChunk, channel_id: int, t_ns: int, record: memoryview) -> None:
    """Append a record to a chunk; ``channel_id`` is -1 if it is not a message."""
    if channel_id >= 0:
        chunk.entries.setdefault(channel_id, array("Q")).extend((t_ns, chunk.size))
    chunk.parts.append(bytes(record))
    chunk.size += len(record)


def _free_id(taken: Mapping[int, object], last: int, what: str, wanted: int = 0) -> int:
    """The id that is ``wanted`` if it is free, else the first free one after ``last``, else the lowest free one."""
    if wanted and wanted not in taken:
        return wanted
    free = (number for number in chain(range(last + 1, _MAX_ID + 1), range(1, last + 1)) if number not in taken)
    free_id = next(free, None)
    if free_id is None:
        raise McaptrackError(f"there are {len(taken)} {what} already; a log holds no more")
    return free_id


def refuse_earlier_results(path: Path) -> None:
    """Raise McaptrackError if a new log at ``path`` would be read with the sidecar of an earlier one."""
    results = results_path(path)
    if not path.name.endswith(RESULTS_SUFFIX) and results.exists():
        raise McaptrackError(
            f"{results} holds results of an earlier {path.name} and would be read with the new one; remove it first, "
            "or choose another name"
        )


@contextmanager
def create(path: Path, profile: str = "", *, header: bytes | None = None) -> Iterator[LogWriter]:
    """Write a new log, which is published at ``path`` when the block succeeds.

    ``header`` is the header of another log.

    ``profile`` is that of the MCAP registry, such as "ros2".
    """
    refuse_earlier_results(path)
    is_half_written = journal.is_left_behind(path)
    with publish_stream(path) as stream:
        writer = LogWriter(stream)
        writer.header(profile, header)
        yield writer
        messages = writer.finish()
        stream.flush()
        verify(Path(stream.name), writer, messages)
    if is_half_written:  # of the log that was replaced
        journal.remove(path)


def verify(path: Path, writer: LogWriter, messages: int, start: int = 0, crc: int = 0) -> None:
    """Read back what was written from ``start`` on; ``crc`` is the checksum of the bytes before it.

    Raises McaptrackError if it differs from what was written; then it must not be published.
    """
    file = OpenFile.at(path)
    try:
        source = ByteSource.of(file)
        index = read_index(source)
        readable = sum(index.counts.values())
        is_right = crc_of(source, start, index.data_end, crc) == writer.crc and readable == messages
    except Damaged:
        readable, is_right = 0, False
    finally:
        file.close()
    if not is_right:
        raise McaptrackError(
            f"{path}: {readable} messages are read back of {messages} that were written, or their checksum differs; "
            "the log is left as it was"
        )
