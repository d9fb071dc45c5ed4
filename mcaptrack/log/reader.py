"""Reading a log: channels, messages, frames."""

from __future__ import annotations

import fcntl
import mmap
import os
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple, Self

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.log import records
from mcaptrack.log.index import Index, chunk_record, message_head, message_times, open_chunk, read_index
from mcaptrack.log.records import ChunkIndexRecord, Damaged, Record, walk
from mcaptrack.schema import Frame, Schema

Ints = NDArray[np.int64]

#: Chunks kept open while messages are read in the order of their times.
_OPEN_CHUNKS: Final = 4


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


class Log:
    """An MCAP file, open for reading. A context manager.

    Channels are found by topic; where several channels share one, the first that has messages counts.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._locked = False
        if path.is_dir():
            raise McaptrackError(f"{path} is a folder, not an MCAP file")
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
        if self._locked:  # closing is not enough: the map of the file holds on to it
            fcntl.flock(self._file, fcntl.LOCK_UN)
        self._file.close()

    def lock(self) -> None:
        """Be the only one to write to this log until it is closed. Raises McaptrackError if somebody else is."""
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise McaptrackError(
                f"{self.path} is being written to by another process; try again when it is done"
            ) from None
        self._locked = True
        try:
            same = self.path.stat().st_ino == os.fstat(self._file.fileno()).st_ino
        except OSError:
            same = False
        if not same:
            raise McaptrackError(f"{self.path} was replaced while it was being read; try again")

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
        found = [offset for known, offset in self.index.metadata if known == name]
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

    def frames(self, topic: str, schema: Schema) -> list[Frame]:
        """All rows of a channel, a frame a message. Raises McaptrackError if the channel holds something else."""
        channel = self.channel(topic)
        if channel.schema_name != schema.name or channel.message_encoding != "protobuf":
            raise McaptrackError(f"{self.path}: {topic} holds {channel.schema_name or 'no schema'}, not {schema.name}")
        messages = list(self.messages(topic))
        try:
            rows, counts = schema.codec.decode_all([message.payload for message in messages])
        except ValueError as error:
            raise McaptrackError(f"{self.path}: {topic} is damaged: {error}") from None
        ends = np.cumsum(counts).tolist()
        starts = [0, *ends][:-1]
        spans = zip(messages, starts, ends, strict=True)
        return [Frame(message.t_ns, message.sequence, rows[start:end]) for message, start, end in spans]

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
        return holders, [message_times(self._buffer, chunk, channel_id) for chunk in holders]

    def _chunked(self, channel_id: int) -> Iterator[Message]:
        holders, entries = self._entries(channel_id)
        if not entries:
            return
        t_ns = np.concatenate([times for times, _ in entries])
        offsets = np.concatenate([offset for _, offset in entries])
        chunk_of = np.repeat(np.arange(len(entries)), [len(times) for times, _ in entries])
        order = np.argsort(t_ns, kind="stable")
        opened: OrderedDict[int, memoryview] = OrderedDict()
        for number, offset, time in zip(
            chunk_of[order].tolist(), offsets[order].tolist(), t_ns[order].tolist(), strict=True
        ):
            if number not in opened:
                opened[number] = open_chunk(self._buffer, chunk_record(self._buffer, holders[number]))
                if len(opened) > _OPEN_CHUNKS:
                    opened.popitem(last=False)
            content = opened[number]
            message = self._message(content, records.record_at(content, offset), channel_id)
            if message is None or message.t_ns != time:
                raise Damaged(f"no message of channel {channel_id} at {time} ns where the index says one is")
            yield message

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
