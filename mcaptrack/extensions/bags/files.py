"""Names and first bytes of the files of bags."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from mcaptrack.files import visible
from mcaptrack.log.recording_files import RESULTS_SUFFIX

ROSBAG1, SQLITE = b"#ROSBAG V", b"SQLite format 3\0"
#: The file in the folder of a bag of ROS 2 that lists its files and topics.
METADATA: Final = "metadata.yaml"
_PARTS: Final = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd", ".bag")
_SPLIT: Final = re.compile(r"(.+?)_(\d{1,9})(\.(?:mcap|db3)(?:\.zstd)?)")


def split_files_in(folder: Path) -> list[Path]:
    """The files of the single recording in a folder without metadata.yaml, in order; empty if there is none or several.

    That is one file, or a recording that rosbag2 has split: drive_0.mcap, drive_1.mcap.
    """
    names = [entry.name for entry in visible(folder.iterdir()) if entry.name.endswith(_PARTS)]
    names = [name for name in names if not name.endswith(RESULTS_SUFFIX)]
    matches = [match for match in map(_SPLIT.fullmatch, names) if match]
    if len(matches) == len(names) and len({(match[1], match[3]) for match in matches}) == 1:
        return [folder / match[0] for match in sorted(matches, key=lambda match: int(match[2]))]
    return [folder / names[0]] if len(names) == 1 else []
