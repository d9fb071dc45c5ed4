"""Detect recordings in other formats than MCAP by their first bytes; `mcaptrack ingest` converts them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from mcaptrack.errors import McaptrackError, call
from mcaptrack.files import visible
from mcaptrack.location import P, sibling

_BEGIN: Final = {b"#ROSBAG V": "a ROS 1 bag", b"SQLite format 3\0": "a database, as rosbag2 writes them"}
_MATROSKA: Final = b"\x1a\x45\xdf\xa3"  # and WebM
#: The first bytes of what zstd has compressed.
ZSTD: Final = b"\x28\xb5\x2f\xfd"
_PARTS: Final = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd", ".bag")
_SPLIT: Final = re.compile(r"(.+?)_(\d{1,9})(\.(?:mcap|db3)(?:\.zstd)?)")


def refuse_non_mcap(path: Path) -> None:
    """Raise McaptrackError for a recording in another format, with the command that converts it to a log.

    Other files pass: opening them reports what is wrong.
    """
    try:
        what = _folder(path) if path.is_dir() else _file(path) if path.is_file() else ""
    except OSError:
        return
    if what:
        # the default output would have the same name
        other_name = {"output": "OTHER.mcap"} if path.suffix == ".mcap" else {}
        make = call("ingest", path, **other_name)
        raise McaptrackError(f"{path} is {what}, not an MCAP file; {make} makes a log of it")


def _folder(path: Path) -> str:
    if (path / "metadata.yaml").is_file():
        return "a rosbag2 folder"
    parts = split_files_in(path)
    is_log = len(parts) == 1 and parts[0].suffix == ".mcap"  # which can be given itself
    return "a folder with a recording" if parts and not is_log else ""


# Names of files that belong to a log.


#: Suffix of a sidecar: a log that holds the results of another.
RESULTS_SUFFIX: Final = ".results.mcap"


def results_path(path: P) -> P:
    """The location of the sidecar of a log, which holds its results if they are not in the log itself."""
    return sibling(path, RESULTS_SUFFIX, of=path.name.removesuffix(".mcap"))


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


def _file(path: Path) -> str:
    with path.open("rb") as stream:
        head = stream.read(16)
    if head.startswith(ZSTD) and path.name.endswith(_PARTS):
        return "a compressed file of rosbag2"
    if head[4:8] == b"ftyp" or head.startswith(_MATROSKA) or (head[:4], head[8:12]) == (b"RIFF", b"AVI "):
        return "a video"
    return next((what for begin, what in _BEGIN.items() if head.startswith(begin)), "")
