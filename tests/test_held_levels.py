"""Ellipses corrected by what they have held, and the noise of positions as far as tracks show it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from mcaptrack.geometry.mixtures import Tails, mass_within, squared_radius
from mcaptrack.predictors.position_noise import NoiseOfErrors, PositionNoise, nonnegative, running
from mcaptrack.predictors.tail_calibration import correct, level_counts

STEPS, STEP_S = 3, 0.4
SHAPE = Tails(np.full(STEPS, 0.3), np.full(STEPS, 0.5), np.full(STEPS, 5.0))
AT_ONE_TIME = Tails(*(part[None] for part in SHAPE))


def held(size: float, count: int) -> tuple[Tails, np.ndarray]:
    """The correction of a mixture after errors ``size`` times as large as it says; half their squared distances."""
    rng = np.random.default_rng(1)
    scale = size * np.where(rng.random((STEPS, count)) < 0.3, 5.0, 0.5)
    half = scale * rng.exponential(size=(STEPS, count))
    step = np.repeat(np.arange(STEPS), count)
    counts = level_counts(step, half.ravel(), SHAPE.chosen(step), STEPS)
    return Tails(*(part[0] for part in correct(AT_ONE_TIME, counts[None]))), half


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

    def test_steps_with_errors_of_their_own_are_corrected_more(self):
        step, half = np.repeat(np.arange(STEPS), 30), np.tile(np.geomspace(0.2, 20, 30), STEPS)
        counts = level_counts(step, half, SHAPE.chosen(step), STEPS) * np.array([[0.0], [0.0], [1.0]])
        (found,) = correct(AT_ONE_TIME, counts[None]).narrow_scale
        assert found[2] > found[0] > 0.5

    def test_several_times_are_corrected_as_each_of_them(self):
        step = np.repeat(np.arange(STEPS), 200)
        rng = np.random.default_rng(4)
        counts = np.stack([
            level_counts(step, size * rng.exponential(size=len(step)), SHAPE.chosen(step), STEPS) for size in (0.3, 2)
        ])  # fmt: skip
        together = correct(Tails(*(np.tile(part, (2, 1)) for part in SHAPE)), counts)
        for number, one in enumerate(counts):
            for part, alone in zip(together, correct(AT_ONE_TIME, one[None]), strict=True):
                assert part[number].tolist() == alone[0].tolist()


def test_running_sums_are_those_of_each_time_after_the_one_before():
    before, kept, new = np.array([4.0, 1.0]), np.array([0.5, 0.1, 1.0]), np.arange(6.0).reshape(3, 2)
    sums, last = running(before, kept, new)
    assert sums.tolist() == [[2.0, 1.5], pytest.approx([2.2, 3.15]), pytest.approx([6.2, 8.15])]
    assert last.tolist() == sums[-1].tolist()
    assert running(before, kept[:0], new[:0])[1].tolist() == [4, 1]


class TestNoise:
    def lasting(self, rng: np.random.Generator, sd_m: float, steps: int, *shape: int) -> np.ndarray:
        """Noise (steps, ...) that lasts: a part for each time constant, as of processes that forget (AR(1))."""
        parts = []
        for keep in np.exp(-STEP_S / np.array([0.6, 1.2, 2.4, 4.8])):
            drawn = rng.normal(0, sd_m / 2, (steps, *shape))
            drawn[1:] *= np.sqrt(1 - keep**2)
            for step in range(1, steps):
                drawn[step] += keep * drawn[step - 1]
            parts.append(drawn)
        return np.sum(parts, axis=0)

    def paths(self, white_m: float, lasting_m: float, turns: float = 0.0) -> np.ndarray:
        """The pasts, (93, 60, 8, 2), of 60 people who walk, straight on or in circles, and are measured."""
        rng, people, steps = np.random.default_rng(2), 60, 100
        angle = turns * STEP_S * np.arange(steps) + rng.uniform(0, 6, (people, 1))
        path = np.cumsum(0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=-1), axis=1)
        path += self.lasting(rng, lasting_m, steps, people, 2).swapaxes(0, 1) + white_m * rng.normal(size=path.shape)
        return np.stack([path[:, step - 7 : step + 1] for step in range(7, steps)])

    def seen(self, white_m: float, lasting_m: float, **motion: float) -> tuple[float, float]:
        """White and lasting noise of such people in m, at the end."""
        past = self.paths(white_m, lasting_m, **motion)
        place = np.repeat(np.arange(len(past)), past.shape[1])
        found = PositionNoise(STEP_S).variances_m2(np.ones(len(past), int), place, past.reshape(-1, 8, 2))
        return np.sqrt(found[0][-1]), np.sqrt(found[1][-1])

    @pytest.mark.parametrize(("white_m", "lasting_m"), [(0.2, 0.0), (0.0, 0.2), (0.1, 0.3), (0.0, 0.0)])
    def test_white_and_lasting_noise_are_told_apart(self, white_m, lasting_m):
        white, lasting = self.seen(white_m, lasting_m)
        assert white == pytest.approx(white_m, abs=0.06)
        assert lasting == pytest.approx(lasting_m, abs=0.06)
        if not white_m:
            assert lasting == pytest.approx(lasting_m, rel=0.04, abs=1e-6)

    def test_people_who_turn_are_not_taken_for_noise(self):
        assert np.hypot(*self.seen(0.01, 0.0, turns=0.5)) < 0.06
        assert self.seen(0.1, 0.0, turns=0.5)[0] == pytest.approx(0.1, rel=0.3)

    def test_times_one_by_one_say_the_same_as_together(self):
        past = self.paths(0.1, 0.2)[:30]
        place = np.repeat(np.arange(30), 60)
        together = PositionNoise(STEP_S).variances_m2(np.ones(30, int), place, past.reshape(-1, 8, 2))
        noise, none = PositionNoise(STEP_S), np.zeros(60, int)
        alone = [noise.variances_m2(np.ones(1, int), none, one) for one in past]
        assert np.array(together).T.tolist() == [[white.item(), lasting.item()] for white, lasting in alone]

    def test_what_is_older_counts_less(self):
        noise, passed, none = PositionNoise(STEP_S), np.array([1]), np.zeros(60 * 93, int)
        for white_m in (0.3, 0.1):
            noise.variances_m2(passed, none, self.paths(white_m, 0.0).reshape(-1, 8, 2))
        later = noise.variances_m2(np.array([1000]), none[:60], self.paths(0.1, 0.0)[0])
        assert np.sqrt(later[0].item()) == pytest.approx(0.1, rel=0.35)

    def test_errors_of_noise_that_lasts_are_smaller_near_and_larger_far_than_they_seem(self):
        """A person stands; a forecast is the last measured position, and is compared with measured ones later."""
        past = self.paths(0.0, 0.3).reshape(-1, 8, 2)
        found = NoiseOfErrors(*(part[0] for part in self.effect(past)))
        off = self.lasting(np.random.default_rng(3), 0.3, 13, 20_000)
        added = [np.var(later - off[0]) - np.var(off[0]) for later in off[1:]]
        assert found.added.tolist() == pytest.approx(added, abs=0.03)
        assert found.added[0] < 0 < found.added[-1]
        assert (found.least <= np.var(off[0])).all()

    def test_of_white_noise_all_of_it_is_added(self):
        found = self.effect(self.paths(0.2, 0.0).reshape(-1, 8, 2))
        assert found.added[0].tolist() == pytest.approx([0.04] * 12, rel=0.25)

    def test_few_positions_and_unknown_ones_say_nothing(self):
        noise = PositionNoise(STEP_S)
        for past in (np.full((40, 8, 2), np.nan), np.empty((0, 8, 2)), np.zeros((9, 8, 2))):
            found = noise.follow(np.array([1]), np.zeros(len(past), int), past, 3)
            assert found.added.tolist() == found.least.tolist() == [[0, 0, 0]]

    def effect(self, past: np.ndarray) -> NoiseOfErrors:
        """The effect of noise on the errors of forecasts of 12 steps, after all of these pasts."""
        return PositionNoise(STEP_S).follow(np.array([1]), np.zeros(len(past), int), past, 12)


def test_nonnegative_least_squares_are_those_of_scipy():
    rng = np.random.default_rng(6)
    shapes = rng.uniform(0, 3, (200, 3, 3)) * 10.0 ** rng.uniform(-2, 2, (200, 3, 1))
    wanted = [lsq_linear(one, np.ones(3), (0, np.inf), tol=1e-14) for one in shapes]
    found = nonnegative(shapes)
    assert (found >= 0).all()
    left = ((shapes @ found[..., None])[..., 0] - 1) ** 2
    assert (left.sum(axis=1) / 2).tolist() == pytest.approx([one.cost for one in wanted], abs=1e-6)
