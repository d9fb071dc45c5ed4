"""Flat messages of foreign channels -> Arrow: a column for each field, with names that need no quotes in SQL.

``angular_velocity.x`` becomes ``angular_velocity_x``, because a dot would need quotes in every query; the path of the
field is in the column's metadata. Columns get the narrowest type that holds all values: flags, int64, float64, text, or
lists of these; mixed values become JSON text.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

from mcaptrack.tables.build import Pointers, frames_table

Path = tuple[str, ...]

_EXACT: Final = 2**53
_MAX_INT, _MAX_UINT = 2**63, 2**64


def messages_table(
    topic: str, schema_name: str, places: Pointers, rows: Iterable[Mapping[Path, Any]], blobs: bool = False
) -> tuple[Any, list[str]]:
    """One channel as a table: time and place of each message, then its fields; and the paths of fields left out.

    Fields of bytes are left out unless ``blobs``.
    """
    import pyarrow as pa

    columns: dict[Path, list[Any]] = {}
    count = 0
    for row in rows:
        for path, value in row.items():
            values = columns.setdefault(path, [])
            values += [None] * (count - len(values))
            values.append(value)
        count += 1
    head = frames_table({topic: places}).drop_columns(["rows"])
    names = dict.fromkeys(head.column_names, ())
    left_out: list[str] = []
    fields, arrays = list(head.schema), list(head.columns)
    for path, found in columns.items():
        values = found + [None] * (count - len(found))
        if not blobs and any(isinstance(value, bytes) for value in values):
            left_out.append(".".join(path))
            continue
        name = _free_name("_".join(path), names)
        array = _array(values)
        unit = "ns" if path[-1].endswith("_ns") else ""
        words = {"unit": unit, "description": f"field {'.'.join(path)} of {schema_name or 'the message'}"}
        fields.append(pa.field(name, array.type, metadata=words | {"path": ".".join(path)}))
        arrays.append(array)
    return pa.table(arrays, schema=pa.schema(fields)), left_out


def _free_name(wanted: str, names: dict[str, Any]) -> str:
    """The name, with a number if it is taken; case is ignored, as in SQL."""
    name, number = wanted, 1
    taken = {known.lower() for known in names}
    while name.lower() in taken:
        number += 1
        name = f"{wanted}_{number}"
    names[name] = ()
    return name


def _array(values: Sequence[Any]) -> Any:
    import pyarrow as pa

    there = [value for value in values if value is not None]
    if there and all(isinstance(value, list) for value in there):
        kind = _kind([member for value in there for member in value])
        if kind is not None:
            make = _MAKERS[kind]
            return pa.array([None if v is None else [make(m) for m in v] for v in values], pa.list_(_arrow(kind)))
    kind = _kind(there) if not any(isinstance(value, list) for value in there) else None
    if kind is None:
        return pa.array([None if value is None else _json(value) for value in values], pa.string())
    return pa.array([None if value is None else _MAKERS[kind](value) for value in values], _arrow(kind))


def _kind(values: Sequence[Any]) -> str | None:
    """The narrowest type that holds all values; None if only JSON does."""
    kinds = {type(value) for value in values}
    if len(kinds) == 1 and kinds <= {bool, float, str, bytes}:
        return kinds.pop().__name__
    if not kinds:
        return "float"
    if kinds == {int}:
        low, high = min(values), max(values)
        return "int" if low >= -_MAX_INT and high < _MAX_INT else "uint" if low >= 0 and high < _MAX_UINT else None
    exact = all(abs(value) <= _EXACT for value in values if isinstance(value, int))
    return "float" if kinds == {int, float} and exact else None


def _clean(text: str) -> str:
    """Text without lone surrogates, which JSON allows and UTF-8 does not."""
    return text.encode("utf-8", "replace").decode("utf-8")


def _json(value: Any) -> str:
    return _clean(json.dumps(value.hex() if isinstance(value, bytes) else value, ensure_ascii=False))


_MAKERS: Final[Mapping[str, Callable[[Any], Any]]] = {
    "bool": bool,
    "float": float,
    "int": int,
    "uint": int,
    "bytes": bytes,
    "str": _clean,
}


def _arrow(kind: str) -> Any:
    import pyarrow as pa

    kinds = {
        "bool": pa.bool_(),
        "float": pa.float64(),
        "int": pa.int64(),
        "uint": pa.uint64(),
        "bytes": pa.binary(),
        "str": pa.string(),
    }
    return kinds[kind]
