"""Recognise boxes and positions of other software by the names and types of the fields of their messages.

Where the things of a message are, and which of their fields is what, is written as paths, in the syntax of ``map=``:

    position=people[].pose.pose.position,id=people[].track_id,score=people[].confidence

``recognised`` finds these paths in the definition of a type; a user may give them; ``known_types`` has those of types
whose names mislead. ``Reader`` then takes messages to boxes, whatever the paths are from.

Letters: N boxes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, reduce
from itertools import count
from math import cos, isfinite, nan, sin
from operator import attrgetter
from typing import Any, Final, NamedTuple

import numpy as np
from mcap.well_known import MessageEncoding

from mcaptrack.contracts import UNKNOWN_VECTOR, Box, Box3d, Quaternion, Vector
from mcaptrack.errors import McaptrackError, did_you_mean
from mcaptrack.sources.foreign.decoding import (
    MessageType,
    integer,
    number,
    protobuf_unpacker,
    ros_types,
    stamp_of,
    text,
    to_bytes,
)

Path = tuple[str, ...]
#: The token of a list in a path: of things, or of guesses of their class.
_EACH: Final = "[]"
#: A quaternion of zeros: the orientation isn't stated.
UNSTATED: Final[Quaternion] = (0.0, 0.0, 0.0, 0.0)
#: Types are looked at up to this depth, and up to this number of messages in them.
_DEEPEST, _MOST_FIELDS = 9, 2_000


class Shape(NamedTuple):
    """The type of a field: "number", "text", "struct" or "other". ``count`` is None for one value, 0 for a list, and
    the length of an array. ``constants`` are those of a struct: name and value.
    """

    kind: str
    name: str = ""
    fields: tuple[tuple[str, Any], ...] = ()
    count: int | None = None
    constants: tuple[tuple[str, int], ...] = ()

    @property
    def is_struct(self) -> bool:
        """Whether it is one message."""
        return self.kind == "struct" and self.count is None

    def at(self, path: Path) -> Shape | None:
        """The type at the end of a path; None if there is no such field."""
        here = self
        for token in path:
            if token.startswith("["):
                if here.count is None or (token == _EACH and here.kind != "struct"):
                    return None
                here = here._replace(count=None)
                continue
            inner = dict(here.fields).get(token) if here.is_struct else None
            if inner is None:
                return None
            here = inner
        return here


def shape_of_type(kind: MessageType) -> Shape | None:
    """The fields of a type by its definition in the log; None for JSON. Raises McaptrackError as ``unpacker`` does."""
    fields = count(1)  # a type whose definition is made to be endless is cut
    if kind.encoding == MessageEncoding.Protobuf:
        from_string: Any = protobuf_unpacker(kind)
        return _of_descriptor(from_string.__self__.DESCRIPTOR, 0, fields)
    if kind.encoding in (MessageEncoding.ROS1, MessageEncoding.CDR):
        store, name = ros_types(kind)
        return _of_ros(store, name, 0, fields)
    return None


def _of_ros(store: Any, name: str, depth: int, count_fields: Iterator[int]) -> Shape:
    constants, fields = store.fielddefs[name]
    stated = tuple((key, int(value)) for key, _, value in constants if isinstance(value, int))
    if depth >= _DEEPEST or next(count_fields) > _MOST_FIELDS:
        fields = ()
    inner = ((key, _of_ros_field(store, kind, depth + 1, count_fields)) for key, kind in fields)
    return Shape("struct", name, tuple(inner), None, stated)


def _of_ros_field(store: Any, kind: Any, depth: int, count_fields: Iterator[int]) -> Shape:
    from rosbags.interfaces import Nodetype

    node, inner = kind
    if node == Nodetype.NAME:
        return _of_ros(store, inner, depth, count_fields)
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        of_each = _of_ros_field(store, inner[0], depth, count_fields)
        return of_each._replace(count=int(inner[1]) if node == Nodetype.ARRAY else 0)
    of = str(inner[0])
    return Shape("text" if "string" in of else "number" if re.match(r"u?int|float|octet|byte", of) else "other")


def _of_descriptor(descriptor: Any, depth: int, count_fields: Iterator[int]) -> Shape:
    def shape(inner: Any) -> Shape:
        if inner.message_type is not None:
            out = _of_descriptor(inner.message_type, depth + 1, count_fields)
        else:
            kinds = {inner.CPPTYPE_STRING: "text", inner.CPPTYPE_BOOL: "other"}
            values = inner.enum_type.values if inner.enum_type is not None else ()
            out = Shape(kinds.get(inner.cpp_type, "number"), constants=tuple((v.name, v.number) for v in values))
        # Before version 6 of protobuf there is only the label.
        is_list = inner.is_repeated if hasattr(inner, "is_repeated") else inner.label == inner.LABEL_REPEATED
        return out._replace(count=0) if is_list else out

    is_cut = depth >= _DEEPEST or next(count_fields) > _MOST_FIELDS
    members = () if is_cut else descriptor.fields
    return Shape("struct", descriptor.full_name, tuple((inner.name, shape(inner)) for inner in members))


def shape_of_message(message: Any, depth: int = 0) -> Shape:
    """The fields of a message that was decoded from JSON; of lists those of their first members together."""
    if isinstance(message, list):
        of_all = reduce(_together, (shape_of_message(member, depth + 1) for member in message[:_JUDGED]), _NOTHING)
        is_vector = of_all.kind == "number" and len(message) <= _JUDGED
        return of_all._replace(count=len(message) if is_vector else 0) if of_all.count is None else Shape("other")
    if isinstance(message, bool) or message is None:
        return Shape("other")
    if isinstance(message, int | float):
        return Shape("number")
    if isinstance(message, str):
        return Shape("text")
    fields = vars(message).items() if depth < _DEEPEST else ()
    return Shape("struct", "", tuple((key, shape_of_message(value, depth + 1)) for key, value in fields))


def _together(one: Shape, other: Shape) -> Shape:
    """The type of a field that has these types in two messages: in each something may be missing."""
    if one.kind == "other" or other.kind == "other":
        return other if one.kind == "other" else one
    if one.kind != "struct" or other.kind != "struct":
        return one
    fields = dict(one.fields)
    for name, inner in other.fields:
        fields[name] = _together(fields.get(name, _NOTHING), inner)
    return one._replace(fields=tuple(fields.items()))


_NOTHING: Final = Shape("other")
#: Members of lists of JSON that are looked at.
_JUDGED: Final = 50


# Recognise: which field is what, by its name and type. Names count in lower case and without "_".


#: Structs that a position may be in, the usual ones first.
_PLACES: Final = (
    "pose", "position", "center", "centre", "posewithcovariance", "initialposewithcovariance", "pos", "centroid",
    "location", "point", "kinematics", "state", "bbox", "bbox3d", "boundingbox", "boundingbox3d", "box", "bodypose",
)  # fmt: skip
_VELOCITIES: Final = (
    "velocity", "vel", "twist", "twistwithcovariance", "initialtwistwithcovariance", "linear", "linearvelocity",
    "kinematics", "state",
)  # fmt: skip
_SIZES: Final = (
    "size", "dimensions", "dimension", "extent", "extents", "scale", "bbox", "bbox3d", "boundingbox", "boundingbox3d",
    "box", "shape",
)  # fmt: skip
_PICTURED: Final = (
    "bbox", "boundingbox", "boundingbox2d", "bbox2d", "box", "box2d", "roi", "rect", "region", "regionofinterest",
    "face", "body",
)  # fmt: skip
_IDS: Final = ("trackid", "trackingid", "objectid", "personid", "instanceid", "uuid", "uid", "id")
_CLASSES: Final = (
    "classname", "classlabel", "class", "label", "category", "objectclass", "objectname", "objectlabel",
    "classification", "objecttype", "classid", "labelid", "type",
)  # fmt: skip
_SCORES: Final = (
    "score", "confidence", "existenceprobability", "probability", "reliability", "likelihood", "conf", "c",
)  # fmt: skip
#: Left, top, right and bottom; or left, top, width and height.
_CORNERS: Final = (
    ("xmin", "ymin", "xmax", "ymax"), ("x1", "y1", "x2", "y2"), ("left", "top", "right", "bottom"),
    ("minx", "miny", "maxx", "maxy"), ("x0", "y0", "x1", "y1"),
)  # fmt: skip
_SPANS: Final = (
    ("xoffset", "yoffset", "width", "height"), ("x", "y", "width", "height"), ("x", "y", "w", "h"),
    ("left", "top", "width", "height"),
)  # fmt: skip
#: Words in the names of types and lists of people and other things that move; and of what isn't.
PEOPLE: Final = re.compile(r"people|persons?|pedestrians?|humans?|bod(y|ies)|walkers?")
THINGS: Final = re.compile(
    PEOPLE.pattern
    + r"|track(s|ed|lets?)?|detect(ions?|ed)?|objects?|obstacles?|b?box(es)?|bounding|legs?|faces?|targets?"
    r"|clusters?|vehicles?|agents?|cars?|yolo|roi|region|circles?|rects?|predicted"
)
_OTHERS: Final = re.compile(
    r"tags?|apriltags?|fiducials?|waypoints?|paths?|trajector(y|ies)|joints?|landmarks?|lanes?|keypoints?|skeletons?|particles?"
    r"|grids?|maps?|signals?|traffic|signs?|markers?|goals?|plans?|grasps?|wheels?|motors?|features?|gps|satellites?"
    r"|calibration|clouds?|points|lines?|segments?|polygons?|links?|models?|contacts?|wrench(es)?|transforms?|images?"
)
#: Parts of people: what their type is called is their class.
_PARTS: Final = re.compile(r"legs?|faces?")
#: Types that hold no things, or whose lists are something else.
_NO_THINGS: Final = re.compile(
    r"(sensor|std|nav|tf2?|diagnostic|trajectory|actionlib|action|stereo|shape|map|octomap|control|lifecycle|rosgraph|bond|"
    r"statistics|builtin|controller|moveit|ublox|novatel_gps|velodyne|gazebo|rosapi|dynamic_reconfigure)\w*/.*|rcl_interfaces/.*"
)


@dataclass(frozen=True)
class Fields:
    """Where a message has its things, and which of their fields is what.

    Attributes
    ----------
    things : tuple of str
        The path of the list of things, ending with "[]"; () if the message itself is one.
    paths : dict of str to list of tuple of str
        Paths from a thing on, by what they hold; of several the first that isn't 0 throughout.
    names : dict of int to str
        Names of classes that are numbers, from constants of the definition.
    class_name : str
        The class of all things, by the name of their type; "" if it doesn't say.
    is_certain : bool
        Whether these are things that move: their names say so, and they have more than a position.
    has_zero : bool
        Whether a class of 0 is stated, and not left out: it is a text, or one of several guesses.
    """

    things: Path
    paths: Mapping[str, Sequence[Path]]
    names: Mapping[int, str] = field(default_factory=dict)
    class_name: str = ""
    is_certain: bool = True
    has_zero: bool = False

    @property
    def in_space(self) -> bool:
        """Whether it has positions in metres."""
        return "position" in self.paths or "x" in self.paths

    @property
    def in_picture(self) -> bool:
        """Whether it has boxes in a picture."""
        return not _PICTURED_KEYS.isdisjoint(self.paths)

    def __str__(self) -> str:
        """The paths, as ``map=`` takes them."""
        return ",".join(f"{key}={_joined((*self.things, *paths[0]))}" for key, paths in self.paths.items() if paths)


#: Parts of a box in a picture; a size in space has other names.
_PICTURED_KEYS: Final = frozenset({"left", "top", "right", "bottom", "w", "h", "cx", "cy", "theta", "corners"})


def recognised(shape: Shape, type_name: str) -> Fields | None:
    """The things of a type of messages; None if it has none, that is no position and no box."""
    if _NO_THINGS.fullmatch(type_name):
        return None
    out = [fields for things, each, names in _lists(shape, type_name) if (fields := _thing(things, each, names))]
    return max(out, key=lambda fields: (fields.is_certain, len(fields.paths)), default=None)


def _lists(shape: Shape, type_name: str) -> Iterator[tuple[Path, Shape, list[str]]]:
    """The lists of messages in a message, and in those that it consists of, and the message itself."""
    own = _words_in(type_name)
    for name, inner in shape.fields:
        if inner.kind == "struct" and inner.count is not None:
            yield (name, _EACH), inner._replace(count=None), [*own, *_words_in(name), *_words_in(inner.name)]
        elif inner.is_struct:
            for below, last in inner.fields:
                if last.kind == "struct" and last.count is not None:
                    names = [*own, *_words_in(name), *_words_in(below), *_words_in(last.name)]
                    yield (name, below, _EACH), last._replace(count=None), names
    yield (), shape, own


def _thing(things: Path, each: Shape, words: Sequence[str]) -> Fields | None:
    """The fields of a thing; None if it has neither a position nor a box."""
    is_other = any(_OTHERS.fullmatch(word) for word in words)
    picture = _picture(each)
    inside = next((path for paths in picture.values() for path in paths), ())[:1]
    sizes = [word for word in _SIZES if word not in [name.replace("_", "").lower() for name in inside]]
    paths = {key: [path] for key, path in _position(each, inside).items()} | picture
    if not paths:
        return None
    guess = _guess(each)
    facts = {
        "velocity": _vector_at(each, _VELOCITIES),
        "size": _vector_at(each, sizes),
        "id": _fact(each, _IDS, is_id=True),
        "class": _fact(each, _CLASSES, "text") or guess.get("class") or _fact(each, _CLASSES, "number"),
        "score": _fact(each, _SCORES, "number"),
        "guess": guess.get("score"),
        "frame": _fact(each, ("frameid",), "text", deepest=1),
    }
    for key, keys, names in (("velocity", _FLAT_V, "vx vy vz"), ("size", _FLAT_SIZE, "length width height")):
        if facts[key] is None:
            paths |= {name: [path] for name, path in zip(names.split(), _flat(each, keys), strict=False)}
    if guess and "position" in paths and (pose := _position(guess_shape(each, guess), ())):
        prefix = guess["class"][: guess["class"].index(_EACH) + 1]
        for key in ("position", "orientation"):
            if key in paths and key in pose:
                paths[key] = [*paths[key], (*prefix, *pose[key])]
    if (radius := _flat(each, (("radius",),))) and "size" not in paths:
        facts["radius"] = radius[0] if facts["size"] is None else None
    is_person = any(PEOPLE.fullmatch(word) for word in words)
    if is_person and facts["class"] is None and facts["id"] is None:
        facts["id"] = _fact(each, ("name",), "text", deepest=0)
    paths |= {key: [path] for key, path in facts.items() if path is not None}
    said = sum(key in paths for key in ("id", "class", "score", "velocity", "vx", "size", "length"))
    is_named = any(THINGS.fullmatch(word) for word in words)
    enough = (1 if things else 2) - bool(picture)
    is_certain = not is_other and is_named and said >= enough
    if not things and not is_certain:
        return None
    part = next((word.rstrip("s") for word in words if _PARTS.fullmatch(word)), "")
    class_name = "" if "class" in paths else part or ("person" if is_person else "")
    return _with_classes(each, Fields(things, paths, {}, class_name, is_certain))


def _with_classes(each: Shape, fields: Fields) -> Fields:
    """Fields with what the definition says of their class."""
    path = fields.paths.get("class", [()])[0]
    kind = each.at(path)
    if not path or kind is None:
        return fields
    return replace(fields, names=_names_of(each, path), has_zero=_EACH in path or kind.kind == "text")


def guess_shape(each: Shape, guess: Mapping[str, Path]) -> Shape:
    """The type of a guess of the class of a thing."""
    inner = each.at(guess["class"][: guess["class"].index(_EACH) + 1])
    return inner or Shape("other")


def _words_in(name: str) -> list[str]:
    """The words of a name: geometry_msgs/msg/PoseArray -> pose, array."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", re.split(r"[/.]", name)[-1])]


