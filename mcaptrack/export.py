"""A log as tables: one folder a table, one file a log, ready for DuckDB, Polars and pandas.

    <folder>/<table>/recording=<name of the log>/part-0.parquet

``frames`` holds a row for every message of every channel, so that a frame in which nothing was seen is told from one at
which nobody looked; ``channels`` says how each channel was made; the others hold the rows themselves.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from mcaptrack import __version__, foreign, log, tables
from mcaptrack.provenance import Provenance
from mcaptrack.schema import DETECTIONS, EVENTS, GROUND_PLANE, PREDICTIONS, TRACKS, Frame

#: Tables of rows by name; each holds all channels of one schema.
ROW_TABLES: Final = {
    "detections": DETECTIONS,
    "tracks": TRACKS,
    "predictions": PREDICTIONS,
    "ground_planes": GROUND_PLANE,
    "events": EVENTS,
}


def default_folder(path: Path) -> Path:
    """Where the tables of a log go unless said otherwise: log.mcap -> log.tables beside it."""
    return path.with_suffix(".tables")


def recording_name(path: Path) -> str:
    """The name of a log as it can stand in a path and in a partition: no slash, no equals sign, nothing that climbs."""
    return re.sub(r"[^\w.\-]+", "_", path.stem).lstrip(".") or "log"


def export(
    opened: log.Log, folder: Path, progress: Callable[[str, int, int], None] = lambda *_: None
) -> dict[str, int]:
    """Write all tables of a log; returns the rows of each. Tables without rows are written too, with their columns."""
    partition = f"recording={recording_name(opened.path)}"
    lineage = {
        channel.topic: {"transform": made.transform, "input": made.input, "parameters": made.parameters}
        for channel in sorted(opened.channels.values(), key=lambda channel: channel.topic)
        if (made := Provenance.from_metadata(channel.metadata)) and made.transform != "view"
    }
    provenance = {
        "version": __version__,
        "recording": opened.path.name,
        "lineage": json.dumps(lineage, sort_keys=True, separators=(",", ":")),
    }
    content: dict[str, Any] = {}
    entries: dict[str, list[tuple[int, int, int]]] = {}
    for name, schema in ROW_TABLES.items():
        topics = [channel.topic for channel in log.topics_with_schema(opened, [schema.name])]
        members = {topic: opened.frames(topic, schema) for topic in topics}
        content[name] = tables.rows_table(schema, members)
        entries |= {topic: _entries(frames) for topic, frames in members.items()}
    for channel in filter(foreign.holds_pictures, opened.channels.values()):
        times = opened.times(channel.topic).tolist()
        entries[channel.topic] = [(t_ns, index, -1) for index, t_ns in enumerate(times)]
    content["frames"] = tables.frames_table(dict(sorted(entries.items())))
    content["channels"] = tables.channels_table([_describe(channel) for _, channel in sorted(opened.channels.items())])
    for count, (name, table) in enumerate(sorted(content.items()), start=1):
        tables.write(folder / name / partition / "part-0.parquet", table, provenance)
        progress("export", count, len(content))
    return {name: table.num_rows for name, table in sorted(content.items())}


def _entries(frames: list[Frame]) -> list[tuple[int, int, int]]:
    return [(frame.t_ns, frame.index, len(frame.rows)) for frame in frames]


def _describe(channel: log.Channel) -> dict[str, object]:
    made = Provenance.from_metadata(channel.metadata)
    out: dict[str, object] = {"topic": channel.topic, "schema": channel.schema_name, "messages": channel.messages}
    if made:
        out |= {
            name: getattr(made, name) or None for name in ("transform", "input", "version", "digest", "input_digest")
        }
        out["parameters"] = json.dumps(made.parameters, sort_keys=True, separators=(",", ":"))
    return out
