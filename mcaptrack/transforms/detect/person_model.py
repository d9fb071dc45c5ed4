"""The appearance of people in a scene: their height over the row of the feet, and their shape.

The height is learned as a line over the row of the feet, from regions of a foreground mask that stand alone; the shape
is the mean of these regions, scaled to one height: the probability that a pixel belongs to a person who stands there.

The line is not right everywhere: a person close to a low camera is ten times as tall as those far away, and their feet
are out of the picture. Regions that are too tall for the line and shaped like one person contradict it; where they
cover more pixels than the regions that fit, the line does not hold.

Letters: N regions or boxes (x, y, w, h); T rows of a template, C its columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
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
#: A region is too tall for a group if it is taller than this, in expected heights, and shaped like one person if it is
#: no wider than tall (or twice that where the edge of the picture cuts it) and fills this share of its box at least.
_TOO_TALL: Final = 2.0
_CUT_WIDTH: Final = 2.0
_LEAST_FILL: Final = 0.3
#: A region fits the expected height within this share.
_FITS: Final = 0.25
#: Regions count for the rows around their feet, up to this share of the picture's height.
_AROUND: Final = 0.05
#: So many regions of a mask are compared with the line, the largest ones.
_MOST_COMPARED: Final = 200
#: People are at least this wide on average, in heights: a narrower shape was learned from noise.
_LEAST_WIDTH: Final = 0.08
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
    rows : (H + 1,) bool, optional
        Where the line of heights holds, by the row of the feet; everywhere if None.
    contradicted : float
        The share of the moving pixels that contradict the heights, of those that fit or contradict them.

    """

    slope: float
    level: float
    template: Map
    rows: Bools | None = None
    contradicted: float = 0.0

    def height(self, foot_px: float) -> float:
        """The height of a person who stands at this row, in pixels."""
        return max(self.slope * foot_px + self.level, _MIN_HEIGHT_PX)

    def heights(self, foot_px: Ints) -> Floats:
        """The heights (N,) of people who stand at these rows (N,), in pixels."""
        return np.asarray(np.maximum(self.slope * foot_px + self.level, _MIN_HEIGHT_PX), np.float64)

    def holds(self, foot_px: Ints) -> Bools:
        """Whether the line of heights holds at these rows (N,)."""
        if self.rows is None:
            return np.ones(foot_px.shape, np.bool_)
        return np.asarray(self.rows[np.clip(foot_px, 0, len(self.rows) - 1)], np.bool_)


def is_too_tall(height: Ints, expected: Floats) -> Bools:
    """Which regions (N,) are taller than people of the expected height who stand behind each other."""
    return np.asarray(height > _TOO_TALL * expected, np.bool_)


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
    x, y, w, h = cv2.boundingRect(mask)  # labels cost time for each pixel
    labels = np.zeros(mask.shape, np.uint16 if kind == cv2.CV_16U else np.int32)
    if not w:
        return labels, np.empty((0, 5), np.int64)
    _, inner, stats, _ = cv2.connectedComponentsWithStats(
        np.ascontiguousarray(mask[y : y + h, x : x + w]), connectivity=8, ltype=kind
    )
    labels[y : y + h, x : x + w] = inner
    return cast("Labels", labels), np.asarray(stats[1:], np.int64) + np.array([x, y, 0, 0, 0])


def typical_heights(masks: Sequence[Image]) -> tuple[float, float]:
    """The height of regions of masks, in pixels: the medians weighted by their area, and by their outline.

    Both are the same where people are about as tall everywhere. One person close to the camera covers more pixels than
    all those far away, but their outlines are longer together.
    """
    sizes: list[tuple[int, int]] = []
    for mask in masks:
        _, boxes = regions(closed(mask, 3, 3), 1)
        large = boxes[(boxes[:, 4] >= MIN_AREA_PX) & (boxes[:, 3] < mask.shape[0] / 2)]
        sizes += zip(large[:, 3].tolist(), (large[:, 2] * large[:, 3]).tolist(), strict=True)
    if not sizes:
        return INITIAL_HEIGHT_PX, INITIAL_HEIGHT_PX
    height, area = np.array(sorted(sizes), np.float64).T
    by_area, by_outline = (
        np.searchsorted(total, total[-1] / 2) for total in (np.cumsum(area), np.cumsum(np.sqrt(area)))
    )
    return float(height[by_area]), float(height[by_outline])


def region_boxes(mask: Image, person_px: float) -> Floats:
    """Boxes (N, 4) around the regions of a mask in which people are about ``person_px`` tall."""
    _, boxes = regions(mask, odd(JOIN * person_px))
    return boxes[boxes[:, 4] >= max(MIN_AREA_PX, MIN_AREA * person_px**2), :4].astype(np.float64)


