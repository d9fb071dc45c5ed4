"""HOTA (Luiten et al. 2021): detection and association in one number, over all thresholds of similarity.

Letters: P pairs, M pairs of a person and a track that are matched at least once, A thresholds.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.evaluation.metrics.matchup import Matchup
from mcaptrack.geometry.arrays import Indices
from mcaptrack.geometry.assignment import solve

ALPHAS: Final = np.arange(0.05, 0.99, 0.05)
_EPS: Final = float(np.finfo(float).eps)


def hota(matchup: Matchup) -> dict[str, NDArray[np.float64]]:
    """HOTA_TP, HOTA_FN, HOTA_FP, AssA, LocA of one sequence, each an array over the 19 thresholds ``ALPHAS``."""
    n_truth, n_tracks, pairs = matchup.n_truth, matchup.n_tracks, matchup.pairs
    truth_count = np.bincount(matchup.all_truth, minlength=n_truth)
    track_count = np.bincount(matchup.all_tracks, minlength=n_tracks)
    of_row, of_column = np.bincount(pairs.row, pairs.similarity), np.bincount(pairs.column, pairs.similarity)
    share = pairs.similarity / (of_column[pairs.column] + of_row[pairs.row] - pairs.similarity)
    cell = pairs.who * n_tracks + pairs.by
    shared = np.bincount(cell, share, minlength=n_truth * n_tracks).reshape(n_truth, n_tracks)
    alignment = shared / np.maximum(truth_count[:, None] + track_count[None, :] - shared, _EPS)

    def solve_frame(number: int, *_: object) -> tuple[Indices, Indices]:
        who, by = matchup.truth[number], matchup.tracks[number]
        return solve(-(alignment[who[:, None], by] * matchup.similarity[number]))

    found = matchup.solved(pairs, solve_frame)
    # How many of the thresholds a match passes; then, for each threshold, what passes it.
    passed = np.searchsorted(ALPHAS - _EPS, found.similarity, "right")
    levels = len(ALPHAS) + 1
    tp = _at_least(np.bincount(passed, minlength=levels))
    located = _at_least(np.bincount(passed, found.similarity, minlength=levels))
    cells, at = np.unique(found.who * n_tracks + found.by, return_inverse=True)
    counts = np.bincount(at * levels + passed, minlength=levels * len(cells)).reshape(len(cells), levels)
    matches = _at_least(counts)  # (M, A)
    there = (truth_count[cells // n_tracks] + track_count[cells % n_tracks])[:, None] if n_tracks else matches
    association = matches / np.maximum(1, there - matches)
    return {
        "HOTA_TP": tp,
        "HOTA_FN": len(matchup.all_truth) - tp,
        "HOTA_FP": len(matchup.all_tracks) - tp,
        "AssA": (matches * association).sum(axis=0) / np.maximum(1, tp),
        "LocA": np.where(tp > 0, np.maximum(located, 1e-10) / np.maximum(tp, 1e-10), 1.0),
    }


def _at_least(by_level: NDArray[np.generic]) -> NDArray[np.float64]:
    """Counts by the number of thresholds passed (..., A + 1) -> counts of what passes each threshold (..., A)."""
    return np.cumsum(by_level[..., ::-1], axis=-1)[..., ::-1][..., 1:].astype(float)
