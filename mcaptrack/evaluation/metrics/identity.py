"""Identity scores: one track for each person over the whole sequence."""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.evaluation.metrics.matchup import Matchup
from mcaptrack.geometry.arrays import Floats, Indices
from mcaptrack.geometry.assignment import assign_pairs_by_gain, solve

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
        found, frames = assign_pairs_by_gain((cells // shape[1], cells % shape[1]), together.astype(float), shape)
        return found[0], frames
    if not shape[0] * shape[1]:
        return np.empty(0, np.intp), np.empty(0)
    table = np.bincount(cell, minlength=shape[0] * shape[1]).reshape(shape).astype(float)
    rows, columns = solve(-table)
    return rows, table[rows, columns]
