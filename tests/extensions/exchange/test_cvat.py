"""Files of cvat."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tests.label_cases import Row, Writer, by_frame, corners


def cvat(folder: Path, rows: Sequence[Row]) -> Path:
    """Tracks, whose attribute is the id; a row without one is a track of its own."""
    frames = by_frame(rows)
    parts = ["<annotations><meta><task><size>99</size></task></meta>"]
    for frame, mine in frames.items():
        for row in mine:
            left, top, right, bottom = corners(row)
            own = "" if row.id is None else f'<attribute name="track_id">{row.id}</attribute>'
            parts.append(
                f'<image id="{frame}" width="640" height="480"><box label="{row.kind or ""}" xtl="{left}" ytl="{top}" xbr="{right}" '
                f'ybr="{bottom}">{own}</box></image>'
                if frame not in frames or len(mine) == 1
                else f'<box label="{row.kind or ""}" xtl="{left}" ytl="{top}" xbr="{right}" ybr="{bottom}">{own}</box>'
            )
        if len(mine) > 1:
            parts[-len(mine)] = f'<image id="{frame}" width="640" height="480">' + parts[-len(mine)]
            parts[-1] += "</image>"
    path = folder / "a.xml"
    path.write_text("".join(parts) + "</annotations>")
    return path


WRITERS = {
    "cvat": Writer(cvat, "score numbered", size=True, first="stated"),
}
