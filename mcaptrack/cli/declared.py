"""Commands of declared functions (``api.declared``): their options, their help, and calls on each of many logs."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from mcaptrack.api.declared import Parameter, one_of_many, options_of, with_dashes, words_of
from mcaptrack.cli import common

_OF_ALL: dict[str, Any] = {"json": common.Json, "quiet": common.Quiet, "verbose": common.Verbose}


def command(
    name: str,
    declared: Callable[..., Any],
    run: Callable[[Mapping[str, Any]], None],
    more: Mapping[str, Any] | None = None,
) -> Callable[..., None]:
    """Return the function of a command, with the signature of a declared function as Typer takes it.

    ``more`` are options in the place of ``**options``. ``run`` gets the values of all.
    """
    annotations: dict[str, tuple[Any, Any]] = {}
    if each := one_of_many(declared):
        argument = typer.Argument(metavar=each.metavar, help=each.help, show_default=False)
        annotations[each.name] = Annotated[list[Path], argument], inspect.Parameter.empty
    annotations |= {parameter.name: (annotation_of(parameter), parameter.default) for parameter in options_of(declared)}
    annotations |= dict(more or {})
    annotations |= {option: (hint, False) for option, hint in _OF_ALL.items()} | {"config": (common.Config, None)}

    def call(**values: Any) -> None:
        run(values)

    keyword = inspect.Parameter.KEYWORD_ONLY
    call.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [inspect.Parameter(n, keyword, default=default, annotation=hint) for n, (hint, default) in annotations.items()]
    )
    call.__name__, call.__annotations__ = name, {n: hint for n, (hint, _) in annotations.items()}
    function: Any = common.one_line(call)
    function.settable = ()
    function.help, function.most_used = help_of(declared), getattr(declared, "most_used", ())
    return function  # type: ignore[no-any-return]


def annotation_of(parameter: Parameter) -> Any:
    """Return the annotation of an option, as Typer takes it."""
    about = parameter.option
    settings: dict[str, Any] = {"help": parameter.help, "metavar": about.metavar}
    if parameter.shown is not None:
        settings["show_default"] = parameter.shown
    if about.names is not None:
        settings["autocompletion"] = about.names
    info = common.option(
        *parameter.flags,
        panel=about.panel,
        tuning=about.tuning,
        least=about.least,
        most=about.most,
        **settings,
    )
    kind: Any = list[parameter.kind] if parameter.many else parameter.kind  # type: ignore[name-defined]
    return Annotated[kind | None if parameter.default is None else kind, info]


def help_of(declared: Callable[..., Any]) -> str:
    """Return the help of a command: the docstring of its function, with options as the command line writes them."""
    doc = words_of(declared)
    flags = {option.name: option.flags[0] for option in options_of(declared)}
    examples = [f"Example: {line}" for line in doc.examples]
    return "\n\n".join([with_dashes(doc.text, flags), *examples])
