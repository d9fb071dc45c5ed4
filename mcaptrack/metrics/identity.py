"""Identity scores (Ristani et al. 2016): one track for one person over the whole sequence."""

from __future__ import annotations

import numpy as np

from mcaptrack.match import solve
from mcaptrack.metrics.matchup import Matchup


def identity(matchup: Matchup) -> dict[str, float]:
    """IDTP, IDFN, IDFP of one sequence.

    IDTP is the weight of the best pairing of people with tracks, where a pair weighs the frames in which it is similar
    enough. The pairing is solved on the counts themselves: a pair that weighs nothing is the same as no pair.
    """
    together = np.zeros((matchup.n_truth, matchup.n_tracks))
    for people, tracks, similarity in zip(matchup.truth, matchup.tracks, matchup.similarity, strict=True):
        rows, columns = np.nonzero(similarity >= matchup.threshold)
        together[people[rows], tracks[columns]] += 1
    hits = 0.0
    if together.size:
        rows, columns = solve(-together)
        hits = float(together[rows, columns].sum())
    return {"IDTP": hits, "IDFN": matchup.truth_rows - hits, "IDFP": matchup.track_rows - hits}
