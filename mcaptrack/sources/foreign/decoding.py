"""Payload bytes -> a message whose fields are attributes, whatever it was written with.

Protobuf is read with the classes of the Foxglove schemas, JSON as it is, ROS 1 and ROS 2 by the definition that the
log carries for them, so that a robot's own version of a message is read too. rosbags does that.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

from mcaptrack import foxglove
from mcaptrack.errors import McaptrackError

#: Payload -> message. What is malformed raises some exception: only its caller knows what it was to be.
Unpack = Callable[[bytes], Any]

#: The message encodings that are read.
ENCODINGS: Final = ("protobuf", "json", "ros1", "cdr")
#: A definition that is longer describes no picture; parsing one takes time.
_MAX_DEFINITION: Final = 2**20
_ROS_NAME: Final = re.compile(r"([A-Za-z]\w*)/(?:msg/)?([A-Za-z]\w*)", re.ASCII)
_IDL_HEAD: Final = re.compile(r"^=+\r?\nIDL: .*\r?\n", re.MULTILINE)


class MessageType(NamedTuple):
    """What a channel says of its messages: its schema record and its message encoding."""

    name: str
    schema_encoding: str
    schema: bytes
    encoding: str


def plain_name(schema_name: str) -> str:
    """The name that a message goes by in all encodings: sensor_msgs/msg/Image and sensor_msgs/Image are one, and so
    are foxglove_msgs/msg/RawImage and foxglove.RawImage.
    """
    found = _ROS_NAME.fullmatch(schema_name)
    if not found:
        return schema_name
    package, name = found.groups()
    return f"foxglove.{name}" if package == "foxglove_msgs" else f"{package}/{name}"


def guarded(kind: MessageType, convert: Callable[[Any], Any]) -> Callable[[bytes], Any]:
    """Payload -> what ``convert`` makes of the message. Whatever goes wrong is the payload's fault: McaptrackError.

    Raises McaptrackError as ``unpacker`` does.
    """
    unpack = unpacker(kind)

    def decode(payload: bytes) -> Any:
        try:
            return convert(unpack(payload))
        except McaptrackError:
            raise
        except Exception as error:  # bytes of strangers through parsers of others: no list of exceptions is complete
            why = " ".join(str(error).split())[:120] or type(error).__name__
            raise McaptrackError(f"{len(payload)} bytes are no {kind.name} message ({why})") from None

    return decode


def unpacker(kind: MessageType) -> Unpack:
    """What reads the messages of a channel. Raises McaptrackError for what can't be read, whatever the messages are."""
    if kind.encoding == "protobuf" and kind.name.startswith("foxglove."):
        return lambda payload: foxglove.unpack(kind.name, payload)
    if kind.encoding == "json":
        return lambda payload: json.loads(payload, object_hook=lambda fields: SimpleNamespace(**fields))
    if kind.encoding in ("ros1", "cdr"):
        return _ros_unpacker(kind)
    raise McaptrackError(
        f"{kind.name} in the encoding {kind.encoding or 'unknown'!r} is not read; {', '.join(ENCODINGS)} are"
    )


def _ros_unpacker(kind: MessageType) -> Unpack:
    from rosbags.typesys import Stores

    found = _ROS_NAME.fullmatch(kind.name)
    if not found:
        raise McaptrackError(f"{kind.name!r} is no name of a ROS message; those are like sensor_msgs/Image")
    name = "{}/msg/{}".format(*found.groups())
    is_ros1 = kind.encoding == "ros1"
    store = _typestore(name, kind, Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
    read = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr

    def unpack(payload: bytes) -> Any:
        # No sequence has more members than its message has bytes; one of an empty type could go on forever.
        store.max_sequence_length = len(payload)
        return read(payload, name)

    return unpack


def _typestore(name: str, kind: MessageType, known: Any) -> Any:
    """The types of a channel: by its own definition, by that with ROS's own types added, or by ROS's own alone."""
    from rosbags.typesys import Stores, get_typestore

    why = "the log has no definition of it, and it is none of ROS's own"
    for base in (Stores.EMPTY, known):
        store = get_typestore(base)
        try:
            types = _types(name, kind)
            if types:
                store.register(types)
            store.get_msgdef(name)
        except Exception as error:  # noqa: BLE001, RUF100  # of a parser that fails in its own many ways
            if kind.schema:
                why = f"the log's definition of it can't be understood ({' '.join(str(error).split())[:120]})"
        else:
            return store
    raise McaptrackError(f"{kind.name} can't be read: {why}")


def _types(name: str, kind: MessageType) -> Any:
    """The types that a schema record defines: the one of its name, and those that it is made of."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    text = kind.schema.decode("utf-8", "replace")
    if len(text) > _MAX_DEFINITION:
        raise ValueError(f"it has {len(text)} characters")
    if not text.strip():
        return {}
    if kind.schema_encoding in ("ros2idl", "omgidl"):
        types: dict[str, Any] = {}
        for part in _IDL_HEAD.split(text):
            if part.strip():
                types |= get_types_from_idl(part)
        return types
    return get_types_from_msg(text, name)
