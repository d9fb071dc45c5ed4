"""Files of yolo."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tests.label_cases import Row, Writer, by_frame, number, shares


def yolo(folder: Path, rows: Sequence[Row]) -> Path:
    """Shares of 640x480 of boxes in pixels; those that are shares are far too large then."""
    (folder / "labels").mkdir(exist_ok=True)
    for frame, mine in by_frame(rows).items():
        lines = []
        for row in mine:
            place = shares(row)
            kind = {"person": "0", "77": "77"}.get(row.kind, "-1")
            lines.append(f"{kind} {' '.join(map(str, place))} {number(row.score, '1')} {number(row.id, '-1')}")
        (folder / "labels" / f"{frame:06}.txt").write_text("\n".join(lines))
    if not any(row.kind == "77" for row in rows):
        (folder / "classes.txt").write_text("person\n")
    return folder / "labels"


WRITERS = {
    "yolo": Writer(yolo, names=False, shares=True),
}
