"""Recordings that are told by what is in them: ROS 1 bags, rosbag2 folders and databases, MCAP files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Protocol

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.files import refuse_special
from mcaptrack.sources.video import IMAGE_SUFFIXES

_MCAP, _ROS1, _SQLITE, _ZSTD = b"\x89MCAP0\r\n", b"#ROSBAG V", b"SQLite format 3\0", b"\x28\xb5\x2f\xfd"
_SUFFIXES: Final = {".mcap": "an MCAP file", ".bag": "a ROS bag", ".db3": "a rosbag2 database"}


@dataclass(frozen=True, eq=False)
class Connection:
    """What becomes a channel. ``schema`` is the name, the encoding and the data of a schema record."""

    topic: str
    schema: tuple[str, str, bytes]
    encoding: str
    metadata: Mapping[str, str]


@dataclass
class Found:
    """Words about a recording: worth saying, and what of it can't be read."""

    notes: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)


class Source(Protocol):
    """A recording, open for reading."""

    @property
    def profile(self) -> str:
        """As in the MCAP registry: ros1, ros2."""

    @property
    def words(self) -> Found:
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

    def messages(self, found: Found) -> Iterator[tuple[Connection, log.Message]]:
        """All messages, as they stand in the recording; from the start whenever it is called."""

    def extras(self, writer: log.LogWriter, has_clock: bool, passed_on: bool = False) -> None:
        """Write what the recording holds beside messages, and beside ``as_it_is`` if that is passed on."""

    def close(self) -> None:
        """Let go of its files."""


def open_source(path: Path) -> Source | None:
    """The recording at ``path``; None if it is something else.

    Raises McaptrackError for a recording that can't be read.
    """
    if path.is_dir():
        return _open_folder(path)
    refuse_special(path)
    try:
        with path.open("rb") as stream:
            head = stream.read(16)
    except OSError as error:
        raise McaptrackError(f"{path} can't be read: {error.strerror}") from None
    if head.startswith(_ROS1):
        from mcaptrack.sources.ingest.rosbag1 import Bag1

        return Bag1(path)
    if head.startswith((_ZSTD, _MCAP, _SQLITE)):
        from mcaptrack.sources.ingest.rosbag2 import open_files

        return open_files([path], path)
    if path.suffix.lower() in _SUFFIXES:
        what = "is empty" if not head else "does not begin as one does"
        raise McaptrackError(f"{path} can't be read as {_SUFFIXES[path.suffix.lower()]}: it {what}")
    return None


def is_mcap(path: Path) -> bool:
    """Whether a file begins as an MCAP file does; False for what can't be read."""
    refuse_special(path)
    try:
        with path.open("rb") as stream:
            return stream.read(len(_MCAP)) == _MCAP
    except OSError:
        return False


def _open_folder(path: Path) -> Source | None:
    from mcaptrack.sources.ingest.bag_metadata import METADATA, holds_metadata
    from mcaptrack.sources.ingest.rosbag2 import open_bag, open_files

    if holds_metadata(path / METADATA):
        return open_bag(path)
    names = sorted(entry.name for entry in path.iterdir())
    if any(Path(name).suffix.lower() in IMAGE_SUFFIXES for name in names):
        return None
    if parts := log.parts_in(path):
        return open_files(parts, path) if len(parts) > 1 else open_source(parts[0])
    logs = [name for name in names if Path(name).suffix.lower() in _SUFFIXES]
    if logs:
        raise McaptrackError(
            f"{path} has no {METADATA}, and its {len(logs)} logs are no parts of one; give {logs[0]} and so on by name"
        )
    return None
