"""Tables without text of their own: Parquet, Arrow and Feather, JSON lines, and JSON of rows as pandas writes it.

Columns are those of tables with a header (``delimited``).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.sources.ingest.labels.delimited import SEPARATOR, Csv, Opened, hold_places, records, with_lists
from mcaptrack.sources.ingest.labels.format import MAX_LINE, LabelFile

if TYPE_CHECKING:
    import pyarrow as pa

_PARQUET: Final = b"PAR1"
_ARROW: Final = b"ARROW1"
#: The beginning of a stream of Arrow, which is like that of no text.
_STREAM: Final = b"\xff\xff\xff\xff"


class Records(Csv):
    """Tables that other programs write, of boxes in pictures and in metres."""

    title = "tables in Parquet, Arrow, Feather or JSON"
    row = "the same columns in Parquet, Arrow or Feather, in JSON lines, or in a JSON list of objects"
    rank = 3

    def recognises(self, file: LabelFile) -> bool:
        """Whether a file begins so, or is JSON of rows with a place in each."""
        is_stream = file.head.startswith(_STREAM) and not file.head.startswith(2 * _STREAM)  # as parts of videos do
        if file.head.startswith((_PARQUET, _ARROW)) or is_stream or file.has_json_lines:
            return True
        try:
            return file.is_json and hold_places(records(file).header)
        except McaptrackError:
            return False

    def header(self, file: LabelFile) -> list[str]:
        """The names of columns."""
        return self.opened(file).header

    def opened(self, file: LabelFile) -> Opened:
        """The columns of a file, and its rows as texts."""
        return records(file) if file.is_json else _of_arrow(file)


def _of_arrow(file: LabelFile) -> Opened:
    import pyarrow as pa
    import pyarrow.parquet as pq

    path, schema = file.path, pa.schema([])
    batches: Iterator[pa.RecordBatch]
    try:
        source = pa.OSFile(str(path))
        if file.head.startswith(_PARQUET):
            table = pq.ParquetFile(source)
            schema, batches = table.schema_arrow, table.iter_batches()
        elif file.head.startswith(_ARROW):
            reader = pa.ipc.open_file(source)
            schema, batches = reader.schema, map(reader.get_batch, range(reader.num_record_batches))
        else:
            stream = pa.ipc.open_stream(source)
            schema, batches = stream.schema, iter(stream)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise McaptrackError(f"{path} is no table that can be read: {str(error).splitlines()[0][:200]}") from None

    def flattened(table: pa.Table) -> pa.Table:
        """A table with the fields of structures as columns of their own, named with a dot."""
        return table.flatten() if any(map(pa.types.is_struct, table.schema.types)) else table

    others = (pa.types.is_binary, pa.types.is_large_binary, pa.types.is_struct)  # which can't be read as texts
    fields = flattened(pa.Table.from_batches([], schema)).schema
    names = [field.name for field in fields if not any(is_other(field.type) for is_other in others)]

    def lines() -> Iterator[tuple[int, str]]:
        number = 0
        try:
            for batch in batches:
                part = flattened(pa.Table.from_batches([batch])).select(names)
                for row in zip(*map(_texts, part.columns), strict=True):
                    number += 1
                    yield number, SEPARATOR.join(row)
        except (pa.ArrowException, OSError, ValueError) as error:
            raise McaptrackError(f"{path}: after row {number}: {str(error).splitlines()[0][:200]}") from None

    return with_lists(Opened(path, 1, names, lines(), lambda line: line.split(SEPARATOR)))


def _texts(column: pa.ChunkedArray) -> Iterable[str]:
    """The values of a column as texts; "" for none."""
    import pyarrow as pa

    kind = column.type
    if not (pa.types.is_nested(kind) or pa.types.is_string(kind)):
        column = column.cast(pa.string())
    return ("" if value is None else str(value).replace(SEPARATOR, " ")[:MAX_LINE] for value in column.to_pylist())
