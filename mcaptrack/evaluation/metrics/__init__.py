"""Scores of tracking and prediction: arrays in, numbers out. No module here knows a file, a channel or a tracker.

matchup = Matchup(...)                 ground truth and tracks of one sequence, and how similar they are
summary(score(matchup))                MOTA, IDF1, HOTA and their counts
summary(combine([score(a), score(b)])) the same over several sequences
average_over_recalls([ScoredMatchup(matchup, scores_of_tracks)])   AMOTA, AMOTP and sAMOTA
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.evaluation.metrics.clear import Rules, clear
from mcaptrack.evaluation.metrics.hota import hota
from mcaptrack.evaluation.metrics.identity import identity
from mcaptrack.evaluation.metrics.matchup import Matchup, distances, metres_to_similarity
from mcaptrack.evaluation.metrics.recalls import ScoredMatchup, average_over_recalls

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


class Score(NamedTuple):
    """The scores of a sequence that can be added up: counts, and the parts of HOTA at its 19 thresholds."""

    counts: dict[str, float]
    hota: dict[str, NDArray[np.float64]]


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
