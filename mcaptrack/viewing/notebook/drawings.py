"""The views that a notebook shows: those in the log, or else drawings of rows that have no view yet.

Only runs write views. A channel that was only ingested, such as a ground truth, is drawn while it is shown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import log, pipeline
from mcaptrack.errors import McaptrackError, list_names
from mcaptrack.foxglove import ANNOTATIONS, SCENE, views
from mcaptrack.foxglove.messages import message_class
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.notices import warn
from mcaptrack.schema import PREDICTIONS, Schema
from mcaptrack.schema.classes import class_names
from mcaptrack.schema.framing import has_any
from mcaptrack.sources.camera_motion import path_of, tracks_topic
from mcaptrack.sources.foreign import holds_pictures
from mcaptrack.sources.foreign.flatten import message_decoder
from mcaptrack.transforms import FULL

#: The channels that are drawn if there are no views, below the name of a camera: the first that there is.
_BEST: Final = (f"retracks{FULL}", "retracks", "tracks", "detections", "truth")
#: The time before the first picture from which pictures are drawn, for trails.
_TRAIL_NS: Final = 3 * NS_PER_S


class ShownView(NamedTuple):
    """A view: its topic, or that of the rows which are drawn; and how its messages are read.

    ``messages`` gives time in ns and payload of each message in a span of times, for rising times of pictures.
    """

    topic: str
    messages: Callable[[Ints, tuple[int, int]], Iterator[tuple[int, bytes]]]
    read: Callable[[bytes], Any]

    def payloads(self, t_ns: Ints, span: tuple[int, int]) -> Iterator[bytes]:
        """Yield the payloads of all messages in a span of times."""
        return (payload for _, payload in self.messages(t_ns, span))

    def payload_at(self, t_ns: Ints, span: tuple[int, int]) -> Callable[[int], bytes | None]:
        """Return a function that gives the payload at exactly a time, for rising times; None if there is none."""
        coming = self.messages(t_ns, span)
        waiting = next(coming, None)

        def at(time_ns: int) -> bytes | None:
            nonlocal waiting
            while waiting is not None and waiting[0] < time_ns:
                waiting = next(coming, None)
            return waiting[1] if waiting is not None and waiting[0] == time_ns else None

        return at


class ToShow(NamedTuple):
    """The views that are shown, and the topic of the pictures that they are on; "" for the ground, from above.

    ``t_ns`` are the times of the pictures or scenes.
    """

    views: list[ShownView]
    pictures: str
    t_ns: Ints


def find_drawings(opened: log.Log, prefix: str, topics: Sequence[str]) -> ToShow:
    """Return what is shown of a camera: given channels, or those that layouts show by default.

    A given channel of pictures is shown with nothing on it. Pictures without anything to draw on them are shown, too,
    with a warning. Raises McaptrackError if there is nothing to see, if a given channel can't be drawn, or if the views
    of given ones don't fit together.
    """
    given = [_full(opened, prefix, topic) for topic in topics]
    if len(given) == 1 and given[0] in opened.channels and holds_pictures(opened.channels[given[0]]):
        return ToShow([], given[0], opened.times(given[0]))
    without = [topic for topic in given if not _has_view(opened, topic)]
    if without:
        for topic in given:
            _schema_of(opened, topic)
        return _drawn_now(opened, prefix, given)
    try:
        shown = pipeline.find_views(opened, prefix, given)
    except McaptrackError as error:
        found = [topic for topic in _candidates(opened, prefix) if not given][:1]
        if not found and (given or pipeline.camera_at(opened, prefix).pictures is None):
            raise
        if not found:
            warn(f"nothing is drawn on the pictures: {error}", "nothing-found")
        return _drawn_now(opened, prefix, found)
    t_ns = opened.times(shown.pictures or shown.views[0])
    return ToShow([_recorded(opened, topic) for topic in shown.views], shown.pictures, t_ns)


def _full(opened: log.Log, prefix: str, topic: str) -> str:
    """Return the topic of a channel that is given by its topic, or by its name below the camera."""
    below = f"{prefix}/{topic.strip('/')}"
    return below if topic not in opened.channels and below in opened.channels else topic


def _has_view(opened: log.Log, topic: str) -> bool:
    begin = tuple(one + suffix for one in (topic, topic + FULL) for suffix in views.SUFFIXES)
    is_view = any(suffix in topic for suffix in views.SUFFIXES)
    return is_view or any(one.startswith(begin) for one in opened.channels)


def _candidates(opened: log.Log, prefix: str) -> list[str]:
    """Return the channels of a camera that can be drawn, the best ones first."""
    best = [f"{prefix}/{name}" for name in _BEST]
    there = [*best, *sorted(pipeline.camera_at(opened, prefix).topics)]
    return [one for one in dict.fromkeys(there) if one in opened.channels and _kind(opened.channels[one])]


def _kind(channel: log.Channel) -> Schema | None:
    return next((schema for schema in views.DRAWN if channel.holds(schema)), None)


def _schema_of(opened: log.Log, topic: str) -> Schema:
    """Return the schema of a channel to draw. Raises McaptrackError if it can't be drawn."""
    schema = _kind(opened.channel(topic))
    if schema is None:
        there = list_names(sorted(one.topic for one in opened.channels.values() if _kind(one)))
        raise McaptrackError(f"{opened.path}: {topic} has no boxes, tracks or predictions to draw; there are {there}")
    return schema


def _recorded(opened: log.Log, topic: str) -> ShownView:
    def messages(_: Ints, span: tuple[int, int]) -> Iterator[tuple[int, bytes]]:
        return ((message.t_ns, message.payload) for message in opened.messages(topic, *span))

    return ShownView(topic, messages, message_decoder(opened, topic))


def _drawn_now(opened: log.Log, prefix: str, topics: Sequence[str]) -> ToShow:
    """Return drawings of channels: on the pictures of the camera, or on the ground."""
    pictures = pipeline.camera_at(opened, prefix).pictures
    t_ns = opened.times(pictures or topics[0])
    return ToShow([_drawing(opened, prefix, topic, pictures is None) for topic in topics], pictures or "", t_ns)


def _drawing(opened: log.Log, prefix: str, topic: str, is_above: bool) -> ShownView:
    schema = _schema_of(opened, topic)
    frames = opened.frame_columns(topic, schema)
    if is_above and schema is not PREDICTIONS and not has_any(schema, frames, lambda rows: np.isfinite(rows["x_m"])):
        raise McaptrackError(
            f"{opened.path} has no pictures of {prefix}, and {topic} no positions in metres to show from above; "
            "with a ground plane, it has"
        )
    names = class_names(opened.channel(topic).metadata)
    path, _ = path_of(opened, prefix, tracks_topic(prefix))
    drawing = views.Drawing(topic, schema, frames, pipeline.read_planes(opened, prefix) or (), classes=names, path=path)

    def messages(t_ns: Ints, span: tuple[int, int]) -> Iterator[tuple[int, bytes]]:
        times = np.unique(t_ns[(t_ns >= span[0] - _TRAIL_NS) & (t_ns < span[1])])
        drawn = drawing.on_ground(times, "") if is_above else drawing.on_pictures(times, times)
        return ((at_ns, payload) for at_ns, _, payload in drawn if span[0] <= at_ns < span[1])

    return ShownView(topic, messages, message_class(SCENE if is_above else ANNOTATIONS).FromString)
