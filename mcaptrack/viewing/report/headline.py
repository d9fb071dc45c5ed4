"""What matters first: who kept whom, in words and a few numbers, for one log or several."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from mcaptrack.errors import command
from mcaptrack.evaluation import EvaluationRow, combined
from mcaptrack.evaluation.metrics import summary
from mcaptrack.viewing.report.contents import LogReport, result_of
from mcaptrack.viewing.report.markup import Markup, counted, number, percent, sentence, tag, times

#: The rules by which the headline counts, the first that both can be scored by.
_RULES = (("metres", 1.0), ("iou", 0.5))


class Pair(NamedTuple):
    """Tracking and re-tracking, scored by one rule; either may be missing."""

    rule: tuple[str, float]
    plain: EvaluationRow | None
    repaired: EvaluationRow | None

    def values(self, name: str) -> list[float]:
        """A score of those that there are."""
        return [summary(result.score)[name] for result in (self.plain, self.repaired) if result is not None]


def rule_words(similarity: str, gate: float) -> str:
    """A rule for people."""
    return f"within {gate:g} m on the ground" if similarity == "metres" else f"by overlap of boxes of at least {gate:g}"


def pair_of(report: LogReport, results: Sequence[EvaluationRow]) -> Pair | None:
    """What the headline compares: tracks on the clock of prediction with those that re-tracking made of them."""
    for similarity, gate in _RULES:
        found = {
            role: result_of(results, one.topic, similarity, gate)
            for role, one in report.sets.items()
            if role in ("samples", "tracks", "offline", "online")
        }
        plain = found.get("samples") or found.get("tracks")
        repaired = found.get("offline") or found.get("online")
        if plain or repaired:
            return Pair((similarity, gate), plain, repaired)
    return None


def combined_results(reports: Sequence[LogReport]) -> list[EvaluationRow]:
    """The results of all logs together, where several have any."""
    scored = [report for report in reports if report.results]
    return combined([result for report in scored for result in report.results]) if len(scored) > 1 else []


def headline(reports: Sequence[LogReport]) -> Markup:
    """The sentence, and the tiles below it."""
    scored = [report for report in reports if report.results]
    pair = None
    if scored:
        together = combined_results(reports)
        pair = pair_of(scored[0], together or scored[0].results)
    said = _with_truth(reports, scored, pair) if pair and scored else _without_truth(reports)
    tiles = _tiles(pair) if pair else ""
    return Markup(tag("p", sentence(said), class_="lead") + tiles)


def _with_truth(reports: Sequence[LogReport], scored: Sequence[LogReport], pair: Pair) -> str:
    first = scored[0]
    name = first.sets["tracks"].name if "tracks" in first.sets else "the tracker"
    name = "The tracks as given" if name == "tracks as given" else name
    names = {one.sets["tracks"].name for one in scored if "tracks" in one.sets}
    name = "the tracker" if len(names) > 1 else name
    switches = pair.values("IDSW")
    where = ""
    if len(reports) > 1:
        where = f"In {counted(len(scored), 'log')} with truth, "
        where = (
            f"In {'both' if len(reports) == 2 else f'all {len(reports)}'} logs together, "
            if len(scored) == len(reports)
            else where
        )
    if pair.plain and pair.repaired:
        said = f"{name} switched identities {times(int(switches[0]))}, re-tracking {times(int(switches[1]))}."
    elif pair.plain:
        said = f"{name} switched identities {times(int(switches[0]))}; nothing has been re-tracked yet."
    else:
        said = f"re-tracked, identities switched {times(int(switches[0]))}."
    said = where + said
    return f"{said[0].upper()}{said[1:]} Counted {rule_words(*pair.rule)}{_clock(scored[0])}."


def _clock(report: LogReport) -> str:
    return ", on the clock of prediction" if "samples" in report.sets else ""


def _without_truth(reports: Sequence[LogReport]) -> str:
    tracked = joined = repaired = seen = 0
    for report in reports:
        for one in report.data["tracks"]:
            tracked += one["tracks"] if one["role"] == "tracks" else 0
            repaired += one["tracks"] if one["role"] == "offline" else 0
            seen += one["role"] in ("tracks", "samples", "offline", "online")
        offline = report.sets.get("offline")
        told = [e for e in report.data["events"] if offline and e["topic"] == offline.topic]
        joined += sum(e["counts"]["joined"] for e in told)
    if not any(report.data["messages"] for report in reports):
        return "There is nothing in here yet: no messages at all."
    if not seen:
        run = command("run", *(Path(report.file) for report in reports))
        return f"This log has no tracks yet; {run} makes them."
    said = f"Tracking found {counted(tracked, 'track')}."
    if any("offline" in report.sets for report in reports):
        was = "was" if joined == 1 else "were"
        said = (
            f"Tracking found {counted(tracked, 'track')}; re-tracked there are {number(repaired)}, and "
            f"{counted(joined, 'gap or mix-up', 'gaps and mix-ups')} {was} repaired by joining."
        )
    return f"{said} How right they are can't be said without truth."


def _tiles(pair: Pair) -> Markup:
    def change(name: str, is_share: bool) -> str:
        values = pair.values(name)
        said = [number(100 * value, 1) if is_share else number(int(value)) for value in values]
        return "\N{NO-BREAK SPACE}→ ".join(said) + ("\N{NO-BREAK SPACE}%" if is_share else "")

    both = "before → after re-tracking" if pair.plain and pair.repaired else None
    tiles: list[tuple[str, str, str | None]] = [
        ("identity switches", change("IDSW", False), both),
        ("identities kept (IDF1)", change("IDF1", True), both),
        ("accuracy (MOTA)", change("MOTA", True), both),
        ("HOTA", change("HOTA", True), both),
    ]
    if pair.plain and pair.plain.displacement:
        said = pair.plain.displacement.summary()
        tiles.append(("forecast error (ADE)", number(said["ADE_m"], 2, "m"), f"at recall {percent(said['recall'], 0)}"))
    return tag(
        "dl",
        *(
            tag("div", tag("dt", what), tag("dd", value, tag("small", note) if note else ""), class_="tile")
            for what, value, note in tiles
        ),
        class_="tiles",
    )
