"""HOTA (Luiten et al. 2021): detection and association in one number, over all thresholds of similarity."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.match import solve
from mcaptrack.metrics.matchup import Matchup

ALPHAS: Final = np.arange(0.05, 0.99, 0.05)
_EPS: Final = float(np.finfo(float).eps)


def hota(matchup: Matchup) -> dict[str, NDArray[np.float64]]:
    """HOTA_TP, HOTA_FN, HOTA_FP, AssA, LocA of one sequence, each an array over the 19 thresholds ``ALPHAS``."""
    n_truth, n_tracks = matchup.n_truth, matchup.n_tracks
    shape, frames = (n_truth, n_tracks), list(zip(matchup.truth, matchup.tracks, matchup.similarity, strict=True))
    truth_count, track_count = np.zeros(n_truth), np.zeros(n_tracks)
    shared = np.zeros(shape)
    for people, tracks, similarity in frames:
        truth_count[people] += 1
        track_count[tracks] += 1
        either = similarity.sum(axis=0)[None, :] + similarity.sum(axis=1)[:, None] - similarity
        shared[np.ix_(people, tracks)] += np.divide(similarity, either, np.zeros_like(similarity), where=either > _EPS)
    alignment = shared / np.maximum(truth_count[:, None] + track_count[None, :] - shared, _EPS)

    tp, located = np.zeros(len(ALPHAS)), np.zeros(len(ALPHAS))
    matches = np.zeros((len(ALPHAS), *shape))
    for people, tracks, similarity in frames:
        if len(people) == 0 or len(tracks) == 0:
            continue
        rows, columns = solve(-(alignment[np.ix_(people, tracks)] * similarity))
        value = similarity[rows, columns]
        kept = value[None, :] >= ALPHAS[:, None] - _EPS
        tp += kept.sum(axis=1)
        located += (kept * value).sum(axis=1)
        matches[:, people[rows], tracks[columns]] += kept
    association = matches / np.maximum(1, truth_count[:, None] + track_count[None, :] - matches)
    return {
        "HOTA_TP": tp,
        "HOTA_FN": truth_count.sum() - tp,
        "HOTA_FP": track_count.sum() - tp,
        "AssA": (matches * association).sum(axis=(1, 2)) / np.maximum(1, tp),
        "LocA": np.where(tp > 0, np.maximum(located, 1e-10) / np.maximum(tp, 1e-10), 1.0),
    }
