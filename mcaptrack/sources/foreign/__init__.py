"""Adapters for messages of other software: pictures for detectors, and boxes of other detectors.

A message has two times: the log time, which orders everything, and the stamp of its publisher, by which viewers match
drawings to a picture.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import foxglove, log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.notices import warn
from mcaptrack.schema import Frame
from mcaptrack.sources.foreign.boxes import DETECTIONS_READ, Classes, boxes_decoder
from mcaptrack.sources.foreign.decoding import MessageType, decoder_with_errors, plain_name
from mcaptrack.sources.video import PixelLayout

__all__ = [
    "DETECTIONS_READ",
    "PICTURES_READ",
    "Classes",
    "MessageType",
    "NamedFrames",
    "Picture",
    "boxes_decoder",
    "detections",
    "holds_detections",
    "holds_pictures",
    "is_compressed",
    "is_picture",
    "named_detections",
    "picture_decoder",
    "picture_reader",
    "pictures",
    "stamp_of",
    "stamps",
]

_COMPRESSED: Final = (foxglove.VIDEO, foxglove.IMAGE, "sensor_msgs/CompressedImage")
_RAW: Final = ("foxglove.RawImage", "sensor_msgs/Image")
#: Schemas of pictures, by their names in ROS 1 and Foxglove; ROS 2 adds "/msg/".
PICTURES_READ: Final = (*_COMPRESSED, *_RAW)
#: Words for video codecs in the format of a compressed picture; other formats are still images.
_VIDEO_WORDS: Final = {"h264": "h264", "avc": "h264", "h265": "h265", "hevc": "h265", "vp9": "vp9", "av1": "av1"}
_RFC3339: Final = re.compile(r"(\d{4}-\d\d-\d\d)[Tt ](\d\d:\d\d:\d\d)(?:\.(\d{1,9})\d*)?(Z|z|[+-]\d\d:\d\d)", re.ASCII)
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_LIMIT_NS: Final = 2**63


class Picture(NamedTuple):
    """A recorded picture: ``format`` is "h264", "jpeg" and so on, or with a ``layout`` a pixel format.

    ``stamp_ns`` is the stamp in the message, in nanoseconds since 1970.
    """

    stamp_ns: int
    format: str
    data: bytes
    layout: PixelLayout | None = None


class NamedFrames(NamedTuple):
    """Frames of a channel, the names of their classes by class id, and the frame that their metres are in, or ""."""

    frames: list[Frame]
    classes: dict[int, str]
    frame_id: str = ""


def holds_pictures(channel: log.Channel) -> bool:
    """Whether a channel's messages are pictures, by the name of their schema."""
    return is_picture(channel.schema_name)


def is_picture(schema_name: str) -> bool:
    """Whether messages of this schema are pictures."""
    return plain_name(schema_name) in PICTURES_READ


def is_compressed(schema_name: str) -> bool:
    """Whether messages of this schema are compressed pictures."""
    return plain_name(schema_name) in _COMPRESSED


def holds_detections(channel: log.Channel) -> bool:
    """Whether a channel's messages are boxes of another detector, by the name of their schema."""
    return plain_name(channel.schema_name) in DETECTIONS_READ


# Channels


def pictures(opened: log.Log, topic: str) -> Iterator[tuple[log.Message, Picture]]:
    """The messages of a channel with their pictures.

    Raises McaptrackError, with topic and time, for messages that can't be read.
    """
    yield from _decoded(opened, topic, picture_decoder)


def picture_reader(opened: log.Log, topic: str) -> Callable[[log.Message], Picture]:
    """A function that decodes messages of a channel to pictures; both raise errors as ``pictures`` does."""
    return _reader(opened, topic, picture_decoder)


def stamps(opened: log.Log, topic: str) -> Ints:
    """The stamps of a channel's pictures in log time order, (M,) ns."""
    return np.array([picture.stamp_ns for _, picture in pictures(opened, topic)], np.int64)


def detections(opened: log.Log, topic: str) -> list[Frame]:
    """The boxes of another detector, one frame for each message. Raises McaptrackError as ``pictures`` does."""
    return named_detections(opened, topic).frames


def named_detections(opened: log.Log, topic: str) -> NamedFrames:
    """The boxes of another detector as ``detections`` gives them, with the names of their classes.

    Class names are converted to ids (see ``boxes.Classes``), which a warning lists.
    """
    classes = Classes()
    found = _decoded(opened, topic, lambda kind: boxes_decoder(kind, classes))
    frames = [Frame(message.t_ns, index, rows) for index, (message, rows) in enumerate(found)]
    numbers = classes.numbers()
    for frame in frames:
        frame.rows["class_id"] = [numbers.get(number, number) for number in frame.rows["class_id"].tolist()]
    if numbers:
        names = ", ".join(f"{number} is {name!r}" for name, number in classes.named())
        warn(f"{opened.path}: classes of {topic} are names; in class_id 1 is a person, {names}", "classes")
    return NamedFrames(frames, classes.names_by_id())


