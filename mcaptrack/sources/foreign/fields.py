"""Recognise boxes and positions of other software by the names and types of the fields of their messages.

Where the things of a message are, and which of their fields is what, is written as paths, in the syntax of ``map=``:

    position=people[].pose.pose.position,id=people[].track_id,score=people[].confidence

``recognised`` finds these paths in the definition of a type; a user may give them; ``known_types`` has those of types
with misleading names. ``FieldReader`` then takes messages to boxes, whatever the paths are from.

Letters: N boxes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, reduce
from itertools import count, takewhile
from math import nan
from typing import Any, Final, NamedTuple

import numpy as np
from mcap.well_known import MessageEncoding

from mcaptrack.contracts import Box3d, Quaternion, Vector
from mcaptrack.errors import McaptrackError, did_you_mean
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.sources.foreign.decoding import integer, number, protobuf_class, stamp_of, text, to_bytes
from mcaptrack.sources.foreign.definitions import MessageType, ros_types
from mcaptrack.sources.foreign.things import EACH, HEADS, Path, Things, heads

#: A quaternion of zeros: the orientation isn't stated.
UNSTATED: Final[Quaternion] = (0.0, 0.0, 0.0, 0.0)
#: Types are looked at up to this depth, and up to this number of messages in them.
_DEEPEST, _MOST_FIELDS = 9, 2_000


class FieldShape(NamedTuple):
    """The type of a field: "number", "text", "struct" or "other". ``count`` is None for one value, 0 for a list, and
    the length of an array. ``constants`` are those of a struct: name and value.
    """

    kind: str
    name: str = ""
    fields: tuple[tuple[str, Any], ...] = ()
    count: int | None = None  # type: ignore[assignment]  # tuples have a method of this name
    constants: tuple[tuple[str, int], ...] = ()

    @property
    def is_struct(self) -> bool:
        """Whether it is one message."""
        return self.kind == "struct" and self.count is None

    def at(self, path: Path) -> FieldShape | None:
        """The type at the end of a path; None if there is no such field."""
        here = self
        for token in path:
            if token.startswith("["):
                if here.count is None or (token == EACH and here.kind != "struct"):
                    return None
                here = here._replace(count=None)
                continue
            inner = dict(here.fields).get(token) if here.is_struct else None
            if inner is None:
                return None
            here = inner
        return here


def shape_of_type(kind: MessageType) -> FieldShape | None:
    """The fields of a type by its definition in the log; None for JSON. Raises McaptrackError as ``unpacker`` does."""
    fields = count(1)  # a definition that is made to be endless is cut
    if kind.encoding == MessageEncoding.Protobuf:
        return _of_descriptor(protobuf_class(kind).DESCRIPTOR, 0, fields)
    if kind.encoding in (MessageEncoding.ROS1, MessageEncoding.CDR):
        store, name = ros_types(kind)
        return _of_ros(store, name, 0, fields)
    return None


def _of_ros(store: Any, name: str, depth: int, count_fields: Iterator[int]) -> FieldShape:
    constants, fields = store.fielddefs[name]
    stated = tuple((key, int(value)) for key, _, value in constants if isinstance(value, int))
    if depth >= _DEEPEST or next(count_fields) > _MOST_FIELDS:
        fields = ()
    inner = ((key, _of_ros_field(store, kind, depth + 1, count_fields)) for key, kind in fields)
    return FieldShape("struct", name, tuple(inner), None, stated)


def _of_ros_field(store: Any, kind: Any, depth: int, count_fields: Iterator[int]) -> FieldShape:
    from rosbags.interfaces import Nodetype

    node, inner = kind
    if node == Nodetype.NAME:
        return _of_ros(store, inner, depth, count_fields)
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        of_each = _of_ros_field(store, inner[0], depth, count_fields)
        return of_each._replace(count=int(inner[1]) if node == Nodetype.ARRAY else 0)
    of = str(inner[0])
    return FieldShape("text" if "string" in of else "number" if re.match(r"u?int|float|octet|byte", of) else "other")


def _of_descriptor(descriptor: Any, depth: int, count_fields: Iterator[int]) -> FieldShape:
    def shape(inner: Any) -> FieldShape:
        if inner.message_type is not None:
            out = _of_descriptor(inner.message_type, depth + 1, count_fields)
        else:
            kinds = {inner.CPPTYPE_STRING: "text", inner.CPPTYPE_BOOL: "other"}
            values = inner.enum_type.values if inner.enum_type is not None else ()
            out = FieldShape(kinds.get(inner.cpp_type, "number"), constants=tuple((v.name, v.number) for v in values))
        # Before version 6 of protobuf there is only the label.
        is_list = inner.is_repeated if hasattr(inner, "is_repeated") else inner.label == inner.LABEL_REPEATED
        return out._replace(count=0) if is_list else out

    is_cut = depth >= _DEEPEST or next(count_fields) > _MOST_FIELDS
    members = () if is_cut else descriptor.fields
    return FieldShape("struct", descriptor.full_name, tuple((inner.name, shape(inner)) for inner in members))


def shape_of_message(message: Any, depth: int = 0) -> FieldShape:
    """The fields of a message that was decoded from JSON; of lists those of their first members together."""
    if isinstance(message, list):
        of_all = reduce(_together, (shape_of_message(member, depth + 1) for member in message[:_JUDGED]), _NOTHING)
        is_vector = of_all.kind == "number" and len(message) <= _JUDGED
        return of_all._replace(count=len(message) if is_vector else 0) if of_all.count is None else FieldShape("other")
    if isinstance(message, bool) or message is None:
        return FieldShape("other")
    if isinstance(message, int | float):
        return FieldShape("number")
    if isinstance(message, str):
        return FieldShape("text")
    fields = vars(message).items() if depth < _DEEPEST else ()
    return FieldShape("struct", "", tuple((key, shape_of_message(value, depth + 1)) for key, value in fields))


def _together(one: FieldShape, other: FieldShape) -> FieldShape:
    """The type of a field that has these types in two messages: in each something may be missing."""
    if one.kind == "other" or other.kind == "other":
        return other if one.kind == "other" else one
    if one.kind != "struct" or other.kind != "struct":
        return one
    fields = dict(one.fields)
    for name, inner in other.fields:
        fields[name] = _together(fields.get(name, _NOTHING), inner)
    return one._replace(fields=tuple(fields.items()))


_NOTHING, _NUMBER = FieldShape("other"), FieldShape("number")
#: Members of lists of JSON that are looked at.
_JUDGED: Final = 50


# Recognise: which field is what, by its name and type. Names count in lower case and without "_".


#: Names of fields, the usual ones first.
_PLACES, _VELOCITIES, _SIZES, _PICTURED, _HEADINGS, _IDS, _CLASSES, _SCORES = (
    words.split()
    for words in (
        "pose position center centre posewithcovariance posecovariance initialposewithcovariance pos centroid location "
        "point kinematics state base bbox bbox3d boundingbox boundingbox3d box bodypose",
        "velocity vel twist twistwithcovariance twistcovariance initialtwistwithcovariance linear linearvelocity "
        "kinematics state base",
        "size dimensions dimension extent extents scale bbox bbox3d boundingbox boundingbox3d box shape base",
        "bbox boundingbox boundingbox2d bbox2d box box2d roi rect region regionofinterest face body",
        "heading yaw theta orientation rotationy",
        "trackid trackingid objectid personid instanceid uuid uid id",
        "classname classlabel class label category objectclass objectname objectlabel classification objecttype "
        "classid labelid type kind semantic",
        "score confidence existenceprobability probability reliability likelihood conf c",
    )
)
#: Numbers that are a box in a picture together, those that are a position, and those that are a velocity.
_BOXES: Final = (
    *(f"left={left} top={top} right={right} bottom={bottom}" for left, top, right, bottom in (
        ("xmin", "ymin", "xmax", "ymax"), ("minx", "miny", "maxx", "maxy"), ("left", "top", "right", "bottom"),
        ("x1", "y1", "x2", "y2"), ("x0", "y0", "x1", "y1"))),
    *(f"left={left} top={top} w={w} h={h}" for left, top, w, h in (
        ("xoffset", "yoffset", "width", "height"), ("x", "y", "width", "height"), ("x", "y", "w", "h"),
        ("left", "top", "width", "height"))),
    *(f"cx={middle}.x cy={middle}.y w={w} h={h}"
      for middle in ("center", "center.position", "centre") for w, h in (
        ("sizex", "sizey"), ("size.x", "size.y"), ("width", "height"))),
)  # fmt: skip
_FLAT_PLACES: Final = [
    " ".join(f"{axis}={form.format(axis)}" for axis in "xy")
    for form in ("pos{}", "position{}", "center{}", "centre{}", "p{}", "{}pos", "{}position", "{}m", "{}center")
]
_FLAT_VELOCITIES: Final = [
    " ".join(f"v{axis}={form.format(axis)}" for axis in "xy")
    for form in ("v{}", "vel{}", "velocity{}", "{}vel", "{}velocity")
]
_FLAT_SIZES: Final = (
    *(f"length={at}length width={at}width height={at}height"
      for at in ("", "dimensions.", "dimension.", "size.", "base.dimension.")),
    "length=sizex width=sizey height=sizez", "radius=radius", "width=width height=height",
)  # fmt: skip
#: Words in the names of types and lists of people and other things that move; and of what isn't.
PEOPLE: Final = re.compile(r"people|persons?|pedestrians?|humans?|bod(y|ies)|walkers?")
THINGS: Final = re.compile(
    PEOPLE.pattern
    + r"|track(s|ed|lets?)?|detect(ions?|ed)?|objects?|obstacles?|b?box(es)?|bounding|legs?|faces?|targets?"
    r"|clusters?|vehicles?|agents?|cars?|yolo|roi|region|circles?|rects?|predicted"
)
_OTHERS: Final = re.compile(
    r"(april)?tags?|fiducials?|waypoints?|paths?|trajector(y|ies)|joints?|landmarks?|lanes?|keypoints?|skeletons?"
    r"|particles?|grids?|maps?|signals?|traffic|signs?|markers?|goals?|plans?|grasps?|wheels?|motors?|features?|gps"
    r"|satellites?|calibration|clouds?|points|lines?|segments?|polygons?|links?|models?|contacts?|wrench(es)?"
    r"|transforms?|images?"
)
#: Parts of people: what their type is called is their class.
_PARTS: Final = re.compile(r"legs?|faces?")
#: Packages with messages that hold no things.
NO_THINGS: Final = re.compile(
    r"(action|actionlib|bond|builtin|control|controller|diagnostic|dynamic_reconfigure|gazebo|lifecycle|map|moveit|nav"
    r"|novatel_gps|octomap|rcl|rosapi|rosgraph|sensor|shape|statistics|std|stereo|tf|tf2|trajectory|ublox|velodyne)"
    r"(_msgs|_interfaces)?/.*"
)


@dataclass(frozen=True)
class ThingFields:
    """Where a message has its things, and which of their fields is what.

    Attributes
    ----------
    things : tuple of str
        The path of the list of things, ending with "[]"; () if the message itself is one.
    paths : dict of str to list of tuple of str
        Paths from a thing on, by what they hold; of several the first that isn't 0 throughout.
    names : dict of int or str to str
        Names of classes that are numbers, or constants, from the constants of the definition.
    class_name : str
        The class of all things, by the name of their type; "" if it doesn't say.
    is_certain : bool
        Whether these are things that move: their names say so, and they have more than a position.
    has_zero : bool
        Whether a class of 0 is stated, and not left out: it is a text, or one of several guesses.
    """

    things: Path
    paths: Mapping[str, Sequence[Path]]
    names: Mapping[int | str, str] = field(default_factory=dict)
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


def recognised(shape: FieldShape, type_name: str) -> ThingFields | None:
    """The things of a type of messages; None if it has none, that is no position and no box."""
    lists = _lists(shape, type_name)
    out = [fields for at, each, names in lists if (fields := _thing(at, each, names) or _wrapped(at, each))]
    return max(out, key=lambda fields: (fields.is_certain, len(fields.paths)), default=None)


def _lists(shape: FieldShape, type_name: str) -> Iterator[tuple[Path, FieldShape, list[str]]]:
    """The lists of messages in a message, and in those that it consists of, and the message itself; with the words in
    their names.
    """
    own = _words_in(type_name)
    insides: list[tuple[Path, FieldShape]] = [((name,), inner) for name, inner in shape.fields]
    insides += [
        ((name, below), last) for name, inner in shape.fields if inner.is_struct for below, last in inner.fields
    ]
    for path, inner in insides:
        if inner.kind == "struct" and inner.count is not None:
            words = [*own, *(word for name in (*path, inner.name) for word in _words_in(name))]
            yield (*path, EACH), inner._replace(count=None), words
    yield (), shape, own


def _words_in(name: str) -> list[str]:
    """The words of a name: geometry_msgs/msg/PoseArray -> pose, array."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", re.split(r"[/.]", name)[-1])]


