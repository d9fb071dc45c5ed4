"""Messages of channels of other software -> Arrow: a column for each field, with names that need no quotes in SQL.

``angular_velocity.x`` becomes ``angular_velocity_x``, because a dot would need quotes in every query; the path of the
field is in the column's metadata. Columns have the types of the definition; messages in lists are structs. A message
that can't be read has no values, and costs the others nothing.

Messages without a definition (JSON) have the types of their values, which are known when all were read, so they wait in
a temporary file: numbers, texts, lists and structs; values that no type holds become JSON text.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Ints
from mcaptrack.log.messages import Payloads
from mcaptrack.schema.spill import SpillFile, Stored
from mcaptrack.sources.foreign.flatten import UnreadMessages
from mcaptrack.tables.build import Pointers, TablePieces, frames_table
from mcaptrack.tables.fields import RECORDING

if TYPE_CHECKING:
    from mcaptrack.columns import ProtobufColumns, RosColumns

_NOTHING: Final = np.empty(0, np.int64)
_NO_MESSAGES: Final = Payloads(_NOTHING, np.empty(0, np.uint8), _NOTHING, _NOTHING, _NOTHING, _NOTHING)

Path = tuple[str, ...]
Columns = Mapping[Path, Any]
Flatten = Callable[[bytes], Mapping[Path, Any]]

#: Types with units that their definitions state (REP 103 for those of ROS), and these, by the ends of paths of fields.
_STATED: Final = re.compile(r"(geometry_msgs|nav_msgs|sensor_msgs|foxglove)[./].*")
_UNITS: Final[Mapping[str, str]] = {
    "m": r"\.(position|translation|point)\.[xyz]|\.altitude|/LaserScan\.range(s|_min|_max)",
    "m/s": r"/(Twist\w*|Odometry)\..*linear\.[xyz]",
    "rad/s": r"/(Twist\w*|Odometry)\..*angular\.[xyz]|/Imu\.angular_velocity\.[xyz]",
    "m/s^2": r"/Imu\.linear_acceleration\.[xyz]",
    "rad": r"/LaserScan\.angle_(min|max|increment)",
    "deg": r"(/NavSatFix|\.LocationFix)\.(latitude|longitude)",
    "T": r"/MagneticField\.magnetic_field\.[xyz]",
    "Pa": r"/FluidPressure\.fluid_pressure",
    "1": r"\.(orientation|rotation)\.[xyzw]",
}
#: A part of flat messages ends after so many of them.
_PART_MESSAGES: Final = 4096
#: Bytes of rows after which a piece of the table ends, so that a table of pictures is made in pieces, too.
PIECE_BYTES: Final = 32 * 2**20


class MessageSource(NamedTuple):
    """The messages of a channel, or of a part of it.

    Attributes
    ----------
    topic, schema_name, file : str
        ``file`` is the name of the file that holds them.
    first, total : int
        The number of messages of the channel before them, and theirs.
    where : str
        Their place for errors.
    payloads : callable
        Gives their bytes in batches; takes a function that is called with number and reason for those in damaged
        chunks.
    flatten : callable
        Decodes a single one.
    """

    topic: str
    schema_name: str
    file: str
    first: int
    total: int
    where: str
    payloads: Callable[[Callable[[int, str], None]], Iterator[Payloads]]
    flatten: Flatten


class MessagesTable(NamedTuple):
    """A channel as a table, the paths of its fields, and of those that were left out."""

    pieces: TablePieces
    fields: Sequence[Path]
    left_out: Sequence[Path]


def _unit(schema_name: str, path: Path) -> str:
    """The unit of a field where its type states one; otherwise ""."""
    name = ".".join([schema_name, *path])
    units = _UNITS.items() if _STATED.fullmatch(name) else ()
    return next((unit for unit, pattern in units if re.search(rf"({pattern})$", name)), "")


class _Rows:
    """Rows of messages: time and place of each, then its fields, of the types by path."""

    def __init__(self, source: MessageSource, types: Mapping[Path, Any]) -> None:
        import pyarrow as pa

        self._source, self._types, self._done = source, types, source.first
        head = self._head(_NO_MESSAGES).schema
        names = {RECORDING.name, *map(str.lower, head.names)}
        columns = list(head)
        for path, kind in types.items():
            unit = "ns" if path[-1].endswith("_ns") or pa.types.is_timestamp(kind) else _unit(source.schema_name, path)
            metadata = {"unit": unit, "description": f"field {'.'.join(path)} of {source.schema_name or 'the message'}"}
            name = _free_name("_".join(path), names)
            columns.append(pa.field(name, kind, metadata=metadata | {"path": ".".join(path)}))
        self.schema = pa.schema(columns)

    def _head(self, messages: Payloads) -> Any:
        count = len(messages.t_ns)
        frame = np.arange(self._done, self._done + count)
        places = Pointers(
            self._source.file, messages.t_ns, frame, np.full(count, -1), messages.chunk_offset, messages.offset
        )
        return frames_table(self._source.topic, places).drop_columns(["rows"])

    def table(self, messages: Payloads, values: Columns) -> Any:
        """The next messages as rows; fields without values are null."""
        import pyarrow as pa

        count = len(messages.t_ns)
        arrays = [values.get(path, pa.nulls(count, kind)) for path, kind in self._types.items()]
        out = pa.table([*self._head(messages).columns, *arrays], schema=self.schema)
        self._done += count
        return out


# Messages with a definition


class TypedMessages:
    """Messages that are read as columns batch by batch, or, where ``reader`` can't, each for itself."""

    def __init__(self, source: MessageSource, reader: RosColumns | ProtobufColumns) -> None:
        nothing = np.empty(0, np.int64)
        types = {path: column.type for path, column in reader.read(np.empty(0, np.uint8), nothing, nothing).items()}
        self.types = {path: kind for path, kind in types.items() if _has_fields(kind)}
        self.source, self.reader, self._rows = source, reader, _Rows(source, self.types)
        self.unread = UnreadMessages(source.where, source.total)
        self.schema, self.left_out = self._rows.schema, list(reader.left_out)

    def rows(self, batch: Payloads) -> Any:
        """The next batch as a table. Raises McaptrackError if none can be read."""
        self.unread.count(len(batch.t_ns))
        return self._rows.table(batch, _read(self.reader, batch, self.types, self.source.flatten, self.unread))

    def warn(self) -> None:
        """Warn of messages that could not be read, when all were."""
        self.unread.warn("they have no values")


