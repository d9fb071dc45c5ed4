"""Steps before and after a transform, and its inputs beside the main one.

A stage declares its steps (``Stage.before``, ``Stage.after``) and channels that it reads beside its main one
(``Stage.also_reads``); a transform declares what else it takes from the log, as fields made with ``context()``. The
tables ``BEFORE``, ``CONTEXT`` and ``AFTER`` say what each name stands for. The runner loops over these declarations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.errors import McaptrackError, list_names
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.geometry.clocks import NS_PER_S, parse_ns
from mcaptrack.geometry.plane import Planes, is_assumed, scene_planes
from mcaptrack.geometry.ragged import find_rows
from mcaptrack.notices import Code, Notice, Progress, warn
from mcaptrack.pipeline.checks import Job
from mcaptrack.pipeline.following import Before, warn_unfollowed
from mcaptrack.pipeline.motion import SideInput, boxes_input, motion_input, path_with
from mcaptrack.pipeline.pictures import with_descriptors
from mcaptrack.pipeline.planes import AS_BEFORE, PlaneChoice, is_poor, planes_for, without_unseen
from mcaptrack.pipeline.scores import DOUBTFUL, score_map, score_range, without_doubtful
from mcaptrack.pipeline.staleness import digest_of, takes_corrections
from mcaptrack.pipeline.write import RunState
from mcaptrack.schema import DECISIONS, TRACKS, VIDEO, Frame, Rows, Schema
from mcaptrack.schema.as_rows import to_pictures, to_scene
from mcaptrack.schema.classes import majority
from mcaptrack.schema.frame_columns import collect
from mcaptrack.schema.framing import JoinedFrames, frame_times, join_frames, joined_parts, mapped_rows, row_ends
from mcaptrack.schema.provenance import CLOCK
from mcaptrack.sources.cameras import camera_at
from mcaptrack.sources.corrections import ANSWERS, corrections_of, fixed_ids, with_corrections, without_filled
from mcaptrack.sources.pictures import picture_size
from mcaptrack.transforms import FULL, STAGES, Sample, Stage
from mcaptrack.transforms.motion_limits import ClassNames, unknown_limits
from mcaptrack.transforms.protocol import traits_of
from mcaptrack.transforms.stages import StepAfter, StepBefore
from mcaptrack.transforms.to_video_rate import linked_tracks, to_video_rate

#: Why pictures of a video are left out.
LATE_BEGINNING: Final = "a video has to begin with a key picture that has its parameter sets"
#: The memory that a run needs, in bytes: whatever its length, and for each second that a person is seen (re-tracking
#: has all samples in memory).
_BASE, _A_PERSON_SECOND = 400_000_000, 3_000
#: Classes that a warning names.
_LISTED: Final = 8


class Input(NamedTuple):
    """The input of a job.

    A stream of frames, all frames if they are rows (else empty), and, after the stream was read, the digest and the
    number of its messages; the names of its classes, the frame of its metres, the numbers of damaged pictures, the
    errors of images that are left out, and how boxes of other software were read.
    """

    stream: Iterable[Frame]
    frames: Sequence[Frame]
    digest: Callable[[], str]
    messages: Callable[[], int]
    classes: Mapping[str, str] = {}
    frame_id: str = ""
    damaged: Sequence[int] = ()
    unreadable: Sequence[McaptrackError] = ()
    boxes: Mapping[str, str] = {}

    def with_frames(self, frames: Sequence[Frame]) -> Input:
        """Return the same input with other rows."""
        return self._replace(stream=frames, frames=frames)

    def warn_lost(self, topic: str, reads: Schema, count_read: int) -> None:
        """Warn of messages that were left out of the ``count_read`` that a transform got, and of damaged ones."""
        messages = self.messages()
        left_out = messages - count_read - len(self.unreadable)
        if reads is VIDEO and 0 < left_out < messages:
            warn(f"{topic}: {left_out} of {messages} messages were left out: {LATE_BEGINNING}", "left-out")
        if self.unreadable:
            warn(
                f"{topic}: {len(self.unreadable)} of {messages} pictures can't be decoded and are left out, the first: "
                f"{self.unreadable[0]}",
                "lost",
            )
        if self.damaged:
            warn(
                f"{topic}: {len(self.damaged)} of {messages} pictures are damaged, number {self.damaged[0]} first; "
                "what can't be decoded there is taken from others, so that detections may be wrong up to the next key "
                "picture",
                "lost",
            )


@dataclass
class Work:
    """A job while it is done: what it reads, its transform, and what it has made.

    ``planes`` are the ground planes of the camera, and ``plane_choice`` how one is made where none is given.
    ``seen`` are the frames of its input with boxes in the pictures that they were seen in, also where the camera moves
    by ``path``. ``references`` are the digests of channels beside the main input, by topic. ``outputs`` are schema and
    frames by topic; ``continued`` says how their ids go on from the log before. ``scores`` say what scores of its input
    were taken for, by class, and ``notices`` are warnings of that and of its input, which its channels keep.
    """

    state: RunState
    job: Job
    source: Input
    planes: Planes | None
    plane_choice: PlaneChoice = AS_BEFORE
    log_before: Before | None = None
    progress: Progress = lambda *_: None
    path: CameraPath | None = None
    is_led: bool = False
    references: dict[str, str] = field(default_factory=dict)
    outputs: dict[str, tuple[Schema, Sequence[Frame]]] = field(default_factory=dict)
    continued: Mapping[str, str] = field(default_factory=dict)
    scores: Mapping[str, str] = field(default_factory=dict)
    notices: list[Notice] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.transform, self.seen, self.own_planes = self.job.transform, self.source.frames, self.planes

    @property
    def stage(self) -> Stage:
        """Its stage."""
        return STAGES[self.job.stage]

    def main(self) -> Sequence[Frame]:
        """Return the frames of the main output."""
        return self.outputs[self.job.target][1]

    def prepare(self) -> None:
        """Do the steps before the transform, and give it what it takes from the log."""
        for step in self.stage.before:
            BEFORE[step](self)
        self.take_context()

    def take_context(self) -> None:
        """Give the transform the values of its fields that follow from the log."""
        taken = {f.name for f in fields(self.transform) if f.metadata.get("context")}
        values: dict[str, Any] = {}
        for name, (topic, schema) in self.stage.also_reads.items():
            values |= self._taken(name, self._channel(f"{self.state.prefix}/{topic}", schema))
        for name, input_of in CONTEXT.items():
            if name in taken:
                values |= self._taken(name, input_of(self))
        self.transform = replace(self.transform, **values)
        opened, prefix, *_ = self.state
        self.transform = with_descriptors(self.transform, opened, prefix, self.seen, self.progress, self.job.keep)

    def finish(self) -> None:
        """Do the steps after the transform."""
        for step in self.stage.after:
            AFTER[step](self)

    def say(self, message: str, code: Code) -> None:
        """Warn of something that its channels keep, so that later runs repeat it."""
        self.notices.append(Notice(message, code))
        warn(message, code)

    def _taken(self, name: str, side: SideInput | None) -> dict[str, Any]:
        if side is None:
            return {}
        self.references |= side.references
        return {name: side.value}

    def _channel(self, topic: str, schema: Schema) -> SideInput | None:
        is_there = self.state.holds(topic, schema)
        return SideInput(self.state.frames(topic, schema), {topic: self.state.digest(topic)}) if is_there else None


# Steps before a transform.


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


def _with_corrections(work: Work) -> None:
    """Take tracks as people have corrected them."""
    state, source = work.state, work.job.source
    topic = corrections_of(state.opened, state.prefix, source)
    if topic is not None:
        frames = with_corrections(work.source.frames, state.opened.frame_columns(topic, TRACKS))
        work.source, work.seen = work.source.with_frames(frames), frames
        work.references[topic] = digest_of(state.opened, topic)


def _with_planes(work: Work) -> None:
    """Take the ground planes of the camera, and make one where none is given and the stage needs it."""
    source = (work.job.source, work.source.digest())
    planes, frame_id = planes_for(work.state, work.job, work.source.frames, source, work.planes, work.plane_choice)
    work.planes = work.own_planes = planes
    work.source = work.source._replace(frame_id=work.source.frame_id or frame_id)


def _in_scene(work: Work) -> None:
    """Move boxes to the reference picture: those of pictures that the camera moved between can't be joined."""
    work.path, motion = path_with(work.state, work.job.source)
    work.references |= motion
    if work.path is not None:
        work.source = work.source.with_frames(to_scene(work.source.frames, work.path))
        work.planes = scene_planes(work.planes or (), work.path)


