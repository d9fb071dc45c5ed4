"""The class of a track, where its rows are of several: that of most of them.

Letters: N rows, K tracks.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mcaptrack.notices import warn
from mcaptrack.schema import TRACKS, Frame, Rows
from mcaptrack.schema.classes import first_classes, majority
from mcaptrack.schema.framing import join_frames, split_rows


def settle_classes(frames: Sequence[Frame]) -> list[Frame]:
    """Give each track one class, that of most of its rows; of several, the one that it had first.

    Warns of the tracks that have rows of several classes. Frames are unchanged if there are none.
    """
    joined = join_frames(TRACKS, frames)
    rows = joined.rows.copy()
    changed, count = vote(rows)
    if not changed:
        return list(frames)
    warn(
        f"{changed} of {count} tracks have detections of several classes; each has the class of most of its detections",
        "classes",
    )
    return split_rows(joined.t_ns, [frame.index for frame in frames], rows, joined.ends[1:])


def vote(rows: Rows) -> tuple[int, int]:
    """Give each track the class of most of its rows (N,), in place; rows are ordered by time.

    Returns the number of tracks that had several classes, and of all tracks.
    """
    ids, track = np.unique(rows["track_id"], return_inverse=True)
    changed = rows["class_id"] != first_classes(track, rows["class_id"], len(ids))[track]
    if changed.any():
        rows["class_id"] = majority(track, rows["class_id"], len(ids))[track]
    return len(np.unique(track[changed])), len(ids)
