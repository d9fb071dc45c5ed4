"""Pass video streams through without transcoding: packets of a container become messages with the same pictures.

Viewers require: one picture in each message, display order equal to decoding order, upright, progressive, 8-bit 4:2:0,
one size; key pictures that can be decoded independently, with their parameter sets, at short intervals.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Ints
from mcaptrack.sources.video.codecs import CODECS, FrameNumber, FrameNumbers, is_interlaced, sequence_headers
from mcaptrack.sources.video.container import fraction, has_slots, is_transport, reading
from mcaptrack.sources.video.encode import VideoOptions
from mcaptrack.sources.video.recognise import WORDS

_PIXELS: Final = ("yuv420p", "yuvj420p")
_DAMAGED: Final = "some of its packets are damaged"
_ONLY_SOME: Final = "it is H.265, which viewers play only where the hardware does (`image_format='h265'` keeps it)"


class StreamPacket(NamedTuple):
    """A packet as a message: its time in seconds, if it has one, and its flags in the container."""

    seconds: Fraction | None
    data: bytes
    is_key: bool
    is_hidden: bool
    is_damaged: bool
    changes_sets: bool


@dataclass
class StreamCheck:
    """The result of checking all packets of a stream.

    ``format`` is the format name in messages, "" if they have none. ``why_not`` says why the stream can't be passed
    through, "" if it can; then ``sets`` are the parameter sets to insert before key pictures that lack them. Before the
    pictures ``missing`` there were others.
    """

    format: str
    why_not: str
    sets: tuple[bytes, ...] = ()
    missing: tuple[int, ...] = ()


def packets(opened: Any, index: int, image_format: str) -> Iterator[StreamPacket]:
    """The packets of a stream as messages, up to the first one that can't be read."""
    import av
    from av.bitstream import BitStreamFilterContext

    stream = opened.streams[index]
    name = CODECS[image_format].annex_b
    to_annex_b = BitStreamFilterContext(name, stream) if name else None
    base = fraction(stream.time_base) or Fraction(1)
    slots, demuxed = has_slots(opened), opened.demux(stream)
    while True:
        try:
            packet = next(demuxed, None)
        except av.error.FFmpegError:  # FFmpeg can't read on
            yield StreamPacket(None, b"", False, False, True, False)
            return
        if packet is None:
            return
        if packet.size == 0:
            continue
        ticks = packet.dts if slots else packet.pts
        seconds = None if ticks is None else ticks * base
        flags = (packet.is_keyframe, packet.is_discard, packet.is_corrupt, packet.has_sidedata("new_extradata"))
        try:
            units = to_annex_b.filter(packet) if to_annex_b else [packet]  # moves the data out of the packet
        except av.error.FFmpegError:
            units, flags = [], (*flags[:2], True, flags[3])
        yield StreamPacket(seconds, b"".join(bytes(unit) for unit in units), *flags)


# Find damage in streams without decoding them: by zeros where a NAL unit can't have any, by jumps in the numbers of
# pictures (H.264), and by packets that are missing in a transport stream.
#
# Other damage shows only when pictures are decoded.


#: This many zero bytes are a hole in the file, not padding between NAL units.
_HOLE: Final = bytes(64)
_START: Final = b"\x01"
#: Encoders that pad pictures with zeros do so in more than this share of them; those that don't count pictures as the
#: standard wants have more jumps than this share.
_PADDED, _UNCOUNTED = 0.1, 0.25
#: Transport streams: the bytes of a packet and its first byte; formats have 0, 4 (M2TS) or 16 (checksums) bytes more.
_PACKET, _SYNC, _EXTRA = 188, 0x47, (0, 4, 16)
_BLOCK: Final = 1 << 22
_SURE: Final = 4


class Holes:
    """Counts pictures of H.264 or H.265 (Annex B) in which a part was replaced by zeros, as file systems and broken
    transfers leave them.

    Within NAL units there are no three zero bytes in a row (ITU-T H.264, 7.4.1), and between them only before a start
    code. Zeros at the end of a picture may be padding, if many have them.
    """

    def __init__(self) -> None:
        self._pictures, self._within, self._at_end = 0, 0, 0

    def add(self, data: bytes) -> None:
        """Look at one picture."""
        self._pictures += 1
        at, is_hole = data.find(_HOLE), False
        if at < 0:
            return
        while at >= 0:
            rest = data[at:].lstrip(b"\x00")
            is_hole |= bool(rest) and not rest.startswith(_START)
            at = data.find(_HOLE, len(data) - len(rest)) if rest else -1
        self._within += is_hole
        self._at_end += not is_hole and data.endswith(_HOLE)

    @property
    def count(self) -> int:
        """The number of damaged pictures."""
        return self._within + (self._at_end if self._at_end <= _PADDED * self._pictures else 0)


