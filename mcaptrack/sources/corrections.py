"""Tracks that people have corrected: a channel beside the tracks, which takes their place in the times that it covers.

A correction covers all pictures from its first frame to its last, also those in which no one is left. Its ids are those
of the channel that was exported, and say nothing about the ids of the tracker: rows of corrections get ids after these.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from mcaptrack import log
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns
from mcaptrack.schema.framing import frame_times, unique_values
from mcaptrack.sources.cameras import camera_at

#: The topic of corrections, below the name of their camera.
CORRECTED: Final = "corrected"
#: The topic of the tracks that they correct.
_TRACKS: Final = "tracks"


def corrections_of(opened: log.Log, prefix: str, topic: str) -> str | None:
    """The topic of the corrections of a camera's tracks; None if there are none, and for other tracks."""
    if topic != f"{prefix}/{_TRACKS}":
        return None
    for name in (prefix, *camera_at(opened, prefix).names):
        channel = opened.channels.get(f"{name}/{CORRECTED}")
        if channel is not None and channel.holds(TRACKS):
            return channel.topic
    return None


def fixed_ids(tracks: Sequence[Frame], corrected: Sequence[Frame]) -> tuple[int, ...]:
    """The ids that ``with_corrections`` gives to corrected tracks, in order of their own ids."""
    ids = unique_values(TRACKS, corrected, "track_id")
    first = int(max(unique_values(TRACKS, tracks, "track_id").tolist(), default=0)) + 1
    return tuple(range(first, first + len(ids)))


def with_corrections(tracks: Sequence[Frame], corrected: Sequence[Frame]) -> FrameColumns:
    """Frames of tracks with those of corrections in their place.

    Parameters
    ----------
    tracks, corrected : sequence of Frame

    Returns
    -------
    FrameColumns
        The frames of both. Rows of corrections have new ids (``fixed_ids``) and count as observed.
    """
    own = unique_values(TRACKS, corrected, "track_id")
    new = np.array(fixed_ids(tracks, corrected), np.int64)
    times = frame_times(corrected)
    out, place = FrameCollector(TRACKS), 0

    def add_until(t_ns: int) -> None:
        nonlocal place
        while place < len(times) and times[place] <= t_ns:
            frame = corrected[place]
            rows = frame.rows.copy()
            rows["track_id"] = new[np.searchsorted(own, rows["track_id"])] if len(rows) else rows["track_id"]
            rows["observed"] = True
            out.append(frame._replace(rows=rows))
            place += 1

    for frame in tracks:
        add_until(frame.t_ns)
        if not (place and times[place - 1] == frame.t_ns):
            out.append(frame)
    add_until(np.iinfo(np.int64).max)
    return out.done()
