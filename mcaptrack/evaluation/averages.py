"""Scores of 3D tracks averaged over recalls (AMOTA, sAMOTA), with the scores of tracks that they need.

Letters: N rows, H tracks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from mcaptrack.evaluation.aligned import LocatedRows, RowComparison, Similarity
from mcaptrack.evaluation.metrics import Rules, ScoredMatchup, average_over_recalls
from mcaptrack.geometry.arrays import Floats

#: The similarity of a recall that is not reached: a distance at the gate, no overlap.
_WORST: Final[dict[Similarity, float]] = {"metres": 0.5}
_AMOTP: Final = "AMOTP"


def scored_matchups(compared: RowComparison) -> tuple[ScoredMatchup, ...]:
    """A comparison with the scores of its tracks; none if no track has any."""
    score = _track_scores(compared.tracks)
    known = np.isfinite(score)
    if len(score) and not known.any():
        return ()
    return (ScoredMatchup(compared.matchup, np.where(known, score, score[known].min(initial=0.0))),)


def _track_scores(tracks: LocatedRows) -> Floats:
    """The mean score of the boxes of each track (H,), of those that a detection stands behind if there are any."""
    count, score = len(tracks.ids), tracks.rows["score"].astype(float)
    out = np.full(count, np.nan)
    for used in (np.isfinite(score), np.isfinite(score) & tracks.rows["observed"]):
        of, rows = tracks.track[used], np.bincount(tracks.track[used], minlength=count)
        total = np.bincount(of, score[used], minlength=count)
        out[rows > 0] = total[rows > 0] / rows[rows > 0]
    return out


def averages(parts: Sequence[ScoredMatchup], similarity: Similarity, gate: float, rules: Rules) -> dict[str, float]:
    """The averages over recalls of one class, in all sequences; AMOTP is a distance (AMOTP_m) or an overlap."""
    found = average_over_recalls(parts, rules, _WORST.get(similarity, 0.0))
    if similarity == "metres":
        found["AMOTP_m"] = 2 * gate * (1 - found.pop(_AMOTP))
    return found


def mean_of_classes(of_classes: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The averages of all classes together: their means over classes, as nuScenes gives them."""
    return {name: float(np.mean([one[name] for one in of_classes])) for name in (of_classes[0] if of_classes else ())}
