"""Stages in order: which channel feeds which transform, what has to run first, and what it leaves in the log.

A stage runs on a log that stands and adds its channels to it, with what they were made from and how. What is missing is
made first; what was made from a channel that has changed since is made again, with the parameters it had.
"""

from __future__ import annotations

import heapq
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack import foreign, foxglove, log, views
from mcaptrack.carry import carry
from mcaptrack.clock import NS_PER_S
from mcaptrack.errors import McaptrackError
from mcaptrack.plane import GroundPlane, Planes, assumed_plane
from mcaptrack.predictors import weights_sha256
from mcaptrack.provenance import CLOCK, Provenance, digest
from mcaptrack.schema import DETECTIONS, GROUND_PLANE, PREDICTIONS, SCHEMAS, TRACKS, VIDEO, Frame, Schema
from mcaptrack.schema.ground import plane_to_rows, rows_to_plane
from mcaptrack.transforms import TRANSFORMS, Transform, choice, chosen
from mcaptrack.video import Encoded, brightness

Ints = NDArray[np.int64]
Progress = Callable[[str, int, int], None]
Say = Callable[[str], None]
#: Log time, number of the channel, sequence and payload of a message.
Numbered = tuple[int, int, int, bytes]

DEFAULT_CAMERA: Final = "camera"


class Route(NamedTuple):
    """Where a transform reads and writes, below the camera's prefix."""

    reads: str
    writes: str


#: The channels between the stages, in the order in which they run.
ROUTES: Final[Mapping[str, Route]] = {
    "detect": Route("video", "detections"),
    "track": Route("detections", "tracks"),
    "sample": Route("tracks", "samples"),
    "predict": Route("samples", "predictions"),
    "retrack": Route("samples", "retracks"),
}
_MAKER: Final = {route.writes: name for name, route in ROUTES.items()}
#: Below the re-tracked tracks: the same at the video's rate.
_FULL: Final = "/full"
_ASSUME: Final = "assume-ground-plane"


class Job(NamedTuple):
    """A transform to run from one topic to another; ``keep`` are the outputs that go into the log, None for all."""

    stage: str
    transform: Transform
    source: str
    target: str
    keep: tuple[str, ...] | None = None

    def outputs(self) -> dict[str, Schema]:
        """Topic and schema of each output, in the transform's order."""
        return {f"{self.target}/{suffix}".rstrip("/"): schema for suffix, schema in self.transform.writes.items()}

    def kept(self) -> set[str]:
        """The topics that go into the log."""
        kept = {f"{self.target}/{suffix}".rstrip("/") for suffix in self.keep or self.transform.writes}
        return kept | {self.target + _FULL} if self.stage == "retrack" and self.target in kept else kept


class Made(NamedTuple):
    """A channel that was just made."""

    schema: Schema
    frames: list[Frame]
    provenance: Provenance
    messages: list[tuple[int, int, bytes]]


@dataclass
class Report:
    """What a run did: the stages that ran, the frames of each topic they made, and the layout for their views.

    ``stale`` are the channels that were made from something that has now been replaced.
    """

    stages: list[str] = field(default_factory=list)
    frames: dict[str, int] = field(default_factory=dict)
    layout: bytes | None = None
    stale: list[str] = field(default_factory=list)


def find_camera(opened: log.Log, camera: str | None, topic: str | None = None) -> str:
    """The prefix that everything of one camera lives under: of the topic, of the name, or the only one of the log."""
    if topic:
        return "/" + topic.strip("/").rpartition("/")[0] if "/" in topic.strip("/") else "/" + DEFAULT_CAMERA
    if camera:
        return "/" + camera.strip("/")
    ours = [channel for channel in opened.channels.values() if Provenance.from_metadata(channel.metadata)]
    names = [*(route.writes for route in ROUTES.values()), "video", "truth", "ground_plane"]
    found = {c.topic.removesuffix("/" + name) for c in ours for name in names if c.topic.endswith("/" + name)}
    found = {prefix for prefix in found if prefix + "/retracks" not in found and not prefix.endswith("/retracks")}
    if len(found) > 1 and "/" + DEFAULT_CAMERA not in found:
        raise McaptrackError(f"{opened.path} has several cameras, {', '.join(sorted(found))}; choose one with --camera")
    if not found:
        return find_camera(opened, None, _only_pictures(opened) or DEFAULT_CAMERA)
    return found.pop() if len(found) == 1 else "/" + DEFAULT_CAMERA


