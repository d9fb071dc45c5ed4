"""Foxglove's schemas: their records in a log, and single messages."""

from __future__ import annotations

from functools import cache
from typing import Any, Final

from mcap.well_known import SchemaEncoding

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.clocks import NS_PER_S

VIDEO: Final = "foxglove.CompressedVideo"
IMAGE: Final = "foxglove.CompressedImage"
ANNOTATIONS: Final = "foxglove.ImageAnnotations"
SCENE: Final = "foxglove.SceneUpdate"
TRANSFORM: Final = "foxglove.FrameTransform"
LOG: Final = "foxglove.Log"
CALIBRATION: Final = "foxglove.CameraCalibration"


@cache
def message_class(schema_name: str) -> Any:
    """The generated class of a schema "foxglove.X"."""
    from importlib import import_module

    name = schema_name.removeprefix("foxglove.")
    return getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)


@cache
def schema_record(schema_name: str) -> tuple[str, str, bytes]:
    """Name, encoding and data of the MCAP schema record of a Foxglove schema, with its imports."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    files = FileDescriptorSet()
    done: set[str] = set()

    def add(descriptor: Any) -> None:
        for dependency in descriptor.dependencies:
            if dependency.name not in done:
                done.add(dependency.name)
                add(dependency)
        descriptor.CopyToProto(files.file.add())

    add(message_class(schema_name).DESCRIPTOR.file)
    return schema_name, SchemaEncoding.Protobuf, files.SerializeToString(deterministic=True)


def pack_picture(schema_name: str, t_ns: int, frame_id: str, image_format: str, data: bytes) -> bytes:
    """A CompressedVideo or CompressedImage message.

    ``schema_name`` says which of the two. ``t_ns`` is its time in ns, ``frame_id`` its frame of reference; ``data`` is
    the picture in ``image_format``, as in "h264" or "jpeg".
    """
    return pack_stamped(message_class(schema_name)(frame_id=frame_id, format=image_format, data=data), t_ns)


def pack_transform(t_ns: int, parent_frame_id: str, frame_id: str) -> bytes:
    """A FrameTransform message: a frame with the pose of its parent.

    ``t_ns`` is its time in ns; ``frame_id`` and ``parent_frame_id`` name the two frames.
    """
    message = message_class(TRANSFORM)(parent_frame_id=parent_frame_id, child_frame_id=frame_id)
    message.translation.SetInParent()
    message.rotation.w = 1.0
    return pack_stamped(message, t_ns)


def pack_stamped(message: Any, t_ns: int) -> bytes:
    """A message of a Foxglove schema with this time."""
    message.timestamp.seconds, message.timestamp.nanos = divmod(t_ns, NS_PER_S)
    payload: bytes = message.SerializeToString(deterministic=True)
    return payload


def pack_log(t_ns: int, level: str, name: str, text: str) -> bytes:
    """A Log message; ``level`` is "DEBUG", "INFO", "WARNING" or "ERROR", ``name`` is that of the source.

    ``t_ns`` is its time in ns, and ``text`` what it says.
    """
    kind = message_class(LOG)
    return pack_stamped(kind(level=kind.Level.Value(level), name=name, message=text), t_ns)


def unpack(schema_name: str, payload: bytes) -> Any:
    """Parse a message of a Foxglove schema. Raises McaptrackError if it is none."""
    from google.protobuf.message import DecodeError

    message = message_class(schema_name)()
    try:
        message.ParseFromString(payload)
    except DecodeError:
        raise McaptrackError(f"{len(payload)} bytes are no {schema_name} message") from None
    return message
