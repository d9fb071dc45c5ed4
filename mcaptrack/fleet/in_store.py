"""Find the logs that the URL of a store names: an object, a prefix, or a pattern."""

from __future__ import annotations

import glob
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

from mcaptrack import objects
from mcaptrack.errors import McaptrackError
from mcaptrack.location import Url

_SUFFIX: Final = ".mcap"


def logs_in_store(url: Url, leave_out: str) -> Iterator[tuple[Url, Path]]:
    """Yield the logs that a URL names, each with its name below the prefix or pattern.

    A prefix stands for all logs below it. A pattern is matched as for files: "*" within a part of the name, "**" over
    several. Raises McaptrackError if nothing fits, or if the store can't be read.
    """
    if glob.has_magic(url.key):
        found = [*_matching(url, leave_out)]
        if not found:
            raise McaptrackError(f"no object matches {url}")
        yield from found
        return
    is_log = url.suffix.lower() == _SUFFIX and not url.endswith("/")
    found = [] if is_log else [*_below(url, leave_out)]
    if not found and (url.endswith("/") or not url.key):
        raise McaptrackError(f"{url} has no log: no object below it ends with {_SUFFIX}")
    yield from found or [(url, Path(url.name))]


def _below(prefix: Url, leave_out: str) -> Iterator[tuple[Url, Path]]:
    """Yield all logs below a prefix, in order of their names."""
    for url, _ in sorted(objects.list_objects(prefix)):
        name = url.key.removeprefix(prefix.key.rstrip("/")).lstrip("/")
        if _is_log(url, leave_out) and not any(part.startswith(".") for part in name.split("/")):
            yield url, Path(name)


def _matching(pattern: Url, leave_out: str) -> Iterator[tuple[Url, Path]]:
    """Yield the objects that a pattern matches, and the logs below prefixes that it matches."""
    parts = pattern.key.rstrip("/").split("/")
    fixed = next(number for number, part in enumerate(parts) if glob.has_magic(part))
    prefix = Url(f"{pattern.scheme}://{pattern.bucket}")
    for part in parts[:fixed]:
        prefix /= part
    for url, _ in sorted(objects.list_objects(prefix)):
        names = url.key.split("/")
        is_below = _is_log(url, leave_out) and any(_fits(names[:end], parts) for end in range(1, len(names)))
        if is_below or _fits(names, parts):
            yield url, Path(*names[fixed:])


def _is_log(url: Url, leave_out: str) -> bool:
    return url.suffix.lower() == _SUFFIX and not (leave_out and url.endswith(leave_out))


def _fits(names: Sequence[str], parts: Sequence[str]) -> bool:
    """Whether the parts of a name fit those of a pattern."""
    if not parts:
        return not names
    if parts[0] == "**":
        return any(_fits(names[start:], parts[1:]) for start in range(len(names) + 1))
    return bool(names) and fnmatchcase(names[0], parts[0]) and _fits(names[1:], parts[1:])
