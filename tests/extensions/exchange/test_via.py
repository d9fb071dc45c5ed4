"""Files of via."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tests.label_cases import Row, Writer, as_json, by_frame


def via(rows: Sequence[Row]) -> Any:
    out = {}
    for frame, mine in by_frame(rows).items():
        regions = [
            {"shape_attributes": {"name": "rect", **dict(zip(("x", "y", "width", "height"), row.box, strict=True))},
             "region_attributes": {"class": row.kind, "track": row.id}} for row in mine
        ]  # fmt: skip
        out[f"{frame}.jpg9"] = {"filename": f"{frame}.jpg", "regions": regions}
    return out


WRITERS = {
    "via": Writer(as_json(via), "score", first="listed"),
}
