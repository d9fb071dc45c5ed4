"""Identity swaps at encounters: where two tracks came near each other, decide again which is which.

While two people are near each other their paths are hard to predict, but the position of one relative to the other
changes little. A Kalman filter of that relative position either goes on smoothly or, where the identities were swapped,
jumps to its mirror image. The most likely sequence of swaps over an encounter is found by dynamic programming (Viterbi)
with one filter for each surviving hypothesis, for all encounters at once.

Letters: C encounters, T steps of them, N rows of trajectories.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.neighbours import near_pairs
from mcaptrack.geometry.ragged import batches, group_index, run_ends, run_starts
from mcaptrack.transforms.retrack.appearance import Sides
from mcaptrack.transforms.retrack.motion_model import MotionModel, StateRows, Trajectories, update

#: Drifts of a relative velocity within a second, in m/s: the most likely of these is taken for each encounter. With the
#: largest, of people who walk to and fro, motion says little.
DRIFTS_M_PER_S: Final = (0.05, 0.15, 0.4, 1.2)
#: Two tracks nearer than this meet; an encounter lasts so many steps longer at both ends.
_NEAR_M: Final = 2.0
_MARGIN: Final = 10
#: Errors of the expected relative position have Student's distribution with so many degrees of freedom: people also
#: turn round, and a normal distribution would then believe in a swap against all other evidence.
_FREEDOM: Final = 6.0
#: Cost of a swap as a log likelihood. Input ids count no more: trackers exchange them where people exchange places.
_SWAP_COST: Final = 2.5
#: Steps of encounters that are computed with at once.
_CELLS: Final = 2**16
#: The least gain in log likelihood of swaps over none.
_MIN_GAIN: Final = 1.0


# Which encounters are changed at once: of those that need the same track at the same time, the one that gains most.
#
# Whether two tracks were swapped is judged as if all other tracks were right. So of two encounters that overlap in
# time and have a track in common only one is changed.


def compatible(pair: Ints, low: Ints, high: Ints, gain: Floats) -> Ints:
    """The encounters (C,), rising, of which no two change a track at the same time: each that no better one precludes.

    ``pair`` (C, 2) are the tracks of each, which are judged and changed between the steps ``low`` and ``high`` (C,).
    """
    chosen = np.zeros(len(gain), bool)
    for encounter in np.argsort(-gain, kind="stable").tolist():
        shares = np.isin(pair, pair[encounter]).any(axis=1)
        chosen[encounter] = not (chosen & shares & (low <= high[encounter]) & (low[encounter] <= high)).any()
    return np.flatnonzero(chosen)


class Encounters(NamedTuple):
    """Encounters (C,) of tracks ``i`` and ``j``: their first and last steps, and those at which both are near."""

    i: Ints
    j: Ints
    low: Ints
    high: Ints
    meet: Ints
    part_ways: Ints


def resolve_swaps(model: MotionModel, trajectories: Trajectories, seen: Sides | None = None) -> tuple[Ints, int]:
    """The track that each row of the trajectories belongs to (N,), and the number of encounters that were changed.

    An encounter stays as it is if a better one changes one of its tracks at the same time. ``seen`` compares what the
    tracks look like before and after an encounter.
    """
    track = group_index(np.diff(trajectories.first))
    encounters = find_encounters(trajectories)
    if len(encounters.i) == 0:
        return track, 0
    i, j, low, high, meet, part_ways = encounters
    evidence = np.zeros(len(i)) if seen is None else seen.of_swaps(i, j, meet, part_ways)
    begin = trajectories.first[:-1] - trajectories.step[trajectories.first[:-1]]
    swaps: dict[int, list[tuple[int, int, int]]] = {}  # of each encounter that is changed: steps, and both tracks
    gain = np.zeros(len(i))
    by_length = np.argsort(high - low, kind="stable")
    for part in (by_length[span] for span in batches((high - low + 1)[by_length], _CELLS)):
        steps = low[part, None] + np.arange(int((high - low)[part].max()) + 1)
        inside = steps <= high[part, None]
        row_i = np.where(inside, steps + begin[i[part]][:, None], 0)
        row_j = np.where(inside, steps + begin[j[part]][:, None], 0)
        relative = np.where(inside[..., None], trajectories.xy_m[row_i] - trajectories.xy_m[row_j], np.nan)
        paths, gain[part] = find_swaps(model, relative, evidence[part])
        for at, path, length in zip(part.tolist(), paths, (high - low)[part].tolist(), strict=True):
            if gain[at] >= _MIN_GAIN:
                changes = low[at] + np.flatnonzero(np.diff(path[: length + 1], prepend=False))
                swaps[at] = [(step, int(i[at]), int(j[at])) for step in changes.tolist()]
    which = np.array(sorted(swaps), np.int64)
    chosen = which[compatible(np.stack([i, j], axis=1)[which], low[which], high[which], gain[which])]
    in_order = sorted(swap for at in chosen.tolist() for swap in swaps[at])
    return _exchanged(trajectories, track, in_order), len(chosen)


def _exchanged(trajectories: Trajectories, track: Ints, swaps: list[tuple[int, int, int]]) -> Ints:
    """The track that each row (N,) belongs to after swaps: steps, rising, and the two tracks that are swapped there.

    These go on as each other, or as whichever tracks they are by then.
    """
    owner = track.copy()
    now: dict[int, int] = {}
    for step, a, b in swaps:
        now[a], now[b] = now.get(b, b), now.get(a, a)
        for number in (a, b):
            first, last = trajectories.first[number : number + 2]
            owner[first + step - trajectories.step[first] : last] = now[number]
    return owner


def find_encounters(trajectories: Trajectories) -> Encounters:
    """Find where tracks come near each other."""
    first = trajectories.first
    count = len(first) - 1
    track = group_index(np.diff(first))
    observed = np.flatnonzero(np.isfinite(trajectories.xy_m[:, 0]))
    mine, other = near_pairs(trajectories.step[observed], trajectories.xy_m[observed], _NEAR_M)
    a, b = observed[mine], observed[other]
    pair = np.minimum(track[a], track[b]) * count + np.maximum(track[a], track[b])
    when = trajectories.step[a]
    order = np.lexsort((when, pair))
    pair, when = pair[order], when[order]
    starts = run_starts(pair, times=when, max_gap=2 * _MARGIN)
    begin, end = np.flatnonzero(starts), np.flatnonzero(run_ends(starts))
    i, j = np.divmod(pair[begin], count)
    track_begins, track_ends = trajectories.step[first[:-1]], trajectories.step[first[1:] - 1]
    low = np.maximum(when[begin] - _MARGIN, np.maximum(track_begins[i], track_begins[j]))
    high = np.minimum(when[end] + _MARGIN, np.minimum(track_ends[i], track_ends[j]))
    return Encounters(i, j, low, high, when[begin], when[end])


def find_swaps(model: MotionModel, relative_m: Floats, evidence: Floats | None = None) -> tuple[Bools, Floats]:
    """At which steps of encounters the identities are swapped, (C, T), and how much more likely that is than no swap.

    ``relative_m`` (C, T, 2) is the position of one track relative to the other, NaN where one of them was not observed.
    The identities of the first step stand. ``evidence`` (C,) is the log likelihood ratio that they are swapped at the
    last step, by what else is known. The gain (C,) is a difference of log likelihoods.
    """
    swapped = np.zeros(len(relative_m)) if evidence is None else evidence
    drifts = len(DRIFTS_M_PER_S)  # all at once: a step of few encounters takes as long as one of many
    drift = np.repeat(DRIFTS_M_PER_S, len(relative_m))[:, None]
    paths, gain, likelihood = _viterbi(
        replace(model, drift_m_per_s=drift, drift_ratio=0.0, noise_m=np.sqrt(2) * model.noise_m),
        np.tile(relative_m, (drifts, 1, 1)),
        np.tile(swapped, drifts),
    )
    best = np.argmax(likelihood.reshape(drifts, -1), axis=0) * len(relative_m) + np.arange(len(relative_m))
    return paths[best], gain[best]


def _viterbi(model: MotionModel, relative_m: Floats, is_swapped: Floats) -> tuple[Bools, Floats, Floats]:
    """Swaps (C, T), their gain (C,) and log likelihood (C,) with the noise and drift of relative positions."""
    count, steps = relative_m.shape[:2]
    # hypotheses: as labelled, swapped, and never swapped at all
    state = StateRows(np.zeros((4, count, 3)), np.zeros((3, count, 3)))
    state.cov[0], state.cov[2] = model.noise_m**2, 2 * model.speed_m_per_s**2
    total = np.tile([0.0, -np.inf, 0.0], (count, 1))
    came_swapped = np.zeros((steps, count, 2), bool)  # whether the best predecessor has the other labels
    started, row = np.zeros(count, bool), np.arange(count)[:, None]
    sign = np.array([1.0, -1.0, 1.0])
    for step in range(steps):
        observed = np.isfinite(relative_m[:, step, 0])
        new, go = observed & ~started, (observed & started)[:, None]
        z = np.where(observed, relative_m[:, step].T, 0.0)[..., None]
        if step:
            model.predict(state, model.step_s, state)
        state.mean[:2, new], state.mean[2:, new] = (z * sign)[:, new], 0.0
        # from each hypothesis (0, 1, 2) to each labelling (+1, -1)
        off = z[..., None] * sign[:2] - state.mean[:2, ..., None]
        s = state.cov[0] + model.noise_m**2
        # Student's distribution in the plane
        like = -(_FREEDOM / 2 + 1) * np.log1p((off**2).sum(0) / s[..., None] / _FREEDOM) - np.log(s)[..., None]
        like = np.where(go[..., None], like, 0.0)
        stay = total[:, :2] + np.stack([like[:, 0, 0], like[:, 1, 1]], axis=1)
        change = total[:, 1::-1] + np.stack([like[:, 1, 0], like[:, 0, 1]], axis=1) - _SWAP_COST
        came_swapped[step] = jumped = (change > stay) & go
        total = np.concatenate([np.where(jumped, change, stay), (total[:, 2] + like[:, 2, 0])[:, None]], axis=1)
        source = np.concatenate([np.where(jumped, [1, 0], [0, 1]), np.full((count, 1), 2)], axis=1)
        state = StateRows(state.mean[:, row, source], state.cov[:, row, source])
        update(state, z * sign, np.where(go, model.noise_m, np.inf))
        started |= observed
    total[:, 1] += is_swapped
    path = np.zeros((count, steps), bool)
    now = total[:, 1] > total[:, 0]
    for step in range(steps - 1, -1, -1):
        path[:, step] = now
        now = np.where(came_swapped[step, np.arange(count), now.astype(int)], ~now, now)
    best = np.maximum(total[:, 0], total[:, 1])
    return path, best - total[:, 2], best
