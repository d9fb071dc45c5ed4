"""Paths that a command is given: what no file can be is refused before anything is opened."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.files import refuse_special

#: A URL, also one that has become a path: "s3://bucket/a" is "s3:/bucket/a" then.
_URL: Final = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/+([^\s]+)")


def check_paths(values: Iterable[Any]) -> None:
    """Raise McaptrackError for a path among the values of a command's options that is a URL, a pipe or a device."""
    for value in values:
        for path in value if isinstance(value, list | tuple) else [value]:
            if isinstance(path, Path):
                refuse_url(path)
                refuse_special(path)


def refuse_url(path: Path | str) -> None:
    """Raise McaptrackError for a URL, with the slashes that it had."""
    found = _URL.fullmatch(str(path))
    if found and not Path(path).exists():
        scheme, rest = found.groups()
        raise McaptrackError(f"{scheme}://{rest} is a URL; only files are read and written: copy it here first")
