"""What has to be known about an H.265 stream (ITU-T H.265, 7.3 and Annex B) before it is passed on or entered."""

from __future__ import annotations

from typing import Final

from mcaptrack.sources.video.bitstream import AccessUnit, PictureHead, nal_starts, nal_units

_SETS: Final = frozenset((32, 33, 34))  # VPS, SPS, PPS
_DELIMITER: Final = 35
_LAST_PICTURE: Final = 31
_RANDOM_ACCESS: Final = range(16, 24)
#: Pictures that are shown before the key picture that they follow, and may need those before it.
_LEADING: Final = range(6, 10)


def _kind(data: bytes, at: int) -> int:
    """The type of the NAL unit that begins there; a type that nothing has where it is cut off."""
    return data[at] >> 1 & 0x3F if at < len(data) else 63


def inspect(data: bytes) -> AccessUnit:
    """What the access unit ``data`` (Annex B) holds. Layers above the first are passed over."""
    pictures, is_key, is_leading = 0, False, False
    sets: dict[bytes, int] = {}
    for kind, nal in nal_units(data, _SETS, 1, 0x3F):
        if len(nal) < 3 or nal[0] & 1 or nal[1] >> 3:
            continue
        if kind in _SETS:
            sets[nal] = kind
        elif kind <= _LAST_PICTURE:
            pictures += nal[2] >> 7  # first_slice_segment_in_pic_flag
            is_key |= kind in _RANDOM_ACCESS
            is_leading |= kind in _LEADING
    return AccessUnit(pictures, is_key, tuple(sets), set(sets.values()) == _SETS, is_leading)


def read_head(data: bytes) -> PictureHead:
    """What a message begins with; nothing behind the head of its first slice is looked at."""
    found: set[int] = set()
    for start in nal_starts(data):
        kind = _kind(data, start)
        if kind <= _LAST_PICTURE:
            return PictureHead(True, kind in _RANDOM_ACCESS, found >= _SETS)
        found.add(kind)
    return PictureHead(False, False, found >= _SETS)


def with_sets(data: bytes, sets: tuple[bytes, ...]) -> bytes:
    """An access unit with parameter sets before its slices, behind its delimiter."""
    first = next(nal_starts(data), len(data))
    at = first + 3 if _kind(data, first) == _DELIMITER else 0
    return data[:at] + b"".join(b"\x00\x00\x00\x01" + nal for nal in sets) + data[at:]
