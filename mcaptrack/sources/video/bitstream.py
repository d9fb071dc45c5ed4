"""What one message's bytes of a video stream hold, said the same way for every codec, and how bytes are taken apart."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Final, NamedTuple

_START_CODE: Final = b"\x00\x00\x01"
#: Enough of a slice's NAL unit for all that is read of it.
_HEAD: Final = 24


class AccessUnit(NamedTuple):
    """What one message holds.

    ``pictures`` is how many pictures a decoder shows of it. ``is_key``: everything before can be forgotten, given the
    parameter sets. ``sets`` are the parameter sets (H.264, H.265) or the sequence header (AV1) that stand in it, and
    ``has_sets`` says whether these are all that a decoder needs. ``reorders``: pictures are shown in another order than
    they stand in. ``size`` is the width and height that a picture says, where no parameter set says them.
    """

    pictures: int
    is_key: bool
    sets: tuple[bytes, ...] = ()
    has_sets: bool = True
    reorders: bool = False
    size: tuple[int, int] | None = None


class PictureHead(NamedTuple):
    """What the first bytes of a message say.

    Whether it holds a picture, whether decoding can begin with that, given parameter sets, and whether it holds these.
    """

    has_picture: bool
    is_key: bool
    has_sets: bool


class Bits:
    """The bits of ``data``, from the first on; zeros where it has ended."""

    def __init__(self, data: bytes) -> None:
        self._bits = int.from_bytes(data, "big")
        self._left = 8 * len(data)

    @classmethod
    def of_nal(cls, nal: bytes) -> Bits:
        """Those of a NAL unit, without the bytes that keep start codes out of it."""
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
    """Where the NAL units of an Annex B stream begin, behind their start codes; found as they are asked for."""
    at = data.find(_START_CODE)
    while at >= 0:
        yield at + 3
        at = data.find(_START_CODE, at + 3)


def nal_units(data: bytes, whole: frozenset[int], shift: int, mask: int) -> Iterator[tuple[int, bytes]]:
    """The type and the bytes of each NAL unit; of types that are not in ``whole`` the first bytes alone.

    The type is in the first byte, ``shift`` bits from its end under ``mask``.
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
