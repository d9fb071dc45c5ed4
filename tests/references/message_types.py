"""The values of a column of flat messages, all at once: what ``mcaptrack/tables/messages.py`` makes in parts."""

from __future__ import annotations

import json
from typing import Any


def column(values: list[Any]) -> tuple[str, list[Any]]:
    """The type of a column of values, as Arrow names it, and the values in it."""
    there = [value for value in values if value is not None]
    if there and all(isinstance(value, list) for value in there):
        kind = _type([member for value in there for member in value])
        if kind is not None:
            members = [value and [_as(kind, member) for member in value] for value in values]
            return f"list<element: {kind}>", members
    elif not any(isinstance(value, list) for value in there):
        kind = _type(there)
        if kind is not None:
            return kind, [None if value is None else _as(kind, value) for value in values]
    return "string", [None if value is None else _text(value) for value in values]


def _type(values: list[Any]) -> str | None:
    types = {type(value).__name__ for value in values}
    if not types:
        return "double"
    if types == {"int"}:
        for kind, low, high in (("int64", -(2**63), 2**63 - 1), ("uint64", 0, 2**64 - 1)):
            if all(low <= value <= high for value in values):
                return kind
        return None
    if types == {"int", "float"}:
        return "double" if all(abs(value) <= 2**53 for value in values if isinstance(value, int)) else None
    names = {"bool": "bool", "float": "double", "str": "string", "bytes": "binary"}
    return names.get(types.pop()) if len(types) == 1 else None


def _as(kind: str, value: Any) -> Any:
    if kind == "double":
        return float(value)
    return value.encode("utf-8", "replace").decode() if kind == "string" else value


def _text(value: Any) -> str:
    said = json.dumps(value.hex() if isinstance(value, bytes) else value, ensure_ascii=False)
    return said.encode("utf-8", "replace").decode()
