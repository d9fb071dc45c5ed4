"""Where tracks of boxes in space begin and end, decided over a whole log.

Letters: F frames, K tracks, N rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.clocks import LAST_NS, NS_PER_S
from mcaptrack.geometry.ragged import run_ends, run_starts
from mcaptrack.schema import TRACKS, Rows
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns
from mcaptrack.schema.framing import JoinedFrames, filtered_rows, joined_parts
from mcaptrack.schema.resampling import interval_ns

#: A single box this long after the one before, and after so many frames without one, doesn't continue a track.
_LONG_NS: Final = NS_PER_S
_LONG_FRAMES: Final = 8
#: Tracks with fewer rows are too short to say how they move on.
_LEAST_ROWS: Final = 3
#: A track is moved on to the next frame if that is at most so many usual intervals and ns away.
_NEXT_INTERVALS: Final = 1.5
_NEXT_NS: Final = 600_000_000
#: The time in ns over which the motion at the beginning of a track is measured.
_MOTION_NS: Final = 500_000_000


def mended_ends(frames: FrameColumns) -> FrameColumns:
    """Tracks of boxes in space without a lone last box, and with a row before the first and one after the last.

    After a second without a detection, one more and none after it is as likely false, or of another object, as it is
    of the track. It is left out with the gap before it. On the other hand, objects come and go between two frames or
    while they are missed: in two of three cases an object is there one frame before its first and one frame after its
    last detection, at any frame rate (in drawn traffic with known ground truth), but not two. These rows are not
    observed.

    Parameters
    ----------
    frames : FrameColumns
        Tracks with positions and velocities in metres.

    Returns
    -------
    FrameColumns
        As many frames, at the same times.
    """
    until_ns = {one: int(frames.t_ns[frame]) for one, frame in _kept_until(frames).items()}
    if until_ns:
        frames = filtered_rows(TRACKS, frames, lambda joined: _is_kept(joined, until_ns))
    return _with_rows(frames, *_moved_on(frames))


def _is_kept(joined: JoinedFrames, until_ns: Mapping[int, int]) -> Bools:
    """Which rows (N,) are not after the time that is given for their track, if there is one."""
    ids, which = np.unique(joined.rows["track_id"], return_inverse=True)
    limits = np.array([until_ns.get(one, LAST_NS) for one in ids.tolist()], np.int64)
    return np.asarray(joined.row_ns <= limits[which])


def _kept_until(frames: FrameColumns) -> dict[int, int]:
    """The last frame of tracks that end with a lone box after a long gap, by their ids: the one before the gap."""
    out: dict[int, int] = {}
    last: dict[int, int] = {}
    for low, _, joined in joined_parts(TRACKS, frames):
        of = joined.rows["track_id"]
        order = np.lexsort((joined.frame, of))
        order = order[joined.rows["observed"][order]]
        starts = np.flatnonzero(run_starts(of[order]))
        for here in np.split(order, starts[1:]) if len(order) else ():
            one, found = int(of[here[0]]), joined.frame[here] + low
            before = np.append(last.get(one, found[0]), found[:-1])
            waited = frames.t_ns[found] - frames.t_ns[before]
            is_alone = (waited > _LONG_NS) & (found - before > _LONG_FRAMES)
            # A detection soon after another one makes both certain.
            sure = np.flatnonzero(~is_alone)
            if len(sure):
                out[one] = int(found[sure[-1]])
            last[one] = int(found[-1])
    return {one: frame for one, frame in out.items() if frame < last[one]}


def _moved_on(frames: FrameColumns) -> tuple[Rows, Ints]:
    """Rows (N,) that move tracks on by a frame at both of their ends, and the frame of each."""
    t_ns = frames.t_ns
    first: dict[int, tuple[int, Rows]] = {}
    soon: dict[int, tuple[int, Rows]] = {}
    last: dict[int, tuple[int, Rows]] = {}
    count: dict[int, int] = {}
    for low, _, joined in joined_parts(TRACKS, frames):
        order = np.lexsort((joined.frame, joined.rows["track_id"]))
        starts = run_starts(joined.rows["track_id"][order])
        is_last = run_ends(starts)
        bounds = zip(np.flatnonzero(starts).tolist(), np.flatnonzero(is_last).tolist(), strict=True)
        for a, b in bounds:
            here = order[a : b + 1]
            rows, at = joined.rows, joined.frame[here] + low
            one = int(rows["track_id"][here[0]])
            count[one] = count.get(one, 0) + len(here)
            if one not in first:
                first[one] = int(at[0]), rows[here[:1]].copy()
            near = int(np.searchsorted(t_ns[at], t_ns[first[one][0]] + _MOTION_NS, "right")) - 1
            if near >= 0:
                soon[one] = int(at[near]), rows[here[near : near + 1]].copy()
            last[one] = int(at[-1]), rows[here[-1:]].copy()
    limit = min(_NEXT_INTERVALS * interval_ns(t_ns), _NEXT_NS)
    out, frame_of = [TRACKS.empty()], []
    for one, number in count.items():
        if number < _LEAST_ROWS:
            continue
        (begin, row), (later, then), (end, final) = first[one], soon[one], last[one]
        if later > begin > 0 and (dt_ns := int(t_ns[begin] - t_ns[begin - 1])) <= limit:
            share = dt_ns / int(t_ns[later] - t_ns[begin])
            out.append(_moved(row, *(share * (row[name] - then[name]) for name in ("x_m", "y_m"))))
            frame_of.append(begin - 1)
        if end + 1 < len(t_ns) and (dt_ns := int(t_ns[end + 1] - t_ns[end])) <= limit:
            passed_s = dt_ns / NS_PER_S
            out.append(_moved(final, *(passed_s * final[name] for name in ("vx_m_per_s", "vy_m_per_s"))))
            frame_of.append(end + 1)
    return TRACKS.joined(out), np.array(frame_of, np.int64)


def _moved(row: Rows, x_m: Floats, y_m: Floats) -> Rows:
    """A row (1,) that is not observed, so far away."""
    out = row.copy()
    out["x_m"] += x_m
    out["y_m"] += y_m
    out["observed"], out["source_id"] = False, -1
    return out


def _with_rows(frames: FrameColumns, rows: Rows, frame_of: Ints) -> FrameColumns:
    """Frames with more rows (N,), of these frames; those of each frame are ordered by id."""
    out = FrameCollector(TRACKS)
    for low, high, joined in joined_parts(TRACKS, frames):
        here = (frame_of >= low) & (frame_of < high)
        both = TRACKS.joined([joined.rows, rows[here]])
        of = np.concatenate([joined.frame, frame_of[here] - low])
        order = np.lexsort((both["track_id"], of))
        ends = np.searchsorted(of[order], np.arange(high - low + 1))
        out.extend(joined.t_ns, frames.numbers[low:high], ends, both.take(order))
    return out.done()