class MissingPictures:
    """Counts pictures of H.264 that are missing, by the numbers in their slices (7.4.3)."""

    def __init__(self) -> None:
        self._numbers = FrameNumbers()
        self._before: FrameNumber | None = None
        self._pictures = 0
        self._places: list[int] = []

    def add(self, index: int, data: bytes) -> None:
        """Look at picture ``index``."""
        number = self._numbers.of(data)
        self._pictures += 1
        if number is None:
            self._before = None
            return
        before = self._before
        # After a reset of the numbers by the encoder (memory management control operation 5) they go on from 0.
        is_counted = not (number.is_idr or number.may_jump) and number.value > 1
        if before and is_counted and (number.value - before.value) % number.modulus > 1:
            self._places.append(index)
        if number.is_reference or before is None:
            self._before = number

    @property
    def places(self) -> list[int]:
        """The pictures before which others are missing; none if the encoder doesn't count as the standard wants."""
        return self._places if len(self._places) <= _UNCOUNTED * self._pictures else []


def transport_faults(path: Path, pid: int) -> int:
    """The number of places in a transport stream (ISO 13818-1, 2.4.3) where packets of a stream are missing or
    damaged: jumps of their counter, and bytes between packets that belong to none.
    """
    faults, last = 0, -1
    for packets, is_after_gap in _transport_packets(path):
        faults += is_after_gap
        head = packets[:, :6].astype(np.int64)
        mine = ((head[:, 1] & 0x1F) << 8 | head[:, 2]) == pid
        faults += int((mine & (head[:, 1] & 0x80 > 0)).sum())  # transport_error_indicator
        mine &= head[:, 3] & 0x10 > 0  # has a payload
        counters: Ints = head[mine, 3] & 0x0F
        is_restart: Bools = (head[mine, 3] & 0x20 > 0) & (head[mine, 4] > 0) & (head[mine, 5] & 0x80 > 0)
        before = np.concatenate([[last], counters[:-1]])[: len(counters)]
        step = (counters - before) % 16
        jumps = (step > 1) & ~is_restart & (before >= 0)  # a packet may come twice
        faults += int(jumps.sum()) if not is_after_gap else int(jumps[1:].sum())
        last = int(counters[-1]) if len(counters) else last
    return faults


def _transport_packets(path: Path) -> Iterator[tuple[np.ndarray, bool]]:
    """The packets of a transport stream (N, 188), in blocks, and whether other bytes stand before a block."""
    with path.open("rb") as file:
        data, at = np.frombuffer(file.read(_BLOCK), np.uint8), 0
        size = next((_PACKET + more for more in _EXTRA if _in_step(data, _PACKET + more) is not None), 0)
        if not size:
            return
        at = _in_step(data, size) or 0
        is_after_gap = False
        while True:
            count = (len(data) - at) // size
            rows = data[at : at + count * size].reshape(count, size)
            wrong = np.flatnonzero(rows[:, 0] != _SYNC)
            good = int(wrong[0]) if len(wrong) else count
            if good:
                yield rows[:good, :_PACKET], is_after_gap
                is_after_gap = False
            at += good * size
            if good < count:
                step = _in_step(data[at:], size)
                is_after_gap = True
                if step is not None:
                    at += step
                    continue
                at = max(at, len(data) - _SURE * size)
            more = np.frombuffer(file.read(_BLOCK), np.uint8)
            if not len(more):
                return
            data, at = np.concatenate([data[at:], more]), 0


def _in_step(data: np.ndarray, size: int) -> int | None:
    """The first offset from which on packets of ``size`` bytes follow one another; None if there is none."""
    starts = np.flatnonzero(data[: max(0, len(data) - (_SURE - 1) * size)] == _SYNC)
    for number in range(1, _SURE):
        starts = starts[data[starts + number * size] == _SYNC]
    return int(starts[0]) if len(starts) else None


