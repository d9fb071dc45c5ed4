"""Online links: which new track continues a lost one, decided when the new one is first written, or before.

A track that is lost for longer than its filter can bridge terminates, and the same person comes back as a new track.
Where that is likely, the new one is written under the id of the lost one, and if it is likelier than not, it is written
at once: a person who was confirmed needs no more proof. Links are judged by motion as they are offline, but from the
past alone: by the state of the lost track when it was last observed, that of the new one now, and by how many earlier
links of this log seem right. Offline re-tracking doesn't depend on these links.

Letters: R tracks alive at the steps of some frames, end to end; F frames; K tracks; L lost and N new ones; E links.
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
#: The number of pairs that are examined at once.
_BATCH: Final = 200_000


class _Known(NamedTuple):
    """Tracks (K,): ids, the steps at which they began, were last observed and are over, the number of observations, and
    the state at the last one.
    """

    ids: Ints
    began: Ints
    last: Ints
    over: Ints
    hits: Ints
    state: State

    def take(self, which: Bools | Ints) -> _Known:
        ids, began, last, over, hits, state = self
        return _Known(ids[which], began[which], last[which], over[which], hits[which], state.take(which))

    def joined(self, other: _Known) -> _Known:
        ids, began, last, over, hits = (np.concatenate(both) for both in zip(self[:5], other[:5], strict=True))
        mean, cov = (np.concatenate(both) for both in zip(self.state, other.state, strict=True))
        return _Known(ids, began, last, over, hits, State(mean, cov))


_NONE: Final = np.empty(0, np.int64)
_NOTHING: Final = _Known(_NONE, _NONE, _NONE, _NONE, _NONE, State(np.empty((0, 4)), np.empty((0, 3))))


class _Links(NamedTuple):
    """Candidate links (E,): from a lost track to a new one, by index, the seconds between them, and their log odds."""

    lost: Ints
    new: Ints
    gap_s: Floats
    log_odds: Floats

    def take(self, which: Bools | Ints) -> _Links:
        lost, new, gap_s, log_odds = self
        return _Links(lost[which], new[which], gap_s[which], log_odds[which])


_NO_LINKS: Final = _Links(_NONE, _NONE, np.empty(0), np.empty(0))


class OnlineLinks:
    """Which tracks are written under which ids: called with the steps of a log, some at a time.

    Parameters
    ----------
    model : MotionModel
        How people move.
    max_gap_s : float
        Links are made over gaps of at most so many seconds; 0 for none.
    min_confidence : float
        The least probability of a link. As offline, odds of a third of this are enough, but not for a track to be
        written sooner.
    confirm_hits : int
        Only tracks with so many observations are continued by one that is not written otherwise.
    """

    def __init__(self, model: MotionModel, max_gap_s: float, min_confidence: float, confirm_hits: int) -> None:
        self._model, self._step_s, self._max_gap_s = model, model.step_s, max_gap_s
        self._confirm_hits = confirm_hits
        self._sure = float(np.log(min_confidence / (1 - min_confidence)))
        self._least = self._sure + float(np.log(linking.ENOUGH))
        self._names: dict[int, int] = {}  # the ids under which tracks are written, of those that were
        self._alive, self._lost = _NOTHING, _NOTHING  # lost ones are over, were written, and are continued by no other
        self._links: deque[tuple[float, float]] = deque(maxlen=_LINKS)  # log odds and seconds
        self._link_count, self._estimated = 0, 0
        self._shifts = linking.prior_shifts(np.empty(0), np.empty(0))

    def __call__(
        self, steps: Ints, tick: Ints, tracks: Ints, state: State, is_observed: Bools, is_written: Bools
    ) -> tuple[Ints, Bools]:
        """The ids under which the tracks alive at each of F steps are written, (R,), and whether they are, (R,).

        ``steps`` (F,) are the numbers of the steps, ``tick`` (R,) the index of the step of each track, rising;
        ``tracks`` (5, R) and ``state`` (R,) are as in ``Step``. ``is_written`` (R,) says which are written in any case.
        Nothing is known at a step that was not known then.
        """
        if self._max_gap_s <= 0:
            return np.asarray(tracks[IDS]), is_written
        alive, which = self._known(steps, tick, tracks, state, is_observed)
        count = len(tick)
        first = np.full(len(alive.ids), count)  # the row from which on a track is written in any case
        written = np.flatnonzero(is_written)
        np.minimum.at(first, which[written], written)
        rows = np.flatnonzero(
            (is_written | is_observed) & (np.arange(count) <= first[which]) & ~self._are_named(alive.ids)[which]
        )
        of = which[rows]
        new = alive.take(of)._replace(last=steps[tick[rows]], hits=tracks[HITS, rows], state=state.take(rows))
        over = np.flatnonzero(alive.over < _NEVER)
        lost = self._lost.joined(alive.take(over))
        # a lost track was written before it was over; or else it has to continue another one
        was_written = np.append(np.ones(len(self._lost.ids), bool), first[over] < count)
        order = np.argsort(lost.ids)  # however many steps are read at once, links of equal odds are chosen by ids
        lost, was_written = lost.take(order), was_written[order]
        is_first = rows == first[of]
        links = self._candidates(lost, new, is_first)
        since = np.full(len(alive.ids), count)  # those that continue another one are written whenever they are observed
        since[[self._names.get(track, track) != track for track in alive.ids.tolist()]] = 0
        used = np.zeros(len(lost.ids), bool)
        for at_once in np.split(np.arange(len(links.new)), np.flatnonzero(np.diff(tick[rows[links.new]])) + 1):
            may_be = ~used[links.lost[at_once]] & (since[of[links.new[at_once]]] == count)
            may_be &= was_written[links.lost[at_once]] | self._are_named(lost.ids[links.lost[at_once]])
            edges = links.take(at_once[may_be])
            chosen = self._decide(edges, is_first[edges.new])
            for ended, other in zip(edges.lost[chosen].tolist(), edges.new[chosen].tolist(), strict=True):
                self._names[int(new.ids[other])] = self._names.get(int(lost.ids[ended]), int(lost.ids[ended]))
                used[ended], since[of[other]] = True, rows[other]
        for track in alive.ids[first < count].tolist():
            self._names.setdefault(track, track)
        reached = lost.last >= steps[-1] - self._max_gap_s / self._step_s
        self._lost = lost.take(reached & ~used & self._are_named(lost.ids))
        self._alive = alive.take(alive.over == _NEVER)
        names = np.array([self._names.get(track, track) for track in alive.ids.tolist()], np.int64)
        kept = {*self._alive.ids.tolist(), *self._lost.ids.tolist()}
        self._names = {track: name for track, name in self._names.items() if track in kept}
        return np.asarray(names[which]), is_written | (is_observed & (np.arange(count) >= since[which]))

    def _are_named(self, ids: Ints) -> Bools:
        return np.array([track in self._names for track in ids.tolist()], bool)

    def _candidates(self, lost: _Known, new: _Known, is_written: Bools) -> _Links:
        """The links with a chance from lost tracks (L,) to new ones (N,), ordered by these, at the steps ``new.last``.

        Those that are not ``is_written`` (N,) may continue only tracks that were confirmed.
        """
        parts = [_NO_LINKS]
        each = max(1, _BATCH // max(len(lost.ids), 1))
        for low in range(0, len(new.ids), each):
            part = slice(low, low + each)
            gaps_s = (new.last[part, None] - lost.last) * self._step_s
            fits = (lost.over <= new.last[part, None]) & (gaps_s <= self._max_gap_s)
            fits &= (lost.last < new.began[part, None]) & (is_written[part, None] | (lost.hits >= self._confirm_hits))
            row, candidate = np.nonzero(fits)
            row, gap_s = row + low, np.asarray(gaps_s[row, candidate], np.float64)
            gaps = linking.Gaps(lost.state.take(candidate), new.state.take(row), gap_s)
            is_near = linking.are_in_reach(gaps)
            candidate, row, gaps = candidate[is_near], row[is_near], gaps.take(is_near)
            before, after, gap_s = gaps
            # nothing is known of the velocity of what was observed once: it may be that of the lost one
            single = new.hits[row] == 1
            after.mean[single, 2:], after.cov[single, 2] = before.mean[single, 2:], before.cov[single, 2]
            log_odds = linking.log_odds(linking.features(self._model, gaps))
            parts.append(_Links(candidate, row, gap_s, log_odds).take(linking.has_chance(log_odds)))
        return _Links(*(np.concatenate(members) for members in zip(*parts, strict=True)))

    def _decide(self, links: _Links, is_written: Bools) -> Bools:
        """Which of the links (E,) at one step are made, to tracks that are written in any case or not."""
        is_made = np.zeros(len(links.new), bool)
        if not len(is_made):
            return is_made
        ends, begins = (np.unique(side, return_inverse=True)[1] for side in (links.lost, links.new))
        best = linking.best_links(ends, begins, links.log_odds, len(is_made))
        shifted = links.log_odds[best] + self._shifts[linking.gap_classes(links.gap_s[best])]
        is_right = shifted > np.where(is_written[best], self._least, self._sure)
        # one that is not written yet is judged again at the next step: it counts once it is
        counts = best[is_written[best] | is_right]
        self._learn(links.log_odds[counts], links.gap_s[counts])
        is_made[best[is_right]] = True
        return is_made

    def _known(self, steps: Ints, tick: Ints, tracks: Ints, state: State, is_observed: Bools) -> tuple[_Known, Ints]:
        """All tracks as known at the last step or when they were over, (K,), and the one that each row (R,) is of."""
        before = self._alive
        names, which = np.unique(np.concatenate([before.ids, tracks[IDS]]), return_inverse=True)
        had, which = which[: len(before.ids)], which[len(before.ids) :]
        ends = np.full(len(names), -1)
        ends[which] = tick  # rising, so the last one stays
        last_row = np.full(len(names), -1)
        seen = np.flatnonzero(is_observed)
        last_row[which[seen]] = seen
        began = np.full(len(names), _NEVER)
        np.minimum.at(began, which, steps[tick])
        began[had] = before.began
        (last, hits), mean, cov = (
            np.zeros((2, len(names)), np.int64),
            np.zeros((len(names), 4)),
            np.zeros((len(names), 3)),
        )
        earlier, now = (before.last, before.hits, *before.state), (steps[tick], tracks[HITS], *state)
        is_seen = last_row >= 0
        for values, was, is_now in zip((last, hits, mean, cov), earlier, now, strict=True):
            values[had] = was
            values[is_seen] = is_now[last_row[is_seen]]
        return _Known(names, began, last, np.append(steps, _NEVER)[ends + 1], hits, State(mean, cov)), which

    def _learn(self, log_odds: Floats, gap_s: Floats) -> None:
        """Learn from the best links so far how many are right after gaps of what length."""
        self._links.extend(zip(log_odds.tolist(), gap_s.tolist(), strict=True))
        self._link_count += len(log_odds)
        if self._link_count > self._estimated + min(_GROWS * self._estimated, _GROWS * _LINKS):
            self._estimated = self._link_count
            self._shifts = linking.prior_shifts(*np.array(self._links).T)
