"""``mcaptrack zones``: count visits of zones and crossings of lines."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mcaptrack.cli import common
from mcaptrack.cli.many import LogWork, process, takes_many
from mcaptrack.cli.text import console, say
from mcaptrack.errors import McaptrackError

if TYPE_CHECKING:
    from mcaptrack import RunResult

_COUNT = "Counting"
#: The word before a log that is drawn on.
_DRAW = "draw"


@common.one_line
@takes_many()
def zones(
    logs: common.Logs,
    zones: Annotated[
        Path | None,
        common.option(
            "--zones",
            panel=_COUNT,
            metavar="FILE",
            help="Zones (Polygons) and lines (LineStrings) of GeoJSON, in metres or pixels.",
            show_default="those that were counted before",
        ),
    ] = None,
    topic: Annotated[
        list[str] | None,
        common.option(
            "--topic",
            panel=_COUNT,
            help="Count these channels of tracks.",
            show_default="tracks, re-tracked tracks, truth",
        ),
    ] = None,
    margin_m: Annotated[
        float | None,
        common.option(
            "--margin-m",
            panel=_COUNT,
            least=0,
            most=100,
            help="A track changes sides where it is farther than so many metres from an edge: noise there counts once.",
            show_default="0.25",
        ),
    ] = None,
    max_gap_s: Annotated[
        float | None,
        common.option(
            "--max-gap-s",
            panel=_COUNT,
            least=0,
            most=1e6,
            help="A track that is not seen for more seconds than this ends its visit.",
            show_default="4",
        ),
    ] = None,
    camera: common.Camera = None,
    output: common.Output = None,
    sidecar: common.Sidecar = None,
    force: common.Force = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Count visits of zones and crossings of lines by the tracks of a log, and write them into the log.

    Beside each channel of tracks, such as /camera/retracks/full, go .../zones/visits, .../zones/crossings, and counts
    for each frame in .../zones/counts. `mcaptrack run --zones FILE` does this, too, and later runs count again where
    tracks have changed. `mcaptrack docs zones` says what the file holds.

    With `draw` before the log, a page is written on which zones are drawn over a picture of the scene, in a browser.

    Example: mcaptrack zones log.mcap --zones zones.geojson

    Example: mcaptrack zones draw log.mcap
    """
    import mcaptrack
    from mcaptrack.fleet import find_logs

    if str(logs[0]) == _DRAW and len(logs) == 1 and not Path(_DRAW).exists():
        raise McaptrackError("`zones draw` needs a log: name it after draw")
    if str(logs[0]) == _DRAW and len(logs) > 1:
        extra = {"--zones": zones, "--topic": topic, "--margin-m": margin_m, "--max-gap-s": max_gap_s}
        extra |= {"--sidecar": sidecar}
        if len(logs) > 2 or any(value is not None for value in extra.values()):
            unused = next((name for name, value in extra.items() if value is not None), f"another log ({logs[-1]})")
            raise McaptrackError(f"`zones draw` takes one log, --camera, --output and --force, not {unused}")
        page = mcaptrack.draw_zones(logs[1], camera=camera, output=output, force=force)
        if json:
            common.print_json({"log": str(logs[1]), "page": str(page)})
        elif not quiet:
            say(f"{page}: open it in a browser, draw, and download the file for --zones")
        return

    options: dict[str, Any] = {"zones": zones, "topic": topic, "margin_m": margin_m, "max_gap_s": max_gap_s}
    options |= {"camera": camera, "sidecar": sidecar, "force": force}
    with common.Talk(quiet, verbose).open() as talk:
        work: LogWork[RunResult] = LogWork(
            "zones",
            mcaptrack.zones,
            options,
            show=lambda _, result: _print(result, talk, json),
            data=_as_json,
            line=zones_in_short,
        )
        results, totals = process(find_logs(logs), work, talk, output)
    if json:
        common.print_json({"results": [_as_json(result) for result in results], **totals})


def zones_in_short(result: RunResult) -> str:
    """The number of zones and lines that were counted, and of channels of tracks, in words."""
    zones = len({total.zone for totals in result.zones.values() for total in totals})
    topics = len(result.zones)
    named = "zone or line" if zones == 1 else "zones and lines"
    return f"{zones} {named}, of {topics} channel{'' if topics == 1 else 's'} of tracks"


def _as_json(result: RunResult) -> dict[str, Any]:
    return {
        "log": str(result.log),
        "stages": list(result.stages),
        "zones": {topic: [total.to_json() for total in totals] for topic, totals in result.zones.items()},
        "written_to": str(result.written_to) if result.written_to else None,
        "seconds": result.seconds,
    }


def _print(result: RunResult, talk: common.Talk, is_json: bool) -> None:
    if not is_json:
        print_zones(result)
    where = f"results are in {result.written_to}" if result.written_to else "everything was up to date"
    where += f": {result.written_because}" if result.written_to and result.written_because else ""
    talk.say(f"{result.log}: {where}")


def print_zones(result: RunResult) -> None:
    """Print a table of zones and one of lines, with a row for each channel of tracks."""
    from rich import box
    from rich.table import Table

    heads = {
        False: ("zone", "tracks of", "tracks", "visits", "entered", "left", "mean stay", "most inside"),
        True: ("line", "tracks of", "tracks", "forward", "backward"),
    }
    names = dict.fromkeys((total.zone, total.is_line) for totals in result.zones.values() for total in totals)
    for is_line, head in heads.items():
        table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
        for place, name in enumerate(head):
            table.add_column(name, justify="left" if place < 2 else "right", overflow="fold")
        for name, _ in (pair for pair in names if pair[1] == is_line):
            for topic, totals in result.zones.items():
                counts = next((total for total in totals if (total.zone, total.is_line) == (name, is_line)), None)
                if counts is None:
                    continue
                stay = "" if counts.mean_dwell_s is None else f"{counts.mean_dwell_s:.1f} s"
                of_zone = (counts.visits, counts.entered, counts.left, stay, counts.most_inside)
                cells = (counts.tracks, *((counts.forward, counts.backward) if is_line else of_zone))
                table.add_row(name, topic, *map(str, cells))
        if table.row_count:
            console().print(table)
