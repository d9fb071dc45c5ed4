"""Make the commands of the stages from the parameters of their transforms."""

from __future__ import annotations

import inspect
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field
from functools import partial
from types import MappingProxyType
from typing import Annotated, Any, Final, get_args, get_type_hints

import mcaptrack
from mcaptrack.api.declared import options_of as options_of_function
from mcaptrack.cli import common
from mcaptrack.cli.chosen import Maker, configured, has_flag, is_open, listed, options_of, values_set
from mcaptrack.cli.command import is_on_command_line
from mcaptrack.cli.declared import annotation_of, command, help_of
from mcaptrack.cli.many import NAMES
from mcaptrack.cli.running import run_on_logs
from mcaptrack.cli.text import stdout_to_stderr
from mcaptrack.errors import McaptrackError
from mcaptrack.registry import BUILT_IN, Kind, names
from mcaptrack.transforms import STAGES, Stage, Transform
from mcaptrack.transforms.protocol import choices, member_type

Topic = Annotated[
    str | None, common.option("--topic", panel=common.FILES, help="Read this channel instead of the default one.")
]
Frame = Annotated[
    str | None, common.option("--frame", panel=common.FILES, help="Bring boxes in space to this frame, such as map.")
]
Set = Annotated[
    list[str] | None,
    common.option(
        "--set",
        tuning=r"[A-Za-z0-9_-]+=[A-Za-z0-9_.,+ -]*",
        metavar="NAME=VALUE",
        help="Set a parameter that has no option of its own, as often as needed; `mcaptrack docs options` lists them.",
        show_default=False,
    ),
]
#: Names that files in the working folder may give: built-in or installed ones, but not ``module:Class``.
_NAME: Final = r"[A-Za-z0-9_-]+"


def chooser(kind: Kind, intro: str = "The {kind} to use", panel: str = "", shown: str | bool = True) -> Any:
    """Return the option that chooses a detector, tracker or so on of the registry by name."""
    built_in = ", ".join(BUILT_IN[kind])
    return common.option(
        f"--{kind}",
        tuning=_NAME,
        panel=panel,
        metavar="NAME",
        help=f"{intro.format(kind=kind)}: {built_in}, one of an installed package, or module:Class.",
        autocompletion=lambda: names(kind),
        show_default=shown,
    )


#: Options that every command has beside those of its function.
RESERVED: Final = (
    "help",
    "logs",
    "json",
    "quiet",
    "verbose",
    "config",
    "log-format",
    *(n.replace("_", "-") for n in NAMES),
)


class StageCommand:
    """The commands of stages: declared by their functions, with the parameters of their transforms as options."""

    @staticmethod
    def function_of(name: str) -> Callable[..., None]:
        """Return the function of the command of a stage."""
        return stage_command(STAGES[name])


def stage_help(stage: Stage, plugins: Mapping[str, type[Transform]] = MappingProxyType({})) -> str:
    """Return the help of the command of a stage: that of its function, and what its transforms do, plug-ins first."""
    text, *examples = help_of(getattr(mcaptrack, stage.name)).split("\n\nExample: ")
    built_in = stage.built_in() if stage.kind else {}
    firsts = {name: inspect.cleandoc(cls.__doc__ or "").partition("\n\n")[0] for name, cls in built_in.items()}
    lines = [f"- `{name}`: {' '.join(first.split())}" for name, first in firsts.items()]
    others = [f"{name}: {doc}" for name, plugin in plugins.items() if (doc := _own_doc(plugin))]
    others = [re.split(r"\n\n\w+\n---", doc)[0] for doc in others]  # without the sections on use from Python
    return "\n\n".join([text, *others, "\n".join(lines), *(f"Example: {line}" for line in examples)])


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


def _option(field: Field[Any], annotation: Any, of: Sequence[str] = ()) -> Any:
    """Return the option for a parameter. Its value is None unless it is set; its help shows the default.

    ``of`` are the names of the transforms that have the parameter; none if all have it.
    """
    (kind, is_tuple), about = member_type(annotation), field.metadata
    flag = "--" + field.name.replace("_", "-")
    switch = f"{flag}/--no-{flag[2:]}" if kind is bool and not is_tuple else flag
    tuning = _NAME if about.get("kind") else about.get("pattern") or bool(choices(kind)) or kind is not str
    text = f"parameter {field.name} of {' and '.join(of)}"
    info = option_of(field, switch, _panel(about.get("theme", ""), of), tuning, text)
    values: Any = list[kind] if is_tuple else kind  # type: ignore[valid-type]
    return Annotated[values | None, info]