def _after_log_before(work: Work) -> None:
    """Begin with the last seconds of the log before."""
    before, frames = work.log_before, work.source.frames
    if before is None:
        warn_unfollowed(work.state.opened, work.job)
        return
    lead = before.lead(work.job, frames, work.planes or ()) if work.path is None else ()
    if lead:
        work.is_led = True
        work.source = work.source.with_frames(collect(work.transform.reads, chain(lead, frames)))


def _with_likelihoods(work: Work) -> None:
    """Take scores that are outside of 0 to 1 for likelihoods that detections are real, and leave out unlikely ones."""
    frames, transform = work.source.frames, work.transform
    span = score_range(frames)
    if span is None:
        return
    least = getattr(transform, "min_score", None)
    text = f"{work.job.source}: scores are from {span.low:g} to {span.high:g}"
    if least is not None and not 0 <= least <= 1:
        work.say(f"{text}; `min_score={least:g}` is one of these, so they stay as they are", "scores")
        return
    names = {int(number): name for number, name in work.source.classes.items()}
    score_meaning = score_map(frames, span, tuple(names.items()), getattr(transform, "class_limits", ""))
    curves = {names.get(number) or f"class {number}": curve for number, curve in score_meaning.curves.items()}
    work.scores = {name: str(curve) for name, curve in curves.items()}
    frames, text = score_meaning.mapped(frames), f"{text}: {score_meaning.basis}"
    if score_meaning.is_fitted and least is None:
        count, frames = int(row_ends(frames)[-1]), without_doubtful(frames)
        limits = list_names([f"{name} {curve.least(DOUBTFUL):.3g}" for name, curve in sorted(curves.items())], _LISTED)
        text += f"; {count - int(row_ends(frames)[-1]):,} of {count:,} detections are less likely than {DOUBTFUL:g} "
        text += f"(scores below {limits}) and are left out"
        text += "; `min_score=` sets another limit" if hasattr(transform, "min_score") else ""
    work.source, work.seen = work.source.with_frames(frames), frames
    work.say(text, "scores")