def _decoded(
    opened: log.Log, topic: str, make: Callable[[MessageType], Callable[[bytes], Any]]
) -> Iterator[tuple[Any, Any]]:
    read = _reader(opened, topic, make)
    return ((message, read(message)) for message in opened.timed(topic))


def _reader(
    opened: log.Log, topic: str, make: Callable[[MessageType], Callable[[bytes], Any]]
) -> Callable[[log.Message], Any]:
    channel = opened.channel(topic)
    index = opened.part(channel.topic).index
    schema = index.schemas.get(index.channels[channel.id].schema_id)
    words = (schema.name, schema.encoding, bytes(schema.data)) if schema else ("", "", b"")
    try:
        decode = make(MessageType(*words, channel.message_encoding))
    except McaptrackError as error:
        raise McaptrackError(f"{opened.path}: {topic}: {error}") from None

    def read(message: log.Message) -> Any:
        try:
            return decode(message.payload)
        except McaptrackError as error:
            raise McaptrackError(f"{opened.path}: {topic} at {message.t_ns} ns: {error}") from None

    return read


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
    data = _bytes(message.data)
    if not data:
        raise ValueError("it holds no data")
    return Picture(stamp_of(message), _format(_text(message.format)), data)


def _format(words: str) -> str:
    """The codec in a format: "h264" -> "h264", "rgb8; jpeg compressed bgr8" -> "jpeg"."""
    found = re.findall(r"[a-z0-9]+", words.lower().replace("h.26", "h26"))
    for word in found:
        if word in _VIDEO_WORDS:
            return _VIDEO_WORDS[word]
    if "compresseddepth" in found:
        raise ValueError(f"depth in the format {words[:40]!r} is not read")
    return next((word for word in ("jpeg", "jpg", "png", "webp") if word in found), words[:40])


def _raw(message: Any) -> Picture:
    layout = PixelLayout(
        _integer(message.width),
        _integer(message.height),
        _integer(message.step),
        bool(
            getattr(message, "is_bigendian", False)
        ),  # foxglove.RawImage has no such field: it is always little-endian
    )
    return Picture(stamp_of(message), _text(message.encoding).lower(), _bytes(message.data), layout)


def stamp_of(message: Any) -> int:
    """The stamp of a message in nanoseconds: ``timestamp`` in Foxglove messages, ``header.stamp`` in ROS messages."""
    stamp = message.timestamp if hasattr(message, "timestamp") else message.header.stamp
    if isinstance(stamp, str):
        found = _RFC3339.fullmatch(stamp)
        if not found:
            raise ValueError(f"{stamp[:40]!r} is no time")
        day, clock, fraction, zone = found.groups()
        passed = datetime.fromisoformat(f"{day}T{clock}{zone.upper()}") - _EPOCH
        t_ns = (passed.days * 86400 + passed.seconds) * NS_PER_S + int((fraction or "").ljust(9, "0"))
    else:
        t_ns = _time_field(stamp, "sec", "secs", "seconds") * NS_PER_S + _time_field(
            stamp, "nsec", "nsecs", "nanosec", "nanos"
        )
    if not -_LIMIT_NS <= t_ns < _LIMIT_NS:
        raise ValueError(f"its stamp, {t_ns} ns, is out of range")
    return t_ns


def _time_field(stamp: Any, *names: str) -> int:
    for name in names:
        if hasattr(stamp, name):
            return _integer(getattr(stamp, name))
    raise ValueError(f"its stamp has no {names[0]}")


def _integer(value: Any) -> int:
    if isinstance(value, float) and value.is_integer():  # JSON of writers without an integer type
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not -_LIMIT_NS <= value < _LIMIT_NS:
        raise ValueError(f"{str(value)[:40]!r} where a whole number belongs")
    return int(value)


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"a {type(value).__name__} where text belongs")
    return value


def _bytes(value: Any) -> bytes:
    """Bytes of a field: from protobuf, ROS (an array), JSON (base64, or numbers from ROS bridges)."""
    if isinstance(value, str):
        return base64.b64decode(value, validate=True)
    if isinstance(value, np.ndarray):
        return value.tobytes()
    if isinstance(value, bytes | list):
        return bytes(value)
    raise ValueError(f"a {type(value).__name__} where bytes belong")
