"""Networks: against torch, with files that are damaged, and on other clocks."""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit, softmax

from mcaptrack import log, notices, pipeline
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import taken
from mcaptrack.predictors import (
    NAMES,
    Forecast,
    OnClock,
    PeopleSeen,
    are_covariances,
    make,
    predict_among,
    predict_together,
    social,
    weights_sha256,
)
from mcaptrack.predictors.linear import LinearPredictor
from mcaptrack.predictors.lstm import Lstm
from mcaptrack.predictors.red import Red
from mcaptrack.predictors.weights import SHIPPED, Weights, load, save
from mcaptrack.schema import Frame
from mcaptrack.sources.ingest import IngestOptions, ingest
from mcaptrack.testing import LawError, check_predictor
from mcaptrack.transforms import PROFILES, Predict
from mcaptrack.transforms.retrack import passes
from tests.logs import provenance_of
from tests.worlds import ns, tracks_at

#: Small networks, and what torch made of the same numbers.
TORCH = json.loads((Path(__file__).parent / "networks.json").read_text())
STORED = {name: {key: np.array(value) for key, value in TORCH[name]["tensors"].items()} for name in ("red", "lstm")}
CARDS = {name: {"network": name, "steps": "3", "step_s": "0.4"} for name in ("red", "lstm")}
PAST, KNOWN = np.array(TORCH["past"]), np.array(TORCH["known"], bool)


def weights(name: str, **changes: np.ndarray | None) -> Weights:
    tensors = {key: value for key, value in (STORED[name] | changes).items() if value is not None}
    return Weights(Path("w.safetensors"), tensors, CARDS[name], "")


class TestAgainstTorch:
    def test_red_equals_torch(self):
        forecast = Red.of(weights("red")).predict(PAST, KNOWN)
        np.testing.assert_allclose(forecast.mean, TORCH["red"]["mean"], atol=1e-8)
        np.testing.assert_allclose(forecast.cov, TORCH["red"]["cov"], atol=1e-8)

    def test_the_folded_lstm_equals_torch_unfolded(self):
        forecast = Lstm.of(weights("lstm")).predict(PAST[:, -4:], np.ones((len(PAST), 4), bool))
        np.testing.assert_allclose(forecast.mean, TORCH["lstm"]["mean"], atol=1e-8)

    def test_the_covariance_of_the_lstm_is_that_of_the_kalman_filter_times_its_calibration(self):
        wider = weights("lstm", spread=np.array([1.0, 2.0, 4.0]))
        known = np.ones((len(PAST), 8), bool)
        kalman = LinearPredictor("kalman", 3, 0.4).predict(PAST, known).cov
        factor = np.array([1.0, 2.0, 4.0])[:, None, None]
        np.testing.assert_allclose(Lstm.of(wider).predict(PAST, known).cov, kalman * factor)


def test_a_blend_is_the_mean_of_the_network_and_of_constant_velocity():
    blend, red, cv = (make(name, 12, 0.4).predict(PAST, KNOWN) for name in ("blend", "red", "cv"))
    np.testing.assert_allclose(blend.mean, (red.mean + cv.mean) / 2, atol=1e-12)
    np.testing.assert_array_equal(blend.cov, red.cov)
    assert weights_sha256("blend") == weights_sha256("red")


class TestShippedWeights:
    @pytest.mark.parametrize("name", ["red", "lstm", "social"])
    def test_they_are_small_and_have_a_model_card(self, name):
        shipped = load(SHIPPED / f"{name}.safetensors")
        assert sum(file.stat().st_size for file in SHIPPED.glob("*.safetensors")) < 650_000
        assert shipped.card["network"] == name
        assert shipped.card["licence"] == "Apache-2.0"
        assert "synthetic walks" in shipped.card["data"]
        assert "ADE_m" in shipped.card["scores_noisy"]
        assert make(name, 12, 0.4).weights_sha256 == shipped.sha256

    def test_predictions_name_the_weights_that_made_them(self, tmp_path):
        lines = [f"{12 * n} 1 {0.4 * n} 0" for n in range(20)]
        (tmp_path / "t.txt").write_text("\n".join(lines))
        path = tmp_path / "t.mcap"
        ingest(tmp_path / "t.txt", path, IngestOptions(fps=Fraction(30), role="tracks"))
        for name in ("red", "kalman"):
            with log.read(path) as opened:
                pipeline.run(
                    opened, "/camera", pipeline.plan_stage(opened, "/camera", "predict", Predict(predictor=name))
                )
            made = provenance_of(path, "/camera/predictions")
            shipped = load(SHIPPED / "red.safetensors").sha256
            assert made.weights_sha256 == (shipped if name == "red" else "")


