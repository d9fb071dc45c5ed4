"""Run stages: read their inputs, pass them facts about the log, and write their outputs."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import count
from pathlib import Path
from time import perf_counter
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np

from mcaptrack import log
from mcaptrack.environment import release_memory
from mcaptrack.errors import McaptrackError, call
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.geometry.clocks import NS_PER_S, parse_ns
from mcaptrack.geometry.plane import Planes, is_assumed, is_estimated, scene_planes
from mcaptrack.notices import Notice, collected, known_code, warn
from mcaptrack.pipeline.checks import Job, check_inputs, may_replace, read_named_frames, superseded
from mcaptrack.pipeline.events import STAGE as EVENTS_STAGE
from mcaptrack.pipeline.events import Watch, make_events, tally
from mcaptrack.pipeline.following import Before, led, numbers_of, warn_unfollowed
from mcaptrack.pipeline.motion import path_with, side_inputs
from mcaptrack.pipeline.pictures import pictures_of, with_descriptors
from mcaptrack.pipeline.plan import corrected_tracks, fixed_in, without_filled_in
from mcaptrack.pipeline.planes import (
    AS_BEFORE,
    Channels,
    PlaneChoice,
    is_poor,
    plane_in_words,
    planes_for,
    recorded_planes,
    without_unseen,
)
from mcaptrack.pipeline.rebuild import plugins_of
from mcaptrack.pipeline.staleness import CORRECTED_IN, digest_of, read_planes, warn_clock_jumps
from mcaptrack.pipeline.write import Made, RunState, write
from mcaptrack.pipeline.zones import STAGE as ZONES_STAGE
from mcaptrack.pipeline.zones import ZoneWatch, make_zones
from mcaptrack.predictors import weights_sha256
from mcaptrack.schema import DETECTIONS, TRACKS, VIDEO, Frame, Schema
from mcaptrack.schema.camera_motion import to_pictures, to_scene
from mcaptrack.schema.classes import class_names
from mcaptrack.schema.frame_columns import FrameCollector
from mcaptrack.schema.framing import frame_times, row_ends, unique_values
from mcaptrack.schema.provenance import CLOCK, FUSE, VIEW, Provenance
from mcaptrack.sources.camera_motion import tracks_topic
from mcaptrack.sources.cameras import camera_at
from mcaptrack.sources.corrections import corrections_of, with_corrections
from mcaptrack.sources.fixed_frame import BoxesRead
from mcaptrack.sources.pictures import picture_size
from mcaptrack.transforms import FULL, STAGES, Sample, Transform
from mcaptrack.transforms.guarded import guarded
from mcaptrack.transforms.motion_limits import ClassNames, unknown_limits
from mcaptrack.transforms.protocol import ModelCard, traits_of
from mcaptrack.transforms.retrack.offline import settle_classes
from mcaptrack.transforms.to_video_rate import linked_tracks, to_video_rate

Progress = Callable[[str, int, int], None]


# Measure the time that each part of a run takes.


T = TypeVar("T")


class Stopwatch:
    """Seconds by part, such as a stage. The time of a part within another one counts for the inner one alone.

    Examples
    --------
    >>> watch = Stopwatch()
    >>> with watch.part("detect"):
    ...     pictures = list(watch.each("decode", range(3)))
    >>> list(watch.seconds)
    ['detect', 'decode']
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._open: list[str] = []
        self._since = perf_counter()

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count the time of a block for a part."""
        self._count()
        self.seconds.setdefault(name, 0.0)
        self._open.append(name)
        try:
            yield
        finally:
            self._count()
            self._open.pop()

    def each(self, name: str, items: Iterable[T]) -> Iterator[T]:
        """Yield items, and count the time that making each takes for a part."""
        source = iter(items)
        while True:
            with self.part(name):
                try:
                    item = next(source)
                except StopIteration:
                    return
            yield item

    def _count(self) -> None:
        now = perf_counter()
        if self._open:
            self.seconds[self._open[-1]] += now - self._since
        self._since = now


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

    def count(self, topic: str, channel: Made) -> None:
        """Count the frames, rows and tracks of a new channel."""
        self.frames[topic], self.rows[topic] = len(channel.frames), int(row_ends(channel.frames)[-1])
        if channel.schema is TRACKS:
            self.tracks[topic] = len(unique_values(TRACKS, channel.frames, "track_id"))

    def add(self, stage: str, made: Mapping[str, Made]) -> None:
        """Count the messages of the channels of a stage, if it made any."""
        self.frames |= {topic: channel.size() for topic, channel in made.items()}
        self.stages += [stage] if made else []


# Warn about results that are empty or unreliable, and about memory that runs out.


#: The stages with results in metres: all except those that read pictures.
_IN_METRES: Final = {name for name, stage in STAGES.items() if stage.reads is not VIDEO}
#: The memory that a run needs, in bytes: whatever its length, and for each second that a person is seen (re-tracking
#: has all samples in memory).
_BASE, _A_PERSON_SECOND = 400_000_000, 3_000


def warn_no_rows(
    stage: str, source: str, transform: Transform, read: Sequence[Frame], made_rows: Sequence[Frame]
) -> None:
    """Warn if a stage made no rows, with the likely reason.

    ``read`` are the frames that the stage read, ``made_rows`` those of its first output.
    """
    if row_ends(made_rows)[-1]:
        return
    if transform.reads is not VIDEO and not row_ends(read)[-1]:
        warn(f"{source} holds nothing, so nothing was made of it", "nothing-found")
        return
    reason = transform.why_empty(read, made_rows) if hasattr(transform, "why_empty") else "the transform gave none"
    warn(f"no {STAGES[stage].rows} of {source}: {reason}", "nothing-found")


def warn_memory(frames: Sequence[Frame]) -> None:
    """Warn if the stages that follow need more memory for these boxes than is free."""
    boxes, steps = int(row_ends(frames)[-1]), np.diff(frame_times(frames))
    seen_s = boxes * (float(np.median(steps)) / NS_PER_S if len(steps) else 0.0)
    needed, free = _BASE + seen_s * _A_PERSON_SECOND, free_memory()
    if free is not None and needed > free:
        warn(
            f"{boxes:,} boxes, of people who are seen for {seen_s / 3600:,.0f} hours together, take about "
            f"{needed / 1e9:.1f} GB of memory, and {free / 1e9:.1f} GB are free: re-tracking has all samples in memory",
            "memory",
        )


def free_memory() -> int | None:
    """Return the free memory for this process in bytes, as Linux reports it; None if it isn't known."""
    limits = []
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        limits += [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")]
        most, now = (Path(f"/sys/fs/cgroup/memory.{name}").read_text().strip() for name in ("max", "current"))
        limits += [int(most) - int(now)] if most != "max" else []
    except (OSError, ValueError):
        pass  # not Linux, or no memory limit for this process's control group
    return min(limits, default=None)


def warn_findings(
    opened: log.Log, prefix: str, results: Mapping[str, Provenance], planes: Planes, is_all: bool
) -> None:
    """Repeat the warnings that channels carry in their provenance, and warn about an estimated scale.

    This covers ``results`` and the channels that they were made from; with ``is_all`` all channels of the camera.
    """
    provenances = dict(results)
    for topic in sorted(camera_at(opened, prefix).topics):
        provenance = Provenance.from_metadata(opened.channels[topic].metadata)
        if provenance is not None:
            provenances.setdefault(topic, provenance)
    topics = list(provenances) if is_all else list(results)
    for topic in topics:
        if provenances[topic].input in provenances and provenances[topic].input not in topics:
            topics.append(provenances[topic].input)
    stages = {provenances[topic].transform for topic in topics}
    for topic in topics:
        for code, message in provenances[topic].warnings:
            warn(message, known_code(code))
    if is_assumed(planes) and stages & _IN_METRES:
        plane = plane_in_words(planes, provenances.get(camera_at(opened, prefix).ground_plane))
        warn(plane, "estimated-ground-plane" if is_estimated(planes) else "assumed-ground-plane")
    parameters = [provenances[topic].parameters for topic in topics]
    held_back = [values for values in parameters if values.get("poor_scale") and not values.get("side_view")]
    if held_back:
        by_likelihood = [values for values in held_back if values.get("retracker", "likelihood") == "likelihood"]
        is_linked = any(values.get("link_s") != 0 for values in by_likelihood)
        done = "only linked over gaps, by their boxes in the picture" if is_linked else "not re-tracked but passed on"
        warn(
            f"tracks were {done}: without a measured ground plane, more needs a camera that looks down, and this one "
            f"looks along the ground. To insist: {call('retrack', opened.path, side_view=True)}",
            "held-back",
        )


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
    boxes, results = boxes or BoxesRead(), dict(fused)
    state = RunState(opened, prefix, results)
    stamps: dict[str, list[int]] = {}
    report = Report(stages=[FUSE] if fused else [])
    for topic, channel in fused.items():
        report.count(topic, channel)
    part = report.watch.part
    with collected() as warnings:
        if jobs:
            warn_clock_jumps(opened)
        planes = read_planes(opened, prefix)
        for job in jobs:
            with part("read"):
                job_input = _input(state, job, stamps, progress, boxes, report.watch)
                source = (job.source, job_input.digest())
            with part(job.stage):
                planes, frame_id = planes_for(state, job, job_input.frames, source, planes, plane)
            job_input = job_input._replace(frame_id=job_input.frame_id or frame_id)
            if job.transform.reads is DETECTIONS:
                warn_memory(job_input.frames)
            try:
                with part(job.stage):
                    results |= _run_job(state, job, job_input, planes or (), before, progress)
            except McaptrackError as error:
                if not job.is_optional:
                    raise
                warn(f"{job.target} is left out: {error}", "left-out")
                continue
            for topic in (topic for topic in job.outputs() if topic in results):
                report.count(topic, results[topic])
            report.stages.append(job.stage)
            del job_input
            release_memory()
        if watch is not None:
            with part(EVENTS_STAGE):
                events = make_events(state, watch)
            report.add(EVENTS_STAGE, events)
            report.events = tally(events)
            results |= events
        if zones is not None:
            with part(ZONES_STAGE):
                counted = make_zones(state, planes or (), zones, stamps)
            report.add(ZONES_STAGE, counted)
            report.has_zones = True
            results |= counted
        gone = _gone(opened, jobs, results)
        if results or output is not None:
            with part("write"):
                path, _ = path_with(state, tracks_topic(prefix))
                write(state, planes or (), stamps, output, path, boxes.in_space(), gone)
                report.is_written = True
        provenances = {topic: channel.provenance for topic, channel in results.items()}
        warn_findings(opened, prefix, provenances, planes or (), is_all=watch is not None or not jobs)
    late = outdated_by(opened, {topic: how.digest for topic, how in provenances.items()})
    report.stale = [topic for topic in late if topic not in gone]
    report.warnings = list(dict.fromkeys(warnings))
    return report


def _gone(opened: log.Log, jobs: Sequence[Job], results: Mapping[str, Made]) -> set[str]:
    """Return channels that these jobs made earlier and don't make now, and the channels made from those."""
    gone: set[str] = set()
    for job in jobs:
        if job.kept() & {*results}:
            empty = [
                topic for topic in job.kept() if topic in opened.channels
            ]  # no rows, no tracks at the video's rate
            gone.update(superseded(opened, job))
            gone.update(topic for topic in empty if may_replace(opened, topic, job.stage))
    gone -= {*results}
    for topic in sorted(opened.channels, key=len):  # what is made of a channel has a longer topic
        provenance = Provenance.from_metadata(opened.channels[topic].metadata)
        if provenance and provenance.transform in (EVENTS_STAGE, ZONES_STAGE, VIEW) and provenance.input in gone:
            gone.add(topic)
    return gone - {*results}


def outdated_by(opened: log.Log, digests: Mapping[str, str]) -> list[str]:
    """Return the other channels that stages made from earlier contents of these topics, or compared with them."""
    outdated = []
    for topic, channel in sorted(opened.channels.items()):
        provenance = Provenance.from_metadata(channel.metadata)
        if topic not in digests and provenance and provenance.transform in {*STAGES, EVENTS_STAGE, ZONES_STAGE, FUSE}:
            is_late = any(digests.get(name, then) != then for name, then in provenance.made_from().items())
            outdated += [topic] if is_late else []
    return outdated


class _Repeatable:
    """Frames that can be read more than once, each time from the beginning."""

    def __init__(self, begin: Callable[[], Iterator[Frame]]) -> None:
        self._begin = begin

    def __iter__(self) -> Iterator[Frame]:
        return self._begin()


class _Input(NamedTuple):
    """The input of a job: a stream of frames, all frames if they are rows (else empty), and, after the stream was read,
    the digest and the number of its messages; the names of its classes, the frame of its metres, the numbers of
    damaged pictures, and the errors of images that are left out.
    """

    stream: Iterable[Frame]
    frames: Sequence[Frame]
    digest: Callable[[], str]
    messages: Callable[[], int]
    classes: Mapping[str, str] = {}
    frame_id: str = ""
    damaged: Sequence[int] = ()
    unreadable: Sequence[McaptrackError] = ()

    def corrected(self, opened: log.Log, prefix: str, job: Job) -> tuple[_Input, Mapping[str, str]]:
        """Return tracks with the corrections of people, and the digests of these by topic."""
        topic = corrections_of(opened, prefix, job.source) if job.stage == CORRECTED_IN else None
        if topic is None:
            return self, {}
        frames = with_corrections(self.frames, opened.frame_columns(topic, TRACKS))
        return self._replace(stream=frames, frames=frames), {topic: digest_of(opened, topic)}

    def in_scene(self, path: CameraPath) -> _Input:
        """Return the same tracks with boxes in pixels of the reference picture."""
        moved = to_scene(self.frames, path)
        return self._replace(stream=moved, frames=moved)


# Re-tracked tracks at the rate of the tracks that were sampled.


def at_video_rate(
    state: RunState,
    job: Job,
    retracked: Sequence[Frame],
    planes: Planes,
    path: CameraPath | None,
    carry: Callable[[Sequence[Frame], Sequence[Frame], Planes], Sequence[Frame]],
) -> Sequence[Frame]:
    """Return re-tracked tracks at the rate of the tracks that were sampled; no frames if there are no such tracks.

    ``carry`` gives these tracks the re-tracked ids. Where the camera moves by ``path``, ``planes`` and the boxes of
    ``retracked`` are those of reference pictures.
    """
    opened, prefix, _ = state
    samples = state.provenance(job.source)
    source = samples.input if samples else ""
    tracks = state.frames(source)
    tracks = corrected_tracks(opened, prefix, source, tracks) if len(tracks) else tracks
    carried = without_filled_in(opened, prefix, source, carry(to_scene(tracks, path), retracked, planes))
    return to_pictures(carried, path)


# Context: the parameters of transforms that follow from the log, and not from the user.


def in_context(
    opened: log.Log,
    prefix: str,
    job: Job,
    frames: Sequence[Frame],
    planes: Planes,
    classes: Mapping[str, str],
) -> Transform:
    """Return the transform with its context fields filled in.

    They are the ground planes, the start of the clock in ns, the rate in Hz, and the names of classes by number.
    """
    names = {f.name for f in fields(job.transform) if f.metadata.get("context")}
    context: dict[str, Any] = {}
    if "ground_planes" in names:
        context["ground_planes"] = tuple(planes)
    if "class_names" in names:
        context["class_names"] = tuple((int(number), name) for number, name in classes.items())
        _warn_of_limits(str(getattr(job.transform, "class_limits", "")), context["class_names"])
    if "start_ns" in names:
        context["start_ns"] = _clock_start(opened, prefix)
    if "rate_hz" in names:
        steps = np.diff(frame_times(frames))
        if (steps > 0).any():  # frames may share a time
            context["rate_hz"] = round(NS_PER_S / float(np.median(steps[steps > 0])), 6)
            usual = f"{prefix}/{STAGES[job.stage].input_topic}"
            if job.source != usual and context["rate_hz"] > 2 * Sample().rate_hz:
                warn(
                    f"{job.source} has {context['rate_hz']:g} frames a second, and {job.stage} takes steps at that "
                    f"rate; {usual} has {Sample().rate_hz:g} unless it was made otherwise",
                    "clock",
                )
    if "poor_scale" in names and is_assumed(planes):
        context["poor_scale"] = is_poor(frames)
    return replace(job.transform, **context)


def _warn_of_limits(class_limits: str, names: ClassNames) -> None:
    """Warn of limits for classes that don't exist."""
    if unknown := unknown_limits(class_limits, names):
        classes = ", ".join(sorted({name for _, name in names if name})) or "none with a name"
        text = f"`class_limits=` names {', '.join(unknown)}: no such class is in the table of limits or in the boxes"
        warn(f"{text} (classes of these are: {classes})", "option-not-used")


def _clock_start(opened: log.Log, prefix: str) -> int | None:
    """Return the start of the prediction clock in ns: from the log's metadata, or the time of the first picture."""
    clock = opened.metadata(CLOCK)
    if clock and (start := parse_ns(clock.get("start_ns", ""))) is not None:
        return start
    pictures = camera_at(opened, prefix).pictures
    return min(opened.times(pictures).tolist(), default=None) if pictures else None


def _run_job(
    state: RunState, job: Job, job_input: _Input, planes: Planes, before: Before | None, progress: Progress
) -> dict[str, Made]:
    """Run a job, and return its channels by topic."""
    opened, prefix, _ = state
    side = side_inputs(state, job)
    job_input, corrections = job_input.corrected(opened, prefix, job)
    shown = job_input.frames
    path, motion = path_with(state, job.source) if job.transform.reads is TRACKS else (None, {})
    if path is not None:  # boxes of pictures that the camera moved between can't be joined as they are
        job_input, planes = job_input.in_scene(path), scene_planes(planes, path)
    if before is None:
        warn_unfollowed(opened, job)
    lead = before.lead(job, numbers_of(job_input.frames), planes) if before and path is None else ()
    if lead:
        frames = led(lead, job_input.frames, job.transform.reads)
        job_input = job_input._replace(stream=frames, frames=frames)
    context = in_context(opened, prefix, job, job_input.frames, planes, job_input.classes)
    fixed = fixed_in(state, job.source) if hasattr(context, "fixed_ids") else ()
    transform = replace(context, **side.values, **({"fixed_ids": fixed} if fixed else {}))
    transform = before.in_context(transform) if before and lead else transform
    transform = with_descriptors(transform, opened, prefix, shown, progress, job.keep)
    collectors = [FrameCollector(schema) for schema in transform.writes.values()]
    taken = [0]
    try:
        with collected() as warnings:
            entry = STAGES[job.stage].entry(type(transform))
            is_own = STAGES[job.stage].is_built_in(type(transform))
            stream = _Repeatable(lambda: _counting(job_input.stream, taken))
            batches = transform(stream) if is_own else guarded(entry, transform, stream)
            for result in batches:
                for frame, collector in zip(result, collectors, strict=True):
                    collector.append(frame)
            outputs: list[Sequence[Frame]] = [collector.done() for collector in collectors]
            if job.transform.reads is DETECTIONS and job.transform.writes[""] is TRACKS:
                outputs[0] = settle_classes(outputs[0])
            outputs, continued = before.own(job, outputs) if before else (outputs, {})
            if not warnings:  # otherwise a warning has given the reason
                warn_no_rows(job.stage, job.source, transform, job_input.frames, outputs[0])
    except McaptrackError as error:
        where = "" if str(opened.path) in str(error) else f"{opened.path}: {job.source}: "
        raise type(error)(f"{where}{error}") from None
    left_out = job_input.messages() - max(taken) - len(job_input.unreadable)
    if transform.reads is VIDEO and left_out > 0:
        warn(
            f"{job.source}: {left_out} of {job_input.messages()} messages were left out: a video has to begin with a "
            "key picture that has its parameter sets",
            "left-out",
        )
    if job_input.unreadable:
        warn(
            f"{job.source}: {len(job_input.unreadable)} of {job_input.messages()} pictures can't be decoded and are "
            f"left out, the first: {job_input.unreadable[0]}",
            "lost",
        )
    if job_input.damaged:
        warn(
            f"{job.source}: {len(job_input.damaged)} of {job_input.messages()} pictures are damaged, number "
            f"{job_input.damaged[0]} first; what can't be decoded there is taken from others, so that detections may "
            "be wrong up to the next key picture",
            "lost",
        )
    provenance = _provenance_of(job, transform, job_input, warnings, {**side.references, **motion, **corrections})
    provenance = replace(provenance, continued=continued)
    channels: dict[str, tuple[Schema, Sequence[Frame]]] = {
        topic: (schema, to_pictures(channel, path) if schema is TRACKS else channel)
        for (topic, schema), channel in zip(job.outputs().items(), outputs, strict=True)
    }
    if job.target + FULL in job.kept():
        carry = linked_tracks if traits_of(transform).leaves_unchanged else to_video_rate
        frames = at_video_rate(state, job, outputs[0], planes, path, carry)
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
    job: Job, transform: Transform, job_input: _Input, warnings: Sequence[Notice], references: Mapping[str, str]
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
        job_input.digest(),
        weights_sha256=weights_sha256(predictor) if isinstance(predictor, str) else card.weights_sha256,
        references=references,
        plugins=plugins_of(stage, transform),
        classes={str(number): name for number, name in card.classes.items()} or job_input.classes,
        frame_id=job_input.frame_id,
        model=card.facts,
        warnings=[(notice.code, notice.message) for notice in warnings],
    )


