"""Open a recording: its kind is detected by its first bytes, not by the name of the file."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.files import read_beginning, refuse_special
from mcaptrack.sources.ingest.bags.metadata_yaml import METADATA, holds_metadata
from mcaptrack.sources.ingest.bags.recording import RecordingReader
from mcaptrack.sources.ingest.bags.rosbag1 import Bag1
from mcaptrack.sources.ingest.bags.rosbag2 import open_bag, open_files
from mcaptrack.sources.video import IMAGE_SUFFIXES

_MCAP, _ROS1, _SQLITE, _ZSTD = b"\x89MCAP0\r\n", b"#ROSBAG V", b"SQLite format 3\0", b"\x28\xb5\x2f\xfd"
_SUFFIXES: Final = {".mcap": "an MCAP file", ".bag": "a ROS bag", ".db3": "a rosbag2 database"}


def open_recording(path: Path) -> RecordingReader | None:
    """Open the recording at ``path``; None if it is something else.

    Raises McaptrackError for a recording that can't be read.
    """
    if path.is_dir():
        return _open_folder(path)
    head = read_beginning(path, 16)
    if head.startswith(_ROS1):
        return Bag1(path)
    if head.startswith((_ZSTD, _MCAP, _SQLITE)):
        return open_files([path], path)
    if path.suffix.lower() in _SUFFIXES:
        what = "is empty" if not head else "does not begin as one does"
        raise McaptrackError(f"{path} can't be read as {_SUFFIXES[path.suffix.lower()]}: it {what}")
    return None


def is_mcap(path: Path) -> bool:
    """Whether a file begins with the magic bytes of MCAP; False if it can't be read."""
    refuse_special(path)
    try:
        with path.open("rb") as stream:
            return stream.read(len(_MCAP)) == _MCAP
    except OSError:
        return False


def _open_folder(path: Path) -> RecordingReader | None:
    if holds_metadata(path / METADATA):
        return open_bag(path)
    names = sorted(entry.name for entry in path.iterdir())
    if any(Path(name).suffix.lower() in IMAGE_SUFFIXES for name in names):
        return None
    if parts := log.split_files_in(path):
        return open_files(parts, path) if len(parts) > 1 else open_recording(parts[0])
    logs = [name for name in names if Path(name).suffix.lower() in _SUFFIXES]
    if logs:
        raise McaptrackError(
            f"{path} has no {METADATA}, and its {len(logs)} logs are no parts of one; give {logs[0]} and so on by name"
        )
    return None