def _thing(things: Path, each: FieldShape, words: Sequence[str]) -> ThingFields | None:
    """The fields of a thing; None if it has neither a position nor a box."""
    is_person = any(map(PEOPLE.fullmatch, words))
    if any(map(_OTHERS.fullmatch, words)) and not is_person:
        return None
    picture = _picture(each)
    inside = next(iter(picture.values()), ())[:1]
    found: dict[str, Path | None] = {**_position(each, inside), **picture}
    if not found:
        return None
    guess = _guess(each)
    sizes = [word for word in _SIZES if word not in map(_word, inside)]
    found |= {
        "velocity": next(filter(None, _vectors(each, _VELOCITIES)), None),
        "size": next((path for path in _vectors(each, sizes) if path and _axes(each.at(path)) == 3), None),
        "id": _fact(each, _IDS, "id"),
        "class": _fact(each, _CLASSES, "text") or guess.get("class") or _fact(each, _CLASSES, "number"),
        "score": _fact(each, _SCORES, "number"),
        "guess": guess.get("score"),
        "frame": _fact(each, ["frameid"], "text", deepest=1),
    }
    found |= {} if found["velocity"] else _form(each, _FLAT_VELOCITIES)
    found |= {} if found["size"] or inside else _form(each, _FLAT_SIZES)
    if is_person and not found["class"] and not found["id"]:
        found["id"] = _fact(each, ["name"], "text", deepest=0)
    paths = {key: [path] for key, path in found.items() if path is not None}
    _add_posed_guess(each, guess, paths)
    said = sum(key in paths for key in ("id", "class", "score", "velocity", "vx", "size", "length"))
    is_certain = any(map(THINGS.fullmatch, words)) and said >= (1 if things else 2) - bool(picture)
    if not things and not is_certain:
        return None
    part = next((word.rstrip("s") for word in words if _PARTS.fullmatch(word)), "")
    class_name = "" if "class" in paths else part or ("person" if is_person else "")
    return _with_classes(each, ThingFields(things, paths, {}, class_name, is_certain))


