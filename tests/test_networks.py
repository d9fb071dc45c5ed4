"""Networks: against torch, with files that are damaged, on other clocks, and in ONNX."""

from __future__ import annotations

import base64
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
from tests.onnx_graphs import INT64, model, node, tensor, value

#: Small networks, and what torch made of the same numbers.
TORCH = json.loads((Path(__file__).parent / "networks.json").read_text())
STORED = {name: {key: np.array(value) for key, value in TORCH[name]["tensors"].items()} for name in ("red", "lstm")}
CARDS = {name: {"network": name, "steps": "3", "step_s": "0.4"} for name in ("red", "lstm")}
PAST, KNOWN = np.array(TORCH["past"]), np.array(TORCH["known"], bool)

# Networks in ONNX, made with its own helpers: constant velocity of the last step for three steps, from four positions;
# the same with a covariance of as many m^2 as positions are known; the same with its axes in the wrong order.
LINE, WITH_COV, WRONG = (TORCH["onnx"][name] for name in ("line", "with_cov", "wrong"))


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
            ("ret", r"no predictor is called ret; did you mean red\? there are blend, red, social, cv, holt-cv, kalman, lstm, onnx;"),
            ("red:", "or blend:FILE, red:FILE, social:FILE, lstm:FILE, onnx:FILE, not red:"),
            ("cv:file", "or blend:FILE, red:FILE, social:FILE, lstm:FILE, onnx:FILE, not cv:file"),
            ("onnx", "predictor onnx needs a file, as in onnx:FILE"),
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


