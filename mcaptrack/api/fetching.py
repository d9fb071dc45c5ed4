"""Read single messages of a log by their place in the file, and pictures by their time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.api.columns import times_of
from mcaptrack.errors import McaptrackError
from mcaptrack.log import Log

_NEEDED: Final = ("chunk_offset", "message_offset")


class FetchedMessage(NamedTuple):
    """A message of a log.

    Attributes
    ----------
    topic : str
        The channel.
    t_ns, publish_ns : int
        When it was recorded and when it was sent, in nanoseconds.
    sequence : int
        The number that its sender gave it; 0 if none.
    payload : bytes
        Its bytes as they were recorded.

    """

    topic: str
    t_ns: int
    publish_ns: int
    sequence: int
    payload: bytes


def fetch_message(log: Log, row: Mapping[str, Any]) -> FetchedMessage:
    """Read the message that a row points to; see ``Recording.fetch``."""
    if isinstance(row, np.void):
        row = {name: row[name] for name in row.dtype.names or ()}
    missing = [name for name in _NEEDED if name not in row]
    if missing:
        raise McaptrackError(f"a row without {', '.join(missing)} does not say where its message is; rows of frames do")
    chunk, offset = (_whole(row[name]) for name in _NEEDED)
    file = row.get("file")
    part = next((part for part in log.parts if file in (None, part.path.name)), None)
    if part is None or offset is None:
        raise McaptrackError(f"{log.path}: the row points to byte {offset} of {file}, which is not part of this log")
    old = f"{part.path} has no such message at this place; export its tables again"
    try:
        topic, message = part.message_at(chunk, offset)
    except McaptrackError as error:
        raise McaptrackError(f"{old} ({error})") from None
    stated = (row.get("topic", topic), _whole(row.get("t_ns", message.t_ns)))
    if stated != (topic, message.t_ns):
        raise McaptrackError(old)
    return FetchedMessage(topic, message.t_ns, message.publish_ns, message.sequence, message.payload)


def _whole(value: Any) -> int | None:
    """Return a whole number of a table; pandas makes floats of columns in which some are missing."""
    return None if value is None or value != value else int(value)  # noqa: PLR0124  # NaN is not itself


def shown_pictures(opened: Log, topic: str, times: Sequence[int] | NDArray[Any]) -> dict[int, int]:
    """The numbers of the pictures that are shown at these times, and how often each is asked for."""
    wanted = times_of(times, "`times=`")
    at = np.searchsorted(opened.times(topic), wanted, "right") - 1
    if len(at) and at.min() < 0:
        first = int(wanted[at.argmin()])
        raise McaptrackError(f"{opened.path}: {topic} has no picture at {first} ns; its first picture is later")
    numbers, counts = np.unique(at, return_counts=True)
    return dict(zip(numbers.tolist(), counts.tolist(), strict=True))