def _wrapped(things: Path, each: FieldShape) -> ThingFields | None:
    """The fields of a thing that is the field ``object`` of another, as where its features stand beside it."""
    inner = each.at(("object",)) if things else None
    fields = _thing(things, inner, _words_in(inner.name)) if inner is not None and inner.is_struct else None
    paths = {key: [("object", *path) for path in of] for key, of in fields.paths.items()} if fields else {}
    return replace(fields, paths=paths) if fields else None


def _add_posed_guess(each: FieldShape, guess: Mapping[str, Path], paths: dict[str, list[Path]]) -> None:
    """Add the pose in a guess of what a thing is, for things that state no other."""
    prefix = guess["class"][: guess["class"].index(EACH) + 1] if guess and "position" in paths else ()
    for key, path in _position(each.at(prefix) or _NOTHING, ()).items() if prefix else ():
        if key in paths:
            paths[key].append((*prefix, *path))


def _with_classes(each: FieldShape, fields: ThingFields) -> ThingFields:
    """ThingFields with what the definition says of their class."""
    path = fields.paths.get("class", [()])[0]
    kind = each.at(path)
    if not path or kind is None:
        return fields
    return replace(fields, names=_names_of(each, path), has_zero=EACH in path or kind.kind == "text")


def _word(name: str) -> str:
    return name.replace("_", "").lower()


