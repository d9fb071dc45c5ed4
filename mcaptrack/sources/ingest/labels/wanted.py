"""Which classes of label files become tracks and ground truth. Letters: N rows, C classes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Bools, Ints
from mcaptrack.schema.classes import PERSON, is_person

_ALL: Final = "all"
_SHOWN: Final = 10
_MAX_LISTED: Final = 20


@dataclass(frozen=True)
class WantedClasses:
    """Names or numbers of classes with commas between them, or "all".

    ``may_lack``: a file may lack some of them, as tracks may that are compared with ground truth.
    """

    text: str = "person"
    may_lack: bool = False

    @property
    def is_people(self) -> bool:
        """Whether people alone are wanted."""
        return is_person(self.text)

    def mask(self, path: Path, class_id: NDArray[np.integer], names: Mapping[int, str]) -> Bools:
        """Mask the rows (N,) of wanted classes; ``names`` are those of the file by class id.

        Raises McaptrackError for a class that the file doesn't have, or if there is none at all in the text.
        """
        if self.text.strip().casefold() == _ALL:
            return np.ones(len(class_id), bool)
        there = np.unique(class_id).tolist()
        by_name: dict[str, set[int]] = {}
        for number in there:
            by_name.setdefault(names.get(number, "").strip().casefold(), set()).add(number)
        wanted: set[int] = set()
        for word in (word.strip() for word in self.text.split(",")):
            found = by_name.get(word.casefold(), set()) if word else set()
            found = {PERSON} & {*there} if is_person(word) else found
            if not found and word.isascii() and word.isdecimal() and int(word[:12]) in there:
                found = {int(word)}
            if not found and not (self.may_lack and word):
                called = [names.get(number) or f"{number}" for number in there]
                more = f" and {len(called) - _SHOWN} more" if len(called) > _SHOWN else ""
                raise McaptrackError(
                    f"{path} has no class {word!r:.60}; `classes=` takes {', '.join(called[:_SHOWN])}{more}, or {_ALL}"
                )
            wanted |= found
        return np.isin(class_id, sorted(wanted))


#: The default: people alone.
ONLY_PEOPLE: Final = WantedClasses()


def describe_classes(ids: NDArray[np.integer], counts: Ints, names: Mapping[int, str]) -> str:
    """List classes (C,), each with its name and the number of its rows; "" for one class."""
    if len(ids) < 2:
        return ""
    called = [f"{number} {names[number]}" if number in names else f"{number}" for number in ids.tolist()]
    listed = [f"{name} ({count})" for name, count in zip(called, counts.tolist(), strict=True)][:_MAX_LISTED]
    return ", ".join(listed) + (f" and {len(ids) - _MAX_LISTED} more" if len(ids) > _MAX_LISTED else "")
