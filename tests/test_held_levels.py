"""Ellipses corrected by what they have held, and the noise of positions as far as tracks show it."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.geometry.mixtures import Tails, mass_within, squared_radius
from mcaptrack.predictors.held_levels import HeldLevels
from mcaptrack.predictors.position_noise import PositionNoise

STEPS, STEP_S = 3, 0.4
SHAPE = Tails(np.full(STEPS, 0.3), np.full(STEPS, 0.5), np.full(STEPS, 5.0))


def held(size: float, count: int, times: int = 1) -> tuple[Tails, np.ndarray]:
    """The correction of a mixture after errors ``size`` times as large as it says; half their squared distances."""
    rng = np.random.default_rng(1)
    scale = size * np.where(rng.random((STEPS, count)) < 0.3, 5.0, 0.5)
    half = scale * rng.exponential(size=(STEPS, count))
    levels = HeldLevels(STEPS)
    for _ in range(times):
        step = np.repeat(np.arange(STEPS), count)
        levels.add(step, half.ravel(), SHAPE.chosen(step))
    return levels.correct(SHAPE, 1.0), half


class TestLevels:
    def test_without_errors_and_with_those_that_were_expected_mixtures_stay(self):
        for size, count in ((1.0, 0), (1.0, 20_000)):
            found, _ = held(size, count)
            for one, given in zip(found, SHAPE, strict=True):
                assert one.tolist() == pytest.approx(given.tolist(), rel=0.05)

    @pytest.mark.parametrize("size", [0.7, 1.5, 2.0])
    def test_after_many_errors_ellipses_hold_half_of_them(self, size):
        found, half = held(size, 20_000)
        inside = mass_within(2 * half, Tails(*(part[:, None] for part in found)))
        before = mass_within(2 * half, Tails(*(part[:, None] for part in SHAPE)))
        assert abs((before <= 0.5).mean() - 0.5) > 0.08
        assert (inside <= 0.5).mean() == pytest.approx(0.5, abs=0.05)

    @pytest.mark.parametrize("size", [0.1, 10.0])
    def test_corrections_have_limits(self, size):
        found, _ = held(size, 20_000)
        assert np.ptp(np.log(found.narrow_scale / SHAPE.narrow_scale)) == pytest.approx(0)
        assert 0.5 <= found.narrow_scale[0] / SHAPE.narrow_scale[0] <= 2
        assert 1 <= found.wide_scale[0] / SHAPE.wide_scale[0] <= 2

    def test_large_errors_only_make_the_wide_part_larger(self):
        less, more = held(0.5, 20_000)[0], held(3.0, 20_000)[0]
        assert less.wide_scale.tolist() == SHAPE.wide_scale.tolist()
        assert (less.narrow_scale < 0.8 * SHAPE.narrow_scale).all()
        assert (more.wide_scale > 1.2 * SHAPE.wide_scale).all()

    def test_few_errors_change_little(self):
        few, more, many = (squared_radius(0.5, held(2.0, count)[0])[0] for count in (2, 30, 2000))
        assert few < 1.15 * squared_radius(0.5, SHAPE)[0] < more < many

    def test_what_is_forgotten_does_not_count(self):
        levels, step = HeldLevels(STEPS), np.repeat(np.arange(STEPS), 30)
        levels.add(step, np.tile(np.geomspace(0.2, 20, 30), STEPS), SHAPE.chosen(step))
        levels.forget(np.array([0.0, 0.0, 1.0]))
        found = levels.correct(SHAPE, 1.0).narrow_scale
        assert found[2] > found[0] > 0.5
        levels.forget(np.zeros(STEPS))
        assert levels.correct(SHAPE, 1.0).narrow_scale.tolist() == pytest.approx([0.5] * STEPS)


class TestNoise:
    def seen(self, white_m: float, lasting_m: float, turns: float = 0.0, lasts_s: float = 1.2) -> PositionNoise:
        """The noise of 60 people who walk, straight on or in circles, and are measured."""
        rng, people, steps = np.random.default_rng(2), 60, 100
        keep = np.exp(-STEP_S / lasts_s)
        off = lasting_m * rng.normal(size=(people, 2))
        angle = turns * STEP_S * np.arange(steps) + rng.uniform(0, 6, (people, 1))
        path = np.cumsum(0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=-1), axis=1)
        noise = PositionNoise(STEP_S)
        for step in range(steps):
            off = keep * off + np.sqrt(1 - keep**2) * lasting_m * rng.normal(size=(people, 2))
            path[:, step] += off + white_m * rng.normal(size=(people, 2))
            if step >= 7:
                noise.see(step, path[:, step - 7 : step + 1])
        return noise

    @pytest.mark.parametrize(("white_m", "lasting_m"), [(0.2, 0.0), (0.0, 0.2), (0.1, 0.3), (0.0, 0.0)])
    def test_white_and_lasting_noise_are_told_apart(self, white_m, lasting_m):
        found = self.seen(white_m, lasting_m)
        assert np.sqrt(found.white_m2) == pytest.approx(white_m, abs=0.06)
        assert np.sqrt(found.lasting_m2) == pytest.approx(lasting_m, abs=0.06)
        if not white_m:
            assert np.sqrt(found.lasting_m2) == pytest.approx(lasting_m, rel=0.04)

    def test_people_who_turn_are_not_taken_for_noise(self):
        found = self.seen(0.01, 0.0, turns=0.5)
        assert np.sqrt(found.white_m2 + found.lasting_m2) < 0.06
        assert np.sqrt(self.seen(0.1, 0.0, turns=0.5).white_m2) == pytest.approx(0.1, rel=0.3)

    def test_errors_of_noise_that_lasts_are_smaller_near_and_larger_far_than_they_seem(self):
        """A person stands; a forecast is the last measured position, and is compared with measured ones later."""
        found = self.seen(0.0, 0.3).of_errors(12)
        rng, keep = np.random.default_rng(3), np.exp(-STEP_S / 1.2)
        off = [rng.normal(0, 0.3, 20_000)]
        for _ in range(12):
            off.append(keep * off[-1] + np.sqrt(1 - keep**2) * rng.normal(0, 0.3, 20_000))
        added = [np.var(later - off[0]) - np.var(off[0]) for later in off[1:]]
        assert found.added.tolist() == pytest.approx(added, abs=0.025)
        assert found.added[0] < 0 < found.added[-1]
        assert (found.least <= np.var(off[0])).all()

    def test_of_white_noise_all_of_it_is_added(self):
        found = self.seen(0.2, 0.0).of_errors(12)
        assert found.added.tolist() == pytest.approx([0.04] * 12, rel=0.25)

    def test_few_positions_and_unknown_ones_say_nothing(self):
        noise = PositionNoise(STEP_S)
        for step in range(10):
            noise.see(step, np.full((4, 8, 2), np.nan))
            noise.see(step, np.empty((0, 8, 2)))
        assert noise.white_m2 == noise.lasting_m2 == 0
        assert noise.of_errors(3).added.tolist() == [0, 0, 0]
