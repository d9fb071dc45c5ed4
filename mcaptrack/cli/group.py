"""All commands by name. One is made when it is called: ``mcaptrack --help`` makes none, and shows this table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, MutableMapping
from importlib import import_module
from typing import Any, Final, NamedTuple

import typer
from typer.core import TyperGroup
from typer.main import get_command

from mcaptrack.cli.command import Command, Reading, usage_in_one_line
from mcaptrack.cli.settings import may_be_set

_MAKE, _RUN, _LOOK = "Make a log", "Detect, track, predict", "Look at results"
_MEASURE, _KEEP = "Measure and improve", "Check and repair logs"


class Listed(NamedTuple):
    """A command: its heading and its line in the help, and where in ``mcaptrack.cli`` it is.

    ``place`` is MODULE:NAME, of a function with the options of Typer, or of an object with ``function_of(name)``. A
    command that ``reads`` changes no file except the one that -o names.
    """

    name: str
    panel: str
    summary: str
    place: str
    reads: bool = False


ENTRIES: Final = (
    Listed(
        "ingest",
        _MAKE,
        "Make a log of a video, a folder of images, a ROS bag, an MCAP file, or a label file.",
        "ingest:Ingest",
    ),
    Listed(
        "demo",
        _MAKE,
        "Draw a scene with known ground truth, run everything on it, and compare SORT with re-tracking.",
        "demo:Demo",
    ),
    Listed("run", _RUN, "Run all stages that are missing or out of date, then events, views and tables.", "run:run"),
    Listed(
        "detect",
        _RUN,
        "Detect who differs from the median of the recording, in colour; shadows are removed, groups separated.",
        "stages:StageCommand",
    ),
    Listed("motion", _RUN, "Estimate how the camera moves, from picture to picture.", "stages:StageCommand"),
    Listed("track", _RUN, "Track detections over time.", "stages:StageCommand"),
    Listed("sample", _RUN, "Resample tracks to a fixed rate, in metres on the ground.", "stages:StageCommand"),
    Listed("predict", _RUN, "Predict where tracked people go.", "stages:StageCommand"),
    Listed("retrack", _RUN, "Repair tracks: re-tracking by likelihood.", "stages:StageCommand"),
    Listed(
        "fuse",
        _RUN,
        "Fuse the detections of several cameras with one ground to detections of the whole scene.",
        "fuse:fuse",
    ),
    Listed(
        "models",
        _RUN,
        "List the learned detectors of the catalogue, or fetch the weights of one, once.",
        "models:Models",
    ),
    Listed(
        "info",
        _LOOK,
        "Show the channels of a log, their number of messages, and what was made from what.",
        "show:info",
        reads=True,
    ),
    Listed(
        "view",
        _LOOK,
        "Serve a log to this machine's browser, and print links that open it in Lichtblick and Foxglove.",
        "view:View",
        reads=True,
    ),
    Listed(
        "render",
        _LOOK,
        "Draw boxes, trails and predictions on the video of a log: LOG.mp4, or a GIF.",
        "render:Render",
    ),
    Listed(
        "report",
        _LOOK,
        "Write one page about a log, or several: scores, forecasts, tracks over the scene, identity switches, lineage.",
        "report:Report",
    ),
    Listed(
        "query",
        _LOOK,
        "Query the tables of logs in SQL: where people were, how fast, for how long, and how well they were tracked.",
        "query:Query",
        reads=True,
    ),
    Listed(
        "export",
        _LOOK,
        "Write a log as tables (Parquet), one row per object and frame, as a ROS 2 bag, or for other programs.",
        "show:export",
    ),
    Listed("docs", _LOOK, "List the pages of the documentation, or print one.", "docs:Docs", reads=True),
    Listed("evaluate", _MEASURE, "Score tracks and predictions against ground truth.", "evaluate:Evaluate", reads=True),
    Listed(
        "events",
        _MEASURE,
        "Write events of tracks (begin, end, identity switches) and errors of predictions into the log.",
        "events:events",
    ),
    Listed(
        "zones",
        _MEASURE,
        "Count visits of zones and crossings of lines by the tracks of a log, and write them into the log.",
        "zones:zones",
    ),
    Listed(
        "calibrate",
        _MEASURE,
        "Correct the ground planes of cameras that disagree with the others, by the people that they see together.",
        "calibrate:calibrate",
    ),
    Listed("tune", _MEASURE, "Find the settings of a stage that score best against ground truth.", "tune:Tune"),
    Listed("train", _MEASURE, "Train a predictor on tracks of people, or on synthetic walks.", "train:Train"),
    Listed(
        "check",
        _KEEP,
        "Check every byte of a log: structure, checksums, indexes, statistics, order of messages.",
        "files:check",
        reads=True,
    ),
    Listed(
        "recover",
        _KEEP,
        "Save what is intact in a damaged log to LOG.recovered.mcap; the damaged log stays unchanged.",
        "files:recover",
    ),
    Listed(
        "drop",
        _KEEP,
        "Remove channels from a log, in place or in a copy; all others stay unchanged, to the byte.",
        "files:drop",
    ),
    Listed(
        "doctor",
        _KEEP,
        "Print what this installation has: versions, codecs, memory, folders, plug-ins, and what may be done with "
        "a store.",
        "doctor:Doctor",
        reads=True,
    ),
)
#: Commands with options of plug-ins.
_WITH_PLUGINS: Final = ("run", *(entry.name for entry in ENTRIES if entry.place == "stages:StageCommand"))


def make(entry: Listed, function: Any = None) -> Any:
    """Make a command of Typer of an entry; ``function`` is its function, if it is not the usual one."""
    module, _, name = entry.place.partition(":")
    target = function or getattr(import_module(f"mcaptrack.cli.{module}"), name)
    function = target.function_of(entry.name) if hasattr(target, "function_of") else target
    app = typer.Typer(add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False)
    app.command(
        entry.name,
        cls=Reading if entry.reads else Command,
        help=getattr(function, "help", None),
        context_settings={"help_option_names": ["--help", "-h"]},
        rich_help_panel=entry.panel,
    )(function)
    return get_command(app)


class Commands(MutableMapping[str, Any]):
    """The commands by name; each is made when it is looked up."""

    def __init__(self, changed: Mapping[str, Any] | None = None, commands_made: dict[str, Any] | None = None) -> None:
        self._entries = {entry.name: entry for entry in ENTRIES}
        self._made: dict[str, Any] = {} if commands_made is None else commands_made
        self._changed = changed or {}

    def __getitem__(self, name: str) -> Any:
        if name in self._changed:
            return self._changed[name]
        if name not in self._made:
            self._made[name] = make(self._entries[name])
        return self._made[name]

    def __setitem__(self, name: str, command: Any) -> None:
        self._made[name] = command

    def __delitem__(self, name: str) -> None:
        del self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def changed(self, functions: Mapping[str, Any]) -> Commands:
        """Return a copy of the table, with other functions for some commands."""
        changed = {name: make(self._entries[name], function) for name, function in functions.items()}
        return Commands(changed, self._made)


class Group(TyperGroup):
    """The group of all commands."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes | {"commands": {}})
        self.commands = self._own = Commands()
        self._lists = False

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of all commands, without making them."""
        return list(self.commands)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command; one that shows no more than its line, while the commands are listed."""
        if not self._lists or cmd_name not in self.commands:
            return super().get_command(ctx, cmd_name) if cmd_name in self.commands else None
        entry = next(candidate for candidate in ENTRIES if candidate.name == cmd_name)
        line: Any = typer.core.TyperCommand(entry.name, help=entry.summary, rich_help_panel=entry.panel)
        return line

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help."""
        self._lists = True
        try:
            super().format_help(ctx, formatter)
        finally:
            self._lists = False

    def shell_complete(self, ctx: Any, incomplete: str) -> Any:
        """Complete the name of a command."""
        self._lists = True
        try:
            return super().shell_complete(ctx, incomplete)
        finally:
            self._lists = False

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the options before the command; refuse an unknown one in one line."""
        if not args:
            return super().parse_args(ctx, args)  # which prints the help
        self.commands = self._own.changed(_with_plugins(self._own, args))
        with usage_in_one_line():
            return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command; refuse an unknown one in one line."""
        with usage_in_one_line():
            return super().resolve_command(ctx, args)


def _with_plugins(commands: Commands, arguments: list[str]) -> dict[str, Any]:
    """The functions of commands with options of plug-ins in this call. Where there can be none, nothing is loaded."""
    if not set(arguments) & set(_WITH_PLUGINS) and not may_be_set(arguments):
        return {}
    from mcaptrack.cli.plugins import commands_with_plugins

    return commands_with_plugins(commands, arguments)