def picture_topic(opened: log.Log, prefix: str) -> str | None:
    """Where the pictures of a camera are: its video, what its detections were made from, or all that others recorded.

    None if there are no pictures, or several channels of them and nothing to tell whose they are.
    """
    if f"{prefix}/video" in opened.channels:
        return f"{prefix}/video"
    detections = opened.channels.get(f"{prefix}/detections")
    made = Provenance.from_metadata(detections.metadata) if detections else None
    source = opened.channels.get(made.input) if made else None
    return source.topic if source and foreign.holds_pictures(source) else _only_pictures(opened)


def _only_pictures(opened: log.Log) -> str | None:
    channels = opened.channels.values()
    theirs = [c.topic for c in channels if foreign.holds_pictures(c) and not Provenance.from_metadata(c.metadata)]
    return theirs[0] if len(theirs) == 1 else None


def plan_stage(
    opened: log.Log,
    prefix: str,
    stage: str,
    transform: Transform,
    source: str | None = None,
    target: str | None = None,
    keep: tuple[str, ...] | None = None,
    say: Say = lambda _: None,
    defaults: Mapping[str, Transform] = {},
) -> list[Job]:
    """The jobs that run one stage, whether or not its channel stands, and before it what is missing or out of date.

    ``source`` and ``target`` are topics other than the usual ones; ``defaults`` are transforms for stages that are
    missing, where they are not to be the usual ones. Raises McaptrackError if there is nothing to start
    from.
    """
    route = ROUTES[stage]
    planner = _Planner(opened, prefix, say, defaults=defaults)
    source = source or planner.source_of(stage)
    planner.ensure(source)
    planner.jobs.append(Job(stage, transform, source, target or f"{prefix}/{route.writes}", keep))
    _check_inputs(opened, prefix, planner.jobs)
    return planner.jobs


def plan_all(
    opened: log.Log,
    prefix: str,
    say: Say = lambda _: None,
    source: str | None = None,
    defaults: Mapping[str, Transform] = {},
) -> list[Job]:
    """The jobs that bring everything about a camera up to date; none if it is.

    ``source`` is a topic with pictures or with boxes that others detected, to begin with; ``defaults`` as in
    ``plan_stage``. Raises McaptrackError as that does.
    """
    planner = _Planner(opened, prefix, say, {_stage_from(opened, source): source} if source else {}, defaults)
    for target in ("predictions", "retracks"):
        planner.ensure(f"{prefix}/{target}")
    _check_inputs(opened, prefix, planner.jobs)
    return planner.jobs


def _stage_from(opened: log.Log, source: str) -> str:
    """The first stage of a run that begins with this topic."""
    channel = opened.channel(source)
    return "track" if channel.schema_name == DETECTIONS.name or foreign.holds_detections(channel) else "detect"


class _Planner:
    """Collects the jobs that make channels stand and be up to date.

    ``sources`` are inputs of stages and ``defaults`` transforms of stages, where they are not the usual ones.
    """

    def __init__(
        self,
        opened: log.Log,
        prefix: str,
        say: Say,
        sources: Mapping[str, str] = {},
        defaults: Mapping[str, Transform] = {},
    ) -> None:
        self.jobs: list[Job] = []
        self._defaults = defaults
        self._opened, self._prefix, self._say = opened, prefix, say
        self._sources = sources
        self._changes: dict[str, bool] = {}

    def source_of(self, stage: str) -> str:
        """The topic that a stage reads, unless it was made from another one before."""
        usual = f"{self._prefix}/{ROUTES[stage].reads}"
        if stage != "detect" or stage in self._sources or usual in self._opened.channels:
            return self._sources.get(stage, usual)
        found = picture_topic(self._opened, self._prefix)
        if found:
            self._say(f"{usual} is missing: taking the pictures of {found}")
        return found or usual

    def ensure(self, topic: str) -> bool:
        """Plan what makes ``topic``; returns whether it will change."""
        if topic not in self._changes:
            self._changes[topic] = self._plan(topic)
        return self._changes[topic]

    def _plan(self, topic: str) -> bool:
        stage = _MAKER.get(topic.removeprefix(self._prefix + "/")) if topic.startswith(self._prefix + "/") else None
        channel = self._opened.channels.get(topic)
        if stage is None or (channel and not _made_by_stage(channel)):
            if stage in self._sources:
                raise McaptrackError(
                    f"{self._opened.path}: {topic} is there and was not made by {stage}; leave --topic out to go on "
                    f"from it, or run {stage} with --topic and --to"
                )
            return False  # recorded or ingested: nothing makes it but its recording
        if channel is None:
            source = self.source_of(stage)
            self.ensure(source)
            self._say(f"{topic} is missing: running {stage}")
            self.jobs.append(Job(stage, self._defaults.get(stage) or TRANSFORMS[stage](), source, topic))
            return True
        made = Provenance.from_metadata(channel.metadata)
        had = made.input if made else self.source_of(stage)
        source = self._sources.get(stage, had)
        if not self.ensure(source) and not is_stale(self._opened, topic) and source == had:
            return False
        if source != had:
            self._say(f"{topic} was made from {had}: running {stage} again, from {source}")
            self.jobs.append(Job(stage, _transform_of(stage, channel), source, topic))
            return True
        self._say(f"{topic} was made from an earlier {source}: running {stage} again, as before")
        self.jobs.append(Job(stage, _transform_of(stage, channel), source, topic))
        return True


