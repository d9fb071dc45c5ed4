"""Values of fields of decoded messages, in all encodings: times, whole numbers, texts and bytes."""

from __future__ import annotations

import base64
import re
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np

from mcaptrack.geometry.clocks import NS_PER_S

_RFC3339: Final = re.compile(r"(\d{4}-\d\d-\d\d)[Tt ](\d\d:\d\d:\d\d)(?:\.(\d{1,9})\d*)?(Z|z|[+-]\d\d:\d\d)", re.ASCII)
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_LIMIT_NS: Final = 2**63


def stamp_of(message: Any) -> int:
    """The stamp of a message in nanoseconds: ``timestamp`` in Foxglove messages, ``header.stamp`` in ROS messages."""
    stamp = message.timestamp if hasattr(message, "timestamp") else message.header.stamp
    if isinstance(stamp, str):
        found = _RFC3339.fullmatch(stamp)
        if not found:
            raise ValueError(f"{stamp[:40]!r} is no time")
        day, clock, fraction, zone = found.groups()
        passed = datetime.fromisoformat(f"{day}T{clock}{zone.upper()}") - _EPOCH
        t_ns = (passed.days * 86400 + passed.seconds) * NS_PER_S + int((fraction or "").ljust(9, "0"))
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
