"""The interface of recordings in all formats: connections, messages, and the declared number of messages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

from mcap.well_known import Profile

from mcaptrack import log
from mcaptrack.sources.foreign.definitions import MessageType


@dataclass(frozen=True, eq=False)
class Connection:
    """A topic of a recording, which becomes a channel. ``schema`` is name, encoding and data of the schema record."""

    topic: str
    schema: tuple[str, str, bytes]
    encoding: str
    metadata: Mapping[str, str]

    @property
    def kind(self) -> MessageType:
        """The type of its messages."""
        return MessageType(*self.schema, self.encoding)


@dataclass
class ReadingNotes:
    """Remarks about a recording (``notes``), and the parts that can't be read (``lost``)."""

    notes: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)


class RecordingReader:
    """A recording, open for reading.

    ``profile`` is that of the MCAP registry. ``findings`` are those before any message is read. ``declared_counts`` is
    the number of messages of each connection, None if the recording doesn't declare it. ``as_log`` is the recording as
    a log if it is a single MCAP file. ``closing`` closes its files.
    """

    profile = Profile.ROS2
    as_log: log.Log | None = None
    declared_counts: Mapping[Connection, int] | None = None
    #: All connections, including those without messages.
    connections: Sequence[Connection]

    def __init__(self) -> None:
        self.findings = ReadingNotes()
        self.closing = ExitStack()

    def close(self) -> None:
        """Close its files."""
        self.closing.close()

    def messages(self, report: ReadingNotes) -> Iterator[tuple[Connection, log.Message]]:
        """All messages in the order of the recording; every call starts from the beginning."""
        raise NotImplementedError

    def extras(self, writer: log.LogWriter, has_clock: bool, is_copied: bool) -> None:
        """Write attachments and metadata; if ``is_copied``, only those that ``as_log`` does not contain."""