BEFORE: Final[Mapping[StepBefore, Callable[[Work], None]]] = MappingProxyType(
    {
        "memory": lambda work: warn_memory(work.source.frames),
        "planes": _with_planes,
        "scale": _with_planes,
        "corrections": _with_corrections,
        "scene": _in_scene,
        "log-before": _after_log_before,
        "scores": _with_likelihoods,
    }
)


# Inputs beside the main one: fields of transforms by name, None where the log has nothing to give.


def _class_names(work: Work) -> SideInput:
    names = tuple((int(number), name) for number, name in work.source.classes.items())
    _warn_of_limits(str(getattr(work.transform, "class_limits", "")), names)
    return SideInput(names)


def _warn_of_limits(class_limits: str, names: ClassNames) -> None:
    """Warn of limits for classes that don't exist."""
    if unknown := unknown_limits(class_limits, names):
        classes = ", ".join(sorted({name for _, name in names if name})) or "none with a name"
        text = f"`class_limits=` names {', '.join(unknown)}: no such class is in the table of limits or in the boxes"
        warn(f"{text} (classes of these are: {classes})", "option-not-used")


def _clock_start(work: Work) -> SideInput:
    """Take the start of the prediction clock in ns: from the log's metadata, or the time of the first picture."""
    opened = work.state.opened
    if work.is_led and work.log_before and work.log_before.is_bridged:
        return SideInput(work.log_before.lead_ns)
    clock = opened.metadata(CLOCK)
    if clock and (start := parse_ns(clock.get("start_ns", ""))) is not None:
        return SideInput(start)
    pictures = camera_at(opened, work.state.prefix).pictures
    return SideInput(min(opened.times(pictures).tolist(), default=None) if pictures else None)


