"""Re-tracked ids at the video's rate: the boxes of the tracker under the ids that re-tracking assigned.

Letters: N rows of the tracker.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes, iou_of_pairs
from mcaptrack.geometry.clocks import LAST_NS, NS_PER_S, seconds_to_ns
from mcaptrack.geometry.plane import Planes, plane_at
from mcaptrack.geometry.ragged import find_rows, run_ends, run_starts
from mcaptrack.schema import TRACKS, Frame, Rows
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns, collect
from mcaptrack.schema.framing import (
    JoinedFrames,
    filtered_rows,
    frame_numbers,
    frame_times,
    has_any,
    join_frames,
    joined_parts,
    mapped_rows,
)
from mcaptrack.schema.resampling import interval_ns, resample, resample_parts

#: Columns taken from the tracker where it has a box.
_FROM_TRACKER: Final = ("x_px", "y_px", "w_px", "h_px", "score", "observed")
#: Columns of tracks that a tracker made in metres, with velocities.
_IN_METRES: Final = ("x_m", "y_m", "z_m", "heading_rad", "vx_m_per_s", "vy_m_per_s")


#: Lengths of gaps in s for which it is asked whether interpolated boxes are right: if they overlap so much with what
#: is there, of at least so many boxes so large a share. (On drawn scenes more interpolated boxes are right than wrong
#: from this share on: people turn and stop more often where they are hidden.)
_GAPS_S: Final = (0.25, 0.5, 1.0, 2.0, 3.0, 4.0)
_RIGHT_IOU: Final = 0.5
_LEAST_BOXES: Final = 20
_LEAST_RIGHT: Final = 0.9


# Where tracks of boxes in space begin and end, decided over a whole log.
#
# Letters: F frames, K tracks, N rows.


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
    until_ns = {track: int(frames.t_ns[frame]) for track, frame in _kept_until(frames).items()}
    if until_ns:
        frames = filtered_rows(TRACKS, frames, lambda joined: _is_kept(joined, until_ns))
    return _with_rows(frames, *_moved_on(frames))


def _is_kept(joined: JoinedFrames, until_ns: Mapping[int, int]) -> Bools:
    """Mask the rows (N,) that are not later than the limit of their track, if it has one."""
    ids, which = np.unique(joined.rows["track_id"], return_inverse=True)
    limits = np.array([until_ns.get(track, LAST_NS) for track in ids.tolist()], np.int64)
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
            track, seen = int(of[here[0]]), joined.frame[here] + low
            before = np.append(last.get(track, seen[0]), seen[:-1])
            waited = frames.t_ns[seen] - frames.t_ns[before]
            is_alone = (waited > _LONG_NS) & (seen - before > _LONG_FRAMES)
            # A detection soon after another one makes both certain.
            sure = np.flatnonzero(~is_alone)
            if len(sure):
                out[track] = int(seen[sure[-1]])
            last[track] = int(seen[-1])
    return {track: frame for track, frame in out.items() if frame < last[track]}


def _moved_on(frames: FrameColumns) -> tuple[Rows, Ints]:
    """Rows (N,) that extend tracks by one frame at both ends, and the frame of each."""
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
            track = int(rows["track_id"][here[0]])
            count[track] = count.get(track, 0) + len(here)
            if track not in first:
                first[track] = int(at[0]), rows[here[:1]].copy()
            near = int(np.searchsorted(t_ns[at], t_ns[first[track][0]] + _MOTION_NS, "right")) - 1
            if near >= 0:
                soon[track] = int(at[near]), rows[here[near : near + 1]].copy()
            last[track] = int(at[-1]), rows[here[-1:]].copy()
    limit = min(_NEXT_INTERVALS * interval_ns(t_ns), _NEXT_NS)
    out, frame_of = [TRACKS.empty()], []
    for track, number in count.items():
        if number < _LEAST_ROWS:
            continue
        (begin, row), (later, then), (end, final) = first[track], soon[track], last[track]
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
    """A copy of a row (1,) moved by these distances, which is not observed."""
    out = row.copy()
    out["x_m"] += x_m
    out["y_m"] += y_m
    out["observed"], out["source_id"] = False, -1
    return out


def _with_rows(frames: FrameColumns, rows: Rows, frame_of: Ints) -> FrameColumns:
    """Frames with rows (N,) added to frames (N,); the rows of each frame are ordered by id."""
    out = FrameCollector(TRACKS)
    for low, high, joined in joined_parts(TRACKS, frames):
        here = (frame_of >= low) & (frame_of < high)
        _extend(out, joined, frames.numbers[low:high], rows[here], frame_of[here] - low)
    return out.done()


def _extend(out: FrameCollector, joined: JoinedFrames, numbers: Ints, rows: Rows, frame_of: Ints) -> None:
    """Collect frames with rows (N,) added to frames (N,)."""
    rows, ends = _in_order(TRACKS.joined([joined.rows, rows]), np.append(joined.frame, frame_of), len(joined.t_ns))
    out.extend(joined.t_ns, numbers, ends, rows)


def _in_order(rows: Rows, frame_of: Ints, frames: int) -> tuple[Rows, Ints]:
    """Rows in the order of frames and ids, and where those of each frame end."""
    order = np.lexsort((rows["track_id"], frame_of))
    return rows.take(order), np.searchsorted(frame_of[order], np.arange(frames + 1))


def to_video_rate(tracks: Sequence[Frame], retracks: Sequence[Frame], planes: Planes) -> FrameColumns:
    """The frames of ``tracks`` with the ids of ``retracks``.

    Each box of the tracker gets the re-tracked id that its track has at the nearest sample time. Where a re-tracked
    track has no box, its row is interpolated between the samples and not observed. Boxes of tracks that re-tracking
    left out are left out. Where tracks of boxes in space begin and end is decided again (``mended_ends``).

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
    frames = out.done()
    # Boxes in space; what several cameras place on the ground has no size, and is seen until it leaves.
    return mended_ends(frames) if has_velocity and _have_sizes(tracks) else frames


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
    boxes, at, ids = boxes.take(order), at[order], ids[order]

    place = find_rows((base_at, base["track_id"]), (at, ids))
    inside = place >= 0
    for name in columns:
        base[name][place[inside]] = boxes[name][inside]
    base["source_id"][place[inside]] = boxes["track_id"][inside]
    outside = boxes[~inside]
    outside["source_id"], outside["track_id"] = outside["track_id"], ids[~inside]
    to_metres(outside, frame_ns[at[~inside]], planes)
    rows = TRACKS.joined([base, outside])
    rows_at = np.append(base_at, at[~inside])
    track_ids, class_id = classes
    if len(track_ids):  # of the re-tracked track: that of the tracker's box may be another one
        rows["class_id"] = class_id[np.searchsorted(track_ids, rows["track_id"])]
    return _in_order(rows, rows_at, len(frame_ns))


