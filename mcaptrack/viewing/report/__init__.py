"""A report on logs that people read: one page that needs nothing else, and its numbers as JSON.

gather(log, camera)      everything about a log, read and counted
draw(report, 0, 1)       its part of the page; lets go of its tracks and pictures
page(reports)            the page, with all numbers inside
data(reports)            the numbers alone: as ``evaluate --json`` has them, and more

The same logs give the same bytes. The page loads nothing and runs nothing: its policy forbids both, so that a name in a
log that got past the escaping still could not do anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from typing import Any, Final

import numpy as np

from mcaptrack import SCHEMA_VERSION, __version__, foxglove
from mcaptrack.evaluation import EvaluationRow
from mcaptrack.evaluation.metrics import summary
from mcaptrack.foxglove.colours import COUNT as COLOURS
from mcaptrack.viewing.report import lineage, sections, sights
from mcaptrack.viewing.report.charts import Axis, beside, figure, pairs_chart, round_most
from mcaptrack.viewing.report.contents import LogReport, gather
from mcaptrack.viewing.report.headline import combined_results, headline, pair_of
from mcaptrack.viewing.report.markup import NONE, Markup, counted, join, name, number, percent, script_json, table, tag

__all__ = ["ELEMENT", "LogReport", "data", "draw", "gather", "page"]

#: The id of the element that holds the numbers.
ELEMENT: Final = "mcaptrack-report"
_POLICY: Final = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"


def data(reports: Sequence[LogReport]) -> dict[str, Any]:
    """All numbers. ``results`` are those of ``evaluate --json``, but that curves stand once for each log, thinned."""
    results = [result for report in reports for result in report.results] + combined_results(reports)
    return {
        "schema_version": SCHEMA_VERSION,
        "mcaptrack_version": __version__,
        "results": [_without_curve(result) for result in results],
        "logs": [report.data for report in reports],
    }


def _without_curve(result: EvaluationRow) -> dict[str, Any]:
    said = result.to_json()
    if "displacement" in said:
        said["displacement"] = {k: v for k, v in said["displacement"].items() if not k.startswith("curve_")}
    return said


def draw(report: LogReport, at: int, total: int) -> None:
    """Draw the part of a page that is about one log, which is number ``at`` of ``total``.

    After that the report no longer holds the tracks and pictures, so that many logs find room.
    """
    report.drawn = _log(report, at, 2 if total == 1 else 3)
    report.behind, report.sequence, report.shown = None, None, []
    for one in report.sets.values():
        one.frames = []


def page(reports: Sequence[LogReport]) -> str:
    """The whole page; what has not been drawn yet is."""
    for k, report in enumerate(reports):
        if not report.drawn:
            draw(report, k, len(reports))
    title = reports[0].name if len(reports) == 1 else counted(len(reports), "log")
    body = [tag("h1", "Report on ", tag("bdi", title)), headline(reports)]
    if len(reports) == 1:
        body.append(Markup(reports[0].drawn))
    else:
        body.append(_comparison(reports))
        for k, report in enumerate(reports):
            words = tag("summary", tag("h2", tag("bdi", report.file), ": ", _in_short(report)))
            body.append(tag("details", words, Markup(report.drawn), class_="log", open="" if k == 0 else None))
    made = tag(
        "p", f"Made by mcaptrack {__version__}. All numbers are in this page as JSON, in the element ", class_="soft"
    )
    made = Markup(made[: -len("</p>")] + tag("code", f"#{ELEMENT}") + ".</p>")
    head = [
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="color-scheme", content="light dark"),
        tag("meta", name="generator", content=f"mcaptrack {__version__}"),
        tag("link", rel="icon", href="data:,"),
        tag("title", "Report on ", title),
        tag("style", Markup(_style())),
    ]
    whole = tag(
        "html",
        tag("head", *head),
        tag("body", tag("main", *body), made, script_json(data(reports), ELEMENT)),
        lang="en",
    )
    return f"<!doctype html>\n{whole}\n"


def _style() -> str:
    colours = [foxglove.colour(k) for k in range(COLOURS)]
    by_identity = "".join(
        f".c{k}{{stroke:#{''.join(f'{round(255 * part):02x}' for part in rgba[:3])}}}" for k, rgba in enumerate(colours)
    )
    return files(__package__ or __name__).joinpath("style.css").read_text(encoding="utf-8") + by_identity


def _log(report: LogReport, number_of: int, level: int) -> Markup:
    """All sections on one log, with headings of this level."""
    parts: list[object] = []
    for title, content in (
        ("Scores", sections.scores(report)),
        ("Where people walked", sights.scene(report, number_of)),
        ("What happened to identities", sights.moments(report, level + 1)),
        ("Forecasts", sections.forecasts(report)),
        ("How people move", sections.motion(report)),
        ("How it was made", lineage.provenance(report)),
    ):
        parts += [tag("section", tag(f"h{level}", title), content)]
    if report.notes:
        parts.append(
            tag("section", tag(f"h{level}", "Notes"), tag("ul", *(tag("li", words) for words in report.notes)))
        )
    return join(parts)


def _in_short(report: LogReport) -> str:
    pair = pair_of(report, report.results) if report.results else None
    if pair is None:
        tracks = next((one for one in report.data["tracks"] if one["role"] in ("tracks", "offline")), None)
        return counted(tracks["tracks"], "track") + ", no truth" if tracks else "nobody tracked"
    return " → ".join(number(int(value)) for value in pair.values("IDSW")) + " switches"


def _comparison(reports: Sequence[LogReport]) -> Markup:
    """Scores by log, and the logs beside each other."""
    rows: list[tuple[object, ...]] = []
    pairs = []
    for report in [*reports, None]:
        results = report.results if report else combined_results(reports)
        known = report or next((one for one in reports if one.results), None)
        if known is None or (report is None and not results):
            continue
        pair = pair_of(known, results) if results else None
        called = name(report.file) if report else tag("b", "all together")
        if pair is None:
            rows.append((called, "no truth", *[NONE] * 8))
            continue
        cells: list[object] = []
        for key, is_share in (("IDSW", False), ("IDF1", True), ("MOTA", True), ("HOTA", True)):
            for side in (pair.plain, pair.repaired):
                value = summary(side.score)[key] if side else None
                cells.append(percent(value) if is_share else number(value))
        rule = f"{pair.rule[1]:g} m" if pair.rule[0] == "metres" else f"IoU {pair.rule[1]:g}"
        rows.append((called, rule, *cells))
        if report and pair.plain and pair.repaired:
            pairs.append((report.name, pair))
    columns = ["log", "within"]
    for key in ("IDSW", "IDF1", "MOTA", "HOTA"):
        columns += [f"{key} tracked", "re-tracked"]
    parts: list[object] = [tag("h2", "The logs beside each other")]
    parts.append(table("Scores of tracking and of re-tracking, by log", columns, rows, words=2))
    charts = []
    for key, label, is_share in (("IDSW", "identity switches", False), ("IDF1", "identities kept (IDF1), %", True)):
        values = [(who, float(before), float(after)) for who, pair in pairs for before, after in [pair.values(key)]]
        if values:
            axis = Axis(label, 1.0 if is_share else round_most([np.array([v[1:] for v in values]).ravel()]), is_share)
            drawn = pairs_chart(f"{label} by log", values, axis, ("tracked", "re-tracked"))
            charts.append(figure(drawn, tag("b", label)))
    return join([*parts, beside(charts)])
