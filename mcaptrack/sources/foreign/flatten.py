"""Flatten messages of any schema to rows: every field with a value, or a list of values, by its path.

Times and durations (seconds and nanoseconds) become an integer in nanoseconds; lists of messages become JSON; bytes are
kept as bytes, so that pictures and point clouds can be excluded from tables.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final
from weakref import WeakKeyDictionary

import numpy as np
from mcap.well_known import MessageEncoding

from mcaptrack import log
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.notices import warn
from mcaptrack.sources.foreign.decoding import decoder_with_errors, protobuf_unpacker, unpacker
from mcaptrack.sources.foreign.definitions import MessageType, defined, is_defined

Path = tuple[str, ...]
Value = bool | int | float | str | bytes | list[Any] | None

_MAX_DEPTH: Final = 32
#: The field names of times in ROS 1, ROS 2, JSON of bridges, and protobuf.
_TIMES: Final = (("secs", "nsecs"), ("sec", "nsec"), ("sec", "nanosec"), ("seconds", "nanos"))


class _Messages(tuple[Any, ...]):
    """A list of messages, which becomes JSON even if it is empty, so that a column keeps its type."""


#: The definitions of open logs that were found by their messages, by topic.
_DEFINED: Final[WeakKeyDictionary[log.Log, dict[str, MessageType]]] = WeakKeyDictionary()


def message_type_of(opened: log.Log, topic: str) -> MessageType:
    """The message type of a channel of a log; a warning says which definition fits if the log has none."""
    channel = opened.channel(topic)
    index = opened.part(channel.topic).index
    schema = index.schemas.get(index.channels[channel.id].schema_id)
    fields = (schema.name, schema.encoding, bytes(schema.data)) if schema else ("", "", b"")
    kind = MessageType(*fields, channel.message_encoding)
    if is_defined(kind):
        return kind
    kinds = _DEFINED.setdefault(opened, {})
    if topic not in kinds:
        payloads = (message.payload for message in opened.messages(topic))
        kinds[topic], origin, doubts = defined(kind, payloads)
        warn(
            f"{opened.path}: {topic} does not say what {kind.name} is; {doubts or f'its definition is {origin}'}",
            "definitions",
        )
    return kinds[topic]


def message_decoder(opened: log.Log, topic: str) -> Callable[[bytes], Any]:
    """A function that decodes the messages of a channel: a view is a ROS message in a recording of ROS 2.

    Raises McaptrackError as ``unpacker`` does; so does the returned function for malformed payloads.
    """
    return decoder_with_errors(message_type_of(opened, topic), lambda message: message)


def recorded_decoder(kind: MessageType) -> Callable[[bytes], Any]:
    """A function that decodes messages by their definition in the log: messages of protobuf and of ROS, dicts of JSON.

    Raises McaptrackError as ``unpacker`` does; so does the returned function for malformed payloads.
    """
    return decoder_with_errors(kind, lambda message: message, _unpacker(kind))


def flattener(kind: MessageType) -> Callable[[bytes], dict[Path, Value]]:
    """A function that flattens a payload to a row: path of each field -> value.

    Raises McaptrackError if messages of this type are not supported; the returned function raises McaptrackError for
    malformed payloads.
    """
    return decoder_with_errors(kind, lambda message: dict(_walk(message, ())), _unpacker(kind))


def _unpacker(kind: MessageType) -> Callable[[bytes], Any]:
    if kind.encoding == MessageEncoding.JSON:
        return json.loads
    if kind.encoding == MessageEncoding.Protobuf:
        return protobuf_unpacker(kind)
    return unpacker(kind)


def _walk(value: Any, path: Path) -> Iterator[tuple[Path, Value]]:
    if len(path) > _MAX_DEPTH:
        raise ValueError(f"it is more than {_MAX_DEPTH} messages deep")
    fields = _fields(value)
    if fields is None:
        yield path or ("value",), _value(value)
        return
    t_ns = _nanoseconds(fields)
    if t_ns is not None and path:
        yield (*path[:-1], path[-1] + "_ns"), t_ns
        return
    for name, member in fields.items():
        yield from _walk(member, (*path, name))


def _fields(value: Any) -> Mapping[str, Any] | None:
    """The fields of a message in any encoding; None for other values."""
    if isinstance(value, dict):
        return value
    if hasattr(value, "DESCRIPTOR"):
        return {field.name: _member(value, field) for field in value.DESCRIPTOR.fields}
    fields = getattr(value, "__dataclass_fields__", None)
    if fields is not None:  # the fields include constants, which are marked as ClassVar
        kinds = {name: str(field.type) for name, field in fields.items()}
        return {name: _ros(getattr(value, name), kind) for name, kind in kinds.items() if "ClassVar" not in kind}
    return None


def _ros(value: Any, kind: str) -> Any:
    """A field of a ROS message."""
    return _Messages(value) if isinstance(value, list) and "__" in kind else value


def _member(message: Any, field: Any) -> Any:
    """A field of a protobuf message: None if it is not set, enumerations by name."""
    if field.has_presence and not message.HasField(field.name):
        return None
    value = getattr(message, field.name)
    if field.message_type is not None and isinstance(value, Sequence):
        return _Messages(value)
    if field.enum_type is None:
        return value
    names = field.enum_type.values_by_number

    def named(number: int) -> str:
        return str(names[number].name) if number in names else str(number)

    return named(value) if isinstance(value, int) else [named(number) for number in value]


def _nanoseconds(fields: Mapping[str, Any]) -> int | None:
    for seconds, nanoseconds in _TIMES:
        if set(fields) == {seconds, nanoseconds}:
            parts = [fields[seconds], fields[nanoseconds]]
            if all(isinstance(part, int | np.integer) and not isinstance(part, bool) for part in parts):
                return int(parts[0]) * NS_PER_S + int(parts[1])
    return None


def _value(value: Any) -> Value:
    if value is None or isinstance(value, bool | str | bytes | int | float):
        return value
    if isinstance(value, np.generic):
        return value.item()  # type: ignore[no-any-return]
    if isinstance(value, np.ndarray):
        return value.tobytes() if value.dtype.itemsize == 1 and value.dtype.kind in "ui" else value.tolist()
    if hasattr(value, "items"):  # a map of protobuf
        return _json({str(key): member for key, member in value.items()})
    members = list(value)
    if not isinstance(value, _Messages) and all(
        isinstance(member, bool | int | float | str | np.generic) for member in members
    ):
        return [member.item() if isinstance(member, np.generic) else member for member in members]
    return _json(members)


def _json(value: Any) -> str:
    return json.dumps(_plain(value, 0), ensure_ascii=False, separators=(",", ":"), allow_nan=False)


def _plain(value: Any, depth: int) -> Any:
    """A message as JSON data; non-finite numbers as text, bytes as their number."""
    if depth > _MAX_DEPTH:
        raise ValueError(f"it is more than {_MAX_DEPTH} messages deep")
    fields = _fields(value)
    if fields is not None:
        return {name: _plain(member, depth + 1) for name, member in fields.items()}
    if isinstance(value, float | np.floating) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if hasattr(value, "items"):
        return {str(key): _plain(member, depth + 1) for key, member in value.items()}
    return [_plain(member, depth + 1) for member in value]
