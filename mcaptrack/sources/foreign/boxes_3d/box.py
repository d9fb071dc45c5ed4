"""A 3D box as a message states it, and the parts of messages that several families share."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from math import isfinite, nan
from typing import Any, Final, NamedTuple

from mcaptrack.sources.foreign.decoding import integer, stamp_of, text

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

_ORIGIN: Final[Vector] = (0.0, 0.0, 0.0)
#: A velocity or size that isn't stated.
UNKNOWN_VECTOR: Final[Vector] = (nan, nan, nan)
#: A quaternion of zeros: the orientation isn't stated.
UNSTATED: Final[Quaternion] = (0.0, 0.0, 0.0, 0.0)
_WORD: Final = re.compile(r"[^\W\d_][\w-]*")
_PERCENT: Final = re.compile(r"(?<![\w.])(\d{1,3}(?:\.\d+)?)\s*%")
#: A number from 0 to 1 that isn't a distance, speed or angle.
_SHARE: Final = re.compile(r"(?<![\w.-])(?:0?\.\d+|1\.0+|[01]\.)(?![\w.])(?!\s*(?:c?m|km|m?s|deg|rad|kph)\b|\s*°)")


class Box3d(NamedTuple):
    """A box in a frame: its centre, size along its own axes in metres, and orientation (x, y, z, w).

    ``stamp_ns`` is 0 and ``frame_id`` "" where the message states none. ``source_id`` is a number or a text, None where
    there is none. ``velocity`` is along the axes of the frame in m/s. ``has_heading`` is false where the message says
    that the orientation is not known.
    """

    stamp_ns: int
    frame_id: str
    centre: Vector
    orientation: Quaternion
    size: Vector
    class_name: str = ""
    score: float = nan
    source_id: int | str | None = None
    velocity: Vector = UNKNOWN_VECTOR
    has_heading: bool = True


@dataclass
class Message3d:
    """The boxes of a message, and a count of its other parts for each description of them.

    ``is_measured`` is false for a message that only takes boxes away from a viewer: nothing was measured then.
    """

    stamp_ns: int
    frame_id: str
    boxes: list[Box3d] = field(default_factory=list)
    ignored: Counter[str] = field(default_factory=Counter)
    is_measured: bool = True


def head_of(message: Any) -> tuple[int, str]:
    """Stamp in ns and frame of a message with a ROS header."""
    return stamp_of(message), text(message.header.frame_id)


def own_head(message: Any, around: tuple[int, str]) -> tuple[int, str]:
    """Stamp and frame of a part of a message: its own, or, where it states no frame, those of the message around it."""
    stamp_ns, frame_id = head_of(message)
    return (stamp_ns or around[0], frame_id) if frame_id else around


def vector(value: Any) -> Vector:
    """A point or vector; the origin where it is missing, as protobuf leaves out zeros."""
    return _ORIGIN if value is None else (number(value.x), number(value.y), number(value.z))


def quaternion(value: Any) -> Quaternion:
    """A quaternion; zeros where it is missing."""
    return UNSTATED if value is None else (number(value.x), number(value.y), number(value.z), number(value.w))


def number(value: Any) -> float:
    """A number, also from the texts that stand for NaN and infinity in JSON; null is NaN."""
    if isinstance(value, bool):
        raise ValueError("true or false where a number belongs")
    return nan if value is None else float(value)


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


def named(names: Mapping[int, str], label: Any) -> str:
    """The name of a class by its number in an enumeration; the number where it has none."""
    return names.get(integer(label), str(integer(label)))


def enumeration(message: Any, prefix: str = "") -> Mapping[int, str]:
    """The names of classes by number that the recorded definition of a message states, as constants with a prefix.

    Names are in lower case, without the prefix; "unknown" is "". Empty where there are no constants, as in JSON.
    """
    kind: Any = type(message)
    return _constants(kind, prefix)


@lru_cache(maxsize=64)
def _constants(kind: Any, prefix: str) -> Mapping[int, str]:
    whole = {name: value for name, value in vars(kind).items() if name.isupper() and isinstance(value, int)}
    names = {value: name.removeprefix(prefix).lower() for name, value in whole.items() if name.startswith(prefix)}
    return {value: "" if name == "unknown" else name for value, name in names.items()}


def words_of(said: str) -> tuple[str, float]:
    """The class and the score in a text beside a box: "car 0.93" -> "car", 0.93; "" and NaN where there are none."""
    word = _WORD.search(said)
    percent, share = _PERCENT.search(said), _SHARE.search(said)
    score = float(percent.group(1)) / 100 if percent else float(share.group()) if share else nan
    return (word.group() if word else ""), score if score <= 1 else nan
