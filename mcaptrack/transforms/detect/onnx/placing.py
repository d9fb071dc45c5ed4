"""A picture, or a tile of one, as the input of a network, and boxes back from there."""

from __future__ import annotations

from math import ceil
from typing import Literal, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats, Image

#: Where a picture lies in the input: at the top left or in the centre, with its proportions, or filling it.
Fit = Literal["corner", "centre", "stretch"]
Size = tuple[int, int]
Tile = tuple[int, int, int, int]


class Placement(NamedTuple):
    """Where a tile of a picture lies in the input: input = (picture - origin) * scale + shift, as (x, y)."""

    origin: tuple[float, float]
    scale: tuple[float, float]
    shift: tuple[float, float]

    def to_picture(self, xyxy: Floats) -> Floats:
        """Boxes (N, 4) in pixels of the input -> pixels of the picture."""
        origin, scale, shift = (np.tile(pair, 2) for pair in self)
        return np.asarray((xyxy - shift) / scale + origin)


def place(image: Image, tile: Tile, size: Size, fit: Fit, pad: int) -> tuple[Image, Placement]:
    """Resize a tile of a picture to an input of ``size`` (width, height), and fill the rest with the value ``pad``."""
    import cv2

    x1, y1, x2, y2 = tile
    part = image[y1:y2, x1:x2]
    wide, high = size
    ratio = min(wide / (x2 - x1), high / (y2 - y1))
    inner = size if fit == "stretch" else (max(1, round((x2 - x1) * ratio)), max(1, round((y2 - y1) * ratio)))
    if inner != (x2 - x1, y2 - y1):
        part = np.asarray(cv2.resize(part, inner, interpolation=cv2.INTER_LINEAR), np.uint8)
    left, top = ((wide - inner[0]) // 2, (high - inner[1]) // 2) if fit == "centre" else (0, 0)
    placement = Placement((x1, y1), (inner[0] / (x2 - x1), inner[1] / (y2 - y1)), (left, top))
    if inner == size:
        return np.ascontiguousarray(part), placement
    canvas = np.full((high, wide, 3), pad, np.uint8)
    canvas[top : top + inner[1], left : left + inner[0]] = part
    return canvas, placement


def tiles_of(width: int, height: int, columns: int, rows: int, overlap: float) -> list[Tile]:
    """Tiles that cover a picture, each of which shares ``overlap`` of its width or height with its neighbours."""
    return [(x1, y1, x2, y2) for y1, y2 in _spans(height, rows, overlap) for x1, x2 in _spans(width, columns, overlap)]


def _spans(length: int, count: int, overlap: float) -> list[tuple[int, int]]:
    size = min(length, ceil(length / (count - (count - 1) * overlap)))
    starts = [round(number * (length - size) / max(count - 1, 1)) for number in range(count)]
    return [(start, start + size) for start in starts]
