"""Read options from the environment and from files, and check them.

The order is: command line, environment, file, default. The file is the one that ``--config`` names, otherwise that of
the working folder and then that of the user.

A file is a mcaptrack.toml, with one table for each command. One that ``--config`` names and that in the user's config
folder may set all options. A file in the working folder may set tuning options only, because it may have come with
other people's data.
"""

from __future__ import annotations

import os
import re
import reprlib
import shlex
import stat
import tomllib
from collections import defaultdict
from collections.abc import Iterable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

import typer

from mcaptrack.api.declared import Option, Parameter
from mcaptrack.choices import limits
from mcaptrack.cli.text import refuse_usage
from mcaptrack.environment import PREFIX, VARIABLES
from mcaptrack.errors import McaptrackError, did_you_mean, similar
from mcaptrack.files import missing, unreadable
from mcaptrack.installed import missing_extension

#: Words for a switch.
SWITCH: Final = dict.fromkeys(("1", "true", "yes", "on"), True) | dict.fromkeys(("0", "false", "no", "off"), False)
_LARGEST: Final = 2**63


class Given(NamedTuple):
    """A value from the environment (``rank`` 1) or from a file (``rank`` 2), and where it was set."""

    value: Any
    where: str
    rank: int


@dataclass(frozen=True)
class Setting:
    """An option of a command: its ``name`` on the command line, its ``parameter`` in Python, and its type."""

    command: str
    name: str
    parameter: str
    kind: Any
    many: bool
    declared: Option

    @property
    def variable(self) -> str:
        """Name of the environment variable."""
        return f"{PREFIX}{self.command}_{self.name}".upper().replace("-", "_")

    def from_text(self, text: str) -> Any:
        """Convert the text of an environment variable. Raises ValueError for a value of the wrong type."""
        if self.many:
            return shlex.split(text)
        if self.kind is not bool:
            return text
        if text.strip().lower() not in SWITCH:
            raise ValueError(f"needs true or false, not {reprlib.repr(text)}")
        return SWITCH[text.strip().lower()]

    def from_toml(self, value: Any) -> Any:
        """Check a value from a file. Raises ValueError for a value of the wrong type."""
        if self.many:
            return [self._one(member) for member in (value if isinstance(value, list) else [value])]
        return self._one(value)

    def _one(self, value: Any) -> Any:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if isinstance(value, int) and abs(value) >= _LARGEST:
            raise ValueError("is too large a number for TOML")
        if self.kind is bool:
            fits, wanted = isinstance(value, bool), "true or false"
        elif self.kind is int:
            fits, wanted = is_number and isinstance(value, int), "a whole number"
        elif self.kind is float:
            fits, wanted = is_number, "a number"
        elif self.kind is str and is_number:  # as in fps = 25
            return str(value)
        else:
            fits, wanted = isinstance(value, str), "text in quotes"
        if not fits:
            raise ValueError(f"needs {wanted}, not {reprlib.repr(value)}")
        return value

    def check(self, value: Any, where: str) -> None:
        """Raise McaptrackError for a number out of range. ``where`` is what set it; "" is the command line."""
        least, most = self.declared.least, self.declared.most
        for number in (value or ()) if self.many else (value,):
            if self.kind in (int, float) and number is not None and not least <= number <= most:
                range_text = limits(least, most) or "a number"
                raise McaptrackError(f"{where or f'--{self.name}'} has to be {range_text}, not {number}")

    def may_tune(self, value: Any) -> bool:
        """Whether a file in the working folder may set this value."""
        pattern = self.declared.tuning
        if not isinstance(pattern, str):
            return pattern
        members = value if self.many else [value]
        return all(re.fullmatch(pattern, str(member)) is not None for member in members)


class HasSettings(Protocol):
    """A command: ``settings`` are its options by name, ``elsewhere`` has other parameters by the flags of options."""

    name: str | None
    settings: dict[str, Setting]
    elsewhere: Mapping[str, Elsewhere]


class Elsewhere(NamedTuple):
    """A parameter without an option: ``--set`` sets it, or Python alone does. ``value`` is what its flag would set."""

    parameter: str
    value: str
    is_set: bool


