"""Declare a command once: a function of the library, from which the command line and the documentation follow.

The signature says what there is: names, types, defaults. The docstring says what it means: the first paragraph of a
parameter is its help, and ``; by default X.`` at its end is the default that the help shows. ``Annotated`` adds what
neither can say: the range of a number, the heading in the help, who may set it (``Option``). A parameter that many
functions share says there what it means, too, and ``declared`` puts this into their docstrings. This module imports
nothing heavy, so that ``--help`` stays quick; a declared function imports what it needs in its body. By the same
annotations the arguments of calls are checked (``checked``): names of files, choices, ranges of numbers, progress.
"""

from __future__ import annotations

import inspect
import json
import math
import os
import re
import textwrap
import types
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cache, partial, wraps
from numbers import Integral, Real
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Final,
    Literal,
    NamedTuple,
    ParamSpec,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from mcaptrack.errors import McaptrackError, offer
from mcaptrack.installed import missing_extension

__all__ = ["PYTHON_ONLY", "Argument", "Option", "checked", "declared", "done_by"]

P = ParamSpec("P")
T = TypeVar("T")
_More = Callable[[Collection[str]], Mapping[str, inspect.Parameter]]


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
    commas : bool
        Whether several values are one text on the command line, with commas between them.
    help : str
        The meaning of the parameter, where the docstring of a function doesn't say it.
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
    commas: bool = False
    help: str = ""


@dataclass(frozen=True)
class Argument:
    """A parameter that the command takes by its place on the command line.

    Attributes
    ----------
    name : str
        Name of the argument of the command.
    metavar, text, shown : str
        What its help shows: the name, the text, and the default.
    words : bool
        Whether the command takes any number of words there, and reads by itself what they mean.
    help : str
        The meaning of the parameter in Python, where the docstring of a function doesn't say it.
    """

    name: str
    metavar: str
    text: str
    _: KW_ONLY
    shown: str | bool = False
    words: bool = False
    help: str = ""


@dataclass(frozen=True)
class OneOfMany(Argument):
    """A path that the function takes one of, and the command many: each gets a call of its own, in worker processes.

    With ``is_one`` the command takes one name, since other arguments follow; a folder or a pattern stands for many.
    """

    is_one: bool = False


@dataclass(frozen=True)
class PythonOnly:
    """A parameter that is no option; ``help`` is its meaning, where the docstring of a function doesn't say it."""

    help: str = ""


#: For a parameter that is no option: ``Annotated[..., PYTHON_ONLY]``.
PYTHON_ONLY: Final = PythonOnly()


class Words(NamedTuple):
    """The parts of a docstring: text, parameters with their text by paragraphs, and lines that call the command."""

    text: str
    parameters: dict[str, list[str]]
    examples: list[str]


class Parameter(NamedTuple):
    """A parameter as an option: its type there, its names, its help, the default that the help shows, and whether
    ``--set`` sets it (``declared``).
    """

    name: str
    kind: Any
    many: bool
    flags: tuple[str, ...]
    default: Any
    option: Option
    help: str
    shown: str | bool | None
    is_set: bool = False


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
    return next((part for part in about(hint) if isinstance(part, Option)), Option())


def about(hint: Any) -> tuple[Any, ...]:
    """The facts that ``Annotated`` adds to a type."""
    return get_args(hint)[1:] if get_origin(hint) is Annotated else ()


def arguments_of(function: Callable[..., Any]) -> dict[str, Argument]:
    """The parameters that the command takes by their place, in order."""
    pairs = ((name, part) for name, hint in hints_of(function).items() for part in about(hint))
    return {name: part for name, part in pairs if isinstance(part, Argument)}


def options_of(function: Callable[..., Any]) -> list[Parameter]:
    """The parameters of a declared function that are options of its command, in order."""
    doc, hints, settable = words_of(function), hints_of(function), getattr(function, "settable", ())
    flags = {name: _flag(name, hint) for name, hint in hints.items()}
    options = [
        parameter_of(name, hints[name], parameter.default, with_dashes(doc.parameters.get(name, [""])[0], flags))
        for name, parameter in inspect.signature(function).parameters.items()
        if parameter.kind is not parameter.VAR_KEYWORD
        and name not in getattr(function, "python_only", ())
        and not any(isinstance(part, PythonOnly | Argument) for part in about(hints[name]))
    ]
    return [option._replace(is_set=option.name in settable) for option in options]