def _input(
    state: RunState,
    job: Job,
    stamps: dict[str, list[int]],
    progress: Progress,
    boxes: BoxesRead,
    watch: Stopwatch,
) -> _Input:
    """Return the input of a job; the capture times of pictures in ns are appended to ``stamps``, by topic."""
    opened, results = state.opened, state.results
    if job.source not in results and job.transform.reads is VIDEO:
        seen = stamps.setdefault(job.source, [])
        damaged, unreadable = list[int](), list[McaptrackError]()
        digest, pictures = pictures_of(opened, job, seen, damaged, unreadable)
        steps = opened.channel(job.source).messages * traits_of(job.transform).passes
        numbers = count(1)
        each = _Repeatable(lambda: _counted(watch.each("decode", pictures), numbers, steps, job.stage, progress))
        return _Input(each, [], digest, lambda: len(seen), damaged=damaged, unreadable=unreadable)
    if job.source in results:
        frames, how = results[job.source].frames, results[job.source].provenance
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
    filled = in_context(opened, prefix, job, frames, read_planes(opened, prefix) or (), classes)
    filled = with_descriptors(
        replace(filled, **side_inputs(RunState(opened, prefix, {}), job).values), opened, prefix, frames
    )
    return frames, {f.name: getattr(filled, f.name) for f in fields(filled) if f.metadata.get("context")}
