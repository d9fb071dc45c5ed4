"""Files of datumaro."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from tests.label_cases import Row, Writer, as_json, by_frame, refused


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


@pytest.mark.parametrize("number", [-1, 1, 2**63])
def test_a_label_that_the_file_does_not_list_is_named(tmp_path, number):
    content = datumaro([Row()])
    content["items"][0]["annotations"][0]["label_id"] = number
    assert refused(tmp_path, content).endswith(f": no 'label_id {number}'")
