"""Run stages: read their inputs, pass them facts about the log, and write their outputs."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import count
from pathlib import Path
from time import perf_counter
from typing import Any, Final, Protocol, TypeVar

import numpy as np

from mcaptrack import log
from mcaptrack.environment import release_memory
from mcaptrack.errors import McaptrackError, call
from mcaptrack.geometry.plane import Planes, is_assumed, is_estimated
from mcaptrack.notices import Notice, Progress, collected, warn
from mcaptrack.pipeline.checks import Job, check_inputs, may_replace, read_named_frames, superseded
from mcaptrack.pipeline.following import Before
from mcaptrack.pipeline.pictures import pictures_of
from mcaptrack.pipeline.planes import AS_BEFORE, PlaneChoice, plane_in_words, recorded_planes
from mcaptrack.pipeline.rebuild import plugins_of
from mcaptrack.pipeline.staleness import (
    digest_of,
    is_finished,
    is_stale,
    missing_finisher,
    read_planes,
    warn_clock_jumps,
)
from mcaptrack.pipeline.steps import BEFORE, LATE_BEGINNING, Input, Work
from mcaptrack.pipeline.write import Made, RunState, write
from mcaptrack.predictors import weights_sha256
from mcaptrack.schema import EVENT_KINDS, EVENTS, TRACKS, VIDEO, Frame
from mcaptrack.schema.classes import class_names
from mcaptrack.schema.frame_columns import FrameCollector
from mcaptrack.schema.framing import join_frames, row_ends, unique_values
from mcaptrack.schema.provenance import FUSE, VIEW, Provenance
from mcaptrack.sources import foreign
from mcaptrack.sources.cameras import camera_at, provenance_of
from mcaptrack.sources.fixed_frame import BoxesRead
from mcaptrack.sources.sidecar import encoding_for
from mcaptrack.transforms import STAGES, Stage, Transform
from mcaptrack.transforms.guarded import guarded
from mcaptrack.transforms.protocol import ModelCard, traits_of

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
    ``watch`` has the seconds of each stage, and of reading, waiting for pictures ("decode") and writing.
    """

    stages: list[str] = field(default_factory=list)
    frames: dict[str, int] = field(default_factory=dict)
    rows: dict[str, int] = field(default_factory=dict)
    tracks: dict[str, int] = field(default_factory=dict)
    is_written: bool = False
    stale: list[str] = field(default_factory=list)
    events: dict[str, dict[str, int]] = field(default_factory=dict)
    warnings: list[Notice] = field(default_factory=list)
    watch: Stopwatch = field(default_factory=Stopwatch)

    @classmethod
    def begun_with(cls, fused: Mapping[str, Made]) -> Report:
        """Return a report that begins with channels that were made of those of several cameras, if any."""
        report = cls(stages=[FUSE] if fused else [])
        for topic, channel in fused.items():
            report.count(topic, channel)
        return report

    def count(self, topic: str, channel: Made) -> None:
        """Count the frames, rows and tracks of a new channel."""
        self.frames[topic], self.rows[topic] = len(channel.frames), int(row_ends(channel.frames)[-1])
        if channel.schema is TRACKS:
            self.tracks[topic] = len(unique_values(TRACKS, channel.frames, "track_id"))

    def add(self, name: str, made: Mapping[str, Made]) -> None:
        """Count the messages of the channels that were made at the end, if any, and the events in them."""
        self.frames |= {topic: channel.size() for topic, channel in made.items()}
        self.stages += [name] if made else []
        self.events |= tally(made)


def tally(results: Mapping[str, Made]) -> dict[str, dict[str, int]]:
    """Count the events of each kind for each channel of tracks: count by name of the kind, by topic of the tracks."""
    out = {}
    for topic, channel in results.items():
        if channel.schema is EVENTS and not channel.drawn:
            kinds = join_frames(EVENTS, channel.frames).rows["kind"]
            counts = np.bincount(kinds, minlength=max(EVENT_KINDS) + 1).tolist()
            out[topic.rpartition("/")[0]] = {name: counts[kind] for kind, name in EVENT_KINDS.items()}
    return out


# Warn about results that are empty or unreliable, and about memory that runs out.


#: The stages with results in metres: all except those that read pictures.
_IN_METRES: Final = {name for name, stage in STAGES.items() if stage.reads is not VIDEO}


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


