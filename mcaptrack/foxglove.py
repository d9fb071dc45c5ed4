"""Rows as Foxglove sees them: pictures, annotations drawn over them, and the layout that switches these on.

Rules that viewers hold (Foxglove, Lichtblick) and that shape what is written here: an annotation belongs to a picture
if its timestamp is the picture's to the nanosecond; a picture is shown only if every annotation topic that is switched
on has something for it, so every frame gets a message and an empty one holds a point that can't be seen; annotation
topics are off until a layout switches them on.

Letters: N boxes, P points.
"""

from __future__ import annotations

import colorsys
import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from math import isnan
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.clock import NS_PER_S
from mcaptrack.errors import McaptrackError

if TYPE_CHECKING:
    from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations

Floats = NDArray[np.float64]
Rgba = tuple[float, float, float, float]

VIDEO: Final = "foxglove.CompressedVideo"
IMAGE: Final = "foxglove.CompressedImage"
ANNOTATIONS: Final = "foxglove.ImageAnnotations"
LOG: Final = "foxglove.Log"
#: Schemas whose messages are pictures.
PICTURES: Final = (VIDEO, IMAGE)

# Okabe and Ito's colours, which stay apart for colour-blind people, without black; then again, lighter and darker.
_HUES: Final = ("E69F00", "56B4E9", "009E73", "F0E442", "0072B2", "D55E00", "CC79A7")
_SHADES: Final = (1.0, 1.35, 0.7)
_LIGHT: Final = 0.55
_INVISIBLE: Final = (0.0, 0.0, 0.0, 0.0)


@cache
def _message_class(schema_name: str) -> Any:
    """foxglove.X -> the generated class."""
    from importlib import import_module

    name = schema_name.removeprefix("foxglove.")
    return getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)


