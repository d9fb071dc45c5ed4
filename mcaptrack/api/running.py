"""Run stages on one log, and write their results into it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mcaptrack import log as logs
from mcaptrack import notices, pipeline
from mcaptrack.api.common import Notes, as_location, log_output, warnings_about
from mcaptrack.api.declared import checked
from mcaptrack.api.options import PathLike, Progress, Value, no_progress
from mcaptrack.choices import Mode
from mcaptrack.errors import McaptrackError, call
from mcaptrack.files import publish, publish_bytes, refuse_overwrite, sweep
from mcaptrack.installed import missing_extension
from mcaptrack.location import Location
from mcaptrack.notices import Notice, Say, warn
from mcaptrack.pipeline import AS_BEFORE, Job, PlaneChoice
from mcaptrack.pipeline.several import (
    Act,
    CameraResult,
    ChosenCameras,
    Done,
    EveryCamera,
    Steps,
    refuse_failed,
    together,
)
from mcaptrack.registry import others
from mcaptrack.sources.fixed_frame import BoxesRead
from mcaptrack.sources.foreign.boxes import choosing
from mcaptrack.sources.foreign.definitions import definitions_of
from mcaptrack.sources.sidecar import SidecarChoice
from mcaptrack.transforms import STAGES, Stage, Transform
from mcaptrack.transforms.stages import refuse_unknown

if TYPE_CHECKING:
    from mcaptrack import _OfFinishers
    from mcaptrack.contracts import Finished
    from mcaptrack.pipeline import Summary
    from mcaptrack.pipeline.runner import Finish
    from mcaptrack.pipeline.scenes import Scenes
    from mcaptrack.pipeline.write import Made
else:
    _OfFinishers = object


# The files beside a log (layouts, tables), all of them made from the content of the log.
#
# A log is written as a whole, with its views and its layouts; what stands beside it is written afterwards, so a run
# that is killed may leave the log without. ``write_products`` is what every command calls after it has written, or
# found nothing to write: it makes what is missing or older than the log, and removes what killed runs have left.


@dataclass
class Products:
    """The files beside a log: all that are owed; the layouts and tables among them that were written now, by name of
    the table; and the numbers of rows of all tables.
    """

    owed: list[Path] = field(default_factory=list)
    layouts: list[Path] = field(default_factory=list)
    tables: list[str] = field(default_factory=list)
    rows: dict[str, int] = field(default_factory=dict)


def refuse_foreign_products(opened: logs.Log, target: Location) -> None:
    """Raise McaptrackError if the tables of the log at ``target``, made from ``opened``, would replace another's."""
    from mcaptrack.tables.export import default_folder, refuse_tables_of_another

    if isinstance(target, Path):
        refuse_tables_of_another(opened, target, default_folder(target))


def write_products(
    log: Location,
    *,
    is_new: bool,
    tables: bool = False,
    force: bool = False,
    progress: Progress,
    boxes: BoxesRead | None = None,
) -> Products:
    """Bring all files beside a log up to date; ``is_new`` says whether this process has just written the log.

    None are beside an object: the log itself holds its layouts.
    """
    done = Products()
    if not isinstance(log, Path):
        return done
    with logs.read(log) as opened:
        if opened.results is None:
            logs.update_listing(log)
        for path, content in _layouts(opened, log):
            done.owed.append(path)
            sweep(path.parent, path.name)
            if is_new or not _stands(path, content, opened):
                publish_bytes(path, content)
                done.layouts.append(path)
        if tables:
            from mcaptrack.tables.export import default_folder, export, main_file

            exported = export(opened, default_folder(log), progress, force=force, boxes=boxes)
            done.owed.append(main_file(log, default_folder(log)))
            done.rows, done.tables = exported.rows, exported.written
            for note in exported.notes:
                warn(note, "left-out")
    return done


def _layouts(opened: logs.Log, log: Path) -> Iterator[tuple[Path, bytes]]:
    """Yield the layouts that a log holds, each with its path beside the log."""
    for name in pipeline.LAYOUTS:
        content = opened.attachment(pipeline.attachment_of(name))
        if content is not None:
            yield pipeline.layout_path(log, name), content


