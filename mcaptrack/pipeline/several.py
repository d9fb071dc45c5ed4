"""Run several cameras of a log: which, one after the other, then the scenes that they are fused to."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from mcaptrack import log as logs
from mcaptrack import notices, pipeline
from mcaptrack.errors import McaptrackError, list_names
from mcaptrack.location import Location
from mcaptrack.notices import Progress, Say, warn
from mcaptrack.pipeline.checks import cameras_named
from mcaptrack.pipeline.runner import Report
from mcaptrack.pipeline.scenes import Scenes
from mcaptrack.pipeline.write import Made, RunState, write
from mcaptrack.schema import DETECTIONS, TRACKS
from mcaptrack.sources import foreign
from mcaptrack.sources.cameras import (
    Camera,
    camera_at,
    cameras,
    detections_topic,
    has_own_channels,
    provenance_of,
    scenes_of,
)
from mcaptrack.sources.fixed_frame import BoxesRead
from mcaptrack.sources.pictures import size_of_pictures
from mcaptrack.sources.sidecar import SidecarChoice
from mcaptrack.transforms import STAGES, Transform
from mcaptrack.transforms.protocol import traits_of

if TYPE_CHECKING:
    from mcaptrack.pipeline.summary import Summary

#: The scene that a run fuses cameras to.
_SCENE: Final = "/world"
#: How the reason begins why a camera with pictures of no use is left out.
_UNREAD: Final = "has pictures that can't be read"
#: The channels that a run can begin with, if a camera has no pictures and no boxes of others.
_BEGINNINGS: Final = tuple(STAGES[name].input_topic for name in ("track", "sample", "predict"))
#: Changes an open log, or a copy of it at the path; returns the prefix of the camera, and what was done.
Act = Callable[[logs.Log, Path | None, Say, BoxesRead], tuple[str, Report]]


class ChosenCameras(NamedTuple):
    """The cameras of a run, by prefix; the reasons why others are left out, by name; and the scenes that are named."""

    prefixes: tuple[str, ...]
    left_out: Mapping[str, str]
    scenes: tuple[str, ...] = ()


def choose_cameras(opened: logs.Log, names: Sequence[str] = ()) -> ChosenCameras | None:
    """Choose the cameras of a run: those with these names, or all that have pictures or boxes.

    None if the log has one camera only, or sensors of boxes in space alone: then there is no choice. Raises
    McaptrackError if no camera has anything to begin with, and for names that the log doesn't have, or that can't be
    run.
    """
    named, scenes = cameras_named(opened, names, cameras(opened)), scenes_of(opened)
    wanted = [camera for camera in named if camera.prefix not in scenes] if names else _usual(opened, scenes)
    if not names and not wanted:
        return None
    wanted_scenes = tuple(camera.prefix for camera in named if camera.prefix in scenes)
    chosen, lacks = split_by_lack(wanted, partial(_lack, opened) if names else partial(_unfit, opened))
    if not chosen and not wanted_scenes:
        why = "; ".join(f"{name} {reason}" for name, reason in lacks.items())
        raise McaptrackError(f"{opened.path} has no camera to begin with: {why}")
    for name, reason in lacks.items() if names else ():
        raise McaptrackError(f"{opened.path}: {name} {reason}; leave it out of `camera=`")
    return ChosenCameras(tuple(camera.prefix for camera in chosen), lacks, wanted_scenes)


def split_by_lack(wanted: Sequence[Camera], lack: Callable[[Camera], str]) -> tuple[list[Camera], dict[str, str]]:
    """Return the cameras that lack nothing, and what the others lack, by name."""
    lacks = {camera.prefix[1:]: why for camera in wanted if (why := lack(camera))}
    return [camera for camera in wanted if camera.prefix[1:] not in lacks], lacks


def _usual(opened: logs.Log, scenes: Sequence[str]) -> list[Camera]:
    """Return the cameras of a run that names none, but none if there is no choice between several with pictures.

    Those that are only boxes in space are left out.
    """
    usual = [camera for camera in cameras(opened) if camera.prefix not in scenes]
    usual = [camera for camera in usual if not _is_truth_of_scene(opened, camera)]
    usual = [camera for camera in usual if not camera.in_space or has_own_channels(opened, camera)]
    return usual if len(usual) + len(scenes) > 1 and not all(camera.in_space for camera in usual) else []


def _is_truth_of_scene(opened: logs.Log, camera: Camera) -> bool:
    """Whether these are the labels of a scene that isn't made yet."""
    return camera.prefix == _SCENE and camera.pictures is None and camera.boxes is None and _is_bare(opened, camera)