@lru_cache(maxsize=1024)
def _members(shape: Shape) -> Mapping[str, tuple[str, Shape]]:
    """The fields of a struct by their name in lower case and without "_"."""
    return {name.replace("_", "").lower(): (name, inner) for name, inner in reversed(shape.fields)}


def _point(shape: Shape) -> int:
    """The number of axes of a point; 0 if a type isn't one."""
    if shape.kind == "number":
        return shape.count if shape.count in (2, 3) else 0
    members = _members(shape) if shape.is_struct else {}
    is_axis = [axis in members and members[axis][1] == Shape("number") for axis in "xyzw"]
    return 0 if is_axis[3] or not all(is_axis[:2]) else 2 + is_axis[2]


def _position(shape: Shape, inside: Path) -> dict[str, Path]:
    """The paths of the position of a thing, and of its orientation. Fields of its box in a picture don't count."""
    for path in _places(shape, 0):
        if not (inside and path[:1] == inside) and not (not path and inside == ("x",)):
            at = path[:-1] if path and path[-1].lower() == "position" else path
            out = {"position": path}
            owner = shape.at(at)
            turn = _members(owner).get("orientation") if owner else None
            if turn and turn[1].is_struct:
                return out | {"orientation": (*at, turn[0])}
            heading = _fact(owner, _HEADINGS, "number", deepest=0) if owner and owner.is_struct else None
            heading = (*at, *heading) if heading else _fact(shape, _HEADINGS, "number", deepest=0)
            return out | ({"heading": heading} if heading else {})
    flat = [] if inside else _flat(shape, _FLAT_PLACE)
    heading = _fact(shape, _HEADINGS, "number", deepest=0)
    out = dict(zip("xyz", flat, strict=False))
    return out | ({"heading": heading} if heading and out else {})


