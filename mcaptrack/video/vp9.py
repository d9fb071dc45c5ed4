"""What has to be known about a VP9 stream (its specification, 6.2 and Annex B) before it is passed on or entered."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from mcaptrack.video.units import Bits, Entry, Unit

_SYNC: Final = 0x498342
_RGB: Final = 7
_HEAD: Final = 16


def inspect(data: bytes) -> Unit:
    """What a packet holds: a frame, or several of which one is shown."""
    pictures, is_key, size = 0, False, None
    for number, (start, end) in enumerate(_frames(data)):
        shown, key, extent = _header(data[start : min(end, start + _HEAD)])
        pictures += shown
        if number == 0:
            is_key, size = key, extent
    return Unit(pictures, is_key, size=size)


def entry(data: bytes) -> Entry:
    """What a message begins with; it needs no parameter sets."""
    return Entry(True, _header(data[:_HEAD])[1], True)


def _frames(data: bytes) -> Iterator[tuple[int, int]]:
    """Where the frames of a packet stand, by the index at its end if it has one."""
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
    """Of an uncompressed header: is the frame shown, is it a key frame, and then what are its width and height."""
    bits = Bits(head)
    if bits.take(2) != 2:
        return False, False, None
    profile = bits.take(1) + 2 * bits.take(1)
    if profile == 3:
        bits.take(1)
    if bits.take(1):
        return True, False, None  # a frame from before is shown
    is_inter, is_shown = bits.take(1), bool(bits.take(1))
    bits.take(1)
    if is_inter or bits.take(24) != _SYNC:
        return is_shown, False, None
    if profile >= 2:
        bits.take(1)
    if bits.take(3) != _RGB:
        bits.take(1)
        if profile in (1, 3):
            bits.take(3)
    elif profile in (1, 3):
        bits.take(1)
    return is_shown, True, (bits.take(16) + 1, bits.take(16) + 1)
