"""Make the commands of the stages from the parameters of their transforms."""

from __future__ import annotations

import inspect
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Final, get_type_hints

from mcaptrack.api.declared import Option, Parameter, parameter_of
from mcaptrack.api.declared import options_of as options_of_function
from mcaptrack.cli.chosen import Maker, configured, has_flag, options_of, settable_of, tuning_of
from mcaptrack.cli.command import is_option_given, is_stronger, listed
from mcaptrack.cli.declared import OfAll, command, help_of, parameters_of
from mcaptrack.cli.running import RunsStages
from mcaptrack.cli.text import stdout_to_stderr
from mcaptrack.errors import McaptrackError
from mcaptrack.registry import titled
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
