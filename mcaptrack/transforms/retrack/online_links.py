"""Online links: which new track continues a lost one, decided when the new one is first written.

A track that is lost for longer than its filter can bridge terminates, and the same person comes back as a new track.
Where that is likely, the new one is written under the id of the lost one. Links are judged by motion as they are
offline, but from the past alone: by the state of the lost track when it was last observed, that of the new one now, and
by how many earlier links of this log seem right. Only ids change: offline re-tracking doesn't depend on these links.

Letters: R tracks alive at the steps of some frames, end to end; F frames, K tracks, L lost tracks, N new tracks.
"""

from __future__ import annotations

from collections import deque
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.transforms.retrack import linking
from mcaptrack.transforms.retrack.motion_model import MotionModel, State
from mcaptrack.transforms.retrack.online_tracker import HITS, IDS

#: So many of the last links say how many are right. That is estimated again when their number has grown by this share,
#: because it takes longer than a decision.
_LINKS: Final = 500
_GROWS: Final = 0.1
_NEVER: Final = np.iinfo(np.int64).max


class _Known(NamedTuple):
    """Tracks (K,): ids, the steps at which they began, were last observed and are over, and the state at the last
    observation.
    """

    ids: Ints
    began: Ints
    last: Ints
    over: Ints
    state: State

    def take(self, which: Bools | Ints) -> _Known:
        ids, began, last, over, state = self
        return _Known(ids[which], began[which], last[which], over[which], state.take(which))

    def joined(self, other: _Known) -> _Known:
        ids, began, last, over = (np.concatenate(both) for both in zip(self[:4], other[:4], strict=True))
        mean, cov = (np.concatenate(both) for both in zip(self.state, other.state, strict=True))
        return _Known(ids, began, last, over, State(mean, cov))


_NO_STEP: Final = np.empty(0, np.int64)
_NOTHING: Final = _Known(_NO_STEP, _NO_STEP, _NO_STEP, _NO_STEP, State(np.empty((0, 4)), np.empty((0, 3))))


