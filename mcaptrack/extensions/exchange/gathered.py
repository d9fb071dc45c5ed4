"""Rows of a file that isn't a table, gathered one after the other: of JSON, mostly.

Letters: N rows, C numbers of a box.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from mcaptrack.errors import McaptrackError, list_names
from mcaptrack.geometry.arrays import Floats
from mcaptrack.sources.ingest.labels.table import MAX_FRAME, NO_ID, NOTHING, BoxTable, LabelFacts
from mcaptrack.sources.ingest.labels.text import MAX_NAME, MAX_ROWS, ClassNames, FrameNames, TrackIds, is_count

_LISTED: Final = 10
#: A number as a text, of files that are made of XML or tables.
_NUMBER: Final = re.compile(r"\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*", re.ASCII)

Part = TypeVar("Part")


def is_number(value: Any) -> bool:
    """Whether a value of JSON is a number."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def number_in(value: Any) -> float | None:
    """The number that a value of JSON is, or that its text says; None if it is none."""
    if isinstance(value, str) and _NUMBER.fullmatch(value):
        return float(value)
    return as_float(value) if is_number(value) else None


def as_float(value: float) -> float:
    """A number of JSON, also one that is too large."""
    try:
        return float(value)
    except OverflowError:
        return math.inf


class GatheredRows:
    """Rows as they come: boxes in pictures, or in metres, which are all the same kind.

    ``noun`` names a row in messages, as "label".
    """

    def __init__(self, facts: LabelFacts, noun: str) -> None:
        self.facts, self._noun = facts, noun
        self._values, self._boxes, self._places = array("d"), array("d"), list[int | str]()
        self._ids, self._names = TrackIds(), ClassNames()

    def refuse(self, place: int | str, problem: str) -> McaptrackError:
        """The error for a row at this place in the file."""
        return McaptrackError(f"{self.facts.path}: {self._noun} {place} {problem}")

    def number(self, place: int | str, value: Any, key: str, missing: float = np.nan) -> float:
        """The number with this key. Raises McaptrackError if it is there, and none."""
        if value is not None and not is_number(value):
            raise self.refuse(place, f"has a {key} that isn't a number, {value!r:.40}")
        return missing if value is None else as_float(value)

    def numbers(self, place: str, content: Any, keys: Sequence[Any]) -> list[float]:
        """The numbers with these keys, or at these places, also as texts. Raises McaptrackError if there aren't all."""
        try:
            values = [number for key in keys if (number := number_in(content[key])) is not None]
        except (KeyError, IndexError, TypeError):
            values = []
        if len(values) != len(keys) or (isinstance(content, list) and len(content) != len(keys)):
            listed = ", ".join(map(str, keys))
            raise self.refuse(place, f"has no box of {len(keys)} numbers ({listed}): {str(content)[:60]}")
        return values

    def add(
        self,
        place: int | str,
        frame: float,
        box: Sequence[float],
        track: Any = None,
        name: Any = None,
        score: Any = None,
        *,
        kind: float | None = None,
        observed: bool = True,
        counts: bool = True,
        aside: int = NOTHING,
    ) -> None:
        """Add a row. ``track`` is a number or a text, ``name`` that of its class. Raises McaptrackError if not."""
        if isinstance(track, str):
            track = (int(track) if is_count(track, 15) else self._ids.number(track[:MAX_NAME])) if track else None
        own, stated = self.number(place, track, "track_id", NO_ID), self.number(place, score, "score")
        if name is not None and not isinstance(name, str):
            raise self.refuse(place, f"has a class that is no text: {str(name)[:40]!r}")
        kind = self._names.number(name or "") if kind is None else kind
        self._values.extend((frame, own, kind, stated, observed, counts, aside))
        self._boxes.extend(box)
        self._places.append(place)
        if len(self._places) > MAX_ROWS:
            raise McaptrackError(f"{self.facts.path} has more than {MAX_ROWS} boxes; give it in parts")

    def table(self) -> BoxTable:
        """All rows. Raises McaptrackError if there are none."""
        count, facts = len(self._places), self.facts
        if not count:
            raise McaptrackError(f"{facts.path} holds no boxes")
        values: Floats = np.frombuffer(self._values, np.float64).reshape(count, -1)
        boxes: Floats = np.frombuffer(self._boxes, np.float64).reshape(count, -1).copy()
        frame, own, kind, score, observed, counts, aside = values.T
        track_id, said = self._ids.of(facts.path, own)
        facts.name(self._names.names)
        places = self._places
        return BoxTable(
            facts=facts, at=lambda row: f"{facts.path}: {self._noun} {places[row]}", frame=frame, id=track_id,
            boxes_px=boxes if boxes.shape[1] == 4 else None, boxes_m=boxes if boxes.shape[1] == 7 else None,
            xy_m=boxes if boxes.shape[1] == 2 else None, score=score, class_id=kind,
            observed=observed == 1, counts=None if counts.all() else counts == 1,
            aside=aside.astype(int) if aside.any() or not counts.all() else None,
            remarks=said,
        )  # fmt: skip


def chosen_part(path: Path, parts: Mapping[str, Part], wanted: str | None, noun: str, where: str = "") -> Part:
    """The part of a file, a ``noun``, with this name, or the only one.

    Raises McaptrackError if there is none, or if there are several and none is named.
    """
    if wanted is None and len(parts) == 1:
        return next(iter(parts.values()))
    if wanted is None or wanted not in parts:
        what = f"no {noun} {wanted!r:.60}" if wanted else f"{len(parts)} {noun}s"
        listed = list_names(sorted(parts), _LISTED)
        raise McaptrackError(f"{path} has {what}{where}; choose one with `scene=`: {listed}")
    return parts[wanted]


def frame_numbers(names: Sequence[Any], entries: Sequence[Any] = (), keys: Sequence[str] = ()) -> tuple[list[int], str]:
    """The frame numbers of pictures by the first of ``keys`` with another number in each of ``entries``, or those in
    their ``names`` if all have one of one sequence, or their order; and which it is: the key, "names" or "order".
    """
    for key in keys:
        values = [entry.get(key) for entry in entries]
        numbers = [int(n) for n in values if is_number(n) and 0 <= n <= MAX_FRAME and n == int(n)]
        if len({*numbers}) == len(entries):
            return numbers, key
    reader = FrameNames()
    try:
        numbers = [reader.number(name) for name in names]
    except (AttributeError, TypeError, ValueError):
        numbers = []
    if numbers and len({*numbers}) == len(names) and max(numbers) <= MAX_FRAME:
        return numbers, "names"
    return [*range(len(names))], "order"
