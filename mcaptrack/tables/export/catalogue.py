"""The columns of ``recordings`` about a log as a whole, so that one table compares thousands of logs."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from mcaptrack import log
from mcaptrack.evaluation.aligned import GATE_3D_M, GATE_M
from mcaptrack.files import place_of
from mcaptrack.location import Location
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.cameras import Camera

#: The tracks that stand for a camera, below its name: the first that there are.
_BEST: Final = ("retracks", "retracks/online", "tracks")
#: The rules by which they are scored, the first that gave a score.
_RULES: Final = (("metres", GATE_M), ("iou", 0.5))
_RULES_3D: Final = (("metres", GATE_3D_M), *_RULES)
#: The scores that are taken over.
_SCORES: Final = ("MOTA", "IDF1", "HOTA", "IDSW")


def location_of(path: Location) -> str:
    """Where a log is, as the ledger of many logs names it: its path without links, or its URL."""
    return os.fsencode(str(place_of(path))).decode("utf-8", "backslashreplace")


def best_tracks(camera: Camera, topics: Iterable[str]) -> str | None:
    """The topic of the tracks that stand for a camera; None if it has none."""
    there = set(topics)
    return next((name for below in _BEST if (name := f"{camera.prefix}/{below}") in there), None)


def about_channels(opened: log.Log) -> dict[str, Any]:
    """The warnings that the channels of a log carry, and the versions that made them."""
    made = [Provenance.from_metadata(channel.metadata) for _, channel in sorted(opened.channels.items())]
    warnings = list(dict.fromkeys((code, message) for one in made if one for code, message in one.warnings))
    versions = sorted({one.version for one in made if one})
    said = [{"code": code, "message": message} for code, message in warnings]
    return {
        "warnings": len(warnings),
        "warning_texts": json.dumps(said, ensure_ascii=False) if said else None,
        "versions": ", ".join(versions) or None,
    }


def worst_score(topics: Sequence[str], scores: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The scores of the camera with the lowest IDF1, of the tracks in ``topics``; empty without ground truth."""
    found = [row for topic in topics if (row := _headline([one for one in scores if one["topic"] == topic]))]
    if not found:
        return {}
    worst = min(found, key=lambda row: row["IDF1"])
    return {"scored": worst["topic"]} | {name: worst[name] for name in ("similarity", "gate", *_SCORES)}


def _headline(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """The row of one channel of tracks by which it is compared; None if it has no score."""
    together = [row for row in rows if row.get("class") is None]
    rules = _RULES_3D if any(row.get("AMOTA") is not None for row in together) else _RULES
    by_rule = {(row["similarity"], row["gate"]): row for row in together}
    return next((by_rule[rule] for rule in rules if rule in by_rule), None)