def _stands(path: Path, content: bytes, opened: logs.Log) -> bool:
    """Return whether a layout is that of the log, or one that a user has edited since the log was written."""
    try:
        changed_ns = path.stat().st_mtime_ns
        written_ns = Path(opened.parts[-1].path).stat().st_mtime_ns
        return path.read_bytes() == content or changed_ns > written_ns
    except OSError:
        return False


@dataclass(frozen=True)
class RunResult(_OfFinishers):
    """The result of running stages on a log.

    Attributes
    ----------
    log : pathlib.Path or str
        The log that holds the results; the URL of one in a store.
    stages : tuple of str
        The stages that ran, in order; empty if everything was up to date.
    frames, rows, tracks : dict of str to int
        Number of frames, rows and track ids by topic, of the channels that were made.
    events : dict of str to dict of str to int
        Number of events of each kind by the topic of the tracks.
    finished : dict of str to Finished
        What finishers say of the log, by their names; ``RESULT.NAME`` is the value of one, {} without it.
    stale : tuple of str
        Topics that are out of date now, because what they were made from was replaced.
    layouts : tuple of pathlib.Path
        Layout files for Foxglove and Lichtblick that were written.
    tables : dict of str to int
        Number of rows of each table that was written; only ``run`` writes tables.
    summary : mcaptrack.pipeline.Summary or None
        What the log holds now, in numbers; only ``run`` counts it. That of the scene if several cameras were run and
        fused, None if they were not fused.
    written_to : pathlib.Path, str or None
        The file that holds the new channels: the log, or LOG.results.mcap beside it; None if nothing was written.
    written_because : str
        Why the results went there, where that needs a reason.
    warnings : tuple of mcaptrack.Notice
        What was assumed, left out or looks odd.
    notes : tuple of str
        Routine notes, such as which stages ran because their channels were missing.
    seconds : float
        How long it took.
    seconds_by_part : dict of str to float
        How long each stage took, and "read", "decode" (waiting for pictures, which are decoded while others are worked
        on), "write", "tables" and "summary".
    cameras : dict of str to CameraResult
        What was made for each camera, and for the scene, by name; only of runs of several cameras.
    left_out : dict of str to str
        The cameras that were left out, each with the reason.
    not_fused : str
        Why the cameras were not fused to a scene; "" if they were, and for one camera.
    continued : mcaptrack.pipeline.Continued or None
        How ids go on from those of the log before, if one was named.
    files : tuple of pathlib.Path
        All files beside the log that the run owes, written now or before: layouts, and the last of the tables.
    written_tables : tuple of str
        The tables that were written; the others were up to date.

    """

    log: Location
    stages: tuple[str, ...]
    frames: Mapping[str, int]
    rows: Mapping[str, int]
    tracks: Mapping[str, int]
    events: Mapping[str, Mapping[str, int]]
    finished: Mapping[str, Finished]
    stale: tuple[str, ...]
    layouts: tuple[Path, ...]
    tables: Mapping[str, int]
    summary: Summary | None
    written_to: Location | None
    written_because: str
    warnings: tuple[Notice, ...]
    notes: tuple[str, ...]
    seconds: float
    seconds_by_part: Mapping[str, float]
    cameras: Mapping[str, CameraResult] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    not_fused: str = ""
    continued: pipeline.Continued | None = None
    files: tuple[Path, ...] = ()
    written_tables: tuple[str, ...] = ()

    def __repr__(self) -> str:
        did, summary = ", ".join(self.stages) or "up to date", self.summary
        counts = "" if summary is None or summary.tracks is None else f"; {summary.tracks} tracks"
        counts += f", {summary.repair.tracks} after re-tracking" if counts and summary and summary.repair else ""
        return f"RunResult({str(self.log)!r}: {did}{counts}; {self.seconds:.1f} s, {len(self.warnings)} warnings)"

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> object:
            """Return what a finisher says; nothing if it was not asked."""
            if not name.startswith("_") and name in others("finisher"):
                report = self.finished.get(name)
                return report.value if report else {}
            text = missing_extension(name) or f"{type(self).__name__!r} object has no attribute {name!r}"
            raise AttributeError(text)

    @property
    def channels(self) -> tuple[str, ...]:
        """The topics of the channels that were made."""
        return tuple(self.frames)

    @property
    def is_up_to_date(self) -> bool:
        """Whether there was nothing to do."""
        return not (self.stages or self.layouts or self.written_tables)