class TestFiles:
    def test_weights_and_card_survive_a_round_trip(self, tmp_path):
        save(tmp_path / "w.safetensors", STORED["red"], CARDS["red"])
        back = load(tmp_path / "w.safetensors")
        assert back.card == CARDS["red"]
        assert all(np.allclose(back.tensors[name], value) for name, value in STORED["red"].items())
        predictor = make(f"red:{tmp_path / 'w.safetensors'}", 3, 0.4)
        np.testing.assert_allclose(predictor.predict(PAST, KNOWN).mean, TORCH["red"]["mean"], atol=1e-5)

    @pytest.mark.parametrize("damage", ["empty", "text", "cut", "pickle"])
    def test_damaged_files_of_weights_are_refused_in_one_line(self, tmp_path, damage):
        path = tmp_path / "w.safetensors"
        save(path, STORED["red"], CARDS["red"])
        data = path.read_bytes()
        path.write_bytes(
            {"empty": b"", "text": b"not weights", "cut": data[:-40], "pickle": b"\x80\x04cos\nsystem\n."}[damage]
        )
        with pytest.raises(McaptrackError, match=r"w\.safetensors is not a file of weights"):
            make(f"red:{path}", 3, 0.4)

    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ({"head.bias": None}, "has no head.bias"),
            ({"head.bias": np.zeros(7)}, "head.bias has to be 15, not 7"),
            ({"gru.weight_hh": np.zeros((9, 4))}, "gru.weight_ih has to be 12x11, not 9x11"),
            ({"base.spread": np.full((9, 3), np.nan)}, "base.spread has to be 9x3, not numbers that are not finite"),
        ],
    )
    def test_weights_that_do_not_fit_are_refused_by_name(self, changes, words):
        with pytest.raises(McaptrackError, match=words):
            Red.of(weights("red", **changes))

    def test_weights_of_another_network_are_refused(self, tmp_path):
        save(tmp_path / "w.safetensors", STORED["lstm"], CARDS["lstm"])
        with pytest.raises(McaptrackError, match=r"w\.safetensors holds lstm, not red"):
            make(f"red:{tmp_path / 'w.safetensors'}", 3, 0.4)
        save(tmp_path / "x.safetensors", STORED["red"], CARDS["red"] | {"steps": "many"})
        with pytest.raises(McaptrackError, match="its card lacks the number of steps"):
            make(f"red:{tmp_path / 'x.safetensors'}", 3, 0.4)

    @pytest.mark.parametrize(
        ("name", "said"),
        [
            ("ret", r"no predictor is called ret; did you mean red\? there are blend, red, social, cv, holt-cv, kalman, lstm[,;]"),
            ("red:", "or blend:FILE, red:FILE, social:FILE, lstm:FILE(, onnx:FILE)?, not red:"),
            ("cv:file", "or blend:FILE, red:FILE, social:FILE, lstm:FILE(, onnx:FILE)?, not cv:file"),
            (":x", ":x is not of the form module:Class"),
        ],
    )  # fmt: skip
    def test_names_that_mean_nothing_are_refused_before_anything_runs(self, name, said):
        with pytest.raises(McaptrackError, match=said):
            Predict(predictor=name)

    def test_a_file_that_is_not_there_is_refused_before_anything_runs(self):
        with pytest.raises(McaptrackError, match=r"nowhere\.safetensors does not exist"):
            Predict(predictor="red:nowhere.safetensors")


class _Straight:
    """Repeats the last displacement; the covariance grows with the square of time; its steps are 0.4 s."""

    name, past, steps, step_s, weights_sha256 = "straight", 4, 3, 0.4, None

    def predict(self, xy_m, valid):
        self.seen, self.valid = xy_m, valid
        ahead = np.arange(1, 4)[:, None]
        mean = xy_m[:, -1:] + ahead * (xy_m[:, -1:] - xy_m[:, -2:-1])
        return mean, np.tile(np.eye(2) * (ahead[:, :, None] ** 2), (len(xy_m), 1, 1, 1))


class TestOwnClock:
    @pytest.mark.parametrize(
        ("step_s", "steps"), [(0.1, 30), (0.2, 4), (0.4, 2), (0.4, 8), (0.3, 5), (0.8, 3), (1.0, 4)]
    )
    def test_straight_lines_are_extrapolated_at_any_rate(self, step_s, steps):
        inner = _Straight()
        outer = OnClock(_Forecasts(inner), steps, step_s)
        times = np.arange(-12, 1) * step_s
        past = np.stack([2 * times + 1, -times], axis=-1)[None]
        forecast = outer.predict(past, np.ones((1, 13), bool))
        ahead = step_s * np.arange(1, steps + 1)
        np.testing.assert_allclose(forecast.mean[0], np.stack([2 * ahead + 1, -ahead], axis=-1), atol=1e-9)
        spread = np.sqrt(forecast.cov[0, :, 0, 0])
        assert (np.diff(spread) > 0).all()
        beyond = ahead > 1.2
        np.testing.assert_allclose(spread[beyond], 3 * ahead[beyond] / 1.2)  # grows with the time
        assert inner.valid.all()
        np.testing.assert_allclose(inner.seen[0, -4:, 0], 2 * 0.4 * np.arange(-3, 1) + 1, atol=1e-9)

    def test_positions_beside_unknown_ones_are_unknown(self):
        inner = _Straight()
        known = np.ones((1, 7), bool)
        known[0, 3] = False  # 0.9 s ago: between 0.8 s and 1.2 s lie positions 0.6, 0.9 and 1.2 s ago
        OnClock(_Forecasts(inner), 2, 0.3).predict(np.zeros((1, 7, 2)), known)
        assert inner.valid.tolist() == [[True, False, True, True]]

    def test_the_number_of_past_positions_by_hand(self):
        assert [OnClock(_Forecasts(_Straight()), 3, step_s).past for step_s in (0.1, 0.3, 0.4, 1.0)] == [13, 5, 4, 3]


