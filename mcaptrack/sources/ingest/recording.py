"""Open recordings: MCAP files here, others by recording formats; what parts of split recordings have in common."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import closing
from operator import index
from pathlib import Path
from typing import Any, Final, SupportsIndex

from mcap.well_known import MessageEncoding, Profile

from mcaptrack import log
from mcaptrack.contracts import ReadingNotes, RecordedChannel, RecordedMessage, RecordingReader
from mcaptrack.errors import McaptrackError, list_names
from mcaptrack.files import visible
from mcaptrack.log.recording_files import format_of, is_mcap, is_video, logs_in, refuse_missing
from mcaptrack.notices import warn
from mcaptrack.registry import Entry, blamed, of_type
from mcaptrack.registry.guard import Guard
from mcaptrack.schema.provenance import CLOCK
from mcaptrack.sources.foreign.definitions import Defined, MessageType, defined, is_defined, is_packed, unpacked
from mcaptrack.sources.ingest import decompression
from mcaptrack.sources.sidecar import holds_packed
from mcaptrack.sources.video import IMAGE_SUFFIXES

_SUFFIX: Final = ".mcap"
#: So many files of a folder are looked at, to say whether it holds recordings.
_MOST_LOOKED_AT: Final = 16


def open_recording(path: Path) -> RecordingReader | None:
    """Open the recording at ``path``; None if it is something else.

    Raises McaptrackError for a recording that can't be read, and if the extension that reads it is missing.
    """
    recognised = format_of(path)
    if recognised:
        return opened_by(recognised.entry, recognised.form, path)
    if path.is_dir():
        entries = sorted(visible(path.iterdir()))
        if any(entry.suffix.lower() in IMAGE_SUFFIXES for entry in entries):
            return None
        logs = logs_in(path)
        if len(logs) == 1:
            return open_recording(logs[0])
        files = (entry for entry in entries[:_MOST_LOOKED_AT] if entry.is_file())
        first = logs[0] if logs else next((file for file in files if format_of(file)), None)
        if first:
            raise McaptrackError(
                f"{path} holds several recordings, which are no parts of one; give {first.name} and so on by name"
            )
    elif is_mcap(path):
        return McapRecording([path], path)
    elif path.suffix.lower() == _SUFFIX and not is_video(path):
        raise unlike(path, "an MCAP file")
    refuse_missing(path)
    return None


def unlike(path: Path, what: str) -> McaptrackError:
    """The error for a file that isn't what its name says it is."""
    why = "does not begin as one does" if path.stat().st_size else "is empty"
    return McaptrackError(f"{path} can't be read as {what}: it {why}")


def opened_by(entry: Entry, form: Any, path: Path) -> RecordingReader:
    """The recording that a format opens; that of another package is checked while it is read."""
    with blamed(entry, f"can't read {path}"):
        recording = form.open(path)
    of_type(entry, recording, RecordingReader, "open")
    return recording if entry.is_built_in else RecordingOfPackage(entry, recording, path)


def compare_counts(
    recording: RecordingReader, path: Path, counts: Mapping[RecordedChannel, int], lost: list[str]
) -> None:
    """Compare the numbers of messages that were read with those that a recording states; fewer are a line of ``lost``.

    Raises McaptrackError if they differ though nothing was lost.
    """
    for channel, declared in (recording.declared_counts or {}).items():
        count = counts.get(channel, 0)
        if count < declared and lost:
            lost.append(f"{channel.topic}: {declared - count} of {declared} messages")
        elif count != declared:
            raise McaptrackError(
                f"{path} does not add up: its index counts {declared} messages of {channel.topic}, "
                f"and {count} are there"
            )


