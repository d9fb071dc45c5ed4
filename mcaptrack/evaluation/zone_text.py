"""Visits of zones and crossings of lines as text, for the log panel of viewers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import isnan
from typing import Any

from mcaptrack import foxglove
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.zones import Zone
from mcaptrack.schema import Frame


def zone_messages(
    visited: Sequence[Frame], crossed: Sequence[Frame], zones: Sequence[Zone], tracks_topic: str, start_ns: int
) -> Iterator[tuple[int, int, bytes]]:
    """foxglove.Log messages (time, number, payload) of enters, leaves and crossings, in order of time.

    ``visited`` and ``crossed`` are frames of ZoneVisits and ZoneCrossings; times in the text count from ``start_ns``.
    """
    names = {zone.number: zone.name for zone in zones}
    lines: list[tuple[int, int, str]] = []
    for frame in visited:
        for row in frame.rows:
            track, name, dwell_s = f"track {row['track_id']}", names[int(row["zone_id"])], float(row["dwell_s"])
            verb = "begins in" if row["began_inside"] else "enters"
            lines.append((frame.t_ns, 0, f"{track} {verb} {name}{_place(row)}"))
            until_ns, verb = frame.t_ns + round(dwell_s * NS_PER_S), "ends in" if row["ended_inside"] else "leaves"
            lines.append((until_ns, 1, f"{track} {verb} {name} after {dwell_s:.1f} s{_place(row, 'last_')}"))
    for frame in crossed:
        for row in frame.rows:
            way = "forward" if row["forward"] else "backward"
            words = f"track {row['track_id']} crosses {names[int(row['zone_id'])]} {way}{_place(row)}"
            lines.append((frame.t_ns, 2, words))
    for number, (t_ns, _, words) in enumerate(sorted(lines)):
        text = f"{words} at {(t_ns - start_ns) / NS_PER_S:.2f} s"
        yield t_ns, number, foxglove.pack_log(t_ns, "INFO", tracks_topic, text)


def _place(row: Any, front: str = "") -> str:
    for unit, digits in (("m", 1), ("px", 0)):
        x, y = float(row[f"{front}x_{unit}"]), float(row[f"{front}y_{unit}"])
        if not isnan(x) and not isnan(y):
            return f", ({x:.{digits}f}, {y:.{digits}f}) {unit},"
    return ""