class _Forecasts:
    """A predictor that returns a plain tuple, as the protocol allows."""

    def __init__(self, inner):
        self._inner = inner

    def __getattr__(self, name):
        return getattr(self._inner, name)

    def predict(self, xy_m, valid):
        from mcaptrack.predictors import Forecast

        return Forecast(*self._inner.predict(xy_m, valid))


def test_saved_files_are_aligned_and_in_order_whatever_the_card_says(tmp_path):
    """The format wants the tensors to begin at a multiple of 8 bytes."""
    for length in range(9):
        save(tmp_path / "w.safetensors", STORED["red"], CARDS["red"] | {"note": "x" * length})
        data = (tmp_path / "w.safetensors").read_bytes()
        header = int.from_bytes(data[:8], "little")
        assert header % 8 == 0
        names = list(json.loads(data[8 : 8 + header]))
        assert names == sorted(names)  # the library's own order differs from run to run
        assert load(tmp_path / "w.safetensors").card["note"] == "x" * length


@pytest.mark.parametrize(("steps", "said"), [(6, 0), (7, 0), (8, 1)])
def test_half_a_step_beyond_its_last_one_is_still_its_own(tmp_path, steps, said):
    path = tmp_path / "w.safetensors"
    save(path, STORED["red"], CARDS["red"] | {"step_s": "1.0"})
    with notices.collected() as heard:
        made = make(f"red:{path}", steps, 0.5)
    assert (made.steps, made.step_s, len(heard)) == (steps, 0.5, said)
    if said:
        words = f"red:{path} predicts 3 s ahead; beyond it, up to 4 s, predictions are a straight line"
        assert heard == [notices.Notice(words, "extrapolated")]


@pytest.mark.parametrize(
    "cov", [[[1, 2], [2, 1]], [[0, 0], [0, 1]], [[-1, 0], [0, 1]], [[1, 0.5], [0.2, 1]], [[1, 0], [0, np.nan]]]
)
def test_matrices_that_are_no_covariances_are_recognised(cov):
    assert not are_covariances(np.full((1, 3, 2, 2), cov))


# Predictors that look at other people: what they are given, the laws that they obey, and `social`


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
        list(Predict(predictor="tests.test_networks:Watching")(frames))
        xy_m, people = SEEN[-1]
        assert xy_m[:, -1].tolist() == [[3, 1], [3, 0]]  # tracks 2 and 1, which have four positions
        assert people.xy_m[:, -1].tolist() == [[0, 5], [3, 1], [3, 0]]
        assert people.row.tolist() == [1, 2]
        np.testing.assert_array_equal(people.xy_m[people.row], xy_m)
        assert people.moment.tolist() == [0, 0, 0]
        assert people.valid.sum(axis=1).tolist() == [1, 4, 4]

    def test_vehicles_and_people_are_not_seen_together_because_their_units_differ(self):
        frames = [frame(n, {1: (n, 0), 2: (9 * n, 1)}, cars=(2,)) for n in range(4)]
        list(Predict(predictor="tests.test_networks:Watching", class_names=((1, "pedestrian"), (3, "car")))(frames))
        xy_m, people = SEEN[-1]
        assert len(set(people.moment.tolist())) == 2
        np.testing.assert_array_equal(people.xy_m[people.row], xy_m)
        assert people.xy_m[1, -1].tolist() == [27 / 4, 1 / 4]  # in units of 4 m

    def test_a_predictor_that_does_not_ask_gets_positions_alone(self):
        frames = [frame(n, {1: (n, 0), 2: (n, 1)}) for n in range(5)]
        list(Predict(predictor="tests.test_networks:Blind")(frames))
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
        list(replace(PROFILES[profile], predictor="tests.test_networks:Watching")(frames))
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
        return mean if self.law == "alone" else (mean, cov)


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
            ("alone", "forecasts: predictor Breaks gave no mean and covariance: ValueError"),
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
