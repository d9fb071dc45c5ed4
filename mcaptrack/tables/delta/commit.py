"""Add logs to Delta tables, replace and remove them: a transaction a table, repeated if another process was quicker.

A transaction that replaces rows fails if another one has added rows of the same logs since the version that it read; so
none is lost and none stands there twice. Rows of the tables are written first. The row in ``recordings`` is written
last, from the version that was read first: if another process has changed this row meanwhile, all tables of these logs
are written again. It has digests of all tables, by which a second call finds what has changed, also after a kill.
"""

from __future__ import annotations

import json
import random
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar

from mcaptrack import __version__
from mcaptrack.errors import McaptrackError
from mcaptrack.location import Location
from mcaptrack.tables.delta import columns
from mcaptrack.tables.delta.exported import ExportedLog, rows_of, schema_of
from mcaptrack.tables.delta.opening import CATALOGUE, DIGESTS, DeltaFolder, library, options_of, reporting
from mcaptrack.tables.fields import RECORDING, TABLES, Field
from mcaptrack.tables.files import file_metadata

T = TypeVar("T")
#: How often a transaction is tried, and the longest pause before the next try in seconds.
_TRIES: Final = 60
_LONGEST_PAUSE_S: Final = 2.0
#: Tables that are written at the same time.
_AT_ONCE: Final = 4
#: Columns with statistics for each file, by which readers leave files out.
_STATISTICS: Final = ("recording", "topic", "track_id", "t_ns", "start_t_ns", "frame")
_DIGESTS_COLUMN: Final = Field(DIGESTS, "text", "digests of the log's tables, as JSON", nullable=True)
_KNOWN: Final = ("location", "digest", DIGESTS)