def typed_table(described: TypedMessages) -> MessagesTable:
    """The table of messages that are read as columns."""
    source = described.source

    def pieces() -> Iterator[Any]:
        messages = TypedMessages(source, described.reader)
        yield from map(messages.rows, source.payloads(messages.unread.lose))
        messages.warn()

    table = TablePieces(described.schema, source.total, pieces, PIECE_BYTES)
    return MessagesTable(table, list(described.types), described.left_out)


def _read(
    reader: RosColumns | ProtobufColumns,
    batch: Payloads,
    types: Mapping[Path, Any],
    flatten: Flatten,
    unread: UnreadMessages,
) -> Columns:
    """The columns of a batch, with nulls for messages that can't be read."""
    import pyarrow as pa

    from mcaptrack.columns import Malformed, Unsupported

    parts: list[tuple[Ints, Columns]] = []
    todo = [np.flatnonzero(batch.start >= 0)]
    while todo:
        rows = todo.pop()
        try:
            parts.append((rows, reader.read(batch.data, batch.start[rows], batch.end[rows])))
        except Malformed as error:
            at = error.message
            unread.add(int(batch.t_ns[rows[at]]), str(error))
            todo += [some for some in (rows[at + 1 :], rows[:at]) if len(some)]
        except Unsupported:
            flat = list(_flat(batch, rows, flatten, unread))
            values = {path: [_with_numbers(row.get(path)) for row in flat] for path in types}
            parts.append((rows, {path: pa.array(values[path], kind) for path, kind in types.items()}))
    if len(parts) == 1 and len(parts[0][0]) == len(batch.t_ns):
        return parts[0][1]
    read = np.concatenate([rows for rows, _ in parts] or [np.empty(0, np.int64)])
    place = np.full(len(batch.t_ns), -1)
    place[read] = np.arange(len(read))
    take = pa.array(place, mask=place < 0)
    joined = {path: pa.chunked_array([part[path] for _, part in parts], kind) for path, kind in types.items()}
    return {path: column.combine_chunks().take(take) for path, column in joined.items()}


