"""Answers of queries: Arrow tables of any types, as files, as text, and as cells for a terminal.

Text has exact numbers and times; whole numbers of more than 64 bits, intervals and dates are text. Cells have six
decimals.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, Literal

from mcaptrack.errors import McaptrackError
from mcaptrack.files import publish
from mcaptrack.tables import text

#: The formats of answers.
ANSWERS: Final = ("csv", "json", "jsonl", "parquet", "arrow")
_DIGITS: Final = 6


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


def pieces(table: Any, form: Literal["csv", "json", "jsonl"]) -> Iterator[bytes]:
    """An answer as text; ``json`` is an array with an object for each row."""
    flat = _for_text(table)
    if form == "csv":
        yield from text.csv(flat)
    elif form == "jsonl":
        yield from text.json_lines(flat)
    else:
        between = b"[\n "
        for line in text.json_lines(flat):
            yield between + line.rstrip(b"\n")
            between = b",\n "
        yield b"[]\n" if between == b"[\n " else b"\n]\n"


def write_answer(path: Path, table: Any, form: str) -> None:
    """Write an answer to a file, which appears when it is complete. Raises McaptrackError if it can't be written."""
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
                for piece in pieces(table, form):  # type: ignore[arg-type]
                    stream.write(piece)
    except (OSError, pa.ArrowException) as error:
        words = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise McaptrackError(f"{path} can't be written: {words}") from error


def cells(table: Any, limit: int) -> tuple[list[bool], list[list[str | None]]]:
    """The first rows of an answer for a terminal: which columns are numbers, and the texts of each row, None for
    null.
    """
    import pyarrow as pa

    numbers = [pa.types.is_integer(field.type) or pa.types.is_floating(field.type) for field in table.schema]
    rows = text.rows(_for_text(table.slice(0, limit)))
    return numbers, [[_word(value) for value in row.values()] for row in rows]


def _word(value: Any) -> str | None:
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        small = value != 0 and abs(value) < 10**-_DIGITS * 10
        if small or abs(value) >= 1e15:
            return f"{value:.{_DIGITS}g}"
        return f"{value:.{_DIGITS}f}".rstrip("0").rstrip(".")
    if isinstance(value, list | tuple):
        return f"[{', '.join(_word(member) or 'null' for member in value)}]"
    if isinstance(value, dict):
        members = [f"{name}: {_word(member) or 'null'}" for name, member in value.items()]
        return f"{{{', '.join(members)}}}"
    return str(value)


def _for_text(table: Any) -> Any:
    """Dates, times of day and lists of times as text; ``text`` handles the other types."""
    import pyarrow as pa

    for number, field in enumerate(table.schema):
        column, kind = table.column(number), field.type
        if pa.types.is_date(kind) or pa.types.is_time(kind) or pa.types.is_duration(kind):
            column = column.cast(pa.string())
        elif pa.types.is_list(kind) and pa.types.is_timestamp(kind.value_type):
            column = column.cast(pa.list_(pa.string()))
        else:
            continue
        table = table.set_column(number, field.name, column)
    return table


def _interval(value: Any) -> str | None:
    """An interval as DuckDB prints it: 1 month 2 days 00:00:01.5."""
    if value is None:
        return None
    words = [f"{count} {name}{'s' * (abs(count) != 1)}" for count, name in _calendar(value) if count]
    sign, rest = "-" * (value.nanoseconds < 0), abs(value.nanoseconds)
    if rest or not words:
        seconds, nanos = divmod(rest, 10**9)
        fraction = f".{nanos:09d}".rstrip("0") if nanos else ""
        words.append(f"{sign}{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}{fraction}")
    return " ".join(words)


def _calendar(value: Any) -> Sequence[tuple[int, str]]:
    years = math.trunc(value.months / 12)
    return ((years, "year"), (value.months - 12 * years, "month"), (value.days, "day"))
