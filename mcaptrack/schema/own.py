"""Schemas of a user's own: rows of numbers with names and units, kept in a log as rows of mcaptrack's schemas are.

The schema record of such a channel is derived from its columns, in protobuf or as a ROS message. Their units and
descriptions, which neither can state, are in the metadata ``mcaptrack.columns`` of the channel.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any, Final, NamedTuple

from mcaptrack.errors import McaptrackError
from mcaptrack.schema import SCHEMAS, Schema
from mcaptrack.schema.proto import KINDS, Column, Definition

#: The package of schemas that are named without one.
PACKAGE: Final = "own"
#: The most columns of a schema, and the longest name, unit or description.
_MOST_COLUMNS: Final = 1000
_LONGEST: Final = 200
#: Names of columns that all of protobuf, ROS and SQL accept, and names of schemas that protobuf and ROS do.
_COLUMN: Final = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
_NAME: Final = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*\.[A-Z][A-Za-z0-9]*")
#: Packages of messages that other software defines; "sensor" is that of sensor_msgs in ROS.
_TAKEN: Final = (
    *("actionlib", "builtin_interfaces", "diagnostic", "foxglove", "geometry", "google", "map", "mcaptrack", "nav"),
    *("pcl", "ros", "rosgraph", "sensor", "shape", "std", "stereo", "tf", "tf2", "trajectory", "unique_identifier"),
    *("vision", "visualization"),
)
#: Columns of each table of rows, beside those of its schema.
RESERVED: Final = ("t", "t_ns", "frame", "row", "topic", "recording", "class", "zone")
#: The key of the columns in the metadata of a channel.
_COLUMNS: Final = "mcaptrack.columns"
_DOC: Final = "Rows at one instant, as a user has defined them."


def checked_name(name: object) -> str:
    """Return the name of a schema with its package. Raises McaptrackError if it is none, or one of other software."""
    whole = f"{PACKAGE}.{name}" if isinstance(name, str) and "." not in name else name
    if not isinstance(whole, str) or not _NAME.fullmatch(whole) or len(whole) > _LONGEST:
        raise McaptrackError(
            f"{name!r:.60} can't name a schema; names are such as Speed or my_tool.Speed: letters and digits, "
            "beginning with a capital, below a package in lower case"
        )
    package, _, last = whole.partition(".")
    if package in _TAKEN:
        raise McaptrackError(
            f"{whole} is in the package {package}, which is not yours; name the schema {PACKAGE}.{last}"
        )
    return whole


def name_for(topic: str) -> str:
    """Return the name of a schema for the rows of a channel: /camera/speed -> own.CameraSpeed."""
    words = re.findall(r"[A-Za-z0-9]+", topic)
    name = "".join(word[0].upper() + word[1:] for word in words)[: _LONGEST // 2]
    return f"{PACKAGE}.{name if name[:1].isalpha() else f'Rows{name}'}"


class OwnColumn(NamedTuple):
    """A column of a schema of its own; ``kind`` is one of ``KINDS``. Floating-point numbers may be missing."""

    name: str
    kind: str
    unit: str = ""
    doc: str = ""


def own_schema(name: str, columns: Iterable[OwnColumn]) -> Schema:
    """Return a schema of its own: the same object for the same columns, which keeps its codecs.

    ``name`` may be without a package. Raises McaptrackError if a name, a unit or a description can't be one, or if
    there are no columns.
    """
    whole, listed = checked_name(name), tuple(columns)
    if not 0 < len(listed) <= _MOST_COLUMNS:
        raise McaptrackError(f"{whole} has {len(listed)} columns beside the time; a schema has 1 to {_MOST_COLUMNS}")
    names = [column.name for column in listed]
    for column in listed:
        _check(whole, column)
        if names.count(column.name) > 1:
            raise McaptrackError(f"{whole} has two columns {column.name}; rename one")
    return _schema(Definition(whole, _DOC, tuple(map(_column, listed, range(1, len(listed) + 1)))))


def _check(schema: str, column: OwnColumn) -> None:
    """Raise McaptrackError if a column of a schema has a name, a unit or a description that can't be one."""
    where = f"{schema}.{column.name}"
    if column.name in RESERVED:
        raise McaptrackError(f"{where} is a column that tables have beside those of rows; rename it, or leave it out")
    if not _COLUMN.fullmatch(column.name) or len(column.name) > _LONGEST:
        raise McaptrackError(
            f"{column.name!r:.60} can't name a column of {schema}; names have lower-case letters, digits and single "
            "underscores, and begin with a letter: rename it"
        )
    for what, text in (("unit", column.unit), ("description", column.doc)):
        if not isinstance(text, str) or (text and not text.isprintable()) or len(text) > _LONGEST:
            raise McaptrackError(
                f"the {what} of {where} is printable text of at most {_LONGEST} characters, not {text!r:.60}"
            )


def _column(own: OwnColumn, number: int) -> Column:
    is_float = own.kind in ("double", "float")
    column = Column(own.name, own.kind, number, is_float, own.doc, stated_unit=own.unit)
    return replace(column, stated_unit=column.unit)  # that of its name, if there is no other


@lru_cache(maxsize=1024)
def _schema(definition: Definition) -> Schema:
    return Schema(definition.name, definition=definition)


def columns_in_metadata(schema: Schema) -> str:
    """Return the columns of a schema of its own as text, for the metadata of its channels; "" for mcaptrack's own."""
    if not schema.is_own:
        return ""
    return json.dumps([[c.name, c.kind, c.unit, c.doc] for c in schema.columns], ensure_ascii=False)


def schema_of_channel(name: str, metadata: Mapping[str, str]) -> Schema | None:
    """Return the schema of rows of a channel, by its name and the metadata; None if it holds no rows."""
    if name in SCHEMAS or _COLUMNS not in metadata:
        return SCHEMAS.get(name)
    try:
        columns: Any = json.loads(metadata[_COLUMNS])
        listed = [OwnColumn(*map(str, column)) for column in columns]
        return own_schema(name, listed) if all(column.kind in KINDS for column in listed) else None
    except (ValueError, TypeError, RecursionError, McaptrackError):
        return None