_HEADINGS: Final = ("heading", "yaw", "theta", "orientation", "rotationy")
_FLAT_PLACE: Final = tuple(
    tuple(form.format(axis) for axis in "xyz")
    for form in ("pos{}", "position{}", "center{}", "centre{}", "p{}", "{}pos", "{}position", "{}m", "{}center")
)
_FLAT_V: Final = tuple(
    tuple(form.format(axis) for axis in "xyz") for form in ("v{}", "vel{}", "velocity{}", "{}vel", "{}velocity")
)
_FLAT_SIZE: Final = (("length", "width", "height"), ("sizex", "sizey", "sizez"), ("l", "w", "h"), ("width", "height"))


def _flat(shape: Shape, choices: Sequence[Sequence[str]]) -> list[Path]:
    """The paths of numbers that stand beside each other, by their names; of the first choice that is there."""
    members = _members(shape)
    for names in choices:
        stated = [(members[name][0],) for name in names if name in members and members[name][1] == Shape("number")]
        if len(stated) >= min(2, len(names)):
            return stated
    return []


def _places(shape: Shape, depth: int) -> Iterator[Path]:
    """The paths of points in a thing, the likeliest first."""
    members = _members(shape)
    if _point(shape):
        yield ()
    for word in _PLACES if depth < 4 else ():
        if word not in members:
            continue
        name, inner = members[word]
        if inner.kind == "number" and _point(inner):
            yield (name,)
        elif inner.is_struct:
            yield from ((name, *path) for path in _places(inner, depth + 1))


