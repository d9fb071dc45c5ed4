"""What a report says about one log: everything read and counted, nothing drawn yet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack import log, pipeline
from mcaptrack.errors import DamagedError, McaptrackError, command
from mcaptrack.evaluation import EvaluateOptions, EvaluationInput, EvaluationRow, evaluate, sequence_of_log
from mcaptrack.evaluation.aligned import has_positions, resample_frames
from mcaptrack.evaluation.events import EventOptions, MatchRule, find_events
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.plane import Planes, plane_at
from mcaptrack.schema import EVENTS, TRACKS, Frame
from mcaptrack.schema.framing import frame_times
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.pictures import Pictures
from mcaptrack.viewing.report import measures
from mcaptrack.viewing.report.markup import plain
from mcaptrack.viewing.report.moments import Moment, Story, most_important, photograph, tell
from mcaptrack.viewing.report.scenery import Backdrop, backdrop

#: The channels of a camera that a report is about, and the part that each plays in it: its colour.
ROLES: Final = {
    "tracks": "tracks",
    "samples": "samples",
    "retracks/online": "online",
    "retracks": "offline",
    "truth": "truth",
}
_TRACKERS: Final = {"sort": "SORT", "bytetrack": "ByteTrack", "ocsort": "OC-SORT"}
#: Events are told of these.
_TOLD: Final = ("tracks", "offline")
#: So many of them are shown.
_THUMBNAILS: Final = 12


@dataclass
class TrackSet:
    """A channel of tracks: the part it plays, what people call it, and its frames."""

    topic: str
    role: str
    name: str
    frames: list[Frame]


@dataclass
class LogReport:
    """All about one log. ``data`` is what goes into the page as JSON; ``lacks`` says why a section has nothing."""

    file: str
    name: str
    prefix: str
    start_ns: int
    end_ns: int
    sets: dict[str, TrackSet] = field(default_factory=dict)
    sequence: EvaluationInput | None = None
    results: list[EvaluationRow] = field(default_factory=list)
    stories: list[Story] = field(default_factory=list)
    shown: list[list[Moment]] = field(default_factory=list)
    planes: Planes = ()
    behind: Backdrop | None = None
    data: dict[str, Any] = field(default_factory=dict)
    lacks: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    drawn: str = ""

    @property
    def start_s(self) -> float:
        """When the log begins."""
        return self.start_ns / NS_PER_S

    @property
    def clocked(self) -> dict[str, TrackSet]:
        """The tracks that are on the same clock: those of prediction, or else the tracker's."""
        there = {role: one for role, one in self.sets.items() if role in ("samples", "offline")}
        return there or {role: one for role, one in self.sets.items() if role == "tracks"}

    @property
    def is_assumed(self) -> bool:
        """Whether metres are guessed."""
        return any(plane.assumed for _, plane in self.planes)


def gather(opened: log.Log, camera: str | None, progress: Callable[[str], None] = lambda _: None) -> LogReport:
    """Read and count everything about one camera of a log.

    Raises McaptrackError where the log is damaged, or has several cameras and none is chosen.
    """
    prefix = pipeline.find_camera(opened, camera)
    out = LogReport(opened.path.name, opened.path.stem, prefix, opened.start_ns, opened.end_ns)
    _read(opened, out)
    progress(f"{opened.path}: scores")
    _score(opened, out)
    progress(f"{opened.path}: events")
    _tell(opened, out)
    progress(f"{opened.path}: pictures")
    _look(opened, out)
    out.data = plain(_recording(opened) | {"name": out.name, "camera": prefix} | _numbers(out) | {"notes": out.notes})
    return out


def _said(error: McaptrackError, opened: log.Log) -> str:
    """A fault in words; where the log lies on this machine is nobody's business who reads the page."""
    return str(error).replace(str(opened.path), opened.path.name)


def _read(opened: log.Log, out: LogReport) -> None:
    """The tracks, and the ground."""
    camera = pipeline.camera_at(opened, out.prefix)
    channel = opened.channels.get(f"{out.prefix}/tracks")
    made = Provenance.from_metadata(channel.metadata) if channel else None
    by = _TRACKERS.get(str(made.parameters.get("tracker", "sort")), "tracker") if made else "tracker"
    tracker = by if made and made.transform == "track" else "tracks as given"
    names = {
        "tracks": tracker,
        "samples": f"{tracker}, sampled",
        "online": "re-tracked online",
        "offline": "re-tracked",
        "truth": "truth",
    }
    for below, role in ROLES.items():
        topic = camera.truth if role == "truth" else f"{out.prefix}/{below}"
        there = opened.channels.get(topic)
        if there is None:
            continue
        if there.schema_name != TRACKS.name or there.message_encoding != "protobuf":
            out.notes.append(f"{topic} holds {there.schema_name or 'no schema'}, not tracks; it is left out")
            continue
        out.sets[role] = TrackSet(topic, role, names[role], opened.frames(topic, TRACKS))
    try:
        out.planes = pipeline.read_planes(opened, out.prefix) or ()
    except DamagedError:
        raise
    except McaptrackError as error:
        out.notes.append(_said(error, opened))


def _score(opened: log.Log, out: LogReport) -> None:
    path = opened.path.name
    if "truth" not in out.sets:
        out.lacks["scores"] = (
            "How right the tracks are can't be said: the log has no truth. Add labels with "
            f"{command('ingest', 'LABELS', '--as', 'truth', '--into', Path(path))}."
        )
        return
    try:
        out.sequence = sequence_of_log(opened, out.prefix, ())
        outcome = evaluate([out.sequence], EvaluateOptions())
    except DamagedError:
        raise
    except McaptrackError as error:
        out.lacks["scores"] = f"Nothing could be scored: {_said(error, opened)}."
        return
    out.results = outcome.results
    out.notes += outcome.notes


