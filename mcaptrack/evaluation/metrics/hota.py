"""HOTA: detection and association in one number, over a range of similarity thresholds.

Letters: P pairs, M pairs of a person and a track that are matched at least once, A thresholds.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.evaluation.metrics.matchup import Matchup, SparseTables
from mcaptrack.geometry.arrays import Indices

ALPHAS: Final = np.arange(0.05, 0.99, 0.05)
_EPS: Final = float(np.finfo(float).eps)


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

    found = matchup.assigned(pairs, solve_frame)
    # The number of thresholds that each match passes; from that, the matches that pass each threshold.
    passed = np.searchsorted(ALPHAS - _EPS, found.similarity, "right")
    levels = len(ALPHAS) + 1
    tp = _at_least(np.bincount(passed, minlength=levels))
    located = _at_least(np.bincount(passed, found.similarity, minlength=levels))
    cells, at = np.unique(found.person * n_tracks + found.track, return_inverse=True)
    counts = np.bincount(at * levels + passed, minlength=levels * len(cells)).reshape(len(cells), levels)
    matches = _at_least(counts)  # (M, A)
    there = (truth_count[cells // n_tracks] + track_count[cells % n_tracks])[:, None] if n_tracks else matches
    association = matches / (there - matches)  # a match counts twice in ``there``, so that this is 1 at least
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