def _vector_at(shape: Shape, words: Sequence[str], depth: int = 0) -> Path | None:
    """The path of a vector in fields with such names."""
    members = _members(shape)
    for word in words if depth < 4 else ():
        if word in members:
            name, inner = members[word]
            if _point(inner) and (inner.is_struct or inner.kind == "number"):
                return (name,)
            if inner.is_struct:
                if "size" in words and len(_flat(inner, _FLAT_SIZE[:1])) == 3:
                    return (name,)
                if path := _vector_at(inner, words, depth + 1):
                    return (name, *path)
    return None


def _fact(shape: Shape, words: Sequence[str], kind: str = "", is_id: bool = False, deepest: int = 2) -> Path | None:
    """The path of a field with such a name; those that are least deep count first."""
    levels: list[tuple[Path, Shape]] = [((), shape)]
    for _ in range(deepest + 1):
        for path, owner in levels:
            members = _members(owner)
            for word in words:
                if word in members:
                    name, inner = members[word]
                    if is_id and (below := _id_below(inner)) is not None:
                        return (*path, name, *below)
                    if not is_id and inner.kind == kind and inner.count is None:
                        return (*path, name)
        levels = [
            ((*path, name), inner) for path, owner in levels for name, inner in owner.fields if _may_say(name, inner)
        ]
    return None


