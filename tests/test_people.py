"""Parts of the median detector against plain implementations of what they say, with numbers at their ends."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from mcaptrack.transforms.detect.median import Background, Sampler
from mcaptrack.transforms.detect.people import (
    Learner,
    Person,
    Separator,
    _fit_height,
    _joined_parts,
    region_boxes,
    regions,
    typical_heights,
)

ROWS = 24


def drawn(size: tuple[int, int], *boxes: tuple[int, int, int, int]) -> np.ndarray:
    """A mask (height, width) with boxes x, y, w, h."""
    mask = np.zeros(size, np.uint8)
    for x, y, w, h in boxes:
        mask[y : y + h, x : x + w] = 255
    return mask


class TestHeightOverFeet:
    FOOT = np.array([50.0, 70.0, 90.0, 110.0, 130.0, 150.0])

    def fit(self, height, foot=FOOT, weight=None, picture=200):
        weight = np.ones(len(foot)) if weight is None else np.array(weight, float)
        return _fit_height(foot, np.array(height, float), weight, picture)

    def test_a_line_is_found_beside_regions_that_do_not_follow_it(self):
        height = 10 + 0.2 * self.FOOT
        foot = np.append(self.FOOT, [60.0, 80.0, 100.0])
        slope, level = self.fit(np.append(height, [60.0, 5.0, 70.0]), foot)
        assert (slope, level) == (pytest.approx(0.2), pytest.approx(10))

    def test_those_with_more_weight_decide(self):
        foot = np.concatenate([self.FOOT, self.FOOT])
        height = np.concatenate([10 + 0.2 * self.FOOT, 40 + 0.4 * self.FOOT])
        for heavy, (slope, level) in (([3] * 6 + [1] * 6, (0.2, 10)), ([1] * 6 + [3] * 6, (0.4, 40))):
            assert self.fit(height, foot, heavy) == (pytest.approx(slope), pytest.approx(level))

    def test_who_is_farther_away_is_not_taller(self):
        slope, level = self.fit(30 - 0.02 * self.FOOT)
        assert (slope, level) == (0, pytest.approx(np.median(30 - 0.02 * self.FOOT)))

    @pytest.mark.parametrize(("spread", "is_level"), [(20.0, True), (20.5, False)])
    def test_feet_that_spread_over_a_tenth_of_the_picture_or_less_give_no_slope(self, spread, is_level):
        foot = np.linspace(100.0, 100.0 + spread, 6)
        slope, level = self.fit(20 + 0.2 * (foot - 100), foot)
        assert (slope == 0) == is_level
        assert level == pytest.approx(np.median(20 + 0.2 * (foot - 100)) if is_level else 0, abs=1e-6)


def joined(boxes: np.ndarray, expected: np.ndarray) -> set[frozenset[int]]:
    """Groups by comparing each pair, and joining what is linked."""
    groups = [{n} for n in range(len(boxes))]
    for i, (ax, ay, aw, ah) in enumerate(boxes[:, :4].tolist()):
        for j, (bx, by, bw, bh) in enumerate(boxes[:, :4].tolist()):
            if i == j or not (ah < 0.7 * expected[i] or bh < 0.7 * expected[j]):
                continue
            aside, gap = 0.05 * expected[i], 0.4 * expected[i]
            is_beside = ax - aside < bx + bw and bx < ax + aw + aside
            is_above = ay - gap < by + bh and by < ay + ah + gap
            tall = max(ay + ah, by + bh) - min(ay, by)
            if is_beside and is_above and tall <= 1.2 * max(expected[i], expected[j]):
                one = next(group for group in groups if i in group)
                other = next(group for group in groups if j in group)
                if one is not other:
                    one |= other
                    groups.remove(other)
    return {frozenset(group) for group in groups}


@pytest.mark.parametrize("seed", range(60))
def test_parts_above_each_other_are_joined_up_to_the_height_of_one_person(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 7))
    corner, size = rng.integers(0, 25, (count, 2)), rng.integers(1, 24, (count, 2))
    found = np.column_stack([corner, size, size.prod(axis=1)])
    expected = rng.choice([20.0, 20.0, 30.0], count)
    alone, several = _joined_parts(found, expected)
    groups = [np.array([at]) for at in alone] + several
    assert {frozenset(group.tolist()) for group in groups} == joined(found, expected)
    assert sorted(np.concatenate(groups).tolist()) == list(range(count))


class TestRegions:
    @pytest.mark.parametrize(
        ("box", "person_px", "there"),
        [((20, 20, 5, 4), 10, 1), ((20, 20, 19, 1), 10, 0), ((20, 20, 10, 5), 50, 1), ((20, 20, 7, 7), 50, 0)],
    )
    def test_regions_have_20_pixels_and_two_percent_of_a_squared_height(self, box, person_px, there):
        assert region_boxes(drawn((60, 60), box), person_px).tolist() == [[*map(float, box)]] * there

    @pytest.mark.parametrize(("gap", "count"), [(1, 1), (4, 1), (5, 2)])
    def test_regions_above_each_other_are_joined_over_a_fifth_of_a_height(self, gap, count):
        """An opening of up to 4 rows is closed by a column of 5."""
        mask = drawn((60, 40), (10, 10, 6, 8), (10, 18 + gap, 6, 8))
        assert len(region_boxes(mask, 25)) == count

    @pytest.mark.parametrize(("rows", "columns"), [(217, 302), (255, 257)])
    def test_noise_may_have_more_regions_than_short_labels_can_tell(self, rows, columns):
        """OpenCV refuses 65 535 regions with labels of 16 bits, not 65 534."""
        mask = np.zeros((2 * rows - 1, 2 * columns - 1), np.uint8)
        mask[::2, ::2] = 255
        labels, found = regions(mask, 1)
        assert (len(found), int(labels.max())) == (rows * columns,) * 2

    def test_the_typical_height_is_the_median_weighted_by_area(self):
        def height(*masks):
            return typical_heights(masks)[0]

        assert height() == height(drawn((100, 100), (5, 5, 19, 1))) == 20
        assert height(drawn((100, 100), (5, 5, 5, 4))) == 4
        # 6 x 10 and 5 x 12 have the same area; 8 x 15 = 120 is half of all.
        low, middle, high = (5, 5, 6, 10), (30, 5, 5, 12), (50, 5, 8, 15)
        assert height(drawn((100, 100), low, middle, high)) == 12
        assert height(drawn((100, 100), low), drawn((100, 100), high)) == 15
        assert height(drawn((100, 100), low, (30, 5, 2, 50))) == 10  # half the picture is no person
        assert height(drawn((100, 100), low, (30, 5, 2, 49))) == 49

    @pytest.mark.parametrize(("far", "wanted"), [(3, (40, 40)), (5, (40, 10)), (15, (40, 10)), (17, (10, 10))])
    def test_far_people_decide_by_their_outline_before_they_do_by_their_area(self, far, wanted):
        """One of 16 x 40 pixels has the area of 16 people of 4 x 10, and the outline of four."""
        boxes = [(2 + 8 * n, 5, 4, 10) for n in range(far)]
        assert typical_heights([drawn((100, 160), (20, 40, 16, 40), *boxes)]) == wanted


class TestLearning:
    def learned(self, boxes, size=(120, 120), person_px=20.0):
        learner = Learner()
        learner.add([drawn(size, box) for box in boxes], person_px)
        return learner.person()

    def test_eight_regions_that_are_alike_are_needed(self):
        boxes = [(20 + n, 40, 8, 20) for n in range(8)]
        person = self.learned(boxes)
        assert (person.slope, person.level) == (0, 20)
        assert self.learned(boxes[:7]) is None
        assert self.learned([*boxes[:7], (20, 20, 8, 40)]) is None  # which is twice as tall
        for x, y, is_cut in ((1, 40, True), (2, 40, False), (111, 40, True), (110, 40, False), (40, 1, True)):
            assert (self.learned([*boxes[:7], (x, y, 8, 20)]) is None) == is_cut
        for y, is_cut in ((1, True), (2, False), (99, True), (98, False)):
            assert (self.learned([*boxes[:7], (40, y, 8, 20)]) is None) == is_cut

    def test_the_shape_is_the_mean_of_those_alone_and_the_same_on_both_sides(self):
        person = self.learned([(20 + n, 40, 8, 24) for n in range(10)], person_px=24.0)
        template = person.template
        assert template.shape == (ROWS, math.ceil(24 * 8 / 24 * 1.8) // 2 * 2 + 2)
        np.testing.assert_array_equal(template, template[:, ::-1])
        middle = template.shape[1] // 2
        np.testing.assert_array_equal(template[:, middle - 4 : middle + 4], 1)
        assert template.sum() == 8 * ROWS
        wide = self.learned([(20 + n, 40, 8, 24) for n in range(10)] + [(20, 40, 11, 24)] * 5, person_px=24.0)
        np.testing.assert_array_equal(wide.template, template)  # 11 is more than 1.35 times 8
        wide = self.learned([(20 + n, 40, 8, 24) for n in range(10)] + [(20, 40, 10, 24)] * 10, person_px=24.0)
        np.testing.assert_allclose(wide.template[:, middle - 5], 0.5)

    def test_what_is_closed_between_two_parts_is_no_part_of_the_shape(self):
        """Of bodies in two parts, two rows of 24 apart; six of the eight columns of the first row are empty, too."""
        learner = Learner()
        for n in range(10):
            mask = drawn((120, 120), (20 + n, 40, 8, 10), (20 + n, 52, 8, 12))
            mask[40, 20 + n : 26 + n] = 0
            learner.add([mask], 24.0)
        shape = learner.person().template
        middle = shape.shape[1] // 2
        assert shape[10:12].max() == 0
        assert shape[12:, middle - 4 : middle + 4].min() == 1
        assert shape[1:10, middle - 4 : middle + 4].min() == 1
        assert shape[0, middle - 4 : middle + 4].tolist() == [0.5] * 2 + [0.0] * 4 + [0.5] * 2

    @pytest.mark.parametrize(("box", "is_known"), [((20, 40, 6, 8), False), ((20, 40, 5, 10), True)])
    def test_regions_to_learn_from_have_two_percent_of_the_squared_height(self, box, is_known):
        """Of a person of 50 pixels."""
        assert (self.learned([box] * 8, person_px=50.0) is not None) == is_known

    def test_people_are_at_least_eight_pixels_tall(self):
        person = Person(0.1, 5.0, np.zeros((ROWS, 10), np.float32))
        assert (person.height(20), person.height(30), person.height(50)) == (8, 8, 10)


def template(half: int = 4, columns: int = 12) -> np.ndarray:
    shape = np.zeros((ROWS, columns), np.float32)
    shape[:, columns // 2 - half : columns // 2 + half] = 0.9
    shape[:4, :] *= 0.5
    return shape


PERSON = Person(0.0, 24.0, template())


class TestSeparating:
    @pytest.mark.parametrize(
        ("box", "there"),
        [
            ((40, 40, 8, 24), 1),
            ((40, 40, 8, 30), 1),  # 1.25 times as tall
            ((40, 40, 12, 24), 1),  # at most 1.6 times as wide as 8
            ((40, 40, 7, 4), 0),  # 28 pixels: less than three times two percent of 24 squared
            ((40, 40, 7, 5), 1),
            ((40, 40, 2, 12), 1),  # half as tall as a person
            ((40, 40, 2, 11), 0),
            ((40, 40, 5, 3), 0),
            ((1, 40, 7, 4), 1),  # at the edge of the picture a part is seen
            ((2, 40, 7, 4), 0),
            ((40, 1, 7, 4), 1),
            ((40, 2, 7, 4), 0),
            ((92, 40, 7, 4), 1),
            ((91, 40, 7, 4), 0),
            ((40, 95, 7, 4), 1),
            ((40, 94, 7, 4), 0),
        ],
    )
    def test_a_region_of_one_person_is_a_box_if_enough_of_it_is_seen(self, box, there):
        found = Separator(PERSON, 0.5).boxes(drawn((100, 100), box))[0]
        assert found.tolist() == [[*map(float, box)]] * there

    def test_nothing_has_no_boxes(self):
        assert Separator(PERSON, 0.5).boxes(drawn((100, 100)))[0].shape == (0, 4)

    @pytest.mark.parametrize("count", [2, 3])
    def test_people_side_by_side_get_a_box_each(self, count):
        mask = drawn((100, 140), *((30 + 9 * n, 40, 8, 24) for n in range(count)))
        mask[50:54, 30 : 30 + 9 * count - 1] = 255  # they hold hands
        found = Separator(PERSON, 0.5).boxes(mask)[0]
        found = found[np.argsort(found[:, 0])]
        np.testing.assert_allclose(found, [(30 + 9 * n, 40, 8, 24) for n in range(count)], atol=1.01)

    @pytest.mark.parametrize("apart", [6, 7, 8])
    def test_places_are_looked_for_again_when_another_person_is_added(self, apart):
        """They overlap, so that the first two places alone explain the mask differently."""
        mask = drawn((100, 140), *((30 + apart * n, 40, 8, 24) for n in range(3)))
        found = Separator(PERSON, 0.5).boxes(mask)[0]
        seen = [(30, 40, 8, 24), (30 + apart, 40, apart, 24), (30 + 2 * apart, 40, 8, 24)]  # of the middle one
        np.testing.assert_allclose(found[np.argsort(found[:, 0])], seen, atol=0.01)

    @pytest.mark.parametrize("hidden", [0, 1, 2])
    def test_a_box_ends_half_way_between_the_shape_and_what_is_seen(self, hidden):
        """Something hides the left columns of one; their shape, 8 columns wide, begins there, and ends beyond them."""
        mask = drawn((100, 140), (30, 40, 8, 24), (39, 40, 8, 24))
        mask[50:54, 30:47] = 255
        mask[:, : 30 + hidden] = 0
        found = Separator(PERSON, 0.5).boxes(mask)[0]
        wanted = [(30 + hidden, 40, 8 - hidden / 2, 24), (39, 40, 8, 24)]
        np.testing.assert_allclose(found[np.argsort(found[:, 0])], wanted, atol=0.01)

    @pytest.mark.parametrize(("wide", "there"), [(8, 0), (9, 1)])
    def test_a_region_has_two_percent_of_the_squared_height(self, wide, there):
        """Of a person of 60 pixels 72; at the edge of the picture nothing else is asked."""
        tall = Person(0.0, 60.0, template())
        assert len(Separator(tall, 0.5).boxes(drawn((200, 200), (0, 80, wide, 8)))[0]) == there

    @pytest.mark.parametrize("count", [1, 2, 3, 4])
    def test_a_box_around_several_people_carries_how_many_they_are(self, count):
        separator = Separator(PERSON, 0.5)
        mask = drawn((100, 140), *((30 + 9 * n, 40, 8, 24) for n in range(count)), (110, 60, 8, 24))
        mask[50:54, 30 : 30 + 9 * count - 1] = 255
        assert separator.boxes(mask)[1].tolist() == [1] * (count + 1)
        whole = np.array([(110, 60, 8, 24), (30, 40, 9 * count - 1, 24)], float)
        assert separator.counts(mask, whole).tolist() == [1, count]

    def test_who_is_hidden_too_much_for_a_box_is_counted_in_the_one_before(self):
        """Three of the eight columns of one behind another can be seen; a third person stands apart, holding their hands."""
        mask = drawn((100, 140), (30, 40, 8, 24), (33, 40, 8, 24), (50, 40, 8, 24))
        mask[50:54, 30:58] = 255
        boxes, people = Separator(PERSON, 0.75).boxes(mask)
        assert people[np.argsort(boxes[:, 0])].tolist() == [2, 1]
        assert Separator(PERSON, 0.3).boxes(mask)[1].tolist() == [1, 1, 1]

    @pytest.mark.parametrize("is_large", [True, False])
    def test_the_people_in_what_does_not_look_like_people_are_unknown(self, is_large):
        """A low region is a box from the area of two whole people on, 2 x 8 x 24 pixels."""
        box = (20, 40, 56 if is_large else 54, 7)
        mask = drawn((100, 140), box)
        boxes, people = Separator(PERSON, 0.5).boxes(mask)
        assert (boxes.tolist(), people.tolist()) == ([[*map(float, box)]] * is_large, [0] * is_large)
        assert Separator(PERSON, 0.5).counts(mask, np.array([box], float)).tolist() == [0]


class TestBackground:
    STILL = np.full((40, 48, 3), (100, 120, 140), np.uint8)

    def background(self, **changed) -> Background:
        return Background.of([self.STILL] * 5, **changed)

    def test_samples_are_every_so_many_pictures_a_power_of_two(self):
        for count in (1, 47, 48, 49, 96, 97, 500):
            sampler = Sampler()
            for number in range(count):
                sampler.add(lambda number=number: number)
            step = next(2**n for n in range(20) if math.ceil(count / 2**n) <= 48)
            assert sampler.pictures == list(range(0, count, step))

    @pytest.mark.parametrize(("threshold", "least"), [(None, 22), (5.0, 5), (300.0, 255)])
    def test_differences_above_the_threshold_count(self, threshold, least):
        background = self.background(threshold=threshold)
        assert (background.threshold == least).all()
        for channel in range(3):
            for by in (least, least + 1, -least, -least - 1):
                value = int(self.STILL[0, 0, channel]) + by
                if not 0 <= value <= 255:
                    continue
                image = self.STILL.copy()
                image[20:24, 20:24, channel] = value
                assert (background.mask(image, shadows=False)[20:24, 20:24] == 255 * (abs(by) > least)).all()

    @pytest.mark.parametrize(
        ("factor", "tint", "is_shadow"),
        [(0.5, 0, False), (0.6, 0, True), (0.75, 0, True), (0.75, 0.1, True), (0.75, 0.14, False), (1.3, 0, False)],
    )
    def test_a_shadow_is_darker_and_of_the_same_colour(self, factor, tint, is_shadow):
        image = self.STILL.copy()
        image[20:24, 20:24] = np.rint((self.STILL[0, 0] + 1.0) * (factor + np.array([0, 0, tint])) - 1).astype(np.uint8)
        background = self.background(threshold=5.0)
        assert (background.mask(image, shadows=False)[20:24, 20:24] == 255).all()
        assert (background.mask(image, shadows=True)[20:24, 20:24] == 255 * (not is_shadow)).all()
        grey = Background.of([np.full_like(self.STILL, 120)] * 5, 5.0)
        assert grey.is_grey
        assert not background.is_grey
        image[:] = 120
        image[20:24, 20:24] = 80
        assert (grey.mask(image, shadows=True)[20:24, 20:24] == 255).all()

    @pytest.mark.parametrize("factor", [0.8, 0.97, 1.1])
    def test_light_that_changes_everywhere_is_compensated(self, factor):
        image = cv2.convertScaleAbs(self.STILL, alpha=factor)
        image[20:24, 20:24] = 250
        same = self.background()._same_light(image)
        assert np.abs(same[:16].astype(int) - self.STILL[:16]).max() <= 1
        almost = cv2.convertScaleAbs(self.STILL, alpha=1.01)
        assert self.background()._same_light(almost) is almost

    def test_a_pixel_beside_another_colour_may_have_it(self):
        still = self.STILL.copy()
        still[:, 24:] = (20, 220, 20)
        background = Background.of([still] * 5)
        np.testing.assert_array_equal(background.lowest[10, 22:26, 0], [100, 20, 20, 20])
        np.testing.assert_array_equal(background.highest[10, 22:26, 0], [100, 100, 100, 20])
        moved = np.roll(still, 1, axis=1)
        assert not background.mask(moved, shadows=False)[:, 20:30].any()
        assert background.mask(np.roll(still, 2, axis=1), shadows=False)[:, 20:30].any()

    @pytest.mark.parametrize(("beyond", "is_near"), [(8, True), (9, False)])
    def test_a_colour_that_is_almost_in_the_range_sways_too(self, beyond, is_near):
        still = np.full((80, 120, 3), (100, 120, 140), np.uint8)
        still[20:40, 20:30] = (20, 40, 220)
        moved = still.copy()
        moved[20:40, 30:33] = (20 - beyond, 40, 220)
        plain = Background.of([still] * 5)
        assert np.array_equal(plain.swaying([moved] * 8, 20.0).lowest, plain.lowest) != is_near

    def test_what_sways_has_the_range_of_a_wider_surrounding_and_what_passes_has_not(self):
        """A flag shows its own colour a few pixels aside; a person brings another one."""
        still = np.full((80, 120, 3), (100, 120, 140), np.uint8)
        still[20:40, 20:30] = (20, 40, 220)
        flag, person = [], []
        for number in range(8):
            image = still.copy()
            image[20:40, 30:33] = (20, 40, 220) if number % 2 else (100, 120, 140)
            flag.append(image)
            passing = still.copy()
            passing[20:60, 60:70] = (240, 240, 10) if number % 2 else (100, 120, 140)
            person.append(passing)
        plain = Background.of([still] * 5)
        swaying, passing = plain.swaying(flag, 20.0), plain.swaying(person, 20.0)
        assert plain.mask(flag[1], shadows=False)[20:40, 31:33].all()
        assert not swaying.mask(flag[1], shadows=False).any()
        assert (passing.mask(person[1], shadows=False)[20:60, 60:70] == 255).all()
        np.testing.assert_array_equal(passing.highest, plain.highest)
        np.testing.assert_array_equal(swaying.lowest[:, 60:], plain.lowest[:, 60:])
        assert (swaying.median == plain.median).all()


class TestWork:
    """Work is counted in filtered pixels; the bound is a multiple of the picture's pixels, whatever is expected."""

    @pytest.mark.parametrize("tall", [1.0, 12.0, 30.0, 90.0, 400.0])
    @pytest.mark.parametrize("half", [1, 4])
    @pytest.mark.parametrize("what", ["everything", "person", "vehicle", "column", "rain", "noise"])
    def test_the_work_for_a_picture_is_bounded_by_its_pixels(self, monkeypatch, tall, half, what):
        mask = {
            "everything": lambda: drawn((300, 400), (0, 0, 400, 300)),
            "person": lambda: drawn((300, 400), (100, 60, 90, 230)),
            "vehicle": lambda: drawn((300, 400), (50, 100, 300, 120)),
            "column": lambda: drawn((300, 400), *((9 * k % 380, 100 + k, 8, 24) for k in range(120))),
            "rain": lambda: drawn((300, 400), *((x, y, 2, 12) for x in range(0, 400, 4) for y in range(0, 290, 14))),
            "noise": lambda: (np.random.default_rng(1).random((300, 400)) < 0.4).astype(np.uint8) * 255,
        }[what]()
        filtered, plain = [], cv2.filter2D

        def counted(image, *arguments, **options):
            filtered.append(image.size)
            return plain(image, *arguments, **options)

        monkeypatch.setattr(cv2, "filter2D", counted)
        separator = Separator(Person(0.0, tall, template(half)), 0.5)
        boxes, _ = separator.boxes(mask)
        assert sum(filtered) <= 200_000 + 2 * mask.size
        separator.counts(mask, boxes)
        assert sum(filtered) <= 2 * (200_000 + 2 * mask.size)

    def test_somebody_close_is_one_box_where_the_heights_do_not_hold(self):
        """A person of 230 pixels where 30 are expected, a bag within their box, and somebody far away."""
        rows = np.arange(301) < 150
        separator = Separator(Person(0.0, 30.0, template(), rows), 0.5)
        mask = drawn((300, 400), (100, 60, 30, 230), (135, 250, 8, 20), (100, 280, 60, 10), (300, 100, 10, 30))
        boxes, people = separator.boxes(mask)
        assert boxes.tolist() == [[300, 100, 10, 30], [100, 60, 60, 230]]
        assert people.tolist() == [1, 1]
        assert separator.counts(mask, boxes).tolist() == [1, 1]

    def test_heights_that_what_moves_contradicts_do_not_hold_there(self):
        """Fourteen people far away, and one close: both heights are learned where they are seen."""
        learner = Learner()
        for n in range(20):
            far = [(20 + 25 * k + n, 40 + 2 * k, 10, 25 + k // 4) for k in range(14)]
            close = [(30 + 10 * n, 120, 120, 175)] if n % 2 else []
            learner.add([drawn((300, 400), *far, *close)], 175.0, 26.0)
        person = learner.person()
        assert person.height(80) == pytest.approx(26, abs=2)
        assert person.holds(np.array([65, 94, 295])).tolist() == [True, True, False]
        assert person.contradicted > 0.5
