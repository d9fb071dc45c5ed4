"""Checksums of MCAP: the CRC-32 of parts of a file, and of the beginning of a file when its end is rewritten."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Final

from mcaptrack.log.records import Bytes, Record

_CRC_POLYNOMIAL: Final = 0xEDB88320
#: Bytes read at once.
_CRC_BLOCK: Final = 2**20


def crc_of(buffer: Bytes, start: int, end: int, crc: int = 0) -> int:
    """The CRC-32 of a part of a file, continuing from ``crc``; one block in memory at a time."""
    for at in range(start, end, _CRC_BLOCK):
        crc = zlib.crc32(buffer[at : min(at + _CRC_BLOCK, end)], crc)
    return crc


def attachment_is_whole(buffer: Bytes, record: Record) -> bool:
    """Whether the checksum of an attachment is right; 0 means that it has none."""
    crc = int.from_bytes(buffer[record.end - 4 : record.end], "little")
    return not crc or crc_of(buffer, record.body, record.end - 4) == crc


def crc_before(crc: int, tail_crc: int, tail_size: int) -> int:
    """The CRC-32 of the first part of some bytes, from the CRC of all of them and the CRC and size of the rest.

    The CRC of a concatenation is the CRC of the first part, shifted by the length of the second part, plus the CRC of
    the second part (zlib's crc32_combine). The shift can be inverted.
    """
    shifted = crc ^ tail_crc
    # The inverse shift by one bit as a 32 x 32 bit matrix; its squares shift back by two, four, eight bits.
    back = [1 << bit + 1 for bit in range(31)] + [(1 << 31 ^ _CRC_POLYNOMIAL) << 1 & 0xFFFFFFFF | 1]
    bits = 8 * tail_size
    while bits:
        if bits & 1:
            shifted = _times(back, shifted)
        back = [_times(back, column) for column in back]
        bits >>= 1
    return shifted


def _times(columns: Sequence[int], vector: int) -> int:
    """Product of a bit matrix and a bit vector, over GF(2)."""
    out = 0
    for column in columns:
        if vector & 1:
            out ^= column
        vector >>= 1
    return out
