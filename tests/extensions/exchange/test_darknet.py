"""Files of darknet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tests.label_cases import Row, Writer, as_json, by_frame, shares


def darknet(rows: Sequence[Row]) -> Any:
    """Shares of 640x480 of boxes in pixels; those that are shares are far too large then."""
    out = []
    for frame, mine in by_frame(rows).items():
        objects = []
        for row in mine:
            place = dict(zip(("center_x", "center_y", "width", "height"), shares(row), strict=True))
            objects.append(
                {"name": row.kind or "", "class_id": "", "confidence": row.score, "relative_coordinates": place}
            )
        out.append({"frame_id": frame, "objects": objects})
    return out


WRITERS = {
    "darknet": Writer(as_json(darknet), "id numbered", tracks=False, first="listed", shares=True),
}
