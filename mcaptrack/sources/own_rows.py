"""Rows that a user gives, from arrays and columns of tables: times, frame numbers, boxes, positions, names of classes;
and schemas of a user's own from what Python has: dtypes of NumPy, dataclasses, schemas of Arrow.

All are checked. Letters: N rows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from operator import index as as_index
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError, in_one_line
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import LAST_NS
from mcaptrack.notices import warn
from mcaptrack.schema import (
    BOX_PX,
    DETECTIONS,
    EVENTS,
    PLACE_M,
    PREDICTIONS,
    SCORES_MAPPED,
    TRACKS,
    Frame,
    Rows,
    Schema,
)
from mcaptrack.schema.classes import PERSON, UNKNOWN, is_person
from mcaptrack.schema.impossible import first_impossible
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


BoxFormat = Literal["xyxy", "xywh"]
#: The frame number of a frame that was not numbered; ``Recording.write`` gives it one.
UNNUMBERED: Final = -1
#: The largest frame number of a message.
_LAST_INDEX: Final = 2**32 - 1
#: Values of required columns that may be left out.
_DEFAULTS: Final[Mapping[Schema, Mapping[str, int | bool]]] = {
    DETECTIONS: {"class_id": UNKNOWN},
    TRACKS: {"observed": True, "source_id": -1},
    EVENTS: {"track_id": -1, "truth_id": -1, "previous_id": -1, "source_id": -1, "frames": 0},
}
#: The schemas that rows are of without a word if they have their columns and no others.
OURS: Final = (TRACKS, DETECTIONS, PREDICTIONS, EVENTS)
#: Parameters of ``mcaptrack.detections`` by the columns that they give.
_IN_SPACE: Final = {
    **dict.fromkeys(("x_m", "y_m", "z_m"), "positions_m"),
    **dict.fromkeys(("length_m", "width_m", "height_m"), "sizes_m"),
    **dict.fromkeys(("vx_m_per_s", "vy_m_per_s"), "velocities_m_per_s"),
    "heading_rad": "headings_rad",
    "source_id": "source_ids",
}
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_IN_NS: Final = "whole nanoseconds, such as `round(seconds * 1e9)`"


def frame_of(
    schema: Schema, boxes: Floats | None, named: Mapping[str, Any], t_ns: int | np.datetime64, index: int
) -> Frame:
    """Return a frame of boxes (N, 4), or of positions, with the columns in ``named``."""
    columns: dict[str, Any] = {} if boxes is None else dict(zip(BOX_PX, boxes.T, strict=True))
    count = len(named["x_m"]) if boxes is None else len(boxes)
    for name, values in named.items():
        if values is None:
            continue
        try:
            array = _floats(values) if name == "score" else np.asarray(_unmasked(values))
        except (TypeError, ValueError) as error:
            raise McaptrackError(f"{_named(name)} needs numbers of shape (N,): {in_one_line(error)}") from None
        if array.shape != (count,):
            raise McaptrackError(f"{count} boxes need {_named(name)} of shape ({count},), not {array.shape}")
        columns[name] = array
    time, number = time_of(t_ns), number_of(index)
    try:
        rows = _rows(schema, columns, count, f"the frame at {time} ns")
    except McaptrackError as error:
        text = str(error)
        for name in named:
            text = text.replace(f"{schema.name}.{name} ", f"{_named(name)} ")
        raise McaptrackError(text) from None
    return Frame(time, number, rows)


def columns_in_space(arrays: Mapping[tuple[str, ...], Any]) -> dict[str, Any]:
    """Return columns by name, from arrays (N,) or (N, C) by the names of their columns; the last may be left out.

    Raises McaptrackError for other shapes, and for what is no number.
    """
    out: dict[str, Any] = {}
    for names, values in arrays.items():
        if values is None:
            continue
        own = _IN_SPACE[names[0]]
        try:
            array = np.asarray(values) if names == ("source_id",) else _floats(values)
        except (TypeError, ValueError) as error:
            raise McaptrackError(f"`{own}=` needs numbers: {in_one_line(error)}") from None
        widths = (2, 3) if names == ("x_m", "y_m", "z_m") else (len(names),)
        array = array.reshape(0, widths[-1]) if not array.size else array
        table = array[:, None] if len(names) == 1 and array.ndim == 1 else array
        if table.ndim != 2 or table.shape[1] not in widths:
            wanted = "(N,)" if len(names) == 1 else " or ".join(f"(N, {width})" for width in widths)
            raise McaptrackError(f"`{own}=` needs numbers of shape {wanted}, not {array.shape}")
        out |= dict(zip(names, table.T, strict=False))
    return out


def schema_of_columns(name: str, columns: Sequence[ColumnOfUser]) -> Schema:
    """Return the schema of mcaptrack that has these columns, or else one of its own with this name.

    What keeps rows with a box or a position from being detections or tracks is named in a warning.
    """
    names = {column.name for column in columns}
    fitting = next((schema for schema in OURS if _fits(schema, names)), None)
    if fitting is not None:
        return fitting
    schema = of_columns(name, columns)
    parts = [group for group in (BOX_PX, PLACE_M) if names & {*group}]
    if parts:
        near = TRACKS if "track_id" in names else DETECTIONS
        strange = sorted(names - {column.name for column in near.columns})
        lacking = [column for column in parts[0] if column not in names]
        why = f"has no column {', '.join(strange)}" if strange else f"needs {', '.join(lacking)}, too"
        warn(f"rows are of {schema.name}, because {near.name} {why}; `schema=` says what rows are", "other")
    return schema


def _fits(schema: Schema, names: set[str]) -> bool:
    """Whether a schema has all of these columns, and they are all that rows of it need."""
    needed = {column.name for column in schema.columns if not column.optional and not column.since}
    is_placed = schema not in (DETECTIONS, TRACKS) or any(names.issuperset(group) for group in (BOX_PX, PLACE_M))
    own = {column.name for column in schema.columns}
    return is_placed and needed - set(_DEFAULTS.get(schema, ())) <= names <= own


def frames_of_columns(
    columns: dict[str, Any], schema: Schema | None, name: str, about: Sequence[ColumnOfUser] = ()
) -> tuple[Schema, list[Frame]]:
    """Frames of a table: rows of the same ``t_ns`` and ``frame`` are a frame.

    Without a schema, their columns decide; ``name`` is that of one of its own, ``about`` what is known of its columns.
    """
    columns = {column: _unmasked(values) for column, values in columns.items()}
    if "t_ns" not in columns:
        raise McaptrackError(f"the table has no column t_ns (times in nanoseconds); it has {', '.join(columns)}")
    schema = schema or schema_of_columns(name, _described(columns, about))
    own = {column.name for column in schema.columns}
    strange = sorted(set(columns) - own - {*BESIDE, "index"})
    if strange:
        raise McaptrackError(f"{schema.name} has no column {', '.join(strange)}; it has {', '.join(sorted(own))}")
    _refuse_several(columns)
    t_ns = times_of(columns["t_ns"], "the column t_ns")
    if len(t_ns):
        time_of(t_ns.min())
    rows = _rows(schema, {column: columns[column] for column in columns if column in own}, len(t_ns), "the table")
    numbers = _numbers(columns["frame"]) if "frame" in columns else np.full(len(t_ns), UNNUMBERED)
    order = np.lexsort((numbers, t_ns))
    begins = np.flatnonzero((np.diff(t_ns[order]) != 0) | (np.diff(numbers[order]) != 0)) + 1
    parts = np.split(order, begins) if len(order) else []
    return schema, [Frame(int(t_ns[part[0]]), int(numbers[part[0]]), rows[part]) for part in parts]


def _described(columns: Mapping[str, Any], about: Sequence[ColumnOfUser]) -> list[ColumnOfUser]:
    """The columns of rows, with what is known about them."""
    facts = {column.name: (column.unit, column.doc) for column in about}
    return [
        ColumnOfUser(name, np.dtype((values.dtype, values.shape[1:])), *facts.get(name, ("", "")))
        for name, values in columns.items()
        if name not in BESIDE
    ]


def _refuse_several(columns: Mapping[str, Any]) -> None:
    """Raise McaptrackError if a table has rows of several channels or logs."""
    for name in ("topic", "recording"):
        different = sorted({str(value) for value in columns.get(name, ())})
        if len(different) > 1:
            raise McaptrackError(
                f"the table has rows of {len(different)} {name}s: {', '.join(different)}; their ids and times do not "
                f"go together: select one {name}"
            )


def _rows(schema: Schema, inputs: Mapping[str, Any], count: int, where: str) -> Rows:
    """Return the rows of columns; columns with a default may be left out."""
    columns = {name: _whole(values) if schema.dtype[name].kind in "iu" else values for name, values in inputs.items()}
    columns = {name: np.full(count, value) for name, value in _DEFAULTS.get(schema, {}).items()} | columns
    try:
        return schema.rows(**columns)
    except ValueError as error:
        raise McaptrackError(f"{where}: {error}") from None


def check_frames(schema: Schema, frames: Sequence[Frame]) -> None:
    """Raise McaptrackError for the first row that can't be; warn of scores that trackers can't use."""
    rows = schema.joined([frame.rows for frame in frames])
    of = np.repeat(np.arange(len(frames)), [len(frame.rows) for frame in frames])
    if impossible := first_impossible(schema, rows, of):
        at, reason = impossible
        number = at - int(np.searchsorted(of, of[at]))
        raise McaptrackError(f"the frame at {frames[of[at]].t_ns} ns: in row {number} {reason}")
    if schema not in (DETECTIONS, TRACKS):
        return
    odd = (rows["score"] < 0) | (rows["score"] > 1)
    if odd.any():
        low, high = np.nanmin(rows["score"]), np.nanmax(rows["score"])
        warn(f"scores are from {low:g} to {high:g}; {SCORES_MAPPED}", "scores")


def time_of(t_ns: Any) -> int:
    """Return a time in whole nanoseconds. Raises McaptrackError for anything else, such as seconds."""
    value = nanoseconds_of(t_ns, "`t_ns=`") if isinstance(t_ns, datetime | np.datetime64) else t_ns
    return _whole_number(value, 0, LAST_NS, f"`t_ns=` needs {_IN_NS}, since 1970 from 0 to {LAST_NS}")


def nanoseconds_of(time: Any, name: str) -> int:
    """Return a time in whole nanoseconds since 1970, also from a timestamp. Raises McaptrackError with ``name``."""
    value = time
    if isinstance(time, datetime):
        if hasattr(time, "to_datetime64"):  # of pandas, to the nanosecond
            value = time.to_datetime64()
        elif time.tzinfo is None:
            raise McaptrackError(f"{name} needs a time zone, such as `datetime(..., tzinfo=UTC)`; {time} has none")
        else:
            value = (time - _EPOCH) // timedelta(microseconds=1) * 1000
    if isinstance(value, np.datetime64):
        if np.isnat(value):
            raise McaptrackError(f"{name} needs a time, not NaT")
        value = value.astype("datetime64[ns]").astype(np.int64)
    try:
        return as_index(value)
    except TypeError:
        raise McaptrackError(f"{name} needs {_IN_NS}, not {kind_of(time)}") from None


def times_of(values: Any, name: str) -> Ints:
    """Return times (N,) in nanoseconds, also from timestamps. Raises McaptrackError with ``name`` for anything else."""
    array = np.asarray(values)
    if array.dtype.kind == "M":
        array = array.astype("datetime64[ns]").astype(np.int64)
    if array.ndim != 1 or (array.dtype.kind not in "iu" and len(array)):
        raise McaptrackError(f"{name} needs {_IN_NS}, in an array (N,), not {array.dtype} of shape {array.shape}")
    if len(array) and not -LAST_NS <= int(array.min()) <= int(array.max()) <= LAST_NS:
        raise McaptrackError(f"{name} needs nanoseconds up to {LAST_NS}; there are {array.min()} to {array.max()}")
    return array.astype(np.int64)


def number_of(index: Any) -> int:
    """Return a frame number. Raises McaptrackError for anything else."""
    wanted = f"`index=` needs the whole number of a picture, from 0 to {_LAST_INDEX}"
    return _whole_number(index, UNNUMBERED, _LAST_INDEX, wanted)


def _whole_number(value: Any, least: int, most: int, wanted: str) -> int:
    try:
        whole = as_index(value)
    except TypeError:
        raise McaptrackError(f"{wanted}, not {kind_of(value)}") from None
    if not least <= whole <= most:
        raise McaptrackError(f"{wanted}, not {whole}")
    return whole


def _numbers(values: Any) -> Ints:
    """Return the frame numbers (N,) of a table; UNNUMBERED where one is missing."""
    array = np.asarray(values)
    array = _whole(np.where(np.isnan(array), UNNUMBERED, array)) if array.dtype.kind == "f" else array
    if len(array) and (array.dtype.kind not in "iu" or array.min() < UNNUMBERED or array.max() > _LAST_INDEX):
        raise McaptrackError(f"the column frame holds numbers of pictures, from 0 to {_LAST_INDEX}")
    return array.astype(np.int64)


def _whole(values: Any) -> Any:
    """Whole numbers of a column; many libraries give them as floating-point numbers."""
    array = np.asarray(values)
    if array.dtype.kind == "f" and (np.abs(array) < 2**53).all() and (array == np.round(array)).all():
        return array.astype(np.int64)
    return array.astype(np.int64) if array.size == 0 else array


def boxes_of(boxes: Any, box_format: BoxFormat) -> Floats:
    """Boxes (N, 4) as left, top, width, height."""
    try:
        array = _floats(boxes)
    except (TypeError, ValueError) as error:
        raise McaptrackError(f"boxes are numbers of shape (N, 4): {in_one_line(error)}") from None
    array = array.reshape(0, 4) if array.shape in ((0,), (0, 0)) else array
    if array.ndim != 2 or array.shape[1] != 4:
        raise McaptrackError(f"boxes are an array of shape (N, 4), not {array.shape}")
    wrong = ~np.isfinite(array).all(axis=1)
    if wrong.any():
        raise McaptrackError(
            f"box {wrong.argmax()} has numbers that are missing or infinite: {array[wrong][0].tolist()}"
        )
    xywh: Floats = (
        np.concatenate([array[:, :2], array[:, 2:] - array[:, :2]], axis=1) if box_format == "xyxy" else array
    )
    wrong = (xywh[:, 2:] < 0).any(axis=1)
    if wrong.any():
        raise McaptrackError(
            f"box {wrong.argmax()} has a negative size: {array[wrong][0].tolist()} read as {box_format}"
        )
    return xywh


def _floats(values: Any) -> Floats:
    """Numbers; NaN where they are masked. Raises TypeError or ValueError for anything else."""
    if np.iscomplexobj(values):
        raise TypeError("there are complex numbers")
    return np.asarray(_unmasked(values), np.float64)


def _unmasked(values: Any) -> Any:
    """An array without a mask: NaN where numbers are masked."""
    if not isinstance(values, np.ma.MaskedArray):
        return values
    is_missing = values.dtype.kind in "fiub" and np.ma.getmaskarray(values).any()
    return np.ma.filled(values.astype(np.float64), np.nan) if is_missing else values.data


def _named(column: str) -> str:
    """The parameter of ``mcaptrack.detections`` that gives a column."""
    return {"score": "`scores=`", "class_id": "`classes=`"}.get(column) or (
        f"`{_IN_SPACE[column]}=`" if column in _IN_SPACE else column
    )


def kind_of(value: Any) -> str:
    """Describe a value in one line: its type, and the value if it is short."""
    text = repr(value)
    name = type(value).__name__
    return f"{text} ({name})" if len(text) <= 40 and text.isprintable() else name


# Names of classes.


_LAST_CLASS: Final = 2**32 - 1
#: The longest name of a class.
_LONGEST_NAME: Final = 200
_NUMBER, _NAME = "class_id", "class"


def checked_names(classes: Mapping[int, str] | None) -> dict[int, str]:
    """Return the names of classes by number. Raises McaptrackError for what can't be a number or a name."""
    out = {}
    if classes is not None and not isinstance(classes, Mapping):
        raise McaptrackError(
            f"`classes=` is a mapping of numbers to names, as in {{2: 'bicycle'}}, not {classes!r:.40}"
        )
    for number, name in (classes or {}).items():
        whole = _whole_number(number, UNKNOWN, _LAST_CLASS, f"a class is a whole number from 0 to {_LAST_CLASS}")
        out[whole] = _checked_name(whole, name)
    return out