class RecordingOfPackage(RecordingReader):
    """A recording as another package reads it: what it raises names the format, and what it gives is checked."""

    def __init__(self, entry: Entry, recording: RecordingReader, path: Path) -> None:
        super().__init__()
        self._entry, self._recording, self._path, self._guard = entry, recording, path, Guard(str(entry))
        with self._blamed("gave what is no RecordingReader"):
            self.channels, self.findings = list(recording.channels), _notes_of(recording.findings)
            self.profile, counts = str(recording.profile), recording.declared_counts
            self.declared_counts = None if counts is None else {each: index(count) for each, count in counts.items()}
        for channel in (*self.channels, *(self.declared_counts or ())):
            if not _is_channel(channel) or channel not in self.channels:
                raise McaptrackError(f"{entry} gave what is no RecordedChannel of its own: {channel!r:.60}")

    def close(self) -> None:
        """Close its files. What fails then is a warning: all has been read, or another error says why not."""
        try:
            with self._blamed(f"can't close {self._path}"):
                self._recording.close()
        except McaptrackError as error:
            warn(str(error), "other")

    def _blamed(self, what: str) -> Any:
        return blamed(self._entry, what, self._guard)

    def messages(self, report: ReadingNotes) -> Iterator[RecordedMessage]:
        """All messages. Raises McaptrackError for what is none of a channel of the recording."""
        failed, notes = f"can't read {self._path}", ReadingNotes()
        with self._blamed(failed):
            messages = iter(self._recording.messages(notes))
        channels = set(self.channels)
        while True:
            with self._blamed(failed):
                message = next(messages, None)
            if message is None:
                break
            if not (isinstance(message, RecordedMessage) and message.channel in channels and _fits(message)):
                raise McaptrackError(f"{self._entry} gave what is no message of a channel of its own: {message!r:.60}")
            yield message
        with self._blamed("gave what are no ReadingNotes"):
            notes = _notes_of(notes)
        report.notes += notes.notes
        report.lost += notes.lost

    def extras(self, writer: Any, has_clock: bool, is_copied: bool) -> None:
        """Write attachments and metadata."""
        with self._blamed(f"can't write what {self._path} holds beside messages"):
            self._recording.extras(writer, has_clock, is_copied)


def _is_channel(channel: Any) -> bool:
    """Whether a channel holds what can be written into a log."""
    if not isinstance(channel, RecordedChannel):
        return False
    schema, metadata = channel.schema, channel.metadata
    is_schema = isinstance(schema, tuple) and [*map(type, schema)] == [str, str, bytes]
    is_text = isinstance(metadata, Mapping) and all(isinstance(part, str) for pair in metadata.items() for part in pair)
    return isinstance(channel.topic, str) and isinstance(channel.encoding, str) and is_schema and is_text


def _fits(message: RecordedMessage) -> bool:
    """Whether times, number and payload of a message can be written into a log."""
    numbers = [(message.t_ns, 2**63), (message.publish_ns or 0, 2**64), (message.sequence or 0, 2**32)]
    are_whole = all(isinstance(number, SupportsIndex) and 0 <= index(number) < end for number, end in numbers)
    return are_whole and isinstance(message.payload, bytes)


def _notes_of(notes: ReadingNotes) -> ReadingNotes:
    """A copy of remarks, as texts."""
    return ReadingNotes([*map(str, notes.notes)], [*map(str, notes.lost)])


class Parts(RecordingReader):
    """The files of a recording, read as one; ``whole`` names it in messages. They have the same channels.

    ``is_packed`` says that messages are compressed one by one, of whatever encoding they are.
    """

    profile = Profile.ROS2
    is_packed = False

    def __init__(self, paths: Sequence[Path], whole: Path) -> None:
        super().__init__()
        self.paths, self.whole = paths, whole
        self.declared_counts: dict[RecordedChannel, int] = {}
        self._known_channels: dict[tuple[object, ...], RecordedChannel] = {}
        #: Definitions of types that the recording doesn't define.
        self._found: dict[MessageType, Defined] = {}
        try:
            for number in range(len(paths)):
                self._open(number)
        except BaseException:
            self.close()
            raise
        self._compare()
        self.channels = list(self.declared_counts)
        for doubts in dict.fromkeys(found.doubts for found in self._found.values() if found.doubts):
            names = [kind.name for kind, found in self._found.items() if found.doubts == doubts]
            warn(f"{whole} does not say what {list_names(names)} is; {doubts}", "definitions")

    def messages(self, report: ReadingNotes) -> Iterator[RecordedMessage]:
        """All messages, file by file, in their order there."""
        for number, path in enumerate(self.paths):
            left = decompression.limit_of(path.stat().st_size)
            for message in self._messages(number):
                if (self.is_packed or message.channel.encoding == MessageEncoding.CDR) and is_packed(message.payload):
                    payload = _unpack_message(message.payload, path, message.t_ns, left)
                    left -= len(payload)
                    yield message._replace(payload=payload)
                else:
                    yield message

    def _open(self, number: int) -> None:
        raise NotImplementedError

    def _compare(self) -> None:
        """Compare the files with what is said of them elsewhere."""

    def _defined(self, kind: MessageType, distribution: str = "", digest: str = "") -> Defined:
        """A message type with the definition that fits if the recording doesn't define it."""
        if is_defined(kind):
            return Defined(kind, "", "")
        if kind not in self._found:
            with closing(self._payloads(kind)) as payloads:
                self._found[kind] = defined(kind, payloads, distribution, digest)
            if not self._found[kind].doubts:
                text = f"{self.whole} does not say what {kind.name} is; its definition is {self._found[kind].origin}"
                self.findings.notes.append(text)
        return self._found[kind]

    def _payloads(self, kind: MessageType) -> Generator[bytes]:
        """The messages of a type, in all files."""
        raise NotImplementedError

    def _messages(self, number: int) -> Iterator[RecordedMessage]:
        """The messages of a file as they are stored."""
        raise NotImplementedError

    def _channel(self, repeats: dict[object, int], described: RecordedChannel, messages: int) -> RecordedChannel:
        """The channel that a part of the recording describes.

        ``repeats`` counts, in one part, those that are described in the same words.
        """
        key = (described.topic, described.schema, described.encoding, *sorted(described.metadata.items()))
        repeats[key] = repeats.get(key, 0) + 1
        channel = self._known_channels.setdefault((*key, repeats[key]), described)
        self.declared_counts[channel] = self.declared_counts.get(channel, 0) + messages
        return channel


