"""The re-tracked tracks once the whole log is known: linked, parted, filled, smoothed, without what never lasted.

Letters: C claims (a track has a sample at a step), R rows, K tracks, N rows of paths (see ``motion.Paths``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.plane import Planes, plane_at
from mcaptrack.schema import TRACKS, Rows
from mcaptrack.schema.resampling import LINEAR
from mcaptrack.transforms.retrack.doubt import log_odds
from mcaptrack.transforms.retrack.link import link
from mcaptrack.transforms.retrack.motion import Paths, Walker, smooth
from mcaptrack.transforms.retrack.part import part

if TYPE_CHECKING:
    from mcaptrack.transforms.retrack import Retrack


@dataclass
class Claims:
    """Which sample each track had at which step; filled while the tracks run."""

    _steps: list[Ints] = field(default_factory=list)
    _tracks: list[Ints] = field(default_factory=list)
    _sources: list[Ints] = field(default_factory=list)
    _sure: list[tuple[int, Ints]] = field(default_factory=list)

    def add(self, step: Ints | int, tracks: Ints, sources: Ints) -> None:
        """``tracks`` (C,) have the samples of ``sources`` (C,), the ids of the input, at ``step``."""
        self._steps.append(np.broadcast_to(step, tracks.shape))
        self._tracks.append(tracks)
        self._sources.append(sources)

    def confirm(self, step: int, tracks: Ints) -> None:
        """What ``tracks`` (C,) claimed up to ``step`` stands; with the first call, what is never confirmed falls."""
        self._sure.append((step, tracks))

    def on(self, samples: Rows, steps: Sequence[int], counts: Sequence[int]) -> tuple[Ints, Ints, Ints, Ints]:
        """Steps, tracks, sources and samples (rows of ``samples``, ``counts`` of them at each of ``steps``) of claims.

        In the order in which they were made. A track claims one sample a step.
        """
        nothing = [np.empty(0, np.int64)]
        step, track, source = (np.concatenate(p or nothing) for p in (self._steps, self._tracks, self._sources))
        key = _lookup(samples["track_id"], np.repeat(np.array(steps, np.int64), counts), source, step)
        kept = np.flatnonzero((key >= 0) & self._stands(step, track))
        return step[kept], track[kept], source[kept], key[kept]

    def _stands(self, step: Ints, track: Ints) -> NDArray[np.bool_]:
        """Which claims (C,) are not later than the last time that their track was confirmed."""
        if not self._sure:
            return np.ones(len(step), bool)
        until = np.full(int(track.max(initial=0)) + 1, np.iinfo(np.int64).min)
        for when, tracks in self._sure:  # rising
            until[tracks] = when
        return step <= until[track]


def whole_tracks(
    options: Retrack,
    walker: Walker,
    claims: Claims,
    sample_rows: Sequence[Rows],
    steps: Sequence[int],
    times_ns: Sequence[int],
) -> tuple[Rows, Ints]:
    """The rows of all tracks, ordered by step and id, and the step of each.

    ``sample_rows`` are the input rows of each of ``steps``. A sample that two tracks claim goes to the one that claimed
    it first as it happened; with ``backfill`` "all" both keep it, as in the authors' program.
    """
    samples = TRACKS.joined(sample_rows)
    step, track, source, key = claims.on(samples, steps, [len(rows) for rows in sample_rows])
    if options.backfill != "all":
        _, kept = np.unique(key, return_index=True)
        step, track, source, key = step[kept], track[kept], source[kept], key[kept]
    xy_m = np.stack([samples["x_m"][key], samples["y_m"][key]], axis=-1)
    step_s = 1 / options.rate_hz
    if options.link_s > 0 and len(track):
        track = _linked(options, walker, step, track, xy_m, step_s)
    if options.part and len(track):
        for _ in range(_ROUNDS):
            ids, at, paths = laid(step, track, xy_m, walker.noise_m)
            owner, changed = part(walker, paths, at, source, step_s)
            track = ids[owner[at]]
            if not changed:
                break
    order = np.lexsort((step, track))
    step, track, key = step[order], track[order], key[order]
    rows, row_step = _filled(samples, step, track, key)
    if len(rows) and (options.smooth or options.min_certainty > 0):
        ids, _, paths = laid(step, track, xy_m[order], walker.noise_m)
        _, _, smoothed = smooth(walker, paths, step_s)
        if options.smooth:  # the rows stand as the paths do: by track, then by step
            when = np.array(times_ns, np.int64)[np.minimum(np.searchsorted(steps, row_step), len(times_ns) - 1)]
            rows = moved(rows, smoothed.mean[:, :2], options.ground_planes, when)
        certain = 1 / (1 + np.exp(-log_odds(walker, paths, smoothed, step_s))) >= options.min_certainty
        sure = certain[np.searchsorted(ids, rows["track_id"])]
        rows, row_step = rows[sure], row_step[sure]
    min_rows = round(options.min_track_s * options.rate_hz) + 1
    names, which, lengths = np.unique(rows["track_id"], return_inverse=True, return_counts=True)
    there = np.isin(row_step, np.array(steps, np.int64))  # where nobody looked there are no frames
    lasting = lengths[which] >= min_rows if len(names) else np.zeros(0, bool)
    rows, row_step = rows[lasting & there], row_step[lasting & there]
    order = np.lexsort((rows["track_id"], row_step))
    return rows[order], row_step[order]


#: How often encounters are looked at anew after labels were exchanged.
_ROUNDS = 3


def laid(step: Ints, track: Ints, xy_m: Floats, noise_m: float) -> tuple[Ints, Ints, Paths]:
    """Claims (C,) laid end to end, by track: the tracks' ids (K,), the row of each claim (C,), and the paths."""
    ids, which = np.unique(track, return_inverse=True)
    low, high = np.full(len(ids), np.iinfo(np.int64).max), np.full(len(ids), np.iinfo(np.int64).min)
    np.minimum.at(low, which, step)
    np.maximum.at(high, which, step)
    length = high - low + 1
    first = np.concatenate([[0], np.cumsum(length)])
    total = int(first[-1])
    steps = np.arange(total) - np.repeat(first[:-1] - low, length)
    at = first[which] + step - low[which]
    places = np.full((total, 2), np.nan)
    places[at] = xy_m
    return ids, at, Paths(first, steps, places, np.full(total, noise_m))


