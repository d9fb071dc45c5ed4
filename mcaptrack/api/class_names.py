"""Names of classes that a user gives: checked, or taken from the columns of a table. Letters: N rows."""

from __future__ import annotations

from collections.abc import Mapping
from operator import index as as_index
from typing import Any, Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.schema.classes import PERSON, UNKNOWN, is_person

_LAST: Final = 2**32 - 1
#: The longest name of a class.
_LONGEST: Final = 200
_NUMBER, _NAME = "class_id", "class"


def checked_names(classes: Mapping[int, str] | None) -> dict[int, str]:
    """Return the names of classes by number. Raises McaptrackError for what can't be a number or a name."""
    out = {}
    if classes is not None and not isinstance(classes, Mapping):
        raise McaptrackError(
            f"`classes=` is a mapping of numbers to names, as in {{2: 'bicycle'}}, not {classes!r:.40}"
        )
    for number, name in (classes or {}).items():
        try:
            whole = as_index(number)
        except TypeError:
            raise McaptrackError(f"a class is a whole number from 0 to {_LAST}, not {number!r:.40}") from None
        if not UNKNOWN <= whole <= _LAST:
            raise McaptrackError(f"a class is a whole number from 0 to {_LAST}, not {whole}")
        out[whole] = _checked_name(whole, name)
    return out


def _checked_name(number: int, name: object) -> str:
    if not isinstance(name, str) or not name.strip() or not name.isprintable() or len(name) > _LONGEST:
        raise McaptrackError(
            f"the name of class {number} is printable text of at most {_LONGEST} characters, not {name!r:.60}"
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
