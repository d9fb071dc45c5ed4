"""Run stages: read their inputs, pass them facts about the log, and write their outputs."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

from mcaptrack import log
from mcaptrack.environment import release_memory
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.geometry.plane import Planes, scene_planes
from mcaptrack.notices import Notice, collected, warn
from mcaptrack.pipeline.appearance import with_descriptors
from mcaptrack.pipeline.checks import Job, check_inputs, may_replace, read_named_frames, superseded
from mcaptrack.pipeline.context import in_context
from mcaptrack.pipeline.corrections import corrected_input, fixed_in
from mcaptrack.pipeline.events import STAGE as EVENTS_STAGE
from mcaptrack.pipeline.events import Watch, make_events, tally
from mcaptrack.pipeline.findings import warn_clock_jumps, warn_findings, warn_memory, warn_no_rows
from mcaptrack.pipeline.following import Before, led, numbers_of, warn_unfollowed
from mcaptrack.pipeline.motion import path_with, side_inputs
from mcaptrack.pipeline.pictures import pictures_of
from mcaptrack.pipeline.planes import AS_BEFORE, PlaneChoice, planes_for, read_planes, recorded_planes
from mcaptrack.pipeline.rebuild import plugins_of
from mcaptrack.pipeline.timing import Stopwatch
from mcaptrack.pipeline.video_rate import at_video_rate
from mcaptrack.pipeline.visible import Channels, picture_size, without_unseen
from mcaptrack.pipeline.write import Made, digest_of, write
from mcaptrack.pipeline.zones import STAGE as ZONES_STAGE
from mcaptrack.pipeline.zones import ZoneWatch, make_zones
from mcaptrack.predictors import weights_sha256
from mcaptrack.schema import DETECTIONS, TRACKS, VIDEO, Frame, Schema
from mcaptrack.schema.camera_motion import to_pictures, to_scene
from mcaptrack.schema.classes import class_names
from mcaptrack.schema.frame_columns import FrameCollector
from mcaptrack.schema.framing import row_ends, unique_values
from mcaptrack.schema.provenance import FUSE, VIEW, Provenance
from mcaptrack.sources.camera_motion import tracks_topic
from mcaptrack.sources.cameras import camera_at
from mcaptrack.sources.fixed_frame import BoxesRead
from mcaptrack.transforms import FULL, STAGES, Transform
from mcaptrack.transforms.guarded import guarded
from mcaptrack.transforms.protocol import ModelCard, traits_of
from mcaptrack.transforms.to_video_rate import linked_tracks, to_video_rate
from mcaptrack.transforms.track_classes import settle_classes

Progress = Callable[[str, int, int], None]


@dataclass
class Report:
    """The result of a run: its stages; the frames, rows and tracks of each topic they made; whether it wrote the log.

    ``stale`` are the channels that are out of date, because this run replaced their input. ``events`` are the numbers
    of events of each kind by channel of tracks. ``warnings`` report what was assumed, left out or looks unusual.
    ``has_zones`` says whether zones were counted, or are up to date. ``watch`` has the seconds of each stage, and of
    reading, waiting for pictures ("decode") and writing.
    """

    stages: list[str] = field(default_factory=list)
    frames: dict[str, int] = field(default_factory=dict)
    rows: dict[str, int] = field(default_factory=dict)
    tracks: dict[str, int] = field(default_factory=dict)
    is_written: bool = False
    stale: list[str] = field(default_factory=list)
    events: dict[str, dict[str, int]] = field(default_factory=dict)
    warnings: list[Notice] = field(default_factory=list)
    has_zones: bool = False
    watch: Stopwatch = field(default_factory=Stopwatch)

    def count(self, topic: str, made: Made) -> None:
        """Count the frames, rows and tracks of a new channel."""
        self.frames[topic], self.rows[topic] = len(made.frames), int(row_ends(made.frames)[-1])
        if made.schema is TRACKS:
            self.tracks[topic] = len(unique_values(TRACKS, made.frames, "track_id"))


def run(
    opened: log.Log,
    prefix: str,
    jobs: Sequence[Job],
    output: Path | None = None,
    progress: Progress = lambda *_: None,
    watch: Watch | None = None,
    plane: PlaneChoice = AS_BEFORE,
    boxes: BoxesRead | None = None,
    zones: ZoneWatch | None = None,
    fused: Mapping[str, Made] = {},
    before: Before | None = None,
) -> Report:
    """Run the jobs, and write their channels and views into the log, or into a copy of it at ``output``.

    With ``watch`` the last stage finds events of tracks, if they are missing or out of date. ``plane`` says how to make
    a ground plane where none is given. ``boxes`` keeps boxes of other software that are read. With ``zones`` these are
    counted, or those that were counted before. ``fused`` are channels that were made again from those of several
    cameras, to begin with. Ids go on from the log ``before``.

    The log is replaced as a whole, after everything was computed.
    """
    with collected() as warnings:
        if jobs:
            warn_clock_jumps(opened)
        report = _run(opened, prefix, jobs, output, progress, watch, plane, boxes or BoxesRead(), zones, fused, before)
    report.warnings = list(dict.fromkeys(warnings))
    return report


def _run(
    opened: log.Log,
    prefix: str,
    jobs: Sequence[Job],
    output: Path | None,
    progress: Progress,
    watch: Watch | None,
    choice: PlaneChoice,
    boxes: BoxesRead,
    zones: ZoneWatch | None,
    fused: Mapping[str, Made],
    before: Before | None,
) -> Report:
    made: dict[str, Made] = dict(fused)
    stamps: dict[str, list[int]] = {}
    report = Report(stages=[FUSE] if fused else [])
    for topic, channel in fused.items():
        report.count(topic, channel)
    planes, part = read_planes(opened, prefix), report.watch.part
    for job in jobs:
        with part("read"):
            given = _input(opened, job, made, stamps, progress, boxes, report.watch)
            source = (job.source, given.digest())
        with part(job.stage):
            planes, ground, frame_id = planes_for(opened, prefix, job, given.frames, source, made, planes, choice)
        made |= ground
        given = given._replace(frame_id=given.frame_id or frame_id)
        if job.transform.reads is DETECTIONS:
            warn_memory(given.frames)
        try:
            with part(job.stage):
                made |= _run_job(opened, prefix, job, given, made, planes or (), before, progress)
        except McaptrackError as error:
            if not job.is_optional:
                raise
            warn(f"{job.target} is left out: {error}", "left-out")
            continue
        for topic in (topic for topic in job.outputs() if topic in made):
            report.count(topic, made[topic])
        report.stages.append(job.stage)
        del given
        release_memory()
    if watch is not None:
        with part(EVENTS_STAGE):
            events = make_events(opened, prefix, made, watch)
        made |= events
        report.frames |= {topic: channel.size() for topic, channel in events.items()}
        report.events = tally(events)
        report.stages += [EVENTS_STAGE] if events else []
    if zones is not None:
        with part(ZONES_STAGE):
            counted = make_zones(opened, prefix, made, planes or (), zones, stamps)
        made |= counted
        report.frames |= {topic: channel.size() for topic, channel in counted.items()}
        report.stages += [ZONES_STAGE] if counted else []
        report.has_zones = True
    gone = _gone(opened, jobs, made)
    if made or output is not None:
        with part("write"):
            path, _ = path_with(opened, prefix, tracks_topic(prefix), made)
            write(opened, prefix, made, planes or (), stamps, output, path, boxes.in_space(), gone)
            report.is_written = True
    provenances = {topic: channel.provenance for topic, channel in made.items()}
    warn_findings(opened, prefix, provenances, planes or (), is_all=watch is not None or not jobs)
    late = outdated_by(opened, {topic: channel.provenance.digest for topic, channel in made.items()})
    report.stale = [topic for topic in late if topic not in gone]
    return report


def _gone(opened: log.Log, jobs: Sequence[Job], made: Mapping[str, Made]) -> set[str]:
    """Return earlier results of jobs that have run which these don't make now, and what was made of them."""
    gone: set[str] = set()
    for job in jobs:
        if job.kept() & {*made}:
            empty = [
                topic for topic in job.kept() if topic in opened.channels
            ]  # no rows, no tracks at the video's rate
            gone.update(superseded(opened, job))
            gone.update(topic for topic in empty if may_replace(opened, topic, job.stage))
    gone -= {*made}
    for topic in sorted(opened.channels, key=len):  # what is made of a channel has a longer topic
        known = Provenance.from_metadata(opened.channels[topic].metadata)
        if known and known.transform in (EVENTS_STAGE, ZONES_STAGE, VIEW) and known.input in gone:
            gone.add(topic)
    return gone - {*made}


