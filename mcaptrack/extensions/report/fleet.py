"""The page about thousands of logs: what is computed of them, and the page with links to those of single logs."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np

from mcaptrack import SCHEMA_VERSION, __version__
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.viewing.charts import Axis, Line, figure, line_chart, round_most
from mcaptrack.viewing.formatting import NONE, counted, number, percent, plain, render

#: The columns of a log in the data of the page.
_KEPT: Final = (
    *("recording", "location", "start_t_ns", "duration_s", "tracks", "scored", "similarity", "gate"),
    *("IDF1", "MOTA", "HOTA", "IDSW", "warnings"),
)


# The contents of a page about thousands of logs: totals, trends, the worst logs, outliers, and what warnings say.
#
# All of it follows from the table ``recordings``: a mapping for each log, with the columns of that table.
#
# Letters: L logs, B bins of time.


Row = Mapping[str, Any]

#: Clocks that begin with the recording say nothing about its date: times before the year 2000.
_FIRST_DATE_NS: Final = 946_684_800 * NS_PER_S
#: Lengths of bins of time, in seconds, with their names; the shortest that gives at most so many bins.
_BINS_S: Final = {3600: "hour", 86400: "day", 7 * 86400: "week", 30 * 86400: "30 days", 365 * 86400: "year"}
_MOST_BINS: Final = 62
#: How many logs a list has.
_LISTED: Final = 20
#: A value is an outlier if its logarithm is so many (robust) standard deviations from the median, among enough logs.
_FAR, _ENOUGH = 3.5, 8
#: Standard deviation of a normal distribution by its median absolute deviation.
_BY_MAD: Final = 1.4826
#: Deviations below this are not looked at: a twentieth more or less.
_LEAST_SPREAD: Final = 0.05


def per_hour(row: Row, name: str) -> float | None:
    """A count per hour of the log; None if the count or the duration is not known."""
    count, hours = row.get(name), (row.get("duration_s") or 0) / 3600
    return None if count is None or hours <= 0 else count / hours


def _per_second(row: Row, name: str) -> float | None:
    hourly = per_hour(row, name)
    return None if hourly is None else hourly / 3600


#: What is looked at for outliers: its name, unit and value.
MEASURES: Final[Mapping[str, tuple[str, Callable[[Row], float | None]]]] = {
    "duration": ("s", lambda row: row.get("duration_s")),
    "size by time": ("kB/s", lambda row: None if (v := _per_second(row, "size_bytes")) is None else v / 1e3),
    "messages by time": ("1/s", lambda row: _per_second(row, "messages")),
    "tracks by time": ("1/h", lambda row: per_hour(row, "tracks")),
    "identity switches by time": ("1/h", lambda row: per_hour(row, "IDSW")),
}


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Totals over all logs."""
    scored = [row["IDF1"] for row in rows if row.get("IDF1") is not None]
    return {
        "logs": len(rows),
        "hours": sum(row.get("duration_s") or 0 for row in rows) / 3600,
        "bytes": sum(row.get("size_bytes") or 0 for row in rows),
        "tracks": sum(row.get("tracks") or 0 for row in rows),
        "scored": len(scored),
        "median_IDF1": float(np.median(scored)) if scored else None,
        "IDSW": sum(row.get("IDSW") or 0 for row in rows) if scored else None,
        "with_warnings": sum(bool(row.get("warnings")) for row in rows),
        "without_tracks": sum(row.get("tracks") is None for row in rows),
        "empty": sum(not row.get("messages") for row in rows),
        "versions": _versions(rows),
    }


def _versions(rows: Sequence[Row]) -> dict[str, int]:
    """The number of logs with results of each version; "" for those without results."""
    return dict(sorted(Counter(row.get("versions") or "" for row in rows).items()))


