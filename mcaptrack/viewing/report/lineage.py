"""The file itself, and the provenance of its channels."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, Final

from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.viewing.report.contents import LogReport

_GROUND: Final = {
    "given": "measured",
    "estimated": "estimated from boxes of people",
    "assumed": "guessed from the size of people",
    None: "none",
}
_MAX_DEPTH: Final = 6


def provenance(report: LogReport) -> dict[str, Any]:
    """The values of the section: the file, and its channels in the order in which they were made, without views."""
    data = report.data
    span = "no messages"
    if data["start_ns"] is not None:
        span = f"{data['start_ns'] / NS_PER_S:.3f} to {data['end_ns'] / NS_PER_S:.3f} s"
    channels = _by_lineage([channel for channel in data["channels"] if channel["transform"] != "view"])
    return {
        "log": data,
        "span": span,
        "ground_plane": _GROUND[data["ground_plane"]],
        "channels": [channel | {"parameters": _parameters(channel)} for channel in channels],
    }


def _by_lineage(channels: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Channels, each after the one that it was made from, with their depth."""
    topics = {channel["topic"] for channel in channels}
    made_from: dict[str | None, list[dict[str, Any]]] = {}
    for channel in channels:
        made_from.setdefault(channel["input"], []).append(channel)
    out: dict[str, dict[str, Any]] = {}
    roots = [channel for channel in channels if channel["input"] not in topics]
    for root in (*roots, *channels):  # channels in a cycle have no root
        waiting = [(root, 0)]
        while waiting:
            channel, depth = waiting.pop()
            if channel["topic"] not in out:
                out[channel["topic"]] = channel | {"depth": min(depth, _MAX_DEPTH)}
                waiting += [(other, depth + 1) for other in reversed(made_from.get(channel["topic"], []))]
    return list(out.values())


def _parameters(channel: dict[str, Any]) -> list[str]:
    """The parameters of a channel as text."""
    values = channel["parameters"] or {}
    return [
        f"{key} {value if isinstance(value, str) else json.dumps(value)}"
        for key, value in sorted(values.items())
        if key != "ground_planes"
    ]
