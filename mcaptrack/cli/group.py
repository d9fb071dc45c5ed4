"""All commands by name. One is made when it is called: ``mcaptrack --help`` makes none, and shows this table."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple

import typer
from typer.core import TyperGroup
from typer.main import get_command

from mcaptrack import _MODULES
from mcaptrack.cli.command import Command, refuse_several, usage_in_one_line, values_of
from mcaptrack.cli.help import ALL, HELP, write_page, write_paragraph, write_section
from mcaptrack.cli.settings import may_be_set, nearest
from mcaptrack.cli.text import log_format, refuse_usage
from mcaptrack.environment import variable
from mcaptrack.errors import command

_FIRST, _STEP, _RESULTS, _IMPROVE = "Start here", "One step alone", "Results", "Improve and repair"
_OF_PACKAGES = "Of installed packages"
#: The options of the program, which may stand before the command or after it.
PROGRAM_OPTIONS: Final = ("--config", "--log-format")


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
    Listed("demo", _FIRST, "demo:Demo"),
    Listed("ingest", _FIRST, "ingest:Ingest"),
    Listed("run", _FIRST, "running:Run"),
    Listed("view", _FIRST, "view:ViewCommand"),
    Listed("info", _FIRST, "show:Info"),
    Listed("report", _FIRST, "report:ReportCommand"),
    Listed("detect", _STEP, "stages:StageCommand"),
    Listed("motion", _STEP, "stages:StageCommand"),
    Listed("track", _STEP, "stages:StageCommand"),
    Listed("sample", _STEP, "stages:StageCommand"),
    Listed("predict", _STEP, "stages:StageCommand"),
    Listed("retrack", _STEP, "stages:StageCommand"),
    Listed("fuse", _STEP, "running:Fuse"),
    Listed("models", _STEP, "models:Models"),
    Listed("render", _RESULTS, "render:Render"),
    Listed("query", _RESULTS, "query:Query"),
    Listed("export", _RESULTS, "show:Export"),
    Listed("cut", _RESULTS, "files:Cut"),
    Listed("evaluate", _RESULTS, "evaluate:Evaluate"),
    Listed("events", _RESULTS, "running:Events"),
    Listed("zones", _RESULTS, "zones:Zones"),
    Listed("tune", _IMPROVE, "tune:Tune"),
    Listed("train", _IMPROVE, "train:Train"),
    Listed("calibrate", _IMPROVE, "calibrate:Calibrate"),
    Listed("check", _IMPROVE, "files:Check"),
    Listed("recover", _IMPROVE, "files:Recover"),
    Listed("drop", _IMPROVE, "files:Drop"),
    Listed("doctor", _IMPROVE, "doctor:Doctor"),
    Listed("docs", _IMPROVE, "docs:Docs"),
)
#: The commands by name.
ENTRIES: Final = {entry.name: entry for entry in _LISTED}
#: Commands with options of plug-ins.
_WITH_PLUGINS: Final = ("run", *(entry.name for entry in _LISTED if entry.place == "stages:StageCommand"))


def make(entry: Listed, function: Any = None) -> Any:
    """Make a command of Typer of an entry; ``function`` is its function, if it is not the usual one."""
    function = function or entry.command.function_of(entry.name)
    app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
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
        """Print the help: all commands with their lines, without making them."""
        formatter.write_usage(ctx.command_path, "[OPTIONS] COMMAND ...")
        write_paragraph(formatter, self.help or "")
        panels: dict[str, list[tuple[str, str]]] = {}
        for entry in {**ENTRIES, **of_packages()}.values():
            panels.setdefault(entry.panel, []).append((entry.name, entry.summary))
        for panel, rows in panels.items():
            write_section(formatter, panel, rows)
        own: list[Any] = [option for option in self.get_params(ctx) if option.opts[0] in PROGRAM_OPTIONS]
        rows = [(f"{option.opts[0]} {option.metavar}", option.help) for option in own]
        write_section(formatter, "Options", [*rows, ("-h, --help, --version", "Show this page, or the version.")])

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
        own, rest = _split(args)
        config = Path(named) if (named := next(values_of(own, "--config"), variable("MCAPTRACK_CONFIG"))) else None
        said = next(values_of(own, "--log-format"), variable("MCAPTRACK_LOG_FORMAT"))
        ctx.with_resource(log_format(said, next((word for word in rest if not word.startswith("-")), "")))
        if len(rest) == 2 and rest[1] in HELP and rest[0] in self._own:
            formatter = ctx.make_formatter()
            path, function = f"{ctx.command_path} {rest[0]}", ENTRIES[rest[0]].command.function_of(rest[0])
            write_page(formatter, path, function, rest[1] == ALL)
            typer.echo(formatter.getvalue().rstrip("\n"))
            ctx.exit()
        functions = _with_plugins(self._own, rest, config)
        self.commands = self._own.changed({name: make(ENTRIES[name], functions[name]) for name in functions})
        with usage_in_one_line():
            for option in PROGRAM_OPTIONS:
                refuse_several(own, [option])
            return super().parse_args(ctx, [*own, *rest])

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command; refuse an unknown one in one line."""
        name = args[0]
        every = self.list_commands(ctx)
        if name not in every and not name.startswith("-"):
            if Path(name).exists():
                refuse_usage(f"{name} is a file; the command comes first, as in {command('info', Path(name))}")
            text = f"there is no command {name}{nearest(name, every)}"
            refuse_usage(f"{text}{'' if text.endswith('?') else ';'} `mcaptrack --help` lists the commands")
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


def _split(args: list[str]) -> tuple[list[str], list[str]]:
    """The words of the options of the program, which may stand anywhere, and the others."""
    own: list[str] = []
    others: list[str] = []
    words = iter(args)
    for word in words:
        if word == "--":
            others += [word, *words]
        elif word in PROGRAM_OPTIONS:
            value = [*islice(words, 1)]
            if not value:
                return [word], []  # which is refused: it has no value
            own += [word, *value]
        else:
            (own if word.partition("=")[0] in PROGRAM_OPTIONS else others).append(word)
    return own, others


def _with_plugins(commands: Commands, arguments: list[str], config: Path | None) -> dict[str, Any]:
    """The functions of commands with options of plug-ins in this call. Where there can be none, nothing is loaded."""
    if not (set(arguments) & set(_WITH_PLUGINS) or config or may_be_set()):
        return {}
    from mcaptrack.cli.plugins import commands_with_plugins

    return commands_with_plugins(commands, arguments, config)
