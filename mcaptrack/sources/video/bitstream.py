"""Access units and their first bytes, described in the same way for all codecs; and a reader of bits and NAL units."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Final, NamedTuple

_START_CODE: Final = b"\x00\x00\x01"
#: Bytes of a slice's NAL unit that are enough for the fields that are read.
_HEAD: Final = 24


class AccessUnit(NamedTuple):
    """The content of one message.

    ``pictures`` is the number of pictures that a decoder shows of it. ``is_key``: decoding can begin here, given the
    parameter sets. ``sets`` are the parameter sets (H.264, H.265) or sequence headers (AV1) in it, and
    ``has_parameter_sets`` says whether they are all that a decoder needs. ``reorders``: display order differs from
    decoding order. ``size`` is (width, height) in pixels if the picture itself states it (VP9).
    """

    pictures: int
    is_key: bool
    sets: tuple[bytes, ...] = ()
    has_parameter_sets: bool = True
    reorders: bool = False
    size: tuple[int, int] | None = None


class PictureHead(NamedTuple):
    """The information in the first bytes of a message.

    Whether it has a picture, whether decoding can begin with it, given the parameter sets, and whether it has these.
    """

    has_picture: bool
    is_key: bool
    has_parameter_sets: bool


class Bits:
    """Reads the bits of ``data`` from the beginning; zeros after its end."""

    def __init__(self, data: bytes) -> None:
        self._bits = int.from_bytes(data, "big")
        self._left = 8 * len(data)

    @classmethod
    def of_nal(cls, nal: bytes) -> Bits:
        """The bits of a NAL unit, without emulation prevention bytes."""
        return cls(nal.replace(b"\x00\x00\x03", b"\x00\x00"))

    def take(self, count: int) -> int:
        """The next bits, as a number."""
        self._left -= count
        return (self._bits >> self._left if self._left >= 0 else 0) & ((1 << count) - 1)

    def golomb(self) -> int:
        """The next unsigned Exp-Golomb number."""
        zeros = 0
        while self._left > 0 and not self.take(1):
            zeros += 1
        return (1 << zeros) - 1 + self.take(zeros)

    def signed_golomb(self) -> int:
        """The next signed Exp-Golomb number."""
        number = self.golomb()
        return (number + 1) // 2 if number % 2 else -(number // 2)


def nal_starts(data: bytes) -> Iterator[int]:
    """The offsets of NAL units in an Annex B stream, after their start codes; searched lazily."""
    at = data.find(_START_CODE)
    while at >= 0:
        yield at + 3
        at = data.find(_START_CODE, at + 3)


def nal_units(data: bytes, whole: frozenset[int], shift: int, mask: int) -> Iterator[tuple[int, bytes]]:
    """The type and the bytes of each NAL unit; only the first bytes of types that are not in ``whole``.

    The type is ``mask`` applied to the first byte, shifted right by ``shift`` bits.
    """
    starts = [*nal_starts(data), len(data) + 3]
    for start, following in pairwise(starts):
        if start >= len(data):
            return
        kind = data[start] >> shift & mask
        if kind in whole:
            yield kind, data[start : following - 3].rstrip(b"\x00")
        else:
            yield kind, data[start : min(start + _HEAD, following - 3)]
