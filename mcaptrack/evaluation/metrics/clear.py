"""CLEAR MOT: missed detections, false positives, identity switches and fragmentation.

Two evaluators are in use, TrackEval and py-motmetrics, and their rules differ; both are implemented. Earlier frames
matter only in frames in which several pairs compete; all other frames are counted at once.

Letters: G people of the ground truth, H tracks in a frame; P pairs.
"""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from mcaptrack.evaluation.metrics.matchup import Matchup, RowPairs
from mcaptrack.geometry.arrays import Indices
from mcaptrack.geometry.assignment import assign, solve

Rules = Literal["trackeval", "motmetrics"]
Counts = dict[str, float]

_EPS: Final = float(np.finfo(float).eps)
_NO_ID: Final = -1


def clear(matchup: Matchup, rules: Rules = "trackeval") -> Counts:
    """Count the errors that CLEAR MOT defines [1]_, in one sequence.

    Parameters
    ----------
    matchup : Matchup
        Ground truth and tracks of the sequence.
    rules : {"trackeval", "motmetrics"}
        "trackeval" follows TrackEval and the MATLAB devkit of MOTChallenge: one assignment for each frame, which keeps
        the pairs of the previous frame where possible. "motmetrics" follows py-motmetrics: first each person keeps
        their last track, however long ago that was; the others are then assigned, as many as possible at the least
        cost.

    Returns
    -------
    dict
        TP, FP, FN: matched rows, rows of tracks without a person, rows of people without a track. IDSW: identity
        switches. Frag: fragmentations. MT, PT, ML: people who are mostly tracked, partly tracked, mostly lost. GT:
        people. similarity_sum: sum of the similarities of matched rows.

    References
    ----------
    .. [1] K. Bernardin, R. Stiefelhagen: Evaluating Multiple Object Tracking Performance: The CLEAR MOT Metrics.
    EURASIP
       Journal on Image and Video Processing, 2008, 246309.

    Examples
    --------
    One person in two frames, followed by track 0 and then by track 1:

    >>> import numpy as np
    >>> from mcaptrack.evaluation.metrics import Matchup
    >>> first, second, same = np.array([0]), np.array([1]), np.ones((1, 1))
    >>> found = clear(Matchup((first, first), (first, second), (same, same), 0.5, n_ground_truth=1, n_tracks=2))
    >>> found["TP"], found["IDSW"], found["MT"]
    (2, 1, 1)
    """
    by_devkit = rules == "trackeval"
    pairs = matches(matchup, rules)
    present = np.bincount(matchup.all_ground_truth, minlength=matchup.n_ground_truth)
    tracked = np.bincount(pairs.person, minlength=matchup.n_ground_truth)[present > 0]
    ratio = tracked / present[present > 0]
    mostly = ratio > 0.8 if by_devkit else ratio >= 0.8
    lost = ratio < 0.2
    return {
        "TP": len(pairs.person),
        "FP": matchup.track_rows - len(pairs.person),
        "FN": matchup.ground_truth_rows - len(pairs.person),
        "IDSW": int(is_switch(pairs).sum()),
        "Frag": _fragments_trackeval(matchup, pairs) if by_devkit else _fragments_motmetrics(matchup, pairs),
        "MT": int(mostly.sum()),
        "PT": int((~mostly & ~lost).sum()),
        "ML": int(lost.sum()),
        "GT": int((present > 0).sum()),
        "similarity_sum": float(pairs.similarity.sum()),
    }


def matches(matchup: Matchup, rules: Rules = "trackeval") -> RowPairs:
    """The matched pairs of all frames, ordered by person and frame."""
    pairs, by_devkit = matchup.pairs, rules == "trackeval"
    near = pairs.similarity >= matchup.threshold - _EPS if by_devkit else pairs.similarity >= matchup.threshold
    memory = _LastTracks(matchup)
    assigned = matchup.assigned(pairs.where(near), memory.pairs_trackeval if by_devkit else memory.pairs_motmetrics)
    return assigned.where(np.lexsort((assigned.frame, assigned.person)))


def is_switch(pairs: RowPairs) -> NDArray[np.bool_]:
    """Mark the matches (P,) with another track than the person's last; matches are ordered by person and frame."""
    out = np.zeros(len(pairs.person), bool)
    out[1:] = (pairs.person[1:] == pairs.person[:-1]) & (pairs.track[1:] != pairs.track[:-1])
    return out