def warn_findings(state: RunState, results: Mapping[str, Provenance], planes: Planes, is_all: bool) -> None:
    """Repeat the warnings that channels carry in their provenance, and warn about an estimated scale.

    This covers ``results`` and the channels that they were made from; with ``is_all`` all channels of the camera.
    """
    opened, camera = state.opened, camera_at(state.opened, state.prefix)
    of_log = {topic: provenance_of(opened, topic) for topic in sorted(camera.topics - results.keys() - state.gone)}
    provenances = {**results, **{topic: how for topic, how in of_log.items() if how is not None}}
    topics = list(provenances) if is_all else list(results)
    for topic in topics:
        if provenances[topic].input in provenances and provenances[topic].input not in topics:
            topics.append(provenances[topic].input)
    covered = [provenances[topic] for topic in topics]
    for how in covered:
        how.warn_again()
    if is_assumed(planes) and {how.transform for how in covered} & _IN_METRES:
        plane = plane_in_words(planes, provenances.get(camera.ground_plane))
        warn(plane, "estimated-ground-plane" if is_estimated(planes) else "assumed-ground-plane")
    _warn_held_back(opened, covered)


def _warn_held_back(opened: log.Log, covered: Sequence[Provenance]) -> None:
    if done := max((how.held_back for how in covered), default=""):  # of those that were linked, if there are any
        warn(
            f"tracks were {done}: without a measured ground plane, more needs a camera that looks down, and this one "
            f"looks along the ground. To insist: {call('retrack', opened.path, side_view=True)}",
            "held-back",
        )


class Finish(Protocol):
    """A finisher: a step at the end of a run with what it made, such as finding events.

    ``name`` stands in reports, and is the ``transform`` in the provenance of channels. It may have ``topics``, channels
    that say which camera is meant, and a method ``report(opened, prefixes)``, which returns a ``Finished`` for the
    cameras of a run, or None.
    """

    @property
    def name(self) -> str: ...  # noqa: D102

    def make(self, state: RunState, planes: Planes, stamps: Mapping[str, Sequence[int]]) -> dict[str, Made]:
        """Return new channels by topic, below their inputs; ``stamps`` are the times in ns of pictures, by topic."""
        ...


def run(
    opened: log.Log,
    prefix: str,
    jobs: Sequence[Job],
    output: Path | None = None,
    progress: Progress = lambda *_: None,
    *,
    finishing: Sequence[Finish] = (),
    views: bool = False,
    plane: PlaneChoice = AS_BEFORE,
    boxes: BoxesRead | None = None,
    fused: Mapping[str, Made] = {},
    before: Before | None = None,
) -> Report:
    """Run the jobs, and write their channels into the log, or into a copy of it at ``output``.

    ``finishing`` is done after the last job; with ``views`` channels are drawn for viewers. ``plane`` says how to make
    a ground plane where none is given. ``boxes`` keeps boxes of other software that are read. ``fused`` are channels
    that were made again from those of several cameras, to begin with. Ids go on from the log ``before``.

    The log is replaced as a whole, after everything was computed.
    """
    boxes, results = boxes or BoxesRead(), dict(fused)
    state, stamps, report = RunState(opened, prefix, results), dict[str, list[int]](), Report.begun_with(fused)
    part = report.watch.part
    with collected() as warnings:
        if jobs:
            encoding_for(opened)  # refuses a recording that results can't be written into
            warn_clock_jumps(opened)
        planes = read_planes(opened, prefix)
        for job in jobs:
            with part("read"), collected() as of_input:
                source = _input(state, job, stamps, progress, boxes, report.watch)
            planes = _add_results(Work(state, job, source, planes, plane, before, progress, notices=of_input), report)
            del source
            release_memory()
        own_planes = planes or ()
        state = state._replace(gone=_gone(opened, jobs, results))  # what follows from it must not be made again
        for step in finishing:
            with part(step.name):
                made = step.make(state, own_planes, stamps)
            report.add(step.name, made)
            results |= made
        state = state._replace(gone=state.gone - {*results})
        drawn = None
        if views:
            from mcaptrack.pipeline.views import STAGE, make_views

            with part(STAGE):
                drawn = make_views(state, own_planes, stamps, boxes.in_space(), is_written=output is not None)
            report.stages += [STAGE] if drawn and drawn.topics else []
        with part("write"):
            report.is_written = write(state, output, drawn)
        provenances = {topic: channel.provenance for topic, channel in results.items()}
        warn_findings(state, provenances, own_planes, is_all=bool(finishing) or not jobs)
    late = outdated_by(opened, {topic: how.digest for topic, how in provenances.items()})
    late += _left_by_finishers(state) if finishing else []
    report.stale = [topic for topic in dict.fromkeys(late) if topic not in state.gone]
    report.warnings = list(dict.fromkeys(warnings))
    return report


