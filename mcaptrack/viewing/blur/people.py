"""Which parts of each picture to hide: all boxes of people that a log has, and where people must be in between.

Boxes in space are projected into the pictures of calibrated cameras. Boxes grow with the time since a person was seen.

Letters: N boxes, M pictures.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from mcaptrack import log
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import seconds_to_ns
from mcaptrack.schema import DETECTIONS, TRACKS, Frame, Schema
from mcaptrack.schema.classes import class_names
from mcaptrack.schema.framing import frame_times, joined_parts
from mcaptrack.sources import foreign
from mcaptrack.sources.cameras import Camera
from mcaptrack.viewing.blur.classes import people_among
from mcaptrack.viewing.blur.in_space import people_in_space
from mcaptrack.viewing.blur.pieces import MAX_GAP_S, Pieces, around, joined, linked

#: Detections count for this many pictures before and after their own.
_NEAR_PICTURES: Final = 2.5
_NEAR_S: Final = 0.25
#: Margins at each side: shares of width and height, at least some pixels; and the growth, in widths, for each second
#: without a row.
_MARGIN: Final = (0.2, 0.1)
_LEAST_PX: Final = 4.0
_GROWTH_PER_S: Final = 0.5
#: Pictures without a frame of boxes within this time were not looked at.
_LOOKED_S: Final = 1.0
#: Boxes are computed for this many pictures at once.
_BLOCK: Final = 512


class HiddenPeople:
    """The boxes to hide in the pictures of a channel, from all detections, tracks and labels of its cameras, and from
    all boxes in space.

    Attributes
    ----------
    topics : tuple of str
        The channels of boxes.
    frame_ns : (F,) of int64
        Times of frames of boxes, also of empty ones, sorted.
    problems : tuple of str
        Boxes in space that can't be placed in these pictures, and why.
    """

    def __init__(self, opened: log.Log, of_pictures: Sequence[Camera], pictures: str) -> None:
        self._at_ns = opened.times(pictures)
        usual = float(np.median(np.diff(self._at_ns))) if len(self._at_ns) > 1 else 0.0
        near_ns = round(min(_NEAR_PICTURES * usual, seconds_to_ns(_NEAR_S)))
        pieces, topics, looked = [], [], [np.empty(0, np.int64)]
        known = {topic for one in of_pictures for topic in (*one.topics, one.truth, one.boxes or "")}
        for topic in sorted(known & set(opened.channels)):
            found = _people(opened, topic)
            if found is not None:
                schema, frame_ns, t_ns, track_id, boxes = found
                pieces.append(_linked(t_ns, track_id, boxes) if schema is TRACKS else around(t_ns, boxes, near_ns))
                topics.append(topic)
                looked.append(frame_ns)
        problems: list[str] = []
        self._in_space = people_in_space(opened, pictures, problems)
        self.problems = tuple(problems)
        self.topics = tuple(sorted({*topics, *(one.topic for one in self._in_space)}))
        self.frame_ns = np.unique(np.concatenate([*looked, *(one.frame_ns for one in self._in_space)]))
        self._pieces = joined(pieces, 4)
        self._block: tuple[int, list[Floats]] = (-1, [])

    def unseen(self) -> int:
        """The number of pictures without a frame of boxes near their time: no detector saw them."""
        if not len(self.frame_ns):
            return len(self._at_ns)
        after = np.searchsorted(self.frame_ns, self._at_ns)
        near = np.stack([np.maximum(after - 1, 0), np.minimum(after, len(self.frame_ns) - 1)])
        apart_ns = np.abs(self.frame_ns[near] - self._at_ns).min(axis=0)
        return int((apart_ns > seconds_to_ns(_LOOKED_S)).sum())

    def unplaced(self) -> int:
        """The number of pictures into which boxes in space can't be projected: where the camera was is not known."""
        return max((int(one.unknown().sum()) for one in self._in_space), default=0)

    def at(self, number: int) -> Floats:
        """The boxes (N, 4) to hide in a picture, with their margins; quick for pictures in order."""
        block = number // _BLOCK
        if self._block[0] != block:
            self._block = block, self.between(block * _BLOCK, (block + 1) * _BLOCK)
        return self._block[1][number % _BLOCK]

    def between(self, first: int, last: int) -> list[Floats]:
        """The boxes (N, 4) to hide in each of the pictures ``first`` to before ``last``, with their margins."""
        at_ns = self._at_ns[first:last]
        parts = [self._pieces.at(at_ns), *(one.between(first, last) for one in self._in_space)]
        picture, boxes, unseen_s = (np.concatenate([part[n] for part in parts]) for n in range(3))
        order = np.argsort(picture, kind="stable")
        boxes = _with_margins(boxes, unseen_s)[order]
        bounds = np.searchsorted(picture[order], np.arange(len(at_ns) + 1))
        return [boxes[a:b] for a, b in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)]


def _people(opened: log.Log, topic: str) -> tuple[Schema, Ints, Ints, Ints, Floats] | None:
    """The boxes of people in a channel: schema, times of its frames, and times, track ids and boxes of the rows.

    None for other channels, and for those without boxes in pixels.
    """
    channel = opened.channels[topic]
    names = class_names(channel.metadata)
    frames: Sequence[Frame]
    schema = next((one for one in (TRACKS, DETECTIONS) if channel.holds(one)), None)
    if schema is not None:
        frames = opened.frame_columns(topic, schema)
    elif foreign.holds_detections(channel):
        schema, found = DETECTIONS, foreign.named_detections(opened, topic)
        frames, names = found.frames, names | found.classes
    else:
        return None
    parts: list[tuple[Ints, Ints, Floats]] = []
    for _, _, part in joined_parts(schema, frames):
        boxes, rows = columns_to_boxes(part.rows), part.rows
        known = np.isfinite(boxes).all(axis=1) & (boxes[:, 2:] > 0).all(axis=1)
        known &= people_among(rows["class_id"], names)
        number = rows["track_id"] if schema is TRACKS else np.zeros(len(rows), np.int64)
        parts.append((part.row_ns[known], number[known].astype(np.int64), boxes[known]))
    if not sum(len(part[0]) for part in parts) and not _has_pixels(schema, frames):
        return None
    t_ns, number, boxes = (np.concatenate([part[n] for part in parts]) for n in range(3)) if parts else _NOTHING
    return schema, frame_times(frames), t_ns, number, boxes


_NOTHING: Final = (np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 4)))


def _has_pixels(schema: Schema, frames: Sequence[Frame]) -> bool:
    """Whether any row has a box in pixels, or there are no rows at all: nothing was found in the pictures."""
    parts = [columns_to_boxes(part.rows) for _, _, part in joined_parts(schema, frames)]
    return not sum(map(len, parts)) or any(bool(np.isfinite(boxes).all(axis=1).any()) for boxes in parts)


def _linked(t_ns: Ints, track_id: Ints, boxes: Floats) -> Pieces:
    """Tracks as pieces; beyond their ends, boxes move with their middles and keep their size."""
    return linked(t_ns, track_id, boxes, boxes[:, :2] + boxes[:, 2:] / 2)


def _with_margins(boxes: Floats, unseen_s: Floats) -> Floats:
    """Boxes (N, 4) that reach beyond the given ones, more so the longer nothing was seen."""
    growth = _GROWTH_PER_S * np.minimum(unseen_s, MAX_GAP_S)[:, None] * boxes[:, 2:3]
    margin = np.maximum(boxes[:, 2:] * _MARGIN, _LEAST_PX) + growth
    return np.concatenate([boxes[:, :2] - margin, boxes[:, 2:] + 2 * margin], axis=1)
