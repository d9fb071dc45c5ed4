"""Frames as flat rows and back, and all pairs within groups."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mcaptrack.geometry.ragged import cross_pairs
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.framing import frame_times, join_frames, split_rows
from tests.worlds import tracks_at

COUNTS = st.lists(st.integers(0, 4), max_size=8)


def frames_of(counts: list[int]) -> list[Frame]:
    """Frames with these numbers of rows; ids and times differ."""
    numbers = iter(range(1000))
    members = [{next(numbers): (float(k), -float(k)) for _ in range(count)} for k, count in enumerate(counts)]
    return [Frame(7 * k + k * k, 100 + k, tracks_at(rows)) for k, rows in enumerate(members)]


@given(COUNTS)
def test_joined_frames_are_split_into_the_same_frames(counts):
    frames = frames_of(counts)
    joined = join_frames(TRACKS, frames)
    assert joined.t_ns.tolist() == frame_times(frames).tolist() == [frame.t_ns for frame in frames]
    assert joined.row_ns.tolist() == [frame.t_ns for frame in frames for _ in frame.rows]
    assert joined.rows["track_id"].tolist() == list(range(sum(counts)))
    again = split_rows(joined.t_ns, [frame.index for frame in frames], joined.rows, joined.ends[1:])
    assert [(f.t_ns, f.index, f.rows.tobytes()) for f in again] == [(f.t_ns, f.index, f.rows.tobytes()) for f in frames]
    assert all(type(frame.t_ns) is int and type(frame.index) is int for frame in again)


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), max_size=8))
def test_cross_pairs_are_those_of_nested_loops(counts):
    wanted, first, second = [], 0, 0
    for group, (a, b) in enumerate(counts):
        wanted += [(group, i, j) for i in range(first, first + a) for j in range(second, second + b)]
        first, second = first + a, second + b
    found = cross_pairs(*np.array(counts, np.int64).reshape(-1, 2).T)
    assert list(zip(*(part.tolist() for part in found), strict=True)) == wanted
