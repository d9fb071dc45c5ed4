"""Files of argoverse."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
from pyarrow import feather

from tests.label_cases import Row, Writer


def argoverse(folder: Path, rows: Sequence[Row]) -> Path:
    columns = {
        "timestamp_ns": pa.array([row.frame for row in rows], pa.int64()),
        "track_uuid": [f"t{row.id}" for row in rows],
        "category": pa.array(["PEDESTRIAN" if row.kind else None for row in rows], pa.string()),
        **{f"{name}_m": [float(row.size[at]) for row in rows] for at, name in enumerate(("length", "width", "height"))},
        "qw": [math.cos(row.heading / 2) for row in rows],
        "qz": [math.sin(row.heading / 2) for row in rows],
        "qx": [0.0 for _ in rows],
        "qy": [0.0 for _ in rows],
        "tx_m": [float(row.xy[0]) for row in rows],
        "ty_m": [float(row.xy[1]) for row in rows],
        "tz_m": [1.0 for _ in rows],
    }
    feather.write_feather(pa.table(columns), folder / "annotations.feather")
    return folder


WRITERS = {
    "argoverse": Writer(argoverse, "score id numbered", "space", first="timed"),
}
