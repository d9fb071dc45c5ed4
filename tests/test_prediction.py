"""Sampling, predictors, prediction."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.predictors import make
from mcaptrack.predictors.linear import (
    DRIFT_M2_PER_S3,
    MAX_SCALE,
    MIN_SCALE,
    POSITION_NOISE_M,
    PRIOR_COUNT,
    SPEED_M_PER_S,
    TAIL_FACTOR,
    LinearPredictor,
    linear_variance,
)
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.transforms import Predict, Sample
from tests.worlds import ids, ns, places, tracks_at, walk

NETWORKS = ["red", "lstm"]
LINEAR = ["cv", "holt-cv", "kalman"]
every_linear = pytest.mark.parametrize("name", LINEAR)
every_predictor = pytest.mark.parametrize("name", [*LINEAR, *NETWORKS])
SEEDS = st.integers(0, 2**32 - 1)
PASTS = hnp.arrays(float, st.tuples(st.integers(1, 4), st.integers(1, 10), st.just(2)), elements=st.floats(-50, 50))


def sampled(frames, **options):
    return [frame for (frame,) in Sample(**options)(frames)]


class TestSample:
    def test_ticks_lie_between_frames(self):
        frames = [Frame(ns(n / 7), n, tracks_at({4: (n / 7, 0.0)})) for n in range(15)]
        out = sampled(frames)
        assert [frame.t_ns for frame in out] == [ns(0.4 * n) for n in range(6)]
        np.testing.assert_allclose([frame.rows["x_m"][0] for frame in out], 0.4 * np.arange(6), atol=1e-6)
        assert [frame.index for frame in out] == [0, 2, 5, 8, 11, 14]  # the picture on screen then
        assert all(frame.rows["observed"].all() for frame in out)
        assert all(frame.rows["source_id"].tolist() == [4] for frame in out)

    def test_labels_on_the_clock_stay_as_they_are(self):
        frames = walk(lambda n: {1: (n * 0.37, -n), 2: (5.0, 5.0)}, 20)
        out = sampled(frames, start_ns=0)
        assert [places(frame) for frame in out] == [places(frame) for frame in frames]
        assert [frame.t_ns for frame in out] == [frame.t_ns for frame in frames]

    def test_the_clock_may_begin_before_the_tracks(self):
        frames = [Frame(ns(1.0 + n / 10), n, tracks_at({1: (n / 10, 0)})) for n in range(10)]
        assert [frame.t_ns for frame in sampled(frames, start_ns=ns(0.0))] == [ns(1.2), ns(1.6)]

    def test_short_gaps_are_interpolated_and_marked_and_long_ones_stay(self):
        def path(n):
            return {} if 3 <= n <= 5 or (n > 10 and n < 18) else {1: (float(n), 0.0)}

        out = {frame.t_ns: frame for frame in sampled(walk(path, 25), max_gap_s=2.0)}
        seen = {tick: out[ns(0.4 * tick)].rows for tick in range(25)}
        assert [seen[tick]["observed"].tolist() for tick in range(2, 7)] == [[True], [False], [False], [False], [True]]
        assert [seen[tick]["x_m"].tolist() for tick in (3, 4, 5)] == [[3.0], [4.0], [5.0]]
        assert all(len(seen[tick]) == 0 for tick in range(11, 18))

    def test_boxes_are_projected_by_the_plane_valid_at_their_time(self):
        rows = TRACKS.rows(
            track_id=[1], x_px=[10.0], y_px=[20.0], w_px=[4.0], h_px=[8.0], observed=[True], source_id=[-1]
        )
        planes = [
            (0, GroundPlane((0.1, 0, 0, 0, 0.1, 0, 0, 0, 1), 99, 99)),
            (ns(0.4), GroundPlane((1, 0, 0, 0, 1, 0, 0, 0, 1), 99, 99)),
        ]
        out = sampled([Frame(0, 0, rows), Frame(ns(0.4), 1, rows)], ground_planes=planes)
        assert [places(frame) for frame in out] == [{1: (1.2, 2.8)}, {1: (12.0, 28.0)}]
        with pytest.raises(McaptrackError, match="tracks are in pixels, and there is no ground plane"):
            sampled([Frame(0, 0, rows)])

    def test_boxes_above_the_horizon_are_left_out(self):
        tilted = GroundPlane((0.01, 0, 0, 0, 0.01, 0, 0, 0.01, -1), 200, 200)
        rows = TRACKS.rows(
            track_id=[1, 2],
            x_px=[10.0, 10],
            y_px=[20.0, 150],
            w_px=[4.0, 4],
            h_px=[8.0, 8],
            observed=[True] * 2,
            source_id=[-1] * 2,
        )
        (frame,) = sampled([Frame(0, 0, rows)], ground_planes=[(0, tilted)])
        assert ids(frame) == [2]

    def test_a_log_that_jumps_over_a_year_has_no_ticks_in_between(self):
        year = 365 * 86400
        out = sampled([Frame(ns(s), 0, tracks_at({1: (0, 0)})) for s in (0, 0.4, 0.8, year, year + 0.4)])
        assert len(out) == 5


class TestPredictors:
    @every_predictor
    @given(past=PASTS, shift=hnp.arrays(float, 2, elements=st.floats(-1e3, 1e3)))
    def test_translated_tracks_have_translated_forecasts(self, name, past, shift):
        predictor, known = make(name, 12, 0.4), np.ones(past.shape[:2], bool)
        here, there = predictor.predict(past, known), predictor.predict(past + shift, known)
        np.testing.assert_allclose(there.mean, here.mean + shift, atol=1e-6)
        np.testing.assert_allclose(there.cov, here.cov, rtol=1e-6, atol=1e-6)

    @pytest.mark.parametrize("name", [*LINEAR, "red"])
    @given(past=PASTS, angle=st.floats(0, 7))
    def test_rotated_tracks_have_rotated_forecasts(self, name, past, angle):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        predictor, known = make(name, 12, 0.4), np.ones(past.shape[:2], bool)
        turned, straight = predictor.predict(past @ turn.T, known), predictor.predict(past, known)
        np.testing.assert_allclose(turned.mean, straight.mean @ turn.T, atol=1e-6)
        np.testing.assert_allclose(turned.cov, turn @ straight.cov @ turn.T, rtol=1e-6, atol=1e-6)

    @every_predictor
    @given(past=PASTS, seed=SEEDS)
    def test_unknown_positions_do_not_matter_and_covariances_are_positive_definite(self, name, past, seed):
        rng, predictor = np.random.default_rng(seed), make(name, 12, 0.4)
        known = rng.random(past.shape[:2]) < 0.6
        known[:, -1] = True
        forecast = predictor.predict(np.where(known[..., None], past, np.nan), known)
        other = predictor.predict(np.where(known[..., None], past, rng.normal(size=past.shape)), known)
        np.testing.assert_array_equal(other.mean, forecast.mean)
        np.testing.assert_array_equal(other.cov, forecast.cov)
        assert (np.linalg.eigvalsh(forecast.cov) > 0).all()
        np.testing.assert_array_equal(forecast.cov, forecast.cov.transpose(0, 1, 3, 2))
        more = np.concatenate([rng.normal(size=(len(past), 12, 2)), past], axis=1)
        padded = np.concatenate([np.zeros((len(past), 12), bool), known], axis=1)
        np.testing.assert_allclose(predictor.predict(more, padded).mean, forecast.mean, atol=1e-9)

    @every_predictor
    @given(past=PASTS)
    def test_tracks_of_a_batch_do_not_affect_each_other(self, name, past):
        predictor, known = make(name, 12, 0.4), np.ones(past.shape[:2], bool)
        whole = predictor.predict(past, known)
        for number in range(len(past)):
            alone = predictor.predict(past[number : number + 1], known[number : number + 1])
            np.testing.assert_allclose(whole.mean[number], alone.mean[0], atol=1e-9)
            np.testing.assert_allclose(whole.cov[number], alone.cov[0], atol=1e-9)

    @every_linear
    def test_straight_lines_are_extrapolated(self, name):
        steps = np.arange(8)[:, None] * [0.5, -0.2]
        forecast = make(name, 12, 0.4).predict(steps[None], np.ones((1, 8), bool))
        ahead = 7 + np.arange(1, 13)
        wanted = ahead[:, None] * [0.5, -0.2]
        # The Kalman filter starts from "at rest, perhaps" and never quite forgets it.
        np.testing.assert_allclose(forecast.mean[0], wanted, rtol=0.02 if name == "kalman" else 1e-9)

    @every_linear
    def test_one_known_position_is_predicted_to_stay_with_large_variance(self, name):
        past = np.array([[[np.nan, np.nan], [3.0, 4.0]]])
        forecast = make(name, 12, 0.4).predict(past, np.array([[False, True]]))
        np.testing.assert_allclose(forecast.mean[0], np.tile([3.0, 4.0], (12, 1)))
        spread = np.sqrt(forecast.cov[0, :, 0, 0])
        assert (np.diff(spread) > 0).all()
        assert spread[-1] > 4.8 * SPEED_M_PER_S

    @every_predictor
    def test_an_empty_batch_gives_no_forecasts(self, name):
        forecast = make(name, 12, 0.4).predict(np.empty((0, 8, 2)), np.empty((0, 8), bool))
        assert forecast.mean.shape == (0, 12, 2)
        assert forecast.cov.shape == (0, 12, 2, 2)

    def test_the_mean_of_three_steps_by_hand(self):
        past = np.array([[[9.0, 0], [0, 0], [1, 0], [3, 0], [6, 3]]])
        forecast = make("cv", 2, 0.4).predict(past, np.ones((1, 5), bool))
        np.testing.assert_allclose(forecast.mean[0], [[8, 4], [10, 5]])  # (6 - 0) / 3, (3 - 0) / 3

    def test_smoothed_velocity_by_hand(self):
        past = np.array([[[0.0, 0], [1, 0], [3, 0], [7, 0]]])  # displacements 1, 2, 4: level 2.875 as in Eq. 3
        forecast = make("holt-cv", 2, 0.4).predict(past, np.ones((1, 4), bool))
        np.testing.assert_allclose(forecast.mean[0, :, 0], [9.875, 12.75])

    def test_kalman_weights_equal_a_kalman_filter(self):
        """Against a filter with matrices, on noisy positions."""
        rng, step = np.random.default_rng(2), 0.4
        seen = np.cumsum(rng.normal(0.4, 0.2, 8))
        move = np.array([[1, step], [0, 1]])
        noise = DRIFT_M2_PER_S3 * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
        state, cov = np.array([seen[0], 0.0]), np.diag([POSITION_NOISE_M**2, SPEED_M_PER_S**2])
        surprise = 0.0
        for value in seen[1:]:
            state, cov = move @ state, move @ cov @ move.T + noise
            gain = cov[:, 0] / (cov[0, 0] + POSITION_NOISE_M**2)
            surprise += 2 * (value - state[0]) ** 2 / (cov[0, 0] + POSITION_NOISE_M**2)  # along x and along y
            state, cov = state + gain * (value - state[0]), cov - np.outer(gain, cov[0])
        forecast = make("kalman", 12, step).predict(np.stack([seen, seen], -1)[None], np.ones((1, 8), bool))
        scale = TAIL_FACTOR * np.clip((PRIOR_COUNT + surprise) / (PRIOR_COUNT + 14), MIN_SCALE, MAX_SCALE)
        for ahead in range(1, 13):
            state, cov = move @ state, move @ cov @ move.T + noise
            np.testing.assert_allclose(forecast.mean[0, ahead - 1], state[0], rtol=1e-9)
            np.testing.assert_allclose(forecast.cov[0, ahead - 1], scale * cov[0, 0] * np.eye(2), rtol=1e-9)

    @every_linear
    @pytest.mark.parametrize("known", [1, 2, 4, 8])
    def test_variance_equals_that_of_simulated_motion(self, name, known):
        """Simulate the motion model: the variance of the errors equals that of the forecast."""
        rng, step, fine, people = np.random.default_rng(known), 0.4, 8, 20_000
        speed = rng.normal(0, SPEED_M_PER_S, people)
        place, path = np.zeros(people), []
        for _ in range(known + 12):
            path.append(place.copy())
            for _ in range(fine):
                kick = rng.normal(0, np.sqrt(DRIFT_M2_PER_S3 * step / fine), people)
                place += (speed + kick / 2) * step / fine
                speed = speed + kick
        path = np.array(path).T
        seen = path[:, :known] + rng.normal(0, POSITION_NOISE_M, (people, known))
        forecast = make(name, 12, step).predict(np.stack([seen, seen], -1), np.ones((people, known), bool))
        errors = forecast.mean[:, :, 0] - path[:, known:]
        predictor = LinearPredictor(name, 12, step)
        said = np.sqrt(predictor.table[1][min(known, predictor.past)])
        np.testing.assert_allclose(errors.std(axis=0), said, rtol=0.04)

    @pytest.mark.parametrize("known", [2, 3, 5, 8])
    def test_the_scale_is_that_of_the_innovations_of_a_kalman_filter(self, known):
        """Four innovations of variance 1 are assumed beside those that are seen, along both axes; then 1.5 times."""
        rng, step_s = np.random.default_rng(known), 0.4
        pasts = np.cumsum(rng.normal(0.3, [[[0.1]], [[0.25]], [[0.3]], [[0.4]]], (4, known, 2)), axis=1)
        total = np.zeros(4)
        move = np.array([[1.0, step_s], [0.0, 1.0]])
        noise = 0.06 * np.array([[step_s**3 / 3, step_s**2 / 2], [step_s**2 / 2, step_s]])
        for track in range(4):
            for axis in range(2):
                state, cov = np.array([pasts[track, 0, axis], 0.0]), np.diag([0.04, 1.0])
                for seen in pasts[track, 1:, axis]:
                    state, cov = move @ state, move @ cov @ move.T + noise
                    spread = cov[0, 0] + 0.04
                    innovation, gain = seen - state[0], cov[:, 0] / spread
                    total[track] += innovation**2 / spread
                    state, cov = state + gain * innovation, cov - np.outer(gain, cov[0])
        wanted = 1.5 * np.clip((4 + total) / (4 + 2 * (known - 1)), 0.7, 2.0)
        assert len(set(wanted.tolist())) > 2 or known < 5
        for name in LINEAR:
            predictor = LinearPredictor(name, 3, step_s)
            cov = predictor.predict(pasts, np.ones((4, known), bool)).cov
            plain = predictor.table[1][min(known, predictor.past)]
            np.testing.assert_allclose(cov[:, :, 0, 0], wanted[:, None] * plain, rtol=1e-9)
            np.testing.assert_allclose(cov[:, :, 1, 1], cov[:, :, 0, 0])
            assert not cov[:, :, 0, 1].any()

    def test_variance_by_hand_for_standing_still(self):
        """One position, weight 1, predicted 1 s ahead: the variances of noise, velocity and drift add up."""
        variance = linear_variance(np.ones((1, 1)), np.array([0.0]), np.array([1.0]))
        assert variance[0] == pytest.approx(POSITION_NOISE_M**2 + SPEED_M_PER_S**2 + DRIFT_M2_PER_S3 / 3)
        assert variance[0] == pytest.approx(0.2**2 + 1 + 0.06 / 3)

    def test_variance_depends_on_no_clock(self):
        weights, times, ahead = np.array([[-1.0, 0.5, 1.5], [-2.0, 1.0, 2.0]]), np.array([0.0, 0.4, 0.8]), [0.4, 0.8]
        here, later = (linear_variance(weights, start + times, np.array(ahead)) for start in (0.0, 100.0))
        np.testing.assert_allclose(here, later, rtol=1e-9)


class TestPredict:
    def run(self, frames, **options):
        return [frame for (frame,) in Predict(**options)(frames)]

    def test_one_row_per_step_for_each_track_with_enough_positions(self):
        out = self.run(
            walk(lambda n: {1: (0.5 * n, 0.0)} | ({2: (0.0, 1.0 * n)} if n >= 4 else {}), 10), predictor="cv"
        )
        assert [len(frame.rows) for frame in out] == [0, 0, 0, 12, 12, 12, 12, 24, 24, 24]
        rows = out[7].rows
        assert rows["track_id"].tolist() == [1] * 12 + [2] * 12
        assert rows["step"].tolist() == list(range(1, 13)) * 2
        np.testing.assert_allclose(rows["ahead_s"][:3], [0.4, 0.8, 1.2])
        np.testing.assert_allclose(rows["x_m"][:3], [4.0, 4.5, 5.0])
        np.testing.assert_allclose(rows["y_m"][12:15], [8.0, 9.0, 10.0])
        assert (rows["cov_xx_m2"] > 0).all()

    def test_nothing_is_predicted_from_inside_a_gap(self):
        frames = walk(lambda n: {1: (float(n), 0.0)}, 10)
        frames[6] = frames[6]._replace(rows=tracks_at({1: (6.0, 0.0)}, observed=False))
        out = self.run(frames)
        assert [len(frame.rows) > 0 for frame in out[4:8]] == [True, True, False, True]

    def test_horizon_and_rate_make_the_steps(self):
        out = self.run(
            walk(lambda n: {1: (float(n), 0.0)}, 10, rate_hz=5.0), rate_hz=5.0, horizon_s=2.0, predictor="cv"
        )
        assert out[9].rows["step"].max() == 10
        np.testing.assert_allclose(out[9].rows["ahead_s"].max(), 2.0)

    @pytest.mark.parametrize(("horizon_s", "steps"), [(0.1, 1), (0.6, 2), (0.61, 2), (1.0, 2), (1.01, 3)])
    def test_there_is_one_step_at_least_and_as_many_as_fit_best(self, horizon_s, steps):
        """At 2.5 steps a second; a half is rounded to the even number."""
        out = self.run(walk(lambda n: {1: (float(n), 0.0)}, 6), horizon_s=horizon_s, predictor="cv")
        assert out[-1].rows["step"].tolist() == list(range(1, steps + 1))

    def test_a_gap_in_the_clock_breaks_the_past(self):
        frames = [Frame(ns(0.4 * t), t, tracks_at({1: (float(t), 0.0)})) for t in (0, 1, 2, 3, 6, 7, 8, 9)]
        out = self.run(frames)
        assert [len(frame.rows) > 0 for frame in out] == [False, False, False, True, False, False, False, True]
