"""What tracks say of themselves: where each begins and ends, and what re-tracking repaired.

Letters: N rows, R events.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.schema import EVENTS, EventKind, Rows

NOBODY: Final = -1
#: What is the same again after less than this is one event.
SAME_S: Final = 1.0


def event_rows(kind: EventKind, places: Rows, **columns: Ints | Floats) -> Rows:
    """Events of one kind, a row each; they happened where the rows of tracks or truth in ``places`` (R,) stand."""
    out = EVENTS.empty(len(places))
    out["kind"] = kind
    for name in ("track_id", "truth_id", "previous_id", "source_id"):
        out[name] = NOBODY
    out["x_m"], out["y_m"] = places["x_m"], places["y_m"]
    out["x_px"], out["y_px"] = places["x_px"] + places["w_px"] / 2, places["y_px"] + places["h_px"] / 2
    out["duration_s"] = np.nan
    for name, values in columns.items():
        out[name] = values
    return out


def usual_ns(t_ns: Ints) -> int:
    """What lies between two of these times, most often."""
    return int(np.median(np.diff(t_ns))) if len(t_ns) > 1 else 0


def between_s(frame_ns: Ints, last_ns: Ints, next_ns: Ints) -> Floats:
    """How long it was from the frame after ``last_ns`` to ``next_ns`` (R,): 0 from one frame to the next."""
    after = np.minimum(np.searchsorted(frame_ns, last_ns, "right"), max(len(frame_ns) - 1, 0))
    apart: Floats = np.maximum(next_ns - frame_ns[after], 0) / NS_PER_S
    return apart


class Lives:
    """What tracks say of themselves: all their rows by time and id, the time of each, and the times of all frames."""

    def __init__(self, rows: Rows, row_ns: Ints, frame_ns: Ints) -> None:
        self.rows, self.row_ns, self.frame_ns = rows, row_ns, frame_ns
        order = np.lexsort((row_ns, rows["track_id"]))
        ids = rows["track_id"][order]
        change = ids[1:] != ids[:-1]
        self._first = order[np.append(True, change)[: len(order)]]
        self._last = order[np.append(change, True)[: len(order)]]
        self._size = np.unique(ids, return_counts=True)[1]

    def births(self) -> tuple[Ints, Rows]:
        """The first row of every track."""
        there = self.rows[self._first]
        return self.row_ns[self._first], event_rows(EventKind.BIRTH, there, track_id=there["track_id"])

    def ends(self) -> tuple[Ints, Rows]:
        """The last row of every track that doesn't go on to the last frame, with how long it was there."""
        until = self.row_ns[self._last]
        kept = until < (self.frame_ns[-1] if len(self.frame_ns) else 0)
        there, until, since = self.rows[self._last][kept], until[kept], self.row_ns[self._first][kept]
        lasted = (until - since + usual_ns(self.frame_ns)) / NS_PER_S
        size = self._size[kept]
        return until, event_rows(EventKind.END, there, track_id=there["track_id"], duration_s=lasted, frames=size)

    def repairs(self) -> tuple[Ints, Rows]:
        """Where a track goes on from another source (joined), and where a source goes on as a track that is new."""
        said = self.rows["source_id"] >= 0
        rows, t_ns = self.rows[said], self.row_ns[said]
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
            duration_s=between_s(self.frame_ns, t_ns[end[before]][joined], t_ns[at]),
        )
        by_source = np.lexsort((t_ns[start], source))
        whose = np.full(len(start), NOBODY)
        same = source[by_source][1:] == source[by_source][:-1]
        whose[by_source[1:][same]] = track[by_source[:-1]][same]
        parted = ~joined & (whose >= 0) & (whose != track)
        split = event_rows(
            EventKind.PARTED,
            rows[start[parted]],
            track_id=track[parted],
            previous_id=whose[parted],
            source_id=source[parted],
        )
        return np.concatenate([t_ns[at], t_ns[start[parted]]]), np.concatenate([moved, split])


def _runs(track: Ints, source: Ints, t_ns: Ints) -> tuple[Ints, Ints]:
    """First and last rows of the runs in which a track has one source; rows are by track and time.

    Runs shorter than a moment, between two of one source, are passed over: nothing is another way after them.
    """
    starts = np.flatnonzero(np.append(True, (track[1:] != track[:-1]) | (source[1:] != source[:-1]))[: len(track)])
    lasts = np.append(starts[1:], len(track)) - 1 if len(starts) else starts
    who, what, at = track[starts], source[starts], t_ns[starts]
    brief = np.zeros(len(starts), bool)
    brief[1:-1] = (who[2:] == who[:-2]) & (what[2:] == what[:-2]) & (at[2:] - at[1:-1] < seconds_to_ns(SAME_S))
    starts, lasts, who, what = starts[~brief], lasts[~brief], who[~brief], what[~brief]
    first = np.append(True, (who[1:] != who[:-1]) | (what[1:] != what[:-1]))[: len(who)]
    last = np.append(first[1:], True)[: len(who)]
    return starts[first], lasts[last]
