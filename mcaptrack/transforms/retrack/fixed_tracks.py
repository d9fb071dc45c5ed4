"""Tracks that people have corrected: re-tracking neither cuts nor joins them, and leaves none of their samples out.

Letters: C assignments (a track has a sample at a step), N samples.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from mcaptrack.geometry.arrays import Bools, Ints


def fix_tracks(step: Ints, track: Ints, source: Ints, fixed: Collection[int]) -> Ints:
    """The track of each assignment (C,) after all samples of a fixed input id have one track, and no other fixed one.

    Parameters
    ----------
    step, track, source : (C,) of int
        The step of each assignment, the track that it has now, and the input id of its sample.
    fixed : collection of int
        Input ids of corrected tracks.

    Returns
    -------
    (C,) of int
        What a track has before the first sample of a fixed id, or after its last one, stays with it: a person who was
        followed into the corrected part keeps the id. All else keeps its track, or gets a new one where a fixed id has
        taken it.
    """
    is_fixed = np.isin(source, np.array(sorted(fixed), np.int64))
    if not is_fixed.any():
        return track
    out = np.full(len(track), -1, np.int64)
    following = int(track.max()) + 1
    ends: dict[int, tuple[int, int]] = {}
    for one in np.unique(source[is_fixed]).tolist():
        own = np.flatnonzero(source == one)
        ends[one] = int(own[step[own].argmin()]), int(own[step[own].argmax()])
    taken: set[int] = set()
    node: dict[int, int] = {}
    for one in sorted(ends, key=lambda key: -int((source == key).sum())):
        names, counts = np.unique(track[source == one], return_counts=True)
        free = [int(name) for name in names[np.argsort(-counts, kind="stable")] if int(name) not in taken]
        node[one] = free[0] if free else following
        following += not free
        taken.add(node[one])
        out[source == one] = node[one]
    for one in np.unique(track[is_fixed]).tolist():
        own = np.flatnonzero(track == one)
        own = own[np.argsort(step[own], kind="stable")]
        rest = following  # of this track, what belongs to no fixed id, if one has taken its name
        for low, high in _runs(is_fixed[own]):
            run = own[low:high]
            before = int(source[own[low - 1]]) if low else None
            after = int(source[own[high]]) if high < len(own) else None
            if before is not None and ends[before][1] == own[low - 1]:
                out[run] = node[before]
            elif after is not None and ends[after][0] == own[high]:
                out[run] = node[after]
            else:
                out[run] = rest if one in taken else one
                following = rest + 1
    untouched = out < 0
    out[untouched] = track[untouched]
    return out


def _runs(is_fixed: Bools) -> list[tuple[int, int]]:
    """The runs of assignments that are not of fixed ids, as begin and end."""
    edges = np.flatnonzero(np.diff(np.concatenate([[True], is_fixed, [True]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
