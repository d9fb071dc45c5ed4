"""What stages made goes into the log, with what a person looks at: views, and a layout that shows them."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack import foreign, foxglove, log, views
from mcaptrack.errors import McaptrackError
from mcaptrack.pipeline.plan import picture_topic as find_pictures
from mcaptrack.plane import Planes
from mcaptrack.provenance import Provenance
from mcaptrack.schema import DETECTIONS, PREDICTIONS, TRACKS, Frame, Schema

Ints = NDArray[np.int64]
#: Log time, number of the channel, sequence and payload of a message.
Numbered = tuple[int, int, int, bytes]


class Made(NamedTuple):
    """A channel that was just made; ``record`` is its schema record, if that is not the schema's own."""

    schema: Schema
    frames: list[Frame]
    provenance: Provenance
    messages: list[tuple[int, int, bytes]]
    record: tuple[str, str, bytes] | None = None


def _stamps(opened: log.Log, topic: str, known: Sequence[int]) -> Ints:
    """The stamps of a channel's pictures. Our own are the log's times; those of others stand in the messages."""
    if Provenance.from_metadata(opened.channel(topic).metadata):
        return opened.times(topic)
    return np.array(known, np.int64) if known else foreign.stamps(opened, topic)


def write(
    opened: log.Log,
    prefix: str,
    made: Mapping[str, Made],
    planes: Planes,
    stamps: Mapping[str, Sequence[int]],
    output: Path | None,
) -> bytes | None:
    """Put what was made, and its views, into the log. Returns the layout, if there are pictures to draw on.

    ``stamps`` are those of pictures that were read on the way.
    """
    usual = f"{prefix}/video"
    video = usual if usual in opened.channels else next(iter(stamps), None) or find_pictures(opened, prefix)
    truth = f"{prefix}/truth"
    picture_ns = opened.times(video) if video else np.empty(0, np.int64)
    stamp_ns = _stamps(opened, video, stamps.get(video, ())) if video else picture_ns
    shown = {topic: (channel.schema, channel.frames, channel.provenance.digest) for topic, channel in made.items()}
    if truth in opened.channels and truth + views.SUFFIX not in opened.channels:
        known = Provenance.from_metadata(opened.channel(truth).metadata)
        shown[truth] = (TRACKS, opened.frames(truth, TRACKS), known.digest if known else "")
    outdated = {topic + views.SUFFIX for topic in made}
    streams: list[Iterator[Numbered]] = []
    with log.extend(opened, output, drop={*made, *outdated}, drop_attachments=[LAYOUT]) as writer:
        for topic, channel in made.items():
            record = channel.record or (channel.schema.name, "protobuf", channel.schema.descriptor)
            made_by = channel.provenance.transform  # results of one stage share chunks, so that they can go together
            number = writer.add_channel(topic, record, "protobuf", channel.provenance.to_metadata(), group=made_by)
            streams.append(_with_number(number, channel.messages))
        if video is None or not len(picture_ns):
            _write_by_time(writer, streams)
            return None
        topics = [topic for topic in opened.channels if topic.endswith(views.SUFFIX) and topic not in outdated]
        for topic, (schema, frames, made_from) in shown.items():
            if schema not in (DETECTIONS, TRACKS, PREDICTIONS) or topic.endswith(_NOT_SHOWN):
                continue
            metadata = Provenance("view", {}, topic, made_from).to_metadata()
            record = foxglove.schema_record(foxglove.ANNOTATIONS)
            made_by = made[topic].provenance.transform if topic in made else ""
            number = writer.add_channel(topic + views.SUFFIX, record, "protobuf", metadata, group=made_by)
            view = views.view(topic, schema, frames, picture_ns, planes, stamp_ns)
            streams.append(_with_number(number, view))
            topics.append(topic + views.SUFFIX)
        _write_by_time(writer, streams)
        layout_file = layout(prefix, topics, video)
        writer.add_attachment(LAYOUT, "application/json", layout_file)
    return layout_file


def _with_number(number: int, messages: Iterable[tuple[int, int, bytes]]) -> Iterator[Numbered]:
    return ((t_ns, number, sequence, data) for t_ns, sequence, data in messages)


def _write_by_time(writer: log.LogWriter, streams: Iterable[Iterator[Numbered]]) -> None:
    """Messages of several channels, each by time, all together by time: so that those shown together stand together."""
    for t_ns, number, sequence, data in heapq.merge(*streams, key=lambda message: message[0]):
        writer.add_message(number, t_ns, sequence, data)


#: Channels without a view: they show what others show, at fewer times.
_NOT_SHOWN: Final = ("/samples", "/online")
#: The attachment that holds the layout.
LAYOUT: Final = "mcaptrack.layout.json"
#: Views that a layout switches on, below the prefix; the others can be switched on by hand.
_SHOWN: Final = ("retracks/full", "retracks", "tracks", "detections")


def layout(prefix: str, view_topics: Sequence[str], picture_topic: str) -> bytes:
    """The layout for a camera's views over its pictures: the best that there is switched on."""
    names = {topic: topic.removeprefix(prefix + "/").removesuffix(views.SUFFIX) for topic in sorted(view_topics)}
    there = set(names.values())
    on = _switched_on(there)
    paths = [f"{prefix}/{name}.rows[:].x_m" for name in ("tracks", "retracks") if name in there]
    return foxglove.layout(picture_topic, {topic: name in on for topic, name in names.items()}, paths)


def _switched_on(there: set[str]) -> list[str]:
    """The best views of those that there are, below the prefix."""
    best = [name for name in _SHOWN if name in there][:1]
    return best + [name for name in ("retracks/predictions",) if "retracks" in there and name in there]


def find_views(opened: log.Log, prefix: str, topics: Sequence[str] = ()) -> list[str]:
    """The topics of the views that a layout switches on, or those of these channels.

    Raises McaptrackError if there are none.
    """
    if topics:
        chosen = [topic if topic.endswith(views.SUFFIX) else topic + views.SUFFIX for topic in topics]
        return [opened.channel(topic).topic for topic in chosen]
    there = {
        topic.removeprefix(prefix + "/").removesuffix(views.SUFFIX)
        for topic in opened.channels
        if topic.startswith(prefix + "/") and topic.endswith(views.SUFFIX)
    }
    found = [f"{prefix}/{name}{views.SUFFIX}" for name in _switched_on(there)]
    if not found:
        raise McaptrackError(f"{opened.path} has no views of {prefix} yet; `mcaptrack run {opened.path}` makes them")
    return found
