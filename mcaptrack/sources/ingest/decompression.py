"""Decompression within limits: a small file can declare any size, or expand to it."""

from __future__ import annotations

import zlib
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import IO, Any, Final

from mcaptrack import environment
from mcaptrack.errors import McaptrackError
from mcaptrack.files import refuse_special, unreadable
from mcaptrack.log.recording_files import ZSTD

ENVIRONMENT: Final = "MCAPTRACK_MAX_UNPACKED_MIB"
#: The limit is this ratio, but at least this many MiB, unless the environment variable sets another one.
_RATIO, _MIN_MIB = 64, 64
#: The first bytes of what gzip has compressed.
_GZIP: Final = b"\x1f\x8b"
#: One byte of zstd can expand to 32 KiB: without a declared size the input is fed in small pieces.
_FED_BYTES: Final = 2**10
WINDOW_BYTES: Final = 2**27


class NotUnpackedError(ValueError):
    """Data that can't be decompressed, or would be too large; the message says why."""


def limit_of(packed: int) -> int:
    """The size limit for decompressing ``packed`` bytes."""
    mib = environment.whole_number(ENVIRONMENT, 0)
    return mib * 2**20 if mib else max(_RATIO * packed, _MIN_MIB * 2**20)


def too_large(size: int | None, most: int) -> NotUnpackedError:
    """The error for data that are larger, or declare to be larger, than ``most`` bytes."""
    mib = f"{most / 2**20:.0f} MiB"
    text = f"it has more than {mib}" if size is None else f"it says that it has {size} bytes, more than {mib}"
    return NotUnpackedError(f"{text} when decompressed, which is unusual; {ENVIRONMENT} sets another limit")


def unzstd(data: bytes, most: int) -> bytes:
    """Decompress zstd to at most ``most`` bytes. Raises NotUnpackedError."""
    import zstandard

    try:
        size = zstandard.frame_content_size(data)
        if size > most:
            raise too_large(size, most)
        if size >= 0:
            return zstandard.ZstdDecompressor(max_window_size=WINDOW_BYTES).decompress(data)
    except zstandard.ZstdError as error:
        raise NotUnpackedError(str(error)) from None
    return _unpacked(data, True, most)


def opened(path: Path) -> IO[bytes]:
    """The bytes of a file, decompressed if they are those of gzip or zstd. Raises McaptrackError."""
    refuse_special(path)
    try:
        stream = path.open("rb")
        magic = stream.read(4)
        stream.seek(0)
        if not magic.startswith(_GZIP) and magic != ZSTD:
            return stream
        with stream:
            data = stream.read()
            return BytesIO(_unpacked(data, magic == ZSTD, limit_of(len(data))))
    except OSError as error:
        raise unreadable(path, error) from None
    except NotUnpackedError as error:
        raise McaptrackError(f"{path} can't be decompressed: {error}") from None


def _unpacked(data: bytes, is_zstd: bool, most: int) -> bytes:
    """Decompress all parts of gzip or zstd that follow each other, to at most ``most`` bytes; or NotUnpackedError."""
    import zstandard

    of_zstd = zstandard.ZstdDecompressor(max_window_size=WINDOW_BYTES)
    new: Any = of_zstd.decompressobj if is_zstd else partial(zlib.decompressobj, zlib.MAX_WBITS + 16)
    parts, size, unpacker = list[bytes](), 0, new()
    try:
        for at in range(0, len(data), _FED_BYTES):
            piece = data[at : at + _FED_BYTES]
            while piece:
                unpacker = new() if unpacker.eof else unpacker
                parts.append(unpacker.decompress(piece))
                piece = unpacker.unused_data if unpacker.eof else b""
                size += len(parts[-1])
            if size > most:
                raise too_large(None, most)
    except (zlib.error, zstandard.ZstdError) as error:
        raise NotUnpackedError(str(error)) from None
    if not unpacker.eof:
        raise NotUnpackedError("it is cut off")
    return b"".join(parts)