#: Commands by name. One is made when it is looked up, so only those are that the environment and files name.
Commands = Mapping[str, HasSettings]
#: What is done in place of an option that other commands have.
_INSTEAD: Final = {
    **dict.fromkeys(("--o", "--output"), "`> FILE` at the end of the line writes its text to a file"),
    **dict.fromkeys(("--ledger", "--timeout"), "in Python mcaptrack.fleet.run has it, for any function"),
}
_KNOWN: Final[ContextVar[tuple[Commands, dict[str, dict[str, Given]]]]] = ContextVar("known")


def declared_settings(command: str, parameters: Iterable[Parameter]) -> dict[str, Setting]:
    """Return the options of a command by name."""
    names = ((max(each.flags, key=len).partition("/")[0].lstrip("-"), each) for each in parameters)
    return {name: Setting(command, name, each.name, each.kind, each.many, each.option) for name, each in names}


def may_be_set() -> bool:
    """Whether the environment or a usual file may set options; quick, and never wrongly False."""
    return any(name.startswith(PREFIX) for name in os.environ) or Path(NAME).exists() or user_file().exists()


def gather(commands: Commands, config: Path | None) -> dict[str, dict[str, Given]]:
    """Return the values that environment and files set, by command and option; the strongest source wins.

    An unknown name, a value of the wrong type, and an option that a file may not set end the command with exit code 2.
    """
    values_set: dict[str, dict[str, Given]] = defaultdict(dict)
    for command, setting, set_value in _from_environment(commands):
        values_set[command][setting.name] = set_value
    for file in read_files(config):
        for command, setting, set_value in _from_file(commands, file):
            values_set[command].setdefault(setting.name, set_value)
    _KNOWN.set((commands, values_set))
    return values_set


def _from_environment(commands: Commands) -> Iterable[tuple[str, Setting, Given]]:
    for name, text in os.environ.items():
        if not name.startswith(PREFIX) or name in VARIABLES:
            continue
        command = name.removeprefix(PREFIX).partition("_")[0].lower()
        own = commands[command].settings.values() if command in commands else ()
        setting = next((candidate for candidate in own if candidate.variable == name), None)
        if setting is None and command not in commands and _is_of_package(command):
            continue
        if setting is None:
            is_command = command in commands
            start = f"{PREFIX}{command.upper()}_" if is_command else PREFIX
            variables = [
                each.variable
                for other in ([command] if is_command else commands)
                for each in commands[other].settings.values()
            ]
            tails = {each.removeprefix(PREFIX): each for each in VARIABLES}
            tails |= {each.removeprefix(start): each for each in variables}
            option = name.removeprefix(start).lower()
            missing = missing_extension(command) or missing_extension(option)
            way = other_way(commands[command], option, f"{start}SET=") if is_command else ""
            meant = similar(option, tails)
            hint = missing or way or (f"did you mean {tails[meant]}?" if meant else "")
            refuse_usage(f"the environment variable {name} names no option{f'; {hint}' if hint else ''}")
        if not text:
            continue
        try:
            value = setting.from_text(text)
        except ValueError as error:
            refuse_usage(f"{name}: {error}")
        yield setting.command, setting, Given(value, name, 1)


def _from_file(commands: Commands, file: ConfigFile) -> Iterable[tuple[str, Setting, Given]]:
    for command, values in file.tables.items():
        if command not in commands and _is_of_package(command):
            continue
        if command not in commands:
            refuse_usage(f"{file.path}: there is no command {command}{nearest(command, commands)}")
        if not isinstance(values, dict):
            refuse_usage(f"{file.path}: {command} is a command; write its options below [{command}]")
        own = commands[command].settings
        for key, value in values.items():
            name = key.replace("_", "-")
            if name != key and name in values:
                refuse_usage(f"{file.path}: [{command}] has {key} and {name}; give one of them")
            if name not in own:
                way = other_way(commands[command], name, 'set = ["', f'={value}"]')
                hint = f"; {way}" if way else nearest(name, own)
                refuse_usage(f"{file.path}: {command} has no option {key}{hint}")
            where = f"{file.path}: [{command}] {key}"
            try:
                taken = own[name].from_toml(value)
            except ValueError as error:
                refuse_usage(f"{where} {error}")
            if not file.trusted and not own[name].may_tune(taken):
                refuse_usage(
                    f"{where} = {reprlib.repr(value)}: a {NAME} in the working folder may tune and nothing else; give "
                    f"--{name} or {own[name].variable}, or put it into {user_file()} or a file for --config"
                )
            yield command, own[name], Given(taken, where, 2)


def _is_of_package(command: str) -> bool:
    """Whether a command is of an installed package; it isn't imported to check its options unless it is called."""
    from mcaptrack.registry import others

    return command in (*others("command"), *others("stage"))