def _have_sizes(frames: Sequence[Frame]) -> bool:
    """Whether there are rows with a size in metres, and none with a box in pixels."""
    has_size = has_any(TRACKS, frames, lambda rows: np.isfinite(rows["length_m"]))
    return has_size and not has_any(TRACKS, frames, lambda rows: np.isfinite(rows["w_px"]))


def steady_s(tracks: Sequence[Frame], most_s: float) -> float:
    """The longest gap in s, up to ``most_s``, in which interpolated boxes would be right.

    The log tells it: boxes in the middle of stretches without a gap are compared with what would be interpolated there.
    People who turn and cameras that shake move away from a straight line; then long gaps are better left open.
    """
    parts = [
        (joined.rows["track_id"], joined.frame + low, columns_to_boxes(joined.rows))
        for low, _, joined in joined_parts(TRACKS, tracks)
    ]
    if not parts:
        return most_s
    track, frame, boxes = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.lexsort((frame, track))
    order = order[np.isfinite(boxes[order]).all(axis=1)]
    track, frame, boxes = track[order], frame[order], boxes[order]
    usual_s, longest_s = interval_ns(frame_times(tracks)) / NS_PER_S, most_s
    for gap_s in [gap_s for gap_s in _GAPS_S if gap_s <= most_s] if usual_s else ():
        half = max(round(gap_s / usual_s / 2), 1)
        if len(track) <= 2 * half:
            return most_s
        before, middle, after = (slice(low, len(track) - 2 * half + low) for low in (0, half, 2 * half))
        whole = (track[before] == track[after]) & (frame[after] - frame[before] == 2 * half)
        share = iou_of_pairs((boxes[before] + boxes[after])[whole] / 2, boxes[middle][whole])
        if len(share) >= _LEAST_BOXES and (share >= _RIGHT_IOU).mean() < _LEAST_RIGHT:
            return longest_s
        longest_s = gap_s
    return most_s


