"""Look after Delta tables: join small files, delete those that only old versions need, and say what there is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.location import Location
from mcaptrack.tables.delta.opening import DeltaFolder, is_delta_folder, library, reporting

#: The size of files that small ones are joined to. Replacing one log writes the files again that it is in.
_TARGET_BYTES: Final = 32 * 2**20
_TRIES: Final = 5


@dataclass(frozen=True)
class TableState:
    """A Delta table: its name, version, rows, data files and their size in bytes."""

    name: str
    version: int
    rows: int
    files: int
    bytes: int


def describe(where: Location) -> list[TableState]:
    """The tables in a folder. Raises McaptrackError if there are none."""
    folder = _opened(where)
    out = []
    for name in folder.names():
        table = folder.table(name)
        if table is not None:
            import pyarrow as pa

            with reporting(folder.location(name), "read"):
                files = pa.table(table.get_add_actions(flatten=True))
            rows, size = (sum(files.column(column).to_pylist()) for column in ("num_records", "size_bytes"))
            out.append(TableState(name, table.version(), rows, files.num_rows, size))
    return out


def compact(where: Location) -> dict[str, tuple[int, int]]:
    """Join small files of each table, in one transaction a table; returns how many became how many, by table."""
    folder, out = _opened(where), {}
    for name in folder.names():
        done = _repeated(folder, name, lambda table: table.optimize.compact(target_size=_TARGET_BYTES))
        if done and done["numFilesRemoved"]:
            out[name] = (int(done["numFilesRemoved"]), int(done["numFilesAdded"]))
    return out


def vacuum(where: Location, keep_days: float) -> int:
    """Delete files that no version of the last days needs; returns how many."""
    folder, count = _opened(where), 0
    for name in folder.names():
        deleted = _repeated(
            folder,
            name,
            lambda table: table.vacuum(
                retention_hours=round(24 * keep_days), dry_run=False, enforce_retention_duration=False, full=True
            ),
        )
        count += len(deleted or ())
    return count


def _opened(where: Location) -> DeltaFolder:
    if not is_delta_folder(where):
        raise McaptrackError(f"{where} has no Delta tables of logs; `mcaptrack.export(LOG, delta=...)` makes them")
    return DeltaFolder(where)


def _repeated(folder: DeltaFolder, name: str, work: Any) -> Any:
    """Change the newest version; tried again if another process was quicker."""
    for left in reversed(range(_TRIES)):
        table = folder.table(name)
        if table is None:
            return None
        try:
            with reporting(folder.location(name), "written"):
                return work(table)
        except library().exceptions.CommitFailedError as error:
            if not left:
                raise McaptrackError(
                    f"{folder.location(name)} can't be compacted: other processes write to it; try again later"
                ) from error
    return None
