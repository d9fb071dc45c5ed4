"""The last stage: what became of tracks and of forecasts, beside their channels.

<tracks>/events             what happened to identities: rows of Events
<tracks>/events/view/log    the same in words, for a viewer
<tracks>/counts             how tracking stands, frame by frame
<predictions>/errors        how far off each forecast was: rows of ForecastErrors
<predictions>/scores        their means, frame by frame
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import foxglove, log
from mcaptrack.errors import McaptrackError, call
from mcaptrack.evaluation.event_text import SUFFIX, log_messages
from mcaptrack.evaluation.events import EventOptions, find_events
from mcaptrack.evaluation.forecasts import FORECAST_INPUTS, find_forecast_errors
from mcaptrack.notices import warn
from mcaptrack.pipeline.checks import how_it_came, may_replace
from mcaptrack.pipeline.plan import is_stale
from mcaptrack.pipeline.write import Made, digest_of
from mcaptrack.schema import (
    COUNTS,
    EVENT_KINDS,
    EVENTS,
    FORECAST_ERRORS,
    FORECAST_SCORES,
    PREDICTIONS,
    TRACKS,
    Frame,
    Schema,
)
from mcaptrack.schema.provenance import VIEW, Provenance
from mcaptrack.sources.cameras import camera_at

#: The name of the stage, in reports and in the provenance.
STAGE: Final = "events"
#: What is watched unless something else is asked for, below the camera's prefix.
WATCHED: Final = ("tracks", "retracks")
#: The tracks of the whole log: forecasts are compared with them, and with the ground truth.
_BECAME: Final = "retracks"
_EVENTS, _COUNTS = "/events", "/counts"
_ERRORS, _SCORES = "/errors", "/scores"


@dataclass(frozen=True)
class Watch:
    """Which channels of tracks events are made of; none named are the usual ones, and those that have events.

    With ``again`` they are made whether or not they stand; with ``anew``, too, as they were asked for before.
    """

    options: EventOptions = EventOptions()
    topics: tuple[str, ...] = ()
    again: bool = False
    anew: bool = False


def outputs(topic: str) -> tuple[str, ...]:
    """The topics that the events of a channel of tracks take."""
    return topic + _EVENTS, topic + _EVENTS + SUFFIX, topic + _COUNTS


def make_events(opened: log.Log, prefix: str, made: Mapping[str, Made], watch: Watch) -> dict[str, Made]:
    """Events of all watched channels where they are missing or out of date, and errors of predictions likewise.

    ``made`` are channels that were just made. What can't be compared with the ground truth is left out, with a warning.
    Raises McaptrackError for topics that were asked for and hold no tracks.
    """
    out: dict[str, Made] = {}
    topics = watch.topics or _watched(opened, prefix, made)
    if watch.again and not topics:
        raise McaptrackError(f"{opened.path} has no tracks of {prefix}; {call('run', opened.path)} makes them")

    @cache
    def truth() -> _Truth:
        return _read_truth(opened, camera_at(opened, prefix).truth)

    for topic in topics:
        options = watch.options if watch.again else _asked(opened, topic, watch.options)
        stands = _asked(opened, topic, EventOptions()) == options and not _is_due(opened, outputs(topic), made)
        if stands and not (watch.again or watch.anew):
            continue
        taken = _taken(opened, outputs(topic))
        if taken:
            if watch.topics:
                raise McaptrackError(f"{opened.path}: events would replace {taken}")
            warn(f"no events of {topic}: they would replace {taken}", "left-out")
            continue
        frames, tracks_digest = _rows(opened, topic, made)
        found = find_events(frames, truth().frames, options, opened.path.stem, topic)
        for words in found.notes:
            warn(words, "not-compared")
        parameters = found.parameters(options)
        provenance = Provenance(STAGE, parameters, topic, tracks_digest, references=truth().digests)
        out[topic + _EVENTS] = events = Made.of(EVENTS, found.events, provenance)
        words_of = list(log_messages(found.events, topic, opened.start_ns, found.frame_interval_s))
        view = Provenance(VIEW, {}, topic + _EVENTS, events.provenance.digest)
        out[topic + _EVENTS + SUFFIX] = Made(EVENTS, [], view, words_of, foxglove.schema_record(foxglove.LOG))
        out[topic + _COUNTS] = Made.of(COUNTS, found.counts, provenance)
    if not watch.topics:
        for name in FORECAST_INPUTS:
            out |= _forecast_errors(opened, prefix, name, made, watch.again or watch.anew, truth)
    return out


def _forecast_errors(
    opened: log.Log,
    prefix: str,
    name: str,
    made: Mapping[str, Made],
    again: bool,
    truth: Callable[[], _Truth],
) -> dict[str, Made]:
    """How far off the forecasts of one channel were, if they are there and that is missing or out of date."""
    topic, tracks, later = (f"{prefix}/{one}" for one in (name, FORECAST_INPUTS[name], _BECAME))
    if not _holds(opened, topic, made, PREDICTIONS) or not _holds(opened, tracks, made):
        return {}
    later = later if _holds(opened, later, made) else tracks
    topics = (topic + _ERRORS, topic + _SCORES)
    if not again and not _is_due(opened, topics, made) and later in _made_from(opened, topics[0]):
        return {}
    taken = _taken(opened, topics)
    if taken:
        warn(f"no errors of {topic}: they would replace {taken}", "left-out")
        return {}
    forecasts, digest_of_forecasts = _rows(opened, topic, made, PREDICTIONS)
    (from_tracks, of_tracks), (became, of_later) = (_rows(opened, one, made) for one in (tracks, later))
    try:
        found = find_forecast_errors(forecasts, from_tracks, truth().frames, became, topic)
    except McaptrackError as error:
        warn(f"no errors of forecasts: {error}", "not-compared")
        return {}
    references = truth().digests | {tracks: of_tracks, later: of_later}
    provenance = Provenance(STAGE, {}, topic, digest_of_forecasts, references=references)
    return {
        topics[0]: Made.of(FORECAST_ERRORS, found.errors, provenance),
        topics[1]: Made.of(FORECAST_SCORES, found.scores, provenance),
    }


def tally(happened: Mapping[str, Made]) -> dict[str, dict[str, int]]:
    """How many events of each kind, in words, each channel of tracks has."""
    out = {}
    for topic, channel in happened.items():
        if channel.schema is EVENTS and channel.record is None:
            kinds = EVENTS.joined([frame.rows for frame in channel.frames])["kind"]
            counts = np.bincount(kinds, minlength=max(EVENT_KINDS) + 1).tolist()
            out[topic.removesuffix(_EVENTS)] = {words: counts[kind] for kind, words in EVENT_KINDS.items()}
    return out


class _Truth(NamedTuple):
    """The true tracks of a camera, None if there are none, and their digest by topic: nothing where that holds
    something else.
    """

    frames: list[Frame] | None
    digests: dict[str, str]


def _read_truth(opened: log.Log, topic: str) -> _Truth:
    if topic not in opened.channels:
        return _Truth(None, {topic: ""})
    if not _holds(opened, topic):
        return _Truth(None, {})
    try:
        return _Truth(opened.frames(topic, TRACKS), {topic: digest_of(opened, topic)})
    except McaptrackError as error:
        warn(f"no misses, false tracks and switches: {error}", "not-compared")
        return _Truth(None, {})


def _watched(opened: log.Log, prefix: str, made: Mapping[str, Made]) -> list[str]:
    """The usual channels of tracks, and those of the camera that have events already."""
    topics = [f"{prefix}/{name}" for name in WATCHED]
    topics += [
        topic.removesuffix(_EVENTS)
        for topic in sorted(camera_at(opened, prefix).topics)
        if topic.endswith(_EVENTS) and may_replace(opened, topic, STAGE)
    ]
    return [topic for topic in dict.fromkeys(topics) if _holds(opened, topic, made)]


def _asked(opened: log.Log, topic: str, given: EventOptions) -> EventOptions:
    """The options that the events of a channel were made with, unless others are given now."""
    channel = opened.channels.get(topic + _EVENTS)
    known = Provenance.from_metadata(channel.metadata) if channel else None
    asked: Any = known.parameters.get("asked") if known and known.transform == STAGE else None
    if given != EventOptions() or not isinstance(asked, dict):
        return given
    similarity = asked.get("similarity")
    if similarity not in ("iou", "metres"):
        similarity = None
    if "gate" in asked:  # as version 0.1 said it
        asked = {"min_iou" if similarity == "iou" else "gate_m": asked["gate"]}
    gates = {name: gate for name in ("gate_m", "min_iou") if _is_gate(gate := asked.get(name))}
    return EventOptions(similarity, **gates)


def _is_gate(value: Any) -> bool:
    return isinstance(value, float | int) and not isinstance(value, bool) and value > 0


def _is_due(opened: log.Log, topics: Sequence[str], made: Mapping[str, Made]) -> bool:
    """Whether one of what the first of these topics was made with is missing, or was made from others than there are
    now.
    """
    if not all(topic in opened.channels for topic in topics) or is_stale(opened, topics[0]):
        return True
    was = _made_from(opened, topics[0])
    return not was or any(name in made and made[name].provenance.digest != then for name, then in was.items())


def _made_from(opened: log.Log, topic: str) -> dict[str, str]:
    known = Provenance.from_metadata(opened.channel(topic).metadata)
    return known.made_from() if known else {}


def _taken(opened: log.Log, topics: Sequence[str]) -> str:
    """The first of these topics that holds what events may not replace, and how that came; "" if there is none."""
    made_by = {topic: VIEW if topic.endswith(SUFFIX) else STAGE for topic in topics}
    taken = [topic for topic, transform in made_by.items() if not may_replace(opened, topic, transform)]
    return f"{taken[0]}, which {how_it_came(opened, taken[0])}" if taken else ""


def _holds(opened: log.Log, topic: str, made: Mapping[str, Made] = {}, schema: Schema = TRACKS) -> bool:
    """Whether rows of a schema stand in a channel, or were just made for it."""
    if topic in made:
        return made[topic].schema is schema
    channel = opened.channels.get(topic)
    return channel is not None and channel.schema_name == schema.name and channel.message_encoding == "protobuf"


def _rows(
    opened: log.Log, topic: str, made: Mapping[str, Made], schema: Schema = TRACKS
) -> tuple[Sequence[Frame], str]:
    """The frames of a channel, and their digest."""
    if topic in made:
        return made[topic].frames, made[topic].provenance.digest
    return opened.frames(topic, schema), digest_of(opened, topic)