def _is_bare(opened: logs.Log, camera: Camera) -> bool:
    return not any(f"{camera.prefix}/{name}" in opened.channels for name in _BEGINNINGS)


def _lack(opened: logs.Log, camera: Camera) -> str:
    """The reason why nothing can be made of a camera; "" if there is none."""
    if camera.boxes or not _is_bare(opened, camera):
        return ""
    if camera.pictures is None:
        with_pictures = sorted(topic for topic in camera.topics if foreign.holds_pictures(opened.channels[topic]))
        if with_pictures:
            return f"has pictures in {list_names(with_pictures)}; `topic=` runs it on one of them"
        has = sorted(topic for topic in camera.topics if "/view/" not in topic)
        return f"has neither pictures nor boxes, but {list_names(has, 5)}"
    if not opened.channels[camera.pictures].messages:
        return f"has no pictures: {camera.pictures} has no messages"
    if depth := foreign.depth_of(opened, camera.pictures):
        return f"has depths in {camera.pictures} ({depth}), in which people are not detected; `topic=` runs it"
    try:
        if size_of_pictures(opened, camera.pictures) is None:
            why = foreign.facts_of(opened, camera.pictures).recogniser.cause
            return f"{_UNREAD}: none in {camera.pictures} can be decoded{f', because {why}' if why else ''}"
    except McaptrackError as error:
        return f"{_UNREAD}: {error}"
    return ""


def _unfit(opened: logs.Log, camera: Camera) -> str:
    """The reason why a camera that no option names isn't run; "" if there is none."""
    if lack := _lack(opened, camera):
        return lack
    topic = camera.pictures
    if topic is None or has_own_channels(opened, camera):
        return ""
    better = foreign.better_form(opened, topic)
    return f"has the pictures of {better} a second time, in {topic}; `camera=` runs it" if better else ""


def _begins_with(opened: logs.Log, prefix: str) -> str:
    """Describe the input of the run of one of several cameras; "" for the usual one, pictures alone."""
    camera, detections = camera_at(opened, prefix), detections_topic(prefix)
    provenance = provenance_of(opened, detections)
    if detections in opened.channels and (provenance is None or provenance.transform not in STAGES):
        return f"{prefix[1:]} has detections in {detections} already: it is tracked from these, nothing is detected"
    if camera.pictures is None and camera.boxes:
        return f"{prefix[1:]} has no pictures: it is tracked from the boxes in {camera.boxes}"
    if camera.pictures is None:
        return f"{prefix[1:]} has neither pictures nor boxes, but tracks or samples: it is run from these"
    return ""


@dataclass
class Done:
    """The report on a camera, or a scene of several; ``failure``, the reason why it failed, is "" if it didn't."""

    name: str
    prefix: str
    report: Report
    is_scene: bool = False
    failure: str = ""


