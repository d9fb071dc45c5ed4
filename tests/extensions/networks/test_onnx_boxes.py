"""Pictures in the input of a network and boxes back, tiles and their seams, and suppression: against slow references."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.extensions.networks.nms import Boxes, join_tiles, place, suppress, tiles_of

SEEDS = st.integers(0, 2**32 - 1)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    wide, high = (min(a[k + 2], b[k + 2]) - max(a[k], b[k]) for k in (0, 1))
    inner = max(wide, 0) * max(high, 0)
    return inner / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - inner)


def greedy(boxes: Boxes, most: float) -> list[int]:
    """The textbook's suppression, one box after the other; the indices of those that are kept."""
    left = sorted(range(len(boxes.score)), key=lambda n: (-boxes.score[n], boxes.xyxy[n, 1], boxes.xyxy[n, 0]))
    kept = []
    while left:
        best = left.pop(0)
        kept.append(best)
        left = [
            n for n in left if boxes.label[n] != boxes.label[best] or overlap(boxes.xyxy[n], boxes.xyxy[best]) <= most
        ]
    return kept


def some_boxes(rng: np.random.Generator, count: int, classes: int = 2) -> Boxes:
    low = rng.uniform(0, 100, (count, 2))
    size = rng.uniform(5, 60, (count, 2))
    return Boxes(np.hstack([low, low + size]), rng.uniform(0, 1, count).round(2), rng.integers(0, classes, count))


@given(seed=SEEDS, count=st.integers(0, 60), most=st.floats(0.05, 0.95))
@settings(max_examples=60, deadline=None)
def test_suppression_keeps_what_the_textbook_keeps(seed, count, most):
    boxes = some_boxes(np.random.default_rng(seed), count)
    assert suppress(boxes, most).xyxy.tolist() == boxes.xyxy[greedy(boxes, most)].tolist()


