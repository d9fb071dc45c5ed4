"""Check the arguments of functions when they are called: names of files, choices, ranges of numbers, progress.

Ranges stand in the annotations (``declared.Option``), from which the command line takes them, too. Without these checks
``form="parqet"`` would be an error of the program, or change nothing.
"""

from __future__ import annotations

import inspect
import os
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from difflib import get_close_matches
from functools import cache, wraps
from numbers import Integral, Real
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin

from mcaptrack.api.declared import bare, hints_of, option_of
from mcaptrack.errors import McaptrackError

P = ParamSpec("P")
T = TypeVar("T")


def checked(**ranges: tuple[float, float]) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Check parameters before a function runs: paths, those of a ``Literal``, those with a range, and ``progress``.

    Parameters
    ----------
    **ranges : tuple of two float
        Smallest and largest value of a parameter that is a number, or several.

    Returns
    -------
    callable
        A decorator. The function raises McaptrackError, and does nothing, if a value is an empty name of a file, none
        of the choices, or out of its range.

    """

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        signature = inspect.signature(function)

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> T:
            for name, value in signature.bind(*args, **kwargs).arguments.items():
                if value is signature.parameters[name].default:
                    continue
                kinds = _kinds(function).get(name, ())
                choices = [choice for kind in kinds if get_origin(kind) is Literal for choice in get_args(kind)]
                if "" in map(_name_of, _paths_in(value, kinds)):
                    raise McaptrackError(f"`{name}=` is an empty name; give the name of a file or folder")
                if choices:
                    _check_choice(name, value, choices)
                if kinds and set(kinds) <= {str, type(None)} and not isinstance(value, tuple(kinds)):
                    raise McaptrackError(f"`{name}=` is text, not {value!r:.40}")
                if ends := ranges.get(name) or _ranges(function).get(name):
                    _check_range(name, value, ends, is_whole=float not in kinds)
                if name == "progress" and not callable(value):
                    raise McaptrackError(
                        f"`progress=` is called as progress(stage, done, total), which {value!r:.40} is not"
                    )
            return function(*args, **kwargs)

        return call

    return decorate


def declared(*, most_used: tuple[str, ...] = ()) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Declare a command: a function that is ``checked``. The options ``most_used`` come first in its help."""

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        call = checked()(function)
        vars(call)["most_used"] = most_used
        return call

    return decorate


@cache
def _kinds(function: Callable[..., object]) -> dict[str, tuple[Any, ...]]:
    """The types that each parameter may have. That of the result is left out: it may be known to type checkers only."""
    types_of = {name: bare(hint) for name, hint in hints_of(function).items()}
    return {
        name: get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
        for name, hint in types_of.items()
    }


@cache
def _ranges(function: Callable[..., object]) -> dict[str, tuple[float, float]]:
    """The ranges that the annotations of a function declare."""
    options = {name: option_of(hint) for name, hint in hints_of(function).items()}
    return {name: (option.least, option.most) for name, option in options.items() if option.is_bounded}


def _paths_in(value: Any, kinds: Iterable[Any]) -> Iterable[Any]:
    """The paths among the value of a parameter of these types: itself, members of a sequence, values of a mapping."""
    if isinstance(value, Mapping):
        return value.values() if any(get_origin(kind) is Mapping and _holds_paths(kind) for kind in kinds) else ()
    if not any(map(_holds_paths, kinds)):
        return ()
    return value if isinstance(value, Sequence) and not isinstance(value, str) else (value,)


def _holds_paths(kind: Any) -> bool:
    whole = get_origin(kind) or kind
    return (isinstance(whole, type) and issubclass(whole, os.PathLike)) or any(map(_holds_paths, get_args(kind)))


def _name_of(path: Any) -> Any:
    return os.fspath(path) if isinstance(path, os.PathLike) else path


def _check_choice(name: str, value: object, choices: list[Any]) -> None:
    if not isinstance(value, str) or value not in choices:
        close = get_close_matches(str(value), map(str, choices), 1)
        meant = f"did you mean {close[0]}? " if close else ""
        raise McaptrackError(f"`{name}=` can't be {value!r:.40}; {meant}there are {', '.join(map(str, choices))}")


def _check_range(name: str, value: Any, ends: tuple[float, float], *, is_whole: bool) -> None:
    kind: Any = Integral if is_whole else Real
    least, most = ends
    values = list(value) if isinstance(value, Iterable) and not isinstance(value, str | bytes) else [value]
    for number in values:
        if not isinstance(number, kind) or isinstance(number, bool) or not least <= number <= most:
            text = "a whole number" if is_whole else "a number"
            raise McaptrackError(f"`{name}=` is {text} from {least:.12g} to {most:.12g}, not {number!r:.40}")
    if not values:
        raise McaptrackError(f"`{name}=` needs at least one number")
