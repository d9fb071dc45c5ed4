"""Which encounters are changed at once: of those that need the same track at the same time, the best ones together.

Whether two tracks were swapped is judged as if all other tracks were right. So of two encounters that overlap in time
and have a track in common only one is changed, and the other is judged again afterwards. Encounters hang together in
chains where many people meet: the best set is found by an integer programme (HiGHS), one for each such group.

Letters: C encounters, Q groups of encounters of which only one can be changed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.notices import warn

if TYPE_CHECKING:
    from scipy.sparse import csr_array

#: The most encounters that are decided at once, and nodes after which the solver gives up: unlike a time, both are the
#: same on every machine.
_MOST, _NODES = 1_000, 10_000


def compatible(pair: Ints, low: Ints, high: Ints, gain: Floats) -> Ints:
    """The encounters (C,) with the largest total gain of which no two change a track at the same time, rising.

    ``pair`` (C, 2) are the tracks of each, which are judged and changed between the steps ``low`` and ``high`` (C,).
    Gains (C,) are positive.
    """
    rivals = _rivals(pair, low, high)
    if not rivals:
        return np.arange(len(gain))
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    ends = np.cumsum([0, *(len(one) for one in rivals)])
    limits = csr_array((np.ones(ends[-1]), np.concatenate(rivals), ends), shape=(len(rivals), len(gain)))
    _, part = connected_components(limits.T @ limits, directed=False)
    chosen = np.bincount(part)[part] == 1
    for one in np.unique(part[~chosen]):
        among = np.flatnonzero(part == one)
        of_these = limits[:, among]
        chosen[among] = _solved(of_these[np.diff(of_these.indptr) > 0], np.round(gain[among], 6))
    return np.flatnonzero(chosen)


def _rivals(pair: Ints, low: Ints, high: Ints) -> list[Ints]:
    """Groups of encounters that need one track at one time: those of a track that last when another one begins.

    None is a part of another one.
    """
    encounter = np.repeat(np.arange(len(pair)), 2)
    order = np.lexsort((low[encounter], pair.ravel()))
    out: list[Ints] = []
    group, before = np.empty(0, np.int64), -1
    for track, new in zip(pair.ravel()[order].tolist(), encounter[order].tolist(), strict=True):
        lasting = group[high[group] >= low[new]] if track == before else group[:0]
        if len(lasting) < len(group):
            out.append(group)
        group, before = np.append(lasting, new), track
    return [one for one in [*out, group] if len(one) > 1]


def _solved(limits: csr_array, gain: Floats) -> Bools:
    """Which encounters (C,) have the largest total gain, if one at most of each row of ``limits`` (Q, C) is chosen."""
    from scipy.optimize import Bounds, LinearConstraint, milp

    if len(gain) <= _MOST:
        found = milp(
            -gain,
            integrality=np.ones(len(gain)),
            bounds=Bounds(0, 1),
            constraints=LinearConstraint(limits, ub=1),
            options={"node_limit": _NODES, "mip_rel_gap": 0.0},
        )
        if found.status == 0:
            return np.asarray(found.x > 0.5)
    warn(f"{len(gain)} encounters were decided one after another: too many people meet to decide them at once")
    chosen, is_taken = np.zeros(len(gain), bool), np.zeros(limits.shape[0], bool)
    groups = limits.tocsc()
    for one in np.argsort(-gain, kind="stable").tolist():
        own = groups.indices[groups.indptr[one] : groups.indptr[one + 1]]
        if not is_taken[own].any():
            chosen[one] = is_taken[own] = True
    return chosen