def _flag(name: str, hint: Any) -> str:
    """The name of an option on the command line, by that of the parameter."""
    return f"--{(option_of(hint).flag or name).replace('_', '-')}"


def parameter_of(name: str, hint: Any, default: Any, text: str = "") -> Parameter:
    """An option of a type, which ``Annotated`` says more about; ``text`` is its help, by default that of its type."""
    option, (kind, many) = option_of(hint), on_command_line(bare(hint))
    if option.commas:
        kind, many = str, False
        default = ",".join(f"{value:g}" for value in default) if isinstance(default, tuple) else default
    text, shown = (text or option.help).partition("\n\n")[0], option.shown
    if shown is None:
        text, shown = _split_default(text)
    flag, _, off = _flag(name, hint).partition("/")
    if kind is bool and (off or default is not False):
        off = f"--{off or f'no-{flag[2:]}'}"
        text = text.replace("(True)", f"({flag})").replace("(False)", f"({off})")
    names = (f"{flag}/{off}" if off else flag, *([f"-{option.short}"] if option.short else []))
    return Parameter(name, kind, many, names, default, option, text, shown)


def on_command_line(hint: Any) -> tuple[Any, bool]:
    """The type of one value of an option, and whether it may have several.

    Python takes more than a command line can say: of ``str | Sequence[str]`` an option takes several texts, of
    ``float | str | Fraction`` a text, of ``str | os.PathLike`` a path, of ``Mapping[str, float]`` texts such as a=1, of
    ``Literal["a", "b"] | str`` (names, and those of installed packages) a text.
    """
    members: dict[Any, list[Any]] = {}  # those of all parts of a kind together, such as all choices
    for part in _parts(hint):
        members.setdefault(get_origin(part) or part, []).extend(get_args(part))
    if Mapping in members and str not in members:
        return str, True
    if Sequence in members:
        return on_command_line(members[Sequence][0])[0], True
    if os.PathLike in members:
        return Path, False
    if Literal in members and str not in members:
        return Literal[tuple(members[Literal])], False
    for kind in (str, bool, float, int):
        if kind in members:
            return kind, False
    raise TypeError(f"an option can't have the type {hint}")


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
        for name in _names_of(block):
            lines = inspect.cleandoc(block.partition("\n")[2])
            parameters[name] = [" ".join(part.split()) for part in lines.split("\n\n")]
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


def checked(function: Callable[P, T]) -> Callable[P, T]:
    """Check arguments before a function runs: their types, paths, choices, ranges, and ``progress``.

    The function raises McaptrackError, and does nothing, if a value is of another type than text, a path, True or
    False, where these are declared, an empty name of a file, none of the choices, or out of the range of ``Option``.
    """
    signature = inspect.signature(function)
    has_more = any(parameter.kind is parameter.VAR_KEYWORD for parameter in signature.parameters.values())

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        for name in () if has_more else kwargs:
            if name not in signature.parameters:
                others = missing_extension(name) or offer(name, signature.parameters, "there are")
                raise TypeError(f"{function.__name__}() has no parameter {name}; {others}")
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            if value is signature.parameters[name].default:
                continue
            kinds = _kinds(function).get(name, ())
            if _has_empty_name(value, kinds):
                raise McaptrackError(f"`{name}=` is an empty name; give the name of a file or folder")
            _check_choice(name, value, kinds)
            _check_type(name, value, kinds)
            _check_members(name, value, kinds)
            if ends := _ranges(function).get(name):
                _check_range(name, value, ends, is_whole=float not in kinds)
            if name == "progress" and not callable(value):
                raise McaptrackError(
                    f"`progress=` is called as progress(stage, done, total), which {value!r:.40} is not"
                )
        return function(*args, **kwargs)

    return call


