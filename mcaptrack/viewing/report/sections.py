"""What numbers say in a report: scores, forecasts, and how people move."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack.errors import command
from mcaptrack.evaluation import EvaluationRow
from mcaptrack.evaluation.metrics import summary
from mcaptrack.viewing.report.charts import Axis, Bars, Line, beside, figure, histogram_chart, line_chart, round_most
from mcaptrack.viewing.report.contents import LogReport
from mcaptrack.viewing.report.headline import pair_of, rule_words
from mcaptrack.viewing.report.markup import Markup, counted, join, lack, name, number, percent, short, table, tag

_SCORES: Final = {"IDF1": True, "MOTA": True, "HOTA": True, "IDSW": False, "Frag": False, "FP": False, "FN": False}
_LOWER: Final = ("IDSW", "Frag", "FP", "FN")
_MEANINGS: Final = (
    "IDF1: identities kept. MOTA: rows that are right, less misses, false rows and switches. HOTA: both, over many "
    "thresholds. IDSW: identity switches. Frag: fragments. FP: false rows. FN: missed rows. Best of a group in bold."
)


def scores(report: LogReport) -> Markup:
    """All scores by rule, and what can be said of tracks without truth."""
    parts: list[Markup] = []
    if report.results:
        pair = pair_of(report, report.results)
        first = [r for r in report.results if pair is None or (r.similarity, r.gate) == pair.rule]
        rest = [r for r in report.results if r not in first]
        parts.append(score_table(first, report))
        parts.append(tag("p", _MEANINGS, class_="soft"))
        if rest:
            rules = sorted({(r.similarity, r.gate) for r in rest})
            words = "The same " + "; ".join(rule_words(*rule) for rule in rules)
            parts.append(tag("details", tag("summary", words), score_table(rest, report)))
    if "scores" in report.lacks:
        parts.append(lack(report.lacks["scores"]))
    parts.append(_track_table(report))
    return join(parts)


def score_table(results: Sequence[EvaluationRow], report: LogReport) -> Markup:
    """Scores, a group of rows for each rule."""
    called = {one.topic: (one.name, one.role) for one in report.sets.values()}
    groups: dict[tuple[str, float], list[EvaluationRow]] = {}
    for result in results:
        groups.setdefault((result.similarity, result.gate), []).append(result)
    body: list[Markup] = []
    for (similarity, gate), members in sorted(groups.items()):
        body.append(tag("tr", tag("th", rule_words(similarity, gate), colspan=2 + len(_SCORES), scope="rowgroup")))
        all_values = [summary(result.score) for result in members]
        for result, values in zip(members, all_values, strict=True):
            words, role = called.get(result.tracks, (result.tracks, "truth"))
            cells = [tag("th", tag("b", words, class_=f"s-{role}"), scope="row"), tag("td", name(result.tracks))]
            for key, is_share in _SCORES.items():
                among = [one[key] for one in all_values]
                is_best = len(members) > 1 and values[key] == (min if key in _LOWER else max)(among)
                said = percent(values[key]) if is_share else number(values[key])
                cells.append(tag("td", said, class_="n best" if is_best else "n"))
            body.append(tag("tr", *cells))
    head = [tag("th", "tracks", scope="col"), tag("th", "channel", scope="col")]
    head += [tag("th", key, scope="col", class_="n") for key in _SCORES]
    caption = tag("caption", "Scores against the truth, as ", tag("code", "evaluate"), " gives them")
    whole = tag("table", caption, tag("thead", tag("tr", *head)), tag("tbody", *body))
    return tag("div", whole, class_="wide", tabindex="0", role="region", aria_label="scores")


def _track_table(report: LogReport) -> Markup:
    if not report.sets:
        run = command("run", Path(report.file))
        return lack(f"There are no tracks here; {run} finds, tracks and re-tracks people.")
    repairs = {story.topic: story.counts["joined"] + story.counts["parted"] for story in report.stories}
    rows = [
        (
            tag("b", one["name"], class_=f"s-{one['role']}"),
            name(one["topic"]),
            number(one["tracks"]),
            number(one["median_s"], 1, "s"),
            number(one["longest_s"], 1, "s"),
            percent(one["observed_share"], 0),
            number(repairs.get(one["topic"]) if one["role"] == "offline" else None),
        )
        for one in report.data["tracks"]
    ]
    columns = ("tracks", "channel", "how many", "median length", "longest", "rows seen", "repairs")
    caption = "Tracks as they are, whoever is right. Rows seen: a detection stands behind them; others were filled in."
    return table(caption, columns, rows, words=2)


def forecasts(report: LogReport) -> Markup:
    """Errors over recall, errors by horizon, calibration."""
    found = report.data["forecasts"]
    if not found:
        why = "There are no forecasts that could be scored"
        reason = "the log has no truth" if "truth" not in report.sets else "none have a known future"
        if not any(c["schema"] == "mcaptrack.Predictions" for c in report.data["channels"]):
            reason = f"the log holds none; {command('predict', Path(report.file))} makes them"
        return lack(f"{why}: {reason}.")
    roles = {one.topic: one for one in report.sets.values()}

    def of(one: dict[str, Any]) -> tuple[str, str]:
        known = roles.get(one["tracks"])
        return (known.name, known.role) if known else (one["tracks"], "truth")

    lines = [
        Line(short(of(one)[0]), of(one)[1], np.array(one["curve_recall"]), np.array(one["curve_ADE_m"]))
        for one in found
    ]
    y = Axis("mean displacement error, m", round_most([line.y for line in lines]))
    x = Axis("recall: share of people with a forecast", 1.0)
    figures = [
        figure(
            line_chart("Displacement error of forecasts over recall", lines, x, y),
            tag("b", "Error over recall. "),
            "From left to right, people whose past was tracked best come first. Lower and longer is better.",
        )
    ]
    most = round_most(
        [
            np.array(part[key], float)
            for one in found
            for part in (one["by_horizon"], one["constant_velocity"])
            if part
            for key in ("mean_m", "three_quarters_m")
        ]
    )
    figures += [_by_horizon(one, *of(one), most) for one in found if one["by_horizon"]["n"]]
    held = [one for one in found if all(part["held"] is not None for part in one["calibration"])]
    if held:
        figures.append(_calibration([(*of(one), one["calibration"]) for one in held]))
    else:
        figures.append(lack("How well the ellipses are calibrated can't be said: the forecasts have no covariance."))
    return beside(figures, "grid charts")


def _by_horizon(one: dict[str, Any], words: str, role: str, most: float) -> Markup:
    part, plain = one["by_horizon"], one["constant_velocity"]
    ahead = np.array(part["ahead_s"])
    band = (np.array(part["quarter_m"]), np.array(part["three_quarters_m"]))
    lines = [Line(short(words), role, ahead, np.array(part["mean_m"]), *band)]
    said = f"{number(part['mean_m'][-1], 2, 'm')} after {number(float(ahead[-1]), 1, 's')}"
    if plain and plain["n"]:
        lines.append(Line("walking on", "truth", np.array(plain["ahead_s"]), np.array(plain["mean_m"]), dashed=True))
        said += f"; walking on as before would be {number(plain['mean_m'][-1], 2, 'm')} off"
    chart = line_chart(
        f"Error of the forecasts of {words} by how far ahead they look",
        lines,
        Axis("seconds ahead", float(ahead[-1])),
        Axis("distance from the truth, m", most),
    )
    caption = f"{said}. Line: mean of {counted(part['n'], 'forecast')}; band: the middle half."
    return figure(chart, tag("b", f"Error by horizon, {words}. "), caption)


def _calibration(found: Sequence[tuple[str, str, list[dict[str, float]]]]) -> Markup:
    lines = [
        Line(
            short(words),
            role,
            np.array([part["nominal"] for part in levels]),
            np.array([part["held"] for part in levels]),
        )
        for words, role, levels in found
    ]
    chart = line_chart(
        "Share of true futures inside the forecast ellipses, against what they promise",
        lines,
        Axis("promised, %", 1.0, percent=True),
        Axis("held, %", 1.0, percent=True),
        diagonal="as promised",
    )
    said = "; ".join(
        f"{words}: " + ", ".join(f"{percent(part['held'], 0)} in {percent(part['nominal'], 0)}" for part in levels)
        for words, _, levels in found
    )
    return figure(
        chart, tag("b", "Calibration. "), f"{said}. Below the dashed line forecasts are too sure, above it too careful."
    )


def motion(report: LogReport) -> Markup:
    """How fast people walk and how long they stay."""
    figures: list[Markup] = []
    speeds, dwell = report.data["speed_m_per_s"], report.data["dwell_s"]
    guessed = " Metres are guessed from the size of people: nobody measured the ground." if report.is_assumed else ""
    if speeds:
        between = "From one row to the next" + (" on the clock of prediction" if "samples" in report.sets else "")
        note = f"{between}; holes left out.{guessed}"
        figures.append(_histogram(report, speeds, "Speed. ", "speed, m/s", note, "m/s", "step", 2))
    elif report.sets:
        words = "Speeds can't be said: nobody knows where on the ground people are"
        figures.append(lack(words + "; a ground plane says it."))
    if dwell:
        note = "From the first row of a track to its last."
        figures.append(_histogram(report, dwell, "Dwell. ", "time there, s", note, "s", "track", 1))
    return beside(figures, "grid charts") if figures else lack("Nobody is there, so nobody moves.")


def _histogram(
    report: LogReport, found: dict[str, Any], title: str, x: str, note: str, unit: str, of: str, digits: int
) -> Markup:
    roles = {one.topic: one for one in report.sets.values()}
    edges = np.array(found["edges"])
    bars, said = [], []
    for part in found["series"]:
        one = roles[part["topic"]]
        if not part["n"]:
            continue
        shares = np.array(part["counts"]) / part["n"]
        words = f"median {number(part['median'], digits, unit)}"
        bars.append(Bars(short(one.name), one.role, shares, part["median"], words))
        beyond = f" ({number(part['above'])} of them beyond)" if part["above"] else ""
        said.append(f"{short(one.name)} {counted(part['n'], of)}{beyond}")
    high = f"the highest bar is {percent(max(float(one.shares.max(initial=0)) for one in bars), 0)}"
    chart = histogram_chart(f"Histograms: {x}", bars, edges, x)
    return figure(chart, tag("b", title), f"Shares of {', '.join(said)}; {high}; lines are medians. {note}")