def outdated_by(opened: log.Log, digests: Mapping[str, str]) -> list[str]:
    """Return the other channels that stages made from earlier contents of these topics, or compared with them."""
    found = []
    for topic, there in sorted(opened.channels.items()):
        known = Provenance.from_metadata(there.metadata)
        if topic not in digests and known and known.transform in {*STAGES, EVENTS_STAGE, ZONES_STAGE, FUSE}:
            is_late = any(digests.get(name, then) != then for name, then in known.made_from().items())
            found += [topic] if is_late else []
    return found


class _Repeatable:
    """Frames that can be read more than once, each time from the beginning."""

    def __init__(self, begin: Callable[[], Iterator[Frame]]) -> None:
        self._begin = begin

    def __iter__(self) -> Iterator[Frame]:
        return self._begin()


class _Input(NamedTuple):
    """The input of a job: a stream of frames, all frames if they are rows (else empty), and, after the stream was read,
    the digest and the number of its messages; the names of its classes, the frame of its metres, and the numbers of
    damaged pictures.
    """

    stream: Iterable[Frame]
    frames: Sequence[Frame]
    digest: Callable[[], str]
    messages: Callable[[], int]
    classes: Mapping[str, str] = {}
    frame_id: str = ""
    damaged: Sequence[int] = ()

    def corrected(self, opened: log.Log, prefix: str, job: Job) -> tuple[_Input, Mapping[str, str]]:
        """Return tracks with the corrections of people, and the digests of these by topic."""
        frames, references = corrected_input(opened, prefix, job, self.frames)
        return (self._replace(stream=frames, frames=frames) if references else self), references

    def in_scene(self, path: CameraPath) -> _Input:
        """Return the same tracks with boxes in pixels of the reference picture."""
        moved = to_scene(self.frames, path)
        return self._replace(stream=moved, frames=moved)