@pytest.mark.usefixtures("networks_here")
class TestOnnx:
    def file(self, folder, text):
        path = folder / "net.onnx"
        path.write_bytes(base64.b64decode(text))
        return f"onnx:{path}"

    def test_a_network_in_onnx_format(self, tmp_path):
        predictor = make(self.file(tmp_path, LINE), 3, 0.4)
        past = np.array([[[5.0, 5.0], [np.nan, np.nan], [7.0, 5.5]]])
        forecast = predictor.predict(past, np.array([[True, False, True]]))
        np.testing.assert_allclose(forecast.mean[0], [[8, 5.75], [9, 6.0], [10, 6.25]], atol=1e-5)
        kalman = make("kalman", 3, 0.4).predict(past, np.array([[True, False, True]]))
        np.testing.assert_allclose(forecast.cov, kalman.cov)
        assert len(predictor.weights_sha256) == 64
        nothing = predictor.predict(np.empty((0, 3, 2)), np.empty((0, 3), bool))
        assert (nothing.mean.shape, nothing.cov.shape) == ((0, 3, 2), (0, 3, 2, 2))

    def test_a_network_with_a_covariance_and_a_mask_of_gaps(self, tmp_path):
        predictor = make(self.file(tmp_path, WITH_COV), 3, 0.4)
        known = np.array([[True, False, False, True], [True, True, True, True]])
        cov = predictor.predict(np.zeros((2, 4, 2)), known).cov
        np.testing.assert_allclose(cov[:, 0], [2 * np.eye(2), 4 * np.eye(2)])

    def with_step(self, folder, said: str) -> str:
        """A network whose metadata say how long a step is (field 14 of the model: key and value)."""
        entry = b"\x0a\x06step_s\x12" + bytes([len(said)]) + said.encode()
        path = folder / "net.onnx"
        path.write_bytes(base64.b64decode(LINE) + b"\x72" + bytes([len(entry)]) + entry)
        return f"onnx:{path}"

    def test_metadata_say_how_long_a_step_is(self, tmp_path):
        past = np.array([[[5.0, 5.0], [6.0, 5.25], [7.0, 5.5]]])
        forecast = make(self.with_step(tmp_path, "0.8"), 3, 0.8).predict(past, np.ones((1, 3), bool))
        np.testing.assert_allclose(forecast.mean[0], [[8, 5.75], [9, 6.0], [10, 6.25]], atol=1e-5)
        assert make(self.with_step(tmp_path, "0.8"), 6, 0.4).step_s == 0.4  # read between the steps of the network

    @pytest.mark.parametrize("said", ["0", "-0.4", "inf", "nan", "half"])
    def test_a_step_that_is_no_number_of_seconds_is_refused(self, tmp_path, said):
        with pytest.raises(McaptrackError, match=f"its metadata have step_s = '{said}'; a positive number"):
            make(self.with_step(tmp_path, said), 3, 0.4)

    @pytest.mark.parametrize(("declared", "given"), [(12, (8, 8)), ("T", (8, 12)), (8, (8, 12))])
    def test_a_network_that_returns_other_steps_than_it_declares_is_refused(self, tmp_path, declared, given):
        """ONNX Runtime corrects declared shapes that it can infer; it can't infer this one."""
        few, many = given
        nodes = [
            node("Shape", ["obs"], ["all"]),
            node("Slice", ["all", "zero", "one"], ["batch"]),
            node("Greater", ["batch", "one"], ["is more"]),
            node("Where", ["is more", "many", "few"], ["steps"]),
            node("Concat", ["batch", "steps", "two"], ["shape"], axis=0),
            node("ConstantOfShape", ["shape"], ["mean"]),
        ]
        numbers = {"zero": 0, "one": 1, "two": 2, "few": few, "many": many}
        constants = {name: tensor([number], name, INT64) for name, number in numbers.items()}
        outputs = [value("mean", ["B", declared, 2])]
        (tmp_path / "net.onnx").write_bytes(model(nodes, [value("obs", ["B", 4, 2])], outputs, constants))
        with pytest.raises(McaptrackError, match=r"declares the output .*, and returns \[8, 12\] steps"):
            make(f"onnx:{tmp_path / 'net.onnx'}", 12, 0.4)

    def test_beyond_its_steps_it_is_extrapolated_with_a_warning(self, tmp_path):
        name = self.file(tmp_path, LINE)
        with notices.collected() as said:
            make(name, 3, 0.4)
        assert said == []
        with notices.collected() as said:
            make(name, 6, 0.4)
        assert [notice.code for notice in said] == ["extrapolated"]
        assert "predicts 1.2 s ahead; beyond it, up to 2.4 s, predictions are a straight line" in said[0].message

    @pytest.mark.parametrize(("steps", "said"), [(6, 0), (7, 0), (8, 1)])
    def test_half_a_step_beyond_its_last_one_is_still_its_own(self, tmp_path, steps, said):
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
    def test_matrices_that_are_no_covariances_are_recognised(self, cov):
        assert not are_covariances(np.full((1, 3, 2, 2), cov))

    @pytest.mark.parametrize("shape", [["B", 4], ["B", 4, 2, 1], ["B", "L", 2], ["B", 4, 3], ["B", 4, "C"]])
    def test_the_first_input_is_positions_of_a_fixed_number(self, tmp_path, shape):
        path = tmp_path / "net.onnx"
        path.write_bytes(model([node("Identity", ["past"], ["y"])], [value("past", shape)], [value("y", None)]))
        with pytest.raises(
            McaptrackError, match=r"net\.onnx: its first input has to be B x L x 2 with a fixed L, not \["
        ):
            make(f"onnx:{path}", 3, 0.4)

    def test_unusable_networks_are_refused_in_one_line(self, tmp_path):
        name = self.file(tmp_path, WRONG)
        with pytest.raises(McaptrackError, match=r"net\.onnx has to return \(B, T, 2\)"):
            make(name, 3, 0.4)
        (tmp_path / "net.onnx").write_bytes(b"nothing of the kind")
        with pytest.raises(McaptrackError, match=r"net\.onnx is no ONNX file, or is damaged or incomplete"):
            make(name, 3, 0.4)

    def test_without_onnx_runtime_it_says_what_to_install(self, tmp_path, monkeypatch):
        (tmp_path / "other.onnx").write_bytes(b"x")
        monkeypatch.setitem(__import__("sys").modules, "onnxruntime", None)
        with pytest.raises(McaptrackError, match=r"needs ONNX Runtime, which is not installed; `pip install"):
            make(f"onnx:{tmp_path / 'other.onnx'}", 3, 0.4)
