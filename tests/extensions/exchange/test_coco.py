"""Files of coco."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tests.label_cases import Row, Writer, as_json


def coco(rows: Sequence[Row]) -> Any:
    kinds = {"person": 1, "77": 77, None: None}
    images = [{"id": n, "frame_id": n, "width": 640, "height": 480} for n in sorted({row.frame for row in rows})]
    entries = [
        {"image_id": row.frame, "track_id": row.id, "bbox": list(row.box), "score": row.score, "category_id": kinds[row.kind]}
        for row in rows
    ]  # fmt: skip
    return {"images": images, "annotations": entries, "categories": [{"id": 1, "name": "person"}]}


WRITERS = {
    "coco": Writer(as_json(coco), names=False, size=True, first="listed"),
}
