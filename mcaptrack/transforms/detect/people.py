"""Separate people within the regions of a foreground mask, by the height and shape that people have in the scene.

A region that is taller or wider than one person is explained by as few people as raise the likelihood of its mask
enough: greedily, each place being looked for again when another person is added. People with too little in sight for
a box of their own are counted in the box of the person who hides them.

Work is bounded by the pixels of the picture, whatever height is expected. It is counted in pixels of filtered crops;
regions that would exceed the budget of a picture, need more people than a group has, or contradict the heights where
they stand, are one box.

Letters: N boxes (x, y, w, h).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools, Floats, Image, Ints

#: A region of one person is at most this much taller and wider than expected.
_TALL: Final = 1.25
_WIDE: Final = 1.6
#: A region less tall than this may be a part of a person behind something; parts are joined over these distances.
_PART: Final = 0.7
_PART_GAP: Final = 0.4
_PART_ASIDE: Final = 0.05
_PARTS_TALL: Final = 1.2
#: The probability of foreground where no person is.
_CLUTTER: Final = 0.03
_MAX_PROBABILITY: Final = 0.97
#: People explain a region if their shapes overlap with it by at least this share of both.
_EXPLAINED: Final = 0.5
_ROUNDS: Final = 3
#: The share of a person, in log-likelihood, that must be seen to be counted.
_COUNTED: Final = 0.3
#: The work for a picture is at most this many pixels plus twice its own. Places are looked for again as long
#: as half of it is left. Ordinary scenes take a tenth to a fifth of it.
_LEAST_WORK: Final = 200_000
_PASSES: Final = 2
#: What a region costs in addition to its filtered pixels, in pixels.
_REGION_WORK: Final = 5_000
#: A region that more people would have to fill is not separated: its outline couldn't tell them apart.
_MOST_PEOPLE: Final = 32
#: More regions in a picture than this are noise, such as rain: they are not compared with each other.
_MOST_PARTS: Final = 500
#: A region with this share of its box inside the box of something large is a part of it.
_INSIDE: Final = 0.8

#: x, y, w, h of a box, and the number of people in it; 0 if unknown.
_Counted = tuple[float, float, float, float, int]
#: Column and row of the feet of a person in a crop.
_Place = tuple[int, int]


# The appearance of people in a scene: their height over the row of the feet, and their shape.
#
# The height is learned as a line over the row of the feet, from regions of a foreground mask that stand alone; the
# shape is the mean of these regions, scaled to one height: the probability that a pixel belongs to a person who
# stands there.
#
# The line is not right everywhere: a person close to a low camera is ten times as tall as those far away, and their
# feet are out of the picture. Regions that are too tall for the line and shaped like one person contradict it;
# where they cover more pixels than the regions that fit, the line does not hold.
#
# Letters: N regions or boxes (x, y, w, h); T rows of a template, C its columns.


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


class Separator:
    """Boxes of people in masks, and how many people each holds.

    ``least_visible`` is the share of a person, in log-likelihood, that must be seen for a box of their own.
    """

    def __init__(self, person: Person, least_visible: float) -> None:
        self._person = person
        shape = np.clip(person.template, 0.0, _MAX_PROBABILITY)
        self._shape, self._columns = shape, shape.shape[1]
        # Log-likelihood that a person adds: at pixels of the foreground, and at those of the background.
        self._hit = np.log((_CLUTTER + (1 - _CLUTTER) * shape) / _CLUTTER).astype(np.float32)
        self._miss = np.log1p(-shape).astype(np.float32)
        whole = float((shape * self._hit + (1 - shape) * self._miss).sum())
        self._least, self._counted = least_visible * whole, min(least_visible, _COUNTED) * whole
        wide = np.flatnonzero(shape.max(axis=0) > 0.35)
        self._half = (wide[-1] - wide[0] + 1) / 2 if len(wide) else self._columns / 4
        self._anchor = (self._columns // 2, ROWS - 1)
        self._work, self._most_work = 0, 0

    def boxes(self, mask: Image) -> tuple[Floats, Ints]:
        """Boxes (N, 4) of people in a mask, and the number of people in each (N,); 0 if unknown."""
        import cv2

        height, width = mask.shape
        join_px = odd(JOIN * self._person.height(0.6 * height))
        x, y, w, h = cv2.boundingRect(mask)  # all that follows costs time for each pixel
        if not w:
            return np.empty((0, 4)), np.empty(0, np.int64)
        labels, stats = regions(np.ascontiguousarray(mask[y : y + h, x : x + w]), join_px)
        is_member = np.zeros(len(stats) + 1, np.bool_)
        numbers = np.flatnonzero(stats[:, 4] >= MIN_AREA_PX)
        stats = stats[numbers] + (x, y, 0, 0, 0)
        expected = self._person.heights(stats[:, 1] + stats[:, 3])
        is_large = stats[:, 4] >= MIN_AREA * expected**2
        numbers, stats, expected = numbers[is_large], stats[is_large], expected[is_large]
        large, is_rest = self._contradicting(stats, expected)
        numbers, stats, expected = numbers[is_rest], stats[is_rest], expected[is_rest]
        alone, groups = _joined_parts(stats, expected)
        is_one = self._is_one(stats[alone, 2], stats[alone, 3], expected[alone])
        groups += [np.array([at]) for at in alone[~is_one]]
        lone, tall = stats[alone[is_one]], expected[alone[is_one]]
        is_cut = (lone[:, :2] <= 1).any(axis=1) | (lone[:, :2] + lone[:, 2:4] >= (width - 1, height - 1)).any(axis=1)
        is_seen = is_cut | (lone[:, 4] >= 3 * MIN_AREA * tall**2) | (lone[:, 3] >= 0.5 * tall)
        boxes: list[_Counted] = []
        self._begin(mask)
        groups.sort(key=lambda members: int(stats[members, 4].sum()))  # one large region must not use up the work
        for members in groups:
            some = stats[members]
            x0, y0 = some[:, :2].min(axis=0).tolist()
            x1, y1 = (some[:, :2] + some[:, 2:4]).max(axis=0).tolist()
            is_member[numbers[members] + 1] = True
            region = is_member[labels[y0 - y : y1 - y, x0 - x : x1 - x]] & (mask[y0:y1, x0:x1] > 0)
            is_member[numbers[members] + 1] = False
            boxes.extend(self._separate(region, x0, y0, (width, height)))
        separated = np.array(boxes, np.float64).reshape(-1, 5)
        out = np.concatenate([np.insert(lone[is_seen, :4], 4, 1, axis=1), large, separated])
        return out[:, :4], out[:, 4].astype(np.int64)

    def _contradicting(self, boxes: Ints, expected: Floats) -> tuple[Ints, Bools]:
        """Boxes and counts (M, 5) of regions (N, 5) too tall for people of their height; and a mask of the others.

        What lies inside of the box of such a region, such as a shoe or a bag, is a part of it and no person beside it.
        The second array (N,) is false for both.
        """
        is_large = is_too_tall(boxes[:, 3], expected) & ~self._person.holds(boxes[:, 1] + boxes[:, 3])
        large, is_rest = boxes[is_large], ~is_large
        for x, y, w, h in large[:, :4].tolist():
            wide = np.minimum(boxes[:, 0] + boxes[:, 2], x + w) - np.maximum(boxes[:, 0], x)
            high = np.minimum(boxes[:, 1] + boxes[:, 3], y + h) - np.maximum(boxes[:, 1], y)
            shared = np.maximum(wide, 0) * np.maximum(high, 0)
            is_rest &= shared < _INSIDE * boxes[:, 2] * boxes[:, 3]
        count = (large[:, 2] <= large[:, 3]).astype(np.int64)  # who is wider than tall may be anything
        return np.column_stack([large[:, :4], count]), is_rest

    def counts(self, mask: Image, boxes: Floats) -> Ints:
        """Count the people in each box (N, 4) around a region of a mask, (N,); 0 if unknown."""
        size = (mask.shape[1], mask.shape[0])
        x, y, w, h = boxes.astype(np.int64).reshape(-1, 4).T
        expected = self._person.heights(y + h)
        is_one = self._is_one(w, h, expected)
        out = is_one.astype(np.int64)
        contradicts = is_too_tall(h, expected) & ~self._person.holds(y + h)
        out[contradicts] = w[contradicts] <= h[contradicts]
        self._begin(mask)
        rest = np.flatnonzero(~is_one & ~contradicts)
        for at in rest[np.argsort((w * h)[rest], kind="stable")].tolist():
            region = mask[y[at] : y[at] + h[at], x[at] : x[at] + w[at]] > 0
            explained = self._explained(region, int(x[at]), int(y[at]), size)
            if explained and explained.is_by_people:
                out[at] = len(explained.people) + len(explained.hidden)
        return out

    def _is_one(self, wide: Ints, high: Ints, tall: Floats) -> Bools:
        """Which regions are no larger than a person of this height."""
        return np.asarray((high <= _TALL * tall) & (wide <= 2 * _WIDE * self._half / ROWS * tall), np.bool_)

    def _begin(self, mask: Image) -> None:
        """Begin to count the work for a picture."""
        self._work, self._most_work = 0, _LEAST_WORK + _PASSES * mask.size

    def _explained(self, region: Bools, x0: int, y0: int, size: tuple[int, int]) -> _Explanation | None:
        """The people who explain a region of a picture of this size (width, height), at x0, y0.

        None if they would be more than a group has, or if looking for them exceeds the work for a picture.
        """
        h = region.shape[0]
        tall = self._person.height(y0 + h)
        scale = ROWS / self._person.height(y0 + h - max(h - tall, 0) / 4)
        self._work += _REGION_WORK
        pixels = float(np.prod(np.multiply(region.shape, scale) + np.array([ROWS, self._columns])))
        is_group = np.count_nonzero(region) * scale**2 <= _MOST_PEOPLE * self._shape.sum()
        if not is_group or self._work + 3 * pixels > self._most_work:
            return None
        crop = _Crop(region, scale, (self._columns // 2 + 1, ROWS // 2))
        ink = crop.ink
        unknown = crop.beyond(x0, y0, size)
        paper = self._filter(np.where(unknown, np.float32(0), 1 - ink), self._miss)
        places = self._places(ink, paper)
        if places is None:
            return None
        people, hidden = places
        drawn = np.zeros((len(people), *ink.shape), np.float32)
        for layer, place in zip(drawn, people, strict=True):
            where, shape = self._patch(place, ink.shape)
            layer[where] = shape
        cover = drawn.max(axis=0, initial=0.0)
        both = np.count_nonzero((cover > 0.4) & (ink > 0.5))
        either = np.count_nonzero((cover > 0.4) | (ink > 0.5))
        return _Explanation(crop, people, hidden, drawn, bool(people) and bool(both >= _EXPLAINED * either))

    def _separate(self, region: Bools, x0: int, y0: int, size: tuple[int, int]) -> Iterator[_Counted]:
        """Boxes of the people in a region of a picture of this size (width, height), at x0, y0."""
        h, w = region.shape
        tall = self._person.height(y0 + h)
        explanation = self._explained(region, x0, y0, size)
        if explanation is None:
            yield x0, y0, w, h, 0
            return
        crop, people, hidden, drawn, is_by_people = explanation
        if not is_by_people:
            is_plausible = (0.4 * tall <= h <= 1.5 * tall and w < tall) or h * w > 4 * self._half / ROWS * tall**2
            if people or is_plausible:
                yield x0, y0, w, h, 0
            return
        ink, cover = crop.ink, drawn.max(axis=0)
        count = np.ones(len(people), np.int64)
        for place in hidden:
            count[np.argmin(np.linalg.norm(np.subtract(people, place), axis=1))] += 1
        owner, is_ink = drawn.argmax(axis=0), (ink > 0.5) & (cover > 0.1)
        body = 0.3 * np.count_nonzero(self._shape > 0.5)
        for number, (column, row) in enumerate(people):
            left, right = column - self._half, column + self._half
            own = np.nonzero(is_ink & (owner == number))[1]
            if len(own) >= body:
                own = np.sort(own)
                left, right = (left + _quantile(own, 0.03)) / 2, (right + _quantile(own, 0.97) + 1) / 2
            a, b = crop.to_picture(left, row - ROWS + 1)
            c, d = crop.to_picture(right, row + 1)
            a, b, c, d = max(a + x0, 0), max(b + y0, 0), min(c + x0, size[0]), min(d + y0, size[1])
            if c > a and d > b:
                yield a, b, c - a, d - b, int(count[number])

    def _places(self, ink: Map, paper: Map) -> tuple[list[_Place], list[_Place]] | None:
        """Column and row of the feet of the people who explain the ink, and of those who are counted only.

        None if that exceeds the work for a picture.
        """
        people: list[_Place] = []
        most = min(int(np.ceil(ink.sum() / (0.4 * self._shape.sum()))) + 1, 2 * _MOST_PEOPLE)
        while len(people) < most:
            if self._work + ink.size > self._most_work:
                return None
            place, gain = self._best(ink, paper, people)
            if gain < self._least:
                return people, self._hidden(ink, paper, people, place, gain)
            people.append(place)
            for _ in range(_ROUNDS if len(people) > 1 else 0):
                if not self._is_affordable(ink, people):
                    break
                before = list(people)
                for at in range(len(people)):
                    people[at] = self._best(ink, paper, people[:at] + people[at + 1 :])[0]
                if people == before:
                    break
            if not self._is_affordable(ink, people):
                continue
            gains = [
                float(self._gains(ink, paper, people[:at] + people[at + 1 :])[row, column])
                for at, (column, row) in enumerate(people)
            ]
            if min(gains) < self._least:
                place = people.pop(int(np.argmin(gains)))
                return people, [place] if min(gains) >= self._counted and people else []
        return people, []

    def _is_affordable(self, ink: Map, people: Sequence[_Place]) -> bool:
        """Whether half of the work for a picture is enough to look at each person once more."""
        return self._work + len(people) * ink.size <= self._most_work // 2

    def _hidden(self, ink: Map, paper: Map, people: Sequence[_Place], place: _Place, gain: float) -> list[_Place]:
        """Places of people with too little in sight for a box; ``place`` is the likeliest, with its ``gain``."""
        hidden: list[_Place] = []
        while gain >= self._counted and len(hidden) < len(people) and self._work + ink.size <= self._most_work:
            hidden.append(place)
            place, gain = self._best(ink, paper, [*people, *hidden])
        return hidden

    def _best(self, ink: Map, paper: Map, others: Sequence[_Place]) -> tuple[_Place, float]:
        """The best place of another person, and the log-likelihood that is gained."""
        gains = self._gains(ink, paper, others)
        row, column = divmod(int(gains.argmax()), gains.shape[1])
        return (column, row), float(gains[row, column])

    def _gains(self, ink: Map, paper: Map, others: Sequence[_Place]) -> Map:
        """The log-likelihood that a person adds at each place, beside others."""
        left = ink.copy()
        for place in others:
            where, shape = self._patch(place, ink.shape)
            left[where] *= 1 - shape
        return self._filter(left, self._hit) + paper

    def _filter(self, image: Map, kernel: Map) -> Map:
        import cv2

        self._work += image.size
        return np.asarray(
            cv2.filter2D(image, -1, kernel, anchor=self._anchor, borderType=cv2.BORDER_CONSTANT), np.float32
        )

    def _patch(self, place: _Place, size: tuple[int, ...]) -> tuple[tuple[slice, slice], Map]:
        """Where a person's shape lies in a crop, and the part of the shape that lies there."""
        x, y = place[0] - self._columns // 2, place[1] - ROWS + 1
        x0, x1, y0, y1 = max(x, 0), min(x + self._columns, size[1]), max(y, 0), min(y + ROWS, size[0])
        return (slice(y0, y1), slice(x0, x1)), self._shape[y0 - y : y1 - y, x0 - x : x1 - x]


