"""Boxes of other software, as messages state them: those in pictures as rows of detections, those in space one by one.

Letters: N boxes.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import islice
from math import cos, isfinite, isnan, nan, sin
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.contracts import UNKNOWN_VECTOR, Box, Box3d, Quaternion, Vector, is_in_space
from mcaptrack.errors import McaptrackError
from mcaptrack.registry import BUILT_IN, Entry, blamed, find, others
from mcaptrack.registry.guard import Guard
from mcaptrack.schema import DETECTIONS, Rows
from mcaptrack.schema.classes import PERSON, UNKNOWN, is_person
from mcaptrack.schema.names import plain_name
from mcaptrack.sources.foreign.decoding import decoder_with_errors, integer, number, stamp_of, text, to_bytes
from mcaptrack.sources.foreign.definitions import MessageType

_KIND: Final = "message_reader"
#: Schemas of boxes of other software in pictures.
DETECTIONS_READ: Final = tuple(BUILT_IN[_KIND])[:3]

_NUMBER: Final = re.compile(r"[0-9]{1,10}")
_NAME: Final = re.compile(r"[^\W\d_]")
#: The maximum number of class names of a channel; ids from ``_FIRST_NAME`` on are placeholders until all names are
#: known.
_MAX_NAMES: Final = 1024
_FIRST_NAME: Final = 2**32 - _MAX_NAMES
_SHOWN: Final = 12
_PERSON: Final = "person"


class Classes:
    """The classes of one channel: numeric classes keep their id, people are 1, and other names get new ids.

    New ids follow the largest id of the channel in alphabetical order, so that they don't depend on the order of
    messages.
    """

    def __init__(self) -> None:
        self._names: dict[str, int] = {}
        self._people: set[str] = set()
        self._largest = PERSON

    def class_id(self, name: str) -> int:
        """The id of a class; for a name a placeholder, which ``numbers`` maps to the final id."""
        if is_person(name):
            self._people.add(name)
            return PERSON
        if _NUMBER.fullmatch(name):
            number = int(name) if int(name) < _FIRST_NAME else UNKNOWN
            self._largest = max(self._largest, number)
            return number
        if not _NAME.search(name) or (name not in self._names and len(self._names) == _MAX_NAMES):
            return UNKNOWN
        return self._names.setdefault(name, _FIRST_NAME + len(self._names))

    def numbers(self) -> dict[int, int]:
        """The final id of each class name, by the placeholder from ``class_id``."""
        order = enumerate(sorted(self._names), start=self._largest + 1)
        return {self._names[name]: number for number, name in order}

    def names_by_id(self) -> dict[int, str]:
        """The names of all classes by their final id; of people only where all have one name other than "person"."""
        people = {PERSON: min(self._people)} if len(self._people) == 1 and self._people != {_PERSON} else {}
        return people | dict(enumerate(sorted(self._names), start=self._largest + 1))

    def nameless(self, used: Collection[int]) -> list[int]:
        """The final ids among ``used`` that messages state as numbers, without a name; 0 is no class."""
        named = set(self.numbers().values()) | ({PERSON} if self._people else set()) | {UNKNOWN}
        return sorted(set(used) - named)

    def named(self) -> list[tuple[str, int]]:
        """The first class names in alphabetical order, with their ids."""
        return list(islice(zip(sorted(self._names), range(self._largest + 1, 2**32), strict=False), _SHOWN))


def boxes_decoder(
    kind: MessageType, classes: Classes, stamps: list[int | None] | None = None
) -> Callable[[bytes], Rows]:
    """A function that decodes payloads of a channel to rows of detections (N,); raises as ``picture_decoder`` does.

    ``classes`` collects the class names, and ``stamps`` the stamp of the picture that each message is about.
    """
    reader = reader_of(kind.name)
    if reader is None or reader.in_space:
        raise McaptrackError(
            f"it holds {kind.name or 'no schema'}, not detections; {', '.join(DETECTIONS_READ)} are read"
        )

    def decode(message: Any) -> Rows:
        if stamps is not None:
            stamps.append(picture_stamp_of(message))
        return rows_of(reader.read(message), classes)

    return decoder_with_errors(kind, decode)


def picture_stamp_of(message: Any) -> int | None:
    """The stamp in ns of the picture of a message: of its ``image_header`` (darknet), or its own; None if unset."""
    about = getattr(message, "image_header", None)
    try:
        stamp_ns = stamp_of(message) if about is None else stamp_of(SimpleNamespace(header=about))
    except (AttributeError, TypeError, ValueError):
        return None
    return stamp_ns or None


def rows_of(boxes: Sequence[Box], classes: Classes) -> Rows:
    """Rows of detections of boxes."""
    *numbers, _ = zip(*boxes, strict=True) if boxes else ((),) * 6
    columns = dict(zip(("x_px", "y_px", "w_px", "h_px", "score"), numbers, strict=True))
    ids = [classes.class_id(box.class_name) if box.class_name else UNKNOWN for box in boxes]
    return DETECTIONS.rows(class_id=np.array(ids, np.uint32), **columns)


def detections_2d(message: Any) -> list[Box]:
    """The boxes of a message of vision_msgs."""
    return [_box(detection) for detection in message.detections]


def _box(detection: Any) -> Box:
    """The upright box around a detection, with its best score."""
    centre = detection.bbox.center
    place = getattr(centre, "position", centre)  # a Point2D in vision_msgs 4, a Pose2D in version 3
    x, y, theta, w, h = (
        float(value)
        for value in (place.x, place.y, getattr(centre, "theta", 0.0), detection.bbox.size_x, detection.bbox.size_y)
    )
    _check_box(x, y, w, h, theta)
    if theta:
        w, h = (abs(w * cos(theta)) + abs(h * sin(theta)), abs(w * sin(theta)) + abs(h * cos(theta)))
    name, score = best_hypothesis(detection.results)
    return Box(x - w / 2, y - h / 2, w, h, score, name or "")


def darknet_boxes(message: Any) -> list[Box]:
    """The boxes of a message of darknet_ros."""
    return [_darknet_box(box) for box in message.bounding_boxes]


def _darknet_box(box: Any) -> Box:
    left, top, right, bottom = (number(getattr(box, name)) for name in ("xmin", "ymin", "xmax", "ymax"))
    _check_box(left, top, right - left, bottom - top)
    name = box.class_id if hasattr(box, "class_id") else box.Class  # in ROS 1
    return Box(left, top, right - left, bottom - top, number(box.probability), text(name))


def yolo_boxes(message: Any) -> list[Box]:
    """The boxes of a message of yolo_ros."""
    return [_yolo_box(detection) for detection in message.detections]


def _yolo_box(detection: Any) -> Box:
    place, size = detection.bbox.center.position, detection.bbox.size
    x, y, w, h = (number(value) for value in (place.x, place.y, size.x, size.y))
    _check_box(x, y, w, h)
    return Box(x - w / 2, y - h / 2, w, h, number(detection.score), text(detection.class_name))


def _check_box(x: float, y: float, w: float, h: float, theta: float = 0.0) -> None:
    """Raise ValueError for a box that can't be."""
    if not all(isfinite(value) for value in (x, y, theta, w, h)) or w < 0 or h < 0:
        raise ValueError(f"a box can't be {w:g} x {h:g} at ({x:g}, {y:g})")


