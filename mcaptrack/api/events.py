"""Write events of tracks, and errors of predictions, into a log."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import mcaptrack
from mcaptrack.api.common import names_of, warn_unused
from mcaptrack.api.declared import Option, declared
from mcaptrack.api.options import (
    FILES,
    Camera,
    EachLog,
    Force,
    Output,
    Reports,
    Sidecar,
    gate_m,
    min_iou,
    no_progress,
    similarity,
)
from mcaptrack.choices import Similarity


@declared(
    most_used=("topic", "similarity", "gate_m", "output", "force"),
    python_only=("sidecar",),
    heading="Results",
    printed_by="mcaptrack.cli.running:Events",
)
def events(
    log: EachLog,
    *,
    topic: Annotated[str | Sequence[str] | None, Option(FILES, shown="tracks, retracks")] = None,
    similarity: Annotated[Similarity | None, similarity("iou at the video's rate, otherwise metres")] = None,
    gate_m: Annotated[float | None, gate_m("1.0, and 2.0 for 3D boxes")] = None,
    min_iou: Annotated[float | None, min_iou("0.5")] = None,
    camera: Camera = None,
    output: Output = None,
    sidecar: Sidecar = None,
    force: Force = False,
    progress: Reports = no_progress,
) -> mcaptrack.RunResult:
    """Write begins, ends and identity switches of tracks into the log.

    Events are the begin and end of tracks, and which tracks re-tracking joined or split; if the log has /camera/truth
    also missed people, false tracks and identity switches, matched as in `mcaptrack evaluate`. They go to
    /camera/tracks/events (rows), .../events/view/log (text) and /camera/tracks/counts (totals frame by frame); for
    /camera/retracks likewise.

    Errors of predictions, against ground truth and against re-tracked tracks, go to /camera/predictions/errors and,
    frame by frame, to .../scores; for /camera/retracks/predictions likewise. With ``topic`` they are left out.
    `mcaptrack run` writes all this, too.

    Parameters
    ----------
    topic : str or sequence of str, optional
        Write events of these channels of tracks.

        By default of /camera/tracks and /camera/retracks, with the errors of predictions.

    Returns
    -------
    RunResult
        What was made: ``events`` has the number of events of each kind.

    Raises
    ------
    McaptrackError
        If the log cannot be read or written, or has no tracks.

    Examples
    --------
    On the command line:

        mcaptrack events log.mcap --similarity metres --gate-m 1

    >>> import mcaptrack
    >>> result = mcaptrack.events("log.mcap", similarity="metres", gate_m=0.5)
    >>> sorted(result.events)
    ['/camera/retracks', '/camera/tracks']

    """
    from mcaptrack.api.running import Where, work
    from mcaptrack.evaluation.events import EventOptions
    from mcaptrack.pipeline import Job, Watch

    def plan(*_: object) -> list[Job]:
        if similarity is not None:
            unused = {"min_iou": min_iou is not None} if similarity == "metres" else {"gate_m": gate_m is not None}
            warn_unused(f"ground truth and tracks are compared by {similarity}", **unused)
        return []

    watch = Watch(EventOptions(similarity, gate_m, min_iou), topics=names_of(topic), again=True)
    return work(Where(log, camera, None, output, sidecar, force), plan, progress, finishing=(watch,), views=True)
