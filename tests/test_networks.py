"""Networks: against torch, with files that are damaged, and on other clocks."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from mcaptrack import log, notices, pipeline
from mcaptrack.errors import McaptrackError
from mcaptrack.predictors import OnClock, are_covariances, make, weights_sha256
from mcaptrack.predictors.linear import LinearPredictor
from mcaptrack.predictors.lstm import Lstm
from mcaptrack.predictors.red import Red
from mcaptrack.predictors.weights import SHIPPED, Weights, load, save
from mcaptrack.sources.ingest import IngestOptions, ingest
from mcaptrack.transforms import Predict
from tests.logs import provenance_of

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
