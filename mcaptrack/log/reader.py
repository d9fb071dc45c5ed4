"""Reading a log: channels, messages, frames."""

from __future__ import annotations

import hashlib
import heapq
import os
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Concatenate, Final, NamedTuple, ParamSpec, Self, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from mcap.records import Channel as ChannelRecord
from mcap.records import Message as MessageRecord
from mcap.records import Schema as SchemaRecord
from mcap.well_known import SchemaEncoding
from numpy.typing import NDArray

from mcaptrack import notices
from mcaptrack.errors import DamagedError, McaptrackError, call, list_names, offer
from mcaptrack.files import place_of
from mcaptrack.geometry.arrays import Ints
from mcaptrack.location import Location, Url, is_remote
from mcaptrack.log import in_place, records
from mcaptrack.log.byte_source import ByteSource, OpenFile, ReadFile, Signature, open_file
from mcaptrack.log.chunks import MAX_NS
from mcaptrack.log.index import Index, ends_with_magic, read_index, starts_with_magic
from mcaptrack.log.journal import changed, find_journal, recover_hint
from mcaptrack.log.messages import ChannelRows, Message, MessageLocations, Messages, Payloads, Span, TimeOutOfRange
from mcaptrack.log.recording_files import RESULTS_SUFFIX
from mcaptrack.log.records import Damaged
from mcaptrack.log.remote import RemoteFile
from mcaptrack.objects import Version
from mcaptrack.schema import Frame, Schema
from mcaptrack.schema.classes import with_only_class
from mcaptrack.schema.encodings import ROW_ENCODINGS, RowReader, reader_of, schema_name_of
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns
from mcaptrack.schema.framing import split_rows
from mcaptrack.schema.own import schema_of_channel

T = TypeVar("T")
P = ParamSpec("P")


class Channel(NamedTuple):
    """A channel of a log, or all channels of a topic: ``messages`` is their total, the rest describes the first one.

    ``schema_name`` of rows is that of their schema, mcaptrack.Tracks, also where they are ROS messages.

    ``id`` is its number in the file, ``message_encoding`` the encoding of payloads, as in "protobuf" or "cdr", and
    ``metadata`` its texts by key.
    """

    id: int
    topic: str
    schema_name: str
    message_encoding: str
    metadata: dict[str, str]
    messages: int

    def holds(self, schema: Schema) -> bool:
        """Whether it has rows of a schema, in any encoding of rows."""
        return self.schema_name == schema.name and self.message_encoding in ROW_ENCODINGS

    @property
    def schema(self) -> Schema | None:
        """The schema of its rows, mcaptrack's or a user's own; None if it holds no rows."""
        return schema_of_channel(self.schema_name, self.metadata) if self.message_encoding in ROW_ENCODINGS else None


# A log as it was when it was opened, even if its file changes afterwards.


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
        self.path: Location = path
        self.file: ReadFile = file
        self.source: ByteSource = source
        self.index: Index = index
        self.messages: Messages = Messages(source, index)
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

    def is_at(self, path: Path) -> bool:
        """Whether a path leads to the file that was opened, and that was certainly not changed."""
        assert isinstance(self.file, OpenFile)
        try:
            is_same = os.path.samestat(path.stat(), os.fstat(self.file.handle))
        except OSError:
            return False
        return is_same and self._is_certain and self.file.signature() == self._signature

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
        whole = ByteSource.of(file)  # with the magic bytes at one end, `recover` may find something in it
        hint = f"; {recover_hint(path)}" if starts_with_magic(whole) or ends_with_magic(whole) else ""
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


def _is_unchanged(path: Location, file: ReadFile, signature: Signature) -> bool:
    """Whether the path still leads to this file, and the file has not changed."""
    if isinstance(path, Url) or not isinstance(file, OpenFile):
        return True
    try:
        return os.path.samestat(path.stat(), os.fstat(file.handle)) and file.signature() == signature
    except OSError:
        return False


