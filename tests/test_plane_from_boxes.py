"""Ground planes that are estimated from boxes, against cameras whose pictures are computed here, by another route."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.plane_from_boxes import PlaneFit, plane_from_boxes, whole_people
from tests.tiers import thorough

WIDTH, HEIGHT = 1280, 720


class View:
    """A camera ``high`` metres above the origin; x is to the right of it, y away from it, z up."""

    def __init__(self, high: float, pitch_deg: float, focal: float = 1.0, roll_deg: float = 0.0) -> None:
        a, r = np.deg2rad(pitch_deg), np.deg2rad(roll_deg)
        down = np.array([[1, 0, 0], [0, -np.sin(a), -np.cos(a)], [0, np.cos(a), -np.sin(a)]])  # to right, down, ahead
        turn = np.array([[np.cos(r), np.sin(r), 0], [-np.sin(r), np.cos(r), 0], [0, 0, 1]])
        camera = np.diag([focal * WIDTH, focal * WIDTH, 1.0])
        camera[:2, 2] = WIDTH / 2, HEIGHT / 2
        self.matrix = camera @ turn @ down
        self.high = high

    def pixels(self, xyz: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of points (N, 3) in metres; NaN behind the camera."""
        u, v, w = self.matrix @ (xyz - [0, 0, self.high]).T
        w = np.where(w > 0.2, w, np.nan)
        return np.stack([u / w, v / w], axis=-1)

    def boxes(
        self, count: int, seed: int, noise: float = 0.0, hidden: float = 0.0, far: float = 35.0, spread: float = 0.1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Boxes (N, 4) of people that are wholly in the picture, and where they stand (N, 2)."""
        rng = np.random.default_rng(seed)
        away = rng.uniform(1.0, far, 60 * count)
        x, tall = rng.uniform(-1, 1, len(away)) * away, rng.normal(1.7, spread, len(away))
        around = np.linspace(0, 2 * np.pi, 9)[:-1]
        rim = np.stack([np.cos(around), np.sin(around)], axis=1) * 0.12
        points = np.array([[*side, high] for side in rim for high in (0.0, 1.0)])
        body = points[None] * np.stack([np.ones_like(tall), np.ones_like(tall), tall], axis=1)[:, None]
        body = body + np.stack([x, away, np.zeros_like(x)], axis=1)[:, None]
        pixels = self.pixels(body.reshape(-1, 3)).reshape(len(x), -1, 2)
        low, high = pixels.min(axis=1), pixels.max(axis=1)
        boxes = np.concatenate([low, high - low], axis=1)
        boxes[:, 0] -= 0.12 * boxes[:, 3]  # arms
        boxes[:, 2] += 0.24 * boxes[:, 3]
        boxes += rng.normal(0, noise / np.sqrt(2), boxes.shape) * boxes[:, 3:] * [0, 1, 0, 1]
        is_cut = rng.random(len(boxes)) < hidden
        boxes[is_cut, 3] *= rng.uniform(0.4, 0.95, is_cut.sum())
        seen = (low > 8).all(axis=1) & (high < [WIDTH - 8, HEIGHT - 8]).all(axis=1)
        return boxes[seen][:count], np.stack([x, away], axis=1)[seen][:count]


def fitted(boxes: np.ndarray, **options: float) -> PlaneFit:
    alone = np.arange(len(boxes))  # one in each picture
    return plane_from_boxes(boxes, alone, np.full(len(boxes), np.nan), WIDTH, HEIGHT, **options)


@pytest.mark.parametrize(
    ("high", "pitch", "focal", "roll"),
    [(6.0, 20.0, 1.0, 0.0), (3.0, 8.0, 1.1, 2.0), (8.0, 35.0, 0.9, -2.0), (1.6, 2.0, 1.0, 0.0)],
)
def test_a_camera_is_found_from_people_before_it(high, pitch, focal, roll):
    view = View(high, pitch, focal, roll)
    boxes, places = view.boxes(500, seed=3)
    fit = fitted(boxes)
    assert fit.camera_height_m == pytest.approx(high, rel=0.12)
    assert fit.pitch_deg == pytest.approx(pitch, abs=3.0)
    assert fit.roll_deg == pytest.approx(roll, abs=0.7)
    assert fit.inliers > 0.85
    assert fit.residual < 0.07
    assert fit.plane.assumed
    assert fit.plane.is_estimated
    found = fit.plane.boxes_to_metres(boxes)
    assert np.median(np.abs(found[:, 0] / places[:, 0] - 1)) < 0.04  # across
    assert np.median(np.abs(found[:, 1] / places[:, 1] - 1)) < 0.15  # along: here the focal length is a guess
    near, far = np.quantile(np.hypot(*places.T), [0.05, 0.95])
    assert (fit.nearest_m, fit.farthest_m) == pytest.approx((near, far), rel=0.2)


@thorough
def test_noise_and_hidden_people_change_the_scale_little_over_random_cameras():
    rng = np.random.default_rng(5)
    off = []
    for seed in range(12):
        view = View(rng.uniform(2.5, 10), rng.uniform(5, 45), rng.uniform(0.7, 1.3), rng.normal(0, 1))
        boxes, places = view.boxes(400, seed, noise=0.05, hidden=0.2)
        if len(boxes) < 250:  # steep and low: it sees little ground
            continue
        feet = view.pixels(np.column_stack([places, np.zeros(len(places))]))
        to_right = view.pixels(np.column_stack([places + [0.1, 0], np.zeros(len(places))]))
        try:
            plane = fitted(boxes).plane
        except McaptrackError as error:  # a view of a few metres
            assert "same distance" in str(error)
            continue
        apart = np.linalg.norm(plane.pixels_to_metres(to_right) - plane.pixels_to_metres(feet), axis=1)
        off.append(np.nanmedian(apart) / 0.1 - 1)
    assert len(off) >= 8
    assert np.median(np.abs(off)) < 0.03
    assert np.max(np.abs(off)) < 0.12


def test_the_height_of_people_gives_the_scale():
    boxes, _ = View(5.0, 20.0).boxes(300, seed=1)
    small, tall = fitted(boxes), fitted(boxes, person_m=3.4)
    assert tall.camera_height_m == pytest.approx(2 * small.camera_height_m)
    assert tall.plane.boxes_to_metres(boxes) == pytest.approx(2 * small.plane.boxes_to_metres(boxes))
    assert tall.pitch_deg == small.pitch_deg


def test_the_order_of_boxes_has_no_effect_beyond_rounding():
    boxes, _ = View(5.0, 20.0).boxes(300, seed=1)
    one, other = fitted(boxes), fitted(boxes[np.random.default_rng(1).permutation(len(boxes))])
    assert one.plane.boxes_to_metres(boxes) == pytest.approx(other.plane.boxes_to_metres(boxes), rel=1e-3)
    assert fitted(boxes) == one


def test_all_numbers_of_a_fit_are_values_of_json():
    said = fitted(View(5.0, 20.0).boxes(300, seed=1)[0]).to_json()
    assert said["boxes"] + 0.0 == pytest.approx(300, abs=40)
    assert "plane" not in said
    assert {type(value) for value in said.values()} <= {int, float}


def nothing() -> np.ndarray:
    return np.empty((0, 4))


def few() -> np.ndarray:
    return View(5.0, 20.0).boxes(119, seed=2)[0]


def lane() -> np.ndarray:
    boxes, places = View(1.6, 0.0).boxes(6000, seed=2)
    return boxes[np.abs(places[:, 1] - 12) < 0.5]


def above() -> np.ndarray:
    return View(14.0, 80.0).boxes(300, seed=2, far=6.0)[0] * [1, 1, 0.5, 1]


def unrelated() -> np.ndarray:
    boxes, _ = View(5.0, 20.0).boxes(400, seed=2)
    boxes[:, 3] = np.random.default_rng(1).uniform(30, 300, len(boxes))
    boxes[:, 2] = boxes[:, 3] * 0.4
    return boxes


def lying() -> np.ndarray:
    return View(5.0, 20.0).boxes(300, seed=2)[0] * [1, 1, 4, 1]


@pytest.mark.parametrize(
    ("boxes", "words"),
    [
        (nothing, "0 of 0 boxes show whole people, and 120 are needed"),
        (few, "of 119 boxes show whole people, and 120 are needed"),
        pytest.param(lane, "people are all at about the same distance from the camera", marks=thorough),
        (unrelated, "heights of boxes don't follow from where they stand: "),
        (lying, "0% of the boxes have the shape of an upright person"),
    ],
    ids=["none", "few", "one distance", "unrelated", "lying"],
)
def test_boxes_that_cannot_tell_are_refused(boxes, words):
    with pytest.raises(McaptrackError, match=words):
        fitted(boxes())


@pytest.mark.parametrize("seen_m", [1.2, 1.4])
def test_people_who_sit_among_others_are_refused(seen_m):
    """Of people who sit and people who stand neither are most: metres along the view can be wrong by a factor of two."""
    boxes, _ = View(4.0, 20.0).boxes(600, seed=2)
    boxes[::2, 1] += boxes[::2, 3] * (1 - seen_m / 1.7)
    boxes[::2, 3] *= seen_m / 1.7
    with pytest.raises(McaptrackError, match="heights of boxes don't follow from where they stand"):
        fitted(boxes)


def test_a_camera_that_looks_down_is_refused():
    with pytest.raises(McaptrackError, match=r"looks down|same distance|don't follow|shape|show whole"):
        fitted(above())


def test_people_that_are_cut_off_hidden_or_uncertain_do_not_count():
    boxes = np.array(
        [
            [100, 100, 40, 100],  # whole
            [120, 110, 40, 120],  # whole, and before the first one
            [300, 100, 40, 100],
            [0.5, 100, 40, 100],  # at the left edge
            [1238, 100, 40, 100],  # at the right edge
            [400, 1, 40, 100],  # at the upper edge
            [500, 618, 40, 100],  # at the lower edge
            [600, 100, 90, 100],  # too wide
            [700, 100, 10, 100],  # too narrow
            [800, 100, 40, 100],  # of a low score
            [np.nan, 100, 40, 100],
        ]
    )
    score = np.full(len(boxes), 0.9)
    score[9] = 0.5
    together = np.zeros(len(boxes), np.int64)
    assert np.flatnonzero(whole_people(boxes, together, score, WIDTH, HEIGHT)).tolist() == [1, 2]
    assert np.flatnonzero(whole_people(boxes, together, score * np.nan, WIDTH, HEIGHT)).tolist() == [1, 2, 9]
    apart = np.arange(len(boxes))
    assert np.flatnonzero(whole_people(boxes, apart, score, WIDTH, HEIGHT)).tolist() == [0, 1, 2]