def _checked_name(number: int, name: object) -> str:
    if not isinstance(name, str) or not name.strip() or not name.isprintable() or len(name) > _LONGEST_NAME:
        raise McaptrackError(
            f"the name of class {number} is printable text of at most {_LONGEST_NAME} characters, not {name!r:.60}"
        )
    if number == PERSON and not is_person(name):
        raise McaptrackError(f"class {PERSON} is a person; give {name!r:.60} another number")
    return str(name)


def numbers_of(classes: Any, class_names: Mapping[int, str]) -> Any:
    """Classes (N,) given by name as numbers; other classes as they are. Raises McaptrackError for unknown names."""
    names = checked_names(class_names)
    values = np.asarray(() if classes is None else classes)
    if values.dtype.kind not in "UO":
        return classes
    number_of = {name: number for number, name in sorted(names.items(), reverse=True)}
    out = []
    for name in values.reshape(-1).tolist():
        number = PERSON if isinstance(name, str) and is_person(name) else number_of.get(name)
        if number is None:
            listed = ", ".join(list(number_of)[:8]) + (", ..." if len(number_of) > 8 else "")
            raise McaptrackError(f"`class_names=` has no class {name!r:.60}; it has {listed or 'none'}")
        out.append(number)
    return np.array(out, np.int64).reshape(values.shape)


