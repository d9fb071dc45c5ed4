"""Messages of pictures with another picture in them: all other fields stay as they were recorded."""

from __future__ import annotations

import base64
import dataclasses
import json
from collections.abc import Callable
from typing import Any

import numpy as np

from mcaptrack import foxglove
from mcaptrack.errors import McaptrackError
from mcaptrack.sources.foreign.decoding import MessageType, ros_types

#: Payload, new data, and the new format ("" for the same one) -> payload.
Replace = Callable[[bytes, bytes, str], bytes]


def picture_replacer(kind: MessageType) -> Replace:
    """A function that puts another picture into messages of this type, in any encoding that pictures are read in.

    Raises McaptrackError if the type is not supported; the returned function takes only payloads that have been
    decoded before.
    """
    if kind.encoding == "protobuf" and kind.name.startswith("foxglove."):
        return lambda payload, data, word: _protobuf(kind.name, payload, data, word)
    if kind.encoding == "json":
        return _json
    if kind.encoding in ("ros1", "cdr"):
        return _ros(kind)
    raise McaptrackError(f"{kind.name} in the encoding {kind.encoding or 'unknown'!r} is not written")


def _protobuf(name: str, payload: bytes, data: bytes, word: str) -> bytes:
    message = foxglove.unpack(name, payload)
    message.data = data
    if word:
        message.format = word
    packed: bytes = message.SerializeToString(deterministic=True)
    return packed


def _json(payload: bytes, data: bytes, word: str) -> bytes:
    fields = json.loads(payload)
    fields["data"] = base64.b64encode(data).decode() if isinstance(fields["data"], str) else list(data)
    if word:
        fields["format"] = word
    return json.dumps(fields, separators=(",", ":")).encode()


def _ros(kind: MessageType) -> Replace:
    store, name = ros_types(kind)
    read, write = (
        (store.deserialize_ros1, store.serialize_ros1)
        if kind.encoding == "ros1"
        else (store.deserialize_cdr, store.serialize_cdr)
    )

    def replace(payload: bytes, data: bytes, word: str) -> bytes:
        store.max_sequence_length = len(payload)
        changed: dict[str, Any] = {"data": np.frombuffer(data, np.uint8)} | ({"format": word} if word else {})
        return bytes(write(dataclasses.replace(read(payload, name), **changed), name))

    return replace
