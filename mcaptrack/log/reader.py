"""Reading a log: channels, messages, frames."""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.log import journal, records
from mcaptrack.log.chunks import Heads, chunk_record, forget, heads_at, message_head, message_times, open_chunk
from mcaptrack.log.index import Index, read_index
from mcaptrack.log.records import ChunkIndexRecord, Damaged, Record, walk
from mcaptrack.schema import Frame, Rows, Schema

Ints = NDArray[np.int64]


class Channel(NamedTuple):
    """A channel of a log."""

    id: int
    topic: str
    schema_name: str
    message_encoding: str
    metadata: dict[str, str]
    messages: int


class Message(NamedTuple):
    """A message as it stands in a log; times in nanoseconds."""

    t_ns: int
    sequence: int
    publish_ns: int
    payload: bytes


class Columns(NamedTuple):
    """All rows of a channel by time, and of each message its time, sequence number and how many rows are its own."""

    rows: Rows
    t_ns: Ints
    sequence: Ints
    counts: Ints


class Log:
    """An MCAP file, open for reading. A context manager.

    Channels are found by topic; where several channels share one, the first that has messages counts.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.real_path = path.resolve()
        self._lock: int | None = None
        if path.is_dir():
            raise McaptrackError(f"{path} is a folder, not an MCAP file")
        journal.settle(self.real_path)
        try:
            self._file = path.open("rb")
        except OSError as error:
            raise McaptrackError(f"{path} can't be opened: {error.strerror}") from None
        try:
            size = path.stat().st_size
            if size == 0:
                raise Damaged("it is empty")
            self._buffer = memoryview(mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ))
            self.index: Index = read_index(self._buffer)
        except Damaged as error:
            self._file.close()
            raise McaptrackError(f"{path} can't be read as an MCAP file: {error}") from None
        self.channels: dict[str, Channel] = {}
        for record in self.index.channels.values():
            schema = self.index.schemas.get(record.schema_id)
            count = self.index.counts.get(record.id, 0)
            channel = Channel(
                record.id, record.topic, schema.name if schema else "", record.message_encoding, record.metadata, count
            )
            if record.topic not in self.channels or (count and not self.channels[record.topic].messages):
                self.channels[record.topic] = channel

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
        self._file.close()

    def lock(self) -> int:
        """Be the only one to write to this log until it is closed; returns a handle to write with.

        Raises McaptrackError if somebody else is, or if nobody may.
        """
        if self._lock is None:
            try:
                handle = os.open(self.real_path, os.O_RDWR)
            except OSError as error:
                raise McaptrackError(
                    f"{self.path} can't be written to: {error.strerror}; write to another file with -o"
                ) from None
            try:
                journal.lock(self.real_path, handle)
                if not os.path.samestat(os.fstat(handle), os.fstat(self._file.fileno())) or os.fstat(
                    handle
                ).st_size != len(self._buffer):
                    raise McaptrackError(f"{self.path} was replaced while it was being read; try again")
            except BaseException:
                os.close(handle)
                raise
            self._lock = handle
        return self._lock

    @property
    def buffer(self) -> memoryview:
        """The bytes of the file."""
        return self._buffer

    @property
    def start_ns(self) -> int:
        """The time of the first message."""
        return self.index.start_ns

    @property
    def end_ns(self) -> int:
        """The time of the last message."""
        return self.index.end_ns

    def channel(self, topic: str) -> Channel:
        """The channel of that topic. Raises McaptrackError, with what there is, if there is none."""
        if topic not in self.channels:
            there = [name for name in sorted(self.channels) if "/view/" not in name]
            raise McaptrackError(
                f"{self.path} has no channel {topic}; it has {', '.join(there) or 'none'}. "
                f"`mcaptrack info {self.path}` shows more"
            )
        return self.channels[topic]

    def metadata(self, name: str) -> dict[str, str] | None:
        """The last metadata record of that name."""
        found = [listed.offset for listed in self.index.metadata if listed.name == name]
        if not found:
            return None
        try:
            return records.read_metadata(self._buffer, records.record_at(self._buffer, found[-1]))[1]
        except Damaged as error:
            raise McaptrackError(f"{self.path} is damaged: {error}") from None

    def messages(self, topic: str) -> Iterator[Message]:
        """The messages of a channel in the order of their times. Raises McaptrackError where the file is damaged."""
        channel = self.channel(topic)
        try:
            yield from self._loose(channel.id) if self.index.loose else self._chunked(channel.id)
        except Damaged as error:
            raise McaptrackError(f"{self.path} is damaged: {error}") from None

    def rows(self, topic: str, schema: Schema) -> Columns:
        """All rows of a channel as one array. Raises McaptrackError if the channel holds something else."""
        channel = self.channel(topic)
        if channel.schema_name != schema.name or channel.message_encoding != "protobuf":
            raise McaptrackError(f"{self.path}: {topic} holds {channel.schema_name or 'no schema'}, not {schema.name}")
        try:
            found = None if self.index.loose else self._columns(channel.id, schema)
            if found is not None:
                return found
            messages = list(self.messages(topic))
            rows, counts = schema.codec.decode_all([message.payload for message in messages])
        except (Damaged, ValueError) as error:
            raise McaptrackError(f"{self.path}: {topic} is damaged: {error}") from None
        t_ns = np.array([message.t_ns for message in messages], np.int64)
        return Columns(rows, t_ns, np.array([message.sequence for message in messages], np.int64), counts)

    def frames(self, topic: str, schema: Schema) -> list[Frame]:
        """The same, a frame a message."""
        found = self.rows(topic, schema)
        ends = np.cumsum(found.counts)
        columns = (found.t_ns, found.sequence, ends - found.counts, ends)
        spans = zip(*(column.tolist() for column in columns), strict=True)
        return [Frame(t_ns, sequence, found.rows[start:end]) for t_ns, sequence, start, end in spans]

    def times(self, topic: str) -> Ints:
        """The times of a channel's messages, rising, without reading them."""
        channel = self.channel(topic)
        if self.index.loose:
            return np.array([message.t_ns for message in self.messages(topic)], np.int64)
        try:
            return np.sort(np.concatenate([np.empty(0, np.int64), *(t for t, _ in self._entries(channel.id)[1])]))
        except Damaged as error:
            raise McaptrackError(f"{self.path} is damaged: {error}") from None

    def _entries(self, channel_id: int) -> tuple[list[ChunkIndexRecord], list[tuple[Ints, Ints]]]:
        """The chunks that hold messages of a channel, and the times and places of these messages."""
        holders = [chunk for chunk in self.index.chunks if channel_id in chunk.message_index_offsets]
        entries = [message_times(self._buffer, chunk, channel_id) for chunk in holders]
        listed, said = sum(len(times) for times, _ in entries), self.index.counts.get(channel_id, 0)
        if listed != said:
            raise Damaged(f"its indexes list {listed} messages of channel {channel_id}, and there are {said}")
        return holders, entries

    def _columns(self, channel_id: int, schema: Schema) -> Columns | None:
        """Rows without a loop over messages; None where a message is laid out otherwise than ours."""
        holders, entries = self._entries(channel_id)
        parts: list[Columns] = []
        for chunk, (t_ns, offset) in zip(holders, entries, strict=True):
            content = open_chunk(self._buffer, chunk_record(self._buffer, chunk))
            found = heads_at(content, channel_id, t_ns, offset)
            decoded = schema.codec.decode_at(np.frombuffer(content, np.uint8), found.start, found.end)
            if decoded is None:
                return None
            parts.append(Columns(decoded[0], t_ns, found.head["sequence"].astype(np.int64), decoded[1]))
        if not parts:
            return Columns(schema.empty(), *(np.empty(0, np.int64) for _ in range(3)))
        rows = schema.codec.join([part.rows for part in parts])
        times, sequence, counts = (np.concatenate(column) for column in list(zip(*parts, strict=True))[1:])
        order = np.argsort(times, kind="stable")
        if (np.diff(order) != 1).any():
            first, kept = (np.cumsum(counts) - counts)[order], counts[order]
            rows = rows[np.repeat(first - (np.cumsum(kept) - kept), kept) + np.arange(len(rows))]
        rows.flags.writeable = False
        return Columns(rows, times[order], sequence[order], counts[order])

    def _chunked(self, channel_id: int) -> Iterator[Message]:
        """By time; messages of one time as they stand in the file. A chunk is open while its messages are due."""
        holders, entries = self._entries(channel_id)
        if not any(len(times) for times, _ in entries):
            return
        t_ns = np.concatenate([times for times, _ in entries])
        chunk_of = np.repeat(np.arange(len(entries)), [len(times) for times, _ in entries])
        due = np.bincount(chunk_of, minlength=len(entries)).tolist()
        opened: dict[int, Iterator[Message]] = {}
        in_order = chunk_of[np.argsort(t_ns, kind="stable")]
        # Chunks rarely overlap: as long as one goes on, its messages are passed on without a look at the others.
        turns = np.flatnonzero(np.diff(in_order)) + 1
        starts = np.concatenate([[0], turns, [len(in_order)]])
        for number, run in zip(in_order[starts[:-1]].tolist(), np.diff(starts).tolist(), strict=True):
            if number not in opened:
                opened[number] = self._messages_of(holders[number], channel_id, *entries[number])
            yield from islice(opened[number], run)
            due[number] -= run
            if not due[number]:
                del opened[number]
                forget(self._buffer, holders[number].offset, holders[number].offset + holders[number].length)

    def _messages_of(self, chunk: ChunkIndexRecord, channel_id: int, t_ns: Ints, offset: Ints) -> Iterator[Message]:
        """One channel's messages in a chunk, by time."""
        order = np.argsort(t_ns, kind="stable")
        content = open_chunk(self._buffer, chunk_record(self._buffer, chunk))
        found: Heads = heads_at(content, channel_id, t_ns[order], offset[order])
        whole = content.obj
        data = whole if isinstance(whole, bytes) and len(whole) == len(content) else content
        spans = zip(found.start.tolist(), found.end.tolist(), strict=True)
        payloads = (bytes(data[start:end]) for start, end in spans)
        head = found.head
        return map(Message, head["t_ns"].tolist(), head["sequence"].tolist(), head["publish_ns"].tolist(), payloads)

    def _loose(self, channel_id: int) -> Iterator[Message]:
        """For files in which messages stand outside of chunks."""
        found = [self._message(self._buffer, record, channel_id) for record in self.index.loose]
        for chunk in self.index.chunks:
            content = open_chunk(self._buffer, chunk_record(self._buffer, chunk))
            found += [self._message(content, record, channel_id) for record in walk(content, 0, len(content))]
        yield from sorted((message for message in found if message), key=lambda message: message.t_ns)

    @staticmethod
    def _message(buffer: memoryview, record: Record, channel_id: int) -> Message | None:
        if record.opcode != Opcode.MESSAGE:
            return None
        channel, sequence, t_ns, publish_ns = message_head(buffer, record)
        if channel != channel_id:
            return None
        return Message(t_ns, sequence, publish_ns, bytes(buffer[record.body + records.MESSAGE_HEAD.size : record.end]))


def read(path: Path) -> Log:
    """Open a log. Raises McaptrackError, in one line, if it is none or is damaged."""
    return Log(path)


def topics_with_schema(log: Log, names: Sequence[str]) -> list[Channel]:
    """The channels that hold one of these schemas, in order of topic."""
    return [channel for _, channel in sorted(log.channels.items()) if channel.schema_name in names]
