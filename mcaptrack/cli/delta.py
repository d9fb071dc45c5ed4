"""``mcaptrack delta``: list Delta tables of many logs, remove logs from them, tidy them up."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mcaptrack.cli import common
from mcaptrack.cli.text import console, stdout_to_stderr

if TYPE_CHECKING:
    from mcaptrack import DeltaState

_CHANGE = "Change"


@common.one_line
def delta(
    location: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER", help="Folder or URL that logs were exported to with --delta.", show_default=False
        ),
    ],
    remove: Annotated[
        list[str] | None,
        common.option(
            "--remove",
            panel=_CHANGE,
            metavar="NAME",
            help="Remove this log, by its name in the column recording, or those that a pattern matches.",
            show_default=False,
        ),
    ] = None,
    compact: Annotated[
        bool, common.option("--compact", panel=_CHANGE, help="Join small files, so that queries open fewer.")
    ] = False,
    keep_days: Annotated[
        float | None,
        common.option(
            "--keep-days",
            panel=_CHANGE,
            least=1,
            most=36500,
            help="Delete files that no version of the last days needs; earlier versions can't be read any more.",
            show_default="all files stay",
        ),
    ] = None,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """List the Delta tables that logs were exported to; remove logs from them, and tidy their files up.

    Changes are transactions: others may read and write the tables meanwhile, and older versions stay as they were until
    --keep-days deletes their files. Logs are added by `mcaptrack export --delta`. `mcaptrack docs tables` says more.

    Example: mcaptrack delta lake/

    Example: mcaptrack delta lake/ --remove 'night-*' --compact --keep-days 30
    """
    import mcaptrack

    with common.Talk(quiet, verbose).open() as talk:
        with stdout_to_stderr():
            done = mcaptrack.delta(location, remove=remove, compact=compact, keep_days=keep_days)
        if done.removed:
            talk.say(f"{len(done.removed)} log{'s' if len(done.removed) > 1 else ''} removed")
            talk.detail(f"removed: {', '.join(done.removed)}")
        for name, (before, after) in done.compacted.items():
            talk.say(f"{name}: {before} files became {after}")
        if keep_days is not None:
            talk.say(f"{done.deleted} files of older versions deleted")
    if json:
        common.print_json(
            {
                "location": str(done.location),
                "removed": list(done.removed),
                "compacted": {name: list(counts) for name, counts in done.compacted.items()},
                "deleted": done.deleted,
                "results": [asdict(one) for one in done.tables],
            }
        )
    else:
        _print(done)


def _print(done: DeltaState) -> None:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for number, name in enumerate(("table", "version", "rows", "files", "MB")):
        table.add_column(name, justify="right" if number else "left", overflow="fold")
    for one in done.tables:
        table.add_row(one.name, str(one.version), str(one.rows), str(one.files), f"{one.bytes / 1e6:.2f}")
    console().print(table)
