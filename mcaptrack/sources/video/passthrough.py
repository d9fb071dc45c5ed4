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

from mcaptrack.sources.video import av1, h264
from mcaptrack.sources.video.codecs import CODECS
from mcaptrack.sources.video.container import fraction, has_slots, is_transport, reading, videos
from mcaptrack.sources.video.damage import Holes, MissingPictures, transport_faults
from mcaptrack.sources.video.encode import VideoOptions

_PIXELS: Final = ("yuv420p", "yuvj420p")
_WORDS: Final = {"h264": "H.264", "h265": "H.265", "vp9": "VP9", "av1": "AV1"}
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


def packets(opened: Any, image_format: str) -> Iterator[StreamPacket]:
    """The packets of the first video stream as messages, up to the first one that can't be read."""
    import av
    from av.bitstream import BitStreamFilterContext

    stream = videos(opened)[0]
    name = CODECS[image_format].annex_b
    to_annex_b = BitStreamFilterContext(name, stream) if name else None
    base = fraction(stream.time_base) or Fraction(1)
    slots, found = has_slots(opened), opened.demux(stream)
    while True:
        try:
            packet = next(found, None)
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


def check_stream(path: Path, options: VideoOptions) -> StreamCheck:
    """Check in one pass over its packets whether the first video stream of a file can be passed through."""
    with reading(path) as opened:
        stream = videos(opened)[0]
        context = stream.codec_context
        name = context.codec.canonical_name
        image_format = next((key for key, codec in CODECS.items() if codec.name == name), "")
        why_not = _rejected_by_codec(image_format, name, options, context)
        if why_not:
            return StreamCheck(image_format, why_not)
        found = StreamCheck(image_format, "", _container_sets(image_format, context))
        found.why_not = _check_packets(
            packets(opened, image_format), found, options.fps, Fraction(options.key_within_s)
        )
        if not found.why_not and is_transport(opened) and transport_faults(path, stream.id):
            found.why_not = _DAMAGED
        if image_format == "h265" and options.image_format != "h265" and not found.why_not:
            found.why_not = _ONLY_SOME
        return found


def _rejected_by_codec(image_format: str, name: str, options: VideoOptions, context: Any) -> str:
    """Why a stream can't be passed through, judged by codec and options alone; "" if they allow it."""
    if not image_format:
        return f"it is {name}, which viewers don't play"
    if options.image_format == "h264" and image_format != "h264":
        return f"it is {_WORDS[image_format]}, not H.264"
    if options.quality is not None:
        return "a quality was asked for"
    if context.pix_fmt not in _PIXELS:
        return f"its pixels are {context.pix_fmt}, not 8-bit 4:2:0"
    return "it has B-frames" if context.has_b_frames else ""


def _container_sets(image_format: str, context: Any) -> tuple[bytes, ...]:
    """Sequence headers that the container stores outside of packets; for H.264 and H.265 the filter inserts them."""
    return av1.sequence_headers(bytes(context.extradata or b"")) if image_format == "av1" else ()


def _check_packets(found: Iterator[StreamPacket], stream: StreamCheck, fps: Fraction | None, within_s: Fraction) -> str:
    """Why these packets can't be passed through, "" if they can; records the parameter sets to insert."""
    inspect = CODECS[stream.format].inspect
    known: tuple[bytes, ...] = stream.sets
    size: tuple[int, int] | None = None
    last: Fraction | None = None
    key_at = Fraction(0)
    all_have_sets, cut_off = True, False
    holes, numbers = Holes(), MissingPictures()
    for count, packet in enumerate(found):
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
        if count == 0 and not (unit.is_key and (unit.has_parameter_sets or known)):
            return "it does not begin with a key frame"
        if packet.is_key and not unit.is_key:
            return "not every key frame can be decoded on its own (open groups of pictures)"
        if unit.is_key:
            key_at = seconds
            all_have_sets &= unit.has_parameter_sets
        elif seconds - key_at > within_s:
            return f"its key frames are more than {float(within_s):g} s apart"
        if count == 0:  # the stream itself decides; the container may say something else
            known = unit.sets or known
        if not set(unit.sets) <= set(known) or (size and unit.size and size != unit.size):
            return "it changes its size or its parameters on the way"
        size = size or unit.size
        if count == 0 and stream.format == "h264" and h264.is_interlaced(known):
            return "it is interlaced"
    if holes.count:
        return _DAMAGED
    stream.sets, stream.missing = () if all_have_sets else known, tuple(numbers.places)
    return ""
