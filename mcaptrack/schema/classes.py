"""Classes of objects: their numbers in rows, and their names in the metadata of a channel.

``mcaptrack.classes`` names the classes of a channel, as JSON: {"1": "person", "2": "bicycle"}. Where all rows of a
channel of tracks are of one class, it stands once in the metadata, as ``mcaptrack.class_id``, and not in the rows.

Letters: N rows.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.files import read_beginning
from mcaptrack.geometry.arrays import Ints
from mcaptrack.schema import Frame, Rows, Schema
from mcaptrack.schema.provenance import read_texts

__all__ = ["COCO", "PEOPLE", "PERSON", "UNKNOWN", "class_name", "class_names", "is_person"]

#: The class of what is not known, and of people.
UNKNOWN: Final = 0
PERSON: Final = 1
#: Names of people, in lower case, the usual one first.
PEOPLE: Final[tuple[str, ...]] = ("person", "pedestrian", "people", "human")
_COLUMN: Final = "class_id"
#: Keys of the metadata of channels: names of classes by number, and the class of all rows that state none.
_NAMES, _ONLY = "mcaptrack.classes", "mcaptrack.class_id"
_LAST: Final = 2**32 - 1
#: The names of the 80 classes of COCO as detectors number them, from 0.
COCO: Final[tuple[str, ...]] = tuple(
    """person|bicycle|car|motorcycle|airplane|bus|train|truck|boat|traffic light|fire hydrant|stop sign|parking meter
    |bench|bird|cat|dog|horse|sheep|cow|elephant|bear|zebra|giraffe|backpack|umbrella|handbag|tie|suitcase|frisbee|skis
    |snowboard|sports ball|kite|baseball bat|baseball glove|skateboard|surfboard|tennis racket|bottle|wine glass|cup
    |fork|knife|spoon|bowl|banana|apple|sandwich|orange|broccoli|carrot|hot dog|pizza|donut|cake|chair|couch
    |potted plant|bed|dining table|toilet|tv|laptop|mouse|remote|keyboard|cell phone|microwave|oven|toaster|sink
    |refrigerator|book|clock|vase|scissors|teddy bear|hair drier|toothbrush""".replace("\n    ", "").split("|")
)
#: A file of class names that is longer is none.
_MOST_BYTES: Final = 2**20
#: The path of a file with names that are numbered from another number than 0: labels.txt@1.
_NUMBERED_FROM: Final = re.compile(r"(.+)@(\d{1,9})", re.DOTALL)
#: A line of a file that states the number of its name: "0=person", "0: person", "0 person".
_NUMBERED_LINE: Final = re.compile(r"(\d{1,10})(?:\s*[=:]\s*|\s+)(\S.*)")


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


@dataclass(frozen=True)
class ClassMap:
    """The names of classes by what another program calls them, which is a number or a name.

    ``entries`` are pairs of its class and the name, in order. ``str`` is a text that ``parse`` reads, with the content
    of a file instead of its path, so that it says in provenance what was done.
    """

    entries: tuple[tuple[str, str], ...]

    @classmethod
    def parse(cls, text: str) -> Self:
        """A map from the text of an option.

        Parameters
        ----------
        text : str
            Pairs ("0=person,2=car", "ped=person"), as JSON where names have commas; "coco" for the 80 classes of COCO
            by number from 0; or the path of a file with a name in each line, numbered from 0 ("coco.names"), or with
            "@1" after the path from 1 ("labels.txt@1"), or by the numbers that all its lines begin with.

        Raises
        ------
        McaptrackError
            For a text that is none of these, a class that has two names, an empty name, and a file that can't be read.
        """
        if text == "coco":
            return cls.of_names(COCO)
        if text.startswith("{"):
            return cls._of_json(text)
        path, first = Path(text), 0
        if (numbered := _NUMBERED_FROM.fullmatch(text)) and not _is_file(path):
            path, first = Path(numbered[1]), int(numbered[2])
        if text.strip() and _is_file(path):
            return cls._of_lines(path, first)
        if "=" not in text:
            raise McaptrackError(
                f"{text!r} is no class map: neither a file with names, nor `coco`, nor pairs as `0=person,2=car`"
            )
        return cls._of_pairs([pair.partition("=")[::2] for pair in text.split(",") if pair.strip()], "class map")

    @classmethod
    def of_names(cls, names: Iterable[str], first: int = 0) -> Self:
        """A map of classes that are numbered from ``first``; an empty name leaves its number out."""
        return cls(tuple((str(number), name.strip()) for number, name in enumerate(names, first) if name.strip()))

    def name(self, own: int | str) -> str | None:
        """The name of a class that another program calls ``own``, in whatever case; None if the map has none."""
        return self._names.get(_folded(str(own)))

    def __str__(self) -> str:
        """The text form, which ``parse`` reads."""
        if self == type(self).of_names(COCO):
            return "coco"
        pairs = ",".join(f"{own}={name}" for own, name in self.entries)
        is_plain = not any(mark in own + name for own, name in self.entries for mark in ",=") and pairs[:1] != "{"
        return pairs if is_plain and pairs else json.dumps(dict(self.entries), ensure_ascii=False)

    @cached_property
    def _names(self) -> dict[str, str]:
        return {_folded(own): name for own, name in self.entries}

    @classmethod
    def _of_json(cls, text: str) -> Self:
        names = read_texts(text)
        if not names:
            raise McaptrackError(f'{text[:60]!r} is no class map: JSON as {{"0": "person"}} is read')
        return cls._of_pairs(names.items(), "class map")

    @classmethod
    def _of_lines(cls, path: Path, first: int) -> Self:
        data = read_beginning(path, _MOST_BYTES + 1)
        try:
            lines = data.decode("utf-8-sig").splitlines()
        except UnicodeDecodeError:
            lines = []
        if len(data) > _MOST_BYTES or not any(map(str.strip, lines)) or "\0" in lines[0]:
            raise McaptrackError(f"{path} has no names of classes: a text file with a name in each line is read")
        numbered = [_NUMBERED_LINE.fullmatch(line.strip()) for line in lines if line.strip()]
        if all(numbered):
            return cls._of_pairs([match.groups() for match in numbered if match], str(path))
        while lines and not lines[-1].strip():
            lines.pop()
        return cls.of_names(lines, first)

    @classmethod
    def _of_pairs(cls, pairs: Iterable[tuple[str, ...]], where: str) -> Self:
        entries: dict[str, tuple[str, str]] = {}
        for own, name in ((own.strip(), name.strip()) for own, name in pairs):
            if not own or not name:
                raise McaptrackError(f"{where}: {own}={name} is no pair of a class and a name, as 0=person is")
            before = entries.setdefault(_folded(own), (own, name))
            if before[1] != name:
                raise McaptrackError(f"{where}: class {own} has two names, {before[1]} and {name}")
        return cls(tuple(entries.values()))


def _folded(own: str) -> str:
    """A class as it is looked up: numbers without zeros before them, names in whatever case."""
    own = own.strip()
    return str(int(own)) if own.isascii() and own.isdecimal() and len(own) <= len(str(_LAST)) else own.casefold()


def _is_file(path: Path) -> bool:
    try:
        return path.exists() and not path.is_dir()
    except (OSError, ValueError):
        return False