@lru_cache(maxsize=1024)
def _members(shape: FieldShape) -> Mapping[str, tuple[str, FieldShape]]:
    """The fields of a message by their name in lower case and without "_"."""
    return {_word(name): (name, inner) for name, inner in reversed(shape.fields)} if shape.is_struct else {}


def _member(shape: FieldShape, words: str) -> tuple[Path, FieldShape]:
    """The path of a field by words with dots between them, and its type."""
    path: Path = ()
    for word in words.split("."):
        name, shape = _members(shape).get(word, ("", _NOTHING))
        path = (*path, name)
    return path, shape


def _form(shape: FieldShape, forms: Sequence[str]) -> dict[str, Path]:
    """The paths of numbers that stand together in one of several forms; empty if there is none of these."""
    for form in forms:
        members = {key: _member(shape, words) for key, _, words in (pair.partition("=") for pair in form.split())}
        if all(inner == _NUMBER for _, inner in members.values()):
            return {key: path for key, (path, _) in members.items()}
    return {}


def _axes(shape: FieldShape | None) -> int:
    """The number of axes of a point; 0 if a type isn't one."""
    if shape is None or shape.kind == "number":
        return shape.count if shape is not None and shape.count in (2, 3) else 0
    x, y, z, w = (_members(shape).get(axis, ("", _NOTHING))[1] == _NUMBER for axis in "xyzw")
    return 0 if w or not (x and y) else 2 + z


def _vectors(shape: FieldShape, words: Sequence[str], depth: int = 0) -> Iterator[Path]:
    """The paths of points: the type itself, and in fields with such names, the likeliest first."""
    if _axes(shape):
        yield ()
    members = _members(shape) if depth < 4 else {}
    for word in filter(members.__contains__, words):
        name, inner = members[word]
        yield from ((name, *path) for path in _vectors(inner, words, depth + 1))


def _position(shape: FieldShape, inside: Path) -> dict[str, Path]:
    """The paths of the position of a thing, and of its orientation. Those of its box in a picture don't count."""
    for path in _vectors(shape, _PLACES):
        if not inside or (path and path[:1] != inside) or (not path and _axes(shape) == 3):
            at = path[:-1] if path and _word(path[-1]) == "position" else path
            owner = shape.at(at) or _NOTHING
            turn, heading = _member(owner, "orientation"), _fact(owner, _HEADINGS, "number", deepest=0)
            if "w" in _members(turn[1]):
                return {"position": path, "orientation": (*at, *turn[0])}
            if angle := _fact(turn[1], ["yaw"], "number", deepest=0):
                heading = (*turn[0], *angle)
            heading = (*at, *heading) if heading else _fact(shape, _HEADINGS, "number", deepest=0)
            return {"position": path} | ({"heading": heading} if heading else {})
    flat = {} if inside else _form(shape, _FLAT_PLACES)
    heading = _fact(shape, _HEADINGS, "number", deepest=0) if flat else None
    return flat | ({"heading": heading} if heading else {})


