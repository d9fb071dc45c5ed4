"""Adapters for messages of other software: pictures for detectors, and boxes of other detectors.

A message has two times: the log time, which orders everything, and the stamp of its publisher, by which viewers match
drawings to a picture.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from mcaptrack import foxglove, log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Ints
from mcaptrack.sources.foreign.boxes import BOXES_READ as BOXES_READ
from mcaptrack.sources.foreign.boxes import NamedFrames as NamedFrames
from mcaptrack.sources.foreign.boxes import boxes_decoder as boxes_decoder
from mcaptrack.sources.foreign.boxes import decoded_messages, message_reader
from mcaptrack.sources.foreign.boxes import holds_boxes as holds_boxes
from mcaptrack.sources.foreign.boxes import reading_of as reading_of
from mcaptrack.sources.foreign.boxes import uncertain_boxes as uncertain_boxes
from mcaptrack.sources.foreign.decoding import MessageType as MessageType
from mcaptrack.sources.foreign.decoding import decoder_with_errors, integer, plain_name, stamp_of, text, to_bytes

if TYPE_CHECKING:
    from mcaptrack.sources.video import EncodedPicture, PixelLayout

_COMPRESSED: Final = (foxglove.VIDEO, foxglove.IMAGE, "sensor_msgs/CompressedImage")
_RAW: Final = ("foxglove.RawImage", "sensor_msgs/Image")
#: Schemas of pictures, by their names in ROS 1 and Foxglove; ROS 2 adds "/msg/".
PICTURES_READ: Final = (*_COMPRESSED, *_RAW)
#: Words for video codecs in the format of a compressed picture; other formats are still images.
_VIDEO_WORDS: Final = {"h264": "h264", "avc": "h264", "h265": "h265", "hevc": "h265", "vp9": "vp9", "av1": "av1"}


#: The stamps of pictures of open logs, by topic.
_STAMPS: Final[WeakKeyDictionary[log.Log, dict[str, Ints]]] = WeakKeyDictionary()


class Picture(NamedTuple):
    """A recorded picture: ``format`` is "h264", "jpeg" and so on, or with a ``layout`` a pixel format.

    ``stamp_ns`` is the stamp in the message, in nanoseconds since 1970.
    """

    stamp_ns: int
    format: str
    data: bytes
    layout: PixelLayout | None = None

    def encoded(self, t_ns: int, number: int, where: str) -> EncodedPicture:
        """The picture for decoders: with its time, its number and its place for errors."""
        from mcaptrack.sources.video import EncodedPicture

        return EncodedPicture(t_ns, number, self.format, self.data, self.layout, where)


def holds_pictures(channel: log.Channel) -> bool:
    """Whether a channel's messages are pictures, by the name of their schema."""
    return is_picture(channel.schema_name)


def is_picture(schema_name: str) -> bool:
    """Whether messages of this schema are pictures."""
    return plain_name(schema_name) in PICTURES_READ


def is_compressed(schema_name: str) -> bool:
    """Whether messages of this schema are compressed pictures."""
    return plain_name(schema_name) in _COMPRESSED


# Channels


def pictures(opened: log.Log, topic: str) -> Iterator[tuple[log.Message, Picture]]:
    """The messages of a channel with their pictures.

    Raises McaptrackError, with topic and time, for messages that can't be read.
    """
    yield from decoded_messages(opened, topic, picture_decoder)


def picture_reader(opened: log.Log, topic: str) -> Callable[[log.Message], Picture]:
    """A function that decodes messages of a channel to pictures; both raise errors as ``pictures`` does."""
    return message_reader(opened, topic, picture_decoder)


def stamps(opened: log.Log, topic: str) -> Ints:
    """The stamps of a channel's pictures in log time order, (M,) ns; they are kept as long as the log is open."""
    kept = _STAMPS.setdefault(opened, {})
    if topic not in kept:
        kept[topic] = np.array([picture.stamp_ns for _, picture in pictures(opened, topic)], np.int64)
    return kept[topic]


# Pictures


def picture_decoder(kind: MessageType) -> Callable[[bytes], Picture]:
    """A function that decodes payloads of a channel to pictures.

    Raises McaptrackError if messages of this type are not supported; the returned function raises McaptrackError for
    malformed payloads.
    """
    name = plain_name(kind.name)
    if name in _COMPRESSED:
        return decoder_with_errors(kind, _compressed)
    if name in _RAW:
        return decoder_with_errors(kind, _raw)
    raise McaptrackError(f"it holds {kind.name or 'no schema'}, not pictures; {', '.join(PICTURES_READ)} are read")


def _compressed(message: Any) -> Picture:
    data = to_bytes(message.data)
    if not data:
        raise ValueError("it holds no data")
    return Picture(stamp_of(message), _format(text(message.format)), data)


def _format(text: str) -> str:
    """The codec in a format: "h264" -> "h264", "rgb8; jpeg compressed bgr8" -> "jpeg"."""
    tokens = re.findall(r"[a-z0-9]+", text.lower().replace("h.26", "h26"))
    for word in tokens:
        if word in _VIDEO_WORDS:
            return _VIDEO_WORDS[word]
    if "compresseddepth" in tokens:
        raise ValueError(f"depth in the format {text[:40]!r} is not read")
    return next((word for word in ("jpeg", "jpg", "png", "webp") if word in tokens), text[:40])


def _raw(message: Any) -> Picture:
    from mcaptrack.sources.video import PixelLayout

    is_bigendian = bool(getattr(message, "is_bigendian", False))  # foxglove.RawImage is always little-endian
    layout = PixelLayout(integer(message.width), integer(message.height), integer(message.step), is_bigendian)
    return Picture(stamp_of(message), text(message.encoding).lower(), to_bytes(message.data), layout)
