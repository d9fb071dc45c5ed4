"""``mcaptrack info`` and ``mcaptrack export``: show the channels of a log, and write them as tables."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from mcaptrack.cli import common
from mcaptrack.cli.many import LogWork, many_options, process, takes_many
from mcaptrack.cli.text import console, printable
from mcaptrack.location import Location

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.tree import Tree

    from mcaptrack import ExportResult, LogInfo


@common.one_line
@takes_many(outputs=False)
def info(
    logs: common.Logs,
    frames: Annotated[
        bool,
        common.option(
            "--frames", help="Also read the transforms between frames of reference, and draw the tree of frames."
        ),
    ] = False,
    output: common.Printed = None,
    force: common.Force = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Show the channels of a log, their number of messages, and what was made from what.

    Those of each camera are together, if there are several, under its name.

    Reads the summary only, unless --frames is given. With -v also the parameters that channels were made with.

    Example: mcaptrack info log.mcap

    Example: mcaptrack info robot.mcap --frames
    """
    import mcaptrack
    from mcaptrack.fleet import find_logs

    def show(_: Location, log_info: LogInfo) -> None:
        if not json:
            _print(log_info.to_json(), verbose)

    work: LogWork[LogInfo] = LogWork(
        "info", mcaptrack.info, {"frames": frames}, show, lambda log_info: log_info.to_json(), writes=False
    )
    with common.Talk(quiet, verbose).open() as talk, common.printed_to(output, force):
        infos, totals = process(find_logs(logs), work, talk)
        if json:
            common.print_json({"results": [log_info.to_json() for log_info in infos], **totals})


def _print(data: dict[str, Any], verbose: bool) -> None:
    from rich.table import Table
    from rich.text import Text

    out = console()
    seconds = (data["end_ns"] - data["start_ns"]) / 1e9
    name = Text(printable(data["log"]), "bold")
    out.print(name, f" {data['bytes']:,} bytes, {data['messages']:,} messages, {seconds:.3f} s")
    out.print(f"starts at {_when(data['start_ns'])}" if data["messages"] else "no messages")
    if data["results"]:
        out.print(f"with results in {data['results']}")
    table = Table(box=None, pad_edge=False)
    for column in ("topic", "schema", "messages", "per second"):
        is_number = column in ("messages", "per second")
        table.add_column(column, justify="right" if is_number else "left", overflow="fold")
    for camera, channel in _by_camera(data["channels"]):
        if camera is not None:
            table.add_row(Text(camera, "bold"))
        topic = channel["topic"] + ("  (replaced by the results)" if channel["replaced"] else "")
        rate = "" if channel["rate_hz"] is None else f"{channel['rate_hz']:.1f}"
        table.add_row(topic, channel["schema"], f"{channel['messages']:,}", rate)
    out.print(table)
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

    if t_ns < _FIRST_DATE_NS:
        return f"{t_ns / 1e9:.3f} s"
    return f"{datetime.fromtimestamp(t_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S}.{t_ns % 10**9 // 10**6:03d} UTC"


#: Earlier times are not dates but seconds since something began: the year 1980.
_FIRST_DATE_NS: Final = 315_532_800 * 10**9
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
        label = Text(printable(channel["topic"]))
        label.append(f"  {printable(channel['transform'])}" if channel["transform"] else "", "dim")
        for plugin in (channel["plugins"] or {}).values():
            package = f"{plugin['distribution']} {plugin['version']}".strip()
            text = f"  {plugin['name']}" + (f" ({package})" if package else "")
            label.append(printable(text), "dim")
        corrections = [topic for topic in channel.get("references") or () if topic.endswith("/corrected")]
        label.append(f"  with {printable(corrections[0])}" if corrections else "", "dim")
        label.append(f"  in {printable(channel['frame'])}" if channel["frame"] else "", "dim")
        label.append("  out of date" if channel["stale"] else "", "red")
        node = parent.add(label)
        if verbose and channel["parameters"]:
            text = ", ".join(f"{key}={value}" for key, value in sorted(channel["parameters"].items()))
            node.add(Text(printable(text), "dim"))
        below = node if depth < _DEEPEST else parent
        waiting += [(below, other, depth + 1) for other in reversed(made_from.get(channel["topic"], []))]
    return root


