"""Which parts of each picture to hide: all boxes of people that a log has, and where people must be in between.

A person who is missed for a moment has to stay hidden. So every track is interpolated over its gaps and continued
before its first and after its last row, along its motion, and boxes grow with the time since they were seen.

Letters: N boxes, M pictures, S pieces of tracks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.geometry.ragged import group_index, ragged_range, run_ends, run_starts
from mcaptrack.schema import DETECTIONS, TRACKS, Frame, Schema
from mcaptrack.schema.classes import UNKNOWN, class_name, class_names, is_person
from mcaptrack.schema.framing import frame_times, joined_parts
from mcaptrack.sources import foreign
from mcaptrack.sources.cameras import Camera

#: Tracks are interpolated over gaps of this length, and continued for this long at either end.
_MAX_GAP_S: Final = 5.0
_AHEAD_S: Final = 1.0
#: The motion at an end of a track is that of this time.
_MOTION_S: Final = 0.5
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


class _Pieces(NamedTuple):
    """Pieces of tracks between two times (S,), with the boxes (S, 4) at both, and whether there was a row at each."""

    first_ns: Ints
    last_ns: Ints
    first: Floats
    last: Floats
    is_row: tuple[Bools, Bools]


class HiddenPeople:
    """The boxes to hide in the pictures of a camera, from all its channels of detections, tracks and labels.

    Attributes
    ----------
    topics : tuple of str
        The channels of boxes.
    frame_ns : (F,) of int64
        Times of frames of boxes, also of empty ones, sorted.
    """

    def __init__(self, opened: log.Log, camera: Camera, picture_ns: Ints) -> None:
        self._at_ns = picture_ns
        usual = float(np.median(np.diff(picture_ns))) if len(picture_ns) > 1 else 0.0
        self._near_ns = round(min(_NEAR_PICTURES * usual, seconds_to_ns(_NEAR_S)))
        pieces, topics, looked = [], [], [np.empty(0, np.int64)]
        for topic in sorted({*camera.topics, camera.truth, camera.boxes or ""} & set(opened.channels)):
            found = _people(opened, topic)
            if found is not None:
                schema, frame_ns, t_ns, track_id, boxes = found
                pieces.append(_linked(t_ns, track_id, boxes) if schema is TRACKS else self._still(t_ns, boxes))
                topics.append(topic)
                looked.append(frame_ns)
        self.topics = tuple(topics)
        self.frame_ns = np.unique(np.concatenate(looked))
        self._pieces = _joined(pieces)
        self._block: tuple[int, list[Floats]] = (-1, [])

    def unseen(self) -> int:
        """The number of pictures without a frame of boxes near their time: no detector saw them."""
        if not len(self.frame_ns):
            return len(self._at_ns)
        after = np.searchsorted(self.frame_ns, self._at_ns)
        near = np.stack([np.maximum(after - 1, 0), np.minimum(after, len(self.frame_ns) - 1)])
        apart_ns = np.abs(self.frame_ns[near] - self._at_ns).min(axis=0)
        return int((apart_ns > seconds_to_ns(_LOOKED_S)).sum())

    def at(self, number: int) -> Floats:
        """The boxes (N, 4) to hide in a picture, with their margins; quick for pictures in order."""
        block = number // _BLOCK
        if self._block[0] != block:
            self._block = block, self.between(block * _BLOCK, (block + 1) * _BLOCK)
        return self._block[1][number % _BLOCK]

    def between(self, first: int, last: int) -> list[Floats]:
        """The boxes (N, 4) to hide in each of the pictures ``first`` to before ``last``, with their margins."""
        at_ns = self._at_ns[first:last]
        if not len(at_ns):
            return []
        near = (self._pieces.first_ns <= at_ns[-1]) & (self._pieces.last_ns >= at_ns[0])
        begin, end, start, stop, (is_row, is_row_too) = _chosen(self._pieces, near)
        low, high = np.searchsorted(at_ns, begin, "left"), np.searchsorted(at_ns, end, "right")
        of, picture = group_index(high - low), ragged_range(low, high - low)
        t_ns = at_ns[picture]
        share = (t_ns - begin[of]) / np.maximum(end - begin, 1)[of]
        boxes = start[of] + share[:, None] * (stop - start)[of]
        since = np.where(is_row[of], t_ns - begin[of], np.inf)
        until = np.where(is_row_too[of], end[of] - t_ns, np.inf)
        boxes = _with_margins(boxes, np.minimum(since, until) / NS_PER_S)
        order = np.argsort(picture, kind="stable")
        bounds = np.searchsorted(picture[order], np.arange(len(at_ns) + 1))
        boxes = boxes[order]
        return [boxes[a:b] for a, b in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)]

    def _still(self, t_ns: Ints, boxes: Floats) -> _Pieces:
        """Detections as pieces around their time."""
        halves = [(t_ns - self._near_ns, t_ns, False, True), (t_ns, t_ns + self._near_ns, True, False)]
        return _joined(
            [
                _Pieces(first, last, boxes, boxes, (np.full(len(t_ns), one), np.full(len(t_ns), other)))
                for first, last, one, other in halves
            ]
        )


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
    for _, _, joined in joined_parts(schema, frames):
        boxes, rows = columns_to_boxes(joined.rows), joined.rows
        known = np.isfinite(boxes).all(axis=1) & (boxes[:, 2:] > 0).all(axis=1)
        classes = rows["class_id"].astype(np.int64)
        wanted = [one for one in np.unique(classes).tolist() if one == UNKNOWN or is_person(class_name(one, names))]
        known &= np.isin(classes, wanted)
        number = rows["track_id"] if schema is TRACKS else np.zeros(len(rows), np.int64)
        parts.append((joined.row_ns[known], number[known].astype(np.int64), boxes[known]))
    if not sum(len(part[0]) for part in parts) and not _has_pixels(schema, frames):
        return None
    t_ns, number, boxes = (np.concatenate([part[n] for part in parts]) for n in range(3)) if parts else _NOTHING
    return schema, frame_times(frames), t_ns, number, boxes


_NOTHING: Final = (np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 4)))


def _has_pixels(schema: Schema, frames: Sequence[Frame]) -> bool:
    """Whether any row has a box in pixels, or there are no rows at all: nothing was found in the pictures."""
    parts = [columns_to_boxes(joined.rows) for _, _, joined in joined_parts(schema, frames)]
    return not sum(map(len, parts)) or any(bool(np.isfinite(boxes).all(axis=1).any()) for boxes in parts)


def _linked(t_ns: Ints, track_id: Ints, boxes: Floats) -> _Pieces:
    """Tracks as pieces between consecutive rows, with one before the first row of each and one after the last."""
    order = np.lexsort((t_ns, track_id))
    t_ns, track_id, boxes = t_ns[order], track_id[order], boxes[order]
    starts = run_starts(track_id, times=t_ns, max_gap=seconds_to_ns(_MAX_GAP_S))
    first, last = np.flatnonzero(starts), np.flatnonzero(run_ends(starts))
    inner = np.flatnonzero(~run_ends(starts))
    yes = np.ones(len(inner), np.bool_)
    between = _Pieces(t_ns[inner], t_ns[inner + 1], boxes[inner], boxes[inner + 1], (yes, yes))
    run = np.cumsum(starts) - 1
    motion_ns, ahead_ns = seconds_to_ns(_MOTION_S), seconds_to_ns(_AHEAD_S)
    # The row that is half a second after the first one of its track, and the one that is half a second before the last.
    later = np.minimum(_first_at(run, t_ns, first, t_ns[first] + motion_ns), last)
    earlier = np.maximum(_first_at(run, t_ns, last, t_ns[last] - motion_ns), first)
    before = boxes[first] - _motion(t_ns, boxes, first, later) * _AHEAD_S
    after = boxes[last] + _motion(t_ns, boxes, earlier, last) * _AHEAD_S
    no, yes = np.zeros(len(first), np.bool_), np.ones(len(first), np.bool_)
    return _joined(
        [
            between,
            _Pieces(t_ns[first] - ahead_ns, t_ns[first], before, boxes[first], (no, yes)),
            _Pieces(t_ns[last], t_ns[last] + ahead_ns, boxes[last], after, (yes, no)),
        ]
    )


def _first_at(run: Ints, t_ns: Ints, rows: Ints, wanted_ns: Ints) -> Ints:
    """For some rows, the index of the first row of the same run at a time or later; the one after the run if none."""
    if not len(rows):
        return rows
    base = int(t_ns.min())
    length = int(t_ns.max()) - base + seconds_to_ns(_MAX_GAP_S)
    keys = run.astype(np.float64) * length + (t_ns - base)
    found = np.searchsorted(keys, run[rows].astype(np.float64) * length + (wanted_ns - base))
    return found.astype(np.int64)


def _motion(t_ns: Ints, boxes: Floats, one: Ints, other: Ints) -> Floats:
    """The motion of boxes between two rows in px/s, of the same size."""
    passed = np.maximum(t_ns[other] - t_ns[one], 1)[:, None] / NS_PER_S
    out: Floats = (boxes[other] - boxes[one]) / passed
    out[:, :2] += out[:, 2:] / 2
    out[:, 2:] = 0
    out[other == one] = 0
    return out


def _with_margins(boxes: Floats, unseen_s: Floats) -> Floats:
    """Boxes (N, 4) that reach beyond the given ones, more so the longer nothing was seen."""
    growth = _GROWTH_PER_S * np.minimum(unseen_s, _MAX_GAP_S)[:, None] * boxes[:, 2:3]
    margin = np.maximum(boxes[:, 2:] * _MARGIN, _LEAST_PX) + growth
    return np.concatenate([boxes[:, :2] - margin, boxes[:, 2:] + 2 * margin], axis=1)


def _chosen(pieces: _Pieces, which: Bools) -> _Pieces:
    first, last, start, stop, (one, other) = pieces
    return _Pieces(first[which], last[which], start[which], stop[which], (one[which], other[which]))


def _joined(parts: Sequence[_Pieces]) -> _Pieces:
    if not parts:
        none = np.empty(0, np.int64)
        return _Pieces(none, none, np.empty((0, 4)), np.empty((0, 4)), (np.empty(0, np.bool_), np.empty(0, np.bool_)))
    rows = tuple(np.concatenate([part.is_row[n] for part in parts]) for n in range(2))
    first, last, start, stop = (np.concatenate([part[n] for part in parts]) for n in range(4))
    return _Pieces(first, last, start, stop, (rows[0], rows[1]))
