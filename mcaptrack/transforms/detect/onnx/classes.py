"""The classes of a detector: their names, the ones that are wanted, and their numbers in rows."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Final

from mcaptrack.errors import McaptrackError
from mcaptrack.schema.classes import PEOPLE, PERSON

#: The classes of COCO in the order of networks that count 80.
COCO: Final = tuple(
    """
    person, bicycle, car, motorcycle, airplane, bus, train, truck, boat, traffic light, fire hydrant, stop sign,
    parking meter, bench, bird, cat, dog, horse, sheep, cow, elephant, bear, zebra, giraffe, backpack, umbrella,
    handbag, tie, suitcase, frisbee, skis, snowboard, sports ball, kite, baseball bat, baseball glove, skateboard,
    surfboard, tennis racket, bottle, wine glass, cup, fork, knife, spoon, bowl, banana, apple, sandwich, orange,
    broccoli, carrot, hot dog, pizza, donut, cake, chair, couch, potted plant, bed, dining table, toilet, tv, laptop,
    mouse, remote, keyboard, cell phone, microwave, oven, toaster, sink, refrigerator, book, clock, vase, scissors,
    teddy bear, hair drier, toothbrush
    """.replace("\n    ", " ")
    .strip()
    .split(", ")
)
#: The numbers up to 90 that COCO's own numbers of categories leave out.
_LEFT_OUT: Final = frozenset({0, 12, 26, 29, 30, 45, 66, 68, 69, 71, 83})


def names_of(declared: Mapping[int, str], count: int | None) -> dict[int, str]:
    """The names of classes by index: as the file declares them, or COCO's for 80, 91 or an unknown number of classes.

    The only class of a network is a person. Others without names are called by their index.
    """
    if declared:
        return dict(declared)
    if count in (80, None):
        return dict(enumerate(COCO))
    if count in (90, 91):
        numbers = [number for number in range(91) if number not in _LEFT_OUT]
        return dict(zip(numbers, COCO, strict=True))
    return {0: PEOPLE[0]} if count == 1 else {index: str(index) for index in range(count)}


def numbers_of(names: Mapping[int, str]) -> dict[int, int]:
    """The number of each class in rows: 1 is a person and nothing else, 0 stays free for what is unknown.

    Others keep their index, plus one where the network counts from 0; the one that would be 1 takes the number of
    people, or the next one after all if there are none.
    """
    first = 0 if 0 not in names else 1
    people = _people(names)
    numbers = {index: index + first for index in names}
    free = max(numbers.values(), default=0) + 1 if people is None else numbers[people]
    for index, number in numbers.items():
        if people is not None and names[index].casefold() == names[people].casefold():
            numbers[index] = PERSON
        elif number == PERSON:
            numbers[index] = free
    return numbers


def wanted(names: Mapping[int, str], classes: str, where: str) -> list[int]:
    """The indices of classes that are wanted: names or indices with commas between them, or ``all``.

    Raises McaptrackError, which begins with ``where``, for one that there is not.
    """
    if are_all(classes):
        return sorted(names)
    by_name: dict[str, list[int]] = {}
    for index, name in names.items():  # two classes may have one name
        by_name.setdefault(name.casefold(), []).append(index)
    out: set[int] = set()
    for word in filter(None, (word.strip().casefold() for word in classes.split(","))):
        people = _people(names) if word == PEOPLE[0] else None
        found = by_name.get(word) or ([] if people is None else by_name[names[people].casefold()])
        if not found and word.isdecimal() and int(word) in names:
            found = [int(word)]
        if not found:
            close = difflib.get_close_matches(word, by_name, 1)
            meant = f"did you mean {close[0]}? " if close else ""
            raise McaptrackError(f"{where} has no class {word!r}; {meant}`classes=` takes {_known(names)}")
        out.update(found)
    if not out:
        raise McaptrackError(f"`classes=` names none; {where} has {_known(names)}")
    return sorted(out)


def are_all(classes: str) -> bool:
    """Whether every class is wanted."""
    return classes.strip().casefold() == "all"


def _known(names: Mapping[int, str]) -> str:
    some = ", ".join(list(names.values())[:10])
    return f"{some} and {len(names) - 10} more, or all" if len(names) > 10 else f"{some}, or all"


def _people(names: Mapping[int, str]) -> int | None:
    """The first index of the class of people."""
    by_name = {name.casefold(): index for index, name in reversed(list(names.items()))}
    return next((by_name[name] for name in PEOPLE if name in by_name), None)
