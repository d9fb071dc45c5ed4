"""The command line. Each command parses its options, calls the function of the library of the same name, and prints.

``mcaptrack.__main__`` is the program, and loads this package.
"""

from __future__ import annotations

from typing import Annotated

import typer

from mcaptrack import __version__
from mcaptrack.cli.calibrate import calibrate
from mcaptrack.cli.command import Group
from mcaptrack.cli.common import register
from mcaptrack.cli.demo import demo
from mcaptrack.cli.docs import docs
from mcaptrack.cli.doctor import doctor
from mcaptrack.cli.evaluate import evaluate
from mcaptrack.cli.events import events
from mcaptrack.cli.files import check, drop, recover
from mcaptrack.cli.fuse import fuse
from mcaptrack.cli.ingest import ingest
from mcaptrack.cli.models import models
from mcaptrack.cli.query import query
from mcaptrack.cli.render import render
from mcaptrack.cli.report import report
from mcaptrack.cli.run import run
from mcaptrack.cli.show import export, info
from mcaptrack.cli.stages import add_stages
from mcaptrack.cli.text import show
from mcaptrack.cli.train import train
from mcaptrack.cli.tune import tune
from mcaptrack.cli.view import view
from mcaptrack.cli.zones import zones

app = typer.Typer(
    name="mcaptrack",
    cls=Group,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["--help", "-h"]},
)


def _version(wanted: bool) -> None:
    if wanted:
        show(f"mcaptrack {__version__}")
        raise typer.Exit


@app.callback()
def _main(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", is_eager=True, callback=_version, show_default=False)
    ] = False,
) -> None:
    """Detect and track people in a video or a log, repair the tracks, predict where people go, and write the results
    into the log.

    Start with `mcaptrack demo`, or with `mcaptrack ingest video.mp4` and `mcaptrack run video.mcap`.
    """


_MAKE, _RUN, _LOOK = "Make a log", "Detect, track, predict", "Look at results"
_MEASURE, _KEEP = "Measure and improve", "Check and repair logs"
register(app, _MAKE, "ingest", ingest)
register(app, _MAKE, "demo", demo)
register(app, _RUN, "run", run)
add_stages(app, _RUN)
register(app, _RUN, "fuse", fuse)
register(app, _RUN, "models", models)
register(app, _LOOK, "info", info, reads=True)
register(app, _LOOK, "view", view, reads=True)
register(app, _LOOK, "render", render)
register(app, _LOOK, "report", report)
register(app, _LOOK, "query", query, reads=True)
register(app, _LOOK, "export", export)
register(app, _LOOK, "docs", docs, reads=True)
register(app, _MEASURE, "evaluate", evaluate, reads=True)
register(app, _MEASURE, "events", events)
register(app, _MEASURE, "zones", zones)
register(app, _MEASURE, "calibrate", calibrate)
register(app, _MEASURE, "tune", tune)
register(app, _MEASURE, "train", train)
register(app, _KEEP, "check", check, reads=True)
register(app, _KEEP, "recover", recover)
register(app, _KEEP, "drop", drop)
register(app, _KEEP, "doctor", doctor, reads=True)