def _frames(frames: list[dict[str, Any]], start_ns: int) -> Tree:
    """Return frames as a tree, with the rate of each, and its times in seconds from the start of the log."""
    from rich.text import Text
    from rich.tree import Tree

    def seconds(t_ns: int) -> str:
        return f"{(t_ns - start_ns) / 1e9:.3f}"

    root = Tree("frames")
    nodes: dict[str | None, tuple[Tree, int]] = {None: (root, 0)}
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
        above, depth = nodes[frame["parent"]]
        node = above.add(label)
        nodes[frame["frame"]] = (node, depth + 1) if depth < _DEEPEST else (above, depth)
    return root


@common.one_line
@takes_many()
def export(
    logs: common.Logs,
    output: Annotated[
        Path | None,
        common.option(
            "--output",
            "-o",
            panel=common.FILES,
            help="Folder for the tables or the bag, or the file.",
            show_default="LOG.tables, LOG.rosbag2, LOG.cvat.xml, ... beside the log",
        ),
    ] = None,
    form: Annotated[
        Literal[
            "parquet",
            "arrow",
            "csv",
            "jsonl",
            "rosbag2",
            "rosbag2-sqlite3",
            "mot",
            "kitti",
            "coco",
            "cvat",
            "boxes-csv",
            "rerun",
        ],
        common.option(
            "--format",
            panel=common.FILES,
            help="Tables (parquet, arrow, csv, jsonl), a ROS 2 bag, or a file with the boxes of one channel: "
            "MOTChallenge, KITTI tracking, COCO with tracks, CVAT for video, a table, or a recording of Rerun.",
        ),
    ] = "parquet",
    topic: Annotated[
        list[str] | None,
        common.option(
            "--topic",
            panel=common.FILES,
            help="Also write a table of all messages of this channel; the channel with the boxes for a file.",
            show_default=False,
        ),
    ] = None,
    blobs: Annotated[
        bool,
        common.option(
            "--blobs",
            panel=common.FILES,
            help="With --topic: include binary fields, such as pictures and point clouds.",
        ),
    ] = False,
    force: Annotated[
        bool,
        common.option(
            "--force",
            panel=common.FILES,
            help="Write all tables again, also over those of another log of this name; replace a bag or a file.",
        ),
    ] = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Write a log as tables (Parquet), one row per object and frame, as a ROS 2 bag, or for other programs.

    One folder a table (frames, detections, tracks, track_summary, predictions, events, metrics, channels, recordings
    and others), one file a log in it; several logs can share a folder. Exporting again replaces what has changed.
    `mcaptrack docs tables` lists all columns. A bag (rosbag2) holds results as ROS messages, for RViz and `ros2 bag`.
    A file (mot, kitti, coco, cvat, boxes-csv) has the boxes of one channel; `mcaptrack ingest` reads it again.

    Example: mcaptrack export log.mcap -o tables/

    Example: mcaptrack export log.mcap --format cvat -o boxes.xml

    Example: mcaptrack export robot.mcap --topic /imu --format csv
    """
    import mcaptrack
    from mcaptrack.api.exporting import refuse_same_tables
    from mcaptrack.fleet import find_logs
    from mcaptrack.tables import FORMATS as TABLES
    from mcaptrack.tables.catalogue import refresh
    from mcaptrack.tables.exchange import ends_with

    logs_found, is_table = find_logs(logs), form in TABLES
    folder = output or many_options().output_dir
    if is_table:
        refuse_same_tables([log.path for log in logs_found], folder)

    def rows(done: ExportResult) -> str:
        return ", ".join(f"{name} {count}" for name, count in done.rows.items())

    def show(_: Location, done: ExportResult) -> None:
        talk.say(f"{done.folder}: {rows(done)}")
        talk.detail(f"{done.folder}: written {', '.join(done.written) or 'nothing, all tables are up to date'}")

    def data(done: ExportResult) -> dict[str, object]:
        return {"log": str(done.log), "folder": str(done.folder), "rows": done.rows, "written": list(done.written)}

    options: dict[str, Any] = {"form": form, "topic": topic, "blobs": blobs, "force": force}
    with common.Talk(quiet, verbose).open() as talk:
        work = LogWork(
            "export",
            mcaptrack.export,
            options,
            show,
            data,
            rows,
            ".rosbag2" if form.startswith("rosbag2") else ends_with(form),
            shares_output=is_table,
        )
        results, totals = process(logs_found, work, talk, output)
        if folder is not None and form == "parquet" and len(logs_found) > 1:
            refresh(folder)
    if json:
        common.print_json({"results": [data(result) for result in results], **totals})
