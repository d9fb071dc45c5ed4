"""The re-tracked tracks once the whole log is known: holes filled, what never lasted left out.

Letters: C claims (a track has a sample at a step), R rows.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mcaptrack.resample import LINEAR
from mcaptrack.schema import Rows

Ints = NDArray[np.int64]


@dataclass
class Claims:
    """Which sample each track had at which step; filled while the tracks run."""

    _steps: list[Ints] = field(default_factory=list)
    _tracks: list[Ints] = field(default_factory=list)
    _sources: list[Ints] = field(default_factory=list)

    def add(self, step: Ints | int, tracks: Ints, sources: Ints) -> None:
        """``tracks`` (C,) have the samples of ``sources`` (C,), the ids of the input, at ``step``."""
        self._steps.append(np.broadcast_to(step, tracks.shape))
        self._tracks.append(tracks)
        self._sources.append(sources)

    def columns(self) -> tuple[Ints, Ints, Ints]:
        """Steps, track ids and source ids of all claims, in the order they were made."""
        nothing = [np.empty(0, np.int64)]
        return tuple(np.concatenate(part or nothing) for part in (self._steps, self._tracks, self._sources))  # type: ignore[return-value]


def whole_tracks(
    claims: Claims, samples: Rows, sample_step: Ints, min_rows: int, share_backfill: bool
) -> tuple[Rows, Ints]:
    """The rows of all tracks that have at least ``min_rows``, ordered by step and id, and the step of each.

    ``samples`` are all input rows with their steps. A sample that two tracks claim goes to the one that claimed it
    first as it happened; with ``share_backfill`` both keep it, as in the authors' program.
    """
    step, track, source = claims.columns()
    key = _lookup(samples["track_id"], sample_step, source, step)
    step, track, key = step[key >= 0], track[key >= 0], key[key >= 0]
    kept = _first_of(track, step)
    step, track, key = step[kept], track[kept], key[kept]
    if not share_backfill:
        kept = _first_of(key, np.zeros_like(key))
        step, track, key = step[kept], track[kept], key[kept]
    order = np.lexsort((step, track))
    step, track, key = step[order], track[order], key[order]

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
    row_step = step[before] + within

    names, which, lengths = np.unique(rows["track_id"], return_inverse=True, return_counts=True)
    lasting = lengths[which] >= min_rows if len(names) else np.zeros(0, bool)
    rows, row_step = rows[lasting], row_step[lasting]
    order = np.lexsort((rows["track_id"], row_step))
    return rows[order], row_step[order]


def _first_of(a: Ints, b: Ints) -> Ints:
    """Positions of the first occurrence of each pair, in their order."""
    order = np.lexsort((b, a))
    first = np.ones(len(order), bool)
    first[1:] = (a[order][1:] != a[order][:-1]) | (b[order][1:] != b[order][:-1])
    return np.sort(order[first])


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
