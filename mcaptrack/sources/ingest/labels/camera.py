"""Find the pictures that labels belong to. A camera is the part of a topic before its last "/"."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from fractions import Fraction
from itertools import islice
from typing import Final, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from mcaptrack import log
from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import parse_fps
from mcaptrack.schema import DETECTIONS, VIDEO
from mcaptrack.schema.framing import joined_parts
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources import foreign
from mcaptrack.sources.foreign.flatten import message_type_of
from mcaptrack.sources.ingest.labels.timeline import Timeline
from mcaptrack.sources.pictures import size_of_pictures
from mcaptrack.sources.video import is_video_codec, read_head
from mcaptrack.transforms import STAGES

#: The default camera name.
DEFAULT: Final = "camera"


class CameraTopics(NamedTuple):
    """The prefix of all topics of a camera, and the topic of its pictures, "" if there are none."""

    prefix: str
    pictures: str


def choose_camera(where: object, camera: str, topics: Collection[str]) -> CameraTopics:
    """The camera with this name, among topics of pictures.

    The name may also be a topic of pictures itself, or be below a camera: a second set of labels for the pictures of
    ``front`` goes to ``front/labels``. With the default name it is the only camera with pictures. Raises
    McaptrackError, with the names, if a camera has several topics of pictures, or if there are several cameras and none
    is named.
    """
    prefix = "/" + camera.strip("/")
    for at in (prefix, *_above(prefix)):
        if at in topics:
            return CameraTopics(camera_prefix(at) if at == prefix else prefix, at)
        fitting = sorted(topic for topic in topics if camera_prefix(topic) == at)
        if len(fitting) == 1 or f"{at}/video" in fitting:
            return CameraTopics(prefix, f"{at}/video" if len(fitting) > 1 else fitting[0])
        if fitting:
            raise McaptrackError(
                f"{where}: {at} has several topics of pictures, {', '.join(fitting)}; name one with "
                f"`camera={fitting[0].strip('/')!r}`"
            )
    if camera != DEFAULT or not topics:
        return CameraTopics(prefix, "")
    if len(topics) > 1:
        names = sorted({camera_prefix(topic).strip("/") for topic in topics})
        names = names if len(names) == len(topics) else sorted(topic.strip("/") for topic in topics)
        raise McaptrackError(
            f"{where} has pictures of several cameras, {', '.join(sorted(topics))}; labels and ground planes belong to "
            f"those of one: choose with `camera={names[0]!r}`"
        )
    (topic,) = topics
    return CameraTopics(camera_prefix(topic), topic)


def _above(prefix: str) -> Iterator[str]:
    while "/" in prefix[1:]:
        prefix = prefix.rpartition("/")[0]
        yield prefix


def camera_prefix(topic: str) -> str:
    """The prefix of the camera that a topic belongs to."""
    folder, slash, _ = topic.strip("/").rpartition("/")
    return f"/{folder}" if slash else f"/{DEFAULT}"


def camera_of(opened: log.Log, camera: str) -> CameraTopics:
    """The camera with this name in a log. Raises McaptrackError as ``choose_camera`` does."""
    topics = [c.topic for c in opened.channels.values() if foreign.holds_pictures(c) and c.messages]
    return choose_camera(opened.path, camera, topics)


def picture_predicate(kind: foreign.MessageType) -> Callable[[bytes], bool]:
    """A predicate: whether a message of a channel has a picture; video messages may have parameter sets alone."""
    if not foreign.is_compressed(kind.name):
        return lambda _: True
    decode = foreign.picture_decoder(kind)

    def test(payload: bytes) -> bool:
        try:
            picture = decode(payload)
        except McaptrackError:
            return True  # a damaged picture counts; decoding it reports what is wrong
        return read_head(picture.format, picture.data).has_picture

    return test


def timeline_of(opened: log.Log, topic: str) -> Timeline:
    """The pictures of a channel. Raises McaptrackError if it is damaged, or holds no pictures."""
    t_ns: NDArray[np.int64] = opened.times(topic)
    index, every, of = np.arange(len(t_ns)), 1, f"the pictures of {topic}"
    provenance = Provenance.from_metadata(opened.channel(topic).metadata)
    if provenance:
        value = provenance.parameters.get("every")
        every = value if isinstance(value, int) and value > 0 else 1
        last = max(message.sequence for message in opened.messages(topic, int(t_ns[-1])))
        if last + 1 != len(t_ns):  # some pictures could not be read; the others keep their numbers
            index = np.array([message.sequence for message in opened.messages(topic)], np.int64)
    elif _may_be_video(opened, topic):
        is_picture = picture_predicate(message_type_of(opened, topic))
        t_ns = np.array([m.t_ns for m in opened.messages(topic) if is_picture(m.payload)], np.int64)
        index = np.arange(len(t_ns))
    if not len(t_ns):
        raise McaptrackError(f"{opened.path}: {topic} has no pictures that labels could be of")
    return Timeline(index, t_ns, of, len(index) == index[-1] + 1, every)


def detections_topic(opened: log.Log, prefix: str) -> str:
    """The topic of detections made from pictures that were dropped since; "" if there is none."""
    channel = opened.channels.get(f"{prefix}/detections")
    provenance = Provenance.from_metadata(channel.metadata) if channel else None
    stage = STAGES.get(provenance.transform) if provenance else None
    is_of_pictures = stage is not None and stage.reads is VIDEO
    return channel.topic if channel and channel.messages and is_of_pictures else ""


def _may_be_video(opened: log.Log, topic: str) -> bool:
    """Whether the first picture of a channel is video, or can't be read."""
    if not foreign.is_compressed(opened.channel(topic).schema_name):
        return False
    decode = foreign.picture_decoder(message_type_of(opened, topic))
    try:
        return any(is_video_codec(decode(message.payload).format) for message in islice(opened.messages(topic), 1))
    except McaptrackError:
        return True


