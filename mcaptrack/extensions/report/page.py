"""A report on logs for people: one page that needs no other file, with its numbers as JSON.

gather(log, camera)      read and compute everything about a log
draw(report, 0, 1)       render its part of the page; releases its tracks and pictures
page(reports)            the page, with all numbers inside
data(reports)            the numbers alone: those of ``evaluate --json``, and more
fleet_page(rows, ...)    the page about all logs of a folder of tables; its numbers are ``fleet_data(rows)``

The same logs give the same bytes. The page loads nothing, and runs only its own script, which sorts a table, lights a
track that is clicked and shows values; its policy forbids all else, in case a name in a log got past the escaping.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack import SCHEMA_VERSION, __version__, foxglove
from mcaptrack.errors import command
from mcaptrack.evaluation import EvaluationRow, combined, metrics, set_means
from mcaptrack.evaluation.people import Intervals, intervals
from mcaptrack.extensions.report import figures, sections
from mcaptrack.extensions.report.contents import LogReport, gather
from mcaptrack.extensions.report.figures import identity_timeline, people_over_time
from mcaptrack.extensions.report.fleet import fleet_data, fleet_page
from mcaptrack.extensions.report.headline import BEFORE, BeforeAfter, rule_text
from mcaptrack.foxglove.palette import COUNT as COLOURS
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.viewing.charts import Axis, figure, pairs_chart, ranges_chart, round_most
from mcaptrack.viewing.formatting import NONE, counted, number, percent, policy, render, short, times
from mcaptrack.viewing.serving import LogPage

__all__ = ["ELEMENT", "LogReport", "data", "draw", "fleet_data", "fleet_page", "gather", "page", "view_page"]

#: The id of the element that holds the numbers.
ELEMENT: Final = "mcaptrack-report"
#: The scores that compare logs, and whether they are shares.
_COMPARED: Final = {"IDSW": False, "IDF1": True, "MOTA": True, "HOTA": True}


# The top of the page: how many identities tracking and re-tracking kept, in a sentence and a few numbers.


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
        repairs = sum(event["counts"][kind] for event in events for kind in ("joined", "parted"))
        text += f"; re-tracked there are {number(total('offline'))}, after {counted(repairs, 'repair')}"
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


def data(reports: Sequence[LogReport]) -> dict[str, Any]:
    """All numbers. ``results`` are those of ``evaluate --json``, without curves, which each log has once, thinned.

    ``reports`` are those on the logs of the page.
    """
    results = [result for report in reports for result in report.results] + combined_results(reports)
    return {
        "schema_version": SCHEMA_VERSION,
        "mcaptrack_version": __version__,
        "results": [_without_curve(result) for result in results],
        "logs": [report.data for report in reports],
    }


def _without_curve(result: EvaluationRow) -> dict[str, Any]:
    values = result.to_json()
    if "displacement" in values:
        values["displacement"] = {k: v for k, v in values["displacement"].items() if not k.startswith("curve_")}
    return values


# The file itself, and the provenance of its channels.


_GROUND: Final = {
    "given": "measured",
    "estimated": "estimated from boxes of people",
    "assumed": "guessed from the size of people",
    None: "none",
}
_MAX_DEPTH: Final = 6


def provenance(report: LogReport) -> dict[str, Any]:
    """The values of the section: the file, and its channels in the order in which they were made, without views."""
    data = report.data
    span = "no messages"
    if data["start_ns"] is not None:
        span = f"{data['start_ns'] / NS_PER_S:.3f} to {data['end_ns'] / NS_PER_S:.3f} s"
    channels = _by_lineage([channel for channel in data["channels"] if channel["transform"] != "view"])
    return {
        "log": data,
        "span": span,
        "ground_plane": _GROUND[data["ground_plane"]],
        "channels": [channel | {"parameters": _parameters(channel)} for channel in channels],
    }


def _by_lineage(channels: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Channels, each after the one that it was made from, with their depth."""
    topics = {channel["topic"] for channel in channels}
    made_from: dict[str | None, list[dict[str, Any]]] = {}
    for channel in channels:
        made_from.setdefault(channel["input"], []).append(channel)
    out: dict[str, dict[str, Any]] = {}
    roots = [channel for channel in channels if channel["input"] not in topics]
    for root in (*roots, *channels):  # channels in a cycle have no root
        waiting = [(root, 0)]
        while waiting:
            channel, depth = waiting.pop()
            if channel["topic"] not in out:
                out[channel["topic"]] = channel | {"depth": min(depth, _MAX_DEPTH)}
                waiting += [(other, depth + 1) for other in reversed(made_from.get(channel["topic"], []))]
    return list(out.values())


def _parameters(channel: dict[str, Any]) -> list[str]:
    """The parameters of a channel as text."""
    values = channel["parameters"] or {}
    return [
        f"{key} {value if isinstance(value, str) else json.dumps(value)}"
        for key, value in sorted(values.items())
        if key != "ground_planes"
    ]


