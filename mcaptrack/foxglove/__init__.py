"""Rows as Foxglove and Lichtblick see them: pictures, what is drawn over them and on the ground, and layouts."""

from mcaptrack.foxglove.annotations import Annotations
from mcaptrack.foxglove.colours import colour, colours
from mcaptrack.foxglove.messages import (
    ANNOTATIONS,
    IMAGE,
    LOG,
    PICTURES,
    SCENE,
    TRANSFORM,
    VIDEO,
    message_class,
    pack_log,
    pack_picture,
    pack_transform,
    schema_record,
    unpack,
    unpack_picture,
)
from mcaptrack.foxglove.scene import Figure, Scene

__all__ = [
    "ANNOTATIONS",
    "IMAGE",
    "LOG",
    "PICTURES",
    "SCENE",
    "TRANSFORM",
    "VIDEO",
    "Annotations",
    "Figure",
    "Scene",
    "colour",
    "colours",
    "message_class",
    "pack_log",
    "pack_picture",
    "pack_transform",
    "schema_record",
    "unpack",
    "unpack_picture",
]