@cache
def schema_record(schema_name: str) -> tuple[str, str, bytes]:
    """Name, encoding and data of the MCAP schema record of a foxglove schema, with all that it imports."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    files = FileDescriptorSet()
    done: set[str] = set()

    def add(descriptor: Any) -> None:
        for dependency in descriptor.dependencies:
            if dependency.name not in done:
                done.add(dependency.name)
                add(dependency)
        descriptor.CopyToProto(files.file.add())

    add(_message_class(schema_name).DESCRIPTOR.file)
    return schema_name, "protobuf", files.SerializeToString(deterministic=True)


def _stamp(message: Any, t_ns: int) -> None:
    message.timestamp.seconds, message.timestamp.nanos = divmod(t_ns, NS_PER_S)


def pack_picture(schema_name: str, t_ns: int, frame_id: str, image_format: str, data: bytes) -> bytes:
    """A CompressedVideo or CompressedImage message."""
    message = _message_class(schema_name)(frame_id=frame_id, format=image_format, data=data)
    _stamp(message, t_ns)
    payload: bytes = message.SerializeToString(deterministic=True)
    return payload


def unpack(schema_name: str, payload: bytes) -> Any:
    """A message of a foxglove schema. Raises McaptrackError if it is none."""
    from google.protobuf.message import DecodeError

    message = _message_class(schema_name)()
    try:
        message.ParseFromString(payload)
    except DecodeError:
        raise McaptrackError(f"{len(payload)} bytes are no {schema_name} message") from None
    return message


def unpack_picture(schema_name: str, payload: bytes) -> tuple[str, bytes]:
    """Format and data of a CompressedVideo or CompressedImage message. Raises McaptrackError if it is none."""
    message = unpack(schema_name, payload)
    return message.format, message.data


@cache
def colour(identity: int, alpha: float = 1.0) -> Rgba:
    """The colour of an identity, the same in every panel."""
    base, shade = _HUES[identity % len(_HUES)], _SHADES[identity // len(_HUES) % len(_SHADES)]
    red, green, blue = (int(base[at : at + 2], 16) / 255 for at in (0, 2, 4))
    hue, light, saturation = colorsys.rgb_to_hls(red, green, blue)
    return (*colorsys.hls_to_rgb(hue, min(light * shade, 0.85), saturation), alpha)


class Path(NamedTuple):
    """A line through points (P, 2) in pixels, with the opacity of each point (P,)."""

    identity: int
    points: Floats
    opacity: Sequence[float]


def pack_annotations(
    t_ns: int,
    boxes: Floats,
    identities: Sequence[int] | None,
    paths: Iterable[Path] = (),
    thickness: float = 2.0,
    rgba: Rgba | None = None,
) -> bytes:
    """An ImageAnnotations message for one picture: boxes (N, 4) with their ids, and lines.

    ``rgba`` draws everything in one colour; otherwise each identity has its own. ``identities`` None draws no ids.
    """
    message: ImageAnnotations = _message_class(ANNOTATIONS)()
    _stamp(message, t_ns)
    loop, strip, dots = 2, 3, 1  # PointsAnnotation.LINE_LOOP, LINE_STRIP, POINTS
    corners = np.stack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], axis=1).round(2).tolist()
    names = [0] * len(corners) if identities is None else identities
    for ((x1, y1), (x2, y2)), name in zip(corners, names, strict=True):
        if isnan(x1 + y1 + x2 + y2):  # no box is known
            continue
        shade = rgba or colour(name)
        _line(message, t_ns, loop, ((x1, y1), (x2, y1), (x2, y2), (x1, y2)), shade, thickness)
        if identities is not None:
            text = message.texts.add(text=str(name), font_size=12)
            text.timestamp.CopyFrom(message.timestamp)
            text.position.x, text.position.y = x1, y1
            is_light = 0.299 * shade[0] + 0.587 * shade[1] + 0.114 * shade[2] > _LIGHT
            _paint(text.text_color, (0.0, 0.0, 0.0, 1.0) if is_light else (1.0, 1.0, 1.0, 1.0))
            _paint(text.background_color, (*shade[:3], 0.6))
    for path in paths:
        points = path.points.round(2).tolist()
        line = _line(message, t_ns, strip, points, rgba or colour(path.identity), thickness)
        for opacity in path.opacity:
            _paint(line.outline_colors.add(), (*(rgba or colour(path.identity))[:3], opacity))
    if not message.points:
        _line(message, t_ns, dots, ((0.0, 0.0),), _INVISIBLE, 1.0)
    payload: bytes = message.SerializeToString(deterministic=True)
    return payload


def _line(message: Any, t_ns: int, kind: int, points: Iterable[Sequence[float]], rgba: Rgba, thickness: float) -> Any:
    line = message.points.add(type=kind, thickness=thickness)
    line.timestamp.CopyFrom(message.timestamp)
    for x, y in points:
        line.points.add(x=x, y=y)
    _paint(line.outline_color, rgba)
    return line


def _paint(target: Any, rgba: Rgba) -> None:
    target.r, target.g, target.b, target.a = rgba


def layout(image_topic: str, annotation_topics: Mapping[str, bool], plots: Sequence[str]) -> bytes:
    """A layout file for Foxglove and Lichtblick: the picture with these annotation topics (on or off), and plots.

    Pictures don't wait for annotations (``synchronize`` is off), so the video always shows.
    """
    image = {
        "imageMode": {
            "imageTopic": image_topic,
            "synchronize": False,
            "annotations": {topic: {"visible": shown} for topic, shown in annotation_topics.items()},
        },
        "synchronize": False,
        "syncedTopics": dict.fromkeys(annotation_topics, False),
    }
    plot = {
        "paths": [
            {"value": value, "enabled": True, "timestampMethod": "receiveTime", "label": value} for value in plots
        ],
        "showLegend": True,
        "isSynced": True,
        "xAxisVal": "timestamp",
    }
    tree = {
        "configById": {"Image!picture": image, "Plot!positions": plot, "SourceInfo!log": {}},
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "first": "Image!picture",
            "second": {"direction": "column", "first": "Plot!positions", "second": "SourceInfo!log"},
            "splitPercentage": 70,
        },
    }
    return json.dumps(tree, indent=1, sort_keys=True).encode() + b"\n"


def pack_log(t_ns: int, level: str, name: str, words: str) -> bytes:
    """A Log message; ``level`` is "INFO", "WARNING" or "ERROR", ``name`` says whom it comes from."""
    kind = _message_class(LOG)
    message = kind(level=kind.Level.Value(level), name=name, message=words)
    _stamp(message, t_ns)
    payload: bytes = message.SerializeToString(deterministic=True)
    return payload
