"""``mcaptrack check``, ``recover`` and ``drop``: check logs, save damaged ones, and remove channels."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mcaptrack.cli import common
from mcaptrack.cli.many import LogWork, many_options, process, takes_many
from mcaptrack.cli.text import console, show
from mcaptrack.location import Location

if TYPE_CHECKING:
    from mcaptrack import DropResult, LogCheck, LogRecovery
    from mcaptrack.log import CheckResult

_SHOWN = 20
#: Ending of the names of logs that were saved.
_RECOVERED = ".recovered.mcap"


@common.one_line
@takes_many(outputs=False)
def check(
    logs: common.Logs,
    output: common.Printed = None,
    force: common.Force = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Check every byte of a log: structure, checksums, indexes, statistics, order of messages.

    The exit code is 1 if there are errors; warnings are about what could be better. `mcaptrack recover` saves what is
    intact.

    Example: mcaptrack check log.mcap
    """
    import mcaptrack
    from mcaptrack.fleet import find_logs

    work: LogWork[LogCheck] = LogWork(
        "check",
        mcaptrack.check,
        {},
        show=lambda *_: None,
        data=lambda log_check: {"files": [_as_json(file) for file in log_check.files]},
        line=_verdict,
        writes=False,
    )
    with common.Talk(quiet, verbose).open() as talk:
        checks, totals = process(find_logs(logs), work, talk)
    checked = [file for log_check in checks for file in log_check.files]
    with common.printed_to(output, force):
        if json:
            common.print_json({"results": [_as_json(file) for file in checked], **totals})
        elif not many_options().json_lines:
            for file in checked:
                _print_check(file, quiet)
    if not all(file.is_sound for file in checked):
        raise typer.Exit(common.REFUSED)


def _verdict(checked: LogCheck) -> str:
    """Return the result of one of many logs in one line; the findings are printed at the end."""
    if checked.is_sound:
        return "sound"
    return f"damaged, {sum(finding.level == 'error' for finding in checked.findings)} errors"


def _as_json(checked: CheckResult) -> dict[str, object]:
    return {
        "log": str(checked.path),
        "sound": checked.is_sound,
        "messages": checked.messages,
        "chunks": checked.chunks,
        "findings": [
            {"level": f.level, "kind": f.kind, "byte": f.where, "times": f.times, "words": f.words}
            for f in checked.findings
        ],
    }


def _print_check(checked: CheckResult, quiet: bool) -> None:
    from rich.table import Table
    from rich.text import Text

    if not quiet:
        verdict = "sound" if checked.is_sound else "damaged"
        show(f"{checked.path}: {verdict}; {checked.messages} messages in {checked.chunks} chunks")
    findings = [finding for finding in checked.findings if not quiet or finding.level == "error"]
    if not findings:
        return
    table = Table(box=None, pad_edge=False)
    for name, justify in (("", "left"), ("byte", "right"), ("times", "right"), ("kind", "left"), ("", "left")):
        table.add_column(name, justify=justify, overflow="fold")  # type: ignore[arg-type]
    for finding in findings:
        style = "red" if finding.level == "error" else "yellow"
        table.add_row(Text(finding.level, style), str(finding.where), str(finding.times), finding.kind, finding.words)
    console().print(table)


@common.one_line
@takes_many()
def recover(
    logs: common.Logs,
    output: Annotated[Path | None, common.output("LOG.recovered.mcap beside the log")] = None,
    force: common.Force = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Save what is intact in a damaged log to LOG.recovered.mcap; the damaged log stays unchanged.

    Every chunk that can be read and has the right checksum is copied, with new indexes. What is lost is printed, and
    the exit code is then 3.

    Example: mcaptrack recover broken.mcap -o saved.mcap
    """
    import mcaptrack
    from mcaptrack.fleet import find_logs

    def show(_: Location, report: LogRecovery) -> None:
        talk.say(f"{report.output}: {report.messages} messages in {report.chunks} chunks are saved")
        for loss in report.lost if verbose else report.lost[:_SHOWN]:
            talk.say(f"lost: {loss}")
        if len(report.lost) > _SHOWN and not verbose:
            talk.say(f"lost: {len(report.lost) - _SHOWN} more; -v shows them")
        if not report.lost:
            talk.say("nothing was lost")

    def line(report: LogRecovery) -> str:
        saved = f"{report.messages} messages in {report.chunks} chunks are saved in {report.output}"
        return f"{saved}; {f'{len(report.lost)} losses' if report.lost else 'nothing was lost'}"

    def data(report: LogRecovery) -> dict[str, object]:
        saved = {"log": str(report.log), "output": str(report.output), "messages": report.messages}
        return saved | {"chunks": report.chunks, "lost": list(report.lost)}

    logs_found = find_logs(logs, each=True, leave_out=_RECOVERED)
    with common.Talk(quiet, verbose).open() as talk:
        work = LogWork("recover", mcaptrack.recover, {"force": force}, show, data, line, _RECOVERED)
        reports, totals = process(logs_found, work, talk, output)
    if json:
        common.print_json({"results": [data(report) for report in reports], **totals})
    if any(report.lost for report in reports):
        raise typer.Exit(common.LOST)


@common.one_line
@takes_many()
def drop(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="LOG", help="A log, a folder of logs, a pattern, or - for a list on stdin.", show_default=False
        ),
    ],
    topics: Annotated[
        list[str],
        typer.Argument(metavar="TOPIC", help="Channels to remove, or patterns such as '/camera/*'."),
    ],
    output: common.Output = None,
    in_place: Annotated[
        bool,
        common.option(
            "--in-place", panel=common.FILES, help="Also change a recording in place that ROS tools may have to read."
        ),
    ] = False,
    force: common.Force = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Remove channels from a log, in place or in a copy; all others stay unchanged, to the byte.

    Channels that only describe a removed one are removed with it: its `/view/`, `/events`, `/counts`, `/errors` and
    `/scores`. Results that stand beside the log are part of it, and of a copy.

    Example: mcaptrack drop log.mcap /camera/video -o small.mcap
    """
    import mcaptrack
    from mcaptrack.fleet import find_logs

    def line(done: DropResult) -> str:
        dropped = f"{', '.join(done.dropped)} with {done.messages} messages left out"
        return f"{dropped}; {done.bytes_before} bytes became {done.bytes}"

    def data(done: DropResult) -> dict[str, object]:
        return {"log": str(done.log), "dropped": list(done.dropped), "messages": done.messages, "bytes": done.bytes}

    options = {"topics": topics, "in_place": in_place, "force": force}
    with common.Talk(quiet, verbose).open() as talk:
        work = LogWork(
            "drop", mcaptrack.drop, options, lambda _, done: talk.say(f"{done.log}: {line(done)}"), data, line
        )
        results, totals = process(find_logs([path]), work, talk, output)
    if json:
        common.print_json({"results": [data(done) for done in results], **totals})