def _run_job(
    opened: log.Log,
    prefix: str,
    job: Job,
    given: _Input,
    made: Mapping[str, Made],
    planes: Planes,
    before: Before | None,
    progress: Progress,
) -> dict[str, Made]:
    """Run a job, and return its channels by topic. ``made`` are the channels of earlier jobs."""
    known = side_inputs(opened, prefix, job, made)
    given, corrections = given.corrected(opened, prefix, job)
    shown = given.frames
    path, motion = path_with(opened, prefix, job.source, made) if job.transform.reads is TRACKS else (None, {})
    if path is not None:  # boxes of pictures that the camera moved between can't be joined as they are
        given, planes = given.in_scene(path), scene_planes(planes, path)
    if before is None:
        warn_unfollowed(opened, job)
    lead = before.lead(job, numbers_of(given.frames), planes) if before and path is None else ()
    if lead:
        frames = led(lead, given.frames, job.transform.reads)
        given = given._replace(stream=frames, frames=frames)
    context = in_context(opened, prefix, job, given.frames, planes, given.classes)
    fixed = fixed_in(opened, prefix, job.source, made) if hasattr(context, "fixed_ids") else ()
    transform = replace(context, **known.values, **({"fixed_ids": fixed} if fixed else {}))
    transform = before.in_context(transform) if before and lead else transform
    transform = with_descriptors(transform, opened, prefix, shown, progress, job.keep)
    collectors = [FrameCollector(schema) for schema in transform.writes.values()]
    taken = [0]
    try:
        with collected() as warnings:
            entry = STAGES[job.stage].entry(type(transform))
            is_own = STAGES[job.stage].is_built_in(type(transform))
            stream = _Repeatable(lambda: _counting(given.stream, taken))
            results = transform(stream) if is_own else guarded(entry, transform, stream)
            for result in results:
                for frame, collector in zip(result, collectors, strict=True):
                    collector.append(frame)
            outputs: list[Sequence[Frame]] = [collector.done() for collector in collectors]
            if job.transform.reads is DETECTIONS and job.transform.writes[""] is TRACKS:
                outputs[0] = settle_classes(outputs[0])
            outputs, continued = before.own(job, outputs) if before else (outputs, {})
            if not warnings:  # otherwise a warning has given the reason
                warn_no_rows(job.stage, job.source, transform, given.frames, outputs[0])
    except McaptrackError as error:
        where = "" if str(opened.path) in str(error) else f"{opened.path}: {job.source}: "
        raise type(error)(f"{where}{error}") from None
    left_out = given.messages() - max(taken)
    if transform.reads is VIDEO and left_out > 0:
        warn(
            f"{job.source}: {left_out} of {given.messages()} messages were left out: a video has to begin with a key "
            "picture that has its parameter sets",
            "left-out",
        )
    if given.damaged:
        warn(
            f"{job.source}: {len(given.damaged)} of {given.messages()} pictures are damaged, number {given.damaged[0]} "
            "first; what can't be decoded there is taken from others, so that detections may be wrong up to the next "
            "key picture",
            "lost",
        )
    provenance = _provenance_of(job, transform, given, warnings, {**known.references, **motion, **corrections})
    provenance = replace(provenance, continued=continued)
    channels: dict[str, tuple[Schema, Sequence[Frame]]] = {
        topic: (schema, to_pictures(channel, path) if schema is TRACKS else channel)
        for (topic, schema), channel in zip(job.outputs().items(), outputs, strict=True)
    }
    if job.target + FULL in job.kept():
        carry = linked_tracks if traits_of(transform).leaves_unchanged else to_video_rate
        frames = at_video_rate(opened, prefix, job, made, outputs[0], planes, path, carry)
        channels |= {job.target + FULL: (TRACKS, frames)} if frames else {}
    seen: Channels = channels
    if not traits_of(transform).keeps_unseen:
        seen = without_unseen(channels, lambda: picture_size(opened, camera_at(opened, prefix).pictures))
    usual = STAGES[job.stage].outputs(job.target)
    return {
        topic: Made.of(
            schema, frames, replace(provenance, output="" if topic in usual else topic.removeprefix(job.target + "/"))
        )
        for topic, (schema, frames) in seen.items()
        if topic in job.kept()
    }


