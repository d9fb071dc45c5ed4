"""Tables as text: CSV (RFC 4180), and JSON lines with an object for each row.

Missing values are empty in CSV and null in JSON; numbers that JSON does not have are "Infinity", "-Infinity" and "NaN",
as in protobuf's JSON. Times are ISO 8601 with nanoseconds. Lists in CSV are JSON.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
from collections.abc import Iterable, Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any

_PIECE = 16_384


def write(path: Path, pieces: Iterable[Any], form: str) -> None:
    """Write a table in pieces as "csv" or "jsonl". Raises RuntimeError if it does not read back identically."""
    written = hashlib.sha256()
    with path.open("xb") as stream:
        for number, table in enumerate(pieces):
            for piece in csv(table, has_header=number == 0) if form == "csv" else json_lines(table):
                written.update(piece)
                stream.write(piece)
    with path.open("rb") as stream:
        reread = hashlib.file_digest(stream, "sha256").hexdigest()
    if reread != written.hexdigest():
        raise RuntimeError(f"{path}: what was written can't be read back")


def json_lines(table: Any) -> Iterator[bytes]:
    """A table as JSON, one object a line."""
    for row in rows(table):
        yield (json.dumps(row, ensure_ascii=False, allow_nan=False) + "\n").encode("utf-8")


def csv(table: Any, has_header: bool = True) -> Iterator[bytes]:
    """A table as CSV, by default with a header."""
    import pyarrow as pa
    from pyarrow.csv import WriteOptions, write_csv

    for number, field in enumerate(table.schema):
        if pa.types.is_timestamp(field.type):
            table = table.set_column(number, field.name, iso(table.column(number)))
        elif pa.types.is_dictionary(field.type):
            table = table.set_column(number, field.name, table.column(number).cast(pa.string()))
        elif pa.types.is_nested(field.type) or pa.types.is_binary(field.type):
            values = [
                None if value is None else json.dumps(_plain(value)) for value in table.column(number).to_pylist()
            ]
            table = table.set_column(number, field.name, pa.array(values, pa.string()))
    for start in range(0, max(table.num_rows, 1), _PIECE):
        piece = io.BytesIO()
        write_csv(table.slice(start, _PIECE), piece, WriteOptions(include_header=has_header and start == 0))
        yield piece.getvalue()


def iso(column: Any) -> Any:
    """Times as text, with their number of decimals; a Z if they are in UTC."""
    import pyarrow as pa
    import pyarrow.compute as pc

    texts = column.cast(pa.timestamp(column.type.unit)).cast(pa.string())
    return pc.binary_join_element_wise(pc.replace_substring(texts, " ", "T"), "Z" if column.type.tz else "", "")


def rows(table: Any) -> Iterator[dict[str, Any]]:
    """The rows of a table with values that JSON supports."""
    import pyarrow as pa

    for number, field in enumerate(table.schema):
        if pa.types.is_timestamp(field.type):
            table = table.set_column(number, field.name, iso(table.column(number)))
    for batch in table.to_batches(_PIECE):
        for row in batch.to_pylist():
            yield {name: _plain(value) for name, value in row.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    if isinstance(value, bytes):
        import base64

        return base64.b64encode(value).decode("ascii")
    if isinstance(value, list | tuple):
        return [_plain(member) for member in value]
    if isinstance(value, dict):
        return {name: _plain(member) for name, member in value.items()}
    if isinstance(value, Decimal):
        return float(value)
    if value is not None and not isinstance(value, str | int | float):
        return str(value)  # dates within lists
    return value