def _quantile(ordered: Ints, share: float) -> float:
    """The quantile of ordered values, as ``numpy.quantile`` interpolates it; that one takes ten times as long."""
    at = (len(ordered) - 1) * share
    low, rest = int(at), at - int(at)
    below, above = int(ordered[low]), int(ordered[min(low + 1, len(ordered) - 1)])
    return below + (above - below) * rest if rest < 0.5 else above - (above - below) * (1 - rest)


class _Crop:
    """A region with a margin (columns, rows), scaled so that people are as tall as templates."""

    def __init__(self, region: Bools, scale: float, margin: tuple[int, int]) -> None:
        import cv2

        self._scale, self._margin = scale, margin
        columns, rows = (int(np.ceil(n * scale)) + 2 * m for n, m in zip(region.shape[::-1], margin, strict=True))
        ink = region.astype(np.float32)
        if scale < 0.7:
            ink = np.asarray(cv2.blur(ink, (odd(1 / scale),) * 2, borderType=cv2.BORDER_CONSTANT), np.float32)
        # Pixels are areas: the middle of the first one lies half a pixel from the edge, at any scale.
        middle = (scale - 1) / 2
        matrix = np.array([[scale, 0, margin[0] + middle], [0, scale, margin[1] + middle]])
        #: How much of each pixel is foreground, 0 to 1.
        self.ink: Map = np.asarray(cv2.warpAffine(ink, matrix, (columns, rows), flags=cv2.INTER_LINEAR), np.float32)

    def to_picture(self, column: float, row: float) -> tuple[float, float]:
        """A point of the crop, in pixels from the corner of the region."""
        return (column - self._margin[0]) / self._scale, (row - self._margin[1]) / self._scale

    def beyond(self, x0: int, y0: int, size: tuple[int, int]) -> Bools:
        """Mask the part outside of the picture, of which nothing is known; the region's corner is at x0, y0."""
        rows, columns = self.ink.shape
        x = x0 + (np.arange(columns) + 0.5 - self._margin[0]) / self._scale
        y = y0 + (np.arange(rows) + 0.5 - self._margin[1]) / self._scale
        outside: Bools = ((y < 0) | (y > size[1]))[:, None] | ((x < 0) | (x > size[0]))
        return outside