def _rate_hz(work: Work) -> SideInput | None:
    steps = np.diff(frame_times(work.source.frames))
    if not (steps > 0).any():  # frames may share a time
        return None
    rate_hz = round(NS_PER_S / float(np.median(steps[steps > 0])), 6)
    usual, usual_hz = f"{work.state.prefix}/{work.stage.input_topic}", Sample().rate_hz
    if work.job.source != usual and rate_hz > 2 * usual_hz:
        warn(
            f"{work.job.source} has {rate_hz:g} frames a second, and {work.job.stage} takes steps at that rate; "
            f"{usual} has {usual_hz:g} unless it was made otherwise",
            "clock",
        )
    return SideInput(rate_hz)


def _fixed_ids(work: Work) -> SideInput | None:
    """Take the ids of corrected tracks in the input; none if it was made without corrections."""
    state, how = work.state, work.state.provenance(work.job.source)
    is_corrected = how is not None and takes_corrections(how.transform)
    topic = corrections_of(state.opened, state.prefix, how.input) if how and is_corrected else None
    if how is None or topic is None or topic not in how.references:
        return None
    return SideInput(fixed_ids(state.frames(how.input), state.opened.frame_columns(topic, TRACKS)))


def _answers(work: Work) -> SideInput | None:
    """Take answers about identities, without those about samples that aren't there."""
    topic = f"{work.state.prefix}/{ANSWERS}"
    answers = work._channel(topic, DECISIONS)
    if answers is None:
        return None
    samples, asked = join_frames(TRACKS, work.seen), join_frames(DECISIONS, answers.value)
    at = find_rows((samples.row_ns, samples.rows["track_id"]), (asked.row_ns, asked.rows["source_id"]))
    is_there = at >= 0
    rows = samples.rows[at[is_there]]
    for place, side in (("x_px", "w_px"), ("y_px", "h_px")):  # ids of a tracker that was run again are others
        off = np.abs(rows[place] + rows[side] / 2 - asked.rows[place][is_there])
        is_there[is_there] &= ~(off > rows[side])
        rows = samples.rows[at[is_there]]
    if not is_there.all():
        lost = np.count_nonzero(~is_there)
        text = f"{lost} of {len(at)} answers in {topic} are about tracks that {work.job.source} doesn't have any more"
        work.say(f"{text}, and are left out", "left-out")
    kept = iter(is_there.tolist())
    frames = [frame._replace(rows=frame.rows[[next(kept) for _ in frame.rows]]) for frame in answers.value]
    return answers._replace(value=[frame for frame in frames if len(frame.rows)])


def _sampled_tracks(work: Work) -> tuple[Sequence[Frame], Sequence[Frame] | None]:
    """The tracks of which the input has samples, in the reference picture, and corrections of them, if any."""
    state = work.state
    samples = state.provenance(work.job.source)
    source = samples.input if samples else ""
    tracks = state.frames(source)
    topic = corrections_of(state.opened, state.prefix, source)
    corrections = state.opened.frame_columns(topic, TRACKS) if topic is not None else None
    if len(tracks) and corrections is not None:
        tracks = with_corrections(tracks, corrections)
    return to_scene(tracks, work.path), corrections


def _boxes(work: Work) -> SideInput | None:
    """Take the tracks of which the input has samples, where these are poor; their digests are those of the samples."""
    if not (is_assumed(work.planes) and is_poor(work.source.frames)) or work.is_led:
        return None
    tracks = collect(TRACKS, _sampled_tracks(work)[0])
    return SideInput(tracks) if len(tracks) else None