def done_by(*command_line: str, **options: bool) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Declare a function that is ``checked``, and that a command does with these words and options.

    Messages that name a call of it name that command on the command line.
    """
    return partial(_checked_with, done_by=(command_line, options))


def _checked_with(function: Callable[P, T], **facts: Any) -> Callable[P, T]:
    """A function that is ``checked``, with facts that the command line asks for."""
    call = checked(function)
    vars(call).update(facts)
    return call


def declared(
    *,
    most_used: tuple[str, ...] = (),
    settable: tuple[str, ...] = (),
    python_only: tuple[str, ...] = (),
    heading: str = "",
    printed_by: str = "",
    more: _More | None = None,
) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Declare a command: a function that is ``checked``. The options ``most_used`` come first in its help.

    The command has no options of its own for ``settable`` parameters, which few users can choose a value for:
    ``--set name=value`` sets them. Those in ``python_only`` are options of other commands, and of this one in Python.

    What the annotations say of parameters that the docstring leaves out is added to it. ``heading`` is that of the
    command in ``mcaptrack --help``, which reads it from the source, and ``printed_by`` the class that prints the
    result, as MODULE:CLASS (of the kind ``mcaptrack.cli.declared.Once``, or ``mcaptrack.cli.many.EachLog``). ``more``
    returns the parameters that take the place of the function's ``**more``; it gets the names of the others.
    """

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        if more is not None:
            _take_more(function, more)
        if function.__doc__:  # there is none with python -OO
            function.__doc__ = _completed(function)
        return _checked_with(
            function, most_used=most_used, settable=settable, python_only=python_only, heading=heading,
            printed_by=printed_by,
        )  # fmt: skip

    return decorate


def _take_more(function: Callable[..., Any], more: _More) -> None:
    """Put parameters in the place of the ``**more`` of a function."""
    signature = inspect.signature(function)
    own = dict(signature.parameters)
    del own["more"], function.__annotations__["more"]
    added = more(own)
    function.__annotations__ |= {name: parameter.annotation for name, parameter in added.items()}
    vars(function)["__signature__"] = signature.replace(parameters=[*own.values(), *added.values()])


def _completed(function: Callable[..., Any]) -> str:
    """The docstring of a function with all parameters, in order: also with those that annotations alone describe."""
    doc, hints, parameters = inspect.getdoc(function) or "", hints_of(function), inspect.signature(function).parameters
    if untyped := [name for name in parameters if name not in hints]:
        raise TypeError(f"the parameter {untyped[0]} of {function.__name__} has no type; annotate it")
    if _PARAMETERS not in doc:
        doc = re.sub(r"(?=^Returns\n)|\Z", f"{_PARAMETERS}\n\n", doc, count=1, flags=re.M)
    before, _, rest = doc.partition(_PARAMETERS)
    own, *after = re.split(r"^(?=\w+\n-+\n)", rest, maxsplit=1, flags=re.M)
    blocks = [block.rstrip() for block in re.split(r"^(?=\S)", own, flags=re.M) if block.strip()]
    described = {name for block in blocks for name in _names_of(block)}
    blocks += [_described(parameters[name], hints[name]) for name in parameters if name not in described]
    blocks.sort(key=lambda block: list(parameters).index(_names_of(block)[0]))
    return "\n".join([f"{before}{_PARAMETERS}", *blocks, "", *after])


#: The heading of a section of a docstring.
_PARAMETERS: Final = "Parameters\n----------"


def _names_of(block: str) -> list[str]:
    """The parameters that a block of a docstring is about."""
    return [name.lstrip("*") for name in block.partition("\n")[0].partition(" : ")[0].split(", ")]


def _described(parameter: inspect.Parameter, hint: Any) -> str:
    """The description of a parameter by its annotation, as numpydoc has it."""
    text = next((part.help for part in about(hint) if part.help), "")
    default = parameter.default
    is_said = isinstance(default, str | int | float)
    end = f", default {json.dumps(default) if isinstance(default, str) else default}" if is_said else ", optional"
    lines = [textwrap.fill(part, 116, initial_indent="    ", subsequent_indent="    ") for part in text.split("\n\n")]
    kind = _in_words(bare(hint)) + ("" if default is parameter.empty else end)
    return "\n".join([f"{parameter.name} : {kind}", "\n\n".join(lines)])


def _in_words(hint: Any) -> str:
    """A type as numpydoc has it: "path or sequence of path"."""
    parts = [part for part in _parts(hint) if part is not type(None)]
    if any(get_origin(part) is os.PathLike for part in parts):
        parts.remove(str)
    names = [_name_in_words(part) for part in parts]
    return " or ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def _name_in_words(kind: Any) -> str:
    origin, members = get_origin(kind), get_args(kind)
    if origin is Literal:
        return f"{{{', '.join(map(json.dumps, members))}}}"
    if origin is Sequence:
        return f"sequence of {_in_words(members[0])}"
    if origin is Mapping:
        return f"mapping of {_in_words(members[0])} to {_in_words(members[1])}"
    return {os.PathLike: "path", Callable: "callable"}.get(origin) or str(kind.__name__)


