"""The video codecs of messages: their streams are parsed as far as passing them through and seeking in them need it.

Access units and their first bytes are described in the same way for all codecs.
"""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from itertools import pairwise
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.errors import in_one_line
from mcaptrack.geometry.arrays import Image

#: Before NAL units in Annex B; the first byte may be missing.
START_CODE: Final = b"\x00\x00\x00\x01"
_SHORT_CODE: Final = START_CODE[1:]
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
        """The bits of a NAL unit, without its first byte and emulation prevention bytes."""
        return cls(nal[1:].replace(b"\x00\x00\x03", b"\x00\x00"))

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
    at = data.find(_SHORT_CODE)
    while at >= 0:
        yield at + 3
        at = data.find(_SHORT_CODE, at + 3)


class NalFormat(NamedTuple):
    """The marks of NAL units (Annex B) of a codec.

    The type is the first byte of ``header_bytes``, shifted right by ``shift`` bits, within ``mask``. ``sets`` are
    the types of parameter sets, ``pictures`` those of slices, ``random_access`` those that decoding can begin with.
    """

    shift: int
    mask: int
    header_bytes: int
    sets: frozenset[int]
    pictures: frozenset[int]
    random_access: frozenset[int]
    delimiter: int

    def kind(self, data: bytes, at: int) -> int:
        """The type of the NAL unit at an offset; -1 if it is cut off."""
        return data[at] >> self.shift & self.mask if at < len(data) else -1

    def units(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """The type and the bytes of each NAL unit; of those that are no parameter sets only the first bytes."""
        starts = [*nal_starts(data), len(data) + 3]
        for start, following in pairwise(starts):
            if start >= len(data):
                return
            kind = self.kind(data, start)
            if kind in self.sets:
                yield kind, data[start : following - 3].rstrip(b"\x00")
            else:
                yield kind, data[start : min(start + _HEAD, following - 3)]

    def read_head(self, data: bytes) -> PictureHead:
        """Parse the first bytes of a message, up to the header of its first slice."""
        kinds: set[int] = set()
        for start in nal_starts(data):
            kind = self.kind(data, start)
            if kind in self.pictures:
                return PictureHead(True, kind in self.random_access, kinds >= self.sets)
            kinds.add(kind)
        return PictureHead(False, False, kinds >= self.sets)

    def with_parameter_sets(self, data: bytes, sets: tuple[bytes, ...]) -> bytes:
        """Insert parameter sets into an access unit, after its delimiter."""
        first = next(nal_starts(data), len(data))
        at = first + self.header_bytes + 1 if self.kind(data, first) == self.delimiter else 0
        return data[:at] + b"".join(START_CODE + nal for nal in sets) + data[at:]


# H.264 (ITU-T H.264, 7.3 and Annex B).


_IDR, _SPS, _PPS = 5, 7, 8
#: Pictures are slices, also the first of several partitions, and those that decoding can begin with.
_H264: Final = NalFormat(0, 0x1F, 1, frozenset((_SPS, _PPS)), frozenset((1, 2, _IDR)), frozenset((_IDR,)), delimiter=9)
_B: Final = 1
_MOST_BITS: Final = 16  # of frame_num
#: Profiles with chroma_format_idc in their sequence parameter sets.
_HIGH: Final = (100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135)


def _inspect_h264(data: bytes) -> AccessUnit:
    """Parse an access unit in Annex B format."""
    pictures, is_key, has_b = 0, False, False
    sets: dict[bytes, int] = {}
    for kind, nal in _H264.units(data):
        if kind in _H264.sets:
            sets[nal] = kind
        elif kind in _H264.pictures:
            bits = Bits.of_nal(nal)
            pictures += bits.golomb() == 0  # first_mb_in_slice
            has_b |= bits.golomb() % 5 == _B  # slice_type
            is_key |= kind == _IDR
    return AccessUnit(pictures, is_key, tuple(sets), set(sets.values()) == _H264.sets, has_b)


def is_interlaced(sets: tuple[bytes, ...]) -> bool:
    """Whether pictures may consist of two fields."""
    return any(not _parse_sps(nal).frames_only for nal in sets if nal[0] & 0x1F == _SPS)


def largest_size(data: bytes) -> tuple[int, int]:
    """The largest picture size in the sequence parameter sets: width and height, rounded up to macroblocks."""
    parsed = [_parse_sps(nal) for kind, nal in _H264.units(data) if kind == _SPS]
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
        for kind, nal in _H264.units(data):
            bits = Bits.of_nal(nal)
            if kind == _SPS:
                sps = _parse_sps(nal)
                self._sps[sps.name] = sps
            elif kind == _PPS:
                pps = bits.golomb()
                self._sps_of[pps] = bits.golomb()
            elif kind in _H264.pictures:
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
    bits = Bits.of_nal(nal)
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


# H.265 (ITU-T H.265, 7.3 and Annex B).


#: Parameter sets are VPS, SPS and PPS.
_H265: Final = NalFormat(
    1, 0x3F, 2, frozenset((32, 33, 34)), frozenset(range(32)), frozenset(range(16, 24)), delimiter=35
)
#: Leading pictures (RASL, RADL): they follow a key picture but are shown before it, and may need earlier pictures.
_LEADING: Final = range(6, 10)


def _inspect_h265(data: bytes) -> AccessUnit:
    """Parse an access unit in Annex B format. Layers above the base layer are skipped."""
    pictures, is_key, is_leading = 0, False, False
    sets: dict[bytes, int] = {}
    for kind, nal in _H265.units(data):
        if len(nal) < 3 or nal[0] & 1 or nal[1] >> 3:
            continue
        if kind in _H265.sets:
            sets[nal] = kind
        elif kind in _H265.pictures:
            pictures += nal[2] >> 7  # first_slice_segment_in_pic_flag
            is_key |= kind in _H265.random_access
            is_leading |= kind in _LEADING
    return AccessUnit(pictures, is_key, tuple(sets), set(sets.values()) == _H265.sets, is_leading)


# VP9 (VP9 specification, 6.2 and Annex B).


_SYNC: Final = 0x498342
_RGB: Final = 7
_VP9_HEAD: Final = 16


def _inspect_vp9(data: bytes) -> AccessUnit:
    """Parse a packet: one frame, or a superframe of which one frame is shown."""
    pictures, is_key, size = 0, False, None
    for number, (start, end) in enumerate(_vp9_frames(data)):
        shown, key, declared = _vp9_header(data[start : min(end, start + _VP9_HEAD)])
        pictures += shown
        is_key |= key and number == 0
        size = declared or size
    return AccessUnit(pictures, is_key, size=size)


def _read_head_vp9(data: bytes) -> PictureHead:
    """Parse the first bytes of a message; key pictures of VP9 need no parameter sets."""
    is_key = _vp9_header(data[:_VP9_HEAD])[1]
    return PictureHead(True, is_key, is_key)


def vp9_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of a key picture of VP9; None for anything else."""
    _, is_key, size = _vp9_header(data[:_VP9_HEAD])
    return size if is_key else None


def _vp9_frames(data: bytes) -> Iterator[tuple[int, int]]:
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


def _vp9_header(head: bytes) -> tuple[bool, bool, tuple[int, int] | None]:
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


# AV1 (AV1 specification, 5.3 to 5.9).


_SEQUENCE, _TEMPORAL_DELIMITER, _FRAME_HEADER, _FRAME = 1, 2, 3, 6
_KEY_FRAME: Final = 0


class _Obu(NamedTuple):
    kind: int
    start: int
    body: int
    end: int


def obus(data: bytes) -> Iterator[_Obu]:
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


def _inspect_av1(data: bytes) -> AccessUnit:
    """Parse a temporal unit."""
    pictures, is_key, sets = 0, False, []
    for obu in obus(data):
        if obu.end > len(data):
            break
        if obu.kind == _SEQUENCE:
            sets.append(data[obu.start : obu.end])
        elif obu.kind in (_FRAME_HEADER, _FRAME) and obu.body < len(data):
            is_shown, key = _av1_header(data[obu.body])
            is_key |= key and not pictures
            pictures += is_shown
    return AccessUnit(pictures, is_key, tuple(sets), bool(sets))


def _read_head_av1(data: bytes) -> PictureHead:
    """Parse the first bytes of a message; only key frames that are shown count as key pictures."""
    has_sequence = False
    for obu in obus(data):
        has_sequence |= obu.kind == _SEQUENCE
        if obu.kind in (_FRAME_HEADER, _FRAME) and obu.body < len(data):
            return PictureHead(True, _av1_header(data[obu.body])[1], has_sequence)
    return PictureHead(False, False, has_sequence)


def _with_sequence_headers(data: bytes, sets: tuple[bytes, ...]) -> bytes:
    """Insert sequence headers into a temporal unit, after its delimiter."""
    first = next(obus(data), None)
    at = first.end if first and first.kind == _TEMPORAL_DELIMITER else 0
    return data[:at] + b"".join(sets) + data[at:]


def sequence_headers(configuration: bytes) -> tuple[bytes, ...]:
    """The sequence headers in the configuration record of a container (AV1 in ISO BMFF, 2.3)."""
    body = configuration[4:]
    return tuple(body[obu.start : obu.end] for obu in obus(body) if obu.kind == _SEQUENCE)


def _av1_header(byte: int) -> tuple[bool, bool]:
    """From an uncompressed header: whether a frame is shown, and whether it is a key frame."""
    if byte >> 7:
        return True, False  # show_existing_frame
    is_shown = bool(byte >> 4 & 1)
    return is_shown, is_shown and byte >> 5 & 3 == _KEY_FRAME


class Codec(NamedTuple):
    """The functions for the bytes of a codec. ``name`` and ``decoder`` are FFmpeg's names of it and of its decoder.

    ``annex_b`` is FFmpeg's bitstream filter from packets of a container to messages, "" where they are the same.
    ``read_head`` reads only the first bytes of a message.
    """

    name: str
    decoder: str
    annex_b: str
    inspect: Callable[[bytes], AccessUnit]
    read_head: Callable[[bytes], PictureHead]
    with_parameter_sets: Callable[[bytes, tuple[bytes, ...]], bytes]


#: By the format name in messages.
CODECS: Final[Mapping[str, Codec]] = {
    "h264": Codec("h264", "h264", "h264_mp4toannexb", _inspect_h264, _H264.read_head, _H264.with_parameter_sets),
    "h265": Codec("hevc", "hevc", "hevc_mp4toannexb", _inspect_h265, _H265.read_head, _H265.with_parameter_sets),
    "vp9": Codec("vp9", "vp9", "", _inspect_vp9, _read_head_vp9, lambda data, _: data),
    "av1": Codec("av1", "libdav1d", "", _inspect_av1, _read_head_av1, _with_sequence_headers),
}


def read_head(image_format: str, data: bytes) -> PictureHead:
    """Parse the first bytes of a message; decoding can begin at every still image."""
    codec = CODECS.get(image_format)
    return codec.read_head(data) if codec else PictureHead(True, True, True)


def is_video_codec(image_format: str) -> bool:
    """Whether pictures of this format may depend on earlier pictures."""
    return image_format in CODECS


# A tiny picture is decoded and encoded by each codec, to see whether the FFmpeg that is installed can.


_SIZE_PX: Final = 64
#: Mean error of the brightness: that of video may run from 16 to 235, and compression changes it.
_MAX_ERROR: Final = 40.0
#: One picture of each codec, as `_picture` draws it: 64 x 64 px. The encoder, which is tested too, makes that of H.264.
_ENCODED: Final[Mapping[str, str]] = MappingProxyType(
    {
        "h265": "AAAAAUABDAH//wFgAAADAJAAAAMAAAMAHpWYCQAAAAFCAQEBYAAAAwCQAAADAAADAB6gIIEFllZpJMrmgIAAAAMAgAAADIQAAAAB"
        "RAHBcrQiQAAAASgBrx2A9wFb//JQqqg+DEnqcw==",
        "vp9": "gkmDQgAD8AP2ADgkHBhKAAAwYAAAZz///1ZFYwh//suGE7oA",
        "av1": "EgAKCgAAAAKv/41fMAgyGhAAugIIIEEBAAAItGZwzAUquVjPd3bb8FfH",
    }
)


def codec_faults() -> dict[str, str]:
    """Return why pictures can't be decoded, or encoded as H.264, by codec; "" where they can.

    The keys are those of ``CODECS`` and "h264 encoder".
    """
    faults = {}
    data, faults["h264 encoder"] = _encoded()
    for name in CODECS:
        data_of = data if name == "h264" else b64decode(_ENCODED[name])
        faults[name] = _decoding_fault(name, data_of) if data_of else "there is no picture to decode"
    return faults


def _picture() -> Image:
    """Draw a picture: its left half is black, its right half white."""
    image = np.zeros((_SIZE_PX, _SIZE_PX, 3), np.uint8)
    image[:, _SIZE_PX // 2 :] = 255
    return image


def _encoded() -> tuple[bytes, str]:
    """Return the picture as H.264, and why it can't be encoded."""
    from mcaptrack.sources.video.encode import H264Encoder

    try:
        return H264Encoder(_SIZE_PX, _SIZE_PX, Fraction(25)).encode(_picture(), 0), ""
    except Exception as error:  # whatever an incomplete FFmpeg raises
        return b"", in_one_line(error)


def _decoding_fault(name: str, data: bytes) -> str:
    """Return why a picture can't be decoded, or that it differs from the encoded one; "" otherwise."""
    from mcaptrack.sources.video.decode import EncodedPicture, decode_gray

    try:
        pictures = [frame.rows for frame in decode_gray([EncodedPicture(0, 0, name, data)])]
    except Exception as error:  # as above
        return in_one_line(error)
    wanted = _picture()[:, :, 0]
    if len(pictures) != 1 or pictures[0].shape != wanted.shape:
        return f"one picture became {len(pictures)}" if len(pictures) != 1 else "the picture has another size"
    error_mean = np.abs(pictures[0].astype(float) - wanted).mean()
    return "" if error_mean < _MAX_ERROR else f"the picture looks different (by {error_mean:.0f} of 255 on average)"