def _tell(opened: log.Log, out: LogReport) -> None:
    """Events of the channels that are told of: those of the log, or made now where it has none that hold."""
    truth = out.sets["truth"].frames if "truth" in out.sets else None
    for role in _TOLD:
        tracks = out.sets.get(role)
        if tracks is None or not any(len(frame.rows) for frame in tracks.frames):
            continue
        known = _recorded(opened, tracks.topic + "/events")
        if known is None:
            found = find_events(tracks.frames, truth, EventOptions(), out.name, tracks.topic)
            known = found.events, found.rule
        events, rule = known
        out.stories.append(tell(tracks.topic, events, rule, tracks.frames, truth, (out.start_ns, out.end_ns)))
    out.shown = most_important(out.stories, _THUMBNAILS)


def _recorded(opened: log.Log, topic: str) -> tuple[list[Frame], MatchRule | None] | None:
    """Events that stand in the log and by what rule they were matched, unless they are out of date."""
    channel = opened.channels.get(topic)
    made = Provenance.from_metadata(channel.metadata) if channel else None
    if channel is None or made is None or channel.schema_name != EVENTS.name or pipeline.is_stale(opened, topic):
        return None
    similarity, gate = made.parameters.get("similarity"), made.parameters.get("gate")
    rule = None
    if similarity in ("iou", "metres") and isinstance(gate, float | int):
        rule = MatchRule(similarity, float(gate))
    return opened.frames(topic, EVENTS), rule


def _look(opened: log.Log, out: LogReport) -> None:
    topic = pipeline.camera_at(opened, out.prefix).pictures
    if topic is None:
        out.lacks["pictures"] = "The log has no pictures of the scene"
        return
    try:
        pictures = Pictures(opened, topic)
        out.behind = backdrop(pictures)
        for story, moments in zip(out.stories, out.shown, strict=True):
            tracks = next(one for one in out.sets.values() if one.topic == story.topic)
            photograph(moments, tracks.frames, pictures, out.start_ns)
    except DamagedError:
        raise
    except McaptrackError as error:
        out.lacks["pictures"] = f"The pictures can't be shown: {_said(error, opened)}"
        return
    if out.behind is None:
        out.lacks["pictures"] = f"{topic} holds no pictures"


def _numbers(out: LogReport) -> dict[str, Any]:
    """What is counted, as JSON."""
    sets = [
        {"topic": one.topic, "name": one.name, "role": one.role} | measures.describe_tracks(one.frames)
        for one in out.sets.values()
    ]
    clocked = {one.topic: one.frames for one in out.clocked.values()}
    if "truth" in out.sets:
        truth = out.sets["truth"]
        at_ns = np.unique(np.concatenate([np.empty(0, np.int64), *map(frame_times, clocked.values())]))
        clocked[truth.topic] = resample_frames(truth.frames, at_ns) if len(at_ns) else truth.frames
    metric = {topic: frames for topic, frames in clocked.items() if has_positions(frames, "metres")}
    return {
        "tracks": sets,
        "forecasts": measures.describe_forecasts(out.sequence, out.results) if out.sequence else [],
        "events": [story.to_json() for story in out.stories],
        "speed_m_per_s": measures.histograms({t: measures.speeds_m_per_s(frames) for t, frames in metric.items()}),
        "dwell_s": measures.histograms({topic: measures.lives_s(frames) for topic, frames in clocked.items()}),
        "ground_plane": None if not out.planes else "assumed" if out.is_assumed else "given",
    }


def _recording(opened: log.Log) -> dict[str, Any]:
    """What the log is, and how each of its channels was made."""
    messages = sum(sum(part.index.counts.values()) for part in opened.parts)
    return {
        "log": opened.path.name,
        "results_file": opened.results.path.name if opened.results else None,
        "bytes": sum(part.size for part in opened.parts),
        "messages": messages,
        "start_ns": opened.start_ns if messages else None,
        "end_ns": opened.end_ns if messages else None,
        "duration_s": (opened.end_ns - opened.start_ns) / NS_PER_S if messages else 0.0,
        "digest": opened.fingerprint(),
        "channels": [_channel(opened, channel) for _, channel in sorted(opened.channels.items())],
    }


def _channel(opened: log.Log, channel: log.Channel) -> dict[str, Any]:
    made = Provenance.from_metadata(channel.metadata)
    names = ("transform", "input", "version", "weights_sha256", "digest", "input_digest")
    return {
        "topic": channel.topic,
        "schema": channel.schema_name,
        "encoding": channel.message_encoding,
        "messages": channel.messages,
        **{key: (getattr(made, key) or None) if made else None for key in names},
        "references": dict(made.references) if made else {},
        "parameters": dict(made.parameters) if made else None,
        "stale": pipeline.is_stale(opened, channel.topic),
    }


def plane_of(report: LogReport) -> Any:
    """The ground plane at the beginning of the log, if there is one."""
    return plane_at(report.planes, report.start_ns)


def result_of(results: Sequence[EvaluationRow], topic: str, similarity: str, gate: float) -> EvaluationRow | None:
    """The score of a channel by one rule."""
    return next((r for r in results if (r.tracks, r.similarity, r.gate) == (topic, similarity, gate)), None)
