"""Parquet files of mcaptrack or of other tools, as arrays and frames."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.schema import Frame
from mcaptrack.schema.framing import split_rows


def read_columns(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Columns of a Parquet file as arrays, missing numbers as NaN.

    Raises McaptrackError if it is no Parquet file or lacks a column.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with path.open("rb") as stream:  # a single file: the names of its folders are no columns
            table = pq.read_table(stream)
    except OSError as error:
        raise McaptrackError(f"{path} can't be read: {error.strerror or error}") from None
    except pa.ArrowException as error:
        raise McaptrackError(f"{path} is no Parquet file that can be read: {str(error).splitlines()[0]}") from None
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
    file = _parquet(path)
    return set(_OF_TRACKS) <= set(file.schema_arrow.names) and file.metadata.num_rows > 0


def read_tracks(path: Path) -> dict[str, list[Frame]]:
    """The tracks of a Parquet file with these columns, as frames by topic ("" without topics).

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
    t_ns, track_id = (np.asarray(table.column(name).to_numpy()).astype(np.int64) for name in _OF_TRACKS[:2])
    x_m, y_m = (np.asarray(table.column(name).to_numpy(), np.float64) for name in _OF_TRACKS[2:])
    topic = np.array(table.column("topic").to_pylist()) if "topic" in names else np.full(count, "")
    observed = table.column("observed").to_numpy().astype(bool) if "observed" in names else np.ones(count, bool)
    nowhere = np.full(count, np.nan)
    out = {}
    for name in np.unique(topic).tolist():
        mine = np.flatnonzero((topic == name) & np.isfinite(x_m) & np.isfinite(y_m))
        mine = mine[np.lexsort((track_id[mine], t_ns[mine]))]
        given = {"track_id": track_id, "x_m": x_m, "y_m": y_m, "observed": observed, "source_id": np.full(count, -1)}
        given |= dict.fromkeys(("x_px", "y_px", "w_px", "h_px", "score"), nowhere)
        rows = TRACKS.rows(**{column: values[mine] for column, values in given.items()})
        times, first = np.unique(t_ns[mine], return_index=True)
        out[name] = split_rows(times, range(len(times)), rows, np.append(first[1:], len(mine)))
    return out


def _parquet(path: Path) -> Any:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.ParquetFile(pa.OSFile(os.fsencode(path)))  # a name with a colon would be taken for a URL
    except (OSError, pa.ArrowException) as error:
        raise McaptrackError(f"{path} can't be read as Parquet: {error}") from None