#: What types of arguments are called in errors.
_TYPES: Final[Mapping[Any, str]] = {
    bool: "True or False",
    os.PathLike: "the name of a file or folder",
    str: "text",
    Sequence: "several of these",
    Mapping: "a mapping",
}


@cache
def _kinds(function: Callable[..., object]) -> dict[str, tuple[Any, ...]]:
    """The types that each parameter may have. That of the result is left out: it may be known to type checkers only."""
    return {name: tuple(_parts(bare(hint))) for name, hint in hints_of(function).items()}


@cache
def _ranges(function: Callable[..., object]) -> dict[str, tuple[float, float]]:
    """The ranges that the annotations of a function declare."""
    options = {name: option_of(hint) for name, hint in hints_of(function).items()}
    ends = {name: (option.least, option.most) for name, option in options.items()}
    return {name: pair for name, pair in ends.items() if pair != (-math.inf, math.inf)}


def _paths_in(value: Any, kinds: Iterable[Any]) -> Iterable[Any]:
    """The paths among the value of a parameter of these types: itself, members of a sequence, values of a mapping."""
    if isinstance(value, Mapping):
        return value.values() if any(get_origin(kind) is Mapping and _holds_paths(kind) for kind in kinds) else ()
    if not any(map(_holds_paths, kinds)):
        return ()
    return value if isinstance(value, Sequence) and not isinstance(value, str) else (value,)


def _has_empty_name(value: Any, kinds: Iterable[Any]) -> bool:
    """Whether a path among a value is empty; arrays, which can't be compared, are none."""
    return any(isinstance(path, str | os.PathLike) and not os.fspath(path) for path in _paths_in(value, kinds))


def _holds_paths(kind: Any) -> bool:
    whole = get_origin(kind) or kind
    return (isinstance(whole, type) and issubclass(whole, os.PathLike)) or any(map(_holds_paths, get_args(kind)))


def _check_type(name: str, value: object, kinds: Sequence[Any]) -> None:
    """Raise McaptrackError for a value of another type. Types that aren't in ``_TYPES`` are not checked here."""
    types = {get_origin(kind) or kind for kind in kinds}
    types -= {Literal} if str in types else set()  # names, and those of installed packages
    if not types & {*_TYPES} or not types <= {*_TYPES, type(None)} or isinstance(value, tuple(types)):
        return
    if bool in types and type(value).__name__ in ("bool", "bool_"):  # NumPy's
        return
    is_path = os.PathLike in types  # which text is a name of, too
    meant = [text for kind, text in _TYPES.items() if kind in types and not (is_path and kind is str)]
    raise McaptrackError(f"`{name}=` is {' or '.join(meant)}, not {_begin_of(value)}")


def _check_members(name: str, value: object, kinds: Sequence[Any]) -> None:
    if Sequence[str] in kinds and isinstance(value, list | tuple) and any(not isinstance(each, str) for each in value):
        raise McaptrackError(f"`{name}=` holds texts, and no other values, not {_begin_of(value)}")


def _begin_of(value: object) -> str:
    """The beginning of a value as Python writes it, in one line."""
    return f"{' '.join(repr(value).split()):.40}"


def _check_choice(name: str, value: object, kinds: Sequence[Any]) -> None:
    choices = [choice for kind in kinds if get_origin(kind) is Literal for choice in get_args(kind)]
    if choices and str not in kinds and (not isinstance(value, str) or value not in choices):
        names = list(map(str, choices))
        raise McaptrackError(f"`{name}=` can't be {value!r:.40}; {offer(str(value), names, 'there are')}")


def _check_range(name: str, value: Any, ends: tuple[float, float], *, is_whole: bool) -> None:
    kind: Any = Integral if is_whole else Real
    least, most = ends
    values = list(value) if isinstance(value, Iterable) and not isinstance(value, str | bytes | Iterator) else [value]
    for number in values:
        if not isinstance(number, kind) or isinstance(number, bool) or not least <= number <= most:
            text = "a whole number" if is_whole else "a number"
            raise McaptrackError(f"`{name}=` is {text} from {least:.12g} to {most:.12g}, not {number!r:.40}")
    if not values:
        raise McaptrackError(f"`{name}=` needs at least one number")
