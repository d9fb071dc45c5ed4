"""Files of youtube-vis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tests.label_cases import Row, Writer, as_json


def youtube_vis(rows: Sequence[Row]) -> Any:
    """A track for each row."""
    names = [f"{frame}.jpg" for frame in range(max((row.frame for row in rows), default=0) + 1)]
    tracks = [
        {"id": row.id, "video_id": 1, "category_id": row.kind or "", "score": row.score,
         "bboxes": [row.box if name == f"{row.frame}.jpg" else None for name in names]} for row in rows
    ]  # fmt: skip
    return {"videos": [{"id": 1, "width": 640, "height": 480, "file_names": names}], "annotations": tracks}


WRITERS = {
    "youtube-vis": Writer(as_json(youtube_vis), size=True, first="stated"),
}