def _with_numbers(value: Any) -> Any:
    """A value with whole nanoseconds for times, which Arrow takes where it is told that they are times."""
    if isinstance(value, np.datetime64):
        return int(value.astype("datetime64[ns]").astype(np.int64))
    if isinstance(value, list):
        return [_with_numbers(member) for member in value]
    return {name: _with_numbers(member) for name, member in value.items()} if isinstance(value, dict) else value


def _flat(batch: Payloads, rows: Ints, flatten: Flatten, unread: UnreadMessages) -> Iterator[Mapping[Path, Any]]:
    """Some messages of a batch, decoded each for itself; nothing of those that can't be."""
    for t_ns, start, end in zip(
        *(values[rows].tolist() for values in (batch.t_ns, batch.start, batch.end)), strict=True
    ):
        try:
            yield {} if start < 0 else flatten(batch.data[start:end].tobytes())
        except McaptrackError as error:
            unread.add(t_ns, str(error))
            yield {}


# Messages without one


def inferred_table(source: MessageSource, wanted: Callable[[Path], bool], blobs: bool) -> MessagesTable:
    """The table of messages without types: fields have those of their values."""
    stored, unread = _Stored(wanted, blobs), UnreadMessages(source.where, source.total)
    heads = [_NO_MESSAGES]
    for batch in source.payloads(unread.lose):
        unread.count(len(batch.t_ns))
        heads.append(batch._replace(data=_NO_MESSAGES.data))
        for row in _flat(batch, np.arange(len(batch.t_ns)), source.flatten, unread):
            stored.add(row)
    stored.close()
    unread.warn("they have no values")
    types = stored.types()

    head = Payloads(*map(np.concatenate, zip(*heads, strict=True)))

    def pieces() -> Iterator[Any]:
        rows, low = _Rows(source, types), 0
        for count, columns in stored.columns(types):
            part = slice(low, low + count)
            places = head.chunk_offset[part], head.offset[part]
            yield rows.table(Payloads(head.t_ns[part], head.data, head.start[part], head.end[part], *places), columns)
            low += count

    table = TablePieces(_Rows(source, types).schema, source.total, pieces, PIECE_BYTES)
    return MessagesTable(table, list(types), list(stored.left_out))


class _Stored:
    """Flat messages as columns, part by part, which wait in a temporary file."""

    def __init__(self, wanted: Callable[[Path], bool], blobs: bool) -> None:
        self.left_out: dict[Path, None] = {}
        self._wanted, self._blobs = wanted, blobs
        self._rows: list[Mapping[Path, Any]] = []
        self._types: dict[Path, dict[Any, None]] = {}
        self._mixed: set[Path] = set()
        self._parts: list[tuple[int, list[Path], Stored]] = []
        self._file = SpillFile()

    def add(self, row: Mapping[Path, Any]) -> None:
        """Add a message."""
        self._rows.append(row)
        if len(self._rows) >= _PART_MESSAGES:
            self.close()

    def close(self) -> None:
        """End a part."""
        import pyarrow as pa

        columns: dict[Path, Any] = {}
        for path in dict.fromkeys(path for row in self._rows for path in row if self._wanted(path)):
            values = [row.get(path) for row in self._rows]
            if not self._blobs and any(isinstance(value, bytes) for value in values):
                self.left_out[path] = None
                continue
            columns[path] = _array(values)
        count, self._rows = len(self._rows), []
        if not count:
            return
        for path, column in columns.items():
            self._types.setdefault(path, {})[column.type] = None
        table = pa.table(list(columns.values()), [str(number) for number in range(len(columns))])
        sink = pa.BufferOutputStream()
        with pa.ipc.new_stream(sink, table.schema) as stream:
            stream.write_table(table)
        self._parts.append((count, list(columns), self._file.put(memoryview(sink.getvalue()))))

    def types(self) -> dict[Path, Any]:
        """The type of each column that holds the values of all parts; text, for JSON, if there is none."""
        import pyarrow as pa

        out = {path: _common(list(kinds)) for path, kinds in self._types.items() if path not in self.left_out}
        several = {path for path in out if len(self._types[path]) > 1}
        for _, columns in self._read(several) if several else ():  # a number may be too large for the common type
            for path, column in columns.items():
                try:
                    column.cast(out[path] or column.type)
                except pa.ArrowInvalid:
                    out[path] = None
        self._mixed = {path for path, kind in out.items() if kind is None}
        return {path: pa.string() if kind is None else kind for path, kind in out.items()}

    def columns(self, types: Mapping[Path, Any]) -> Iterator[tuple[int, Columns]]:
        """The columns of each part."""
        for count, columns in self._read(set(types)):
            yield (
                count,
                {
                    path: _as_json(column) if path in self._mixed else column.cast(types[path])
                    for path, column in columns.items()
                },
            )

    def _read(self, wanted: Set[Path]) -> Iterator[tuple[int, dict[Path, Any]]]:
        import pyarrow as pa

        for count, names, place in self._parts:
            table = pa.ipc.open_stream(self._file.get(place)).read_all()
            columns = zip(names, table.columns, strict=True)
            yield count, {path: column.combine_chunks() for path, column in columns if path in wanted}


