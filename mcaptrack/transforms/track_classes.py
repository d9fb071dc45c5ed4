"""The class of a track, where its rows are of several: that of most of them.

Letters: N rows, K tracks.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mcaptrack.notices import warn
from mcaptrack.schema import TRACKS, Frame, Rows
from mcaptrack.schema.classes import first_classes, majority
from mcaptrack.schema.framing import JoinedFrames, joined_parts, mapped_rows


def settle_classes(frames: Sequence[Frame]) -> Sequence[Frame]:
    """Give each track one class, that of most of its rows; of several, the one that it had first.

    Warns of the tracks that have rows of several classes. Frames are unchanged if there are none.
    """
    pairs = np.empty((2, 0), np.int64)
    for _, _, joined in joined_parts(TRACKS, frames):
        those = np.stack([joined.rows["track_id"].astype(np.int64), joined.rows["class_id"].astype(np.int64)])
        pairs = np.unique(np.concatenate([pairs, those], axis=1), axis=1)
    ids, count = np.unique(pairs[0], return_counts=True)
    if not (count > 1).any():
        return frames
    changed = ids[count > 1]
    parts = [
        joined.rows[["track_id", "class_id"]][np.isin(joined.rows["track_id"], changed)]
        for _, _, joined in joined_parts(TRACKS, frames)
    ]
    rows = np.concatenate(parts)
    track = np.searchsorted(changed, rows["track_id"])
    class_id = majority(track, rows["class_id"], len(changed))

    def settled(joined: JoinedFrames) -> Rows:
        place = np.minimum(np.searchsorted(changed, joined.rows["track_id"]), len(changed) - 1)
        mine = changed[place] == joined.rows["track_id"]
        joined.rows["class_id"][mine] = class_id[place[mine]]
        return joined.rows

    warn(
        f"{len(changed)} of {len(ids)} tracks have detections of several classes; each has the class of most of its "
        "detections",
        "classes",
    )
    return mapped_rows(TRACKS, frames, settled)


def vote(rows: Rows) -> tuple[int, int]:
    """Give each track the class of most of its rows (N,), in place; rows are ordered by time.

    Returns the number of tracks that had several classes, and of all tracks.
    """
    ids, track = np.unique(rows["track_id"], return_inverse=True)
    changed = rows["class_id"] != first_classes(track, rows["class_id"], len(ids))[track]
    if changed.any():
        rows["class_id"] = majority(track, rows["class_id"], len(ids))[track]
    return len(np.unique(track[changed])), len(ids)
