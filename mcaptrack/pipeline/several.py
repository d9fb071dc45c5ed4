"""Run all cameras of a log, one after the other, then the scenes that they are fused to."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from mcaptrack import log as logs
from mcaptrack import notices, pipeline
from mcaptrack.errors import McaptrackError
from mcaptrack.files import publish
from mcaptrack.location import Location
from mcaptrack.notices import warn
from mcaptrack.pipeline.runner import Report
from mcaptrack.pipeline.scenes import Scenes
from mcaptrack.pipeline.write import Made, RunState, write
from mcaptrack.schema import DETECTIONS, TRACKS
from mcaptrack.sources.fixed_frame import BoxesRead
from mcaptrack.sources.sidecar import SidecarChoice
from mcaptrack.transforms import STAGES, Transform
from mcaptrack.transforms.protocol import traits_of

if TYPE_CHECKING:
    from mcaptrack.pipeline.summary import Summary

#: Called with the name of a stage, the amount that is done, and the total.
Progress = Callable[[str, int, int], None]
#: Takes a note.
Say = Callable[[str], None]
#: Changes an open log, or a copy of it at the path; returns the prefix of the camera, and what was done.
Act = Callable[[logs.Log, Path | None, Say, BoxesRead], tuple[str, Report]]


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

    ``run_at`` returns what runs a camera, by its prefix, and ``joins`` makes scenes of several. ``left_out`` and
    ``not_fused`` are the reasons why cameras are left out, by name, and why no scene is made.
    """

    names: Sequence[str]
    joins: Scenes
    run_at: Callable[[str, Progress], Act]
    left_out: dict[str, str] = field(default_factory=dict)
    not_fused: str = ""
    prefixes: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ()

    def chooses(self, opened: logs.Log, say: Say) -> bool:
        """Return whether the log has several cameras, or several are named; note which are run."""
        chosen = pipeline.choose_cameras(opened, self.names)
        if chosen is None:
            return False
        self.prefixes, self.scenes = chosen.prefixes, chosen.scenes
        self.left_out |= chosen.left_out
        for name, why in self.left_out.items():
            code: notices.Code = "no-pictures" if why.startswith(pipeline.UNREAD) else "left-out"
            warn(f"the camera {name} is left out: it {why}", code)
        if len(self.prefixes) > 1:
            listed = ", ".join(prefix[1:] for prefix in self.prefixes)
            say(f"running {len(self.prefixes)} cameras, {listed}; `camera=` names those to run")
        for prefix in self.prefixes:
            if reason := pipeline.begins_with(opened, prefix):
                say(reason)
        return True

    def run(
        self, path: Location, output: Path | None, sidecar: SidecarChoice, say: Say, progress: Progress
    ) -> list[Done]:
        """Run each camera, then scenes. The log is written for each of them; ``output`` is written as a whole."""
        with publish(output) if output is not None else nullcontext() as part:
            steps = _Steps(path, part, output, sidecar, say, progress)
            for prefix in self.prefixes:
                steps.take(prefix[1:], self.run_at(prefix, _named(progress, prefix[1:])))
            if steps.failed:
                self.not_fused = f"{', '.join(steps.failed)} failed"
            else:
                self._run_scenes(steps)
        return steps.done

    def _run_scenes(self, steps: _Steps) -> None:
        """Make the scenes again that are out of date, or a new one, and run them."""
        with steps.opened() as opened:
            off = self.joins.off
            scenes = self.scenes or (() if off else pipeline.scenes_of(opened))
            joined: list[str] = []
            if not off and not scenes:
                joined, why = self.joins.joinable(opened, [prefix[1:] for prefix in self.prefixes])
                self.not_fused = "" if joined else why
                if joined and why:
                    steps.say(f"not in the scene: {why}")
        if joined:
            scenes, name = (pipeline.SCENE,), pipeline.SCENE[1:]
            if not steps.take(name, self._join(joined, _named(steps.progress, name)), is_scene=True):
                self.not_fused = steps.done.pop().failure
                scenes = ()
        if off and not self.scenes:
            self.not_fused = off
        elif self.not_fused:
            steps.say(f"no scene is made of the cameras: {self.not_fused}")
        for scene in scenes:
            steps.take(scene[1:], self.run_at(scene, _named(steps.progress, scene[1:])), is_scene=True)

    def _join(self, names: Sequence[str], progress: Progress) -> Act:
        def act(opened: logs.Log, output: Path | None, say: Say, _: BoxesRead) -> tuple[str, Report]:
            say(f"fusing {', '.join(names)} to {pipeline.SCENE}")
            return write_scene(opened, pipeline.SCENE, partial(self.joins.join, opened, names), progress, output)

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


def _named(progress: Progress, name: str) -> Progress:
    """Return a function that reports the progress of the stages of a camera."""
    return lambda stage, done, total: progress(f"{name} {stage}", done, total)


@dataclass
class _Steps:
    """The work on a log, step by step: first from ``path``, to ``part`` if it is given."""

    path: Location
    part: Path | None
    output: Path | None
    sidecar: SidecarChoice
    say: Say
    progress: Progress
    done: list[Done] = field(default_factory=list)

    @property
    def failed(self) -> list[str]:
        """The names of the cameras that failed."""
        return [camera.name for camera in self.done if camera.failure]

    def opened(self) -> logs.Log:
        """The log as it is now."""
        if self.part is not None:
            return logs.read(self.part if self.part.exists() else self.path)
        return logs.read(self.path, sidecar=self.sidecar)

    def take(self, name: str, act: Act, is_scene: bool = False) -> bool:
        """Do one step; returns whether it succeeded."""
        output = self.part if self.part is not None and not self.part.exists() else None
        with notices.naming(name), self.opened() as opened:
            if self.part is None:
                opened.lock()
            try:
                prefix, report = act(opened, output, self.say, BoxesRead())
            except McaptrackError as error:
                why = str(error).replace(str(self.part), str(self.output))
                self.done = [step for step in self.done if step.name != name]
                self.done.append(Done(name, f"/{name}", Report(), is_scene, why))
                return False
        before = next((step for step in self.done if step.name == name), None)
        if before is None:
            self.done.append(Done(name, prefix, report, is_scene))
        else:
            before.report = together([before.report, report])
        return True


def unfitting(
    opened: logs.Log, prefix: str, transforms: Mapping[str, Transform], say: Callable[[str], None]
) -> set[str]:
    """Return the stages with a transform that can't take the boxes of this camera or scene.

    A tracker that is named is for the cameras, or for the scene: of boxes in pictures, or of positions in metres.
    """
    space = "ground" if pipeline.camera_at(opened, prefix).in_space else "picture"
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
