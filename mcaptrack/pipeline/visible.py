"""Leave out rows of people who are outside of the picture: interpolated and coasting boxes that the camera can't see.

A track goes on while its person is occluded, and its row then stands where the person is expected. Outside of the
picture, where people come and go unseen, such a row is no statement about that picture.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Bools
from mcaptrack.geometry.boxes import columns_to_boxes, share_inside
from mcaptrack.notices import warn
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame, Rows, Schema
from mcaptrack.schema.framing import JoinedFrames, join_frames, split_rows
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
        joined = join_frames(schema, frames)
        is_unseen = _is_unseen(joined.rows, picture_size) if schema is TRACKS else np.zeros(0, bool)
        if not is_unseen.any():
            continue
        out[topic] = schema, _kept(joined, ~is_unseen, frames)
        count = np.count_nonzero(is_unseen)
        rows = "row is" if count == 1 else "rows are"
        warn(f"{topic}: {count:,} {rows} left out, outside of the picture and without a detection", "left-out")
        stem, _, name = topic.rpartition("/")
        predictions = f"{stem}/predictions"
        if name == "online" and predictions in channels:
            made = channels[predictions][1]
            theirs = join_frames(PREDICTIONS, made)
            gone = {(f, one) for f, one, is_gone in zip(*_keys(joined), is_unseen.tolist(), strict=True) if is_gone}
            kept = np.array([key not in gone for key in zip(*_keys(theirs), strict=True)], bool)
            out[predictions] = PREDICTIONS, _kept(theirs, kept, made)
    return out


def _is_unseen(rows: Rows, picture_size: Callable[[], PictureSize]) -> Bools:
    """Mask the rows that are not observed and lie outside of the picture."""
    boxes, observed = columns_to_boxes(rows), rows["observed"]
    nothing = np.zeros(len(rows), bool)
    if not (~observed & np.isfinite(boxes).all(axis=1)).any() or (size := picture_size()) is None:
        return nothing
    is_outside: Bools = share_inside(boxes, *size) < _LEAST_INSIDE  # false without a box
    if np.count_nonzero(is_outside & observed) > _MOST_OUTSIDE * np.count_nonzero(observed):
        return nothing
    return np.asarray(is_outside & ~observed)


def _keys(joined: JoinedFrames) -> tuple[list[int], list[int]]:
    """The number of the frame and the id of each row."""
    return joined.frame.tolist(), joined.rows["track_id"].tolist()


def _kept(joined: JoinedFrames, kept: Bools, frames: Sequence[Frame]) -> list[Frame]:
    """Return frames with those of their rows that are kept (N,)."""
    ends = np.concatenate([[0], kept.cumsum()])[joined.ends[1:]]
    return split_rows(joined.t_ns, [frame.index for frame in frames], joined.rows[kept], ends)
