"""A log with people hidden in its pictures, and a video of such pictures.

All other records of the log stay as they are: the messages of other channels, their order and times, metadata and
attachments. The pictures keep their times and all fields but the picture itself.
"""

from __future__ import annotations

import base64
import dataclasses
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from mcap.well_known import MessageEncoding

from mcaptrack import __version__, foxglove, log
from mcaptrack.errors import McaptrackError, call
from mcaptrack.extensions.render.blur.people import HiddenPeople, hide
from mcaptrack.extensions.render.video import rate_of
from mcaptrack.geometry.arrays import Bools, Image
from mcaptrack.notices import Progress, warn
from mcaptrack.pipeline import LAYOUTS, attachment_of
from mcaptrack.sources import foreign
from mcaptrack.sources.cameras import Camera, cameras, find_camera
from mcaptrack.sources.foreign.definitions import MessageType, ros_types, unpacked
from mcaptrack.sources.foreign.flatten import message_type_of
from mcaptrack.sources.pictures import Pictures
from mcaptrack.sources.video import H264Encoder, encode_image
from mcaptrack.sources.video.pixels import raw_with

#: The key of the metadata of a channel with replaced pictures.
BLURRED: Final = "mcaptrack.blurred"
#: Words in the names of schemas of messages that may show people and are not pictures that are read.
_MAY_SHOW: Final = ("image", "video", "pointcloud", "disparity", "laserscan")
_JPEG: Final = ("jpeg", "jpg")


class Blurred(NamedTuple):
    """The number of pictures of each topic that were replaced, the number of hidden boxes, and the topics of boxes."""

    pictures: dict[str, int]
    boxes: int
    sources: tuple[str, ...]


def blurrable(opened: log.Log, camera_name: str | None = None) -> dict[str, HiddenPeople]:
    """The channels of pictures in which people can be hidden, each with what to hide: of all cameras, or of one.

    Raises McaptrackError if there are none; warns of cameras without boxes, of boxes in space that can't be placed in
    the pictures, and of pictures that no detector saw.
    """
    only = None if camera_name is None else find_camera(opened, camera_name)
    out: dict[str, HiddenPeople] = {}
    with_pictures: list[Camera] = [
        camera for camera in cameras(opened) if camera.pictures and (only is None or camera.prefix == only)
    ]
    problems: list[str] = []
    for topic in dict.fromkeys(camera.pictures for camera in with_pictures if camera.pictures):
        people = HiddenPeople(opened, [camera for camera in with_pictures if camera.pictures == topic], topic)
        problems += people.problems
        if people.topics:
            out[topic] = people
            _warn_of_pictures(opened, topic, people)
    if not with_pictures:
        of = f" of {only}" if only else ""
        raise McaptrackError(f"{opened.path} has no pictures{of} in which people could be hidden")
    if not out:
        picture_topics = ", ".join(dict.fromkeys(str(camera.pictures) for camera in with_pictures))
        why = f" ({'; '.join(dict.fromkeys(problems))})" if problems else ""
        raise McaptrackError(
            f"{opened.path} has {picture_topics} and no boxes of people in them to hide{why}; "
            f"{call('run', opened.path)} finds people"
        )
    for problem in dict.fromkeys(problems):
        warn(f"{opened.path}: people in boxes in space may be recognisable: {problem}", "not-blurred")
    return out


def _warn_of_pictures(opened: log.Log, topic: str, people: HiddenPeople) -> None:
    """Warn of pictures that no detector saw, and of those into which 3D boxes can't be projected."""
    total = len(opened.times(topic))
    unseen, unplaced = people.unseen(), people.unplaced()
    said = [f"no detector saw {unseen:,} of the {total:,} pictures of {topic}"] if unseen else []
    if unplaced:
        said.append(f"where the camera was is not known for {unplaced:,} of the {total:,} pictures of {topic}")
    for text in said:
        warn(f"{opened.path}: {text}; people in them may be recognisable", "not-blurred")