def _fragments_trackeval(matchup: Matchup, pairs: RowPairs) -> int:
    """Count how often people are tracked again after a frame without a match; ``pairs`` is ordered by person.

    Frames without people or without tracks are skipped, as in the devkit.
    """
    looked_at = np.cumsum((matchup.ground_truth_counts > 0) & (matchup.track_counts > 0))[pairs.frame]
    again = pairs.person[1:] == pairs.person[:-1]
    return int((again & (np.diff(looked_at) > 1)).sum())


def _fragments_motmetrics(matchup: Matchup, pairs: RowPairs) -> int:
    """Count changes from tracked to missed between the first and the last frame in which a person is tracked."""
    is_tracked = np.zeros(matchup.ground_truth_rows, bool)
    is_tracked[pairs.row] = True
    order = np.argsort(matchup.all_ground_truth, kind="stable")
    person, flag = matchup.all_ground_truth[order], is_tracked[order]
    begins = flag.copy()
    begins[1:] &= ~(flag[:-1] & (person[1:] == person[:-1]))
    runs = np.bincount(person[begins], minlength=matchup.n_ground_truth)
    return int((runs[runs > 0] - 1).sum())


class _LastTracks:
    """The last track of each person, kept for the frames in which pairs compete."""

    def __init__(self, matchup: Matchup) -> None:
        self._matchup = matchup
        self._last = np.full(matchup.n_ground_truth, _NO_ID)
        self._looked_at = ((matchup.ground_truth_counts > 0) & (matchup.track_counts > 0)).nonzero()[0]
        self._number = _NO_ID
        self._persons = self._tracks = np.empty(0, np.intp)

    def _decided(self, number: int, rows: Indices, columns: Indices) -> tuple[Indices, Indices]:
        self._number = number
        self._persons, self._tracks = self._matchup.ground_truth[number][rows], self._matchup.tracks[number][columns]
        return rows, columns

    def pairs_trackeval(self, number: int, easy: RowPairs, low: int, high: int) -> tuple[Indices, Indices]:
        """Keep the pairs of the previous frame where possible; assign the rest by similarity."""
        matchup, last = self._matchup, self._last
        at = int(np.searchsorted(self._looked_at, number))
        before = int(self._looked_at[at - 1]) if at else _NO_ID
        last[:] = _NO_ID
        if before == self._number:
            last[self._persons] = self._tracks
        else:
            start = low + int(np.searchsorted(easy.frame[low:high], before))
            last[easy.person[start:high]] = easy.track[start:high]
        people, tracks = matchup.ground_truth[number], matchup.tracks[number]
        if matchup.tables.is_large(number):
            rows, columns, similarity = matchup.tables.pairs_of(number)
            score = similarity + 1000.0 * (tracks[columns] == last[people[rows]])
            score[similarity < matchup.threshold - _EPS] = 0
            return self._decided(number, *matchup.tables.best(number, score))
        similarity = matchup.tables[number]
        score = similarity + 1000.0 * (tracks[None, :] == last[people][:, None])
        score[similarity < matchup.threshold - _EPS] = 0
        rows, columns = solve(-score)
        kept = score[rows, columns] > _EPS
        return self._decided(number, rows[kept], columns[kept])

    def pairs_motmetrics(self, number: int, easy: RowPairs, low: int, high: int) -> tuple[Indices, Indices]:
        """Keep each person's last track, however long ago; then assign as many pairs as possible at the least cost."""
        matchup = self._matchup
        self._last[self._persons] = self._tracks
        self._last[easy.person[low:high]] = easy.track[low:high]  # the last one of several counts
        people, tracks = matchup.ground_truth[number], matchup.tracks[number]
        if matchup.tables.is_large(number):
            return self._decided(number, *self._largest_motmetrics(number, people, tracks))
        similarity = matchup.tables[number]
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

    def _largest_motmetrics(self, number: int, people: Indices, tracks: Indices) -> tuple[Indices, Indices]:
        """As ``pairs_motmetrics``, for a frame with a table of all pairs that would be too large."""
        tables = self._matchup.tables
        rows, columns, similarity = tables.pairs_of(number)
        ok = similarity >= self._matchup.threshold
        kept = np.flatnonzero(ok & (tracks[columns] == self._last[people[rows]]))
        kept = kept[np.unique(columns[kept], return_index=True)[1]]
        ok &= ~np.isin(rows, rows[kept]) & ~np.isin(columns, columns[kept])
        # One more pair gains more than all similarities together.
        more_rows, more_columns = tables.best(number, np.where(ok, len(people) + 1.0 + similarity, 0.0))
        return np.concatenate([rows[kept], more_rows]), np.concatenate([columns[kept], more_columns])
