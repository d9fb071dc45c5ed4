"""The pixels that hide a person: a mosaic that is too coarse to be undone.

A cell is at least a quarter as large as the person, so that a face is smaller than a cell, and its colour is rounded to
one of eight levels, so that pictures that follow each other don't give more detail together. Cells stay where they are
in the picture.

Letters: N boxes, H rows, W columns.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Image

#: The least size of a cell in px, and its least share of the longer side of a box.
_LEAST_PX: Final = 8
_SHARE: Final = 0.25
#: Colours are multiples of this, in the middle of their step.
_STEP: Final = 32


def hide(image: Image, boxes: Floats) -> tuple[Image, Bools]:
    """Hide the inside of boxes.

    Parameters
    ----------
    image : (H, W, 3) of uint8
        Blue, green, red. It is not changed.
    boxes : (N, 4)
        Left, top, width and height in px. Parts outside of the picture have no effect.

    Returns
    -------
    image : (H, W, 3) of uint8
    mask : (H, W) of bool
        Which pixels are hidden. All others are those of the given picture.
    """
    import cv2

    height, width = image.shape[:2]
    mask = np.zeros((height, width), np.bool_)
    out = image.copy()
    left, top = np.floor(boxes[:, :2]).T.clip(0, [[width], [height]]).astype(np.int64)
    right, bottom = np.ceil(boxes[:, :2] + boxes[:, 2:]).T.clip(0, [[width], [height]]).astype(np.int64)
    longer = np.maximum(boxes[:, 2:].max(axis=1, initial=0) * _SHARE, _LEAST_PX)
    power = np.ceil(np.log2(longer) - 1e-9).astype(np.int64)
    for level in np.unique(power).tolist():  # where boxes overlap, larger cells hide smaller ones
        own = np.flatnonzero((power == level) & (right > left) & (bottom > top))
        if not len(own):
            continue
        cell = 1 << level
        inside = np.zeros((height, width), np.bool_)
        for number in own.tolist():
            inside[top[number] : bottom[number], left[number] : right[number]] = True
        x, y = int(left[own].min()) // cell * cell, int(top[own].min()) // cell * cell
        part = image[y : int(bottom[own].max()), x : int(right[own].max())]
        rows, columns = -(-part.shape[0] // cell), -(-part.shape[1] // cell)
        more = (rows * cell - part.shape[0], columns * cell - part.shape[1])
        whole = cv2.copyMakeBorder(part, 0, more[0], 0, more[1], cv2.BORDER_REPLICATE)
        small = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
        rough = (np.asarray(small, np.uint8) // _STEP * _STEP + _STEP // 2).repeat(cell, axis=0).repeat(cell, axis=1)
        end = np.s_[y : y + part.shape[0], x : x + part.shape[1]]
        out[end][inside[end]] = rough[: part.shape[0], : part.shape[1]][inside[end]]
        mask |= inside
    return out, mask
