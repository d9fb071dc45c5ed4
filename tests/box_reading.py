"""The boxes of single messages, read from a log as those of any."""

from __future__ import annotations

from collections.abc import Iterable
from math import nan
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from mcaptrack import log
from mcaptrack.contracts import Box, Box3d
from mcaptrack.schema.names import plain_name
from mcaptrack.sources import fixed_frame
from mcaptrack.sources.foreign import MessageType, reading_of
from mcaptrack.sources.foreign.boxes import _special
from mcaptrack.sources.foreign.fields import Message3d
from mcaptrack.sources.foreign.things import read_channel
from tests.logs import recorder


def _values(column: Any) -> list[Any]:
    """A column as values of Python, with one NaN, so that equal boxes are equal."""
    one = lambda value: nan if value != value else value  # noqa: E731
    return [tuple(map(one, value)) if isinstance(value, list) else one(value) for value in column.tolist()]


def boxes_in(opened: log.Log, topic: str) -> list[Any]:
    """What each message of a channel holds: a list of ``Box``, or a ``Message3d``."""
    reading = reading_of(opened, topic) or _special(plain_name(opened.channel(topic).schema_name))
    if reading is None:
        return list(fixed_frame.named_detections(opened, topic).frames)  # raises an error that says so
    log_ns, parts, _ = read_channel(opened, topic, reading.read, reading.paths)
    out: list[Any] = [None] * len(log_ns)
    for which, seen in parts:
        boxes = seen.boxes if reading.in_space else seen
        rows = list(zip(*(_values(column) for column in boxes[1:]), strict=True))
        for place, number in enumerate(which.tolist()):
            own = [row for row, of in zip(rows, boxes.message.tolist(), strict=True) if of == place]
            if not reading.in_space:
                out[number] = [Box(*sides, score, name) for sides, score, name in own]
                continue
            held = [Box3d(*row) for row in own]
            out[number] = Message3d(int(seen.stamp_ns[place]), held, dict(seen.ignored), bool(seen.is_measured[place]))
    return out


def boxes_of(kind: MessageType, payload: bytes) -> Any:
    """What a message holds; raises McaptrackError if it can't be read."""
    return boxes_of_each(kind, [payload])[0]


def boxes_of_each(kind: MessageType, payloads: Iterable[bytes]) -> list[Any]:
    """What each of the messages of a log holds; None for those that can't be read."""
    with TemporaryDirectory() as folder:
        path = Path(folder, "a.mcap")
        with recorder(path) as writer:
            channel = writer.add_channel("/t", (kind.name, kind.schema_encoding, kind.schema), kind.encoding)
            for number, payload in enumerate(payloads, 1):
                writer.add_message(channel, number, payload, number)
        with log.read(path) as opened:
            return boxes_in(opened, "/t")


def recorded(messages: Iterable[tuple[int, Message3d]]) -> fixed_frame.Recorded3d:
    """The boxes of messages at these log times."""
    times = [(t_ns, message.columns()) for t_ns, message in messages]
    log_ns = np.array([t_ns for t_ns, _ in times], np.int64)
    return fixed_frame.recorded(log_ns, [(np.array([number]), seen) for number, (_, seen) in enumerate(times)])
