"""The median detector on drawn scenes with known people: standing, in groups, in shade, behind things, in wind."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from scipy import ndimage

import mcaptrack
from mcaptrack import McaptrackError, log, pipeline
from mcaptrack.geometry.assignment import assign
from mcaptrack.geometry.boxes import columns_to_boxes, iou
from mcaptrack.notices import collected
from mcaptrack.schema import Frame
from mcaptrack.transforms import KnnDetector, MedianDetector
from mcaptrack.transforms.detect.median import Background
from mcaptrack.transforms.detect.people import Learner, Person, Separator, closed
from tests.drawn import HEIGHT, WIDTH, figure, film, walk
from tests.tiers import thorough
from tests.worlds import ns, small_scene

STEADY = MedianDetector(stabilise=False)


def boxes_of(frames: Sequence[Frame], detector: MedianDetector = STEADY) -> list[np.ndarray]:
    return [columns_to_boxes(frame.rows) for (frame,) in detector(frames)]


def hits(found: np.ndarray, true) -> int:
    return len(assign(1 - iou(np.array(true, float).reshape(-1, 4), found), 0.5)[0]) if len(found) else 0


def test_walking_people_of_a_rendered_scene_are_found():
    shots = list(small_scene().shots())
    frames = [Frame(ns(shot.seconds), n, shot.image) for n, shot in enumerate(shots)]
    found = boxes_of(frames, MedianDetector())
    right = sum(hits(seen, shot.boxes) for seen, shot in zip(found, shots, strict=True))
    assert right > 0.75 * sum(len(shot.boxes) for shot in shots)
    assert right > 0.75 * sum(map(len, found))


def test_who_stands_for_a_third_of_the_time_is_found_all_the_while_also_from_the_first_picture_on():
    def paint(image, number):
        walk(image, number)
        if number < 20:
            figure(image, 200, 80, (160, 60, 30))

    found = boxes_of(film(paint))
    there = [hits(seen, [(193.6, 40, 12.8, 40)]) for seen in found]
    assert there == [1] * 20 + [0] * 40
    assert all(len(seen) == 1 for seen in found[20:])


def three_side_by_side(image, number):
    """One person walks, and in every third picture three stand beside each other."""
    walk(image, number)
    if number % 3 == 0:
        for x in (100, 110, 120):
            figure(image, x, 80)


def test_three_who_stand_side_by_side_get_three_boxes_and_one_region_without_separation():
    frames = film(three_side_by_side)
    true = [(x - 6.4, 40, 12.8, 40) for x in (100, 110, 120)]
    assert [hits(seen, true) for seen in boxes_of(frames)[::3]] == [3] * 20
    joined = boxes_of(frames, MedianDetector(stabilise=False, separate=False))[::3]
    assert all(hits(seen, [(93.6, 40, 32.8, 40)]) == 1 for seen in joined)


@thorough
def test_boxes_of_several_people_carry_how_many_they_are():
    frames = film(three_side_by_side)
    for separate, wanted in ((True, [1, 1, 1, 1]), (False, [1, 3])):
        found = [frame.rows for (frame,) in MedianDetector(stabilise=False, separate=separate)(frames)][::3]
        counts = [sorted(rows["people"].tolist()) for rows in found]
        assert counts.count(wanted) >= 18
    (frame,) = list(KnnDetector()([f._replace(rows=f.rows[..., 0]) for f in frames]))[3]
    assert set(frame.rows["people"].tolist()) <= {0}


def test_one_behind_another_gets_a_box_of_a_whole_person_if_enough_of_them_is_seen():
    def paint(image, number):
        walk(image, number)
        if number % 3 == 0:
            figure(image, 150, 70)
            figure(image, 153, 92)

    frames = film(paint)
    true = [(143.6, 30, 12.8, 40), (146.6, 52, 12.8, 40)]
    assert [hits(seen, true) for seen in boxes_of(frames)[::3]] == [2] * 20
    strict = MedianDetector(stabilise=False, least_visible=0.95)
    assert sum(hits(seen, true) for seen in boxes_of(frames, strict)[::3]) < 40


def test_shadows_are_left_out_of_boxes_unless_they_are_kept():
    def paint(image, number):
        x = 20 + 7.5 * (number % 28)
        image[146:152, round(x) : round(x) + 30] = image[146:152, round(x) : round(x) + 30] * 0.7
        figure(image, x, 150)

    frames = film(paint)[:26]
    width = {
        is_removed: np.median(
            [
                seen[0, 2]
                for seen in boxes_of(frames, MedianDetector(stabilise=False, remove_shadows=is_removed, separate=False))
            ]
        )
        for is_removed in (True, False)
    }
    assert 11 <= width[True] <= 15
    assert width[False] >= 30


def test_light_that_changes_for_all_of_the_picture_is_no_motion():
    def paint(image, number):
        walk(image, number)

    frames = film(paint)
    lit = [f._replace(rows=(f.rows * (1.0 if f.index < 40 else 0.75)).astype(np.uint8)) for f in frames]
    for before, after in zip(boxes_of(frames), boxes_of(lit), strict=True):
        assert len(after) == len(before) == 1
        assert hits(after, before) == 1


def test_leaves_in_the_wind_are_no_people():
    rng = np.random.default_rng(5)
    leaves = [(rng.uniform(20, 70), rng.uniform(15, 50), tuple(rng.integers(20, 120, 3).tolist())) for _ in range(60)]

    def paint(image, number):
        walk(image, number)
        gust = 5 * np.sin(number * 0.9) * (number % 7 < 4)
        for x, y, (b, g, r) in leaves:
            cv2.circle(image, (round(x + gust), round(y)), 5, (b, g + 80, r), -1)

    found = boxes_of(film(paint))
    assert sum(len(seen) for seen in found) <= 1.15 * len(found)


def test_each_block_of_time_has_its_own_background():
    def paint(image, number):
        walk(image, number)
        if number >= 70:
            image[20:70, 90:130] = (40, 90, 200)  # a van parks, and stays

    frames, van = film(paint, 120), [(90, 20, 40, 50)]
    for history_s, there in ((30.0, 0), (600.0, 50)):
        found = boxes_of(frames, MedianDetector(stabilise=False, history_s=history_s, separate=False))
        assert sum(hits(seen, van) for seen in found[70:]) == there


def test_large_pictures_are_halved_and_their_boxes_are_in_full_pixels():
    frames = film(walk)
    large = [f._replace(rows=np.repeat(np.repeat(f.rows, 2, axis=0), 2, axis=1)) for f in frames]
    halved = MedianDetector(stabilise=False, max_pixels=HEIGHT * WIDTH)
    for plain, doubled in zip(boxes_of(frames), boxes_of(large, halved), strict=True):
        np.testing.assert_allclose(doubled, 2 * plain)


def test_grey_pictures_are_taken_too_and_shadows_stay_there():
    grey = [frame._replace(rows=frame.rows.mean(axis=2).astype(np.uint8)) for frame in film(walk)]
    found = boxes_of(grey)
    assert all(hits(seen, [(13.6 + 7.5 * (n % 28), 110, 12.8, 40)]) == 1 for n, seen in enumerate(found))


@thorough
def test_a_log_that_knn_made_keeps_knn(fresh):
    mcaptrack.detect(fresh, detector="knn")
    with log.read(fresh) as opened:
        first, *_ = pipeline.plan_all(opened, "/camera", force=True)
        assert type(first.transform) is KnnDetector
        first, *_ = pipeline.plan_all(opened, "/camera")
        assert first.stage == "track"


def test_an_iterator_is_refused_because_the_pictures_are_read_twice():
    with pytest.raises(McaptrackError, match="reads the pictures twice; give it a list"):
        list(STEADY(iter(film(walk))))


@pytest.mark.parametrize(("count", "step_s"), [(0, 0.5), (1, 0.5), (9, 0.5), (12, 0.15)])
def test_views_that_are_too_short_for_a_median_are_left_to_knn_and_a_warning_says_so(count, step_s):
    frames = film(walk, count, step_s)
    grey = [frame._replace(rows=cv2.cvtColor(frame.rows, cv2.COLOR_BGR2GRAY)) for frame in frames]
    with collected() as warnings:
        found = list(MedianDetector()(frames))
    for (frame,), (wanted,) in zip(found, KnnDetector()(grey), strict=True):
        np.testing.assert_array_equal(columns_to_boxes(frame.rows), columns_to_boxes(wanted.rows))
    assert [notice.code for notice in warnings] == ["few-pictures"] * (count > 0)
    with collected() as warnings:
        list(MedianDetector()(film(walk, 10)))
        list(MedianDetector()(film(walk, 13, 0.15)))
    assert not warnings


def test_after_a_cut_people_are_found_at_once_and_nothing_else_is():
    """Both views have texture, so that they are told apart, and each is registered to its own first picture."""
    rng = np.random.default_rng(8)
    walls = [
        cv2.resize(rng.integers(40, 220, (20, 30, 3), dtype=np.uint8), (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
        for _ in range(2)
    ]

    def paint(image, number):
        image[:] = walls[number // 40 % 2]
        walk(image, number)

    with collected() as warnings:
        found = boxes_of(film(paint, 120), MedianDetector())
    assert [notice.code for notice in warnings] == ["view-lost"]
    true = [(13.6 + 7.5 * (n % 28), 110, 12.8, 40) for n in range(120)]
    right = [hits(seen, [box]) for seen, box in zip(found, true, strict=True)]
    assert sum(right[40:58]) + sum(right[80:98]) >= 34
    assert sum(map(len, found)) <= 1.1 * sum(right)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (5, 1), (9, 1), (3, 3), (41, 1)])
def test_gaps_are_closed_as_if_the_mask_went_on_beyond_its_edges(height, width):
    rng = np.random.default_rng(height)
    for _ in range(20):
        mask = rng.random(rng.integers(3, 30, 2)) < 0.2
        wanted = ndimage.binary_closing(np.pad(mask, 50), np.ones((height, width)))[50:-50, 50:-50]
        np.testing.assert_array_equal(closed(mask.astype(np.uint8) * 255, height, width) > 0, wanted)


def test_the_background_is_the_median_of_each_channel_and_the_noise_its_deviation():
    rng = np.random.default_rng(3)
    samples = [rng.integers(100, 120 if n < 5 else 220, (12, 16, 3), dtype=np.uint8) for n in range(9)]
    background = Background.of(samples, 80.0)
    median = np.median(np.stack(samples), axis=0)
    np.testing.assert_array_equal(background.median, median.astype(np.uint8))
    deviation = np.median(np.abs(np.stack(samples) - median).max(axis=-1), axis=0)
    np.testing.assert_array_equal(background.threshold, np.clip(4 * 1.4826 * deviation, 80, 255).astype(np.uint8))


def test_height_is_learned_as_a_line_over_the_feet_from_those_who_stand_alone():
    learner, rng = Learner(), np.random.default_rng(1)
    for _ in range(40):
        mask = np.zeros((240, 320), np.uint8)
        for foot in rng.permutation([80, 130, 180, 230])[:2]:
            figure(mask, rng.uniform(30, 290), foot, 255, 10 + 0.2 * foot)
        learner.add([mask], 40.0)
    person = learner.person()
    assert person is not None
    for foot in (80, 150, 230):
        assert person.height(foot) == pytest.approx(10 + 0.2 * foot, rel=0.05)


def test_the_same_people_are_found_wherever_the_picture_is_cut():
    """A region's people depend on the region alone, not on where it lies in the picture."""
    learner = Learner()
    for x in range(30, 200, 8):
        mask = np.zeros((120, 240), np.uint8)
        figure(mask, x, 80, 255)
        learner.add([mask], 40.0)
    person = learner.person()
    assert person is not None
    level = Person(0.0, person.height(80), person.template)
    separator = Separator(level, 0.5)
    mask = np.zeros((120, 240), np.uint8)
    for x in (60, 70, 81):
        figure(mask, x, 80, 255)
    moved = np.roll(mask, (17, 90), axis=(0, 1))
    np.testing.assert_allclose(separator.boxes(moved)[0], separator.boxes(mask)[0] + [90, 17, 0, 0], atol=1e-6)
    assert len(separator.boxes(mask)[0]) == 3
