"""All commands by name. One is made when it is called: ``mcaptrack --help`` makes none, and reads their sources."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import lru_cache
from importlib.machinery import PathFinder
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple

import typer
from typer.core import TyperGroup
from typer.main import get_command

from mcaptrack.cli.command import Command, refuse_several, usage_in_one_line, values_of
from mcaptrack.cli.help import ALL, HELP, write_page, write_paragraph, write_section
from mcaptrack.cli.settings import may_be_set, nearest
from mcaptrack.cli.text import log_format, refuse_usage
from mcaptrack.environment import variable
from mcaptrack.errors import command
from mcaptrack.installed import Declared, declared, missing_extension
from mcaptrack.registry import BUILT_IN, Kind, points

#: The headings of commands that declare none: of mcaptrack, and of other packages.
_STEP, _OF_PACKAGES = "One step alone", "Of installed packages"
#: The options of the program, which may stand before the command or after it.
PROGRAM_OPTIONS: Final = ("--config", "--log-format")


class Listed(NamedTuple):
    """A command: the MODULE:NAME of its function, or of the class of a stage; ``package`` is that of a stranger."""

    name: str
    place: str
    kind: Kind = "command"
    package: str = ""

    @property
    def command(self) -> Any:
        """The class of the command (``cli.declared.Called``), which is imported now."""
        if self.kind == "stage" or self.name in BUILT_IN["stage"]:
            from mcaptrack.cli.stages import StageCommand

            return StageCommand
        from mcaptrack.cli.installed import class_of

        return class_of(self.name)

    @property
    def panel(self) -> str:
        """Its heading in the help, which is read from the source."""
        heading = re.search(r'\bheading="([ -~]+?)"', _in_source(self.place).get("declared") or "")
        return heading[1] if heading else _OF_PACKAGES if self.package else _STEP

    @property
    def summary(self) -> str:
        """Its line in the help: the first paragraph of the docstring of its function, and the package.

        It is read from the source, because an import of all commands takes half a second.
        """
        text = _in_source(self.place).get("doc") or ""
        if not (text or self.package):
            text = (self.command.declaration(self.name).__doc__ or "").partition("\n\n")[0]
        line = "".join(character for character in " ".join(text.split()) if character.isprintable())
        if self.package:
            line = f"{line.removesuffix('.')} ({self.package})." if line else f"Of {self.package}."
        return line


def _in_source(reference: str) -> dict[str, str | None]:
    """Read in the source of MODULE:NAME how the function is ``declared``, and its first paragraph; {} if unknown."""
    module, _, name = reference.partition(":")
    pattern = (
        r"^(?:@(?:\w+\.)*declared\((?P<declared>(?:(?!^@|^def ).)*?)\)\n)?"
        rf'(?:def|class) {re.escape(name)}\b(?:(?!\n[^\s)]).)*?:\n\s+r?"""(?P<doc>.*?)(?:\n\n|""")'
    )
    match = re.search(pattern, _source_of(module), re.MULTILINE | re.DOTALL)
    return match.groupdict() if match else {}


def _source_of(module: str) -> str:
    """The source of a module, without importing the packages that it is in; "" if there is none."""
    parts = module.split(".")
    spec = None
    try:
        for number in range(len(parts)):
            places = spec.submodule_search_locations if spec else None
            spec = PathFinder.find_spec(".".join(parts[: number + 1]), places)
        return Path((spec and spec.origin) or "").read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError, ImportError):
        return ""


#: Those with options of plug-ins.
_WITH_PLUGINS: Final = ("run", *BUILT_IN["stage"])


def make(entry: Listed, function: Any = None) -> Any:
    """Make a command of Typer of an entry; ``function`` is its function, if it is not the usual one."""
    function = function or entry.command.function_of(entry.name)
    app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    app.command(
        entry.name,
        cls=Command,
        help=function.help,
        context_settings={"help_option_names": ["--help", "-h"]},
    )(function)
    return get_command(app)


def entries() -> dict[str, Listed]:
    """The commands of mcaptrack by name: those of the core, and of its extensions. Imports none of them."""
    core = [Listed(*each) for each in BUILT_IN["command"].items()]
    return {entry.name: entry for entry in (*core, *_by_entry_point(declared())) if not entry.package}


def of_packages() -> dict[str, Listed]:
    """The commands of other packages by name, and those of their stages. Imports none of them.

    Those with a name of ours, or one that is no word, are left out.
    """
    return {entry.name: entry for entry in _by_entry_point(declared()) if entry.package}


@lru_cache(maxsize=4)
def _by_entry_point(_: Declared) -> list[Listed]:
    """The commands of all packages, extensions among them; kept until something is installed."""
    kinds: tuple[Kind, ...] = ("command", "stage")
    out = []
    for kind in kinds:
        for point in sorted(points(kind), key=lambda point: point.name):
            if re.fullmatch(r"\w[\w-]*", point.name):
                package = "" if point.is_own else " ".join(point.package).strip() or point.value
                out.append(Listed(point.name, point.value, kind, package))
    return out


class Commands(Mapping[str, Any]):
    """The built-in commands by name, and that of a package which is called; each is made when it is looked up."""

    def __init__(self, made: dict[str, Any] | None = None, changed: Mapping[str, Any] | None = None) -> None:
        self._made, self._changed = {} if made is None else made, changed or {}

    def __getitem__(self, name: str) -> Any:
        if name in self._changed:
            return self._changed[name]
        if name not in self._made:
            if name not in (every := entries()):
                raise KeyError(missing_extension(name) or name)
            self._made[name] = make(every[name])
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter({**entries(), **self._changed})

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __contains__(self, name: object) -> bool:
        return name in entries() or name in self._changed

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
        entry = entries().get(cmd_name) or of_packages().get(cmd_name)
        if entry is None:
            return None
        if not self._lists:
            if cmd_name not in self.commands:
                self.commands = self.commands.changed({cmd_name: _made_of_package(entry)})
            return super().get_command(ctx, cmd_name)
        line: Any = typer.core.TyperCommand(cmd_name, help=entry.summary)
        return line

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help: all commands with their lines, without making them."""
        formatter.write_usage(ctx.command_path, "[OPTIONS] COMMAND ...")
        write_paragraph(formatter, self.help or "")
        panels: dict[str, list[tuple[str, str]]] = {}
        for entry in {**entries(), **of_packages()}.values():
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
            path, function = f"{ctx.command_path} {rest[0]}", entries()[rest[0]].command.function_of(rest[0])
            write_page(formatter, path, function, rest[1] == ALL)
            typer.echo(formatter.getvalue().rstrip("\n"))
            ctx.exit()
        functions = _with_plugins(self._own, rest, config)
        self.commands = self._own.changed({name: make(entries()[name], functions[name]) for name in functions})
        with usage_in_one_line():
            for option in PROGRAM_OPTIONS:
                refuse_several(own, [option])
            return super().parse_args(ctx, [*own, *rest])

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command; refuse an unknown one in one line."""
        name = args[0]
        every = self.list_commands(ctx)
        if name not in every and not name.startswith("-") and not ctx.resilient_parsing:  # which completes words
            if Path(name).exists():
                refuse_usage(f"{name} is a file; the command comes first, as in {command('info', Path(name))}")
            if missing := missing_extension(name):
                refuse_usage(missing)
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
    from mcaptrack.cli.stages import commands_with_plugins

    return commands_with_plugins(commands, arguments, config)
