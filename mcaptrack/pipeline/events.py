"""The last stage: what happened to the identities of tracks, beside each channel of them that is watched.

<tracks>/events             rows of Events
<tracks>/events/view/log    the same in words, for a viewer
<tracks>/counts             how tracking stands, frame by frame
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import foxglove, log
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.events import EventOptions, find_events
from mcaptrack.evaluation.words import SUFFIX, log_messages
from mcaptrack.pipeline.plan import is_stale
from mcaptrack.pipeline.write import Made
from mcaptrack.provenance import Provenance, digest
from mcaptrack.schema import COUNTS, EVENT_KINDS, EVENTS, TRACKS, Frame, Schema

Say = Callable[[str], None]

#: The name of the stage, in reports and in the provenance.
STAGE: Final = "events"
#: What is watched unless something else is asked for, below the camera's prefix.
WATCHED: Final = ("tracks", "retracks")
_EVENTS, _COUNTS = "/events", "/counts"


@dataclass(frozen=True)
class Watch:
    """Which channels of tracks events are made of; none named are the usual ones, and those that have events.

    With ``again`` they are made whether or not they stand.
    """

    options: EventOptions = EventOptions()
    topics: tuple[str, ...] = ()
    again: bool = False


def outputs(topic: str) -> tuple[str, ...]:
    """The topics that the events of a channel of tracks take."""
    return topic + _EVENTS, topic + _EVENTS + SUFFIX, topic + _COUNTS


def make_events(
    opened: log.Log, prefix: str, made: Mapping[str, Made], watch: Watch, say: Say = lambda _: None
) -> dict[str, Made]:
    """The events of all channels that are watched and whose events are missing or out of date.

    ``made`` are channels that were just made. What can't be compared with the truth is said, in a line, and left out.
    Raises McaptrackError for topics that were asked for and hold no tracks.
    """
    out: dict[str, Made] = {}
    topics = watch.topics or _watched(opened, prefix, made)
    if watch.again and not topics:
        raise McaptrackError(f"{opened.path} has no tracks of {prefix}; run `mcaptrack run {opened.path}`")
    truth: _Truth | None = None
    for topic in topics:
        options = watch.options if watch.again else _asked(opened, topic, watch.options)
        if not watch.again and not _is_due(opened, topic, made, options):
            continue
        taken = [name for name in outputs(topic) if not _is_ours(opened, name)]
        if taken:
            if watch.topics:
                raise McaptrackError(f"{opened.path}: events would replace {taken[0]}, which others recorded")
            say(f"no events of {topic}: {taken[0]} was recorded by others")
            continue
        frames, tracks_digest = _tracks(opened, topic, made)
        truth = truth or _read_truth(opened, f"{prefix}/truth", say)
        found = find_events(frames, truth.frames, options, opened.path.stem, topic)
        for words in found.notes:
            say(words)
        parameters = found.parameters(options)
        provenance = Provenance(
            STAGE, parameters, topic, tracks_digest, reference=truth.topic, reference_digest=truth.digest
        )
        out[topic + _EVENTS] = events = _made(EVENTS, found.events, provenance)
        words_of = list(log_messages(found.events, topic, opened.start_ns, found.usual_s))
        view = Provenance("view", {}, topic + _EVENTS, events.provenance.digest)
        out[topic + _EVENTS + SUFFIX] = Made(EVENTS, [], view, words_of, foxglove.schema_record(foxglove.LOG))
        out[topic + _COUNTS] = _made(COUNTS, found.counts, provenance)
    return out


def tally(happened: Mapping[str, Made]) -> dict[str, dict[str, int]]:
    """How many events of each kind, in words, each channel of tracks has."""
    out = {}
    for topic, channel in happened.items():
        if channel.schema is EVENTS and channel.record is None:
            kinds = np.concatenate([EVENTS.empty(), *(frame.rows for frame in channel.frames)])["kind"]
            counts = np.bincount(kinds, minlength=max(EVENT_KINDS) + 1).tolist()
            out[topic.removesuffix(_EVENTS)] = {words: counts[kind] for kind, words in EVENT_KINDS.items()}
    return out


def camera_of(opened: log.Log, topics: Sequence[str]) -> str | None:
    """The camera that these channels belong to: the shortest prefix of the first under which there are tracks."""
    parts = topics[0].strip("/").split("/")[:-1] if topics else []
    prefixes = ["/".join(parts[: count + 1]) for count in range(len(parts))]
    names = ("truth", "tracks", "samples", "detections", "video")
    return next((one for one in prefixes if any(f"/{one}/{name}" in opened.channels for name in names)), None)


class _Truth(NamedTuple):
    """The true tracks of a camera, None if there are none; ``topic`` is empty where that holds something else."""

    frames: list[Frame] | None
    topic: str
    digest: str


def _read_truth(opened: log.Log, topic: str, say: Say) -> _Truth:
    if topic not in opened.channels:
        return _Truth(None, topic, "")
    if not _holds_tracks(opened, topic):
        return _Truth(None, "", "")
    try:
        return _Truth(opened.frames(topic, TRACKS), topic, _digest(opened, topic))
    except McaptrackError as error:
        say(f"no misses, false tracks and switches: {error}")
        return _Truth(None, "", "")


def _made(schema: Schema, frames: list[Frame], provenance: Provenance) -> Made:
    messages = [(frame.t_ns, frame.index, schema.codec.encode(frame.rows)) for frame in frames]
    return Made(schema, frames, replace(provenance, digest=digest(messages)), messages)


def _watched(opened: log.Log, prefix: str, made: Mapping[str, Made]) -> list[str]:
    """The usual channels of tracks, and those of the camera that have events already."""
    topics = [f"{prefix}/{name}" for name in WATCHED]
    topics += [
        topic.removesuffix(_EVENTS)
        for topic in sorted(opened.channels)
        if topic.startswith(prefix + "/") and topic.endswith(_EVENTS) and _is_ours(opened, topic)
    ]
    there = {topic for topic, channel in made.items() if channel.schema is TRACKS}
    return [topic for topic in dict.fromkeys(topics) if topic in there or _holds_tracks(opened, topic)]


def _asked(opened: log.Log, topic: str, given: EventOptions) -> EventOptions:
    """The options that the events of a channel were made with, unless others are given now."""
    channel = opened.channels.get(topic + _EVENTS)
    known = Provenance.from_metadata(channel.metadata) if channel else None
    asked: Any = known.parameters.get("asked") if known and known.transform == STAGE else None
    if given != EventOptions() or not isinstance(asked, dict):
        return given
    similarity, gate = asked.get("similarity"), asked.get("gate")
    is_gate = isinstance(gate, float | int) and gate > 0
    return EventOptions(similarity if similarity in ("iou", "metres") else None, gate if is_gate else None)


def _is_due(opened: log.Log, topic: str, made: Mapping[str, Made], options: EventOptions) -> bool:
    """Whether the events of a channel are missing, or were made from others than there are now, or otherwise."""
    stand = [opened.channels.get(name) for name in outputs(topic)]
    if not all(stand) or is_stale(opened, topic + _EVENTS):
        return True
    known = Provenance.from_metadata(opened.channel(topic + _EVENTS).metadata)
    if known is None or _asked(opened, topic, EventOptions()) != options:
        return True
    return topic in made and made[topic].provenance.digest != known.input_digest


def _is_ours(opened: log.Log, topic: str) -> bool:
    """Whether a topic is free, or holds what may be replaced."""
    channel = opened.channels.get(topic)
    return channel is None or Provenance.from_metadata(channel.metadata) is not None


def _holds_tracks(opened: log.Log, topic: str) -> bool:
    channel = opened.channels.get(topic)
    return channel is not None and channel.schema_name == TRACKS.name and channel.message_encoding == "protobuf"


def _tracks(opened: log.Log, topic: str, made: Mapping[str, Made]) -> tuple[Sequence[Frame], str]:
    """The frames of a channel of tracks, and their digest."""
    if topic in made:
        return made[topic].frames, made[topic].provenance.digest
    return opened.frames(topic, TRACKS), _digest(opened, topic)


def _digest(opened: log.Log, topic: str) -> str:
    known = Provenance.from_metadata(opened.channel(topic).metadata)
    if known and known.digest:
        return known.digest
    return digest((message.t_ns, message.sequence, message.payload) for message in opened.messages(topic))
