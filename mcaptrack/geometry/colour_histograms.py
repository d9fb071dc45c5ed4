"""Descriptors of people in pictures: histograms of the colours of the upper body and of the legs.

Histograms forget where exactly a colour is, so that they change little while a person walks and turns. They say what
a person wears and nothing else: there are no features of faces, and none that outlast a change of clothes.

Letters: N boxes, P pixels.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools, Floats, Image, Ints

#: Boxes are brought to this size (width, height) in pixels; the parts of the body are these rows of it.
_WIDTH, _HEIGHT = 16, 32
_PARTS: Final = ((5, 16), (16, 29))
#: The lightness and both axes of colour (CIELAB in 8 bits): the ends of the first and of the last bin, and how many.
#: Bins are wide and a pixel counts for two of them, so that a change of light moves little.
_BINS: Final = ((20.0, 235.0, 8), (98.0, 158.0, 10), (98.0, 158.0, 10))
#: The names of the bins of one part of the body, in their order.
BINS: Final = tuple(
    f"{axis}_{number + 1}"
    for axis, (_, _, count) in zip(("lightness", "green_red", "blue_yellow"), _BINS, strict=True)
    for number in range(count)
)
#: The length of a descriptor, in bytes.
LENGTH: Final = len(_PARTS) * len(BINS)
#: Boxes that another one covers to more than this share may show another person.
_MAX_COVERED: Final = 0.35
#: Smaller boxes have too few pixels, and those that end at a border of the picture show less than a person.
_MIN_WIDTH_PX, _MIN_HEIGHT_PX = 4.0, 8.0
#: Boxes are at a border that is so many of their widths or heights away: that far people walk between two samples.
_BORDER_WIDTHS, _BORDER_HEIGHTS = 1.0, 0.25


def describe(picture: Image, boxes: Floats) -> NDArray[np.uint8]:
    """Histograms of colours in boxes, as roots of shares: (N, ``LENGTH``), where 255 is 1.

    The distance of two rows is that of Hellinger, for each part and axis alike. Background shows at the sides of a box:
    its middle counts most.

    Parameters
    ----------
    picture : (height, width, 3) uint8
        Blue, green, red.
    boxes : (N, 4) float
        Left, top, width and height in px. They overlap the picture, as those of which ``is_clear`` is true.
    """
    import cv2

    height, width = picture.shape[:2]
    patches = np.empty((len(boxes), _HEIGHT, _WIDTH, 3), np.uint8)
    corners = np.rint(np.hstack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]])).astype(np.int64)
    for patch, (left, top, right, bottom) in zip(patches, corners.tolist(), strict=True):
        inside = picture[max(top, 0) : min(bottom, height), max(left, 0) : min(right, width)]
        patch[:] = cv2.resize(inside, (_WIDTH, _HEIGHT), interpolation=cv2.INTER_AREA)
    if len(boxes) == 0:
        return np.empty((0, LENGTH), np.uint8)
    lab: Image = np.asarray(cv2.cvtColor(patches.reshape(-1, _WIDTH, 3), cv2.COLOR_BGR2LAB), np.uint8)
    lab = lab.reshape(patches.shape)
    parts = [_histogram(lab[:, low:high, :, axis], *_BINS[axis]) for low, high in _PARTS for axis in range(3)]
    return np.asarray(np.rint(255 * np.sqrt(np.hstack(parts) / len(parts))), np.uint8)


def mean_shares(descriptors: NDArray[np.uint8], group: Ints, count: int) -> Floats:
    """The mean histograms of groups of descriptors (N, ``LENGTH``): shares of pixels, (count, parts of the body, BINS).

    ``group`` (N,) is from 0 to below ``count``; no group is empty. The shares of each axis are 1 together.
    """
    squares = np.square(descriptors / 255.0)
    mean = np.stack([np.bincount(group, column, count) for column in squares.T], axis=-1)
    shares = mean.reshape(count, len(_PARTS), len(BINS))
    starts = np.cumsum([0, *(bins for _, _, bins in _BINS[:-1])])
    total = np.add.reduceat(shares, starts, axis=2)
    return np.asarray(shares / np.repeat(total, [bins for _, _, bins in _BINS], axis=2))


def _histogram(values: NDArray[np.uint8], low: float, high: float, count: int) -> Floats:
    """The share of pixels in each bin, (N, count), of values (N, rows, ``_WIDTH``); the middle columns count most."""
    number, rows, width = values.shape
    middle = (width - 1) / 2
    weight = 1 - ((np.arange(width) - middle) / (middle - 1)) ** 2
    weights = np.broadcast_to(np.maximum(weight, 0.0), (number, rows, width)).ravel()
    place = np.clip((values.ravel() - low) / (high - low) * (count - 1), 0, count - 1)
    lower: Ints = np.minimum(place.astype(np.int64), count - 2)
    upper_share = place - lower
    cell = np.repeat(np.arange(number) * count, rows * width) + lower
    total = np.bincount(cell, weights * (1 - upper_share), number * count)
    total += np.bincount(cell + 1, weights * upper_share, number * count)
    return np.asarray(total.reshape(number, count) / weights[: rows * width].sum())


def is_clear(boxes: Floats, width_px: int, height_px: int) -> Bools:
    """Whether boxes (N, 4) of one picture are large enough, inside of it, and not covered by another one, (N,)."""
    x0, y0, w, h = boxes.T
    x1, y1 = x0 + w, y0 + h
    is_inside = (x0 >= 1) & (y0 >= 1) & (x1 <= width_px - 1) & (y1 <= height_px - 1)
    wide = np.minimum(x1[:, None], x1) - np.maximum(x0[:, None], x0)
    tall = np.minimum(y1[:, None], y1) - np.maximum(y0[:, None], y0)
    common = np.maximum(wide, 0) * np.maximum(tall, 0)
    np.fill_diagonal(common, 0)
    is_covered = common.max(axis=1, initial=0.0) > _MAX_COVERED * w * h
    return np.asarray(is_inside & (w >= _MIN_WIDTH_PX) & (h >= _MIN_HEIGHT_PX) & ~is_covered)


def at_border(boxes: Floats, width_px: int, height_px: int) -> Bools:
    """Whether boxes (N, 4) are next to a border of the picture, (N,)."""
    x0, y0, w, h = boxes.T
    aside, above = _BORDER_WIDTHS * w, _BORDER_HEIGHTS * h
    is_aside = (x0 < aside) | (x0 + w > width_px - aside)
    return np.asarray(is_aside | (y0 < above) | (y0 + h > height_px - above))
