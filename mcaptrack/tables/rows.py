"""Rows of channels as Arrow tables, in pieces of bounded size; the summaries of tracks; the names of their classes.

Letters: N rows, K tracks.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.ragged import group_index
from mcaptrack.schema import Frame, Schema
from mcaptrack.schema.classes import PERSON, majority
from mcaptrack.schema.frame_columns import FrameColumns, collect
from mcaptrack.schema.framing import joined_parts, unique_values
from mcaptrack.tables.build import repeated, table_of, times
from mcaptrack.tables.fields import CLASS, TABLES, TRACK_CLASS, ZONE, Table
from mcaptrack.tables.ordered import OrderedRows, ordered_rows
from mcaptrack.tables.table_pieces import TablePieces

#: The name of people where a channel names no classes.
_PERSON: Final = "person"


class TrackNames(NamedTuple):
    """The names of the classes of tracks by their ids: of the tracks that rows are about, and of the ground truth."""

    tracks: Mapping[int, str] = {}
    truth: Mapping[int, str] = {}


def rows_table(
    schema: Schema,
    channels: Mapping[str, Sequence[Frame]],
    names: Mapping[str, Mapping[int, str]] = {},
    of_tracks: Mapping[str, TrackNames] = {},
) -> Any:
    """All rows of channels of one schema as an Arrow table, in the table's order; missing numbers are null.

    ``names`` are the names of classes by their number, for each channel that names any; ``of_tracks`` those of tracks,
    for each channel with rows about tracks of another one.
    """
    columns = {topic: collect(schema, frames) for topic, frames in channels.items()}
    return rows_in_pieces(schema, columns, names, of_tracks).table()


def rows_in_pieces(
    schema: Schema,
    channels: Mapping[str, FrameColumns],
    names: Mapping[str, Mapping[int, str]] = {},
    of_tracks: Mapping[str, TrackNames] = {},
    zones: Mapping[str, Mapping[int, str]] = {},
) -> TablePieces:
    """The table of ``rows_table``, piece by piece; ``zones`` are names of zones by number, for each channel."""
    import pyarrow as pa

    table, members = table_of(schema), dict(sorted(channels.items()))
    named = {topic: _Names.of(table, names.get(topic, {}), of_tracks.get(topic)) for topic in members}
    named_zones = {topic: _Names(ZONE.name, (("zone_id", zones.get(topic, {})),)) for topic in members}
    columns_of = {topic: [named[topic], *([named_zones[topic]] if table.is_of_zones() else [])] for topic in members}
    words: dict[str, int] = {}
    for topic, frames in members.items():
        for one in columns_of[topic]:
            one.collect(schema, frames, words)
    known = pa.array(list(words), pa.string())

    def made() -> Iterator[Any]:
        for topic, frames in members.items():
            for part in ordered_rows(schema, frames, "track_id" in table.order):
                columns = _columns(schema, frames, part)
                columns["topic"] = repeated([topic], [len(part.rows)], list(members))
                for one in columns_of[topic]:
                    if one.column:
                        codes = one.codes(part.rows, words)
                        columns[one.column] = pa.DictionaryArray.from_arrays(pa.array(codes, mask=codes < 0), known)
                yield pa.table([columns[field.name] for field in table.arrow], schema=table.arrow)

    return TablePieces(table.arrow, sum(int(frames.ends[-1]) for frames in members.values()), made)


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
    """The names in a column of a channel's rows, of classes or zones: the column, and names by the values of others."""

    column: str
    by: tuple[tuple[str, Mapping[int, str]], ...]

    @classmethod
    def of(cls, table: Table, classes: Mapping[int, str], tracks: TrackNames | None) -> _Names:
        """By the class of each row if it has one, or by its track; for rows without a track, by the ground truth."""
        if table.is_of_tracks():
            tracks = tracks or TrackNames()
            has_truth = "truth_id" in table.arrow.names
            return cls(
                TRACK_CLASS.name,
                (("track_id", tracks.tracks), *((("truth_id", tracks.truth),) if has_truth else ())),
            )
        if CLASS.name in table.arrow.names:
            return cls(CLASS.name, (("class_id", {PERSON: _PERSON, **classes}),))
        return cls("", ())

    def collect(self, schema: Schema, frames: FrameColumns, words: dict[str, int]) -> None:
        """Add the names that occur to ``words``."""
        for column, names in self.by:
            if names:
                for number in unique_values(schema, frames, column).tolist():
                    if number in names:
                        words.setdefault(names[number], len(words))

    def codes(self, rows: NDArray[np.void], words: Mapping[str, int]) -> NDArray[np.int32]:
        """The places in ``words`` of the names of rows (N,); -1 for those without a name."""
        (column, names), *others = self.by
        out = _codes(rows[column], names, words)
        for other, of_other in others:
            out = np.where(rows[column] >= 0, out, _codes(rows[other], of_other, words))
        return out


def _codes(numbers: NDArray[Any], names: Mapping[int, str], words: Mapping[str, int]) -> NDArray[np.int32]:
    """The places of names in ``words``; -1 for numbers without a name."""
    there, which = np.unique(numbers, return_inverse=True)
    return np.array([words.get(names.get(number, ""), -1) for number in there.tolist()], np.int32)[which]


class _Pairs(NamedTuple):
    """Different pairs of track and class, (P,): both, the first row of each, and how many rows there are of it."""

    track: Ints
    of_class: Ints
    first: Ints
    rows: Ints

    def joined(self) -> _Pairs:
        """Each pair once; earlier rows stand before later ones."""
        tracks, track = np.unique(self.track, return_inverse=True)
        classes, of_class = np.unique(self.of_class, return_inverse=True)
        pair, first, which = np.unique(track * len(classes) + of_class, return_index=True, return_inverse=True)
        rows = np.bincount(which, self.rows, len(pair)).astype(np.int64)
        return _Pairs(
            tracks[pair // max(len(classes), 1)], classes[pair % max(len(classes), 1)], self.first[first], rows
        )


def names_by_track(frames: FrameColumns, names: Mapping[int, str]) -> dict[int, str]:
    """The names of the classes of tracks by id, as far as they have one; ``names`` are those of classes by number.

    A track has the class of most of its rows; of several, the one that comes first.
    """
    found = _Pairs(*(np.empty(0, np.int64) for _ in _Pairs._fields))
    for low, _, joined in joined_parts(frames.schema, frames):
        track, of_class = (joined.rows[name].astype(np.int64) for name in ("track_id", "class_id"))
        place = np.arange(len(track)) + frames.ends[low]
        here = _Pairs(track, of_class, place, np.ones(len(track), np.int64)).joined()
        found = _Pairs(*(np.concatenate(both) for both in zip(found, here, strict=True))).joined()
    order = np.lexsort((found.first, -found.rows, found.track))
    ids, begin = np.unique(found.track[order], return_index=True)
    classes = found.of_class[order][begin].tolist()
    known = {PERSON: _PERSON, **names}
    return {one: known[of] for one, of in zip(ids.tolist(), classes, strict=True) if of in known}


def summary_table(channels: Mapping[str, FrameColumns], names: Mapping[str, Mapping[int, str]] = {}) -> Any:
    """The table ``track_summary`` of channels of tracks; ``names`` as in ``rows_table``."""
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
    known = {topic: {PERSON: _PERSON, **names.get(topic, {})} for topic in channels}
    called = [known[topic].get(number) for topic, part in parts for number in part["class_id"].tolist()]
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
