"""Boxes that mean the same object: class-wise non-maximum suppression, and joining across the seams of tiles.

Letters: N boxes.
"""

from __future__ import annotations

from math import ceil
from typing import Final, Literal, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Image, Ints, taken

#: So many boxes of a picture, the likeliest, are looked at: pairs of them are compared.
_MOST: Final = 1000
#: Boxes of two tiles are one object if so much of the smaller one is covered by the other.
_COVERED: Final = 0.7
#: Parts of a box on both sides of a seam are one object if they agree so well along the seam.
_ALONG: Final = 0.6
#: A box that ends so near to an edge of its tile is cut off there, in pixels of the picture.
_EDGE_PX: Final = 4.0


class Boxes(NamedTuple):
    """Boxes (N, 4) as x1, y1, x2, y2 in pixels, scores (N,), and class indices (N,)."""

    xyxy: Floats
    score: Floats
    label: Ints

    @classmethod
    def joined(cls, parts: list[Boxes]) -> Boxes:
        """All of several, in order."""
        if not parts:
            return cls(np.empty((0, 4)), np.empty(0), np.empty(0, np.int64))
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def suppress(boxes: Boxes, max_iou: float) -> Boxes:
    """Greedy non-maximum suppression within each class: the likeliest first, without those that overlap it.

    Parameters
    ----------
    boxes : Boxes
        N boxes; the 1000 likeliest are looked at.
    max_iou : float
        Boxes of one class with a greater intersection over union are one object.

    Returns
    -------
    Boxes
        Those that are kept, the likeliest first.

    """
    boxes = taken(boxes, _by_score(boxes)[:_MOST])
    beaten_by = np.triu(_overlaps(boxes.xyxy)[0] > max_iou, 1) & (boxes.label[:, None] == boxes.label)
    kept = np.ones(len(boxes.score), bool)
    while True:  # after n rounds the n likeliest are settled; usually three rounds are enough for all
        again = ~(beaten_by & kept[:, None]).any(axis=0)
        if (again == kept).all():
            return taken(boxes, kept)
        kept = again


def join_tiles(parts: list[Boxes], tiles: list[tuple[int, int, int, int]], max_iou: float) -> Boxes:
    """The boxes of a picture from those of its tiles.

    A box that an edge of its tile cuts off is dropped where a larger box of another tile covers it; two that continue
    one another across a seam become one.

    Parameters
    ----------
    parts : list of Boxes
        For each tile, in pixels of the picture.
    tiles : list of (x1, y1, x2, y2)
        In pixels of the picture.
    max_iou : float
        As for ``suppress``.

    Returns
    -------
    Boxes
        The likeliest first.

    """
    boxes = Boxes.joined(parts)
    tile = np.repeat(np.arange(len(parts)), [len(part.score) for part in parts])
    cut = np.concatenate([_cut(part.xyxy, tile, tiles) for part, tile in zip(parts, tiles, strict=True)])
    order = _by_score(boxes)[:_MOST]
    boxes, tile, cut = taken(boxes, order), tile[order], cut[order]
    overlap, inner = _overlaps(boxes.xyxy)
    area = _areas(boxes.xyxy)
    is_cut = np.asarray(cut.any(axis=1))
    other = (tile[:, None] != tile) & (boxes.label[:, None] == boxes.label)
    facing = other & _continued(boxes.xyxy, cut)
    # Each cut box is a part of one other box at most: two people beside one another are whole in a tile each, and what
    # either tile cuts off may lie within both.
    larger = (area[:, None] < area) | ((area[:, None] == area) & np.tri(len(area), k=-1, dtype=bool))
    part_of = other & ~facing & is_cut[:, None] & larger & (inner >= _COVERED * area[:, None])
    is_gone = part_of.any(axis=1)
    score = boxes.score.copy()
    others = np.where(part_of, overlap, -1.0)[is_gone].argmax(axis=1) if is_gone.any() else []
    np.maximum.at(score, others, boxes.score[is_gone])
    boxes, left = taken(boxes._replace(score=score), ~is_gone), np.flatnonzero(~is_gone)
    group = _groups(facing[np.ix_(left, left)])
    xyxy, score = boxes.xyxy.copy(), boxes.score.copy()
    np.minimum.at(xyxy[:, :2], group, boxes.xyxy[:, :2])
    np.maximum.at(xyxy[:, 2:], group, boxes.xyxy[:, 2:])
    np.maximum.at(score, group, boxes.score)
    return suppress(taken(Boxes(xyxy, score, boxes.label), np.unique(group)), max_iou)


def _by_score(boxes: Boxes) -> Ints:
    """The order from the likeliest on; equal ones from the top left."""
    return np.lexsort((boxes.xyxy[:, 0], boxes.xyxy[:, 1], -boxes.score))


def _areas(xyxy: Floats) -> Floats:
    return np.asarray(np.prod(np.maximum(xyxy[:, 2:] - xyxy[:, :2], 0), axis=1))


def _overlaps(xyxy: Floats) -> tuple[Floats, Floats]:
    """Intersection over union of all pairs (N, N), and the area of the intersection."""
    low = np.maximum(xyxy[:, None, :2], xyxy[:, :2])
    high = np.minimum(xyxy[:, None, 2:], xyxy[:, 2:])
    inner = np.prod(np.maximum(high - low, 0), axis=-1)
    area = _areas(xyxy)
    union = area[:, None] + area - inner
    return np.divide(inner, union, out=np.zeros_like(inner), where=union > 0), inner


def _cut(xyxy: Floats, tile: tuple[int, int, int, int], tiles: list[tuple[int, int, int, int]]) -> Bools:
    """Whether each side (N, 4) of boxes ends at an edge of their tile that is no edge of the picture."""
    every = np.array(tiles)
    outer = np.array([*every[:, :2].min(axis=0), *every[:, 2:].max(axis=0)])
    edges = np.array(tile)
    return np.asarray((np.abs(xyxy - edges) <= _EDGE_PX) & (edges != outer))


def _continued(xyxy: Floats, cut: Bools) -> Bools:
    """Whether pairs (N, N) are the parts of one box: cut on sides that face each other and meet, of equal extent."""
    out = np.zeros((len(xyxy), len(xyxy)), bool)
    for axis in (0, 1):
        across, along = axis, 1 - axis
        low, high = xyxy[:, along], xyxy[:, along + 2]
        inner = np.minimum(high[:, None], high) - np.maximum(low[:, None], low)
        union = np.maximum(high[:, None], high) - np.minimum(low[:, None], low)
        agrees = inner >= _ALONG * np.maximum(union, 1e-9)
        meets = xyxy[:, across] <= xyxy[:, None, across + 2] + 2 * _EDGE_PX
        faces = cut[:, None, across + 2] & cut[None, :, across] & meets & meets.T
        out |= agrees & (faces | faces.T)
    return out


def _groups(same: Bools) -> Ints:
    """The number of the first member of the group of each, where pairs that are the same are in one group."""
    number = np.arange(len(same))
    joined = same | np.eye(len(same), dtype=bool)
    while True:
        again = np.where(joined, number, len(same)).min(axis=1, initial=len(same))
        if (again == number).all():
            return number
        number = again


# A picture, or a tile of one, as the input of a network, and boxes back from there.


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
