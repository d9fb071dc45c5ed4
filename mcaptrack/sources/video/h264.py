"""Parse H.264 streams (ITU-T H.264, 7.3 and Annex B) as far as passing them through and seeking in them need it."""

from __future__ import annotations

from typing import Final, NamedTuple

from mcaptrack.sources.video.bitstream import AccessUnit, Bits, PictureHead, nal_starts, nal_units

_SLICE, _PARTITION, _IDR, _SPS, _PPS, _DELIMITER = 1, 2, 5, 7, 8, 9
_PICTURES: Final = (_SLICE, _PARTITION, _IDR)
_SETS: Final = frozenset((_SPS, _PPS))
_B: Final = 1
_MOST_BITS: Final = 16  # of frame_num
#: Profiles with chroma_format_idc in their sequence parameter sets.
_HIGH: Final = (100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135)


def inspect(data: bytes) -> AccessUnit:
    """Parse an access unit in Annex B format."""
    pictures, is_key, has_b = 0, False, False
    sets: dict[bytes, int] = {}
    for kind, nal in nal_units(data, _SETS, 0, 0x1F):
        if kind in _SETS:
            sets[nal] = kind
        elif kind in _PICTURES:
            bits = Bits.of_nal(nal[1:])
            pictures += bits.golomb() == 0  # first_mb_in_slice
            has_b |= bits.golomb() % 5 == _B  # slice_type
            is_key |= kind == _IDR
    return AccessUnit(pictures, is_key, tuple(sets), set(sets.values()) == _SETS, has_b)


def read_head(data: bytes) -> PictureHead:
    """Parse the first bytes of a message, up to the header of its first slice."""
    kinds: set[int] = set()
    for start in nal_starts(data):
        kind = data[start] & 0x1F if start < len(data) else 0
        if kind in _PICTURES:
            return PictureHead(True, kind == _IDR, kinds >= _SETS)
        kinds.add(kind)
    return PictureHead(False, False, kinds >= _SETS)


def with_parameter_sets(data: bytes, sets: tuple[bytes, ...]) -> bytes:
    """Insert parameter sets into an access unit, after its delimiter."""
    first = next(nal_starts(data), len(data))
    at = 0
    if first < len(data) and data[first] & 0x1F == _DELIMITER:
        at = first + 2
    return data[:at] + b"".join(b"\x00\x00\x00\x01" + nal for nal in sets) + data[at:]


def is_interlaced(sets: tuple[bytes, ...]) -> bool:
    """Whether pictures may consist of two fields."""
    return any(not _parse_sps(nal).frames_only for nal in sets if nal[0] & 0x1F == _SPS)


def largest_size(data: bytes) -> tuple[int, int]:
    """The largest picture size in the sequence parameter sets: width and height, rounded up to macroblocks."""
    parsed = [_parse_sps(nal) for kind, nal in nal_units(data, _SETS, 0, 0x1F) if kind == _SPS]
    sizes = [(sps.width_px, sps.height_px) for sps in parsed]
    return max(sizes, key=lambda size: size[0] * size[1], default=(0, 0))


class FrameNumber(NamedTuple):
    """The number of a picture (frame_num), counted up to ``modulus``: it grows by one after each reference picture.

    ``may_jump``: the stream leaves out numbers on purpose.
    """

    value: int
    modulus: int
    is_idr: bool
    is_reference: bool
    may_jump: bool


class FrameNumbers:
    """Reads the numbers of progressive pictures, by the parameter sets that came before them."""

    def __init__(self) -> None:
        self._sps: dict[int, _Sps] = {}
        self._sps_of: dict[int, int] = {}

    def of(self, data: bytes) -> FrameNumber | None:
        """The number of an access unit in Annex B format; None if it isn't known."""
        for kind, nal in nal_units(data, _SETS, 0, 0x1F):
            bits = Bits.of_nal(nal[1:])
            if kind == _SPS:
                sps = _parse_sps(nal)
                self._sps[sps.name] = sps
            elif kind == _PPS:
                pps = bits.golomb()
                self._sps_of[pps] = bits.golomb()
            elif kind in _PICTURES:
                bits.golomb(), bits.golomb()  # first_mb_in_slice, slice_type
                used = self._sps.get(self._sps_of.get(bits.golomb(), -1))
                if used is None or used.has_planes or not used.frames_only or not 4 <= used.number_bits <= _MOST_BITS:
                    return None
                width = used.number_bits
                return FrameNumber(bits.take(width), 1 << width, kind == _IDR, bool(nal[0] & 0x60), used.may_jump)
        return None


class _Sps(NamedTuple):
    """A sequence parameter set (7.3.2.1.1): sizes in pixels are rounded up to macroblocks; ``has_planes``: each colour
    has slices of its own; ``number_bits`` are those of frame_num.
    """

    name: int
    has_planes: bool
    number_bits: int
    may_jump: bool
    width_px: int
    height_px: int
    frames_only: bool


def _parse_sps(nal: bytes) -> _Sps:
    bits = Bits.of_nal(nal[1:])
    profile = bits.take(8)
    bits.take(16)  # constraints, level
    name, has_planes = bits.golomb(), False
    if profile in _HIGH:
        chroma = bits.golomb()
        if chroma == 3:
            has_planes = bool(bits.take(1))
        bits.golomb(), bits.golomb(), bits.take(1)  # bit depths, lossless
        if bits.take(1):
            for number in range(8 if chroma != 3 else 12):
                if bits.take(1):
                    _skip_scaling_list(bits, 16 if number < 6 else 64)
    number_bits = bits.golomb() + 4
    order = bits.golomb()  # pic_order_cnt_type
    if order == 0:
        bits.golomb()
    elif order == 1:
        bits.take(1)
        bits.golomb(), bits.golomb()
        for _ in range(min(bits.golomb(), 255)):
            bits.golomb()
    bits.golomb()  # references
    may_jump = bool(bits.take(1))
    blocks, units = bits.golomb() + 1, bits.golomb() + 1  # map units are one macroblock high, or two in pairs of fields
    frames_only = bool(bits.take(1))
    return _Sps(
        name, has_planes, number_bits, may_jump, 16 * blocks, 16 * units * (1 if frames_only else 2), frames_only
    )


def _skip_scaling_list(bits: Bits, size: int) -> None:
    last = following = 8
    for _ in range(size):
        if following:
            following = (last + bits.signed_golomb()) % 256
        last = following or last
