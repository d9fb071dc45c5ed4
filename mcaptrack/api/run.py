"""Run all stages on a log."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Annotated, Final, Unpack

import mcaptrack
from mcaptrack.api.common import as_location, split_names, warn_unused
from mcaptrack.api.declared import PYTHON_ONLY, Option, declared
from mcaptrack.api.finishing import PartsOfRun
from mcaptrack.api.options import (
    FILES,
    ClassNames,
    Definitions,
    EachLog,
    FieldMap,
    Force,
    Frame,
    Output,
    PathLike,
    Reports,
    Sidecar,
    Topic,
    chooser,
    no_progress,
)
from mcaptrack.api.stages import Stages
from mcaptrack.choices import CameraMotionUse
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.events import EventOptions
from mcaptrack.notices import Say
from mcaptrack.transforms import STAGES, Transform
from mcaptrack.transforms.motion_limits import LIMITS_PATTERN

if TYPE_CHECKING:
    from mcaptrack import log as logs
    from mcaptrack.location import Location
    from mcaptrack.pipeline import Job

#: Headings in the help.
_AFTER: Final = "After the stages"
_CLASSES: Final = "Classes of objects"
_AGAIN: Final = "The {kind}, also where another one was used before"
_PARTS: Final = PartsOfRun()


@declared(
    most_used=(
        *("output", "topic", "camera", "detector", "tracker", "retracker", "predictor"),
        *(*_PARTS.most_used, "force"),
    ),
    heading="Start here",
    printed_by="mcaptrack.cli.running:Run",
    more=_PARTS.options,
)
def run(
    log: EachLog,
    *,
    topic: Topic = None,
    camera: Annotated[str | Sequence[str] | None, Option(FILES, metavar="A,B", commas=True, shown="all")] = None,
    frame: Frame = None,
    map: FieldMap = None,  # noqa: A002  # the name of the option
    class_map: ClassNames = None,
    output: Output = None,
    definitions: Definitions = None,
    sidecar: Sidecar = None,
    events: Annotated[bool | EventOptions, Option(_AFTER)] = True,
    tables: Annotated[bool, Option(_AFTER)] = True,
    force: Force = False,
    detector: Annotated[str | Transform | None, chooser("detector", _AGAIN, shown="as before, or median")] = None,
    tracker: Annotated[
        str | Transform | None, chooser("tracker", _AGAIN, shown="as before, or one that suits the detections")
    ] = None,
    retracker: Annotated[str | Transform | None, chooser("retracker", _AGAIN, shown="as before, or likelihood")] = None,
    predictor: Annotated[str | Transform | None, chooser("predictor", _AGAIN, shown="as before, or blend")] = None,
    camera_motion: Annotated[CameraMotionUse | None, Option(tuning=True, shown="auto")] = None,
    across_classes: Annotated[
        bool | None, Option(_CLASSES, tuning=True, flag="across-classes/within-classes", shown="within")
    ] = None,
    class_limits: Annotated[str | None, Option(_CLASSES, tuning=LIMITS_PATTERN, shown="a table")] = None,
    fit_plane: Annotated[bool | None, Option(tuning=True, shown="estimate")] = None,
    person_height_m: Annotated[float | None, Option("", 0.1, 10, tuning=True, shown="1.7")] = None,
    ground_frame: Annotated[str | None, Option(shown="the fixed frame")] = None,
    stages: Stages = None,
    follows: Annotated[PathLike | Sequence[PathLike] | None, PYTHON_ONLY] = None,
    progress: Reports = no_progress,
    **more: Unpack[mcaptrack._RunOptions],
) -> mcaptrack.RunResult:
    """Detect, track, re-track and predict: do what a log still lacks.

    Runs all stages that are missing or out of date, then events and tables. From /camera/video (or the detections,
    tracks or samples that the log has) to /camera/predictions and /camera/retracks; then events (see `mcaptrack
    events`), views, and Parquet tables beside the log. ``topic`` starts with the pictures, or the boxes, of that
    channel.

    Channels that are up to date are kept; those that are out of date are made again with the options that they had.
    ``force`` makes all again; on the command line with the parameters that environment and config files set now,
    otherwise with those they had.

    All cameras of a log are run, one after the other. Where the extension is installed, those with a measured ground
    plane are fused to /world, as `mcaptrack fuse` does, and this scene is run, too.

    Parameters
    ----------
    topic : str, optional
        Begin with the pictures, or the detections, of this channel.
    camera : str or sequence of str, optional
        Which cameras, if the log has several; one alone is not fused.

        Also with commas between names. By default all that have pictures or boxes.
    events : bool or EventOptions, default True
        Write events and scores of identities, as `mcaptrack events` does.

        Or how tracks are matched with the ground truth for them.
    tables : bool, default True
        Write Parquet tables beside the log.
    force : bool, default False
        Run everything again, and replace the output file if it exists.
    camera_motion : {"auto", "on", "off"}, optional
        Compensate tracks for the motion of the camera: if it moves or has cuts (auto), also if it only shakes (on), or
        never (off); also where it was done otherwise before.

        By default as before, and "auto" where there are no tracks yet.
    across_classes : bool, optional
        Let a track continue with a detection, and after re-tracking with a track, of another class.

        By default as before, and False where there are no tracks yet.
    class_limits : str, optional
        Limits of the motion of a class in all stages: NAME=SPEED:DRIFT:NOISE:GATE in m/s, m/s within a second, m and m,
        as in car=40,pedestrian=4::0.1.

        By default as before, or those of the table.
    fit_plane : bool, optional
        Where no ground plane is given, estimate one from the boxes of a learned detector.

        By default as before, and True where there is none yet.
    person_height_m : float, optional
        Mean height of people in metres, for a ground plane that is not given.

        By default as before, or 1.7.
    ground_frame : str, optional
        Frame with the ground as z = 0, for a camera of a robot with a calibration and transforms.

        By default as before, or the fixed frame.
    stages : mapping of str to str or Transform, optional
        Transforms, or their names, by stage, for channels that are missing; with ``force`` also for those that exist.
    follows : path or sequence of path, optional
        The log before this one, of the same camera: people who are in the picture at the cut keep their ids, and others
        get ids that it doesn't have. Of several logs, in order, it is the one before this one.

    Returns
    -------
    RunResult
        What was made; ``summary`` has what the log holds now, and its scores if it has ground truth.

    Raises
    ------
    McaptrackError
        If the log cannot be read or written, or if there is nothing to start from.

    Examples
    --------
    On the command line:

        mcaptrack run log.mcap

    >>> import mcaptrack
    >>> from mcaptrack.transforms import ByteTrack
    >>> result = mcaptrack.run("log.mcap", output="done.mcap", tracker=ByteTrack(max_age_s=1.0))
    >>> result.summary.tracks > 0
    True

    """
    from mcaptrack.api.running import Where, transform_of, transforms_of, work
    from mcaptrack.pipeline import PlaneChoice, Watch, plan_all
    from mcaptrack.pipeline.scenes import Scenes
    from mcaptrack.pipeline.several import unfitting
    from mcaptrack.sources.foreign.boxes import choosing
    from mcaptrack.sources.foreign.definitions import definitions_of

    names = tuple(dict.fromkeys(split_names("camera", camera)))
    if len(names) > 1 and topic is not None:
        raise McaptrackError(f"`topic={topic!r}` is of one camera, and `camera=` names {len(names)}; leave one out")
    named = {"detector": detector, "tracker": tracker, "retracker": retracker, "predictor": predictor}
    chosen = {kind: choice for kind, choice in named.items() if choice is not None}
    transforms = transforms_of(stages)
    transforms |= {s.name: transform_of(s.name, chosen[s.option], {}) for s in STAGES.values() if s.option in chosen}
    joins = Scenes(_PARTS.scene_makers(more))
    plane = PlaneChoice(fit_plane, person_height_m, frame, ground_frame)
    settings = {"camera_motion": camera_motion, "across_classes": across_classes, "class_limits": class_limits}
    shared = {name: value for name, value in settings.items() if value is not None}

    def plan(opened: logs.Log, prefix: str, say: Say, changed: Collection[str], renewed: Collection[str]) -> list[Job]:
        others = unfitting(opened, prefix, transforms, say) if len(names) != 1 and topic is None else set()
        kept = {stage: transform for stage, transform in transforms.items() if stage not in others}
        options = chosen.keys() - {STAGES[stage].option for stage in others}
        return plan_all(opened, prefix, say, topic, kept, force, options, shared, plane, frame or "", changed, renewed)

    options = events if isinstance(events, EventOptions) else EventOptions()
    finishing = [*([Watch(options, force=force)] if events else []), *_PARTS.finishers(more, force)]
    where = Where(log, names[0] if len(names) == 1 else None, topic, output, sidecar, force)
    earlier = _log_before(as_location(log), follows)
    with definitions_of(definitions), choosing(topic, map, class_map):
        result = work(
            where, plan, progress, tables, finishing=finishing, views=True, plane=plane, cameras=names, joins=joins,
            follows=earlier,
        )  # fmt: skip
    if not result.cameras:
        warn_unused("one camera is run", **_PARTS.chosen("scene", more))
    elif unused := joins.unused:
        why = "the log has a scene, or another maker of scenes came first"
        warn_unused(why, **_PARTS.chosen("scene", more, unused))
    return result


def _log_before(log: Location, follows: PathLike | Sequence[PathLike] | None) -> Location | None:
    """Return the log that a log follows; of several the one before it, None if it is the first."""
    if follows is None or isinstance(follows, str | os.PathLike):
        before = None if follows is None else as_location(follows)
    else:
        order = [as_location(log_before) for log_before in follows]
        if log not in order:
            raise McaptrackError(f"{log} is not one of the logs of `follows=`; their order says which one it follows")
        at = order.index(log)
        before = order[at - 1] if at else None
    if before is not None and before == log:
        raise McaptrackError(f"{log} can't follow itself; `follows=` is the log before it")
    return before
