"""The values of the sections with numbers: scores, forecasts, and how people move."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack.errors import command
from mcaptrack.evaluation import EvaluationRow
from mcaptrack.evaluation.metrics import summary
from mcaptrack.evaluation.metrics.displacement import LEVELS
from mcaptrack.extensions.report.contents import LogReport
from mcaptrack.extensions.report.headline import result_of, rule_text, rules_text
from mcaptrack.viewing.charts import Axis, Bars, Line, figure, histogram_chart, line_chart, round_most
from mcaptrack.viewing.formatting import counted, number, percent, short

#: The columns of the table of scores: whether a column is a share, and whether its lowest value is the best.
_SCORES: Final = {"IDF1": True, "MOTA": True, "HOTA": True, "IDSW": False, "Frag": False, "FP": False, "FN": False}
_LOWEST: Final = ("IDSW", "Frag", "FP", "FN", "AMOTP_m")
#: Further columns, where they are known: averages over recalls, of 3D tracks with scores. Their numbers of digits, or
#: None for shares.
_AVERAGES: Final = {"AMOTA": None, "AMOTP_m": 2, "AMOTP": 2}

#: The least change of a share that is called one.
_LEAST_FALL: Final = 0.001

Figure = dict[str, Any]


def scores(report: LogReport) -> dict[str, Any]:
    """All scores by rule, and statistics of tracks that need no ground truth."""
    headline = report.headline
    of_all = [row for row in report.results if row.of_class is None]
    # The tracker's tracks at the prediction rate are compared with the re-tracked ones: one number for one thing.
    beside = report.track_sets["tracks"].topic if {"tracks", "samples"} <= set(report.track_sets) else ""

    def by_rule(row: EvaluationRow) -> bool:
        return headline is None or (row.similarity, row.gate) == headline.rule

    first = [row for row in of_all if by_rule(row) and row.tracks != beside]
    of_classes = [row for row in report.results if row.of_class is not None and by_rule(row)]
    rest = [row for row in of_all if row not in first]
    rules = sorted({(row.similarity, row.gate) for row in rest})
    return {
        "columns": _columns(first + of_classes),
        "groups": _score_groups(first + of_classes, report),
        "other_columns": _columns(rest),
        "other_groups": _score_groups(rest, report),
        "has_averages": any(row.averages for row in report.results),
        "other_rules": rules_text(rules),
        "is_at_prediction_rate": bool(beside),
        "falls": _falls(report, of_all),
        "missing": report.missing.get("scores", ""),
        "tracks": _track_rows(report),
        "no_tracks": f"There are no tracks here; {command('run', Path(report.file))} makes them.",
    }


def _falls(report: LogReport, results: Sequence[EvaluationRow]) -> list[str]:
    """Which scores are worse after re-tracking, by which rule; shares by at least a tenth of a point."""
    before, after = (report.track_sets[role].topic if role else "" for role in report.compared_roles)
    out = []
    for row in results:
        other = result_of(results, after, row.similarity, row.gate) if row.tracks == before else None
        if other is None:
            continue
        was, now = summary(row.score), summary(other.score)
        for key, is_share in (("IDF1", True), ("MOTA", True), ("HOTA", True), ("IDSW", False)):
            worse = was[key] - now[key] >= _LEAST_FALL if is_share else now[key] > was[key]
            if worse:
                change = " → ".join(_score_text(key, values[key]) for values in (was, now))
                out.append(f"{key} {change} {rule_text(row.similarity, row.gate)}")
    return out


def _columns(results: Sequence[EvaluationRow]) -> list[str]:
    """The columns of a table of scores."""
    return [*_SCORES, *(name for name in _AVERAGES if any(name in row.averages for row in results))]


def _score_groups(results: Sequence[EvaluationRow], report: LogReport) -> list[dict[str, Any]]:
    """A group of rows for each rule, and for each class; the best value of a group is marked."""
    names = {track_set.topic: (track_set.name, track_set.role) for track_set in report.track_sets.values()}
    groups: dict[tuple[str, float, str], list[EvaluationRow]] = {}
    for row in results:
        groups.setdefault((row.similarity, row.gate, row.of_class or ""), []).append(row)
    out = []
    columns = _columns(results)
    for (similarity, gate, of_class), members in sorted(groups.items()):
        all_values = [{**dict.fromkeys(columns), **summary(row.score), **row.averages} for row in members]
        best = {key: _best([values[key] for values in all_values], key) for key in columns}
        rows = []
        for row, values in zip(members, all_values, strict=True):
            name, role = names.get(row.tracks, (row.tracks, "truth"))
            cells = [
                (_score_text(key, values[key]), len(members) > 1 and best[key] is not None and values[key] == best[key])
                for key in columns
            ]
            rows.append({"name": name, "role": role, "topic": row.tracks, "cells": cells})
        rule = rule_text(similarity, gate) + (f", {of_class}" if of_class else "")
        out.append({"rule": rule, "rows": rows})
    return out


def _best(values: Sequence[float | None], key: str) -> float | None:
    """The best value of a column; None if none is known."""
    present = [value for value in values if value is not None]
    return (min if key in _LOWEST else max)(present) if present else None


def _score_text(key: str, value: float | None) -> str:
    if key in _AVERAGES and (digits := _AVERAGES[key]) is not None:
        return number(value, digits, "m" if key.endswith("_m") else "")
    return percent(value) if _SCORES.get(key, True) else number(value)


def _track_rows(report: LogReport) -> list[dict[str, Any]]:
    repairs = {events.topic: events.counts["joined"] + events.counts["parted"] for events in report.channel_events}
    return [
        {
            "name": tracks["name"],
            "role": tracks["role"],
            "topic": tracks["topic"],
            "cells": [
                number(tracks["tracks"]),
                number(tracks["median_s"], 1, "s"),
                number(tracks["longest_s"], 1, "s"),
                percent(tracks["observed_share"], 0),
                number(repairs.get(tracks["topic"]) if tracks["role"] == "offline" else None),
            ],
        }
        for tracks in report.data["tracks"]
    ]


def forecasts(report: LogReport) -> dict[str, Any]:
    """Errors by recall and by horizon, and calibration."""
    errors = report.data["forecasts"]
    if not errors:
        reason = "the log has no ground truth" if "truth" not in report.track_sets else "none have a known future"
        if not any(channel["schema"] == "mcaptrack.Predictions" for channel in report.data["channels"]):
            reason = f"the log holds none; {command('predict', Path(report.file))} makes them"
        missing = [f"There are no forecasts that could be scored: {reason}."]
        return {"figures": [], "missing": missing, "scene": report.forecast_scene}
    names = {track_set.topic: (track_set.name, track_set.role) for track_set in report.track_sets.values()}
    members = [(entry, *names.get(entry["tracks"], (entry["tracks"], "truth"))) for entry in errors]
    figures = [_by_recall(members)]
    parts = [part for entry in errors for part in (entry["by_horizon"], entry["constant_velocity"]) if part]
    most = round_most(np.array(part[key], float) for part in parts for key in ("mean_m", "three_quarters_m"))
    figures += [_by_horizon(entry, name, role, most) for entry, name, role in members if entry["by_horizon"]["n"]]
    with_covariance = [member for member in members if member[0]["calibration"]]
    if with_covariance:
        figures = [*figures, _reliability(with_covariance)]
        return {"figures": figures, "missing": [], "scene": report.forecast_scene}
    why = "The reliability of the ellipses is not known: the forecasts have no covariance."
    return {"figures": figures, "missing": [why], "scene": report.forecast_scene}


def _by_recall(members: Sequence[tuple[dict[str, Any], str, str]]) -> Figure:
    lines = [
        Line(short(name), role, np.array(errors["curve_recall"]), np.array(errors["curve_ADE_m"]))
        for errors, name, role in members
    ]
    y = Axis("mean displacement error, m", round_most(line.y for line in lines))
    x = Axis("recall: share of people with a forecast", 1.0)
    caption = "People with the best tracked past come first, from left to right. Lower and longer is better."
    return figure(line_chart("Displacement error of forecasts over recall", lines, x, y), "Error over recall.", caption)


def _by_horizon(errors: dict[str, Any], name: str, role: str, most: float) -> Figure:
    part, baseline = errors["by_horizon"], errors["constant_velocity"]
    ahead = np.array(part["ahead_s"])
    band = (np.array(part["quarter_m"]), np.array(part["three_quarters_m"]))
    lines = [Line(short(name), role, ahead, np.array(part["mean_m"]), *band)]
    text = f"{number(part['mean_m'][-1], 2, 'm')} after {number(float(ahead[-1]), 1, 's')}"
    if baseline and baseline["n"]:
        mean_m = np.array(baseline["mean_m"])
        lines.append(Line("constant velocity", "truth", np.array(baseline["ahead_s"]), mean_m, dashed=True))
        text += f"; constant velocity has {number(baseline['mean_m'][-1], 2, 'm')}"
        if part["mean_m"][-1] >= baseline["mean_m"][-1]:
            text += ", so these forecasts don't help at that distance"
    title = f"Error of the forecasts of {name} by how far ahead they look"
    axes = Axis("seconds ahead", float(ahead[-1])), Axis("distance from the ground truth, m", most)
    caption = f"{text}. Line: mean of {counted(part['n'], 'forecast')}; band: the middle half."
    return figure(line_chart(title, lines, *axes), f"Error by horizon, {name}.", caption)


def _reliability(members: Sequence[tuple[dict[str, Any], str, str]]) -> Figure:
    lines = []
    for errors, name, role in members:
        nominal, held = (np.array([part[key] for part in errors["calibration"]]) for key in ("nominal", "held"))
        lines.append(Line(short(name), role, nominal, held))
    title = "Share of true futures inside the forecast ellipses, against their probability"
    axes = Axis("probability, %", 1.0, percent=True), Axis("share inside, %", 1.0, percent=True)
    text = "; ".join(
        f"{name}: "
        + ", ".join(
            f"{percent(part['held'], 0)} in {percent(part['nominal'], 0)}"
            for part in errors["calibration"]
            if part["nominal"] in LEVELS
        )
        + f", NLL {number(errors['NLL'], 2)}"
        for errors, name, _ in members
    )
    text += (
        ". Below the dashed line forecasts are overconfident, above it too cautious. NLL: negative log-likelihood of "
    )
    text += "the true positions; lower is better."
    return figure(line_chart(title, lines, *axes, diagonal="calibrated"), "Reliability.", text)


def motion(report: LogReport) -> dict[str, Any]:
    """Speeds of people, and durations of tracks."""
    figures, missing = [], []
    speeds, durations = report.data["speed_m_per_s"], report.data["dwell_s"]
    if speeds:
        note = "From one row to the next" + (" at the prediction rate" if "samples" in report.track_sets else "")
        note += "; gaps left out."
        note += report.metres_note
        figures.append(_histogram(report, speeds, "Speed.", "speed, m/s", note, "m/s", "step", 2))
    elif report.track_sets:
        missing.append("Speeds are not known: without a ground plane there are no positions on the ground.")
    if durations:
        note = "From the first row of a track to its last."
        figures.append(_histogram(report, durations, "Duration.", "duration of a track, s", note, "s", "track", 1))
    if not figures and not missing:
        missing.append("There are no people, so there is no motion.")
    return {"figures": figures, "missing": missing}


def _histogram(
    report: LogReport, histogram: dict[str, Any], title: str, x: str, note: str, unit: str, of: str, digits: int
) -> Figure:
    track_sets = {track_set.topic: track_set for track_set in report.track_sets.values()}
    edges = np.array(histogram["edges"])
    bars, texts = [], []
    for part in histogram["series"]:
        if not part["n"]:
            continue
        tracks = track_sets[part["topic"]]
        shares = np.array(part["counts"]) / part["n"]
        median = f"median {number(part['median'], digits, unit)}"
        bars.append(Bars(short(tracks.name), tracks.role, shares, part["median"], median))
        beyond = f" ({number(part['above'])} of them beyond)" if part["above"] else ""
        texts.append(f"{short(tracks.name)} {counted(part['n'], of)}{beyond}")
    high = f"the highest bar is {percent(max(float(bar.shares.max(initial=0)) for bar in bars), 0)}"
    caption = f"Shares of {', '.join(texts)}; {high}; lines are medians. {note}"
    return figure(histogram_chart(f"Histograms: {x}", bars, edges, x), title, caption)
