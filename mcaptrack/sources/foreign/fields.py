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
from itertools import count
from math import cos, isfinite, nan, sin
from operator import attrgetter
from typing import Any, Final, NamedTuple

import numpy as np
from mcap.well_known import MessageEncoding

from mcaptrack.contracts import UNKNOWN_VECTOR, Box, Box3d, Quaternion, Vector
from mcaptrack.errors import McaptrackError, did_you_mean
from mcaptrack.sources.foreign.decoding import (
    integer,
    number,
    protobuf_unpacker,
    stamp_of,
    text,
    to_bytes,
)
from mcaptrack.sources.foreign.definitions import MessageType, ros_types

Path = tuple[str, ...]
#: The token of a list in a path: of things, or of guesses of their class.
_EACH: Final = "[]"
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
                if here.count is None or (token == _EACH and here.kind != "struct"):
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
        from_string: Any = protobuf_unpacker(kind)
        return _of_descriptor(from_string.__self__.DESCRIPTOR, 0, fields)
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
        "pose position center centre posewithcovariance initialposewithcovariance pos centroid location point "
        "kinematics state bbox bbox3d boundingbox boundingbox3d box bodypose",
        "velocity vel twist twistwithcovariance initialtwistwithcovariance linear linearvelocity kinematics state",
        "size dimensions dimension extent extents scale bbox bbox3d boundingbox boundingbox3d box shape",
        "bbox boundingbox boundingbox2d bbox2d box box2d roi rect region regionofinterest face body",
        "heading yaw theta orientation rotationy",
        "trackid trackingid objectid personid instanceid uuid uid id",
        "classname classlabel class label category objectclass objectname objectlabel classification objecttype "
        "classid labelid type",
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
    *(f"length={at}length width={at}width height={at}height" for at in ("", "dimensions.", "dimension.", "size.")),
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


def recognised(shape: FieldShape, type_name: str) -> ThingFields | None:
    """The things of a type of messages; None if it has none, that is no position and no box."""
    out = [fields for things, each, names in _lists(shape, type_name) if (fields := _thing(things, each, names))]
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
            yield (*path, _EACH), inner._replace(count=None), words
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


def _add_posed_guess(each: FieldShape, guess: Mapping[str, Path], paths: dict[str, list[Path]]) -> None:
    """Add the pose in a guess of what a thing is, for things that state no other."""
    prefix = guess["class"][: guess["class"].index(_EACH) + 1] if guess and "position" in paths else ()
    for key, path in _position(each.at(prefix) or _NOTHING, ()).items() if prefix else ():
        if key in paths:
            paths[key].append((*prefix, *path))


def _with_classes(each: FieldShape, fields: ThingFields) -> ThingFields:
    """ThingFields with what the definition says of their class."""
    path = fields.paths.get("class", [()])[0]
    kind = each.at(path)
    if not path or kind is None:
        return fields
    return replace(fields, names=_names_of(each, path), has_zero=_EACH in path or kind.kind == "text")


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
            if turn[1].is_struct:
                return {"position": path, "orientation": (*at, *turn[0])}
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
    return _member(shape, "uuid")[0] if "uuid" in _members(shape) else None


def _guess(shape: FieldShape) -> dict[str, Path]:
    """The paths of class and score in a list of guesses of what a thing is; empty if it has no such list."""
    for name, inner in shape.fields:
        if inner.kind == "struct" and inner.count is not None:
            each, words = inner._replace(count=None), [*_CLASSES, "id"]
            score = _fact(each, _SCORES, "number")
            own = _fact(each, words, "text") or _fact(each, words, "number")
            if score and own:
                return {"class": (name, _EACH, *own), "score": (name, _EACH, *score)}
    return {}


def _names_of(each: FieldShape, path: Path) -> dict[int, str]:
    """The names of classes that are numbers, by the constants beside their field."""
    owner, kind = each.at(path[:-1]) or _NOTHING, each.at(path) or _NOTHING
    if kind.kind != "number":
        return {}
    named = kind.constants
    for prefix in (f"{path[-1].upper()}_", "CLASSIFICATION_", "CLASS_", "LABEL_", "TYPE_"):
        named = named or tuple((name[len(prefix) :], own) for name, own in owner.constants if name.startswith(prefix))
    numbers = [name for name, inner in owner.fields if inner == _NUMBER and _word(name) not in _SCORES]
    named = named or (owner.constants if numbers == [path[-1]] else ())
    return {own: "" if name.lower() == "unknown" else name.lower() for name, own in named}


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
            return {"corners": (name, _EACH, *path)}
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


_ENDED: Final = "boxes of tracks that have ended"


