"""Tell ROS bags from other files and folders, and open them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from mcaptrack.extensions.bags.files import METADATA, ROSBAG1, SQLITE, split_files_in
from mcaptrack.files import read_beginning, visible
from mcaptrack.log.recording_files import ZSTD

if TYPE_CHECKING:
    from mcaptrack.contracts import RecordingReader

_BEGIN: Final = {
    ROSBAG1: "a ROS 1 bag",
    SQLITE: "a database, as rosbag2 writes them",
    ZSTD: "a compressed file of rosbag2",
}
_NAMES: Final = {".bag": "a ROS bag", ".db3": "a rosbag2 database"}


class RosBags:
    """Bags of ROS 1, and folders and files of rosbag2, as a recording format."""

    def recognises(self, path: Path) -> str:
        """Say what a file or folder is; "" if it is no bag. A folder with a single MCAP file is that file."""
        if path.is_dir():
            return _folder(path)
        head = read_beginning(path, 16)
        by_bytes = next((description for begin, description in _BEGIN.items() if head.startswith(begin)), "")
        return by_bytes or (f"{_NAMES[path.suffix.lower()]} by its name" if path.suffix.lower() in _NAMES else "")

    def open(self, path: Path) -> RecordingReader:
        """Open a bag. Raises McaptrackError if it can't be read or is incomplete."""
        from mcaptrack.extensions.bags import metadata_yaml, rosbag1, rosbag2
        from mcaptrack.sources.ingest.recording import unlike

        if path.is_dir():
            if metadata_yaml.holds_metadata(path / METADATA):
                return rosbag2.open_bag(path)
            parts = split_files_in(path)
            return rosbag2.open_files(parts, path) if len(parts) > 1 else self.open(parts[0])
        head = read_beginning(path, 16)
        if head.startswith(ROSBAG1):
            return rosbag1.Bag1(path)
        if not head.startswith((SQLITE, ZSTD)):
            raise unlike(path, _NAMES[path.suffix.lower()])
        return rosbag2.open_files([path], path)

    def listing(self, path: Path) -> Path | None:
        """The metadata.yaml beside a log that names it."""
        metadata = path.with_name(METADATA)
        if not metadata.is_file():
            return None
        from mcaptrack.extensions.bags.metadata_yaml import names_file

        return metadata if names_file(metadata, path.name) else None

    def update(self, path: Path) -> None:
        """Bring the metadata.yaml that names a log up to date. A warning says if it can't be."""
        from mcaptrack.extensions.bags.metadata_yaml import update_metadata

        update_metadata(path)


def _folder(path: Path) -> str:
    from mcaptrack.extensions.bags.metadata_yaml import holds_metadata
    from mcaptrack.sources.video import IMAGE_SUFFIXES

    if holds_metadata(path / METADATA):
        return "a rosbag2 folder"
    if any(entry.suffix.lower() in IMAGE_SUFFIXES for entry in visible(path.iterdir())):
        return ""
    parts = split_files_in(path)
    is_log = len(parts) == 1 and parts[0].suffix == ".mcap"
    return "a folder with a recording" if parts and not is_log else ""
