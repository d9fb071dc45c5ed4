"""Read the tables of untrusted SQLite files row by row, and nothing else that their schema can contain.

An SQLite schema is a program: views, virtual tables and generated columns, and pages that are referenced repeatedly,
can run forever or produce gigabytes from a small file. Tables are therefore read completely and in order, the output is
limited by the size of the file, and signals interrupt every query. Nothing is written beside the file.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Generator, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.bags.unpacking import copy
from mcaptrack.files import follow_links, refuse_special, temporary_folder

#: Virtual machine steps of SQLite between two checks for signals: a few milliseconds.
_STEPS: Final = 100_000
#: The step limit of a query: a minimum, and steps per byte of the file. A row takes about ten steps.
_MIN_STEPS, _STEPS_PER_BYTE = 2_000_000, 4
#: The minimum size of a row in the file.
_ROW_BYTES: Final = 6
#: UTF-16 text grows in UTF-8, by at most half.
_MAX_EXPANSION: Final = 1.5
#: The size limit of a value, the same as for messages of a log.
_MAX_VALUE_BYTES: Final = 2**28
#: The length limit of SQL text, including the schema.
_MAX_SQL_BYTES: Final = 2**20
#: Bytes appended to a rollback journal, so that SQLite reads no name of a master journal from its end.
_JOURNAL_END: Final = bytes(16)
#: The value in PRAGMA table_xinfo for columns that are neither hidden nor generated.
_ORDINARY: Final = 0


class SqliteTables:
    """An SQLite file, open for reading. Raises McaptrackError, in one line, for everything that is wrong with it."""

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
            self._restrict_to_tables()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._close.close()

    def columns(self, table: str) -> Collection[str]:
        """The columns of one of the tables; empty if there is no such table."""
        return self._columns[table]

    def rows(
        self, table: str, columns: Sequence[str], where: tuple[str, object] | None = None
    ) -> Generator[tuple[Any, ...]]:
        """These columns of all rows, or of those ``where`` a column has a value, in table order; text as bytes."""
        names = ", ".join(f'"{name}"' for name in columns)
        chosen = f' WHERE "{where[0]}" IS ?' if where else ""
        left = int(_MAX_EXPANSION * self._size)
        for row in self._query(f'SELECT {names} FROM "{table}" NOT INDEXED{chosen}', where[1:] if where else ()):  # noqa: S608
            left -= _ROW_BYTES + sum(len(value) for value in row if isinstance(value, bytes))
            if left < 0:
                raise McaptrackError(f"{self.path} is damaged: its table {table} holds more than the file can")
            yield row

    def count(self, table: str) -> int:
        """The number of rows of a table, by its index if there is one."""
        ((count,),) = self._query(f'SELECT sum(1) FROM "{table}"')  # noqa: S608  # count(*) would not check for signals
        return count or 0

    def _opened(self) -> sqlite3.Connection:
        path, is_copy = follow_links(self.path), False
        # A killed recorder leaves a journal that belongs to the file. It is opened in a copy, because opening it
        # writes.
        journals = [path.with_name(path.name + end) for end in ("-wal", "-journal")]
        left = [other for other in journals if other.is_file() and other.stat().st_size]
        if left:
            folder = Path(self._close.enter_context(temporary_folder()))
            for other in (path, *left):
                copy(other, folder / other.name)
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
        limits = {"LENGTH": _MAX_VALUE_BYTES, "SQL_LENGTH": _MAX_SQL_BYTES, "EXPR_DEPTH": 50, "COMPOUND_SELECT": 2}
        limits |= {"ATTACHED": 0, "WORKER_THREADS": 0, "TRIGGER_DEPTH": 1}
        for name, most in limits.items():
            database.setlimit(getattr(sqlite3, f"SQLITE_LIMIT_{name}"), most)
        if hasattr(database, "setconfig"):  # from Python 3.12 on
            for name, wanted in (("DEFENSIVE", True), ("ENABLE_TRIGGER", False), ("ENABLE_VIEW", False)):
                database.setconfig(getattr(sqlite3, f"SQLITE_DBCONFIG_{name}"), wanted)
        self._steps, self._watching = 0, self._watch()
        database.set_progress_handler(self._watching.__next__, _STEPS)
        self._database = database
        for pragma in ("trusted_schema=OFF", "cell_size_check=ON", "mmap_size=0"):
            list(self._query(f"PRAGMA {pragma}"))
        return database

    def _watch(self) -> Iterator[int]:
        """Yields 1 to abort the query, otherwise 0.

        A generator, so that exceptions of signal handlers are raised inside it; SQLite would swallow them.
        """
        try:
            while True:
                yield int(self._steps > self._max_steps)
                self._steps += _STEPS
        except GeneratorExit:
            raise
        except BaseException as raised:  # raised again in _query
            self._interruption = raised
        while True:
            yield 1

    @property
    def _max_steps(self) -> int:
        return _MIN_STEPS + _STEPS_PER_BYTE * self._size

    def _find(self, table: str) -> Collection[str]:
        """The stored columns of a table. Raises McaptrackError for views, virtual tables and generated columns."""
        columns = [(text_of(row[1]), row[6]) for row in self._query(f'PRAGMA main.table_xinfo("{table}")')]
        if not columns:
            return ()
        query = f"SELECT sql FROM main.sqlite_master WHERE name = '{table}' COLLATE NOCASE"  # noqa: S608
        made_by = [text_of(row[0]) for row in self._query(query)]
        # SQLite normalises the SQL text to this form, and decides by it.
        if not (made_by and all(text.startswith("CREATE TABLE ") for text in made_by)):
            raise McaptrackError(
                f"{self.path}: {table} is not an ordinary table; views and virtual tables are not read"
            )
        computed = [name for name, kind in columns if kind != _ORDINARY]
        if computed:
            raise McaptrackError(f"{self.path}: the column {computed[0]} of {table} is computed; stored ones are read")
        return {name for name, _ in columns}

    def _restrict_to_tables(self) -> None:
        """Deny everything but reading these tables from now on."""
        allowed = {table.lower() for table, columns in self._columns.items() if columns}

        def may(action: int, first: str | None, second: str | None, _: str | None, view: str | None) -> int:
            harmless = {
                sqlite3.SQLITE_READ: (first or "").lower() in allowed,
                sqlite3.SQLITE_SELECT: True,
                sqlite3.SQLITE_FUNCTION: second == "sum",
            }
            return sqlite3.SQLITE_OK if view is None and harmless.get(action) else sqlite3.SQLITE_DENY

        self._database.set_authorizer(may)

    def _query(self, query: str, values: Sequence[Any] = ()) -> Iterator[tuple[Any, ...]]:
        self._steps = 0
        try:
            yield from self._database.execute(query, values)
        except (sqlite3.Error, UnicodeDecodeError, OverflowError) as error:  # messages of SQLite may quote damaged text
            if self._interruption is not None:
                raise self._interruption from None
            why = "it can't be understood" if isinstance(error, UnicodeDecodeError) else str(error)
            if self._steps > self._max_steps:
                why = "its tables go on for longer than the file can"
            saved = "; `sqlite3 FILE .recover` may save a part of it" if "malformed" in why else ""
            raise McaptrackError(f"{self.path} is damaged: {why}{saved}") from None


def text_of(value: Any) -> str:
    """The text of a value, which may be bytes or of another type."""
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else "" if value is None else str(value)
