"""How a log was made: what it is, and where each of its channels comes from."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.viewing.report.contents import LogReport
from mcaptrack.viewing.report.markup import NONE, Markup, counted, join, lack, name, number, table, tag


def provenance(report: LogReport) -> Markup:
    """What the log is and how everything in it was made."""
    data = report.data
    span = "no messages"
    if data["start_ns"] is not None:
        span = f"{data['start_ns'] / NS_PER_S:.3f} to {data['end_ns'] / NS_PER_S:.3f} s"
    ground = {"given": "measured", "assumed": "guessed from the size of people", None: "none"}[data["ground_plane"]]
    about = [
        ("file", name(data["log"])),
        ("results beside it", name(data["results_file"]) if data["results_file"] else None),
        ("size", number(data["bytes"] / 1e6, 2, "MB") + ", " + counted(data["messages"], "message")),
        ("log time", f"{span} ({number(data['duration_s'], 1, 's')})"),
        ("ground plane", ground),
        ("digest", tag("code", data["digest"])),
    ]
    listed = tag("dl", *(join([tag("dt", k), tag("dd", v)]) for k, v in about if v is not None), class_="about")
    shown = [c for c in data["channels"] if c["transform"] != "view"]
    if not shown:
        return join([listed, lack("The log has no channels.")])
    rows = [_made(channel) for channel in _by_lineage(shown)]
    columns = ("channel", "made by", "digest", "messages")
    caption = "How each channel was made; views are left out. Whole digests and all parameters are in the page's data."
    return join([listed, table(caption, columns, rows, words=3)])


def _by_lineage(channels: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Channels after what they were made from, with how deep they stand."""
    topics = {channel["topic"] for channel in channels}
    made_from: dict[str | None, list[dict[str, Any]]] = {}
    for channel in channels:
        made_from.setdefault(channel["input"], []).append(channel)
    out: dict[str, dict[str, Any]] = {}
    roots = [channel for channel in channels if channel["input"] not in topics]
    for root in (*roots, *channels):  # after the roots those that say they were made from each other
        waiting = [(root, 0)]
        while waiting:
            channel, depth = waiting.pop()
            if channel["topic"] not in out:
                out[channel["topic"]] = channel | {"depth": depth}
                waiting += [(other, depth + 1) for other in reversed(made_from.get(channel["topic"], []))]
    return list(out.values())


def _made(channel: dict[str, Any]) -> tuple[object, ...]:
    how: list[object] = [channel["schema"] or "no schema"]
    if channel["transform"]:
        how = [tag("b", channel["transform"]), f", mcaptrack {channel['version'] or '?'}"]
        if channel["input"]:
            how += [", from ", name(channel["input"])]
        for place, topic in enumerate(sorted(channel["references"])):
            how += [", " if place else ", compared with ", name(topic)]
    if channel["stale"]:
        how.append(tag("span", " out of date", class_="stale"))
    said = {key: value for key, value in (channel["parameters"] or {}).items() if key != "ground_planes"}
    if said:
        words = ", ".join(f"{key} {_parameter(value)}" for key, value in sorted(said.items()))
        how.append(tag("details", tag("summary", counted(len(said), "parameter")), words, class_="made"))
    deep = Markup("&emsp;" * min(channel["depth"], 6))
    digest = channel["digest"]
    short = tag("code", digest[:12], title=digest) if digest else NONE
    return join([deep, name(channel["topic"])]), join(how), short, number(channel["messages"])


def _parameter(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
