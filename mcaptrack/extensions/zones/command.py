"""``mcaptrack zones``: what it prints."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import mcaptrack
from mcaptrack.cli import common
from mcaptrack.cli.many import EachLog
from mcaptrack.cli.text import print_table, say, show, show_left_out
from mcaptrack.errors import McaptrackError
from mcaptrack.location import Location

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from mcaptrack import RunResult
    from mcaptrack.extensions.zones.visits import ZoneInWorlds

#: The word before a log that is drawn on.
_DRAW: Final = "draw"


class Zones(EachLog["RunResult"]):
    """Count visits of zones and crossings of lines; with ``draw`` before a log, write a page to draw them on."""

    def run(self, names: Mapping[str, str]) -> None:
        """Run the command."""
        logs = self.values["logs"]
        if str(logs[0]) != _DRAW or (len(logs) == 1 and Path(_DRAW).exists()):
            super().run(names)
            return
        if len(logs) == 1:
            raise McaptrackError("`zones draw` needs a log: name it after draw")
        counting = ("zones", "topic", "margin_m", "max_gap_s")
        extra = {f"--{name.replace('_', '-')}": self.values[name] for name in counting}
        if len(logs) > 2 or any(value is not None for value in extra.values()):
            unused = next((name for name, value in extra.items() if value is not None), f"another log ({logs[-1]})")
            raise McaptrackError(f"`zones draw` takes one log, --camera, --output and --force, not {unused}")
        options = {name: self.values[name] for name in ("camera", "output", "force")}
        page = mcaptrack.draw_zones(logs[1], **options)
        if self.values["json"]:
            common.print_json({"log": str(logs[1]), "page": str(page)})
        elif not self.values["quiet"]:
            say(f"{page}: open it in a browser, draw, and download the file for --zones")

    def show(self, log: Location, done: RunResult, talk: common.Talk) -> None:
        """Print the totals of zones and lines."""
        if not self.values["json"]:
            print_zones(done)
        where = f"results are in {done.written_to}" if done.written_to else "everything was up to date"
        where += f": {done.written_because}" if done.written_to and done.written_because else ""
        talk.say(f"{done.log}: {where}")

    def line(self, done: RunResult) -> str:
        """Return the number of zones and lines that were counted."""
        from mcaptrack.extensions.zones.counting import zones_in_short

        return zones_in_short(done.zones)

    def data(self, done: RunResult) -> dict[str, Any]:
        """Return the totals as values of JSON."""
        return {
            "log": str(done.log),
            "stages": list(done.stages),
            "zones": {topic: [total.to_json() for total in totals] for topic, totals in done.zones.items()},
            "written_to": str(done.written_to) if done.written_to else None,
            "seconds": done.seconds,
        }


def print_zones(result: RunResult) -> None:
    """Print a table of zones and one of lines, with a row for each channel of tracks."""
    heads = {
        False: ("zone", "tracks of", "tracks", "visits", "entered", "left", "mean stay", "most inside"),
        True: ("line", "tracks of", "tracks", "forward", "backward"),
    }
    names = dict.fromkeys((total.zone, total.is_line) for totals in result.zones.values() for total in totals)
    for is_line, head in heads.items():
        rows: list[tuple[str, ...]] = []
        for name, _ in (pair for pair in names if pair[1] == is_line):
            for topic, totals in result.zones.items():
                counts = next((total for total in totals if (total.zone, total.is_line) == (name, is_line)), None)
                if counts is None:
                    continue
                stay = "" if counts.mean_dwell_s is None else f"{counts.mean_dwell_s:.1f} s"
                of_zone = (counts.visits, counts.entered, counts.left, stay, counts.most_inside)
                cells = (counts.tracks, *((counts.forward, counts.backward) if is_line else of_zone))
                rows.append((name, topic, *map(str, cells)))
        if rows:
            show_left_out(print_table(head, rows, head[2:], head[:1:-1], ruled=True))
    for topic, totals in result.zones.items():
        _print_worlds(topic, [(total.zone, total.in_worlds) for total in totals if total.in_worlds])


def _print_worlds(topic: str, zones: Sequence[tuple[str, ZoneInWorlds]]) -> None:
    """Print what worlds of re-tracking say of zones, by their names."""
    from mcaptrack.extensions.zones.visits import medians_of

    if not zones:
        return
    show(f"{topic} in {zones[0][1].worlds} worlds: {medians_of(zone for _, zone in zones)}")
    head = ("zone", "tracks", "mean stay")
    rows = [
        (name, zone.tracks.words(), zone.mean_dwell_s.words(1, " s") if zone.mean_dwell_s else "")
        for name, zone in zones
    ]
    show_left_out(print_table(head, rows, head[1:], ruled=True))
    ways = [(name, to, tracks.words()) for name, zone in zones for to, tracks in zone.then.items() if tracks.high]
    if ways:
        show_left_out(print_table(("from", "then to", "tracks"), ways, ("tracks",), ruled=True))
