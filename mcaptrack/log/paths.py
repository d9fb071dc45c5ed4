"""Names of files that belong to a log."""

from __future__ import annotations

from typing import Final

from mcaptrack.location import P, sibling

#: Suffix of a sidecar: a log that holds the results of another.
RESULTS_SUFFIX: Final = ".results.mcap"


def results_path(path: P) -> P:
    """The location of the sidecar of a log, which holds its results if they are not in the log itself."""
    return sibling(path, RESULTS_SUFFIX, of=path.name.removesuffix(".mcap"))