def _may_say(name: str, inner: Shape) -> bool:
    """Whether a struct may say what a thing is, and not only where."""
    word = name.replace("_", "").lower()
    is_place = word in (*_PLACES, *_VELOCITIES) and word not in (*_SIZES, *_PICTURED)
    return inner.is_struct and not is_place and word != "header"


def _id_below(shape: Shape) -> Path | None:
    """The path of an id in the field of an id: number, text, or the bytes of a UUID; None if there is none."""
    if shape.kind in ("number", "text") and (shape.count is None or (shape.kind == "number" and shape.count == 16)):
        return ()
    inner = _members(shape).get("uuid") if shape.is_struct else None
    return (inner[0],) if inner else None


def _guess(shape: Shape) -> dict[str, Path]:
    """The paths of class and score in a list of guesses of a thing; empty if it has no such list."""
    for name, inner in shape.fields:
        if inner.kind == "struct" and inner.count is not None:
            each = inner._replace(count=None)
            score = _fact(each, _SCORES, "number")
            own = _fact(each, (*_CLASSES, "id"), "text") or _fact(each, (*_CLASSES, "id"), "number")
            if score and own:
                return {"class": (name, _EACH, *own), "score": (name, _EACH, *score)}
    return {}


def _names_of(each: Shape, path: Path) -> dict[int, str]:
    """The names of classes that are numbers, by the constants beside their field."""
    owner, kind = each.at(path[:-1]), each.at(path)
    if owner is None or kind is None or kind.kind != "number":
        return {}
    prefixes = [path[-1].upper() + "_", *(f"{word}_" for word in ("CLASSIFICATION", "CLASS", "LABEL", "TYPE"))]
    for prefix in prefixes:
        if names := {value: name.removeprefix(prefix) for name, value in owner.constants if name.startswith(prefix)}:
            return _lower(names)
    integers = [name for name, inner in owner.fields if inner == Shape("number") and name.lower() not in _SCORES]
    return (
        _lower({value: name for name, value in owner.constants})
        if integers == [path[-1]]
        else _lower({value: name for name, value in kind.constants})
    )


def _lower(names: Mapping[int, str]) -> dict[int, str]:
    return {value: "" if name.lower() == "unknown" else name.lower() for value, name in names.items()}


def _picture(shape: Shape, depth: int = 0) -> dict[str, list[Path]]:
    """The paths of a box in a picture: of a thing, or of its field with such a name; empty if there is none."""
    if out := _box_in(shape):
        return out
    members = _members(shape)
    for word in _PICTURED if depth < 2 else ():
        if word in members and members[word][1].is_struct:
            name, inner = members[word]
            if out := _picture(inner, depth + 1):
                return {key: [(name, *path) for path in paths] for key, paths in out.items()}
    return {}


def _box_in(shape: Shape) -> dict[str, list[Path]]:
    members = _members(shape)
    numbers = {word: (name,) for word, (name, inner) in members.items() if inner == Shape("number")}
    for keys, forms in ((("left", "top", "right", "bottom"), _CORNERS), (("left", "top", "w", "h"), _SPANS)):
        for form in forms:
            if all(word in numbers for word in form) and "z" not in numbers:
                return {key: [numbers[word]] for key, word in zip(keys, form, strict=True)}
    corners = members.get("corners")
    if corners and corners[1].kind == "struct" and corners[1].count is not None:
        each = corners[1]._replace(count=None)
        if path := next((path for path in ((), ("kp",)) if (at := each.at(path)) and _point(at) == 2), None):
            return {"corners": [(corners[0], _EACH, *path)]}
    return _centred(members, numbers)


def _centred(members: Mapping[str, tuple[str, Shape]], numbers: Mapping[str, Path]) -> dict[str, list[Path]]:
    """The paths of a box by its centre and size, which has no third axis."""
    name, centre = members.get("center", members.get("centre", ("", Shape("other"))))
    inner = _members(centre)["position"][0:2] if centre.is_struct and "position" in _members(centre) else None
    at, place = ((name, inner[0]), inner[1]) if inner else ((name,), centre)
    if _point(place) != 2 or not place.is_struct:
        return {}
    size_name, size = members.get("size", ("", Shape("other")))
    if size.is_struct and _point(size) == 2:
        sides = [(size_name, "x"), (size_name, "y")]
    else:
        sides = [numbers[word] for word in ("sizex", "sizey", "width", "height") if word in numbers][:2]
    if len(sides) != 2:
        return {}
    out = dict(zip(("cx", "cy", "w", "h"), ((*at, "x"), (*at, "y"), *sides), strict=True))
    theta = _members(centre).get("theta")
    return {key: [path] for key, path in (out | ({"theta": (name, theta[0])} if theta else {})).items()}


# Paths that a user gives


