"""Calibrated forecasts: what the table says, and how it follows a log."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from mcaptrack.evaluation.metrics.displacement import ellipse_levels
from mcaptrack.geometry.arrays import taken
from mcaptrack.geometry.mixtures import Tails, mass_within, squared_radius
from mcaptrack.notices import Notice, listening
from mcaptrack.predictors import NAMES, Forecast, make, tail_calibration
from mcaptrack.predictors.position_noise import NoiseOfErrors, PositionNoise, nonnegative
from mcaptrack.predictors.tail_calibration import (
    TABLE_OF_CLASS,
    VEHICLE_TABLES,
    Learned,
    TailCalibration,
    calibrated_vehicles,
    correct,
    counts_of,
    follow,
    level_counts,
    table_of,
)
from mcaptrack.schema import TRACKS, Frame, Rows
from mcaptrack.schema.as_rows import tails_of
from mcaptrack.transforms import PROFILES
from mcaptrack.transforms.motion_limits import LIMITS
from mcaptrack.transforms.predict import Predict
from tests.worlds import ns, tracks_at
from tools.regression import fit_mixture

STEP_NS = 400_000_000


def walkers(count: int = 6, ticks: int = 80, noise_m: float = 0.01, seed: int = 1) -> list[Frame]:
    rng = np.random.default_rng(seed)
    out = []
    for tick in range(ticks):
        noise = noise_m * rng.normal(size=(count, 2))
        rows = tracks_at({n + 1: (0.5 * tick + noise[n, 0], 8.0 * (n + 1) + noise[n, 1]) for n in range(count)})
        out.append(Frame(tick * STEP_NS, tick, rows))
    return out


class TestTable:
    @pytest.mark.parametrize("name", NAMES)
    def test_every_predictor_has_one(self, name):
        table = table_of(name)
        assert len({len(part) for part in table}) == 1
        assert (table.narrow_scale < table.wide_scale).all()
        assert ((table.wide_weight > 0) & (table.wide_weight < 1)).all()
        assert table.short[0] > 1
        assert (table.coasting > 1).all()

    def test_at_other_times_it_is_between_its_neighbours(self):
        table = table_of("red")
        (one,) = zip(*table.at(np.array([0.6])), strict=True)
        for value, part in zip(one[1:], table[1:], strict=True):
            assert min(part[:2]) <= value <= max(part[:2])
        assert table.at(np.array([0.1, 9.0])).wide_scale.tolist() == pytest.approx(table.wide_scale[[0, -1]].tolist())


def test_a_mixture_is_found_again_from_its_samples():
    rng = np.random.default_rng(2)
    scale = np.where(rng.random(50_000) < 0.3, 6.0, 0.5)
    half = scale * (rng.normal(size=(50_000, 2)) ** 2).sum(axis=1) / 2
    counts = counts_of(np.zeros(len(half), np.int64), half, 1)
    assert counts.sum() == len(half)
    found = fit_mixture(counts, Tails(*(np.array([part]) for part in (0.5, 0.2, 2.0))), 200)
    assert [part.item() for part in found] == pytest.approx([0.3, 0.5, 6.0], rel=0.08)


class TestFollowing:
    """What mixtures become after a table and the comparisons of a log, over many iterations."""

    TABLE = Tails(np.full(3, 0.2), np.array([0.3, 0.5, 0.6]), np.array([2.0, 3.0, 4.0]))

    def followed(self, halves: list[np.ndarray], noise: float = 0.0, least: float = 0.0) -> Tails:
        ahead = np.repeat(np.arange(3), [len(part) for part in halves])
        counts = counts_of(ahead, np.concatenate(halves), 3)
        learned = Learned(counts, np.zeros(3), np.full(3, noise), np.full(3, least))
        return follow(self.TABLE, self.TABLE, learned, 100)

    def samples(self, narrow: float, wide: float, count: int, noise: float = 0.0) -> np.ndarray:
        rng = np.random.default_rng(3)
        scale = np.where(rng.random(count) < 0.3, wide, narrow) + noise
        return scale * rng.exponential(size=count)

    @pytest.mark.parametrize("noise", [0.0, 0.5])
    def test_after_many_they_are_those_of_the_log_without_the_noise_of_its_positions(self, noise):
        found = self.followed([self.samples(1.0, 20.0, 50_000, noise)] * 3, noise)
        for one, wanted in zip(found, (0.3, 1.0, 20.0), strict=True):
            assert one.tolist() == pytest.approx([wanted] * 3, rel=0.08)

    def test_what_is_known_of_the_near_future_counts_for_the_distant_one_but_less(self):
        nothing = np.empty(0)
        found = self.followed([self.samples(0.03, 0.2, 500), nothing, nothing]).narrow_scale / self.TABLE.narrow_scale
        assert found[0] < 0.2
        assert found[0] < found[1] == pytest.approx(found[2])
        assert found[1] < 0.5

    def test_large_and_small_errors_count_alike(self):
        """Scales are averaged as logarithms: a log with a tenth of the errors changes as much as one with ten times."""
        less, more = (self.followed([np.full(20, 0.5 * factor)] * 3) for factor in (0.01, 100.0))
        smaller = np.log(less.narrow_scale / self.TABLE.narrow_scale)
        larger = np.log(more.wide_scale / self.TABLE.wide_scale)
        assert (smaller < -2).all()
        assert (larger > 0.5).all()

    def test_errors_are_no_smaller_than_positions_are_known(self):
        tiny = [np.full(1000, 1e-4)] * 3
        assert self.followed(tiny, least=0.2).narrow_scale.tolist() == pytest.approx([0.2] * 3, rel=0.01)
        assert (self.followed(tiny).narrow_scale < 0.01).all()


class TestCalibration:
    def forecasts(
        self,
        sd_m: float,
        noise_m: float = 0.0,
        steps: int = 60,
        tracks: int = 40,
        adapts: bool = True,
        ring: bool = False,
        passing: int = 0,
    ):
        """Errors of a known size of a predictor that says 1 m; the levels of the ellipses that hold them, by time.

        With ``ring`` they are all about as large; ``passing`` tracks are others each time.
        """
        rng = np.random.default_rng(4)
        predictor = make("kalman", 3, 0.4)
        self.calibration = calibration = TailCalibration.of("kalman", predictor, adapts)
        ids, levels = np.arange(tracks), []
        place = np.zeros((steps + 4, tracks, 2))
        for step in range(steps):
            off = rng.normal(size=(tracks, 3, 2))
            if ring:
                off *= rng.uniform(0.8, 1, (tracks, 3, 1)) / np.linalg.norm(off, axis=2, keepdims=True)
            mean = np.stack([place[step + k] for k in (1, 2, 3)], axis=1) + sd_m * off
            ids[tracks - passing :] += tracks
            cov = np.tile(np.eye(2), (tracks, 3, 1, 1))
            past = noise_m * rng.normal(size=(tracks, 8, 2))
            made, tails = calibration(
                np.full(tracks, step), ids.copy(), Forecast(mean, cov), past, np.zeros(tracks, bool)
            )
            truth = np.stack([place[step + k] for k in (1, 2, 3)], axis=1)
            levels.append(ellipse_levels(made.mean - truth, made.cov, tails))
        return np.array(levels)

    @pytest.mark.parametrize("sd_m", [0.05, 0.5, 3.0])
    def test_ellipses_come_to_hold_what_they_say(self, sd_m):
        levels = self.forecasts(sd_m)[30:]
        for level in (0.5, 0.95):
            assert (levels <= level).mean() == pytest.approx(level, abs=0.04)

    def test_they_are_no_smaller_than_noise_allows(self):
        self.forecasts(0.001, noise_m=0.3)
        nothing = Forecast(np.zeros((1, 3, 2)), np.tile(np.eye(2), (1, 3, 1, 1)))
        made, tails = self.calibration(np.array([60]), np.array([-1]), nothing, np.zeros((1, 8, 2)), np.zeros(1, bool))
        assert (made.cov[0, :, 0, 0] * tails.narrow_scale[0] > 0.27 * 0.3**2).all()

    def test_tracks_that_are_lost_count_as_some_large_errors(self):
        weights = []
        for passing in (0, 200):
            self.forecasts(0.3, passing=passing, tracks=20 + passing)
            nothing = Forecast(np.zeros((1, 3, 2)), np.tile(np.eye(2), (1, 3, 1, 1)))
            _, tails = self.calibration(np.array([60]), np.array([-1]), nothing, np.zeros((1, 8, 2)), np.zeros(1, bool))
            weights.append(tails.wide_weight[0, 0])
        assert weights[0] < 0.8 * weights[1]

    def test_errors_that_are_much_larger_than_in_the_table_are_a_warning(self):
        for sd_m, adapts, codes in ((0.9, True, []), (3.0, False, []), (1.5, True, ["ellipses"])):
            self.forecasts(sd_m, steps=20, adapts=adapts)
            warned: list[Notice] = []
            with listening(warned.append):
                self.calibration.warn("kalman")
            assert [one.code for one in warned] == codes

    def test_unknown_positions_and_certain_predictions_are_not_compared(self):
        predictor = make("cv", 3, 0.4)
        calibration = TailCalibration.of("cv", predictor)
        for step in range(20):
            past = np.tile([1.0, 2.0], (3, 8, 1))
            past[1] = np.nan
            mean, cov = np.tile([1.0, 2.0], (3, 3, 1)), np.tile(np.eye(2), (3, 3, 1, 1))
            cov[2] = 0.0
            made, tails = calibration(np.full(3, step), np.arange(3), Forecast(mean, cov), past, np.zeros(3, bool))
        assert np.isfinite(tails).all()
        assert np.isfinite(made.cov).all()
        assert (tails.narrow_scale[0] < 0.5).all()

    def test_ellipses_are_of_true_positions_though_measured_ones_have_noise(self):
        levels = self.forecasts(0.3, noise_m=0.3, steps=200)[100:]
        assert (levels <= 0.5).mean() == pytest.approx(0.5, abs=0.08)

    @pytest.mark.parametrize("together", [7, 60])
    def test_many_times_at_once_give_the_same_as_one_by_one(self, together):
        rng, predictor = np.random.default_rng(8), make("kalman", 12, 0.4)
        step = np.repeat(np.array([*range(30), *range(47, 77)]), 9)
        ids, coasts = np.tile(np.arange(9), 60) + 9 * (step // 10), rng.random(540) < 0.1
        past = 0.4 * (step[:, None, None] + np.arange(-7, 1)[:, None]) + rng.normal(0, 0.1, (540, 8, 2))
        past[rng.random(540) < 0.1, :4] = np.nan
        forecast = predictor.predict(past, np.isfinite(past[..., 0]))

        def calibrated(times: int) -> list[np.ndarray]:
            calibration, parts = TailCalibration.of("kalman", predictor), []
            for low in range(0, 540, 9 * times):
                here = slice(low, low + 9 * times)
                one = Forecast(forecast.mean[here], forecast.cov[here])
                made, tails = calibration(step[here], ids[here], one, past[here], coasts[here])
                parts.append((made.mean, made.cov, *tails))
            return [np.concatenate(part) for part in zip(*parts, strict=True)]

        alone, many = calibrated(1), calibrated(together)
        assert np.ptp(alone[3][:, 5]) > 0.1
        for one, other in zip(alone, many, strict=True):
            np.testing.assert_array_equal(one, other)

    def test_fits_are_rarer_after_some_time_and_only_while_tracks_are_seen(self):
        """Every 0.8 s, from 16 s on after a twentieth of the time, at most every 4 s."""
        predictor = make("cv", 3, 0.4)
        calibration, changed, last = TailCalibration.of("cv", predictor), [], None
        for step in [*range(300), *range(1000, 1010)]:
            past = np.tile(np.random.default_rng(step).normal(size=(1, 8, 2)), (2, 1, 1))
            forecast = predictor.predict(past, np.ones((2, 8), bool))
            _, tails = calibration(np.full(2, step), np.arange(2), forecast, past, np.full(2, 50 < step < 60))
            now = tails.narrow_scale[0].tolist()
            if last is not None and now != last:
                changed.append(step)
            last = now
        assert changed[:4] == [2, 4, 6, 8]
        assert [step for step in changed if 40 < step < 64] == [42, 44, 46, 48, 50, 60, 63]
        assert changed[-4:] == [272, 282, 292, 1000]

    def test_the_covariance_is_that_of_the_mixture(self):
        predictor = make("red", 12, 0.4)
        calibration = TailCalibration.of("red", predictor)
        past = np.cumsum(np.full((2, 8, 2), 0.3), axis=1)
        plain = predictor.predict(past, np.ones((2, 8), bool))
        made, tails = calibration(np.zeros(2, int), np.array([1, 2]), plain, past, np.zeros(2, bool))
        weight, narrow, wide = tails
        assert ((1 - weight) * narrow + weight * wide).ravel().tolist() == pytest.approx([1.0] * 24)
        assert made.mean.tolist() == plain.mean.tolist()
        assert (squared_radius(0.5, tails) < 2 * np.log(2)).all()  # most errors are small

    def test_short_and_coasting_tracks_have_larger_ellipses(self):
        predictor = make("kalman", 12, 0.4)
        past = np.cumsum(np.full((3, 8, 2), 0.3), axis=1)
        past[1, :4] = np.nan
        given = Forecast(np.zeros((3, 12, 2)), np.tile(np.eye(2), (3, 12, 1, 1)))
        calibration, coasts = TailCalibration.of("kalman", predictor), np.array([False, False, True])
        made, _ = calibration(np.zeros(3, int), np.arange(3), given, past, coasts)
        whole, short, coasting = made.cov[:, :, 0, 0]
        assert (short > whole).all()
        assert (coasting > short).all()


class TestInTransforms:
    def test_positions_on_both_sides_of_times_with_velocities_are_not_neighbours(self, monkeypatch):
        """People on straight lines have no bends, also where some of their rows are of another tracker."""
        seen: list[np.ndarray] = []
        given = PositionNoise.variances_m2

        def kept(noise: PositionNoise, passed: np.ndarray, place: np.ndarray, past: np.ndarray) -> Any:
            seen.append(past)
            return given(noise, passed, place, past)

        monkeypatch.setattr(PositionNoise, "variances_m2", kept)
        frames = walkers(noise_m=0.0)
        for frame in frames[30:33]:
            frame.rows["vx_m_per_s"] = frame.rows["vy_m_per_s"] = 1.0
        list(Predict()(frames))
        bends = np.diff(np.concatenate(seen), 2, axis=1)
        assert np.isfinite(bends).any()
        assert np.nanmax(np.abs(bends)) < 1e-9

    def test_the_profiles_of_the_paper_have_none(self):
        for name in ("paper", "authors"):
            made = [frames[2].rows for frames in PROFILES[name](walkers(ticks=20))]
            assert sum(len(rows) for rows in made) > 100
            assert all(np.isnan(part).all() for rows in made for part in tails_of(rows))

    def test_a_network_that_loses_to_constant_velocity_says_so(self):
        warned: list[Notice] = []
        for transform in (Predict(predictor="lstm"), replace(PROFILES["default"], predictor="lstm")):
            with listening(warned.append):
                list(transform(walkers(ticks=8)))
            assert [warned.pop().code] == ["weak-predictor"]
        with listening(warned.append):
            for name in ("red", "cv"):
                list(Predict(predictor=name)(walkers(ticks=8)))
        assert warned == []


# Forecasts of vehicles are mixtures, by class and by whether they stand


TABLE = {"ahead_s": [1.0, 2.0], "wide_weight": [0.2, 0.4], "narrow_scale": [0.1, 0.4], "wide_scale": [2.0, 8.0]}
TABLES = {
    "red": {kind: {"standing": TABLE, "moving": TABLE | {"wide_weight": [0.5, 0.5]}} for kind in ("car", "truck")}
}


def forecast(count: int, steps: int = 3) -> Forecast:
    half = np.random.default_rng(0).normal(size=(count, steps, 2, 2))
    return Forecast(np.zeros((count, steps, 2)), half @ half.transpose(0, 1, 3, 2))


def test_mixtures_by_hand(monkeypatch: pytest.MonkeyPatch):
    """A standing car, a moving bus, a person, and a car whose speed is unknown; steps at 0.75, 1.5 and 2.25 s."""
    monkeypatch.setattr(tail_calibration, "tables_in", lambda path: TABLES)
    given = forecast(4)
    names, speed = ["car", "bus", "person", "car"], np.array([0.4, 0.5, 9.0, np.nan])
    made, shapes = calibrated_vehicles("red", given, 0.75, names, speed)
    assert shapes is not None
    narrow, wide = np.array([0.1, 0.2, 0.4]), np.array([2.0, 4.0, 8.0])  # the logarithms are interpolated
    for row, weight in ((0, np.array([0.2, 0.3, 0.4])), (1, np.full(3, 0.5))):
        whole = (1 - weight) * narrow + weight * wide
        np.testing.assert_allclose(made.cov[row], given.cov[row] * whole[:, None, None])
        np.testing.assert_allclose([part[row] for part in shapes], [weight, narrow / whole, wide / whole])
    np.testing.assert_array_equal(made.cov[2:], given.cov[2:])
    assert np.isnan([part[2:] for part in shapes]).all()
    np.testing.assert_array_equal(made.mean, given.mean)
    assert calibrated_vehicles("cv", given, 0.75, names, speed) == (given, None)


def test_the_tables_that_ship_are_distributions_for_all_vehicles():
    tables = json.loads(VEHICLE_TABLES.read_text())
    assert "no recordings" in tables["card"]["data"]
    assert {name for name, row in LIMITS.items() if row.turns} == set(TABLE_OF_CLASS)
    names = sorted(TABLE_OF_CLASS)
    for speed in (0.0, 5.0):
        _, shapes = calibrated_vehicles("red", forecast(len(names)), 0.4, names, np.full(len(names), speed))
        assert shapes is not None
        weight, narrow, wide = shapes
        np.testing.assert_allclose((1 - weight) * narrow + weight * wide, 1.0)
        assert (weight > 0).all()
        assert (weight < 1).all()
        assert (narrow > 0).all()
        assert (narrow < wide).all()


def test_only_forecasts_of_vehicles_in_metres_are_mixtures():
    frames = []
    for tick in range(10):
        rows = TRACKS.rows(
            track_id=[1, 2], class_id=[3, 1], x_m=[4.0 * tick, 0.5 * tick], y_m=[0.0, 9.0], observed=[True] * 2,
            source_id=[1, 2], vx_m_per_s=[10.0, 1.25], vy_m_per_s=[0.0] * 2,
        )  # fmt: skip
        frames.append(Frame(tick * 400_000_000, tick, rows))
    last = [rows.rows for (rows,) in Predict(predictor="red", class_names=((1, "person"), (3, "car")))(frames)][-1]
    is_mixture = {one: np.isfinite(last["wide_weight"][last["track_id"] == one]) for one in (1, 2)}
    assert len(is_mixture[1]) == 12
    assert is_mixture[1].all()
    assert len(is_mixture[2]) == 12
    assert not is_mixture[2].any()


# Predictions of vehicles that stand: they stay, and ellipses are as small as that is certain


CLASS_NAMES = ((1, "pedestrian"), (3, "car"))
STEPS = 10


def last_forecast(class_id: int, speed_m_per_s: float, in_metres: bool, stops: int = 0, predictor: str = "red") -> Rows:
    """The forecast of an object along x, with or without the velocities that a tracker in metres gives."""
    velocity = {"vx_m_per_s": [speed_m_per_s], "vy_m_per_s": [0.0]} if in_metres else {}
    frames = []
    for tick in range(STEPS):
        x_m = speed_m_per_s * min(tick, STEPS - stops) / 2.5
        rows = TRACKS.rows(
            track_id=[1], x_m=[x_m], y_m=[0.0], observed=[True], source_id=[-1], class_id=[class_id], **velocity
        )
        frames.append(Frame(ns(tick / 2.5), tick, rows))
    return [frame.rows for (frame,) in Predict(predictor=predictor, class_names=CLASS_NAMES)(frames)][-1]


def axis_m(rows: Rows) -> float:
    """Half of the longer axis of the last 95 % ellipse, by its largest eigenvalue."""
    xx, xy, yy = (float(rows[name][-1]) for name in ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2"))
    return float(np.sqrt(-2 * np.log(0.05) * np.linalg.eigvalsh([[xx, xy], [xy, yy]])[-1]))


@pytest.fixture
def as_predicted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ellipses as predictors make them: otherwise they follow the log, and those of vehicles are mixtures."""
    monkeypatch.setattr(TailCalibration, "of", lambda *_: None)
    monkeypatch.setattr(tail_calibration, "tables_in", lambda path: {})


