"""Leave out rows of people who are outside of the picture: interpolated and coasting boxes that the camera can't see.

A track goes on while its person is occluded, and its row then stands where the person is expected. Outside of the
picture, where people come and go unseen, such a row is no statement about that picture.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Bools
from mcaptrack.geometry.boxes import columns_to_boxes, share_inside
from mcaptrack.notices import warn
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame, Rows, Schema
from mcaptrack.schema.frame_columns import FrameCollector
from mcaptrack.schema.framing import JoinedFrames, filtered_rows, frame_numbers, has_any, joined_parts
from mcaptrack.sources.pictures import size_of_pictures

#: Width and height of pictures in pixels; None where they aren't known.
PictureSize = tuple[int, int] | None
#: Channels by topic: the schema and the frames of each.
Channels = Mapping[str, tuple[Schema, Sequence[Frame]]]

#: A person is outside of the picture if a smaller share of the box is inside.
_LEAST_INSIDE: Final = 0.5
#: Boxes are taken to be in pixels of the pictures if no more than this share of those that were detected is outside:
#: other software may have seen larger pictures than those in the log.
_MOST_OUTSIDE: Final = 0.05


def picture_size(opened: log.Log, topic: str | None) -> PictureSize:
    """Return the size of the pictures of a channel; None if there are none that can be decoded."""
    try:
        return size_of_pictures(opened, topic) if topic else None
    except McaptrackError:
        return None


def without_unseen(channels: Channels, picture_size: Callable[[], PictureSize]) -> Channels:
    """Return the outputs of a stage without rows that are not observed and lie outside of the picture.

    ``picture_size`` is called if there are rows that are not observed. Predictions go with their rows of online tracks.
    A warning counts the rows.
    """
    out = dict(channels)
    for topic, (schema, frames) in channels.items():
        found = _find_unseen(frames, picture_size) if schema is TRACKS else None
        if found is None:
            continue
        is_unseen, count = found
        rows = "row is" if count == 1 else "rows are"
        warn(f"{topic}: {count:,} {rows} left out, outside of the picture and without a detection", "left-out")
        stem, _, name = topic.rpartition("/")
        predictions = f"{stem}/predictions"
        if name == "online" and predictions in channels:
            gone: set[tuple[int, int]] = set()
            for low, _, joined in joined_parts(schema, frames):
                gone.update(_keys(joined, low, is_unseen(joined.rows)))
            made = channels[predictions][1]
            out[predictions] = PREDICTIONS, _without(made, gone)
        out[topic] = schema, _seen(frames, is_unseen)
    return out


def _seen(frames: Sequence[Frame], is_unseen: Callable[[Rows], Bools]) -> Sequence[Frame]:
    return filtered_rows(TRACKS, frames, lambda joined: ~is_unseen(joined.rows))


def _find_unseen(
    frames: Sequence[Frame], picture_size: Callable[[], PictureSize]
) -> tuple[Callable[[Rows], Bools], int] | None:
    """Return what masks the rows that are not observed and lie outside of the picture, and their number.

    None if there are none.
    """

    def may_be_unseen(rows: Rows) -> Bools:
        return np.asarray(~rows["observed"] & np.isfinite(columns_to_boxes(rows)).all(axis=1))

    if not has_any(TRACKS, frames, may_be_unseen) or (size := picture_size()) is None:
        return None

    def is_outside(rows: Rows) -> Bools:  # false without a box
        return np.asarray(share_inside(columns_to_boxes(rows), *size) < _LEAST_INSIDE)

    outside = observed = unseen = 0
    for _, _, joined in joined_parts(TRACKS, frames):
        outer, there = is_outside(joined.rows), joined.rows["observed"]
        outside, observed = outside + int((outer & there).sum()), observed + int(there.sum())
        unseen += int((outer & ~there).sum())
    if not unseen or outside > _MOST_OUTSIDE * observed:
        return None
    return lambda rows: np.asarray(is_outside(rows) & ~rows["observed"]), unseen


def _keys(joined: JoinedFrames, low: int, mask: Bools | slice = slice(None)) -> Iterator[tuple[int, int]]:
    """The number of the frame and the id of each row that ``mask`` chooses; ``low`` is the number of the first one."""
    return zip((joined.frame[mask] + low).tolist(), joined.rows["track_id"][mask].tolist(), strict=True)


def _without(frames: Sequence[Frame], gone: Collection[tuple[int, int]]) -> Sequence[Frame]:
    """Return forecasts without those of these frames and ids."""
    out, numbers = FrameCollector(PREDICTIONS), frame_numbers(frames)
    for low, high, joined in joined_parts(PREDICTIONS, frames):
        kept = np.array([key not in gone for key in _keys(joined, low)], bool)
        ends = np.concatenate([[0], kept.cumsum()])[joined.ends]
        out.extend(joined.t_ns, numbers[low:high], ends, joined.rows[kept])
    return out.done()
