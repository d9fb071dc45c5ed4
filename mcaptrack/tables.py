"""Rows as Parquet: one row an object a frame, with units, meaning and provenance in the metadata.

Floats are split by byte and whole numbers stored as differences, which makes files smaller and writing faster than the
defaults. Missing numbers are null in tables and NaN in rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.atomic import publish
from mcaptrack.errors import McaptrackError
from mcaptrack.schema import Frame, Schema

#: Version of the tables' columns; columns are only ever added.
TABLE_VERSION: Final = "1"
_ROW_GROUP: Final = 128 * 1024

_TIME_FIELDS: Final = (
    ("topic", "channel of the log that the row comes from"),
    ("frame", "frame number of the video, from 0"),
    ("t", "log time"),
    ("t_ns", "log time as a whole number, exact"),
)


def _fixed_fields() -> list[Any]:
    """topic, frame, t, t_ns: the columns that every table of rows begins with."""
    import pyarrow as pa

    kinds = (pa.dictionary(pa.int32(), pa.string()), pa.int64(), pa.timestamp("ns", tz="UTC"), pa.int64())
    units = ("", "", "", "ns")
    return [
        pa.field(name, kind, nullable=False, metadata={"description": words} | ({"unit": unit} if unit else {}))
        for (name, words), kind, unit in zip(_TIME_FIELDS, kinds, units, strict=True)
    ]


def rows_table(schema: Schema, channels: Mapping[str, Sequence[Frame]]) -> Any:
    """All rows of channels of one schema as one Arrow table, ordered as the channels and in time."""
    import pyarrow as pa

    fields = [*_fixed_fields(), *schema.arrow]
    frames = [(topic, frame) for topic, members in channels.items() for frame in members]
    counts = np.array([len(frame.rows) for _, frame in frames], np.int64)
    rows = np.concatenate([schema.empty(), *(frame.rows for _, frame in frames)])
    t_ns = np.repeat(np.array([frame.t_ns for _, frame in frames], np.int64), counts)
    index = np.repeat(np.array([frame.index for _, frame in frames], np.int64), counts)
    columns = [_topics([topic for topic, _ in frames], counts), pa.array(index), _times(t_ns), pa.array(t_ns)]
    for column in schema.columns:
        values = np.ascontiguousarray(rows[column.name])
        columns.append(pa.array(values, mask=np.isnan(values) if column.optional else None))
    return pa.table(columns, schema=pa.schema(fields))


def frames_table(channels: Mapping[str, Sequence[tuple[int, int, int]]]) -> Any:
    """One row a message: topic, frame, time, and how many rows it holds; null for pictures.

    ``channels`` maps topics to tuples of time, frame and number of rows (-1 for pictures). With it a frame in which
    nothing was seen is told from one at which nobody looked.
    """
    import pyarrow as pa

    words = {"description": "rows of the message; null for a picture"}
    schema = pa.schema([*_fixed_fields(), pa.field("rows", pa.int64(), metadata=words)])
    entries = np.array([entry for members in channels.values() for entry in members], np.int64).reshape(-1, 3)
    counts = np.array([len(members) for members in channels.values()], np.int64)
    t_ns, index, rows = entries.T
    columns = [
        _topics(list(channels), counts),
        pa.array(index),
        _times(t_ns),
        pa.array(t_ns),
        pa.array(rows, mask=rows < 0),
    ]
    return pa.table(columns, schema=schema)


def channels_table(channels: Sequence[Mapping[str, Any]]) -> Any:
    """One row a channel: topic, schema, messages, and how it was made."""
    import pyarrow as pa

    words = {
        "topic": "name of the channel",
        "schema": "name of its schema",
        "messages": "how many messages it holds",
        "transform": "what made it; null if it was recorded",
        "input": "topic it was made from",
        "version": "version of mcaptrack that made it",
        "parameters": "parameters it was made with, as JSON",
        "digest": "SHA-256 of its messages",
        "input_digest": "SHA-256 of the messages it was made from",
    }
    schema = pa.schema(
        [
            pa.field(n, pa.int64() if n == "messages" else pa.string(), metadata={"description": w})
            for n, w in words.items()
        ]
    )
    return pa.Table.from_pylist([dict(channel) for channel in channels], schema=schema)


def _topics(topics: Sequence[str], counts: NDArray[np.int64]) -> Any:
    import pyarrow as pa

    names = list(dict.fromkeys(topics))
    at = np.repeat(np.array([names.index(topic) for topic in topics], np.int32), counts)
    return pa.DictionaryArray.from_arrays(pa.array(at, pa.int32()), pa.array(names, pa.string()))


def _times(t_ns: NDArray[np.int64]) -> Any:
    import pyarrow as pa

    return pa.array(t_ns).cast(pa.timestamp("ns", tz="UTC"))


def table_to_frames(schema: Schema, rows: Any, frames: Any, topic: str) -> list[Frame]:
    """The way back: the frames of one channel, empty ones too, from its table of rows and the table of frames."""
    import pyarrow.compute as pc

    def mine(table: Any) -> Any:
        return table.filter(pc.equal(table.column("topic").cast("string"), topic))

    rows, frames = mine(rows), mine(frames)
    columns = {}
    for column in schema.columns:
        values = rows.column(column.name).combine_chunks()
        values = values.fill_null(np.nan) if column.optional else values
        columns[column.name] = values.to_numpy(zero_copy_only=False)
    members = schema.rows(**columns)
    ends = np.cumsum(np.array(frames.column("rows").to_pylist(), np.int64)).tolist()
    spans = zip(
        frames.column("t_ns").to_pylist(), frames.column("frame").to_pylist(), [0, *ends][:-1], ends, strict=True
    )
    return [Frame(t_ns, index, members[low:high]) for t_ns, index, low, high in spans]


def read_columns(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Columns of a Parquet file as arrays, missing numbers as NaN.

    Raises McaptrackError if it is no Parquet file or lacks a column.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with path.open("rb") as stream:  # a file alone: what its folders are called is no column
            table = pq.read_table(stream)
    except OSError as error:
        raise McaptrackError(f"{path} can't be read: {error.strerror or error}") from None
    except pa.ArrowException as error:
        raise McaptrackError(f"{path} is no Parquet file that can be read: {str(error).splitlines()[0]}") from None
    missing = [name for name in names if name not in table.column_names]
    if missing:
        raise McaptrackError(
            f"{path} has no column {', '.join(missing)}; a table of tracks as `mcaptrack export` writes it has"
        )
    out = {}
    for name in names:
        column = table.column(name)
        if pa.types.is_dictionary(column.type):
            column = column.cast(pa.string())
        if pa.types.is_floating(column.type):
            column = column.fill_null(np.nan)
        out[name] = column.to_numpy()
    return out


#: What a table needs so that its rows are tracks in metres; ``topic`` and ``observed`` count if they are there.
_OF_TRACKS: Final = ("t_ns", "track_id", "x_m", "y_m")


def holds_tracks(path: Path) -> bool:
    """Whether a Parquet file holds rows of tracks in metres. Raises McaptrackError if it is no Parquet file."""
    file = _parquet(path)
    return set(_OF_TRACKS) <= set(file.schema_arrow.names) and file.metadata.num_rows > 0


def read_tracks(path: Path) -> dict[str, list[Frame]]:
    """The tracks of a Parquet file, ours or another with the same columns, as frames by topic ("" where none is named).

    Raises McaptrackError if it holds none.
    """
    from mcaptrack.schema import TRACKS

    names = _parquet(path).schema_arrow.names
    missing = [name for name in _OF_TRACKS if name not in names]
    if missing:
        raise McaptrackError(f"{path} has no column {', '.join(missing)}; tracks need {', '.join(_OF_TRACKS)}")
    table = _parquet(path).read([*_OF_TRACKS, *(name for name in ("topic", "observed") if name in names)])
    if table.num_rows == 0:
        raise McaptrackError(f"{path} has no rows")
    count = table.num_rows
    t_ns, who = (np.asarray(table.column(name).to_numpy()).astype(np.int64) for name in _OF_TRACKS[:2])
    x_m, y_m = (np.asarray(table.column(name).to_numpy(), np.float64) for name in _OF_TRACKS[2:])
    topic = np.array(table.column("topic").to_pylist()) if "topic" in names else np.full(count, "")
    observed = table.column("observed").to_numpy().astype(bool) if "observed" in names else np.ones(count, bool)
    nowhere = np.full(count, np.nan)
    out = {}
    for name in np.unique(topic).tolist():
        mine = np.flatnonzero((topic == name) & np.isfinite(x_m) & np.isfinite(y_m))
        mine = mine[np.lexsort((who[mine], t_ns[mine]))]
        given = {"track_id": who, "x_m": x_m, "y_m": y_m, "observed": observed, "source_id": np.full(count, -1)}
        given |= dict.fromkeys(("x_px", "y_px", "w_px", "h_px", "score"), nowhere)
        rows = TRACKS.rows(**{column: values[mine] for column, values in given.items()})
        times, first = np.unique(t_ns[mine], return_index=True)
        ends = [*first[1:].tolist(), len(mine)]
        spans = zip(times.tolist(), first.tolist(), ends, strict=True)
        out[name] = [Frame(t, number, rows[low:high]) for number, (t, low, high) in enumerate(spans)]
    return out


def _parquet(path: Path) -> Any:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.ParquetFile(path)
    except (OSError, pa.ArrowException) as error:
        raise McaptrackError(f"{path} can't be read as Parquet: {error}") from None


def write(path: Path, table: Any, provenance: Mapping[str, str]) -> None:
    """Write an Arrow table as Parquet, there once it is complete and can be read back.

    ``provenance`` goes into the schema's metadata. Raises McaptrackError if the file can't be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    words = {"mcaptrack.table_version": TABLE_VERSION} | {
        f"mcaptrack.{key}": value for key, value in provenance.items()
    }
    table = table.replace_schema_metadata(words)
    encodings, dictionaries = {}, []
    for field in table.schema:
        if pa.types.is_floating(field.type):
            encodings[field.name] = "BYTE_STREAM_SPLIT"
        elif pa.types.is_integer(field.type) or pa.types.is_timestamp(field.type):
            encodings[field.name] = "DELTA_BINARY_PACKED"
        elif pa.types.is_string(field.type) or pa.types.is_dictionary(field.type):
            dictionaries.append(field.name)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with publish(path) as part:
            pq.write_table(
                table,
                part,
                row_group_size=_ROW_GROUP,
                compression="zstd",
                compression_level=3,
                use_dictionary=dictionaries,
                column_encoding=encodings,
                write_page_index=True,
                store_schema=True,
            )
            if pq.read_metadata(part).num_rows != table.num_rows:
                raise RuntimeError(
                    f"{table.num_rows} rows were written and {pq.read_metadata(part).num_rows} can be read"
                )
    except OSError as error:
        raise McaptrackError(f"{path} can't be written: {error.strerror or error}") from error
