"""visualization_msgs/MarkerArray and Marker: cubes, and lists of cubes.

Markers are drawings, as entities of scenes are (see ``scene_update``): a cube counts when it is added.
"""

from __future__ import annotations

import re
from collections import Counter
from math import isnan
from typing import Any, Final

from mcaptrack.sources.foreign.boxes_3d.box import Box3d, Message3d, head_of, moved, part, quaternion, vector, words_of
from mcaptrack.sources.foreign.decoding import integer, text

_CUBE, _CUBE_LIST, _TEXT, _ADD = 1, 6, 9, 0
#: Namespaces that say nothing about the class of their markers.
_GENERIC: Final = re.compile(
    r"((b(ounding)?_?box(es)?|(basic_?)?shapes?|(box|cluster|cube|detection|id|marker|object|obstacle|track)(e?s)?|ns)"
    r"(_?array)?[\W_]*\d*|[\W\d_]*)"
)


def boxes_of(message: Any) -> Message3d:
    """The cubes of a message."""
    markers = list(message.markers) if hasattr(message, "markers") else [message]
    out = Message3d(*(head_of(markers[0]) if markers else (0, "")))
    # Deletions say nothing about what is measured.
    added = [marker for marker in markers if integer(part(marker, "action") or 0) == _ADD]
    labels = _labels(added)
    for marker in added:
        kind = integer(marker.type)
        if kind == _CUBE:
            name, score = _class_of(marker)
            label, share = words_of(labels.get(integer(marker.id), ""))
            name, score = name or label, share if isnan(score) else score
            pose = _pose(marker)
            box = Box3d(*head_of(marker), *pose, vector(marker.scale), name, score, integer(marker.id))
            out.boxes.append(box)
        elif kind == _CUBE_LIST:
            name, score = _class_of(marker)
            centre, orientation = _pose(marker)
            out.boxes += [
                Box3d(*head_of(marker), moved(centre, orientation, vector(point)), orientation, size, name, score)
                for size in [vector(marker.scale)]
                for point in part(marker, "points") or ()
            ]
        elif kind != _TEXT or integer(marker.id) not in labels:
            out.ignored["markers that are no cubes"] += 1
    out.is_measured = bool(out.boxes) or not (markers and (out.ignored or not added))
    return out


def _labels(markers: list[Any]) -> dict[int, str]:
    """The texts of markers beside cubes, by the id that they share with one cube."""
    cubes, texts = (
        Counter(integer(marker.id) for marker in markers if integer(marker.type) == kind) for kind in (_CUBE, _TEXT)
    )
    return {
        integer(marker.id): text(part(marker, "text") or "")
        for marker in markers
        if integer(marker.type) == _TEXT and cubes[integer(marker.id)] == texts[integer(marker.id)] == 1
    }


def _pose(marker: Any) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
    return vector(marker.pose.position), quaternion(part(marker.pose, "orientation"))


def _class_of(marker: Any) -> tuple[str, float]:
    """The class, which is the namespace or, if that says nothing, a word of the text; and the score in the text."""
    space = text(part(marker, "ns") or "").strip().rpartition("/")[2]
    word, score = words_of(text(part(marker, "text") or ""))
    return (word, score) if _GENERIC.fullmatch(space.lower()) else (space, score)