def _fact(shape: FieldShape, words: Sequence[str], kind: str, deepest: int = 2) -> Path | None:
    """The path of a field with such a name; those that are least deep count first."""
    levels: list[tuple[Path, FieldShape]] = [((), shape)]
    for _ in range(deepest + 1):
        for path, owner in levels:
            for word in words:
                name, inner = _members(owner).get(word, ("", _NOTHING))
                if kind == "id" and name and (below := _id_below(inner)) is not None:
                    return (*path, name, *below)
                if inner.kind == kind and inner.count is None:
                    return (*path, name)
        levels = [
            ((*path, name), inner) for path, owner in levels for name, inner in owner.fields if _may_say(name, inner)
        ]
    return None


def _may_say(name: str, inner: FieldShape) -> bool:
    """Whether a struct may say what a thing is, and not only where."""
    is_place = _word(name) in (*_PLACES, *_VELOCITIES) and _word(name) not in (*_SIZES, *_PICTURED)
    return inner.is_struct and not is_place and _word(name) != "header"


def _id_below(shape: FieldShape) -> Path | None:
    """The path of an id in the field of an id: number, text, or the bytes of a UUID; None if there is none."""
    if shape.kind in ("number", "text") and shape.count in (None, 16):
        return ()
    return next((_member(shape, word)[0] for word in ("uuid", "value") if word in _members(shape)), None)


def _guess(shape: FieldShape) -> dict[str, Path]:
    """The paths of class and score in a list of guesses of what a thing is; empty if it has no such list."""
    for name, inner in shape.fields:
        if inner.kind == "struct" and inner.count is not None:
            each, words = inner._replace(count=None), [*_CLASSES, "id"]
            score = _fact(each, _SCORES, "number")
            own = _fact(each, words, "text") or _fact(each, words, "number")
            if score and own:
                return {"class": (name, EACH, *own), "score": (name, EACH, *score)}
    return {}


def _names_of(each: FieldShape, path: Path) -> dict[int | str, str]:
    """The names of classes that are numbers, by the constants beside their field, and by the names of these.

    What all constants begin with (OBJECT_TYPE_CAR, OBJECT_TYPE_BUS), as enumerations of protobuf do, is left out.
    """
    owner, kind = each.at(path[:-1]) or _NOTHING, each.at(path) or _NOTHING
    if kind.kind != "number":
        return {}
    named = kind.constants
    for prefix in (f"{path[-1].upper()}_", "CLASSIFICATION_", "CLASS_", "LABEL_", "TYPE_"):
        named = named or tuple((name[len(prefix) :], own) for name, own in owner.constants if name.startswith(prefix))
    numbers = [name for name, inner in owner.fields if inner == _NUMBER and _word(name) not in _SCORES]
    named = named or (owner.constants if numbers == [path[-1]] else ())
    same = takewhile(lambda letters: len(set(letters)) == 1, zip(*(name for name, _ in named), strict=False))
    start = "".join(letters[0] for letters in same).rfind("_") + 1 if len(named) > 2 else 0
    return {key: plain_class(name[start:]) for name, own in named for key in (own, name)}


def _picture(shape: FieldShape, depth: int = 0) -> dict[str, Path]:
    """The paths of a box in a picture: of a thing, or of its field with such a name; empty if there is none."""
    out = {} if _axes(shape) == 3 or _axes(_member(shape, "center.position")[1]) == 3 else _form(shape, _BOXES)
    if _axes(_member(shape, "center")[1]) == 3:
        out = {}
    if "cx" in out and (theta := _member(shape, "center.theta"))[1] == _NUMBER:
        out["theta"] = theta[0]
    name, corners = _members(shape).get("corners", ("", _NOTHING))
    for path in ((), ("kp",)) if corners.kind == "struct" and not out else ():
        if _axes(corners._replace(count=None).at(path)) == 2:
            return {"corners": (name, EACH, *path)}
    for word in _PICTURED if depth < 2 and not out else ():
        name, inner = _members(shape).get(word, ("", _NOTHING))
        if below := _picture(inner, depth + 1) if inner.is_struct else {}:
            return {key: (name, *path) for key, path in below.items()}
    return out


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
            form = "1280x720 is a size" if key == "picture" else "people[].pose.position.x is one"
            raise McaptrackError(f"`map=`: {key}={path} is no path of fields; {form}")
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


def mapped(shape: FieldShape, type_name: str, chosen: Mapping[str, Path]) -> ThingFields:
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
    for group in _GROUPS:
        if not own.keys().isdisjoint(group):
            kept = {key: paths for key, paths in kept.items() if key not in group}
    paths = kept | own
    if not any(form <= paths.keys() for form in _ENOUGH):
        raise McaptrackError(
            "`map=` has to name position, or x and y, or left, top, right and bottom, or left, top, w and h"
        )
    class_name = base.class_name if base and "class" not in paths else ""
    return _with_classes(shape.at(things) or shape, ThingFields(things, paths, {}, class_name))