def found_of(command: str) -> dict[str, tuple[Setting, Given]]:
    """Return the options of a command that environment and files set, with their values, by parameter."""
    commands, values_set = _KNOWN.get()
    if not values_set.get(command):
        return {}
    settings = commands[command].settings
    return {settings[name].parameter: (settings[name], set_value) for name, set_value in values_set[command].items()}


def other_way(command: HasSettings, name: str, start: str = "--set ", end: str = "") -> str:
    """Return how a parameter of a command is given that has no option there; "" if there is no such parameter.

    ``name`` is that of its flag. Text that sets it begins with ``start``, and its value ends with ``end``.
    """
    flag = f"--{name.lstrip('-').replace('_', '-')}"
    elsewhere = command.elsewhere.get(flag)
    if elsewhere is None:
        return _INSTEAD.get(flag, "")
    if elsewhere.is_set:
        return f"write {start}{elsewhere.parameter}{end or f'={elsewhere.value}'}"
    return f"in Python mcaptrack.{command.name} has it: {elsewhere.parameter}={elsewhere.value}"


def nearest(name: str, names: Iterable[str]) -> str:
    """The end of a message: the extension that a name is of, if it is missing, or a question about the name that is
    meant; "" if none is close.
    """
    hint = missing_extension(name) or did_you_mean(name, names).rstrip()
    return f"; {hint}" if hint else ""


NAME: Final = "mcaptrack.toml"
#: A larger file is refused before it is read.
MAX_BYTES: Final = 2**20
BOM: Final = "\N{ZERO WIDTH NO-BREAK SPACE}"


class ConfigFile(NamedTuple):
    """The tables of one file. Only a ``trusted`` file may set options other than tuning ones."""

    path: Path
    tables: dict[str, Any]
    trusted: bool


def user_file() -> Path:
    """Return the file in the user's config folder: ~/.config/mcaptrack/mcaptrack.toml on Linux."""
    return Path(typer.get_app_dir("mcaptrack")) / NAME


def read_files(named: Path | None) -> list[ConfigFile]:
    """Return the files to use, the strongest first: ``named``, or those of the working folder and of the user.

    A file that can't be read ends the command with exit code 2.
    """
    if named is not None:
        tables = _read(named)
        if tables is None:
            refuse_usage(f"--config: {missing(named)}")
        return [ConfigFile(named, tables, trusted=True)]
    own = user_file()
    candidates = [(Path(NAME), _is_same(Path(NAME), own)), (own, True)]
    if candidates[0][1]:
        del candidates[0]
    return [ConfigFile(path, tables, trusted) for path, trusted in candidates if (tables := _read(path)) is not None]


def _is_same(path: Path, other: Path) -> bool:
    try:
        return path.samefile(other)
    except OSError:
        return False


def _read(path: Path) -> dict[str, Any] | None:
    """Return the tables of a file; None if it does not exist."""
    try:
        content = read_toml(path)
    except McaptrackError as error:
        refuse_usage(str(error))
    return None if content is None else content.tables


class Toml(NamedTuple):
    """A file of TOML: its text, line endings as they are, and its tables."""

    text: str
    tables: dict[str, Any]


def read_toml(path: Path) -> Toml | None:
    """Read a file of options; returns None if it does not exist.

    Raises McaptrackError if it is not a regular file of TOML of at most ``MAX_BYTES``. It is opened without blocking,
    because opening a FIFO would wait for a writer.
    """
    try:
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from None
    try:
        about = os.fstat(handle)
        if not stat.S_ISREG(about.st_mode):
            raise McaptrackError(f"{path} is not a regular file; options are read from a TOML file")
        with open(handle, "rb", closefd=False) as stream:
            data = stream.read(MAX_BYTES + 1)
    except OSError as error:
        raise unreadable(path, error) from None
    finally:
        os.close(handle)
    if len(data) > MAX_BYTES:
        raise McaptrackError(f"{path} has {about.st_size} bytes; a file of options has at most {MAX_BYTES}")
    try:
        text = data.decode("utf-8")
        return Toml(text, tomllib.loads(text.removeprefix(BOM)))
    except RecursionError:
        raise McaptrackError(f"{path} is not valid TOML: it is nested too deeply") from None
    except ValueError as error:
        raise McaptrackError(f"{path} is not valid TOML: {error}") from None
