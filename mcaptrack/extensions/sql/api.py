"""Answer queries in SQL, and list the tables that can be queried."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Final

from mcaptrack.api.common import as_path, detail, locations_of
from mcaptrack.api.declared import PYTHON_ONLY, Argument, Option, declared, done_by
from mcaptrack.api.options import PathLike

if TYPE_CHECKING:
    import pyarrow as pa
else:
    pa = SimpleNamespace(Table=object)  # help doesn't import pyarrow

#: Heading of options in the help.
QUERY: Final = "Query and answer"


@declared(heading="Results", printed_by="mcaptrack.extensions.sql.command:Query")
def query(
    log: Annotated[
        PathLike | Sequence[PathLike],
        Argument(
            "words",
            "LOG... QUERY",
            "Logs, patterns or folders of tables, then the query in quotes; - reads it from standard input.",
            words=True,
        ),
    ],
    sql: Annotated[str, PYTHON_ONLY],
    *,
    files: Annotated[
        Mapping[str, PathLike] | None, Option(QUERY, flag="with", metavar="NAME=FILE", shown=False)
    ] = None,
    worlds: Annotated[bool, Option(QUERY)] = False,
) -> pa.Table:
    """Query the tables of logs in SQL: who was where, and how fast.

    The tables are those of `mcaptrack export` (`mcaptrack docs tables`); the column `recording` names the log. They are
    read from the files beside the log if those are up to date, otherwise from the log. Each other channel is a table
    under its topic in double quotes. Queries read nothing else and change nothing. Needs DuckDB (`pip install duckdb`).
    `mcaptrack docs sql` has examples.

    Parameters
    ----------
    log : path or sequence of paths
        Logs, or folders of tables.
    sql : str
        The query.
    files : mapping of str to path, optional
        A CSV, JSON or Parquet file as one more table.
    worlds : bool, default False
        Ask `tracks` in each world of `retrack --worlds`: median and 90 % interval of each number.

    Returns
    -------
    pyarrow.Table
        The answer; times are UTC. With ``worlds``, each number ``n`` is a median, with the interval in ``n_from`` and
        ``n_to``; rows are told apart by their texts and times.

    Raises
    ------
    McaptrackError
        If a log cannot be read, and for what DuckDB refuses.

    Examples
    --------
    On the command line:

        mcaptrack query log.mcap "select topic, count(distinct track_id) from tracks group by topic"

        mcaptrack query 'runs/*.mcap' -f speed.sql -o speed.csv

    >>> import mcaptrack
    >>> mcaptrack.query("log.mcap", "select count(*) > 0 as found from tracks").to_pydict()
    {'found': [True]}

    """
    from mcaptrack.extensions.sql.database import Database

    named = {name: as_path(path) for name, path in (files or {}).items()}
    with Database(locations_of(log), named) as database:
        answer = database.ask_worlds(sql) if worlds else database.ask(sql)
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


@done_by("query", tables=True)
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
    from mcaptrack.tables import RECORDING, TABLES

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
    from mcaptrack.extensions.sql.database import Database

    with Database(paths, {name: as_path(path) for name, path in (files or {}).items()}) as database:
        return TableList(tables, database.recordings, database.channels)
