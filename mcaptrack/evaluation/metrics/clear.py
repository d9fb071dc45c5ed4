"""CLEAR MOT (Bernardin and Stiefelhagen 2008): misses, false tracks, identity switches, and how whole the tracks are.

Two evaluators are in use and their rules differ; both are here, by name. What was before matters only in frames in
which pairs compete; everything else is counted for all frames at once.

Letters: G true people, H tracks in a frame; P pairs.
"""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from mcaptrack.evaluation.metrics.matchup import Matchup, Pairs
from mcaptrack.geometry.arrays import Indices
from mcaptrack.geometry.assignment import assign, solve

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
    by_devkit = rules == "trackeval"
    found = matches(matchup, rules)
    present = np.bincount(matchup.all_truth, minlength=matchup.n_truth)
    tracked = np.bincount(found.who, minlength=matchup.n_truth)[present > 0]
    ratio = tracked / present[present > 0]
    mostly = ratio > 0.8 if by_devkit else ratio >= 0.8
    lost = ratio < 0.2
    return {
        "TP": len(found.who),
        "FP": matchup.track_rows - len(found.who),
        "FN": matchup.truth_rows - len(found.who),
        "IDSW": int(switched(found).sum()),
        "Frag": _breaks_trackeval(matchup, found) if by_devkit else _breaks_motmetrics(matchup, found),
        "MT": int(mostly.sum()),
        "PT": int((~mostly & ~lost).sum()),
        "ML": int(lost.sum()),
        "GT": int((present > 0).sum()),
        "similarity_sum": float(found.similarity.sum()),
    }


def matches(matchup: Matchup, rules: Rules = "trackeval") -> Pairs:
    """Who is matched with which track in which frame, by person and then by frame."""
    pairs, by_devkit = matchup.pairs, rules == "trackeval"
    near = pairs.similarity >= matchup.threshold - _EPS if by_devkit else pairs.similarity >= matchup.threshold
    memory = _Memory(matchup)
    found = matchup.solved(pairs.where(near), memory.pairs_trackeval if by_devkit else memory.pairs_motmetrics)
    return found.where(np.lexsort((found.frame, found.who)))


def switched(found: Pairs) -> NDArray[np.bool_]:
    """Which of these matches (P,), ordered by person and frame, are with another track than the person's last."""
    out = np.zeros(len(found.who), bool)
    out[1:] = (found.who[1:] == found.who[:-1]) & (found.by[1:] != found.by[:-1])
    return out


def _breaks_trackeval(matchup: Matchup, found: Pairs) -> int:
    """How often people who were tracked began to be tracked again, after a frame without; ``found`` ordered by person.

    Frames without people or without tracks are passed over, as the devkit does.
    """
    looked_at = np.cumsum((matchup.truth_counts > 0) & (matchup.track_counts > 0))[found.frame]
    again = found.who[1:] == found.who[:-1]
    return int((again & (np.diff(looked_at) > 1)).sum())


def _breaks_motmetrics(matchup: Matchup, found: Pairs) -> int:
    """How often people change from tracked to missed between the first and the last frame in which they are tracked."""
    is_tracked = np.zeros(matchup.truth_rows, bool)
    is_tracked[found.row] = True
    order = np.argsort(matchup.all_truth, kind="stable")
    who, flag = matchup.all_truth[order], is_tracked[order]
    begins = flag.copy()
    begins[1:] &= ~(flag[:-1] & (who[1:] == who[:-1]))
    runs = np.bincount(who[begins], minlength=matchup.n_truth)
    return int((runs[runs > 0] - 1).sum())


class _Memory:
    """The track that each person had, for the frames in which that decides."""

    def __init__(self, matchup: Matchup) -> None:
        self._matchup = matchup
        self._last = np.full(matchup.n_truth, _NOBODY)
        self._looked_at = ((matchup.truth_counts > 0) & (matchup.track_counts > 0)).nonzero()[0]
        self._number = _NOBODY
        self._who = self._by = np.empty(0, np.intp)

    def _decided(self, number: int, rows: Indices, columns: Indices) -> tuple[Indices, Indices]:
        self._number = number
        self._who, self._by = self._matchup.truth[number][rows], self._matchup.tracks[number][columns]
        return rows, columns

    def pairs_trackeval(self, number: int, easy: Pairs, low: int, high: int) -> tuple[Indices, Indices]:
        """The pairs of the frame before are kept where they can be, then similarity counts."""
        matchup, last = self._matchup, self._last
        at = int(np.searchsorted(self._looked_at, number))
        before = int(self._looked_at[at - 1]) if at else _NOBODY
        last[:] = _NOBODY
        if before == self._number:
            last[self._who] = self._by
        else:
            start = low + int(np.searchsorted(easy.frame[low:high], before))
            last[easy.who[start:high]] = easy.by[start:high]
        people, tracks, similarity = matchup.truth[number], matchup.tracks[number], matchup.similarity[number]
        score = similarity + 1000.0 * (tracks[None, :] == last[people][:, None])
        score[similarity < matchup.threshold - _EPS] = 0
        rows, columns = solve(-score)
        kept = score[rows, columns] > _EPS
        return self._decided(number, rows[kept], columns[kept])

    def pairs_motmetrics(self, number: int, easy: Pairs, low: int, high: int) -> tuple[Indices, Indices]:
        """Everybody keeps the track it had last, however long ago; then as many and as near pairs as there can be."""
        matchup = self._matchup
        self._last[self._who] = self._by
        self._last[easy.who[low:high]] = easy.by[low:high]  # of several the last one counts
        people, tracks, similarity = matchup.truth[number], matchup.tracks[number], matchup.similarity[number]
        ok = similarity >= matchup.threshold
        kept_rows, kept_columns = np.nonzero(ok & (tracks[None, :] == self._last[people][:, None]))
        # Two people may have had the same track last; the first in order keeps it.
        kept_columns, first = np.unique(kept_columns, return_index=True)
        kept_rows = kept_rows[first]
        cost = np.where(ok, 1 - similarity, np.inf)
        cost[kept_rows, :] = np.inf
        cost[:, kept_columns] = np.inf
        rows, columns = assign(cost, np.finfo(float).max)
        return self._decided(number, np.concatenate([kept_rows, rows]), np.concatenate([kept_columns, columns]))
