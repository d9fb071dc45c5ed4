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
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Image, Ints
from mcaptrack.transforms.detect.person_model import (
    JOIN,
    MIN_AREA,
    MIN_AREA_PX,
    ROWS,
    Map,
    Person,
    is_too_tall,
    odd,
    regions,
)

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