def check_stream(path: Path, index: int, options: VideoOptions) -> StreamCheck:
    """Check in one pass over its packets whether a video stream of a file can be passed through."""
    with reading(path) as opened:
        stream = opened.streams[index]
        context = stream.codec_context
        name = context.codec.canonical_name
        image_format = next((key for key, codec in CODECS.items() if codec.name == name), "")
        why_not = _rejected_by_codec(image_format, name, options, context)
        if why_not:
            return StreamCheck(image_format, why_not)
        # Sequence headers may stand outside of packets; for H.264 and H.265 the filter inserts them.
        sets = sequence_headers(bytes(context.extradata or b"")) if image_format == "av1" else ()
        stream_check = StreamCheck(image_format, "", sets)
        stream_check.why_not = _check_packets(
            packets(opened, index, image_format), stream_check, options.fps, Fraction(options.key_within_s)
        )
        if not stream_check.why_not and is_transport(opened) and transport_faults(path, stream.id):
            stream_check.why_not = _DAMAGED
        if image_format == "h265" and options.image_format != "h265" and not stream_check.why_not:
            stream_check.why_not = _ONLY_SOME
        return stream_check


def _rejected_by_codec(image_format: str, name: str, options: VideoOptions, context: Any) -> str:
    """Why a stream can't be passed through, judged by codec and options alone; "" if they allow it."""
    if not image_format:
        return f"it is {name}, which viewers don't play"
    if options.image_format == "h264" and image_format != "h264":
        return f"it is {WORDS[image_format]}, not H.264"
    if options.quality is not None:
        return "a quality was asked for"
    if context.pix_fmt not in _PIXELS:
        return f"its pixels are {context.pix_fmt}, not 8-bit 4:2:0"
    return "it has B-frames" if context.has_b_frames else ""


def _check_packets(
    coming: Iterator[StreamPacket], stream: StreamCheck, fps: Fraction | None, within_s: Fraction
) -> str:
    """Why these packets can't be passed through, "" if they can; records the parameter sets to insert."""
    inspect = CODECS[stream.format].inspect
    sets: tuple[bytes, ...] = stream.sets
    size: tuple[int, int] | None = None
    last: Fraction | None = None
    key_at = Fraction(0)
    all_have_sets, cut_off = True, False
    holes, numbers = Holes(), MissingPictures()
    for count, packet in enumerate(coming):
        if cut_off:
            return _DAMAGED
        if packet.is_damaged:
            cut_off = True  # the last packet can be left out; others are needed by those that follow
            continue
        if packet.is_hidden:
            return "an edit list hides some of its frames"
        if packet.changes_sets and count:
            return "it changes its parameters on the way"
        seconds = Fraction(count) / fps if fps else packet.seconds
        if seconds is None:
            return "some of its frames have no time"
        if last is not None and (seconds <= last):
            return "its frames are not in the order of their times"
        last = seconds
        if CODECS[stream.format].annex_b:
            holes.add(packet.data)
        if stream.format == "h264":
            numbers.add(count, packet.data)
        unit = inspect(packet.data)
        if unit.reorders:
            return "it has B-frames"
        if unit.pictures != 1:
            return "its packets are not one picture each"
        if count == 0 and not (unit.is_key and (unit.has_parameter_sets or sets)):
            return "it does not begin with a key frame"
        if packet.is_key and not unit.is_key:
            return "not every key frame can be decoded on its own (open groups of pictures)"
        if unit.is_key:
            key_at = seconds
            all_have_sets &= unit.has_parameter_sets
        elif seconds - key_at > within_s:
            return f"its key frames are more than {float(within_s):g} s apart"
        if count == 0:  # the stream itself decides; the container may say something else
            sets = unit.sets or sets
        if not set(unit.sets) <= set(sets) or (size and unit.size and size != unit.size):
            return "it changes its size or its parameters on the way"
        size = size or unit.size
        if count == 0 and stream.format == "h264" and is_interlaced(sets):
            return "it is interlaced"
    if holes.count:
        return _DAMAGED
    stream.sets, stream.missing = () if all_have_sets else sets, tuple(numbers.places)
    return ""
