"""An Arrow table that is made piece by piece, because it may take more than the memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final

#: Rows of a piece, and of a row group in a file.
PIECE_ROWS: Final = 128 * 1024


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
        import pyarrow as pa

        waiting, count, is_first = [self.schema.empty_table()], 0, True
        for table in self._make():
            waiting.append(table)
            count += table.num_rows
            if self._most_bytes is not None and sum(one.nbytes for one in waiting) >= self._most_bytes:
                yield pa.concat_tables(waiting)
                waiting, count, is_first = [self.schema.empty_table()], 0, False
            if count < PIECE_ROWS:
                continue
            whole = pa.concat_tables(waiting)
            end = count - count % PIECE_ROWS
            for start in range(0, end, PIECE_ROWS):
                yield whole.slice(start, PIECE_ROWS)
            rest = whole.slice(end)  # copied, because a slice keeps what it is a part of
            waiting, count, is_first = [rest.take(pa.array(range(rest.num_rows), pa.int64()))], count - end, False
            del whole
        if count or is_first:
            yield pa.concat_tables(waiting)

    def table(self) -> Any:
        """The whole table."""
        import pyarrow as pa

        return pa.concat_tables([self.schema.empty_table(), *self._make()])


def pieces_of(table: Any) -> Iterable[Any]:
    """The pieces of a table, either an Arrow table or ``TablePieces``."""
    if isinstance(table, TablePieces):
        return table
    return TablePieces(table.schema, table.num_rows, lambda: [table])
