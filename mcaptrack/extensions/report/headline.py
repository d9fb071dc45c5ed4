"""The rule by which a page counts: one for its summary, its timelines and its events, so that numbers agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from mcaptrack.evaluation import EvaluationRow
from mcaptrack.evaluation.metrics import summary
from mcaptrack.tables.export.contents import RULES, RULES_3D

#: The roles of tracks before and after re-tracking, the first that there is: at the prediction rate if possible.
BEFORE: Final = ("samples", "tracks")
AFTER: Final = ("offline", "online")


class BeforeAfter(NamedTuple):
    """Tracking and re-tracking, scored by one rule; either may be missing. ``roles`` are those that are scored."""

    rule: tuple[str, float]
    tracked: EvaluationRow | None
    retracked: EvaluationRow | None
    roles: tuple[str, str] = ("", "")

    def values(self, name: str) -> list[float]:
        """A score before and after re-tracking, as far as these were scored."""
        return [summary(row.score)[name] for row in (self.tracked, self.retracked) if row is not None]


def rule_text(similarity: str, gate: float) -> str:
    """A rule in words."""
    return _rule_text(similarity, f"{gate:g}")


def _rule_text(similarity: str, gate: str) -> str:
    if similarity == "metres":
        return f"within {gate} m on the ground"
    seen = {"bev-iou": ", seen from above,", "3d-iou": " in space"}.get(similarity, "")
    return f"by overlap of boxes{seen} of at least {gate}"


def rules_text(rules: Sequence[tuple[str, float]]) -> str:
    """Rules in words, those that differ in their limit together.

    Examples
    --------
    >>> rules_text([("iou", 0.5), ("metres", 0.5), ("metres", 2.0)])
    'by overlap of boxes of at least 0.5; within 0.5 or 2 m on the ground'
    """
    gates: dict[str, list[str]] = {}
    for similarity, gate in rules:
        gates.setdefault(similarity, []).append(f"{gate:g}")
    texts = []
    for similarity, some in gates.items():
        several = ", ".join(some[:-1]) + f" or {some[-1]}" if len(some) > 1 else some[0]
        texts.append(_rule_text(similarity, several))
    return "; ".join(texts)


def result_of(results: Sequence[EvaluationRow], topic: str, similarity: str, gate: float) -> EvaluationRow | None:
    """The scores of a channel for one similarity and gate."""
    return next((r for r in results if (r.tracks, r.similarity, r.gate) == (topic, similarity, gate)), None)


def compared(topics: Mapping[str, str], results: Sequence[EvaluationRow]) -> BeforeAfter | None:
    """The scores that a page compares, of the topics of tracks by role; None if nothing was scored."""
    is_3d = bool(results) and all(row.is_3d for row in results)
    for similarity, gate in RULES_3D if is_3d else RULES:
        rows = {role: result_of(results, topic, similarity, gate) for role, topic in topics.items()}
        before = next((role for role in BEFORE if rows.get(role)), "")
        after = next((role for role in AFTER if rows.get(role)), "")
        if before or after:
            return BeforeAfter((similarity, gate), rows.get(before), rows.get(after), (before, after))
    return None
