"""Scores of tracking and prediction: arrays in, numbers out. No module here knows a file, a channel or a tracker.

matchup = Matchup(...)                 ground truth and tracks of one sequence, and how similar they are
summary(score(matchup))                MOTA, IDF1, HOTA and their counts
summary(combine([score(a), score(b)])) the same over several sequences
average_over_recalls([ScoredMatchup(matchup, scores_of_tracks)])   AMOTA, AMOTP and sAMOTA
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.evaluation.metrics.matchup import Matchup, RowPairs, SparseTables, distances, metres_to_similarity
from mcaptrack.geometry.arrays import Bools, Floats, Indices, taken
from mcaptrack.geometry.assignment import assign, assign_pairs_by_gain, solve

__all__ = [
    "Matchup",
    "Rules",
    "Score",
    "ScoredMatchup",
    "average_over_recalls",
    "combine",
    "distances",
    "metres_to_similarity",
    "score",
    "summary",
]


#: The rates of ``summary``; its other numbers are counts.
RATES: Final = ("MOTA", "IDF1", "IDP", "IDR", "HOTA", "DetA", "AssA", "LocA")


# HOTA: detection and association in one number, over a range of similarity thresholds.
#
# Letters: P pairs, M pairs of a person and a track that are matched at least once, A thresholds.


ALPHAS: Final = np.arange(0.05, 0.99, 0.05)


# CLEAR MOT: missed detections, false positives, identity switches and fragmentation.
#
# Two evaluators are in use, TrackEval and py-motmetrics, and their rules differ; both are implemented. Earlier
# frames matter only in frames in which several pairs compete; all other frames are counted at once.
#
# Letters: G people of the ground truth, H tracks in a frame; P pairs.


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
    assigned = matchup.assigned(taken(pairs, near), memory.pairs_trackeval if by_devkit else memory.pairs_motmetrics)
    return taken(assigned, np.lexsort((assigned.frame, assigned.person)))


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


def hota(matchup: Matchup) -> dict[str, NDArray[np.float64]]:
    """Compute the parts of HOTA [1]_ of one sequence at the 19 thresholds ``ALPHAS``.

    Parameters
    ----------
    matchup : Matchup
        Ground truth and tracks of the sequence; its threshold is not used.

    Returns
    -------
    dict of arrays (19,)
        HOTA_TP, HOTA_FN, HOTA_FP: counts of rows. AssA: association accuracy. LocA: localisation accuracy.

    References
    ----------
    .. [1] J. Luiten, A. Osep, P. Dendorfer, P. Torr, A. Geiger, L. Leal-Taixe, B. Leibe: HOTA: A Higher Order Metric
    for
       Evaluating Multi-Object Tracking. International Journal of Computer Vision 129, 2021.

    Examples
    --------
    >>> import numpy as np
    >>> from mcaptrack.evaluation.metrics import Matchup
    >>> first, second, same = np.array([0]), np.array([1]), np.ones((1, 1))
    >>> found = hota(Matchup((first, first), (first, second), (same, same), 0.5, n_ground_truth=1, n_tracks=2))
    >>> found["HOTA_TP"][0].item(), found["AssA"][0].item()
    (2.0, 0.5)
    """
    n_ground_truth, n_tracks, pairs = matchup.n_ground_truth, matchup.n_tracks, matchup.pairs
    truth_count = np.bincount(matchup.all_ground_truth, minlength=n_ground_truth)
    track_count = np.bincount(matchup.all_tracks, minlength=n_tracks)
    of_row, of_column = np.bincount(pairs.row, pairs.similarity), np.bincount(pairs.column, pairs.similarity)
    share = pairs.similarity / (of_column[pairs.column] + of_row[pairs.row] - pairs.similarity)
    # Only people and tracks that are alike in some frame have an alignment: a table of all would be far larger.
    cell, of_pair = np.unique(pairs.person * n_tracks + pairs.track, return_inverse=True)
    shared = np.bincount(of_pair, share, minlength=len(cell))
    together = truth_count[cell // max(1, n_tracks)] + track_count[cell % max(1, n_tracks)]
    gain = (shared / np.maximum(together - shared, _EPS))[of_pair] * pairs.similarity
    ends = (np.append(0, np.cumsum(counts)) for counts in (matchup.ground_truth_counts, matchup.track_counts))
    gains = SparseTables(pairs.frame, pairs.row, pairs.column, gain, *ends)

    def solve_frame(number: int, *_: object) -> tuple[Indices, Indices]:
        return gains.best(number)

    matched = matchup.assigned(pairs, solve_frame)
    # The number of thresholds that each match passes; from that, the matches that pass each threshold.
    passed = np.searchsorted(ALPHAS - _EPS, matched.similarity, "right")
    levels = len(ALPHAS) + 1
    tp = _at_least(np.bincount(passed, minlength=levels))
    located = _at_least(np.bincount(passed, matched.similarity, minlength=levels))
    cells, at = np.unique(matched.person * n_tracks + matched.track, return_inverse=True)
    counts = np.bincount(at * levels + passed, minlength=levels * len(cells)).reshape(len(cells), levels)
    matches = _at_least(counts)  # (M, A)
    total = (truth_count[cells // n_tracks] + track_count[cells % n_tracks])[:, None] if n_tracks else matches
    association = matches / (total - matches)  # a match counts twice in ``total``, so that this is 1 at least
    return {
        "HOTA_TP": tp,
        "HOTA_FN": len(matchup.all_ground_truth) - tp,
        "HOTA_FP": len(matchup.all_tracks) - tp,
        "AssA": (matches * association).sum(axis=0) / np.maximum(1, tp),
        "LocA": np.where(tp > 0, np.maximum(located, 1e-10) / np.maximum(tp, 1e-10), 1.0),
    }


def _at_least(by_level: NDArray[np.generic]) -> NDArray[np.float64]:
    """Counts by number of passed thresholds (..., A + 1) -> counts that pass each threshold (..., A)."""
    return np.cumsum(by_level[..., ::-1], axis=-1)[..., ::-1][..., 1:].astype(float)


class Score(NamedTuple):
    """The scores of a sequence that can be added up: counts, and the parts of HOTA at its 19 thresholds."""

    counts: dict[str, float]
    hota: dict[str, NDArray[np.float64]]


# Identity scores: one track for each person over the whole sequence.


#: Larger tables of people and tracks are not made: most of their pairs never meet.
_LARGE: Final = 100_000


def identity(matchup: Matchup) -> dict[str, float]:
    """Count identity true and false positives and negatives [1]_ of one sequence.

    The best one-to-one assignment of people to tracks is found for the whole sequence; a pair weighs the number of
    frames in which it is at least as similar as the threshold. Pairs of weight zero are the same as no pair.

    Parameters
    ----------
    matchup : Matchup
        Ground truth and tracks of the sequence.

    Returns
    -------
    dict
        IDTP: rows matched under the best assignment. IDFN, IDFP: the other rows of the ground truth and of the tracks.

    References
    ----------
    .. [1] E. Ristani, F. Solera, R. Zou, R. Cucchiara, C. Tomasi: Performance Measures and a Data Set for Multi-Target,
       Multi-Camera Tracking. ECCV Workshops 2016.

    Examples
    --------
    >>> import numpy as np
    >>> from mcaptrack.evaluation.metrics import Matchup
    >>> first, second, same = np.array([0]), np.array([1]), np.ones((1, 1))
    >>> identity(Matchup((first, first), (first, second), (same, same), 0.5, n_ground_truth=1, n_tracks=2))
    {'IDTP': 1.0, 'IDFN': 1.0, 'IDFP': 1.0}
    """
    hits = float(best_tracks(matchup)[1].sum())
    return {"IDTP": hits, "IDFN": matchup.ground_truth_rows - hits, "IDFP": matchup.track_rows - hits}


def best_tracks(matchup: Matchup, large: int = _LARGE) -> tuple[Indices, Floats]:
    """The people of the best assignment of one track to each, and in how many frames they match, (P,) each.

    No table is made of more than ``large`` cells.
    """
    shape = (matchup.n_ground_truth, matchup.n_tracks)
    pairs = matchup.pairs
    near = pairs.similarity >= matchup.threshold
    cell = pairs.person[near] * matchup.n_tracks + pairs.track[near]
    if shape[0] * shape[1] > large:
        cells, together = np.unique(cell, return_counts=True)
        pair, frames = assign_pairs_by_gain((cells // shape[1], cells % shape[1]), together.astype(float), shape)
        return pair[0], frames
    if not shape[0] * shape[1]:
        return np.empty(0, np.intp), np.empty(0)
    table = np.bincount(cell, minlength=shape[0] * shape[1]).reshape(shape).astype(float)
    rows, columns = solve(-table)
    return rows, table[rows, columns]


def score(matchup: Matchup, rules: Rules = "trackeval") -> Score:
    """Compute CLEAR, identity and HOTA scores of one sequence.

    Parameters
    ----------
    matchup : Matchup
        Ground truth and tracks of the sequence.
    rules : {"trackeval", "motmetrics"}
        Rules of CLEAR for keeping pairs from frame to frame, see `clear`.

    Returns
    -------
    Score
        Counts of CLEAR and identity, and the parts of HOTA; input of `combine` and `summary`.

    Examples
    --------
    >>> import numpy as np
    >>> first, second, same = np.array([0]), np.array([1]), np.ones((1, 1))
    >>> matchup = Matchup((first, first), (first, second), (same, same), 0.5, n_ground_truth=1, n_tracks=2)
    >>> found = summary(score(matchup))
    >>> found["IDSW"], found["IDF1"]
    (1, 0.5)
    """
    return Score(clear(matchup, rules) | identity(matchup), hota(matchup))


def combine(scores: Sequence[Score]) -> Score:
    """Combine the scores of several sequences: counts are added, AssA and LocA weighted by matches at each threshold.

    Parameters
    ----------
    scores : sequence of Score
        At least one.

    Returns
    -------
    Score
        The scores of all sequences together.

    Examples
    --------
    >>> import numpy as np
    >>> one, same = np.array([0]), np.ones((1, 1))
    >>> matchup = Matchup((one,), (one,), (same,), 0.5, n_ground_truth=1, n_tracks=1)
    >>> combine([score(matchup), score(matchup)]).counts["TP"]
    2
    """
    counts = {name: sum(part.counts[name] for part in scores) for name in scores[0].counts}
    tp = np.stack([part.hota["HOTA_TP"] for part in scores])
    total = tp.sum(axis=0)
    parts = {name: sum(part.hota[name] for part in scores) for name in ("HOTA_TP", "HOTA_FN", "HOTA_FP")}
    for name in ("AssA", "LocA"):
        weighted = (tp * np.stack([part.hota[name] for part in scores])).sum(axis=0)
        parts[name] = np.maximum(weighted, 1e-10 * (name == "LocA")) / np.maximum(total, 1e-10)
    return Score(counts, {name: np.asarray(values) for name, values in parts.items()})


def summary(part: Score) -> dict[str, Any]:
    """Compute the usual rates (between 0 and 1, MOTA at most 1) and counts of a score.

    Parameters
    ----------
    part : Score
        Of one sequence or of several.

    Returns
    -------
    dict
        MOTA, IDF1, IDP, IDR, HOTA, DetA, AssA and LocA as floats; IDSW, FP, FN, Frag, MT, PT, ML and GT as ints.
        Without ground truth MOTA is 0, as in TrackEval; it has no meaning then.

    Examples
    --------
    >>> import numpy as np
    >>> one, same = np.array([0]), np.ones((1, 1))
    >>> summary(score(Matchup((one,), (one,), (same,), 0.5, n_ground_truth=1, n_tracks=1)))["MOTA"]
    1.0
    """
    c, h = part.counts, part.hota
    det_a = h["HOTA_TP"] / np.maximum(1, h["HOTA_TP"] + h["HOTA_FN"] + h["HOTA_FP"])

    def ratio(a: float, b: float) -> float:
        return a / max(b, 1.0)

    return {
        "MOTA": ratio(c["TP"] - c["FP"] - c["IDSW"], c["TP"] + c["FN"]) if c["TP"] + c["FN"] else 0.0,
        "IDF1": ratio(2 * c["IDTP"], 2 * c["IDTP"] + c["IDFP"] + c["IDFN"]),
        "IDP": ratio(c["IDTP"], c["IDTP"] + c["IDFP"]),
        "IDR": ratio(c["IDTP"], c["IDTP"] + c["IDFN"]),
        "HOTA": float(np.sqrt(det_a * h["AssA"]).mean()),
        "DetA": float(det_a.mean()),
        "AssA": float(h["AssA"].mean()),
        "LocA": float(h["LocA"].mean()),
        **{name: int(c[name]) for name in ("IDSW", "FP", "FN", "Frag", "MT", "PT", "ML", "GT")},
    }


# Scores averaged over recalls: AMOTA and AMOTP of nuScenes, sAMOTA and AMOTA of AB3DMOT.
#
# A tracker that may drop its less certain tracks trades recall for precision. These scores drop tracks by their
# score, and average over the recalls that this gives.
#
# Letters: P pairs, R recalls, H tracks.


#: The number of recalls.
_RECALLS: Final = 40
#: The least recall of nuScenes.
_LEAST: Final = 0.1


class ScoredMatchup(NamedTuple):
    """A matchup, and the scores of its tracks (H,): the mean score of the boxes of each."""

    matchup: Matchup
    score: Floats


class _Counts(NamedTuple):
    """Counts of all sequences with the tracks from a score on: matches, false positives, switches, similarity."""

    tp: int
    fp: int
    switches: int
    similarity_sum: float


def average_over_recalls(
    parts: Sequence[ScoredMatchup], rules: Rules = "trackeval", worst: float = 0.5
) -> dict[str, float]:
    """Average CLEAR scores over the recalls of one class.

    For each of 40 recalls r the least score is found from which on tracks reach it (by interpolation between the scores
    of all matches), the other tracks are dropped, and the rest is matched again. With P rows of ground truth:

    AMOTA [1]_: mean of MOTAR = max(0, 1 - (IDSW + FP + FN - (1 - r) P) / (r P)) over r from 0.1 to 1; in this formula
    the r that the tracks reach, as in the benchmark's own evaluator. AMOTP: mean similarity of matches over the same r.
    sAMOTA [2]_: mean of max(0, min(1, 1 - (IDSW + FP + FN - (1 - r) P) / (r P))) over r = 1/40, 2/40, ..., 1.
    AMOTA_unscaled: AMOTA of [2]_, the mean of MOTA over the same r as sAMOTA. A recall that is never reached counts as
    0, and in AMOTP as ``worst``.

    Parameters
    ----------
    parts : sequence of ScoredMatchup
        The matchups of all sequences, with the scores of tracks.
    rules : {"trackeval", "motmetrics"}
        Rules of CLEAR, see `clear`.
    worst : float
        The similarity of recalls that are not reached, for AMOTP: that at the gate for distances, 0 for overlaps.

    Returns
    -------
    dict
        AMOTA, AMOTP, sAMOTA and AMOTA_unscaled; NaN without ground truth. AMOTP is a similarity.

    References
    ----------
    .. [1] H. Caesar, V. Bankiti, A. H. Lang, S. Vora, V. E. Liong, Q. Xu, A. Krishnan, Y. Pan, G. Baldan, O. Beijbom:
       nuScenes: A Multimodal Dataset for Autonomous Driving. CVPR 2020; the definition is that of the tracking task.
    .. [2] X. Weng, J. Wang, D. Held, K. Kitani: 3D Multi-Object Tracking: A Baseline and New Evaluation Metrics.
       IROS 2020.

    Examples
    --------
    Two objects in two frames; one is tracked, the other is not, so that recalls above 0.5 are not reached:

    >>> import numpy as np
    >>> from mcaptrack.evaluation.metrics import Matchup
    >>> both, one, similarity = np.array([0, 1]), np.array([0]), np.array([[1.0], [0.0]])
    >>> matchup = Matchup((both, both), (one, one), (similarity, similarity), 0.5, n_ground_truth=2, n_tracks=1)
    >>> found = average_over_recalls([ScoredMatchup(matchup, np.array([0.9]))])
    >>> found["AMOTA"], found["AMOTP"], found["sAMOTA"]
    (0.45, 0.725, 0.5)
    """
    total = sum(part.matchup.ground_truth_rows for part in parts)
    if not total:
        return dict.fromkeys(("AMOTA", "AMOTP", "sAMOTA", "AMOTA_unscaled"), float("nan"))
    matched_scores = [part.score[matches(part.matchup, rules).track] for part in parts]
    scores = np.sort(np.concatenate(matched_scores))[::-1]
    counts_of: dict[tuple[bytes, ...], _Counts] = {}

    def at(recalls: Floats) -> list[tuple[float, _Counts]]:
        """The recalls that are reached, each with its counts."""
        reached = recalls <= len(scores) / total
        found_recalls = np.arange(1, len(scores) + 1) / total
        least = np.interp(recalls[reached], found_recalls, scores) if len(scores) else np.empty(0)
        out = []
        for recall, score in zip(recalls[reached].tolist(), least.tolist(), strict=True):
            kept = [part.score >= score for part in parts]
            key = tuple(mask.tobytes() for mask in kept)
            if key not in counts_of:
                counts_of[key] = _count(
                    [_of_tracks(part.matchup, mask) for part, mask in zip(parts, kept, strict=True)], rules
                )
            out.append((recall, counts_of[key]))
        return out

    nuscenes = [counts for _, counts in at(np.linspace(_LEAST, 1, _RECALLS).round(12))]
    motar = [max(0.0, 1 - (at_recall.switches + at_recall.fp) / at_recall.tp) for at_recall in nuscenes if at_recall.tp]
    motp = [at_recall.similarity_sum / at_recall.tp for at_recall in nuscenes if at_recall.tp]
    by_target = at(np.arange(1, _RECALLS + 1) / _RECALLS)
    right = [(recall * total, counts.tp - counts.fp - counts.switches) for recall, counts in by_target]
    return {
        "AMOTA": sum(motar) / _RECALLS,
        "AMOTP": (sum(motp) + worst * (_RECALLS - len(motp))) / _RECALLS,
        "sAMOTA": sum(min(1.0, max(0.0, hits / wanted)) for wanted, hits in right) / _RECALLS,
        "AMOTA_unscaled": sum(hits / total for _, hits in right) / _RECALLS,
    }


def _count(matchups: Sequence[Matchup], rules: Rules) -> _Counts:
    matched = [matches(matchup, rules) for matchup in matchups]
    tp = sum(len(pairs.person) for pairs in matched)
    return _Counts(
        tp,
        sum(matchup.track_rows for matchup in matchups) - tp,
        sum(int(is_switch(pairs).sum()) for pairs in matched),
        float(sum(pairs.similarity.sum() for pairs in matched)),
    )


def _of_tracks(matchup: Matchup, kept: Bools) -> Matchup:
    """A matchup with some of its tracks (H,)."""
    if kept.all():
        return matchup
    tracks = tuple(tracks[kept[tracks]] for tracks in matchup.tracks)
    return replace(matchup, tracks=tracks, similarity=matchup.tables.of_columns(kept[matchup.all_tracks]))