def warn_of_rest(opened: log.Log, blurred: Sequence[str]) -> None:
    """Warn of channels and attachments that may show people and are copied as they are."""
    rest = [
        topic
        for topic, channel in sorted(opened.channels.items())
        if topic not in blurred
        and (foreign.holds_pictures(channel) or any(word in channel.schema_name.lower() for word in _MAY_SHOW))
        and not channel.schema_name.endswith("ImageAnnotations")
    ]
    if rest:
        warn(f"{opened.path}: {', '.join(rest)} are kept as recorded and may show people", "not-blurred")
    ours = {attachment_of(name) for name in LAYOUTS}
    kept = sorted({attachment.name for part in opened.parts for attachment in part.index.attachments} - ours)
    if kept:
        warn(f"{opened.path}: the attachments {', '.join(kept)} are kept as they are", "not-blurred")


def blurred_pictures(
    opened: log.Log, topic: str, people: HiddenPeople
) -> Iterator[tuple[log.Message, foreign.Picture, Image, Bools, int]]:
    """Each message of a channel of pictures with its picture, the same with people hidden, the mask, and the boxes.

    Messages with pictures that can't be decoded, as before the first key picture of a video, are left out, with a
    warning. Raises McaptrackError if none can.
    """
    pictures, messages = Pictures(opened, topic), enumerate(opened.messages(topic))
    read, damaged, left_out = foreign.picture_reader(opened, topic), list[McaptrackError](), len(pictures.t_ns)
    for frame in pictures.readable(range(len(pictures.t_ns)), damaged):
        message = next(message for number, message in messages if number == frame.index)
        own = people.at(frame.index)
        image, mask = hide(np.asarray(frame.rows, np.uint8), own)
        yield message, read(message), image, mask, len(own)
        left_out -= 1
    if left_out:
        what = f"{left_out} messages of {topic} without a picture that can be decoded"
        first = f", the first: {damaged[0]}" if damaged else ""
        warn(f"{opened.path}: {what} are left out{first}", "left-out")


# Messages of pictures with another picture in them: all other fields stay as they were recorded.


#: Payload, new data, and the new format ("" for the same one) -> payload.
Replace = Callable[[bytes, bytes, str], bytes]


def picture_replacer(kind: MessageType) -> Replace:
    """A function that puts another picture into messages of this type, in any encoding that pictures are read in.

    Raises McaptrackError if the type is not supported; the returned function takes only payloads that have been
    decoded before.
    """
    if kind.encoding == MessageEncoding.Protobuf and kind.name.startswith("foxglove."):
        return lambda payload, data, word: _protobuf(kind.name, payload, data, word)
    if kind.encoding == MessageEncoding.JSON:
        return _json
    if kind.encoding in (MessageEncoding.ROS1, MessageEncoding.CDR):
        return _ros(kind)
    raise McaptrackError(f"{kind.name} in the encoding {kind.encoding or 'unknown'!r} is not written")


def _protobuf(name: str, payload: bytes, data: bytes, word: str) -> bytes:
    message = foxglove.unpack(name, payload)
    message.data = data
    if word:
        message.format = word
    packed: bytes = message.SerializeToString(deterministic=True)
    return packed


def _json(payload: bytes, data: bytes, word: str) -> bytes:
    fields = json.loads(payload)
    fields["data"] = base64.b64encode(data).decode() if isinstance(fields["data"], str) else list(data)
    if word:
        fields["format" if "format" in fields else "encoding"] = word
    return json.dumps(fields, separators=(",", ":")).encode()


def _ros(kind: MessageType) -> Replace:
    store, name = ros_types(kind)
    read, write = (
        (store.deserialize_ros1, store.serialize_ros1)
        if kind.encoding == MessageEncoding.ROS1
        else (store.deserialize_cdr, store.serialize_cdr)
    )

    def replace(payload: bytes, data: bytes, word: str) -> bytes:
        payload = unpacked(payload) if kind.encoding == MessageEncoding.CDR else payload
        store.max_sequence_length = max(len(payload), 1)
        message = read(payload, name)
        key = "format" if hasattr(message, "format") else "encoding"
        changed: dict[str, Any] = {"data": np.frombuffer(data, np.uint8)} | ({key: word} if word else {})
        return bytes(write(dataclasses.replace(message, **changed), name))

    return replace


