"""Running stages: what they read, what they know of the log, and what they make of it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack import foreign, log
from mcaptrack.carry import carry
from mcaptrack.clock import NS_PER_S, parse_ns
from mcaptrack.notices import Notice, collected, warn
from mcaptrack.pipeline.events import STAGE as EVENTS_STAGE
from mcaptrack.pipeline.events import Watch, make_events, tally
from mcaptrack.pipeline.plan import FULL, ROUTES, Job, check_inputs, picture_topic
from mcaptrack.pipeline.write import Made, digest_of, write
from mcaptrack.plane import GroundPlane, Planes, assumed_plane
from mcaptrack.predictors import weights_sha256
from mcaptrack.provenance import CLOCK, Provenance
from mcaptrack.schema import DETECTIONS, GROUND_PLANE, SCHEMAS, TRACKS, VIDEO, Frame, Schema
from mcaptrack.schema.ground import plane_to_rows, rows_to_plane
from mcaptrack.transforms import TRANSFORMS, Transform, choice
from mcaptrack.video import Encoded, brightness

Ints = NDArray[np.int64]
Progress = Callable[[str, int, int], None]

_ASSUME: Final = "assume-ground-plane"


@dataclass
class Report:
    """What a run did: the stages that ran, the frames of each topic they made, and the layouts for their views.

    ``stale`` are the channels that were made from something that has now been replaced. ``events`` says for each
    channel of tracks how many events of each kind were found. ``warnings`` are what was assumed, left out or looks odd.
    """

    stages: list[str] = field(default_factory=list)
    frames: dict[str, int] = field(default_factory=dict)
    layouts: dict[str, bytes] = field(default_factory=dict)
    stale: list[str] = field(default_factory=list)
    events: dict[str, dict[str, int]] = field(default_factory=dict)
    warnings: list[Notice] = field(default_factory=list)


def run(
    opened: log.Log,
    prefix: str,
    jobs: Sequence[Job],
    output: Path | None = None,
    progress: Progress = lambda *_: None,
    watch: Watch | None = None,
) -> Report:
    """Run the jobs and put their channels and the views of these into the log, or into a copy of it at ``output``.

    With ``watch`` the events of tracks follow as the last stage, as far as they are missing or out of date.

    Nothing is written until everything is computed; then the log is replaced as a whole.
    """
    with collected() as warnings:
        report = _run(opened, prefix, jobs, output, progress, watch)
    report.warnings = warnings
    return report


def _run(
    opened: log.Log, prefix: str, jobs: Sequence[Job], output: Path | None, progress: Progress, watch: Watch | None
) -> Report:
    made: dict[str, Made] = {}
    stamps: dict[str, list[int]] = {}
    report = Report()
    planes = read_planes(opened, prefix)
    for job in jobs:
        # A guessed scale is guessed anew from new detections; a given one stands.
        if (planes is None and job.stage in ("track", "sample")) or (job.stage == "track" and _is_assumed(planes)):
            planes = _assume_plane(opened, prefix, made, job.source)
        transform = _in_context(opened, prefix, job, made, planes or ())
        input_digest, frames = _input(opened, job, made, stamps, progress)
        outputs: list[list[Frame]] = [[] for _ in job.transform.writes]
        for result in transform(frames):
            for frame, channel in zip(result, outputs, strict=True):
                channel.append(frame)
        seen = len(stamps.get(job.source, ())) if job.source not in made else 0
        if job.transform.reads is VIDEO and seen > len(outputs[0]):
            warn(
                f"{job.source}: {seen - len(outputs[0])} of {seen} messages were left out: a video has to begin with a "
                "key picture that has its parameter sets",
                "left-out",
            )
        weights = weights_sha256(transform.predictor) if hasattr(transform, "predictor") else ""
        for (topic, schema), channel in zip(job.outputs().items(), outputs, strict=True):
            if topic not in job.kept():
                continue
            parameters = json.loads(json.dumps(choice(job.stage, transform) | asdict(transform)))
            provenance = Provenance(job.stage, parameters, job.source, input_digest(), weights_sha256=weights)
            made[topic] = Made.of(schema, channel, provenance)
            report.frames[topic] = len(channel)
        if job.target + FULL in job.kept():
            made |= _carried(opened, job, made, planes or ())
        report.stages.append(job.stage)
    if watch is not None:
        happened = make_events(opened, prefix, made, watch)
        made |= happened
        report.frames |= {topic: len(channel.messages) for topic, channel in happened.items()}
        report.events = tally(happened)
        report.stages += [EVENTS_STAGE] if happened else []
    if made or output is not None:
        report.layouts = write(opened, prefix, made, planes or (), stamps, output)
    digests = {topic: channel.provenance.digest for topic, channel in made.items()}
    for topic, there in sorted(opened.channels.items()):
        known = Provenance.from_metadata(there.metadata)
        if topic not in made and known and known.transform in {*TRANSFORMS, EVENTS_STAGE}:
            is_late = any(digests.get(name, then) != then for name, then in known.made_from().items())
            report.stale += [topic] if is_late else []
    return report


def _carried(opened: log.Log, job: Job, made: Mapping[str, Made], planes: Planes) -> dict[str, Made]:
    """The re-tracked people at the rate of the tracks that their samples were made from; nothing if there are none."""
    samples = (
        made[job.source].provenance
        if job.source in made
        else Provenance.from_metadata(opened.channel(job.source).metadata)
    )
    source = samples.input if samples else ""
    if source in made:
        tracks = made[source].frames if made[source].schema is TRACKS else []
    else:
        there = source in opened.channels and opened.channels[source].schema_name == TRACKS.name
        tracks = opened.frames(source, TRACKS) if there else []
    if not tracks:
        return {}
    retracked = made[job.target]
    frames = carry(tracks, retracked.frames, planes)
    return {job.target + FULL: Made.of(TRACKS, frames, retracked.provenance)}


def _in_context(opened: log.Log, prefix: str, job: Job, made: Mapping[str, Made], planes: Planes) -> Transform:
    """The transform with what the log knows: ground planes, the start of the clock, its rate."""
    names = {f.name for f in fields(job.transform) if f.metadata.get("context")}
    known: dict[str, Any] = {}
    if "ground_planes" in names:
        known["ground_planes"] = tuple(planes)
    if "start_ns" in names:
        known["start_ns"] = _clock_start(opened, prefix)
    if "rate_hz" in names:
        times = [f.t_ns for f in made[job.source].frames] if job.source in made else opened.times(job.source).tolist()
        steps = np.diff(times)
        if (steps > 0).any():  # frames may share a time
            known["rate_hz"] = round(NS_PER_S / float(np.median(steps[steps > 0])), 6)
    return replace(job.transform, **known)


def _clock_start(opened: log.Log, prefix: str) -> int | None:
    """When the clock of prediction begins: as ingest said, or with the first picture of the camera."""
    said = opened.metadata(CLOCK)
    if said and (start := parse_ns(said.get("start_ns", ""))) is not None:
        return start
    pictures = picture_topic(opened, prefix)
    return min(opened.times(pictures).tolist(), default=None) if pictures else None


def _input(
    opened: log.Log, job: Job, made: Mapping[str, Made], stamps: dict[str, list[int]], progress: Progress
) -> tuple[Callable[[], str], Iterable[Frame]]:
    """The frames that a job reads, and their digest, to be asked for when they have been read."""
    if job.source in made:
        source = made[job.source]
        return (lambda: source.provenance.digest), _counted(source.frames, job.stage, progress)
    channel = opened.channel(job.source)
    if job.transform.reads is VIDEO:
        return _pictures(opened, channel, stamps.setdefault(channel.topic, []), job.stage, progress)
    said = digest_of(opened, job.source)
    frames = _frames(opened, job.source, job.transform.reads)
    return (lambda: said), _counted(frames, job.stage, progress)


def _frames(opened: log.Log, topic: str, schema: Schema) -> list[Frame]:
    """The rows of a channel, ours or others'."""
    theirs = foreign.holds_detections(opened.channel(topic))
    return foreign.detections(opened, topic) if theirs else opened.frames(topic, schema)


