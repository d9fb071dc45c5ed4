"""Boxes in pixels, arrays (N, 4) of left, top, width, height; and oriented boxes in metres, arrays (N, 7) of the centre
x, y, z, length, width, height, heading.

The length lies along the heading, which counts from the x axis, counter-clockwise about z, in radians. z is up.

Letters: M, N boxes, P pairs.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools, Floats, Indices
from mcaptrack.geometry.neighbours import touching_pairs
from mcaptrack.geometry.ragged import group_index, ragged_range

__all__ = ["columns_to_boxes", "parse_size"]

#: From so many pairs on, finding those that can overlap first is faster; and from so many on, finding them by cells.
_MANY = 1500
_VERY_MANY = 250_000


def columns_to_boxes(rows: NDArray[np.void]) -> Floats:
    """The columns x_px, y_px, w_px, h_px of N rows as boxes (N, 4)."""
    return np.stack([rows["x_px"], rows["y_px"], rows["w_px"], rows["h_px"]], axis=-1)


def parse_size(text: str) -> tuple[int, int] | None:
    """Width and height of a text with an x between both, as 1920x1080: whole numbers from 1 to 999999; else None."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isascii() and part.isdecimal() and 0 < len(part) < 7 for part in parts):
        return None
    first, second = map(int, parts)
    return (first, second) if first and second else None


def iou(a: Floats, b: Floats) -> Floats:
    """Intersection over union (M, N) of all boxes of ``a`` (M, 4) with all of ``b`` (N, 4); 0 for empty boxes."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, :2] + a[:, None, 2:], b[None, :, :2] + b[None, :, 2:])
    extent = np.clip(high - low, 0, None)
    intersection = extent[..., 0] * extent[..., 1]
    union = (a[:, 2] * a[:, 3])[:, None] + (b[:, 2] * b[:, 3])[None, :] - intersection
    return _ratio(intersection, union)


def _ratio(shared: Floats, union: Floats) -> Floats:
    """Intersection over union; 0 for boxes without an extent."""
    with np.errstate(invalid="ignore"):
        is_box = union > 0
    return np.where(is_box, shared / np.where(is_box, union, 1.0), 0.0)


def iou_of_pairs(a: Floats, b: Floats) -> Floats:
    """Intersection over union (N,) of each box of ``a`` (N, 4) with the box of ``b`` (N, 4) at the same index."""
    (ax, ay, aw, ah), (bx, by, bw, bh) = a.T, b.T
    width = np.minimum(ax + aw, bx + bw) - np.maximum(ax, bx)
    height = np.minimum(ay + ah, by + bh) - np.maximum(ay, by)
    intersection = np.clip(width, 0, None) * np.clip(height, 0, None)
    union = aw * ah + bw * bh - intersection
    return _ratio(intersection, union)


def share_inside(boxes: Floats, width_px: float, height_px: float) -> Floats:
    """The share of the area of each box (N, 4) that is inside of a picture; NaN for boxes that are empty or missing."""
    extent = [
        np.clip(boxes[:, k] + boxes[:, k + 2], 0, size) - np.clip(boxes[:, k], 0, size)
        for k, size in enumerate((width_px, height_px))
    ]
    area = boxes[:, 2] * boxes[:, 3]
    share: Floats = np.divide(extent[0] * extent[1], area, out=np.full(len(boxes), np.nan), where=area > 0)
    return share


def overlapping(a: Floats, b: Floats, area_a: Floats, area_b: Floats) -> tuple[Indices, Indices, Floats]:
    """The pairs of boxes that overlap, and their intersection over union.

    ``a`` (4, M) and ``b`` (4, N) are left, top, right, bottom, with their areas (M,) and (N,). Returns the indices into
    ``a`` (P,), rising, those into ``b`` (P,), and the intersection over union (P,).
    """
    if a.shape[1] * b.shape[1] > _MANY:
        is_large = a.shape[1] * b.shape[1] > _VERY_MANY
        first, second = (
            touching_pairs(a.T, b.T, *(np.zeros(n, np.int64) for n in (a.shape[1], b.shape[1])))
            if is_large
            else _sweep(a, b)
        )
        extent = np.minimum(a[2:].take(first, axis=1), b[2:].take(second, axis=1))
        extent -= np.maximum(a[:2].take(first, axis=1), b[:2].take(second, axis=1))
        np.maximum(extent, 0.0, out=extent)
        extent[0] *= extent[1]
        at = extent[0].nonzero()[0]
        first, second, intersection = first.take(at), second.take(at), extent[0].take(at)
    else:
        extent = np.minimum(a[2:, :, None], b[2:, None, :])
        extent -= np.maximum(a[:2, :, None], b[:2, None, :])
        np.maximum(extent, 0.0, out=extent)
        extent[0] *= extent[1]
        areas = extent[0].ravel()
        at = areas.nonzero()[0]
        intersection = areas.take(at)
        first, second = np.divmod(at, b.shape[1] or 1)
    union = area_a.take(first)
    union += area_b.take(second)
    union -= intersection
    return first, second, intersection / union


def _sweep(a: Floats, b: Floats) -> tuple[Indices, Indices]:
    """Candidate pairs of a sweep from left to right: all pairs that overlap are among them."""
    order = b[0].argsort(kind="stable")
    left = b[0, order]
    low = left.searchsorted(a[0] - (b[2] - b[0]).max(), "left")
    high = left.searchsorted(a[2], "right")
    return group_index(high - low), order[ragged_range(low, high - low)]


def outside(boxes: Floats, size: Floats) -> tuple[Bools, Bools]:
    """Mask boxes (N, 4) of left, top, width, height that lie outside of pictures of this size (2,) or these sizes
    (N, 2) of width and height: as a whole, and by more than half of their area.
    """
    low, high = boxes[:, :2], boxes[:, :2] + boxes[:, 2:]
    beyond: Bools = np.asarray(((low >= size) | (high <= 0)).any(axis=1))
    inner = np.maximum(np.minimum(high, size) - np.maximum(low, 0), 0).prod(axis=1)
    return beyond, np.asarray(~beyond & (inner < boxes[:, 2:].prod(axis=1) / 2))


#: The columns of rows that make a box, in the order of the arrays.
ORIENTED_COLUMNS: Final = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad")
_X, _Y, _Z, _LENGTH, _WIDTH, _HEIGHT, _HEADING = range(7)
#: The corners of a box, counter-clockwise, in halves of its length and width.
_CORNERS: Final = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


def columns_to_oriented_boxes(rows: NDArray[np.void]) -> Floats:
    """The columns of N rows as boxes (N, 7)."""
    return np.stack([rows[name] for name in ORIENTED_COLUMNS], axis=-1)


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


def wrapped(angle: Floats) -> Floats:
    """Angles in radians, from -pi (not included) to pi."""
    return np.asarray(np.pi - (np.pi - angle) % (2 * np.pi))


def headings(ahead: Floats) -> Floats:
    """The angles (N,) of vectors (N, 2 or 3) from the x axis in the x-y plane, from -pi (not included) to pi."""
    angle = np.arctan2(ahead[:, 1], ahead[:, 0])
    return np.asarray(np.where(angle == -np.pi, np.pi, angle))
