"""Boxes that other software draws: the solids of markers of ROS and of scenes of Foxglove.

Drawings are measurements at the time at which they are added. They stay until they are deleted, replaced or over, and
may be locked to a frame, which says where a drawing is later and makes no difference then.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from math import dist, isfinite, isnan, nan, prod
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.contracts import Box3d, Quaternion, Vector
from mcaptrack.sources.foreign.decoding import integer, number, stamp_of, text
from mcaptrack.sources.foreign.fields import Message3d, head_of, part, quaternion, rotated, vector

_WORD: Final = re.compile(r"[^\W\d_][\w-]*")
_PERCENT: Final = re.compile(r"(?<![\w.])(\d{1,3}(?:\.\d+)?)\s*%")
#: A number from 0 to 1 that isn't a distance, speed or angle.
_SHARE: Final = re.compile(r"(?<![\w.-])(?:0?\.\d+|1\.0+|[01]\.)(?![\w.])(?!\s*(?:c?m|km|m?s|deg|rad|kph)\b|\s*°)")


class Solid(NamedTuple):
    """A box around a drawn solid; ``has_heading`` is false for what is round."""

    centre: Vector
    orientation: Quaternion
    size: Vector
    has_heading: bool = True


#: The points of the edges of a box.
_EDGES: Final = 24
#: The volume of three sides, as a share of that of a box with these sides.
_SQUARE: Final = 0.99


def wired(points: Sequence[Vector], centre: Vector, orientation: Quaternion) -> Iterator[Solid]:
    """The boxes that lines draw, edge by edge, in a frame at ``centre``."""
    if len(points) % _EDGES:
        return
    for begin in range(0, len(points), _EDGES):
        ends = np.array(points[begin : begin + _EDGES]).reshape(-1, 2, 3)
        corner = ends[0, 0]
        at_corner = np.isclose(ends, corner, atol=1e-6).all(axis=2)
        sides = (ends.sum(axis=1) - 2 * corner)[at_corner.any(axis=1)]
        corners = np.unique(np.round(ends.reshape(-1, 3), 6), axis=0)
        lengths = np.linalg.norm(sides, axis=1)
        if len(corners) == 8 and len(sides) == 3 and abs(np.linalg.det(sides)) > _SQUARE * lengths.prod() > 0:
            yield _boxed(sides, lengths, corners.mean(axis=0), centre, orientation)


def _boxed(sides: Any, lengths: Any, middle: Any, centre: Vector, orientation: Quaternion) -> Solid:
    """A box by its three sides: the most upright is the height, the longer of the others the length."""
    from scipy.spatial.transform import Rotation

    axes = sides / lengths[:, None]
    up = int(np.abs(axes[:, 2]).argmax())
    along, across = sorted({0, 1, 2} - {up}, key=lambda axis: -lengths[axis])
    x, z = axes[along], axes[up] * (1 if axes[up][2] >= 0 else -1)
    turn = Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=1))
    is_turned = any(orientation) and all(map(isfinite, orientation))
    whole = (Rotation.from_quat(orientation) * turn if is_turned else turn).as_quat().tolist()
    (place,) = _placed(centre, orientation, [middle])
    size = (float(lengths[along]), float(lengths[across]), float(lengths[up]))
    return Solid(place, (whole[0], whole[1], whole[2], whole[3]), size)


def _placed(centre: Vector, orientation: Quaternion, points: Sequence[Any]) -> list[Vector]:
    """Points of a group, given along its axes, in the frame of the group."""
    turned = rotated(np.array(orientation), np.array(points, np.float64).reshape(-1, 3))
    return [(x, y, z) for x, y, z in (np.array(centre) + turned).tolist()]


def words_of(said: str) -> tuple[str, float]:
    """The class and the score in a text beside a box: "car 0.93" -> "car", 0.93; "" and NaN where there are none."""
    word = _WORD.search(said)
    percent, share = _PERCENT.search(said), _SHARE.search(said)
    score = float(percent.group(1)) / 100 if percent else float(share.group()) if share else nan
    return (word.group() if word else ""), score if score <= 1 else nan


# foreign.SceneUpdate: an entity is a thing, which is drawn by solids of one kind.


#: Keys of metadata, in lower case and without separators, the first that there is.
_CLASS_KEYS: Final = ("class", "classname", "label", "category", "type", "objectclass", "classification", "objecttype")
_SCORE_KEYS: Final = ("score", "confidence", "probability", "existenceprobability")
_ID_KEYS: Final = ("trackid", "trackingid", "objectid", "instanceid")
_OTHERS: Final = ("arrows", "triangles", "texts", "models")


def scene_solids(message: Any) -> Message3d:
    """The solids of a message."""
    entities, deletions = list(part(message, "entities") or ()), list(part(message, "deletions") or ())
    first = next(iter([*entities, *deletions]), None)
    out = Message3d(_stamp(first))
    without = 0
    for entity in entities:
        solids = list(_solids(entity))
        out.boxes += [_of_entity(entity, solid, is_alone=len(solids) == 1) for solid in solids]
        without += not solids and any(part(entity, name) for name in (*_OTHERS, "lines"))
    out.ignored |= {"entities without solids": without} if without else {}
    out.is_measured = bool(out.boxes) or not (deletions or out.ignored)
    return out


def _stamp(entity: Any) -> int:
    return stamp_of(entity) if part(entity, "timestamp") is not None else 0


def _solids(entity: Any) -> Iterator[Solid]:
    """The cubes of an entity; or else its cylinders, spheres, or boxes of lines."""
    for kind in ("cubes", "cylinders", "spheres"):
        if solids := list(part(entity, kind) or ()):
            for solid in solids:
                yield Solid(*_pose(part(solid, "pose")), vector(part(solid, "size")), kind == "cubes")
            return
    for line in part(entity, "lines") or ():
        points = [vector(point) for point in part(line, "points") or ()]
        if indices := list(part(line, "indices") or ()):
            points = [points[integer(index)] for index in indices]
        if integer(part(line, "type") or 0) == _LINES:
            yield from wired(points, *_pose(part(line, "pose")))


#: The type of lines that are pairs of points.
_LINES: Final = 2


def _pose(pose: Any) -> tuple[Vector, Quaternion]:
    return vector(part(pose, "position")), quaternion(part(pose, "orientation"))


def _of_entity(entity: Any, solid: Solid, is_alone: bool) -> Box3d:
    said = {
        "".join(filter(str.isalnum, text(pair.key).lower())): _words(pair.value)
        for pair in part(entity, "metadata") or ()
    }
    texts = list(part(entity, "texts") or []) if is_alone else []
    word, share = words_of(text(texts[0].text)) if texts else ("", nan)
    score = _first(said, _SCORE_KEYS)
    return Box3d(
        _stamp(entity),
        text(part(entity, "frame_id") or ""),
        *solid[:3],
        _first(said, _CLASS_KEYS).strip() or word,
        _score(score) if score else share,
        # The id of several solids is that of none of them.
        _first(said, _ID_KEYS) or (_words(part(entity, "id")) if is_alone else "") or None,
        has_heading=solid.has_heading,
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


# visualization_msgs/MarkerArray and Marker.


_CUBE, _SPHERE, _CYLINDER, _LINE_LIST, _CUBE_LIST, _SPHERE_LIST, _TEXT, _ADD = 1, 2, 3, 5, 6, 7, 9, 0
#: Namespaces that say nothing about the class of their markers.
_GENERIC: Final = re.compile(
    r"((b(ounding)?_?box(es)?|(basic_?)?shapes?|(box|cluster|cube|cylinder|sphere|detection|id|marker|object|obstacle|track)"
    r"(e?s)?|ns)(_?array)?[\W_]*\d*|[\W\d_]*)"
)


def marker_solids(message: Any) -> Message3d:
    """The solids of a message; lines count only where there are none."""
    markers = list(message.markers) if hasattr(message, "markers") else [message]
    out = Message3d(head_of(markers[0])[0] if markers else 0)
    # Deletions say nothing about what is measured.
    added = [marker for marker in markers if integer(part(marker, "action") or 0) == _ADD]
    labels = _labels(added)
    solids = [(marker, list(_of_marker(marker))) for marker in added]
    if any(drawn and integer(marker.type) != _LINE_LIST for marker, drawn in solids):
        solids = [(marker, [] if integer(marker.type) == _LINE_LIST else drawn) for marker, drawn in solids]
    without = 0
    for marker, drawn in solids:
        if not drawn:
            without += integer(marker.type) != _TEXT or integer(marker.id) not in labels
        out.boxes += [_of_solid(marker, solid, labels) for solid in drawn]
    count, out.boxes = len(out.boxes), _without_parts(out.boxes)
    parts = count - len(out.boxes)
    out.ignored |= {"markers that are parts of larger ones with their id": parts} if parts else {}
    out.ignored |= {"markers that are no solids": without} if without else {}
    out.is_measured = bool(out.boxes) or not (markers and (out.ignored or not added))
    return out


def _without_parts(boxes: list[Box3d]) -> list[Box3d]:
    """Boxes without what is round, and above, below or inside of the largest with the same id: heads of bodies."""
    largest: dict[Any, Box3d] = {}
    for box in boxes:
        if box.source_id is not None and prod(box.size) > prod(largest.get(box.source_id, box).size):
            largest[box.source_id] = box
        largest.setdefault(box.source_id, box)

    def is_part(box: Box3d) -> bool:
        whole = largest[box.source_id]
        if box.source_id is None or box.has_heading or box.frame_id != whole.frame_id:
            return False
        is_smaller = prod(box.size) < prod(whole.size)
        return is_smaller and dist(box.centre[:2], whole.centre[:2]) < max(whole.size[:2]) / 2

    return [box for box in boxes if not is_part(box)]


def _of_marker(marker: Any) -> Iterator[Solid]:
    kind, (centre, orientation) = integer(marker.type), _pose(marker.pose)
    if kind in (_CUBE, _SPHERE, _CYLINDER):
        yield Solid(centre, orientation, vector(marker.scale), kind == _CUBE)
    elif kind in (_CUBE_LIST, _SPHERE_LIST):
        for place in _placed(centre, orientation, [vector(point) for point in part(marker, "points") or ()]):
            yield Solid(place, orientation, vector(marker.scale), kind == _CUBE_LIST)
    elif kind == _LINE_LIST:
        yield from wired([vector(point) for point in part(marker, "points") or ()], centre, orientation)


def _of_solid(marker: Any, solid: Solid, labels: dict[int, str]) -> Box3d:
    name, score = _marker_class(marker)
    source_id = None
    if integer(marker.type) not in (_CUBE_LIST, _SPHERE_LIST):
        source_id = integer(marker.id)
        label, share = words_of(labels.get(source_id, ""))
        name, score = name or label, share if isnan(score) else score
    head, (centre, orientation, size, has_heading) = head_of(marker), solid
    return Box3d(*head, centre, orientation, size, name, score, source_id, has_heading=has_heading)


def _labels(markers: list[Any]) -> dict[int, str]:
    """The texts of markers beside solids, by the id that they share with one solid."""
    kinds = {_TEXT: {_TEXT}, _CUBE: {_CUBE, _SPHERE, _CYLINDER}}
    solids, texts = (
        Counter(integer(marker.id) for marker in markers if integer(marker.type) in kinds[kind])
        for kind in (_CUBE, _TEXT)
    )
    return {
        integer(marker.id): text(part(marker, "text") or "")
        for marker in markers
        if integer(marker.type) == _TEXT and solids[integer(marker.id)] == texts[integer(marker.id)] == 1
    }


def _marker_class(marker: Any) -> tuple[str, float]:
    """The class, which is the namespace or, if that says nothing, a word of the text; and the score in the text."""
    space = text(part(marker, "ns") or "").strip().rpartition("/")[2]
    word, score = words_of(text(part(marker, "text") or ""))
    return (word, score) if _GENERIC.fullmatch(space.lower()) else (space, score)
