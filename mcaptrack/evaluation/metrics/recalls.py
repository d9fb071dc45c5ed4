"""Scores averaged over recalls: AMOTA and AMOTP of nuScenes, sAMOTA and AMOTA of AB3DMOT.

A tracker that may drop its less certain tracks trades recall for precision. These scores drop tracks by their score,
and average over the recalls that this gives.

Letters: P pairs, R recalls, H tracks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.evaluation.metrics.clear import Rules, is_switch, matches
from mcaptrack.evaluation.metrics.matchup import Matchup, SparseTables
from mcaptrack.geometry.arrays import Bools, Floats

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
    found = [part.score[matches(part.matchup, rules).track] for part in parts]
    scores = np.sort(np.concatenate(found))[::-1]
    known: dict[tuple[bytes, ...], _Counts] = {}

    def at(recalls: Floats) -> list[tuple[float, _Counts]]:
        """The recalls that are reached, each with its counts."""
        reached = recalls <= len(scores) / total
        found_recalls = np.arange(1, len(scores) + 1) / total
        least = np.interp(recalls[reached], found_recalls, scores) if len(scores) else np.empty(0)
        out = []
        for recall, score in zip(recalls[reached].tolist(), least.tolist(), strict=True):
            kept = [part.score >= score for part in parts]
            key = tuple(one.tobytes() for one in kept)
            if key not in known:
                known[key] = _count(
                    [_of_tracks(part.matchup, one) for part, one in zip(parts, kept, strict=True)], rules
                )
            out.append((recall, known[key]))
        return out

    nuscenes = [one for _, one in at(np.linspace(_LEAST, 1, _RECALLS).round(12))]
    motar = [max(0.0, 1 - (one.switches + one.fp) / one.tp) for one in nuscenes if one.tp]
    motp = [one.similarity_sum / one.tp for one in nuscenes if one.tp]
    by_target = at(np.arange(1, _RECALLS + 1) / _RECALLS)
    right = [(recall * total, one.tp - one.fp - one.switches) for recall, one in by_target]
    return {
        "AMOTA": sum(motar) / _RECALLS,
        "AMOTP": (sum(motp) + worst * (_RECALLS - len(motp))) / _RECALLS,
        "sAMOTA": sum(min(1.0, max(0.0, hits / wanted)) for wanted, hits in right) / _RECALLS,
        "AMOTA_unscaled": sum(hits / total for _, hits in right) / _RECALLS,
    }


def _count(matchups: Sequence[Matchup], rules: Rules) -> _Counts:
    found = [matches(matchup, rules) for matchup in matchups]
    tp = sum(len(one.person) for one in found)
    return _Counts(
        tp,
        sum(matchup.track_rows for matchup in matchups) - tp,
        sum(int(is_switch(one).sum()) for one in found),
        float(sum(one.similarity.sum() for one in found)),
    )


def _of_tracks(matchup: Matchup, kept: Bools) -> Matchup:
    """A matchup with some of its tracks (H,)."""
    if kept.all():
        return matchup
    there = [kept[tracks] for tracks in matchup.tracks]
    alike = matchup.similarity
    return Matchup(
        matchup.ground_truth,
        tuple(tracks[one] for tracks, one in zip(matchup.tracks, there, strict=True)),
        alike.of_columns(kept[matchup.all_tracks])
        if isinstance(alike, SparseTables)
        else tuple(similarity[:, one] for similarity, one in zip(alike, there, strict=True)),
        matchup.threshold,
        matchup.n_ground_truth,
        matchup.n_tracks,
    )
