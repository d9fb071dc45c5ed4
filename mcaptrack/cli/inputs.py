"""Which inputs a command line names. URLs, pipes and devices are refused before a command opens anything."""

from __future__ import annotations

import glob
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
    """Return paths, with patterns replaced by the files that match.

    With ``folders``, a folder that has logs stands for these, and "-" for a list of logs on standard input.
    LOG.results.mcap is left out if LOG is among the paths, because it is a part of LOG; with ``each`` it is kept.
    Raises McaptrackError for a pattern that matches no file.
    """
    from mcaptrack.files import place_of
    from mcaptrack.fleet.expansion import LIST, find_logs, has_logs
    from mcaptrack.log import results_path

    out: list[Location] = []
    for path in paths:
        if is_remote(url := parse(path)):
            out.append(url)
            continue
        refuse_url(path)
        if folders and (str(path) == LIST or (path.is_dir() and has_logs(path))):
            out += [one.path for one in find_logs([path])]
            continue
        if path.exists() or not glob.has_magic(str(path)):
            out.append(path)
            continue
        found = sorted(Path(name) for name in glob.glob(str(path), recursive=True))
        if not found:
            raise McaptrackError(f"no file matches {path}")
        out += found
    results = {results_path(place_of(path)) for path in out}
    return [path for path in out if each or place_of(path) not in results]


def only_one_output(paths: Sequence[Location], output: Path | None) -> None:
    """Raise McaptrackError if several inputs would be written to one output."""
    if output is not None and len(paths) > 1:
        raise McaptrackError(
            f"{len(paths)} inputs can't all be written to {output}; give one input, or no name for the output"
        )
