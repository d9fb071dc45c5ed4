"""Which classes of objects show people: they are hidden with the object.

Letters: N rows.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools
from mcaptrack.schema.classes import PEOPLE, UNKNOWN, class_name

#: Words for people in names of classes of data sets, as in "human.pedestrian.police_officer" or "Person_sitting".
_WORDS: Final = frozenset(
    {*PEOPLE, "persons", "pedestrians", "rider", "riders", "cyclist", "bicyclist", "motorcyclist", "adult", "child"}
    | {"man", "woman", "face", "head", "worker", "officer", "wheelchair", "stroller", "passenger", "driver"}
)
_LETTERS: Final = re.compile(r"[a-z]+")


def shows_people(name: str) -> bool:
    """Return whether objects of a class of this name are people, or carry them in view.

    Examples
    --------
    >>> [shows_people(name) for name in ("person", "human.pedestrian.adult", "BICYCLIST", "bicycle", "carriage")]
    [True, True, True, False, False]
    """
    return not _WORDS.isdisjoint(_LETTERS.findall(name.casefold()))


def people_among(class_id: NDArray[Any], names: Mapping[int, str]) -> Bools:
    """Which rows (N,) are people, or of unknown class."""
    numbers = class_id.astype(np.int64)
    wanted = [one for one in np.unique(numbers).tolist() if one == UNKNOWN or shows_people(class_name(one, names))]
    return np.asarray(np.isin(numbers, wanted), np.bool_)
