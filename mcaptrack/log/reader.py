"""Reading a log: channels, messages, frames."""

from __future__ import annotations

import hashlib
import heapq
import mmap
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import DamagedError, McaptrackError
from mcaptrack.log import journal, records
from mcaptrack.log.fingerprint import fingerprint
from mcaptrack.log.index import Index, read_index
from mcaptrack.log.messages import Columns, Message, Messages, Places
from mcaptrack.log.records import ChannelRecord, Damaged
from mcaptrack.log.writer import RESULTS, create, results_of
from mcaptrack.schema import Frame, Schema

Ints = NDArray[np.int64]


class Channel(NamedTuple):
    """A channel of a log, or all channels of a topic: ``messages`` counts those of all, the rest is of the first."""

    id: int
    topic: str
    schema_name: str
    message_encoding: str
    metadata: dict[str, str]
    messages: int


class Log:
    """An MCAP file, open for reading. A context manager.

    Channels are found by topic; several channels of one topic and one message layout are read as one, by time. With
    ``results``, another log beside it, channels of both are there, those of the results first; what is added goes to
    the results.
    """

    def __init__(self, path: Path, results: Log | None = None) -> None:
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
            self._messages = Messages(self._buffer, self.index)
        except Damaged as error:
            self._file.close()
            raise McaptrackError(f"{path} can't be read as an MCAP file: {error}; {_recover(path)}") from None
        self.results = results
        self.is_new = False  # made a moment ago, and to be removed if nothing comes into it
        #: Every channel of this file, also those that share a topic, and those that the results replace.
        self.recorded: tuple[Channel, ...] = tuple(map(self._channel, self.index.channels.values()))
        self._by_topic: dict[str, list[Channel]] = {}
        for channel in self.recorded:
            self._by_topic.setdefault(channel.topic, []).append(channel)
        self.channels: dict[str, Channel] = {}
        for topic, those in self._by_topic.items():
            first = next((channel for channel in those if channel.messages), those[0])
            self.channels[topic] = first._replace(messages=sum(channel.messages for channel in those))
        if results is not None:
            self.channels |= results.channels

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
        self._file.close()
        if self.results is not None:
            self.results.__exit__()
            if self.results.is_new:
                with Log(self.results.path) as left:
                    is_empty = not left.channels
                if is_empty:
                    self.results.path.unlink()

    def lock(self) -> int:
        """Be the only one to write to this log until it is closed; returns a handle to write with.

        Raises McaptrackError if somebody else is, or if nobody may.
        """
        if self.results is not None:
            return self.results.lock()
        if self._lock is None:
            try:
                handle = os.open(self.real_path, os.O_RDWR)
            except OSError as error:
                raise McaptrackError(
                    f"{self.path} can't be written to: {error.strerror}; "
                    "write to another file with -o, or beside it with --sidecar"
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
    def parts(self) -> tuple[Log, ...]:
        """The log, and its results if they stand in another."""
        return (self,) if self.results is None else (self, self.results)

    def part(self, topic: str) -> Log:
        """The part that holds the channel of that topic."""
        return self.results if self.results is not None and topic in self.results.channels else self

    @property
    def start_ns(self) -> int:
        """The time of the first message."""
        return min((part.index.start_ns for part in self.parts if part.index.counts), default=0)

    @property
    def end_ns(self) -> int:
        """The time of the last message."""
        return max(part.index.end_ns for part in self.parts)

    def channel(self, topic: str) -> Channel:
        """The channel of that topic. Raises McaptrackError, with what there is, if there is none."""
        if topic not in self.channels:
            there = [name for name in sorted(self.channels) if "/view/" not in name]
            raise McaptrackError(
                f"{self.path} has no channel {topic}; it has {', '.join(there) or 'none'}. "
                f"`mcaptrack info {self.path}` shows more"
            )
        return self.channels[topic]

    def _channel(self, record: ChannelRecord) -> Channel:
        schema = self.index.schemas.get(record.schema_id)
        name, count = schema.name if schema else "", self.index.counts.get(record.id, 0)
        return Channel(record.id, record.topic, name, record.message_encoding, record.metadata, count)

    def _ids(self, topic: str) -> list[int]:
        """The channels of a topic that hold messages, to be read as one.

        Raises McaptrackError if there is no channel of that topic, or if their messages are laid out differently.
        """
        self.channel(topic)
        those = [channel for channel in self._by_topic[topic] if channel.messages]
        layouts = {self._layout(channel): channel for channel in reversed(those)}
        if len(layouts) > 1:
            kinds = ", ".join(
                f"{channel.messages} of channel {channel.id} ({channel.schema_name or 'no schema'}, "
                f"{channel.message_encoding or 'no encoding'})"
                for channel in those
            )
            raise McaptrackError(f"{self.path}: messages of {topic} are laid out differently: {kinds}")
        return [channel.id for channel in those]

    def _layout(self, channel: Channel) -> tuple[str, ...]:
        """What decides how a channel's messages are decoded. Comments and blanks in ROS definitions don't."""
        schema = self.index.schemas.get(self.index.channels[channel.id].schema_id)
        if schema is None:
            return (channel.message_encoding,)
        data = bytes(schema.data)
        if schema.encoding in ("ros1msg", "ros2msg"):
            data = b"\n".join(b" ".join(line.partition(b"#")[0].split()) for line in data.splitlines())
            data = b"\n".join(filter(None, data.split(b"\n")))
        return (channel.message_encoding, schema.name, schema.encoding, hashlib.sha256(data).hexdigest())

    def metadata(self, name: str) -> dict[str, str] | None:
        """The last metadata record of that name."""
        if self.results is not None and (of_results := self.results.metadata(name)) is not None:
            return of_results
        found = [listed.offset for listed in self.index.metadata if listed.name == name]
        if not found:
            return None
        with self.mending():
            return records.read_metadata(self._buffer, records.record_at(self._buffer, found[-1]))[1]

    def attachment(self, name: str) -> bytes | None:
        """The data of the last attachment of that name."""
        if self.results is not None and (of_results := self.results.attachment(name)) is not None:
            return of_results
        found = [listed.offset for listed in self.index.attachments if listed.name == name]
        if not found:
            return None
        with self.mending():
            return bytes(records.read_attachment(self._buffer, records.record_at(self._buffer, found[-1]))[4])

    def messages(self, topic: str, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Message]:
        """The messages of a channel by time, from ``start_ns`` to before ``end_ns``, all of them without these.

        Chunks outside of that span are not touched. Raises McaptrackError where the file is damaged.
        """
        if (part := self.part(topic)) is not self:
            yield from part.messages(topic, start_ns, end_ns)
            return
        channels = self._ids(topic)
        with self.mending():
            yield from self._messages.by_time(channels, (start_ns, end_ns))

    def merged(
        self, topics: Iterable[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[tuple[str, Message]]:
        """The messages of several channels by time, with their topics; those of one time in the order of topics."""

        def named(topic: str) -> Iterator[tuple[str, Message]]:
            return ((topic, message) for message in self.messages(topic, start_ns, end_ns))

        return heapq.merge(*map(named, topics), key=lambda found: found[1].t_ns)

    def rows(self, topic: str, schema: Schema) -> Columns:
        """All rows of a channel as one array. Raises McaptrackError if the channel holds something else."""
        if (part := self.part(topic)) is not self:
            return part.rows(topic, schema)
        channel = self.channel(topic)
        if channel.schema_name != schema.name or channel.message_encoding != "protobuf":
            raise McaptrackError(f"{self.path}: {topic} holds {channel.schema_name or 'no schema'}, not {schema.name}")
        try:
            found = self._messages.columns(self._ids(topic), schema)
            if found is not None:
                return found
            messages = list(self.messages(topic))
            rows, counts = schema.codec.decode_all([message.payload for message in messages])
        except (Damaged, ValueError) as error:
            raise DamagedError(f"{self.path}: {topic} is damaged: {error}; {_recover(self.path)}") from None
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
        if (part := self.part(topic)) is not self:
            return part.times(topic)
        channels = self._ids(topic)
        with self.mending():
            return self._messages.times(channels)

    def places(self, topic: str) -> Places:
        """Where the messages of a channel stand in the file of its part, by time, without reading them."""
        if (part := self.part(topic)) is not self:
            return part.places(topic)
        channels = self._ids(topic)
        with self.mending():
            return self._messages.places(channels)

    def message_at(self, chunk_offset: int | None, offset: int) -> tuple[str, Message]:
        """The message at a place in this file, results aside, and its topic; one chunk is opened.

        Raises McaptrackError if none stands there.
        """
        with self.mending():
            channel, message = self._messages.at(chunk_offset, offset)
            if channel not in self.index.channels:
                raise Damaged(f"a message of channel {channel}, which is not described anywhere")
            return self.index.channels[channel].topic, message

    def fingerprint(self, topic: str | None = None) -> str:
        """SHA-256 of what the file says a channel, or all of it, is: another one when anything of it has changed.

        Made of records and checksums, so that no message is read but where checksums are missing.
        """
        if topic is not None and (part := self.part(topic)) is not self:
            return part.fingerprint(topic)
        with self.mending():
            if topic is not None:
                self.channel(topic)
                those = [fingerprint(self._buffer, self.index, one.id) for one in self._by_topic[topic]]
                return those[0] if len(those) == 1 else hashlib.sha256("".join(those).encode()).hexdigest()
            whole = [fingerprint(part.buffer, part.index) for part in self.parts]
            return whole[0] if len(whole) == 1 else hashlib.sha256("".join(whole).encode()).hexdigest()

    @contextmanager
    def mending(self) -> Iterator[None]:
        """What is found damaged in the block is said of this log, with what can be done; for this package alone."""
        try:
            yield
        except Damaged as error:
            raise DamagedError(f"{self.path} is damaged: {error}; {_recover(self.path)}") from None


def _recover(path: Path) -> str:
    return f"`mcaptrack recover {path}` saves what is whole"


def read(path: Path, *, sidecar: bool | None = None) -> Log:
    """Open a log, with its results if they stand beside it; with ``sidecar`` they do from now on, without it never.

    Raises McaptrackError, in one line, if it is none or is damaged.
    """
    beside = results_of(path)
    if path.name.endswith(RESULTS) or sidecar is False or not (sidecar or beside.exists()):
        return Log(path)
    if not path.exists():
        return Log(path)  # which says so
    is_new = not beside.exists()
    if is_new:
        with create(beside):
            pass
    results = Log(beside)
    results.is_new = is_new
    return Log(path, results)


def topics_with_schema(log: Log, names: Sequence[str]) -> list[Channel]:
    """The channels that hold one of these schemas, in order of topic."""
    return [channel for _, channel in sorted(log.channels.items()) if channel.schema_name in names]
