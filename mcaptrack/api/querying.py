"""Answer queries in SQL, and list the tables that can be queried."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mcaptrack.api.common import as_path, detail, locations_of
from mcaptrack.api.declared import checked
from mcaptrack.api.options import PathLike
from mcaptrack.tables import RECORDING, TABLES

if TYPE_CHECKING:
    import pyarrow as pa


@checked()
def query(
    log: PathLike | Sequence[PathLike],
    sql: str,
    *,
    files: Mapping[str, PathLike] | None = None,
) -> pa.Table:
    """Query the tables of logs in SQL. Needs DuckDB.

    Parameters
    ----------
    log : path or sequence of paths
        Logs, or folders of tables; the column ``recording`` tells several apart.
    sql : str
        The query.
    files : mapping of str to path, optional
        CSV, JSON or Parquet files as more tables, by name.

    Returns
    -------
    pyarrow.Table
        The answer; times are UTC.

    Raises
    ------
    McaptrackError
        If a log cannot be read, and for what DuckDB refuses.

    Examples
    --------
    >>> import mcaptrack
    >>> mcaptrack.query("log.mcap", "select count(*) > 0 as found from tracks").to_pydict()
    {'found': [True]}

    """
    from mcaptrack.tables.sql import Database

    named = {name: as_path(path) for name, path in (files or {}).items()}
    with Database(locations_of(log), named) as database:
        answer = database.ask(sql)
        for note in database.notes:
            detail(note)
    return answer


@dataclass(frozen=True)
class ColumnInfo:
    """A column of a table.

    Attributes
    ----------
    name, type : str
        Its name and the type of its values, such as "int64" or "text".
    unit : str
        The unit of its values; "" if they have none.
    meaning : str
        What it holds.

    """

    name: str
    type: str
    unit: str
    meaning: str


@dataclass(frozen=True)
class TableInfo:
    """A table that every log has.

    Attributes
    ----------
    name, meaning : str
        Its name, and what a row of it is.
    columns : tuple of ColumnInfo
        Its columns, in order.

    """

    name: str
    meaning: str
    columns: tuple[ColumnInfo, ...]


@dataclass(frozen=True)
class TableList:
    """The tables that queries can name.

    Attributes
    ----------
    tables : tuple of TableInfo
        The tables of every log.
    recordings : tuple of str
        The names of the logs in the column ``recording``.
    channels : tuple of str
        Topics of channels, which are tables under their names in double quotes.

    """

    tables: tuple[TableInfo, ...]
    recordings: tuple[str, ...]
    channels: tuple[str, ...]


@checked()
def list_tables(log: PathLike | Sequence[PathLike] = (), *, files: Mapping[str, PathLike] | None = None) -> TableList:
    """List the tables that queries can name, with their columns, units and meanings.

    Parameters
    ----------
    log : path or sequence of paths, optional
        Logs, or folders of tables, to list recordings and channels of; needs DuckDB.
    files : mapping of str to path, optional
        As for ``query``: files that would be tables are checked.

    Returns
    -------
    TableList
        The tables, and the recordings and channels of the logs.

    Raises
    ------
    McaptrackError
        If a log or a file cannot be read.

    Examples
    --------
    >>> import mcaptrack
    >>> found = mcaptrack.list_tables("log.mcap")
    >>> found.tables[0].name, found.recordings
    ('frames', ('log',))

    """
    tables = tuple(
        TableInfo(
            table.name,
            table.doc,
            tuple(
                ColumnInfo(
                    name=field.name,
                    type="text" if str(field.type).startswith(("dictionary", "string")) else str(field.type),
                    unit=field.metadata[b"unit"].decode(),
                    meaning=field.metadata[b"description"].decode(),
                )
                for field in (*table.arrow, RECORDING.arrow)
            ),
        )
        for table in TABLES.values()
    )
    paths = locations_of(log)
    if not paths:
        return TableList(tables, (), ())
    from mcaptrack.tables.sql import Database

    with Database(paths, {name: as_path(path) for name, path in (files or {}).items()}) as database:
        return TableList(tables, database.recordings, database.channels)
