"""Tables of rows, and tables as files: one row for each object in each frame; metadata hold units and provenance.

TABLES                               all tables with their columns
rows_in_pieces(schema, channels)     rows -> Arrow; missing numbers are null in tables and NaN in rows
write(path, table, provenance)       Arrow -> Parquet, Arrow IPC, CSV or JSON lines
verify(path)                         check that a file holds what was written
join(parts)                          the same table of several logs as one
read_tracks(path), read_columns(...) files -> arrays and frames, also of files from other tools
"""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.files import unreadable
from mcaptrack.geometry.clocks import FIRST_DATE_NS, NS_PER_S
from mcaptrack.schema import Frame
from mcaptrack.schema.framing import split_rows
from mcaptrack.tables import text
from mcaptrack.tables.build import (
    Pointers,
    TablePieces,
    as_arrow,
    columns_of,
    columns_of_arrow,
    frames_table,
    records_table,
    rows_of_topic,
    table_of,
    table_to_array,
    with_recording,
)
from mcaptrack.tables.catalogue import join
from mcaptrack.tables.fields import RECORDING, TABLES, table_version
from mcaptrack.tables.files import FORMATS, ParquetTable, file_metadata, opened_parquet, verify, write
from mcaptrack.tables.messages import MessageSource, MessagesTable, TypedMessages, inferred_table, typed_table
from mcaptrack.tables.rows import TrackNames, names_by_track, rows_in_pieces, summary_table

# Parquet files of mcaptrack or of other tools, as arrays and frames.


def read_columns(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Columns of a Parquet file as arrays, missing numbers as NaN.

    Raises McaptrackError if it is no Parquet file or lacks a column.

    ``names`` are those of the columns.
    """
    import pyarrow as pa

    with opened_parquet(path) as file:
        table = file.read()
    missing = [name for name in names if name not in table.column_names]
    if missing:
        raise McaptrackError(f"{path} has no column {', '.join(missing)}; an exported table of tracks has")
    out = {}
    for name in names:
        column = table.column(name)
        if pa.types.is_dictionary(column.type):
            column = column.cast(pa.string())
        if pa.types.is_floating(column.type):
            column = column.fill_null(np.nan)
        out[name] = column.to_numpy()
    return out


#: Required columns of tracks in metres; ``topic`` and ``observed`` are optional.
_OF_TRACKS: Final = ("t_ns", "track_id", "x_m", "y_m")


def holds_tracks(path: Path) -> bool:
    """Whether a Parquet file holds rows of tracks in metres. Raises McaptrackError if it is no Parquet file."""
    with opened_parquet(path) as file:
        return set(_OF_TRACKS) <= set(file.schema_arrow.names) and file.metadata.num_rows > 0


def read_tracks(path: Path) -> dict[str, list[Frame]]:
    """The tracks of a Parquet file with these columns, as frames by topic ("" without topics).

    Raises McaptrackError if it holds none.
    """
    from mcaptrack.schema import TRACKS

    with opened_parquet(path) as file:
        names = file.schema_arrow.names
        missing = [name for name in _OF_TRACKS if name not in names]
        if missing:
            raise McaptrackError(f"{path} has no column {', '.join(missing)}; tracks need {', '.join(_OF_TRACKS)}")
        table = file.read([*_OF_TRACKS, *(name for name in ("topic", "observed") if name in names)])
    if table.num_rows == 0:
        raise McaptrackError(f"{path} has no rows")
    count = table.num_rows
    t_ns, track_id = (np.asarray(table.column(name).to_numpy()).astype(np.int64) for name in _OF_TRACKS[:2])
    x_m, y_m = (np.asarray(table.column(name).to_numpy(), np.float64) for name in _OF_TRACKS[2:])
    topic = np.array(table.column("topic").to_pylist()) if "topic" in names else np.full(count, "")
    observed = table.column("observed").to_numpy().astype(bool) if "observed" in names else np.ones(count, bool)
    nowhere = np.full(count, np.nan)
    out = {}
    for name in np.unique(topic).tolist():
        mine = np.flatnonzero((topic == name) & np.isfinite(x_m) & np.isfinite(y_m))
        mine = mine[np.lexsort((track_id[mine], t_ns[mine]))]
        columns = {"track_id": track_id, "x_m": x_m, "y_m": y_m, "observed": observed, "source_id": np.full(count, -1)}
        columns |= dict.fromkeys(("x_px", "y_px", "w_px", "h_px", "score"), nowhere)
        rows = TRACKS.rows(**{column: values[mine] for column, values in columns.items()})
        times, first = np.unique(t_ns[mine], return_index=True)
        out[name] = split_rows(times, range(len(times)), rows, np.append(first[1:], len(mine)))
    return out


# Answers of queries: Arrow tables of any types, as files, as text, and as cells for a terminal.
#
# Text has exact numbers and times; whole numbers of more than 64 bits, intervals and dates are text. Cells have six
# decimals.


_DIGITS: Final = 6


def pieces(table: Any, form: Literal["csv", "json", "jsonl"]) -> Iterator[bytes]:
    """An answer as text; ``json`` is an array with an object for each row.

    ``form`` is that format.
    """
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


#: The decimals of each unit of times.
_DECIMALS: Final = {"s": 0, "ms": 3, "us": 6, "ns": 9}


def cells(table: Any, limit: int) -> tuple[list[bool], list[list[str | None]]]:
    """The first rows of an answer for a terminal: which columns are numbers, and the texts of each row, None for
    null.

    ``limit`` is how many rows.
    """
    import pyarrow as pa

    numbers = [pa.types.is_integer(field.type) or pa.types.is_floating(field.type) for field in table.schema]
    shown = table.slice(0, limit)
    for number, field in enumerate(shown.schema):
        if pa.types.is_timestamp(field.type):
            shown = shown.set_column(number, field.name, _times(shown.column(number)))
    rows = text.rows(_for_text(shown))
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


def _times(column: Any) -> Any:
    """Times as text with the decimals that one of them needs; in seconds if none is a date."""
    import pyarrow as pa

    try:
        t_ns = column.cast(pa.timestamp("ns", column.type.tz)).cast(pa.int64()).to_pylist()
    except pa.ArrowInvalid:  # later than nanoseconds of 64 bits reach
        return text.iso(column)
    decimals = max((len(f"{t % NS_PER_S:09d}".rstrip("0")) for t in t_ns if t is not None), default=0)
    if all(t is None or 0 <= t < FIRST_DATE_NS for t in t_ns):
        return pa.array([None if t is None else f"{t / NS_PER_S:.{decimals}f} s" for t in t_ns], pa.string())
    unit = next(unit for unit, digits in _DECIMALS.items() if decimals <= digits)
    return text.iso(column.cast(pa.timestamp(unit, column.type.tz)))


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