def write_blurred_log(
    opened: log.Log, blurrable: dict[str, HiddenPeople], output: Path, progress: Progress = lambda *_: None
) -> Blurred:
    """Write a copy of a log in which people are hidden in the pictures of these topics.

    Raises McaptrackError for pictures that can't be decoded or encoded.
    """
    total = sum(len(opened.times(topic)) for topic in blurrable)
    done, boxes, pictures = 0, 0, dict[str, int]()
    recorded = opened if opened.results is None else log.read(opened.path, sidecar=False)
    try:
        with log.extend(recorded, output, drop=tuple(blurrable)) as writer:
            if opened.results is not None:
                _copy_results(opened.results, writer, blurrable)
            for topic, people in blurrable.items():
                channel = opened.channel(topic)
                kind = message_type_of(opened, topic)
                note = {"hidden": "people", "boxes": list(people.topics), "version": __version__}
                metadata = channel.metadata | {BLURRED: json.dumps(note, sort_keys=True, separators=(",", ":"))}
                schema = (kind.name, kind.schema_encoding, kind.schema)
                number = writer.add_channel(topic, schema, kind.encoding, metadata, "media", topic)
                replace, encode = picture_replacer(kind), _Encoder(opened, topic)
                for message, picture, image, mask, count in blurred_pictures(opened, topic, people):
                    data, word = encode(message.t_ns, picture, image, mask)
                    payload = replace(message.payload, data, word)
                    writer.add_message(number, message.t_ns, message.sequence, payload, message.publish_ns)
                    done, boxes = done + 1, boxes + count
                    pictures[topic] = pictures.get(topic, 0) + 1
                    progress("blur", done, total)
    finally:
        if recorded is not opened:
            recorded.__exit__()
    warn_of_rest(opened, tuple(blurrable))
    sources = tuple(dict.fromkeys(name for people in blurrable.values() for name in people.topics))
    return Blurred(pictures, boxes, sources)


def _copy_results(results: log.Log, writer: log.LogWriter, blurrable: dict[str, HiddenPeople]) -> None:
    """Copy the channels of a sidecar, its metadata and attachments."""
    numbers = {}
    for channel in results.recorded:
        if channel.topic in blurrable:
            continue
        kind = message_type_of(results, channel.topic)
        schema = (kind.name, kind.schema_encoding, kind.schema)
        numbers[channel.id] = writer.add_channel(
            channel.topic, schema, channel.message_encoding, channel.metadata, "rows", "", another=True
        )
    for channel_id, message in log.stream(results):
        if channel_id in numbers:
            writer.add_message(numbers[channel_id], message.t_ns, message.sequence, message.payload, message.publish_ns)
    log.copy_attachments_and_metadata(results, writer)


class _Encoder:
    """Encodes the pictures of a channel as they were: the same format where it can be written, else PNG or H.264."""

    def __init__(self, opened: log.Log, topic: str) -> None:
        self._name = f"{opened.path}: {topic}"
        self._fps = rate_of(opened.times(topic))
        self._is_compressed = foreign.is_compressed(opened.channel(topic).schema_name)
        self._codec: H264Encoder | None = None
        self._size, self._has_warned = (0, 0), False

    def __call__(self, t_ns: int, picture: foreign.Picture, image: Image, mask: Bools) -> tuple[bytes, str]:
        """The data of a picture, and its new format, "" for the same one."""
        if picture.layout is not None and not self._is_compressed:
            return raw_with(picture.format, picture.data, picture.layout, image, mask, picture.span), ""
        if picture.format in _JPEG:
            return encode_image(image, "jpeg"), ""
        if picture.format in ("h264", "h265", "vp9", "av1"):
            if picture.format != "h264":
                self._warn_of_format(picture.format, "h264")
            even = image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2]
            if self._codec is None or even.shape[:2] != self._size:
                self._size = even.shape[:2]
                self._codec = H264Encoder(even.shape[1], even.shape[0], self._fps)
            return self._codec.encode(even, t_ns), "" if picture.format == "h264" else "h264"
        if picture.format != "png":
            self._warn_of_format(picture.format, "png")
        return encode_image(image, "png"), "" if picture.format == "png" and not picture.is_depth else "png"

    def _warn_of_format(self, before: str, after: str) -> None:
        if not self._has_warned:
            warn(f"{self._name}: pictures in {before} become {after}", "other")
        self._has_warned = True