class _Explanation(NamedTuple):
    """People who explain a region: those with boxes of their own, and those who are only counted.

    ``drawn`` (people, rows, columns) are shapes in the crop. ``is_by_people``: whether the region looks like them.
    """

    crop: _Crop
    people: list[_Place]
    hidden: list[_Place]
    drawn: Map
    is_by_people: bool


def _joined_parts(boxes: Ints, expected: Floats) -> tuple[Ints, list[Ints]]:
    """Regions (N, 5) that stand alone, and groups of those that may be parts of a person behind something."""
    count = len(boxes)
    is_part = boxes[:, 3] < _PART * expected
    if count < 2 or count > _MOST_PARTS or not is_part.any():
        return np.arange(count), []
    x0, y0 = boxes[:, 0], boxes[:, 1]
    x1, y1 = x0 + boxes[:, 2], y0 + boxes[:, 3]
    aside, gap = _PART_ASIDE * expected, _PART_GAP * expected
    beside = ((x0 - aside)[:, None] < x1) & (x0 < (x1 + aside)[:, None])
    above = ((y0 - gap)[:, None] < y1) & (y0 < (y1 + gap)[:, None])
    tall = np.maximum(y1[:, None], y1) - np.minimum(y0[:, None], y0)
    is_one = tall <= _PARTS_TALL * np.maximum(expected[:, None], expected)
    near = beside & above & is_one & (is_part[:, None] | is_part)
    near |= near.T
    np.fill_diagonal(near, False)
    has_near = near.any(axis=1)
    some, near = np.flatnonzero(has_near), near[has_near][:, has_near]
    group = np.arange(len(some))
    while len(some):  # each takes the lowest number of those near it, until that changes nothing
        lowest = np.minimum(group, np.where(near, group, len(some)).min(axis=1))
        if (lowest == group).all():
            break
        group = lowest[lowest]
    return np.flatnonzero(~has_near), [some[group == first] for first in np.unique(group)]
