"""Typer commands. Their options can also be set in the environment and in files."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from typing import Annotated, Any, Final, NamedTuple

import typer
from typer.core import TyperCommand, TyperOption

from mcaptrack.api.declared import Option, Parameter, parameter_of
from mcaptrack.cli.help import ALL, HELP, LAST_PANELS, write_page
from mcaptrack.cli.settings import (
    SWITCH,
    Elsewhere,
    Given,
    Setting,
    declared_settings,
    found_of,
    gather,
    nearest,
    other_way,
)
from mcaptrack.cli.text import RUNNING, refuse_usage, say
from mcaptrack.errors import list_names, similar
from mcaptrack.installed import missing_extension
from mcaptrack.notices import warn

#: The exception of Typer for a command line that it can't parse.
_UsageError: Final[Any] = typer.BadParameter.__bases__[0]


#: What a value should be, by pydantic's name of the error.
_NOT: Final = {
    "float_parsing": "a number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "bool_parsing": "true or false",
}


@contextmanager
def usage_in_one_line(command: str = "") -> Iterator[None]:
    """Refuse a wrong command line with one line of text instead of Typer's box."""
    try:
        yield
    except _UsageError as error:
        error.message = _message(error)
        text = " ".join(error.format_message().rstrip(".").split())
        if hasattr(error, "possibilities"):
            text = _unknown_option(error)
        page = f"mcaptrack {command} {ALL}" if command else "mcaptrack --help"
        end = "" if text.endswith("?") else ";"
        refuse_usage(f"{text[:1].lower()}{text[1:]}{end} `{page}` lists the {'options' if command else 'commands'}")


def _message(error: Any) -> str:
    """Return the message of an error; for errors of pydantic a shorter one."""
    for fault in error.__cause__.errors() if hasattr(error.__cause__, "errors") else ():
        if fault["type"] in _NOT:
            return f"{fault['input']!r} is not {_NOT[fault['type']]}"
    message = str(error.message).replace("Value error, ", "")
    if choice := re.match(r"'(.+)' is not one of (.+)", message):
        message = message.rstrip(".") + nearest(choice[1], re.findall(r"'(.+?)'", choice[2]))
    return re.sub(r"Got unexpected extra argument(?:s|\(s\))? \((.*)\)", r"too many arguments: \1", message)


def _unknown_option(error: Any) -> str:
    """Return the message about an unknown option: which commands have it, and which option may be meant."""
    name, context = error.option_name, error.ctx
    if missing := missing_extension(name.removeprefix("--").removeprefix("no-")):
        return missing
    text = f"no such option: {name}"
    if context is None or context.parent is None:
        return f"{text}{nearest(name, error.possibilities or ())}"
    theirs = {command: _options_of(command_class) for command, command_class in context.parent.command.commands.items()}
    if having := [command for command, options in theirs.items() if name in options]:
        text += f" ({list_names(having, 5)} {'has' if len(having) == 1 else 'have'} it)"
    own_options = theirs.get(context.info_name, [])
    begin = f"--{name.removeprefix('--').replace('_', '-')}-"
    if len(alike := [option for option in own_options if option.startswith(begin)]) > 1:
        return f"{text}; did you mean {' or '.join(alike)}?"
    if way := other_way(context.command, name):
        return f"{text}; {way}"
    meant = similar(name, own_options, 0.75)
    return f"{text}; did you mean {meant}?" if meant else text


def _options_of(command: Any) -> list[str]:
    return [name for option in command.params if not getattr(option, "hidden", False) for name in option.opts]


