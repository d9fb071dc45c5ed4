"""The classes of a detector: their names, the ones that are wanted, and their numbers in rows."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Final

from mcaptrack.errors import McaptrackError

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
#: Names of people, the usual one first.
_PEOPLE: Final = ("person", "pedestrian", "people", "human")
#: The number of people in rows; 0 is unknown.
_PERSON: Final = 1


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
    return {0: _PEOPLE[0]} if count == 1 else {index: str(index) for index in range(count)}


def numbers_of(names: Mapping[int, str]) -> dict[int, int]:
    """The number of each class in rows: 1 is a person, 0 stays free for what is unknown.

    Others keep their index, plus one where the network counts from 0.
    """
    first = 0 if 0 not in names else 1
    people = _people(names)
    numbers = {index: index + first for index in names}
    if people is not None and numbers[people] != _PERSON:
        taken = next((index for index, number in numbers.items() if number == _PERSON), None)
        if taken is not None:
            numbers[taken] = numbers[people]
        numbers[people] = _PERSON
    return numbers


def wanted(names: Mapping[int, str], classes: str, where: str) -> list[int]:
    """The indices of classes that are wanted: names or indices with commas between them, or ``all``.

    Raises McaptrackError, which begins with ``where``, for one that there is not.
    """
    if classes.strip() == "all":
        return sorted(names)
    by_name = {name.casefold(): index for index, name in names.items()}
    out = []
    for word in (word.strip() for word in classes.split(",")):
        index = by_name.get(word.casefold())
        if index is None and word.casefold() == _PEOPLE[0]:
            index = _people(names)
        if index is None and word.isdecimal() and int(word) in names:
            index = int(word)
        if index is None:
            close = difflib.get_close_matches(word.casefold(), by_name, 1)
            meant = f"did you mean {close[0]}? " if close else ""
            known = ", ".join(list(names.values())[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")
            raise McaptrackError(f"{where} has no class {word!r}; {meant}`classes=` takes {known}, or all")
        out.append(index)
    return sorted(set(out))


def _people(names: Mapping[int, str]) -> int | None:
    by_name = {name.casefold(): index for index, name in names.items()}
    return next((by_name[name] for name in _PEOPLE if name in by_name), None)
