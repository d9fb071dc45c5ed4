"""Predictors that look at other people: what they are given, the laws that they obey, and `social`."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit, softmax

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import taken
from mcaptrack.predictors import NAMES, Forecast, PeopleSeen, make, predict_among, predict_together, social
from mcaptrack.predictors.weights import SHIPPED, Weights, load
from mcaptrack.schema import Frame
from mcaptrack.testing import LawError, check_predictor
from mcaptrack.transforms import PROFILES, Predict
from mcaptrack.transforms.retrack import passes
from tests.worlds import ns, tracks_at

STEPS = 12
SOCIAL = make("social", STEPS, 0.4)
SEEN: list[Any] = []


@dataclass(frozen=True)
class Watching:
    """Keeps what it is given; people stay where they are."""

    steps: int
    step_s: float
    past: int = 3
    uses_people: ClassVar[bool] = True

    def predict(self, xy_m, valid, people=None):
        SEEN.append((xy_m, people))
        return np.repeat(xy_m[:, -1:], self.steps, axis=1), np.tile(np.eye(2), (len(xy_m), self.steps, 1, 1))


class Blind(Watching):
    uses_people: ClassVar[bool] = False

    def predict(self, xy_m, valid):
        return super().predict(xy_m, valid)


@pytest.fixture(autouse=True)
def nothing_seen() -> None:
    SEEN.clear()


def frame(tick: int, rows: dict[int, tuple[float, float]], unseen: tuple[int, ...] = (), cars: tuple[int, ...] = ()):
    content = tracks_at(rows)
    content["observed"] = ~np.isin(list(rows), unseen)
    content["class_id"] = np.where(np.isin(list(rows), cars), 3, 1)
    return Frame(ns(0.4 * tick), tick, content)


def crowd(seed: int, count: int, length: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """Pasts (M, L, 2) of walks that are near each other, with gaps, and which positions are known."""
    rng = np.random.default_rng(seed)
    speed = rng.normal(0, 0.4, (count, 1, 2))
    xy_m = rng.uniform(-4, 4, (count, 1, 2)) + speed * np.arange(1 - length, 1)[:, None]
    valid = rng.random((count, length)) < 0.8
    valid[:, -1] = True
    return np.where(valid[..., None], xy_m + rng.normal(0, 0.1, xy_m.shape), np.nan), valid


class TestWhatPredictorsAreGiven:
    def test_those_who_are_observed_now_are_people_though_too_short_to_be_predicted(self):
        frames = [frame(n, {1: (n, 0), 2: (n, 1)}) for n in range(3)]
        frames.append(frame(3, {9: (0, 5), 2: (3, 1), 1: (3, 0), 4: (7, 7)}, unseen=(4,)))
        list(Predict(predictor="tests.test_social:Watching")(frames))
        xy_m, people = SEEN[-1]
        assert xy_m[:, -1].tolist() == [[3, 1], [3, 0]]  # tracks 2 and 1, which have four positions
        assert people.xy_m[:, -1].tolist() == [[0, 5], [3, 1], [3, 0]]
        assert people.row.tolist() == [1, 2]
        np.testing.assert_array_equal(people.xy_m[people.row], xy_m)
        assert people.moment.tolist() == [0, 0, 0]
        assert people.valid.sum(axis=1).tolist() == [1, 4, 4]

    def test_vehicles_and_people_are_not_seen_together_because_their_units_differ(self):
        frames = [frame(n, {1: (n, 0), 2: (9 * n, 1)}, cars=(2,)) for n in range(4)]
        list(Predict(predictor="tests.test_social:Watching", class_names=((1, "pedestrian"), (3, "car")))(frames))
        xy_m, people = SEEN[-1]
        assert len(set(people.moment.tolist())) == 2
        np.testing.assert_array_equal(people.xy_m[people.row], xy_m)
        assert people.xy_m[1, -1].tolist() == [27 / 4, 1 / 4]  # in units of 4 m

    def test_a_predictor_that_does_not_ask_gets_positions_alone(self):
        frames = [frame(n, {1: (n, 0), 2: (n, 1)}) for n in range(5)]
        list(Predict(predictor="tests.test_social:Blind")(frames))
        assert [people for _, people in SEEN] == [None] * len(SEEN) != []

    def test_other_steps_are_those_of_people_too(self):
        """At 5 Hz a network with steps of 0.4 s gets every other position, of everybody."""
        xy_m = np.random.default_rng(2).normal(0, 1, (2, 10, 2))
        slow = make("social", 24, 0.2)
        given = PeopleSeen(xy_m, np.ones((2, 10), bool), np.zeros(2, int), np.array([0, 1]))
        every = xy_m[:, 1::2]
        wanted = predict_together(SOCIAL, every, np.ones((2, 5), bool))
        found = predict_among(slow, xy_m, np.ones((2, 10), bool), given)
        np.testing.assert_allclose(found.mean[:, 1::2], wanted.mean, atol=1e-9)
        assert np.abs(SOCIAL.predict(every, np.ones((2, 5), bool)).mean - wanted.mean).max() > 0.01

    @pytest.mark.parametrize("profile", ["default", "paper"])
    def test_retracking_gives_all_tracks_of_a_step_at_once(self, monkeypatch, profile):
        rng = np.random.default_rng(1)
        frames = [frame(n, {k: (0.4 * n, 2 * k + rng.normal(0, 0.05)) for k in range(5)}) for n in range(12)]
        monkeypatch.setattr(passes, "_SAMPLES", 4)
        list(replace(PROFILES[profile], predictor="tests.test_social:Watching")(frames))
        calls = [(xy_m, people) for xy_m, people in SEEN if len(xy_m)]
        for xy_m, people in calls:
            np.testing.assert_array_equal(people.xy_m[people.row], xy_m)
        sizes = [size for _, people in calls for size in np.bincount(people.moment).tolist() if size]
        assert set(sizes) == {5}
        assert len(calls) > 5


class Breaks:
    """Constant positions, but for one law."""

    steps, step_s, past, uses_people = 3, 0.4, 4, True

    def __init__(self, law: str) -> None:
        self.law, self.calls = law, 0

    def predict(self, xy_m, valid, people=None):
        self.calls += 1
        mean = np.repeat(xy_m[:, -1:], self.steps, axis=1)
        cov = np.tile(np.eye(2), (len(mean), self.steps, 1, 1))
        others = people.xy_m[:, -1]
        mean = mean + {
            "pure": self.calls,
            "unknown": np.nan_to_num(xy_m[:, :1]).clip(0, 9),
            "order-blind": others[0] - others[-1],
            "batch": float(len(mean)),
            "moment": others.sum() - 8 * xy_m[0, -1].sum(),
            "moves": -mean / 2,
            "rotates": [1.0, 0.0],
        }.get(self.law, 0.0)
        if self.law == "covariances":
            cov[0, 0] = [[1.0, 2.0], [2.0, 1.0]]
        if self.law == "shapes":
            mean = mean[:, :1]
        if self.law == "input":
            people.xy_m[0, -1] = 0.0
        return mean, cov


class TestLaws:
    def test_the_built_in_predictors_obey_them(self):
        for name, step_s, seed in itertools.product(NAMES, (0.4, 0.25), range(3)):
            check_predictor(make(name, STEPS, step_s), rotates=name != "lstm", seed=seed)

    def test_one_that_obeys_passes(self):
        check_predictor(Breaks(""), rotates=True)
        check_predictor(Breaks("rotates"))

    @pytest.mark.parametrize(
        ("law", "said"),
        [
            *((one, f"{one}: ") for one in ("pure", "unknown", "order-blind", "batch", "moment", "moves", "rotates")),
            ("covariances", "forecasts: means that are not finite, or covariances"),
            ("shapes", r"forecasts: shapes are \(5, 1, 2\)"),
            ("input", "pure: it changes its input"),
        ],
    )
    def test_one_that_breaks_a_law_is_told_which(self, law, said):
        with pytest.raises(LawError, match=said):
            check_predictor(Breaks(law), rotates=True)


class TestSocial:
    @settings(max_examples=25)
    @given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 40))
    def test_pairs_are_the_nearest_people_of_the_same_moment(self, seed, count):
        rng = np.random.default_rng(seed)
        now = rng.uniform(-9, 9, (count, 2))
        moment, row = rng.integers(0, 2, count), rng.permutation(count)[: rng.integers(1, count + 1)]
        found = social.pairs_of(PeopleSeen(now[:, None], np.ones((count, 1), bool), moment, row), now)
        wanted = []
        for track, me in enumerate(row.tolist()):
            away = {
                j: float(np.hypot(*(now[j] - now[me]))) for j in range(count) if j != me and moment[j] == moment[me]
            }
            near = sorted((j for j in away if away[j] < 12), key=away.__getitem__)[:16]
            wanted += [(track, j) for j in near]
        assert list(zip(*(part.tolist() for part in found), strict=True)) == wanted

    def test_the_formulas_are_those_of_attention(self):
        """Against loops over tracks, people and steps, on the same features."""
        xy_m, valid = crowd(11, 6)
        found = predict_together(SOCIAL, xy_m, valid)
        seen, get = SOCIAL.see(xy_m, valid), SOCIAL.weights.tensors

        def layer(name: str, x: np.ndarray) -> np.ndarray:
            return get[f"{name}.weight"] @ x + get[f"{name}.bias"]

        ahead = seen.mean - xy_m[:, -1:]
        features = np.concatenate([social.own_features(seen), seen.state], axis=1)
        for i in range(6):
            own = np.tanh(layer("own", features[i]))
            others = [j for j in range(6) if j != i]
            views, scores = [], [layer("alone", own)]
            for j in others:
                one, two = taken(seen, np.array([i])), taken(seen, np.array([j]))
                pair = np.tanh(layer("pair", social.pair_features(one, two, 0.4)[0]))
                views.append(np.tanh(layer("both", pair) + get["both.own"] @ own))
                scores.append(layer("attention", views[-1]))
            share = softmax(np.array(scores), axis=0)[1:]
            pool = sum(part[0] * view for part, view in zip(share, views, strict=True))
            total = sum(expit(score[0]) * view for score, view in zip(scores[1:], views, strict=True))
            out = layer("head", np.tanh(layer("dense", np.concatenate([own, pool, total])))).reshape(STEPS, 4)
            for t in range(STEPS):
                late = t / (STEPS - 1)
                mean = seen.mean[i, t].copy()
                for part, j in zip(share, others, strict=True):
                    mean += ((1 - late) * part[1] + late * part[2]) * (ahead[j, t] - ahead[i, t])
                mean += seen.turn[i].T @ out[t, :2] * seen.gate[i] * seen.spread[i, t]
                np.testing.assert_allclose(found.mean[i, t], mean, atol=1e-9)
                wide = np.exp([out[t, 2] + seen.gate[i] * out[t, 3], out[t, 2] - seen.gate[i] * out[t, 3]])
                matrix = seen.turn[i].T @ np.diag(wide) @ seen.turn[i]
                np.testing.assert_allclose(found.cov[i, t], matrix @ seen.cov[i, t] @ matrix.T, atol=1e-9)

    def test_its_file_says_what_it_was_trained_on_and_holds_red_as_it_is(self):
        found, red = load(SHIPPED / "social.safetensors"), load(SHIPPED / "red.safetensors")
        assert found.card["red_sha256"] == red.sha256
        for name, part in red.tensors.items():
            np.testing.assert_array_equal(found.tensors[f"red.{name}"], part)

    def test_a_file_of_another_network_is_refused(self):
        with pytest.raises(McaptrackError, match=r"red\.safetensors holds red, not social"):
            make(f"social:{SHIPPED / 'red.safetensors'}", STEPS, 0.4)
        whole = load(SHIPPED / "social.safetensors")
        for name in whole.tensors:
            rest = {key: part for key, part in whole.tensors.items() if key != name}
            with pytest.raises(McaptrackError, match=r"has no |has to be 0x"):
                social.Social.of(Weights(whole.path, rest, whole.card, ""))

    def test_no_tracks_have_no_forecasts(self):
        empty = SOCIAL.predict(np.empty((0, 8, 2)), np.empty((0, 8), bool))
        assert isinstance(empty, Forecast)
        assert empty.mean.shape == (0, STEPS, 2)