def best_hypothesis(results: Any) -> tuple[str | None, float]:
    """The class with the highest score of results of vision_msgs, None if there is none, and its score, or NaN.

    Before ROS 2 Humble a result is its own hypothesis, with ``id`` in the place of ``class_id``.
    """
    guesses = [getattr(result, "hypothesis", result) for result in results]
    scored = [(number(guess.score), guess) for guess in guesses]
    finite = [(score, guess) for score, guess in scored if isfinite(score)]
    score, best = max(finite or scored, key=lambda pair: pair[0], default=(nan, None))
    if best is None:
        return None, nan
    return str(best.class_id if hasattr(best, "class_id") else best.id).strip(), score if finite else nan


# 3D boxes of other software, as messages state them: what the families of messages share, then each family.
#
# A family is a function that takes a decoded message to a ``Message3d``; ``recorded`` makes arrays of all messages
# of a channel.


_ORIGIN: Final[Vector] = (0.0, 0.0, 0.0)
#: A quaternion of zeros: the orientation isn't stated.
UNSTATED: Final[Quaternion] = (0.0, 0.0, 0.0, 0.0)
_WORD: Final = re.compile(r"[^\W\d_][\w-]*")
_PERCENT: Final = re.compile(r"(?<![\w.])(\d{1,3}(?:\.\d+)?)\s*%")
#: A number from 0 to 1 that isn't a distance, speed or angle.
_SHARE: Final = re.compile(r"(?<![\w.-])(?:0?\.\d+|1\.0+|[01]\.)(?![\w.])(?!\s*(?:c?m|km|m?s|deg|rad|kph)\b|\s*°)")


