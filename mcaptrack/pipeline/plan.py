"""Which channel feeds which transform, and what has to run, and before what.

What is missing is made first; what was made from a channel that has changed since is made again, with the parameters it
had.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Final, NamedTuple

from mcaptrack import foreign, log, views
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import warn
from mcaptrack.provenance import Provenance
from mcaptrack.schema import DETECTIONS, VIDEO, Schema
from mcaptrack.transforms import TRANSFORMS, Transform, chosen

Say = Callable[[str], None]

DEFAULT_CAMERA: Final = "camera"
#: Below the re-tracked tracks: the same at the video's rate.
FULL: Final = "/full"


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
#: So many parameters that differ are named.
_NAMED: Final = 3
_MAKER: Final = {route.writes: name for name, route in ROUTES.items()}


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
        return kept | {self.target + FULL} if self.stage == "retrack" and self.target in kept else kept


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
    check_inputs(opened, prefix, planner.jobs)
    return planner.jobs


def plan_all(
    opened: log.Log,
    prefix: str,
    say: Say = lambda _: None,
    source: str | None = None,
    defaults: Mapping[str, Transform] = {},
    anew: bool = False,
) -> list[Job]:
    """The jobs that bring everything about a camera up to date; none if it is.

    ``source`` is a topic with pictures or with boxes that others detected, to begin with; ``defaults`` as in
    ``plan_stage``. With ``anew`` what is up to date is made again, too, as ``defaults`` say or else as before. Raises
    McaptrackError as ``plan_stage`` does.
    """
    planner = _Planner(opened, prefix, say, {_stage_from(opened, source): source} if source else {}, defaults, anew)
    for target in ("predictions", "retracks"):
        planner.ensure(f"{prefix}/{target}")
    check_inputs(opened, prefix, planner.jobs)
    return planner.jobs


def _stage_from(opened: log.Log, source: str) -> str:
    """The first stage of a run that begins with this topic."""
    channel = opened.channel(source)
    return "track" if channel.schema_name == DETECTIONS.name or foreign.holds_detections(channel) else "detect"


class _Planner:
    """Collects the jobs that make channels stand and be up to date.

    ``sources`` are inputs of stages and ``defaults`` transforms of stages, where they are not the usual ones. With
    ``anew`` all stages run, whether or not their channels stand.
    """

    def __init__(
        self,
        opened: log.Log,
        prefix: str,
        say: Say,
        sources: Mapping[str, str] = {},
        defaults: Mapping[str, Transform] = {},
        anew: bool = False,
    ) -> None:
        self.jobs: list[Job] = []
        self._defaults, self._anew = defaults, anew
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
        stands = not self.ensure(source) and not is_stale(self._opened, topic) and source == had
        before = _transform_of(stage, channel)
        wanted = self._defaults.get(stage, before)
        if self._anew:
            before = wanted
        elif differing := _differing(before, wanted):
            warn(
                f"{topic} was made with other settings than now ({differing}); `mcaptrack run --force` takes these",
                "other-settings",
            )
        if stands and not self._anew:
            return False
        if source != had:
            self._say(f"{topic} was made from {had}: running {stage} again, from {source}")
        elif not stands and not self._anew:
            self._say(f"{topic} was made from an earlier {source}: running {stage} again, as before")
        self.jobs.append(Job(stage, before, source, topic))
        return True


def _differing(before: Transform, wanted: Transform) -> str:
    """The parameters in which two transforms of a stage differ, in words; "" if there are none."""
    if type(before) is not type(wanted):
        return f"{type(wanted).__name__}, not {type(before).__name__}"
    names = [f.name for f in fields(before) if not f.metadata.get("context")]
    pairs = [(name, getattr(before, name), getattr(wanted, name)) for name in names]
    words = [f"{name} {now}, not {then}" for name, then, now in pairs if then != now]
    return "; ".join(words[:_NAMED]) + (f"; and {len(words) - _NAMED} more" if len(words) > _NAMED else "")


def _made_by_stage(channel: log.Channel) -> bool:
    made = Provenance.from_metadata(channel.metadata)
    return made is not None and made.transform in TRANSFORMS


def is_stale(opened: log.Log, topic: str) -> bool:
    """Whether the channel that ``topic`` was made from, or compared with, has been replaced since."""
    made = Provenance.from_metadata(opened.channel(topic).metadata)
    if made is None:
        return False
    if any((name in opened.channels) != bool(then) for name, then in made.references.items()):
        return True
    for name, then in made.made_from().items():
        source = opened.channels.get(name)
        now = Provenance.from_metadata(source.metadata) if source else None
        if now and now.digest and now.digest != then:
            return True
    return False


def _transform_of(stage: str, channel: log.Channel) -> Transform:
    """The transform that made a channel, with the parameters it had as far as they are known today."""
    made = Provenance.from_metadata(channel.metadata)
    had = made.parameters if made else {}
    kind = chosen(stage, had)
    names = {f.name for f in fields(kind) if not f.metadata.get("context")}
    return kind(**{key: value for key, value in had.items() if key in names})


def check_inputs(opened: log.Log, prefix: str, jobs: Sequence[Job]) -> None:
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
            there = [topic for topic in sorted(opened.channels) if "/view/" not in topic]
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
        for topic in sorted(
            name for kept in job.kept() for name in (kept, *(kept + suffix for suffix in views.SUFFIXES))
        ):
            known = opened.channels.get(topic)
            if known and not Provenance.from_metadata(known.metadata):
                raise McaptrackError(
                    f"{opened.path}: {job.stage} would replace {topic}, which others recorded "
                    f"({known.schema_name or 'no schema'}); write to another channel with --to"
                )
        coming |= job.outputs()