def option_of(field: Field[Any], switch: str, panel: str, tuning: Any = True, otherwise: str = "") -> Any:
    """Return the option for a parameter of a transform, with its help, range and default.

    ``otherwise`` is the help of a parameter without any.
    """
    about = field.metadata
    text = str(about.get("help", "") or otherwise)
    default = field.default_factory() if field.default_factory is not MISSING else field.default
    return common.option(
        switch,
        panel=panel,
        tuning=tuning,
        help=f"{text[:1].upper()}{text[1:]}.",
        least=about.get("least", -math.inf),
        most=about.get("most", math.inf),
        show_default=shown_default(default),
    )


def shown_default(default: Any) -> str:
    """Return a default as text for the help."""
    if default is None or default in ("", ()):
        return "none"
    if isinstance(default, tuple):
        return " ".join(map(str, default))
    return str(default).lower() if isinstance(default, bool) else f"{default}"


def _flags(parameter: str, annotation: Any) -> set[str]:
    """The names that an option has on the command line, without the dashes."""
    about = get_args(annotation)[1]
    # Typer takes the first name for a default until it reads the annotation.
    names = (about.default, *(about.param_decls or ()))
    names_given = [part for name in names if isinstance(name, str) for part in name.split("/")]
    return {name.removeprefix("--") for name in (*names_given, parameter.replace("_", "-")) if name}


def stage_command(stage: Stage, plugins: Mapping[str, type[Transform]] = MappingProxyType({})) -> Callable[..., None]:
    """Return the function of a stage's command: the options of its function, and the parameters of its transforms.

    The options of ``plugins``, transforms of other packages, are added.
    """
    declared = getattr(mcaptrack, stage.name)
    kinds = {**plugins, **stage.built_in()}
    own = {name: options_of(kind) for name, kind in kinds.items()}
    owners: dict[str, list[str]] = {}
    for name, options_there in own.items():
        for option in options_there:
            owners.setdefault(option, []).append(name)
    built_in = set(stage.built_in())
    more: dict[str, tuple[Any, Any]] = {}
    for option, having in owners.items():
        if not has_flag(own[having[0]][option]):
            continue
        hint = get_type_hints(kinds[having[0]])[option]
        more[option] = _option(own[having[0]][option], hint, () if built_in <= set(having) else having), None
    if len(more) < len(owners):
        more["set"] = Set, None
    taken = {option.name: annotation_of(option) for option in options_of_function(declared)}
    if stage.kind:
        usual = stage.entry(stage.default).name
        which = chooser(stage.kind, shown=usual if stage.profiles else True)
        # None where a profile may choose the transform.
        taken[stage.kind] = Annotated[str | None, which] if stage.profiles else Annotated[str, which]
    pairs = [*taken.items(), *((option, hint) for option, (hint, _) in more.items())]
    flags = Counter(flag for option, hint in pairs for flag in _flags(option, hint)) + Counter(RESERVED)
    if twice := {flag.replace("-", "_") for flag, count in flags.items() if count > 1}:
        text = f"{' and '.join(plugins)} can't have a parameter {' or '.join(sorted(twice))}"
        raise McaptrackError(f"{text}: that is the name of an option of {stage.name}")
    if stage.kind:
        more[stage.kind] = taken[stage.kind], None if stage.profiles else usual

    def run(values: Mapping[str, Any]) -> None:
        wanted = {option: values[option] for option in owners if values.get(option) is not None}
        for option, value in values_set(stage.name, values.get("set"), kinds).items():
            if option in wanted and is_on_command_line(option):
                raise McaptrackError(f"--set {option} and the option of this name are both given; give one of them")
            wanted[option] = value

        from mcaptrack.api.running import run_stage

        make = Maker.of(stage, values, wanted, owners)
        options: dict[str, Any] = {"topic": values["topic"], "to": values["to"], "frame": values.get("frame")}
        with stdout_to_stderr():
            transform = None if is_open(stage, values) else make("")
            options |= {"stages": configured(), "mode": values["mode"] if stage.modes else None, "make": make}
        run_on_logs(values, stage.name, partial(run_stage, stage.name, transform), options)

    function: Any = command(stage.name, declared, run, more)
    function.help = stage_help(stage, plugins)
    function.settable = tuple(option for option in owners if option not in more)
    return function  # type: ignore[no-any-return]
