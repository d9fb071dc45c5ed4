"""Ground planes <-> rows of the channel `ground_plane`."""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.pinhole import Lens
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import GROUND_PLANE, Rows

#: The columns of distortion, in the order of OpenCV; a lens without distortion has zeros in the first five.
_POLYNOMIAL: Final = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE: Final = ("k1", "k2", "k3", "k4")
_PLUMB_BOB: Final = 5


def plane_to_rows(plane: GroundPlane) -> Rows:
    """Encode a ground plane as the single row of its message."""
    names = [f"h{row}{column}" for row in range(3) for column in range(3)]
    lens = {} if plane.lens is None else _lens_to_columns(plane.lens)
    return GROUND_PLANE.rows(
        **{name: [value] for name, value in zip(names, plane.homography, strict=True)},
        width_px=[plane.width_px],
        height_px=[plane.height_px],
        foot=[plane.point == "foot"],
        assumed=[plane.assumed],
        **{name: [value] for name, value in lens.items()},
    )


def rows_to_plane(rows: Rows) -> GroundPlane:
    """Decode a ground plane. Raises McaptrackError unless there is exactly one row."""
    if len(rows) != 1:
        raise McaptrackError(f"a ground plane message holds one row, not {len(rows)}")
    row = rows[0]
    homography = tuple(float(row[f"h{i}{j}"]) for i in range(3) for j in range(3))
    size = (int(row["width_px"]), int(row["height_px"]))
    lens = _columns_to_lens(row) if np.isfinite(row["fx_px"]) else None
    return GroundPlane(homography, *size, "foot" if row["foot"] else "center", bool(row["assumed"]), lens)


def _lens_to_columns(lens: Lens) -> dict[str, float]:
    (fx, fy), (cx, cy) = lens.focal_px, lens.centre_px
    bent = lens.distortion or (0.0,) * _PLUMB_BOB
    names = _FISHEYE if lens.is_fisheye else _POLYNOMIAL
    columns = {"fx_px": fx, "fy_px": fy, "cx_px": cx, "cy_px": cy}
    return columns | dict(zip(names, bent, strict=False))


def _columns_to_lens(row: np.void) -> Lens:
    is_fisheye = bool(np.isnan(row["p1"]))
    bent = [float(row[name]) for name in (_FISHEYE if is_fisheye else _POLYNOMIAL)]
    coefficients = tuple(value for value in bent if np.isfinite(value))
    focal, centre = ((float(row[f"{name}x_px"]), float(row[f"{name}y_px"])) for name in "fc")
    return Lens(focal, centre, coefficients if any(coefficients) else (), is_fisheye and any(coefficients))