#: What ``map=`` may name.
KEYS: Final = (
    "position", "x", "y", "z", "velocity", "vx", "vy", "size", "length", "width", "height", "radius", "orientation",
    "heading", "id", "class", "score", "left", "top", "right", "bottom", "w", "h", "cx", "cy", "theta", "corners",
    "picture", "frame",
)  # fmt: skip
_PATH: Final = re.compile(r"[A-Za-z_]\w*(\[\d*\])*(\.[A-Za-z_]\w*(\[\d*\])*)*", re.ASCII)
_SIZE: Final = re.compile(r"(\d{1,6})x(\d{1,6})", re.ASCII)


def parse_map(written: str) -> dict[str, Path]:
    """The paths of ``map=`` by what they hold. Raises McaptrackError for what is none."""
    out: dict[str, Path] = {}
    for pair in filter(str.strip, written.split(",")):
        key, _, path = (part.strip() for part in pair.partition("="))
        if key not in KEYS:
            raise McaptrackError(f"`map=` names {key!r}; {did_you_mean(key, KEYS)}there are {', '.join(KEYS)}")
        if not (_SIZE if key == "picture" else _PATH).fullmatch(path):
            form = "a size, as 1280x720," if key == "picture" else "a path of fields, as people[].pose.position.x,"
            raise McaptrackError(f"`map=`: {key}={path} is no {form.removeprefix('a ')} but {form} is wanted")
        if key in out:
            raise McaptrackError(f"`map=` names {key} twice")
        out[key] = (path,) if key == "picture" else _tokens(path)
    if not out:
        raise McaptrackError("`map=` names no field; for example `map=x=people[].pose.position.x,y=...`")
    return out


def _tokens(path: str) -> Path:
    return tuple(re.findall(r"\w+|\[\d*\]", path.replace(".", " ")))


def _joined(path: Path) -> str:
    return ".".join(path).replace(".[", "[")


def mapped(shape: Shape, type_name: str, chosen: Mapping[str, Path]) -> Fields:
    """The things of a type by the paths that a user gave; fields that these don't name are those that are recognised.

    Paths may begin at the message, or at a thing. Raises McaptrackError for paths that the type doesn't have.
    """
    base = recognised(shape, type_name)
    lists = [things for things, _, _ in _lists(shape, type_name)]
    if base is not None:
        lists.sort(key=lambda things: things != base.things)
    begins = {key: _begin(shape, path, lists) for key, path in chosen.items() if key != "picture"}
    for key, begin in begins.items():
        if begin is None:
            tops = ", ".join(f"{name}{'' if inner.count is None else '[]'}" for name, inner in shape.fields)
            raise McaptrackError(f"`map=`: {type_name} has no field {_joined(chosen[key])}; it has {tops or 'none'}")
    places = {begin[0] for begin in begins.values() if begin is not None}
    if len(places) > 1:
        raise McaptrackError(f"`map=`: paths are in several lists: {', '.join(sorted(map(_joined, places)))}")
    things = places.pop() if places else base.things if base else ()
    kept = dict(base.paths) if base and base.things == things else {}
    own = {key: [begin[1]] for key, begin in begins.items() if begin is not None}
    for group in (("position", "x", "y", "z"), ("velocity", "vx", "vy"), ("orientation", "heading"), _PICTURED_KEYS,
                  ("size", "length", "width", "height", "radius"), ("class", "guess")):  # fmt: skip
        if not own.keys().isdisjoint(group):
            kept = {key: paths for key, paths in kept.items() if key not in group}
    if own.keys() & {"position", "x"}:
        kept = {key: paths for key, paths in kept.items() if key not in _PICTURED_KEYS}
    elif own.keys() & _PICTURED_KEYS:
        kept = {key: paths for key, paths in kept.items() if key not in ("position", "x", "y", "z")}
    paths = kept | own
    if not ({"position"} <= paths.keys() or {"x", "y"} <= paths.keys() or _is_boxed(paths)):
        raise McaptrackError(
            "`map=` has to name position, or x and y, or left, top, right and bottom, or left, top, w and h"
        )
    class_name = base.class_name if base and "class" not in paths else ""
    return _with_classes(shape.at(things) or shape, Fields(things, paths, {}, class_name))


def _is_boxed(paths: Mapping[str, Any]) -> bool:
    forms = ({"left", "top", "right", "bottom"}, {"left", "top", "w", "h"}, {"cx", "cy", "w", "h"}, {"corners"})
    return any(form <= paths.keys() for form in forms)


def _begin(shape: Shape, path: Path, lists: Sequence[Path]) -> tuple[Path, Path] | None:
    """The list of a path, and the path from a thing of it on; None if the type has no such field."""
    if shape.at(path) is not None:
        if _EACH not in path:
            return (), path
        end = path.index(_EACH) + 1
        return path[:end], path[end:]
    return next(((things, path) for things in lists if shape.at((*things, *path)) is not None), None)


# Messages to boxes


@dataclass
class Message3d:
    """The boxes of a message, and a count of its other parts for each description of them.

    ``is_measured`` is false for a message that only takes boxes away from a viewer: nothing was measured then.
    """

    stamp_ns: int
    frame_id: str
    boxes: list[Box3d] = field(default_factory=list)
    ignored: dict[str, int] = field(default_factory=dict)
    is_measured: bool = True


