"""Trajnet++: a JSON object in each line, ``{"track": {"f", "p", "x", "y"}}`` with positions in metres, and
``{"scene": {"id", "p", "s", "e", "fps"}}`` with the rate of labels.
"""

from __future__ import annotations

import json
from fractions import Fraction
from typing import Any

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.exchange.gathered import GatheredRows, is_number
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.table import Asked, BoxTable, LabelFacts


class TrajnetPP(Format):
    """Lines of scenes and of positions; of these, a scene, or all."""

    title = "Trajnet++"
    row = '`{"track": {"f": 10, "p": 7, "x": 1.5, "y": 2.5}}` and `{"scene": {"id", "p", "s", "e", "fps"}}`'
    takes = ("scene",)

    def recognises(self, file: LabelFile) -> bool:
        """Whether the first line is an object with a scene or a track alone."""
        line = file.head.partition(b"\n")[0]
        try:
            first = json.loads(line) if line[:1] == b"{" else None
        except (ValueError, RecursionError):
            return False
        return isinstance(first, dict) and len(first) == 1 and isinstance(first.get("scene", first.get("track")), dict)

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The rows of a file; those of other predictions than the first are left out."""
        facts = LabelFacts(file.path, first_frame=0)
        rows, scenes, others = GatheredRows(facts, "line"), dict[str, dict[str, Any]](), 0
        tracks = list[tuple[int, dict[str, Any]]]()
        for number, line in file.lines():
            try:
                entry = json.loads(line)
                scene, track = entry.get("scene"), entry.get("track")
            except (ValueError, RecursionError, AttributeError):
                raise McaptrackError(f"{file.path}:{number}: not a line of Trajnet++: {line.strip()[:60]}") from None
            if isinstance(scene, dict):
                scenes[str(scene.get("id"))] = scene
            if isinstance(track, dict):
                tracks.append((number, track))
        chosen = _chosen(file, scenes, asked.scene)
        for number, content in tracks:
            frame, x, y = rows.numbers(str(number), content, ("f", "x", "y"))
            if content.get("prediction_number") or not _is_of(chosen, content, frame):
                others += 1
                continue
            rows.add(str(number), frame, (x, y), content.get("p"), "person")
        rates = {
            scene["fps"] for scene in scenes.values() if is_number(scene.get("fps")) and 0.001 < scene["fps"] <= 10_000
        }
        table = rows.table()
        if len(rates) == 1:
            facts.interval_s = 1 / Fraction(str(rates.pop())).limit_denominator(1001)
            facts.clock_of = f"the fps of its scenes, a label every {float(facts.interval_s):g} s"
        if others:
            table.left_out = f"{others} positions of other scenes or predictions"
        return table


def _chosen(file: LabelFile, scenes: dict[str, dict[str, Any]], wanted: str | None) -> dict[str, Any] | None:
    if wanted is None:
        return None
    if wanted not in scenes:
        listed = ", ".join(list(scenes)[:10])
        raise McaptrackError(f"{file.path} has no scene {wanted!r:.40}; its {len(scenes)} scenes are {listed}, ...")
    return scenes[wanted]


def _is_of(scene: dict[str, Any] | None, track: dict[str, Any], frame: float) -> bool:
    """Whether a position is of a scene."""
    if scene is None:
        return True
    ends: list[Any] = [scene.get("s"), scene.get("e")]
    is_inside = not all(map(is_number, ends)) or ends[0] <= frame <= ends[1]
    return is_inside and track.get("scene_id", scene.get("id")) == scene.get("id")
