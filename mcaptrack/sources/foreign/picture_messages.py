"""Pictures in messages of other software: what they are, whatever messages call them.

A message has two times: the log time, which orders everything, and the stamp of its publisher, by which viewers match
drawings to a picture. What all pictures of a channel share is found once: the codec, by their bytes; the values that
become black and white where samples have more than 8 bits; whether they are depths.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from mcaptrack import foxglove, log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Ints
from mcaptrack.schema.names import plain_name
from mcaptrack.sources.foreign.decoding import decoder_with_errors, integer, stamp_of, text, to_bytes
from mcaptrack.sources.foreign.definitions import MessageType
from mcaptrack.sources.foreign.flatten import frame_of, payload_decoder

if TYPE_CHECKING:
    from mcaptrack.sources.video import EncodedPicture, PixelLayout, Recogniser, Samples, Span

_PACKET: Final = "ffmpeg_image_transport_msgs/FFMPEGPacket"
_VIDEO: Final = (foxglove.VIDEO, _PACKET)
_COMPRESSED: Final = (*_VIDEO, foxglove.IMAGE, "sensor_msgs/CompressedImage")
_RAW: Final = ("foxglove.RawImage", "sensor_msgs/Image")
#: Schemas of pictures, by their names in ROS 1 and Foxglove; ROS 2 adds "/msg/".
PICTURES_READ: Final = (*_COMPRESSED, *_RAW)
#: Schemas of pictures that are not read, and what they hold.
PICTURES_NOT_READ: Final = {
    "theora_image_transport/Packet": "Theora video",
    "stereo_msgs/DisparityImage": "disparities",
}
#: Codecs by the words that stand for them in the names of formats, encoders and decoders.
_CODECS: Final = {"h264": r"[hx]\.?264|avc", "h265": r"[hx]\.?265|hevc|hvc1|hev1", "vp9": r"vp0?9", "av1": r"av0?1"}
_STILLS: Final = ("jpeg", "jpg", "png", "webp", "tiff", "bmp", "avif")
#: What image_transport of ROS adds to the topic of pictures for another form of them, the best one first, after none.
_TRANSPORTS: Final = ("", "compressed", "avif", "ffmpeg", "zstd", "theora", "compressedDepth")
#: Names of pictures of one camera, as drivers and image_proc of ROS write them, the one to take first.
_VARIANTS: Final = (
    "image_raw",
    "image",
    "image_color",
    "image_rect_color",
    "image_rect",
    "image_rect_raw",
    "image_mono",
)
#: Names of topics and frames of depth cameras.
_DEPTH: Final = re.compile(r"depth|disparity", re.IGNORECASE)
#: How PNG begins; the bytes before it in messages of compressed_depth_image_transport, and before the data in those of
#: zstd_image_transport; at most so many bytes a pixel come out of these.
_PNG: Final = b"\x89PNG"
_DEPTH_HEAD, _ZSTD_HEAD, _BYTES_A_PIXEL = 12, 17, 8
#: Messages that are searched for the beginning of a video.
_SEARCHED: Final = 300


class Picture(NamedTuple):
    """A recorded picture: ``format`` is "h264", "jpeg" and so on, or with a ``layout`` a pixel format.

    ``stamp_ns`` is the stamp in the message, in nanoseconds since 1970. ``pixels`` is the pixel format of what a still
    image holds, "" for usual ones, and ``span`` has the values that become black and white. ``is_depth``: the message
    says that values are distances. ``error`` is why a message can't be read, which then has nothing else.
    """

    stamp_ns: int
    format: str
    data: bytes
    layout: PixelLayout | None = None
    pixels: str = ""
    span: Span | None = None
    is_depth: bool = False
    error: str = ""

    def encoded(self, t_ns: int, number: int, where: str) -> EncodedPicture:
        """The picture for decoders: with its time, its number and its place for errors."""
        from mcaptrack.sources.video import EncodedPicture

        return EncodedPicture(
            t_ns, number, self.format, self.data, self.layout, where, self.span, self.pixels, self.error
        )


def holds_pictures(channel: log.Channel) -> bool:
    """Whether a channel's messages are pictures, by the name of their schema."""
    return is_picture(channel.schema_name)


def is_picture(schema_name: str) -> bool:
    """Whether messages of this schema are pictures."""
    return plain_name(schema_name) in PICTURES_READ


def is_compressed(schema_name: str) -> bool:
    """Whether messages of this schema are compressed pictures."""
    return plain_name(schema_name) in _COMPRESSED