class OnlineLinks:
    """The ids under which tracks are written: called with the steps of a log, some at a time.

    Parameters
    ----------
    model : MotionModel
        How people move.
    step_s : float
        The seconds between steps.
    max_gap_s : float
        Links are made over gaps of at most so many seconds; 0 for none.
    min_confidence : float
        The least probability of a link. As offline, odds of a third of this are enough.
    """

    def __init__(self, model: MotionModel, step_s: float, max_gap_s: float, min_confidence: float) -> None:
        self._model, self._step_s, self._max_gap_s = model, step_s, max_gap_s
        self._least = float(np.log(linking.ENOUGH * min_confidence / (1 - min_confidence)))
        self._names: dict[int, int] = {}  # the ids under which tracks are written, of those that were
        self._alive, self._lost = _NOTHING, _NOTHING  # lost ones are over, were written, and are continued by no other
        self._links: deque[tuple[float, float]] = deque(maxlen=_LINKS)  # log odds and seconds
        self._made, self._estimated = 0, 0
        self._shifts = linking.prior_shifts(np.empty(0), np.empty(0))

    def __call__(
        self, steps: Ints, tick: Ints, tracks: Ints, state: State, is_observed: Bools, is_written: Bools
    ) -> Ints:
        """The ids under which the tracks alive at each of F steps are written, (R,).

        ``steps`` (F,) are the numbers of the steps, ``tick`` (R,) the index of the step of each track, rising;
        ``tracks`` (5, R) and ``state`` (R,) are as in ``Step``. Nothing is known at a step that was not known then.
        """
        if self._max_gap_s <= 0:
            return np.asarray(tracks[IDS])
        known, which = self._known(steps, tick, tracks[IDS], state, is_observed)
        names = np.array([self._names.get(track, -1) for track in known.ids.tolist()], np.int64)
        rows = np.flatnonzero(is_written & (names[which] < 0))
        rows = rows[np.sort(np.unique(which[rows], return_index=True)[1])]  # of each track the first one
        is_named = names >= 0
        is_named[which[rows]] = True
        over = known.take(is_named & (known.over < _NEVER))
        self._lost = self._lost.joined(over)
        for here in np.split(rows, np.flatnonzero(np.diff(tick[rows])) + 1):
            if len(here):
                new = known.take(which[here])._replace(state=state.take(here))
                self._name(int(steps[tick[here[0]]]), new, tracks[HITS, here] == 1)
        self._lost = self._lost.take(self._lost.last >= steps[-1] - self._max_gap_s / self._step_s)
        self._alive = known.take(known.over == _NEVER)
        written = np.array([self._names.get(track, track) for track in known.ids.tolist()], np.int64)
        kept = {*self._alive.ids.tolist(), *self._lost.ids.tolist()}
        self._names = {track: name for track, name in self._names.items() if track in kept}
        return np.asarray(written[which])

    def _known(self, steps: Ints, tick: Ints, ids: Ints, state: State, is_observed: Bools) -> tuple[_Known, Ints]:
        """All tracks as known at the last step or when they were over, (K,), and the one that each row (R,) is of."""
        before = self._alive
        names, which = np.unique(np.concatenate([before.ids, ids]), return_inverse=True)
        had, which = which[: len(before.ids)], which[len(before.ids) :]
        ends = np.full(len(names), -1)
        ends[which] = tick  # rising, so the last one stays
        last_row = np.full(len(names), -1)
        seen = np.flatnonzero(is_observed)
        last_row[which[seen]] = seen
        began = np.full(len(names), _NEVER)
        np.minimum.at(began, which, steps[tick])
        began[had] = before.began
        last, states = np.zeros(len(names), np.int64), State(np.zeros((len(names), 4)), np.zeros((len(names), 3)))
        last[had] = before.last
        for values, earlier, now in zip(states, before.state, state, strict=True):
            values[had] = earlier
            values[last_row >= 0] = now[last_row[last_row >= 0]]
        last[last_row >= 0] = steps[tick[last_row[last_row >= 0]]]
        return _Known(names, began, last, np.append(steps, _NEVER)[ends + 1], states), which

    def _name(self, step: int, new: _Known, is_single: Bools) -> None:
        """Decide under which ids new tracks (N,) are written from ``step`` on; ``is_single`` were observed once."""
        self._names.update(zip(new.ids.tolist(), new.ids.tolist(), strict=True))
        lost = self._lost
        all_gaps_s = np.asarray((step - lost.last) * self._step_s, np.float64)
        left = np.flatnonzero((lost.over <= step) & (all_gaps_s <= self._max_gap_s))
        one, other = np.repeat(left, len(new.ids)), np.tile(np.arange(len(new.ids)), len(left))
        fits = linking.are_in_reach(lost.state.take(one), new.state.take(other), all_gaps_s[one])
        fits &= lost.last[one] < new.began[other]
        one, other = one[fits], other[fits]
        if not len(one):
            return
        before, after, gap_s = lost.state.take(one), new.state.take(other), all_gaps_s[one]
        # nothing is known of the velocity of what was observed once: it may be that of the lost one
        single = is_single[other]
        mean, cov = after.mean.copy(), after.cov.copy()
        mean[single, 2:], cov[single, 2] = before.mean[single, 2:], before.cov[single, 2]
        log_odds = linking.log_odds(linking.features(self._model, before, State(mean, cov), gap_s))
        made = linking.best_links(one, other, log_odds, max(len(lost.ids), len(new.ids)))
        shifted = log_odds[made] + self._shifts[linking.gap_classes(gap_s[made])]
        self._learn(log_odds[made], gap_s[made])
        made = made[shifted > self._least]
        for track, continued in zip(new.ids[other[made]].tolist(), lost.ids[one[made]].tolist(), strict=True):
            self._names[track] = self._names[continued]
        self._lost = lost.take(~np.isin(np.arange(len(lost.ids)), one[made]))

    def _learn(self, log_odds: Floats, gap_s: Floats) -> None:
        """Learn from the best links so far how many are right after gaps of what length."""
        self._links.extend(zip(log_odds.tolist(), gap_s.tolist(), strict=True))
        self._made += len(log_odds)
        if self._made > self._estimated + min(_GROWS * self._estimated, _GROWS * _LINKS):
            self._estimated = self._made
            self._shifts = linking.prior_shifts(*np.array(self._links).T)
