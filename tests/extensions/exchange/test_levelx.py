"""Files of levelx."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from tests.label_cases import Row, Writer, number


def levelx(folder: Path, rows: Sequence[Row]) -> Path:
    lines = ["trackId,frame,xCenter,yCenter,heading,width,length,xVelocity,yVelocity"]
    for row in rows:
        length, width, _ = row.size
        place = f"{row.xy[0]},{row.xy[1]},{math.degrees(row.heading)},{width},{length}"
        lines.append(f"{number(row.id, '-1')},{row.frame},{place},1,0")
    kinds = {f"{row.id},{'pedestrian' if row.kind == 'person' else row.kind}" for row in rows}
    (folder / "00_tracksMeta.csv").write_text("\n".join(["trackId,class", *kinds]))
    (folder / "00_tracks.csv").write_text("\n".join(lines))
    return folder / "00_tracks.csv"


WRITERS = {
    "levelx": Writer(levelx, "score kind numbered", "space", first="stated"),
}