# Topics


def best_form(topics: Sequence[str]) -> str | None:
    """The topic to take of those that show the same pictures in several forms; None if they show different ones."""
    keys = {_form(topic)[0] for topic in topics}
    return min(topics, key=_form) if len(keys) == 1 and ("" not in keys or len(topics) == 1) else None


def better_form(opened: log.Log, topic: str) -> str:
    """The topic of the same pictures that is taken instead of this one; "" if there is none."""
    others = [channel.topic for channel in opened.channels.values() if holds_pictures(channel) and channel.messages]
    own = _form(topic)
    return min((other for other in others if own[0] and own[0] == _form(other)[0] and _form(other) < own), default="")


def _form(topic: str) -> tuple[str, int, int]:
    """The name that all forms of the same pictures have, "" if there can be none; and the rank of this form."""
    base, _, last = topic.rpartition("/")
    transport = last if last in _TRANSPORTS else ""
    above, _, name = (base if transport else topic).rpartition("/")
    if name in _VARIANTS:
        return f"{above}/", _VARIANTS.index(name), _TRANSPORTS.index(transport)
    return (base if transport else topic), 0, _TRANSPORTS.index(transport)


# Channels


@dataclass
class SharedFacts:
    """The facts that all pictures of a channel share: their codec, and the values that become black and white.

    ``depth`` is the format of depths, "" for pictures. ``notes`` are to be said.
    """

    recogniser: Recogniser
    span: Span | None = None
    depth: str = ""
    notes: list[str] = field(default_factory=list)


def depth_of(opened: log.Log, topic: str) -> str:
    """The format of the depths in a channel, "" for pictures, and for messages that can't be read."""
    try:
        return facts_of(opened, topic).depth
    except McaptrackError:
        return ""


def pictures(opened: log.Log, topic: str) -> Iterator[tuple[log.Message, Picture]]:
    """The messages of a channel with their pictures. Raises McaptrackError if their type is not supported."""
    read = picture_reader(opened, topic)
    return ((message, read(message)) for message in opened.timed(topic))


def picture_reader(opened: log.Log, topic: str) -> Callable[[log.Message], Picture]:
    """A function that decodes messages of a channel to pictures; it raises errors as ``pictures`` does."""
    return _reader(opened, topic, facts_of(opened, topic))


def _reader(opened: log.Log, topic: str, facts: SharedFacts) -> Callable[[log.Message], Picture]:
    decode = payload_decoder(opened, topic, lambda kind: picture_decoder(kind, facts))

    def read(message: log.Message) -> Picture:
        try:
            return decode(message.payload)
        except McaptrackError as error:
            return Picture(message.t_ns, "", b"", error=str(error))

    return read


@log.kept
def stamps(opened: log.Log, topic: str) -> Ints:
    """The stamps of a channel's pictures in log time order, (M,) ns; they are kept as long as the log is open."""
    return np.array([picture.stamp_ns for _, picture in pictures(opened, topic)], np.int64)


@log.kept
def facts_of(opened: log.Log, topic: str) -> SharedFacts:
    """The facts that all pictures of a channel share; they are kept as long as the log is open.

    Raises McaptrackError if messages of this type are not supported.
    """
    from mcaptrack.sources.video import Recogniser, measured_span

    facts = SharedFacts(Recogniser())
    read = _reader(opened, topic, facts)
    first: Picture | None = None
    for message in islice(opened.messages(topic), _SEARCHED):
        picture = read(message)
        if picture.error:
            continue  # decoding says so
        first = first or picture
        if facts.recogniser.is_settled or picture.layout:
            break
    facts.notes += [f"{topic}: pictures: {note}" for note in facts.recogniser.notes]
    if first is None:
        return facts
    parts = _sampled(opened, topic, read)
    may_be_depth = bool(parts) and parts[0].shape[2] == 1
    name = (first.format if first.layout else first.pixels or "16uc1").upper()
    if first.is_depth or (may_be_depth and any(map(_DEPTH.search, (topic, frame_of(opened, topic))))):
        facts.depth = name
    if parts and (span := measured_span(parts)) is not None:
        facts.span = span
        of = "distances" if facts.depth else "values"
        low, high = (f"{value:.4g}" for value in span)
        facts.notes.append(f"{topic}: {of} from {low} to {high}, as measured in it, are shown as black to white")
    return facts


# The range of values