class McapRecording(Parts):
    """MCAP files."""

    def __init__(self, paths: Sequence[Path], whole: Path) -> None:
        self.logs: list[log.Log] = []
        self._channels: list[dict[int, RecordedChannel]] = []
        super().__init__(paths, whole)
        profiles = {log.header(opened)[0] for opened in self.logs}
        self.profile = profiles.pop() if len(profiles) == 1 else ""
        is_whole = len(self.logs) == 1 and not any(found.origin for found in self._found.values())
        self.as_log = self.logs[0] if is_whole and not holds_packed(self.logs[0]) else None

    def extras(self, writer: log.LogWriter, has_clock: bool, is_copied: bool) -> None:
        """Write all attachments and metadata records of the files."""
        for opened in [] if is_copied else self.logs:
            log.copy_attachments_and_metadata(opened, writer, without=[CLOCK] if has_clock else [])

    def _open(self, number: int) -> None:
        if not number:  # definitions are tried on the messages of all files
            self.logs += [self.closing.enter_context(log.read(path, sidecar=False)) for path in self.paths]
        path, opened = self.paths[number], self.logs[number]
        if log.results_path(path).exists():
            warn(f"{log.results_path(path)} holds results of {path.name}; they are left out", "left-out")
        channels: dict[int, RecordedChannel] = {}
        repeats: dict[object, int] = {}
        for channel in opened.index.channels.values():
            record = opened.index.schemas.get(channel.schema_id)
            fields = (record.name, record.encoding, record.data) if record else ("", "", b"")
            found = self._defined(MessageType(*fields, channel.message_encoding))
            metadata = channel.metadata | found.metadata
            described = RecordedChannel(channel.topic, found.kind[:3], channel.message_encoding, metadata)
            channels[channel.id] = self._channel(repeats, described, opened.index.counts.get(channel.id, 0))
        self._channels.append(channels)

    def _payloads(self, kind: MessageType) -> Generator[bytes]:
        for opened in self.logs:
            for topic, channel in opened.channels.items():
                if (opened.record_name(channel), channel.message_encoding) == (kind.name, kind.encoding):
                    yield from (message.payload for message in opened.messages(topic))

    def _messages(self, number: int) -> Iterator[RecordedMessage]:
        for channel, (t_ns, sequence, publish_ns, payload) in log.stream(self.logs[number]):
            yield RecordedMessage(self._channels[number][channel], t_ns, payload, publish_ns, sequence)


def _unpack_message(data: bytes, path: Path, t_ns: int, left: int) -> bytes:
    """Decompress a single message; ``left`` is the limit for all remaining messages together."""
    try:
        return unpacked(data, left)
    except decompression.NotUnpackedError as error:
        raise McaptrackError(f"{path}: the message at {t_ns} ns can't be decompressed: {error}") from None
