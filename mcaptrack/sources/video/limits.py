"""Limits for picture sizes: a file of a few bytes can declare a picture that is larger than any memory.

The size is read from the first bytes, before anything is decoded, so that oversized pictures cost nothing.
"""

from __future__ import annotations

import re
from mmap import mmap
from typing import Final, NamedTuple

from mcaptrack import environment
from mcaptrack.errors import McaptrackError

ENVIRONMENT: Final = "MCAPTRACK_MAX_MEGAPIXELS"
_MEGAPIXELS: Final = 100
_MILLION: Final = 1_000_000
#: The largest limit that FFmpeg accepts.
_MOST_MEGAPIXELS: Final = 2147
#: The maximum picture size of H.264 (level 6.2): 139 264 macroblocks of 16 x 16 pixels.
_H264_PIXELS: Final = 139_264 * 256
_PNG, _JPEG, _BMP, _RIFF = b"\x89PNG\r\n\x1a\n", b"\xff\xd8", b"BM", b"RIFF"
#: Where a PNG has the bits of its samples.
_PNG_DEPTH: Final = 24
_TIFF: Final = {b"II*\0": "little", b"MM\0*": "big"}
_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_BITS, _TIFF_SAMPLES, _TIFF_SHORT = 256, 257, 258, 277, 3
#: The memory limit is the pixel limit times this many bytes.
_BYTES: Final = 4
_OLDEST_BMP: Final = 12
#: Markers of JPEG without a length, and those of frames, which hold the size.
_JPEG_BARE: Final = frozenset((0x01, *range(0xD0, 0xD9)))
_JPEG_FRAMES: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
#: The boxes of an AVIF file are searched for image sizes in this many bytes.
_AVIF_HEAD: Final = 65536


class StillHeader(NamedTuple):
    """The header of a still image: its size, and the bytes of a pixel if they are more than four."""

    width_px: int
    height_px: int
    bytes_a_pixel: int = 4


def max_pixels() -> int:
    """The pixel limit for pictures. Raises McaptrackError if the environment variable is not a number."""
    return min(environment.whole_number(ENVIRONMENT, _MEGAPIXELS), _MOST_MEGAPIXELS) * _MILLION


def check_size(width: int, height: int, where: object) -> None:
    """Raise McaptrackError for a picture that is too large."""
    if width * height > max_pixels():
        raise McaptrackError(f"{where} has {width} x {height} pixels; {too_large()}")


def too_large() -> str:
    """The hint for oversized pictures."""
    return f"at most {max_pixels() // _MILLION} megapixels are read ({ENVIRONMENT} sets another limit)"


def check_h264(width: int, height: int, where: object) -> None:
    """Raise McaptrackError for pictures that are too large for H.264."""
    if width * height > _H264_PIXELS:
        raise McaptrackError(
            f"{where} has pictures of {width} x {height} pixels, and those of H.264 have at most "
            f"{_H264_PIXELS / _MILLION:.1f} megapixels; `image_format='jpeg'` keeps larger ones"
        )


def check_still(still: StillHeader, where: object) -> None:
    """Raise McaptrackError for a still image that is too large."""
    width, height, size = still
    check_size(width, height, where)
    if width * height * size > _BYTES * max_pixels():
        raise McaptrackError(f"{where} has {width} x {height} pixels of {size} bytes; {too_large()} of {_BYTES} bytes")


def is_deep(data: bytes) -> bool:
    """Whether a still image may have samples of more than 8 bits, by its first bytes."""
    return data[:4] in _TIFF or (data.startswith(_PNG) and data[_PNG_DEPTH : _PNG_DEPTH + 1] > b"\x08")


def still_size(data: bytes | mmap) -> StillHeader | None:
    """The size in the header of a still image; None for other formats, and for headers that are cut off."""
    head = bytes(data[:32])
    if head.startswith(_PNG):
        return StillHeader(_big_endian(head[16:20]), _big_endian(head[20:24]))
    if head.startswith(_JPEG):
        return _jpeg(data)
    if head.startswith(_BMP):
        if _little_endian(head[14:18]) == _OLDEST_BMP:
            return StillHeader(_little_endian(head[18:20]), _little_endian(head[20:22]))
        width, height = (abs(int.from_bytes(head[at : at + 4], "little", signed=True)) for at in (18, 22))
        return StillHeader(width, height)
    if head.startswith(_RIFF) and head[8:12] == b"WEBP":
        return _webp(head)
    if head[:4] in _TIFF:
        return _tiff(data, _TIFF[head[:4]])
    if head[4:8] == b"ftyp":
        return _avif(bytes(data[:_AVIF_HEAD]))
    return None


def _big_endian(data: bytes) -> int:
    return int.from_bytes(data, "big")


def _little_endian(data: bytes) -> int:
    return int.from_bytes(data, "little")


def _jpeg(data: bytes | mmap) -> StillHeader | None:
    at = 2
    while at + 9 <= len(data):
        head = bytes(data[at : at + 9])
        if head[0] != 0xFF:
            return None
        if head[1] == 0xFF or head[1] in _JPEG_BARE:
            at += 1 if head[1] == 0xFF else 2
        elif head[1] in _JPEG_FRAMES:
            return StillHeader(_big_endian(head[7:9]), _big_endian(head[5:7]))
        else:
            at += 2 + _big_endian(head[2:4])
    return None


def _webp(head: bytes) -> StillHeader | None:
    kind = head[12:16]
    if kind == b"VP8 ":
        return StillHeader(_little_endian(head[26:28]) & 0x3FFF, _little_endian(head[28:30]) & 0x3FFF)
    if kind == b"VP8L":
        bits = _little_endian(head[21:25])
        return StillHeader((bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1)
    return StillHeader(_little_endian(head[24:27]) + 1, _little_endian(head[27:30]) + 1) if kind == b"VP8X" else None


def _tiff(data: bytes | mmap, order: str) -> StillHeader | None:
    """The size of a TIFF image, and the bytes of its pixels, because a whole strip is decoded in memory."""

    def number(at: int, size: int) -> int:
        return int.from_bytes(bytes(data[at : at + size]), order)  # type: ignore[arg-type]

    first = number(4, 4)
    tags = {_TIFF_BITS: 1, _TIFF_SAMPLES: 1}
    for entry in range(number(first, 2)):
        at = first + 2 + 12 * entry
        tag, size = number(at, 2), 2 if number(at + 2, 2) == _TIFF_SHORT else 4
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_BITS, _TIFF_SAMPLES):
            is_elsewhere = size * number(at + 4, 4) > 4
            value = number(number(at + 8, 4) if is_elsewhere else at + 8, size)
            tags[tag] = max(tags.get(tag, 0), value)
    if _TIFF_WIDTH not in tags or _TIFF_HEIGHT not in tags:
        return None
    size = -(-tags[_TIFF_BITS] * tags[_TIFF_SAMPLES] // 8)
    return StillHeader(tags[_TIFF_WIDTH], tags[_TIFF_HEIGHT], max(_BYTES, size))


def _avif(head: bytes) -> StillHeader | None:
    """The largest size of the images in an AVIF file, which may be composed of tiles."""
    places = [match.start() for match in re.finditer(b"ispe", head)]
    sizes = [StillHeader(_big_endian(head[at + 8 : at + 12]), _big_endian(head[at + 12 : at + 16])) for at in places]
    return max(sizes, key=lambda size: size.width_px * size.height_px, default=None)
