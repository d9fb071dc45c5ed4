"""Groups laid end to end, and pairs of near points: against plain loops."""

from __future__ import annotations

from itertools import groupby

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mcaptrack.geometry.neighbours import near_pairs
from mcaptrack.geometry.ragged import group_index, ragged_range, run_ends, run_starts

GROUPS = st.lists(st.tuples(st.integers(-9, 9), st.integers(0, 4)), max_size=8)


@given(GROUPS, st.sampled_from([1, 3, -2]))
def test_ranges_are_those_of_python_laid_end_to_end(groups, step):
    starts, counts = [start for start, _ in groups], [count for _, count in groups]
    wanted = [n for start, count in groups for n in range(start, start + step * count, step)]
    assert ragged_range(starts, counts, step).tolist() == wanted
    assert group_index(counts).tolist() == [k for k, count in enumerate(counts) for _ in range(count)]


@given(st.lists(st.tuples(st.integers(0, 1), st.integers(0, 1), st.integers(0, 3)), max_size=12))
def test_runs_are_those_of_groupby_and_end_at_long_gaps(members):
    one, other, gaps = np.array(members, int).reshape(-1, 3).T
    runs = [len(list(run)) for _, run in groupby(members, key=lambda member: member[:2])]
    starts = run_starts(one, other)
    assert np.diff(np.append(np.flatnonzero(starts), len(members))).tolist() == runs
    assert (np.flatnonzero(run_ends(starts)) + 1).tolist() == np.cumsum(runs).tolist()
    split = run_starts(one, other, times=np.cumsum(gaps), max_gap=2)
    assert split.tolist() == [first or gap > 2 for first, gap in zip(starts.tolist(), gaps.tolist(), strict=True)]


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 5), st.integers(0, 5)), max_size=12))
def test_near_pairs_are_all_pairs_of_a_group_nearer_than_the_distance(points):
    group, *xy = np.array(points, int).reshape(-1, 3).T
    first, second = near_pairs(group, np.stack(xy, axis=-1).astype(float), 2.0)
    found = sorted(tuple(sorted(pair)) for pair in zip(first.tolist(), second.tolist(), strict=True))
    assert found == [
        (a, b)
        for a in range(len(points))
        for b in range(a + 1, len(points))
        if points[a][0] == points[b][0] and np.hypot(*np.subtract(points[a][1:], points[b][1:])) < 2.0
    ]
