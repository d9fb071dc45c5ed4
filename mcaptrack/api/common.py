"""Shared parts of all functions of the library: paths, progress, warnings and notes."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from mcaptrack import notices
from mcaptrack.api.options import PathLike
from mcaptrack.errors import McaptrackError
from mcaptrack.files import is_same_file, refuse_special, refuse_url
from mcaptrack.location import Location, Url, is_remote, parse
from mcaptrack.notices import Notice

__all__ = [
    "Notes", "as_location", "as_path", "detail", "locations_of", "log_file", "log_location", "names_of",
    "optional_path", "paths_of", "split_names", "warn_unused", "warnings_about",
]  # fmt: skip

#: Where routine notes go ("/camera/tracks is missing: running track"): INFO, and DEBUG for details.
_LOGGER: Final = logging.getLogger("mcaptrack")


def as_path(path: PathLike) -> Path:
    """Return a path to a file or folder. Raises McaptrackError for a URL, a pipe, a device, and for "-"."""
    checked = Path(path)
    refuse_url(checked)
    refuse_special(checked)
    if str(path) == "-":
        raise McaptrackError("- is not a file: pipes are neither read nor written; give the name of a file")
    return checked


def optional_path(path: PathLike | None) -> Path | None:
    """Return ``as_path`` of a path; None for None."""
    return None if path is None else as_path(path)


def as_location(path: PathLike) -> Location:
    """Return the location of a log: an object in a store, or a path as ``as_path`` returns it."""
    location = parse(path)
    return location if isinstance(location, Url) and (is_remote(path) or not Path(path).exists()) else as_path(path)


def log_file(path: PathLike) -> Path:
    """Return the path of a log that stands. Raises McaptrackError as ``log_location``, and for an object in a store."""
    location = log_location(path)
    if isinstance(location, Url):
        raise McaptrackError(f"{location} is in a store, and this works with files only; copy it here first")
    return location


def log_location(path: PathLike) -> Location:
    """Return the location of a log that stands. Raises McaptrackError as ``as_path``, and for a folder."""
    location = as_location(path)
    if isinstance(location, Path) and location.is_dir():
        from mcaptrack.log import refuse_non_mcap

        refuse_non_mcap(location)
        raise McaptrackError(f"{location} is a folder, not an MCAP file; give the log in it")
    return location


def paths_of(paths: PathLike | Sequence[PathLike] | None) -> list[Path]:
    """Return one path, several, or none, as a list."""
    return [as_path(path) for path in _each(paths)]


def locations_of(paths: PathLike | Sequence[PathLike]) -> list[Location]:
    """Return one location, or several, as a list.

    ``paths`` are of files, or URLs in a store.
    """
    return [as_location(path) for path in _each(paths)]


def _each(paths: PathLike | Sequence[PathLike] | None) -> Iterable[PathLike]:
    if paths is None:
        return ()
    is_several = isinstance(paths, Iterable) and not isinstance(paths, str | bytes | os.PathLike)
    return paths if is_several else [paths]  # type: ignore[list-item,return-value]  # one of the two


def names_of(names: str | Sequence[str] | None) -> tuple[str, ...]:
    """Return one name, several, or none, as a tuple."""
    return () if names is None else (names,) if isinstance(names, str) else tuple(names)


def split_names(parameter: str, value: str | Sequence[str] | None) -> tuple[str, ...]:
    """Return names that were given as a sequence, or as text with commas between them.

    Raises McaptrackError for an empty name; ``parameter`` is what they were given as.

    ``value`` is that sequence or text, or None for no names.
    """
    if value is None:
        return ()
    if not isinstance(value, str) and not all(isinstance(name, str) for name in value):
        raise McaptrackError(f"`{parameter}=` has names, with commas between several, not {value!r:.40}")
    names = tuple(name.strip() for name in (value.split(",") if isinstance(value, str) else value))
    if not names or not all(name.strip("/") for name in names):
        raise McaptrackError(f"`{parameter}=` has an empty name, in {value!r:.40}")
    return names


def log_output(path: PathLike, source: Location | None = None) -> Path:
    """Return the path of a log to write, made from ``source``.

    Raises McaptrackError for a name that does not end with .mcap, and for ``source`` itself.
    """
    target = as_path(path)
    if target.is_dir():
        from mcaptrack.log import refuse_non_mcap

        refuse_non_mcap(target)
        raise McaptrackError(f"{target} is a folder; give the name of a file")
    if source is not None and is_same_file(target, source):
        raise McaptrackError(f"{source} is both input and output; give another name with `output=`, or leave it out")
    if target.suffix.lower() != ".mcap":
        raise McaptrackError(f"{target} is not a name for a log: logs are MCAP files; give a name that ends with .mcap")
    return target


@contextmanager
def warnings_about(log: object) -> Iterator[list[Notice]]:
    """Collect the warnings of this block, about ``log``; they are also passed on."""
    with notices.about(log), notices.collected() as warnings:
        yield warnings


def warn_unused(reason: str, **is_unused: bool) -> None:
    """Warn of parameters that have no effect in this call, as far as they were given; ``reason`` says why.

    ``is_unused`` says of each parameter, by its name, whether it was given.
    """
    for name, is_given in is_unused.items():
        if is_given:
            notices.warn(f"`{name}=` changes nothing here: {reason}", "option-not-used")


class Notes(list[str]):
    """Routine notes of one call, kept for its result and logged at once."""

    def say(self, note: str) -> None:
        """Keep a note, and log it."""
        self.append(note)
        _LOGGER.info(note)


def detail(note: str) -> None:
    """Log a detail.

    ``note`` is a line of text.
    """
    _LOGGER.debug(note)
