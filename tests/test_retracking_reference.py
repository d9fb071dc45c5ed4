"""Re-tracking against a second, slow implementation, row by row, on random walkers; and its symmetries."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import chain

import numpy as np
import pytest
from hypothesis import Phase, assume, given, settings
from hypothesis import strategies as st

from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.predictors import make
from mcaptrack.schema import Frame, Rows
from mcaptrack.transforms import PROFILES, Predict, Retrack, RetrackByConsistency
from mcaptrack.transforms.retrack import Retracking, passes
from tests.references.algorithm1 import Algorithm1
from tests.references.online import OnlineTracker
from tests.references.retracking import Undecided, constant_velocity
from tests.tiers import one_in, thorough
from tests.worlds import assert_same_rows, crossing_tracks, ids, noisy_tracks, places, walk

SEEDS = st.integers(0, 2**32 - 1)
#: Offline, gaps are interpolated and short tracks are left out; nothing else.
PLAIN = {"link_s": 0.0, "resolve_swaps": False, "smooth": False, "track_confidence": 0.0}


#: A ground plane that only scales (20 px per metre), so that the movement of boxes is known.
PLANE = ((0, GroundPlane((0.05, 0, 0, 0, 0.05, 0, 0, 0, 1), 640, 480)),)
#: Failures are not shrunk: that takes minutes, and the seed is enough.
QUICK = [Phase.explicit, Phase.generate]


def rows_of(frame: Frame) -> list[dict[str, float]]:
    names = frame.rows.dtype.names
    return [dict(zip(names, row, strict=True)) for row in zip(*(frame.rows[n].tolist() for n in names), strict=True)]


def black_box(name: str, steps: int, step_s: float):
    """A predictor of the package for one track; positions that are not known are None."""
    predictor = make(name, steps, step_s)

    def predict(points):
        known = np.array([[point is not None for point in points]])
        xy = np.array([[(np.nan, np.nan) if point is None else point for point in points]])
        mean, cov = predictor.predict(xy, known)
        return mean[0], cov[0]

    return predict, predictor.past


def compare(transform: Retracking, frames: list[Frame], reference, covariances: bool = True) -> None:
    """Compare all three outputs, row by row."""
    samples, times = [rows_of(frame) for frame in frames], [frame.t_ns for frame in frames]
    try:
        wanted = reference.run(samples, times)
    except Undecided:
        assume(False)
    found = [list(part) for part in zip(*transform(frames), strict=True)]
    for ours, theirs in zip(found[:2], wanted[:2], strict=True):
        assert [len(frame.rows) for frame in ours] == [len(rows) for rows in theirs]
        mine, yours = np.concatenate([frame.rows for frame in ours]), list(chain(*theirs))
        for name in mine.dtype.names:
            np.testing.assert_allclose(mine[name], [row[name] for row in yours], rtol=1e-6, atol=1e-9, err_msg=name)
    for frame, forecasts in zip(found[2], wanted[2], strict=True):
        horizon = len(frame.rows) // max(len(forecasts), 1)
        assert frame.rows["track_id"].tolist() == [name for name, _, _ in forecasts for _ in range(horizon)]
        for at, (_, mean, cov) in enumerate(forecasts):
            rows = frame.rows[at * horizon : (at + 1) * horizon]
            assert rows["step"].tolist() == list(range(1, len(mean) + 1))
            np.testing.assert_allclose(rows["ahead_s"], np.arange(1, len(mean) + 1) / transform.rate_hz)
            np.testing.assert_allclose(np.stack([rows["x_m"], rows["y_m"]], axis=-1), mean, atol=1e-9)
            if covariances:
                found_cov = np.stack([rows["cov_xx_m2"], rows["cov_xy_m2"], rows["cov_yy_m2"]], axis=-1)
                wanted_cov = cov[:, [0, 0, 1], [0, 1, 1]]
                if np.isfinite(rows["wide_weight"]).all():  # calibrated: the predictor's covariance, scaled
                    wanted_cov = wanted_cov * (found_cov[:, :1] / wanted_cov[:, :1])
                np.testing.assert_allclose(found_cov, wanted_cov, atol=1e-9)


def algorithm_1(transform: RetrackByConsistency) -> Algorithm1:
    predict, past = black_box(
        transform.predictor, round(transform.horizon_s * transform.rate_hz), 1 / transform.rate_hz
    )
    return Algorithm1(transform, predict, past)


@given(seed=SEEDS)
@settings(max_examples=5, phases=QUICK)
def test_profile_paper_equals_algorithm_1(seed):
    paper = replace(PROFILES["paper"], min_track_s=1.2)
    reference = Algorithm1(paper, constant_velocity(12), 4)
    compare(paper, noisy_tracks(np.random.default_rng(seed)), reference, covariances=False)


#: Numeric options of Algorithm 1, with a few values each that change its results.
NUMBERS = {
    "horizon_s": [0.8, 2.0, 4.8], "sigma_m": [0.3, 1.0], "noise_m": [None, 0.0, 0.5], "max_distance": [0.5, 1.5, 3.0],
    "priority_distance": [0.0, 0.4], "gate_m": [None, 0.5, 1.5], "same_id_bonus": [0.0, 1.0, 12.0],
    "max_age_s": [0.4, 1.2, 3.2], "alpha": [0.5, 0.8, 1.0], "beta": [0.0, 0.5], "min_history": [1, 2, 4, 5],
    "min_hits": [0, 1, 2], "min_track_s": [0.0, 0.8, 2.0], "rate_hz": [2.5, 4.0],
}  # fmt: skip
CHOICES = {
    "distance": ["mean", "max"],
    "covariance": ["paper", "predictor"],
    "birth": ["raw", "smoothed"],
    "backfill": ["none", "unclaimed", "all"],
    "trim_ends": [False, True],
    "interpolated": [False, True],
    "predictor": ["cv", "holt-cv"],
}


@given(seed=SEEDS, chosen=st.fixed_dictionaries({name: st.sampled_from(v) for name, v in (NUMBERS | CHOICES).items()}))
@settings(max_examples=10, phases=QUICK)
def test_algorithm_1_with_random_options_equals_the_reference(seed, chosen):
    transform = RetrackByConsistency(**PLAIN, **chosen)
    frames = noisy_tracks(np.random.default_rng(seed), rate_hz=transform.rate_hz)
    compare(transform, frames, algorithm_1(transform))


#: Options of the method by likelihood, with the values to try.
LIKELIHOOD = {
    "horizon_s": [0.8, 4.8], "noise_m": [None, None, 0.1, 0.3], "speed_m_per_s": [0.5, 1.75],
    "drift_m_per_s": [0.0, 0.12, 0.5], "drift_ratio": [0.0, 0.08, 0.3], "same_id_bonus": [0.0, 4.0, 12.0],
    "max_age_s": [0.4, 1.2, 2.0], "merge_distance_m": [0.0, 1.0, 2.0], "merge_timeout_s": [0.0, 0.8, 3.0],
    "confirm_s": [0.0, 0.4, 1.2], "coast_s": [0.0, 0.4, 1.2], "adapt": [False, True],
    "adapt_online": [False, True, True], "min_track_s": [0.0, 0.8, 2.0], "interpolated": [False, True],
    "rate_hz": [2.5, 4.0], "predictor": ["kalman", "cv"],
}  # fmt: skip


@given(seed=SEEDS, chosen=st.fixed_dictionaries({name: st.sampled_from(v) for name, v in LIKELIHOOD.items()}))
@settings(max_examples=10, phases=QUICK)
def test_the_likelihood_method_equals_the_reference(seed, chosen):
    transform = Retrack(**PLAIN, **chosen)
    predict, past = black_box(
        transform.predictor, round(transform.horizon_s * transform.rate_hz), 1 / transform.rate_hz
    )
    reference = OnlineTracker(transform, predict, past)
    rng = np.random.default_rng(seed)
    make_frames = crossing_tracks if rng.random() < 0.3 else noisy_tracks
    frames = make_frames(rng, rate_hz=transform.rate_hz)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(passes, "_SAMPLES", int(rng.choice([1, 9, 2**12])))  # so many are written at once
        compare(transform, frames, reference)


#: Options of the offline steps, with the values to try.
OFFLINE = {
    "kind": [Retrack, Retrack, RetrackByConsistency],
    "noise_m": [None, 0.1, 0.3],
    "speed_m_per_s": [0.8, 1.75],
    "drift_m_per_s": [0.05, 0.12],
    "drift_ratio": [0.0, 0.08],
    "same_id_bonus": [0.0, 12.0, 25.0],
    "link_s": [0.0, 4.0, 20.0],
    "link_confidence": [0.2, 0.5, 0.9],
    "resolve_swaps": [False, True],
    "smooth": [False, True],
    "track_confidence": [0.0, 0.2, 0.5],
    "min_track_s": [0.0, 2.0],
    "ground_planes": [(), PLANE],
}


@given(seed=SEEDS, chosen=st.fixed_dictionaries({name: st.sampled_from(v) for name, v in OFFLINE.items()}))
@settings(max_examples=6, phases=QUICK)
def test_the_offline_steps_equal_the_reference(seed, chosen):
    kind = chosen.pop("kind")
    transform = kind(predictor="cv", horizon_s=2.0, **chosen)
    rng = np.random.default_rng(seed)
    frames = crossing_tracks(rng) if rng.random() < 0.5 else noisy_tracks(rng, ticks=70, hidden=0.02)
    if kind is RetrackByConsistency:
        reference = algorithm_1(transform)
    else:
        reference = OnlineTracker(transform, *black_box("cv", 5, 0.4))
    compare(transform, frames, reference)


#: Options that decide whether anything is re-tracked at all, together, and in which unit of length.
WHETHER = {"side_view", "poor_scale", "across_classes", "class_names", "class_limits", "fixed_ids"}
WHETHER |= {"appearance", "store_appearance", "descriptors", "boxes", "worlds", "answers"}


def test_every_option_is_varied():
    varied = {*NUMBERS, *CHOICES, *LIKELIHOOD, *OFFLINE} - {"kind"} | WHETHER
    assert {option.name for kind in (Retrack, RetrackByConsistency) for option in fields(kind)} == varied


@given(seed=SEEDS)
@settings(max_examples=5, phases=QUICK)
def test_where_nothing_is_re_tracked_tracks_are_the_input_and_predictions_those_of_predict(seed):
    frames = noisy_tracks(np.random.default_rng(seed))
    options = {"predictor": "cv", "horizon_s": 2.0, "min_history": 3}
    passed_on, insisted, usual = (
        list(Retrack(**options, **PLAIN, poor_scale=is_poor, side_view=is_asked)(frames))
        for is_poor, is_asked in ((True, False), (True, True), (False, False))
    )
    seen = [(frame.rows, frame.rows[frame.rows["observed"]]) for frame in frames]
    predicted = [frame.rows for (frame,) in Predict(**options)(frames)]
    for (*outputs, decisions), wanted, forecasts in zip(passed_on, seen, predicted, strict=True):
        assert len(decisions.rows) == 0
        for frame, rows in zip(outputs, (*wanted, forecasts), strict=True):
            assert_same_rows(frame.rows, rows)
    for ours, theirs in zip(insisted, usual, strict=True):
        for frame, same in zip(ours, theirs, strict=True):
            assert_same_rows(frame.rows, same.rows)


# Online, a person who comes back keeps the id: links of new tracks to lost ones, from the past alone


def online(frames: list[Frame], **options: object) -> list[Frame]:
    return [result[1] for result in replace(PROFILES["default"], **options)(frames)]


def hidden(n: int) -> dict[int, tuple[float, float]]:
    """One walks at 1.25 m/s, is hidden for ten steps, and goes on with another id."""
    return {} if 20 <= n < 30 else {1 if n < 20 else 2: (0.5 * n, 0.0)}


def passers(rng: np.random.Generator, people: int = 8, ticks: int = 120, flickers: bool = False) -> list[Frame]:
    """People walk straight on; at times they are hidden for up to 6 s, and come back with another id.

    Where it ``flickers``, most tracks are soon over, so that new ones are not written at once.
    """
    begins, speed = rng.integers(0, ticks // 2, people), rng.normal(0, 1.2, (people, 2))
    start, noise_m = rng.uniform(-8, 8, (people, 2)), rng.choice([0.02, 0.1])
    hidden = [set(np.concatenate([np.arange(a, a + rng.integers(6, 15)) for a in (15, 50)])) for _ in range(people)]
    seen = rng.random((people, ticks)) > rng.choice([0.0, 0.1])

    def path(n: int) -> dict[int, tuple[float, float]]:
        out = {1000 + n: tuple(rng.uniform(-12, 12, 2))} if flickers else {}
        for who in range(people):
            age = n - begins[who]
            if 0 <= age < 90 and age not in hidden[who] and seen[who, n]:
                name = who + 10 * sum(age > a for a in (15, 50))
                out[name] = tuple(start[who] + 0.4 * age * speed[who] + rng.normal(0, noise_m, 2))
        return out

    return walk(path, ticks)


def test_who_comes_back_where_expected_keeps_the_id():
    assert {one for frame in online(walk(hidden, 60)) for one in ids(frame)} == {1}


@given(seed=SEEDS, link_s=st.sampled_from([4.0, 20.0]), confidence=st.sampled_from([0.2, 0.5, 0.9]))
@settings(max_examples=3, phases=QUICK)
def test_online_links_equal_the_reference(seed, link_s, confidence):
    rng = np.random.default_rng(seed)
    transform = Retrack(**(PLAIN | {"link_s": link_s}), link_confidence=confidence, predictor="cv", horizon_s=2.0)
    scene = rng.choice(3)
    frames = noisy_tracks(rng, ticks=70, hidden=0.05) if scene == 0 else passers(rng, 4, 85, flickers=scene == 1)
    reference = OnlineTracker(transform, *black_box("cv", 5, 0.4))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(passes, "_SAMPLES", int(rng.choice([1, 40, 2**12])))
        compare(transform, frames, reference)


@thorough
def test_links_with_equal_odds_do_not_depend_on_how_many_steps_are_read_at_once(monkeypatch):
    """All are at one place."""
    frames = passers(np.random.default_rng(5))
    for frame in frames:
        for name in ("x_m", "y_m"):
            frame.rows[name] = 0.0
    wanted = [ids(frame) for frame in online(frames)]
    assert wanted != [ids(frame) for frame in online(frames, link_s=0.0)]
    monkeypatch.setattr(passes, "_SAMPLES", 7)
    assert [ids(frame) for frame in online(frames)] == wanted


# Symmetries of re-tracking: positions, times, ids and distant people don't change the tracks of a crowd


every_method = pytest.mark.parametrize("method", PROFILES.values(), ids=PROFILES)


def outputs(method: Retracking, frames: list[Frame]) -> list[Rows]:
    """The rows of offline tracks, online tracks, predictions and decisions."""
    return [np.concatenate([frame.rows for frame in part]) for part in zip(*method(frames), strict=True)]


def standing(first: list[tuple[float, float]], then: list[tuple[float, float]], gap: range, ticks: int) -> list[Frame]:
    """People stand, are occluded for a while, and then stand elsewhere under new ids."""

    def path(tick: int):
        if tick in gap:
            return {}
        here = first if tick < gap.start else then
        return {k + (10 if tick >= gap.stop else 0): place for k, place in enumerate(here)}

    return walk(path, ticks)


TIES = {
    # The corners of a square: which track went left and which right is ambiguous.
    "online": (standing([(1.3, 2.4), (1.3, 1.0)], [(2.0, 1.7), (0.6, 1.7)], range(12, 13), 30), {"gate_m": None}),
    "link": (
        standing([(1.3, 2.1), (1.3, 1.3)], [(1.7, 1.7), (0.9, 1.7)], range(20, 28), 60),
        {"max_age_s": 0.8, "link_s": 20.0},
    ),
}


@every_method
@pytest.mark.parametrize("tie", one_in(2, TIES))
def test_the_last_digits_of_positions_change_no_assignment(method, tie):
    """The last digits of predictions and sums differ between machines and with the size of the batch."""
    frames, options = TIES[tie]
    own = {option.name for option in fields(method)}
    method = replace(method, track_confidence=0.0, **{name: v for name, v in options.items() if name in own})
    wanted = [sorted(places(frame).items()) for frame, *_ in method(frames)]
    assert len({who for frame in wanted for who, _ in frame}) == 2  # both tracks continue
    for seed in range(6):
        rng = np.random.default_rng(seed)
        shaken = []
        for frame in frames:
            rows = frame.rows.copy()
            rows["x_m"] += rng.uniform(-1e-12, 1e-12, len(rows))
            rows["y_m"] += rng.uniform(-1e-12, 1e-12, len(rows))
            shaken.append(frame._replace(rows=rows))
        assert [sorted(places(frame).items()) for frame, *_ in method(shaken)] == wanted


def test_noise_and_speed_are_never_taken_for_less_than_a_millimetre():
    frames = noisy_tracks(np.random.default_rng(4), ticks=40)
    none, least = (replace(PROFILES["default"], noise_m=least, speed_m_per_s=least) for least in (0.0, 1e-3))
    for found, wanted in zip(outputs(none, frames), outputs(least, frames), strict=True):
        assert_same_rows(found, wanted)