def _provenance_of(
    job: Job, transform: Transform, given: _Input, warnings: Sequence[Notice], references: Mapping[str, str]
) -> Provenance:
    """Return the provenance of a job's channels. Classes are named by the transform, or else by its input.

    Raises McaptrackError for parameters that a log can't hold.
    """
    stage = STAGES[job.stage]
    entry = stage.entry(type(transform))
    choice = {stage.kind: entry.name} if stage.kind else {}
    large = [f for f in fields(transform) if not f.metadata.get("is_recorded", True)]
    unrecorded: dict[str, Any] = {f.name: f.default_factory() for f in large if callable(f.default_factory)}
    recorded = replace(transform, **unrecorded) if unrecorded else transform
    try:
        parameters = {name: value for name, value in asdict(recorded).items() if name not in unrecorded}
        parameters |= recorded_planes(transform)
        parameters = json.loads(json.dumps(parameters | choice))
    except TypeError as error:
        raise McaptrackError(f"the parameters of {entry} can't be kept in a log: {error}") from None
    predictor = getattr(transform, "predictor", None)
    card = transform.model_card() if hasattr(transform, "model_card") else ModelCard()
    return Provenance(
        job.stage,
        parameters,
        job.source,
        given.digest(),
        weights_sha256=weights_sha256(predictor) if isinstance(predictor, str) else card.weights_sha256,
        references=references,
        plugins=plugins_of(stage, transform),
        classes={str(number): name for number, name in card.classes.items()} or given.classes,
        frame_id=given.frame_id,
        model=card.facts,
        warnings=[(notice.code, notice.message) for notice in warnings],
    )


