"""Refuse paths that are not files (URLs, pipes, devices) before a command opens anything."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mcaptrack.files import refuse_special, refuse_url


def check_paths(values: Iterable[Any]) -> None:
    """Raise McaptrackError if a path among the values of a command's options is a URL, a pipe or a device."""
    for value in values:
        for path in value if isinstance(value, list | tuple) else [value]:
            if isinstance(path, Path):
                refuse_url(path)
                refuse_special(path)