def _counted(frames: Sequence[Frame], stage: str, progress: Progress) -> Iterator[Frame]:
    for count, frame in enumerate(frames, start=1):
        yield frame
        progress(stage, count, len(frames))


def _pictures(
    opened: log.Log, channel: log.Channel, stamps: list[int], stage: str, progress: Progress
) -> tuple[Callable[[], str], Iterator[Frame]]:
    """The brightness of a channel's pictures; ``stamps`` gets the stamp of each."""
    import hashlib

    total = hashlib.sha256()

    def encoded() -> Iterator[Encoded]:
        stamps.clear()
        for index, (message, picture) in enumerate(foreign.pictures(opened, channel.topic)):
            total.update(message.t_ns.to_bytes(8, "little") + message.payload)
            stamps.append(picture.stamp_ns)
            where = f"{opened.path}: {channel.topic} at {message.t_ns} ns: frame {index}"
            yield Encoded(message.t_ns, index, picture.format, picture.data, picture.layout, where)
            progress(stage, index + 1, channel.messages)

    return total.hexdigest, brightness(encoded())


def input_of(
    opened: log.Log, prefix: str, stage: str, transform: Transform, source: str | None = None
) -> tuple[list[Frame], dict[str, Any]]:
    """What a stage would read from a log, and what the log knows for it (the fields made with ``context``).

    Raises McaptrackError if the input isn't there.
    """
    topic = source or f"{prefix}/{ROUTES[stage].reads}"
    job = Job(stage, transform, topic, f"{prefix}/{ROUTES[stage].writes}")
    check_inputs(opened, prefix, [job])
    known = _in_context(opened, prefix, job, {}, read_planes(opened, prefix) or ())
    context = {f.name: getattr(known, f.name) for f in fields(known) if f.metadata.get("context")}
    return _frames(opened, topic, transform.reads), context