#: Paths that stand for the same thing: those that a user gives replace all that are recognised.
_GROUPS: Final = (
    {"position", "x", "y", "z", *_PICTURED_KEYS},
    {"velocity", "vx", "vy"},
    {"orientation", "heading"},
    {"size", "length", "width", "height", "radius"},
    {"class", "guess"},
)
#: What has to be known of a thing: one of these.
_ENOUGH: Final = (
    {"position"}, {"x", "y"}, {"left", "top", "right", "bottom"}, {"left", "top", "w", "h"}, {"cx", "cy", "w", "h"},
    {"corners"},
)  # fmt: skip


def _begin(shape: FieldShape, path: Path, lists: Sequence[Path]) -> tuple[Path, Path] | None:
    """The list of a path, and the path from a thing of it on; None if the type has no such field."""
    if shape.at(path) is not None:
        if EACH not in path:
            return (), path
        end = path.index(EACH) + 1
        return path[:end], path[end:]
    return next(((things, path) for things in lists if shape.at((*things, *path)) is not None), None)


# Messages to boxes


class Boxes2d(NamedTuple):
    """Boxes in pictures: the number of the message of each (N,), ``sides`` (N, 4) as left, top, width and height in px,
    ``score`` (N,), NaN where there is none, and ``class_name`` (N,).
    """

    message: Ints
    sides: Floats
    score: Floats
    class_name: Any


NO_BOXES: Final = Boxes2d(np.empty(0, np.int64), np.empty((0, 4)), np.empty(0), np.empty(0, object))


class Boxes3d(NamedTuple):
    """Boxes in space: the number of the message of each (N,), and what ``Box3d`` has, as columns."""

    message: Ints
    stamp_ns: Ints
    frame_id: Any
    centre: Floats
    orientation: Floats
    size: Floats
    class_name: Any
    score: Floats
    source_id: Any
    velocity: Floats
    has_heading: Bools


#: The types of these columns, and how many numbers each box has of them.
_COLUMNS: Final = (
    (np.int64, ()), (object, ()), (float, (3,)), (float, (4,)), (float, (3,)), (object, ()), (float, ()), (object, ()),
    (float, (3,)), (bool, ()),
)  # fmt: skip


class Seen3d(NamedTuple):
    """The contents of M messages: their stamps, 0 where there is none, boxes, and counts of other parts by kind.

    ``is_measured`` (M,) is false for messages that only take boxes away from a viewer: nothing was measured then.
    """

    stamp_ns: Ints
    is_measured: Bools
    boxes: Boxes3d
    ignored: Mapping[str, int]


@dataclass
class Message3d:
    """The boxes of a message that is read as an object; as ``Seen3d``."""

    stamp_ns: int
    boxes: list[Box3d] = field(default_factory=list)
    ignored: dict[str, int] = field(default_factory=dict)
    is_measured: bool = True

    def columns(self) -> Seen3d:
        """The same as columns."""
        values = list(zip(*self.boxes, strict=True)) or [()] * len(_COLUMNS)
        kinds = zip(values, _COLUMNS, strict=True)
        columns = [np.array(of, kind).reshape(len(self.boxes), *shape) for of, (kind, shape) in kinds]
        boxes = Boxes3d(np.zeros(len(self.boxes), np.int64), *columns)
        return Seen3d(np.array([self.stamp_ns], np.int64), np.array([self.is_measured]), boxes, self.ignored)


#: What a type's fields don't tell: boxes as they are meant, by their things; those that are no measurements left out.
Adjust = Callable[[Things, Boxes3d], Boxes3d]


_ENDED: Final = "boxes of tracks that have ended"


