"""``mcaptrack report``: one page about logs, for people."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from mcaptrack.cli import common
from mcaptrack.errors import McaptrackError


@common.one_line
def report(
    logs: common.Logs,
    output: Annotated[
        Path | None,
        common.option(
            "--output", "-o", panel=common.FILES, help="The page.", show_default="LOG.report.html beside the log"
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

    The page needs no network and runs nothing; its numbers are inside it as JSON, and --json prints them too. Scores
    are those of `mcaptrack evaluate`; without ground truth in the log the page has none. Reads logs only: stages that
    are missing in one, `mcaptrack run` makes.

    Example: mcaptrack report log.mcap -o report.html

    Example: mcaptrack report 'logs/*.mcap' -o report.html
    """
    from mcaptrack import log
    from mcaptrack.files import is_same_file, publish_bytes, refuse_overwrite
    from mcaptrack.viewing.report import data, draw, gather, page

    paths = common.expand(logs)
    if output is None and len(paths) > 1:
        raise McaptrackError(f"{len(paths)} logs become one page; say which with -o")
    target = output or paths[0].with_suffix(".report.html")
    if any(is_same_file(path, target) for path in paths):
        raise McaptrackError(f"{target} is a log; give the page another name with -o")
    refuse_overwrite(target, force)
    reports = []
    with common.Talk(quiet, verbose).open() as talk:
        for done, path in enumerate(paths):
            talk.progress("report", done, len(paths))
            with log.read(path) as opened:
                reports.append(gather(opened, camera, talk.detail))
                draw(reports[-1], done, len(paths))
        whole = page(reports).encode("utf-8")
        publish_bytes(target, whole)
        talk.progress("report", len(paths), len(paths))
        talk.say(f"{target}: {len(paths)} log{'s' if len(paths) > 1 else ''}, {len(whole) / 1e6:.2f} MB")
    if json:
        common.print_json(data(reports))
