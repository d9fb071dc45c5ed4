"""Which inputs a command line names. URLs, pipes and devices are refused before a command opens anything."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.files import refuse_special, refuse_url
from mcaptrack.location import Location, is_remote, parse

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


def expand(paths: Sequence[Path], *, each: bool = False, folders: bool = False) -> list[Location]:
    """Return the inputs that arguments name; see ``fleet.expansion.find_inputs``."""
    from mcaptrack.fleet.expansion import find_inputs

    return [one.path for one in find_inputs(paths, each=each, folders=folders)]


def only_one_output(paths: Sequence[Location], output: Path | None) -> None:
    """Raise McaptrackError if several inputs would be written to one output."""
    if output is not None and len(paths) > 1:
        raise McaptrackError(
            f"{len(paths)} inputs can't all be written to {output}; give one input, or no name for the output"
        )
