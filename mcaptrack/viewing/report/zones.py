"""The section on zones and lines: their totals for each channel of tracks, and how many tracks are inside over time.

Letters: F frames, P points of a chart.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from mcaptrack import log, pipeline
from mcaptrack.evaluation.zones import ZoneTotals
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.zones import Zone
from mcaptrack.schema import ZONE_COUNTS
from mcaptrack.schema.framing import joined_parts
from mcaptrack.transforms import FULL
from mcaptrack.viewing.report.charts import POINTS, Axis, Floats, Line, line_chart, round_most
from mcaptrack.viewing.report.formatting import NONE, number, short

#: The colours of channels of tracks, by their names below the camera.
_ROLES: Final = {"tracks": "tracks", "retracks": "offline", f"retracks{FULL}": "offline", "truth": "truth"}
#: The most zones with a chart.
_CHARTS: Final = 12
_OF_ZONES: Final = ("tracks", "visits", "entered", "left", "mean stay", "median stay", "most inside", "mean inside")
_OF_LINES: Final = ("tracks", "forward", "backward")


def zone_section(opened: log.Log, prefix: str, names: Mapping[str, str]) -> dict[str, Any]:
    """Return the values of the section; ``names`` are those of tracks for people, by role.

    Nothing was counted if ``rows`` and ``lines`` are empty. ``data`` are the totals as values of JSON.
    """
    counted = pipeline.counted_zones(opened, prefix)
    if not counted:
        return {"columns": _OF_ZONES, "rows": [], "line_columns": _OF_LINES, "lines": [], "figures": [], "data": {}}
    shown = [(one, _ROLES.get(one.topic.removeprefix(prefix + "/"), "samples")) for one in counted]
    shown.sort(key=lambda pair: ([*_ROLES.values(), "samples"].index(pair[1]), pair[0].topic))
    called = {one.topic: names.get(role, one.topic) if role != "samples" else one.topic for one, role in shown}
    zones = list({zone.name: zone for one in counted for zone in one.zones}.values())
    groups: dict[bool, list[dict[str, Any]]] = {False: [], True: []}
    for zone in zones:
        rows = [
            {"name": called[one.topic], "role": role, "topic": one.topic, "cells": _cells(total)}
            for one, role in shown
            for total in one.totals
            if (total.zone, total.is_line) == (zone.name, zone.is_line)
        ]
        groups[zone.is_line].append({"zone": zone.name, "rows": rows})
    some = [zone for zone in zones if not zone.is_line][:_CHARTS]
    inside = {one.topic: _inside(opened, one.topic, one.zones) for one in counted}
    figures = []
    for zone in some:
        lines = [
            Line(short(called[one.topic]), role, *inside[one.topic][zone.name])
            for one, role in shown
            if zone.name in inside[one.topic]
        ]
        figures.append(_chart(zone.name, lines))
    left = sum(not zone.is_line for zone in zones) - len(some)
    return {
        "columns": _OF_ZONES,
        "rows": groups[False],
        "line_columns": _OF_LINES,
        "lines": groups[True],
        "figures": figures,
        "left_out": left,
        "data": {one.topic: [total.to_json() for total in one.totals] for one in counted},
    }


def _cells(one: ZoneTotals) -> list[str]:
    if one.is_line:
        return [number(value) for value in (one.tracks, one.forward, one.backward)]
    return [
        *(number(value) for value in (one.tracks, one.visits, one.entered, one.left)),
        *(NONE if value is None else number(value, 1, "s") for value in (one.mean_dwell_s, one.median_dwell_s)),
        number(one.most_inside),
        NONE if one.mean_inside is None else number(one.mean_inside, 2),
    ]


def _inside(opened: log.Log, topic: str, zones: tuple[Zone, ...]) -> dict[str, tuple[Floats, Floats]]:
    """The most tracks inside each zone in equal periods: seconds since the start of the log, and numbers (P,)."""
    frames = opened.frame_columns(f"{topic}/zones/counts", ZONE_COUNTS)
    at_s = (frames.t_ns - opened.start_ns) / NS_PER_S
    if not len(at_s):
        return {}
    edges = np.linspace(at_s[0], at_s[-1], min(POINTS, len(at_s)) + 1)
    period = np.clip(np.searchsorted(edges, at_s, "right") - 1, 0, len(edges) - 2)
    out = {zone.name: np.zeros(len(edges) - 1) for zone in zones if not zone.is_line}
    for low, _, joined in joined_parts(ZONE_COUNTS, frames):
        for zone in zones:
            if not zone.is_line:
                of = joined.rows["zone_id"] == zone.number
                np.maximum.at(out[zone.name], period[joined.frame[of] + low], joined.rows["inside"][of])
    middle = (edges[1:] + edges[:-1]) / 2
    return {name: (middle, most) for name, most in out.items()}


def _chart(name: str, lines: list[Line]) -> dict[str, Any]:
    last = max((float(line.x[-1]) for line in lines), default=1.0)
    axes = Axis("time, s", max(last, 1e-3)), Axis("tracks inside", round_most([line.y for line in lines], 4.0))
    return {
        "chart": line_chart(f"Tracks inside {name} over time", lines, *axes),
        "title": f"Inside {name}.",
        "caption": "The most at a time in each period.",
    }