class FieldReader:
    """Takes messages to boxes, by the paths of their fields; ``adjust`` also reads fields of a thing."""

    def __init__(self, fields: ThingFields, adjust: Adjust | None = None, also: str = "") -> None:
        self.fields, self.in_space, self._adjust = fields, fields.in_space, adjust
        each = [("header",), *map(_tokens, also.split()), *(path for paths in fields.paths.values() for path in paths)]
        self.paths: list[Path] = [*HEADS, ("image_header",)]
        self.paths += [(*fields.things, *path) for path in each]

    def read(self, messages: Things) -> Boxes2d | Seen3d:
        """The boxes of messages."""
        return self.in_frame(messages) if self.in_space else self.in_picture(messages)

    def in_picture(self, messages: Things) -> Boxes2d:
        """The boxes of messages in pictures, upright around what they state. Raises ValueError for impossible ones."""
        owner, things = messages.members(self.fields.things)
        names, score = self._classes(things)
        if corners := self._path("corners"):
            inside = corners.index(EACH) + 1
            of, points = things.members(corners[:inside])
            middle, size = around(points.vectors(corners[inside:]), of, len(things))
            sides = np.concatenate([middle - size / 2, size], axis=1)[:, [0, 1, 3, 4]]
        elif "cx" in self.fields.paths:
            x, y, w, h = (self._numbers(things, key) for key in ("cx", "cy", "w", "h"))
            theta = self._numbers(things, "theta") if "theta" in self.fields.paths else np.zeros(len(things))
            theta = np.where(np.isnan(theta), 0.0, theta)
            check_boxes(np.stack([x, y, w, h], axis=1), theta)
            cos, sin = np.abs(np.cos(theta)), np.abs(np.sin(theta))
            w, h = w * cos + h * sin, w * sin + h * cos
            sides = np.stack([x - w / 2, y - h / 2, w, h], axis=1)
        else:
            left, top, right, bottom, w, h = (
                self._numbers(things, key) for key in ("left", "top", "right", "bottom", "w", "h")
            )
            if "right" in self.fields.paths:
                w, h = right - left, bottom - top
            sides = np.stack([left, top, w, h], axis=1)
        check_boxes(sides)
        return Boxes2d(owner, sides, score, names)

    def in_frame(self, messages: Things) -> Seen3d:
        """The boxes of messages in space."""
        owner, things = messages.members(self.fields.things)
        stamp_ns, frame_id = message_heads(messages, owner, things)
        own_ns, own_frame = _own_heads(things, stamp_ns[owner], frame_id[owner])
        if path := self._path("frame"):
            stated = things.texts(path)
            own_frame = np.where(stated != "", stated, own_frame)
        names, score = self._classes(things)
        centre, orientation = self._pose(things)
        heading = self._numbers(things, "heading")
        is_turned = np.isfinite(heading)
        half = heading[is_turned] / 2
        orientation[is_turned] = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=1)
        size = self._vectors(things, "size", ("length", "width", "height"))
        if "radius" in self.fields.paths:
            size = np.outer(self._numbers(things, "radius"), [2.0, 2.0, nan])
        velocity = self._vectors(things, "velocity", ("vx", "vy", "vz"))
        is_flat = np.isfinite(velocity[:, :2]).all(axis=1) & ~np.isfinite(velocity[:, 2])
        velocity[is_flat, 2] = 0.0  # along the ground where there is no z
        ids = things.values(path) if (path := self._path("id")) else [None] * len(things)
        boxes = Boxes3d(
            owner,
            own_ns,
            own_frame,
            centre,
            orientation,
            size,
            names,
            score,
            np.array(list(map(identity, ids)), object),
            velocity,
            is_turned | ("orientation" in self.fields.paths),
        )
        if self._adjust:
            boxes = self._adjust(things, boxes)
        ended = len(owner) - len(boxes.message)
        return Seen3d(stamp_ns, np.ones(len(messages), bool), boxes, {_ENDED: ended} if ended else {})

    def _path(self, key: str) -> Path | None:
        paths = self.fields.paths.get(key)
        return paths[0] if paths else None

    def _numbers(self, things: Things, key: str) -> Floats:
        path = self._path(key)
        return np.full(len(things), nan) if path is None else things.numbers(path)

    def _vectors(self, things: Things, key: str, flat: Sequence[str]) -> Floats:
        path = self._path(key)
        if path is not None:
            return things.vectors(path)
        return np.stack([self._numbers(things, name) for name in flat], axis=1)

    def _pose(self, things: Things) -> tuple[Floats, Floats]:
        """Positions and orientations of things; those of their first guess where only these are filled in."""
        turns = self.fields.paths.get("orientation", ())
        centre, turn = self._vectors(things, "position", ("x", "y", "z")), np.zeros((len(things), 4))
        for order, place in enumerate(self.fields.paths.get("position", ())):
            values, is_missing = things.vectors(place), np.isnan(centre).all(axis=1)
            is_better = is_missing | ((centre == 0).all(axis=1) & (values != 0).any(axis=1))
            is_better = (is_better & ~np.isnan(values).all(axis=1)) | (order == 0)
            centre[is_better], turn[is_better] = values[is_better], 0.0
            if order < len(turns):
                is_stated = is_better & things.is_set(turns[order])
                turn[is_stated] = things.vectors(turns[order], "xyzw")[is_stated]
        return centre, turn

    def _classes(self, things: Things) -> tuple[Any, Floats]:
        """The class of each thing, and its score: its own, or of the likeliest guess of its class."""
        score, path = self._numbers(things, "score"), self._path("class")
        if path is None:
            return np.full(len(things), self.fields.class_name, object), score
        if EACH in path:
            share, values = self._likeliest(things, path)
            score = np.where(score > 0, score, share)
        else:
            values = things.values(path)
        return np.array(list(map(self._class_name, values)), object), score

    def _class_name(self, value: Any) -> str:
        if value is None:
            return self.fields.class_name
        if not isinstance(value, str):
            return self.fields.names.get(integer(value), str(integer(value)))
        # Enumerations of protobuf are by name.
        return self.fields.names.get(value, plain_class(value)) if self.fields.names else value.strip()

    def _likeliest(self, things: Things, path: Path) -> tuple[Floats, list[Any]]:
        """The highest score of guesses that is a number, and the class with it; NaN and None if there is no guess."""
        inside = path.index(EACH) + 1
        owner, guesses = things.members(path[:inside])
        scores = guesses.numbers(self.fields.paths["guess"][0][inside:])
        finite = np.where(np.isfinite(scores), scores, -np.inf)
        order = np.lexsort((-finite, owner))
        with_guess, first = np.unique(owner[order], return_index=True)
        best, values = order[first], guesses.values(path[inside:])
        share, classes = np.full(len(things), nan), [None] * len(things)
        share[with_guess] = np.where(np.isfinite(finite[best]), finite[best], nan)
        for thing, place in zip(with_guess.tolist(), best.tolist(), strict=True):
            classes[thing] = values[place]
        return share, classes


