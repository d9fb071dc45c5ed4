"""Decompress chunks and files of bags, and copy databases, within limits of memory and of free disk space."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.files import reading, writing
from mcaptrack.sources.ingest.decompression import WINDOW_BYTES, NotUnpackedError, limit_of, too_large

#: Small enough that Python handles signals between two pieces.
_PIECE_BYTES: Final = 2**20
#: The share of the free disk space that temporary files may use.
_DISK_SHARE: Final = 0.9


def decompress_steps(unpacker: Any, data: bytes, most: int) -> bytes:
    """Decompress ``data`` to at most ``most`` bytes; ``unpacker`` has the interface of bz2.BZ2Decompressor.

    In steps, because Python handles signals only between them.
    """
    parts, size = [], 0
    while size < most and not unpacker.eof and (data or not unpacker.needs_input):
        parts.append(unpacker.decompress(data, min(_PIECE_BYTES, most - size)))
        size += len(parts[-1])
        data = b""
    return b"".join(parts)


def unzstd_file(path: Path, out: Path) -> None:
    """Decompress a file. Raises McaptrackError."""
    import zstandard

    most = limit_of(path.stat().st_size)
    try:
        with path.open("rb") as packed:
            size = zstandard.frame_content_size(packed.read(18))
            if size > most:
                raise too_large(size, most)
            packed.seek(0)
            unpacker = zstandard.ZstdDecompressor(max_window_size=WINDOW_BYTES)
            with unpacker.stream_reader(packed, read_across_frames=True, closefd=False) as stream:
                _write(stream, out, max(size, 0), most)
    except (zstandard.ZstdError, NotUnpackedError) as error:
        raise McaptrackError(f"{path} can't be decompressed: {error}") from None


def copy(path: Path, out: Path) -> None:
    """Copy a file to a temporary folder. Raises McaptrackError if there is not enough space."""
    size = path.stat().st_size
    try:
        with reading(path) as stream:
            _write(stream, out, size, size)
    except NotUnpackedError:
        raise McaptrackError(f"{path} grows while it is being read; is it still being recorded?") from None


def _write(stream: Any, out: Path, expected: int, most: int) -> None:
    """Write a stream to a file, limited to ``most`` bytes and the free disk space."""
    free = int(shutil.disk_usage(out.parent).free * _DISK_SHARE)
    size = expected
    with writing(out), out.open("wb") as file:
        done = 0
        while size <= min(most, free) and (piece := stream.read(_PIECE_BYTES)):
            done += len(piece)
            size = max(done, expected)
            file.write(piece)
    if size > most:
        raise too_large(None, most)
    if size > free:
        raise McaptrackError(
            f"{out.name} needs {size} bytes or more in {out.parent.parent}, where {free} are free; TMPDIR sets "
            "another folder"
        )