def read_planes(opened: log.Log, prefix: str) -> Planes | None:
    """The ground planes of a camera with the times from which they hold; None if there are none."""
    topic = f"{prefix}/ground_plane"
    if topic not in opened.channels:
        return None
    frames = opened.frames(topic, GROUND_PLANE)
    return [(frame.t_ns, rows_to_plane(frame.rows)) for frame in frames] or None


def _is_assumed(planes: Planes | None) -> bool:
    return planes is not None and all(plane.assumed for _, plane in planes)


def _assume_plane(opened: log.Log, prefix: str, made: dict[str, Made], source: str) -> Planes | None:
    """Guess a scale from the boxes where nobody gave a ground plane; it becomes a channel that says so."""
    if source in made:
        frames, known = made[source].frames, made[source].provenance
    else:
        channel = opened.channel(source)
        frames = _frames(opened, source, SCHEMAS.get(channel.schema_name, DETECTIONS))
        known = Provenance.from_metadata(channel.metadata) or Provenance("", {})
    rows = np.concatenate([frame.rows[["x_px", "y_px", "w_px", "h_px"]] for frame in frames]) if frames else None
    if rows is None or not np.isfinite(rows["h_px"]).any():
        return None  # nothing in pixels: nothing to bring to metres
    width, height = (int(np.nanmax(rows[a] + rows[b]).round()) for a, b in (("x_px", "w_px"), ("y_px", "h_px")))
    plane: GroundPlane = assumed_plane(rows["h_px"], width, height)
    metres = 1 / plane.homography[0]
    warn(
        f"no ground plane is known: taking {metres:.3g} px for a metre, since people are 1.7 m high; "
        "give one with `mcaptrack ingest --ground-plane`",
        "assumed-ground-plane",
    )
    start = frames[0].t_ns
    provenance = Provenance(_ASSUME, {}, source, known.digest)
    made[f"{prefix}/ground_plane"] = Made.of(GROUND_PLANE, [Frame(start, 0, plane_to_rows(plane))], provenance)
    return [(start, plane)]
