"""Messages of any schema as columns, or, where they can't be read so, flat one by one: fields by their paths.

Times become timestamps, durations a whole number of nanoseconds (``..._ns``), messages in lists dicts; bytes stay
bytes, so that pictures and point clouds can be left out of tables.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np
from mcap.well_known import MessageEncoding

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.notices import warn
from mcaptrack.sources.foreign.decoding import (
    decoder_with_errors,
    frame_named,
    protobuf_class,
    unpacker,
)
from mcaptrack.sources.foreign.definitions import MessageType, defined, is_defined, ros_types

if TYPE_CHECKING:
    from mcaptrack.columns import ProtobufColumns, RosColumns

__all__ = ["message_decoder", "message_type_of"]

T = TypeVar("T")
Path = tuple[str, ...]

_MAX_DEPTH: Final = 32
_LIMIT_NS: Final = 2**63
#: If none of the first messages of a channel can be read, and these are more, it is of another type.
_MOST_UNREAD: Final = 10_000
#: Times in protobuf, and the field names of those in ROS 1, ROS 2 and JSON of bridges.
_OF_PROTOBUF: Final = ("google.protobuf.Timestamp", "google.protobuf.Duration")
TIMES: Final = ({"secs", "nsecs"}, {"sec", "nsec"}, {"sec", "nanosec"}, {"seconds", "nanos"})


def message_type_of(opened: log.Log, topic: str) -> MessageType:
    """The message type of a channel of a log; a warning says which definition fits if the log has none."""
    channel = opened.channel(topic)
    index = opened.part(channel.topic).index
    schema = index.schemas.get(index.channels[channel.id].schema_id)
    fields = (schema.name, schema.encoding, bytes(schema.data)) if schema else ("", "", b"")
    kind = MessageType(*fields, channel.message_encoding)
    return kind if is_defined(kind) else _defined_by_messages(opened, topic, kind)


@log.kept
def _defined_by_messages(opened: log.Log, topic: str, kind: MessageType) -> MessageType:
    kind, origin, doubts = defined(kind, (message.payload for message in opened.messages(topic)))
    text = f"{opened.path}: {topic} does not say what {kind.name} is"
    warn(f"{text}; {doubts or f'its definition is {origin}'}", "definitions")
    return kind


def frame_of(opened: log.Log, topic: str) -> str:
    """Return the frame of the first message of a channel; "" if there is none, or it can't be read."""
    try:
        decode = decoder_with_errors(message_type_of(opened, topic), frame_named)
        return next((str(decode(message.payload)) for message in opened.messages(topic)), "")
    except McaptrackError:
        return ""


class UnreadMessages:
    """The messages of ``total`` that can't be read: their number, and the time of the first, and why."""

    def __init__(self, where: str, total: int) -> None:
        self._where, self._total = where, total
        self._seen = self._unread = self._lost = 0
        self._first = (0, "")
        self._damage = ""

    def count(self, messages: int) -> None:
        """Count messages that are read next."""
        self._seen += messages

    def add(self, t_ns: int, why: str) -> None:
        """Add a message. Raises McaptrackError if no message can be read, or none of the first ones."""
        self._first = min(self._first, (t_ns, why)) if self._unread else (t_ns, why)
        self._unread += 1
        if self._unread == self._total or _MOST_UNREAD < self._unread == self._seen:
            raise McaptrackError(str(self))

    def lose(self, messages: int, why: str) -> None:
        """Count messages in a damaged chunk. Raises McaptrackError if all are."""
        self._damage = self._damage or why
        self._lost += messages
        if self._lost == self._total:
            raise McaptrackError(f"{self._where}: all of its {self._lost} messages are in damaged chunks ({why})")

    def warn(self, so: str) -> None:
        """Warn of them, if there are any, and ``so`` of what follows."""
        if self._unread:
            warn(f"{self}; {so}", "lost")
        if self._lost:
            where = f"{self._lost} of {self._total} messages are in damaged chunks ({self._damage})"
            warn(f"{self._where}: {where}; {so}", "lost")

    def __str__(self) -> str:
        if not self._unread:
            return ""
        many = f"; {self._unread} of {self._seen} messages are like this" if self._unread > 1 else ""
        return f"{self._where} at {self._first[0]} ns: {self._first[1]}{many}"


def payload_decoder(opened: log.Log, topic: str, make: Callable[[MessageType], T]) -> T:
    """The decoder of payloads that ``make`` makes for the type of a channel. Raises McaptrackError, with the topic, if
    that type isn't read.
    """
    try:
        return make(message_type_of(opened, topic))
    except McaptrackError as error:
        raise McaptrackError(f"{opened.path}: {topic}: {error}") from None


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


