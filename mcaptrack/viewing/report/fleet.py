"""The contents of a page about thousands of logs: totals, trends, the worst logs, outliers, and what warnings say.

All of it follows from the table ``recordings``: a mapping for each log, with the columns of that table.

Letters: L logs, B bins of time.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np

from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.clocks import NS_PER_S

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
    counts: dict[str, int] = {}
    for row in rows:
        text = row.get("versions") or ""
        counts[text] = counts.get(text, 0) + 1
    return dict(sorted(counts.items()))


def worst(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The logs with the lowest IDF1, the most identity switches by time, and the most warnings."""

    def ranked(value: Callable[[Row], float | None]) -> list[Row]:
        valued = [(value(row), str(row["recording"]), row) for row in rows]
        ranking = sorted((number, name, at) for at, (number, name, _) in enumerate(valued) if number is not None)
        return [rows[at] for _, _, at in ranking[:_LISTED]]

    def most(name: str) -> Callable[[Row], float | None]:
        return lambda row: -value if (value := per_hour(row, name)) else None

    return {
        "IDF1": ranked(lambda row: row.get("IDF1")),
        "IDSW": ranked(most("IDSW")),
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
        first_messages: dict[str, str] = {}
        for code, message in _notices_in(row.get("warning_texts")):
            first_messages.setdefault(code, message)
        for code, message in first_messages.items():
            entry = by_code.setdefault(
                code, {"code": code, "logs": 0, "message": message, "recording": row["recording"]}
            )
            entry["logs"] += 1
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