def find_topic(name: str, topics: Collection[str], where: Location, prefix: str = "") -> str:
    """The topic that a name means: itself, that below the camera ``prefix``, or the only one that ends with it.

    "tracks" is /camera/tracks. A name that is none of the topics is that below the camera, or comes back as it is.
    Raises McaptrackError, with the topics, if there are several.

    ``where`` names the log in the error.
    """
    below = f"{prefix}/{name}"
    if name in topics or (prefix and below in topics):
        return name if name in topics else below
    fitting = sorted(topic for topic in topics if name.strip("/") and topic.endswith("/" + name.strip("/")))
    if len(fitting) > 1:
        raise McaptrackError(f"{where} has {len(fitting)} channels {name}: {list_names(fitting)}; name one whole")
    if fitting:
        return fitting[0]
    return below if prefix and "/" not in name else name


class Log:
    """An MCAP file, open for reading. A context manager.

    Channels are looked up by topic; several channels with the same topic and message layout are read as one, in time
    order. With ``results``, a sidecar log, the channels of both are there, and those of the sidecar take precedence;
    new channels are written to the sidecar.
    """

    def __init__(self, path: Location, folder: TemporaryDirectory[str] | None = None) -> None:
        self.path: Location = path
        self._made = folder  # holds the content of a new log in a store, until it is written there
        place = path if folder is None else Path(folder.name, path.name)
        self.real_path: Location = place_of(place)
        self._lock: int | None = None
        self.snapshot: Snapshot = open_snapshot(place)
        self.index: Index = self.snapshot.index
        self._messages = self.snapshot.messages
        self.results: Log | None = None
        self.is_new = False  # just created; removed again if nothing is written to it
        self.is_outdated = False  # the file has been extended; this log still shows its old content
        #: All channels of this file, also those that share a topic and those that the sidecar replaces.
        self.recorded: tuple[Channel, ...] = tuple(map(self._channel, self.index.channels.values()))
        self._by_topic: dict[str, list[Channel]] = {}
        for channel in self.recorded:
            self._by_topic.setdefault(channel.topic, []).append(channel)
        self.channels: dict[str, Channel] = {}
        for topic, those in self._by_topic.items():
            first = next((channel for channel in those if channel.messages), those[0])
            self.channels[topic] = first._replace(messages=sum(channel.messages for channel in those))

    def attach_results(self, results: Log, is_new: bool) -> None:
        """Add the channels of a sidecar, which takes new channels from now on; beside one that is there already."""
        results.is_new = is_new
        if self.results is None:
            self.results = results
        else:
            self.results.attach_results(results, is_new)
        self.channels |= results.channels

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
        self.snapshot.file.close()
        if self._made is not None:
            self._made.cleanup()
        if self.results is not None:
            self.results.__exit__()
            if self.results.is_new and isinstance(self.results.path, Path):
                with Log(self.results.path) as left:
                    is_empty = not left.channels
                if is_empty:
                    self.results.path.unlink()

    @property
    def version(self) -> Version | None:
        """The version of an object that a new one has to replace; None if there is none yet."""
        file = self.snapshot.file
        return file.version if isinstance(file, RemoteFile) else None

    def lock(self) -> int:
        """Lock this log for writing until it is closed; returns a file descriptor to write to.

        Objects need no lock: an object is replaced only if it is the one that was opened; then -1 is returned. Raises
        McaptrackError if another process holds the lock, or if the file is not writable.
        """
        if self.results is not None:
            return self.results.lock()
        if self.is_outdated:
            raise McaptrackError(f"{self.path} was changed since it was opened; open it again")
        if is_remote(self.path):
            return -1
        if self._lock is None:
            assert isinstance(self.real_path, Path)
            assert isinstance(self.snapshot.file, OpenFile)
            try:
                handle = os.open(self.real_path, os.O_RDWR)
            except OSError as error:
                beside = "" if self.path.name.endswith(RESULTS_SUFFIX) else ", or beside it with `sidecar=True`"
                raise McaptrackError(
                    f"{self.path} can't be written to: {error.strerror}; write to another file with `output=`{beside}"
                ) from None
            try:
                in_place.lock(self.real_path, handle)
                in_place.sweep_left(self.real_path)
                in_place.resolve_journal(self.real_path, handle, self.snapshot.file)
                if not self.snapshot.is_on_disk(os.fstat(handle)):
                    raise McaptrackError(f"{self.path} was replaced while it was being read; try again")
            except BaseException:
                os.close(handle)
                raise
            self._lock = handle
        return self._lock

    @property
    def parts(self) -> tuple[Log, ...]:
        """The log itself, and its sidecar if it has one."""
        return (self,) if self.results is None else (self, *self.results.parts)

    @property
    def size(self) -> int:
        """The size of this log in bytes, without its sidecar."""
        return len(self.snapshot.source)

    @property
    def is_on_disk(self) -> bool:
        """Whether other programs that open the file see the same content: no change of it is unfinished."""
        return not any(part.snapshot.is_through_journal for part in self.parts)

    def part(self, topic: str) -> Log:
        """The part (log or sidecar) that holds a topic."""
        return self.results.part(topic) if self.results is not None and topic in self.results.channels else self

    @property
    def start_ns(self) -> int:
        """The time of the first message in nanoseconds."""
        return min((part.index.start_ns for part in self.parts if part.index.counts), default=0)

    @property
    def end_ns(self) -> int:
        """The time of the last message in nanoseconds."""
        return max(part.index.end_ns for part in self.parts)

    def find(self, name: str, prefix: str = "", among: Collection[str] | None = None) -> str:
        """The topic that a name means; see ``find_topic``. ``among`` are those that may be meant, by default all."""
        return find_topic(name, self.channels if among is None else among, self.path, prefix)

    def channel(self, topic: str) -> Channel:
        """The channel of a topic. Raises McaptrackError, with the topics that exist, if there is none."""
        if topic not in self.channels:
            topics = [name for name in sorted(self.channels) if "/view/" not in name]
            more = call("info", self.path)
            raise McaptrackError(f"{self.path} has no channel {topic}; {offer(topic, topics)}. {more} shows more")
        return self.channels[topic]

    def holds(self, topic: str, schema: Schema) -> bool:
        """Whether there is a channel of a topic, and it has rows of a schema."""
        return topic in self.channels and self.channels[topic].holds(schema)

    def _channel(self, record: ChannelRecord) -> Channel:
        schema = self.index.schemas.get(record.schema_id)
        name = schema_name_of(schema.name, schema.encoding, record.message_encoding, record.metadata) if schema else ""
        count = self.index.counts.get(record.id, 0)
        return Channel(record.id, record.topic, name, record.message_encoding, record.metadata, count)

    def _ids(self, topic: str) -> list[int]:
        """The ids of a topic's channels that hold messages.

        Raises McaptrackError if there is no channel of that topic, or if their messages have different layouts.
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
            raise McaptrackError(f"{self.path}: messages of {topic} have different layouts: {kinds}")
        return [channel.id for channel in those]

    def _layout(self, channel: Channel) -> tuple[str, ...]:
        """A key of the layout of a channel's messages, without comments and white space of ROS definitions."""
        schema = self.index.schemas.get(self.index.channels[channel.id].schema_id)
        if schema is None:
            return (channel.message_encoding,)
        data = bytes(schema.data)
        if schema.encoding in (SchemaEncoding.ROS1, SchemaEncoding.ROS2):
            data = b"\n".join(b" ".join(line.partition(b"#")[0].split()) for line in data.splitlines())
            data = b"\n".join(filter(None, data.split(b"\n")))
        return (channel.message_encoding, schema.name, schema.encoding, hashlib.sha256(data).hexdigest())

    def record_name(self, channel: Channel) -> str:
        """The name in the schema record of a channel of this file: that of the ROS message for rows that are one."""
        schema = self.index.schemas.get(self.index.channels[channel.id].schema_id)
        return schema.name if schema else ""

    def metadata(self, name: str) -> dict[str, str] | None:
        """The last metadata record of that name."""
        return self._last(name, "metadata", lambda whole, at: records.read_metadata(whole, at).metadata)

    def attachment(self, name: str) -> bytes | None:
        """The data of the last attachment of that name."""

        def data(whole: memoryview, record: records.Record) -> bytes:
            attachment = records.read_attachment(whole, record)
            return bytes(whole[attachment.start : attachment.end])

        return self._last(name, "attachments", data)

    def _last(self, name: str, kind: str, read: Callable[[memoryview, records.Record], T]) -> T | None:
        """Read the last "metadata" or "attachments" record of that name: of the sidecar, or else of the log."""
        for part in reversed(self.parts):
            if offsets := [listed.offset for listed in getattr(part.index, kind) if listed.name == name]:
                with part.snapshot.reporting_damage():
                    whole = part.snapshot.record(offsets[-1])
                    return read(whole, records.record_at(whole, 0))
        return None

    def messages(self, topic: str, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Message]:
        """The messages of a channel in time order, from ``start_ns`` (inclusive) to ``end_ns`` (exclusive), if given.

        Chunks outside of this interval are not read. Raises McaptrackError where the file is damaged.
        """
        part = self.part(topic)
        channels = part._ids(topic)
        with part.snapshot.reporting_damage():
            yield from part._messages.by_time(channels, (start_ns, end_ns))
            part.snapshot.confirm_unchanged(channels)

    def payloads(self, topic: str, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Payloads]:
        """The bytes of the messages that ``messages`` gives, in batches, without an object for each.

        Raises McaptrackError where the file is damaged, and for times that don't fit into int64.
        """
        for _, payloads in self.payloads_of([topic], start_ns, end_ns):
            yield payloads

    def payloads_of(
        self,
        topics: Sequence[str],
        start_ns: int | None = None,
        end_ns: int | None = None,
        lose: Callable[[str, int, str], None] | None = None,
    ) -> Iterator[tuple[str, Payloads]]:
        """The same of several channels, with their topics, in one pass over the chunks.

        ``lose`` is called with topic, number and reason for messages in damaged chunks, which ``Payloads`` then mark.
        """
        for part in self.parts:
            here = [topic for topic in topics if self.part(topic) is part]
            channels = [part._ids(topic) for topic in here]

            def lose_some(number: int, count: int, damage: Damaged, here: Sequence[str] = here) -> None:
                assert lose is not None
                lose(here[number], count, str(damage))

            if here:
                with part.snapshot.reporting_bad_times(here[0] if len(here) == 1 else ""):
                    batches = part._messages.payloads(channels, (start_ns, end_ns), lose_some if lose else None)
                    yield from ((here[number], payloads) for number, payloads in batches)
                    part.snapshot.confirm_unchanged([channel for ids in channels for channel in ids])

    def records(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None, *, reverse: bool = False
    ) -> Iterator[tuple[SchemaRecord | None, ChannelRecord, MessageRecord]]:
        """The messages of several topics in time order, as records with those of their channels and schemas.

        Messages of equal time are in file order, those of the sidecar last; ``reverse`` gives the reverse of all. Each
        channel and schema has an id of its own: those of the sidecar count on from those of the log. Raises
        McaptrackError where the file is damaged.
        """
        streams, first_ids = [], (0, 0)
        for part in self.parts:
            ids = [
                channel.id for channel in part.recorded if channel.topic in topics and self.part(channel.topic) is part
            ]
            streams.append(part._records(ids, (start_ns, end_ns), first_ids, reverse=reverse))
            first_ids = (max(part.index.channels, default=0), max(part.index.schemas, default=0))
        if len(streams) == 1:
            return streams[0]
        if reverse:
            streams.reverse()
        return heapq.merge(*streams, key=lambda record: record[2].log_time, reverse=reverse)

    def _records(
        self, channels: Sequence[int], span: Span, first_ids: tuple[int, int], *, reverse: bool
    ) -> Iterator[tuple[SchemaRecord | None, ChannelRecord, MessageRecord]]:
        """The records of channels of this file; ``first_ids`` are added to the ids of channels and of schemas."""
        first_channel, first_schema = first_ids
        described = {}
        for number in channels:
            channel = self.index.channels[number]
            schema = self.index.schemas.get(channel.schema_id)
            schema_id = first_schema + channel.schema_id if channel.schema_id else 0
            metadata = dict(channel.metadata)
            described[first_channel + number] = (
                replace(schema, id=schema_id) if schema else None,
                replace(channel, id=first_channel + number, schema_id=schema_id, metadata=metadata),
            )
        with self.snapshot.reporting_damage():
            for message in self._messages.records(channels, span, reverse=reverse, first_id=first_channel):
                yield *described[message.channel_id], message
            self.snapshot.confirm_unchanged(channels)

    def timed(self, topic: str) -> Iterator[Message]:
        """The messages of a channel in time order, with times that fit into int64.

        Raises McaptrackError at the first message with a later time, and as ``messages`` does.
        """
        for message in self.messages(topic):
            if message.t_ns > MAX_NS:
                self.times(topic)  # raises the error
            yield message

    def rows(self, topic: str, schema: Schema) -> ChannelRows:
        """All rows of a channel as one array. Raises McaptrackError if the channel has another schema.

        Where all rows are of one class, which its metadata name, they get that class.
        """
        part = self.part(topic)
        channel = part._row_channel(topic, schema)
        columns = part._rows(topic, schema)
        return columns._replace(rows=with_only_class(schema, columns.rows, channel.metadata))

    def _row_channel(self, topic: str, schema: Schema) -> Channel:
        """The channel of a topic. Raises McaptrackError if it has another schema."""
        channel = self.channel(topic)
        if not channel.holds(schema):
            raise McaptrackError(f"{self.path}: {topic} holds {channel.schema_name or 'no schema'}, not {schema.name}")
        return channel

    def _rows(self, topic: str, schema: Schema) -> ChannelRows:
        """All rows of a channel of this file as they stand in its messages."""
        channels = self._ids(topic)
        reader = self._reader(topic, schema)
        with self.snapshot.reporting_bad_times(topic):
            columns = self._messages.columns(channels, schema, reader)
            self.snapshot.confirm_unchanged(channels)
            if columns is not None:
                return columns
            messages = list(self.messages(topic))
            try:
                rows, counts = reader.decode_all([message.payload for message in messages])
            except ValueError as error:
                raise Damaged(f"{topic}: {error}") from None
        t_ns = np.array([message.t_ns for message in messages], np.int64)
        return ChannelRows(rows, t_ns, np.array([message.sequence for message in messages], np.int64), counts)

    def _reader(self, topic: str, schema: Schema) -> RowReader:
        """The decoder of a channel with rows. Raises McaptrackError if its definition is not one of such rows."""
        channel = self.channel(topic)
        record = self.index.schemas.get(self.index.channels[channel.id].schema_id)
        try:
            return reader_of(schema, channel.message_encoding, bytes(record.data) if record else b"")
        except ValueError as error:
            raise McaptrackError(f"{self.path}: {topic} can't be read as {schema.name}: {error}") from None

    def frames(self, topic: str, schema: Schema) -> list[Frame]:
        """All rows of a channel, one frame for each message."""
        columns = self.rows(topic, schema)
        return split_rows(columns.t_ns.tolist(), columns.sequence.tolist(), columns.rows, np.cumsum(columns.counts))

    def frame_columns(self, topic: str, schema: Schema) -> FrameColumns:
        """All rows of a channel as ``frames`` gives them, in blocks, most of which are not in memory."""
        part = self.part(topic)
        metadata = part._row_channel(topic, schema).metadata
        channels, reader, out = part._ids(topic), part._reader(topic, schema), FrameCollector(schema)
        with part.snapshot.reporting_bad_times(topic):
            for columns in part._messages.parts(channels, schema, reader):
                if columns is None:
                    whole = part.rows(topic, schema)
                    out = FrameCollector(schema)
                    out.extend(whole.t_ns, whole.sequence, np.append(0, np.cumsum(whole.counts)), whole.rows)
                    break
                rows = with_only_class(schema, columns.rows, metadata)
                out.extend(columns.t_ns, columns.sequence, np.append(0, np.cumsum(columns.counts)), rows)
            part.snapshot.confirm_unchanged(channels)
        return out.done()

    def times(self, topic: str) -> Ints:
        """The sorted times of a channel's messages, (M,) ns, without reading the messages."""
        part = self.part(topic)
        channels = part._ids(topic)
        with part.snapshot.reporting_bad_times(topic):
            return part.snapshot.consistent(lambda messages: messages.times(channels), np.array_equal)

    def places(self, topic: str) -> MessageLocations:
        """The locations of a channel's messages in time order, without reading the messages."""
        part = self.part(topic)
        channels = part._ids(topic)
        with part.snapshot.reporting_bad_times(topic):
            return part.snapshot.consistent(lambda messages: messages.places(channels), _are_equal)

    def chunk_offsets(self, topic: str) -> NDArray[np.uint64]:
        """Where the chunks with messages of a channel begin in the file (C,), and messages of it outside of chunks."""
        part = self.part(topic)
        channels, chunks, every = part._ids(topic), part.index.chunks, part.index.loose
        loose = [every[number][:, 1].astype(np.uint64) for number in channels if number in every]
        return np.concatenate([chunks.offsets[chunks.rows_with(channels)], *loose])

    def message_at(self, chunk_offset: int | None, offset: int) -> tuple[str, Message]:
        """The message at a location in this file (not in its sidecar), and its topic; one chunk is opened.

        Raises McaptrackError if there is none.
        """
        with self.snapshot.reporting_damage():
            channel, message = self._messages.at(chunk_offset, offset)
            if channel not in self.index.channels:
                raise Damaged(f"there is a message of channel {channel}, which has no channel record")
            self.snapshot.confirm_unchanged([channel])
            return self.index.channels[channel].topic, message

    def fingerprint(self, topic: str | None = None) -> str:
        """A SHA-256 that identifies the content of a channel, or of the whole log: it changes with any change of that.

        It is made of index records and stored checksums; messages are read only where checksums are missing.
        """
        if topic is not None and (part := self.part(topic)) is not self:
            return part.fingerprint(topic)
        with self.snapshot.reporting_damage():
            if topic is not None:
                self.channel(topic)
                those = [self._fingerprint(recorded.id) for recorded in self._by_topic[topic]]
                return those[0] if len(those) == 1 else hashlib.sha256("".join(those).encode()).hexdigest()
            whole = [part._fingerprint() for part in self.parts]
            return whole[0] if len(whole) == 1 else hashlib.sha256("".join(whole).encode()).hexdigest()

    def _fingerprint(self, channel_id: int | None = None) -> str:
        return self.snapshot.consistent(lambda messages: messages.fingerprint(channel_id), str.__eq__)


def _are_equal(locations: MessageLocations, other: MessageLocations) -> bool:
    return all(map(np.array_equal, locations, other))


def kept(compute: Callable[Concatenate[Log, P], T]) -> Callable[Concatenate[Log, P], T]:
    """Let a function of an open log compute what it returns once for the same arguments, as long as the log is used."""
    results: WeakKeyDictionary[Log, dict[tuple[object, ...], T]] = WeakKeyDictionary()

    @wraps(compute)
    def look_up(opened: Log, /, *args: P.args, **named: P.kwargs) -> T:
        of_log, key = results.setdefault(opened, {}), (args, *named.items())
        if key not in of_log:
            of_log[key] = compute(opened, *args, **named)
        return of_log[key]

    return look_up
