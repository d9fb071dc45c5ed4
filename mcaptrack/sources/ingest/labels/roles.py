"""Which rows of a source of labels become detections, tracks or ground truth, and their class ids: decided once, for
all formats alike.

Letters: N rows, C classes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError, list_names
from mcaptrack.geometry.arrays import Bools, Ints
from mcaptrack.notices import warn
from mcaptrack.schema.classes import PERSON, UNKNOWN, ClassMap, is_person
from mcaptrack.sources.ingest.labels.table import (
    FORGIVEN,
    NO_CLASS,
    NO_ID,
    NOTHING,
    REGION,
    BoxTable,
    ClassIds,
    IgnoredBoxes,
)
from mcaptrack.sources.ingest.labels.text import is_count

_ALL: Final = "all"
_NAMED: Final = 10
_MAX_LISTED: Final = 20
_SHOWN: Final = 8
#: Names of classes that say that it isn't known.
_UNNAMED: Final = ("", "unknown")


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
        occurring = np.unique(class_id).tolist()
        by_name: dict[str, set[int]] = {}
        for number in occurring:
            by_name.setdefault(names.get(number, "").strip().casefold(), set()).add(number)
        wanted: set[int] = set()
        for word in (word.strip() for word in self.text.split(",")):
            numbers = by_name.get(word.casefold(), set()) if word else set()
            numbers = {PERSON} & {*occurring} if is_person(word) else numbers
            if not numbers and word.isascii() and word.isdecimal() and int(word[:12]) in occurring:
                numbers = {int(word)}
            if not numbers and not (self.may_lack and word):
                called = list_names([names.get(number) or f"{number}" for number in occurring], _NAMED)
                raise McaptrackError(f"{path} has no class {word!r:.60}; `classes=` takes {called}, or {_ALL}")
            wanted |= numbers
        return np.isin(class_id, sorted(wanted))


#: The default: people alone.
ONLY_PEOPLE: Final[WantedClasses] = WantedClasses()


def describe_classes(ids: NDArray[np.integer], counts: Ints, names: Mapping[int, str]) -> str:
    """List classes (C,), each with its name and the number of its rows."""
    called = [f"{number} {names.get(number, '')}".strip() for number in ids.tolist()]
    counted = [f"{name} ({count})" for name, count in zip(called, counts.tolist(), strict=True)]
    return list_names(counted, _MAX_LISTED)


def rename(table: BoxTable, class_map: ClassMap) -> None:
    """Give classes the names of a map, by their number in the source or their name there."""
    facts, numbers = table.facts, np.unique(table.class_id)
    own = facts.names or {}
    are_texts = facts.numbering is not None
    names = {} if are_texts else {int(n): name for n in numbers if n != NO_CLASS and (name := class_map.name(int(n)))}
    names = {number: class_map.name(name) or name for number, name in own.items()} | names
    if names == own:
        said = list_names([*own.values()] or [f"{number:g}" for number in numbers if number != NO_CLASS], _NAMED)
        warn(
            f"{table.path}: `class_map=` changes nothing here: its classes are {said or 'not stated'}",
            "option-not-used",
        )
        return
    facts.names, facts.named_by = names, "the option"


def settled(table: BoxTable, role: Role, wanted: WantedClasses | None, may_be_empty: bool = False) -> BoxTable:
    """The rows that suit a role, in order, with class ids as the schema of detections has them.

    ``wanted`` are the classes of tracks and ground truth; by default people, and of boxes in space all. Raises
    McaptrackError if there are none, unless it ``may_be_empty``.
    """
    class_id, classes = _class_ids(table)
    table = replace(table, class_id=class_id, classes=classes, role=role)
    if role == "truth" and not table.facts.scores_truth:
        table.score = np.full(len(table.frame), np.nan)
    wanted = wanted if wanted or table.in_space else ONLY_PEOPLE
    kept = _kept(table, role, wanted)
    if not kept.any() and not may_be_empty:
        is_people = role != "detections" and wanted is not None and wanted.is_people
        what, take = ("people", "; `classes=` takes others") if is_people else ("such boxes", "")
        raise McaptrackError(f"{table.path} holds no {what}, only {table.left_out}{take}")
    occurring = np.unique(class_id[kept]).tolist()
    table.classes = {number: name for number, name in classes.items() if number in occurring}
    if table.facts.named_by == "format" and occurring == [PERSON]:
        table.classes = {}
    table.counts = table.aside = None
    return table if kept.all() else table.take(kept)


def _kept(table: BoxTable, role: Role, wanted: WantedClasses | None) -> Bools:
    """Mask the rows that suit a role (N,), describe the others, and set aside what they mean in ground truth."""
    count, facts = len(table.frame), table.facts
    aside = np.full(count, NOTHING) if table.aside is None else table.aside
    region, is_wanted = aside == REGION, np.ones(count, bool)
    if role != "detections" and wanted is not None:
        is_people = wanted.is_people and not table.in_space
        is_wanted[~region] = (
            table.class_id[~region] == PERSON
            if is_people
            else wanted.mask(table.path, table.class_id[~region], table.classes)
        )
    elif facts.usual is not None:
        is_wanted = np.isin(table.class_id, [number for number, name in table.classes.items() if name in facts.usual])
    others = ~region & ~is_wanted
    uncounted = np.zeros(count, bool)
    if role == "truth" and table.counts is not None:
        uncounted = ~region & is_wanted & ~table.counts
    lacks_id = ~region & ~others & ~uncounted & (table.id == NO_ID) & table.has_ids & (role != "detections")
    kept: Bools = ~region & ~others & ~uncounted & ~lacks_id
    left = [table.left_out] if table.left_out else []
    left += [table.count_classes(others)] if others.any() else []
    left += [f"{int(region.sum())} regions{facts.region and f' ({facts.region})'}"] if region.any() else []
    left += [f"{int(uncounted.sum())} boxes that don't count ({facts.not_counting})"] if uncounted.any() else []
    left += [f"{int(lacks_id.sum())} boxes without a track id"] if lacks_id.any() else []
    table.left_out = " and ".join(left)
    if role == "truth" and table.boxes_px is not None and table.aside is not None:
        forgiven = (aside == FORGIVEN) | (uncounted & (aside == NOTHING))
        told = ~kept & (forgiven | (aside != NOTHING))
        table.ignored = IgnoredBoxes(table.frame[told], table.boxes_px[told], forgiven[told], region[told])
    return kept


def _class_ids(table: BoxTable) -> tuple[ClassIds, dict[int, str]]:
    """The class ids (N,) of the source's classes, and their names by class id, as the schema of detections has them.

    People are 1. Without names, numbers that begin with 0 are taken to begin with people, as in COCO, and are raised by
    one.
    """
    facts, kind = table.facts, table.class_id
    stated = kind != NO_CLASS
    if not stated.any():
        number = UNKNOWN if table.in_space else PERSON
        if not facts.named_by:
            taken = "class_id is 0" if table.in_space else "all boxes are taken as people"
            table.remark(f" states no classes; {taken}")
        return np.full(len(kind), number, np.uint32), {}
    if count := int((~stated).sum()):
        table.find(": {0} boxes without a class have class_id 0", "classes", count)
    names, places = facts.names, dict[int, int]()
    if names is None and facts.named_by:  # all are people, as the format has it
        return kind.astype(np.uint32), {}
    if names is not None and facts.numbering is not None and all(is_count(name, 9) for name in names.values()):
        kind = np.where(stated, np.array([*map(int, names.values())])[kind], NO_CLASS)
        names = None
    used = np.unique(kind[stated]).tolist()
    if names is None:
        shift = int(not table.in_space and (min(used) == 0 or facts.first_class == 0))
        text = ", and class_id is one higher than the file's numbers" if shift else ""
        table.find(
            f" has no class names; class {1 - shift} is taken as people{text}; `class_map=` names them", "classes"
        )
        return np.where(stated, kind + shift, UNKNOWN).astype(np.uint32), {}
    if facts.numbering is not None:
        places = _numbered_by_name(names, facts.numbering, facts.usual, used)
    else:
        places = _numbered_by_file(names)
        if moved := [f"{names[own]} ({own}) is {places[own]}" for own in used if places.get(own, own) != own]:
            table.remark(f": in class_id 1 is a person: {list_names(moved, _SHOWN)}")
    if nameless := [number for number in used if number not in places]:
        shown = list_names([*map(str, nameless)], _SHOWN)
        count = int(np.isin(kind, nameless).sum())
        table.find(f": {{0}} boxes have classes without a name ({shown}); their class_id is 0", "classes", count)
    classes: dict[int, str] = {}
    for own in sorted(places):
        if places[own] != UNKNOWN:
            classes.setdefault(places[own], names[own])
    ids = np.array([places.get(number, UNKNOWN) for number in used], np.uint32)
    out = np.full(len(kind), UNKNOWN, np.uint32)
    out[stated] = ids[np.searchsorted(used, kind[stated])]
    return out, classes


def _numbered_by_file(names: Mapping[int, str]) -> dict[int, int]:
    """Class ids by the numbers of a file: as they are, but for 0 and 1 where these are not people."""
    largest, places = max(max(names, default=0), PERSON), dict[int, int]()
    for own, name in sorted(names.items()):
        if is_person(name):
            places[own] = PERSON
        elif own > PERSON or (own == UNKNOWN and name.casefold() in _UNNAMED):
            places[own] = own
        else:
            places[own] = largest = largest + 1
    return places


def _numbered_by_name(
    names: Mapping[int, str], usual: Mapping[str, int], first: frozenset[str] | None, used: list[int]
) -> dict[int, int]:
    """Class ids by the numbers of names in rows: those of the format, and others in the order of their names; those of
    the classes in ``first`` come before.
    """
    folded = {own: names[own].casefold() for own in names}
    mine = {folded[own] for own in used if own in folded}
    others = {name for name in mine if name not in usual and not is_person(name) and name not in _UNNAMED}
    rank = {name.casefold() for name in first or ()}
    order = sorted(others, key=lambda name: (name not in rank, name))
    places = {name: number for number, name in enumerate(order, start=max(usual.values(), default=PERSON) + 1)}
    return {
        own: usual.get(name, PERSON if is_person(name) else places.get(name, UNKNOWN)) for own, name in folded.items()
    }
