"""CLEAR MOT (Bernardin and Stiefelhagen 2008): misses, false tracks, identity switches, and how whole the tracks are.

Two evaluators are in use and their rules differ; both are here, by name. Letters: G true people, H tracks in a frame.
"""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from mcaptrack.match import assign, solve
from mcaptrack.metrics.matchup import Matchup

Rules = Literal["trackeval", "motmetrics"]
Counts = dict[str, float]

_EPS: Final = float(np.finfo(float).eps)
_NOBODY: Final = -1


def clear(matchup: Matchup, rules: Rules = "trackeval") -> Counts:
    """The counts of one sequence: TP, FP, FN, IDSW, Frag, MT, PT, ML, GT (people) and the sum of similarities of TP.

    "trackeval" follows TrackEval and the MATLAB devkit: one assignment a frame that keeps the pairs of the frame
    before where it can. "motmetrics" follows py-motmetrics: first every person keeps the track it had last, however
    long ago; then the others are assigned, as many as possible and then as near as possible.
    """
    match = _Matcher(matchup.n_truth, rules)
    frames = zip(matchup.truth, matchup.tracks, matchup.similarity, strict=True)
    for people, tracks, similarity in frames:
        match.frame(people, tracks, similarity, matchup.threshold)
    present, tracked = match.present, match.tracked
    ratio = tracked[present > 0] / present[present > 0]
    mostly = ratio > 0.8 if rules == "trackeval" else ratio >= 0.8
    lost = ratio < 0.2
    return {
        "TP": match.tp,
        "FP": matchup.track_rows - match.tp,
        "FN": matchup.truth_rows - match.tp,
        "IDSW": match.switches,
        "Frag": match.fragmentations(),
        "MT": int(mostly.sum()),
        "PT": int((~mostly & ~lost).sum()),
        "ML": int(lost.sum()),
        "GT": int((present > 0).sum()),
        "similarity_sum": match.similarity_sum,
    }


class _Matcher:
    """The matching of one sequence, frame after frame, and what it has counted so far."""

    def __init__(self, n_truth: int, rules: Rules) -> None:
        self._rules = rules
        self._last = np.full(n_truth, _NOBODY)  # the track each person had last
        self._previous = np.full(n_truth, _NOBODY)  # the track each person had in the frame before
        self._starts = np.zeros(n_truth, int)  # how often each person began to be tracked
        self._pending = np.zeros(n_truth, int)  # motmetrics: misses that become a fragmentation if tracked again
        self._is_tracked = np.zeros(n_truth, bool)
        self._frag = 0
        self.present = np.zeros(n_truth, int)
        self.tracked = np.zeros(n_truth, int)
        self.tp = self.switches = 0
        self.similarity_sum = 0.0

    def frame(
        self, people: NDArray[np.intp], tracks: NDArray[np.intp], similarity: NDArray[np.float64], threshold: float
    ) -> None:
        self.present[people] += 1
        if len(people) == 0 or (len(tracks) == 0 and self._rules == "trackeval"):
            return
        if self._rules == "trackeval":
            rows, columns = self._pairs_trackeval(people, tracks, similarity, threshold)
        else:
            rows, columns = self._pairs_motmetrics(people, tracks, similarity, threshold)
        who, by = people[rows], tracks[columns]
        self.tp += len(rows)
        self.similarity_sum += float(similarity[rows, columns].sum())
        self.switches += int(((self._last[who] != _NOBODY) & (self._last[who] != by)).sum())
        self.tracked[who] += 1
        if self._rules == "trackeval":
            self._starts[who[self._previous[who] == _NOBODY]] += 1
        else:
            self._count_breaks(people, who)
        self._last[who] = by
        self._previous[:] = _NOBODY
        self._previous[who] = by

    def _pairs_trackeval(
        self, people: NDArray[np.intp], tracks: NDArray[np.intp], similarity: NDArray[np.float64], threshold: float
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        score = similarity + 1000.0 * (tracks[None, :] == self._previous[people][:, None])
        score[similarity < threshold - _EPS] = 0
        rows, columns = solve(-score)
        kept = score[rows, columns] > _EPS
        return rows[kept], columns[kept]

    def _pairs_motmetrics(
        self, people: NDArray[np.intp], tracks: NDArray[np.intp], similarity: NDArray[np.float64], threshold: float
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        ok = similarity >= threshold
        kept_rows, kept_columns = np.nonzero(ok & (tracks[None, :] == self._last[people][:, None]))
        # Two people may have had the same track last; the first in order keeps it.
        kept_columns, first = np.unique(kept_columns, return_index=True)
        kept_rows = kept_rows[first]
        cost = np.where(ok, 1 - similarity, np.inf)
        cost[kept_rows, :] = np.inf
        cost[:, kept_columns] = np.inf
        rows, columns = assign(cost, np.finfo(float).max)
        return np.concatenate([kept_rows, rows]), np.concatenate([kept_columns, columns])

    def _count_breaks(self, people: NDArray[np.intp], who: NDArray[np.intp]) -> None:
        """motmetrics: a fragmentation is a change from tracked to missed between first and last tracked frame."""
        self._frag += int(self._pending[who].sum())
        self._pending[who] = 0
        missed = np.setdiff1d(people, who)
        self._pending[missed[self._is_tracked[missed]]] += 1
        self._is_tracked[people] = False
        self._is_tracked[who] = True

    def fragmentations(self) -> int:
        if self._rules == "motmetrics":
            return self._frag
        return int((self._starts[self._starts > 0] - 1).sum())
