"""Count the slots for pictures in containers that number pictures instead of storing times: AVI and IVF.

Slots may be empty, where nothing moved or no picture arrived. The container declares its number of slots; if there are
fewer, the file was cut off.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, Protocol

_RIFF_HEAD, _CHUNK_HEAD, _IVF_FRAME_HEAD = 12, 8, 12
_LISTS: Final = (b"movi", b"rec ")


class _File(Protocol):
    """An unbuffered file: only the heads of chunks are read, far apart."""

    def read(self, size: int, /) -> bytes: ...

    def seek(self, at: int, /) -> int: ...


def count_slots(path: Path, stream: int) -> int | None:
    """The number of slots of a stream that the file really holds; None for other containers."""
    with path.open("rb", buffering=0) as file:
        head = file.read(_RIFF_HEAD)
        if head[:4] == b"RIFF" and head[8:12] == b"AVI ":
            return _avi(file, path.stat().st_size, b"%02d" % stream)
        if head[:4] == b"DKIF":
            return _ivf(file, path.stat().st_size, int.from_bytes(head[6:8], "little"))
    return None


def _avi(file: _File, size: int, name: bytes) -> int:
    """Count the chunks "00dc" and "00db" in all lists of all RIFF parts of the file."""
    count, at = 0, 0
    while at + _CHUNK_HEAD <= size:
        file.seek(at)
        head = file.read(_RIFF_HEAD)
        kind, length = head[:4], int.from_bytes(head[4:8], "little")
        if kind == b"RIFF" or (kind == b"LIST" and head[8:12] in _LISTS):
            at += _RIFF_HEAD
            continue
        at += _CHUNK_HEAD + length + length % 2
        count += kind[:2] == name and kind[2:] in (b"dc", b"db") and at - length % 2 <= size
    return count


def _ivf(file: _File, size: int, first: int) -> int:
    count, at = 0, first
    while at + _IVF_FRAME_HEAD <= size:
        file.seek(at)
        at += _IVF_FRAME_HEAD + int.from_bytes(file.read(4), "little")
        count += at <= size
    return count