def plain_class(name: str) -> str:
    """The class of a constant: its name in lower case, "" for what says that it is unknown."""
    return "" if name.lower() in ("unknown", "unspecified") else name.lower()


def identity(value: Any) -> int | str | None:
    """An id: a number, a text, or the hexadecimal digits of a UUID; None if there is none."""
    if value is None or isinstance(value, str):
        return value or None
    if isinstance(value, np.ndarray | bytes | list):
        return to_bytes(value).hex()
    return str(value) if isinstance(value, int) and value >= 2**63 else integer(value)  # some are unsigned


def message_heads(messages: Things, owner: Ints, things: Things) -> tuple[Ints, Any]:
    """Stamps in ns and frames of messages (M,): of their headers, their own, or those of their first things."""
    if messages.has(("header",)) or messages.has(("timestamp",)):
        return heads(messages)
    stamp_ns, frame_id = np.zeros(len(messages), np.int64), np.full(len(messages), "", object)
    if things.has(("header",)):
        with_things, first = np.unique(owner, return_index=True)
        stamp_ns[with_things] = things.stamps(("header", "stamp"))[first]
        frame_id[with_things] = things.texts(("header", "frame_id"))[first]
    return stamp_ns, frame_id


def _own_heads(things: Things, stamp_ns: Ints, frame_id: Any) -> tuple[Ints, Any]:
    """Stamps and frames of things (N,): their own, or, where they state no frame, those of the messages around them."""
    if not things.has(("header",)):
        return stamp_ns, frame_id
    own_ns, own_frame = things.stamps(("header", "stamp")), things.texts(("header", "frame_id"))
    is_own = own_frame != ""
    return np.where(is_own & (own_ns != 0), own_ns, stamp_ns), np.where(is_own, own_frame, frame_id)


def head_of(message: Any) -> tuple[int, str]:
    """Stamp in ns and frame of a message with a ROS header."""
    return stamp_of(message), text(message.header.frame_id)


def vector(value: Any) -> Vector:
    """A point or vector; the origin where it is missing, as protobuf leaves out zeros.

    A point without z has NaN, which is unknown.
    """
    if value is None:
        return 0.0, 0.0, 0.0
    return number(value.x), number(value.y), number(value.z) if hasattr(value, "z") else nan


def quaternion(value: Any) -> Quaternion:
    """A quaternion; zeros where it is missing."""
    return UNSTATED if value is None else (number(value.x), number(value.y), number(value.z), number(value.w))


def part(message: Any, name: str) -> Any:
    """A field of a message; None where it is missing, as optional fields of JSON are."""
    return getattr(message, name, None)


def rotated(orientation: Floats, points: Floats) -> Floats:
    """Points (N, 3) turned by quaternions (N, 4), or by one (4,); as they are by those of zeros."""
    x, y, z, w = np.broadcast_to(orientation, (len(points), 4)).T
    norm = x * x + y * y + z * z + w * w
    a, b, c = points.T
    # p + 2 w (q x p) + 2 q x (q x p), for a quaternion that need not have length 1
    u, v, t = y * c - z * b, z * a - x * c, x * b - y * a
    with np.errstate(invalid="ignore", divide="ignore"):
        turned = (
            a + 2 * (w * u + y * t - z * v) / norm,
            b + 2 * (w * v + z * u - x * t) / norm,
            c + 2 * (w * t + x * v - y * u) / norm,
        )
    is_turned = np.isfinite(norm) & (norm != 0)
    return np.where(is_turned[:, None], np.stack(turned, axis=1), points)


def around(points: Floats, owner: Ints, count: int) -> tuple[Floats, Floats]:
    """Middle and size (N, 3) of the boxes around the points (K, 3) of each of N owners (K,); NaN without points."""
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, owner, points)
    np.maximum.at(high, owner, points)
    low[low > high] = nan
    return (low + high) / 2, high - low


def check_boxes(sides: Floats, turn: Floats | float = 0.0) -> None:
    """Raise ValueError for a box (N, 4), as left or middle, top or middle, width and height, that can't be."""
    can_be = np.isfinite(sides).all(axis=1) & np.isfinite(turn) & (sides[:, 2:] >= 0).all(axis=1)
    if not can_be.all():
        x, y, w, h = sides[int(np.argmin(can_be))]
        raise ValueError(f"a box can't be {w:g} x {h:g} at ({x:g}, {y:g})")
