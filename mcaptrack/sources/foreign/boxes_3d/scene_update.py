"""foxglove.SceneUpdate: the cubes of its entities.

Entities are drawings: they stay until they are deleted, replaced or ``lifetime`` is over. As measurements they count
once, at their timestamp; ``frame_locked`` says where a drawing is later, which makes no difference then.
"""

from __future__ import annotations

from math import nan
from typing import Any, Final

from mcaptrack.sources.foreign.boxes_3d.box import Box3d, Message3d, number, part, quaternion, vector, words_of
from mcaptrack.sources.foreign.decoding import stamp_of, text

#: Keys of metadata, in lower case and without separators, the first that there is.
_CLASS: Final = ("class", "classname", "label", "category", "type", "objectclass", "classification", "objecttype")
_SCORE: Final = ("score", "confidence", "probability", "existenceprobability")
_ID: Final = ("trackid", "trackingid", "objectid", "instanceid")
_OTHERS: Final = ("arrows", "spheres", "cylinders", "lines", "triangles", "texts", "models")


def boxes_of(message: Any) -> Message3d:
    """The cubes of a message."""
    entities, deletions = list(part(message, "entities") or ()), list(part(message, "deletions") or ())
    first = next(iter([*entities, *deletions]), None)
    out = Message3d(_stamp(first), text(part(first, "frame_id") or ""))
    for entity in entities:
        cubes = list(part(entity, "cubes") or ())
        if not cubes and any(part(entity, name) for name in _OTHERS):
            out.ignored["entities without cubes"] += 1
        out.boxes += [_box(entity, cube, is_alone=len(cubes) == 1) for cube in cubes]
    out.is_measured = bool(out.boxes) or not (deletions or out.ignored)
    return out


def _stamp(entity: Any) -> int:
    return stamp_of(entity) if part(entity, "timestamp") is not None else 0


def _box(entity: Any, cube: Any, is_alone: bool) -> Box3d:
    said = {
        "".join(filter(str.isalnum, text(pair.key).lower())): _words(pair.value)
        for pair in part(entity, "metadata") or ()
    }
    texts = list(part(entity, "texts") or []) if is_alone else []
    word, share = words_of(text(texts[0].text)) if texts else ("", nan)
    score = _first(said, _SCORE)
    pose = part(cube, "pose")
    return Box3d(
        _stamp(entity),
        text(part(entity, "frame_id") or ""),
        vector(part(pose, "position")),
        quaternion(part(pose, "orientation")),
        vector(part(cube, "size")),
        _first(said, _CLASS).strip() or word,
        _score(score) if score else share,
        # The id of several cubes is that of none of them.
        _first(said, _ID) or (_words(part(entity, "id")) if is_alone else "") or None,
    )


def _first(said: dict[str, str], keys: tuple[str, ...]) -> str:
    return next((said[key] for key in keys if said.get(key)), "")


def _words(value: Any) -> str:
    """A text; numbers count as theirs, since writers of JSON give ids and scores as numbers."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return repr(value) if is_number else text("" if value is None else value)


def _score(written: str) -> float:
    try:
        return number(written)
    except ValueError:
        return words_of(written)[1]
