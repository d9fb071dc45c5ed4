"""Files of mots and youtube-vis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tests.label_cases import Row, Writer, as_json, number, text


def mots(row: Row) -> str:
    """A mask that is one pixel wide, in the column that the box begins with."""
    return f"{row.frame} {number(row.id, '-1')} 2 8 9 {chr(48 + 8 * (row.frame % 2))}84l0"


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
    "mots": Writer(text(mots), "box pixels score kind size numbered", first="listed"),
}
