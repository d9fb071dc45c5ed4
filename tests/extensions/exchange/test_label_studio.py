"""Files of label-studio."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tests.label_cases import Row, Writer, as_json, read


def label_studio(rows: Sequence[Row]) -> Any:
    results = []
    for order, row in enumerate(rows):
        left, top, width, height = (
            100 * part / whole for part, whole in zip(row.box, (640, 480, 640, 480), strict=True)
        )
        if row.box[2] <= 2:
            left, top, width, height = (100 * part for part in row.box)
        place = {"frame": row.frame, "enabled": False, "x": left, "y": top, "width": width, "height": height}
        value = {"framesCount": 99, "duration": 9.9, "sequence": [place], "labels": [row.kind] if row.kind else []}
        results.append({"type": "videorectangle", "id": f"t{row.id}" if row.id is not None else "", "value": value})
        results[-1]["order"] = order
    return [{"id": 3, "annotations": [{"result": results}]}]


WRITERS = {
    "label-studio": Writer(as_json(label_studio), "score numbered", first="stated", shares=True),
}


def test_frames_and_their_duration_give_the_rate(tmp_path):
    assert read(tmp_path, label_studio([Row(3, 1, (64, 48, 64, 48))])).facts.fps == 10