def _input(
    opened: log.Log,
    job: Job,
    made: Mapping[str, Made],
    stamps: dict[str, list[int]],
    progress: Progress,
    boxes: BoxesRead,
    watch: Stopwatch,
) -> _Input:
    """Return the input of a job; the capture times of pictures in ns are appended to ``stamps``, by topic."""
    if job.source not in made and job.transform.reads is VIDEO:
        seen = stamps.setdefault(job.source, [])
        damaged: list[int] = []
        digest, pictures = pictures_of(opened, job, seen, damaged)
        steps = opened.channel(job.source).messages * traits_of(job.transform).passes
        numbers = count(1)
        each = _Repeatable(lambda: _counted(watch.each("decode", pictures), numbers, steps, job.stage, progress))
        return _Input(each, [], digest, lambda: len(seen), damaged=damaged)
    if job.source in made:
        frames, how = made[job.source].frames, made[job.source].provenance
        of_rows, names, frame_id = how.digest, class_names(how.to_metadata()), how.frame_id
    else:
        frames, names, frame_id = read_named_frames(opened, job.source, job.transform.reads, job.frame_id, boxes)
        of_rows = digest_of(opened, job.source)
    classes = {str(number): name for number, name in sorted(names.items())}
    stream = _Repeatable(lambda: _counted(frames, count(1), len(frames), job.stage, progress))
    return _Input(stream, frames, lambda: of_rows, lambda: len(frames), classes, frame_id)


def _counting(frames: Iterable[Frame], taken: list[int]) -> Iterator[Frame]:
    """Yield the frames, and append the number of them to ``taken``; they may be read several times."""
    taken.append(0)
    for frame in frames:
        taken[-1] += 1
        yield frame


def _counted(
    frames: Iterable[Frame], numbers: Iterator[int], total: int, stage: str, progress: Progress
) -> Iterator[Frame]:
    """Yield the frames, and report the next of ``numbers`` for each as the progress of a stage."""
    for frame in frames:
        progress(stage, min(next(numbers), total), total)  # before it is used: a stage may not ask whether more follow
        yield frame


def input_of(
    opened: log.Log, prefix: str, stage: str, transform: Transform, source: str | None = None
) -> tuple[Sequence[Frame], dict[str, Any]]:
    """Return the frames that a stage would read from a log, and the values of its context fields by name.

    Raises McaptrackError if the log has no such input.
    """
    topic = source or f"{prefix}/{STAGES[stage].input_topic}"
    job = Job(stage, transform, topic, f"{prefix}/{STAGES[stage].output_topic}")
    check_inputs(opened, prefix, [job])
    frames, names, _ = read_named_frames(opened, topic, transform.reads)
    classes = {str(number): name for number, name in names.items()}
    known = in_context(opened, prefix, job, frames, read_planes(opened, prefix) or (), classes)
    known = with_descriptors(replace(known, **side_inputs(opened, prefix, job, {}).values), opened, prefix, frames)
    return frames, {f.name: getattr(known, f.name) for f in fields(known) if f.metadata.get("context")}