def _sampled(opened: log.Log, topic: str, read: Callable[[log.Message], Picture]) -> list[Samples]:
    """The samples (H, W, N) of pictures all over a channel, if they have more than 8 bits; else none."""
    from mcaptrack.sources.video import measured, wide_samples

    times, parts = opened.times(topic), list[Any]()
    for t_ns in dict.fromkeys(times[measured(len(times))].tolist()):
        message = next(opened.messages(topic, t_ns, t_ns + 1))
        try:
            samples = wide_samples(read(message).encoded(t_ns, 0, ""))
        except McaptrackError:
            continue
        if samples is None:
            break
        parts.append(samples)
    return parts


# Messages


def picture_decoder(kind: MessageType, facts: SharedFacts | None = None) -> Callable[[bytes], Picture]:
    """A function that decodes payloads of a channel, in order, to pictures, by the ``facts`` of the channel.

    Raises McaptrackError if messages of this type are not supported; the returned function raises McaptrackError for
    malformed payloads.
    """
    from mcaptrack.sources.video import Recogniser

    shared = facts or SharedFacts(Recogniser())
    name = plain_name(kind.name)
    if name in _COMPRESSED:
        return decoder_with_errors(kind, lambda message: _compressed(message, shared, name in _VIDEO))
    if name in _RAW:
        return decoder_with_errors(kind, lambda message: _raw(message)._replace(span=shared.span))
    raise McaptrackError(f"it holds {kind.name or 'no schema'}, not pictures; {', '.join(PICTURES_READ)} are read")


def _compressed(message: Any, facts: SharedFacts, is_video: bool) -> Picture:
    from mcaptrack.sources.video import is_mosaic

    data, stamp_ns = to_bytes(message.data), stamp_of(message)
    if not data:
        raise ValueError("it holds no data")
    called = text(message.encoding if hasattr(message, "encoding") else message.format).lower()
    name, is_depth = _format(called), "compresseddepth" in called
    if name == "zstd":
        return _unpacked(data, stamp_ns)._replace(span=facts.span)
    if is_depth:
        data = data if data.startswith(_PNG) else data[_DEPTH_HEAD:]
        if not data.startswith(_PNG):
            raise ValueError(f"depth in the format {called[:40]!r} is not read")
    format_name, data = facts.recogniser.take(name, data, is_video)
    pixels = called.partition(";")[0].strip() if ";" in called else ""
    pixels = pixels if is_mosaic(pixels) else ""
    return Picture(stamp_ns, format_name, data, None, pixels, facts.span, is_depth)


def _format(called: str) -> str:
    """The codec in the name of a format: "rgb8; jpeg compressed bgr8" -> "jpeg", "libx264;yuv420p" -> "h264"."""
    for name, pattern in _CODECS.items():
        if re.search(pattern, called):
            return name
    tokens = re.findall(r"[a-z0-9]+", called)
    return next((word for word in (*_STILLS, "zstd") if word in tokens), called[:40])


def _unpacked(data: bytes, stamp_ns: int) -> Picture:
    """The uncompressed picture in a message of zstd_image_transport: its size and encoding, then its data."""
    import zstandard

    from mcaptrack.sources.video import PixelLayout
    from mcaptrack.sources.video.limits import max_pixels

    height, width, step, count = (int.from_bytes(data[at : at + 4], "little") for at in (0, 4, 9, 13))
    encoding, packed = data[_ZSTD_HEAD : _ZSTD_HEAD + count].decode("ascii").lower(), data[_ZSTD_HEAD + count :]
    most = min(3 * height * step, _BYTES_A_PIXEL * max_pixels())  # three planes at most
    try:
        if packed.startswith(zstandard.FRAME_HEADER):
            pixels = zstandard.ZstdDecompressor(max_window_size=2**27).stream_reader(packed).read(most)
        else:
            pixels = zlib.decompressobj().decompress(packed, most)
    except (zlib.error, zstandard.ZstdError) as error:
        raise ValueError(f"its data can't be decompressed: {error}") from None
    return Picture(stamp_ns, encoding, pixels, PixelLayout(width, height, step, bool(data[8])))


def _raw(message: Any) -> Picture:
    from mcaptrack.sources.video import PixelLayout

    is_bigendian = bool(getattr(message, "is_bigendian", False))  # foxglove.RawImage is always little-endian
    layout = PixelLayout(integer(message.width), integer(message.height), integer(message.step), is_bigendian)
    return Picture(stamp_of(message), text(message.encoding).lower(), to_bytes(message.data), layout)
