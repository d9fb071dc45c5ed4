"""Ground planes <-> rows of the channel `ground_plane`."""

from __future__ import annotations

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import GROUND_PLANE, Rows


def plane_to_rows(plane: GroundPlane) -> Rows:
    """Encode a ground plane as the single row of its message."""
    names = [f"h{row}{column}" for row in range(3) for column in range(3)]
    return GROUND_PLANE.rows(
        **{name: [value] for name, value in zip(names, plane.homography, strict=True)},
        width_px=[plane.width_px],
        height_px=[plane.height_px],
        foot=[plane.point == "foot"],
        assumed=[plane.assumed],
    )


def rows_to_plane(rows: Rows) -> GroundPlane:
    """Decode a ground plane. Raises McaptrackError unless there is exactly one row."""
    if len(rows) != 1:
        raise McaptrackError(f"a ground plane message holds one row, not {len(rows)}")
    row = rows[0]
    homography = tuple(float(row[f"h{i}{j}"]) for i in range(3) for j in range(3))
    size = (int(row["width_px"]), int(row["height_px"]))
    return GroundPlane(homography, *size, "foot" if row["foot"] else "center", bool(row["assumed"]))
