"""Schemas of a user's own from what Python has: dtypes of NumPy, dataclasses, schemas of Arrow."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from types import NoneType, UnionType
from typing import Annotated, Any, Final, NamedTuple, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.schema import Schema
from mcaptrack.schema.own import OwnColumn, own_schema
from mcaptrack.schema.proto import KINDS

#: Columns of tables and arrays that are not part of rows. pandas names an index that has no name so.
BESIDE: Final = ("t", "t_ns", "frame", "row", "topic", "recording", "__index_level_0__")
#: Kinds of columns by the kind of a dtype and its bytes.
_KINDS: Final = {(np.dtype(form).kind, np.dtype(form).itemsize): kind for kind, (form, *_) in KINDS.items()} | {
    ("f", 2): "float",
    ("i", 1): "sfixed32",
    ("i", 2): "sfixed32",
    ("u", 1): "fixed32",
    ("u", 2): "fixed32",
}
_TIMES: Final = "times; give whole nanoseconds, as `values.astype('datetime64[ns]').astype('int64')` does"
#: What is wrong with other dtypes, by their kind, and what to do.
_ELSE: Final = {
    "f": "numbers of more than 64 bits; give float64",
    "c": "complex numbers; give their parts in two columns",
    "M": _TIMES,
    "m": _TIMES,
    "V": "a structure; give a column for each of its parts",
}
_OTHERWISE: Final = (
    "text, lists or objects, and rows hold numbers; give a number for each text, as `np.unique(texts, "
    "return_inverse=True)` does, a column for each member of a list, or leave it out"
)
#: Types of Python and the dtypes of their columns.
_PYTHON: Final[Mapping[Any, str]] = {float: "f8", int: "i8", bool: "?"}
#: The kinds of values that columns take, by the kind of their own dtype.
_TAKES: Final = {"f": "fiu", "i": "iu", "u": "iu", "M": "Miu"}
#: Keys of the metadata of fields, of dataclasses and of Arrow, for descriptions.
_DOCS: Final = ("doc", "description")
#: The unit of numbers in tables that have none.
_PLAIN: Final = ("", "1")


class ColumnOfUser(NamedTuple):
    """A column as a user has it: the dtype of its values, its unit and its description, "" if they aren't stated."""

    name: str
    dtype: np.dtype[Any]
    unit: str = ""
    doc: str = ""


def derived(
    name: str,
    listed: Iterable[ColumnOfUser],
    units: Mapping[str, str] | None = None,
    doc: Mapping[str, str] | None = None,
) -> Schema:
    """Return a schema of its own; see ``mcaptrack.schema_of``."""
    columns = [column for column in listed if column.name not in BESIDE]
    names = [column.name for column in columns]
    units_of, docs_of = _by_column("units", units, names), _by_column("doc", doc, names)
    return of_columns(
        name,
        [
            column._replace(unit=units_of.get(column.name, column.unit), doc=docs_of.get(column.name, column.doc))
            for column in columns
        ],
    )


def _by_column(parameter: str, texts: Mapping[str, str] | None, names: Sequence[str]) -> Mapping[str, str]:
    """The texts of columns. Raises McaptrackError if there is no such column."""
    strange = sorted(str(column) for column in texts or () if column not in names)
    if strange:
        raise McaptrackError(f"`{parameter}=` has {', '.join(strange)}, and the columns are {', '.join(names)}")
    return texts or {}


def of_columns(name: str, columns: Iterable[ColumnOfUser]) -> Schema:
    """Return a schema for columns. Raises McaptrackError if rows can't hold one of them."""
    return own_schema(name, [OwnColumn(c.name, _kind(c.name, c.dtype), c.unit, c.doc) for c in columns])


def is_dataclass(value: object) -> bool:
    """Whether a value is an instance of a dataclass."""
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def columns_of_objects(objects: Sequence[Any]) -> tuple[dict[str, NDArray[Any]], list[ColumnOfUser]]:
    """Return the arrays (N,) of instances of one dataclass by column, and what the dataclass says of the columns."""
    kind = type(objects[0])
    other = next((type(item) for item in objects if type(item) is not kind), None)
    if other is not None:
        raise McaptrackError(f"rows are of one dataclass; there are {kind.__name__} and {other.__name__}")
    columns = _fields(kind)
    return {column.name: _values(kind, column, objects) for column in columns}, columns


