"""Run the last stage: find events of tracks and errors of forecasts, and write them beside their channels.

<tracks>/events             identity events (births, switches, misses, ...): rows of Events
<tracks>/events/view/log    the same events as text, for a viewer
<tracks>/counts             counts of tracks and tracking errors in each frame
<predictions>/errors        the error of each forecast in metres: rows of ForecastErrors
<predictions>/scores        the mean errors in each frame
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, NamedTuple, get_args

import numpy as np

from mcaptrack import foxglove, log
from mcaptrack.choices import Similarity
from mcaptrack.errors import McaptrackError, call
from mcaptrack.evaluation.event_text import SUFFIX, log_messages, nouns_of
from mcaptrack.evaluation.events import EventOptions, find_events
from mcaptrack.evaluation.forecasts import FORECAST_INPUTS, find_forecast_errors
from mcaptrack.notices import warn
from mcaptrack.pipeline.checks import describe_origin, may_replace
from mcaptrack.pipeline.motion import ground_truth_with
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
from mcaptrack.schema.classes import class_names
from mcaptrack.schema.framing import join_frames
from mcaptrack.schema.provenance import VIEW, Provenance
from mcaptrack.sources.cameras import camera_at, provenance_of, repaired_tracks

#: The name of the stage, in reports and in the provenance.
STAGE: Final = "events"
#: The channels of tracks that get events by default, below the camera's prefix.
WATCHED: Final = ("tracks", "retracks")
#: The offline tracks: forecasts are compared with them, and with the ground truth.
_OFFLINE: Final = "retracks"
_EVENTS, _COUNTS = "/events", "/counts"
_ERRORS, _SCORES = "/errors", "/scores"


@dataclass(frozen=True)
class Watch:
    """The channels of tracks to find events in, and the options for that.

    Without ``topics`` these are the default channels and those that have events already. With ``again`` events are
    found again with ``options`` even if they are up to date; with ``force`` also, but with the options they had before.
    """

    options: EventOptions = EventOptions()
    topics: tuple[str, ...] = ()
    again: bool = False
    force: bool = False


def outputs(topic: str) -> tuple[str, ...]:
    """Return the topics for the events of a channel of tracks."""
    return topic + _EVENTS, topic + _EVENTS + SUFFIX, topic + _COUNTS


def make_events(opened: log.Log, prefix: str, results: Mapping[str, Made], watch: Watch) -> dict[str, Made]:
    """Find the events of tracks and the errors of forecasts that are missing or out of date.

    ``results`` are those of this run, by topic. Returns the channels that it makes by topic. A channel that can't
    be compared with the ground truth is left out, with a warning. Raises McaptrackError for given topics that hold no
    tracks.
    """
    out: dict[str, Made] = {}
    topics = watch.topics or _default_topics(opened, prefix, results)
    if watch.again and not topics:
        raise McaptrackError(f"{opened.path} has no tracks of {prefix}; {call('run', opened.path)} makes them")

    @cache
    def truth() -> _GroundTruth:
        return _read_truth(opened, prefix, results)

    for topic in topics:
        options = watch.options if watch.again else _options_for(opened, topic, watch.options)
        has_same_options = _options_for(opened, topic, EventOptions()) == options
        is_up_to_date = has_same_options and not _is_outdated(opened, outputs(topic), results)
        if is_up_to_date and not (watch.again or watch.force):
            continue
        conflict = _find_conflict(opened, outputs(topic))
        if conflict:
            if watch.topics:
                raise McaptrackError(f"{opened.path}: events would replace {conflict}")
            warn(f"no events of {topic}: they would replace {conflict}", "left-out")
            continue
        frames, tracks_digest = _rows(opened, topic, results)
        names = class_names(
            results[topic].provenance.to_metadata() if topic in results else opened.channel(topic).metadata
        )
        classes = (truth().classes, names)
        origin = results[topic].provenance if topic in results else provenance_of(opened, topic)
        frames = repaired_tracks(frames, origin)
        track_events = find_events(frames, truth().frames, options, opened.path.stem, topic, classes)
        for note in track_events.notes:
            warn(note, "not-compared")
        parameters = track_events.parameters(options)
        provenance = Provenance(STAGE, parameters, topic, tracks_digest, references=truth().digests)
        out[topic + _EVENTS] = events = Made.of(EVENTS, track_events.events, provenance)
        nouns = nouns_of(truth().frames or (), frames, classes)
        text = list(log_messages(track_events.events, topic, opened.start_ns, track_events.frame_interval_s, nouns))
        view = Provenance(VIEW, {}, topic + _EVENTS, events.provenance.digest)
        out[topic + _EVENTS + SUFFIX] = Made(EVENTS, [], view, text, foxglove.LOG)
        out[topic + _COUNTS] = Made.of(COUNTS, track_events.counts, provenance)
    if not watch.topics:
        for name in FORECAST_INPUTS:
            out |= _forecast_errors(opened, prefix, name, results, watch.again or watch.force, truth)
    return out


def _forecast_errors(
    opened: log.Log,
    prefix: str,
    name: str,
    results: Mapping[str, Made],
    again: bool,
    truth: Callable[[], _GroundTruth],
) -> dict[str, Made]:
    """Find the errors of the forecasts in one channel, if the channel exists and its errors are missing or outdated."""
    topic, tracks, later = (f"{prefix}/{part}" for part in (name, FORECAST_INPUTS[name], _OFFLINE))
    if not _has_rows(opened, topic, results, PREDICTIONS) or not _has_rows(opened, tracks, results):
        return {}
    later = later if _has_rows(opened, later, results) else tracks
    topics = (topic + _ERRORS, topic + _SCORES)
    if not again and not _is_outdated(opened, topics, results) and later in _input_digests(opened, topics[0]):
        return {}
    conflict = _find_conflict(opened, topics)
    if conflict:
        warn(f"no errors of {topic}: they would replace {conflict}", "left-out")
        return {}
    forecasts, digest_of_forecasts = _rows(opened, topic, results, PREDICTIONS)
    (history, of_tracks), (offline, of_later) = (_rows(opened, each, results) for each in (tracks, later))
    try:
        forecast_errors = find_forecast_errors(forecasts, history, truth().frames, offline, topic)
    except McaptrackError as error:
        warn(f"no errors of forecasts: {error}", "not-compared")
        return {}
    references = truth().digests | {tracks: of_tracks, later: of_later}
    provenance = Provenance(STAGE, {}, topic, digest_of_forecasts, references=references)
    return {
        topics[0]: Made.of(FORECAST_ERRORS, forecast_errors.errors, provenance),
        topics[1]: Made.of(FORECAST_SCORES, forecast_errors.scores, provenance),
    }


def tally(results: Mapping[str, Made]) -> dict[str, dict[str, int]]:
    """Count the events of each kind for each channel of tracks: count by name of the kind, by topic of the tracks."""
    out = {}
    for topic, channel in results.items():
        if channel.schema is EVENTS and not channel.drawn:
            kinds = join_frames(EVENTS, channel.frames).rows["kind"]
            counts = np.bincount(kinds, minlength=max(EVENT_KINDS) + 1).tolist()
            out[topic.removesuffix(_EVENTS)] = {name: counts[kind] for kind, name in EVENT_KINDS.items()}
    return out


class _GroundTruth(NamedTuple):
    """The ground truth of a camera, None if there is none, and its digest by topic.

    The digest is "" if the log has no such topic; ``digests`` is empty if the topic holds no tracks. ``classes`` are
    the names of its classes.
    """

    frames: list[Frame] | None
    digests: dict[str, str]
    classes: Mapping[int, str] = {}


def _read_truth(opened: log.Log, prefix: str, results: Mapping[str, Made]) -> _GroundTruth:
    topic = camera_at(opened, prefix).truth
    if topic not in opened.channels:
        return _GroundTruth(None, {topic: ""})
    if not _has_rows(opened, topic):
        return _GroundTruth(None, {})
    try:
        names = class_names(opened.channel(topic).metadata)
        return _GroundTruth(ground_truth_with(opened, prefix, results), {topic: digest_of(opened, topic)}, names)
    except McaptrackError as error:
        warn(f"no misses, false tracks and switches: {error}", "not-compared")
        return _GroundTruth(None, {})


def _default_topics(opened: log.Log, prefix: str, results: Mapping[str, Made]) -> list[str]:
    """Return the default channels of tracks, and those of the camera that have events already."""
    topics = [f"{prefix}/{name}" for name in WATCHED]
    topics += [
        topic.removesuffix(_EVENTS)
        for topic in sorted(camera_at(opened, prefix).topics)
        if topic.endswith(_EVENTS) and may_replace(opened, topic, STAGE)
    ]
    return [topic for topic in dict.fromkeys(topics) if _has_rows(opened, topic, results)]


def _options_for(opened: log.Log, topic: str, requested: EventOptions) -> EventOptions:
    """Return the given options if they differ from the defaults, else those that the log's events were found with."""
    provenance = provenance_of(opened, topic + _EVENTS)
    asked: Any = provenance.parameters.get("asked") if provenance and provenance.transform == STAGE else None
    if requested != EventOptions() or not isinstance(asked, dict):
        return requested
    similarity = asked.get("similarity")
    if similarity not in get_args(Similarity):
        similarity = None
    gates = {name: gate for name in ("gate_m", "min_iou") if _is_gate(gate := asked.get(name))}
    return EventOptions(similarity, **gates)