@dataclass
class Message3d:
    """The boxes of a message, and a count of its other parts for each description of them.

    ``is_measured`` is false for a message that only takes boxes away from a viewer: nothing was measured then.
    """

    stamp_ns: int
    frame_id: str
    boxes: list[Box3d] = field(default_factory=list)
    ignored: Counter[str] = field(default_factory=Counter)
    is_measured: bool = True


def head_of(message: Any) -> tuple[int, str]:
    """Stamp in ns and frame of a message with a ROS header."""
    return stamp_of(message), text(message.header.frame_id)


def own_head(message: Any, around: tuple[int, str]) -> tuple[int, str]:
    """Stamp and frame of a part of a message: its own, or, where it states no frame, those of the message around it."""
    stamp_ns, frame_id = head_of(message)
    return (stamp_ns or around[0], frame_id) if frame_id else around


def vector(value: Any) -> Vector:
    """A point or vector; the origin where it is missing, as protobuf leaves out zeros."""
    return _ORIGIN if value is None else (number(value.x), number(value.y), number(value.z))


def quaternion(value: Any) -> Quaternion:
    """A quaternion; zeros where it is missing."""
    return UNSTATED if value is None else (number(value.x), number(value.y), number(value.z), number(value.w))


def part(message: Any, name: str) -> Any:
    """A field of a message; None where it is missing, as optional fields of JSON are."""
    return getattr(message, name, None)


def rotated(orientation: Quaternion, point: Vector) -> Vector:
    """A point turned by a quaternion; as it is by one of zeros."""
    x, y, z, w = orientation
    norm = x * x + y * y + z * z + w * w
    if not norm or not isfinite(norm):
        return point
    a, b, c = point
    # p + 2 w (q x p) + 2 q x (q x p), for a quaternion that need not have length 1
    u, v, t = y * c - z * b, z * a - x * c, x * b - y * a
    return (
        a + 2 * (w * u + y * t - z * v) / norm,
        b + 2 * (w * v + z * u - x * t) / norm,
        c + 2 * (w * t + x * v - y * u) / norm,
    )


def moved(centre: Vector, orientation: Quaternion, point: Vector) -> Vector:
    """A point of a box or group, given along its axes, in the frame of the box."""
    x, y, z = rotated(orientation, point)
    return centre[0] + x, centre[1] + y, centre[2] + z


