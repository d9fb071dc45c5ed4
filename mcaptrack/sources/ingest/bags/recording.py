"""The interface of recordings in all formats: connections, messages, and the declared number of messages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from mcaptrack import log


@dataclass(frozen=True, eq=False)
class Connection:
    """A topic of a recording, which becomes a channel. ``schema`` is name, encoding and data of the schema record."""

    topic: str
    schema: tuple[str, str, bytes]
    encoding: str
    metadata: Mapping[str, str]


@dataclass
class ReadingNotes:
    """Remarks about a recording (``notes``), and the parts that can't be read (``lost``)."""

    notes: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)


class RecordingReader(Protocol):
    """A recording, open for reading."""

    @property
    def profile(self) -> str:
        """The profile in the MCAP registry: ros1, ros2."""

    @property
    def findings(self) -> ReadingNotes:
        """Findings before any message is read."""

    @property
    def connections(self) -> list[Connection]:
        """All connections, including those without messages."""

    @property
    def declared_counts(self) -> Mapping[Connection, int] | None:
        """The declared number of messages of each connection; None if the recording doesn't declare it."""

    @property
    def as_log(self) -> log.Log | None:
        """The recording as a log, if it is a single MCAP file; else None."""

    def messages(self, report: ReadingNotes) -> Iterator[tuple[Connection, log.Message]]:
        """All messages in the order of the recording; every call starts from the beginning."""

    def extras(self, writer: log.LogWriter, has_clock: bool, is_copied: bool = False) -> None:
        """Write attachments and metadata; if ``is_copied``, only those that ``as_log`` does not contain."""

    def close(self) -> None:
        """Close its files."""
