"""Boxes in pixels: arrays (N, 4) of left, top, width, height. Letters: M, N boxes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def columns_to_boxes(rows: NDArray[np.void]) -> Floats:
    """The columns x_px, y_px, w_px, h_px of N rows as boxes (N, 4)."""
    return np.stack([rows["x_px"], rows["y_px"], rows["w_px"], rows["h_px"]], axis=-1)


def xyxy_to_xywh(corners: Floats) -> Floats:
    """Left, top, right, bottom -> left, top, width, height; (N, 4)."""
    return np.concatenate([corners[:, :2], corners[:, 2:] - corners[:, :2]], axis=1)


def iou(a: Floats, b: Floats) -> Floats:
    """Intersection over union (M, N) of every box of ``a`` (M, 4) with every one of ``b`` (N, 4); 0 for empty boxes."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, :2] + a[:, None, 2:], b[None, :, :2] + b[None, :, 2:])
    extent = np.clip(high - low, 0, None)
    both = extent[..., 0] * extent[..., 1]
    either = (a[:, 2] * a[:, 3])[:, None] + (b[:, 2] * b[:, 3])[None, :] - both
    return np.where(either > 0, both / np.where(either > 0, either, 1.0), 0.0)