#: What a type's fields don't tell: a box as it is meant, by its thing; None if it is to be left out.
Adjust = Callable[[Any, Box3d], Box3d | None]


class Reader:
    """Takes messages to boxes, by the paths of their fields."""

    def __init__(self, fields: Fields, in_space: bool, adjust: Adjust | None = None) -> None:
        self.fields, self.in_space, self._adjust = fields, in_space, adjust
        self._get = {key: [_getter(path) for path in paths] for key, paths in fields.paths.items()}

    def read(self, message: Any) -> list[Box] | Message3d:
        """The boxes of a message."""
        return self.in_frame(message) if self.in_space else self.in_picture(message)

    def in_picture(self, message: Any) -> list[Box]:
        """The boxes of a message in a picture."""
        return [self._box(thing) for thing in things_of(message, self.fields.things)]

    def in_frame(self, message: Any) -> Message3d:
        """The boxes of a message in space."""
        things = things_of(message, self.fields.things)
        head = message_head(message, things)
        out = Message3d(*head)
        for thing in things:
            box = self._box_3d(thing, head)
            if self._adjust and (box := self._adjust(thing, box)) is None:  # type: ignore[assignment]
                out.ignored["boxes whose track was given up"] = out.ignored.get("boxes whose track was given up", 0) + 1
            else:
                out.boxes.append(box)
        return out

    def _value(self, thing: Any, key: str) -> Any:
        return self._get[key][0](thing) if key in self._get else None

    def _number(self, thing: Any, key: str) -> float:
        return number(self._value(thing, key))

    def _needed(self, thing: Any, key: str) -> float:
        value = self._value(thing, key)
        if value is None:
            raise AttributeError(name=_joined(self.fields.paths[key][0]))
        return number(value)

    def _box(self, thing: Any) -> Box:
        name, score = self._class(thing)
        if "corners" in self._get:
            path = self.fields.paths["corners"][0]
            points = [vector(at) for at in _each(thing, path)]
            x, y = ([point[axis] for point in points] or [nan] for axis in (0, 1))
            left, top, w, h = min(x), min(y), max(x) - min(x), max(y) - min(y)
        elif "cx" in self._get:
            cx, cy, w, h = (self._needed(thing, key) for key in ("cx", "cy", "w", "h"))
            if theta := number(self._value(thing, "theta") or 0.0):
                check_box(cx, cy, w, h, theta)
                w, h = (abs(w * cos(theta)) + abs(h * sin(theta)), abs(w * sin(theta)) + abs(h * cos(theta)))
            left, top = cx - w / 2, cy - h / 2
        else:
            left, top = self._needed(thing, "left"), self._needed(thing, "top")
            if "right" in self._get:
                w, h = self._needed(thing, "right") - left, self._needed(thing, "bottom") - top
            else:
                w, h = self._needed(thing, "w"), self._needed(thing, "h")
        check_box(left, top, w, h)
        return Box(left, top, w, h, score, name)

    def _box_3d(self, thing: Any, head: tuple[int, str]) -> Box3d:
        name, score = self._class(thing)
        centre, orientation = self._pose(thing)
        size = self._vector(thing, "size", ("length", "width", "height"))
        if "radius" in self._get:
            size = (2 * self._number(thing, "radius"),) * 2 + (nan,)
        has_heading = "orientation" in self._get or "heading" in self._get
        if "heading" in self._get:
            half = self._number(thing, "heading") / 2
            orientation = (0.0, 0.0, sin(half), cos(half)) if isfinite(half) else UNSTATED
            has_heading = isfinite(half)
        stamp_ns, frame_id = own_head(thing, head)
        return Box3d(
            stamp_ns,
            text(self._value(thing, "frame") or "") or frame_id,
            centre,
            orientation,
            size,
            name,
            score,
            _identity(self._value(thing, "id")),
            _flat_if_2d(self._vector(thing, "velocity", ("vx", "vy", "vz"))),
            has_heading,
        )

    def _pose(self, thing: Any) -> tuple[Vector, Quaternion]:
        """Position and orientation of a thing; those of its first guess where only these are filled in."""
        if "position" not in self._get:
            x, y = self._needed(thing, "x"), self._needed(thing, "y")
            return (x, y, self._number(thing, "z")), UNSTATED
        turns = self._get.get("orientation", [])
        out: list[tuple[Vector, Quaternion]] = []
        for at, place in enumerate(self._get["position"]):
            if (value := place(thing)) is not None:
                out.append((vector(value), quaternion(turns[at](thing)) if at < len(turns) else UNSTATED))
                if any(out[-1][0]):
                    return out[-1]
        if not out:
            raise AttributeError(name=_joined(self.fields.paths["position"][0]) or "x")
        return out[0]

    def _vector(self, thing: Any, key: str, flat: Sequence[str]) -> Vector:
        if key in self._get:
            value = self._value(thing, key)
            return UNKNOWN_VECTOR if value is None else vector(value)
        x, y, z = (self._number(thing, name) for name in flat)
        return x, y, z

    def _class(self, thing: Any) -> tuple[str, float]:
        """The class of a thing, and its score: its own, or of the likeliest guess of its class."""
        own, score = self.fields.class_name, self._number(thing, "score")
        path = self.fields.paths.get("class", [()])[0]
        if _EACH in path:
            share, value = self._likeliest(thing, path)
            score = score if score > 0 else share
        else:
            value = self._value(thing, "class")
        if value is None:
            return own, score
        if isinstance(value, str):
            return value.strip(), score
        return self.fields.names.get(integer(value), str(integer(value))), score

    def _likeliest(self, thing: Any, path: Path) -> tuple[float, Any]:
        """The highest score of guesses that is a number, and the class with it; NaN and None if there is no guess."""
        after = path.index(_EACH) + 1
        of_class, of_score = _getter(path[after:]), _getter(self.fields.paths["guess"][0][after:])
        scored = [(number(of_score(guess)), of_class(guess)) for guess in things_of(thing, path[:after])]
        finite = [pair for pair in scored if isfinite(pair[0])]
        score, best = max(finite or scored, key=lambda pair: pair[0], default=(nan, None))
        return score if finite else nan, best


