"""Names of files that belong to a log."""

from __future__ import annotations

from pathlib import Path
from typing import Final, TypeVar

from mcaptrack.location import Location, Url

P = TypeVar("P", Path, Url, Location)

#: Suffix of a sidecar: a log that holds the results of another.
RESULTS_SUFFIX: Final = ".results.mcap"


def results_path(path: P) -> P:
    """The location of the sidecar of a log, which holds its results if they are not in the log itself."""
    return path.with_name(path.name.removesuffix(".mcap") + RESULTS_SUFFIX)
