"""Boxes in metres with a heading: arrays (N, 7) of the centre x, y, z, length, width, height, heading.

The length lies along the heading, which counts from the x axis, counter-clockwise about z, in radians. z is up.

Letters: N boxes, or pairs of boxes.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats

#: The columns of rows that make a box, in the order of the arrays.
COLUMNS: Final = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad")
_X, _Y, _Z, _LENGTH, _WIDTH, _HEIGHT, _HEADING = range(7)
#: The corners of a box, counter-clockwise, in halves of its length and width.
_CORNERS: Final = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


def columns_to_oriented_boxes(rows: NDArray[np.void]) -> Floats:
    """The columns of N rows as boxes (N, 7)."""
    return np.stack([rows[name] for name in COLUMNS], axis=-1)


def bev_corners(boxes: Floats) -> Floats:
    """The corners of boxes on the ground plane, counter-clockwise from the front left one: (N, 4, 2)."""
    half = _CORNERS * boxes[:, None, _LENGTH : _WIDTH + 1] / 2
    return _turned(half, boxes[:, _HEADING]) + boxes[:, None, : _Y + 1]


def _turned(xy: Floats, angle: Floats) -> Floats:
    """Points (N, P, 2) turned counter-clockwise by angles (N,)."""
    cos, sin = np.cos(angle[:, None]), np.sin(angle[:, None])
    return np.stack([cos * xy[..., 0] - sin * xy[..., 1], sin * xy[..., 0] + cos * xy[..., 1]], axis=-1)


def bev_iou_of_pairs(a: Floats, b: Floats) -> Floats:
    """Intersection over union (N,) on the ground plane (bird's eye view) of the boxes of ``a`` and ``b`` at one index.

    It is 0 for boxes without an area, and for boxes with a missing column (NaN).
    """
    shared = bev_intersection_of_pairs(a, b)
    union = a[:, _LENGTH] * a[:, _WIDTH] + b[:, _LENGTH] * b[:, _WIDTH] - shared
    return _ratio(shared, union)


def iou_3d_of_pairs(a: Floats, b: Floats) -> Floats:
    """Intersection over union (N,) in space of the boxes of ``a`` (N, 7) and ``b`` (N, 7) at the same index.

    It is 0 for boxes without a volume, and for boxes with a missing column (NaN).
    """
    top = np.minimum(a[:, _Z] + a[:, _HEIGHT] / 2, b[:, _Z] + b[:, _HEIGHT] / 2)
    bottom = np.maximum(a[:, _Z] - a[:, _HEIGHT] / 2, b[:, _Z] - b[:, _HEIGHT] / 2)
    shared = bev_intersection_of_pairs(a, b) * np.clip(top - bottom, 0, None)
    union = a[:, _LENGTH : _HEIGHT + 1].prod(axis=1) + b[:, _LENGTH : _HEIGHT + 1].prod(axis=1) - shared
    return _ratio(shared, union)


def _ratio(shared: Floats, union: Floats) -> Floats:
    with np.errstate(invalid="ignore"):
        is_box = union > 0
    return np.where(is_box, shared / np.where(is_box, union, 1.0), 0.0)


def bev_intersection_of_pairs(a: Floats, b: Floats) -> Floats:
    """The area (N,), m2, on the ground plane that the boxes of ``a`` and ``b`` at the same index share."""
    away = np.hypot(a[:, _X] - b[:, _X], a[:, _Y] - b[:, _Y])
    reach = np.hypot(a[:, _LENGTH], a[:, _WIDTH]) + np.hypot(b[:, _LENGTH], b[:, _WIDTH])
    near = np.flatnonzero(away <= reach / 2)  # none where a column is missing
    out = np.zeros(len(a))
    out[near] = _intersection(a[near], b[near])
    return out


def _intersection(a: Floats, b: Floats) -> Floats:
    """The shared areas (N,) of boxes that may overlap.

    In the axes of ``b``, the shared area is the integral along x, over the length of ``b``, of the height of ``a``
    within the width of ``b``. That is a sum over the edges of ``a``, each a linear function of x that is cut off at
    both sides of ``b``. It needs no list of corners, so that touching and equal boxes are no special cases.
    """
    half = _CORNERS * a[:, None, _LENGTH : _WIDTH + 1] / 2
    centre = _turned(a[:, None, : _Y + 1] - b[:, None, : _Y + 1], -b[:, _HEADING])
    corners = _turned(half, a[:, _HEADING] - b[:, _HEADING]) + centre
    x, y = corners[..., 0], corners[..., 1]
    half_length, half_width = b[:, _LENGTH, None] / 2, b[:, _WIDTH, None] / 2
    step_x, step_y = np.roll(x, -1, axis=1) - x, np.roll(y, -1, axis=1) - y
    start, end = (np.clip(part(x, x + step_x), -half_length, half_length) for part in (np.minimum, np.maximum))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        slope = np.where(step_x == 0, 0.0, step_y / step_x)
        crossings = [x + (side - y) / slope for side in (-half_width, half_width)]
    # Where an edge crosses a side of b; one that is parallel to the sides never does.
    places = [np.clip(np.where(np.isfinite(at), at, start), start, end) for at in crossings]
    at = np.sort(np.stack([start, *places, end]), axis=0)
    height = np.clip(y + slope * (at - x), -half_width, half_width)
    area = ((height[1:] + height[:-1]) / 2 * np.diff(at, axis=0)).sum(axis=0)
    return np.asarray(np.clip((-np.sign(step_x) * area).sum(axis=1), 0, None))
