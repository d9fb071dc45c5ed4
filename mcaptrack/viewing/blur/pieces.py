"""Pieces of tracks between two times: where a person is, or must be, at any time in between.

A person who is missed for a moment is still there. So tracks are interpolated over their gaps, and continued before
their first and after their last row, along their motion.

Letters: N rows, S pieces, D numbers of a state (a box in a picture, or in space), M times.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.geometry.ragged import group_index, ragged_range, run_ends, run_starts

#: Tracks are interpolated over gaps of this length, and continued for this long at either end.
MAX_GAP_S: Final = 5.0
_AHEAD_S: Final = 1.0
#: The motion at an end of a track is that of this time.
_MOTION_S: Final = 0.5


class Pieces(NamedTuple):
    """Pieces of tracks between two times (S,), with the states (S, D) at both, and whether there was a row at each."""

    first_ns: Ints
    last_ns: Ints
    first: Floats
    last: Floats
    is_row: tuple[Bools, Bools]

    def at(self, at_ns: Ints) -> tuple[Ints, Floats, Floats]:
        """The states at rising times (M,): the index of the time of each, (N, D), and for how long nothing was seen, s.

        They are in the order of the pieces.
        """
        if not len(at_ns):
            return np.empty(0, np.int64), self.first[:0], np.empty(0)
        near = (self.first_ns <= at_ns[-1]) & (self.last_ns >= at_ns[0])
        begin, end, start, stop = self.first_ns[near], self.last_ns[near], self.first[near], self.last[near]
        low, high = np.searchsorted(at_ns, begin, "left"), np.searchsorted(at_ns, end, "right")
        of, place = group_index(high - low), ragged_range(low, high - low)
        t_ns = at_ns[place]
        share = (t_ns - begin[of]) / np.maximum(end - begin, 1)[of]
        states = start[of] + share[:, None] * (stop - start)[of]
        since = np.where(self.is_row[0][near][of], t_ns - begin[of], np.inf)
        until = np.where(self.is_row[1][near][of], end[of] - t_ns, np.inf)
        return place, states, np.minimum(since, until) / NS_PER_S


def joined(parts: Sequence[Pieces], width: int) -> Pieces:
    """All pieces of these, of states of so many numbers."""
    if not parts:
        none, no = np.empty(0, np.int64), np.empty(0, np.bool_)
        return Pieces(none, none, np.empty((0, width)), np.empty((0, width)), (no, no))
    rows = tuple(np.concatenate([part.is_row[n] for part in parts]) for n in range(2))
    first, last, start, stop = (np.concatenate([part[n] for part in parts]) for n in range(4))
    return Pieces(first, last, start, stop, (rows[0], rows[1]))


def around(t_ns: Ints, states: Floats, near_ns: int) -> Pieces:
    """Detections as pieces around their times."""
    halves = [(t_ns - near_ns, t_ns, False, True), (t_ns, t_ns + near_ns, True, False)]
    parts = [
        Pieces(first, last, states, states, (np.full(len(t_ns), one), np.full(len(t_ns), other)))
        for first, last, one, other in halves
    ]
    return joined(parts, states.shape[1])


def linked(t_ns: Ints, track_id: Ints, states: Floats, places: Floats) -> Pieces:
    """Tracks as pieces between consecutive rows, with one before the first row of each and one after the last.

    ``places`` (N, P) are what moves beyond the ends, the first numbers of the states; the others stay as they are.
    """
    order = np.lexsort((t_ns, track_id))
    t_ns, track_id, states, places = t_ns[order], track_id[order], states[order], places[order]
    starts = run_starts(track_id, times=t_ns, max_gap=seconds_to_ns(MAX_GAP_S))
    first, last = np.flatnonzero(starts), np.flatnonzero(run_ends(starts))
    inner = np.flatnonzero(~run_ends(starts))
    yes = np.ones(len(inner), np.bool_)
    between = Pieces(t_ns[inner], t_ns[inner + 1], states[inner], states[inner + 1], (yes, yes))
    run = np.cumsum(starts) - 1
    motion_ns, ahead_ns = seconds_to_ns(_MOTION_S), seconds_to_ns(_AHEAD_S)
    # The row that is half a second after the first one of its track, and the one that is half a second before the last.
    later = np.minimum(_first_at(run, t_ns, first, t_ns[first] + motion_ns), last)
    earlier = np.maximum(_first_at(run, t_ns, last, t_ns[last] - motion_ns), first)
    before, after = states[first].copy(), states[last].copy()
    before[:, : places.shape[1]] -= _motion(t_ns, places, first, later) * _AHEAD_S
    after[:, : places.shape[1]] += _motion(t_ns, places, earlier, last) * _AHEAD_S
    no, yes = np.zeros(len(first), np.bool_), np.ones(len(first), np.bool_)
    ends = [
        Pieces(t_ns[first] - ahead_ns, t_ns[first], before, states[first], (no, yes)),
        Pieces(t_ns[last], t_ns[last] + ahead_ns, states[last], after, (yes, no)),
    ]
    return joined([between, *ends], states.shape[1])


def _first_at(run: Ints, t_ns: Ints, rows: Ints, wanted_ns: Ints) -> Ints:
    """For some rows, the index of the first row of the same run at a time or later; the one after the run if none."""
    if not len(rows):
        return rows
    base = int(t_ns.min())
    length = int(t_ns.max()) - base + seconds_to_ns(MAX_GAP_S)
    keys = run.astype(np.float64) * length + (t_ns - base)
    found = np.searchsorted(keys, run[rows].astype(np.float64) * length + (wanted_ns - base))
    return found.astype(np.int64)


def _motion(t_ns: Ints, places: Floats, one: Ints, other: Ints) -> Floats:
    """The motion of places (N, P) between two rows, by second."""
    passed = np.maximum(t_ns[other] - t_ns[one], 1)[:, None] / NS_PER_S
    out: Floats = (places[other] - places[one]) / passed
    out[other == one] = 0
    return out
