"""Re-tracked identities back at the video's rate: the tracker's boxes under the names that re-tracking gave them.

Letters: F frames of the video, T ticks of the clock of prediction, N rows of the tracker, R rows out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.plane import Planes, plane_at
from mcaptrack.geometry.ragged import group_index, run_starts
from mcaptrack.schema import TRACKS, Frame, Rows
from mcaptrack.schema.resampling import resample

#: What is taken from the tracker where it saw somebody.
_SEEN: Final = ("x_px", "y_px", "w_px", "h_px", "score", "observed")


def carry(tracks: Sequence[Frame], retracks: Sequence[Frame], planes: Planes) -> list[Frame]:
    """The frames of ``tracks`` with the people of ``retracks``, whose rows name tracks of the former as their source.

    A box of the tracker belongs to whom its track has at the tick that is nearest. Where a re-tracked person has no box
    their row lies between those of the ticks, not observed. Boxes of tracks that re-tracking left out are left out.
    """
    if not tracks or not retracks:
        return [Frame(frame.t_ns, frame.index, TRACKS.empty()) for frame in tracks]
    frame_ns = np.array([frame.t_ns for frame in tracks], np.int64)
    tick_ns = np.array([frame.t_ns for frame in retracks], np.int64)
    period = int(np.median(np.diff(tick_ns))) if len(tick_ns) > 1 else 1
    base, base_at = resample(retracks, frame_ns, round(1.5 * period))
    base["observed"], base["source_id"] = False, -1

    seen = TRACKS.joined([frame.rows for frame in tracks])
    at = group_index([len(frame.rows) for frame in tracks])
    who, far = _owner(seen["track_id"], frame_ns[at], retracks, tick_ns)
    kept = (who >= 0) & (far <= 1.5 * period)
    # where two boxes are one person's, the one whose tick is nearer
    order = np.lexsort((far, who, at))
    order = order[kept[order]]
    order = order[run_starts(at[order], who[order])]
    seen, at, who = seen[order].copy(), at[order], who[order]

    names = np.unique(np.concatenate([base["track_id"], who]))
    width = len(names) + 1
    have = base_at * width + np.searchsorted(names, base["track_id"])
    want = at * width + np.searchsorted(names, who)
    place = np.minimum(np.searchsorted(have, want), max(len(have) - 1, 0))  # base is ordered by time and id
    inside = have[place] == want if len(have) else np.zeros(len(want), bool)
    for name in _SEEN:
        base[name][place[inside]] = seen[name][inside]
    base["source_id"][place[inside]] = seen["track_id"][inside]
    outside = seen[~inside]
    outside["source_id"], outside["track_id"] = outside["track_id"], who[~inside]
    _to_metres(outside, frame_ns[at[~inside]], planes)
    rows = np.concatenate([base, outside])
    rows_at = np.concatenate([base_at, at[~inside]])
    order = np.lexsort((rows["track_id"], rows_at))
    rows, rows_at = rows[order], rows_at[order]
    bounds = np.searchsorted(rows_at, np.arange(len(tracks) + 1)).tolist()
    spans = zip(tracks, bounds[:-1], bounds[1:], strict=True)
    return [Frame(frame.t_ns, frame.index, rows[low:high]) for frame, low, high in spans]


def keep(tracks: Sequence[Frame], planes: Planes) -> list[Frame]:
    """The frames of ``tracks`` under the names that they have, as ``carry`` gives them."""
    out = []
    for frame in tracks:
        rows = frame.rows.copy()
        rows["source_id"] = rows["track_id"]
        _to_metres(rows, np.full(len(rows), frame.t_ns), planes)
        out.append(frame._replace(rows=rows))
    return out


def _owner(track: Ints, t_ns: Ints, retracks: Sequence[Frame], tick_ns: Ints) -> tuple[Ints, Ints]:
    """Whom rows of ``track`` (N,) at ``t_ns`` belong to by the tick that is nearest of those which say it, and how far
    that is in ns; -1 where none says it.
    """
    rows = TRACKS.joined([frame.rows for frame in retracks])
    row_ns = np.repeat(tick_ns, [len(frame.rows) for frame in retracks])
    said = rows["source_id"] >= 0
    source, owner, row_ns = rows["source_id"][said], rows["track_id"][said], row_ns[said]
    order = np.lexsort((row_ns, source))
    source, owner, row_ns = source[order], owner[order], row_ns[order]
    out, far = np.full(len(track), -1), np.full(len(track), np.iinfo(np.int64).max)
    if len(source) == 0:
        return out, far
    names, times = np.unique(source), np.unique(np.concatenate([row_ns, t_ns]))
    mine = np.searchsorted(names, track)  # one rising key for track and time, so that one search finds both
    keys = np.searchsorted(names, source) * len(times) + np.searchsorted(times, row_ns)
    after = np.searchsorted(keys, mine * len(times) + np.searchsorted(times, t_ns))
    for side in (after - 1, after):
        place = np.clip(side, 0, len(source) - 1)
        gap = np.abs(row_ns[place] - t_ns)
        better = (source[place] == track) & (gap < far)
        out[better], far[better] = owner[place[better]], gap[better]
    return out, far


def _to_metres(rows: Rows, t_ns: Ints, planes: Planes) -> None:
    """Fill in where rows stand on the ground, as far as a plane says it."""
    for when in np.unique(t_ns[np.isnan(rows["x_m"])]).tolist():
        plane, here = plane_at(planes, when), (t_ns == when) & np.isnan(rows["x_m"])
        if plane is not None:
            rows["x_m"][here], rows["y_m"][here] = plane.boxes_to_metres(columns_to_boxes(rows[here])).T
