"""Adapters for messages of other software: pictures for detectors, and boxes of other detectors.

A message has two times: the log time, which orders everything, and the stamp of its publisher, by which viewers match
drawings to a picture.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import takewhile
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.notices import warn
from mcaptrack.schema import Frame, Rows
from mcaptrack.schema.names import plain_name
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.foreign.boxes import (
    BOXES_3D_READ,
    DETECTIONS_READ,
    DRAWINGS,
    Message3d,
    boxes_3d_decoder,
    reader_of,
)
from mcaptrack.sources.foreign.boxes import Classes as Classes
from mcaptrack.sources.foreign.boxes import boxes_decoder as boxes_decoder
from mcaptrack.sources.foreign.definitions import MessageType as MessageType
from mcaptrack.sources.foreign.picture_messages import PICTURES_NOT_READ as PICTURES_NOT_READ
from mcaptrack.sources.foreign.picture_messages import PICTURES_READ as PICTURES_READ
from mcaptrack.sources.foreign.picture_messages import Picture as Picture
from mcaptrack.sources.foreign.picture_messages import best_form as best_form
from mcaptrack.sources.foreign.picture_messages import better_form as better_form
from mcaptrack.sources.foreign.picture_messages import depth_of as depth_of
from mcaptrack.sources.foreign.picture_messages import facts_of as facts_of
from mcaptrack.sources.foreign.picture_messages import holds_pictures as holds_pictures
from mcaptrack.sources.foreign.picture_messages import is_compressed as is_compressed
from mcaptrack.sources.foreign.picture_messages import is_picture as is_picture
from mcaptrack.sources.foreign.picture_messages import picture_decoder as picture_decoder
from mcaptrack.sources.foreign.picture_messages import picture_reader as picture_reader
from mcaptrack.sources.foreign.picture_messages import pictures as pictures
from mcaptrack.sources.foreign.picture_messages import reader
from mcaptrack.sources.foreign.picture_messages import stamps as stamps

#: Schemas of boxes, in pictures and in space.
BOXES_READ: Final = (*DETECTIONS_READ, *BOXES_3D_READ)


class NamedFrames(NamedTuple):
    """Frames of a channel, the names of their classes by class id, and the frame that their metres are in, or ""."""

    frames: Sequence[Frame]
    classes: dict[int, str]
    frame_id: str = ""


def _has_boxes(channel: log.Channel, in_space: bool) -> bool:
    """Whether a channel's messages are boxes in space, or in pictures, by the name of their schema.

    A warning names a package that reads them and can't be imported.
    """
    try:
        message_reader = reader_of(channel.schema_name)
    except McaptrackError as error:
        warn(f"{error}; messages of {channel.topic} are not read", "other")
        return False
    return message_reader is not None and message_reader.in_space == in_space


def holds_detections(channel: log.Channel) -> bool:
    """Whether a channel's messages are boxes in pictures of another detector, by the name of their schema."""
    return _has_boxes(channel, in_space=False)


def may_hold_boxes_3d(channel: log.Channel) -> bool:
    """Whether a channel's messages may be 3D boxes of other software, by the name of their schema."""
    is_recorded = Provenance.from_metadata(channel.metadata) is None  # views of mcaptrack are drawings, too
    return is_recorded and _has_boxes(channel, in_space=True)


def is_drawing(channel: log.Channel) -> bool:
    """Whether a channel's messages are drawings, of which boxes are a kind."""
    return plain_name(channel.schema_name) in DRAWINGS


# Channels


def named_detections(opened: log.Log, topic: str) -> NamedFrames:
    """The boxes of another detector, one frame for each message, with the names of their classes.

    Boxes with the stamp of a picture are at the log time of this picture, others at their own. Class names are
    converted to ids (see ``boxes.Classes``), which a warning lists.
    """
    classes, stamps_ns = Classes(), list[int | None]()
    decoded = _decoded(opened, topic, lambda kind: boxes_decoder(kind, classes, stamps_ns))
    read = [(message.t_ns, rows) for message, rows in decoded]
    names = settle_classes(opened, topic, classes, [rows for _, rows in read])
    t_ns = _times_of_pictures(opened, topic, [at_ns for at_ns, _ in read], stamps_ns)
    order = np.argsort(t_ns, kind="stable").tolist()
    return NamedFrames([Frame(t_ns[at], index, read[at][1]) for index, at in enumerate(order)], names)


def _times_of_pictures(
    opened: log.Log, topic: str, log_ns: Sequence[int], stamps_ns: Sequence[int | None]
) -> Sequence[int]:
    """The log times of the pictures that boxes are about, by their stamps; their own if no channel has such pictures.

    A picture that was not recorded is as late as the others.
    """
    if all(stamp in (None, at_ns) for stamp, at_ns in zip(stamps_ns, log_ns, strict=True)):
        return log_ns
    channels = [channel for channel in opened.channels.values() if holds_pictures(channel) and channel.messages]
    for channel in sorted(channels, key=lambda channel: (-_shared(channel.topic, topic), channel.topic)):
        try:
            shown_ns = opened.times(channel.topic)
            taken_ns = shown_ns if Provenance.from_metadata(channel.metadata) else stamps(opened, channel.topic)
        except McaptrackError:
            continue  # pictures that can't be read have no stamps
        at = dict(zip(reversed(taken_ns.tolist()), reversed(shown_ns.tolist()), strict=True))
        if 2 * sum(stamp in at for stamp in stamps_ns) > len(stamps_ns):
            late_ns = int(np.median(shown_ns - taken_ns))
            pairs = zip(stamps_ns, log_ns, strict=True)
            return [own if stamp is None else at.get(stamp, max(stamp + late_ns, 0)) for stamp, own in pairs]
    if channels:
        late_s = np.median([(own - stamp) / NS_PER_S for stamp, own in zip(stamps_ns, log_ns, strict=True) if stamp])
        text = f"boxes are taken at their log times, {late_s:.3g} s after their stamps, which no picture has"
        warn(f"{opened.path}: {topic}: {text}", "clock")
    return log_ns


def _shared(topic: str, other: str) -> int:
    """The number of parts of two topics that are the same, from the first on."""
    pairs = zip(topic.split("/"), other.split("/"), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def settle_classes(opened: log.Log, topic: str, classes: Classes, parts: Sequence[Rows]) -> dict[int, str]:
    """Give rows the final ids of their classes, in place; returns the names by id, which a warning lists."""
    numbers = classes.numbers()
    for rows in parts if numbers else ():
        rows["class_id"] = [numbers.get(number, number) for number in rows["class_id"].tolist()]
    if numbers:
        names = ", ".join(f"{number} is {name!r}" for name, number in classes.named())
        warn(f"{opened.path}: classes of {topic} are names; in class_id 1 is a person, {names}", "classes")
    return classes.names_by_id()


def boxes_3d(opened: log.Log, topic: str) -> Iterator[tuple[int, Message3d]]:
    """The log time in ns of each message of a channel, and its 3D boxes. Raises McaptrackError as ``pictures`` does."""
    return ((message.t_ns, boxes) for message, boxes in _decoded(opened, topic, boxes_3d_decoder))


def _decoded(
    opened: log.Log, topic: str, make: Callable[[MessageType], Callable[[bytes], Any]]
) -> Iterator[tuple[Any, Any]]:
    read = reader(opened, topic, make)
    return ((message, read(message)) for message in opened.timed(topic))
