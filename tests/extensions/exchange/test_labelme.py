"""Files of labelme."""

from __future__ import annotations

import json

from tests.label_cases import Row, Writer, corners, per_frame


def labelme(frame: int, rows: list[Row]) -> str:
    shapes = [
        {
            "label": row.kind,
            "points": [corners(row)[:2], corners(row)[2:]],
            "shape_type": "rectangle",
            "score": row.score,
        }
        for row in rows
    ]
    return json.dumps({"shapes": shapes, "imagePath": f"{frame}.jpg", "imageWidth": 640, "imageHeight": 480})


WRITERS = {
    "labelme": Writer(per_frame("{}.json", labelme), "box id numbered", size=True, tracks=False, first="listed"),
}