def things_of(message: Any, path: Path) -> Sequence[Any]:
    """The members of a list; the message itself where the path is ()."""
    if not path:
        return [message]
    return _getter(path[:-1])(message) or ()


def _each(thing: Any, path: Path) -> list[Any]:
    """The values at a path for all members of its list."""
    end = path.index(_EACH)
    rest = _getter(path[end + 1 :])
    return [rest(member) for member in things_of(thing, path[: end + 1])]


@lru_cache(maxsize=1024)
def _getter(path: Path) -> Callable[[Any], Any]:
    """A function that takes a message to the value at a path; None where JSON leaves it out.

    Of lists the first member counts.
    """
    if not path:
        return lambda message: message
    if not any(token.startswith("[") for token in path):
        get = attrgetter(".".join(path))

        def quick(message: Any) -> Any:
            try:
                return get(message)
            except AttributeError:
                return None

        return quick

    def walk(message: Any) -> Any:
        for token in path:
            if message is None:
                return None
            if token.startswith("["):
                index = int(token[1:-1] or 0)
                message = message[index] if index < len(message) else None
            else:
                message = getattr(message, token, None)
        return message

    return walk


def _flat_if_2d(velocity: Vector) -> Vector:
    """A velocity in space of one along the ground, which states no z."""
    x, y, z = velocity
    return (x, y, 0.0) if isfinite(x) and isfinite(y) and not isfinite(z) else velocity


def _identity(value: Any) -> int | str | None:
    """An id: a number, a text, or the hexadecimal digits of a UUID; None if there is none."""
    if value is None or isinstance(value, str):
        return value or None
    if isinstance(value, np.ndarray | bytes | list):
        return to_bytes(value).hex()
    return integer(value)


def message_head(message: Any, things: Sequence[Any]) -> tuple[int, str]:
    """Stamp in ns and frame of a message: of its header, its own, or those of its first thing."""
    if hasattr(message, "header"):
        return head_of(message)
    if hasattr(message, "timestamp"):
        return stamp_of(message), text(part(message, "frame_id") or "")
    return head_of(things[0]) if things and hasattr(things[0], "header") else (0, "")


def head_of(message: Any) -> tuple[int, str]:
    """Stamp in ns and frame of a message with a ROS header."""
    return stamp_of(message), text(message.header.frame_id)


def own_head(message: Any, around: tuple[int, str]) -> tuple[int, str]:
    """Stamp and frame of a part of a message: its own, or, where it states no frame, those of the message around it."""
    if not hasattr(message, "header"):
        return around
    stamp_ns, frame_id = head_of(message)
    return (stamp_ns or around[0], frame_id) if frame_id else around


def vector(value: Any) -> Vector:
    """A point or vector, or an array of numbers; the origin where it is missing, as protobuf leaves out zeros.

    A point without z has NaN, which is unknown.
    """
    if value is None:
        return 0.0, 0.0, 0.0
    if isinstance(value, np.ndarray | list | tuple):
        x, y, z = (*map(float, value[:3]), nan, nan, nan)[:3]
        return x, y, z
    if hasattr(value, "length") and not hasattr(value, "x"):
        return number(value.length), number(value.width), number(value.height)
    return number(value.x), number(value.y), number(value.z) if hasattr(value, "z") else nan


def quaternion(value: Any) -> Quaternion:
    """A quaternion; zeros where it is missing."""
    return UNSTATED if value is None else (number(value.x), number(value.y), number(value.z), number(value.w))


def part(message: Any, name: str) -> Any:
    """A field of a message; None where it is missing, as optional fields of JSON are."""
    return getattr(message, name, None)


def check_box(x: float, y: float, w: float, h: float, theta: float = 0.0) -> None:
    """Raise ValueError for a box that can't be."""
    if not all(isfinite(value) for value in (x, y, theta, w, h)) or w < 0 or h < 0:
        raise ValueError(f"a box can't be {w:g} x {h:g} at ({x:g}, {y:g})")
