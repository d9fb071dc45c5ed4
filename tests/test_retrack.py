"""Re-tracking: Eq. 1 to 3 and every branch of Algorithm 1 by hand, and the paper's four failures as small scenes."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.histories import Holt
from mcaptrack.predictors import Forecast
from mcaptrack.transforms import PROFILES
from mcaptrack.transforms.retrack.consistency import SmoothedHistory
from mcaptrack.transforms.retrack.options import (
    mahalanobis,
    prediction_distances,
)
from tests.tiers import one_in
from tests.worlds import ids, places, tracks_at, walk

PAPER, AUTHORS, DEFAULT = PROFILES["paper"], PROFILES["authors"], PROFILES["default"]
every_profile = pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES)


def run(profile, frames):
    """Frames of offline tracks, online tracks and predictions."""
    return [list(part) for part in zip(*profile(frames), strict=True)]


def paths(frames) -> dict[int, dict[int, tuple[float, float]]]:
    """The positions of each id by tick."""
    out: dict[int, dict[int, tuple[float, float]]] = {}
    for tick, frame in enumerate(frames):
        for who, place in places(frame).items():
            out.setdefault(who, {})[tick] = place
    return out


def along(path: dict[int, tuple[float, float]], truth: dict[int, tuple[float, float]]) -> bool:
    """Whether a path has the ticks of another and is within 2 cm of it."""
    return path.keys() == truth.keys() and all(np.hypot(*np.subtract(path[t], truth[t])) < 0.02 for t in truth)


def line(start: float, step: float, count: int = 12) -> np.ndarray:
    """A forecast along the first axis: start + step, start + 2 step, ..."""
    return np.stack([start + step * np.arange(1, count + 1), np.zeros(count)], axis=-1)


def forecast(*means: np.ndarray, variance: float = 1.0) -> Forecast:
    mean = np.stack(means)
    return Forecast(mean, np.broadcast_to(variance * np.eye(2), (*mean.shape, 2)))


class TestDistance:
    def test_eq_1_by_hand(self):
        off, cov = np.array([[3.0, 4.0], [1.0, 1.0]]), np.array([np.diag([9.0, 16.0]), [[2.0, 1.0], [1.0, 2.0]]])
        np.testing.assert_allclose(mahalanobis(off, cov), [np.sqrt(2), np.sqrt(2 / 3)])

    def test_eq_2_by_hand(self):
        """A track predicted one step ago at 0, 1, 2, ...; an observation predicts the same positions 2 m further.

        Step j of the overlap (from 1): variances j + 1 and j, so the distance is 2 / sqrt(2 j + 1), for 11 steps.
        """
        tracks, seen = forecast(line(0, 1)), forecast(line(1, 1) + [2, 0])
        each = 2 / np.sqrt(2 * np.arange(1, 12) + 1)
        age = np.array([1])
        assert prediction_distances(tracks, age, seen, "mean", 1.0)[0, 0] == pytest.approx(each.mean())
        assert prediction_distances(tracks, age, seen, "max", 1.0)[0, 0] == pytest.approx(each.max())
        assert prediction_distances(tracks, age, seen, "first", 1.0)[0, 0] == pytest.approx(each[0])
        assert prediction_distances(tracks, age, seen, "mean", 2.0)[0, 0] == pytest.approx(each.mean() / 2)


class TestSmoothing:
    def test_eq_3_over_a_gap_by_hand(self):
        """Observed at 0 and 1, and three steps later at 5: displacements 1, 4/3, 4/3, 4/3."""
        holt = Holt(0.5, 0.5)
        past = np.array([[[np.nan, np.nan], [0.0, 0], [1, 0]]])
        history = SmoothedHistory.of_observations(holt, past, np.isfinite(past[..., 0]))
        history.append(holt, np.array([[5.0, 0.0]]), np.array([3]))
        level, trend = 1.0, 0.0
        smooth = [level]
        for displacement in (4 / 3, 4 / 3, 4 / 3):
            new = 0.5 * displacement + 0.5 * (level + trend)
            level, trend = new, 0.5 * (new - level) + 0.5 * trend
            smooth.append(level)
        rebuilt, known = history.positions()
        assert known.tolist() == [[True, True, True]]
        np.testing.assert_allclose(rebuilt[0, :, 0], [5 - smooth[-1] - smooth[-2], 5 - smooth[-1], 5])


class TestBranches:
    """Lines 4 to 18 of Algorithm 1, one by one, on people who walk along the first axis."""

    @every_profile
    def test_an_unmatched_track_coasts_and_is_matched_again_within_its_maximum_age(self, profile):
        """Occluded for three steps, then under another id; matched once that id has a past. The gap is interpolated."""
        frames = walk(lambda n: {7 if n < 10 else 8: (0.5 * n, 0.0)} if not 10 <= n < 13 else {}, 26)
        offline, *_ = run(profile, frames)
        (who,) = paths(offline)
        assert along(paths(offline)[who], {tick: (0.5 * tick, 0.0) for tick in range(26)})
        filled = [tick for tick, frame in enumerate(offline) if not frame.rows["observed"].all()]
        assert set(range(10, 13)) <= set(filled)

    @pytest.mark.parametrize(
        ("profile", "horizon_s", "steps"),
        [(DEFAULT, 0.1, 1), *((profile, 1.01, 3) for profile in PROFILES.values())],
        ids=["one", *PROFILES],
    )
    def test_there_is_one_step_at_least_and_as_many_as_fit_best(self, profile, horizon_s, steps):
        """At 2.5 steps a second."""
        frames = walk(lambda n: {7: (0.5 * n, 0.0)}, 12)
        _, _, predictions, *_ = run(replace(profile, horizon_s=horizon_s, predictor="cv"), frames)
        assert predictions[-1].rows["step"].tolist() == list(range(1, steps + 1))
        assert predictions[-1].rows["ahead_s"].max() == pytest.approx(0.4 * steps)

    @pytest.mark.parametrize("distance", ["mean", "max", "first"])
    def test_predictions_of_one_step_are_refused_where_two_predictions_of_one_time_are_compared(self, distance):
        frames = walk(lambda n: {7: (0.5 * n, 0.0)}, 12)
        with pytest.raises(McaptrackError, match=r"horizon_s 0\.4 is one step at 2\.5 Hz.*takes 0\.8 s at least"):
            run(replace(PAPER, distance=distance, horizon_s=0.4), frames)
        two = run(replace(PAPER, distance=distance, horizon_s=0.8), frames)[0]
        assert [ids(frame) for frame in two] == [[1]] * 12
        one = run(replace(PAPER, distance="now", horizon_s=0.4), frames)[0]
        assert [ids(frame) for frame in one] == [[1]] * 12


class TestFailuresOfThePaper:
    """Section IV-B of the paper: errors of tracking that re-tracking repairs."""

    @every_profile
    def test_missed_target(self, profile):
        """Merged into another detection for a second, then under a new id: one track, with the gap interpolated."""

        def crowd(n):
            people = {1: (0.5 * n, 0.0)}
            if n < 10:
                people[2] = (0.5 * n, 3.0 - 0.25 * n)
            elif n >= 13:
                people[3] = (0.5 * n, 3.0 - 0.25 * n)
            return people

        offline, *_ = run(profile, walk(crowd, 30))
        truth = {tick: (0.5 * tick, 3.0 - 0.25 * tick) for tick in range(30)}
        assert any(along(path, truth) for path in paths(offline).values())
        assert len(paths(offline)) == 2

    @pytest.mark.parametrize("profile", [AUTHORS, DEFAULT], ids=["authors", "default"])
    def test_identity_switch_at_meet_and_separate(self, profile):
        """Two cross; their merged detection has the id of the first, and afterwards the ids are swapped."""

        def crowd(n):
            a, b = (0.6 * n, 0.45 * n), (0.6 * n, 10.8 - 0.45 * n)
            if n < 11:
                return {1: a, 2: b}
            if n < 14:
                return {1: (0.6 * n, 5.4)}
            return {1: b, 3: a}  # the tracker gives the first id to the wrong person

        offline, *_ = run(profile, walk(crowd, 30))
        straight = 0
        for path in paths(offline).values():
            ticks = sorted(path)
            if ticks[0] < 8 and ticks[-1] > 22:
                rise = (path[5][1] - path[0][1], path[29][1] - path[24][1])
                straight += (rise[0] > 0) == (rise[1] > 0)
        assert straight == 2

    @pytest.mark.parametrize("profile", one_in(3, PROFILES.values()), ids=PROFILES)
    def test_spurious_track(self, profile):
        """A gust in a tree: for 2.4 s false detections jump about under one id. At most half remain; by likelihood none."""
        kept = 0
        for seed in range(20):
            leaps = np.random.default_rng(seed).uniform(-2.5, 2.5, (60, 2))

            def crowd(n, leaps=leaps):
                tree = {9: (float(leaps[n, 0]), 30 + float(leaps[n, 1]))} if 10 <= n < 16 else {}
                return {1: (0.4 * n, 0.0)} | tree

            offline, *_ = run(profile, walk(crowd, 40))
            found = paths(offline).values()
            kept += sum(len(path) for path in found if next(iter(path.values()))[1] > 15)
            walker = {tick: (0.4 * tick, 0.0) for tick in range(40)}
            assert any(along(path, walker) for path in found)
        assert kept <= (0 if profile == DEFAULT else 0.5 * 20 * 6)

    def test_noisy_track(self):
        """A shaking camera: predictions from the re-tracked path jump less from step to step than those from the raw one."""
        rng = np.random.default_rng(4)
        noise = rng.normal(0, 0.25, (60, 2))
        frames = walk(lambda n: {1: (0.5 * n + noise[n, 0], noise[n, 1])}, 60)

        def drift(profile) -> float:
            _, _, predictions, *_ = run(profile, frames)
            futures = [np.stack([f.rows["x_m"], f.rows["y_m"]], -1) for f in predictions if len(f.rows) == 12]
            steps = [np.hypot(*(a[1:] - b[:-1]).T).mean() for a, b in pairwise(futures)]
            return float(np.mean(steps))

        raw = replace(PAPER, alpha=1.0, beta=0.0)
        assert drift(PAPER) < 0.8 * drift(raw)
        assert drift(DEFAULT) < 0.8 * drift(raw)


def test_the_profile_authors_keeps_what_two_matches_in_a_row_confirm():
    """Observed at ticks 0 to 9, 13 to 16 and from 20 on: four positions give a prediction, so 16, 23, 24 match.

    A single match at the end of a track is left out; in the middle, before a confirmed end, it is kept.
    """

    def crowd(n, last):
        name = next((name for name, start, end in ((1, 0, 9), (2, 13, 16), (3, 20, last)) if start <= n <= end), None)
        return {name: (0.5 * n, 0.0)} if name else {}

    def ticks(profile, last) -> list[int]:
        offline, *_ = run(profile, walk(lambda n: crowd(n, last), 40))
        (path,) = paths(offline).values()
        return list(path)

    assert ticks(AUTHORS, 23) == list(range(10))
    assert ticks(replace(AUTHORS, trim_ends=False), 23) == list(range(24))
    assert ticks(AUTHORS, 24) == list(range(25))


def test_a_log_without_people_gives_frames_without_rows():
    offline, online, predictions, *_ = run(DEFAULT, walk(lambda n: {}, 5))
    assert [len(f.rows) for f in (*offline, *online, *predictions)] == [0] * 15
    assert len(tracks_at({})) == 0
