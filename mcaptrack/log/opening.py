"""Opening logs, with their sidecars, and finding channels in them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from mcaptrack.log.paths import RESULTS_SUFFIX, results_path
from mcaptrack.log.reader import Channel, Log
from mcaptrack.log.writer import create


def read(path: Path, *, sidecar: bool | Callable[[Log], bool] | None = None) -> Log:
    """Open a log.

    Parameters
    ----------
    path : Path
        An MCAP file.
    sidecar : bool or callable, optional
        Whether to open the log with its sidecar, LOG.results.mcap: by default if it exists; True creates it, False
        ignores it. A callable gets the log alone and returns which.

    Returns
    -------
    Log
        Close it, or use it as a context manager.

    Raises
    ------
    McaptrackError
        If the file is missing, not an MCAP file, or damaged.
    """
    log, results = Log(path), results_path(path)
    try:
        if not path.name.endswith(RESULTS_SUFFIX) and (
            sidecar(log) if callable(sidecar) else sidecar or (sidecar is None and results.exists())
        ):
            is_new = not results.exists()
            if is_new:
                with create(results):
                    pass
            log.attach_results(Log(results), is_new)
    except BaseException:
        log.__exit__()
        raise
    return log


def topics_with_schema(log: Log, names: Sequence[str]) -> list[Channel]:
    """The channels with one of these schemas, sorted by topic."""
    return [channel for _, channel in sorted(log.channels.items()) if channel.schema_name in names]
