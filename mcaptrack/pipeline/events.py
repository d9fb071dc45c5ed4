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
from functools import cache, partial
from typing import Any, ClassVar, Final, NamedTuple, get_args

from mcaptrack import foxglove, log
from mcaptrack.choices import Similarity
from mcaptrack.errors import McaptrackError, call
from mcaptrack.evaluation.event_text import SUFFIX, log_messages, nouns_of
from mcaptrack.evaluation.events import EventOptions, find_events
from mcaptrack.evaluation.forecasts import FORECAST_INPUTS, find_forecast_errors
from mcaptrack.geometry.plane import Planes
from mcaptrack.notices import warn
from mcaptrack.pipeline.checks import may_add, may_replace
from mcaptrack.pipeline.motion import ground_truth_with
from mcaptrack.pipeline.staleness import digest_of, is_outdated
from mcaptrack.pipeline.write import Made, RunState
from mcaptrack.schema import COUNTS, EVENTS, FORECAST_ERRORS, FORECAST_SCORES, PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.classes import class_names
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
    name: ClassVar[str] = STAGE

    def make(self, state: RunState, planes: Planes, stamps: Mapping[str, Sequence[int]]) -> dict[str, Made]:
        """Find the events of tracks and the errors of forecasts that are missing or out of date.

        Returns the channels that it makes by topic. A channel that can't be compared with the ground truth is left out,
        with a warning. Raises McaptrackError for given topics that hold no tracks.
        """
        opened, prefix, *_ = state
        out: dict[str, Made] = {}
        topics = [opened.find(topic, prefix) for topic in self.topics] or _default_topics(state)
        if self.again and not topics:
            raise McaptrackError(f"{opened.path} has no tracks of {prefix}; {call('run', opened.path)} makes them")
        truth = cache(partial(_read_truth, state))
        for topic in topics:
            options = self.options if self.again else _options_for(opened, topic, self.options)
            has_same_options = _options_for(opened, topic, EventOptions()) == options
            is_up_to_date = has_same_options and not is_outdated(state, outputs(topic))
            if is_up_to_date and not (self.again or self.force):
                continue
            if may_add(opened, outputs(topic), STAGE, f"events of {topic}", bool(self.topics)):
                out |= _events_of(state, topic, options, truth())
        if not self.topics:
            for name in FORECAST_INPUTS:
                out |= _forecast_errors(state, name, self.again or self.force, truth)
        return out


def outputs(topic: str) -> tuple[str, ...]:
    """Return the topics for the events of a channel of tracks."""
    return topic + _EVENTS, topic + _EVENTS + SUFFIX, topic + _COUNTS


def _events_of(state: RunState, topic: str, options: EventOptions, truth: _GroundTruth) -> dict[str, Made]:
    """Find the events of one channel of tracks, and count tracks and errors in its frames."""
    opened, classes = state.opened, (truth.classes, state.classes(topic))
    tracks = state.results[topic].frames if topic in state.results else opened.frame_columns(topic, TRACKS)
    frames = repaired_tracks(tracks, state.provenance(topic))
    track_events = find_events(frames, truth.frames, options, opened.path.stem, topic, classes)
    for note in track_events.notes:
        warn(note, "not-compared")
    parameters = track_events.parameters(options)
    provenance = Provenance(STAGE, parameters, topic, state.digest(topic), references=truth.digests)
    events = Made.of(EVENTS, track_events.events, provenance)
    nouns = nouns_of(truth.frames or (), frames, classes)
    text = list(log_messages(track_events.events, topic, opened.start_ns, track_events.frame_interval_s, nouns))
    view = Provenance(VIEW, {}, topic + _EVENTS, events.provenance.digest)
    return {
        topic + _EVENTS: events,
        topic + _EVENTS + SUFFIX: Made(EVENTS, [], view, text, foxglove.LOG),
        topic + _COUNTS: Made.of(COUNTS, track_events.counts, provenance),
    }


def _forecast_errors(state: RunState, name: str, again: bool, truth: Callable[[], _GroundTruth]) -> dict[str, Made]:
    """Find the errors of the forecasts in one channel, if the channel exists and its errors are missing or outdated."""
    topic, tracks, later = (f"{state.prefix}/{part}" for part in (name, FORECAST_INPUTS[name], _OFFLINE))
    if not state.holds(topic, PREDICTIONS) or not state.holds(tracks, TRACKS):
        return {}
    later = later if state.holds(later, TRACKS) else tracks
    topics = (topic + _ERRORS, topic + _SCORES)
    how = provenance_of(state.opened, topics[0])
    if not again and not is_outdated(state, topics) and how and later in how.made_from():
        return {}
    if not may_add(state.opened, topics, STAGE, f"errors of {topic}"):
        return {}
    history, offline = state.frames(tracks), state.frames(later)
    try:
        forecast_errors = find_forecast_errors(
            state.frames(topic, PREDICTIONS), history, truth().frames, offline, topic
        )
    except McaptrackError as error:
        warn(f"no errors of forecasts: {error}", "not-compared")
        return {}
    references = truth().digests | {each: state.digest(each) for each in (tracks, later)}
    provenance = Provenance(STAGE, {}, topic, state.digest(topic), references=references)
    return {
        topics[0]: Made.of(FORECAST_ERRORS, forecast_errors.errors, provenance),
        topics[1]: Made.of(FORECAST_SCORES, forecast_errors.scores, provenance),
    }


class _GroundTruth(NamedTuple):
    """The ground truth of a camera, None if there is none, and its digest by topic.

    The digest is "" if the log has no such topic; ``digests`` is empty if the topic holds no tracks. ``classes`` are
    the names of its classes.
    """

    frames: list[Frame] | None
    digests: dict[str, str]
    classes: Mapping[int, str] = {}


def _read_truth(state: RunState) -> _GroundTruth:
    opened = state.opened
    topic = camera_at(opened, state.prefix).truth
    if topic not in opened.channels:
        return _GroundTruth(None, {topic: ""})
    if not opened.channels[topic].holds(TRACKS):
        return _GroundTruth(None, {})
    try:
        names = class_names(opened.channel(topic).metadata)
        return _GroundTruth(ground_truth_with(state), {topic: digest_of(opened, topic)}, names)
    except McaptrackError as error:
        warn(f"no misses, false tracks and switches: {error}", "not-compared")
        return _GroundTruth(None, {})


def _default_topics(state: RunState) -> list[str]:
    """Return the default channels of tracks, and those of the camera that have events already."""
    topics = [f"{state.prefix}/{name}" for name in WATCHED]
    topics += [
        topic.removesuffix(_EVENTS)
        for topic in sorted(camera_at(state.opened, state.prefix).topics)
        if topic.endswith(_EVENTS) and may_replace(state.opened, topic, STAGE)
    ]
    return [topic for topic in dict.fromkeys(topics) if state.holds(topic, TRACKS)]


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
