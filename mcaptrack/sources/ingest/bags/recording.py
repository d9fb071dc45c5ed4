"""What every recording gives, whatever its format: connections, messages, and how many messages it claims to have."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from mcaptrack import log


@dataclass(frozen=True, eq=False)
class Connection:
    """What becomes a channel. ``schema`` is the name, the encoding and the data of a schema record."""

    topic: str
    schema: tuple[str, str, bytes]
    encoding: str
    metadata: Mapping[str, str]


@dataclass
class Findings:
    """Words about a recording: worth saying, and what of it can't be read."""

    notes: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)


class Recording(Protocol):
    """A recording, open for reading."""

    @property
    def profile(self) -> str:
        """As in the MCAP registry: ros1, ros2."""

    @property
    def words(self) -> Findings:
        """What there is to say before any message is read."""

    @property
    def connections(self) -> list[Connection]:
        """All connections, also those without messages."""

    @property
    def claims(self) -> Mapping[Connection, int] | None:
        """How many messages each connection has, as the recording itself says; None if it doesn't."""

    @property
    def as_it_is(self) -> log.Log | None:
        """The recording as a log, if it is one already."""

    def messages(self, found: Findings) -> Iterator[tuple[Connection, log.Message]]:
        """All messages, as they stand in the recording; from the start whenever it is called."""

    def extras(self, writer: log.LogWriter, has_clock: bool, passed_on: bool = False) -> None:
        """Write what the recording holds beside messages, and beside ``as_it_is`` if that is passed on."""

    def close(self) -> None:
        """Let go of its files."""
