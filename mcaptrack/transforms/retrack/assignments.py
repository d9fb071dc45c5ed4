"""Assignments of samples to tracks, collected while tracks run online. Letters: C assignments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mcaptrack.geometry.arrays import Bools, Ints
from mcaptrack.transforms.retrack.samples import LogSamples


@dataclass
class Assignments:
    """Assignments: each has a step, a track and a sample. Samples are named by step and input id."""

    _steps: bytearray = field(default_factory=bytearray)
    _tracks: bytearray = field(default_factory=bytearray)
    _sources: bytearray = field(default_factory=bytearray)
    _confirmed: list[tuple[int, Ints]] = field(default_factory=list)

    def add(self, step: Ints | int, tracks: Ints, sources: Ints) -> None:
        """Assign the samples of the input ids ``sources`` (C,) at ``step`` to ``tracks`` (C,)."""
        for held, values in ((self._steps, step), (self._tracks, tracks), (self._sources, sources)):
            held.extend(np.broadcast_to(np.asarray(values, np.int64), tracks.shape).tobytes())

    def confirm(self, step: int, tracks: Ints) -> None:
        """Confirm assignments of ``tracks`` (C,) up to ``step``; once this was called, unconfirmed ones are dropped."""
        self._confirmed.append((step, tracks))

    def of(self, samples: LogSamples, steps: Sequence[int]) -> tuple[Ints, Ints, Ints, Ints]:
        """Steps, tracks, input ids and samples of the assignments, in the order in which they were made; (C,) each.

        ``samples`` are those of all ``steps``. A track has one sample a step.
        """
        step, track, source = (np.frombuffer(bytes(h), np.int64) for h in (self._steps, self._tracks, self._sources))
        row = _find(samples.column("track_id"), np.repeat(np.array(steps, np.int64), samples.counts), source, step)
        kept = np.flatnonzero((row >= 0) & self._is_confirmed(step, track))
        return step[kept], track[kept], source[kept], row[kept]

    def _is_confirmed(self, step: Ints, track: Ints) -> Bools:
        """Mask the assignments (C,) that are not later than the last confirmation of their track."""
        if not self._confirmed:
            return np.ones(len(step), bool)
        until = np.full(int(track.max(initial=0)) + 1, np.iinfo(np.int64).min)
        for when, tracks in self._confirmed:  # rising
            until[tracks] = when
        return step <= until[track]


def _find(ids: Ints, steps: Ints, wanted_ids: Ints, wanted_steps: Ints) -> Ints:
    """The row with each wanted id and step; -1 where there is none."""
    if len(ids) == 0:
        return np.full(len(wanted_ids), -1)
    names = np.unique(ids)
    low = min(int(steps.min()), int(wanted_steps.min(initial=0)))
    high = int(max(steps.max(), wanted_steps.max(initial=0)))
    width = high - low + 1

    def key(id_: Ints, step: Ints) -> Ints:
        return np.searchsorted(names, id_) * width + (step - low)

    have = key(ids, steps)
    order = np.argsort(have, kind="stable")
    want = key(wanted_ids, wanted_steps)
    at = np.minimum(np.searchsorted(have[order], want), len(have) - 1)
    found = order[at]
    is_there = np.isin(wanted_ids, names) & (have[found] == want)
    return np.where(is_there, found, -1)
