"""Identity scores (Ristani et al. 2016): one track for one person over the whole sequence."""

from __future__ import annotations

import numpy as np

from mcaptrack.evaluation.metrics.matchup import Matchup
from mcaptrack.geometry.assignment import solve


def identity(matchup: Matchup) -> dict[str, float]:
    """IDTP, IDFN, IDFP of one sequence.

    IDTP is the weight of the best pairing of people with tracks, where a pair weighs the frames in which it is similar
    enough. The pairing is solved on the counts themselves: a pair that weighs nothing is the same as no pair.
    """
    shape = (matchup.n_truth, matchup.n_tracks)
    pairs = matchup.pairs
    near = pairs.similarity >= matchup.threshold
    cell = pairs.who[near] * matchup.n_tracks + pairs.by[near]
    together = np.bincount(cell, minlength=shape[0] * shape[1]).reshape(shape).astype(float)
    hits = 0.0
    if together.size:
        rows, columns = solve(-together)
        hits = float(together[rows, columns].sum())
    return {"IDTP": hits, "IDFN": matchup.truth_rows - hits, "IDFP": matchup.track_rows - hits}
