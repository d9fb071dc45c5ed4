"""Decode payloads to messages with their fields as attributes, in all supported encodings.

Protobuf is decoded with the classes of the Foxglove schemas, JSON directly, ROS 1 and ROS 2 messages (by rosbags) with
the definition in the log, so that modified versions of a message are read, too.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from graphlib import TopologicalSorter
from math import nan
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from mcap.well_known import MessageEncoding

from mcaptrack import foxglove
from mcaptrack.errors import McaptrackError, in_one_line
from mcaptrack.geometry.clocks import NS_PER_S, utc_ns
from mcaptrack.schema.names import plain_name
from mcaptrack.sources.foreign.definitions import MessageType, ros_types, unpacked

#: Payload -> message. Malformed payloads raise various exceptions, which the caller handles.
Unpack = Callable[[bytes], Any]

#: The supported message encodings.
ENCODINGS: Final = (MessageEncoding.Protobuf, MessageEncoding.JSON, MessageEncoding.ROS1, MessageEncoding.CDR)
_MAX_DESCRIPTOR: Final = 4 * 2**20
#: Encodings of DDS that aren't read, by how messages begin.
_OTHER_CDR: Final = {
    bytes([0, number + little]): name
    for number, name in ((2, "PL_CDR"), (6, "XCDR2"), (8, "delimited XCDR2"), (10, "PL_CDR of XCDR2"))
    for little in (0, 1)
}


def decoder_with_errors(
    kind: MessageType, convert: Callable[[Any], Any], unpack: Unpack | None = None
) -> Callable[[bytes], Any]:
    """A function that decodes a payload and applies ``convert``; all failures become McaptrackError.

    ``unpack`` decodes payloads in another way than ``unpacker``. Raises McaptrackError as that does.
    """
    unpack = unpack or unpacker(kind)

    def decode(payload: bytes) -> Any:
        try:
            return convert(unpack(payload))
        except McaptrackError:
            raise
        except Exception as error:  # untrusted bytes in third-party parsers, which raise various exceptions
            why = f"it has no field {error.name!r}" if isinstance(error, AttributeError) else in_one_line(error)
            name = kind.name or kind.encoding
            raise McaptrackError(f"{len(payload)} bytes are not a {name} message ({why:.120})") from None

    return decode


def unpacker(kind: MessageType) -> Unpack:
    """A function that decodes messages of this type. Raises McaptrackError if the type is not supported."""
    plain = plain_name(kind.name)
    if kind.encoding == MessageEncoding.Protobuf and plain.startswith("foxglove."):
        return lambda payload: foxglove.unpack(plain, payload)
    if kind.encoding == MessageEncoding.Protobuf:
        return protobuf_class(kind).FromString  # type: ignore[no-any-return]
    if kind.encoding == MessageEncoding.JSON:
        return lambda payload: json.loads(payload, object_hook=lambda fields: SimpleNamespace(**fields))
    if kind.encoding in (MessageEncoding.ROS1, MessageEncoding.CDR):
        return _ros_unpacker(kind)
    raise McaptrackError(
        f"{kind.name} in the encoding {kind.encoding or 'unknown'!r} is not read; {', '.join(ENCODINGS)} are"
    )


def protobuf_class(kind: MessageType) -> Any:
    """The class of a message of protobuf, by the definition in the log."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message_factory import GetMessageClass

    try:
        if len(kind.schema) > _MAX_DESCRIPTOR:
            raise ValueError(f"it has {len(kind.schema)} bytes")
        listed = FileDescriptorSet.FromString(kind.schema).file
        files = {file.name: file for file in listed}
        if len(files) < len(listed):
            raise ValueError("it has two files of the same name")
        imports = {name: [other for other in file.dependency if other in files] for name, file in files.items()}
        pool = DescriptorPool()
        for name in TopologicalSorter(imports).static_order():  # the order of the files in a log is free
            pool.Add(files[name])
        return GetMessageClass(pool.FindMessageTypeByName(kind.name.lstrip(".").replace("/", ".")))
    except Exception as error:  # a third-party parser that raises various exceptions
        why = f"the log's definition of it can't be understood ({in_one_line(error, 120)})"
        raise McaptrackError(f"{kind.name} can't be read: {why}") from None


