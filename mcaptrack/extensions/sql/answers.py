"""Answers of queries: Arrow tables of any types, as all formats support them, and as files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from mcaptrack import tables
from mcaptrack.errors import McaptrackError
from mcaptrack.files import publish


def tidy(table: Any) -> Any:
    """An answer with unique column names and types that all formats support; sums of whole numbers become int64 if
    possible.

    The second of two columns ``a`` is ``a_1``; intervals become text.
    """
    import pyarrow as pa

    names: list[str] = []
    for name in table.schema.names:
        unique = (f"{name}_{number}" if number else name for number in range(len(table.schema.names) + 1))
        names.append(next(name for name in unique if name not in names))
    columns = []
    for column in table.columns:
        kind = column.type
        if pa.types.is_decimal(kind) and kind.scale == 0:
            try:
                column = column.cast(pa.int64())  # noqa: PLW2901
            except pa.ArrowInvalid:
                column = column.cast(pa.string())  # noqa: PLW2901
        elif pa.types.is_decimal(kind):
            column = column.cast(pa.float64())  # noqa: PLW2901
        elif kind == pa.month_day_nano_interval():
            column = pa.array([_interval(value) for value in column.to_pylist()], pa.string())  # noqa: PLW2901
        columns.append(column)
    return pa.table(columns, names=names)


def _interval(value: Any) -> str | None:
    """An interval as DuckDB prints it: 1 month 2 days 00:00:01.5."""
    if value is None:
        return None
    years = math.trunc(value.months / 12)
    calendar = ((years, "year"), (value.months - 12 * years, "month"), (value.days, "day"))
    parts = [f"{count} {name}{'s' * (abs(count) != 1)}" for count, name in calendar if count]
    sign, rest = "-" * (value.nanoseconds < 0), abs(value.nanoseconds)
    if rest or not parts:
        seconds, nanos = divmod(rest, 10**9)
        fraction = f".{nanos:09d}".rstrip("0") if nanos else ""
        parts.append(f"{sign}{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}{fraction}")
    return " ".join(parts)


def write_answer(path: Path, table: Any, form: str) -> None:
    """Write an answer to a file, which appears when it is complete. Raises McaptrackError if it can't be written.

    ``form`` is its format: "csv", "json", "jsonl", "parquet" or "arrow".
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with publish(path) as part, part.open("xb") as stream:
            if form == "parquet":
                pq.write_table(table, stream, compression="zstd")
            elif form == "arrow":
                with pa.ipc.new_file(stream, table.schema) as writer:
                    writer.write_table(table)
            else:
                for piece in tables.pieces(table, form):  # type: ignore[arg-type]
                    stream.write(piece)
    except (OSError, pa.ArrowException) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise McaptrackError(f"{path} can't be written: {reason}") from error
