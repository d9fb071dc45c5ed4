"""All commands by name. One is made when it is called: ``mcaptrack --help`` makes none, and shows this table."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, NamedTuple

import typer
from typer.core import TyperGroup
from typer.main import get_command

from mcaptrack import _MODULES
from mcaptrack.cli.command import Command, usage_in_one_line
from mcaptrack.cli.settings import may_be_set

_MAKE, _RUN, _LOOK = "Make a log", "Detect, track, predict", "Look at results"
_MEASURE, _KEEP = "Measure and improve", "Check and repair logs"
_OF_PACKAGES = "Of installed packages"


class Listed(NamedTuple):
    """A command: its heading in the help, and where in ``mcaptrack.cli`` its class is, as MODULE:CLASS."""

    name: str
    panel: str
    place: str

    @property
    def command(self) -> Any:
        """The class of the command (``cli.declared.Called``), which is imported now."""
        module, _, name = self.place.partition(":")
        return getattr(import_module(f"mcaptrack.cli.{module}"), name)

    @property
    def summary(self) -> str:
        """Its line in the help: the first paragraph of the docstring of its function.

        It is read from the source, because an import of all commands takes half a second.
        """
        source = _source_of(_MODULES[self.name]) if self.name in _MODULES else ""
        match = re.search(rf'^def {self.name}\(.*?"""(.*?)(?:\n\n|""")', source, re.MULTILINE | re.DOTALL)
        doc = match[1] if match else (self.command.declaration(self.name).__doc__ or "").partition("\n\n")[0]
        return " ".join(doc.split())


@cache
def _source_of(module: str) -> str:
    """The source of a module; "" if there is none, as in a frozen program."""
    spec = find_spec(module)
    try:
        return Path((spec and spec.origin) or "").read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""


_LISTED: Final = (
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
    Listed("info", _LOOK, "show:Info"),
    Listed("view", _LOOK, "view:ViewCommand"),
    Listed("render", _LOOK, "render:Render"),
    Listed("report", _LOOK, "report:ReportCommand"),
    Listed("query", _LOOK, "query:Query"),
    Listed("export", _LOOK, "show:Export"),
    Listed("docs", _LOOK, "docs:Docs"),
    Listed("evaluate", _MEASURE, "evaluate:Evaluate"),
    Listed("events", _MEASURE, "running:Events"),
    Listed("zones", _MEASURE, "zones:Zones"),
    Listed("calibrate", _MEASURE, "calibrate:Calibrate"),
    Listed("tune", _MEASURE, "tune:Tune"),
    Listed("train", _MEASURE, "train:Train"),
    Listed("check", _KEEP, "files:Check"),
    Listed("recover", _KEEP, "files:Recover"),
    Listed("cut", _KEEP, "files:Cut"),
    Listed("drop", _KEEP, "files:Drop"),
    Listed("doctor", _KEEP, "doctor:Doctor"),
)
#: The commands by name.
ENTRIES: Final = {entry.name: entry for entry in _LISTED}
#: Commands with options of plug-ins.
_WITH_PLUGINS: Final = ("run", *(entry.name for entry in _LISTED if entry.place == "stages:StageCommand"))


def make(entry: Listed, function: Any = None) -> Any:
    """Make a command of Typer of an entry; ``function`` is its function, if it is not the usual one."""
    function = function or entry.command.function_of(entry.name)
    app = typer.Typer(add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False)
    app.command(
        entry.name,
        cls=Command,
        help=function.help,
        context_settings={"help_option_names": ["--help", "-h"]},
        rich_help_panel=entry.panel,
    )(function)
    return get_command(app)


class OfPackage(Listed):
    """A command of an installed package, which is imported when the command is called."""

    @property
    def summary(self) -> str:
        """Its line in the help: the package."""
        return f"Of {self.place}."

    @property
    def command(self) -> Any:
        """The class of the command."""
        from mcaptrack.cli.installed import class_of

        return class_of(self.name)


class StageOfPackage(OfPackage):
    """The command of a stage of an installed package."""

    @property
    def summary(self) -> str:
        """Its line in the help: the package."""
        return f"A stage of {self.place}."

    @property
    def command(self) -> Any:
        """The class of the command."""
        from mcaptrack.cli.stages import StageCommand

        return StageCommand


def of_packages() -> dict[str, Listed]:
    """The commands of installed packages by name, and those of their stages. Imports none of them.

    Those with a name of ours, or one that is no word, are left out.
    """
    from mcaptrack.installed import entry_points

    out: dict[str, Listed] = {}
    for group, kind in (("mcaptrack.commands", OfPackage), ("mcaptrack.stages", StageOfPackage)):
        for point in sorted(entry_points(group), key=lambda point: point.name):
            if _is_free(point.name):
                place = " ".join(point.package).strip() or point.value
                out.setdefault(point.name, kind(point.name, _OF_PACKAGES, place))
    return out


def _is_free(name: str) -> bool:
    return name not in ENTRIES and re.fullmatch(r"\w[\w-]*", name) is not None


class Commands(Mapping[str, Any]):
    """The built-in commands by name, and that of a package which is called; each is made when it is looked up."""

    def __init__(self, made: dict[str, Any] | None = None, changed: Mapping[str, Any] | None = None) -> None:
        self._made, self._changed = {} if made is None else made, changed or {}

    def __getitem__(self, name: str) -> Any:
        if name in self._changed:
            return self._changed[name]
        if name not in self._made:
            self._made[name] = make(ENTRIES[name])
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter({**ENTRIES, **self._changed})

    def __len__(self) -> int:
        return len({**ENTRIES, **self._changed})

    def __contains__(self, name: object) -> bool:
        return name in ENTRIES or name in self._changed

    def changed(self, commands: Mapping[str, Any]) -> Commands:
        """Return a copy of the table, with others in the place of some commands, or with one more."""
        return Commands(self._made, {**self._changed, **commands})


class Group(TyperGroup):
    """The group of all commands."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes | {"commands": {}})
        self._own = Commands()
        self.commands: Any = self._own
        self._lists = False

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of all commands, without making them."""
        return [*self.commands, *of_packages()]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command; one that shows no more than its line, while the commands are listed.

        One of a package that can't be imported ends the program with one line.
        """
        entry = ENTRIES.get(cmd_name) or of_packages().get(cmd_name)
        if entry is None:
            return None
        if not self._lists:
            if cmd_name not in self.commands:
                self.commands = self.commands.changed({cmd_name: _made_of_package(entry)})
            return super().get_command(ctx, cmd_name)
        line: Any = typer.core.TyperCommand(cmd_name, help=entry.summary, rich_help_panel=entry.panel)
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
        functions = _with_plugins(self._own, args)
        self.commands = self._own.changed({name: make(ENTRIES[name], functions[name]) for name in functions})
        with usage_in_one_line():
            return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command; refuse an unknown one in one line."""
        with usage_in_one_line():
            return super().resolve_command(ctx, args)


def _made_of_package(entry: Listed) -> Any:
    """Make a command of a package; what it prints at its import goes to stderr. One that fails is said in one line."""
    from mcaptrack.cli.common import REFUSED
    from mcaptrack.cli.text import say, stdout_to_stderr
    from mcaptrack.errors import McaptrackError
    from mcaptrack.notices import listening

    try:
        with stdout_to_stderr(), listening(lambda notice: say(notice.message, "warning")):
            return make(entry)
    except McaptrackError as error:
        say(str(error), "error")
        raise typer.Exit(REFUSED) from None


def _with_plugins(commands: Commands, arguments: list[str]) -> dict[str, Any]:
    """The functions of commands with options of plug-ins in this call. Where there can be none, nothing is loaded."""
    if not set(arguments) & set(_WITH_PLUGINS) and not may_be_set(arguments):
        return {}
    from mcaptrack.cli.plugins import commands_with_plugins

    return commands_with_plugins(commands, arguments)
