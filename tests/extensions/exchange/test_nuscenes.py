"""Files of nuscenes."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

from tests.label_cases import Row, Writer


def nuscenes(folder: Path, rows: Sequence[Row]) -> Path:
    tables = {
        "scene": [{"token": "one", "name": "scene-1"}],
        "sample": [{"token": f"s{n}", "timestamp": 100 + n, "scene_token": "one"} for n in range(9)],
        "instance": [{"token": f"i{row.id}", "category_token": row.kind} for row in rows],
        "category": [{"token": kind, "name": "human.pedestrian.adult"} for kind in ("person", None) if kind],
        "sample_annotation": [
            {"token": f"a{n}", "sample_token": f"s{row.frame}", "instance_token": f"i{row.id}",
             "translation": [*row.xy, 1.0], "size": [row.size[1], row.size[0], row.size[2]],
             "rotation": [math.cos(row.heading / 2), 0, 0, math.sin(row.heading / 2)]}
            for n, row in enumerate(rows)
        ],
    }  # fmt: skip
    for name, content in tables.items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    return folder


WRITERS = {
    "nuscenes": Writer(nuscenes, "score kind id numbered", "space", first="timed"),
}