def worst(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The logs with the lowest IDF1, the most identity switches by time, and the most warnings."""

    def ranked(value: Callable[[Row], float | None]) -> list[Row]:
        valued = [(value(row), str(row["recording"]), row) for row in rows]
        ranking = sorted((number, name, at) for at, (number, name, _) in enumerate(valued) if number is not None)
        return [rows[at] for _, _, at in ranking[:_LISTED]]

    return {
        "IDF1": ranked(lambda row: row.get("IDF1")),
        "IDSW": ranked(lambda row: -value if (value := per_hour(row, "IDSW")) else None),
        "warnings": ranked(lambda row: -row["warnings"] if row.get("warnings") else None),
    }


def outliers(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Logs with a value far from that of most others, the farthest first: how many times as large as the median."""
    far_off: list[dict[str, Any]] = []
    for name, (unit, value) in MEASURES.items():
        valued = [(row, number) for row in rows if (number := value(row)) is not None and number > 0]
        if len(valued) < _ENOUGH:
            continue
        logs = np.log([number for _, number in valued])
        middle = float(np.median(logs))
        spread = max(_BY_MAD * float(np.median(np.abs(logs - middle))), _LEAST_SPREAD)
        far = (logs - middle) / spread
        far_off += [
            {
                "row": valued[at][0],
                "measure": name,
                "unit": unit,
                "value": valued[at][1],
                "median": float(np.exp(middle)),
                "deviations": float(far[at]),
            }
            for at in np.flatnonzero(np.abs(far) > _FAR).tolist()
        ]
    return sorted(far_off, key=lambda outlier: (-abs(outlier["deviations"]), str(outlier["row"]["recording"])))[
        : 2 * _LISTED
    ]


def warnings_by_code(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """The codes of warnings: how many logs have each, one of its messages, and a log with it."""
    by_code: dict[str, dict[str, Any]] = {}
    for row in rows:
        # The first message of each code.
        for code, message in dict(reversed([*_notices_in(row.get("warning_texts"))])).items():
            first = {"code": code, "logs": 0, "message": message, "recording": row["recording"]}
            by_code.setdefault(code, first)["logs"] += 1
    return sorted(by_code.values(), key=lambda entry: (-entry["logs"], entry["code"]))


def _notices_in(text: str | None) -> Iterator[tuple[str, str]]:
    try:
        notices = json.loads(text or "[]")
    except ValueError:
        return
    for notice in notices if isinstance(notices, list) else []:
        if isinstance(notice, dict):
            yield str(notice.get("code", "other")), str(notice.get("message", ""))


def trends(rows: Sequence[Row]) -> dict[str, Any] | None:
    """Changes of logs over time, in bins of equal length; None unless there are dates of at least three bins.

    Lists of B values: ``days`` since ``first``, logs, hours, and medians and quartiles of IDF1 and of what is counted
    by hour; None where a bin has no value.
    """
    dated = [row for row in rows if (row.get("start_t_ns") or 0) >= _FIRST_DATE_NS]
    if not dated:
        return None
    start_s = np.array([row["start_t_ns"] // NS_PER_S for row in dated], np.int64)
    # Bins begin at midnight (UTC), so that a night after another adds bins and moves none.
    first = int(start_s.min()) // 86400 * 86400
    span = int(start_s.max()) - first
    step, name = next(((size, name) for size, name in _BINS_S.items() if span / size <= _MOST_BINS), (0, ""))
    if not step:
        step, name = 365 * 86400, "year"
    at = (start_s - first) // step
    bins = np.unique(at)
    if len(bins) < 3:
        return None
    members = [[dated[k] for k in np.flatnonzero(at == number).tolist()] for number in bins.tolist()]
    return {
        "first": datetime.fromtimestamp(first, UTC).date().isoformat(),
        "bin": name,
        "days": ((bins + 0.5) * step / 86400).tolist(),
        "logs": [len(some) for some in members],
        "hours": [sum(row.get("duration_s") or 0 for row in some) / 3600 for some in members],
        "IDF1": _quartiles(members, lambda row: row.get("IDF1")),
        "IDSW": _quartiles(members, lambda row: per_hour(row, "IDSW")),
        "tracks": _quartiles(members, lambda row: per_hour(row, "tracks")),
        "warnings": _quartiles(members, lambda row: row.get("warnings")),
    }


def _quartiles(members: Sequence[Sequence[Row]], value: Callable[[Row], float | None]) -> dict[str, list[float | None]]:
    """Quartiles and mean of a value in each bin; None without any."""
    out: dict[str, list[float | None]] = {"low": [], "median": [], "high": [], "mean": []}
    for some in members:
        values: Floats = np.array([number for row in some if (number := value(row)) is not None], np.float64)
        numbers = [*np.percentile(values, [25, 50, 75]).tolist(), float(values.mean())] if len(values) else [None] * 4
        for name, number in zip(out, numbers, strict=True):
            out[name].append(number)
    return out


#: Address of the page of a log, from this page; "" if it has none.
Link = Callable[[Row], str]


def fleet_data(rows: Sequence[Row]) -> dict[str, Any]:
    """All numbers of the page.

    ``rows`` are those of the table of runs, a row for each log.
    """

    def kept(some: Sequence[Row]) -> list[dict[str, Any]]:
        return [{name: row.get(name) for name in _KEPT} for row in some]

    far = outliers(rows)
    data: dict[str, Any] = plain(
        {
            "schema_version": SCHEMA_VERSION,
            "mcaptrack_version": __version__,
            "summary": summary(rows),
            "trends": trends(rows),
            "worst": {name: kept(some) for name, some in worst(rows).items()},
            "outliers": [
                {"recording": outlier["row"]["recording"]} | {k: v for k, v in outlier.items() if k != "row"}
                for outlier in far
            ],
            "warnings": warnings_by_code(rows),
        }
    )
    return data


def fleet_page(rows: Sequence[Row], title: str, element: str, data: Mapping[str, Any], link: Link) -> str:
    """The page; ``data`` is what ``fleet_data`` gives, and goes into the element of that id.

    ``rows`` are as for ``fleet_data``, ``title`` is the heading, and ``link`` gives the address of the report on the
    log of a row.
    """
    by_name = {str(row["recording"]): row for row in rows}

    def listed(row: Row) -> dict[str, Any]:
        place = row.get("location") or ""
        return {"name": str(row["recording"]), "place": place, "link": link(row), "cells": _cells(row)}

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
        __package__ or "",
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
        charts.append(figure(chart, label, f"of the logs of each {trends['bin']}, with quartiles"))
    counts = np.array(trends["logs"], np.float64)
    warned = values("warnings", "mean")
    lines = [Line("logs", "tracks", days, counts)]
    chart = line_chart("logs over time", lines, x, Axis("logs", round_most([counts])))
    charts.append(figure(chart, "logs", f"of each {trends['bin']}"))
    if np.nanmax(warned, initial=0) > 0:
        has_value = np.isfinite(warned)
        line = Line("mean", "online", days[has_value], warned[has_value])
        chart = line_chart("warnings over time", [line], x, Axis("warnings by log", round_most([warned])))
        charts.append(figure(chart, "warnings by log", f"mean of each {trends['bin']}"))
    return charts