class ExistingLabels(NamedTuple):
    """Labels in a log: their sorted times, the number of frames, and the frame rate if it is known."""

    t_ns: NDArray[np.int64]
    frames: int
    fps: Fraction | None


def labels_of(opened: log.Log, prefix: str) -> dict[str, ExistingLabels]:
    """The ingested labels of a camera in a log, by topic."""
    out = {}
    for role in get_args(Role):
        channel = opened.channels.get(f"{prefix}/{role}")
        provenance = Provenance.from_metadata(channel.metadata) if channel else None
        if channel and channel.messages and provenance and provenance.transform == "ingest":
            t_ns = opened.times(channel.topic)
            value = provenance.parameters.get("fps")
            fps = parse_fps(value) if isinstance(value, str) else None
            frames = 1 + max(message.sequence for message in opened.messages(channel.topic, int(t_ns[-1])))
            out[channel.topic] = ExistingLabels(t_ns, frames, fps)
    return out


def boxes_extent(opened: log.Log, topic: str) -> tuple[int, int]:
    """Width and height, at least 1, of pictures that contain all boxes of a channel; (0, 0) if it has no detections."""
    channel = opened.channels.get(topic)
    if channel is None or not channel.messages or channel.schema_name != DETECTIONS.name:
        return 0, 0
    corner = np.ones(2)
    for _, _, part in joined_parts(DETECTIONS, opened.frame_columns(topic, DETECTIONS)):
        boxes = columns_to_boxes(part.rows)
        corner = np.maximum(corner, (boxes[:, :2] + boxes[:, 2:]).max(axis=0, initial=1.0))
    right, bottom = np.ceil(corner).tolist()
    return int(right), int(bottom)


def picture_size(opened: log.Log, topic: str) -> tuple[int, int]:
    """Width and height of the pictures of a channel. Raises McaptrackError if none of them can be decoded."""
    size = size_of_pictures(opened, topic)
    if size is None:
        raise McaptrackError(f"{opened.path}: {topic} has no picture that can be decoded")
    return size
