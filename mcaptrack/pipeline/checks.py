"""Check the inputs and outputs of stages before any of them runs.

A stage may replace only channels that it made itself: not recorded or ingested ones, and not those of other stages.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import is_dataclass
from typing import Final, NamedTuple

from mcaptrack import log
from mcaptrack.errors import McaptrackError, call, list_names, offer
from mcaptrack.notices import warn
from mcaptrack.schema import DETECTIONS, VIDEO, Frame, Schema
from mcaptrack.schema.classes import class_names
from mcaptrack.schema.frame_columns import collect
from mcaptrack.schema.names import plain_name
from mcaptrack.schema.provenance import INGEST, SCENE_SUFFIX, VIEW, VIEW_SUFFIX, Provenance, frame_id_of
from mcaptrack.sources import foreign
from mcaptrack.sources.cameras import USUAL, Camera, chain_of, provenance_of
from mcaptrack.sources.fixed_frame import BoxesRead
from mcaptrack.transforms import FULL, STAGES, Transform
from mcaptrack.transforms.protocol import check_options

_FIELDS: Final = "`map=` names the fields of positions or boxes in other messages, as `map='x=people[].x,y=people[].y'`"


class Job(NamedTuple):
    """A transform with its input and output topic; ``keep`` are the outputs that are written, None for all.

    The results of a job with ``is_optional`` are left out, with a warning, if it fails. ``frame_id`` is the frame that
    3D boxes are brought to.
    """

    stage: str
    transform: Transform
    source: str
    target: str
    keep: tuple[str, ...] | None = None
    is_optional: bool = False
    frame_id: str = ""

    def outputs(self) -> dict[str, Schema]:
        """Return the schemas of all outputs by topic, in the transform's order."""
        return {f"{self.target}/{suffix}".rstrip("/"): schema for suffix, schema in self.transform.writes.items()}

    def kept(self) -> set[str]:
        """Return the topics that are written to the log."""
        suffixes = [suffix for suffix in self.transform.writes if not self.keep or suffix in self.keep]
        kept = {f"{self.target}/{suffix}".rstrip("/") for suffix in suffixes}
        return kept | {self.target + FULL} if "video-rate" in STAGES[self.stage].after and self.target in kept else kept


def superseded(opened: log.Log, job: Job) -> list[str]:
    """Return channels below the job's target that its stage made before, and that its transform doesn't make."""
    now, stage = {*job.outputs(), job.target + FULL}, job.stage
    before = (topic for topic in opened.channels if topic not in now and topic.startswith(job.target + "/"))
    own = (topic for topic in before if may_replace(opened, topic, stage))
    return sorted(topic for topic in own if main_topic(opened, stage, topic) == job.target)


def cameras_named(opened: log.Log, names: Sequence[str], among: Sequence[Camera]) -> list[Camera]:
    """Return the cameras with these names. Raises McaptrackError for names that none of ``among`` has."""
    by_name = {name.strip("/"): camera for camera in among for name in camera.names}
    for name in names:
        if name.strip("/") not in by_name:
            raise McaptrackError(f"{opened.path} has no camera {name}; {offer(name, sorted(by_name))}")
    return list(dict.fromkeys(by_name[name.strip("/")] for name in names))


def main_topic(opened: log.Log, stage: str, topic: str) -> str:
    """Return the main output topic of the stage that makes ``topic``: itself, or the topic above its last part."""
    provenance = provenance_of(opened, topic)
    if provenance and provenance.output:
        return topic.removesuffix("/" + provenance.output)
    above = topic.rpartition("/")[0]
    has_outputs = any(below in opened.channels for below in STAGES[stage].outputs(topic)[1:])
    return above if topic in STAGES[stage].outputs(above)[1:] and not has_outputs else topic


