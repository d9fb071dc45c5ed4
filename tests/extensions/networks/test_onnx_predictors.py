"""Predictors in ONNX: what a network takes and gives, how long its steps are, and which are refused."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import numpy as np
import pytest

from mcaptrack import notices
from mcaptrack.errors import McaptrackError
from mcaptrack.predictors import make
from tests.extensions.networks.onnx_graphs import INT64, model, node, tensor, value

pytestmark = pytest.mark.usefixtures("networks_here")

# Networks made with the helpers of ONNX: constant velocity of the last step for three steps, from four positions; the
# same with a covariance of as many m^2 as positions are known; the same with its axes in the wrong order.
LINE, WITH_COV, WRONG = json.loads(Path(__file__).with_name("networks.json").read_text()).values()


def stored(folder, text):
    path = folder / "net.onnx"
    path.write_bytes(base64.b64decode(text))
    return f"onnx:{path}"


def test_a_network_in_onnx_format(tmp_path):
    predictor = make(stored(tmp_path, LINE), 3, 0.4)
    past = np.array([[[5.0, 5.0], [np.nan, np.nan], [7.0, 5.5]]])
    forecast = predictor.predict(past, np.array([[True, False, True]]))
    np.testing.assert_allclose(forecast.mean[0], [[8, 5.75], [9, 6.0], [10, 6.25]], atol=1e-5)
    kalman = make("kalman", 3, 0.4).predict(past, np.array([[True, False, True]]))
    np.testing.assert_allclose(forecast.cov, kalman.cov)
    assert len(predictor.weights_sha256) == 64
    nothing = predictor.predict(np.empty((0, 3, 2)), np.empty((0, 3), bool))
    assert (nothing.mean.shape, nothing.cov.shape) == ((0, 3, 2), (0, 3, 2, 2))


def test_a_network_with_a_covariance_and_a_mask_of_gaps(tmp_path):
    predictor = make(stored(tmp_path, WITH_COV), 3, 0.4)
    known = np.array([[True, False, False, True], [True, True, True, True]])
    cov = predictor.predict(np.zeros((2, 4, 2)), known).cov
    np.testing.assert_allclose(cov[:, 0], [2 * np.eye(2), 4 * np.eye(2)])


def with_step(folder, said: str) -> str:
    """A network with metadata that say how long a step is (field 14 of the model: key and value)."""
    entry = b"\x0a\x06step_s\x12" + bytes([len(said)]) + said.encode()
    path = folder / "net.onnx"
    path.write_bytes(base64.b64decode(LINE) + b"\x72" + bytes([len(entry)]) + entry)
    return f"onnx:{path}"


def test_metadata_say_how_long_a_step_is(tmp_path):
    past = np.array([[[5.0, 5.0], [6.0, 5.25], [7.0, 5.5]]])
    forecast = make(with_step(tmp_path, "0.8"), 3, 0.8).predict(past, np.ones((1, 3), bool))
    np.testing.assert_allclose(forecast.mean[0], [[8, 5.75], [9, 6.0], [10, 6.25]], atol=1e-5)
    assert make(with_step(tmp_path, "0.8"), 6, 0.4).step_s == 0.4  # read between the steps of the network


@pytest.mark.parametrize("said", ["0", "-0.4", "inf", "nan", "half"])
def test_a_step_that_is_no_number_of_seconds_is_refused(tmp_path, said):
    with pytest.raises(McaptrackError, match=f"its metadata have step_s = '{said}'; a positive number"):
        make(with_step(tmp_path, said), 3, 0.4)


@pytest.mark.parametrize(("declared", "given"), [(12, (8, 8)), ("T", (8, 12)), (8, (8, 12))])
def test_a_network_that_returns_other_steps_than_it_declares_is_refused(tmp_path, declared, given):
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


def test_beyond_its_steps_it_is_extrapolated_with_a_warning(tmp_path):
    name = stored(tmp_path, LINE)
    with notices.collected() as said:
        make(name, 3, 0.4)
    assert said == []
    with notices.collected() as said:
        make(name, 6, 0.4)
    assert [notice.code for notice in said] == ["extrapolated"]
    assert "predicts 1.2 s ahead; beyond it, up to 2.4 s, predictions are a straight line" in said[0].message


@pytest.mark.parametrize("shape", [["B", 4], ["B", 4, 2, 1], ["B", "L", 2], ["B", 4, 3], ["B", 4, "C"]])
def test_the_first_input_is_positions_of_a_fixed_number(tmp_path, shape):
    path = tmp_path / "net.onnx"
    path.write_bytes(model([node("Identity", ["past"], ["y"])], [value("past", shape)], [value("y", None)]))
    with pytest.raises(McaptrackError, match=r"net\.onnx: its first input has to be B x L x 2 with a fixed L, not \["):
        make(f"onnx:{path}", 3, 0.4)


def test_unusable_networks_are_refused_in_one_line(tmp_path):
    name = stored(tmp_path, WRONG)
    with pytest.raises(McaptrackError, match=r"net\.onnx has to return \(B, T, 2\)"):
        make(name, 3, 0.4)
    (tmp_path / "net.onnx").write_bytes(b"nothing of the kind")
    with pytest.raises(McaptrackError, match=r"net\.onnx is no ONNX file, or is damaged or incomplete"):
        make(name, 3, 0.4)


def test_without_onnx_runtime_it_says_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "other.onnx").write_bytes(b"x")
    monkeypatch.setitem(__import__("sys").modules, "onnxruntime", None)
    with pytest.raises(McaptrackError, match=r"needs ONNX Runtime, which is not installed; `pip install"):
        make(f"onnx:{tmp_path / 'other.onnx'}", 3, 0.4)


@pytest.mark.parametrize(
    ("name", "said"),
    [("onnx", "predictor onnx needs a file, as in onnx:FILE"), ("onnx:", "or .*, onnx:FILE, not onnx:")],
)
def test_a_name_without_a_file_is_refused_before_anything_runs(name, said):
    with pytest.raises(McaptrackError, match=said):
        make(name, 3, 0.4)
