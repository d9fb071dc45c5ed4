"""Classes of objects: their numbers in rows, and their names in the metadata of a channel.

``mcaptrack.classes`` names the classes of a channel, as JSON: {"1": "person", "2": "bicycle"}. Where all rows of a
channel of tracks are of one class, it stands once in the metadata, as ``mcaptrack.class_id``, and not in the rows.

Letters: N rows.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Ints
from mcaptrack.schema import Frame, Rows, Schema
from mcaptrack.schema.provenance import read_texts

#: The class of what is not known, and of people.
UNKNOWN: Final = 0
PERSON: Final = 1
#: Names of people, in lower case, the usual one first.
PEOPLE: Final[tuple[str, ...]] = ("person", "pedestrian", "people", "human")
_COLUMN: Final = "class_id"
#: Keys of the metadata of channels: names of classes by number, and the class of all rows that state none.
_NAMES, _ONLY = "mcaptrack.classes", "mcaptrack.class_id"
_LAST: Final = 2**32 - 1


def class_names(metadata: Mapping[str, str]) -> dict[int, str]:
    """The names of the classes of a channel by their number, from its metadata; 1 is a person unless named otherwise.

    Numbers that no row can have, and names that are empty, are left out.
    """
    names = {PERSON: "person"}
    for number, name in read_texts(metadata.get(_NAMES, "")).items():
        if _is_number(number) and name.strip():
            names[int(number)] = name.encode("utf-8", "backslashreplace").decode()
    return names


def class_name(number: int, names: Mapping[int, str]) -> str:
    """The name of a class in texts: its own, or its number if it has none."""
    return names.get(number) or {UNKNOWN: "unknown", PERSON: "person"}.get(number, f"class {number}")


def is_person(name: str) -> bool:
    """Whether a class of this name is people."""
    return name.strip().casefold() in PEOPLE


def has_classes(schema: Schema) -> bool:
    """Whether rows of a schema have a class."""
    return any(column.name == _COLUMN for column in schema.columns)


def only_class(schema: Schema, frames: Iterable[Frame]) -> int:
    """The class of all rows, if it stands in the metadata instead of in the rows; otherwise 0."""
    if not any(column.name == _COLUMN and column.since for column in schema.columns):
        return UNKNOWN
    first = UNKNOWN
    for frame in frames:
        if len(frame.rows):
            first = first or int(frame.rows[_COLUMN][0])
            if not first or (frame.rows[_COLUMN] != first).any():
                return UNKNOWN
    return first


def without_class(rows: Rows) -> Rows:
    """A copy of rows that state no class."""
    rows = rows.copy()
    rows[_COLUMN] = UNKNOWN
    return rows


def with_only_class(schema: Schema, rows: Rows, metadata: Mapping[str, str]) -> Rows:
    """Rows of a channel with the class that its metadata give to rows that state none."""
    only = metadata.get(_ONLY, "")
    if not (_is_number(only) and int(only) and has_classes(schema)):
        return rows
    rows = schema.joined([rows])
    rows[_COLUMN][rows[_COLUMN] == UNKNOWN] = int(only)
    rows.flags.writeable = False
    return rows


def first_classes(track: Ints, class_id: NDArray[Any], count: int) -> Ints:
    """The class of the first row of each of ``count`` tracks; ``track`` (N,) are their indices by row."""
    out = np.zeros(count, np.int64)
    out[track[::-1]] = class_id[::-1]
    return out


def majority(track: Ints, class_id: NDArray[Any], count: int) -> Ints:
    """The class of most rows of each of ``count`` tracks; of several, the one that comes first.

    ``track`` (N,) are indices of the tracks of rows, which are ordered by time within each track.
    """
    out = first_classes(track, class_id, count)
    if (class_id == out[track]).all():
        return out
    classes, which = np.unique(class_id, return_inverse=True)
    pairs, begins, votes = np.unique(track * len(classes) + which, return_index=True, return_counts=True)
    of = pairs // len(classes)
    order = np.lexsort((begins, -votes, of))
    best = order[np.unique(of[order], return_index=True)[1]]
    out[of[best]] = classes[pairs[best] % len(classes)]
    return out


def _is_number(text: str) -> bool:
    """Whether a text is the number of a class."""
    return text.isascii() and text.isdecimal() and len(text) <= len(str(_LAST)) and int(text) <= _LAST


def classes_beside_rows(class_id: str, classes: Mapping[str, str]) -> str:
    """The classes in the metadata of a channel, as text for its digest; "" where all are people."""
    is_plain = class_id in ("", str(PERSON)) and dict(classes) in ({}, {str(PERSON): "person"})
    return "" if is_plain else json.dumps([class_id, dict(classes)], sort_keys=True)
