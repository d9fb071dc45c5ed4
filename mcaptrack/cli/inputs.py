"""Refuse paths that are not files (URLs, pipes, devices) before a command opens anything."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from mcaptrack.files import refuse_special, refuse_url
from mcaptrack.location import is_remote, parse

#: Arguments that name logs, which may be in a store.
_LOGS: Final = ("logs", "path", "inputs")


def check_paths(given: Mapping[str, Any]) -> None:
    """Raise McaptrackError if a path among the values of a command's options is a URL, a pipe or a device.

    Logs may be URLs of objects in a store.
    """
    for name, value in given.items():
        for path in value if isinstance(value, list | tuple) else [value]:
            if isinstance(path, Path):
                if name not in _LOGS or not is_remote(parse(path)):
                    refuse_url(path)
                refuse_special(path)
