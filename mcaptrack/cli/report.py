"""``mcaptrack report``: write one HTML page about logs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from mcaptrack.cli import common
from mcaptrack.cli.common import expand


@common.one_line
def report(
    logs: common.Logs,
    output: Annotated[
        Path | None,
        common.option(
            "--output",
            "-o",
            panel=common.FILES,
            help="Write the page to this file.",
            show_default="LOG.report.html beside the log",
        ),
    ] = None,
    camera: common.Camera = None,
    force: common.Force = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Write one page about a log, or several: scores, forecasts, tracks over the scene, identity switches, lineage.

    The page needs no network and has no scripts; it contains its numbers as JSON, which --json prints. Scores are those
    of `mcaptrack evaluate`; without ground truth in the log there are none. Only reads logs; `mcaptrack run` runs
    stages that are missing. Of a folder that logs were exported to, with --output-dir, the page has totals,
    trends, the worst logs, outliers and warnings.

    Example: mcaptrack report log.mcap -o report.html

    Example: mcaptrack report 'logs/*.mcap' -o report.html

    Example: mcaptrack report tables/ -o fleet.html
    """
    import mcaptrack

    paths = expand(logs, folders=True)
    with common.Talk(quiet, verbose).open() as talk:
        done = mcaptrack.report(paths, output, camera=camera, force=force, progress=talk.progress)
        count = done.data["summary"]["logs"] if "summary" in done.data else len(paths)
        talk.say(f"{done.page}: {count} log{'s' if count > 1 else ''}, {done.size / 1e6:.2f} MB")
    if json:
        common.print_json(dict(done.data))
