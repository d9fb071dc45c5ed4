"""Events that follow from tracks alone: births, ends, and repairs by re-tracking.

Letters: N rows, R events.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.geometry.ragged import run_ends, run_starts
from mcaptrack.schema import EVENTS, TRACKS, EventKind, Frame, Rows
from mcaptrack.schema.framing import frame_times, joined_parts

NO_ID: Final = -1
#: Interruptions shorter than this do not split a period.
MAX_PAUSE_S: Final = 1.0


def event_rows(kind: EventKind, places: Rows, **columns: Ints | Floats) -> Rows:
    """Events of one kind, at the positions of the rows of tracks or ground truth in ``places`` (R,)."""
    out = EVENTS.empty(len(places))
    out["kind"] = kind
    for name in ("track_id", "truth_id", "previous_id", "source_id"):
        out[name] = NO_ID
    out["x_m"], out["y_m"] = places["x_m"], places["y_m"]
    out["x_px"], out["y_px"] = places["x_px"] + places["w_px"] / 2, places["y_px"] + places["h_px"] / 2
    out["duration_s"] = np.nan
    for name, values in columns.items():
        out[name] = values
    return out


def frame_interval_ns(t_ns: Ints) -> int:
    """The usual time between two frames: the median."""
    return int(np.median(np.diff(t_ns))) if len(t_ns) > 1 else 0


def unobserved_s(frame_ns: Ints, last_ns: Ints, next_ns: Ints) -> Floats:
    """Seconds from the first frame after ``last_ns`` to ``next_ns`` (R,): 0 for consecutive frames."""
    after = np.minimum(np.searchsorted(frame_ns, last_ns, "right"), max(len(frame_ns) - 1, 0))
    apart: Floats = np.maximum(next_ns - frame_ns[after], 0) / NS_PER_S
    return apart


class TrackLifecycle:
    """The rows of tracks with the time of each, and the times of all frames. Rows are ordered by time and id.

    Of the rows only those matter at which something begins or ends; ``size`` are the numbers of all rows of each track,
    by rising ids.
    """

    def __init__(self, rows: Rows, row_ns: Ints, frame_ns: Ints, size: Ints) -> None:
        self.rows, self.row_ns, self.frame_ns = rows, row_ns, frame_ns
        order = np.lexsort((row_ns, rows["track_id"]))
        ids = rows["track_id"][order]
        starts = run_starts(ids)
        self._first, self._last = order[starts], order[run_ends(starts)]
        self._size = size

    def births(self) -> tuple[Ints, Rows]:
        """The first row of each track."""
        there = self.rows[self._first]
        return self.row_ns[self._first], event_rows(EventKind.BIRTH, there, track_id=there["track_id"])

    def ends(self) -> tuple[Ints, Rows]:
        """The last row of each track that ends before the last frame, with the track's duration and number of rows."""
        until = self.row_ns[self._last]
        kept = until < (self.frame_ns[-1] if len(self.frame_ns) else 0)
        there, until, since = self.rows[self._last][kept], until[kept], self.row_ns[self._first][kept]
        lasted = (until - since + frame_interval_ns(self.frame_ns)) / NS_PER_S
        size = self._size[kept]
        return until, event_rows(EventKind.END, there, track_id=there["track_id"], duration_s=lasted, frames=size)

    def repairs(self) -> tuple[Ints, Rows]:
        """Find repairs: a track that continues with another source (joined), a source that continues as another track
        (parted).

        ``source_id`` of a row is the id that its position had before re-tracking.
        """
        has_source = self.rows["source_id"] >= 0
        rows, t_ns = self.rows[has_source], self.row_ns[has_source]
        order = np.lexsort((t_ns, rows["track_id"]))
        rows, t_ns = rows[order], t_ns[order]
        start, end = _runs(rows["track_id"], rows["source_id"], t_ns)
        track, source = rows["track_id"][start], rows["source_id"][start]
        joined = np.zeros(len(start), bool)
        joined[1:] = track[1:] == track[:-1]
        before = np.maximum(np.arange(len(start)) - 1, 0)
        at = start[joined]
        moved = event_rows(
            EventKind.JOINED,
            rows[at],
            track_id=track[joined],
            previous_id=source[before][joined],
            source_id=source[joined],
            duration_s=unobserved_s(self.frame_ns, t_ns[end[before]][joined], t_ns[at]),
        )
        by_source = np.lexsort((t_ns[start], source))
        owner = np.full(len(start), NO_ID)
        same = source[by_source][1:] == source[by_source][:-1]
        owner[by_source[1:][same]] = track[by_source[:-1]][same]
        parted = ~joined & (owner >= 0) & (owner != track)
        split = event_rows(
            EventKind.PARTED,
            rows[start[parted]],
            track_id=track[parted],
            previous_id=owner[parted],
            source_id=source[parted],
        )
        return np.concatenate([t_ns[at], t_ns[start[parted]]]), np.concatenate([moved, split])


def lifecycle_of(frames: Sequence[Frame]) -> TrackLifecycle:
    """The life of tracks, from the rows at which a track, or a run of one source, begins or ends."""
    ids, size = np.empty(0, np.int64), np.empty(0, np.int64)
    kept, kept_ns = [TRACKS.empty()], [np.empty(0, np.int64)]
    for _, _, joined in joined_parts(TRACKS, frames):
        rows, row_ns = joined.rows, joined.row_ns
        there, count = np.unique(rows["track_id"], return_counts=True)
        ids, which = np.unique(np.concatenate([ids, there]), return_inverse=True)
        size = np.bincount(which, np.concatenate([size, count]), len(ids)).astype(np.int64)
        matters = np.zeros(len(rows), bool)
        for some in (np.arange(len(rows)), np.flatnonzero(rows["source_id"] >= 0)):
            order = some[np.lexsort((row_ns[some], rows["track_id"][some]))]
            starts = run_starts(rows["track_id"][order], rows["source_id"][order])
            matters[order[starts | run_ends(starts)]] = True
        kept.append(rows[matters])
        kept_ns.append(row_ns[matters])
    rows, row_ns = TRACKS.joined(kept), np.concatenate(kept_ns)
    order = np.lexsort((rows["track_id"], row_ns))
    return TrackLifecycle(rows[order], row_ns[order], np.unique(frame_times(frames)), size)


def _runs(track: Ints, source: Ints, t_ns: Ints) -> tuple[Ints, Ints]:
    """First and last rows of the runs of one track with one source; rows are ordered by track and time.

    Runs shorter than ``MAX_PAUSE_S`` between two runs of the same source are skipped.
    """
    starts = np.flatnonzero(run_starts(track, source))
    lasts = np.append(starts[1:], len(track)) - 1 if len(starts) else starts
    track, source, at = track[starts], source[starts], t_ns[starts]
    brief = np.zeros(len(starts), bool)
    is_between = (track[2:] == track[:-2]) & (source[2:] == source[:-2])
    brief[1:-1] = is_between & (at[2:] - at[1:-1] < seconds_to_ns(MAX_PAUSE_S))
    starts, lasts = starts[~brief], lasts[~brief]
    first = run_starts(track[~brief], source[~brief])
    return starts[first], lasts[run_ends(first)]