def _linked(options: Retrack, walker: Walker, step: Ints, track: Ints, xy_m: Floats, step_s: float) -> Ints:
    """The claims' tracks with those put together that are one person."""
    ids, _, paths = laid(step, track, xy_m, walker.noise_m)
    forward, backward, _ = smooth(walker, paths, step_s)
    follows = link(walker, paths, forward, backward, step_s, options.link_s, options.link_certainty)
    root = np.arange(len(ids))
    order = np.argsort(paths.step[paths.first[:-1]], kind="stable")  # a track begins after the one that it goes on
    for one in order[follows[order] >= 0].tolist():
        root[follows[one]] = root[one]
    return np.asarray(ids[root][np.searchsorted(ids, track)])


def _filled(samples: Rows, step: Ints, track: Ints, key: Ints) -> tuple[Rows, Ints]:
    """A row for every step of every track from its first to its last, on straight lines inside holes."""
    goes_on = np.zeros(len(track), bool)
    goes_on[:-1] = track[1:] == track[:-1]
    count = np.where(goes_on, np.append(step[1:], 0) - step, 1)
    before = np.repeat(np.arange(len(track)), count)
    within = np.arange(len(before)) - np.repeat(np.cumsum(count) - count, count)
    after = np.where(within > 0, before + 1, before)
    share = within / count[before]
    rows = samples[key[before]].copy()
    for name in LINEAR:
        rows[name] += share * (samples[name][key[after]] - samples[name][key[before]])
    rows["source_id"] = np.where(within == 0, rows["track_id"], -1)
    rows["observed"] &= within == 0
    rows["track_id"] = track[before]
    return rows, step[before] + within


def moved(rows: Rows, xy_m: Floats, planes: Planes, t_ns: Ints) -> Rows:
    """The rows (R,) at other places (R, 2), and their boxes with them where a ground plane says how far that is."""
    out = rows.copy()
    for plane in dict.fromkeys(plane_at(planes, t) for t in np.unique(t_ns).tolist()) if planes else ():
        if plane is None:
            continue
        here = np.array([plane_at(planes, t) == plane for t in t_ns.tolist()]) if len(planes) > 1 else slice(None)
        size = columns_to_boxes(rows[here])[:, 2:]
        shift = plane.standing_boxes(xy_m[here], size) - plane.standing_boxes(
            np.stack([rows["x_m"][here], rows["y_m"][here]], axis=-1), size
        )
        shift = np.where(np.isfinite(shift), shift, 0.0)
        out["x_px"][here] += shift[:, 0]
        out["y_px"][here] += shift[:, 1]
    out["x_m"], out["y_m"] = xy_m.T
    return out


def _lookup(ids: Ints, steps: Ints, wanted_ids: Ints, wanted_steps: Ints) -> Ints:
    """The row with each wanted id and step; -1 where there is none."""
    if len(ids) == 0:
        return np.full(len(wanted_ids), -1)
    names = np.unique(ids)
    low, span = (
        min(int(steps.min()), int(wanted_steps.min(initial=0))),
        int(max(steps.max(), wanted_steps.max(initial=0))),
    )
    width = span - low + 1

    def key(who: Ints, when: Ints) -> Ints:
        return np.searchsorted(names, who) * width + (when - low)

    have = key(ids, steps)
    order = np.argsort(have, kind="stable")
    want = key(wanted_ids, wanted_steps)
    at = np.minimum(np.searchsorted(have[order], want), len(have) - 1)
    found = order[at]
    known = np.isin(wanted_ids, names) & (have[found] == want)
    return np.where(known, found, -1)
