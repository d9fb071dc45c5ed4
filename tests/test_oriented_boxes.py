"""Overlap of boxes with a heading, against OpenCV, polygons that are clipped one by one, and numbers by hand."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from mcaptrack.geometry.boxes import (
    bev_corners,
    bev_intersection_of_pairs,
    bev_iou_of_pairs,
    iou_3d_of_pairs,
)

COUNT = 400


def drawn(seed: int, count: int = COUNT) -> np.ndarray:
    rng = np.random.default_rng(seed)
    headings = np.where(rng.random(count) < 0.3, rng.integers(-4, 5, count) * math.pi / 4, rng.uniform(-4, 4, count))
    return np.column_stack(
        [rng.uniform(-3, 3, (count, 2)), rng.uniform(-1, 1, count), rng.uniform(0.2, 5, (count, 3)), headings]
    )


def box(x=0.0, y=0.0, z=0.0, length=4.0, width=2.0, height=1.5, heading=0.0) -> np.ndarray:
    return np.array([[x, y, z, length, width, height, heading]])


def clipped(subject: np.ndarray, clip: np.ndarray) -> float:
    """The area that two convex polygons share, counter-clockwise: cut off side by side (Sutherland, Hodgman)."""
    points = [tuple(point) for point in subject]
    for a, b in zip(clip, np.roll(clip, -1, axis=0), strict=True):
        side = [(b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) for x, y in points]
        out = []
        for here, there, s, e in zip(points, points[1:] + points[:1], side, side[1:] + side[:1], strict=True):
            if s >= 0:
                out.append(here)
            if (s >= 0) != (e >= 0):
                share = s / (s - e)
                out.append((here[0] + share * (there[0] - here[0]), here[1] + share * (there[1] - here[1])))
        points = out
        if not points:
            return 0.0
    return abs(sum(x * v - y * u for (x, y), (u, v) in zip(points, points[1:] + points[:1], strict=True))) / 2


def test_shared_areas_are_those_of_clipped_polygons_and_of_opencv():
    a, b = drawn(1), drawn(2)
    found = bev_intersection_of_pairs(a, b)
    slow = [clipped(p, r) for p, r in zip(bev_corners(a), bev_corners(b), strict=True)]
    np.testing.assert_allclose(found, slow, atol=1e-9)
    assert 0.2 < (found > 0).mean() < 0.9

    def opencv(one, other):
        both = [((c[0], c[1]), (c[3], c[4]), math.degrees(c[6])) for c in (one, other)]
        corners = cv2.rotatedRectangleIntersection(*both)[1]
        return 0.0 if corners is None else cv2.contourArea(cv2.convexHull(corners))

    np.testing.assert_allclose(found, [opencv(p, r) for p, r in zip(a, b, strict=True)], atol=2e-3)


@pytest.mark.parametrize("iou", [bev_iou_of_pairs, iou_3d_of_pairs])
def test_laws(iou):
    a, b = drawn(3), drawn(4)
    found = iou(a, b)
    assert 0 < found.max() < 1
    np.testing.assert_allclose(iou(b, a), found, atol=1e-12)
    np.testing.assert_allclose(iou(a, a), 1, atol=1e-12)
    half_turn = a + [0, 0, 0, 0, 0, 0, math.pi]
    np.testing.assert_allclose(iou(half_turn, b), found, atol=1e-12)
    across = a[:, [0, 1, 2, 4, 3, 5, 6]] + [0, 0, 0, 0, 0, 0, math.pi / 2]
    np.testing.assert_allclose(iou(across, b), found, atol=1e-12)
    cos, sin = math.cos(0.7), math.sin(0.7)

    def elsewhere(boxes):
        x, y = boxes[:, 0], boxes[:, 1]
        moved = boxes + [5000, -2000, 60, 0, 0, 0, 0.7]
        moved[:, 0], moved[:, 1] = cos * x - sin * y + 5000, sin * x + cos * y - 2000
        return moved

    np.testing.assert_allclose(iou(elsewhere(a), elsewhere(b)), found, atol=1e-9)


@pytest.mark.parametrize("iou", [bev_iou_of_pairs, iou_3d_of_pairs])
def test_boxes_that_touch_are_empty_or_have_missing_columns_share_nothing(iou):
    pairs = [
        (box(), box(x=4)),
        (box(), box(y=2)),
        (box(heading=1), box(x=100)),
        (box(length=0), box()),
        (box(length=0), box(length=0)),
        (box(heading=np.nan), box()),
        (box(), box(width=np.nan)),
    ]
    for a, b in pairs:
        assert iou(a, b)[0] == pytest.approx(0, abs=1e-12), (a, b)
    assert iou(np.empty((0, 7)), np.empty((0, 7))).shape == (0,)
    assert iou_3d_of_pairs(box(), box(z=1.5))[0] == 0
    assert bev_iou_of_pairs(box(), box(z=1.5))[0] == 1
