"""The seqinfo.ini of a MOTChallenge sequence: its frame rate, and how many frames it has."""

from __future__ import annotations

import re
from fractions import Fraction
from pathlib import Path
from typing import Final, NamedTuple

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.clocks import parse_fps

SEQINFO: Final = "seqinfo.ini"
_MAX_BYTES: Final = 65536
_FPS: Final = re.compile(r"^\s*frameRate\s*=(.*)$", re.MULTILINE)
_FRAMES: Final = re.compile(r"^\s*seqLength\s*=\s*([0-9]{1,9})\s*$", re.MULTILINE)


class SeqInfo(NamedTuple):
    """Frame rate and number of frames in a seqinfo.ini; None for a missing value."""

    path: Path
    fps: Fraction | None
    frames: int | None


def find_seqinfo(folder: Path) -> SeqInfo | None:
    """The seqinfo.ini in a folder or in the one above; None if there is none. Raises McaptrackError for a bad one."""
    for path in (folder / SEQINFO, folder.parent / SEQINFO):
        if path.is_file():
            return _read(path)
    return None


def _read(path: Path) -> SeqInfo:
    try:
        with path.open("rb") as stream:
            text = stream.read(_MAX_BYTES).decode("utf-8", "replace")
    except OSError as error:
        raise McaptrackError(f"{path} can't be read: {error.strerror}") from None
    fps, frames = _FPS.search(text), _FRAMES.search(text)
    try:
        return SeqInfo(path, parse_fps(fps[1]) if fps else None, int(frames[1]) if frames else None)
    except ValueError as error:
        raise McaptrackError(f"{path}: frameRate is no number of frames a second ({error})") from None