def linked_tracks(
    tracks: Sequence[Frame], retracks: Sequence[Frame], planes: Planes, filled_s: float = 0.0
) -> FrameColumns:
    """The frames of ``tracks``, of which some continue others in ``retracks``.

    The arguments are those of ``to_video_rate``. All boxes stay, but for the second of two that would have one id in a
    frame: that of the track that began later. Gaps of up to ``filled_s`` are interpolated between boxes, as far as this
    log tells that these are right; without it, all gaps of tracks that are linked.
    """
    spans_ns: dict[int, tuple[int, int]] = {}
    for _, _, joined in joined_parts(TRACKS, tracks):
        for track, t_ns in zip(joined.rows["track_id"].tolist(), joined.row_ns.tolist(), strict=True):
            spans_ns[track] = spans_ns.get(track, (t_ns, t_ns))[0], t_ns
    sources: dict[int, set[int]] = {}

    def renamed(joined: JoinedFrames) -> Rows:
        rows = joined.rows
        rows["source_id"] = rows["track_id"]
        ids, _ = _retracked_ids(rows["track_id"], joined.row_ns, retracks)
        rows["track_id"] = np.where(ids >= 0, ids, rows["track_id"])
        pairs = np.unique(np.stack([rows["track_id"].astype(np.int64), rows["source_id"].astype(np.int64)]), axis=1)
        for track, source in pairs.T.tolist():
            sources.setdefault(track, set()).add(source)
        to_metres(rows, joined.row_ns, planes)
        return rows

    def is_first(joined: JoinedFrames) -> Bools:
        began_ns = np.array([spans_ns[source][0] for source in joined.rows["source_id"].tolist()], np.int64)
        order = np.lexsort((began_ns, joined.rows["track_id"], joined.frame))
        kept = np.empty(len(order), bool)
        kept[order] = run_starts(joined.frame[order], joined.rows["track_id"][order])
        return kept

    frames = mapped_rows(TRACKS, tracks, renamed)
    linked = {track: sorted(spans_ns[source] for source in own) for track, own in sources.items() if len(own) > 1}
    if not linked and not filled_s:
        return frames
    filled_s = steady_s(tracks, filled_s)
    gaps_ns = [later[0] - before[1] for spans in linked.values() for before, later in pairwise(spans)]
    gap_ns, ids = (seconds_to_ns(filled_s), sources) if filled_s else (max([0, *gaps_ns]), linked)
    return _filled(filtered_rows(TRACKS, frames, is_first), np.array(sorted(ids)), gap_ns)


def _filled(frames: FrameColumns, ids: Ints, gap_ns: int) -> FrameColumns:
    """Frames with the gaps of some tracks interpolated that are at most ``gap_ns`` long; these rows aren't observed."""
    out, width = FrameCollector(TRACKS), int(ids[-1]) + 1
    for first, last, rows, at in resample_parts(frames, frames.t_ns, gap_ns):
        own = join_frames(TRACKS, frames, first, last)
        mine = np.isin(own.rows["track_id"], ids)
        have = (own.frame[mine] + first) * width + own.rows["track_id"][mine]
        is_new = np.isin(rows["track_id"], ids) & ~np.isin(at * width + rows["track_id"], have)
        new = rows[is_new]
        new["source_id"], new["observed"] = -1, False
        _extend(out, own, frames.numbers[first:last], new, at[is_new] - first)
    return out.done()


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
    track_ids, classes = np.empty(0, np.int64), np.empty(0, np.int64)
    for _, _, joined in joined_parts(TRACKS, retracks):
        ids = np.concatenate([track_ids, joined.rows["track_id"]])
        those = np.concatenate([classes, joined.rows["class_id"]])
        track_ids, first = np.unique(ids, return_index=True)
        classes = those[first]
    return track_ids, classes


def to_metres(rows: Rows, t_ns: Ints, planes: Planes) -> None:
    """Fill in missing positions in metres, in place, where there is a ground plane."""
    missing = np.flatnonzero(np.isnan(rows["x_m"]))
    missing = missing[np.argsort(t_ns[missing], kind="stable")]
    starts = np.flatnonzero(run_starts(t_ns[missing]))
    for here in np.split(missing, starts[1:]) if len(missing) else ():
        plane = plane_at(planes, int(t_ns[here[0]]))
        if plane is not None:
            rows["x_m"][here], rows["y_m"][here] = plane.boxes_to_metres(columns_to_boxes(rows[here])).T


def move_rows(rows: Rows, xy_m: Floats, planes: Planes, t_ns: Ints) -> Rows:
    """Move rows (R,) to other positions (R, 2), and their boxes with them if there is a ground plane at their times."""
    out = rows.copy()
    which = np.maximum(np.searchsorted([since_ns for since_ns, _ in planes], t_ns, side="right") - 1, 0)
    for number in np.unique(which).tolist() if planes else ():
        plane, here = planes[number][1], which == number
        before, size_px = rows[here], columns_to_boxes(rows[here])[:, 2:]
        from_m = np.stack([before["x_m"], before["y_m"]], axis=-1)
        shift_px = plane.standing_boxes(xy_m[here], size_px) - plane.standing_boxes(from_m, size_px)
        out["x_px"][here], out["y_px"][here] = (
            before[name] + np.where(np.isfinite(shift_px).all(axis=1), shift_px[:, axis], 0.0)
            for axis, name in enumerate(("x_px", "y_px"))
        )
    out["x_m"], out["y_m"] = xy_m.T
    return out