def check_inputs(opened: log.Log, prefix: str, jobs: Sequence[Job]) -> None:
    """Raise McaptrackError if a job's input is missing or of the wrong kind, or if a job would replace other results.

    Inputs may be in the log, or come from an earlier job.
    """
    coming: dict[str, Schema] = {}
    for job in jobs:
        if not is_dataclass(job.transform):
            raise McaptrackError(
                f"{type(job.transform).__qualname__} is no dataclass; the fields of a transform are its parameters"
            )
        check_options(job.transform)  # also for transforms of other packages
        if job.keep and not {*job.keep} & {*job.transform.writes}:
            entry = STAGES[job.stage].entry(type(job.transform))
            raise McaptrackError(f"{entry} has no output {' or '.join(job.keep)}, so it can't run in this `mode=`")
        if job.source in coming:
            name, is_read = coming[job.source].name, coming[job.source] is job.transform.reads
        elif job.source in opened.channels:
            name, is_read = fits(opened, job.source, job.transform.reads)
        else:
            raise McaptrackError(_lacks(opened, prefix, job))
        if not is_read:
            reads = job.transform.reads
            theirs_too = foreign.BOXES_READ if reads is DETECTIONS else ()
            wanted = " or ".join(foreign.PICTURES_READ if reads is VIDEO else (reads.name, *theirs_too))
            wanted += f"; {_FIELDS}" if theirs_too else ""
            holds = f"{job.source} holds {_described(name)}"
            raise McaptrackError(f"{opened.path}: {holds}; {job.stage} reads {wanted}")
        _check_outputs(opened, prefix, job)
        coming |= job.outputs()


def fits(opened: log.Log, topic: str, reads: Schema) -> tuple[str, bool]:
    """Return the name of a channel's schema, and whether a stage that reads ``reads`` can read the channel."""
    channel = opened.channel(topic)
    if reads is VIDEO:
        return channel.schema_name, foreign.holds_pictures(channel)
    is_read = channel.schema_name == reads.name
    return channel.schema_name, is_read or (reads is DETECTIONS and foreign.reading_of(opened, topic) is not None)


def read_frames(opened: log.Log, topic: str, schema: Schema) -> Sequence[Frame]:
    """Read the rows of a channel, or the detections of a recording in a foreign format."""
    return read_named_frames(opened, topic, schema).frames


def read_named_frames(
    opened: log.Log, topic: str, schema: Schema, frame_id: str = "", boxes: BoxesRead | None = None
) -> foreign.NamedFrames:
    """Read the rows of a channel as ``read_frames`` does, with the names of classes and of the frame of reference.

    ``frame_id`` is the frame that 3D boxes are brought to (see ``sources.fixed_frame``); ``boxes`` keeps those of other
    software.
    """
    channel = opened.channel(topic)
    if schema is DETECTIONS and channel.schema_name != DETECTIONS.name:
        boxes_read = (BoxesRead() if boxes is None else boxes).read(opened, topic, frame_id)
        return boxes_read._replace(frames=collect(DETECTIONS, boxes_read.frames))
    return foreign.NamedFrames(
        opened.frame_columns(topic, schema), class_names(channel.metadata), frame_id_of(channel.metadata)
    )


def _lacks(opened: log.Log, prefix: str, job: Job) -> str:
    """Return the message for a missing input: what is missing, what the log has, and what to do."""
    topics = [topic for topic in sorted(opened.channels) if "/view/" not in topic]
    has, hint = offer(job.source, topics), f"{call('info', opened.path)} shows more"
    if job.transform.reads is VIDEO and job.source == f"{prefix}/{STAGES[job.stage].input_topic}":
        pictures = [topic for topic in topics if foreign.holds_pictures(opened.channels[topic])]
        if pictures:
            has, hint = offer(job.source, pictures, "it has pictures in"), "choose one with `topic=`"
        else:
            add = call("ingest", "VIDEO", into=opened.path)
            hint = f"add pictures with {add}, or name what to begin with by `topic=`"
            if positions := foreign.uncertain_boxes(opened):
                listed = list_names([f"{topic} ({name})" for topic, name in positions.items()], 5)
                hint = (
                    f"positions that may be of people are in {listed}: `topic=` takes them; or add pictures with {add}"
                )
            else:
                has = f"it has {list_names([_with_type(opened, topic) for topic in topics])}"
                hint += f"; {_FIELDS}"
            for topic in topics:
                if kind := foreign.PICTURES_NOT_READ.get(plain_name(opened.channels[topic].schema_name)):
                    hint = f"{topic} is {kind}, which is not read; {hint}"
    return f"{opened.path} has no channel {job.source} for {job.stage}; {has}. {hint}"