@dataclass
class Committed:
    """The outcome for logs: names of those that were added, replaced and left as they were; why others failed.

    ``transactions`` are those that succeeded, ``conflicts`` those that had to be repeated.
    """

    added: list[str] = field(default_factory=list)
    replaced: list[str] = field(default_factory=list)
    unchanged: list[str] = field(default_factory=list)
    failed: dict[Location, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    transactions: int = 0
    conflicts: int = 0

    def add(self, other: Committed) -> None:
        """Add what was done with other logs."""
        for name in ("added", "replaced", "unchanged", "notes"):
            getattr(self, name).extend(getattr(other, name))
        self.failed.update(other.failed)
        self.transactions += other.transactions
        self.conflicts += other.conflicts


def prepare(where: Location) -> None:
    """Make the tables in a folder, if there are none yet. Raises McaptrackError if they can't be made or read."""
    Batch(DeltaFolder(where), Committed()).catalogue_table()


def commit(where: Location, logs: Sequence[ExportedLog], *, force: bool = False) -> Committed:
    """Add logs to the Delta tables in a folder, or replace them; one transaction a table that changes.

    Parameters
    ----------
    where : Path or Url
    logs : sequence of ExportedLog
    force : bool
        Write all tables of these logs again, and replace other logs of the same names.

    Raises
    ------
    McaptrackError
        If the tables can't be read or written. A log that can't be added is in ``failed`` instead.
    """
    job = Batch(DeltaFolder(where), Committed())
    left = job.distinct(logs)
    catalogue = job.catalogue_table()
    again = force
    for _ in job.attempts():
        known = job.folder.catalogue(catalogue, [one.recording for one in left], _KNOWN)
        changed = job.changed(left, known, force, again)
        if not changed:
            break
        job.write_tables(changed, known, again)
        catalogue = job.write_catalogue(catalogue, changed, known)
        if catalogue is None:
            break
        again = True  # others wrote these logs: whatever they wrote is written over
    for one in left:
        if one.log not in job.done.failed:
            state = job.done.replaced if one.recording in known else job.done.added
            state = state if one in changed else job.done.unchanged
            state.append(one.recording)
    return job.done


def _differs(one: ExportedLog, known: Mapping[str, Mapping[str, Any]], name: str, again: bool) -> bool:
    """Whether a table of a log has to be written; those of a log that isn't known may be left from a kill."""
    before = _digests(known[one.recording]) if one.recording in known else {}
    if not before:
        return True
    then, now = before.get(name, ""), one.digests.get(name, "")
    return then != now or bool(again and now)


def _digests(row: Mapping[str, Any]) -> dict[str, str]:
    try:
        found = json.loads(row[DIGESTS] or "{}")
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


@dataclass
class Batch:
    """Transactions on the tables in a folder, and what they did."""

    folder: DeltaFolder
    done: Committed

    def attempts(self) -> Iterator[int]:
        """Count tries, with growing pauses between them. Raises McaptrackError after the last."""
        for number in range(_TRIES):
            if number:
                self.done.conflicts += 1
                time.sleep(random.uniform(0, min(_LONGEST_PAUSE_S, 0.02 * 2**number)))  # noqa: S311
            yield number
        raise McaptrackError(
            f"{self.folder.where} can't be written: other processes were quicker {_TRIES} times; try again"
        )

    def distinct(self, logs: Sequence[ExportedLog]) -> list[ExportedLog]:
        """Logs of different names, in their order; others of the same name fail."""
        by_name: dict[str, ExportedLog] = {}
        for one in logs:
            other = by_name.setdefault(one.recording, one)
            if other.log != one.log:
                self._fail(one, f"{other.log} has the same name in the tables, {one.recording}; rename one of them")
        return [by_name[name] for name in sorted(by_name)]

    def changed(
        self, logs: Sequence[ExportedLog], known: Mapping[str, Mapping[str, Any]], force: bool, again: bool
    ) -> list[ExportedLog]:
        """The logs that differ from what stands there. Those that can't be added fail."""
        out = []
        for one in logs:
            try:
                before = known.get(one.recording)
                if not again and before and one.is_as(_digests(before)):
                    continue
                if before and not force and not _is_same_log(one.row, before):
                    raise McaptrackError(
                        f"{self.folder.where} has another log of the name {one.recording}, {before['location']}; "
                        f"rename one of them, or replace it with `force=True`"
                    )
                _ = one.digests
                out.append(one)
            except McaptrackError as error:
                self._fail(one, str(error))
        return [one for one in out if one.log not in self.done.failed]

    def _fail(self, one: ExportedLog, why: str) -> None:
        self.done.failed[one.log] = why if str(one.log) in why else f"{one.log}: {why}"

    def write_tables(self, logs: Sequence[ExportedLog], known: Mapping[str, Mapping[str, Any]], again: bool) -> None:
        """Replace the rows of logs in all tables but ``recordings``, several tables at the same time."""

        def write(name: str) -> None:
            self.write(name, [one for one in logs if _differs(one, known, name, again)])

        with ThreadPoolExecutor(_AT_ONCE) as threads:
            for _ in threads.map(write, self.names(logs, known)):
                pass

    def names(self, changed: Sequence[ExportedLog], known: Mapping[str, Mapping[str, Any]]) -> list[str]:
        """The tables that these logs have, or had."""
        there = {name for one in changed for name in one.digests}
        there |= {name for one in changed for name in _digests(known.get(one.recording, {DIGESTS: None}))}
        return [name for name in TABLES if name != CATALOGUE] + sorted(there - set(TABLES))

    def catalogue_table(self) -> Any:
        """The newest version of ``recordings``. All tables are made if there is none yet."""
        table = self.folder.table(CATALOGUE)
        if table is None:
            for name, declared in TABLES.items():
                schema = columns.columns_of(declared.arrow)
                if name == CATALOGUE:
                    schema = schema.append(columns.columns_of([_DIGESTS_COLUMN.arrow]).field(DIGESTS))
                table = self.table(name, schema)
        self.check(CATALOGUE, table)
        return table

    def check(self, name: str, table: Any) -> None:
        """Raise McaptrackError if a table isn't one of logs."""
        if RECORDING.name not in _arrow(table).names:
            raise McaptrackError(
                f"the Delta table {self.folder.location(name)} is not one of logs: it has no column {RECORDING.name}; "
                "give another folder"
            )

    def table(self, name: str, schema: Any, title: str = "") -> Any:
        """The newest version of a table; made if there is none. Raises McaptrackError if it isn't a table of logs."""
        found = self.folder.table(name)
        if found is None:
            found = self._made(name, schema, title or name)
        self.check(name, found)
        return found

    def _made(self, name: str, schema: Any, title: str) -> Any:
        where, delta = self.folder.location(name), library()
        with_statistics = ",".join(one for one in _STATISTICS if one in schema.names)
        with reporting(where, "written"):
            if isinstance(where, Path):
                where.mkdir(parents=True, exist_ok=True)
            try:
                return delta.DeltaTable.create(
                    str(where),
                    schema,
                    mode="ignore",
                    name=title,
                    description=TABLES[name].doc if name in TABLES else "messages of a channel of other software",
                    configuration={
                        "delta.checkpointInterval": "20",
                        "delta.dataSkippingStatsColumns": with_statistics,
                    },
                    storage_options=options_of(where),
                )
            except delta.exceptions.DeltaError:
                found = self.folder.table(name)  # another process may have made it
                if found is None:
                    raise
                return found

    def write(self, name: str, logs: Sequence[ExportedLog]) -> None:
        """Replace the rows of logs in a table, in one transaction."""
        if not logs:
            return
        own = {one.recording: columns.columns_of(schema_of(one, name)) for one in logs if one.digests.get(name)}
        if name in TABLES:
            first = columns.columns_of(TABLES[name].arrow)
        elif own:
            first = next(iter(own.values()))
        elif self.folder.table(name) is None:
            return
        title = file_metadata(next(one for one in logs if one.recording in own).file(name), "parquet") if own else None
        for _ in self.attempts():
            table = (
                self.table(name, first, (title or {}).get("topic", name))
                if own or name in TABLES
                else self.folder.table(name)
            )
            known = _arrow(table)
            fitting = [one for one in logs if one.recording in own and self._fits(known, own[one.recording], one, name)]
            schema = columns.joined(known, [own[one.recording] for one in fitting])
            try:
                self._replace(table, name, logs, schema, known, partial(rows_of, name, fitting, own, schema))
            except library().exceptions.CommitFailedError:
                continue
            return

    def _fits(self, known: Any, own: Any, one: ExportedLog, name: str) -> bool:
        """Whether the rows of a log can stand in a table; otherwise a note says why they are left out."""
        try:
            columns.joined(known, [own])
            if name in TABLES:
                columns.refuse_other_types(known, own)
        except McaptrackError as error:
            if name in TABLES:
                raise McaptrackError(
                    f"the Delta table {self.folder.location(name)} is not one of logs: {error}"
                ) from None
            words = f"{one.log}: {name} is left out of {self.folder.where}: {error}"
            self.done.notes += [words] if words not in self.done.notes else []
            return False
        return True

    def change(self, name: str, how: Callable[[Any, Any], object]) -> None:
        """Change a table, if it exists, in one transaction."""
        properties = library().CommitProperties(custom_metadata={"mcaptrack": __version__})
        for _ in self.attempts():
            table = self.folder.table(name)
            if table is None:
                return
            try:
                with reporting(self.folder.location(name), "written"):
                    how(table, properties)
            except library().exceptions.CommitFailedError:
                continue
            self.done.transactions += 1
            return

    def write_catalogue(self, table: Any, logs: Sequence[ExportedLog], known: Mapping[str, Any]) -> Any | None:
        """Replace the rows of logs in ``recordings``, which ``table`` is a version of; None if that succeeds.

        If another process has changed the rows of these logs since ``known``, none is written; the newest version.
        """
        names = [one.recording for one in logs]
        before = {name: known[name] for name in names if name in known}
        for _ in self.attempts():
            try:
                self.write_rows(table, logs)
            except library().exceptions.CommitFailedError:
                table = self.catalogue_table()
                if self.folder.catalogue(table, names, _KNOWN) != before:
                    return table
            else:
                return None
        raise AssertionError("attempts end with an error")

    def write_rows(self, table: Any, logs: Sequence[ExportedLog]) -> None:
        """Replace the rows of logs in ``recordings``, after the version that ``table`` is.

        Raises CommitFailedError if they may have been changed since.
        """
        import pyarrow as pa

        own = {one.recording: columns.columns_of(schema_of(one, CATALOGUE)) for one in logs}
        digests = columns.columns_of([_DIGESTS_COLUMN.arrow]).field(DIGESTS)
        schema = columns.joined(_arrow(table), [*own.values(), pa.schema([digests])])
        texts = {one.recording: json.dumps(one.digests, sort_keys=True, separators=(",", ":")) for one in logs}

        def rows() -> Iterator[Any]:
            at = schema.get_field_index(DIGESTS)
            for batch in rows_of(CATALOGUE, logs, own, schema):
                said = pa.array([texts[name] for name in batch.column(0).to_pylist()], digests.type)
                yield batch.set_column(at, schema.field(at), said)

        self._replace(table, CATALOGUE, logs, schema, _arrow(table), rows)

    def _replace(
        self,
        table: Any,
        name: str,
        logs: Sequence[ExportedLog],
        schema: Any,
        known: Any,
        rows: Callable[[], Iterator[Any]],
    ) -> None:
        """One transaction: the rows of these logs are those that ``rows`` gives."""
        import pyarrow as pa

        delta, where = library(), self.folder.location(name)
        words = {"mcaptrack": __version__, "logs": str(len(logs))}
        only = predicate([one.recording for one in logs])
        properties = delta.CommitProperties(custom_metadata=words)
        with reporting(where, "written"):
            if name != CATALOGUE and not any(one.digests.get(name) for one in logs):
                removed = table.delete(only, commit_properties=properties)
                self.done.transactions += bool(removed["num_deleted_rows"])
                return
            delta.write_deltalake(
                table,
                pa.RecordBatchReader.from_batches(schema, rows()),
                mode="overwrite",
                predicate=only,
                schema_mode="merge" if set(schema.names) - set(known.names) else None,
                writer_properties=delta.WriterProperties(compression="ZSTD", compression_level=1),
                commit_properties=properties,
            )
            self.done.transactions += 1


def _is_same_log(row: Mapping[str, Any], before: Mapping[str, Any]) -> bool:
    """Whether a log is the one that is known: at the same place, or with the same content."""
    return before["location"] in (None, row.get("location")) or before["digest"] == row.get("digest")


def _arrow(table: Any) -> Any:
    import pyarrow as pa

    return pa.schema(table.schema().to_arrow())


def predicate(recordings: Sequence[str]) -> str:
    """The condition for the rows of logs, in SQL."""
    names = ", ".join("'" + name.replace("'", "''") + "'" for name in recordings)
    return f"{RECORDING.name} IN ({names})"
