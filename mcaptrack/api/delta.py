"""Look after Delta tables with the tables of many logs, and add logs to them in batches."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from mcaptrack.api.checked import checked
from mcaptrack.api.common import as_location, names_of
from mcaptrack.api.options import PathLike
from mcaptrack.errors import McaptrackError
from mcaptrack.location import Location
from mcaptrack.notices import warn
from mcaptrack.tables import delta as delta_tables
from mcaptrack.tables.delta import Committed, ExportedLog

#: The number of logs that one transaction of each table adds.
BATCH = 50


@dataclass(frozen=True)
class DeltaTableInfo:
    """One of the Delta tables of many logs.

    Attributes
    ----------
    name : str
        Its name, as in ``list_tables``; of a channel of other software, ``topics/`` and the name of its folder.
    version : int
        Its newest version.
    rows, files, bytes : int
        Number of rows and of data files, and the size of the latter.

    """

    name: str
    version: int
    rows: int
    files: int
    bytes: int


@dataclass(frozen=True)
class DeltaState:
    """The Delta tables in a folder, after what was done with them.

    Attributes
    ----------
    location : pathlib.Path or str
        The folder, or its URL.
    removed : tuple of str
        Names of the logs that were removed.
    compacted : dict
        Tables of which small files were joined: how many became how many.
    deleted : int
        Number of files of old versions that were deleted.
    tables : tuple of DeltaTableInfo
        The tables as they are now.

    """

    location: Location
    removed: tuple[str, ...]
    compacted: dict[str, tuple[int, int]]
    deleted: int
    tables: tuple[DeltaTableInfo, ...]


@checked(keep_days=(1, 36500))
def delta(
    location: PathLike,
    *,
    remove: str | Sequence[str] | None = None,
    compact: bool = False,
    keep_days: float | None = None,
) -> DeltaState:
    """List the Delta tables that logs were exported to; remove logs from them, and tidy their files up.

    Parameters
    ----------
    location : path
        The folder, or its URL in a store, that ``export`` was given as ``delta``.
    remove : str or sequence of str, optional
        Remove these logs, by their names in the column ``recording``, or by patterns such as "night-*". Older versions
        of the tables still have them.
    compact : bool, default False
        Join small files, so that queries open fewer. The rows stay the same.
    keep_days : float, optional
        Delete files that no version of the last days needs; versions before that can't be read any more.

    Returns
    -------
    DeltaState
        What was done, and the tables.

    Raises
    ------
    McaptrackError
        If there are no such tables, or no such log.

    Examples
    --------
    >>> import mcaptrack
    >>> mcaptrack.export("log.mcap", "tables", delta="lake").delta
    'added'
    >>> mcaptrack.delta("lake", remove="log").removed
    ('log',)

    """
    where = as_location(location)
    delta_tables.describe(where)  # refuses a folder without tables before anything is done
    removed = delta_tables.remove(where, names_of(remove)).replaced if remove else []
    compacted = delta_tables.compact(where) if compact else {}
    deleted = delta_tables.vacuum(where, keep_days) if keep_days is not None else 0
    tables = tuple(
        DeltaTableInfo(one.name, one.version, one.rows, one.files, one.bytes) for one in delta_tables.describe(where)
    )
    return DeltaState(where, tuple(removed), compacted, deleted, tables)


def add_to_delta(
    where: Location, log: Location, folder: Path, force: bool
) -> Literal["added", "replaced", "unchanged"]:
    """Add a log to Delta tables, from the folder with its tables. Raises McaptrackError if it can't be added."""
    done = delta_tables.commit(where, [ExportedLog(log, folder)], force=force)
    for why in done.failed.values():
        raise McaptrackError(why)
    for words in done.notes:
        warn(words, "left-out")
    return "added" if done.added else "replaced" if done.replaced else "unchanged"


@dataclass
class DeltaBatches:
    """Adds exported logs to Delta tables in batches, each a transaction a table, beside what exports the next ones."""

    where: Location
    force: bool = False
    done: Committed = field(default_factory=Committed)
    _waiting: list[ExportedLog] = field(default_factory=list)
    _running: list[Future[None]] = field(default_factory=list)
    _executor: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1))

    def __post_init__(self) -> None:
        """Make the tables, so that a folder that can't be written is refused before logs are exported."""
        delta_tables.prepare(self.where)

    def add(self, log: Location, folder: Path) -> None:
        """Add a log with its tables in a folder; it may be committed later."""
        self._waiting.append(ExportedLog(log, folder))
        if len(self._waiting) >= BATCH:
            self._start()

    def finish(self) -> Committed:
        """Commit what is left, and wait for all. Raises McaptrackError if the tables can't be written."""
        self._start()
        self._executor.shutdown()
        for one in self._running:
            one.result()
        return self.done

    def _start(self) -> None:
        batch, self._waiting = self._waiting, []
        if batch:
            self._running.append(self._executor.submit(self._commit, batch))

    def _commit(self, batch: Sequence[ExportedLog]) -> None:
        self.done.add(delta_tables.commit(self.where, batch, force=self.force))
