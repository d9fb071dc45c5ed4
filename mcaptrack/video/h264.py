"""What has to be known about an H.264 stream (ITU-T H.264, 7.3 and Annex B) before it is passed on as it is."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

_SLICE, _IDR, _SPS, _PPS = 1, 5, 7, 8


class Picture(NamedTuple):
    """What one access unit in Annex B form holds."""

    has_idr: bool
    has_parameter_sets: bool
    has_b_slice: bool


def _nal_units(data: bytes) -> Iterator[bytes]:
    """The first bytes of each NAL unit between start codes; enough for a header and the start of a slice header."""
    at = data.find(b"\x00\x00\x01")
    while at >= 0:
        yield data[at + 3 : at + 19]
        at = data.find(b"\x00\x00\x01", at + 3)


def _slice_type(nal: bytes) -> int:
    """The second Exp-Golomb number of a slice header: 0 P, 1 B, 2 I, and 5 more if all slices are alike."""
    bits = int.from_bytes(nal[1:].replace(b"\x00\x00\x03", b"\x00\x00"), "big")
    left = 8 * len(nal[1:].replace(b"\x00\x00\x03", b"\x00\x00"))

    def number() -> int:
        nonlocal left
        zeros = 0
        while left > 0 and not bits >> (left - 1) & 1:
            zeros, left = zeros + 1, left - 1
        left -= zeros + 1
        return (bits >> max(left, 0) & ((1 << (zeros + 1)) - 1)) - 1

    number()  # first_mb_in_slice
    return number()


def inspect(data: bytes) -> Picture:
    """What the access unit ``data`` (Annex B) holds."""
    kinds, b_slice = set(), False
    for nal in _nal_units(data):
        if not nal:
            continue
        kind = nal[0] & 0x1F
        kinds.add(kind)
        if kind in (_SLICE, _IDR):
            b_slice |= _slice_type(nal) % 5 == 1
    return Picture(_IDR in kinds, {_SPS, _PPS} <= kinds, b_slice)
