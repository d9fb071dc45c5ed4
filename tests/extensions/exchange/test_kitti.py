"""Files of kitti."""

from __future__ import annotations

import math

from tests.label_cases import Row, Writer, corners, number, per_frame, text


def kitti(row: Row) -> str:
    boxes = " ".join(map(number, corners(row)))
    length, width, height = row.size
    space = f"{height} {width} {length} {-row.xy[1]} 0 {row.xy[0]} {-row.heading - math.pi / 2}"
    who = {"person": "Pedestrian"}.get(row.kind, row.kind)
    return f"{row.frame} {number(row.id, '-1')} {who} 0 0 0 {boxes} {space} {number(row.score)}"


def kitti_frame(_: int, rows: list[Row]) -> str:
    lines = [kitti(row).split() for row in rows]
    return "".join(f"{kind} {own} {' '.join(more)}\n" for _, own, kind, *more in lines)


WRITERS = {
    "kitti": Writer(text(kitti), "kind", first="stated"),
    "kitti-3d": Writer(text(kitti), "kind", "space", first="stated"),
    "kitti-frames": Writer(per_frame("{}.txt", kitti_frame), "kind", first="listed"),
}