#: Keys of the JSON of a run, beside names of ``RunResult`` and of finishers.
OF_JSON: Final = ("next", "written_there_because")
#: Plans the jobs for a log; takes the open log, the prefix of its camera, a function that takes notes, and the topics
#: that were made again already, and those that are to be made again.
Plan = Callable[[logs.Log, str, Say, Collection[str], Collection[str]], list[Job]]


@dataclass(frozen=True)
class Where:
    """The log and camera to run on, and the place for results."""

    log: PathLike
    camera: str | None
    topic: str | None
    output: PathLike | None
    sidecar: bool | None
    force: bool

    def places(self) -> tuple[Location, Path | None]:
        """Return the log, and the copy to write instead, if any. Raises McaptrackError for places that don't fit."""
        path = as_location(self.log)
        output = None if self.output is None else log_output(self.output, path)
        if output is None:
            return path, None
        if self.sidecar is not None:
            raise McaptrackError(
                f"`sidecar={self.sidecar}` and `output=` are two places for the same results; give one"
            )
        refuse_overwrite(output, self.force)
        return path, output


def work(
    where: Where,
    plan: Plan,
    progress: Progress,
    tables: bool | None = None,
    *,
    finishing: Sequence[Finish] = (),
    views: bool = False,
    plane: PlaneChoice = AS_BEFORE,
    cameras: tuple[str, ...] = (),
    joins: Scenes | None = None,
    follows: Location | None = None,
) -> RunResult:
    """Plan and run on one log. ``tables`` is None where a single stage runs, which neither exports nor summarises.

    ``finishing`` is done at the end, and with ``views`` channels are drawn. With ``joins``, which makes scenes, these
    ``cameras`` are run, by default all, and a scene is made again if it is out of date. Ids go on from those of the log
    that this one ``follows``.
    """
    continued: list[pipeline.Continued] = []
    topics = next((topics for step in finishing if (topics := getattr(step, "topics", ()))), ())

    def run_at(prefix: str, progress: Progress) -> Act:
        """Run a camera; without a prefix the only one."""

        def act(opened: logs.Log, output: Path | None, say: Say, boxes: BoxesRead) -> tuple[str, pipeline.Report]:
            at = prefix or pipeline.find_camera(opened, where.camera, where.topic or next(iter(topics), None))
            fused: Mapping[str, Made] = {}
            if joins is not None:
                fused = joins.join_again(opened, at, where.force, not cameras, say, progress)
            run = partial(pipeline.run, opened, at, output=output, progress=progress, plane=plane, boxes=boxes)
            run = partial(run, finishing=finishing, views=views, fused=fused)
            if follows is None:
                return at, run(plan(opened, at, say, fused, ()))
            with logs.read(follows) as earlier:
                if prefix and (why := pipeline.begins_here(earlier, opened, at)):
                    warn(why, "left-out")
                    return at, run(plan(opened, at, say, fused, ()))
                before = pipeline.Before(earlier, opened, at)
                report = run(plan(opened, at, say, fused, before.renewed(opened)), before=before)
            continued.append(before.result)
            for line in before.result.words():
                say(line)
            return at, report

        return act

    each = None
    if joins is not None and where.topic is None and where.camera is None:
        each = EveryCamera(cameras, joins, run_at)
    result = change(where, run_at("", progress), progress, tables, each, finishing)
    return replace(result, continued=pipeline.Continued.joined(continued)) if continued else result


