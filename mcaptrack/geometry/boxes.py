"""Boxes in pixels: arrays (N, 4) of left, top, width, height. Letters: M, N boxes, P pairs."""

from __future__ import annotations

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
    return np.where(union > 0, intersection / np.where(union > 0, union, 1.0), 0.0)


def iou_of_pairs(a: Floats, b: Floats) -> Floats:
    """Intersection over union (N,) of each box of ``a`` (N, 4) with the box of ``b`` (N, 4) at the same index."""
    (ax, ay, aw, ah), (bx, by, bw, bh) = a.T, b.T
    width = np.minimum(ax + aw, bx + bw) - np.maximum(ax, bx)
    height = np.minimum(ay + ah, by + bh) - np.maximum(ay, by)
    intersection = np.clip(width, 0, None) * np.clip(height, 0, None)
    union = aw * ah + bw * bh - intersection
    return np.where(union > 0, intersection / np.where(union > 0, union, 1.0), 0.0)


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
