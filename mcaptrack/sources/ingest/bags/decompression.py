"""Decompression within bounds: a small file can claim, or become, any size."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from mcaptrack import environment
from mcaptrack.errors import McaptrackError

ENVIRONMENT: Final = "MCAPTRACK_MAX_UNPACKED_MIB"
#: What is compressed may become so many times as large, and in any case so many MiB, unless the environment says more.
_RATIO, _LEAST_MIB = 64, 64
#: Small enough for Python to notice a signal between two pieces.
_PIECE_BYTES: Final = 2**20
#: One byte of zstd can become 32 KiB: without a declared size it is fed in pieces that stay small.
_FED_BYTES: Final = 2**10
_WINDOW_BYTES: Final = 2**27
#: The part of the free disk that temporary files may take.
_OF_DISK: Final = 0.9


class NotUnpackedError(ValueError):
    """Data that can't be decompressed, or would become too large; the message says why."""


def limit_of(packed: int) -> int:
    """How many bytes may come out of ``packed`` bytes."""
    mib = environment.whole_number(ENVIRONMENT, 0)
    return mib * 2**20 if mib else max(_RATIO * packed, _LEAST_MIB * 2**20)


def too_large(size: int | None, most: int) -> NotUnpackedError:
    """What to say of data that are, or say that they are, larger than ``most`` bytes."""
    mib = f"{most / 2**20:.0f} MiB"
    said = f"it has more than {mib}" if size is None else f"it says that it has {size} bytes, more than {mib}"
    return NotUnpackedError(f"{said} when decompressed, which is unusual; {ENVIRONMENT} sets another limit")


def unzstd(data: bytes, most: int) -> bytes:
    """One zstd frame as bytes, at most ``most``. Raises NotUnpackedError."""
    import zstandard

    try:
        size = zstandard.frame_content_size(data)
        if size > most:
            raise too_large(size, most)
        if size >= 0:
            return zstandard.ZstdDecompressor(max_window_size=_WINDOW_BYTES).decompress(data)
        unpacker = zstandard.ZstdDecompressor(max_window_size=_WINDOW_BYTES).decompressobj()
        return in_pieces(lambda piece, _: unpacker.decompress(piece), lambda: unpacker.eof, data, most)
    except zstandard.ZstdError as error:
        raise NotUnpackedError(str(error)) from None


def in_steps(unpacker: Any, data: bytes, most: int) -> bytes:
    """The first ``most`` bytes of what ``data`` becomes, or less; ``unpacker`` is as those of Python's bz2 are.

    Step by step, since Python notices signals only between two of them.
    """
    parts, size = [], 0
    while size < most and not unpacker.eof and (data or not unpacker.needs_input):
        parts.append(unpacker.decompress(data, min(_PIECE_BYTES, most - size)))
        size += len(parts[-1])
        data = b""
    return b"".join(parts)


def in_pieces(unpack: Callable[[bytes, int], bytes], ended: Callable[[], bool], data: bytes, most: int) -> bytes:
    """What ``unpack`` makes of ``data``, piece by piece, until it has ``ended``. Raises NotUnpackedError."""
    parts, size = [], 0
    for at in range(0, len(data), _FED_BYTES):
        if ended():
            break
        part = unpack(data[at : at + _FED_BYTES], most)
        size += len(part)
        if size > most:
            raise too_large(None, most)
        parts.append(part)
    if not ended():
        raise NotUnpackedError("it is cut off")
    return b"".join(parts)


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """A folder of our own, gone afterwards."""
    with TemporaryDirectory(prefix="mcaptrack-") as name:
        yield Path(name)


def unzstd_file(path: Path, out: Path) -> None:
    """A file that is compressed as a whole, decompressed. Raises McaptrackError."""
    import zstandard

    most = limit_of(path.stat().st_size)
    try:
        with path.open("rb") as packed:
            size = zstandard.frame_content_size(packed.read(18))
            if size > most:
                raise too_large(size, most)
            packed.seek(0)
            unpacker = zstandard.ZstdDecompressor(max_window_size=_WINDOW_BYTES)
            with unpacker.stream_reader(packed, read_across_frames=True, closefd=False) as stream:
                _write(stream, out, max(size, 0), most)
    except (zstandard.ZstdError, NotUnpackedError) as error:
        raise McaptrackError(f"{path} can't be decompressed: {error}") from None


def copy(path: Path, out: Path) -> None:
    """A copy to a temporary folder. Raises McaptrackError if there is no space for it."""
    size = path.stat().st_size
    try:
        with path.open("rb") as stream:
            _write(stream, out, size, size)
    except NotUnpackedError:
        raise McaptrackError(f"{path} grows while it is being read; is it still being recorded?") from None
    except OSError as error:
        raise McaptrackError(f"{path} can't be read: {error.strerror or error}") from None


def _write(stream: Any, out: Path, expected: int, most: int) -> None:
    """All of a stream to a file, at most ``most`` bytes and what the disk has."""
    free = int(shutil.disk_usage(out.parent).free * _OF_DISK)
    size = expected
    try:
        with out.open("wb") as file:
            done = 0
            while size <= min(most, free) and (piece := stream.read(_PIECE_BYTES)):
                done += len(piece)
                size = max(done, expected)
                file.write(piece)
    except OSError as error:
        raise McaptrackError(f"{out} can't be written: {error.strerror or error}") from None
    if size > most:
        raise too_large(None, most)
    if size > free:
        raise McaptrackError(
            f"{out.name} needs {size} bytes or more in {out.parent.parent}, where {free} can be had; TMPDIR chooses "
            "another folder"
        )