def _add_results(work: Work, report: Report) -> Planes | None:
    """Do the work of a job, and add its channels to those of the run; return the ground planes from now on.

    A job that is optional may fail, with a warning.
    """
    job, results = work.job, work.state.results
    try:
        with report.watch.part(job.stage):
            results |= _done(work)
    except McaptrackError as error:
        if not job.is_optional:
            raise
        warn(f"{job.target} is left out: {error}", "left-out")
        return work.own_planes
    for topic in (topic for topic in job.outputs() if topic in results):
        report.count(topic, results[topic])
    report.stages.append(job.stage)
    return work.own_planes


def _gone(opened: log.Log, jobs: Sequence[Job], results: Mapping[str, Made]) -> set[str]:
    """Return channels that these jobs made earlier and don't make now, and the channels made from those."""
    gone: set[str] = set()
    for job in jobs:
        if job.kept() & {*results}:
            empty = job.kept() & opened.channels.keys()  # no rows, no tracks at the video's rate
            gone |= {*superseded(opened, job), *(topic for topic in empty if may_replace(opened, topic, job.stage))}
    gone -= {*results}
    for topic in sorted(opened.channels, key=len):  # what is made of a channel has a longer topic
        provenance = Provenance.from_metadata(opened.channels[topic].metadata)
        if provenance and (provenance.transform == VIEW or is_finished(topic, provenance)) and provenance.input in gone:
            gone.add(topic)
    return gone - {*results}


def _left_by_finishers(state: RunState) -> list[str]:
    """Return channels that are out of date since an earlier run, and were made by a finisher that isn't installed."""
    topics = sorted(camera_at(state.opened, state.prefix).topics)
    return [topic for topic in topics if missing_finisher(state.opened, topic) and is_stale(state.opened, topic)]


def outdated_by(opened: log.Log, digests: Mapping[str, str]) -> list[str]:
    """Return the other channels that stages made from earlier contents of these topics, or compared with them."""
    outdated = []
    for topic, channel in sorted(opened.channels.items()):
        how = Provenance.from_metadata(channel.metadata)
        if topic in digests or how is None:
            continue
        is_result = how.transform in STAGES or how.transform == FUSE or is_finished(topic, how)
        if is_result and any(digests.get(name, then) != then for name, then in how.made_from().items()):
            outdated.append(topic)
    return outdated


# Run one job.


class _Repeatable(Iterable[Frame]):
    """Frames that a transform can go through several times, each time from the beginning."""

    def __init__(self, begin: Callable[[], Iterator[Frame]]) -> None:
        self._begin = begin

    def __iter__(self) -> Iterator[Frame]:
        return self._begin()


def _done(work: Work) -> dict[str, Made]:
    """Do the work of a job, and return its channels by topic."""
    job, stage, opened = work.job, work.stage, work.state.opened
    work.prepare()
    counts = [0]
    try:
        with collected() as warnings:
            _transform(work, counts)
            work.finish()
            if not warnings and not _has_warned_of_unread(work, max(counts)):  # else a warning has given the reason
                warn_no_rows(job.stage, job.source, work.transform, work.source.frames, work.main())
            if work.transform.reads is VIDEO and job.source in opened.channels:
                for note in foreign.facts_of(opened, job.source).notes:
                    warn(note, "pictures")
    except McaptrackError as error:
        where = "" if str(opened.path) in str(error) else f"{opened.path}: {job.source}: "
        raise type(error)(f"{where}{error}") from None
    work.source.warn_lost(job.source, work.transform.reads, max(counts))
    provenance, usual = _provenance_of(work, [*work.notices, *warnings]), stage.outputs(job.target)
    return {
        topic: Made.of(
            schema, frames, replace(provenance, output="" if topic in usual else topic.removeprefix(job.target + "/"))
        )
        for topic, (schema, frames) in work.outputs.items()
        if topic in job.kept()
    }


def _has_warned_of_unread(work: Work, count_read: int) -> bool:
    """Warn if no picture of a channel could be decoded."""
    messages = work.source.messages()
    if work.transform.reads is not VIDEO or count_read or not messages:
        return False
    cause = foreign.facts_of(work.state.opened, work.job.source).recogniser.cause or LATE_BEGINNING
    warn(f"{work.job.source}: no picture in its {messages} messages can be decoded: {cause}", "no-pictures")
    return True