def change(
    where: Where,
    act: Act,
    progress: Progress,
    tables: bool | None,
    each: EveryCamera | None = None,
    finishing: Sequence[Finish] = (),
) -> RunResult:
    """Change one log; ``tables`` and ``finishing`` as for ``work``.

    With ``each`` all its cameras are run, if it has several.
    """
    began, work = monotonic(), _Change(where)
    with warnings_about(work.target) as warnings:
        done, chosen = work.act(act, progress, each, bool(tables))
        report = together([camera.report for camera in done])
        _say_stale(work.target, report, is_open=chosen is not None)
        with report.watch.part("tables") if tables else nullcontext():
            products = work.products(report, bool(tables), progress)
        refuse_failed(work.target, done)
        finished = _finished(work.target, done, finishing)
        summaries: dict[str, Summary] = {}
        if tables is not None:
            with report.watch.part("summary"):
                summaries = _summaries(work.target, done, work.boxes)
    scenes = [camera.name for camera in done if camera.is_scene]
    return RunResult(
        log=work.target,
        stages=tuple(report.stages),
        frames=report.frames,
        rows=report.rows,
        tracks=report.tracks,
        events=report.events,
        finished=finished,
        stale=tuple(report.stale),
        layouts=tuple(products.layouts),
        tables=products.rows,
        summary=summaries.get("", summaries.get(scenes[-1]) if scenes else None),
        written_to=work.written_to if report.stages else None,
        written_because=work.place.why,
        warnings=tuple(dict.fromkeys(warnings)),
        notes=tuple(work.notes),
        seconds=round(monotonic() - began, 3),
        seconds_by_part={name: round(seconds, 3) for name, seconds in report.watch.seconds.items()},
        cameras={camera.name: CameraResult.of(camera, summaries[camera.name]) for camera in done if chosen},
        left_out=dict(chosen.left_out if chosen else {}),
        not_fused=each.not_fused if each is not None else "",
        files=tuple(products.owed),
        written_tables=tuple(products.tables),
    )


class _Change:
    """A change of the log at ``path``, or of a copy at ``output``: what is said about it, and where it was written."""

    def __init__(self, where: Where) -> None:
        self.force, (self.path, self.output) = where.force, where.places()
        self.target: Location = self.output or self.path
        self.written_to = self.target
        self.notes, self.boxes, self.place = Notes(), BoxesRead(), SidecarChoice(where.sidecar)

    def act(
        self, act: Act, progress: Progress, each: EveryCamera | None, has_tables: bool
    ) -> tuple[list[Done], ChosenCameras | None]:
        """Change the log, or each of its cameras; return what was done, and which of several were chosen."""
        with logs.read(self.path, sidecar=None if self.output else self.place) as opened:
            if self.output is None:
                opened.lock()  # a second process is refused before it computes anything
            if has_tables and not self.force:
                refuse_foreign_products(opened, self.target)
            self.written_to = self.output or opened.parts[-1].path
            chosen = each.choose(opened, self.notes.say) if each is not None else None
            if each is None or chosen is None:
                return [Done("", *act(opened, self.output, self.notes.say, self.boxes))], None
        # The log is written for each camera; a copy is published as a whole.
        with publish(self.output) if self.output is not None else nullcontext() as part:
            return each.run(chosen, Steps(self.path, part, self.output, self.place, self.notes.say, progress)), chosen

    def products(self, report: pipeline.Report, has_tables: bool, progress: Progress) -> Products:
        """Bring the files beside the log up to date."""
        products = write_products(
            self.target,
            is_new=report.is_written,
            tables=has_tables,
            force=self.force,
            progress=progress,
            boxes=self.boxes,
        )
        if has_tables and not isinstance(self.target, Path):
            export = call("export", self.target)
            self.notes.say(f"no tables are written, because {self.target} is in a store; {export} writes them here")
        return products


def _say_stale(target: Location, report: pipeline.Report, is_open: bool) -> None:
    """Warn of channels that are out of date now; with ``is_open`` later steps of the run may have made them again."""
    if not report.stale:
        return
    with logs.read(target) as opened:
        if is_open:
            report.stale = [topic for topic in report.stale if pipeline.is_stale(opened, topic)]
        warn_stale(opened, report.stale)


def _finished(target: Location, done: Sequence[Done], finishing: Sequence[Any]) -> dict[str, Finished]:
    """Return what finishers say of a log, by their names."""
    reports = {step.name: step.report for step in finishing if hasattr(step, "report")}
    with logs.read(target) if reports else nullcontext() as opened:
        finished = {name: report(opened, [camera.prefix for camera in done]) for name, report in reports.items()}
    return {name: report for name, report in finished.items() if report is not None}


def _summaries(target: Location, done: Sequence[Done], boxes: BoxesRead) -> dict[str, Summary]:
    """Return what a log holds now, by the name of each camera, "" for the only one."""
    summaries: dict[str, Summary] = {}
    with logs.read(target) as opened:
        for camera in done:
            with notices.naming(camera.name) if camera.name else nullcontext():
                summaries[camera.name] = pipeline.summarise(opened, camera.prefix, boxes)
    return summaries


