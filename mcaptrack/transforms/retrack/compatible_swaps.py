"""Which encounters are changed at once: of those that need the same track at the same time, the best ones together.

Whether two tracks were swapped is judged as if all other tracks were right. So of two encounters that overlap in time
and have a track in common only one is changed, and the other is judged again afterwards. Encounters hang together in
chains where many people meet: the best set is found by an integer programme (HiGHS), one for each such group.

Letters: C encounters, Q groups of encounters of which only one can be changed.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.notices import warn

#: The solver gives up a group after so many nodes: unlike a time, that is the same on every machine.
_NODES: Final = 10_000


def compatible(pair: Ints, low: Ints, high: Ints, gain: Floats) -> Ints:
    """The encounters (C,) with the largest total gain of which no two change a track at the same time, rising.

    ``pair`` (C, 2) are the tracks of each, which are changed between the steps ``low`` and ``high`` (C,). Gains (C,)
    are positive.
    """
    rivals = _rivals(pair, low, high)
    if not rivals:
        return np.arange(len(gain))
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    group, member = np.repeat(np.arange(len(rivals)), [len(one) for one in rivals]), np.concatenate(rivals)
    holds = coo_array((np.ones(len(group)), (group, member)), shape=(len(rivals), len(gain))).tocsr()
    _, part = connected_components(holds.T @ holds, directed=False)
    chosen = np.bincount(part)[part] == 1
    for one in np.unique(part[~chosen]):
        among = np.flatnonzero(part == one)
        limits = holds[:, among].toarray()
        chosen[among] = _solved(limits[limits.any(axis=1)], np.round(gain[among], 6))
    return np.flatnonzero(chosen)


def _rivals(pair: Ints, low: Ints, high: Ints) -> list[Ints]:
    """Groups of encounters that need one track at one time: those of a track that last when another one begins."""
    encounter = np.repeat(np.arange(len(pair)), 2)
    order = np.lexsort((low[encounter], pair.ravel()))
    out, lasting, before = [], np.empty(0, np.int64), -1
    for track, new in zip(pair.ravel()[order].tolist(), encounter[order].tolist(), strict=True):
        lasting = lasting[high[lasting] >= low[new]] if track == before else lasting[:0]
        lasting, before = np.append(lasting, new), track
        if len(lasting) > 1:
            out.append(lasting)
    return out


def _solved(limits: Floats, gain: Floats) -> Bools:
    """Which encounters (C,) have the largest total gain, if one at most of each row of ``limits`` (Q, C) is chosen."""
    from scipy.optimize import Bounds, LinearConstraint, milp

    whole = np.ones(len(gain))
    found = milp(
        -gain,
        integrality=whole,
        bounds=Bounds(0, 1),
        constraints=LinearConstraint(limits, ub=1),
        options={"node_limit": _NODES},
    )
    if found.status == 0:
        return np.asarray(found.x > 0.5)
    warn(
        f"{len(gain)} encounters were decided one after another: too many people meet to decide them at once",
        "other",
    )
    chosen = np.zeros(len(gain), bool)
    for one in np.argsort(-gain, kind="stable"):
        chosen[one] = not (limits[:, chosen].any(axis=1) & (limits[:, one] > 0)).any()
    return chosen
