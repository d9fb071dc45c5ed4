"""Declare a command once: a function of the library, from which the command line and the documentation follow.

The signature says what there is: names, types, defaults. The docstring says what it means: the first paragraph of a
parameter is its help, and ``; by default X.`` at its end is the default that the help shows. ``Annotated`` adds what
neither can say: the range of a number, the heading in the help, who may set it (``Option``). This module imports
nothing heavy, so that ``--help`` stays quick; a declared function imports what it needs in its body. The decorator
that checks arguments by all this is ``checked.declared``.
"""

from __future__ import annotations

import inspect
import math
import os
import re
import types
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints


@dataclass(frozen=True)
class Option:
    """Facts about a parameter that is an option of a command, too, for its annotation; all are optional.

    Attributes
    ----------
    panel : str
        The heading in the help.
    least, most : float
        The range of a number, or of each of several.
    tuning : bool or str
        Whether a mcaptrack.toml in the working folder may set it (docs/options.md): numbers, choices and switches that
        change how results are computed. For text, a pattern that the whole value has to match.
    flag, short : str
        The name on the command line without dashes, if it is not the parameter's ("in/out" for a switch), and a letter.
    metavar, shown : str
        What the help shows in place of the type, and of the default.
    names : callable or None
        Returns the values to complete.
    """

    panel: str = ""
    least: float = -math.inf
    most: float = math.inf
    _: KW_ONLY
    tuning: bool | str = False
    flag: str = ""
    short: str = ""
    metavar: str | None = None
    shown: str | bool | None = None
    names: Callable[[], Sequence[str]] | None = None

    @property
    def is_bounded(self) -> bool:
        """Whether a number has a range."""
        return self.least > -math.inf or self.most < math.inf


@dataclass(frozen=True)
class OneOfMany:
    """A path that the function takes one of, and the command many: each gets a call of its own, in worker processes.

    ``name`` is that of the argument of the command, ``metavar`` and ``help`` are what its help shows.
    """

    name: str
    metavar: str
    help: str


#: For a parameter that is no option: ``Annotated[..., PYTHON_ONLY]``.
PYTHON_ONLY: Final = object()


class Words(NamedTuple):
    """The parts of a docstring: text, parameters with their text by paragraphs, and lines that call the command."""

    text: str
    parameters: dict[str, list[str]]
    examples: list[str]


class Parameter(NamedTuple):
    """A parameter as an option: its type there, its names, its help, and the default that the help shows."""

    name: str
    kind: Any
    many: bool
    flags: tuple[str, ...]
    default: Any
    option: Option
    help: str
    shown: str | bool | None


@cache
def hints_of(function: Callable[..., Any]) -> dict[str, Any]:
    """The annotations of the parameters. That of the result is left out: type checkers alone may know it."""
    function = inspect.unwrap(function)
    hints = {name: hint for name, hint in function.__annotations__.items() if name != "return"}
    return get_type_hints(types.SimpleNamespace(__annotations__=hints), function.__globals__, include_extras=True)


def bare(hint: Any) -> Any:
    """An annotation without what ``Annotated`` adds."""
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint


def option_of(hint: Any) -> Option:
    """The facts about an option in an annotation."""
    return next((part for part in _about(hint) if isinstance(part, Option)), Option())


def one_of_many(function: Callable[..., Any]) -> OneOfMany | None:
    """The facts about the parameter of which the command takes many; None without one."""
    about = (part for hint in hints_of(function).values() for part in _about(hint))
    return next((part for part in about if isinstance(part, OneOfMany)), None)


def _about(hint: Any) -> tuple[Any, ...]:
    return get_args(hint)[1:] if get_origin(hint) is Annotated else ()


def options_of(function: Callable[..., Any]) -> list[Parameter]:
    """The parameters of a declared function that are options of its command, in order."""
    doc, hints = words_of(function), hints_of(function)
    flags = {name: f"--{(option_of(hint).flag or name).replace('_', '-')}" for name, hint in hints.items()}
    out = []
    for name, parameter in inspect.signature(function).parameters.items():
        about = _about(hints[name])
        if (
            parameter.kind is parameter.VAR_KEYWORD
            or PYTHON_ONLY in about
            or any(isinstance(each, OneOfMany) for each in about)
        ):
            continue
        option, (kind, many) = option_of(hints[name]), on_command_line(bare(hints[name]))
        text, shown = _split_default(doc.parameters.get(name, [""])[0])
        flag, _, off = flags[name].partition("/")
        if kind is bool and (off or parameter.default is not False):
            off = f"--{off or f'no-{flag[2:]}'}"
            text = text.replace("(True)", f"({flag})").replace("(False)", f"({off})")
        names = (f"{flag}/{off}" if off else flag, *([f"-{option.short}"] if option.short else []))
        default = shown if option.shown is None else option.shown
        out.append(Parameter(name, kind, many, names, parameter.default, option, with_dashes(text, flags), default))
    return out


def on_command_line(hint: Any) -> tuple[Any, bool]:
    """The type of one value of an option, and whether it may have several.

    Python takes more than a command line can say: of ``str | Sequence[str]`` an option takes several texts, of
    ``float | str | Fraction`` a text, of ``str | os.PathLike`` a path.
    """
    parts = _parts(hint)
    several = [get_args(part)[0] for part in parts if get_origin(part) is Sequence]
    if several:
        return on_command_line(several[0])[0], True
    if any(get_origin(part) is os.PathLike for part in parts):
        return Path, False
    kind = next((part for part in parts if get_origin(part) is Literal), None)
    if kind is not None:
        names = tuple(name for part in parts if get_origin(part) is Literal for name in get_args(part))
        return Literal[names], False
    return next(
        kind for kind in (str, bool, int, float) if kind in parts and (kind is not int or float not in parts)
    ), False


def _parts(hint: Any) -> list[Any]:
    if get_origin(hint) in (Union, types.UnionType):
        return [part for inner in get_args(hint) for part in _parts(inner)]
    return [hint]


@cache
def words_of(function: Callable[..., Any]) -> Words:
    """The parts of the docstring of a function (numpydoc)."""
    text, *rest = re.split(r"^(\w+)\n-+\n", inspect.getdoc(function) or "", flags=re.M)
    sections = dict(zip(rest[::2], rest[1::2], strict=True))
    parameters: dict[str, list[str]] = {}
    for block in re.split(r"^(?=\S)", sections.get("Parameters", ""), flags=re.M):
        names, _, lines = block.partition("\n")
        for name in names.partition(" : ")[0].split(", "):
            parameters[name.lstrip("*")] = [" ".join(part.split()) for part in inspect.cleandoc(lines).split("\n\n")]
    return Words(text.strip(), parameters, re.findall(r"^ +(mcaptrack .+)$", sections.get("Examples", ""), re.M))


def _split_default(text: str) -> tuple[str, str | None]:
    """Split "Width; by default that of the video." into the help and the default that it shows."""
    match = re.fullmatch(r"(.+?)(?:;|\.) [Bb]y default (.+?)\.", text)
    return (f"{match[1]}.", match[2]) if match else (text, None)


def with_dashes(text: str, flags: dict[str, str]) -> str:
    """Return text of a docstring for the command line: ``max_fps`` and `max_fps=` become --max-fps."""

    def option(match: re.Match[str]) -> str:
        name = match[1] or match[2]
        return flags[name].partition("/")[0] if name in flags else name if match[1] else match[0]

    return re.sub(r"``(\w+)``|`(\w+)=`", option, text).replace("``", "")
