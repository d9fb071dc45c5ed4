"""Arrays and records -> Arrow tables with the columns of ``fields``, and back.

Letters: M messages.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError, in_one_line
from mcaptrack.geometry.arrays import Ints
from mcaptrack.schema import Schema
from mcaptrack.sources.own_rows import ColumnOfUser, facts_of
from mcaptrack.tables.fields import RECORDING, TABLES, Table, of_rows

#: Whole numbers up to this are exact as float64.
_EXACT: Final = 2**53


class Pointers(NamedTuple):
    """The messages of one channel (M,): time, frame, number of rows (-1 for pictures), and their places in a file.

    ``chunk_offset`` is -1 for messages outside of chunks.

    ``message_offset`` is the place of the message in its chunk, or in the file without one.
    """

    file: str
    t_ns: Ints
    frame: Ints
    rows: Ints
    chunk_offset: Ints
    message_offset: Ints


def table_of(schema: Schema) -> Table:
    """The table for rows of a schema."""
    return next((table for table in TABLES.values() if table.rows_of is schema), None) or of_rows(schema)


def frames_table(topic: str, messages: Pointers, names: Sequence[str] = ()) -> Any:
    """The rows of a channel in the table ``frames``, of which ``names`` are all topics and files.

    ``messages`` are those of the channel ``topic``.
    """
    import pyarrow as pa

    file, t_ns, frame, rows, chunk, message = messages
    schema, counts = TABLES["frames"].arrow, [len(t_ns)]
    columns = {
        "topic": repeated([topic], counts, names),
        "frame": pa.array(frame),
        "t": times(t_ns),
        "t_ns": pa.array(t_ns),
        "rows": pa.array(rows, mask=rows < 0),
        "file": repeated([file], counts, names),
        "chunk_offset": pa.array(chunk, mask=chunk < 0),
        "message_offset": pa.array(message),
    }
    return pa.table([columns[name] for name in schema.names], schema=schema)


def records_table(table: Table, records: Sequence[Mapping[str, Any]]) -> Any:
    """A table about a log from its records; missing values are null."""
    import pyarrow as pa

    return pa.Table.from_pylist(records, table.arrow)


def with_recording(table: Any, recording: str) -> Any:
    """The table with the column ``recording`` that reading a folder adds, also at the end."""
    return table.append_column(RECORDING.arrow, repeated([recording], [table.num_rows]))


def rows_of_topic(table: Any, topic: str) -> Any:
    """The rows of one channel."""
    import pyarrow.compute as pc

    return table.filter(pc.equal(table.column("topic").cast("string"), topic))


def table_to_array(table: Any) -> NDArray[Any]:
    """A table as a structured array: times as datetime64[ns], text as str, missing numbers as NaN.

    Columns of whole numbers with missing values become float64.
    """
    import pyarrow as pa

    arrays = {}
    for field in table.schema:
        column = table.column(field.name)
        if pa.types.is_dictionary(field.type) or pa.types.is_string(field.type):
            strings = column.cast(pa.string())
            arrays[field.name] = np.array(strings.fill_null("").to_pylist(), np.str_).reshape(-1)
        elif pa.types.is_timestamp(field.type):
            arrays[field.name] = column.cast(pa.int64()).to_numpy().astype("datetime64[ns]")
        elif pa.types.is_floating(field.type) and column.null_count:
            arrays[field.name] = column.fill_null(np.nan).to_numpy()
        else:
            arrays[field.name] = column.to_numpy()
    out = np.empty(table.num_rows, [(name, values.dtype) for name, values in arrays.items()])
    for name, values in arrays.items():
        out[name] = values
    return out


def as_arrow(rows: Any) -> Any:
    """A table of any library that speaks Arrow (pyarrow, pandas, Polars, DuckDB) as one of pyarrow.

    Raises McaptrackError for what Arrow cannot hold.

    ``rows`` is that table.
    """
    import pyarrow as pa

    try:
        table = pa.table(rows)
    except (pa.ArrowException, TypeError, ValueError) as error:
        raise McaptrackError(f"the table cannot be read as Arrow: {in_one_line(error)}") from None
    if len(set(table.column_names)) < len(table.column_names):
        raise McaptrackError(f"the table has columns of the same name: {', '.join(table.column_names)}")
    return table


def columns_of(table: Any) -> dict[str, NDArray[Any]]:
    """The columns (N,) of a table of Arrow; whole numbers of which some are missing become float64, exactly.

    Raises McaptrackError if they can't, because they are too large.
    """
    import pyarrow as pa

    out = {}
    for field, column in zip(table.schema, table.columns, strict=True):
        out[field.name] = (column.cast(pa.float64()) if pa.types.is_decimal(field.type) else column).to_numpy()
        if pa.types.is_boolean(field.type) and column.null_count:
            raise McaptrackError(
                f"the column {field.name} has flags, and some are missing, which rows can't say: give numbers"
            )
        if pa.types.is_integer(field.type) and column.null_count and (np.abs(out[field.name]) > _EXACT).any():
            raise McaptrackError(
                f"the column {field.name} has whole numbers above 2^53, and some are missing; rows can't hold both"
            )
    return out


def columns_of_arrow(schema: Any) -> list[ColumnOfUser]:
    """The columns of a schema of Arrow, with units and descriptions; those of other types than numbers as objects."""
    import pyarrow as pa

    def dtype(kind: Any) -> Any:
        if pa.types.is_decimal(kind):
            return np.float64
        is_number = pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind)
        return kind.to_pandas_dtype() if is_number else "M8[ns]" if pa.types.is_temporal(kind) else object

    out = []
    for field in pa.schema(schema):
        texts = {key.decode(): value.decode("utf-8", "replace") for key, value in (field.metadata or {}).items()}
        out.append(ColumnOfUser(field.name, np.dtype(dtype(field.type)), *facts_of(texts)))
    return out


def repeated(names: Sequence[str], counts: Sequence[int], among: Sequence[str] = ()) -> Any:
    """Each name, repeated by its count, as an Arrow dictionary; ``among`` are all names that it has, if more."""
    import pyarrow as pa

    different = list(dict.fromkeys(among or names))
    numbers = np.array([different.index(name) for name in names], np.int32)
    at = np.repeat(numbers, np.array(counts, np.int64))
    return pa.DictionaryArray.from_arrays(pa.array(at, pa.int32()), pa.array(different, pa.string()))


def times(t_ns: Ints) -> Any:
    """Times in ns as an Arrow array of times in UTC."""
    import pyarrow as pa

    return pa.array(t_ns).cast(pa.timestamp("ns", tz="UTC"))


# An Arrow table that is made piece by piece, because it may take more than the memory.


#: Rows of a piece, and of a row group in a file.
PIECE_ROWS: Final = 128 * 1024


class PendingRows:
    """Rows that wait for others, until they are a piece of ``PIECE_ROWS`` rows, or of at least ``most_bytes``."""

    def __init__(self, schema: Any, most_bytes: int | None = None) -> None:
        self._schema, self._most_bytes = schema, most_bytes
        self._start([])

    def _start(self, tables: list[Any]) -> None:
        self._tables = tables
        self.rows, self.nbytes = sum(table.num_rows for table in tables), sum(table.nbytes for table in tables)

    def add(self, table: Any) -> Iterator[Any]:
        """Add rows; gives the pieces that are whole."""
        import pyarrow as pa

        self._tables.append(table)
        self.rows += table.num_rows
        self.nbytes += table.nbytes
        if self._most_bytes is not None and self.nbytes >= self._most_bytes:
            yield self.rest()
        elif self.rows >= PIECE_ROWS:
            whole = self.rest()
            end = whole.num_rows - whole.num_rows % PIECE_ROWS
            for start in range(0, end, PIECE_ROWS):
                yield whole.slice(start, PIECE_ROWS)
            rest = whole.slice(end)  # copied, because a slice keeps what it is a part of
            self._start([rest.take(pa.array(range(rest.num_rows), pa.int64()))])

    def rest(self) -> Any:
        """The rows that wait, of which none do then."""
        import pyarrow as pa

        tables = [self._schema.empty_table(), *self._tables]
        self._start([])
        return pa.concat_tables(tables)


class TablePieces:
    """A table in pieces of ``PIECE_ROWS`` rows, which are made again each time they are read.

    Parameters
    ----------
    schema : pyarrow.Schema
    num_rows : int
    make : callable
        Gives the rows as Arrow tables of any size.
    most_bytes : int, optional
        A piece ends earlier if its rows take more bytes.
    """

    def __init__(
        self, schema: Any, num_rows: int, make: Callable[[], Iterable[Any]], most_bytes: int | None = None
    ) -> None:
        self.schema, self.num_rows, self._make, self._most_bytes = schema, num_rows, make, most_bytes

    def __iter__(self) -> Iterator[Any]:
        """The pieces; at least one, which may be empty."""
        waiting, is_first = PendingRows(self.schema, self._most_bytes), True
        for table in self._make():
            for piece in waiting.add(table):
                yield piece
                is_first = False
                del piece
        if waiting.rows or is_first:
            yield waiting.rest()

    def table(self) -> Any:
        """The whole table."""
        import pyarrow as pa

        return pa.concat_tables([self.schema.empty_table(), *self._make()])


def pieces_of(table: Any) -> Iterable[Any]:
    """The pieces of a table, either an Arrow table or ``TablePieces``."""
    if isinstance(table, TablePieces):
        return table
    return TablePieces(table.schema, table.num_rows, lambda: [table])