def numbered_columns(columns: Mapping[str, Any]) -> tuple[dict[str, Any], dict[int, str]]:
    """The columns of a table with classes as numbers, and the names of these, where it names them.

    Names without numbers are numbered from 2 on in alphabetical order; people are 1. Raises McaptrackError if a number
    has two names.
    """
    out = dict(columns)
    texts = out.pop(_NAME, None)
    if texts is None:
        return out, {}
    if np.asarray(texts).dtype.kind in "biufc" and np.asarray(texts).size:
        raise McaptrackError(f"the column {_NAME} holds names of classes; call a column of their numbers {_NUMBER}")
    names = [name if isinstance(name, str) and name.strip() else "" for name in np.asarray(texts).tolist()]
    if _NUMBER not in out:
        others = sorted({name for name in names if name and not is_person(name)})
        numbers = {name: number for number, name in enumerate(others, start=PERSON + 1)}
        ids = [numbers.get(name, PERSON if name else UNKNOWN) for name in names]
        out[_NUMBER] = np.array(ids, np.uint32)
    name_of: dict[int, str] = {}
    for number, name in sorted(set(zip(np.asarray(out[_NUMBER]).tolist(), names, strict=False)), key=repr):
        is_other = name and number in name_of and name_of[number] != name
        if is_other and not (number == PERSON and is_person(name)):
            raise McaptrackError(f"class {number} has two names in the table, {name_of[number]!r:.60} and {name!r:.60}")
        if name:
            name_of.setdefault(number, name)
    return out, {number: _checked_name(number, name) for number, name in name_of.items()}
