"""Definitions of ROS messages: of a recording itself, of a folder that the user names, and of the distributions of ROS.

A recording need not define its messages: sqlite bags before ROS 2 Iron don't. Distributions define some types
differently, so each definition is tried on the messages, and that one is taken with which they decode to their last
byte.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcap.well_known import MessageEncoding, SchemaEncoding

from mcaptrack import foxglove
from mcaptrack.errors import McaptrackError, in_one_line
from mcaptrack.files import read_beginning
from mcaptrack.log.recording_files import ZSTD
from mcaptrack.notices import warn
from mcaptrack.schema import SCHEMAS
from mcaptrack.schema.encodings import CDR, ros_definition, schema_of_ros
from mcaptrack.schema.names import plain_name, ros_type

#: Types as rosbags has them: constants and fields by name.
Types = dict[str, Any]
#: A function that gives the constants and fields of a type; None if it doesn't know it.
LookUp = Callable[[str], Any]

#: Longer definitions are refused, because parsing them takes long.
_MAX_DEFINITION: Final = 2**20
_MAX_FILES: Final = 100_000
#: So many messages are tried at most, and at least if only one definition is left.
_TRIED: Final = 2000
_ENOUGH: Final = 20
#: CDR messages may be filled up to a multiple of this.
_FILL: Final = 4
#: Where metadata of a channel say which definition was taken for it.
_METADATA: Final = "mcaptrack.definition"
_ADVICE: Final = "`definitions=` names a folder with .msg or .idl files"
#: Definitions in IDL: how they begin, the heads of files, texts, which stay, comments and directives, which go, and
#: enumerations. What isn't closed ends with the definition, so that each takes one pass.
_IDL: Final = re.compile(
    r"(?>\s+|//.*|/\*(?s:.*?)(?:\*/|\Z)|#.*)*+(?:=+\s*IDL:|(?:module|struct|typedef|enum|const)\b)"
)
_IDL_HEAD: Final = re.compile(r"^=+\nIDL: .*\n", re.MULTILINE)
_TEXT: Final = r'"(?:\\(?s:.|\Z)|[^"\\])*+(?:"|\Z)'
_IDL_TEXT: Final = re.compile(rf"({_TEXT})|//[^\n]*|/\*(?s:.*?)(?:\*/|\Z)|^[ \t]*#[^\n]*", re.MULTILINE)
_IDL_ENUM: Final = re.compile(
    rf"{_TEXT}|(?:@bit_bound\s*\(\s*(\d+)\s*\)\s*)?(?:@\w+\s*)?\benum\s+(\w+)\s*\{{[^}}]*+(?:\}}|\Z)"
)
#: What changes how messages in IDL are encoded, and isn't read.
_IDL_UNREAD: Final = re.compile(r"@optional|@mutable|@extensibility\(\s*MUTABLE\s*\)|\bunion\b")
#: Types with a definition that is empty.
_EMPTY: Final = re.compile(r"\w+(/msg)?/Empty")
_SEPARATOR: Final = re.compile(r"^=+[ \t]*$", re.MULTILINE)

#: The messages of vision_msgs, which rosbags doesn't know: of a version those that differ from the next one.
_VISION: Final = Path(__file__).with_name("vision_msgs")
#: The version of vision_msgs of a distribution; later ones have version 4.
_VISION_OF: Final = {"ros1_noetic": 1, "ros2_dashing": 2, "ros2_eloquent": 2, "ros2_foxy": 2, "ros2_galactic": 3}
_NEWEST_VISION: Final = 4


#: Encodings of messages of distributions of ROS, by how rosbags calls these.
_ENCODING: Final = {"ros1_": MessageEncoding.ROS1, "ros2_": MessageEncoding.CDR}


class MessageType(NamedTuple):
    """The message type of a channel: its schema record and its message encoding."""

    name: str
    schema_encoding: str
    schema: bytes
    encoding: str


class _Candidate(NamedTuple):
    """A definition of a type with all types of its fields, and the distributions of ROS, or folders, that have it.

    ``layout`` are the kinds of values in a message; ``fits`` says whether a message decodes to its last byte.
    """

    types: Types
    origins: list[str]
    layout: tuple[Any, ...]
    fits: Callable[[bytes], bool]


# The definitions of a folder that the user names.


@dataclass
class _Chosen:
    """The folders of definitions that the user names, the distribution of ROS, and whether they were looked at."""

    folders: tuple[Path, ...] = ()
    distribution: str = ""
    is_used: bool = False


_CHOSEN: Final[ContextVar[_Chosen | None]] = ContextVar("definitions", default=None)


@contextmanager
def definitions_of(names: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] | None) -> Iterator[None]:
    """In this block, types that recordings don't define are looked up in these folders of .msg and .idl files first.

    A name may also be that of a distribution of ROS, such as humble: then only its definitions are tried. Raises
    McaptrackError for what is neither; a warning says so if no definition was needed.
    """
    chosen = _Chosen()
    for name in (names,) if isinstance(names, str | os.PathLike) else names or ():
        path = Path(os.path.abspath(name))
        distributions = [other[5:] for encoding in _ENCODING.values() for other in _distributions(encoding)]
        if str(name).lower() in distributions and not path.exists():
            chosen.distribution = str(name).lower()
        elif not path.is_dir():
            raise McaptrackError(f"`definitions=` names {name}: no folder, and not one of {', '.join(distributions)}")
        else:
            chosen.folders += (path,)
    if chosen != _Chosen():
        for cached in (_files_in, _parsed_file, _typestore):
            cached.cache_clear()
    for path in chosen.folders:
        if not _files_in(path):
            raise McaptrackError(f"`definitions=` names {path}, which has no .msg or .idl files, as pkg/msg/Name.msg")
    token = _CHOSEN.set(chosen)
    try:
        yield
    finally:
        _CHOSEN.reset(token)
    if chosen != _Chosen() and not chosen.is_used:
        warn("`definitions=` changes nothing here: no messages without a definition were read", "option-not-used")


@lru_cache(maxsize=8)
def _files_in(folder: Path) -> dict[str, Path]:
    """The files of definitions in a folder, by the name of their type; by the last part of it if they name no package.

    Packages have their files in PKG/msg/, as in a workspace or in what ROS installs.
    """
    of_kind = (path for path in folder.rglob("[!.]*") if path.suffix in (".msg", ".idl") and path.is_file())
    found = islice(of_kind, _MAX_FILES)
    files: dict[str, Path] = {}
    for path in sorted(found, key=lambda path: (path.suffix == ".idl", path)):  # rosidl makes each .idl of a .msg
        package = path.parent.parent.name if path.parent.name == "msg" else ""
        files.setdefault(ros_type(f"{package}/msg/{path.stem}") if package else path.stem, path)
    return files


def _look_up_file(folder: Path, name: str) -> Any:
    files = _files_in(folder)
    path = files.get(name) or files.get(name.rpartition("/")[2])
    return None if path is None else _parsed_file(path, name).get(name)


@lru_cache(maxsize=1024)
def _parsed_file(path: Path, name: str) -> Types:
    try:
        data = read_beginning(path, _MAX_DEFINITION + 1)
        encoding = SchemaEncoding.ROS2IDL if path.suffix == ".idl" else SchemaEncoding.ROS2
        return parsed(name, encoding, data)
    except (OSError, ValueError) as error:
        raise McaptrackError(f"{path} can't be read as a definition: {error}") from None


# Parse definitions.


def parsed(name: str, schema_encoding: str, data: bytes) -> Types:
    """The types that a definition defines: the named one and those of its fields. Raises ValueError."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    if len(data) > _MAX_DEFINITION:
        raise ValueError(f"it has {len(data)} bytes; at most {_MAX_DEFINITION} are read")
    text = data.decode("utf-8", "replace").replace("\r\n", "\n")
    if not text.strip():
        if not _EMPTY.fullmatch(name):
            return {}
        text = "# no fields"
    try:
        if schema_encoding not in (SchemaEncoding.ROS2IDL, "omgidl") and not _IDL.match(text):
            return get_types_from_msg(_SEPARATOR.sub("=" * 80, text), name)
        plain = _IDL_TEXT.sub(lambda part: part[1] or " ", text)
        if unread := _IDL_UNREAD.search(plain):
            raise ValueError(f"{unread.group()} of IDL is not read")
        plain = _IDL_ENUM.sub(lambda part: f"typedef uint{part[1] or 32} {part[2]}" if part[2] else part[0], plain)
        parts = [get_types_from_idl(part) for part in _IDL_HEAD.split(plain) if part.strip()]
    except Exception as error:  # third-party parsers, which raise various exceptions
        raise ValueError(in_one_line(error, 120)) from None
    return _as_in_ros({inner: fields for part in parts for inner, fields in part.items()}, name)


