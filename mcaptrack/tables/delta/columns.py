"""Columns of tables as Delta has them: text without dictionaries, times in microseconds, no unsigned numbers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.tables.fields import RECORDING

#: Signs that names of columns can't have in Delta.
_FORBIDDEN: Final = re.compile(r"[ ,;{}()\n\t=]")


def columns_of(schema: Any) -> Any:
    """The Arrow schema of a table in Delta, ``recording`` first. Columns without a type are left out."""
    import pyarrow as pa

    fields, taken = [_field(RECORDING.arrow, RECORDING.name)], {RECORDING.name}
    for field in schema:
        name = _name(field.name, taken)
        if not pa.types.is_null(field.type):
            fields.append(_field(field, name))
    return pa.schema(fields)


def _name(name: str, taken: set[str]) -> str:
    """A name that Delta takes, and that differs from the others also without regard to case."""
    plain = out = _FORBIDDEN.sub("_", name)
    number = 1
    while out.lower() in taken:
        number += 1
        out = f"{plain}_{number}"
    taken.add(out.lower())
    return out


def _field(field: Any, name: str) -> Any:
    import pyarrow as pa

    known = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
    words = {"comment": known.get("description", ""), "unit": known.get("unit", "")}
    return pa.field(name, type_of(field.type), metadata={key: word for key, word in words.items() if word})


def type_of(kind: Any) -> Any:
    """The type of a column in Delta."""
    import pyarrow as pa

    if pa.types.is_dictionary(kind):
        return type_of(kind.value_type)
    if pa.types.is_list(kind) or pa.types.is_large_list(kind):
        inner = pa.string() if pa.types.is_null(kind.value_type) else type_of(kind.value_type)
        return pa.list_(pa.field("element", inner))
    if pa.types.is_timestamp(kind):
        return pa.timestamp("us", kind.tz)
    known = {
        pa.uint8(): pa.int16(),
        pa.uint16(): pa.int32(),
        pa.uint32(): pa.int64(),
        pa.uint64(): pa.decimal128(20, 0),
        pa.float16(): pa.float32(),
        pa.large_string(): pa.string(),
        pa.large_binary(): pa.binary(),
    }
    return known.get(kind, kind)


def joined(known: Any | None, schemas: Sequence[Any]) -> Any:
    """The columns of a table and of the rows that come: those it has, then new ones. Types of the table stay.

    Raises McaptrackError if a column would have two types, neither of which holds the values of the other.
    """
    fields = {field.name: field for field in known} if known is not None else {}
    for schema in schemas:
        for field in schema:
            there = fields.setdefault(field.name, field)
            if not holds(there.type, field.type):
                if known is not None or not holds(field.type, there.type):
                    raise McaptrackError(f"its column {field.name} is {field.type}, and {there.type} there")
                fields[field.name] = field
    import pyarrow as pa

    return pa.schema(list(fields.values()))


def refuse_other_types(known: Any, own: Any) -> None:
    """Raise McaptrackError if a column of a table has another type than rows that come."""
    for field in own:
        at = known.get_field_index(field.name)
        if at >= 0 and known.field(at).type != field.type:
            raise McaptrackError(f"its column {field.name} is {field.type}, and {known.field(at).type} there")


def holds(wide: Any, narrow: Any) -> bool:
    """Whether a column of one type can hold the values of another."""
    import pyarrow as pa

    is_text = pa.types.is_string(wide) and not pa.types.is_nested(narrow) and not pa.types.is_binary(narrow)
    is_whole = pa.types.is_integer(narrow) or pa.types.is_decimal(narrow)
    if wide == narrow or is_text or (pa.types.is_floating(wide) and is_whole):
        return True
    if pa.types.is_list(wide) and pa.types.is_list(narrow):
        return holds(wide.value_type, narrow.value_type)
    same = all(map(pa.types.is_integer, (wide, narrow))) or all(map(pa.types.is_floating, (wide, narrow)))
    return bool(same and wide.bit_width >= narrow.bit_width)


def converted(batch: Any, recording: str, own: Any, schema: Any) -> Any:
    """Rows of one log with the columns of a table; ``own`` are its columns as ``columns_of`` gives them."""
    import pyarrow as pa

    count = batch.num_rows
    typed = [number for number, field in enumerate(batch.schema) if not pa.types.is_null(field.type)]
    values = dict(zip(own.names[1:], (batch.column(number) for number in typed), strict=True))
    values[RECORDING.name] = pa.repeat(recording, count)
    return pa.record_batch(
        [
            _cast(values[field.name], field.type) if field.name in values else pa.nulls(count, field.type)
            for field in schema
        ],
        schema=schema,
    )


def _cast(values: Any, kind: Any) -> Any:
    import pyarrow as pa

    if pa.types.is_dictionary(values.type):
        values = values.dictionary_decode()
    if pa.types.is_timestamp(kind):
        return values.cast(kind, safe=False)  # nanoseconds are cut; t_ns has them
    return values if values.type == kind else values.cast(kind)
