"""Who is who after two came near each other, judged from before and after.

While two are near, what each of them does is hard to foresee, but where one is *from the other* changes little. A
walker in that relative position either goes on or, where the labels are exchanged, jumps to its mirror image. The
likeliest course of exchanges over the whole encounter is found by dynamic programming with a Kalman filter for each
survivor (Viterbi), for all encounters at once.

Letters: C encounters, T steps of them, Q models of how steadily people walk beside each other.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.transforms.retrack.motion import Paths, Walker

#: How fast a relative velocity drifts, m/s in a second: the likeliest of these is taken for each encounter.
DRIFTS: Final = (0.05, 0.15, 0.4)


#: Who comes nearer than this to each other meets; the meeting lasts so many steps longer on both sides.
_NEAR_M: Final = 2.0
_MARGIN: Final = 10
#: What an exchange costs as a log likelihood, and what it costs more for each of the two whom the input calls the same
#: as before (and less for each whom it calls as the other).
_COST: Final = 5.0
_SAME: Final = 2.0
#: How much likelier the labels have to be exchanged than not.
_LEAST_GAIN: Final = 3.0


def part(walker: Walker, paths: Paths, at: Ints, source: Ints, step_s: float) -> tuple[Ints, int]:
    """For each row of the paths (N,) the track that it belongs to, and how many encounters were decided anew.

    ``at`` are the rows at which somebody was seen, and ``source`` what the input called them.
    """
    count = len(paths.first) - 1
    track = np.repeat(np.arange(count), np.diff(paths.first))
    named = np.full(len(track), -1)
    named[at] = source
    i, j, low, high = _encounters(paths, track, count)
    if len(i) == 0:
        return track, 0
    steps = low[:, None] + np.arange(int((high - low).max()) + 1)
    inside = steps <= high[:, None]
    row_i = np.where(inside, steps + (paths.first[i] - paths.step[paths.first[i]])[:, None], 0)
    row_j = np.where(inside, steps + (paths.first[j] - paths.step[paths.first[j]])[:, None], 0)
    apart = np.where(inside[..., None], paths.xy_m[row_i] - paths.xy_m[row_j], np.nan)
    name_i, name_j = np.where(inside, named[row_i], -1), np.where(inside, named[row_j], -1)
    hint = _COST + _SAME * _continuity(name_i, name_j)
    exchanged, gain = exchanges(apart, hint, step_s, walker.noise_m, walker.speed_m_per_s)
    owner, used, decided = track.copy(), np.zeros(count, bool), 0
    for one in np.argsort(-gain, kind="stable").tolist():
        if gain[one] < _LEAST_GAIN:
            break
        a, b = int(i[one]), int(j[one])
        if used[a] or used[b]:
            continue
        used[a] = used[b] = True
        decided += 1
        course = exchanged[one, : high[one] - low[one] + 1]
        for mine, other in ((a, b), (b, a)):
            rows = slice(paths.first[mine], paths.first[mine + 1])
            since = paths.step[rows] - low[one]
            swapped = (since >= 0) & course[np.clip(since, 0, len(course) - 1)]
            owner[rows] = np.where(swapped, other, mine)
    return owner, decided


def _encounters(paths: Paths, track: Ints, count: int) -> tuple[Ints, Ints, Ints, Ints]:
    """Pairs of tracks that come near each other, and from which step to which they are looked at, (C,) each."""
    seen = np.flatnonzero(np.isfinite(paths.xy_m[:, 0]))
    seen = seen[np.argsort(paths.step[seen], kind="stable")]
    step = paths.step[seen]
    first, second = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for apart in range(1, len(seen)):
        same = step[apart:] == step[:-apart]
        if not same.any():
            break
        a, b = seen[:-apart][same], seen[apart:][same]
        near = ((paths.xy_m[a] - paths.xy_m[b]) ** 2).sum(axis=1) < _NEAR_M**2
        first.append(a[near])
        second.append(b[near])
    a, b = np.concatenate(first), np.concatenate(second)
    pair = np.minimum(track[a], track[b]) * count + np.maximum(track[a], track[b])
    when = paths.step[a]
    order = np.lexsort((when, pair))
    pair, when = pair[order], when[order]
    new = np.ones(len(pair), bool)
    new[1:] = (pair[1:] != pair[:-1]) | (np.diff(when) > 2 * _MARGIN)
    begin = np.flatnonzero(new)
    end = np.append(begin[1:], len(pair))[: len(begin)] - 1
    i, j = np.divmod(pair[begin], count)
    starts, ends = paths.step[paths.first[:-1]], paths.step[paths.first[1:] - 1]
    low = np.maximum(when[begin] - _MARGIN, np.maximum(starts[i], starts[j]))
    high = np.minimum(when[end] + _MARGIN, np.minimum(ends[i], ends[j]))
    return i, j, low, high


def _continuity(name_i: Ints, name_j: Ints) -> Floats:
    """How many of two (C, T) have the name that they had before, less how many have that of the other."""

    def before(names: Ints) -> Ints:
        at = np.maximum.accumulate(np.where(names >= 0, np.arange(names.shape[1]), 0), axis=1)
        return np.concatenate([np.full((len(names), 1), -1), np.take_along_axis(names, at, axis=1)[:, :-1]], axis=1)

    last_i, last_j = before(name_i), before(name_j)
    same = ((name_i == last_i) & (name_i >= 0)).astype(float) + ((name_j == last_j) & (name_j >= 0))
    crossed = ((name_i == last_j) & (name_i >= 0)).astype(float) + ((name_j == last_i) & (name_j >= 0))
    return np.asarray(same - crossed)


def exchanges(
    apart_m: Floats, hint: Floats, step_s: float, noise_m: float, speed_m_per_s: float
) -> tuple[Bools, Floats]:
    """At which steps of encounters the labels are exchanged, (C, T), and how much likelier that is (C,).

    ``apart_m`` (C, T, 2) is the position of one from the other, NaN where not both were seen. ``hint`` (C, T) is what
    an exchange between a step and the one before costs, as a log likelihood. The labels of the first step stand.
    """
    models = (_viterbi(apart_m, hint, step_s, noise_m, speed_m_per_s, drift**2) for drift in DRIFTS)
    best, best_gain, evidence = next(models)
    for path, gain, total in models:
        better = total > evidence
        evidence = np.where(better, total, evidence)
        best = np.where(better[:, None], path, best)
        best_gain = np.where(better, gain, best_gain)
    return best, best_gain


def _viterbi(
    apart_m: Floats, hint: Floats, step_s: float, noise_m: float, speed_m_per_s: float, drift: float
) -> tuple[Bools, Floats, Floats]:
    count, steps = apart_m.shape[:2]
    r = 2 * noise_m**2
    mean = np.zeros((count, 3, 4))  # survivors: as labelled, exchanged, and one that never exchanges
    cov = np.tile([r, 0.0, 2 * speed_m_per_s**2], (count, 3, 1))
    total = np.tile([0.0, -np.inf, 0.0], (count, 1))
    came = np.zeros((steps, count, 2), bool)  # whether the survivor came from the other state
    started = np.zeros(count, bool)
    sign = np.array([1.0, -1.0, 1.0])
    for step in range(steps):
        seen = np.isfinite(apart_m[:, step, 0])
        z = np.where(seen[:, None], apart_m[:, step], 0.0)
        p, c, v = cov[..., 0], cov[..., 1], cov[..., 2]
        if step:
            p = p + step_s * (2 * c + step_s * (v + step_s * drift / 3))
            c = c + step_s * (v + step_s * drift / 2)
            v = v + step_s * drift
            mean[..., :2] += step_s * mean[..., 2:]
        new = seen & ~started
        mean[new, :, :2] = z[new, None] * sign[None, :, None]
        mean[new, :, 2:] = 0.0
        s = p + r
        go = seen & started
        # from each survivor (0, 1, 2) to each label (+1, -1)
        off = z[:, None, None] * np.array([1.0, -1.0])[None, None, :, None] - mean[:, :, None, :2]
        like = -0.5 * (off**2).sum(-1) / s[..., None] - np.log(s)[..., None]
        like = np.where(go[:, None, None], like, 0.0)
        switch = hint[:, step]
        stay = total[:, :2] + np.stack([like[:, 0, 0], like[:, 1, 1]], axis=1)
        change = total[:, 1::-1] + np.stack([like[:, 1, 0], like[:, 0, 1]], axis=1) - switch[:, None]
        jumped = (change > stay) & go[:, None]
        came[step] = jumped
        total = np.concatenate([np.where(jumped, change, stay), (total[:, 2] + like[:, 2, 0])[:, None]], axis=1)
        source = np.concatenate([np.where(jumped, [1, 0], [0, 1]), np.full((count, 1), 2)], axis=1)
        row = np.arange(count)[:, None]
        mean = mean[row, source]
        p, c, v = p[row, source], c[row, source], v[row, source]
        s = s[row, source]
        gain, gain_rate = np.where(go[:, None], p / s, 0.0), np.where(go[:, None], c / s, 0.0)
        off = z[:, None] * sign[None, :, None] - mean[..., :2]
        mean[..., :2] += gain[..., None] * off
        mean[..., 2:] += gain_rate[..., None] * off
        cov = np.stack([p * (1 - gain), c * (1 - gain), v - gain_rate * c], axis=-1)
        started |= seen
    path = np.zeros((count, steps), bool)
    now = total[:, 1] > total[:, 0]
    for step in range(steps - 1, -1, -1):
        path[:, step] = now
        now = np.where(came[step, np.arange(count), now.astype(int)], ~now, now)
    best = np.maximum(total[:, 0], total[:, 1])
    return path, best - total[:, 2], best