def _made_by_stage(channel: log.Channel) -> bool:
    made = Provenance.from_metadata(channel.metadata)
    return made is not None and made.transform in TRANSFORMS


def is_stale(opened: log.Log, topic: str) -> bool:
    """Whether the channel that ``topic`` was made from has been replaced since."""
    made = Provenance.from_metadata(opened.channel(topic).metadata)
    source = opened.channels.get(made.input) if made else None
    now = Provenance.from_metadata(source.metadata) if source else None
    return bool(made and now and now.digest and now.digest != made.input_digest)


def _transform_of(stage: str, channel: log.Channel) -> Transform:
    """The transform that made a channel, with the parameters it had as far as they are known today."""
    made = Provenance.from_metadata(channel.metadata)
    had = made.parameters if made else {}
    kind = chosen(stage, had)
    names = {f.name for f in fields(kind) if not f.metadata.get("context")}
    return kind(**{key: value for key, value in had.items() if key in names})


def _check_inputs(opened: log.Log, prefix: str, jobs: Sequence[Job]) -> None:
    """Every job's input is in the log or made by a job before it, and is of the right kind."""
    coming: dict[str, Schema] = {}
    for job in jobs:
        reads = job.transform.reads
        channel = opened.channels.get(job.source)
        if job.source in coming:
            name, fits = coming[job.source].name, coming[job.source] is reads
        elif channel:
            theirs = foreign.holds_detections(channel) if reads is DETECTIONS else False
            name = channel.schema_name
            fits = foreign.holds_pictures(channel) if reads is VIDEO else theirs or name == reads.name
        else:
            there = [topic for topic in sorted(opened.channels) if not topic.endswith(views.SUFFIX)]
            hint = f"`mcaptrack info {opened.path}` shows more"
            if job.source == f"{prefix}/video":
                hint = f"add pictures with `mcaptrack ingest VIDEO --into {opened.path}`, or name theirs with --topic"
            has = f"it has {', '.join(there) or 'none'}"
            pictures = [topic for topic in there if foreign.holds_pictures(opened.channels[topic])]
            if job.source == f"{prefix}/video" and pictures:
                has, hint = f"it has pictures in {', '.join(pictures)}", "choose one with --topic"
            raise McaptrackError(f"{opened.path} has no channel {job.source} for {job.stage}; {has}. {hint}")
        if not fits:
            theirs_too = foreign.DETECTIONS_READ if reads is DETECTIONS else ()
            wanted = " or ".join(foreign.PICTURES_READ if reads is VIDEO else (reads.name, *theirs_too))
            raise McaptrackError(f"{opened.path}: {job.source} holds {name or 'no schema'}; {job.stage} reads {wanted}")
        for topic in sorted(name for kept in job.kept() for name in (kept, kept + views.SUFFIX)):
            known = opened.channels.get(topic)
            if known and not Provenance.from_metadata(known.metadata):
                raise McaptrackError(
                    f"{opened.path}: {job.stage} would replace {topic}, which others recorded "
                    f"({known.schema_name or 'no schema'}); write to another channel with --to"
                )
        coming |= job.outputs()