@pytest.mark.usefixtures("as_predicted")
@pytest.mark.parametrize("predictor", ["red", "kalman", "cv"])
def test_a_car_that_stands_has_an_ellipse_of_a_few_metres(predictor: str):
    before, now = (axis_m(last_forecast(3, 0.0, known, predictor=predictor)) for known in (False, True))
    assert before > 8
    assert 1 < now < 7
    assert now < before / 2


@pytest.mark.usefixtures("as_predicted")
@pytest.mark.parametrize(("class_id", "speed_m_per_s"), [(3, 8.0), (1, 0.0), (1, 1.3)])
def test_what_moves_and_people_are_predicted_as_without_velocities(class_id: int, speed_m_per_s: float):
    given, without = (last_forecast(class_id, speed_m_per_s, known) for known in (True, False))
    for name in ("x_m", "y_m", "cov_xx_m2", "cov_yy_m2"):
        np.testing.assert_allclose(given[name], without[name], rtol=1e-6)


@pytest.mark.usefixtures("as_predicted")
def test_a_car_that_has_just_stopped_may_go_on():
    stopped, stands = (axis_m(last_forecast(3, speed, True, stops=3)) for speed in (8.0, 0.0))
    assert stopped > 3 * stands


@pytest.mark.usefixtures("as_predicted")
def test_a_car_that_hardly_moves_goes_on_from_where_it_is():
    way_m = last_forecast(3, 0.1, True, predictor="cv")["x_m"] - 0.1 * (STEPS - 1) / 2.5
    np.testing.assert_allclose(way_m / way_m[0], np.arange(1, len(way_m) + 1), rtol=1e-5)
    assert way_m[0] < 0.02  # of 4 cm, since it may stand


# Ellipses corrected by what they have held, and the noise of positions as far as tracks show it


AHEAD, STEP_S = 3, 0.4
SHAPE = Tails(np.full(AHEAD, 0.3), np.full(AHEAD, 0.5), np.full(AHEAD, 5.0))
AT_ONE_TIME = Tails(*(part[None] for part in SHAPE))


def held(size: float, count: int) -> tuple[Tails, np.ndarray]:
    """The correction of a mixture after errors ``size`` times as large as it says; half their squared distances."""
    rng = np.random.default_rng(1)
    scale = size * np.where(rng.random((AHEAD, count)) < 0.3, 5.0, 0.5)
    half = scale * rng.exponential(size=(AHEAD, count))
    step = np.repeat(np.arange(AHEAD), count)
    counts = level_counts(step, half.ravel(), taken(SHAPE, step), AHEAD)
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
        step, half = np.repeat(np.arange(AHEAD), 30), np.tile(np.geomspace(0.2, 20, 30), AHEAD)
        counts = level_counts(step, half, taken(SHAPE, step), AHEAD) * np.array([[0.0], [0.0], [1.0]])
        (found,) = correct(AT_ONE_TIME, counts[None]).narrow_scale
        assert found[2] > found[0] > 0.5


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
