"""Shared parts of all functions of the library: paths, progress, warnings and notes."""

from __future__ import annotations

import inspect
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from functools import wraps
from pathlib import Path
from typing import Final, Literal, ParamSpec, TypeVar, get_args, get_origin, get_type_hints

from mcaptrack import notices
from mcaptrack.errors import McaptrackError
from mcaptrack.files import is_same_file, refuse_special, refuse_url
from mcaptrack.notices import Notice

P = ParamSpec("P")
R = TypeVar("R")
PathLike = str | os.PathLike[str]
#: Called with the name of a stage, the amount that is done, and the total (None if it is not known).
Progress = Callable[[str, float, float | None], None]

#: Where routine notes go ("/camera/tracks is missing: running track"): INFO, and DEBUG for details.
_LOGGER: Final = logging.getLogger("mcaptrack")


def no_progress(stage: str, done: float, total: float | None) -> None:
    """Ignore the progress."""


def as_path(path: PathLike) -> Path:
    """Return a path to a file or folder. Raises McaptrackError for a URL, a pipe, a device, and for "-"."""
    found = Path(path)
    refuse_url(found)
    refuse_special(found)
    if str(path) == "-":
        raise McaptrackError("- is not a file: pipes are neither read nor written; give the name of a file")
    return found


def optional_path(path: PathLike | None) -> Path | None:
    """Return ``as_path`` of a path; None for None."""
    return None if path is None else as_path(path)


def paths_of(paths: PathLike | Sequence[PathLike]) -> list[Path]:
    """Return one path, or several, as a list."""
    return [as_path(path) for path in ([paths] if isinstance(paths, str | os.PathLike) else paths)]


def names_of(names: str | Sequence[str] | None) -> tuple[str, ...]:
    """Return one name, several, or none, as a tuple."""
    return () if names is None else (names,) if isinstance(names, str) else tuple(names)


def log_output(path: PathLike, source: Path) -> Path:
    """Return the path of a log to write, made from ``source``.

    Raises McaptrackError for a name that does not end with .mcap. Callers check whether it is ``source`` itself.
    """
    found = as_path(path)
    if found.is_dir():
        raise McaptrackError(f"{found} is a folder; give the name of a file")
    if found.suffix.lower() != ".mcap" and not is_same_file(found, source):
        raise McaptrackError(f"{found} is not a name for a log: logs are MCAP files; give a name that ends with .mcap")
    return found


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Wrap a function: raise McaptrackError for text that its type hints (``Literal``) do not list."""
    choices: dict[str, tuple[object, ...]] = {}

    @wraps(function)
    def wrapper(*values: P.args, **named: P.kwargs) -> R:
        if not choices:
            choices.update(_choices_of(function))
        given = inspect.signature(function).bind(*values, **named).arguments
        for name, known in choices.items():
            value = given.get(name)
            if isinstance(value, str) and value not in known:
                close = get_close_matches(value, map(str, known), 1)
                meant = f"did you mean {close[0]}? " if close else ""
                raise McaptrackError(f"`{name}=` can't be {value!r}; {meant}there are {', '.join(map(str, known))}")
        return function(*values, **named)

    return wrapper


def _choices_of(function: Callable[..., object]) -> dict[str, tuple[object, ...]]:
    """Return the values of each parameter that is a ``Literal``, or a ``Literal`` or None."""
    out = {}
    for name, hint in get_type_hints(function).items():
        kinds = [hint] if get_origin(hint) is Literal else get_args(hint)
        literals = [kind for kind in kinds if get_origin(kind) is Literal]
        if literals and str not in kinds and name != "return":
            out[name] = tuple(value for kind in literals for value in get_args(kind))
    return out


@contextmanager
def warnings_about(log: object) -> Iterator[list[Notice]]:
    """Collect the warnings of this block, about ``log``; they are also passed on."""
    with notices.about(log), notices.collected() as warnings:
        yield warnings


class Notes(list[str]):
    """Routine notes of one call, kept for its result and logged at once."""

    def say(self, note: str) -> None:
        """Keep a note, and log it."""
        self.append(note)
        _LOGGER.info(note)


def detail(note: str) -> None:
    """Log a detail."""
    _LOGGER.debug(note)
