"""Sampling, predictors, prediction."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.predictors import make
from mcaptrack.predictors.linear import (
    DRIFT_M2_PER_S3,
    POSITION_NOISE_M,
    SPEED_M_PER_S,
    LinearPredictor,
)
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.transforms import Predict, Sample
from tests.worlds import ids, ns, places, walk

NETWORKS = ["red", "lstm"]
LINEAR = ["cv", "holt-cv", "kalman"]
every_linear = pytest.mark.parametrize("name", LINEAR)
every_predictor = pytest.mark.parametrize("name", [*LINEAR, *NETWORKS])


def sampled(frames, **options):
    return [frame for (frame,) in Sample(**options)(frames)]


class TestSample:
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


class TestPredictors:
    @every_linear
    def test_straight_lines_are_extrapolated(self, name):
        steps = np.arange(8)[:, None] * [0.5, -0.2]
        forecast = make(name, 12, 0.4).predict(steps[None], np.ones((1, 8), bool))
        ahead = 7 + np.arange(1, 13)
        wanted = ahead[:, None] * [0.5, -0.2]
        # The Kalman filter starts from "at rest, perhaps" and never quite forgets it.
        np.testing.assert_allclose(forecast.mean[0], wanted, rtol=0.02 if name == "kalman" else 1e-9)

    @every_predictor
    def test_an_empty_batch_gives_no_forecasts(self, name):
        forecast = make(name, 12, 0.4).predict(np.empty((0, 8, 2)), np.empty((0, 8), bool))
        assert forecast.mean.shape == (0, 12, 2)
        assert forecast.cov.shape == (0, 12, 2, 2)

    @every_linear
    @pytest.mark.parametrize("known", [1, 3, 8])
    def test_variance_equals_that_of_simulated_motion(self, name, known):
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


class TestPredict:
    def run(self, frames, **options):
        return [frame for (frame,) in Predict(**options)(frames)]

    @pytest.mark.parametrize(("horizon_s", "steps"), [(0.1, 1), (0.6, 2), (0.61, 2), (1.0, 2), (1.01, 3)])
    def test_there_is_one_step_at_least_and_as_many_as_fit_best(self, horizon_s, steps):
        """At 2.5 steps a second; a half is rounded to the even number."""
        out = self.run(walk(lambda n: {1: (float(n), 0.0)}, 6), horizon_s=horizon_s, predictor="cv")
        assert out[-1].rows["step"].tolist() == list(range(1, steps + 1))
