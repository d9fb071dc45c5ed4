"""The appearance of people in a scene: their height over the row of the feet, and their shape.

The height is learned as a line over the row of the feet, from regions of a foreground mask that stand alone; the shape
is the mean of these regions, scaled to one height: the probability that a pixel belongs to a person who stands there.

Letters: N regions or boxes (x, y, w, h); T rows of a template, C its columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools, Floats, Image, Ints

#: Values of pixels that are shares or likelihoods.
Map = NDArray[np.float32]
#: Numbers of regions, 0 for the background.
Labels = NDArray[np.uint16] | NDArray[np.int32]

#: Rows of a template.
ROWS: Final = 24
#: Smaller regions are noise; so are those smaller than this share of the squared height of a person.
MIN_AREA_PX: Final = 20
MIN_AREA: Final = 0.02
#: OpenCV refuses so many regions with labels of 16 bits.
_MOST_SHORT_LABELS: Final = 2**16 - 1
#: In heights of a person: a body often gives several regions above each other, which are joined over this distance.
JOIN: Final = 0.2
#: The height of people until enough regions were measured, and the lowest height that is used.
INITIAL_HEIGHT_PX: Final = 20.0
_MIN_HEIGHT_PX: Final = 8.0
#: Regions within this share of the expected height are of one person.
_TOLERANCE: Final = 0.15
_SAME_WIDTH: Final = 0.35
#: So many regions are needed to learn from, and so many are kept.
_MIN_REGIONS: Final = 8
_MAX_REGIONS: Final = 4_000
_DRAWS: Final = 500
#: The share of the picture's height over which feet have to spread for a slope.
_MIN_SPREAD: Final = 0.05
#: A template is wider than people by this factor, so that it holds strides.
_MARGIN: Final = 1.8


@dataclass(frozen=True)
class Person:
    """The appearance of people in a scene.

    Attributes
    ----------
    slope, level : float
        Their height is ``slope`` times the row of the feet plus ``level``, in pixels.
    template : (T, C) float32
        The probability that a pixel of a person's surrounding belongs to the person. Feet stand at the middle of the
        last row.

    """

    slope: float
    level: float
    template: Map

    def height(self, foot_px: float) -> float:
        """The height of a person who stands at this row, in pixels."""
        return max(self.slope * foot_px + self.level, _MIN_HEIGHT_PX)

    def heights(self, foot_px: Ints) -> Floats:
        """The heights (N,) of people who stand at these rows (N,), in pixels."""
        return np.asarray(np.maximum(self.slope * foot_px + self.level, _MIN_HEIGHT_PX), np.float64)


def odd(value: float) -> int:
    """Return an odd number near a value, at least 1."""
    return max(1, round(value) // 2 * 2 + 1)


def closed(mask: Image, height: int, width: int) -> Image:
    """Close gaps of a mask that are smaller than this, both odd; what lies near an edge is not stretched up to it."""
    import cv2

    y, x = height // 2, width // 2
    padded = cv2.copyMakeBorder(mask, y, y, x, x, cv2.BORDER_CONSTANT, value=0)
    kernel = np.ones((height, width), np.uint8)
    # Dilation may reach into the padding, and erosion reads twice as far: there, what it can't see must be empty.
    wide = cv2.dilate(padded, kernel)
    return np.asarray(cv2.erode(wide, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0), np.uint8)[
        y : y + mask.shape[0], x : x + mask.shape[1]
    ]


def regions(mask: Image, join_px: int) -> tuple[Labels, Ints]:
    """Labels of connected regions, and their x, y, w, h and area (N, 5); label k is row k - 1."""
    import cv2

    if join_px > 1:
        mask = closed(mask, join_px, 1)
    # A square of four pixels has one region at most. Short labels take half of the time.
    most = (mask.shape[0] + 1) // 2 * ((mask.shape[1] + 1) // 2)
    kind = cv2.CV_16U if most < _MOST_SHORT_LABELS else cv2.CV_32S
    _, labels, found, _ = cv2.connectedComponentsWithStats(mask, connectivity=8, ltype=kind)
    return cast("Labels", labels), np.asarray(found[1:], np.int64)


def typical_height(masks: Sequence[Image]) -> float:
    """The height of regions of masks, in pixels: the median weighted by their area."""
    sizes: list[tuple[int, int]] = []
    for mask in masks:
        _, found = regions(closed(mask, 3, 3), 1)
        large = found[(found[:, 4] >= MIN_AREA_PX) & (found[:, 3] < mask.shape[0] / 2)]
        sizes += zip(large[:, 3].tolist(), (large[:, 2] * large[:, 3]).tolist(), strict=True)
    if not sizes:
        return INITIAL_HEIGHT_PX
    height, area = np.array(sorted(sizes), np.float64).T
    total = np.cumsum(area)
    return float(height[np.searchsorted(total, total[-1] / 2)])


def region_boxes(mask: Image, person_px: float) -> Floats:
    """Boxes (N, 4) around the regions of a mask in which people are about ``person_px`` tall."""
    _, found = regions(mask, odd(JOIN * person_px))
    return found[found[:, 4] >= max(MIN_AREA_PX, MIN_AREA * person_px**2), :4].astype(np.float64)


class Learner:
    """Collects regions of masks of one view, and learns from them how people look."""

    def __init__(self) -> None:
        self._boxes: list[tuple[int, int, int, int, int]] = []
        self._cuts: list[Image] = []
        self._picture_height = 0

    def add(self, masks: Sequence[Image], person_px: float) -> None:
        """Take the regions of masks in which people are about ``person_px`` tall."""
        for mask in masks:
            self._picture_height, width = mask.shape
            labels, found = regions(mask, odd(JOIN * person_px))
            for number, (x, y, w, h, area) in enumerate(found.tolist(), start=1):
                is_cut = x <= 1 or y <= 1 or x + w >= width - 1 or y + h >= self._picture_height - 1
                if is_cut or area < max(MIN_AREA_PX, MIN_AREA * person_px**2) or len(self._boxes) >= _MAX_REGIONS:
                    continue
                own = (labels[y : y + h, x : x + w] == number) & (mask[y : y + h, x : x + w] > 0)
                self._boxes.append((x, y, w, h, area))
                self._cuts.append(_scaled(own))

    def person(self) -> Person | None:
        """The appearance of people; None if too few regions are alike."""
        if len(self._boxes) < _MIN_REGIONS:
            return None
        _, y, w, h, area = np.array(self._boxes, np.float64).T
        foot = y + h
        slope, level = _fit_height(foot, h, np.sqrt(area), self._picture_height)
        expected = np.maximum(slope * foot + level, _MIN_HEIGHT_PX)
        is_alike = np.abs(h - expected) < _TOLERANCE * expected
        if is_alike.sum() < _MIN_REGIONS:
            return None
        ratio = w / expected
        usual = _mode(ratio[is_alike])
        alone = np.flatnonzero(is_alike & (np.abs(ratio - usual) < _SAME_WIDTH * usual))
        columns = int(np.ceil(ROWS * usual * _MARGIN)) // 2 * 2 + 2
        pile = np.zeros((ROWS, columns), np.float32)
        for at in alone.tolist():
            cut = self._cuts[at]
            first = (cut.shape[1] - columns) // 2
            if first >= 0:
                pile += cut[:, first : first + columns] / np.float32(255)
            else:
                pile[:, -first : -first + cut.shape[1]] += cut / np.float32(255)
        pile /= max(len(alone), 1)
        return Person(slope, level, ((pile + pile[:, ::-1]) / 2).astype(np.float32))


def _scaled(region: Bools) -> Image:
    """A region, 0 to 255, scaled to the height of templates, its middle in the middle of an even number of columns."""
    import cv2

    height, width = region.shape
    scale = ROWS / height
    columns = int(np.ceil(width * scale)) // 2 * 2 + 2
    matrix = np.array([[scale, 0, columns / 2 - scale * width / 2], [0, scale, 0]])
    ink = np.where(region, np.float32(255), np.float32(0))
    if scale < 1:
        ink = np.asarray(cv2.blur(ink, (odd(1 / scale),) * 2), np.float32)
    return np.asarray(cv2.warpAffine(ink, matrix, (columns, ROWS), flags=cv2.INTER_LINEAR), np.float32).astype(np.uint8)


def _fit_height(foot: Floats, height: Floats, weight: Floats, picture_px: int) -> tuple[float, float]:
    """Slope and level of the line of height over the row of feet that most regions follow (RANSAC)."""
    rng = np.random.default_rng(0)
    one, two = rng.integers(0, len(foot), (2, _DRAWS))
    apart = foot[two] - foot[one]
    is_apart = np.abs(apart) > _MIN_SPREAD * picture_px
    slope = np.where(is_apart, (height[two] - height[one]) / np.where(is_apart, apart, 1.0), 0.0)
    slope = np.maximum(slope, 0.0)  # who is farther away is not taller
    level = height[one] - slope * foot[one]
    expected = slope[:, None] * foot + level[:, None]
    agrees = (expected > 0) & (np.abs(height - expected) < _TOLERANCE * expected)
    best = agrees[int((agrees * weight).sum(axis=1).argmax())]
    if np.ptp(foot[best]) > 2 * _MIN_SPREAD * picture_px:
        fitted, at_zero = np.polyfit(foot[best], height[best], 1, w=1 / height[best])
        if fitted >= 0:
            return float(fitted), float(at_zero)
    return 0.0, float(np.median(height[best]))


def _mode(values: Floats) -> float:
    """The half-sample mode: the densest place of values, robust against most of them lying elsewhere."""
    values = np.sort(values)
    while len(values) > 2:
        half = (len(values) + 1) // 2
        first = int(np.argmin(values[half - 1 :] - values[: len(values) - half + 1]))
        values = values[first : first + half]
    return float(values.mean())
