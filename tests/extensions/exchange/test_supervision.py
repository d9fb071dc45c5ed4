"""Files of supervision."""

from __future__ import annotations

from tests.label_cases import Writer, corners, number, text

SUPERVISION = "x_min,y_min,x_max,y_max,class_id,confidence,tracker_id,frame_index"
WRITERS = {
    "supervision": Writer(
        text(
            lambda row: ",".join(
                [
                    *map(number, corners(row)),
                    {"person": "0"}.get(row.kind, row.kind or ""),
                    number(row.score),
                    number(row.id, "-1"),
                    f"{row.frame}",
                ]
            ),
            SUPERVISION,
            "a.csv",
        ),
        names=False,
        first="stated",
    ),
}
