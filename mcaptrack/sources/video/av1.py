"""Parse AV1 streams (AV1 specification, 5.3 to 5.9) as far as passing them through and seeking in them need it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

from mcaptrack.sources.video.bitstream import AccessUnit, PictureHead

_SEQUENCE, _DELIMITER, _FRAME_HEADER, _FRAME = 1, 2, 3, 6
_KEY_FRAME: Final = 0


class _Obu(NamedTuple):
    kind: int
    start: int
    body: int
    end: int


def _obus(data: bytes) -> Iterator[_Obu]:
    """The open bitstream units (OBUs) of a temporal unit in the low-overhead format, up to one without a length."""
    at = 0
    while at < len(data):
        head, start = data[at], at
        at += 2 if head & 4 else 1
        if not head & 2:
            return
        size = 0
        for byte in range(8):
            if at >= len(data):
                return
            size |= (data[at] & 0x7F) << 7 * byte
            at += 1
            if not data[at - 1] & 0x80:
                break
        yield _Obu(head >> 3 & 15, start, at, at + size)
        at += size


def inspect(data: bytes) -> AccessUnit:
    """Parse a temporal unit."""
    pictures, is_key, sets = 0, False, []
    for obu in _obus(data):
        if obu.end > len(data):
            break
        if obu.kind == _SEQUENCE:
            sets.append(data[obu.start : obu.end])
        elif obu.kind in (_FRAME_HEADER, _FRAME) and obu.body < len(data):
            is_shown, key = _header(data[obu.body])
            is_key |= key and not pictures
            pictures += is_shown
    return AccessUnit(pictures, is_key, tuple(sets), bool(sets))


def read_head(data: bytes) -> PictureHead:
    """Parse the first bytes of a message; only key frames that are shown count as key pictures."""
    has_sequence = False
    for obu in _obus(data):
        has_sequence |= obu.kind == _SEQUENCE
        if obu.kind in (_FRAME_HEADER, _FRAME) and obu.body < len(data):
            return PictureHead(True, _header(data[obu.body])[1], has_sequence)
    return PictureHead(False, False, has_sequence)


def with_parameter_sets(data: bytes, sets: tuple[bytes, ...]) -> bytes:
    """Insert sequence headers into a temporal unit, after its delimiter."""
    first = next(_obus(data), None)
    at = first.end if first and first.kind == _DELIMITER else 0
    return data[:at] + b"".join(sets) + data[at:]


def sequence_headers(configuration: bytes) -> tuple[bytes, ...]:
    """The sequence headers in the configuration record of a container (AV1 in ISO BMFF, 2.3)."""
    body = configuration[4:]
    return tuple(body[obu.start : obu.end] for obu in _obus(body) if obu.kind == _SEQUENCE)


def _header(byte: int) -> tuple[bool, bool]:
    """From an uncompressed header: whether a frame is shown, and whether it is a key frame."""
    if byte >> 7:
        return True, False  # show_existing_frame
    is_shown = bool(byte >> 4 & 1)
    return is_shown, is_shown and byte >> 5 & 3 == _KEY_FRAME
