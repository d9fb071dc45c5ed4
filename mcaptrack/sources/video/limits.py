"""How large pictures may be: files of a few bytes can say that they are larger than any memory.

The size is read from the first bytes, before anything is decoded, so that a picture that is too large costs nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple, Protocol

from mcaptrack import environment
from mcaptrack.errors import McaptrackError

ENVIRONMENT: Final = "MCAPTRACK_MAX_MEGAPIXELS"
_MEGAPIXELS: Final = 100
_MILLION: Final = 1_000_000
#: FFmpeg takes no larger limit.
_MOST_MEGAPIXELS: Final = 2147
#: What H.264 can be asked for at most (its level 6.2): 139 264 blocks of 16 x 16 pixels.
_H264_PIXELS: Final = 139_264 * 256
_PNG, _JPEG, _BMP, _RIFF = b"\x89PNG\r\n\x1a\n", b"\xff\xd8", b"BM", b"RIFF"
_TIFF: Final = {b"II*\0": "little", b"MM\0*": "big"}
_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_BITS, _TIFF_SAMPLES, _TIFF_SHORT = 256, 257, 258, 277, 3
#: So many bytes a pixel may have where all pixels are there that are allowed.
_BYTES: Final = 4
_OLDEST_BMP: Final = 12
#: Markers of JPEG without a length, and those of frames, which hold the size.
_JPEG_BARE: Final = frozenset((0x01, *range(0xD0, 0xD9)))
_JPEG_FRAMES: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
#: So far the boxes of an AVIF file are searched for the sizes of its images.
_AVIF_HEAD: Final = 65536


class Still(NamedTuple):
    """What a still says of itself: its size, and how many bytes a pixel has if there are more than four."""

    width_px: int
    height_px: int
    bytes_a_pixel: int = 4


class Buffer(Protocol):
    """Bytes, or a file that is mapped into memory."""

    def __getitem__(self, key: slice, /) -> bytes:
        """Some of the bytes."""

    def __len__(self) -> int:
        """How many there are."""


def max_pixels() -> int:
    """How many pixels a picture may have. Raises McaptrackError if the environment says something that is no number."""
    return min(environment.whole_number(ENVIRONMENT, _MEGAPIXELS), _MOST_MEGAPIXELS) * _MILLION


def check_size(width: int, height: int, where: object) -> None:
    """Raise McaptrackError for a picture that is too large."""
    if width * height > max_pixels():
        raise McaptrackError(f"{where} has {width} x {height} pixels; {too_large()}")


def too_large() -> str:
    """What to do about pictures that are too large, in words."""
    return f"at most {max_pixels() // _MILLION} megapixels are read ({ENVIRONMENT} sets another limit)"


def check_h264(width: int, height: int, where: object) -> None:
    """Raise McaptrackError for pictures that no H.264 stream holds."""
    if width * height > _H264_PIXELS:
        raise McaptrackError(
            f"{where} has pictures of {width} x {height} pixels, and those of H.264 have at most "
            f"{_H264_PIXELS / _MILLION:.1f} megapixels; --image-format jpeg keeps larger ones"
        )


def check_still(still: Still, where: object) -> None:
    """Raise McaptrackError for a still that is too large."""
    width, height, size = still
    check_size(width, height, where)
    if width * height * size > _BYTES * max_pixels():
        raise McaptrackError(f"{where} has {width} x {height} pixels of {size} bytes; {too_large()} of {_BYTES} bytes")


def still_size(data: Buffer) -> Still | None:
    """What a still says of its size; None for another format, or one that is cut off."""
    head = bytes(data[:32])
    if head.startswith(_PNG):
        return Still(_big(head[16:20]), _big(head[20:24]))
    if head.startswith(_JPEG):
        return _jpeg(data)
    if head.startswith(_BMP):
        if _little(head[14:18]) == _OLDEST_BMP:
            return Still(_little(head[18:20]), _little(head[20:22]))
        width, height = (abs(int.from_bytes(head[at : at + 4], "little", signed=True)) for at in (18, 22))
        return Still(width, height)
    if head.startswith(_RIFF) and head[8:12] == b"WEBP":
        return _webp(head)
    if head[:4] in _TIFF:
        return _tiff(data, _TIFF[head[:4]])
    if head[4:8] == b"ftyp":
        return _avif(bytes(data[:_AVIF_HEAD]))
    return None


def _big(data: bytes) -> int:
    return int.from_bytes(data, "big")


def _little(data: bytes) -> int:
    return int.from_bytes(data, "little")


def _jpeg(data: Buffer) -> Still | None:
    at = 2
    while at + 9 <= len(data):
        head = bytes(data[at : at + 9])
        if head[0] != 0xFF:
            return None
        if head[1] == 0xFF or head[1] in _JPEG_BARE:
            at += 1 if head[1] == 0xFF else 2
        elif head[1] in _JPEG_FRAMES:
            return Still(_big(head[7:9]), _big(head[5:7]))
        else:
            at += 2 + _big(head[2:4])
    return None


def _webp(head: bytes) -> Still | None:
    kind = head[12:16]
    if kind == b"VP8 ":
        return Still(_little(head[26:28]) & 0x3FFF, _little(head[28:30]) & 0x3FFF)
    if kind == b"VP8L":
        bits = _little(head[21:25])
        return Still((bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1)
    return Still(_little(head[24:27]) + 1, _little(head[27:30]) + 1) if kind == b"VP8X" else None


def _tiff(data: Buffer, order: str) -> Still | None:
    """With the bytes of a pixel: all of a strip is in memory at once."""

    def number(at: int, size: int) -> int:
        return int.from_bytes(bytes(data[at : at + size]), order)  # type: ignore[arg-type]

    first = number(4, 4)
    found = {_TIFF_BITS: 1, _TIFF_SAMPLES: 1}
    for entry in range(number(first, 2)):
        at = first + 2 + 12 * entry
        tag, size = number(at, 2), 2 if number(at + 2, 2) == _TIFF_SHORT else 4
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_BITS, _TIFF_SAMPLES):
            is_elsewhere = size * number(at + 4, 4) > 4
            value = number(number(at + 8, 4) if is_elsewhere else at + 8, size)
            found[tag] = max(found.get(tag, 0), value)
    if _TIFF_WIDTH not in found or _TIFF_HEIGHT not in found:
        return None
    size = -(-found[_TIFF_BITS] * found[_TIFF_SAMPLES] // 8)
    return Still(found[_TIFF_WIDTH], found[_TIFF_HEIGHT], max(_BYTES, size))


def _avif(head: bytes) -> Still | None:
    """The largest of the sizes that its images have: they may be put together of tiles."""
    found = [Still(_big(head[at + 8 : at + 12]), _big(head[at + 12 : at + 16])) for at in _places(head, b"ispe")]
    return max(found, key=lambda size: size.width_px * size.height_px, default=None)


def _places(head: bytes, name: bytes) -> Iterator[int]:
    at = head.find(name)
    while at >= 0:
        yield at
        at = head.find(name, at + 1)