def run(
    opened: log.Log,
    prefix: str,
    jobs: Sequence[Job],
    output: Path | None = None,
    progress: Progress = lambda *_: None,
    say: Say = lambda _: None,
) -> Report:
    """Run the jobs and put their channels and the views of these into the log, or into a copy of it at ``output``.

    Nothing is written until everything is computed; then the log is replaced as a whole.
    """
    made: dict[str, Made] = {}
    stamps: dict[str, list[int]] = {}
    report = Report()
    planes = read_planes(opened, prefix)
    for job in jobs:
        # A guessed scale is guessed anew from new detections; a given one stands.
        if (planes is None and job.stage in ("track", "sample")) or (job.stage == "track" and _is_assumed(planes)):
            planes = _assume_plane(opened, prefix, made, job.source, say)
        transform = _in_context(opened, prefix, job, made, planes or ())
        input_digest, frames = _input(opened, job, made, stamps, progress)
        outputs: list[list[Frame]] = [[] for _ in job.transform.writes]
        for result in transform(frames):
            for frame, channel in zip(result, outputs, strict=True):
                channel.append(frame)
        weights = weights_sha256(transform.predictor) if hasattr(transform, "predictor") else ""
        for (topic, schema), channel in zip(job.outputs().items(), outputs, strict=True):
            if topic not in job.kept():
                continue
            messages = [(f.t_ns, f.index, schema.codec.encode(schema.check(f.rows))) for f in channel]
            parameters = json.loads(json.dumps(choice(job.stage, transform) | asdict(transform)))
            provenance = Provenance(job.stage, parameters, job.source, input_digest(), digest(messages), weights)
            made[topic] = Made(schema, channel, provenance, messages)
            report.frames[topic] = len(channel)
        if job.target + _FULL in job.kept():
            made |= _carried(opened, job, made, planes or ())
        report.stages.append(job.stage)
    if made or output is not None:
        report.layout = _write(opened, prefix, made, planes or (), stamps, output)
    digests = {topic: channel.provenance.digest for topic, channel in made.items()}
    for topic, there in sorted(opened.channels.items()):
        known = Provenance.from_metadata(there.metadata)
        if topic not in made and known and known.transform in TRANSFORMS and known.input in digests:
            report.stale += [topic] if known.input_digest != digests[known.input] else []
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
    messages = [(f.t_ns, f.index, TRACKS.codec.encode(TRACKS.check(f.rows))) for f in frames]
    return {job.target + _FULL: Made(TRACKS, frames, replace(retracked.provenance, digest=digest(messages)), messages)}


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
        if len(times) > 1:
            known["rate_hz"] = round(NS_PER_S / float(np.median(np.diff(times))), 6)
    return replace(job.transform, **known)


def _clock_start(opened: log.Log, prefix: str) -> int | None:
    """When the clock of prediction begins: as ingest said, or with the first picture of the camera."""
    said = opened.metadata(CLOCK)
    if said and said.get("start_ns", "").lstrip("-").isdigit():
        return int(said["start_ns"])
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
    known = Provenance.from_metadata(channel.metadata)
    said = known.digest if known else ""
    if not said:
        said = digest((m.t_ns, m.sequence, m.payload) for m in opened.messages(job.source))
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
    _check_inputs(opened, prefix, [job])
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


def _assume_plane(opened: log.Log, prefix: str, made: dict[str, Made], source: str, say: Say) -> Planes | None:
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
    say(
        f"no ground plane is known: taking {metres:.3g} px for a metre, since people are 1.7 m high; "
        "give one with `mcaptrack ingest --ground-plane`"
    )
    start = frames[0].t_ns
    messages = [(start, 0, GROUND_PLANE.codec.encode(plane_to_rows(plane)))]
    provenance = Provenance(_ASSUME, {}, source, known.digest, digest(messages))
    made[f"{prefix}/ground_plane"] = Made(GROUND_PLANE, [Frame(start, 0, plane_to_rows(plane))], provenance, messages)
    return [(start, plane)]


def _stamps(opened: log.Log, topic: str, known: Sequence[int]) -> Ints:
    """The stamps of a channel's pictures. Our own are the log's times; those of others stand in the messages."""
    if Provenance.from_metadata(opened.channel(topic).metadata):
        return opened.times(topic)
    return np.array(known, np.int64) if known else foreign.stamps(opened, topic)


