"""``mcaptrack info``, ``export`` and ``view``: what they print about the channels of a log, its tables and its page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from mcaptrack.api.declared import Option
from mcaptrack.cli import common
from mcaptrack.cli.declared import Once
from mcaptrack.cli.many import EachLog
from mcaptrack.cli.text import console, counted, print_table, printable, show, show_left_out
from mcaptrack.geometry.clocks import FIRST_DATE_NS
from mcaptrack.location import Location

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.text import Text
    from rich.tree import Tree

    from mcaptrack import ExportResult, LogInfo, LogServer
    from mcaptrack.fleet import NamedLog


class Info(EachLog["LogInfo"]):
    """Show the channels of logs."""

    writes = False
    prints_results = True

    def show(self, log: Location, done: LogInfo, talk: common.Talk) -> None:
        """Print the channels."""
        if not self.values["json"]:
            _print(done.to_json(), self.values["verbose"])

    def data(self, done: LogInfo) -> dict[str, Any]:
        """Return the channels as values of JSON."""
        return done.to_json()


class Export(EachLog["ExportResult"]):
    """Write logs as tables, as ROS 2 bags, or for other programs."""

    @property
    def shares_output(self) -> bool:  # type: ignore[override]
        """Whether all logs have one output: a folder of tables."""
        from mcaptrack.tables import FORMATS

        return self.values["form"] in FORMATS

    def logs(self) -> Sequence[NamedLog]:
        """Return the logs. Raises McaptrackError if two would have the same tables."""
        from mcaptrack.api.exporting import refuse_same_tables

        logs = super().logs()
        if self.shares_output:
            refuse_same_tables([log.path for log in logs], self.values["output"])
        return logs

    @property
    def makes_folders(self) -> bool:  # type: ignore[override]
        """Whether a log becomes a folder, as the exporter says."""
        from mcaptrack.api.exporting import file_exporter

        by = file_exporter(self.values["form"])
        return by is not None and by.is_folder

    def suffix(self) -> str:
        """Return the end of the names of files and folders."""
        from mcaptrack.api.exporting import file_exporter

        by = file_exporter(self.values["form"])
        return by.end if by is not None else ""

    def show(self, log: Location, done: ExportResult, talk: common.Talk) -> None:
        """Print what was written."""
        talk.say(f"{done.folder}: {self.line(done)}")
        talk.detail(f"{done.folder}: written {', '.join(done.written) or 'nothing, all tables are up to date'}")

    def line(self, done: ExportResult) -> str:
        """Return the number of rows of each table that has a file."""
        rows = ", ".join(f"{name} {count}" for name, count in done.rows.items() if name not in done.left_out)
        without = len(done.left_out)
        return f"{rows}; {counted(without, 'table')} without rows left out" if without else rows

    def data(self, done: ExportResult) -> dict[str, Any]:
        """Return the result as values of JSON."""
        written = {"log": str(done.log), "folder": str(done.folder), "rows": done.rows}
        return written | {"written": list(done.written), "left_out": list(done.left_out)}

    def print_result(self, results: Sequence[ExportResult], totals: Mapping[str, Any]) -> None:
        """Print the results; bring the catalogue of several logs in one folder up to date."""
        from mcaptrack.tables.catalogue import refresh

        folder: Path | None = self.values["output"]
        if folder is not None and self.values["form"] == "parquet" and len(self.values["logs"]) > 1:
            refresh(folder)
        super().print_result(results, totals)


#: Columns of the table of channels that a narrow terminal has no room for, the first to go first.
_SPARE: Final = ("per second", "schema", "messages")


def _print(data: dict[str, Any], verbose: bool) -> None:
    from rich.text import Text

    out = console()
    seconds = (data["end_ns"] - data["start_ns"]) / 1e9
    name = Text(printable(data["log"]), "bold")
    out.print(name, f" {data['bytes']:,} bytes, {data['messages']:,} messages, {seconds:.3f} s")
    out.print(f"starts at {_when(data['start_ns'])}" if data["messages"] else "no messages")
    if data["results"]:
        out.print(f"with results in {data['results']}")
    rows: list[Sequence[str | Text]] = []
    for camera, channel in _by_camera(data["channels"]):
        if camera is not None:
            rows.append([Text(camera, "bold")])
        topic = channel["topic"] + ("  (replaced by the results)" if channel["replaced"] else "")
        rate = "" if channel["rate_hz"] is None else f"{channel['rate_hz']:.1f}"
        rows.append([topic, channel["schema"], f"{channel['messages']:,}", rate])
    names = ("topic", "schema", "messages", "per second")
    show_left_out(print_table(names, rows, ("messages", "per second"), _SPARE))
    shown = {channel["topic"]: channel for channel in reversed(data["channels"]) if not channel["replaced"]}
    out.print(_lineage([*reversed(shown.values())], verbose))
    if data["frames"] is not None:
        out.print(_frames(data["frames"], data["start_ns"]) if data["frames"] else "no transforms")


def _by_camera(channels: list[dict[str, Any]]) -> Iterator[tuple[str | None, dict[str, Any]]]:
    """Yield the channels of each camera after one another, if there are several, each first one with a heading."""
    names = sorted({channel["camera"] for channel in channels if channel.get("camera")})
    if len(names) < 2:
        yield from ((None, channel) for channel in channels)
        return
    for name in (*names, None):
        heading: str | None = f"/{printable(name)}" if name else "other channels"
        for channel in channels:
            if (channel.get("camera") or None) == name:
                yield heading, channel
                heading = None


def _when(t_ns: int) -> str:
    """A time of a log: date and time if it is one, otherwise seconds."""
    from datetime import UTC, datetime

    if t_ns < FIRST_DATE_NS:
        return f"{t_ns / 1e9:.3f} s"
    return f"{datetime.fromtimestamp(t_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S}.{t_ns % 10**9 // 10**6:03d} UTC"


#: Deepest level of drawn trees. Channels and frames below it are drawn at this level, beside their input or parent.
_DEEPEST: Final = 30
#: The most gaps, or jumps, of a frame that are shown one by one.
_SHOWN: Final = 3


def _lineage(channels: list[dict[str, Any]], verbose: bool) -> Tree:
    """Return the lineage of channels as a tree; its roots are channels that were recorded or ingested."""
    from rich.text import Text
    from rich.tree import Tree

    topics = {channel["topic"] for channel in channels}
    made_from: dict[str | None, list[dict[str, Any]]] = {}
    for channel in channels:
        if channel["transform"] != "view":
            made_from.setdefault(channel["input"] if channel["input"] in topics else None, []).append(channel)
    root = Tree("lineage")
    waiting = [(root, channel, 1) for channel in reversed(made_from.get(None, []))]
    while waiting:
        parent, channel, depth = waiting.pop()
        node = parent.add(_label(channel))
        if verbose and channel["parameters"]:
            text = ", ".join(f"{key}={value}" for key, value in sorted(channel["parameters"].items()))
            node.add(Text(printable(text), "dim"))
        below = node if depth < _DEEPEST else parent
        waiting += [(below, other, depth + 1) for other in reversed(made_from.get(channel["topic"], []))]
    return root


def _label(channel: dict[str, Any]) -> Text:
    """Return a channel in a line: what made it, with what, in which frame of reference."""
    from rich.text import Text

    by = channel.get("written_by")
    facts = [f"written by {by}" if by else channel["transform"] or ""]
    for plugin in (channel["plugins"] or {}).values():
        package = f"{plugin['distribution']} {plugin['version']}".strip()
        facts.append(f"{plugin['name']} ({package})" if package else plugin["name"])
    facts += [f"with {topic}" for topic in channel.get("references") or () if topic.endswith("/corrected")][:1]
    facts += [f"in {channel['frame']}"] if channel["frame"] else []
    label = Text(printable(channel["topic"]))
    label.append("".join(f"  {printable(fact)}" for fact in facts if fact), "dim")
    label.append("  out of date" if channel["stale"] else "", "red")
    return label


def _frames(frames: list[dict[str, Any]], start_ns: int) -> Tree:
    """Return frames as a tree, with the rate of each, and its times in seconds from the start of the log."""
    from rich.text import Text
    from rich.tree import Tree

    def seconds(t_ns: int) -> str:
        return f"{(t_ns - start_ns) / 1e9:.3f}"

    root = Tree("frames")
    names = dict.fromkeys(frame["namespace"] for frame in frames)
    nodes: dict[Any, tuple[Tree, int]] = {(name, None): (root.add(name) if name else root, 0) for name in names}
    for frame in frames:
        label = Text(printable(frame["frame"]))
        if frame["static"]:
            label.append("  static", "dim")
        elif frame["parent"] is not None:
            span = f"{seconds(frame['start_ns'])} to {seconds(frame['end_ns'])} s"
            label.append(f"  {frame['rate_hz']:.3g} Hz, {span}", "dim")
        gaps = [f"{seconds(gap['start_ns'])} to {seconds(gap['end_ns'])} s" for gap in frame["gaps"]]
        jumps = [
            f"{seconds(jump['t_ns'])} s ({jump['distance_m']:.2g} m, {jump['angle_deg']:.0f} degrees)"
            for jump in frame["jumps"]
        ]
        for word, faults in (("gap", gaps), ("jump", jumps)):
            if faults:
                more = f" and {len(faults) - _SHOWN} more" if len(faults) > _SHOWN else ""
                label.append(f"  {word}{'s' * (len(faults) > 1)}: {', '.join(faults[:_SHOWN])}{more}", "red")
        above, depth = nodes[frame["namespace"], frame["parent"]]
        node = above.add(label)
        nodes[frame["namespace"], frame["frame"]] = (node, depth + 1) if depth < _DEEPEST else (above, depth)
    return root


class ViewCommand(Once["LogServer"]):
    """Serve a log to the browser."""

    class More:
        """Options that the function has no use for."""

        links: Annotated[
            bool, Option("What is opened", help="Print links that open the log, and each event, in other viewers.")
        ] = False

    def print_result(self, done: LogServer, talk: common.Talk) -> None:
        """Print the address, and serve the log until Ctrl-C."""
        try:
            super().print_result(done, talk)
            done.serve_forever()
        except KeyboardInterrupt:
            talk.detail("done")
        finally:
            done.close()

    def data(self, done: LogServer) -> dict[str, Any]:
        """Return the addresses as values of JSON."""
        return {
            "address": done.address,
            "log": done.logs[0],
            "logs": list(done.logs),
            "layout": next(iter(done.layouts.values()), None),
            "layouts": done.layouts,
            "links": done.links,
            "lichtblick": done.lichtblick,
            "at_s": done.at_s,
            "events": [event._asdict() for event in done.events],
            "notes": list(done.notes),
        }

    def show(self, done: LogServer, talk: common.Talk) -> None:
        """Print the address of the page, and with ``--links`` those that other viewers open."""
        show(f"Open {done.address}")
        for note in done.notes:
            (talk.say if self.values["links"] else talk.detail)(note)
        if not self.values["links"]:
            return
        lines = [(f"Lichtblick, {name}", link) for name, link in done.lichtblick.items()]
        lines = [*(lines or [("Lichtblick", done.links["Lichtblick"])]), ("Foxglove", done.links["Foxglove"])]
        lines += [("log", "  ".join(done.logs))]
        lines += [(f"layout, {name}", address) for name, address in done.layouts.items()]
        width = max(len(name) for name, _ in lines) + 2
        show("", *(f"{name:<{width}}{what}" for name, what in lines))
        for event in done.events:
            show("", f"event {event.event}, {event.topic}: {event.text}", f"  {event.link}")
