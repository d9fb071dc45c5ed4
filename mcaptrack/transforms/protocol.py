"""What a transform is.

A transform is a frozen, keyword-only dataclass. Its fields are its parameters: each has a default, its unit at the end
of its name and a help text; they are at once the options of its command and what its channels say of their making.
Calling it with a stream of frames gives a stream of tuples of frames, one for each of its outputs.

Laws that hold for every transform, tested for all that are built in:

* conforms: every output passes the gate of its schema;
* keeps time: the times of an output never decrease;
* causal: the run of a prefix is a prefix of the run, but for what lies within ``latency_s`` of the prefix's end;
* pure: the same input gives the same output, and runs at the same time don't touch each other;
* order-blind: shuffling the rows of a frame changes names (ids) at most;
* unmoved by silence: frames without rows never stop a run.
"""

from __future__ import annotations

import math
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, field, fields
from functools import cache
from types import UnionType
from typing import Any, ClassVar, Final, Literal, Protocol, get_args, get_origin, get_type_hints

from mcaptrack.errors import McaptrackError
from mcaptrack.registry import Kind
from mcaptrack.schema import Frame, Schema


class WithOptions(Protocol):
    """A dataclass of options: a transform, or what several transforms share."""

    __dataclass_fields__: ClassVar[dict[str, Any]]


class Transform(WithOptions, Protocol):
    """See the module. ``writes`` maps the suffix of each output's topic to its schema; "" is the main output."""

    reads: ClassVar[Schema]
    writes: ClassVar[Mapping[str, Schema]]

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]: ...

    @property
    def latency_s(self) -> Mapping[str, float]:
        """How far each output looks ahead, in seconds: 0 for the past alone, infinity for the whole log."""
        ...


#: The upper end of parameters that name no other: days as seconds, hundreds of kilometres as metres.
LARGEST: Final = 1e6


def option(
    default: Any,
    help: str,  # noqa: A002
    *,
    least: float = -math.inf,
    most: float | None = None,
    search: tuple[float, float] | None = None,
    kind: Kind | None = None,
    theme: str = "",
    was: str = "",
) -> Any:
    """A parameter of a transform: its default, what it means, and its range.

    What has a lower end has an upper one, too, ``LARGEST`` unless ``most`` says another: times in nanoseconds and
    counts of steps stay in 64 bits then.

    ``search`` is the part of the range that is worth a search (``mcaptrack tune``); None for what isn't tuned.
    ``kind`` says that a text is a name of that kind in ``mcaptrack.registry``. ``theme`` is a heading that parameters
    share in the help of a command that has many. ``was`` is the name that it had before, which is accepted for one
    release.
    """
    if most is None:
        most = math.inf if least == -math.inf else LARGEST
    about = {"help": help, "least": least, "most": most, "search": search, "kind": kind, "theme": theme}
    about["was"] = was
    return field(default=default, metadata=about)


def context(factory: Callable[[], Any]) -> Any:
    """A parameter that the log gives and no command line: the ground plane, the start of the clock."""
    return field(default_factory=factory, metadata={"context": True})


def choices(annotation: Any) -> tuple[str, ...]:
    """The names that a parameter with this annotation can take; () if it isn't a choice."""
    return tuple(str(name) for name in get_args(annotation)) if get_origin(annotation) is Literal else ()


#: What a parameter can be, and the values that it takes.
_KINDS: Final[Mapping[type, tuple[type, ...]]] = {float: (int, float), int: (int,), bool: (bool,), str: (str,)}


def bare_type(annotation: Any) -> Any:
    """The type of a parameter without the "or None"."""
    parts = [part for part in get_args(annotation) if part is not type(None)]
    return parts[0] if get_origin(annotation) in (UnionType, typing.Union) and len(parts) == 1 else annotation


def member_type(annotation: Any) -> tuple[Any, bool]:
    """The type of a parameter, or of the members of one that is a tuple of any length; and whether it is a tuple."""
    kind = bare_type(annotation)
    if get_origin(kind) is tuple and get_args(kind)[1:] == (Ellipsis,):
        return get_args(kind)[0], True
    return kind, False


@cache
def option_problem(cls: type[Any]) -> str:
    """Why the parameters of a class can't be options, if they can't; "" if they can."""
    try:
        hints = get_type_hints(cls)
    except Exception as error:  # annotations are code
        return f"the types of its fields can't be read: {type(error).__name__}: {error}"
    for parameter in fields(cls):
        kind, _ = member_type(hints[parameter.name])
        is_choice = bool(choices(kind)) and all(isinstance(one, str) for one in get_args(kind))
        if not (parameter.metadata.get("context") or kind in _KINDS or is_choice):
            return (
                f"{cls.__name__}.{parameter.name} is a {_type_name(hints[parameter.name])}; a parameter is a float, an "
                "int, a bool, a str, a Literal of names, a tuple of any length of one of these, or one of them or None"
            )
        if parameter.default is MISSING and parameter.default_factory is MISSING:
            return f"{cls.__name__}.{parameter.name} has no default; every parameter needs one"
    return ""


def _type_name(annotation: Any) -> str:
    return annotation.__name__ if isinstance(annotation, type) and not get_args(annotation) else str(annotation)


def check_options(transform: WithOptions) -> None:
    """Refuse parameters that are out of range or of the wrong kind, by name and number. For ``__post_init__``.

    Raises McaptrackError; also for a class whose parameters are of types that no command line and no log can hold.
    """
    if problem := option_problem(type(transform)):
        raise McaptrackError(problem)
    hints = get_type_hints(type(transform))
    for parameter in fields(transform):
        if parameter.metadata.get("context"):
            continue
        value, name = getattr(transform, parameter.name), parameter.name
        kind, is_tuple = member_type(hints[name])
        if value is None and bare_type(hints[name]) is not hints[name]:
            continue
        if is_tuple and not isinstance(value, tuple):
            raise McaptrackError(f"{name} needs a tuple, not {value!r}")
        for one in value if is_tuple else (value,):
            _check_value(name, one, kind, parameter.metadata)


def _check_value(name: str, value: Any, kind: Any, about: Mapping[str, Any]) -> None:
    if names := choices(kind):
        if value not in names:
            raise McaptrackError(f"{name} is one of {', '.join(names)}, not {value}")
        return
    if not isinstance(value, _KINDS[kind]) or (isinstance(value, bool) and kind is not bool):
        raise McaptrackError(f"{name} needs {kind.__name__}, not {value!r}")
    least, most = about.get("least", -math.inf), about.get("most", math.inf)
    if kind in (int, float) and not least <= value <= most:
        raise McaptrackError(f"{name} has to be {limits(least, most) or 'a number'}, not {value}")


def limits(least: float, most: float) -> str:
    """A range in words, as in "from 0 to 1"; "" if it has no ends."""
    if most == math.inf:
        return "" if least == -math.inf else f"at least {_number(least)}"
    return f"at most {_number(most)}" if least == -math.inf else f"from {_number(least)} to {_number(most)}"


def _number(value: float) -> str:
    return f"{value:.15g}"
