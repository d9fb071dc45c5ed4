"""A log as it is found: its file, its bytes and its index, taken at one moment."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from mcaptrack.errors import McaptrackError
from mcaptrack.log.index import Index, read_index
from mcaptrack.log.records import Damaged
from mcaptrack.log.source import OpenFile, Signature, Source

#: How long to wait for another process that is changing the file just now, and between two looks.
_PATIENCE_S: Final = 1.0
_PAUSE_S: Final = 0.02


@dataclass
class Opened:
    """An open log. ``signature`` is what its file had when the index was read."""

    file: OpenFile
    source: Source
    index: Index
    signature: Signature
    is_certain: bool


def open_log(path: Path) -> Opened:
    """Open a log. Raises McaptrackError if it is none, is damaged, or goes on being changed."""
    until = time.monotonic() + _PATIENCE_S
    while True:
        file = OpenFile(path)
        try:
            found = _look(path, file)
        except BaseException:
            file.close()
            raise
        if isinstance(found, Opened):
            return found
        file.close()
        if time.monotonic() > until:
            raise found
        time.sleep(_PAUSE_S)


def _look(path: Path, file: OpenFile) -> Opened | McaptrackError:
    """What an open file holds; an error if that can't be told while somebody changes it. Raises what won't pass."""
    signature = Signature.of(file.handle)
    is_certain = signature.is_certain
    try:
        source = Source.of(file)
        if not len(source):
            raise Damaged("it is empty")
        index = read_index(source)
    except Damaged as error:
        words = McaptrackError(f"{path} can't be read as an MCAP file: {error}; {recover_words(path)}")
        if _is_as_it_was(path, file, signature):
            raise words from None
        return words
    if Signature.of(file.handle) != signature:
        return McaptrackError(f"{path} is being changed by another process; try again when it is done")
    return Opened(file, source, index, signature, is_certain)


def _is_as_it_was(path: Path, file: OpenFile, signature: Signature) -> bool:
    """Whether the path still leads to the file, and nobody changed it since."""
    try:
        return os.path.samestat(path.stat(), os.fstat(file.handle)) and Signature.of(file.handle) == signature
    except OSError:
        return False


def changed(path: Path) -> McaptrackError:
    """What is said of a file that turned out to be another one while it was read."""
    return McaptrackError(f"{path} was changed by another process while it was being read; try again")


def recover_words(path: Path) -> str:
    """What to do about a damaged log."""
    return f"`mcaptrack recover {path}` saves what is whole"
