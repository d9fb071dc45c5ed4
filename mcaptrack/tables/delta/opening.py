"""Open Delta tables in a folder or a store, and say in one line why that fails."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.location import Location, Url, hide_secrets, join
from mcaptrack.objects.faults import is_of_store, plain, reason
from mcaptrack.objects.stores import settings_of
from mcaptrack.tables.delta.quiet import without_panics
from mcaptrack.tables.fields import RECORDING, TABLES

#: The table that says which logs there are, and its column with the digests of a log's tables, as JSON.
CATALOGUE, DIGESTS = "recordings", "tables"
_LOG: Final = "_delta_log"


class DeltaFolder:
    """A folder, or a prefix in a store, with a Delta table for each table of logs."""

    def __init__(self, where: Location) -> None:
        if isinstance(where, Path) and "%" in str(where.absolute()):
            raise McaptrackError(f"{where} can't hold Delta tables: their paths are URLs, in which % has a meaning")
        self.where: Location = where if isinstance(where, Url) else Path(os.path.abspath(where))

    def location(self, name: str) -> Location:
        """The location of a table: of ``TABLES``, or ``topics/<channel>``. % means something in the paths of Delta."""
        return join(self.where, *name.replace("%", "+").split("/"))

    def table(self, name: str) -> Any | None:
        """The newest version of a table; None if there is none. Raises McaptrackError if it can't be read."""
        where, delta = self.location(name), library()
        if isinstance(where, Path) and not (where / _LOG).is_dir():
            return None
        with reporting(where, "read"):
            try:
                return delta.DeltaTable(str(where), storage_options=options_of(where))
            except delta.exceptions.TableNotFoundError:
                return None

    def dataset(self, name: str) -> Any | None:
        """The rows of a table as an Arrow dataset; None if there is no such table."""
        table = self.table(name)
        return None if table is None else dataset_of(table, self.location(name))

    def recordings(self) -> list[str]:
        """The names of all logs."""
        table = self.dataset(CATALOGUE)
        return [] if table is None else sorted(table.to_table(columns=[RECORDING.name])[RECORDING.name].to_pylist())

    def catalogue(self, version: Any, names: Sequence[str], columns: Sequence[str]) -> dict[str, dict[str, Any]]:
        """The entries of a version of ``recordings`` about logs, by name."""
        import pyarrow.compute as pc

        known = dataset_of(version, self.location(CATALOGUE))
        there = [name for name in columns if name in known.schema.names]
        rows = known.to_table(
            columns=[RECORDING.name, *there], filter=pc.field(RECORDING.name).isin(list(names))
        ).to_pylist()
        return {row[RECORDING.name]: {name: row.get(name) for name in columns} for row in rows}

    def names(self) -> list[str]:
        """The tables that logs have here, ``recordings`` last; tables of channels follow from the catalogue."""
        import json

        known = self.dataset(CATALOGUE)
        if known is None:
            return []
        texts = set(known.to_table(columns=[DIGESTS])[DIGESTS].to_pylist()) if DIGESTS in known.schema.names else set()
        topics = {name for text in texts if text for name in json.loads(text) if name not in TABLES}
        return [*(name for name in TABLES if name != CATALOGUE), *sorted(topics), CATALOGUE]


def is_delta_folder(where: Location) -> bool:
    """Whether there are Delta tables of logs. Raises McaptrackError if a store can't tell."""
    if isinstance(where, Path):
        return (where / CATALOGUE / _LOG).is_dir()
    return DeltaFolder(where).table(CATALOGUE) is not None


def dataset_of(table: Any, where: Location) -> Any:
    """The rows of a version of a table as an Arrow dataset. Local files are opened by Arrow, which is quicker."""
    import pyarrow.fs as pa_fs

    local = pa_fs.SubTreeFileSystem(str(where), pa_fs.LocalFileSystem()) if isinstance(where, Path) else None
    with reporting(where, "read"):
        return table.to_pyarrow_dataset(filesystem=local)


def library() -> Any:
    """The library, if it is installed."""
    try:
        import deltalake
        import deltalake.exceptions
    except ImportError:
        raise McaptrackError(
            'Delta tables need deltalake, which is not installed; install it with: pip install "mcaptrack[lake]"'
        ) from None
    return deltalake


def options_of(where: Location) -> dict[str, str] | None:
    """The settings of the library for a store; it reads the environment itself."""
    return settings_of(where) if isinstance(where, Url) else None


@contextmanager
def reporting(where: Location, done: str) -> Iterator[None]:
    """Turn errors of the library, and of files, into a McaptrackError that names the table."""
    exceptions = library().exceptions
    try:
        with without_panics() if isinstance(where, Url) else nullcontext():
            yield
    except McaptrackError:
        raise
    except exceptions.TableNotFoundError:
        raise
    except exceptions.CommitFailedError:
        raise
    except exceptions.DeltaProtocolError as error:
        raise McaptrackError(
            f"the Delta table {where} can't be {done}: it uses features that this version of deltalake doesn't know "
            f"({_first(where, error)})"
        ) from None
    except (exceptions.DeltaError, OSError, ValueError) as error:
        raise McaptrackError(f"the Delta table {where} can't be {done}: {_first(where, error)}") from None
    except Exception as error:
        if type(error) is not Exception and not type(error).__module__.startswith("pyarrow"):
            raise
        # Errors of its parts come as plain exceptions.
        raise McaptrackError(f"the Delta table {where} can't be {done}: {_first(where, error)}") from None


def reason_of_store(where: Location, words: str) -> str:
    """Why a request to the store of a folder failed, by a message of a library; "" if the message isn't about that."""
    if not isinstance(where, Url) or not is_of_store(words):
        return ""
    return reason(where, OSError(words))


def _first(where: Location, error: Exception) -> str:
    """The reason of an error, in one line and without secrets."""
    if reason := reason_of_store(where, str(error)):
        return reason
    words = re.split(r" \d+: <unknown>", " ".join(plain(str(error)).split()))[0]
    for sign in ("Help:", "Debug source"):
        words = words.partition(sign)[0].strip()
    known = (
        ("Permission denied", "it may not be written here (permission denied)"),
        ("No space left", "the disk is full"),
        ("Read-only file system", "the file system is read-only"),
    )
    meaning = next((meaning for sign, meaning in known if sign in words), "")
    return meaning or (hide_secrets(words) if words.startswith("http") else words)[:300] or type(error).__name__