@dataclass(frozen=True)
class CameraResult:
    """The result for one of several cameras of a log, or for the scene that they are fused to.

    Attributes
    ----------
    stages : tuple of str
        The stages that ran, in order; empty if everything was up to date.
    frames, rows, tracks : dict of str to int
        Number of frames, rows and track ids by topic, of the channels that were made.
    summary : mcaptrack.pipeline.Summary
        What the log holds of it now, in numbers.
    is_scene : bool
        Whether it is a scene.

    """

    stages: tuple[str, ...]
    frames: Mapping[str, int]
    rows: Mapping[str, int]
    tracks: Mapping[str, int]
    summary: Summary
    is_scene: bool

    @classmethod
    def of(cls, done: Done, summary: Summary) -> CameraResult:
        """Return the result of what was done."""
        report = done.report
        return cls(tuple(report.stages), report.frames, report.rows, report.tracks, summary, done.is_scene)


@dataclass
class EveryCamera:
    """Runs all cameras of a log that has several, or those of these names.

    ``run_at`` returns what runs a camera, by its prefix, and ``joins`` makes scenes of several. ``not_fused`` is the
    reason why no scene is made.
    """

    names: Sequence[str]
    joins: Scenes
    run_at: Callable[[str, Progress], Act]
    not_fused: str = ""

    def choose(self, opened: logs.Log, say: Say) -> ChosenCameras | None:
        """Return the cameras to run, and note which these are; None if there is no choice."""
        chosen = choose_cameras(opened, self.names)
        if chosen is None:
            return None
        for name, why in chosen.left_out.items():
            code: notices.Code = "no-pictures" if why.startswith(_UNREAD) else "left-out"
            warn(f"the camera {name} is left out: it {why}", code)
        if len(chosen.prefixes) > 1:
            listed = ", ".join(prefix[1:] for prefix in chosen.prefixes)
            say(f"running {len(chosen.prefixes)} cameras, {listed}; `camera=` names those to run")
        for reason in filter(None, (_begins_with(opened, prefix) for prefix in chosen.prefixes)):
            say(reason)
        return chosen

    def run(self, chosen: ChosenCameras, steps: Steps) -> list[Done]:
        """Run each camera, then scenes."""
        for prefix in chosen.prefixes:
            steps.take(prefix, partial(self.run_at, prefix))
        if failed := [camera.name for camera in steps.done if camera.failure]:
            self.not_fused = f"{', '.join(failed)} failed"
        else:
            self._run_scenes(chosen, steps)
        return steps.done

    def _run_scenes(self, chosen: ChosenCameras, steps: Steps) -> None:
        """Make the scenes again that are out of date, or a new one, and run them."""
        with steps.opened() as opened:
            off = self.joins.off
            scenes = chosen.scenes or (() if off else scenes_of(opened))
            joined: list[str] = []
            if not off and not scenes:
                joined, why = self.joins.joinable(opened, [prefix[1:] for prefix in chosen.prefixes])
                self.not_fused = "" if joined else why
                if joined and why:
                    steps.say(f"not in the scene: {why}")
        if joined:
            scenes = (_SCENE,)
            if not steps.take(_SCENE, partial(self._join, joined), is_scene=True):
                self.not_fused = steps.done.pop().failure
                scenes = ()
        if off and not chosen.scenes:
            self.not_fused = off
        elif self.not_fused:
            steps.say(f"no scene is made of the cameras: {self.not_fused}")
        for scene in scenes:
            steps.take(scene, partial(self.run_at, scene), is_scene=True)

    def _join(self, names: Sequence[str], progress: Progress) -> Act:
        def act(opened: logs.Log, output: Path | None, say: Say, _: BoxesRead) -> tuple[str, Report]:
            say(f"fusing {', '.join(names)} to {_SCENE}")
            return write_scene(opened, _SCENE, partial(self.joins.join, opened, names), progress, output)

        return act