class Learner:
    """Collects regions of masks of one view, and learns from them how people look."""

    def __init__(self) -> None:
        self._usual = _Sample()
        #: The same with smaller regions, from the first time on that most of the outlines are of smaller ones.
        self._smaller: _Sample | None = None
        self._seen: list[Ints] = []
        self._size = (0, 0)

    def add(self, masks: Sequence[Image], person_px: float, smaller_px: float | None = None) -> None:
        """Take the regions of masks in which people are about ``person_px`` tall, or perhaps only ``smaller_px``."""
        if smaller_px is not None and self._smaller is None:
            self._smaller = self._usual.copy()
        for mask in masks:
            self._size = mask.shape
            boxes = self._usual.add(mask, person_px)
            if self._smaller is not None:
                boxes = self._smaller.add(mask, smaller_px or person_px)
            boxes = boxes[boxes[:, 4] >= MIN_AREA_PX]
            self._seen.append(boxes[np.argsort(-boxes[:, 4], kind="stable")[:_MOST_COMPARED]])

    def person(self) -> Person | None:
        """The appearance of people; None if too few regions are alike, or if they don't look like people."""
        usual = self._usual.person(self._size[0])
        if self._smaller is None:
            return self._checked(usual)
        smaller = self._smaller.person(self._size[0])
        return self._checked(smaller if self._fitting(smaller) > self._fitting(usual) else usual)

    def _judged(self, person: Person) -> tuple[Ints, Ints, Bools, Bools]:
        """Rows of the feet and areas (N,) of regions, which fit the heights of people, and which contradict them."""
        x, y, w, h, area = np.concatenate([*self._seen, np.empty((0, 5), np.int64)]).T
        height, width = self._size
        is_cut = (x <= 1) | (y <= 1) | (x + w >= width - 1) | (y + h >= height - 1)
        expected = person.heights(y + h)
        fits = (np.abs(h - expected) < _FITS * expected) & (w <= h)
        contradicts = is_too_tall(h, expected) & (w <= np.where(is_cut, _CUT_WIDTH, 1.0) * h)
        return y + h, area, fits, contradicts & (area >= _LEAST_FILL * w * h)

    def _fitting(self, person: Person | None) -> float:
        """Sum the square roots of the areas of regions that fit the heights of people, in pixels."""
        if person is None:
            return 0.0
        _, area, fits, _ = self._judged(person)
        return float(np.sqrt(area[fits]).sum())

    def _checked(self, person: Person | None) -> Person | None:
        """The appearance of people, with the rows where their heights hold; None if the shape isn't one of people."""
        if person is None or person.template.sum() < _LEAST_WIDTH * ROWS**2:
            return None
        foot, area, fits, contradicts = self._judged(person)
        rows = self._size[0] + 1
        balance = np.bincount(foot[fits], area[fits], rows) - np.bincount(foot[contradicts], area[contradicts], rows)
        around = round(_AROUND * rows)
        total = np.cumsum(np.pad(balance, (around + 1, around)))
        fitting, contradicting = int(area[fits].sum()), int(area[contradicts].sum())
        share = contradicting / max(fitting + contradicting, 1)
        return replace(person, rows=total[2 * around + 1 :] > total[: -2 * around - 1], contradicted=share)


class _Sample:
    """Regions of masks that may be people of about one height."""

    def __init__(self) -> None:
        self._boxes: list[tuple[int, int, int, int, int]] = []
        self._cuts: list[Image] = []

    def copy(self) -> _Sample:
        """A copy, to which regions can be added independently."""
        other = _Sample()
        other._boxes, other._cuts = [*self._boxes], [*self._cuts]
        return other

    def add(self, mask: Image, person_px: float) -> Ints:
        """Take the regions of a mask in which people are about ``person_px`` tall; returns all regions (N, 5)."""
        picture_px, width = mask.shape
        labels, boxes = regions(mask, odd(JOIN * person_px))
        for number, (x, y, w, h, area) in enumerate(boxes.tolist(), start=1):
            is_cut = x <= 1 or y <= 1 or x + w >= width - 1 or y + h >= picture_px - 1
            if is_cut or area < max(MIN_AREA_PX, MIN_AREA * person_px**2) or len(self._boxes) >= _MAX_REGIONS:
                continue
            own = (labels[y : y + h, x : x + w] == number) & (mask[y : y + h, x : x + w] > 0)
            self._boxes.append((x, y, w, h, area))
            self._cuts.append(_scaled(own))
        return boxes

    def person(self, picture_px: int) -> Person | None:
        """The appearance of people in a picture of this height; None if too few regions are alike."""
        if len(self._boxes) < _MIN_REGIONS:
            return None
        _, y, w, h, area = np.array(self._boxes, np.float64).T
        foot = y + h
        slope, level = _fit_height(foot, h, np.sqrt(area), picture_px)
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
    first, two = rng.integers(0, len(foot), (2, _DRAWS))
    apart = foot[two] - foot[first]
    is_apart = np.abs(apart) > _MIN_SPREAD * picture_px
    slope = np.where(is_apart, (height[two] - height[first]) / np.where(is_apart, apart, 1.0), 0.0)
    slope = np.maximum(slope, 0.0)  # who is farther away is not taller
    level = height[first] - slope * foot[first]
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