def _as_in_ros(types: Types, name: str) -> Types:
    """Types of IDL by their names in ROS, and without the underscores that DDS adds to fields."""

    def renamed(kind: Any) -> Any:
        from rosbags.interfaces import Nodetype

        node, inner = kind
        if node == Nodetype.NAME:
            return node, ros_type(inner)
        return kind if node == Nodetype.BASE else (node, (renamed(inner[0]), inner[1]))

    out: Types = {}
    for inner, (constants, fields) in types.items():
        end = "_" if fields and all(field.endswith("_") for field, _ in fields) else ""
        out[ros_type(inner)] = (constants, [(field.removesuffix(end), renamed(kind)) for field, kind in fields])
    if name not in out:  # a schema that calls its type otherwise than its definition
        last = name.rpartition("/")[2]
        alike = [inner for inner in out if inner.rpartition("/")[2] == last]
        used = {inner for _, fields in out.values() for _, kind in fields for inner in _names_in(kind)}
        alike = alike or [inner for inner in out if inner not in used and out[inner][1]]
        if len(alike) != 1:
            raise ValueError(f"it defines {', '.join(out) or 'nothing'}, not {name}")
        out[name] = out[alike[0]]
    return out


def _names_in(kind: Any) -> Iterator[str]:
    """The other type in the type of a field, if any."""
    from rosbags.interfaces import Nodetype

    node, inner = kind
    if node == Nodetype.NAME:
        yield inner
    elif node != Nodetype.BASE:
        yield from _names_in(inner[0])


