"""``mcaptrack check``, ``recover`` and ``drop``: is a log sound, what of it can be saved, what is left out of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mcaptrack.cli import common
from mcaptrack.cli.text import console, show
from mcaptrack.errors import McaptrackError

if TYPE_CHECKING:
    from mcaptrack.log import CheckResult, Log

_SHOWN = 20


@common.one_line
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
    from mcaptrack import log

    paths = [part for path in common.expand(logs) for part in _parts(path)]
    checked: list[CheckResult] = []
    with common.Talk(quiet, verbose).open() as talk:
        for path in paths:
            with talk.attempt(path, paths):
                checked.append(log.check(path, talk.progress))
    with common.printed_to(output, force):
        if json:
            common.print_json({"results": [_checked_as_data(one) for one in checked]})
        else:
            for one in checked:
                _print_checked(one, quiet)
    if not all(one.is_sound for one in checked):
        raise typer.Exit(common.REFUSED)


def _parts(path: Path) -> list[Path]:
    """A log, and its results if they stand beside it."""
    from mcaptrack import log

    beside = log.results_path(path)
    return [path, beside] if beside != path and beside.exists() else [path]


def _checked_as_data(checked: CheckResult) -> dict[str, object]:
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


def _print_checked(checked: CheckResult, quiet: bool) -> None:
    from rich.table import Table
    from rich.text import Text

    if not quiet:
        verdict = "sound" if checked.is_sound else "damaged"
        show(f"{checked.path}: {verdict}; {checked.messages} messages in {checked.chunks} chunks")
    findings = [found for found in checked.findings if not quiet or found.level == "error"]
    if not findings:
        return
    table = Table(box=None, pad_edge=False)
    for name, justify in (("", "left"), ("byte", "right"), ("times", "right"), ("kind", "left"), ("", "left")):
        table.add_column(name, justify=justify, overflow="fold")  # type: ignore[arg-type]
    for found in findings:
        style = "red" if found.level == "error" else "yellow"
        table.add_row(Text(found.level, style), str(found.where), str(found.times), found.kind, found.words)
    console().print(table)


@common.one_line
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
    from mcaptrack import log
    from mcaptrack.files import is_same_file, refuse_overwrite

    paths = common.expand(logs, each=True)
    common.only_one_output(paths, output)
    reports = []
    with common.Talk(quiet, verbose).open() as talk:
        for path in paths:
            with talk.attempt(path, paths):
                target = output or path.with_suffix(".recovered.mcap")
                if is_same_file(target, path):
                    raise McaptrackError(f"{path} is both input and output; give another name with -o")
                refuse_overwrite(target, force)
                report = log.recover(path, target, talk.progress)
                reports.append(report)
                talk.say(f"{target}: {report.messages} messages in {report.chunks} chunks are saved")
                for words in report.lost if verbose else report.lost[:_SHOWN]:
                    talk.say(f"lost: {words}")
                if len(report.lost) > _SHOWN and not verbose:
                    talk.say(f"lost: {len(report.lost) - _SHOWN} more; -v shows them")
                if not report.lost:
                    talk.say("nothing was lost")
    if json:
        results = [
            {"log": str(r.path), "output": str(r.output), "messages": r.messages, "chunks": r.chunks, "lost": r.lost}
            for r in reports
        ]
        common.print_json({"results": results})
    if any(report.lost for report in reports):
        raise typer.Exit(common.LOST)


@common.one_line
def drop(
    path: Annotated[Path, typer.Argument(metavar="LOG", help="The log.", show_default=False)],
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
    from mcaptrack import log
    from mcaptrack.files import is_same_file, refuse_overwrite
    from mcaptrack.schema.provenance import Provenance
    from mcaptrack.sources.ingest.sidecar import recording_of

    if output is not None:
        refuse_overwrite(output, force)
        if is_same_file(output, path):
            raise McaptrackError(f"{path} is both input and output; leave -o out to change it in place")
    beside = log.results_path(path)
    with common.Talk(quiet, verbose).open() as talk:
        with log.read(path) as opened:
            dropped = _chosen(opened, topics)
            holds = {part.path: [c for c in part.recorded if c.topic in dropped] for part in opened.parts}
            messages = sum(channel.messages for gone in holds.values() for channel in gone)
            before = sum(part.size for part in opened.parts)
            recorded = {c.topic for c in holds[path] if Provenance.from_metadata(c.metadata) is None}
            if recorded and output is None and not in_place and (recording := recording_of(opened)):
                raise McaptrackError(
                    f"{path} is {recording}, which ROS tools read; -o writes a copy without "
                    f"{', '.join(sorted(recorded))}, --in-place changes it all the same"
                )
        targets = {path: output or path, beside: log.results_path(output) if output else beside}
        if output is not None and beside in holds:
            refuse_overwrite(targets[beside], force)
        for part, gone in holds.items():
            if gone or output is not None:
                target = targets[part] if output else None
                with log.read(part, sidecar=False) as opened, log.extend(opened, target, drop={c.topic for c in gone}):
                    pass
        after = sum(targets[part].stat().st_size for part in holds)
        talk.say(
            f"{output or path}: {', '.join(sorted(dropped))} with {messages} messages left out; "
            f"{before} bytes became {after}"
        )
    if json:
        result = {"log": str(output or path), "dropped": sorted(dropped), "messages": messages, "bytes": after}
        common.print_json({"results": [result]})


def _chosen(opened: Log, patterns: list[str]) -> set[str]:
    """The topics that fit any of the patterns, with what only tells of them.

    Raises McaptrackError for a pattern that fits none.
    """
    from fnmatch import fnmatchcase

    from mcaptrack.schema.provenance import Provenance

    chosen: set[str] = set()
    for pattern in patterns:
        found = {topic for topic in opened.channels if topic == pattern or fnmatchcase(topic, pattern)}
        if not found:
            opened.channel(pattern)  # says what there is
        chosen |= found
    made = {topic: Provenance.from_metadata(channel.metadata) for topic, channel in opened.channels.items()}
    for transform in ("events", "view"):  # in this order: events have views
        chosen |= {topic for topic, how in made.items() if how and how.transform == transform and how.input in chosen}
    return chosen