def bilinear(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """A picture at another size: between the four nearest pixels, whose centres are at halves."""
    out = np.zeros((height, width, 3))
    for row in range(height):
        for column in range(width):
            y = min(max((row + 0.5) * image.shape[0] / height - 0.5, 0), image.shape[0] - 1)
            x = min(max((column + 0.5) * image.shape[1] / width - 0.5, 0), image.shape[1] - 1)
            y0, x0 = int(y), int(x)
            y1, x1 = min(y0 + 1, image.shape[0] - 1), min(x0 + 1, image.shape[1] - 1)
            top = image[y0, x0] * (1 - x + x0) + image[y0, x1] * (x - x0)
            low = image[y1, x0] * (1 - x + x0) + image[y1, x1] * (x - x0)
            out[row, column] = top * (1 - y + y0) + low * (y - y0)
    return out


@given(seed=SEEDS, fit=st.sampled_from(["corner", "centre", "stretch"]), data=st.data())
@settings(max_examples=25, deadline=None)
def test_a_picture_fills_the_input_or_keeps_its_proportions(seed, fit, data):
    wide, high, w, h = (data.draw(st.integers(8, 40)) for _ in range(4))
    x1, y1 = data.draw(st.integers(0, 5)), data.draw(st.integers(0, 5))
    image = np.random.default_rng(seed).integers(0, 256, (h + y1, w + x1, 3)).astype(np.uint8)
    canvas, placement = place(image, (x1, y1, x1 + w, y1 + h), (wide, high), fit, 114)
    ratio = min(wide / w, high / h)
    inner = (wide, high) if fit == "stretch" else (max(1, round(w * ratio)), max(1, round(h * ratio)))
    left, top = ((wide - inner[0]) // 2, (high - inner[1]) // 2) if fit == "centre" else (0, 0)
    expected = np.full((high, wide, 3), 114.0)
    expected[top : top + inner[1], left : left + inner[0]] = bilinear(image[y1:, x1:].astype(float), *inner)
    assert canvas.shape == expected.shape
    assert np.abs(canvas - expected).max() <= 1.5
    corners = np.array([[left, top, left + inner[0], top + inner[1]]], float)
    np.testing.assert_allclose(placement.to_picture(corners), [[x1, y1, x1 + w, y1 + h]], atol=1e-9)


@given(
    width=st.integers(20, 400),
    height=st.integers(20, 400),
    columns=st.integers(1, 5),
    rows=st.integers(1, 5),
    overlap=st.floats(0, 0.5),
)
@settings(max_examples=60, deadline=None)
def test_tiles_cover_the_picture_and_share_what_they_should(width, height, columns, rows, overlap):
    tiles = tiles_of(width, height, columns, rows, overlap)
    assert len(tiles) == columns * rows
    covered = np.zeros((height, width), bool)
    for x1, y1, x2, y2 in tiles:
        assert 0 <= x1 < x2 <= width
        assert 0 <= y1 < y2 <= height
        covered[y1:y2, x1:x2] = True
    assert covered.all()
    assert len({(x2 - x1, y2 - y1) for x1, y1, x2, y2 in tiles}) == 1
    for (_, _, x2, _), (x1, _, _, _) in pairwise(tiles[:columns]):
        assert x2 - x1 >= overlap * (tiles[0][2] - tiles[0][0]) - 1


#: Two tiles of a picture of 180 x 100, which share 80 to 100.
LEFT, RIGHT = (0, 0, 100, 100), (80, 0, 180, 100)


def joined(left: list[tuple], right: list[tuple], labels: tuple[int, int] = (0, 0)) -> list[list[float]]:
    parts = [
        Boxes(
            np.array([one[:4] for one in some], float).reshape(-1, 4),
            np.array([one[4] for one in some]),
            np.full(len(some), label),
        )
        for some, label in zip((left, right), labels, strict=True)
    ]
    found = join_tiles(parts, [LEFT, RIGHT], 0.6)
    return [[*box, score] for box, score in zip(found.xyxy.tolist(), found.score.tolist(), strict=True)]


@pytest.mark.parametrize(
    ("left", "right", "expected"),
    [
        # whole in both tiles: once
        ([(86, 10, 94, 40, 0.8)], [(86, 10, 94, 41, 0.7)], [[86, 10, 94, 40, 0.8]]),
        # cut off by the left tile's edge, whole in the right one: the whole one, with the better score
        ([(88, 10, 100, 40, 0.9)], [(88, 10, 118, 40, 0.6)], [[88, 10, 118, 40, 0.9]]),
        # wider than what the tiles share, cut off in both: one box of both parts
        ([(60, 10, 100, 40, 0.6)], [(80, 11, 130, 41, 0.7)], [[60, 10, 130, 41, 0.7]]),
        # two people at the seam, of whom one stands above the other: both
        ([(70, 10, 100, 40, 0.6)], [(80, 50, 110, 80, 0.7)], [[80, 50, 110, 80, 0.7], [70, 10, 100, 40, 0.6]]),
        # two people side by side, whole in one tile each: both
        ([(60, 10, 79, 40, 0.6)], [(101, 10, 120, 40, 0.7)], [[101, 10, 120, 40, 0.7], [60, 10, 79, 40, 0.6]]),
        # cut off at the edge of the picture, which is no seam
        ([(0, 10, 20, 40, 0.6)], [(160, 10, 180, 40, 0.7)], [[160, 10, 180, 40, 0.7], [0, 10, 20, 40, 0.6]]),
        ([], [(150, 10, 160, 40, 0.7)], [[150, 10, 160, 40, 0.7]]),
        ([], [], []),
    ],
)
def test_boxes_of_tiles_are_joined_across_the_seam(left, right, expected):
    assert joined(left, right) == expected


def test_boxes_of_two_classes_are_never_joined():
    assert len(joined([(60, 10, 100, 40, 0.6)], [(80, 11, 130, 41, 0.7)], (0, 1))) == 2


def seen_in_tiles(people: np.ndarray, tiles: list[tuple[int, int, int, int]]) -> list[Boxes]:
    """What a perfect detector finds in each tile: the visible part of each person of whom a third or more is there."""
    parts = []
    for tile in tiles:
        xyxy = np.hstack([np.maximum(people[:, :2], tile[:2]), np.minimum(people[:, 2:], tile[2:])])
        visible = np.prod(np.maximum(xyxy[:, 2:] - xyxy[:, :2], 0), axis=1) / np.prod(
            people[:, 2:] - people[:, :2], axis=1
        )
        some = visible >= 0.35
        parts.append(Boxes(xyxy[some], 0.4 + visible[some] / 2, np.zeros(some.sum(), int)))
    return parts


def crowd(rng: np.random.Generator, size: tuple[int, int], most_iou: float) -> np.ndarray:
    """People anywhere in a picture, who overlap one another by ``most_iou`` at most."""
    people: list[np.ndarray] = []
    for _ in range(40):
        wide = rng.uniform(25, 90)
        shape = np.array([wide, wide * rng.uniform(2, 3)])
        low = rng.uniform(0, np.array(size) - shape)
        box = np.concatenate([low, low + shape])
        if all(overlap(box, other) <= most_iou for other in people):
            people.append(box)
    return np.array(people)


def lost_and_added(people: np.ndarray, found: np.ndarray) -> tuple[int, int]:
    """How many people have no box, and how many boxes are no person or a second one."""
    same = np.array([[overlap(one, box) > 0.8 for box in found] for one in people])
    return int((~same.any(axis=1)).sum()), len(found) - int(same.any(axis=1).sum())


@given(seed=SEEDS, grid=st.sampled_from([(3, 2), (2, 3), (1, 4)]), overlap_of_tiles=st.sampled_from([0.1, 0.2, 0.4]))
@settings(max_examples=20, deadline=None)
def test_people_apart_from_one_another_have_one_box_each_wherever_seams_are(seed, grid, overlap_of_tiles):
    people = crowd(np.random.default_rng(seed), (1400, 1000), 0.0)
    tiles = tiles_of(1400, 1000, *grid, overlap_of_tiles)
    assert lost_and_added(people, join_tiles(seen_in_tiles(people, tiles), tiles, 0.45).xyxy) == (0, 0)


def test_people_who_hide_one_another_at_a_seam_are_kept():
    tiles = tiles_of(1400, 1000, 3, 2, 0.2)
    scenes = [crowd(np.random.default_rng(seed), (1400, 1000), 0.4) for seed in range(8)]
    counts = [lost_and_added(people, join_tiles(seen_in_tiles(people, tiles), tiles, 0.45).xyxy) for people in scenes]
    assert sum(map(len, scenes)) > 200
    assert np.sum(counts, axis=0).tolist() == [0, 0]