def _transform(work: Work, counts: list[int]) -> None:
    """Call the transform of a job, and collect its outputs; ``counts`` gets the frames that it read, each time."""
    transform, stage = work.transform, work.stage
    collectors = [FrameCollector(schema) for schema in transform.writes.values()]
    stream = _Repeatable(lambda: _counting(work.source.stream, counts))
    for result in guarded(stage.entry(type(transform)), transform, stream):
        for frame, collector in zip(result, collectors, strict=True):
            collector.append(frame)
    for (topic, schema), collector in zip(work.job.outputs().items(), collectors, strict=True):
        work.outputs[topic] = schema, collector.done()


def _provenance_of(work: Work, warnings: Sequence[Notice]) -> Provenance:
    """Return the provenance of a job's channels. Classes are named by the transform, or else by its input.

    Raises McaptrackError for parameters that a log can't hold.
    """
    stage, transform, source = work.stage, work.transform, work.source
    predictor = getattr(transform, "predictor", None)
    card = transform.model_card() if hasattr(transform, "model_card") else ModelCard()
    return Provenance(
        work.job.stage,
        _recorded(stage, transform),
        work.job.source,
        source.digest(),
        weights_sha256=weights_sha256(predictor) if isinstance(predictor, str) else card.weights_sha256,
        references=work.references,
        plugins=plugins_of(stage, transform),
        classes={str(number): name for number, name in card.classes.items()} or source.classes,
        frame_id=source.frame_id,
        model=card.facts,
        warnings=[(notice.code, notice.message) for notice in warnings],
        continued=work.continued,
        boxes=source.boxes,
        scores=work.scores,
    )


def _recorded(stage: Stage, transform: Transform) -> dict[str, Any]:
    """Return the parameters of a transform as the provenance holds them. Raises McaptrackError if a log can't."""
    entry = stage.entry(type(transform))
    large = [f for f in fields(transform) if not f.metadata.get("is_recorded", True)]
    unrecorded: dict[str, Any] = {f.name: f.default_factory() for f in large if callable(f.default_factory)}
    recorded = replace(transform, **unrecorded) if unrecorded else transform
    parameters = {name: value for name, value in asdict(recorded).items() if name not in unrecorded}
    parameters |= recorded_planes(transform) | ({stage.kind: entry.name} if stage.kind else {})
    try:
        out: dict[str, Any] = json.loads(json.dumps(parameters))
    except TypeError as error:
        raise McaptrackError(f"the parameters of {entry} can't be kept in a log: {error}") from None
    return out


def _input(
    state: RunState, job: Job, stamps: dict[str, list[int]], progress: Progress, boxes: BoxesRead, watch: Stopwatch
) -> Input:
    """Return the input of a job; the capture times of pictures in ns are appended to ``stamps``, by topic."""
    opened, results = state.opened, state.results
    if job.source not in results and job.transform.reads is VIDEO:
        seen = stamps.setdefault(job.source, [])
        damaged, unreadable = list[int](), list[McaptrackError]()
        digest, pictures = pictures_of(opened, job, seen, damaged, unreadable)
        steps = opened.channel(job.source).messages * traits_of(job.transform).passes
        numbers = count(1)
        each = _Repeatable(lambda: _counted(watch.each("decode", pictures), numbers, steps, job.stage, progress))
        return Input(each, [], digest, lambda: len(seen), damaged=damaged, unreadable=unreadable)
    if job.source in results:
        facts: Mapping[str, str] = {}
        frames, how = results[job.source].frames, results[job.source].provenance
        of_rows, names, frame_id = how.digest, class_names(how.to_metadata()), how.frame_id
    else:
        named = read_named_frames(opened, job.source, job.transform.reads, job.frame_id, boxes)
        frames, names, frame_id, facts = named
        of_rows = digest_of(opened, job.source)
    classes = {str(number): name for number, name in sorted(names.items())}
    stream = _Repeatable(lambda: _counted(frames, count(1), len(frames), job.stage, progress))
    return Input(stream, frames, lambda: of_rows, lambda: len(frames), classes, frame_id, boxes=facts)


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
    topic = opened.find(source, prefix) if source else f"{prefix}/{STAGES[stage].input_topic}"
    job = Job(stage, transform, topic, f"{prefix}/{STAGES[stage].output_topic}")
    check_inputs(opened, prefix, [job])
    frames, names, *_ = read_named_frames(opened, topic, transform.reads)
    classes = {str(number): name for number, name in names.items()}
    source_of_job = Input(frames, frames, lambda: "", lambda: len(frames), classes)
    work = Work(RunState(opened, prefix, {}), job, source_of_job, read_planes(opened, prefix))
    work.take_context()
    if "scores" in work.stage.before:
        BEFORE["scores"](work)
    filled = work.transform
    return work.source.frames, {f.name: getattr(filled, f.name) for f in fields(filled) if f.metadata.get("context")}