def column_reader(kind: MessageType, wanted: Callable[[Path], bool], blobs: bool) -> RosColumns | ProtobufColumns:
    """A reader of all messages of a batch at once. Raises ``columns.Unsupported`` where messages need ``flattener``."""
    from mcaptrack.columns import ProtobufColumns, RosColumns, Unsupported

    if kind.encoding == MessageEncoding.Protobuf:
        return ProtobufColumns(protobuf_class(kind).DESCRIPTOR, wanted, blobs)
    if kind.encoding not in (MessageEncoding.ROS1, MessageEncoding.CDR):
        raise Unsupported(f"messages in {kind.encoding} have no types")
    store, name = ros_types(kind)
    return RosColumns(store.fielddefs, name, kind.encoding, wanted, blobs)


def flattener(kind: MessageType) -> Callable[[bytes], dict[Path, Any]]:
    """A function that flattens a payload to a row: path of each field -> value.

    Raises McaptrackError if messages of this type are not supported; the returned function raises McaptrackError for
    malformed payloads.
    """
    return decoder_with_errors(kind, lambda message: dict(_walk(message, ())), _unpacker(kind))


def _unpacker(kind: MessageType) -> Callable[[bytes], Any]:
    """As ``unpacker``, but with dicts of JSON, and messages of Foxglove by their definition in the log."""
    if kind.encoding == MessageEncoding.JSON:
        return json.loads
    return protobuf_class(kind).FromString if kind.encoding == MessageEncoding.Protobuf else unpacker(kind)


def _walk(value: Any, path: Path) -> Iterator[tuple[Path, Any]]:
    fields = _fields(value)
    if fields is None or (path and _is_time(value, fields)):
        title, plain = _plain(path[-1] if path else "value", value, len(path))
        yield (*path[:-1], title), plain
        return
    if len(path) > _MAX_DEPTH:
        raise ValueError(f"it is more than {_MAX_DEPTH} messages deep")
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
        return {name: getattr(value, name) for name, field in fields.items() if "ClassVar" not in str(field.type)}
    return None


def _member(message: Any, field: Any) -> Any:
    """A field of a protobuf message: None if it is not set, enumerations by name, maps as lists of entries."""
    if field.has_presence and not message.HasField(field.name):
        return None
    value = getattr(message, field.name)
    if field.enum_type is None:
        return [{"key": key, "value": value[key]} for key in value] if hasattr(value, "items") else value
    names = field.enum_type.values_by_number

    def named(number: int) -> str:
        return str(names[number].name) if number in names else str(number)

    return named(value) if isinstance(value, int) else [named(number) for number in value]


def _is_time(value: Any, fields: Mapping[str, Any]) -> bool:
    """Whether a message is a time or duration. JSON says no types: its times are those that 64 bits hold."""
    if isinstance(value, dict):
        return _nanoseconds(fields) is not None
    descriptor = getattr(value, "DESCRIPTOR", None)
    return set(fields) in TIMES if descriptor is None else descriptor.full_name in _OF_PROTOBUF


def _nanoseconds(fields: Mapping[str, Any]) -> int | None:
    """A time or duration in nanoseconds; None if fields are none, or if 64 bits don't hold it."""
    if set(fields) not in TIMES:
        return None
    values = [*fields.values()]  # seconds come first
    if next(iter(fields)).startswith("n"):
        values.reverse()
    if not all(isinstance(value, int | np.integer) and not isinstance(value, bool) for value in values):
        return None
    t_ns = int(values[0]) * NS_PER_S + int(values[1])
    return t_ns if -_LIMIT_NS < t_ns < _LIMIT_NS else None


def _plain(name: str, value: Any, depth: int) -> tuple[str, Any]:
    """A field as Arrow takes it: its name, and a number, a text, bytes, a time, or lists and dicts of these."""
    if depth > _MAX_DEPTH:
        raise ValueError(f"it is more than {_MAX_DEPTH} messages deep")
    fields = _fields(value)
    if fields is not None:
        if not _is_time(value, fields):
            return name, dict(_plain(inner, member, depth + 1) for inner, member in fields.items())
        t_ns, kind = (
            _nanoseconds(fields),
            str(getattr(getattr(value, "DESCRIPTOR", None), "name", type(value).__name__)),
        )
        if kind.endswith("Duration"):
            return f"{name}_ns", t_ns
        return name, None if t_ns is None else np.datetime64(t_ns, "ns")
    if isinstance(value, np.generic):
        return name, value.item()
    if isinstance(value, np.ndarray):
        is_bytes = value.dtype.itemsize == 1 and value.dtype.kind in "ui"
        return name, value.tobytes() if is_bytes else value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return name, [_plain("", member, depth + 1)[1] for member in value]
    return name, value