def draw(report: LogReport, at: int, total: int) -> None:
    """Render the part of the page on one log, number ``at`` of ``total``, and release its tracks and pictures.

    ``report`` gets it as ``html``.
    """
    report.html = render(
        "log.html",
        __package__ or "",
        number=at,
        level=2 if total == 1 else 3,
        identities=identity_timeline(report),
        over_time=people_over_time(report),
        tracks=figures.track_table(report),
        warnings=report.warnings,
        scores=sections.scores(report),
        scene=figures.scene_map(report),
        heat=figures.heat(report),
        events=figures.identity_events(report),
        forecasts=sections.forecasts(report),
        motion=sections.motion(report),
        more_links=[(section.short, name) for name, section in report.sections.items()],
        more_sections=report.sections,
        lineage=provenance(report),
        notes=report.notes,
        people=report.has_only_people,
    )
    report.background, report.forecast_scene, report.sequence, report.highlights = None, None, None, []
    report.doubts, report.doubtful_tracks = [], []
    for track_set in report.track_sets.values():
        track_set.frames = []


def page(reports: Sequence[LogReport]) -> str:
    """Return the whole page; logs that were not rendered yet are rendered first.

    ``reports`` are those on its logs.
    """
    for k, report in enumerate(reports):
        if not report.html:
            draw(report, k, len(reports))
    return render(
        "page.html",
        __package__ or "",
        version=__version__,
        element=ELEMENT,
        title=reports[0].name if len(reports) == 1 else counted(len(reports), "log"),
        colours=[_hex(foxglove.colour(k)) for k in range(COLOURS)],
        summary=summarize(reports),
        comparison=_comparison(reports) if len(reports) > 1 else None,
        logs=[{"file": report.file, "short": _in_short(report), "html": report.html} for report in reports],
        data=data(reports),
    )


def _hex(rgba: Sequence[float]) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in rgba[:3])


def _in_short(report: LogReport) -> str:
    if (scores := report.headline) is not None:
        return " → ".join(number(int(value)) for value in scores.values("IDSW")) + " switches"
    tracks = next((row for row in report.data["tracks"] if row["role"] in ("tracks", "offline")), None)
    return f"{counted(tracks['tracks'], 'track')}, no ground truth" if tracks else "no tracks"


def _comparison(reports: Sequence[LogReport]) -> dict[str, Any]:
    """Scores by log, and of all logs together."""
    pairs = [(report, report.headline) for report in reports]
    sure = [intervals_of([report]) for report in reports]
    rows = [_comparison_row(report.file, scores, sides) for (report, scores), sides in zip(pairs, sure, strict=True)]
    together = combined_results(reports)
    if together:
        whole = next(report for report in reports if report.results).compared_in(together)
        rows.append(_comparison_row("", whole, intervals_of(reports)))
    columns = ["log", "within", "change of IDF1 (95 %)", "re-tracking is", *_COMPARED]
    charts = []
    for key, label, is_share in (("IDSW", "identity switches", False), ("IDF1", "identities kept (IDF1), %", True)):
        values = [
            (report.name, *map(float, scores.values(key)))
            for report, scores in pairs
            if scores and scores.tracked and scores.retracked
        ]
        if values:
            most = 1.0 if is_share else round_most([np.array([v[1:] for v in values]).ravel()], whole=True)
            axis = Axis(label, most, is_share, whole=not is_share)
            chart = pairs_chart(f"{label} by log", values, axis, ("tracked", "re-tracked"))  # type: ignore[arg-type]
            charts.append(figure(chart, label, ""))
    ranges = [
        (report.name, sides.idf1)
        for report, sides in zip(reports, sure, strict=True)
        if sides and sides.idf1[1].is_known
    ]
    if ranges:
        title = "IDF1 with 95 % intervals, by log"
        chart = ranges_chart(
            title, ranges, Axis("identities kept (IDF1), %", 1.0, percent=True), ("tracked", "re-tracked")
        )
        caption = "Logs with bars that overlap may only have other people in them. Bars: bootstrap over people."
        charts.append(figure(chart, "Intervals.", caption))
    return {"columns": columns, "rows": rows, "figures": charts}


def _comparison_row(file: str, scores: BeforeAfter | None, sure: Intervals | None) -> dict[str, Any]:
    if scores is None:
        return {"file": file, "rule": "no ground truth", "cells": [NONE] * (len(_COMPARED) + 2)}
    sides = [metrics.summary(side.score) if side else None for side in (scores.tracked, scores.retracked)]
    similarity, gate = scores.rule
    return {
        "file": file,
        "rule": f"{gate:g} m" if similarity == "metres" else f"IoU {gate:g}",
        "cells": [change_text(sure), verdict(sure)]
        + [
            " → ".join((percent if is_share else number)(side[key] if side else None) for side in sides)
            for key, is_share in _COMPARED.items()
        ],
    }


def view_page() -> LogPage:
    """The page as `mcaptrack view` shows it."""
    return LogPage(lambda opened: page([gather(opened, None)]).encode(), policy("report.js", package=__package__ or ""))