def _check_outputs(opened: log.Log, prefix: str, job: Job) -> None:
    """Raise McaptrackError if a job would replace other channels than its own, or write to a name reserved for others.

    The usual names below a camera are reserved for their stage.
    """
    usual = USUAL.get(job.target.removeprefix(prefix + "/")) if job.target.startswith(prefix + "/") else None
    if usual not in (None, job.stage):
        by = f"what {usual} makes" if usual else "what is ingested"
        raise McaptrackError(f"{opened.path}: {job.target} is the name of {by}; give {job.stage} another `to=`")
    for above in chain_of(opened, job.source):
        if above in job.kept():
            raise McaptrackError(
                f"{opened.path}: {job.source} was itself made from {above}, which {job.stage} would replace; write to "
                "another channel with `to=`"
            )
    for topic in sorted(job.kept()):
        maker = {topic: job.stage} | {topic + suffix: VIEW for suffix in (VIEW_SUFFIX, SCENE_SUFFIX)}
        for name, transform in maker.items():
            if not may_replace(opened, name, transform):
                raise McaptrackError(
                    f"{opened.path}: {job.stage} would replace {name}, which {describe_origin(opened, name)}; "
                    "write to another channel with `to=`"
                )


def may_add(opened: log.Log, topics: Sequence[str], stage: str, what: str, is_asked: bool = False) -> bool:
    """Return whether a stage and its views may write these topics; if not, warn that ``what`` is left out.

    Raises McaptrackError instead, with ``is_asked``.
    """
    made_by = {topic: VIEW if "/view/" in topic else stage for topic in topics}
    taken = next((topic for topic, transform in made_by.items() if not may_replace(opened, topic, transform)), "")
    if not taken:
        return True
    text = f"no {what}: they would replace {taken}, which {describe_origin(opened, taken)}"
    if is_asked:
        raise McaptrackError(f"{opened.path}: {text}")
    warn(text, "left-out")
    return False


def may_replace(opened: log.Log, topic: str, transform: str) -> bool:
    """Return whether a topic is free, or holds only channels that the same transform made."""
    return all(provenance is not None and provenance.transform == transform for provenance, _ in _making(opened, topic))


def describe_origin(opened: log.Log, topic: str) -> str:
    """Describe the origin of a channel as text; if several channels share the topic, a recorded one goes first."""
    provenance, schema_name = min(_making(opened, topic), key=lambda pair: pair[0] is not None)
    if provenance is None:
        return f"was recorded by others ({schema_name or 'no schema'})"
    return "was ingested" if provenance.transform == INGEST else f"was made by {provenance.transform}"


def _making(opened: log.Log, topic: str) -> list[tuple[Provenance | None, str]]:
    """Return provenance (None if recorded) and schema name of each of the channels that share a topic."""
    return [
        (Provenance.from_metadata(channel.metadata), schema.name if schema else "")
        for part in opened.parts
        for channel in part.index.channels.values()
        if channel.topic == topic
        for schema in [part.index.schemas.get(channel.schema_id)]
    ]


def first_stage(opened: log.Log, source: str) -> str:
    """Return the first stage of a run that begins with this topic. Raises McaptrackError if no stage reads it."""
    channel = opened.channel(source)
    for stage in STAGES.values():
        if stage.reads in (VIDEO, DETECTIONS) and fits(opened, source, stage.reads)[1]:
            return stage.name
    wanted = ", ".join((*foreign.PICTURES_READ, DETECTIONS.name, *foreign.BOXES_READ))
    raise McaptrackError(
        f"{opened.path}: {source} holds {_described(channel.schema_name)}; run begins with one of {wanted}; {_FIELDS}"
    )


def _described(type_name: str) -> str:
    """The type of a channel that isn't read, for messages."""
    drawn = " without boxes, cylinders, spheres or frames of lines in its first messages"
    return f"{type_name or 'no schema'}{drawn if foreign.is_drawing(type_name) else ''}"


def _with_type(opened: log.Log, topic: str) -> str:
    type_name = opened.channels[topic].schema_name
    return f"{topic} ({type_name})" if type_name else topic
