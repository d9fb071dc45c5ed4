"""Messages that others recorded -> ours: pictures for detectors, boxes that somebody else detected.

A message has two times: when it was logged, which orders everything, and the stamp that its maker gave it, by which
viewers match what is drawn to a picture.
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
from mcaptrack.sources.foreign.decoding import MessageType, guarded, plain_name
from mcaptrack.sources.video import PixelLayout

__all__ = [
    "DETECTIONS_READ",
    "PICTURES_READ",
    "Classes",
    "MessageType",
    "Picture",
    "boxes_decoder",
    "detections",
    "holds_detections",
    "holds_pictures",
    "is_compressed",
    "is_picture",
    "picture_decoder",
    "picture_reader",
    "pictures",
    "stamps",
]

_COMPRESSED: Final = (foxglove.VIDEO, foxglove.IMAGE, "sensor_msgs/CompressedImage")
_RAW: Final = ("foxglove.RawImage", "sensor_msgs/Image")
#: Schemas whose messages are pictures, as ROS 1 and Foxglove name them; ROS 2 has "/msg/" between.
PICTURES_READ: Final = (*_COMPRESSED, *_RAW)
#: Words in the format of a compressed picture that name a video codec; all others are still images.
_VIDEO_WORDS: Final = {"h264": "h264", "avc": "h264", "h265": "h265", "hevc": "h265", "vp9": "vp9", "av1": "av1"}
_RFC3339: Final = re.compile(r"(\d{4}-\d\d-\d\d)[Tt ](\d\d:\d\d:\d\d)(?:\.(\d{1,9})\d*)?(Z|z|[+-]\d\d:\d\d)", re.ASCII)
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_LIMIT_NS: Final = 2**63


class Picture(NamedTuple):
    """A picture as its maker gave it: ``format`` is "h264", "jpeg" and so on, or with a ``layout`` that of pixels.

    ``stamp_ns`` is the time in the message itself, from 1970.
    """

    stamp_ns: int
    format: str
    data: bytes
    layout: PixelLayout | None = None


def holds_pictures(channel: log.Channel) -> bool:
    """Whether a channel's messages are pictures, by the name of their schema."""
    return is_picture(channel.schema_name)


def is_picture(schema_name: str) -> bool:
    """Whether messages of this schema are pictures."""
    return plain_name(schema_name) in PICTURES_READ


def is_compressed(schema_name: str) -> bool:
    """Whether messages of this schema are pictures that are compressed already."""
    return plain_name(schema_name) in _COMPRESSED


def holds_detections(channel: log.Channel) -> bool:
    """Whether a channel's messages are boxes that others detected, by the name of their schema."""
    return plain_name(channel.schema_name) in DETECTIONS_READ


# Channels


def pictures(opened: log.Log, topic: str) -> Iterator[tuple[log.Message, Picture]]:
    """The messages of a channel, and the picture in each.

    Raises McaptrackError, with topic and time, for messages that can't be read.
    """
    yield from _decoded(opened, topic, picture_decoder)


def picture_reader(opened: log.Log, topic: str) -> Callable[[log.Message], Picture]:
    """What makes pictures of the messages of a channel; it and what it returns raise as ``pictures`` does."""
    return _reader(opened, topic, picture_decoder)


def stamps(opened: log.Log, topic: str) -> Ints:
    """The stamps of a channel's pictures, in the order of their log times."""
    return np.array([picture.stamp_ns for _, picture in pictures(opened, topic)], np.int64)


def detections(opened: log.Log, topic: str) -> list[Frame]:
    """What others detected, a frame a message. Raises McaptrackError, with topic and time, as ``pictures`` does.

    Classes that have names get numbers (see ``boxes.Classes``); a warning says which.
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
    return frames


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
    """What makes pictures of the payloads of a channel.

    Raises McaptrackError if messages of this kind are not read; what it returns raises McaptrackError for payloads that
    are malformed.
    """
    name = plain_name(kind.name)
    if name in _COMPRESSED:
        return guarded(kind, _compressed)
    if name in _RAW:
        return guarded(kind, _raw)
    raise McaptrackError(f"it holds {kind.name or 'no schema'}, not pictures; {', '.join(PICTURES_READ)} are read")


def _compressed(message: Any) -> Picture:
    data = _bytes(message.data)
    if not data:
        raise ValueError("it holds no data")
    return Picture(_stamp_of(message), _format(_text(message.format)), data)


def _format(words: str) -> str:
    """The codec that a format names: "h264", "rgb8; jpeg compressed bgr8" -> "jpeg"."""
    found = re.findall(r"[a-z0-9]+", words.lower().replace("h.26", "h26"))
    for word in found:
        if word in _VIDEO_WORDS:
            return _VIDEO_WORDS[word]
    if "compresseddepth" in found:
        raise ValueError(f"depth in the format {words[:40]!r} is not read")
    return next((word for word in ("jpeg", "jpg", "png", "webp") if word in found), words[:40])


def _raw(message: Any) -> Picture:
    layout = PixelLayout(
        _whole(message.width),
        _whole(message.height),
        _whole(message.step),
        bool(getattr(message, "is_bigendian", False)),  # Foxglove's has none: little-endian always
    )
    return Picture(_stamp_of(message), _text(message.encoding).lower(), _bytes(message.data), layout)


def _stamp_of(message: Any) -> int:
    """The time in a message, in nanoseconds: of Foxglove's ``timestamp`` or of ROS's ``header``."""
    stamp = message.timestamp if hasattr(message, "timestamp") else message.header.stamp
    if isinstance(stamp, str):
        found = _RFC3339.fullmatch(stamp)
        if not found:
            raise ValueError(f"{stamp[:40]!r} is no time")
        day, clock, fraction, zone = found.groups()
        passed = datetime.fromisoformat(f"{day}T{clock}{zone.upper()}") - _EPOCH
        t_ns = (passed.days * 86400 + passed.seconds) * NS_PER_S + int((fraction or "").ljust(9, "0"))
    else:
        t_ns = _part(stamp, "sec", "secs", "seconds") * NS_PER_S + _part(stamp, "nsec", "nsecs", "nanosec", "nanos")
    if not -_LIMIT_NS <= t_ns < _LIMIT_NS:
        raise ValueError(f"its stamp, {t_ns} ns, is out of range")
    return t_ns


def _part(stamp: Any, *names: str) -> int:
    for name in names:
        if hasattr(stamp, name):
            return _whole(getattr(stamp, name))
    raise ValueError(f"its stamp has no {names[0]}")


def _whole(value: Any) -> int:
    if isinstance(value, float) and value.is_integer():  # JSON of writers that know one kind of number
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not -_LIMIT_NS <= value < _LIMIT_NS:
        raise ValueError(f"{str(value)[:40]!r} where a whole number belongs")
    return int(value)


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"a {type(value).__name__} where text belongs")
    return value


def _bytes(value: Any) -> bytes:
    """Bytes as they come: from protobuf, ROS (an array), JSON (base64 or, from ROS bridges, numbers)."""
    if isinstance(value, str):
        return base64.b64decode(value, validate=True)
    if isinstance(value, np.ndarray):
        return value.tobytes()
    if isinstance(value, bytes | list):
        return bytes(value)
    raise ValueError(f"a {type(value).__name__} where bytes belong")