class Command(TyperCommand):
    """A command. ``settings`` has its options by name."""

    def __init__(self, name: str, **arguments: Any) -> None:
        super().__init__(name, **arguments)
        function = arguments["callback"]
        self.parameters: tuple[Parameter, ...] = function.parameters
        self.settings: dict[str, Setting] = declared_settings(name, self.parameters)
        self.most_used: tuple[str, ...] = function.most_used
        self.elsewhere: Mapping[str, Elsewhere] = function.elsewhere
        self.settable: Mapping[str, Settable] = function.settable
        self.set_parameters: list[Parameter] = function.set_parameters
        self._function = function
        self._help_all: Any = None
        for parameter in self.params:
            every: Any = parameter
            every.process_value = _refusing_empty(every.process_value)

    def get_help_option(self, ctx: Any) -> Any:
        """Put ``--help`` below the heading of the options that all commands have."""
        option = super().get_help_option(ctx)
        if option is not None:
            option.rich_help_panel = LAST_PANELS[-1]
        return option

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters, with ``--help-all``."""
        if self._help_all is None:
            self._help_all = copy(self.get_help_option(ctx))
            self._help_all.name, self._help_all.opts, self._help_all.callback = "help_all", [ALL], _show_all
        return [*super().get_params(ctx), self._help_all]

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help: with ``--help-all`` all of it."""
        write_page(formatter, ctx.command_path, self._function, bool(ctx.meta.get(ALL)))

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line; whatever is wrong with it ends the command in one line.

        The values of environment and files are the defaults.
        """
        args_before = list(args)  # parsing may take words away
        if ctx.parent is not None and not ctx.resilient_parsing and not {*args} & {*HELP}:
            gather(ctx.parent.command.commands, ctx.parent.params["config"])
            ctx.default_map = converted(ctx, ctx.info_name or "")
        with usage_in_one_line(self.name or ""):
            left = super().parse_args(ctx, args)
        for option in self.params:
            if isinstance(option, TyperOption) and not option.multiple and not option.is_flag:
                refuse_several(args_before, option.opts)
        return left

    def invoke(self, ctx: Any) -> Any:
        """Run the command; with --verbose first list the options that differ from the defaults, and their sources."""
        RUNNING.set(ctx)
        if ctx.params.get("verbose") and not ctx.params.get("quiet"):
            say(self._options_in_use(ctx))
        return super().invoke(ctx)

    def _options_in_use(self, ctx: Any) -> str:
        set_values = found_of(self.name or "")
        parts = []
        for setting in self.settings.values():
            rank, where = _rank(ctx, setting.parameter, set_values)
            if rank != _DEFAULT and setting.parameter in ctx.params:
                value = ctx.params[setting.parameter]
                text = " ".join(map(str, value)) if setting.many else str(value)
                parts.append(f"{setting.name}={text} ({where or 'command line'})")
        return f"options: {', '.join(parts)}"


def _show_all(ctx: Any, _: Any, is_asked: bool) -> None:
    if is_asked and not ctx.resilient_parsing:
        ctx.meta[ALL] = True
        typer.echo(ctx.get_help(), color=ctx.color)
        ctx.exit()


def _refusing_empty(process: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Return ``process_value`` of a parameter, which refuses empty text: as a path it would be the working folder."""

    def processed(ctx: Any, value: Any) -> Any:
        if "" in (value if isinstance(value, list | tuple) else [value]):
            raise typer.BadParameter("it is empty, as a variable that is not set; give a value, or leave it out")
        return process(ctx, value)

    return processed


def refuse_several(args: Sequence[str], options: Sequence[str]) -> None:
    """Refuse several values of an option that takes one: the last would count, and the others be ignored."""
    names = {value: None for option in options for value in values_of(args, option)}
    if len(names) > 1:
        refuse_usage(f"{options[0]} is given as {' and as '.join(names)}; give one")


def values_of(args: Sequence[str], option: str) -> Iterator[str]:
    """Yield the values of an option on a command line that may be wrong."""
    for number, word in enumerate(args):
        if word == "--":
            return
        if word == option:
            yield "".join(args[number + 1 : number + 2])
        elif word.startswith(f"{option}="):
            yield word.partition("=")[2]
        elif word.startswith(option) and not option.startswith("--"):
            yield word.removeprefix(option)


_DEFAULT: Final = 3


def _rank(ctx: Any, parameter: str, set_values: Mapping[str, tuple[Setting, Given]]) -> tuple[int, str]:
    """Return the rank of the source of a value (0, the command line, is the strongest), and its description."""
    source = ctx.get_parameter_source(parameter)
    if source is None or source.name == "DEFAULT":
        return _DEFAULT, ""
    if source.name == "DEFAULT_MAP":
        return set_values[parameter][1].rank, set_values[parameter][1].where
    return (1, "the environment") if source.name == "ENVIRONMENT" else (0, "")


def converted(context: Any, command: str) -> dict[str, Any]:
    """Return the values that environment and files set for a command, by parameter, converted by Typer.

    A value that the option refuses ends the command with exit code 2.
    """
    parameters = {parameter.name: parameter for parameter in context.parent.command.commands[command].params}
    out = {}
    for name, (_, set_value) in found_of(command).items():
        try:
            out[name] = parameters[name].process_value(context, set_value.value)
        except typer.BadParameter as error:
            refuse_usage(f"{set_value.where}: {_message(error)}")
    return out


def settings_of(command: str) -> dict[str, Any]:
    """Return the values that environment and files set for another command (a stage that the running one runs).

    Those of ``set`` are values by parameter.
    """
    context: Any = RUNNING.get()
    if not (set_values := found_of(command)):
        return {}
    values = converted(context, command)
    other: Command = context.parent.command.commands[command]
    for setting in other.settings.values():
        place = set_values[setting.parameter][1].where if setting.parameter in set_values else ""
        setting.check(values.get(setting.parameter), place)
    if not values.get("set"):
        return values
    texts = values_set(command, values["set"], other.settable)
    for name in [each.name for each in other.set_parameters if each.name in texts and context.info_name == "run"]:
        warn(f"{set_values['set'][1].where}: `mcaptrack {command}` alone has {name}; run ignores it", "option-not-used")
    rank = set_values["set"][1].rank
    return values | {"set": {n: texts[n] for n in texts if n not in set_values or set_values[n][1].rank >= rank}}


