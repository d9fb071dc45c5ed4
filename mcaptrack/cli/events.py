"""``mcaptrack events``: write events of tracks and errors of predictions."""

from __future__ import annotations

from typing import Annotated

from mcaptrack.cli import common, labels
from mcaptrack.cli.many import takes_many
from mcaptrack.cli.running import run_on_logs


@common.one_line
@takes_many()
def events(
    logs: common.Logs,
    topic: Annotated[
        list[str] | None,
        common.option(
            "--topic",
            panel=common.FILES,
            help="Write events of these channels of tracks.",
            show_default="tracks, retracks",
        ),
    ] = None,
    similarity: Annotated[
        labels.SimilarityName | None, labels.similarity("iou at the video's rate, otherwise metres")
    ] = None,
    gate_m: Annotated[float | None, labels.gate_m("1.0, and 2.0 for 3D boxes")] = None,
    min_iou: Annotated[float | None, labels.min_iou()] = None,
    camera: common.Camera = None,
    output: common.Output = None,
    sidecar: common.Sidecar = None,
    force: common.Force = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Write events of tracks (begin, end, identity switches) and errors of predictions into the log.

    Events are the begin and end of tracks, and which tracks re-tracking joined or split; if the log has /camera/truth
    also missed people, false tracks and identity switches, matched as in `mcaptrack evaluate`. They go to
    /camera/tracks/events (rows), .../events/view/log (text) and /camera/tracks/counts (totals frame by frame); for
    /camera/retracks likewise.

    Errors of predictions, against ground truth and against re-tracked tracks, go to /camera/predictions/errors and,
    frame by frame, to .../scores; for /camera/retracks/predictions likewise. With --topic they are left out. `mcaptrack
    run` writes all this, too.

    Example: mcaptrack events log.mcap --similarity metres --gate-m 1
    """
    import mcaptrack

    shared = {"logs": logs, "camera": camera, "output": output, "sidecar": sidecar, "force": force}
    options = {"topic": topic, "similarity": similarity, "gate_m": gate_m, "min_iou": min_iou}
    run_on_logs(shared | {"json": json, "quiet": quiet, "verbose": verbose}, "events", mcaptrack.events, options)
