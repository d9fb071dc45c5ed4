"""Reading a log: channels, messages, frames."""

from __future__ import annotations

import hashlib
import heapq
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import DamagedError, McaptrackError
from mcaptrack.log import journal, records
from mcaptrack.log.fingerprint import fingerprint
from mcaptrack.log.index import read_index
from mcaptrack.log.messages import Columns, Late, Message, Messages, Places
from mcaptrack.log.opening import changed, open_log, recover_words
from mcaptrack.log.records import ChannelRecord, Damaged
from mcaptrack.log.source import Signature, Source
from mcaptrack.log.writer import RESULTS, create, results_of
from mcaptrack.schema import Frame, Schema

Ints = NDArray[np.int64]
T = TypeVar("T")


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
        journal.settle(self.real_path)
        opened = open_log(path)
        self._file, self._signature, self._is_certain = opened.file, opened.signature, opened.is_certain
        self.source, self.index = opened.source, opened.index
        self._messages = Messages(self.source, self.index)
        self._fresh: Messages | None = None  # the log as it was found when it had this signature
        self._fresh_at: Signature | None = None
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
                if not os.path.samestat(os.fstat(handle), os.fstat(self._file.handle)) or not self._is_as_opened():
                    raise McaptrackError(f"{self.path} was replaced while it was being read; try again")
            except BaseException:
                os.close(handle)
                raise
            self._lock = handle
        return self._lock

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
            whole = self.record(found[-1])
            return records.read_metadata(whole, records.record_at(whole, 0))[1]

    def attachment(self, name: str) -> bytes | None:
        """The data of the last attachment of that name."""
        if self.results is not None and (of_results := self.results.attachment(name)) is not None:
            return of_results
        found = [listed.offset for listed in self.index.attachments if listed.name == name]
        if not found:
            return None
        with self.mending():
            whole = self.record(found[-1])
            attachment = records.read_attachment(whole, records.record_at(whole, 0))
            return bytes(whole[attachment.start : attachment.end])

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
            self._confirm(channels)

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
        channels = self._ids(topic)
        with self._computing(topic):
            found = self._messages.columns(channels, schema)
            self._confirm(channels)
            if found is not None:
                return found
            messages = list(self.messages(topic))
            try:
                rows, counts = schema.codec.decode_all([message.payload for message in messages])
            except ValueError as error:
                raise Damaged(f"{topic}: {error}") from None
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
        with self._computing(topic):
            return self._still(lambda messages: messages.times(channels), np.array_equal)

    def places(self, topic: str) -> Places:
        """Where the messages of a channel stand in the file of its part, by time, without reading them."""
        if (part := self.part(topic)) is not self:
            return part.places(topic)
        channels = self._ids(topic)
        with self._computing(topic):
            return self._still(lambda messages: messages.places(channels), _are_equal)

    def message_at(self, chunk_offset: int | None, offset: int) -> tuple[str, Message]:
        """The message at a place in this file, results aside, and its topic; one chunk is opened.

        Raises McaptrackError if none stands there.
        """
        with self.mending():
            channel, message = self._messages.at(chunk_offset, offset)
            if channel not in self.index.channels:
                raise Damaged(f"a message of channel {channel}, which is not described anywhere")
            self._confirm([channel])
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
                those = [self._fingerprint(one.id) for one in self._by_topic[topic]]
                return those[0] if len(those) == 1 else hashlib.sha256("".join(those).encode()).hexdigest()
            whole = [part._fingerprint() for part in self.parts]
            return whole[0] if len(whole) == 1 else hashlib.sha256("".join(whole).encode()).hexdigest()

    def _fingerprint(self, channel_id: int | None = None) -> str:
        return self._still(lambda messages: fingerprint(messages.source, messages.index, channel_id), str.__eq__)

    def record(self, offset: int) -> memoryview:
        """The record that stands at an offset of the file; for this package alone."""

        def whole(messages: Messages) -> memoryview:
            found = records.record_at(messages.source, offset)
            return messages.source[found.start : found.end]

        return self._still(whole, memoryview.__eq__)

    @contextmanager
    def mending(self, topic: str = "") -> Iterator[None]:
        """What is found damaged in the block is said of this log, with what can be done; for this package alone."""
        try:
            yield
        except Damaged as error:
            if not self._is_as_opened():
                raise changed(self.path) from None
            where = f"{self.path}: {topic}" if topic else str(self.path)
            raise DamagedError(f"{where} is damaged: {error}; {recover_words(self.path)}") from None

    @contextmanager
    def _computing(self, topic: str) -> Iterator[None]:
        """The same for whoever takes times as signed numbers."""
        try:
            with self.mending(topic):
                yield
        except Late as late:
            raise McaptrackError(
                f"{self.path}: {topic} has {late.count} messages later than the year 2262, the first at {late.t_ns} "
                "ns; they are kept as they are, but nothing is computed with such times "
                f"(`mcaptrack drop {self.path} {topic}` leaves the channel out)"
            ) from None

    # While others write

    def confirm(self) -> None:
        """Raises McaptrackError if the file was changed since it was opened; for this package alone."""
        if Signature.of(self._file.handle) != self._signature:
            raise changed(self.path)

    def _is_as_opened(self) -> bool:
        """Whether the file still says what it said when it was opened."""
        try:
            now = self._now()
        except (Damaged, McaptrackError):
            return False
        return now is None or self.index.agrees_in_all(now.index)

    def _now(self) -> Messages | None:
        """The log as it is now; None if nobody changed it.

        Raises Damaged if it is no log any more, and McaptrackError if it is being changed.
        """
        now = Signature.of(self._file.handle)
        is_certain = now.is_certain
        if now == self._signature and self._is_certain:
            return None
        if now != self._fresh_at:
            source = Source.of(self._file)
            self._fresh, self._fresh_at = Messages(source, read_index(source)), None
            if self.index.agrees_in_all(self._fresh.index) and self._messages.are_in(self._fresh.source):
                self._signature, self._is_certain = now, is_certain
            elif is_certain:
                self._fresh_at = now
            if Signature.of(self._file.handle) != now:
                raise changed(self.path)
        return self._fresh

    def _confirm(self, channels: Sequence[int]) -> None:
        """Raises McaptrackError if what was read may be half of what was there, and half of what is there now."""
        try:
            fresh = self._now()
            if fresh is None:
                return
            if all(self.index.agrees(fresh.index, one) for one in channels) and self._messages.are_in(fresh.source):
                return
        except Damaged:
            pass
        raise changed(self.path)

    def _still(self, look: Callable[[Messages], T], are_equal: Callable[[T, T], bool]) -> T:
        """What is found in the log, and found once more if the file was changed meanwhile."""
        found, fresh = look(self._messages), self._now()
        if fresh is not None and not are_equal(found, look(fresh)):
            raise changed(self.path)
        return found


def _are_equal(one: Places, other: Places) -> bool:
    return all(map(np.array_equal, one, other))


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
