"""The page about thousands of logs, as text: what ``fleet`` computes, with links to the pages of single logs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np

from mcaptrack import SCHEMA_VERSION, __version__
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.viewing.report import fleet
from mcaptrack.viewing.report.charts import Axis, Line, line_chart, round_most
from mcaptrack.viewing.report.fleet import Row
from mcaptrack.viewing.report.formatting import NONE, counted, number, percent, plain, render

#: The columns of a log in the data of the page.
_KEPT: Final = (
    *("recording", "location", "start_t_ns", "duration_s", "tracks", "scored", "similarity", "gate"),
    *("IDF1", "MOTA", "HOTA", "IDSW", "warnings"),
)
#: Address of the page of a log, from this page; "" if it has none.
Link = Callable[[Row], str]


def fleet_data(rows: Sequence[Row]) -> dict[str, Any]:
    """All numbers of the page."""

    def kept(some: Sequence[Row]) -> list[dict[str, Any]]:
        return [{name: row.get(name) for name in _KEPT} for row in some]

    far = fleet.outliers(rows)
    data: dict[str, Any] = plain(
        {
            "schema_version": SCHEMA_VERSION,
            "mcaptrack_version": __version__,
            "summary": fleet.summary(rows),
            "trends": fleet.trends(rows),
            "worst": {name: kept(some) for name, some in fleet.worst(rows).items()},
            "outliers": [
                {"recording": outlier["row"]["recording"]} | {k: v for k, v in outlier.items() if k != "row"}
                for outlier in far
            ],
            "warnings": fleet.warnings_by_code(rows),
        }
    )
    return data


def fleet_page(rows: Sequence[Row], title: str, element: str, data: Mapping[str, Any], link: Link) -> str:
    """The page; ``data`` is what ``fleet_data`` gives, and goes into the element of that id."""
    by_name = {str(row["recording"]): row for row in rows}

    def listed(row: Row) -> dict[str, Any]:
        return {
            "name": str(row["recording"]),
            "place": row.get("location") or "",
            "link": link(row),
            "cells": _cells(row),
        }

    tables = []
    for name, (heading, lacking) in _LISTS.items():
        some = [listed(by_name[row["recording"]]) for row in data["worst"][name]]
        tables.append({"heading": heading, "rows": some, "missing": "" if some else lacking})
    far = [
        listed(by_name[outlier["recording"]])
        | {
            "measure": outlier["measure"],
            "value": number(outlier["value"], 1, outlier["unit"]),
            "median": number(outlier["median"], 1, outlier["unit"]),
            "times": f"{number(outlier['value'] / outlier['median'], 2)} times",
        }
        for outlier in data["outliers"]
    ]
    return render(
        "fleet.html",
        version=__version__,
        element=element,
        title=title,
        colours=[],
        text=_text(data["summary"]),
        tiles=_tiles(data["summary"]),
        trends=_trends(data["trends"]),
        columns=_COLUMNS,
        tables=tables,
        outliers=far,
        warnings=data["warnings"],
        data=data,
    )


_LISTS: Final = {
    "IDF1": ("Lowest scores", "No log has ground truth, so none has a score."),
    "IDSW": ("Most identity switches by time", "No log with ground truth has an identity switch."),
    "warnings": ("Most warnings", "No log has a warning."),
}
_COLUMNS: Final = ("begins (UTC)", "duration", "tracks", "IDF1", "MOTA", "switches", "warnings")


def _cells(row: Row) -> list[str]:
    start = row.get("start_t_ns")
    return [
        datetime.fromtimestamp(start // NS_PER_S, UTC).strftime("%Y-%m-%d %H:%M") if start is not None else NONE,
        number(row.get("duration_s"), 1, "s"),
        number(row.get("tracks")),
        percent(row.get("IDF1")),
        percent(row.get("MOTA")),
        number(row.get("IDSW")),
        number(row.get("warnings")),
    ]


def _text(summary: Mapping[str, Any]) -> str:
    text = f"{counted(summary['logs'], 'log')}, {number(summary['hours'], 1)} hours"
    text += f", {counted(summary['tracks'], 'track')}." if summary["tracks"] else "."
    if summary["scored"]:
        text += f" {counted(summary['scored'], 'log')} with ground truth: half of them keep more than "
        text += f"{percent(summary['median_IDF1'])} of identities (IDF1)."
    else:
        text += " How good the tracks are is not known without ground truth."
    lacking = [
        f"{counted(summary[name], 'log')} {said}"
        for name, said in (("empty", "without messages"), ("without_tracks", "without tracks"))
        if summary[name]
    ]
    return text + (f" {' and '.join(lacking)}." if lacking else "")


def _tiles(summary: Mapping[str, Any]) -> list[dict[str, str]]:
    versions = ", ".join(f"{name or 'none'}: {count}" for name, count in summary["versions"].items())
    tiles = [
        ("logs", number(summary["logs"]), f"{number(summary['bytes'] / 1e9, 2, 'GB')}"),
        ("hours", number(summary["hours"], 1), ""),
        ("tracks", number(summary["tracks"]), ""),
        ("median IDF1", percent(summary["median_IDF1"]), f"of {counted(summary['scored'], 'log')} with ground truth"),
        ("identity switches", number(summary["IDSW"]), ""),
        ("logs with warnings", number(summary["with_warnings"]), ""),
        ("versions of results", number(len(summary["versions"])), versions),
    ]
    return [{"label": label, "value": value, "note": note} for label, value, note in tiles]


def _trends(trends: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """Charts of what changed over time."""
    if trends is None:
        return []
    days = np.array(trends["days"])
    x = Axis(f"days since {trends['first']} (UTC)", round_most([days]))

    def values(name: str, part: str) -> Any:
        return np.array([np.nan if value is None else value for value in trends[name][part]], np.float64)

    charts = []
    for name, label, is_share in (
        ("IDF1", "IDF1, %", True),
        ("IDSW", "identity switches by hour", False),
        ("tracks", "tracks by hour", False),
    ):
        middle, low, high = (values(name, part) for part in ("median", "low", "high"))
        if not np.isfinite(middle).any():
            continue
        has_value = np.isfinite(middle)
        y = Axis(label, 1.0 if is_share else round_most([high]), is_share)
        line = Line("median", "offline", days[has_value], middle[has_value], low[has_value], high[has_value])
        chart = line_chart(f"{label} over time", [line], x, y)
        charts.append(
            {"chart": chart, "title": label, "caption": f"of the logs of each {trends['bin']}, with quartiles"}
        )
    counts = np.array(trends["logs"], np.float64)
    warned = values("warnings", "mean")
    lines = [Line("logs", "tracks", days, counts)]
    chart = line_chart("logs over time", lines, x, Axis("logs", round_most([counts])))
    charts.append({"chart": chart, "title": "logs", "caption": f"of each {trends['bin']}"})
    if np.nanmax(warned, initial=0) > 0:
        has_value = np.isfinite(warned)
        line = Line("mean", "online", days[has_value], warned[has_value])
        chart = line_chart("warnings over time", [line], x, Axis("warnings by log", round_most([warned])))
        charts.append({"chart": chart, "title": "warnings by log", "caption": f"mean of each {trends['bin']}"})
    return charts
