"""Arrays and records -> Arrow tables with the columns of ``fields``, and back.

Letters: N rows, M messages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.ragged import group_index
from mcaptrack.schema import Frame, Rows, Schema
from mcaptrack.schema.classes import PERSON, majority
from mcaptrack.schema.framing import split_rows
from mcaptrack.tables.fields import CLASS, RECORDING, TABLES, Table

_BITS: Final = 16
#: The name of people where a channel names no classes.
_PERSON: Final = "person"


class Part(NamedTuple):
    """The rows of one channel (N,), and the time, frame and number of rows of each message (M,)."""

    rows: Rows
    t_ns: Ints
    frame: Ints
    counts: Ints


class Pointers(NamedTuple):
    """The messages of one channel (M,): time, frame, number of rows (-1 for pictures), and their places in a file.

    ``chunk_offset`` is -1 for messages outside of chunks.
    """

    file: str
    t_ns: Ints
    frame: Ints
    rows: Ints
    chunk_offset: Ints
    message_offset: Ints


def frames_to_part(schema: Schema, frames: Sequence[Frame]) -> Part:
    """Frames as the arrays from which tables are made."""
    t_ns, index = (np.array([getattr(frame, name) for frame in frames], np.int64) for name in ("t_ns", "index"))
    counts = np.array([len(frame.rows) for frame in frames], np.int64)
    return Part(np.concatenate([schema.empty(), *(frame.rows for frame in frames)]), t_ns, index, counts)


def table_of(schema: Schema) -> Table:
    """The table for rows of a schema."""
    return next(table for table in TABLES.values() if table.rows_of is schema)


class TrackNames(NamedTuple):
    """The names of the classes of tracks by their ids: of the tracks that rows are about, and of the ground truth."""

    tracks: Mapping[int, str] = {}
    truth: Mapping[int, str] = {}


def rows_table(
    schema: Schema,
    channels: Mapping[str, Part | Sequence[Frame]],
    names: Mapping[str, Mapping[int, str]] = {},
    of_tracks: Mapping[str, TrackNames] = {},
) -> Any:
    """All rows of channels of one schema as an Arrow table, in the table's order; missing numbers are null.

    ``names`` are the names of classes by their number, for each channel that names any; ``of_tracks`` those of tracks,
    for each channel with rows about tracks of another one.
    """
    import pyarrow as pa

    table = table_of(schema)
    members = {
        topic: part if isinstance(part, tuple) else frames_to_part(schema, part)
        for topic, part in sorted(channels.items())
    }
    pieces = [_rows_of(schema, table, Part(*part)) for part in members.values()]
    own = [field.name for field in table.arrow if field.name not in ("topic", CLASS.name)]
    columns = {name: pa.chunked_array([piece[name] for piece in pieces], table.arrow.field(name).type) for name in own}
    if table.is_of_tracks():
        columns[CLASS.name] = _names_of_tracks(pieces, [of_tracks.get(topic, TrackNames()) for topic in members])
    elif CLASS.name in table.arrow.names:
        ids = [np.asarray(piece["class_id"]) for piece in pieces]
        columns[CLASS.name] = _class_column(ids, [names.get(topic, {}) for topic in members])
    columns["topic"] = _repeated(list(members), [len(part[0]) for part in members.values()])
    return pa.table([columns[field.name] for field in table.arrow], schema=table.arrow)


def names_by_track(rows: Rows, names: Mapping[int, str]) -> dict[int, str]:
    """The names of the classes of tracks by id, as far as they have one; ``names`` are those of classes by number."""
    ids, track = np.unique(rows["track_id"].astype(np.int64), return_inverse=True)
    known = {PERSON: _PERSON, **names}
    classes = majority(track, rows["class_id"], len(ids)).tolist()
    return {one: known[of] for one, of in zip(ids.tolist(), classes, strict=True) if of in known}


def _names_of_tracks(pieces: Sequence[Mapping[str, Any]], names: Sequence[TrackNames]) -> Any:
    """The names of the classes of tracks as an Arrow dictionary; for rows without a track, of the ground truth."""
    words: dict[str, int] = {}
    codes = []
    for piece, known in zip(pieces, names, strict=True):
        ids = np.asarray(piece["track_id"])
        code = _codes(ids, known.tracks, words)
        if "truth_id" in piece:
            code = np.where(ids >= 0, code, _codes(np.asarray(piece["truth_id"]), known.truth, words))
        codes.append(code)
    return _dictionary(codes, words)


def _class_column(ids: Sequence[NDArray[Any]], names: Sequence[Mapping[int, str]]) -> Any:
    """The names of classes as an Arrow dictionary; ``ids`` and ``names`` are those of each channel."""
    words: dict[str, int] = {}
    known = {PERSON: _PERSON}
    parts = zip(ids, names, strict=True)
    return _dictionary([_codes(some, {**known, **of_channel}, words) for some, of_channel in parts], words)


def _codes(numbers: NDArray[Any], names: Mapping[int, str], words: dict[str, int]) -> NDArray[np.int32]:
    """The places of names in ``words``, to which new ones are added; -1 for numbers without a name."""
    there, which = np.unique(numbers, return_inverse=True)
    called = [names.get(number) for number in there.tolist()]
    of = [-1 if name is None else words.setdefault(name, len(words)) for name in called]
    return np.array(of, np.int32)[which]


def _dictionary(codes: Sequence[NDArray[np.int32]], words: Mapping[str, int]) -> Any:
    """Names as an Arrow dictionary; null for -1."""
    import pyarrow as pa

    joined = np.concatenate([np.empty(0, np.int32), *codes])
    return pa.DictionaryArray.from_arrays(pa.array(joined, mask=joined < 0), pa.array(list(words), pa.string()))


def _rows_of(schema: Schema, table: Table, part: Part) -> dict[str, Any]:
    """The columns of one channel, except its topic."""
    import pyarrow as pa

    message = group_index(part.counts)
    rows, order = part.rows, None
    if "track_id" in table.order:
        order = _stable_order(rows["track_id"])
        message = message[order]
    t_ns = part.t_ns[message]
    number = np.arange(len(rows)) if order is None else order
    out = {"frame": pa.array(part.frame[message]), "t": _times(t_ns), "t_ns": pa.array(t_ns), "row": pa.array(number)}
    for column in schema.columns:
        values = np.ascontiguousarray(rows[column.name]) if order is None else rows[column.name][order]
        missing = np.isnan(values) if column.is_nullable else None
        out[column.name] = pa.array(values, mask=missing if missing is not None and missing.any() else None)
    return out


def _stable_order(values: NDArray[Any]) -> Ints:
    """A stable argsort of whole numbers, 16 bits at a time, for which NumPy uses radix sort."""
    if len(values) == 0:
        return np.empty(0, np.int64)
    low, high = int(values.min()), int(values.max())
    order = np.arange(len(values))
    rest = values.astype(np.uint64) - np.uint64(low % 2**64)
    for shift in range(0, max((high - low).bit_length(), 1), _BITS):
        digit = (rest >> np.uint64(shift)).astype(np.uint16)
        order = order[np.argsort(digit[order], kind="stable")]
    return order


def frames_table(channels: Mapping[str, Pointers]) -> Any:
    """The table ``frames`` of channels, by topic."""
    import pyarrow as pa

    parts = dict(sorted(channels.items()))
    counts = [len(part.t_ns) for part in parts.values()]

    def joined(name: str) -> Ints:
        return np.concatenate([np.empty(0, np.int64), *(getattr(part, name) for part in parts.values())])

    t_ns, rows, chunk = joined("t_ns"), joined("rows"), joined("chunk_offset")
    schema = TABLES["frames"].arrow
    columns = {
        "topic": _repeated(list(parts), counts),
        "frame": pa.array(joined("frame")),
        "t": _times(t_ns),
        "t_ns": pa.array(t_ns),
        "rows": pa.array(rows, mask=rows < 0),
        "file": _repeated([part.file for part in parts.values()], counts),
        "chunk_offset": pa.array(chunk, mask=chunk < 0),
        "message_offset": pa.array(joined("message_offset")),
    }
    return pa.table([columns[name] for name in schema.names], schema=schema)


def summary_table(channels: Mapping[str, Part], names: Mapping[str, Mapping[int, str]] = {}) -> Any:
    """The table ``track_summary`` of channels of tracks; ``names`` as in ``rows_table``."""
    import pyarrow as pa

    table = TABLES["track_summary"]
    parts = {topic: _summary(part) for topic, part in sorted(channels.items())}
    columns = {}
    for field in table.fields[1:]:
        if field is CLASS:
            continue
        values = np.concatenate([part[field.name] for part in parts.values()]) if parts else np.empty(0)
        if field.kind == "time":
            columns[field.name] = _times(values.astype(np.int64))
            continue
        missing = np.isnan(values) if field.nullable else None
        columns[field.name] = pa.array(values, table.arrow.field(field.name).type, mask=missing)
    columns["topic"] = _repeated(list(parts), [len(part["rows"]) for part in parts.values()])
    ids = [part["class_id"] for part in parts.values()]
    columns[CLASS.name] = _class_column(ids, [names.get(topic, {}) for topic in parts])
    return pa.table([columns[name] for name in table.arrow.names], schema=table.arrow)


def _summary(part: Part) -> dict[str, NDArray[Any]]:
    """One row for each track of a channel."""
    order = _stable_order(part.rows["track_id"])
    rows = part.rows[order]
    message = group_index(part.counts)[order]
    t_ns, frame = part.t_ns[message], part.frame[message]
    ids, first, count = np.unique(rows["track_id"], return_index=True, return_counts=True)
    last = first + count - 1
    out: dict[str, NDArray[Any]] = {"track_id": ids, "rows": count}
    for name, at in (("first", first), ("last", last)):
        out |= {f"{name}_t_ns": t_ns[at], f"{name}_t": t_ns[at], f"{name}_frame": frame[at]}
    out["duration_s"] = (t_ns[last] - t_ns[first]) / 1e9
    track = group_index(count)
    share = np.bincount(track, rows["observed"], len(ids))
    out["class_id"] = majority(track, rows["class_id"], len(ids))
    out["observed_share"] = share / np.maximum(count, 1)
    place = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
    out |= _motion(place, t_ns, track, len(ids))
    for unit in ("m", "px"):
        ends = _ends(np.isfinite(rows[f"x_{unit}"]) & np.isfinite(rows[f"y_{unit}"]), first, last)
        for name, at in zip(("first", "last"), ends, strict=True):
            for axis in "xy":
                found = rows[f"{axis}_{unit}"][at] if len(rows) else np.empty(0)
                out[f"{name}_{axis}_{unit}"] = np.where(at < 0, np.nan, found)
    return out


def _motion(place: Floats, t_ns: Ints, track: Ints, tracks: int) -> dict[str, Floats]:
    """Path and speeds of tracks over their known positions; NaN for a track without any."""
    known = np.isfinite(place).all(axis=1)
    place, t_ns, track = place[known], t_ns[known], track[known]
    same = track[1:] == track[:-1]
    step_m = np.hypot(*(place[1:] - place[:-1]).T)[same]
    step_s, of = (t_ns[1:] - t_ns[:-1])[same] / 1e9, track[1:][same]
    has = np.bincount(track, minlength=tracks) > 0
    path = np.where(has, np.bincount(of, step_m, tracks), np.nan)
    passed = np.bincount(of, step_s, tracks)
    fastest = np.full(tracks, -1.0)
    moving = step_s > 0
    np.maximum.at(fastest, of[moving], step_m[moving] / step_s[moving])
    mean = np.divide(path, passed, out=np.full(tracks, np.nan), where=passed > 0)
    return {"path_m": path, "mean_speed_m_s": mean, "max_speed_m_s": np.where(fastest < 0, np.nan, fastest)}


def _ends(known: NDArray[np.bool_], first: Ints, last: Ints) -> tuple[Ints, Ints]:
    """The first and last known position between ``first`` and ``last`` of each track; -1 if there is none."""
    at = np.flatnonzero(known)
    if len(at) == 0:
        return np.full(len(first), -1), np.full(len(first), -1)
    low = np.searchsorted(at, first)
    high = np.searchsorted(at, last, "right") - 1
    none = low > high
    return tuple(np.where(none, -1, at[np.clip(end, 0, len(at) - 1)]) for end in (low, high))  # type: ignore[return-value]


def records_table(table: Table, records: Sequence[Mapping[str, Any]]) -> Any:
    """A table about a log from its records; missing values are null."""
    import pyarrow as pa

    kinds = {field.name: field.type for field in table.arrow}
    columns = []
    for name, kind in kinds.items():
        values = [record.get(name) for record in records]
        columns.append(
            pa.array(values, pa.string()).dictionary_encode().cast(kind)
            if pa.types.is_dictionary(kind)
            else pa.array(values, kind)
        )
    return pa.table(columns, schema=table.arrow)


def with_recording(table: Any, recording: str) -> Any:
    """The table with the column ``recording`` that reading a folder adds, also at the end."""
    return table.append_column(RECORDING.arrow, _repeated([recording], [table.num_rows]))


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
            words = column.cast(pa.string())
            arrays[field.name] = np.array(words.fill_null("").to_pylist(), np.str_).reshape(-1)
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


def columns_of(rows: Any) -> dict[str, NDArray[Any]]:
    """The columns (N,) of a table of any library that speaks Arrow: pyarrow, pandas, Polars, DuckDB.

    Raises McaptrackError for what Arrow cannot hold.
    """
    import pyarrow as pa

    try:
        table = pa.table(rows)
    except (pa.ArrowException, TypeError, ValueError) as error:
        raise McaptrackError(f"the table cannot be read as Arrow: {' '.join(str(error).split())}") from None
    if len(set(table.column_names)) < len(table.column_names):
        raise McaptrackError(f"the table has columns of the same name: {', '.join(table.column_names)}")
    is_decimal = {field.name: pa.types.is_decimal(field.type) for field in table.schema}
    return {
        name: (column.cast(pa.float64()) if is_decimal[name] else column).to_numpy()
        for name, column in zip(table.column_names, table.columns, strict=True)
    }


def table_to_frames(schema: Schema, rows: Any, frames: Any, topic: str) -> list[Frame]:
    """The frames of one channel, also empty ones, from its table of rows and the table of frames."""
    rows, frames = rows_of_topic(rows, topic), rows_of_topic(frames, topic)
    order = np.argsort(rows.column("row").to_numpy(), kind="stable")
    columns = {}
    for column in schema.columns:
        if column.since and column.name not in rows.column_names:  # an older table
            continue
        values = rows.column(column.name).combine_chunks()
        values = values.fill_null(column.missing) if column.optional else values
        columns[column.name] = values.to_numpy(zero_copy_only=False)[order]
    members = schema.rows(**columns)
    times, numbers, counts = (frames.column(name).to_pylist() for name in ("t_ns", "frame", "rows"))
    return split_rows(times, numbers, members, np.cumsum(counts))


def _repeated(names: Sequence[str], counts: Sequence[int]) -> Any:
    """Each name, repeated by its count, as an Arrow dictionary."""
    import pyarrow as pa

    different = list(dict.fromkeys(names))
    numbers = np.array([different.index(name) for name in names], np.int32)
    at = np.repeat(numbers, np.array(counts, np.int64))
    return pa.DictionaryArray.from_arrays(pa.array(at, pa.int32()), pa.array(different, pa.string()))


def _times(t_ns: Ints) -> Any:
    import pyarrow as pa

    return pa.array(t_ns).cast(pa.timestamp("ns", tz="UTC"))
