"""The command line. Each command is declared by the function of the library of the same name; it calls it, and prints.

``mcaptrack.__main__`` is the program, and loads this package.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from mcaptrack import __version__
from mcaptrack.cli import text
from mcaptrack.cli.group import Group

app = typer.Typer(
    name="mcaptrack",
    cls=Group,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["--help", "-h"]},
)


def _version(wanted: bool) -> None:
    if wanted:
        text.show(f"mcaptrack {__version__}")
        raise typer.Exit


@app.callback()
def _main(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", is_eager=True, callback=_version, show_default=False)
    ] = False,
    config: Annotated[
        Path | None,
        typer.Option(metavar="FILE", envvar="MCAPTRACK_CONFIG", show_envvar=False, help="Read options from this file."),
    ] = None,
    log_format: Annotated[
        Literal["text", "json"],
        typer.Option(
            metavar="text|json",
            envvar="MCAPTRACK_LOG_FORMAT",
            show_envvar=False,
            help="Print notes and errors as text or as JSON.",
        ),
    ] = "text",
) -> None:
    """Detect and track people in a video or a log, repair the tracks, and predict where people go. Start with
    `mcaptrack demo`, or with `mcaptrack ingest video.mp4` and `mcaptrack run video.mcap`.
    """