CONTEXT: Final[Mapping[str, Callable[[Work], SideInput | None]]] = MappingProxyType(
    {
        "camera_path": lambda work: motion_input(work.state, work.transform),
        "known_boxes": lambda work: boxes_input(work.state, work.transform),
        "ground_planes": lambda work: SideInput(tuple(work.planes or ())),
        "class_names": _class_names,
        "start_ns": _clock_start,
        "rate_hz": _rate_hz,
        "poor_scale": lambda work: SideInput(is_poor(work.source.frames)) if is_assumed(work.planes) else None,
        "fixed_ids": _fixed_ids,
        "answers": _answers,
        "boxes": _boxes,
    }
)


# Steps after a transform.


def settle_classes(frames: Sequence[Frame]) -> Sequence[Frame]:
    """Give each track one class, that of most of its rows; of several, the one that it had first.

    Warns of the tracks that have rows of several classes. Frames are unchanged if there are none.
    """
    columns = [joined.rows[["track_id", "class_id"]].copy() for _, _, joined in joined_parts(TRACKS, frames)]
    if not columns:
        return frames
    rows = np.concatenate(columns)
    ids, track = np.unique(rows["track_id"], return_inverse=True)
    class_id = majority(track, rows["class_id"], len(ids))
    changed = np.unique(track[rows["class_id"] != class_id[track]])
    if not len(changed):
        return frames

    def settled(joined: JoinedFrames) -> Rows:
        joined.rows["class_id"] = class_id[np.searchsorted(ids, joined.rows["track_id"])]
        return joined.rows

    warn(
        f"{len(changed)} of {len(ids)} tracks have detections of several classes; each has the class of most of its "
        "detections",
        "classes",
    )
    return mapped_rows(TRACKS, frames, settled)


def _with_one_class(work: Work) -> None:
    """Give each track of detections one class."""
    schema, frames = work.outputs[work.job.target]
    if schema is TRACKS:
        work.outputs[work.job.target] = schema, settle_classes(frames)


def _without_lead(work: Work) -> None:
    """Leave out the seconds of the log before, and go on with its ids."""
    if work.log_before is None:
        return
    frames, work.continued = work.log_before.own(work.job, [frames for _, frames in work.outputs.values()])
    for topic, own in zip([*work.outputs], frames, strict=True):
        work.outputs[topic] = work.outputs[topic][0], own


def _at_video_rate(work: Work) -> None:
    """Add the tracks at the rate of those that were sampled, if there are any."""
    job = work.job
    if job.target + FULL not in job.kept():
        return
    tracks, corrections = _sampled_tracks(work)
    if traits_of(work.transform).leaves_unchanged:
        carried: Sequence[Frame] = linked_tracks(
            tracks, work.main(), work.planes or (), getattr(work.transform, "filled_s", 0.0)
        )
    else:
        carried = to_video_rate(tracks, work.main(), work.planes or ())
    if corrections is not None:
        carried = without_filled(carried, corrections)
    if carried:
        work.outputs[job.target + FULL] = TRACKS, carried


def _on_pictures(work: Work) -> None:
    """Move boxes of tracks back to the pictures that they were seen in."""
    for topic, (schema, frames) in work.outputs.items():
        if schema is TRACKS:
            work.outputs[topic] = schema, to_pictures(frames, work.path)


def _without_unseen(work: Work) -> None:
    """Leave out rows outside of the picture without a detection."""
    opened, prefix, *_ = work.state
    if not traits_of(work.transform).keeps_unseen:
        work.outputs |= without_unseen(work.outputs, lambda: picture_size(opened, camera_at(opened, prefix).pictures))


AFTER: Final[Mapping[StepAfter, Callable[[Work], None]]] = MappingProxyType(
    {
        "one-class": _with_one_class,
        "log-before": _without_lead,
        "video-rate": _at_video_rate,
        "pictures": _on_pictures,
        "seen": _without_unseen,
    }
)