def _is_gate(value: Any) -> bool:
    return isinstance(value, float | int) and not isinstance(value, bool) and value > 0


def _is_outdated(opened: log.Log, topics: Sequence[str], results: Mapping[str, Made]) -> bool:
    """Return whether one of these topics is missing, or an input of the first one has changed since."""
    if not all(topic in opened.channels for topic in topics) or is_stale(opened, topics[0]):
        return True
    then = _input_digests(opened, topics[0])
    return not then or any(
        name in results and results[name].provenance.digest != digest for name, digest in then.items()
    )


def _input_digests(opened: log.Log, topic: str) -> dict[str, str]:
    """Return the digests of a channel's inputs when it was made, by topic."""
    provenance = Provenance.from_metadata(opened.channel(topic).metadata)
    return provenance.made_from() if provenance else {}


def _find_conflict(opened: log.Log, topics: Sequence[str]) -> str:
    """Return the first of these topics that events may not replace, with its origin, as text; "" if there is none."""
    made_by = {topic: VIEW if topic.endswith(SUFFIX) else STAGE for topic in topics}
    taken = [topic for topic, transform in made_by.items() if not may_replace(opened, topic, transform)]
    return f"{taken[0]}, which {describe_origin(opened, taken[0])}" if taken else ""


def _has_rows(opened: log.Log, topic: str, results: Mapping[str, Made] = {}, schema: Schema = TRACKS) -> bool:
    """Return whether a channel of the log or of this run has the given schema."""
    if topic in results:
        return results[topic].schema is schema
    channel = opened.channels.get(topic)
    return channel is not None and channel.holds(schema)


def _rows(
    opened: log.Log, topic: str, results: Mapping[str, Made], schema: Schema = TRACKS
) -> tuple[Sequence[Frame], str]:
    """Return the frames of a channel, and the digest of its messages."""
    if topic in results:
        return results[topic].frames, results[topic].provenance.digest
    return opened.frame_columns(topic, schema), digest_of(opened, topic)