def _values(kind: type, column: ColumnOfUser, objects: Sequence[Any]) -> NDArray[Any]:
    """The values (N,) of a field of a dataclass; None is NaN in numbers that may be missing."""
    values = [getattr(item, column.name) for item in objects]
    if column.dtype.kind == "f":
        values = [np.nan if value is None else value for value in values]
    for value in values:
        plain = np.asarray(value)
        if plain.ndim or plain.dtype.kind not in _TAKES.get(column.dtype.kind, column.dtype.kind):
            raise McaptrackError(f"{kind.__name__}.{column.name} is {column.dtype}, and a row has {value!r:.60}")
    array = np.asarray(values)
    return array.astype(column.dtype) if column.dtype.kind in "fb" else array


def columns_of_type(source: Any) -> list[ColumnOfUser]:
    """Return the columns of a dtype or a dataclass. Raises McaptrackError for anything else."""
    if isinstance(source, type) and dataclasses.is_dataclass(source):
        return _fields(source)
    try:
        names = np.dtype(source).names
    except (TypeError, ValueError):
        names = None
    if names is None:
        raise McaptrackError(
            "columns are those of a dataclass, of a dtype with names such as [('speed_m_per_s', 'f8')], or of a schema "
            f"of Arrow, not {source!r:.60}"
        )
    return columns_of_dtype(np.dtype(source))


def columns_of_dtype(dtype: np.dtype[Any]) -> list[ColumnOfUser]:
    """Return the columns of a dtype with names."""
    return [ColumnOfUser(name, dtype[name]) for name in dtype.names or ()]


def _kind(name: str, dtype: np.dtype[Any]) -> str:
    """The kind of the column of a dtype. Raises McaptrackError if rows can't hold it."""
    if dtype.shape:
        raise McaptrackError(f"the column {name} has the shape {dtype.shape}; give each of its numbers a column")
    kind = _KINDS.get((dtype.kind, dtype.itemsize))
    if kind is None:
        raise McaptrackError(f"the column {name} holds {_ELSE.get(dtype.kind, _OTHERWISE)}")
    return kind


def _fields(kind: type) -> list[ColumnOfUser]:
    """The fields of a dataclass."""
    try:
        hints = get_type_hints(kind, include_extras=True)
    except (NameError, TypeError) as error:
        raise McaptrackError(f"the types of {kind.__name__} can't be read: {error}") from None
    out = []
    for field in dataclasses.fields(kind):
        hint, unit = hints[field.name], ""
        if get_origin(hint) is Annotated:
            hint, *extras = get_args(hint)
            unit = next((extra for extra in extras if isinstance(extra, str)), "")
        stated, doc = facts_of(field.metadata)
        dtype = _dtype(f"{kind.__name__}.{field.name}", hint)
        out.append(ColumnOfUser(field.name, dtype, stated or unit, doc))
    return out


def _dtype(where: str, hint: Any) -> np.dtype[Any]:
    """The dtype of the values of a field: of numbers of Python or NumPy; floats may be None."""
    is_union = get_origin(hint) in (Union, UnionType)
    kinds = [kind for kind in get_args(hint) if kind is not NoneType] if is_union else [hint]
    if len(kinds) == 1 and isinstance(kinds[0], type) and (kinds[0] in _PYTHON or issubclass(kinds[0], np.generic)):
        dtype = np.dtype(_PYTHON.get(kinds[0], kinds[0]))
        if not is_union or dtype.kind == "f":
            return dtype
        raise McaptrackError(f"{where} may be None, which whole numbers and flags in rows can't; give float | None")
    raise McaptrackError(f"the column {where} holds {_OTHERWISE}")


def facts_of(metadata: Mapping[Any, Any]) -> tuple[str, str]:
    """Return the unit and the description in the metadata of a field, of a dataclass or of Arrow."""
    unit = metadata.get("unit", "")
    return "" if unit in _PLAIN else unit, next((metadata[key] for key in _DOCS if metadata.get(key)), "")
