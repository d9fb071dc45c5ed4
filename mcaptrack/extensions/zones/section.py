"""The section of the report on zones and lines: totals for each channel of tracks, and how many are inside over time.

Letters: F frames, P points of a chart.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from mcaptrack import log
from mcaptrack.contracts import ReportSection, SectionTable
from mcaptrack.extensions.zones.counting import counted_zones
from mcaptrack.extensions.zones.shapes import Zone
from mcaptrack.extensions.zones.visits import ZoneInWorlds, ZoneTotals, medians_of
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema import ZONE_COUNTS
from mcaptrack.schema.framing import joined_parts
from mcaptrack.transforms import FULL
from mcaptrack.viewing.charts import POINTS, Axis, Floats, Line, figure, line_chart, round_most
from mcaptrack.viewing.formatting import NONE, number, short

#: The colours of channels of tracks, by their names below the camera.
_ROLES: Final = {"tracks": "tracks", "retracks": "offline", f"retracks{FULL}": "offline", "truth": "truth"}
#: The most zones with a chart.
_CHARTS: Final = 12
_OF_ZONES: Final = ("tracks", "visits", "entered", "left", "mean stay", "median stay", "most inside", "mean inside")
_OF_LINES: Final = ("tracks", "forward", "backward")
_IN_WORLDS: Final = ("tracks", "mean stay", "tracks that went on to")
_TABLES: Final = {
    False: ("Who visits zones. Entered and left: visits over the edge; others began or ended inside.", _OF_ZONES),
    True: ("Who crosses lines: forward is from the left to the right of a line, seen from its first point.", _OF_LINES),
}


def section(opened: log.Log, prefix: str, names: Mapping[str, str]) -> ReportSection | None:
    """Return the section; None if nothing was counted. ``names`` are those of tracks for people, by role."""
    counted = counted_zones(opened, prefix, with_worlds=True)
    if not counted:
        return None
    shown = [(channel, _ROLES.get(channel.topic.removeprefix(prefix + "/"), "samples")) for channel in counted]
    shown.sort(key=lambda pair: ([*_ROLES.values(), "samples"].index(pair[1]), pair[0].topic))
    called = {
        channel.topic: names.get(role, channel.topic) if role != "samples" else channel.topic for channel, role in shown
    }
    zones = list({zone.name: zone for channel in counted for zone in channel.zones}.values())
    tables = []
    for is_line, (caption, columns) in _TABLES.items():
        groups = [
            (
                zone.name,
                [
                    (role, called[channel.topic], channel.topic, _cells(total))
                    for channel, role in shown
                    for total in channel.totals
                    if (total.zone, total.is_line) == (zone.name, is_line)
                ],
            )
            for zone in zones
            if zone.is_line == is_line
        ]
        tables += [SectionTable(caption, columns, groups)] if groups else []
    in_worlds = [
        (total.zone, [(role, called[channel.topic], channel.topic, _in_worlds(total.in_worlds))])
        for channel, role in shown
        for total in channel.totals
        if total.in_worlds
    ]
    if in_worlds:
        of_all = medians_of(total.in_worlds for channel in counted for total in channel.totals if total.in_worlds)
        caption = f"Over worlds of re-tracking: {of_all}."
        tables.append(SectionTable(caption, _IN_WORLDS, in_worlds))
    some = [zone for zone in zones if not zone.is_line][:_CHARTS]
    inside = {channel.topic: _inside(opened, channel.topic, channel.zones) for channel in counted}
    figures = []
    for zone in some:
        lines = [
            Line(short(called[channel.topic]), role, *inside[channel.topic][zone.name])
            for channel, role in shown
            if zone.name in inside[channel.topic]
        ]
        figures.append(_chart(zone.name, lines))
    left = sum(not zone.is_line for zone in zones) - len(some)
    note = f"{left} more zones have no chart." if left else ""
    data = {channel.topic: [total.to_json() for total in channel.totals] for channel in counted}
    return ReportSection("Zones", "Zones and lines", tables, figures, note, data)


def _in_worlds(zone: ZoneInWorlds) -> list[str]:
    """The cells of medians and intervals."""
    stay = zone.mean_dwell_s.words(1, " s") if zone.mean_dwell_s else NONE
    then = "; ".join(f"{to}: {tracks.words()}" for to, tracks in zone.then.items() if tracks.high)
    return [zone.tracks.words(), stay, then or NONE]


def _cells(totals: ZoneTotals) -> list[str]:
    if totals.is_line:
        return [number(value) for value in (totals.tracks, totals.forward, totals.backward)]
    return [
        *(number(value) for value in (totals.tracks, totals.visits, totals.entered, totals.left)),
        *(NONE if value is None else number(value, 1, "s") for value in (totals.mean_dwell_s, totals.median_dwell_s)),
        number(totals.most_inside),
        NONE if totals.mean_inside is None else number(totals.mean_inside, 2),
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
    axes = (
        Axis("time, s", max(last, 1e-3)),
        Axis("tracks inside", round_most([line.y for line in lines], 4.0, whole=True), whole=True),
    )
    chart = line_chart(f"Tracks inside {name} over time", lines, *axes)
    return figure(chart, f"Inside {name}.", "The most at a time in each period.")
