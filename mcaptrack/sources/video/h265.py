"""Parse H.265 streams (ITU-T H.265, 7.3 and Annex B) as far as passing them through and seeking in them need it."""

from __future__ import annotations

from typing import Final

from mcaptrack.sources.video.bitstream import AccessUnit, PictureHead, nal_starts, nal_units

_SETS: Final = frozenset((32, 33, 34))  # VPS, SPS, PPS
_DELIMITER: Final = 35
_LAST_PICTURE: Final = 31
_RANDOM_ACCESS: Final = range(16, 24)
#: Leading pictures (RASL, RADL): they follow a key picture but are shown before it, and may need earlier pictures.
_LEADING: Final = range(6, 10)


def _kind(data: bytes, at: int) -> int:
    """The type of the NAL unit at an offset; 63, an unused type, if it is cut off."""
    return data[at] >> 1 & 0x3F if at < len(data) else 63


def inspect(data: bytes) -> AccessUnit:
    """Parse an access unit in Annex B format. Layers above the base layer are skipped."""
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
    """Parse the first bytes of a message, up to the header of its first slice."""
    kinds: set[int] = set()
    for start in nal_starts(data):
        kind = _kind(data, start)
        if kind <= _LAST_PICTURE:
            return PictureHead(True, kind in _RANDOM_ACCESS, kinds >= _SETS)
        kinds.add(kind)
    return PictureHead(False, False, kinds >= _SETS)


def with_parameter_sets(data: bytes, sets: tuple[bytes, ...]) -> bytes:
    """Insert parameter sets into an access unit, after its delimiter."""
    first = next(nal_starts(data), len(data))
    at = first + 3 if _kind(data, first) == _DELIMITER else 0
    return data[:at] + b"".join(b"\x00\x00\x00\x01" + nal for nal in sets) + data[at:]
