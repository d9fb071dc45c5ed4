"""Affine transforms of pixels, (2, 3): x' = matrix[:, :2] @ x + matrix[:, 2]. Letters: N points or boxes.

Pixels are counted from the centre of the first one, as OpenCV counts them.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats

IDENTITY: Final = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
IDENTITY.flags.writeable = False


def compose(second: Floats, first: Floats) -> Floats:
    """The transform (2, 3) that applies ``first`` and then ``second``; exact if one of them is the identity."""
    if first is IDENTITY:
        return second
    if second is IDENTITY:
        return first
    out = second[:, :2] @ first
    out[:, 2] += second[:, 2]
    return out


def invert(matrix: Floats) -> Floats:
    """The transform (2, 3) back."""
    if matrix is IDENTITY:
        return IDENTITY
    linear = np.linalg.inv(matrix[:, :2])
    return np.column_stack([linear, -linear @ matrix[:, 2]])


def move_points(matrix: Floats, points: Floats) -> Floats:
    """Apply a transform to points (N, 2)."""
    return points @ matrix[:, :2].T + matrix[:, 2]


def scale_of(matrix: Floats) -> float:
    """By how much a transform enlarges lengths."""
    return float(np.sqrt(np.abs(np.linalg.det(matrix[:, :2]))))


def move_boxes(matrix: Floats, boxes: Floats) -> Floats:
    """Apply a transform to boxes (N, 4) of left, top, width, height. They stay upright and keep their proportions."""
    size = boxes[:, 2:] * scale_of(matrix)
    return np.concatenate([move_points(matrix, boxes[:, :2] + boxes[:, 2:] / 2) - size / 2, size], axis=1)


def shift_px(matrix: Floats, width_px: float, height_px: float) -> float:
    """The largest distance that a transform moves a corner of the picture, in pixels."""
    if matrix is IDENTITY:
        return 0.0
    corners = np.array([[0.0, 0.0], [width_px, 0.0], [0.0, height_px], [width_px, height_px]])
    away = move_points(matrix, corners) - corners
    return float(np.hypot(away[:, 0], away[:, 1]).max())
