"""Scores in a few lines: identities before and after re-tracking, and forecasts beside constant velocity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from mcaptrack.choices import Similarity
from mcaptrack.evaluation import COMBINED, EvaluationRow
from mcaptrack.evaluation.aligned import GATE_3D_M, GATE_M
from mcaptrack.evaluation.metrics.displacement import Displacement
from mcaptrack.transforms import STAGES

#: Similarities that are overlaps, as text.
OVERLAPS: Final = {"iou": "IoU", "bev-iou": "BEV IoU", "3d-iou": "3D IoU"}
#: A smaller difference of errors, as a share, is no difference.
_ALIKE: Final = 0.01


def main_results(results: Sequence[EvaluationRow]) -> list[EvaluationRow]:
    """Choose the results of one similarity and gate.

    Parameters
    ----------
    results : sequence of EvaluationRow
        At least one.

    Returns
    -------
    list of EvaluationRow
        Those by distance on the ground where there are any, at the gate that is nearest to 1 m, for 3D boxes to 2 m.
    """
    by_distance = [result for result in results if result.similarity == "metres"]
    if not by_distance:
        first: Similarity = results[0].similarity
        return [result for result in results if result.similarity == first]
    usual_m = GATE_3D_M if all(result.is_3d for result in by_distance) else GATE_M
    gate_m = min((result.gate for result in by_distance), key=lambda gate: abs(gate - usual_m))
    return [result for result in by_distance if result.gate == gate_m]


def matched_by(result: EvaluationRow) -> str:
    """The rule by which tracks match ground truth: "within 1 m" or "with IoU 0.5"."""
    overlap = OVERLAPS.get(result.similarity)
    return f"with {overlap} {result.gate:g}" if overlap else f"within {result.gate:g} m"


def verdict(results: Sequence[EvaluationRow]) -> list[str]:
    """Say in a few lines what the main results are: identities, and forecasts beside constant velocity.

    Parameters
    ----------
    results : sequence of EvaluationRow
        At least one.

    Returns
    -------
    list of str
    """
    of_all = [result for result in main_results(results) if result.of_class is None]
    whole = [result for result in of_all if result.sequence == COMBINED]
    together = f"{len({result.sequence for result in of_all}) - 1} sequences together, " if whole else ""
    whole = whole or of_all
    lines = [f"{together}{matched_by(whole[0])}: {_identities(whole)}"]
    return lines + [_forecasts(row.tracks, row.displacement) for row in whole if row.displacement is not None]


def _identities(rows: Sequence[EvaluationRow]) -> str:
    samples = STAGES["retrack"].input_topic
    before = next((row for row in rows if row.tracks.endswith(f"/{samples}")), None)
    after = next((row for row in rows if row.mode == "offline"), None)
    if before is not None and after is not None:
        (was, switches), (now, left) = _scores(before), _scores(after)
        return f"IDF1 {100 * was:.1f} -> {100 * now:.1f}, identity switches {switches} -> {left}" + (
            "; re-tracking made it worse" if now < was else ""
        )
    best = max(rows, key=lambda row: _scores(row)[0])
    idf1, switches = _scores(best)
    text = f"IDF1 {100 * idf1:.1f}, identity switches {switches}"
    return text if len(rows) == 1 else f"{text} ({best.tracks}, the best of {len(rows)})"


def _scores(row: EvaluationRow) -> tuple[float, int]:
    """IDF1 as a share, and identity switches."""
    values = row.to_json()
    return values["IDF1"], values["IDSW"]


def _forecasts(tracks: str, displacement: Displacement) -> str:
    own, straight = displacement.summary()["FDE_m"], displacement.constant_velocity()["FDE_m"]
    if own is None or straight is None:
        return f"forecasts of {tracks}: none can be compared with the ground truth"
    text = f"forecasts of {tracks} end {own:.2f} m off, constant velocity {straight:.2f} m"
    if own > (1 + _ALIKE) * straight:
        return f"{text}: they don't help here"
    return text if own < (1 - _ALIKE) * straight else f"{text}: they help little here"
