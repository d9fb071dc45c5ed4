"""Files of datumaro."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tests.label_cases import Row, Writer, as_json, by_frame


def datumaro(rows: Sequence[Row]) -> Any:
    kinds = sorted({row.kind for row in rows if row.kind})
    items = [
        {"id": f"{frame}", "image": {"size": [480, 640]}, "annotations": [
            {"type": "bbox", "bbox": row.box, "label_id": kinds.index(row.kind) if row.kind else None,
             "attributes": {"track_id": row.id, "score": row.score}} for row in mine]}
        for frame, mine in by_frame(rows).items()
    ]  # fmt: skip
    return {"items": items, "categories": {"label": {"labels": [{"name": kind} for kind in kinds]}}}


WRITERS = {
    "datumaro": Writer(as_json(datumaro), size=True, first="listed"),
}
