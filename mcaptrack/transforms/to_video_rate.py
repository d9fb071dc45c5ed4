"""Re-tracked ids at the video's rate: the boxes of the tracker under the ids that re-tracking assigned.

Letters: N rows of the tracker.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import LAST_NS
from mcaptrack.geometry.plane import Planes, plane_at
from mcaptrack.geometry.ragged import run_starts
from mcaptrack.schema import TRACKS, Frame, Rows
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns, collect
from mcaptrack.schema.framing import (
    JoinedFrames,
    frame_numbers,
    frame_times,
    has_any,
    join_frames,
    joined_parts,
    mapped_rows,
)
from mcaptrack.schema.resampling import resample

#: Columns taken from the tracker where it has a box.
_FROM_TRACKER: Final = ("x_px", "y_px", "w_px", "h_px", "score", "observed")
#: The same for tracks that a tracker made in metres, with velocities.
_IN_METRES: Final = ("x_m", "y_m", "z_m", "heading_rad", "vx_m_per_s", "vy_m_per_s")


def to_video_rate(tracks: Sequence[Frame], retracks: Sequence[Frame], planes: Planes) -> FrameColumns:
    """The frames of ``tracks`` with the ids of ``retracks``.

    Each box of the tracker gets the re-tracked id that its track has at the nearest sample time. Where a re-tracked
    track has no box, its row is interpolated between the samples and not observed. Boxes of tracks that re-tracking
    left out are left out.

    Parameters
    ----------
    tracks : sequence of Frame
        Frames of Tracks at the video's rate, as the tracker made them.
    retracks : sequence of Frame
        Frames of Tracks at sample times; ``source_id`` is the id in ``tracks``.
    planes : Planes
        Ground planes, for positions in metres of boxes that have none.

    Returns
    -------
    FrameColumns
        One frame for each of ``tracks``; no id is at two places of a frame, and no box has two ids.
    """
    if not tracks or not retracks:
        return collect(TRACKS, (Frame(frame.t_ns, frame.index, TRACKS.empty()) for frame in tracks))
    tick_ns, numbers = frame_times(retracks), frame_numbers(tracks)
    period = int(np.median(np.diff(tick_ns))) if len(tick_ns) > 1 else 1
    reach_ns = round(1.5 * period)
    classes = _classes_of(retracks)
    has_velocity = not has_any(TRACKS, tracks, lambda rows: ~np.isfinite(rows["vx_m_per_s"]))
    columns = (*_FROM_TRACKER, *_IN_METRES) if has_velocity else _FROM_TRACKER
    out = FrameCollector(TRACKS)
    for first, last, joined in joined_parts(TRACKS, tracks):
        # A sample farther away than that is neither the nearest of a box nor linked over the times of these frames.
        low = int(np.searchsorted(tick_ns, int(joined.t_ns[0]) - reach_ns - 1, "left"))
        high = int(np.searchsorted(tick_ns, min(int(joined.t_ns[-1]) + reach_ns, LAST_NS - 1) + 1, "right"))
        near = retracks if (low, high) == (0, len(retracks)) else retracks[low:high]
        rows, ends = _part(joined, near, period, columns, planes, classes)
        out.extend(joined.t_ns, numbers[first:last], ends, rows)
    return out.done()


def _part(
    joined: JoinedFrames,
    retracks: Sequence[Frame],
    period: int,
    columns: Sequence[str],
    planes: Planes,
    classes: tuple[Ints, Ints],
) -> tuple[Rows, Ints]:
    """The rows of some frames of the tracker with re-tracked ids, and where those of each frame end.

    ``retracks`` are those near in time, ``period`` ns apart; ``columns`` are taken from the tracker where it has a box.
    """
    boxes, at, frame_ns, _ = joined
    base, base_at = resample(retracks, frame_ns, round(1.5 * period))
    base["observed"], base["source_id"] = False, -1

    ids, distance_ns = _retracked_ids(boxes["track_id"], frame_ns[at], retracks)
    kept = (ids >= 0) & (distance_ns <= 1.5 * period)
    # of two boxes with one id, the one with the nearer sample time
    order = np.lexsort((distance_ns, ids, at))
    order = order[kept[order]]
    order = order[run_starts(at[order], ids[order])]
    boxes, at, ids = boxes[order].copy(), at[order], ids[order]

    names = np.unique(np.concatenate([base["track_id"], ids]))
    width = len(names) + 1
    have = base_at * width + np.searchsorted(names, base["track_id"])
    want = at * width + np.searchsorted(names, ids)
    place = np.minimum(np.searchsorted(have, want), max(len(have) - 1, 0))  # base is ordered by time and id
    inside = have[place] == want if len(have) else np.zeros(len(want), bool)
    for name in columns:
        base[name][place[inside]] = boxes[name][inside]
    base["source_id"][place[inside]] = boxes["track_id"][inside]
    outside = boxes[~inside]
    outside["source_id"], outside["track_id"] = outside["track_id"], ids[~inside]
    _to_metres(outside, frame_ns[at[~inside]], planes)
    rows = np.concatenate([base, outside])
    rows_at = np.concatenate([base_at, at[~inside]])
    known, class_id = classes
    if len(known):  # of the re-tracked track: that of the tracker's box may be another one
        rows["class_id"] = class_id[np.searchsorted(known, rows["track_id"])]
    order = np.lexsort((rows["track_id"], rows_at))
    rows, rows_at = rows[order], rows_at[order]
    return rows, np.searchsorted(rows_at, np.arange(len(frame_ns) + 1), "left")


def unchanged_tracks(tracks: Sequence[Frame], planes: Planes) -> FrameColumns:
    """The frames of ``tracks`` under the ids that they have, in the form of ``to_video_rate``."""

    def unchanged(joined: JoinedFrames) -> Rows:
        rows = joined.rows
        rows["source_id"] = rows["track_id"]
        _to_metres(rows, joined.row_ns, planes)
        return rows

    return mapped_rows(TRACKS, tracks, unchanged)


def _retracked_ids(track: Ints, t_ns: Ints, retracks: Sequence[Frame]) -> tuple[Ints, Ints]:
    """The re-tracked id of each video-rate row at the nearest sample time of its track, and the distance to it in ns.

    Rows are given by ``track`` (N,) and ``t_ns`` (N,). The id is -1 for tracks without a sample.
    """
    joined = join_frames(TRACKS, retracks)
    rows, row_ns = joined.rows, joined.row_ns
    has_source = rows["source_id"] >= 0
    source, owner, row_ns = rows["source_id"][has_source], rows["track_id"][has_source], row_ns[has_source]
    order = np.lexsort((row_ns, source))
    source, owner, row_ns = source[order], owner[order], row_ns[order]
    ids, distance_ns = np.full(len(track), -1), np.full(len(track), np.iinfo(np.int64).max)
    if len(source) == 0:
        return ids, distance_ns
    names, times = np.unique(source), np.unique(np.concatenate([row_ns, t_ns]))
    own = np.searchsorted(names, track)  # one rising key for track and time, so that one search finds both
    keys = np.searchsorted(names, source) * len(times) + np.searchsorted(times, row_ns)
    after = np.searchsorted(keys, own * len(times) + np.searchsorted(times, t_ns))
    for side in (after - 1, after):
        place = np.clip(side, 0, len(source) - 1)
        gap = np.abs(row_ns[place] - t_ns)
        better = (source[place] == track) & (gap < distance_ns)
        ids[better], distance_ns[better] = owner[place[better]], gap[better]
    return ids, distance_ns


def _classes_of(retracks: Sequence[Frame]) -> tuple[Ints, Ints]:
    """The ids of re-tracked tracks, rising, and the class of the first row of each."""
    known, classes = np.empty(0, np.int64), np.empty(0, np.int64)
    for _, _, joined in joined_parts(TRACKS, retracks):
        ids = np.concatenate([known, joined.rows["track_id"]])
        those = np.concatenate([classes, joined.rows["class_id"]])
        known, first = np.unique(ids, return_index=True)
        classes = those[first]
    return known, classes


def _to_metres(rows: Rows, t_ns: Ints, planes: Planes) -> None:
    """Fill in missing positions in metres, in place, where there is a ground plane."""
    missing = np.flatnonzero(np.isnan(rows["x_m"]))
    missing = missing[np.argsort(t_ns[missing], kind="stable")]
    starts = np.flatnonzero(run_starts(t_ns[missing]))
    for here in np.split(missing, starts[1:]) if len(missing) else ():
        plane = plane_at(planes, int(t_ns[here[0]]))
        if plane is not None:
            rows["x_m"][here], rows["y_m"][here] = plane.boxes_to_metres(columns_to_boxes(rows[here])).T