def _write(
    opened: log.Log,
    prefix: str,
    made: Mapping[str, Made],
    planes: Planes,
    stamps: Mapping[str, Sequence[int]],
    output: Path | None,
) -> bytes | None:
    """Put what was made, and its views, into the log. Returns the layout, if there are pictures to draw on.

    ``stamps`` are those of pictures that were read on the way.
    """
    usual = f"{prefix}/video"
    video = usual if usual in opened.channels else next(iter(stamps), None) or picture_topic(opened, prefix)
    truth = f"{prefix}/truth"
    picture_ns = opened.times(video) if video else np.empty(0, np.int64)
    stamp_ns = _stamps(opened, video, stamps.get(video, ())) if video else picture_ns
    shown = {topic: (channel.schema, channel.frames, channel.provenance.digest) for topic, channel in made.items()}
    if truth in opened.channels and truth + views.SUFFIX not in opened.channels:
        known = Provenance.from_metadata(opened.channel(truth).metadata)
        shown[truth] = (TRACKS, opened.frames(truth, TRACKS), known.digest if known else "")
    outdated = {topic + views.SUFFIX for topic in made}
    streams: list[Iterator[Numbered]] = []
    with log.extend(opened, output, drop={*made, *outdated}, drop_attachments=[LAYOUT]) as writer:
        for topic, channel in made.items():
            record = (channel.schema.name, "protobuf", channel.schema.descriptor)
            made_by = channel.provenance.transform  # results of one stage share chunks, so that they can go together
            number = writer.add_channel(topic, record, "protobuf", channel.provenance.to_metadata(), group=made_by)
            streams.append(_with_number(number, channel.messages))
        if video is None or not len(picture_ns):
            _write_by_time(writer, streams)
            return None
        topics = [topic for topic in opened.channels if topic.endswith(views.SUFFIX) and topic not in outdated]
        for topic, (schema, frames, made_from) in shown.items():
            if schema not in (DETECTIONS, TRACKS, PREDICTIONS) or topic.endswith(_NOT_SHOWN):
                continue
            metadata = Provenance("view", {}, topic, made_from).to_metadata()
            record = foxglove.schema_record(foxglove.ANNOTATIONS)
            made_by = made[topic].provenance.transform if topic in made else ""
            number = writer.add_channel(topic + views.SUFFIX, record, "protobuf", metadata, group=made_by)
            view = views.view(topic, schema, frames, picture_ns, planes, stamp_ns)
            streams.append(_with_number(number, view))
            topics.append(topic + views.SUFFIX)
        _write_by_time(writer, streams)
        layout_file = layout(prefix, topics, video)
        writer.add_attachment(LAYOUT, "application/json", layout_file)
    return layout_file


def _with_number(number: int, messages: Iterable[tuple[int, int, bytes]]) -> Iterator[Numbered]:
    return ((t_ns, number, sequence, data) for t_ns, sequence, data in messages)


def _write_by_time(writer: log.LogWriter, streams: Iterable[Iterator[Numbered]]) -> None:
    """Messages of several channels, each by time, all together by time: so that those shown together stand together."""
    for t_ns, number, sequence, data in heapq.merge(*streams, key=lambda message: message[0]):
        writer.add_message(number, t_ns, sequence, data)


#: Channels without a view: they show what others show, at fewer times.
_NOT_SHOWN: Final = ("/samples", "/online")
#: The attachment that holds the layout.
LAYOUT: Final = "mcaptrack.layout.json"
#: Views that a layout switches on, below the prefix; the others can be switched on by hand.
_SHOWN: Final = ("retracks/full", "retracks", "tracks", "detections")


def layout(prefix: str, view_topics: Sequence[str], picture_topic: str) -> bytes:
    """The layout for a camera's views over its pictures: the best that there is switched on."""
    names = {topic: topic.removeprefix(prefix + "/").removesuffix(views.SUFFIX) for topic in sorted(view_topics)}
    there = set(names.values())
    on = _switched_on(there)
    paths = [f"{prefix}/{name}.rows[:].x_m" for name in ("tracks", "retracks") if name in there]
    return foxglove.layout(picture_topic, {topic: name in on for topic, name in names.items()}, paths)


def _switched_on(there: set[str]) -> list[str]:
    """The best views of those that there are, below the prefix."""
    best = [name for name in _SHOWN if name in there][:1]
    return best + [name for name in ("retracks/predictions",) if "retracks" in there and name in there]


def find_views(opened: log.Log, prefix: str, topics: Sequence[str] = ()) -> list[str]:
    """The topics of the views that a layout switches on, or those of these channels.

    Raises McaptrackError if there are none.
    """
    if topics:
        chosen = [topic if topic.endswith(views.SUFFIX) else topic + views.SUFFIX for topic in topics]
        return [opened.channel(topic).topic for topic in chosen]
    there = {
        topic.removeprefix(prefix + "/").removesuffix(views.SUFFIX)
        for topic in opened.channels
        if topic.startswith(prefix + "/") and topic.endswith(views.SUFFIX)
    }
    found = [f"{prefix}/{name}{views.SUFFIX}" for name in _switched_on(there)]
    if not found:
        raise McaptrackError(f"{opened.path} has no views of {prefix} yet; `mcaptrack run {opened.path}` makes them")
    return found
