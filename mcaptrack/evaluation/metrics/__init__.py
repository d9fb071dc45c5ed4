"""Scores: arrays in, numbers out. Nothing here knows a file, a channel or a tracker.

matchup = ...                          who was there, who was tracked, how alike they are
summary(score(matchup))                MOTA, IDF1, HOTA and their counts for one sequence
summary(combine([score(a), score(b)])) the same over several
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.evaluation.metrics.clear import Rules, clear
from mcaptrack.evaluation.metrics.hota import hota
from mcaptrack.evaluation.metrics.identity import identity
from mcaptrack.evaluation.metrics.matchup import Matchup, distances, metres_to_similarity

__all__ = ["Matchup", "Rules", "Score", "combine", "distances", "metres_to_similarity", "score", "summary"]


class Score(NamedTuple):
    """What can be added up over sequences: counts, and HOTA's parts over its thresholds."""

    counts: dict[str, float]
    hota: dict[str, NDArray[np.float64]]


def score(matchup: Matchup, rules: Rules = "trackeval") -> Score:
    """CLEAR, identity and HOTA of one sequence."""
    return Score(clear(matchup, rules) | identity(matchup), hota(matchup))


def combine(scores: Sequence[Score]) -> Score:
    """Several sequences as one: counts are added, AssA and LocA weighted by the matches at each threshold."""
    counts = {name: sum(part.counts[name] for part in scores) for name in scores[0].counts}
    tp = np.stack([part.hota["HOTA_TP"] for part in scores])
    total = tp.sum(axis=0)
    parts = {name: sum(part.hota[name] for part in scores) for name in ("HOTA_TP", "HOTA_FN", "HOTA_FP")}
    for name in ("AssA", "LocA"):
        weighted = (tp * np.stack([part.hota[name] for part in scores])).sum(axis=0)
        parts[name] = np.maximum(weighted, 1e-10 * (name == "LocA")) / np.maximum(total, 1e-10)
    return Score(counts, {name: np.asarray(values) for name, values in parts.items()})


def summary(part: Score) -> dict[str, Any]:
    """The numbers that people compare: rates between 0 and 1, counts as whole numbers.

    Where the truth holds nobody MOTA is 0, as TrackEval has it; it means nothing there.
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