def warn_stale(opened: logs.Log, topics: Sequence[str]) -> None:
    """Warn of channels that are out of date now: those that ``run`` brings up to date, and those that it can't."""
    lost: dict[str, list[str]] = {}
    for topic in topics:
        if name := pipeline.missing_finisher(opened, topic):
            lost.setdefault(name, []).append(topic)
            continue
        camera = pipeline.camera_to_name(opened, topic)
        again = call("run", opened.path, camera=camera) if camera else call("run", opened.path)
        warn(f"{topic} is out of date, because its input was replaced; {again} brings it up to date", "out-of-date")
    for name, (first, *rest) in lost.items():
        why = missing_extension(name, "finisher") or f"no installed package has the finisher {name}"
        those = f"{first} and {len(rest)} more are" if rest else f"{first} is"
        warn(f"{those} out of date, because the input was replaced: {why}", "out-of-date")


def transform_of(stage: str | Stage, chosen: str | Transform | None, options: Mapping[str, Value]) -> Transform:
    """Return the transform of a stage: the one of this name, or this one; with these options.

    Raises McaptrackError for a name or an option that does not exist, and for what is no transform.
    """
    options = {name: value.item() if isinstance(value, np.generic) else value for name, value in options.items()}
    if chosen is None or isinstance(chosen, str):
        step = STAGES[stage] if isinstance(stage, str) else stage
        if chosen and step.parameter:
            return step.make(**{step.parameter: chosen, **options})
        return step.make(chosen or "", **options)
    return _with_options(chosen, options)


def transforms_of(stages: Mapping[str, str | Transform] | None) -> dict[str, Transform]:
    """Return transforms by stage. Raises McaptrackError as ``transform_of``, and for a stage that does not exist."""
    for stage in stages or {}:
        if stage not in STAGES:
            raise McaptrackError(f"there is no stage {stage}; `stages=` has transforms of {', '.join(STAGES)}")
    return {stage: transform_of(stage, chosen, {}) for stage, chosen in (stages or {}).items()}


def _with_options(base: Transform, options: Mapping[str, Value]) -> Transform:
    """Return a transform with other values of some options. Raises McaptrackError for an unknown option."""
    if isinstance(base, type):
        raise McaptrackError(f"{base.__name__} is a class; give an object of it: {base.__name__}()")
    if not is_dataclass(base):
        raise McaptrackError(
            f"{base!r:.80} is no transform: it is no dataclass; give a name, or an object of a transform"
        )
    own = [f.name for f in fields(base) if not f.metadata.get("context")]
    refuse_unknown(type(base).__name__, options, own)
    return replace(base, **options)


@checked
def run_stage(
    stage: str,
    transform: Transform | None,
    log: PathLike,
    topic: str | None = None,
    to: str | None = None,
    camera: str | None = None,
    output: PathLike | None = None,
    sidecar: bool | None = None,
    force: bool = False,
    stages: Mapping[str, str | Transform] | None = None,
    progress: Progress = no_progress,
    *,
    mode: Mode | None = None,
    frame: str | None = None,
    fields: str | None = None,
    class_map: str | None = None,
    make: Callable[[str], Transform] | None = None,
    views: bool = False,
    definitions: PathLike | Sequence[PathLike] | None = None,
) -> RunResult:
    """Run one stage with a transform; ``detect``, ``track`` and the others call this with their transform.

    Without a transform ``make`` makes it, by the name of the one that suits the input, or the default one by "".
    """
    modes = STAGES[stage].modes
    keep = modes[mode or "both"] or None if modes else None
    before = transforms_of(stages)

    def plan(opened: logs.Log, prefix: str, say: Say, *_: Collection[str]) -> list[Job]:
        return pipeline.plan_stage(opened, prefix, stage, transform, topic, to, keep, say, before, frame or "", make)

    where = Where(log, camera, topic, output, sidecar, force)
    with definitions_of(definitions), choosing(topic, fields, class_map):
        return work(where, plan, progress, views=views, plane=PlaneChoice(frame=frame))
