"""Tracks that people have corrected: a channel beside the tracks, which takes their place in the times that it covers.

A correction covers all pictures from its first frame to its last, also those in which no one is left. People may have
looked at every fifth picture: boxes in between are interpolated where the two next to them have one. The ids of a
correction are those of the channel that was exported, and say nothing about the ids of the tracker: rows of corrections
get ids after these.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from mcaptrack import log
from mcaptrack.geometry.arrays import Bools, Ints
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns
from mcaptrack.schema.framing import filtered_rows, frame_times, unique_values
from mcaptrack.schema.resampling import interval_ns, resample
from mcaptrack.sources.cameras import camera_at

__all__ = ["ANSWERS", "CORRECTED"]

#: The topic of corrections, below the name of their camera.
CORRECTED: Final = "corrected"
#: The topic of answers to questions about identities (rows of Decisions), below the name of their camera.
ANSWERS: Final = "answers"
#: The channels that people may have corrected, below the name of their camera, the likeliest first.
CORRECTED_FROM: Final = ("retracks/full", "tracks")
#: The topic of the tracks that they correct.
_TRACKS: Final = "tracks"
#: Pictures between two of a correction are covered, too, unless these are farther apart than so many usual steps.
_MOST_STEPS: Final = 1.5


def corrections_of(opened: log.Log, prefix: str, topic: str) -> str | None:
    """The topic of the corrections of a camera's tracks; None if there are none, and for other tracks."""
    if topic != f"{prefix}/{_TRACKS}":
        return None
    for name in (prefix, *camera_at(opened, prefix).names):
        if opened.holds(f"{name}/{CORRECTED}", TRACKS):
            return f"{name}/{CORRECTED}"
    return None


def fixed_ids(tracks: Sequence[Frame], corrected: Sequence[Frame]) -> tuple[int, ...]:
    """The ids that ``with_corrections`` gives to corrected tracks, in order of their own ids."""
    ids = unique_values(TRACKS, corrected, "track_id")
    first = int(max(unique_values(TRACKS, tracks, "track_id").tolist(), default=0)) + 1
    return tuple(range(first, first + len(ids)))


def corrected_tracks(opened: log.Log, prefix: str, topic: str, tracks: Sequence[Frame]) -> Sequence[Frame]:
    """Return the tracks of a channel with corrections, if it has any."""
    corrections = corrections_of(opened, prefix, topic)
    return tracks if corrections is None else with_corrections(tracks, opened.frame_columns(corrections, TRACKS))


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
    track_ns = frame_times(tracks)
    between = track_ns[_is_covered(track_ns, times) & ~np.isin(track_ns, times)]
    reach_ns = round(_MOST_STEPS * interval_ns(times))
    filled, at = resample(corrected, between, reach_ns) if len(between) else (TRACKS.empty(), np.empty(0, np.int64))
    ends = np.searchsorted(at, np.arange(len(between) + 1))
    out, place = FrameCollector(TRACKS), 0

    def add(frame: Frame) -> None:
        rows = frame.rows.copy()
        rows["track_id"] = new[np.searchsorted(own, rows["track_id"])] if len(rows) else rows["track_id"]
        rows["observed"] = True
        out.append(frame._replace(rows=rows))

    def add_until(t_ns: int) -> None:
        nonlocal place
        while place < len(times) and times[place] <= t_ns:
            add(corrected[place])
            place += 1

    for frame in tracks:
        add_until(frame.t_ns)
        if place and times[place - 1] == frame.t_ns:
            continue
        number = int(np.searchsorted(between, frame.t_ns))
        if number < len(between) and between[number] == frame.t_ns:
            add(frame._replace(rows=filled[ends[number] : ends[number + 1]]))
        else:
            out.append(frame)
    add_until(np.iinfo(np.int64).max)
    return out.done()


def _is_covered(t_ns: Ints, times: Ints) -> Bools:
    """Which of the times ``t_ns`` (T,) lie at frames of a correction (at ``times``), or between two of them."""
    after = np.searchsorted(times, t_ns)
    before = np.searchsorted(times, t_ns, "right") - 1
    is_inside = (before >= 0) & (after < len(times))
    gap = times[np.minimum(after, len(times) - 1)] - times[np.maximum(before, 0)] if len(times) else np.zeros_like(t_ns)
    return np.asarray(is_inside & (gap <= _MOST_STEPS * interval_ns(times)))


def without_filled(frames: Sequence[Frame], corrected: Sequence[Frame]) -> Sequence[Frame]:
    """Re-tracked frames at the rate of the pictures; where there are corrections, only with corrected boxes.

    A person who was said not to be in a picture is not put back there by interpolation.
    """
    times = frame_times(corrected)
    if not len(times):
        return frames
    return filtered_rows(
        TRACKS, frames, lambda joined: ~_is_covered(joined.row_ns, times) | (joined.rows["source_id"] >= 0)
    )
