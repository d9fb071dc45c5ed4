"""Flat messages of foreign channels -> Arrow: a column for each field, with names that need no quotes in SQL.

``angular_velocity.x`` becomes ``angular_velocity_x``, because a dot would need quotes in every query; the path of the
field is in the column's metadata. Columns get the narrowest type that holds all values: flags, int64, float64, text, or
lists of these; mixed values become JSON text. The type is known when all messages were read, so their values wait in a
temporary file, and the table is made in pieces.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from mcaptrack.schema.spill import SpillFile, Stored
from mcaptrack.tables.build import Pointers, TablePieces, frames_table

Path = tuple[str, ...]

_EXACT: Final = 2**53
_MAX_INT, _MAX_UINT = 2**63, 2**64
#: A part of the messages ends after so many of them, or so many bytes in their values.
_PART_MESSAGES: Final = 4096
_PART_BYTES: Final = 4 * 2**20
#: Bytes of rows after which a piece of the table ends, so that a table of pictures is made in pieces, too.
_PIECE_BYTES: Final = 32 * 2**20


def messages_table(
    topic: str, schema_name: str, places: Pointers, rows: Iterable[Mapping[Path, Any]], blobs: bool = False
) -> tuple[TablePieces, list[str]]:
    """One channel as a table: time and place of each message, then its fields; and the paths of fields left out.

    Fields of bytes are left out unless ``blobs``.
    """
    import pyarrow as pa

    kept = _KeptMessages(blobs)
    for row in rows:
        kept.add(row)
    kept.close()
    head = frames_table({topic: places}).drop_columns(["rows"])
    names = dict.fromkeys(head.column_names, ())
    left_out = [".".join(path) for path, facts in kept.facts.items() if facts.has_bytes and not blobs]
    fields, makers = list(head.schema), dict[Path, _Maker]()
    for path, facts in kept.facts.items():
        if facts.has_bytes and not blobs:
            continue
        name = _free_name("_".join(path), names)
        makers[path] = facts.maker()
        unit = "ns" if path[-1].endswith("_ns") else ""
        metadata = {"unit": unit, "description": f"field {'.'.join(path)} of {schema_name or 'the message'}"}
        fields.append(pa.field(name, makers[path].type, metadata=metadata | {"path": ".".join(path)}))
    schema = pa.schema(fields)

    def pieces() -> Iterator[Any]:
        low = 0
        for count, values in kept.parts():
            empty = [None] * count
            arrays = [
                pa.array(
                    [None if value is None else maker.make(value) for value in values.get(path, empty)], maker.type
                )
                for path, maker in makers.items()
            ]
            yield pa.table([*head.slice(low, count).columns, *arrays], schema=schema)
            low += count

    return TablePieces(schema, head.num_rows, pieces, _PIECE_BYTES), left_out


class _KeptMessages:
    """The values of flat messages, most of which wait in a temporary file, and facts about each field."""

    def __init__(self, blobs: bool) -> None:
        self.facts: dict[Path, _Facts] = {}
        self._blobs = blobs
        self._columns: dict[Path, list[Any]] = {}
        self._count = self._bytes = 0
        self._parts: list[Stored] = []
        self._file = SpillFile()

    def add(self, row: Mapping[Path, Any]) -> None:
        """Add a message."""
        for path, value in row.items():
            if path not in self._columns:
                self._columns[path] = []
                self.facts.setdefault(path, _Facts())
            values = self._columns[path]
            values += [None] * (self._count - len(values))
            if isinstance(value, bytes) and not self._blobs:
                self.facts[path].has_bytes = True  # it is left out: its bytes needn't be kept
                continue
            values.append(value)
            self._bytes += (
                8 * len(value) if isinstance(value, list) else len(value) if isinstance(value, str | bytes) else 8
            )
        self._count += 1
        if self._count >= _PART_MESSAGES or self._bytes >= _PART_BYTES:
            self.close()

    def close(self) -> None:
        """End a part."""
        if not self._count:
            return
        for path, values in self._columns.items():
            values.extend([None] * (self._count - len(values)))
            self.facts[path].add(values)
        self._parts.append(self._file.put(pickle.dumps((self._count, self._columns))))
        self._columns, self._count, self._bytes = {}, 0, 0

    def parts(self) -> Iterator[tuple[int, dict[Path, list[Any]]]]:
        """Numbers of messages, and their values by field; a field that none of them has is missing."""
        for part in self._parts:
            yield pickle.loads(self._file.get(part))  # noqa: S301  # from this process


@dataclass
class _Maker:
    """The type of a column, and the function that converts its values."""

    type: Any
    make: Callable[[Any], Any]


@dataclass
class _Facts:
    """Facts about the values of a field, by which its column gets a type; of lists, about their members."""

    has_bytes: bool = False
    has_lists: bool = False
    has_others: bool = False
    types: set[type] = field(default_factory=set)
    low: int = 0
    high: int = 0

    def add(self, values: Sequence[Any]) -> None:
        """Add values, or None for messages without the field."""
        present = [value for value in values if value is not None]
        lists = [value for value in present if isinstance(value, list)]
        self.has_bytes |= any(isinstance(value, bytes) for value in present)
        self.has_lists |= bool(lists)
        self.has_others |= len(lists) < len(present)
        members = [member for value in lists for member in value] if lists else present
        self.types |= set(map(type, members))
        whole = [member for member in members if isinstance(member, int)]
        self.low, self.high = min([self.low, *whole]), max([self.high, *whole])

    def maker(self) -> _Maker:
        """The type of the column."""
        import pyarrow as pa

        kind = None if self.has_lists and self.has_others else self._kind()
        if kind is None:
            return _Maker(pa.string(), _json)
        one = _maker(kind)
        return _Maker(pa.list_(one.type), lambda value: list(map(one.make, value))) if self.has_lists else one

    def _kind(self) -> str | None:
        """The narrowest type that holds all values; None if only JSON does."""
        if len(self.types) == 1 and self.types <= {bool, float, str, bytes}:
            return next(iter(self.types)).__name__
        if not self.types:
            return "float"
        if self.types == {int}:
            if self.low >= -_MAX_INT and self.high < _MAX_INT:
                return "int"
            return "uint" if self.low >= 0 and self.high < _MAX_UINT else None
        return "float" if self.types == {int, float} and max(-self.low, self.high) <= _EXACT else None


def _free_name(wanted: str, names: dict[str, Any]) -> str:
    """The name, with a number if it is taken; case is ignored, as in SQL."""
    name, number = wanted, 1
    taken = {name_taken.lower() for name_taken in names}
    while name.lower() in taken:
        number += 1
        name = f"{wanted}_{number}"
    names[name] = ()
    return name


def _clean(text: str) -> str:
    """Text without lone surrogates, which JSON allows and UTF-8 does not."""
    return text.encode("utf-8", "replace").decode("utf-8")


def _json(value: Any) -> str:
    return _clean(json.dumps(value.hex() if isinstance(value, bytes) else value, ensure_ascii=False))


def _maker(kind: str) -> _Maker:
    """The column of single values of a kind."""
    import pyarrow as pa

    makers = {
        "bool": _Maker(pa.bool_(), bool),
        "float": _Maker(pa.float64(), float),
        "int": _Maker(pa.int64(), int),
        "uint": _Maker(pa.uint64(), int),
        "bytes": _Maker(pa.binary(), bytes),
        "str": _Maker(pa.string(), _clean),
    }
    return makers[kind]