def _array(values: Sequence[Any]) -> Any:
    """Values as Arrow; as an array of JSON text (large_string) if they have no common type."""
    import pyarrow as pa

    errors = (pa.ArrowException, OverflowError, UnicodeEncodeError, TypeError, ValueError)
    with suppress(*errors):
        return pa.array(values)
    for kind, members in (
        (pa.uint64(), values),
        (pa.list_(pa.uint64()), [member for value in values if isinstance(value, list) for member in value]),
    ):
        if {type(member) for member in members} <= {int, type(None)}:  # others would be rounded
            with suppress(*errors):
                return pa.array(values, kind)
    if all(value is None or isinstance(value, str) for value in values):  # lone surrogates, which JSON allows
        return pa.array([None if value is None else _clean(value) for value in values], pa.string())
    return pa.array([None if value is None else _json(value) for value in values], pa.large_string())


def _as_json(column: Any) -> Any:
    """The values of a column as JSON text."""
    import pyarrow as pa

    if pa.types.is_large_string(column.type):
        return column.cast(pa.string())
    return pa.array([None if value is None else _json(value) for value in column.to_pylist()], pa.string())


def _common(kinds: Sequence[Any]) -> Any:
    """A type for all values of these types; None if there is none."""
    import pyarrow as pa

    whole = [kind for kind in kinds if not pa.types.is_null(kind)]
    if any(pa.types.is_unsigned_integer(kind) for kind in whole) and all(map(pa.types.is_integer, whole)):
        return pa.uint64()
    try:
        kind = pa.unify_schemas([pa.schema([("", kind)]) for kind in kinds], promote_options="permissive").field(0).type
    except pa.ArrowException:
        return None
    return None if pa.types.is_large_string(kind) or not _has_fields(kind) else _settled(kind)


def _has_fields(kind: Any) -> bool:
    """Whether all messages of a type have fields; files can't hold others."""
    import pyarrow as pa

    if pa.types.is_list(kind):
        return _has_fields(kind.value_type)
    return not pa.types.is_struct(kind) or bool(kind.num_fields and all(_has_fields(field.type) for field in kind))


def _settled(kind: Any) -> Any:
    """A type as files and queries take it: times in UTC, and numbers where no value says what."""
    import pyarrow as pa

    if pa.types.is_null(kind):
        return pa.float64()
    if pa.types.is_timestamp(kind):
        return pa.timestamp("ns", tz="UTC")
    if pa.types.is_list(kind):
        return pa.list_(_settled(kind.value_type))
    if pa.types.is_struct(kind):
        return pa.struct([(field.name, _settled(field.type)) for field in kind])
    return kind


def _free_name(wanted: str, taken: set[str]) -> str:
    """The name, with a number if it is taken, by a column that SQL adds as well; case is ignored, as in SQL."""
    name, number = wanted, 1
    while name.lower() in taken:
        number += 1
        name = f"{wanted}_{number}"
    taken.add(name.lower())
    return name


def _clean(text: str) -> str:
    """Text without lone surrogates, which JSON allows and UTF-8 does not."""
    return text.encode("utf-8", "replace").decode("utf-8")


def _json(value: Any) -> str:
    def plain(inner: Any) -> str:
        return inner.hex() if isinstance(inner, bytes) else str(inner)

    return _clean(json.dumps(value, ensure_ascii=False, separators=(",", ":"), default=plain))