def _whole(name: str, look_ups: Sequence[LookUp]) -> Types:
    """A type and all types of its fields, each by the first function that knows it. Raises ValueError."""
    types: Types = {}
    missing = [name]
    while missing:
        wanted = missing.pop()
        if wanted not in types:
            known = (look_up(wanted) for look_up in look_ups)
            types[wanted] = next((fields for fields in known if fields is not None), None)
            if types[wanted] is None:
                is_wide = wanted.endswith("/wstring")
                raise ValueError("a field is a wstring, which is not read" if is_wide else f"{wanted} is not defined")
            missing += [inner for _, kind in types[wanted][1] for inner in _names_in(kind)]
    return types


def _store_of(types: Types) -> Any:
    """A store of rosbags with these types."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store


# The types of a channel.


def ros_types(kind: MessageType) -> tuple[Any, str]:
    """The types of a ROS message (a store of rosbags), and its name in it: by its definition, or else that of ROS.

    Raises McaptrackError if its definition can't be understood, or if there is none.
    """
    name = ros_type(kind.name)
    if not name:
        raise McaptrackError(f"{kind.name!r} is not the name of a ROS message; those are like sensor_msgs/Image")
    # Each reader sets the longest sequence of its own store; what was compiled for the type is shared.
    return copy(_typestore(name, kind, (_CHOSEN.get() or _Chosen()).folders)), name


@lru_cache(maxsize=64)
def _typestore(name: str, kind: MessageType, folders: tuple[Path, ...]) -> Any:
    """The types of a channel, kept: the code that reads a type is compiled when it is first used, which takes longer
    than a short log.
    """
    newest = next(iter(_distributions(kind.encoding)))
    try:
        own = parsed(name, kind.schema_encoding, kind.schema)
        store = _store_of(_whole(name, [own.get, *([*_of_folders(folders), *_of_distribution(newest)] if own else [])]))
        store.get_msgdef(name)
    except Exception as error:  # noqa: BLE001, RUF100  # a third-party parser that raises various exceptions
        why = "the log has no definition of it that fits its messages"
        if kind.schema:
            why = f"the log's definition of it can't be understood ({in_one_line(error, 120)})"
        raise McaptrackError(f"{kind.name} can't be read: {why}; {_ADVICE}") from None
    return store


def _of_folders(folders: Sequence[Path]) -> list[LookUp]:
    return [lambda name, folder=folder: _look_up_file(folder, name) for folder in folders]  # type: ignore[misc]


def _distributions(encoding: str) -> list[str]:
    """The names of distributions of ROS in rosbags, the newest first."""
    from rosbags.typesys import Stores

    version = "ros1_" if encoding == MessageEncoding.ROS1 else "ros2_"
    return [store.value for store in reversed(Stores) if store.value.startswith(version)]


def _of_distribution(distribution: str) -> list[LookUp]:
    """Functions that know the messages of a distribution of ROS: of its own packages, and of vision_msgs."""
    from rosbags.typesys import Stores, get_typestore

    versions = range(_VISION_OF.get(distribution, _NEWEST_VISION), _NEWEST_VISION + 1)
    vision = _of_folders([_VISION / str(version) for version in versions])

    def look_up_vision(name: str) -> Any:
        known = (look_up(name) for look_up in vision if name.startswith("vision_msgs/"))
        return next((fields for fields in known if fields is not None), None)

    return [get_typestore(Stores(distribution)).fielddefs.get, look_up_vision]


def typestore_of(distribution: str) -> Any:
    """A store of rosbags with the types of a distribution of ROS, such as ros2_humble, and with vision_msgs."""
    from rosbags.typesys import Stores, get_typestore

    store, look_ups = get_typestore(Stores(distribution)), _of_distribution(distribution)
    for name in ("vision_msgs/msg/Detection2DArray", "vision_msgs/msg/Detection3DArray"):
        store.register(_whole(name, look_ups))
    return store


# Definitions that a recording doesn't have, by its messages.


def is_defined(kind: MessageType) -> bool:
    """Whether a message type has its definition, needs none, or has no name by which it could be looked up."""
    is_ros = kind.encoding in (MessageEncoding.ROS1, MessageEncoding.CDR)
    return not (is_ros and kind.name) or bool(kind.schema.strip() or _EMPTY.fullmatch(kind.name))


class Defined(NamedTuple):
    """A message type with a definition, and in words where this is from; ``doubts`` is what speaks against it.

    Without a definition that fits, the type is as it was, ``origin`` is "", and ``doubts`` says so.
    """

    kind: MessageType
    origin: str
    doubts: str

    @property
    def metadata(self) -> dict[str, str]:
        """The metadata of a channel with this definition."""
        return {_METADATA: self.doubts or self.origin} if self.origin else {}


def defined(kind: MessageType, payloads: Iterable[bytes], distribution: str = "", digest: str = "") -> Defined:
    """A message type with the definition that fits its messages.

    Of several that read other values it is that of ``distribution``, or else the newest. ``digest`` is the hash of the
    type in ROS 2, if it is known.
    """
    name = ros_type(kind.name)
    candidates = _candidates(name, kind, distribution, digest) if name else []
    fitting, fits, count = _fitting(candidates, payloads)
    if not fitting:
        tried = f", and {' and '.join(map(_origin, candidates))} doesn't fit its messages" if candidates else ""
        return Defined(kind, "", f"its definition is not known{tried} ({_ADVICE})")
    first = fitting[0]
    others = [other for other in fitting[1:] if fits and other.layout != first.layout]
    also = [f"its messages also fit {'; '.join(map(_origin, others))}"] if others else []
    also += [f"it fits {fits} of {count} messages"] if fits < count else []
    version = 1 if kind.encoding == MessageEncoding.ROS1 else 2
    text = _store_of(first.types).generate_msgdef(name, ros_version=version)[0]
    encoding = SchemaEncoding.ROS1 if version == 1 else SchemaEncoding.ROS2
    origin = f"{_origin(first)}{', which fits its messages' if count and not also else ''}"
    doubts = f"its definition is a guess, {origin}: {', and '.join(also)} ({_ADVICE})" if also else ""
    return Defined(MessageType(kind.name, encoding, text.encode(), kind.encoding), origin, doubts)


def _candidates(name: str, kind: MessageType, distribution: str, digest: str) -> list[_Candidate]:
    """The definitions of a type, each once: of the folders that the user names, or else of the distributions of ROS.

    Raises McaptrackError if a folder defines the type, but not the types of its fields.
    """
    chosen = _CHOSEN.get() or _Chosen()
    folders, chosen.is_used = chosen.folders, True
    named = [folder for folder in folders if _look_up_file(folder, name) is not None]
    order = sorted(_distributions(kind.encoding), key=lambda other: other[5:] != distribution)
    order = [other for other in order if other[5:] == chosen.distribution] or order
    candidates: list[_Candidate] = []
    for other in order:
        try:
            types = _whole(name, [*_of_folders(folders), *_of_distribution(other), _look_up_ours])
            same = next((candidate for candidate in candidates if candidate.types == types), None)
            if same is not None:
                same.origins.append(other)
            elif named or not digest.startswith("RIHS01_") or _store_of(types).hash_rihs01(name) == digest:
                fits = _exact_reader(types, name, kind.encoding)
                candidates.append(_Candidate(types, [*map(str, named)] or [other], _layout(types, name), fits))
        except (ValueError, LookupError, RecursionError) as error:
            if named and other == order[-1] and not candidates:
                why = f"{named[0]} defines {name}, but its messages can't be read by it: {error}"
                raise McaptrackError(" ".join(why.split())[:300]) from None
    return candidates


def _look_up_ours(name: str) -> Any:
    """The definition of a message of mcaptrack, or of Foxglove, in ROS 2."""
    plain = plain_name(name)
    schema = SCHEMAS.get(schema_of_ros(name))
    if schema is not None:
        return parsed(name, SchemaEncoding.ROS2, ros_definition(schema.definition).encode()).get(name)
    if plain.startswith("foxglove.") and name.startswith("foxglove_msgs/"):
        try:
            return parsed(name, *foxglove.record_in(plain, CDR)[1:]).get(name)
        except (KeyError, AttributeError):
            return None
    return None


def _origin(candidate: _Candidate) -> str:
    """Where a definition is from, in words: "that of ROS 2 Foxy to Galactic"."""
    names = candidate.origins
    if not names[0].startswith(tuple(_ENCODING)):
        return f"that in {names[0]}"
    order = sorted(names, key=_distributions(_ENCODING[names[0][:5]]).index)
    ends = [order[-1], *order[:1]] if len(order) > 1 else order
    return f"that of ROS {names[0][3]} {' to '.join(name[5:].capitalize() for name in ends)}"


def _fitting(candidates: Sequence[_Candidate], payloads: Iterable[bytes]) -> tuple[list[_Candidate], int, int]:
    """The candidates with which most messages decode to their last byte, how many these are, and of how many."""
    scores, count = [0] * len(candidates), 0
    for payload in islice(payloads, _TRIED if candidates else 0):
        try:
            message = unpacked(payload)
        except ValueError:
            continue  # a message that can't be decompressed says nothing
        count += 1
        scores = [score + each.fits(message) for score, each in zip(scores, candidates, strict=True)]
        whole = {each.layout for score, each in zip(scores, candidates, strict=True) if score == count}
        if count >= _ENOUGH and (len(whole) == 1 or not any(scores)):
            break
    best = max(scores, default=0)
    fitting = [each for score, each in zip(scores, candidates, strict=True) if score == best and 2 * best >= count]
    return fitting, best, count


def _exact_reader(types: Types, name: str, encoding: str) -> Callable[[bytes], bool]:
    """A function that says whether a message decodes to its last byte."""
    store = _store_of(types)
    read = store.get_msgdef(name)
    by_head = {b"\0\1": read.deserialize_cdr_le, b"\0\0": read.deserialize_cdr_be}

    def fits(payload: bytes) -> bool:
        try:
            store.max_sequence_length = max(len(payload), 1)
            if encoding == MessageEncoding.ROS1:
                store.deserialize_ros1(payload, name)
                return True
            _, end = by_head[payload[:2]](payload[4:], 0, read.cls, store)
        except Exception:  # noqa: BLE001, RUF100  # of bytes that are no such message
            return False
        left = payload[4 + end :]
        return 4 + end <= len(payload) and len(left) < _FILL and not any(left)

    return fits


def _layout(types: Types, name: str) -> tuple[Any, ...]:
    """The kinds of values in a message, in order: the same for definitions that differ in names only."""
    from rosbags.interfaces import Nodetype

    def flat(kind: Any) -> Any:
        node, inner = kind
        if node == Nodetype.NAME:
            return tuple(part for _, field in types[inner][1] for part in flat(field))
        return (inner[0],) if node == Nodetype.BASE else ((node, flat(inner[0]), inner[1]),)

    return flat((Nodetype.NAME, name))  # type: ignore[no-any-return]


# Messages that are compressed one by one.


_MAX_MESSAGE_BYTES: Final = 2**28


def is_packed(payload: bytes) -> bool:
    """Whether a CDR message is compressed, as rosbag2 does with all of a bag; others begin with a zero byte."""
    return payload.startswith(ZSTD)


def unpacked(payload: bytes, most: int = _MAX_MESSAGE_BYTES) -> bytes:
    """A CDR message, decompressed to at most ``most`` bytes if it is compressed. Raises ValueError."""
    if not is_packed(payload):
        return payload
    from mcaptrack.sources.ingest.decompression import unzstd

    return unzstd(payload, min(most, _MAX_MESSAGE_BYTES))
