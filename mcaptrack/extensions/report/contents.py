"""The contents of a report on one log: everything read and computed, nothing rendered yet."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, get_args

import numpy as np

from mcaptrack import log, pipeline
from mcaptrack.choices import Similarity
from mcaptrack.contracts import ReportSection
from mcaptrack.errors import DamagedError, McaptrackError, command
from mcaptrack.evaluation import EvaluateOptions, EvaluationInput, EvaluationRow, evaluate, sequence_of_log
from mcaptrack.evaluation.aligned import has_positions, resample_frames
from mcaptrack.evaluation.event_text import PEOPLE, nouns_of
from mcaptrack.evaluation.events import EventOptions, MatchRule, find_events
from mcaptrack.evaluation.people import PersonScores, person_scores
from mcaptrack.extensions.report import statistics
from mcaptrack.extensions.report.headline import AFTER, BEFORE, BeforeAfter, compared
from mcaptrack.extensions.report.identity_events import (
    ChannelEvents,
    Doubt,
    DoubtfulTrack,
    IdentityEvent,
    add_thumbnails,
    find_doubtful_tracks,
    find_doubts,
    most_important,
    summarize_events,
)
from mcaptrack.extensions.report.scene_map import forecast_map
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.plane import Planes, is_estimated, origin_of, plane_at
from mcaptrack.registry import find, others
from mcaptrack.schema import DECISIONS, EVENTS, PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.classes import class_names
from mcaptrack.schema.framing import frame_times
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.camera_motion import read_ground_truth
from mcaptrack.sources.cameras import provenance_of, repaired_tracks
from mcaptrack.sources.corrections import CORRECTED
from mcaptrack.sources.pictures import Pictures
from mcaptrack.viewing.formatting import clock, plain, section_of, short, tracker_name
from mcaptrack.viewing.painting import SceneBackground, background_picture, moment_picture

#: The channels of a camera in a report, and the role of each, which gives its colour.
ROLES: Final = {
    "tracks": "tracks",
    "samples": "samples",
    "retracks/online": "online",
    "retracks": "offline",
    "truth": "truth",
}
#: What is added to the name of tracks at the video rate, beside those at the prediction rate that are compared.
EVERY_PICTURE: Final = ", every picture"
#: The channels of forecasts below the name of a camera, the best first, and the roles of their tracks.
_FORECASTS: Final = {"retracks/predictions": "online", "predictions": "samples"}
#: The number of events with thumbnails.
_THUMBNAILS: Final = 12


@dataclass
class TrackSet:
    """A channel of tracks: its topic, role, name for people, and frames."""

    topic: str
    role: str
    name: str
    frames: list[Frame]


@dataclass
class LogReport:
    """A report on one log. ``data`` goes into the page as JSON; ``missing`` says why a section has nothing.

    ``file`` and ``name`` tell the log from others, ``prefix`` is the camera; it lasts from ``start_ns`` to ``end_ns``.
    ``track_sets`` are the tracks by role, ``sequence`` is what is scored, ``results`` are the scores.
    ``channel_events`` are the events of each channel, ``highlights`` the most important of them, and ``repairs`` those
    of the re-tracked ones. ``planes`` are the ground planes, ``background`` is a picture of the scene and
    ``forecast_scene`` a map of forecasts. ``people`` are scores by person, ``doubts`` and ``doubtful_tracks`` what
    re-tracking is least sure of. ``notes`` and ``warnings`` are lines of text, ``html`` is the part of the page once it
    is drawn. ``sections`` are those of packages, by name; ``has_only_people``: no other class occurs.
    """

    file: str
    name: str
    prefix: str
    start_ns: int
    end_ns: int
    track_sets: dict[str, TrackSet] = field(default_factory=dict)
    sequence: EvaluationInput | None = None
    results: list[EvaluationRow] = field(default_factory=list)
    channel_events: list[ChannelEvents] = field(default_factory=list)
    highlights: list[list[IdentityEvent]] = field(default_factory=list)
    repairs: ChannelEvents | None = None
    planes: Planes = ()
    background: SceneBackground | None = None
    forecast_scene: dict[str, Any] | None = None
    data: dict[str, Any] = field(default_factory=dict)
    people: dict[str, PersonScores] = field(default_factory=dict)
    doubts: list[Doubt] = field(default_factory=list)
    doubtful_tracks: list[DoubtfulTrack] = field(default_factory=list)
    missing: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    html: str = ""
    sections: dict[str, ReportSection] = field(default_factory=dict)
    has_only_people: bool = True

    @property
    def start_s(self) -> float:
        """The start of the log in seconds."""
        return self.start_ns / NS_PER_S

    @property
    def on_prediction_clock(self) -> dict[str, TrackSet]:
        """The tracks at the prediction rate; without any, those of the tracker."""
        resampled = {role: track_set for role, track_set in self.track_sets.items() if role in ("samples", "offline")}
        return resampled or {role: track_set for role, track_set in self.track_sets.items() if role == "tracks"}

    @property
    def headline(self) -> BeforeAfter | None:
        """The scores before and after re-tracking that the whole page counts by; None without scores."""
        return self.compared_in(self.results)

    def compared_in(self, results: Sequence[EvaluationRow]) -> BeforeAfter | None:
        """The scores before and after re-tracking among these; None without any."""
        return compared({role: track_set.topic for role, track_set in self.track_sets.items()}, results)

    @property
    def compared_roles(self) -> tuple[str, str]:
        """The roles of tracks before and after re-tracking; "" for those that are missing."""
        headline = self.headline
        if headline is not None:
            return headline.roles
        before, after = (next((role for role in roles if role in self.track_sets), "") for roles in (BEFORE, AFTER))
        return before, after

    @property
    def metres_note(self) -> str:
        """The remark on metres for a ground plane that was not measured; otherwise ""."""
        if not any(plane.assumed for _, plane in self.planes):
            return ""
        if is_estimated(self.planes):
            return " Metres are from a ground plane that was estimated from boxes of people: it was not measured."
        return " Metres are guessed from the size of people: the ground was not measured."


def gather(
    opened: log.Log,
    camera: str | None,
    progress: Callable[[str], None] = lambda _: None,
    file: str = "",
    name: str = "",
) -> LogReport:
    """Read and compute everything about one camera of a log.

    ``file`` and ``name`` tell it from the other logs of a page; by default those of its file, with and without suffix.

    Raises McaptrackError for a damaged log, and for one with several cameras if none is chosen.

    ``progress`` is called with a line for each step.
    """
    prefix = pipeline.find_camera(opened, camera)
    file, name = file or opened.path.name, name or opened.path.stem
    out = LogReport(file, name, prefix, opened.start_ns, opened.end_ns)
    _read(opened, out)
    made = (Provenance.from_metadata(channel.metadata) for _, channel in sorted(opened.channels.items()))
    messages = (message for provenance in made if provenance for _, message in provenance.warnings)
    out.warnings = [text.replace(str(opened.path), opened.path.name) for text in dict.fromkeys(messages)]
    progress(f"{opened.path}: scores")
    _score(opened, out)
    progress(f"{opened.path}: events")
    _compare_people(opened, out)
    _find_events(opened, out)
    if out.repairs is not None:
        after = out.compared_roles[1]
        decisions = _decisions(opened, out.repairs.topic)
        out.doubts = find_doubts(out.repairs, out.track_sets[after].frames, out.people.get(after), decisions)
        out.doubtful_tracks = find_doubtful_tracks(decisions)
    progress(f"{opened.path}: pictures")
    _read_pictures(opened, out)
    _add_sections(opened, out)
    out.data = plain(
        _recording(opened)
        | {"name": out.name, "camera": prefix}
        | _statistics(out)
        | {"notes": out.notes, "warnings": out.warnings}
    )
    return out


def _add_sections(opened: log.Log, out: LogReport) -> None:
    """Add the sections of installed packages."""
    names = {role: track_set.name for role, track_set in out.track_sets.items()}
    for name in others("report_section"):
        if (section := section_of(find("report_section", name), opened, out.prefix, names)) is not None:
            out.sections[name] = section


@contextmanager
def _noting(opened: log.Log, note: Callable[[str], object]) -> Iterator[None]:
    """Note an error without the folder of the log, which readers of the page need not know; damage ends the page."""
    try:
        yield
    except DamagedError:
        raise
    except McaptrackError as error:
        note(str(error).replace(str(opened.path), opened.path.name))


def _read(opened: log.Log, out: LogReport) -> None:
    """Read the tracks and the ground planes."""
    camera = pipeline.camera_at(opened, out.prefix)
    tracker = tracker_name(provenance_of(opened, f"{out.prefix}/tracks"))
    sampled = provenance_of(opened, f"{out.prefix}/samples")
    is_corrected = sampled is not None and any(reference.endswith(f"/{CORRECTED}") for reference in sampled.references)
    names = {
        "tracks": f"{tracker}{EVERY_PICTURE}" if f"{out.prefix}/samples" in opened.channels else tracker,
        "samples": f"{tracker}, corrected" if is_corrected else tracker,
        "online": "re-tracked online",
        "offline": "re-tracked",
        "truth": "ground truth",
    }
    for below, role in ROLES.items():
        topic = camera.truth if role == "truth" else f"{out.prefix}/{below}"
        channel = opened.channels.get(topic)
        if channel is None:
            continue
        if not channel.holds(TRACKS):
            out.notes.append(f"{topic} holds {channel.schema_name or 'no schema'}, not tracks; it is left out")
            continue
        with _noting(opened, out.notes.append):
            frames = read_ground_truth(opened, out.prefix) if role == "truth" else opened.frames(topic, TRACKS)
            out.track_sets[role] = TrackSet(topic, role, names[role], frames)
    out.has_only_people = all(
        nouns_of(track_set.frames, (), (class_names(opened.channel(track_set.topic).metadata), {})) is PEOPLE
        for track_set in out.track_sets.values()
    )
    with _noting(opened, out.notes.append):
        out.planes = pipeline.read_planes(opened, out.prefix) or ()


def _score(opened: log.Log, out: LogReport) -> None:
    path = opened.path.name
    if "truth" not in out.track_sets:
        out.missing["scores"] = (
            "The tracks can't be scored: the log has no ground truth. Add labels with "
            f"{command('ingest', 'LABELS', '--as', 'truth', '--into', Path(path))}."
        )
        return
    with _noting(opened, lambda text: out.missing.update(scores=f"Nothing could be scored: {text}.")):
        out.sequence = sequence_of_log(opened, out.prefix, ())
        out.sequence.name = out.name
        outcome = evaluate([out.sequence], EvaluateOptions())
        out.results = outcome.results
        out.notes += outcome.notes
        if (labelled := out.sequence.labelled.frames) is not None:
            out.notes.append(f"only the frames {labelled} of the ground truth were labelled and scored")


def _classes(opened: log.Log, out: LogReport, topic: str) -> tuple[dict[int, str], dict[int, str]]:
    """The names of the classes of the ground truth, and of tracks."""
    truth = out.track_sets["truth"].topic if "truth" in out.track_sets else topic
    return class_names(opened.channel(truth).metadata), class_names(opened.channel(topic).metadata)


def _compare_people(opened: log.Log, out: LogReport) -> None:
    """Compare tracks before and after re-tracking with each true person, by the rule of the headline."""
    headline = out.headline
    if headline is None:
        return
    for role in filter(None, headline.roles):
        tracks = out.track_sets[role]
        rule = MatchRule(*headline.rule)  # type: ignore[arg-type]  # a similarity
        classes = _classes(opened, out, tracks.topic)
        scores = person_scores(out.track_sets["truth"].frames, tracks.frames, rule, (out.name, tracks.topic), classes)
        if scores is not None:
            out.people[role] = scores


def _find_events(opened: log.Log, out: LogReport) -> None:
    """Read or compute the events of tracks before and after re-tracking, counted by the rule of the headline."""
    ground_truth = out.track_sets["truth"].frames if "truth" in out.track_sets else None
    headline = out.headline
    options = EventOptions()
    if headline is not None:
        similarity, gate = headline.rule
        options = EventOptions(similarity, **{"gate_m" if similarity == "metres" else "min_iou": gate})  # type: ignore[arg-type]
    for role in filter(None, out.compared_roles):
        tracks = out.track_sets[role]
        if not any(len(frame.rows) for frame in tracks.frames):
            continue
        counted_events = _recorded(opened, tracks.topic + "/events")
        classes = _classes(opened, out, tracks.topic)
        if counted_events is None or (headline is not None and counted_events[1] != headline.rule):
            frames = repaired_tracks(tracks.frames, provenance_of(opened, tracks.topic))
            track_events = find_events(frames, ground_truth, options, out.name, tracks.topic, classes)
            counted_events = track_events.events, track_events.rule
        events, rule = counted_events
        span_ns = (out.start_ns, out.end_ns)
        args = (tracks.frames, ground_truth, span_ns, classes)
        out.channel_events.append(summarize_events(tracks.topic, events, rule, *args))
        if role in AFTER:
            out.repairs = summarize_events(tracks.topic, events, None, *args)
    out.highlights = most_important(out.channel_events, _THUMBNAILS)


def _decisions(opened: log.Log, topic: str) -> list[Frame]:
    """The decisions of re-tracking about a channel of tracks; none if there are none, or if they are out of date."""
    below = f"{topic}/decisions"
    is_known = opened.holds(below, DECISIONS) and not pipeline.is_stale(opened, below)
    return opened.frames(below, DECISIONS) if is_known else []


def _recorded(opened: log.Log, topic: str) -> tuple[list[Frame], MatchRule | None] | None:
    """The events in the log and the rule of their matches; None if there are none or they are out of date."""
    provenance = provenance_of(opened, topic)
    if provenance is None or not opened.holds(topic, EVENTS) or pipeline.is_stale(opened, topic):
        return None
    similarity: Any = provenance.parameters.get("similarity")
    gate = provenance.parameters.get("gate")
    rule = None
    if similarity in get_args(Similarity) and isinstance(gate, float | int):
        rule = MatchRule(similarity, float(gate))
    return opened.frames(topic, EVENTS), rule


def _read_pictures(opened: log.Log, out: LogReport) -> None:
    topic = pipeline.camera_at(opened, out.prefix).pictures
    if topic is None:
        out.missing["pictures"] = "The log has no pictures of the scene"
        return
    with _noting(opened, lambda text: out.missing.update(pictures=f"The pictures can't be shown: {text}")):
        pictures = Pictures(opened, topic)
        out.background = background_picture(pictures)
        out.forecast_scene = _forecast_scene(opened, out, pictures)
        for channel, events in zip(out.channel_events, out.highlights, strict=True):
            add_thumbnails(events, _with_boxes(out, channel.topic), pictures, out.start_ns)
        if out.doubts and out.repairs is not None:
            tracks = _with_boxes(out, out.repairs.topic)
            add_thumbnails([doubt.event for doubt in out.doubts], tracks, pictures, out.start_ns)
        if out.background is None:
            out.missing["pictures"] = f"{topic} holds no pictures"


def _forecast_scene(opened: log.Log, out: LogReport, pictures: Pictures) -> dict[str, Any] | None:
    """The forecasts of the time with the most of them, over its picture; None without forecasts or a ground plane."""
    for below, role in _FORECASTS.items():
        topic = f"{out.prefix}/{below}"
        if not opened.holds(topic, PREDICTIONS):
            continue
        chosen = max(
            opened.frames(topic, PREDICTIONS),
            key=lambda frame: len(np.unique(frame.rows["track_id"])),
            default=None,
        )
        plane = plane_at(out.planes, chosen.t_ns) if chosen is not None and len(chosen.rows) else None
        behind = moment_picture(pictures, chosen.t_ns) if chosen is not None and plane is not None else None
        if chosen is None or plane is None or behind is None:
            continue
        past = out.track_sets.get(role)
        future = out.track_sets["truth"].frames if "truth" in out.track_sets else []
        drawn = forecast_map(chosen.rows, past.frames if past else [], future, chosen.t_ns, behind, plane)
        names = {"name": short(past.name) if past else topic, "role": role}
        at = clock((chosen.t_ns - out.start_ns) / NS_PER_S)
        return drawn | names | {"t_ns": chosen.t_ns, "clock": at, "has_truth": bool(future)}
    return None


def _with_boxes(out: LogReport, topic: str) -> list[Frame]:
    """The rows of tracks with boxes in pictures: of the tracker instead of its samples, with the same ids."""
    role = next(track_set.role for track_set in out.track_sets.values() if track_set.topic == topic)
    return out.track_sets["tracks" if role == "samples" and "tracks" in out.track_sets else role].frames


def _statistics(out: LogReport) -> dict[str, Any]:
    """All statistics, as JSON."""
    track_sets = [
        {"topic": track_set.topic, "name": track_set.name, "role": track_set.role}
        | statistics.track_statistics(track_set.frames)
        for track_set in out.track_sets.values()
    ]
    resampled = {track_set.topic: track_set.frames for track_set in out.on_prediction_clock.values()}
    if "truth" in out.track_sets:
        ground_truth = out.track_sets["truth"]
        at_ns = np.unique(np.concatenate([np.empty(0, np.int64), *map(frame_times, resampled.values())]))
        resampled[ground_truth.topic] = (
            resample_frames(ground_truth.frames, at_ns) if len(at_ns) else ground_truth.frames
        )
    metric = {topic: frames for topic, frames in resampled.items() if has_positions(frames, "metres")}
    return {
        "tracks": track_sets,
        "forecasts": statistics.forecast_statistics(out.sequence, out.results) if out.sequence else [],
        "track_list": {
            role: statistics.list_tracks(out.track_sets[role].frames, out.start_ns)
            for role in [role for role in out.compared_roles if role in out.track_sets][-1:]
        },
        "events": [channel.to_json() for channel in out.channel_events],
        "speed_m_per_s": statistics.histograms({t: statistics.speeds_m_per_s(frames) for t, frames in metric.items()}),
        "dwell_s": statistics.histograms(
            {topic: statistics.durations_s(frames) for topic, frames in resampled.items()}
        ),
        "ground_plane": origin_of(out.planes) if out.planes else None,
    } | {name: section.data for name, section in out.sections.items() if section.data}


def _recording(opened: log.Log) -> dict[str, Any]:
    """The log and its channels with their provenance, as JSON."""
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
    provenance = Provenance.from_metadata(channel.metadata)
    names = ("transform", "input", "version", "weights_sha256", "digest", "input_digest")
    return {
        "topic": channel.topic,
        "schema": channel.schema_name,
        "encoding": channel.message_encoding,
        "messages": channel.messages,
        **{key: (getattr(provenance, key) or None) if provenance else None for key in names},
        "references": dict(provenance.references) if provenance else {},
        "parameters": dict(provenance.parameters) if provenance else None,
        "stale": pipeline.is_stale(opened, channel.topic),
    }


def plane_of(report: LogReport) -> Any:
    """The first ground plane of the log, if there is one."""
    return plane_at(report.planes, report.start_ns)
