"""Make the commands of the stages from the parameters of their transforms, of other packages, too."""

from __future__ import annotations

import inspect
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import MISSING, Field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Final, get_type_hints

import typer

from mcaptrack.api.declared import Option, Parameter, parameter_of
from mcaptrack.api.declared import options_of as options_of_function
from mcaptrack.cli import common
from mcaptrack.cli.chosen import Maker, configured, has_flag, options_of, settable_of, tuning_of
from mcaptrack.cli.command import is_option_given, is_stronger, listed, values_of
from mcaptrack.cli.declared import OfAll, command, help_of, parameters_of
from mcaptrack.cli.help import HELP
from mcaptrack.cli.running import RunsStages
from mcaptrack.cli.settings import ConfigFile, read_files
from mcaptrack.cli.text import say, stdout_to_stderr
from mcaptrack.environment import PREFIX
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import listening
from mcaptrack.registry import names, own, titled
from mcaptrack.transforms import STAGES, Stage, Transform
from mcaptrack.transforms.protocol import member_type

if TYPE_CHECKING:
    from mcaptrack import RunResult


#: Arguments of ``run_stage`` that commands have as options.
_WHERE: Final = ("topic", "to", "camera", "output", "sidecar", "force", "mode")


class StageCommand(RunsStages):
    """The command of a stage: declared by its function, with the parameters of its transforms as options.

    ``kinds`` are its transforms by name.
    """

    def __init__(self, name: str, values: Mapping[str, Any], kinds: Mapping[str, type[Transform]]) -> None:
        super().__init__(name, values)
        self.kinds = kinds
        self._transform: Transform | None = None

    @classmethod
    def declaration(cls, name: str) -> Callable[..., RunResult]:
        """Return the function that declares the command: that of a package's stage is made from its class."""
        if not any(STAGES[name].package):
            return super().declaration(name)
        from mcaptrack.api.stages import declaration_of

        return declaration_of(name)

    @property
    def function(self) -> Callable[..., RunResult]:
        """The function, with the transform that ``arguments`` has made."""
        from mcaptrack.api.running import run_stage

        return partial(run_stage, self.name, self._transform)

    def arguments(self, names: Mapping[str, str]) -> dict[str, Any]:
        """Return the arguments of the function, and make the transform, unless the boxes of a log decide which."""
        stage, owners = STAGES[self.name], _owners(self.kinds)
        wanted = {option: self.values[option] for option in owners if self.values.get(option) is not None}
        for option, value in self.values["set"].items():
            if option in wanted and is_option_given(option) and is_option_given("set"):
                raise McaptrackError(f"--set {option} and the option of this name are both given; give one of them")
            if option not in wanted or not is_stronger(option):
                wanted[option] = value
        make = Maker.of(stage, self.values, wanted, owners)
        with stdout_to_stderr():
            is_open = stage.kind == "tracker" and not self.values["tracker"]  # the boxes of a log decide
            self._transform = None if is_open else make()
            arguments: dict[str, Any] = {"stages": configured(), "make": make}
        return arguments | {name: self.values[name] for name in _WHERE if name in names}

    @classmethod
    def function_of(
        cls, name: str, plugins: Mapping[str, type[Transform]] = MappingProxyType({})
    ) -> Callable[..., None]:
        """Return the function of the command, with the options of ``plugins``: transforms of other packages."""
        stage, declared = STAGES[name], cls.declaration(name)
        kinds, own = {**plugins, **stage.built_in()}, options_of_function(declared)
        more = [*_options(stage, kinds), *cls.options(name)]
        flags = Counter(flag for option in (*own, *more, *parameters_of(OfAll)) for flag in _flags(option))
        flags += Counter(["help", "help-all", "logs"])
        if twice := {flag.replace("-", "_") for flag, count in flags.items() if count > 1}:
            owners = " and ".join(plugins) or titled("stage", name, stage.package)
            text = f"{owners} can't have a parameter {' or '.join(sorted(twice))}"
            raise McaptrackError(f"{text}: that is the name of an option of {name}")
        names = {option.name: option.name for option in own}
        flagless = any(not has_flag(field) for kind in kinds.values() for field in options_of(kind).values())
        settable = settable_of(kinds) if flagless else {}
        function: Any = command(
            name, declared, lambda given: cls(name, given, kinds).run(names), more, settable=settable
        )
        function.help = stage_help(stage, help_of(declared), plugins)
        return function  # type: ignore[no-any-return]


def _owners(kinds: Mapping[str, type[Transform]]) -> dict[str, list[str]]:
    """The names of the transforms that have a parameter, by its name."""
    owners: dict[str, list[str]] = {}
    for name, kind in kinds.items():
        for option in options_of(kind):
            owners.setdefault(option, []).append(name)
    return owners


def _options(stage: Stage, kinds: Mapping[str, type[Transform]]) -> Iterator[Parameter]:
    """Yield the options for the transforms of a stage, without the parameters that only ``--set`` sets."""
    for name, having in _owners(kinds).items():
        field = options_of(kinds[having[0]])[name]
        if has_flag(field):
            is_shared = set(stage.built_in()) <= set(having)
            hint = hint_of(kinds[having[0]], field, () if is_shared else having)
            yield parameter_of(name, hint, None)


