"""SQLite files of strangers: their tables, row by row, and nothing else that a schema can hold.

A schema is a program. Views, virtual tables and generated columns can run for ever or make gigabytes of nothing, pages
that stand for several others can do the same. So tables are read in full and in order, what they may give is bounded by
the size of the file, and a signal ends every query. Nothing is ever written beside the file.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.files import follow_links, refuse_special
from mcaptrack.sources.ingest.bags import decompression

#: SQLite's steps between two looks for signals: some milliseconds.
_STEPS: Final = 100_000
#: A query may take so many steps, and so many more for each byte of the file. A row takes about ten.
_LEAST_STEPS, _STEPS_A_BYTE = 2_000_000, 4
#: What a row takes of the file at least, whatever is in it.
_ROW_BYTES: Final = 6
#: Text in UTF-16 becomes longer in UTF-8, by half at most.
_BYTES_A_BYTE: Final = 1.5
#: No value of a row may be longer: as much as a message of a log.
_MAX_VALUE_BYTES: Final = 2**28
#: How a SQL text may be long, that of the schema too.
_MAX_SQL_BYTES: Final = 2**20
#: Bytes behind a rollback journal that end it, so that no name of another journal is read from it.
_JOURNAL_END: Final = bytes(16)
#: What SQLite says of a column that is neither hidden nor computed.
_ORDINARY: Final = 0


class Database:
    """A SQLite file, open for reading. Raises McaptrackError, in one line, for whatever is wrong with it."""

    def __init__(self, path: Path, tables: Collection[str]) -> None:
        self.path = path
        self._close = ExitStack()
        self._interruption: BaseException | None = None
        refuse_special(path)
        if path.is_dir():
            raise McaptrackError(f"{path} is a folder, not a database")
        try:
            self._size = path.stat().st_size
            self._database = self._opened()
            self._columns = {table: self._find(table) for table in tables}
            self._guard()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Let go of the file."""
        self._close.close()

    def columns(self, table: str) -> Collection[str]:
        """The columns of one of the tables; none if it isn't there."""
        return self._columns[table]

    def rows(self, table: str, columns: Sequence[str]) -> Iterator[tuple[Any, ...]]:
        """These columns of all rows, in the order of the table; text as bytes."""
        names = ", ".join(f'"{name}"' for name in columns)
        left = int(_BYTES_A_BYTE * self._size)
        for row in self._ask(f'SELECT {names} FROM "{table}" NOT INDEXED'):  # noqa: S608
            left -= _ROW_BYTES + sum(len(value) for value in row if isinstance(value, bytes))
            if left < 0:
                raise McaptrackError(f"{self.path} is damaged: its table {table} holds more than the file can")
            yield row

    def count(self, table: str) -> int:
        """How many rows a table has, by its index if there is one."""
        ((count,),) = self._ask(f'SELECT sum(1) FROM "{table}"')  # noqa: S608  # count(*) would not see signals
        return count or 0

    def _opened(self) -> sqlite3.Connection:
        path, is_copy = follow_links(self.path), False
        # What a recorder that was killed left beside it belongs to it. It is read in a copy, since reading it writes.
        beside = [path.with_name(path.name + end) for end in ("-wal", "-journal")]
        left = [other for other in beside if other.is_file() and other.stat().st_size]
        if left:
            folder = self._close.enter_context(decompression.temporary_folder())
            for other in (path, *left):
                decompression.copy(other, folder / other.name)
                if other.name.endswith("-journal"):
                    with (folder / other.name).open("ab") as stream:
                        stream.write(_JOURNAL_END)
            path, is_copy = folder / path.name, True
        try:
            address = f"{path.as_uri()}?{'mode=rw' if is_copy else 'immutable=1'}"
            database = sqlite3.connect(address, uri=True, isolation_level=None, cached_statements=0)
        except (sqlite3.Error, OSError) as error:
            raise McaptrackError(f"{self.path} can't be opened: {error}") from None
        self._close.callback(database.close)
        database.text_factory = bytes
        limits = {
            "LENGTH": _MAX_VALUE_BYTES,
            "SQL_LENGTH": _MAX_SQL_BYTES,
            "EXPR_DEPTH": 50,
            "COMPOUND_SELECT": 2,
            "ATTACHED": 0,
            "WORKER_THREADS": 0,
            "TRIGGER_DEPTH": 1,
        }
        for name, most in limits.items():
            database.setlimit(getattr(sqlite3, f"SQLITE_LIMIT_{name}"), most)
        if hasattr(database, "setconfig"):  # from Python 3.12 on
            for name, wanted in (("DEFENSIVE", True), ("ENABLE_TRIGGER", False), ("ENABLE_VIEW", False)):
                database.setconfig(getattr(sqlite3, f"SQLITE_DBCONFIG_{name}"), wanted)
        self._steps, self._watching = 0, self._watch()
        database.set_progress_handler(self._watching.__next__, _STEPS)
        self._database = database
        for pragma in ("trusted_schema=OFF", "cell_size_check=ON", "mmap_size=0"):
            list(self._ask(f"PRAGMA {pragma}"))
        return database

    def _watch(self) -> Iterator[int]:
        """1 for a query that is to end, otherwise 0.

        A generator, so that whatever a signal raises is raised inside of it: SQLite would swallow it.
        """
        try:
            while True:
                yield int(self._steps > self._most_steps)
                self._steps += _STEPS
        except GeneratorExit:
            raise
        except BaseException as raised:  # goes on in _ask
            self._interruption = raised
        while True:
            yield 1

    @property
    def _most_steps(self) -> int:
        return _LEAST_STEPS + _STEPS_A_BYTE * self._size

    def _find(self, table: str) -> Collection[str]:
        """The columns of a table, as far as its rows hold them. Raises McaptrackError for a view or the like."""
        columns = [(_text(row[1]), row[6]) for row in self._ask(f'PRAGMA main.table_xinfo("{table}")')]
        if not columns:
            return ()
        query = f"SELECT sql FROM main.sqlite_master WHERE name = '{table}' COLLATE NOCASE"  # noqa: S608
        made_by = [_text(row[0]) for row in self._ask(query)]
        # SQLite goes by the text alone, and writes it like this, whatever was typed.
        if not (made_by and all(text.startswith("CREATE TABLE ") for text in made_by)):
            raise McaptrackError(f"{self.path}: {table} is no ordinary table; views and virtual tables are not read")
        computed = [name for name, kind in columns if kind != _ORDINARY]
        if computed:
            raise McaptrackError(f"{self.path}: the column {computed[0]} of {table} is computed; stored ones are read")
        return {name for name, _ in columns}

    def _guard(self) -> None:
        """From now on nothing but the tables can be read."""
        allowed = {table.lower() for table, columns in self._columns.items() if columns}

        def may(action: int, first: str | None, second: str | None, _: str | None, view: str | None) -> int:
            harmless = {
                sqlite3.SQLITE_READ: (first or "").lower() in allowed,
                sqlite3.SQLITE_SELECT: True,
                sqlite3.SQLITE_FUNCTION: second == "sum",
            }
            return sqlite3.SQLITE_OK if view is None and harmless.get(action) else sqlite3.SQLITE_DENY

        self._database.set_authorizer(may)

    def _ask(self, query: str) -> Iterator[tuple[Any, ...]]:
        self._steps = 0
        try:
            yield from self._database.execute(query)
        except (sqlite3.Error, UnicodeDecodeError, OverflowError) as error:  # SQLite quotes what is damaged
            if self._interruption is not None:
                raise self._interruption from None
            why = "it can't be understood" if isinstance(error, UnicodeDecodeError) else str(error)
            if self._steps > self._most_steps:
                why = "its tables go on for longer than the file can"
            raise McaptrackError(f"{self.path} is damaged: {why}") from None


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
