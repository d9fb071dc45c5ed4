"""The top of the page: how many identities tracking and re-tracking kept, in a sentence and a few numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mcaptrack.errors import command
from mcaptrack.evaluation import EvaluationRow, combined, set_means
from mcaptrack.evaluation.people import Intervals, intervals
from mcaptrack.viewing.report.contents import LogReport
from mcaptrack.viewing.report.formatting import NONE, counted, number, percent, short, times
from mcaptrack.viewing.report.headline import BEFORE, BeforeAfter, rule_text


def combined_results(reports: Sequence[LogReport]) -> list[EvaluationRow]:
    """The scores of all logs together, if several have any."""
    scored = [report for report in reports if report.results]
    out = combined([result for report in scored for result in report.results]) if len(scored) > 1 else []
    set_means(out)
    return out


def intervals_of(reports: Sequence[LogReport]) -> Intervals | None:
    """Intervals of scores before and after re-tracking; None where these were not compared with ground truth."""
    pairs = [[report.people.get(role) for role in report.compared_roles] for report in reports if report.results]
    if not pairs or any(person_scores is None for pair in pairs for person_scores in pair):
        return None
    before, after = zip(*pairs, strict=True)
    return intervals(before, after)


def change_text(intervals_: Intervals | None) -> str:
    """The change of IDF1 in points with its interval; a dash if it is not known."""
    if intervals_ is None:
        return NONE
    change = intervals_.idf1_change
    value = f"{100 * change.value:+.1f}"
    return f"{value} ({100 * change.low:+.1f} to {100 * change.high:+.1f})" if change.is_known else value


def verdict(intervals_: Intervals | None) -> str:
    """A change of IDF1 in a word: only better or worse if the whole interval says so."""
    if intervals_ is None:
        return NONE
    if not intervals_.idf1_change.is_known:
        return f"unknown: {counted(intervals_.people, 'person', 'people')}"
    return {1: "better", -1: "worse", 0: "not sure"}[intervals_.idf1_change.sign]


def summarize(reports: Sequence[LogReport]) -> dict[str, Any]:
    """The text and the tiles of the summary."""
    scored = [report for report in reports if report.results]
    scores = scored[0].compared_in(combined_results(reports) or scored[0].results) if scored else None
    if scores is None:
        return {"text": _without_ground_truth(reports), "tiles": []}
    text = _with_ground_truth(reports, scored, scores)
    sure = intervals_of(reports)
    if sure is not None and sure.idf1_change.is_known:
        change = sure.idf1_change
        text += (
            f" IDF1 changes by {100 * change.value:+.1f} points (95 % interval {100 * change.low:+.1f} to "
            f"{100 * change.high:+.1f}, by resampling these {number(sure.people)} people)."
        )
    return {"text": text, "tiles": _tiles(scores)}


def _with_ground_truth(reports: Sequence[LogReport], scored: Sequence[LogReport], scores: BeforeAfter) -> str:
    before = [next((role for role in BEFORE if role in report.track_sets), "") for report in scored]
    names = {short(report.track_sets[role].name) for report, role in zip(scored, before, strict=True) if role}
    name = names.pop() if len(names) == 1 and before[0] else "the tracker"
    name = "the tracks as given" if name == "tracks as given" else name
    switches = [times(int(value)) for value in scores.values("IDSW")]
    where = ""
    if 1 < len(reports) == len(scored):
        where = f"in {'both' if len(reports) == 2 else f'all {len(reports)}'} logs together, "
    elif len(reports) > 1:
        where = f"in {counted(len(scored), 'log')} with ground truth, "
    if scores.tracked and scores.retracked:
        text = f"{where}{name} switched identities {switches[0]}, re-tracking {switches[1]}."
    elif scores.tracked:
        text = f"{where}{name} switched identities {switches[0]}; nothing has been re-tracked yet."
    else:
        text = f"{where}re-tracked, identities switched {switches[0]}."
    rate = ", at the prediction rate" if "samples" in scored[0].track_sets else ""
    return f"{text[0].upper()}{text[1:]} Counted {rule_text(*scores.rule)}{rate}."


def _without_ground_truth(reports: Sequence[LogReport]) -> str:
    if not any(report.data["messages"] for report in reports):
        return "There is nothing in here yet: no messages at all."
    tracks = [track_set for report in reports for track_set in report.data["tracks"] if track_set["role"] != "truth"]
    if not tracks:
        run = command("run", *(Path(report.file) for report in reports))
        return f"This log has no tracks yet; {run} makes them."

    def total(role: str) -> int:
        return sum(track["tracks"] for track in tracks if track["role"] == role)

    text = f"Tracking found {counted(total('tracks'), 'track')}"
    offline = {report.track_sets["offline"].topic for report in reports if "offline" in report.track_sets}
    if offline:
        events = [channel for report in reports for channel in report.data["events"] if channel["topic"] in offline]
        joined = sum(event["counts"]["joined"] for event in events)
        text += (
            f"; re-tracked there are {number(total('offline'))}, and "
            f"{counted(joined, 'gap or mix-up', 'gaps and mix-ups')} {'was' if joined == 1 else 'were'} repaired by "
            "joining"
        )
    return f"{text}. Their accuracy is not known without ground truth."


def _tiles(scores: BeforeAfter) -> list[dict[str, str]]:
    def change(name: str, is_share: bool) -> str:
        values = [number(100 * value, 1) if is_share else number(int(value)) for value in scores.values(name)]
        return "\N{NO-BREAK SPACE}→ ".join(values) + ("\N{NO-BREAK SPACE}%" if is_share else "")

    note = "before → after re-tracking" if scores.tracked and scores.retracked else ""
    tiles = [
        {"label": label, "value": change(name, is_share), "note": note}
        for label, name, is_share in (
            ("identity switches", "IDSW", False),
            ("identities kept (IDF1)", "IDF1", True),
            ("accuracy (MOTA)", "MOTA", True),
            ("HOTA", "HOTA", True),
        )
    ]
    if scores.tracked and scores.tracked.displacement:
        errors = scores.tracked.displacement.summary()
        recall = f"at recall {percent(errors['recall'], 0)}"
        tiles.append({"label": "forecast error (ADE)", "value": number(errors["ADE_m"], 2, "m"), "note": recall})
    return tiles
