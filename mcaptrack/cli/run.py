"""``mcaptrack run``: all stages that are missing or out of date, then events, views and tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final, Literal

from mcaptrack.cli import common
from mcaptrack.cli.chosen import configured
from mcaptrack.cli.command import settings_of
from mcaptrack.cli.many import takes_many
from mcaptrack.cli.running import in_order, run_on_logs
from mcaptrack.cli.stages import Frame, Topic, chooser
from mcaptrack.cli.text import stdout_to_stderr
from mcaptrack.transforms import STAGES
from mcaptrack.transforms.motion_limits import LIMITS_PATTERN

_AFTER: Final = "After the stages"
_CLASSES: Final = "Classes of objects"
_SEVERAL: Final = "Several cameras"
_AGAIN: Final = "Use this {kind}, also where another one was used before"


@common.one_line
@takes_many()
def run(
    logs: common.Logs,
    topic: Topic = None,
    camera: Annotated[
        str | None,
        common.option(
            "--camera",
            panel=common.FILES,
            metavar="A,B",
            help="Which cameras, if the log has several; one alone is not fused.",
            show_default="all",
        ),
    ] = None,
    frame: Frame = None,
    output: common.Output = None,
    sidecar: common.Sidecar = None,
    events: Annotated[
        bool,
        common.option(
            "--events/--no-events",
            panel=_AFTER,
            help="Write events and scores of identities, as `mcaptrack events` does.",
        ),
    ] = True,
    tables: Annotated[
        bool, common.option("--tables/--no-tables", panel=_AFTER, help="Write Parquet tables beside the log.")
    ] = True,
    zones: Annotated[
        Path | None,
        common.option(
            "--zones",
            panel=_AFTER,
            metavar="FILE",
            help="Count visits of zones and crossings of lines, as `mcaptrack zones` does.",
            show_default="those that were counted before",
        ),
    ] = None,
    fuse: Annotated[
        bool,
        common.option(
            "--fuse/--no-fuse",
            panel=_SEVERAL,
            tuning=True,
            help="Fuse several cameras with measured ground planes to a scene, as `mcaptrack fuse` does.",
        ),
    ] = True,
    follows: Annotated[
        bool,
        common.option(
            "--continue",
            help="The logs follow one another, in this order, and are of one camera: people who are in the picture at "
            "a cut keep their ids. One log is done after the other.",
        ),
    ] = False,
    force: Annotated[
        bool,
        common.option("--force", panel=common.FILES, help="Run everything again, and replace the file that -o names."),
    ] = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
    fuser: Annotated[str | None, chooser("fuser", intro=_AGAIN, panel=_SEVERAL, shown="as before, or feet")] = None,
    detector: Annotated[str | None, chooser("detector", intro=_AGAIN, shown="as before, or median")] = None,
    tracker: Annotated[
        str | None, chooser("tracker", intro=_AGAIN, shown="as before, or one that suits the detections")
    ] = None,
    retracker: Annotated[str | None, chooser("retracker", intro=_AGAIN, shown="as before, or likelihood")] = None,
    predictor: Annotated[str | None, chooser("predictor", intro=_AGAIN, shown="as before, or red")] = None,
    camera_motion: Annotated[
        Literal["auto", "on", "off"] | None,
        common.option(
            "--camera-motion",
            tuning=True,
            help="Compensate tracks for the motion of the camera: if it moves or has cuts (auto), also if it only "
            "shakes (on), or never (off); also where it was done otherwise before.",
            show_default="auto",
        ),
    ] = None,
    across_classes: Annotated[
        bool | None,
        common.option(
            "--across-classes/--within-classes",
            panel=_CLASSES,
            tuning=True,
            help="Let a track continue with a detection, and after re-tracking with a track, of another class.",
            show_default="within",
        ),
    ] = None,
    class_limits: Annotated[
        str | None,
        common.option(
            "--class-limits",
            panel=_CLASSES,
            tuning=LIMITS_PATTERN,
            help="Limits of the motion of a class in all stages: NAME=SPEED:DRIFT:NOISE:GATE in m/s, m/s within a "
            "second, m and m, as in car=40,pedestrian=4::0.1.",
            show_default="a table",
        ),
    ] = None,
    fit_plane: Annotated[
        bool | None,
        common.option(
            "--fit-plane/--no-fit-plane",
            tuning=True,
            help="Where no ground plane is given, estimate one from the boxes of a learned detector.",
            show_default="estimate",
        ),
    ] = None,
    person_height_m: Annotated[
        float | None,
        common.option(
            "--person-height-m",
            tuning=True,
            least=0.1,
            most=10.0,
            help="Mean height of people in metres, for a ground plane that is not given.",
            show_default="1.7",
        ),
    ] = None,
    ground_frame: Annotated[
        str | None,
        common.option(
            "--ground-frame",
            help="Frame with the ground as z = 0, for a camera of a robot with a calibration and transforms.",
            show_default="the fixed frame",
        ),
    ] = None,
) -> None:
    """Run all stages that are missing or out of date, then events, views and tables.

    From /camera/video (or the detections, tracks or samples that the log has) to /camera/predictions and
    /camera/retracks; then events (see `mcaptrack events`), views, and Parquet tables beside the log. --topic starts
    with the pictures, or the boxes, of that channel. Channels that are up to date are kept; those that are out of date
    are made again with the parameters they had. --force makes all again, with the parameters that environment and
    config files set now, otherwise with those they had. Zones of --zones are counted in later runs, too.

    All cameras of a log are run, one after the other. Those with a measured ground plane are fused to /world, as
    `mcaptrack fuse` does, and this scene is run, too.

    Example: mcaptrack run log.mcap
    """
    shared = {"logs": logs, "output": output, "sidecar": sidecar, "force": force}
    shared |= {"json": json, "quiet": quiet, "verbose": verbose}
    named = {"detector": detector, "tracker": tracker, "retracker": retracker, "predictor": predictor}
    chosen = {kind: name for kind, name in named.items() if name}
    import mcaptrack
    from mcaptrack.evaluation.events import EventOptions

    with stdout_to_stderr():
        settings, stages = settings_of("events"), configured(chosen)
    options: dict[str, Any] = {
        "camera": camera,
        "fuse": fuse,
        "fuser": fuser,
        "topic": topic,
        "tables": tables,
        "frame": frame,
        "camera_motion": camera_motion,
    }
    options |= {"fit_plane": fit_plane, "person_height_m": person_height_m, "ground_frame": ground_frame}
    options |= {"across_classes": across_classes, "class_limits": class_limits, "zones": zones}
    for stage in STAGES.values():
        if stage.option in chosen:
            options[stage.option] = stages.pop(stage.name)
    if follows:
        options["follows"] = in_order(logs, output)
    watched = EventOptions(*(settings.get(name) for name in ("similarity", "gate_m", "min_iou")))
    options |= {"events": watched if events else False, "stages": stages}
    run_on_logs(shared, "run", mcaptrack.run, options)