class FieldReader:
    """Takes messages to boxes, by the paths of their fields."""

    def __init__(self, fields: ThingFields, in_space: bool, adjust: Adjust | None = None) -> None:
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
                out.ignored[_ENDED] = out.ignored.get(_ENDED, 0) + 1
            else:
                out.boxes.append(box)
        return out

    def _value(self, thing: Any, key: str) -> Any:
        return self._get[key][0](thing) if key in self._get else None

    def _number(self, thing: Any, key: str) -> float:
        return number(self._value(thing, key))

    def _numbers(self, thing: Any, keys: str) -> list[float]:
        """Numbers that a thing has to have. Raises AttributeError for one that JSON leaves out."""
        values = [self._value(thing, key) for key in keys.split()]
        if None in values:
            raise AttributeError(name=_joined(self.fields.paths[keys.split()[values.index(None)]][0]))
        return [number(value) for value in values]

    def _box(self, thing: Any) -> Box:
        """A box in a picture: upright around what the message states."""
        name, score = self._class(thing)
        if "corners" in self._get:
            path = self.fields.paths["corners"][0]
            rest = _getter(path[path.index(_EACH) + 1 :])
            points = [vector(rest(corner)) for corner in things_of(thing, path[: path.index(_EACH) + 1])]
            (x, y, _), (w, h, _) = around(points or [UNKNOWN_VECTOR])
            left, top = x - w / 2, y - h / 2
        elif "cx" in self._get:
            x, y, w, h = self._numbers(thing, "cx cy w h")
            theta = number(self._value(thing, "theta") or 0.0)
            check_box(x, y, w, h, theta)
            w, h = (abs(w * cos(theta)) + abs(h * sin(theta)), abs(w * sin(theta)) + abs(h * cos(theta)))
            left, top = x - w / 2, y - h / 2
        elif "right" in self._get:
            left, top, right, bottom = self._numbers(thing, "left top right bottom")
            w, h = right - left, bottom - top
        else:
            left, top, w, h = self._numbers(thing, "left top w h")
        check_box(left, top, w, h)
        return Box(left, top, w, h, score, name)

    def _box_3d(self, thing: Any, head: tuple[int, str]) -> Box3d:
        name, score = self._class(thing)
        centre, orientation = self._pose(thing)
        has_heading = "orientation" in self._get
        if "heading" in self._get and isfinite(heading := self._number(thing, "heading")):
            orientation, has_heading = (0.0, 0.0, sin(heading / 2), cos(heading / 2)), True
        stamp_ns, frame_id = own_head(thing, head)
        diameter = 2 * self._number(thing, "radius")
        x, y, z = self._vector(thing, "velocity", "vx vy vz")
        return Box3d(
            stamp_ns,
            text(self._value(thing, "frame") or "") or frame_id,
            centre,
            orientation,
            (diameter, diameter, nan) if "radius" in self._get else self._vector(thing, "size", "length width height"),
            name,
            score,
            _identity(self._value(thing, "id")),
            (x, y, 0.0 if isfinite(x + y) and not isfinite(z) else z),  # along the ground where there is no z
            has_heading,
        )

    def _pose(self, thing: Any) -> tuple[Vector, Quaternion]:
        """Position and orientation of a thing; those of its first guess where only these are filled in."""
        if "position" not in self._get:
            x, y = self._numbers(thing, "x y")
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

    def _vector(self, thing: Any, key: str, flat: str) -> Vector:
        if key in self._get:
            value = self._value(thing, key)
            return UNKNOWN_VECTOR if value is None else vector(value)
        x, y, z = (self._number(thing, name) for name in flat.split())
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


@lru_cache(maxsize=1024)
def _getter(path: Path) -> Callable[[Any], Any]:
    """A function that takes a message to the value at a path; None where JSON leaves it out.

    Of lists the first member counts.
    """
    if not path:
        return lambda message: message
    steps = [int(token[1:-1] or 0) if token.startswith("[") else attrgetter(token) for token in path]
    if all(map(callable, steps)):
        steps = [attrgetter(".".join(path))]

    def get(message: Any) -> Any:
        try:
            for step in steps:
                message = step(message) if callable(step) else message[step]
        except (AttributeError, IndexError, TypeError):
            return None
        return message

    return get


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
    return number(value.x), number(value.y), number(value.z) if hasattr(value, "z") else nan


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


def check_box(x: float, y: float, w: float, h: float, theta: float = 0.0) -> None:
    """Raise ValueError for a box that can't be."""
    if not all(isfinite(value) for value in (x, y, theta, w, h)) or w < 0 or h < 0:
        raise ValueError(f"a box can't be {w:g} x {h:g} at ({x:g}, {y:g})")
