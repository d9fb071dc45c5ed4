"""Rows of channels as Arrow tables, in pieces of bounded size; the summaries of tracks; the names of their classes.

Letters: N rows, K tracks.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.ragged import group_index
from mcaptrack.schema import Frame, Rows, Schema
from mcaptrack.schema.classes import PERSON, majority
from mcaptrack.schema.frame_columns import FrameColumns, collect
from mcaptrack.schema.framing import joined_parts, unique_values
from mcaptrack.schema.spill import SpillFile, Stored
from mcaptrack.tables.build import TablePieces, repeated, table_of, times
from mcaptrack.tables.fields import CLASS, TABLES, TRACK_CLASS, TRACK_TOPIC, Table

#: The name of people where a channel names no classes.
_PERSON: Final = "person"


class TrackNames(NamedTuple):
    """The names of the classes of tracks by their ids: of the tracks that rows are about, and of the ground truth;
    and the ``topic`` of the tracks that rows are about, "" if the log has none.
    """

    tracks: Mapping[int, str] = {}
    truth: Mapping[int, str] = {}
    topic: str = ""


# The rows of a channel in the order of its table, some at a time: a channel may have more than fit into memory.
#
# Rows of tracks are stored track by track. They are divided into groups of whole tracks, each of which fits into
# memory and is put in order by itself; a large channel is divided by way of a temporary file.
#
# Letters: N rows, G groups.


#: Rows of a group, unless one track has more; and how many groups there are at most, each of which has a buffer.
GROUP_ROWS: Final = 2**15
_MOST_GROUPS: Final = 256
#: Bytes of a group that are collected before they go into the file.
_BUFFER_BYTES: Final = 2**16
_BITS: Final = 16


class OrderedRows(NamedTuple):
    """Rows (N,) of a channel: themselves, the place of each among all of the channel, and the number of its frame."""

    rows: Rows
    place: Ints
    frame: Ints


def ordered_rows(schema: Schema, frames: FrameColumns, by_track: bool) -> Iterator[OrderedRows]:
    """All rows of a channel, some at a time: by time, or by track and then by time.

    Parameters
    ----------
    schema : Schema
        Of the rows; with ``by_track`` it has a column ``track_id``.
    frames : FrameColumns
    by_track : bool
        Whether the rows of each track are together; then no track is in two parts.

    Yields
    ------
    OrderedRows
    """
    if not by_track:
        for low, _, joined in joined_parts(schema, frames):
            first = int(frames.ends[low])
            yield OrderedRows(joined.rows, np.arange(first, first + len(joined.rows)), joined.frame + low)
    elif frames.ends[-1] <= GROUP_ROWS:
        yield _by_track(frames, frames.rows(), np.arange(frames.ends[-1]))
    else:
        yield from _divided(schema, frames)


def _by_track(frames: FrameColumns, rows: Rows, place: Ints) -> OrderedRows:
    """Put rows (N,) at places among all rows, which rise, in the order of their tracks."""
    order = stable_order(rows["track_id"])
    place = place[order]
    return OrderedRows(rows[order], place, np.searchsorted(frames.ends, place, "right") - 1)


def _divided(schema: Schema, frames: FrameColumns) -> Iterator[OrderedRows]:
    """All rows in groups of whole tracks."""
    last_of_group = _groups(schema, frames)
    layout = np.dtype([("place", np.int64), ("row", np.uint8, (schema.dtype.itemsize,))])
    waiting: list[list[NDArray[np.void]]] = [[] for _ in last_of_group]
    stored: list[list[Stored]] = [[] for _ in last_of_group]
    file = SpillFile()

    def put(group: int) -> None:
        stored[group].append(file.put(np.concatenate(waiting[group]).tobytes()))
        waiting[group].clear()

    for low, _, joined in joined_parts(schema, frames):
        group = np.searchsorted(last_of_group, joined.rows["track_id"])
        order = np.argsort(group, kind="stable")
        members = np.empty(len(order), layout)
        members["place"] = frames.ends[low] + order
        members["row"] = joined.rows.view(np.uint8).reshape(len(order), -1)[order]
        groups, starts = np.unique(group[order], return_index=True)
        for number, some in zip(groups.tolist(), np.split(members, starts[1:]), strict=True):
            waiting[number].append(some.copy())  # a part of ``members`` would keep all of it
            if sum(part.nbytes for part in waiting[number]) >= _BUFFER_BYTES:
                put(number)
    for number in range(len(last_of_group)):
        if waiting[number]:
            put(number)
        members = np.frombuffer(b"".join(file.get(piece) for piece in stored[number]), layout)
        rows = np.ascontiguousarray(members["row"]).view(schema.dtype)[:, 0]
        yield _by_track(frames, rows, members["place"])


def _groups(schema: Schema, frames: FrameColumns) -> Ints:
    """The last track of each group, (G,), rising."""
    ids, counts = np.empty(0, np.int64), np.empty(0, np.int64)
    for _, _, joined in joined_parts(schema, frames):
        some, here = np.unique(joined.rows["track_id"].astype(np.int64), return_counts=True)
        ids, which = np.unique(np.concatenate([ids, some]), return_inverse=True)
        counts = np.bincount(which, np.concatenate([counts, here]), len(ids)).astype(np.int64)
    group = (np.cumsum(counts) - 1) // max(GROUP_ROWS, int(counts.sum()) // _MOST_GROUPS)
    return np.asarray(ids[np.append(np.flatnonzero(np.diff(group)), len(ids) - 1)], np.int64)


def stable_order(values: NDArray[np.integer]) -> Ints:
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


def rows_in_pieces(
    schema: Schema,
    channels: Mapping[str, Sequence[Frame]],
    names: Mapping[str, Mapping[int, str]] = {},
    of_tracks: Mapping[str, TrackNames] = {},
    coded: Mapping[str, Mapping[int, str]] = {},
) -> TablePieces:
    """All rows of channels of one schema, piece by piece, in the table's order; missing numbers are null.

    ``names`` and ``coded`` are the names of classes and of ``Table.code`` by their number, for each channel that has
    its own; ``of_tracks`` what is known of tracks, for each channel with rows about those of another one.
    """
    import pyarrow as pa

    table = table_of(schema)
    members = {topic: collect(schema, frames) for topic, frames in sorted(channels.items())}
    named = {
        topic: _names_of(table, names.get(topic, {}), of_tracks.get(topic, TrackNames()), coded.get(topic, {}))
        for topic in members
    }
    places: dict[str, int] = {}
    for topic, frames in members.items():
        for column_names in named[topic]:
            column_names.collect(schema, frames, places)
    dictionary = pa.array(list(places), pa.string())

    def pieces() -> Iterator[Any]:
        for topic, frames in members.items():
            for part in ordered_rows(schema, frames, "track_id" in table.order):
                columns = _columns(schema, frames, part)
                columns["topic"] = repeated([topic], [len(part.rows)], list(members))
                for column_names in named[topic]:
                    codes = column_names.codes(part.rows, places)
                    columns[column_names.column] = pa.DictionaryArray.from_arrays(
                        pa.array(codes, mask=codes < 0), dictionary
                    )
                yield pa.table([columns[field.name] for field in table.arrow], schema=table.arrow)

    return TablePieces(table.arrow, sum(int(frames.ends[-1]) for frames in members.values()), pieces)


def _columns(schema: Schema, frames: FrameColumns, part: OrderedRows) -> dict[str, Any]:
    """The columns of rows of one channel, except its topic and the names of classes."""
    import pyarrow as pa

    t_ns = frames.t_ns[part.frame]
    out = {"frame": frames.numbers[part.frame], "t": times(t_ns), "t_ns": t_ns, "row": part.place}
    out = {name: pa.array(values) for name, values in out.items()}
    for column in schema.columns:
        values = np.ascontiguousarray(part.rows[column.name])
        missing = np.isnan(values) if column.is_nullable else None
        out[column.name] = pa.array(values, mask=missing if missing is not None and missing.any() else None)
    return out


class _Names(NamedTuple):
    """The names in a column of a channel's rows: the column, and names by the values of others.

    Without others, all rows have the name ``same``, or none if it is empty.
    """

    column: str
    by: tuple[tuple[str, Mapping[int, str]], ...]
    same: str = ""

    def collect(self, schema: Schema, frames: FrameColumns, places: dict[str, int]) -> None:
        """Add the names that occur to ``places``."""
        if self.same:
            places.setdefault(self.same, len(places))
        for column, names in self.by:
            if names:
                for number in unique_values(schema, frames, column).tolist():
                    if number in names:
                        places.setdefault(names[number], len(places))

    def codes(self, rows: NDArray[np.void], places: Mapping[str, int]) -> NDArray[np.int32]:
        """The places in ``places`` of the names of rows (N,); -1 for those without a name."""
        if not self.by:
            return np.full(len(rows), places.get(self.same, -1), np.int32)
        (column, names), *others = self.by
        out = _codes(rows[column], names, places)
        for other, of_other in others:
            out = np.where(rows[column] >= 0, out, _codes(rows[other], of_other, places))
        return out


def _names_of(table: Table, classes: Mapping[int, str], tracks: TrackNames, coded: Mapping[int, str]) -> list[_Names]:
    """The columns of names of a channel's rows.

    The class is that of each row if it has one, or of its track; for rows without a track, of the ground truth.
    """
    columns = []
    if table.is_of_tracks():
        has_truth = "truth_id" in table.arrow.names
        of_truth = (("truth_id", tracks.truth),) if has_truth else ()
        columns.append(_Names(TRACK_CLASS.name, (("track_id", tracks.tracks), *of_truth)))
        columns.append(_Names(TRACK_TOPIC.name, (), tracks.topic))
    elif CLASS.name in table.arrow.names:
        columns.append(_Names(CLASS.name, (("class_id", {PERSON: _PERSON, **classes}),)))
    if table.code:
        columns.append(_Names(table.code.beside.name, ((table.code.column, {**dict(table.code.names), **coded}),)))
    return columns


def _codes(numbers: NDArray[Any], names: Mapping[int, str], places: Mapping[str, int]) -> NDArray[np.int32]:
    """The places of names in ``places``; -1 for numbers without a name."""
    unique, which = np.unique(numbers, return_inverse=True)
    return np.array([places.get(names.get(number, ""), -1) for number in unique.tolist()], np.int32)[which]


def names_by_track(frames: FrameColumns, names: Mapping[int, str]) -> dict[int, str]:
    """The names of the classes of tracks by id, as far as they have one; ``names`` are those of classes by number.

    A track has the class of most of its rows; of several, the one that comes first.

    ``frames`` have the rows of the tracks.
    """
    counts: Counter[tuple[int, int]] = Counter()  # rows by track and class, in the order in which these appear
    for _, _, joined in joined_parts(frames.schema, frames):
        pairs = np.stack([joined.rows[name].astype(np.int64) for name in ("track_id", "class_id")], axis=1)
        different, first, rows = np.unique(pairs, axis=0, return_index=True, return_counts=True)
        order = np.argsort(first)
        for (track_id, number), count in zip(different[order].tolist(), rows[order].tolist(), strict=True):
            counts[track_id, number] += count
    classes: dict[int, int] = {}
    for (track_id, number), _ in counts.most_common():
        classes.setdefault(track_id, number)
    all_names = {PERSON: _PERSON, **names}
    return {track_id: all_names[number] for track_id, number in classes.items() if number in all_names}


def summary_table(channels: Mapping[str, FrameColumns], names: Mapping[str, Mapping[int, str]] = {}) -> Any:
    """The table ``track_summary`` of channels of tracks; ``names`` as in ``rows_in_pieces``."""
    import pyarrow as pa

    table, parts = TABLES["track_summary"], list[tuple[str, dict[str, NDArray[Any]]]]()
    for topic, frames in sorted(channels.items()):
        parts += ((topic, _summary(frames, part)) for part in ordered_rows(frames.schema, frames, by_track=True))
    columns = {}
    for field in table.fields[1:]:
        if field is CLASS:
            continue
        values = np.concatenate([part[field.name] for _, part in parts]) if parts else np.empty(0)
        if field.kind == "time":
            columns[field.name] = times(values.astype(np.int64))
            continue
        missing = np.isnan(values) if field.nullable else None
        columns[field.name] = pa.array(values, table.arrow.field(field.name).type, mask=missing)
    columns["topic"] = repeated([topic for topic, _ in parts], [len(part["rows"]) for _, part in parts])
    all_names = {topic: {PERSON: _PERSON, **names.get(topic, {})} for topic in channels}
    called = [all_names[topic].get(number) for topic, part in parts for number in part["class_id"].tolist()]
    columns[CLASS.name] = pa.array(called, pa.string()).dictionary_encode()
    return pa.table([columns[name] for name in table.arrow.names], schema=table.arrow)


def _summary(frames: FrameColumns, part: OrderedRows) -> dict[str, NDArray[Any]]:
    """One row for each track of a part of a channel."""
    rows = part.rows
    t_ns, frame = frames.t_ns[part.frame], frames.numbers[part.frame]
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
                values = rows[f"{axis}_{unit}"][at] if len(rows) else np.empty(0)
                out[f"{name}_{axis}_{unit}"] = np.where(at < 0, np.nan, values)
    return out


def _motion(place: Floats, t_ns: Ints, track: Ints, tracks: int) -> dict[str, Floats]:
    """Path and speeds of tracks over their known positions; NaN for a track without any."""
    has_place = np.isfinite(place).all(axis=1)
    place, t_ns, track = place[has_place], t_ns[has_place], track[has_place]
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


def _ends(has_place: NDArray[np.bool_], first: Ints, last: Ints) -> tuple[Ints, Ints]:
    """The first and last known position between ``first`` and ``last`` of each track; -1 if there is none."""
    at = np.flatnonzero(has_place)
    if len(at) == 0:
        return np.full(len(first), -1), np.full(len(first), -1)
    low = np.searchsorted(at, first)
    high = np.searchsorted(at, last, "right") - 1
    none = low > high
    return tuple(np.where(none, -1, at[np.clip(end, 0, len(at) - 1)]) for end in (low, high))  # type: ignore[return-value]