def write_scene(
    opened: logs.Log,
    prefix: str,
    join: Callable[[str, Progress], Mapping[str, Made]],
    progress: Progress,
    output: Path | None = None,
    views: bool = False,
) -> tuple[str, Report]:
    """Write the channels of a scene, which ``join`` makes by its prefix; with ``views`` they are drawn for viewers.

    Returns the prefix and the report. ``output`` is the copy to write instead, if any.
    """
    with notices.collected() as warnings:
        channels = dict(join(prefix, progress))
    state, drawn = RunState(opened, prefix, channels), None
    if views:
        from mcaptrack.pipeline.views import make_views

        drawn = make_views(state, ())
    write(state, output, drawn)
    report = Report.begun_with(channels)
    report.is_written, report.warnings = True, list(warnings)
    report.stale = pipeline.outdated_by(opened, {topic: made.provenance.digest for topic, made in channels.items()})
    return prefix, report


@dataclass
class Steps:
    """The work on a log, step by step: on ``path``, or, if a copy is written, first from it, then on ``part``.

    ``output`` is what the part becomes.
    """

    path: Location
    part: Path | None
    output: Path | None
    sidecar: SidecarChoice
    say: Say
    progress: Progress
    done: list[Done] = field(default_factory=list)

    def opened(self) -> logs.Log:
        """The log as it is now."""
        if self.part is not None:
            return logs.read(self.part if self.part.exists() else self.path)
        return logs.read(self.path, sidecar=self.sidecar)

    def take(self, prefix: str, begin: Callable[[Progress], Act], is_scene: bool = False) -> bool:
        """Do one step of a camera or scene; returns whether it succeeded. Progress of its stages has its name."""
        name, output = prefix[1:], self.part if self.part is not None and not self.part.exists() else None
        act = begin(lambda stage, done, total: self.progress(f"{name} {stage}", done, total))
        with notices.naming(name), self.opened() as opened:
            if self.part is None:
                opened.lock()
            try:
                prefix, report = act(opened, output, self.say, BoxesRead())
            except McaptrackError as error:
                why = str(error).replace(str(self.part), str(self.output))
                self.done = [step for step in self.done if step.name != name]
                self.done.append(Done(name, prefix, Report(), is_scene, why))
                return False
        before = next((step for step in self.done if step.name == name), None)
        if before is None:
            self.done.append(Done(name, prefix, report, is_scene))
        else:
            before.report = together([before.report, report])
        return True


def unfitting(opened: logs.Log, prefix: str, transforms: Mapping[str, Transform], say: Say) -> set[str]:
    """Return the stages with a transform that can't take the boxes of this camera or scene.

    A tracker that is named is for the cameras, or for the scene: of boxes in pictures, or of positions in metres.
    """
    space = "ground" if camera_at(opened, prefix).in_space else "picture"
    stages = set()
    for stage, transform in transforms.items():
        if transform.reads is DETECTIONS and transform.writes[""] is TRACKS and traits_of(transform).space != space:
            say(f"{prefix[1:]} is not tracked by {STAGES[stage].choice(transform)}, which is for other boxes")
            stages.add(stage)
    return stages


def together(reports: Sequence[Report]) -> Report:
    """Return the reports on several cameras as one."""
    out = Report()
    for report in reports:
        out.stages += report.stages
        out.frames |= report.frames
        out.rows |= report.rows
        out.tracks |= report.tracks
        out.events |= report.events
        out.is_written |= report.is_written
        out.stale = [*dict.fromkeys([*out.stale, *report.stale])]
        out.warnings += report.warnings
        for name, seconds in report.watch.seconds.items():
            out.watch.seconds[name] = out.watch.seconds.get(name, 0.0) + seconds
    return out


def refuse_failed(log: Location, done: Sequence[Done]) -> None:
    """Raise McaptrackError if any camera failed, with its reason."""
    failed = [camera for camera in done if camera.failure]
    if failed:
        why = "; ".join(f"{camera.name}: {camera.failure}" for camera in failed)
        good = ", ".join(camera.name for camera in done if not camera.failure)
        rest = f". What was made of {good} is written; `camera=` names cameras to run" if good else ""
        raise McaptrackError(f"{log}: {len(failed)} of {len(done)} cameras failed: {why}{rest}")
