"""All commands by name. One is made when it is called: ``mcaptrack --help`` makes none, and shows this table."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, MutableMapping
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, NamedTuple

import typer
from typer.core import TyperGroup
from typer.main import get_command

from mcaptrack import _MODULES
from mcaptrack.cli.command import Command, Reading, usage_in_one_line
from mcaptrack.cli.settings import may_be_set

_MAKE, _RUN, _LOOK = "Make a log", "Detect, track, predict", "Look at results"
_MEASURE, _KEEP = "Measure and improve", "Check and repair logs"


class Listed(NamedTuple):
    """A command: its heading in the help, and where in ``mcaptrack.cli`` it is.

    ``place`` is MODULE:NAME, of an object with ``function_of(name)``. A command that ``reads`` changes no file except
    the one that -o names. ``source`` is the module and the name of the function that declares it, if that is not the
    function of the library of its name.
    """

    name: str
    panel: str
    place: str
    reads: bool = False
    source: str = ""

    @property
    def summary(self) -> str:
        """Its line in the help: the first paragraph of the docstring of its function.

        It is read from the source, because an import of all commands takes half a second.
        """
        module, _, name = (self.source or f"{_MODULES[self.name]}:{self.name}").partition(":")
        match = re.search(rf'^def {name}\(.*?"""(.*?)(?:\n\n|""")', _source_of(module), re.MULTILINE | re.DOTALL)
        doc = match[1] if match else (getattr(import_module(module), name).__doc__ or "").partition("\n\n")[0]
        return " ".join(doc.split())


@cache
def _source_of(module: str) -> str:
    """The source of a module; "" if there is none, as in a frozen program."""
    spec = find_spec(module)
    try:
        return Path((spec and spec.origin) or "").read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""


ENTRIES: Final = (
    Listed("ingest", _MAKE, "ingest:Ingest"),
    Listed("demo", _MAKE, "demo:Demo"),
    Listed("run", _RUN, "running:Run"),
    Listed("detect", _RUN, "stages:StageCommand"),
    Listed("motion", _RUN, "stages:StageCommand"),
    Listed("track", _RUN, "stages:StageCommand"),
    Listed("sample", _RUN, "stages:StageCommand"),
    Listed("predict", _RUN, "stages:StageCommand"),
    Listed("retrack", _RUN, "stages:StageCommand"),
    Listed("fuse", _RUN, "running:Fuse"),
    Listed("models", _RUN, "models:Models"),
    Listed("info", _LOOK, "show:Info", reads=True),
    Listed("view", _LOOK, "view:View", reads=True),
    Listed("render", _LOOK, "render:Render"),
    Listed("report", _LOOK, "report:Report"),
    Listed("query", _LOOK, "query:Query", reads=True),
    Listed("export", _LOOK, "show:Export"),
    Listed("docs", _LOOK, "docs:Docs", reads=True, source="mcaptrack.cli.docs:documentation"),
    Listed("evaluate", _MEASURE, "evaluate:Evaluate", reads=True),
    Listed("events", _MEASURE, "running:Events"),
    Listed("zones", _MEASURE, "zones:Zones"),
    Listed("calibrate", _MEASURE, "calibrate:Calibrate"),
    Listed("tune", _MEASURE, "tune:Tune"),
    Listed("train", _MEASURE, "train:Train"),
    Listed("check", _KEEP, "files:Check", reads=True),
    Listed("recover", _KEEP, "files:Recover"),
    Listed("drop", _KEEP, "files:Drop"),
    Listed("doctor", _KEEP, "doctor:Doctor", reads=True),
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