def check_ranges(values: Mapping[str, Any]) -> None:
    """Raise McaptrackError for an option of the running command with a number out of range."""
    context: Any = RUNNING.get()
    if context is None:  # the function was called without a command line
        return
    set_values = found_of(context.info_name)
    for setting in context.command.settings.values():
        setting.check(values.get(setting.parameter), _rank(context, setting.parameter, set_values)[1])


def is_on_command_line(parameter: str) -> bool:
    """Whether a parameter of the running command was given on its command line: by its option, or by ``--set``."""
    if is_option_given(parameter):
        return True
    texts = (RUNNING.get().params["set"] or ()) if is_option_given("set") else ()
    return parameter in (_parameter_of(text.partition("=")[0]) for text in texts)


def is_option_given(parameter: str) -> bool:
    """Whether an option of the running command was given on its command line."""
    context = RUNNING.get()
    source = context.get_parameter_source(parameter) if context is not None else None
    return source is not None and source.name == "COMMANDLINE"


def is_stronger(parameter: str) -> bool:
    """Whether a stronger source gave a parameter of the running command than ``--set``."""
    context: Any = RUNNING.get()
    set_values = found_of(context.info_name)
    return _rank(context, parameter, set_values)[0] < _rank(context, "set", set_values)[0]


# Parameters without an option of their own.


def set_option(settable: Mapping[str, Settable]) -> Parameter:
    """Return the option ``--set``. A file in the working folder may set by it what it may set by other options."""
    tuned = {name.replace("_", "[_-]"): about.tuning for name, about in settable.items() if about.tuning}
    patterns = (f"{name}=({_TUNED if tuning is True else tuning})" for name, tuning in tuned.items())
    option = Option(
        tuning="|".join(patterns),
        metavar="NAME=VALUE",
        shown=False,
        help="Set a parameter that has no option of its own, as often as needed; `mcaptrack docs options` lists them.",
    )
    return parameter_of("set", Annotated[Sequence[str] | None, option], None)


#: Numbers, names and switches, as text.
_TUNED: Final = r"[A-Za-z0-9_.,+ -]*"
_KIND_WORDS: Final = {bool: "true or false", int: "a whole number", float: "a number"}


class Settable(NamedTuple):
    """A parameter that ``--set`` sets: the type of one value, whether it may have several, and be None, and who may set
    it (``Option.tuning``).
    """

    kind: Any
    many: bool = False
    may_be_none: bool = True
    tuning: bool | str = False

    def read(self, value: str) -> Any:
        """The value that a text gives. Raises ValueError that says what it should be."""
        if self.may_be_none and value.lower() == "none":
            return None
        try:
            members = [self._one(member.strip()) for member in (value.split(",") if self.many else [value])]
        except (KeyError, ValueError):
            raise ValueError(_KIND_WORDS[self.kind]) from None
        return tuple(members) if self.many else members[0]

    def _one(self, value: str) -> Any:
        if self.kind is bool:
            return SWITCH[value.lower()]
        return self.kind(value) if self.kind in (int, float) else value


def values_set(command: str, texts: Sequence[str] | None, parameters: Mapping[str, Settable]) -> dict[str, Any]:
    """Return the values of ``--set name=value`` by parameter.

    A text without a value, an unknown parameter, or a value that isn't of its type ends the command with exit code 2;
    the line says where the text was set.
    """
    in_file = found_of(command).get("set")
    where = f"{in_file[1].where}:" if in_file and not is_on_command_line("set") else "--set"
    values: dict[str, Any] = {}
    for text in texts or ():
        written, equals, value = text.partition("=")
        name = _parameter_of(written)
        if not equals or not name:
            refuse_usage(f"{where} needs name=value, as in --set {name or 'name'}=0.5, not {text!r}")
        if name not in parameters:
            hint = nearest(name, parameters) or f"; there are {listed(sorted(parameters))}"
            refuse_usage(f"{where} {text}: there is no parameter {name}{hint}")
        if name in values:
            refuse_usage(f"{where} gives {name} twice")
        try:
            values[name] = parameters[name].read(value.strip())
        except ValueError as error:
            refuse_usage(f"{where} {text}: {value.strip()!r} is not {error}")
    return values


def _parameter_of(written: str) -> str:
    """Return the parameter that a text for ``--set`` names."""
    return written.strip().lstrip("-").replace("-", "_")


def listed(names: Sequence[str]) -> str:
    """Return names in words: "a, b and c"."""
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