def around(points: Sequence[Vector]) -> tuple[Vector, Vector]:
    """Middle and size of the box around points, along their axes. There has to be one at least."""
    low, high = (tuple(pick(point[axis] for point in points) for axis in range(3)) for pick in (min, max))
    middle = ((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, (low[2] + high[2]) / 2)
    return middle, (high[0] - low[0], high[1] - low[1], high[2] - low[2])


def named(names: Mapping[int, str], label: Any) -> str:
    """The name of a class by its number in an enumeration; the number where it has none."""
    return names.get(integer(label), str(integer(label)))


def enumeration(message: Any, prefix: str = "") -> Mapping[int, str]:
    """The names of classes by number that the recorded definition of a message states, as constants with a prefix.

    Names are in lower case, without the prefix; "unknown" is "". Empty where there are no constants, as in JSON.
    """
    kind: Any = type(message)
    return _constants(kind, prefix)


@lru_cache(maxsize=64)
def _constants(kind: Any, prefix: str) -> Mapping[int, str]:
    whole = {name: value for name, value in vars(kind).items() if name.isupper() and isinstance(value, int)}
    names = {value: name.removeprefix(prefix).lower() for name, value in whole.items() if name.startswith(prefix)}
    return {value: "" if name == "unknown" else name for value, name in names.items()}


def words_of(said: str) -> tuple[str, float]:
    """The class and the score in a text beside a box: "car 0.93" -> "car", 0.93; "" and NaN where there are none."""
    word = _WORD.search(said)
    percent, share = _PERCENT.search(said), _SHARE.search(said)
    score = float(percent.group(1)) / 100 if percent else float(share.group()) if share else nan
    return (word.group() if word else ""), score if score <= 1 else nan


# vision_msgs/Detection3DArray, in its forms before ROS 2 Humble and since.


def detections_3d(message: Any) -> Message3d:
    """The boxes of a message."""
    head = head_of(message)
    return Message3d(*head, [_detection(detection, head) for detection in message.detections])


def _stated_pose(centre: Any, results: Any) -> Any:
    """The pose of a box; that of its first result where only this one is filled in."""
    stated = [result.pose.pose for result in results if part(part(result, "pose"), "pose") is not None]
    is_unset = not any(vector(centre.position)) and bool(stated) and any(vector(stated[0].position))
    return stated[0] if is_unset else centre


def _detection(detection: Any, around: tuple[int, str]) -> Box3d:
    class_name, score = best_hypothesis(detection.results)
    pose = _stated_pose(detection.bbox.center, detection.results)
    return Box3d(
        *own_head(detection, around),
        vector(pose.position),
        quaternion(part(pose, "orientation")),
        vector(detection.bbox.size),
        class_name or "",
        score,
        part(detection, "id") or part(detection, "tracking_id") or None,
    )


# foxglove.SceneUpdate: the cubes of its entities.
#
# Entities are drawings: they stay until they are deleted, replaced or ``lifetime`` is over. As measurements they count
# once, at their timestamp; ``frame_locked`` says where a drawing is later, which makes no difference then.


#: Keys of metadata, in lower case and without separators, the first that there is.
_CLASS_KEYS: Final = ("class", "classname", "label", "category", "type", "objectclass", "classification", "objecttype")
_SCORE_KEYS: Final = ("score", "confidence", "probability", "existenceprobability")
_ID_KEYS: Final = ("trackid", "trackingid", "objectid", "instanceid")
_OTHERS: Final = ("arrows", "spheres", "cylinders", "lines", "triangles", "texts", "models")


def scene_cubes(message: Any) -> Message3d:
    """The cubes of a message."""
    entities, deletions = list(part(message, "entities") or ()), list(part(message, "deletions") or ())
    first = next(iter([*entities, *deletions]), None)
    out = Message3d(_stamp(first), text(part(first, "frame_id") or ""))
    for entity in entities:
        cubes = list(part(entity, "cubes") or ())
        if not cubes and any(part(entity, name) for name in _OTHERS):
            out.ignored["entities without cubes"] += 1
        out.boxes += [_cube(entity, cube, is_alone=len(cubes) == 1) for cube in cubes]
    out.is_measured = bool(out.boxes) or not (deletions or out.ignored)
    return out


def _stamp(entity: Any) -> int:
    return stamp_of(entity) if part(entity, "timestamp") is not None else 0


def _cube(entity: Any, cube: Any, is_alone: bool) -> Box3d:
    said = {
        "".join(filter(str.isalnum, text(pair.key).lower())): _words(pair.value)
        for pair in part(entity, "metadata") or ()
    }
    texts = list(part(entity, "texts") or []) if is_alone else []
    word, share = words_of(text(texts[0].text)) if texts else ("", nan)
    score = _first(said, _SCORE_KEYS)
    pose = part(cube, "pose")
    return Box3d(
        _stamp(entity),
        text(part(entity, "frame_id") or ""),
        vector(part(pose, "position")),
        quaternion(part(pose, "orientation")),
        vector(part(cube, "size")),
        _first(said, _CLASS_KEYS).strip() or word,
        _score(score) if score else share,
        # The id of several cubes is that of none of them.
        _first(said, _ID_KEYS) or (_words(part(entity, "id")) if is_alone else "") or None,
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


# visualization_msgs/MarkerArray and Marker: cubes, and lists of cubes. They are drawings, as entities of scenes are: a
# cube counts when it is added.


_CUBE, _CUBE_LIST, _TEXT, _ADD = 1, 6, 9, 0
#: Namespaces that say nothing about the class of their markers.
_GENERIC: Final = re.compile(
    r"((b(ounding)?_?box(es)?|(basic_?)?shapes?|(box|cluster|cube|detection|id|marker|object|obstacle|track)(e?s)?|ns)"
    r"(_?array)?[\W_]*\d*|[\W\d_]*)"
)


def marker_cubes(message: Any) -> Message3d:
    """The cubes of a message."""
    markers = list(message.markers) if hasattr(message, "markers") else [message]
    out = Message3d(*(head_of(markers[0]) if markers else (0, "")))
    # Deletions say nothing about what is measured.
    added = [marker for marker in markers if integer(part(marker, "action") or 0) == _ADD]
    labels = _labels(added)
    for marker in added:
        kind = integer(marker.type)
        if kind == _CUBE:
            name, score = _marker_class(marker)
            label, share = words_of(labels.get(integer(marker.id), ""))
            name, score = name or label, share if isnan(score) else score
            pose = _marker_pose(marker)
            box = Box3d(*head_of(marker), *pose, vector(marker.scale), name, score, integer(marker.id))
            out.boxes.append(box)
        elif kind == _CUBE_LIST:
            name, score = _marker_class(marker)
            centre, orientation = _marker_pose(marker)
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


def _marker_pose(marker: Any) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
    return vector(marker.pose.position), quaternion(part(marker.pose, "orientation"))


def _marker_class(marker: Any) -> tuple[str, float]:
    """The class, which is the namespace or, if that says nothing, a word of the text; and the score in the text."""
    space = text(part(marker, "ns") or "").strip().rpartition("/")[2]
    word, score = words_of(text(part(marker, "text") or ""))
    return (word, score) if _GENERIC.fullmatch(space.lower()) else (space, score)


# jsk_recognition_msgs/BoundingBoxArray.


def jsk_boxes(message: Any) -> Message3d:
    """The boxes of a message."""
    head = head_of(message)
    return Message3d(*head, [_jsk_box(box, head) for box in message.boxes])


def _jsk_box(box: Any, around: tuple[int, str]) -> Box3d:
    return Box3d(
        *own_head(box, around),
        vector(box.pose.position),
        quaternion(part(box.pose, "orientation")),
        vector(box.dimensions),
        str(integer(box.label)),
        number(box.value) or nan,  # 0 where no value is set
    )


# derived_object_msgs/ObjectArray.


#: The classes of derived_object_msgs/Object, for messages without their definition (JSON).
_OBJECT_NAMES: Final = (
    ",unknown_small,unknown_medium,unknown_big,pedestrian,bike,car,truck,motorcycle,other_vehicle,barrier,sign"
)
_OBJECT_CLASSES: Final = dict(enumerate(_OBJECT_NAMES.split(",")))
_PREFIX: Final = "CLASSIFICATION_"
#: The largest certainty of a classification.
_CERTAIN: Final = 255
#: The level of detection from which the velocity is known.
_TRACKED: Final = 1
#: The types of shape_msgs/SolidPrimitive.
_BOX, _SPHERE, _CYLINDER, _CONE = 1, 2, 3, 4


def derived_objects(message: Any) -> Message3d:
    """The objects of a message. Those without a shape, as of radars, have the size of their polygon, or none."""
    head = head_of(message)
    return Message3d(*head, [_object_box(seen, head) for seen in message.objects])


def _shape_size(shape: Any) -> Vector:
    """The size of the box around a shape; NaN if it has none."""
    kind, lengths = integer(shape.type), [number(dimension) for dimension in shape.dimensions]
    if kind == _BOX and len(lengths) >= 3:
        return lengths[0], lengths[1], lengths[2]
    if kind == _SPHERE and lengths:
        return 2 * lengths[0], 2 * lengths[0], 2 * lengths[0]
    if kind in (_CYLINDER, _CONE) and len(lengths) >= 2:  # height and radius
        return 2 * lengths[1], 2 * lengths[1], lengths[0]
    return UNKNOWN_VECTOR


def _object_box(seen: Any, head: tuple[int, str]) -> Box3d:
    certainty = integer(seen.classification_certainty)
    centre, size = vector(seen.pose.position), _shape_size(seen.shape)
    orientation = quaternion(part(seen.pose, "orientation"))
    if isnan(size[0]) and (points := [vector(point) for point in part(part(seen, "polygon"), "points") or ()]):
        x, y, z, w = orientation
        along = [rotated((-x, -y, -z, w), point) for point in points]  # the polygon is in the frame of the message
        middle, (length, width, _) = around(along)
        centre, size = rotated(orientation, middle), (length, width, nan)
    return Box3d(
        *own_head(seen, head),
        centre,
        orientation,
        size,
        named(enumeration(seen, _PREFIX) or _OBJECT_CLASSES, seen.classification),
        certainty / _CERTAIN if certainty else nan,
        integer(seen.id),
        vector(seen.twist.linear) if integer(seen.detection_level) == _TRACKED else UNKNOWN_VECTOR,
    )


# People without a size: people_msgs/People, and TrackedPersons and DetectedPersons of spencer_tracking_msgs.


def people(message: Any) -> Message3d:
    """The people of a message."""
    head = head_of(message)
    return Message3d(
        *head,
        [
            Box3d(
                *head,
                vector(person.position),
                UNSTATED,
                UNKNOWN_VECTOR,
                _PERSON,
                number(person.reliability),
                text(person.name) or None,
                vector(person.velocity),
                has_heading=False,
            )
            for person in message.people
        ],
    )


def spencer_people(message: Any) -> Message3d:
    """The tracked or detected people of a message."""
    head = head_of(message)
    tracks, detections = part(message, "tracks") or (), part(message, "detections") or ()
    boxes = [_spencer_person(head, track, integer(track.track_id), nan) for track in tracks]
    boxes += [_spencer_person(head, seen, None, number(seen.confidence)) for seen in detections]
    return Message3d(*head, boxes)


def _spencer_person(head: tuple[int, str], person: Any, track_id: int | None, score: float) -> Box3d:
    pose, twist = person.pose.pose, part(person, "twist")
    velocity = UNKNOWN_VECTOR if twist is None else vector(twist.twist.linear)
    orientation = quaternion(part(pose, "orientation"))
    return Box3d(*head, vector(pose.position), orientation, UNKNOWN_VECTOR, _PERSON, score, track_id, velocity)


# DetectedObjects, TrackedObjects and PredictedObjects of Autoware (autoware_perception_msgs and
# autoware_auto_perception_msgs).


#: The labels of ObjectClassification, for messages without their definition (JSON). Earlier ones had no bus.
_AUTOWARE_NAMES: Final = (
    ",car,truck,bus,trailer,motorcycle,bicycle,pedestrian,animal,hazard,over_drivable,under_drivable"
)
_AUTOWARE_CLASSES: Final = dict(enumerate(_AUTOWARE_NAMES.split(",")))
_AUTOWARE_CYLINDER, _AUTOWARE_POLYGON = 1, 2
_HEADING_UNKNOWN: Final = 0


def autoware_objects(message: Any) -> Message3d:
    """The objects of a message."""
    head = head_of(message)
    return Message3d(*head, [_autoware_box(item, head) for item in message.objects])


def _autoware_box(item: Any, head: tuple[int, str]) -> Box3d:
    kinematics, shape = item.kinematics, item.shape
    is_predicted = hasattr(kinematics, "initial_pose_with_covariance")
    now = kinematics.initial_pose_with_covariance if is_predicted else kinematics.pose_with_covariance
    pose = now.pose
    centre, orientation, size = vector(pose.position), quaternion(part(pose, "orientation")), vector(shape.dimensions)
    if integer(shape.type) == _AUTOWARE_CYLINDER:  # x is the diameter
        size = (size[0], size[0], size[2])
    elif integer(shape.type) == _AUTOWARE_POLYGON:
        middle, size = _footprint([vector(point) for point in shape.footprint.points], size[2])
        centre = moved(centre, orientation, middle)
    velocity = UNKNOWN_VECTOR
    if getattr(kinematics, "has_twist", True):  # along the axes of the object
        moves = kinematics.initial_twist_with_covariance if is_predicted else kinematics.twist_with_covariance
        velocity = rotated(orientation, vector(moves.twist.linear))
    name, probability = _likeliest(item)
    existence = number(item.existence_probability)
    return Box3d(
        *head,
        centre,
        orientation,
        size,
        name,
        existence if existence > 0 else probability,
        _uuid(item),
        velocity,
        is_predicted or integer(kinematics.orientation_availability) != _HEADING_UNKNOWN,
    )


def _likeliest(item: Any) -> tuple[str, float]:
    """The likeliest class, and its probability; "" and NaN if there is none."""
    guesses = [(number(guess.probability), guess) for guess in item.classification]
    shares = [(share if isfinite(share) else -1.0, guess) for share, guess in guesses]
    if not shares:
        return "", nan
    share, guess = max(shares, key=lambda pair: pair[0])
    return named(enumeration(guess) or _AUTOWARE_CLASSES, guess.label), share if share > 0 else nan


def _footprint(points: list[Vector], height: float) -> tuple[Vector, Vector]:
    """Middle and size of the upright box around a footprint, along the axes of the object."""
    if not points:
        return (0.0, 0.0, 0.0), (nan, nan, height)
    (x, y, _), (length, width, _) = around(points)
    return (x, y, 0.0), (length, width, height)


def _uuid(item: Any) -> str | None:
    """The UUID of a tracked object, in hexadecimal; None for a detected one."""
    uuid = part(item, "object_id")
    return None if uuid is None else to_bytes(uuid.uuid).hex()


#: Schemas of 3D boxes, by their names in ROS 1 and Foxglove; ROS 2 adds "/msg/".
BOXES_3D_READ: Final = tuple(BUILT_IN[_KIND])[3:]
#: Those that are drawings: a channel with such messages need not hold boxes.
DRAWINGS: Final = ("foxglove.SceneUpdate", "visualization_msgs/MarkerArray", "visualization_msgs/Marker")


def boxes_3d_decoder(kind: MessageType) -> Callable[[bytes], Message3d]:
    """A function that decodes payloads of a channel to 3D boxes; raises as ``picture_decoder`` does."""
    reader = reader_of(kind.name)
    if reader is None or not reader.in_space:
        raise McaptrackError(f"it holds {kind.name or 'no schema'}, not 3D boxes; {', '.join(BOXES_3D_READ)} are read")
    return decoder_with_errors(kind, reader.read)


# Readers by the type of messages: built-in ones, and those of other packages.


class BoxReader(NamedTuple):
    """A reader of the messages of a type: a function that gives a list of ``Box``, or of boxes in space a
    ``Message3d``.
    """

    in_space: bool
    read: Callable[[Any], Any]


def reader_of(schema_name: str) -> BoxReader | None:
    """The reader of a type of messages; None if there is none.

    Raises McaptrackError if that of another package can't be imported. Packages that aren't needed are not imported.
    """
    name = plain_name(schema_name)
    if name in BUILT_IN[_KIND]:
        return BoxReader(name not in DETECTIONS_READ, find(_KIND, name).cls)
    named = next((other for other in others(_KIND) if plain_name(other) == name), "")
    return _of_package(find(_KIND, named)) if named else None


@lru_cache(maxsize=64)
def _of_package(entry: Entry) -> BoxReader:
    reader, guard = entry.made("read"), Guard(str(entry))
    in_space = is_in_space(entry, reader)

    def read(message: Any) -> list[Box] | Message3d:
        with blamed(entry, "failed", guard):
            boxes = list(reader.read(message))
        return checked_message_3d(entry, message, boxes) if in_space else checked_boxes(entry, boxes)

    return BoxReader(in_space, read)


def checked_boxes(entry: Entry, boxes: list[Any]) -> list[Box]:
    """The boxes in a picture that a reader gave, as numbers of Python. Raises McaptrackError for what is none."""
    with blamed(entry, "gave what is no Box"):
        out = [Box(float(x), float(y), float(w), float(h), number(s), text(name)) for x, y, w, h, s, name in boxes]
        for x, y, w, h, *_ in out:
            _check_box(x, y, w, h)
    return out


def checked_message_3d(entry: Entry, message: Any, boxes: list[Any]) -> Message3d:
    """The boxes in space that a reader gave, with the header of their message, if it has one."""
    try:
        head = head_of(message)
    except (AttributeError, ValueError):
        head = (0, "")
    with blamed(entry, "gave what is no Box3d"):
        return Message3d(*head, [_checked_box_3d(box, head) for box in boxes])


def _checked_box_3d(box: Any, head: tuple[int, str]) -> Box3d:
    vectors = [tuple(map(float, values)) for values in (box.centre, box.size, box.velocity, box.orientation)]
    if [len(values) for values in vectors] != [3, 3, 3, 4]:
        raise ValueError("a centre, size and velocity are three numbers, and an orientation is four")
    centre, size, velocity, orientation = vectors
    if not all(map(isfinite, (*centre, *orientation))) or any(side < 0 for side in size):
        raise ValueError(f"a box can't be at {centre}, turned by {orientation}, with the size {size}")
    if box.source_id is not None and not isinstance(box.source_id, str):
        integer(box.source_id)
    stamp, frame = (integer(box.stamp_ns), text(box.frame_id))
    return box._replace(  # type: ignore[no-any-return]
        stamp_ns=stamp or head[0], frame_id=frame or head[1], centre=centre, size=size, velocity=velocity,
        orientation=orientation, class_name=text(box.class_name), score=float(box.score),
    )  # fmt: skip