def stage_help(stage: Stage, text: str, plugins: Mapping[str, type[Transform]] = MappingProxyType({})) -> str:
    """Return the help of the command of a stage: ``text``, and what its transforms do, plug-ins first."""
    text, *examples = text.split("\n\nExample: ")
    built_in = stage.built_in() if stage.kind else {}
    firsts = {name: _own_doc(cls).partition("\n\n")[0] for name, cls in built_in.items()}
    lines = [f"- `{name}`: {' '.join(first.split())}" for name, first in firsts.items() if first]
    others = [f"{name}: {doc}" for name, plugin in plugins.items() if (doc := _own_doc(plugin))]
    others = [re.split(r"\n\n\w+\n---", doc)[0] for doc in others]  # without the sections on use from Python
    return "\n\n".join(filter(None, [text, *others, "\n".join(lines), *(f"Example: {line}" for line in examples)]))


def _own_doc(cls: type[Transform]) -> str:
    """The docstring of a class, unless it is the signature that a dataclass without one gets."""
    text = inspect.cleandoc(cls.__doc__ or "")
    return "" if text.startswith(f"{cls.__name__}(") else text


def _panel(theme: str, of: Sequence[str]) -> str:
    """Return the heading of an option in the help: its theme, and the transforms that have it, if not all do."""
    if not of:
        return theme
    those = listed(of) if len(of) > 1 else f"{of[0]} alone"
    return f"{theme} ({those})" if theme else f"Options of {those}"


def hint_of(kind: type[Transform], field: Field[Any], of: Sequence[str] = ()) -> Any:
    """Return the type of the option for a parameter of a transform. Its value is None unless it is set.

    ``of`` are the names of the transforms that have the parameter; none if all have it.
    """
    (member, is_tuple), about = member_type(get_type_hints(kind)[field.name]), field.metadata
    text = str(about.get("help", "") or f"parameter {field.name} of {' and '.join(of)}")
    option = Option(
        _panel(about.get("theme", ""), of),
        about.get("least", -math.inf),
        about.get("most", math.inf),
        tuning=tuning_of(field, member),
        shown=shown_default(field.default_factory() if field.default_factory is not MISSING else field.default),
        help=f"{text[:1].upper()}{text[1:]}.",
    )
    return Annotated[(Sequence[member] if is_tuple else member) | None, option]  # type: ignore[valid-type]


def shown_default(default: Any) -> str:
    """Return a default as text for the help."""
    if default is None or default in ("", ()):
        return "none"
    if isinstance(default, tuple):
        return " ".join(map(str, default))
    return str(default).lower() if isinstance(default, bool) else f"{default}"


def _flags(option: Parameter) -> set[str]:
    """The names that an option has on the command line, without the dashes."""
    flags = {name.removeprefix("--") for flag in option.flags for name in flag.split("/")}
    return flags | {option.name.replace("_", "-")}


# The options of plug-ins (detectors, trackers and so on of other packages), for the command that uses them.
#
# The command line, the environment and files are searched for names of plug-ins before the command line is parsed. Only
# plug-ins that are named there are imported; and, if a file or the environment sets an option that no built-in
# transform has, all that installed packages declare as entry points.


def commands_with_plugins(commands: Mapping[str, Any], arguments: Sequence[str], config: Path | None) -> dict[str, Any]:
    """Return the commands of stages that have options of plug-ins which this call chooses for them.

    A plug-in on the command line that can't be loaded ends the command with exit code 1.
    """
    called = next((word for word in arguments if not word.startswith("-")), "")
    if called not in commands:
        return {}
    files = [] if set(arguments) & set(HELP) else read_files(config)
    functions: dict[str, Any] = {}
    for stage in STAGES.values():
        if not stage.option:
            continue
        try:
            with stdout_to_stderr(), listening(lambda notice: say(notice.message, "warning")):
                plugins = dict(_of_words(stage, arguments)) if called in (stage.name, "run") else {}
                plugins |= _of_settings(stage, files, commands)
            plugins = {name: cls for name, cls in plugins.items() if cls is not stage.default}
            if plugins:
                functions[stage.name] = StageCommand.function_of(stage.name, plugins)
        except McaptrackError as error:
            say(str(error), "error")
            raise typer.Exit(common.REFUSED) from None
    return functions


def _of_words(stage: Stage, arguments: Sequence[str]) -> Iterator[tuple[str, type[Transform]]]:
    assert stage.option
    for name in filter(None, values_of(arguments, f"--{stage.option}")):  # the parser refuses an empty one
        if stage.split(name)[0] in own(stage.option):
            continue
        with nullcontext() if stage.kind else suppress(McaptrackError):  # a predictor: the command reports the error
            yield name, stage.choose(name)


def _of_settings(stage: Stage, files: Sequence[ConfigFile], commands: Mapping[str, Any]) -> dict[str, type[Transform]]:
    """Return the plug-ins that environment and files name for a stage; the stage that uses it reports a missing one.

    A file in the working folder can't name modules.
    """
    kind = stage.option
    assert kind
    plugin_names = [os.environ.get(f"{PREFIX}{user}_{kind}".upper(), "") for user in (stage.name, "run")]
    options: set[str] = set()
    for file in files:
        for user in (stage.name, "run"):
            table = file.tables.get(user)
            name = table.get(kind) if isinstance(table, dict) else None
            if isinstance(name, str) and (file.trusted or ":" not in name):
                plugin_names.append(name)
        table = file.tables.get(stage.name)
        options |= {key.replace("_", "-") for key in table} if isinstance(table, dict) else set()
    start = f"{PREFIX}{stage.name}_".upper()
    options |= {name.removeprefix(start).lower().replace("_", "-") for name in os.environ if name.startswith(start)}
    if options and options - set(commands[stage.name].settings):
        plugin_names += names(kind)
    out = {}
    for name in dict.fromkeys(plugin_names):
        if name and stage.split(name)[0] not in own(kind):
            with suppress(McaptrackError):
                out[name] = stage.choose(name)
    return out
