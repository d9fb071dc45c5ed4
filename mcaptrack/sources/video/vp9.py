"""Parse VP9 streams (VP9 specification, 6.2 and Annex B) as far as passing them through and seeking in them need it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from mcaptrack.sources.video.bitstream import AccessUnit, Bits, PictureHead

_SYNC: Final = 0x498342
_RGB: Final = 7
_HEAD: Final = 16


def inspect(data: bytes) -> AccessUnit:
    """Parse a packet: one frame, or a superframe of which one frame is shown."""
    pictures, is_key, size = 0, False, None
    for number, (start, end) in enumerate(_frames(data)):
        shown, key, declared = _header(data[start : min(end, start + _HEAD)])
        pictures += shown
        is_key |= key and number == 0
        size = declared or size
    return AccessUnit(pictures, is_key, size=size)


def read_head(data: bytes) -> PictureHead:
    """Parse the first bytes of a message; key pictures of VP9 need no parameter sets."""
    is_key = _header(data[:_HEAD])[1]
    return PictureHead(True, is_key, is_key)


def _frames(data: bytes) -> Iterator[tuple[int, int]]:
    """Start and end of the frames of a packet, by the superframe index at its end if it has one."""
    marker = data[-1] if data else 0
    count, width = (marker & 7) + 1, (marker >> 3 & 3) + 1
    at = len(data) - 2 - count * width
    if marker >> 5 != 0b110 or at < 0 or data[at] != marker:
        yield 0, len(data)
        return
    start = 0
    for number in range(count):
        size = int.from_bytes(data[at + 1 + number * width :][:width], "little")
        if size:
            yield start, start + size
        start += size


def _header(head: bytes) -> tuple[bool, bool, tuple[int, int] | None]:
    """From an uncompressed header: whether the frame is shown, whether it is a key frame, its size if it has one."""
    bits = Bits(head)
    if bits.take(2) != 2:
        return False, False, None
    profile = bits.take(1) + 2 * bits.take(1)
    if profile == 3:
        bits.take(1)
    if bits.take(1):
        return True, False, None  # show_existing_frame
    is_inter, is_shown, is_resilient = bits.take(1), bool(bits.take(1)), bits.take(1)
    if not is_inter:
        if bits.take(24) != _SYNC:
            return is_shown, False, None
        _skip_colour_config(bits, profile)
        return is_shown, True, _size(bits)
    is_intra_only = not is_shown and bool(bits.take(1))
    if not is_resilient:
        bits.take(2)
    if is_intra_only:
        bits.take(24)
        if profile:
            _skip_colour_config(bits, profile)
        bits.take(8)
        return is_shown, False, _size(bits)
    bits.take(8 + 3 * 4)  # refresh_frame_flags, ref_frame_idx and sign biases
    has_size_of_another = any(bits.take(1) for _ in range(3))
    return is_shown, False, None if has_size_of_another else _size(bits)


def _size(bits: Bits) -> tuple[int, int]:
    return bits.take(16) + 1, bits.take(16) + 1


def _skip_colour_config(bits: Bits, profile: int) -> None:
    if profile >= 2:
        bits.take(1)
    if bits.take(3) != _RGB:
        bits.take(1)
        if profile in (1, 3):
            bits.take(3)
    elif profile in (1, 3):
        bits.take(1)
