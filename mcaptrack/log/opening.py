"""Opening logs, with their sidecars, and finding channels in them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from mcaptrack import objects
from mcaptrack.files import temporary_folder
from mcaptrack.location import Location, Url
from mcaptrack.log.paths import RESULTS_SUFFIX, results_path
from mcaptrack.log.reader import Channel, Log
from mcaptrack.log.writer import create
from mcaptrack.objects import AbsentError


def read(path: Location, *, sidecar: bool | Callable[[Log], bool] | None = None) -> Log:
    """Open a log.

    Parameters
    ----------
    path : Path or Url
        An MCAP file, or an object that is one.
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
    log = Log(path)
    try:
        if path.name.endswith(RESULTS_SUFFIX):
            return log
        if isinstance(path, Url):
            _attach_remote(log, results_path(path), sidecar(log) if callable(sidecar) else sidecar)
            return log
        results = results_path(path)
        if sidecar(log) if callable(sidecar) else sidecar or (sidecar is None and results.exists()):
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


def find_results(path: Location) -> Location | None:
    """The sidecar of a log, if there is one."""
    if path.name.endswith(RESULTS_SUFFIX):
        return None
    if isinstance(path, Url):
        objects.library(path)
        url = results_path(path)
        return None if objects.find(url) is None else url
    results = results_path(path)
    return results if results.exists() else None


def _attach_remote(log: Log, results: Url, sidecar: bool | None) -> None:
    """Attach the sidecar of a log in a store: the one that is there, or with ``sidecar`` a new one."""
    if sidecar is False:
        return
    try:
        found = Log(results)
    except AbsentError:
        if not sidecar:
            return
        made = temporary_folder()
        with create(Path(made.name, results.name)):
            pass
        log.attach_results(Log(results, made), is_new=True)
    else:
        log.attach_results(found, is_new=False)