def _ros_unpacker(kind: MessageType) -> Unpack:
    store, name = ros_types(kind)
    is_cdr = kind.encoding == MessageEncoding.CDR
    read = store.deserialize_cdr if is_cdr else store.deserialize_ros1

    def unpack(payload: bytes) -> Any:
        payload = unpacked(payload) if is_cdr else payload
        if is_cdr and payload[:2] in _OTHER_CDR:
            raise ValueError(f"its bytes are {_OTHER_CDR[payload[:2]]}; CDR of version 1 is read")
        # A sequence can't have more members than the message has bytes; one of an empty type could be endless.
        store.max_sequence_length = max(len(payload), 1)
        return read(payload, name)

    return unpack


# Values of fields of decoded messages, in all encodings: times, whole numbers, texts and bytes.


_RFC3339: Final = re.compile(r"(\d{4}-\d\d-\d\d)[Tt ](\d\d:\d\d:\d\d)(?:\.(\d{1,9})\d*)?(Z|z|[+-]\d\d:\d\d)", re.ASCII)
_LIMIT_NS: Final = 2**63


def stamp_of(message: Any) -> int:
    """The stamp of a message in nanoseconds: ``timestamp`` in Foxglove messages, ``header.stamp`` in ROS messages."""
    return time_of(message.timestamp if hasattr(message, "timestamp") else message.header.stamp)


def time_of(stamp: Any) -> int:
    """A time in nanoseconds. Raises ValueError for what is none."""
    if isinstance(stamp, str):
        match = _RFC3339.fullmatch(stamp)
        if not match:
            raise ValueError(f"{stamp[:40]!r} is no time")
        day, clock, fraction, zone = match.groups()
        t_ns = utc_ns(f"{day}T{clock}{zone.upper()}", fraction or "")
    else:
        t_ns = _time_field(stamp, "sec", "secs", "seconds") * NS_PER_S + _time_field(
            stamp, "nsec", "nsecs", "nanosec", "nanos"
        )
    if not -_LIMIT_NS <= t_ns < _LIMIT_NS:
        raise ValueError(f"its stamp, {t_ns} ns, is out of range")
    return t_ns


def _time_field(stamp: Any, *names: str) -> int:
    for name in names:
        if hasattr(stamp, name):
            return integer(getattr(stamp, name))
    raise ValueError(f"its stamp has no {names[0]}")


def integer(value: Any) -> int:
    """A whole number of 64 bits; raises ValueError for anything else."""
    if isinstance(value, float) and value.is_integer():  # JSON of writers without an integer type
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not -_LIMIT_NS <= value < _LIMIT_NS:
        raise ValueError(f"{str(value)[:40]!r} where a whole number belongs")
    return int(value)


def number(value: Any) -> float:
    """A number, also from the texts that stand for NaN and infinity in JSON; null is NaN."""
    if isinstance(value, bool):
        raise ValueError("true or false where a number belongs")
    return nan if value is None else float(value)


def text(value: Any) -> str:
    """A text; raises ValueError for anything else."""
    if not isinstance(value, str):
        raise ValueError(f"a {type(value).__name__} where text belongs")
    return value


def to_bytes(value: Any) -> bytes:
    """Bytes of a field: from protobuf, ROS (an array), JSON (base64, or numbers from ROS bridges)."""
    if isinstance(value, str):
        return base64.b64decode(value, validate=True)
    if isinstance(value, np.ndarray):
        return value.tobytes()
    if isinstance(value, bytes | list):
        return bytes(value)
    raise ValueError(f"a {type(value).__name__} where bytes belong")


def frame_named(message: Any) -> str:
    """Return the frame of reference that a message names; "" if it names none."""
    holder = message.header if hasattr(message, "header") else message
    return str(getattr(holder, "frame_id", "")).removeprefix("/")
